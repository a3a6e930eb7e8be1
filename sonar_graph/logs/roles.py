"""Which topic of a log plays which part: found by type, and by name where a type alone says too little."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from sonar_graph.errors import LogError, MissingTopicError
from sonar_graph.logs.container import Recording, Topic
from sonar_graph.logs.message_definitions import short_name

IMU = "sensor_msgs/msg/Imu"
DVL = "marine_acoustic_msgs/msg/Dvl"
PRESSURE = "sensor_msgs/msg/FluidPressure"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
DETECTIONS = "sonar_graph_msgs/msg/LandmarkDetections"
LANDMARK_MAP = "sonar_graph_msgs/msg/LandmarkMap"
TF = "tf2_msgs/msg/TFMessage"

_TRUTH_WORDS = ("ground_truth", "groundtruth", "truth")


@dataclass(frozen=True)
class Role:
    """A part that a topic can play."""

    name: str
    types: Mapping[str, tuple[str, ...]]
    """Message types that fit, each with the words of which a topic's name must hold one; none: any name fits."""
    is_required: bool = False

    def fits(self, topic: Topic, *, by_name: bool = True) -> bool:
        """Whether a topic can play this part."""
        for type_name, words in self.types.items():
            if short_name(type_name) == short_name(topic.type_name) and topic.is_ros2:
                return not by_name or not words or any(word in topic.name.lower() for word in words)
        return False

    def describe(self) -> str:
        """What is looked for."""
        by_words: dict[tuple[str, ...], list[str]] = {}
        for type_name, words in self.types.items():
            by_words.setdefault(words, []).append(type_name)
        return " or ".join(
            " or ".join(names) + (f" on a topic with {words[0]!r} in its name" if words else "")
            for words, names in by_words.items()
        )


ROLES = {
    role.name: role
    for role in (
        Role("imu", {IMU: ()}, is_required=True),
        Role("dvl", {DVL: ()}, is_required=True),
        Role("depth", {PRESSURE: (), POSE_WITH_COVARIANCE: ("depth",), POSE: ("depth",)}),
        Role("detections", {DETECTIONS: ()}),
        Role("truth", {ODOMETRY: _TRUTH_WORDS}),
        Role("true_landmarks", {LANDMARK_MAP: _TRUTH_WORDS}),
    )
}
READ_TYPES = frozenset(short_name(name) for role in ROLES.values() for name in role.types) | {short_name(TF)}
"""Types whose messages are needed, without the ``msg``."""


@dataclass(frozen=True)
class Choice:
    """The topic that plays a part, or why none does."""

    role: Role
    topic: str | None
    reason: str
    candidates: tuple[str, ...] = field(default=())
    """The topics that fit, where they are several."""


def choose_topic(role: Role, recording: Recording, wanted: str | None = None) -> Choice:
    """The topic for a part; a reason instead of an error where there is none.

    Parameters
    ----------
    role, recording
        The part and the log.
    wanted
        The topic that the user chose, which then only needs the right type.
    """
    topics = recording.topics
    if wanted is not None:
        if wanted in topics and role.fits(topics[wanted], by_name=False):
            return Choice(role, wanted, "chosen by name")
        found = f"is a {topics[wanted].type_name}" if wanted in topics else "is not in the log"
        return Choice(role, None, f"{wanted} was chosen but {found}")
    fitting = tuple(name for name, topic in topics.items() if role.fits(topic))
    if len(fitting) == 1:
        return Choice(role, fitting[0], f"the only {topics[fitting[0]].type_name} that fits")
    if fitting:
        return Choice(role, None, f"{len(fitting)} topics fit: {', '.join(fitting)}", fitting)
    others = [name for name, topic in topics.items() if role.fits(topic, by_name=False)]
    passed_over = f"; {', '.join(others)} not used because of its name" if others else ""
    return Choice(role, None, f"no {role.describe()}{passed_over}")


def choose_topics(recording: Recording, wanted: Mapping[str, str]) -> dict[str, Choice]:
    """The choice for each part.

    Raises
    ------
    MissingTopicError
        When a needed part has no topic, or one that the user named is not there; listing the topics that are.
    LogError
        When several topics fit one part, or ``wanted`` names a part that does not exist.
    """
    unknown = wanted.keys() - ROLES.keys()
    if unknown:
        raise LogError(f"there is no role {', '.join(sorted(unknown))}; topics are chosen for {', '.join(ROLES)}")
    choices = {name: choose_topic(role, recording, wanted.get(name)) for name, role in ROLES.items()}
    for choice in choices.values():
        _require(choice, recording, wanted)
    return choices


def _require(choice: Choice, recording: Recording, wanted: Mapping[str, str]) -> None:
    role, path = choice.role, recording.path
    if choice.candidates:
        example = f"topics={{{role.name!r}: {choice.candidates[0]!r}}}"
        raise LogError(f"{path}: for {role.name}, {choice.reason}; choose one: {example}")
    if choice.topic is None and (role.is_required or role.name in wanted):
        raise MissingTopicError(
            f"{path}: nothing for {role.name}: {choice.reason}; the log has {topic_list(recording)}"
        )


def topic_list(recording: Recording) -> str:
    """The topics of a log with their types, for a message."""
    entries = [
        f"{t.name} ({t.type_name or 'no type'}{'' if t.is_ros2 else ', not ROS 2 CDR'})"
        for t in recording.topics.values()
    ]
    return ", ".join(entries) or "no messages at all"
