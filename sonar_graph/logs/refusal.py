"""Why the messages of a topic cannot be decoded."""

from __future__ import annotations

from sonar_graph.errors import LogError
from sonar_graph.logs.schema import parse_definition
from sonar_graph.logs.topic import Topic

_ADVICE = {
    "ros2idl": "record it again where the type's .msg file is installed, or publish a type that is defined by one",
}


def refusal(topic: Topic) -> str | None:
    """What is in the way, which completes "/imu ..."; None where nothing is."""
    if topic.encoding != "cdr":
        return f"has messages in {topic.encoding or 'no named encoding'}; only ROS 2 CDR is read"
    if not topic.schema_encoding:
        return "has no definition of its messages"
    if topic.schema_encoding != "ros2msg":
        advice = _ADVICE.get(topic.schema_encoding)
        return f"has a definition in {topic.schema_encoding}; only ros2msg is read" + (f": {advice}" if advice else "")
    try:
        parse_definition(topic.type_name, topic.schema_text)
    except LogError as error:
        return f"has a definition that cannot be read: {error}"
    return None
