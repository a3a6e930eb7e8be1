"""The log configuration to start from: what would be used, and what might be for roles that nothing plays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters.adapter import leaf_fields
from sonar_graph.logs.adapters.config import LogConfig, shipped_like
from sonar_graph.logs.adapters.toml_text import comment, plain_lines, table_text
from sonar_graph.logs.container import Recording, Topic
from sonar_graph.logs.message_definitions import short_name
from sonar_graph.logs.roles import TF, Choice

_MOST_FIELDS = 24
_UNKNOWN_TOPIC = ['topic = "/..."', 'type = "package/msg/Type"']
_EXAMPLES = {
    "imu": 'angular_velocity = ["...", "...", "..."]\nlinear_acceleration = ["...", "...", "..."]',
    "dvl": 'velocity = ["...", "...", "..."]',
}


def starting_config(recording: Recording, choices: Sequence[Choice], config: LogConfig) -> str:
    """TOML that, read back unchanged, makes the same choices; comments say what else might be chosen."""
    used = {choice.topic for choice in choices}
    unknown = [topic for topic in recording.topics.values() if topic.name not in used and _is_unknown(topic)]
    parts = [f"# What the topics of {recording.path.name} are. Every key of a table that comes along may be left out."]
    parts += [_table(recording, choice, config.table(choice.role.name)) for choice in choices]
    if any(choice.topic is None and choice.role.is_required for choice in choices):
        parts += [comment(_described(topic)) for topic in unknown]
    return "\n\n".join(parts) + "\n"


def _table(recording: Recording, choice: Choice, said: Mapping[str, Any]) -> str:
    role = choice.role.name
    if choice.topic is not None and choice.adapter is not None:
        topic = recording.topics[choice.topic]
        base = shipped_like(role, topic.type_name, topic.definition())
        return table_text(role, choice.topic, choice.adapter, base)
    if said:  # it stays as it is, also where nothing in this log answers to it
        return "\n".join([comment(choice.reason), f"[{role}]", *plain_lines(said)])
    named = choice.candidates or choice.could_be
    if named:
        return comment("\n".join([f"[{role}]  # one of", *(f'topic = "{name}"' for name in named)]))
    if choice.role.is_required:
        return comment("\n".join(_template(recording, role)))
    return comment(f"[{role}]  # nothing found")


def _template(recording: Recording, role: str) -> list[str]:
    """A table to fill in for a type that does not come along; a topic whose name says the role is proposed."""
    likely = [t for t in recording.topics.values() if role in t.name.lower() and t.is_ros2]
    lines = [f"[{role}]  # nothing of a type that comes along; the fields of other topics are listed below"]
    lines += [f'topic = "{likely[0].name}"', f'type = "{likely[0].type_name}"'] if likely else _UNKNOWN_TOPIC
    if likely and "header.stamp.sec" not in _leaves(likely[0]):
        lines.append('stamp = "log"  # messages without a header: when they were recorded')
    return [*lines, _EXAMPLES[role]]


def _is_unknown(topic: Topic) -> bool:
    return topic.is_ros2 and short_name(topic.type_name) != short_name(TF)


def _described(topic: Topic) -> str:
    return "\n".join(_fields(topic))


def _fields(topic: Topic) -> Iterator[str]:
    paths = _leaves(topic)
    yield f"{topic.name} is a {topic.type_name} with the fields"
    yield from (f"  {path}{size}" for path, size in list(paths.items())[:_MOST_FIELDS])
    if len(paths) > _MOST_FIELDS:
        yield f"  and {len(paths) - _MOST_FIELDS} more"


def _leaves(topic: Topic) -> dict[str, str]:
    """Paths of a type's fields, with ``[n]`` or ``[]`` for arrays and sequences; none where it cannot be read."""
    try:
        return dict(leaf_fields(topic.definition()))
    except LogError:
        return {}
