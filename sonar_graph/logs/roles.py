"""Which topic of a log plays which part: as the user said, or found by type, and by name where that says too little.

Why the messages of a topic cannot be decoded.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from sonar_graph.errors import LogError, MissingTopicError
from sonar_graph.logs.adapters import SHIPPED, Adapter, LogConfig, Shipped
from sonar_graph.logs.cdr import parse_definition, short_name
from sonar_graph.logs.mcap import Recording, Topic

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


IMU = "sensor_msgs/msg/Imu"
DVL = "marine_acoustic_msgs/msg/Dvl"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
DETECTIONS = "sonar_graph_msgs/msg/LandmarkDetections"
LANDMARK_MAP = "sonar_graph_msgs/msg/LandmarkMap"
SONAR_IMAGE = "marine_acoustic_msgs/msg/ProjectedSonarImage"
TF = "tf2_msgs/msg/TFMessage"
SONAR = "sonar"
"""The role of sonar images."""
_DEFAULTS = LogConfig()


@dataclass(frozen=True)
class Role:
    """A part that a topic can play."""

    name: str
    shipped: tuple[Shipped, ...]
    """The adapters that come along for it."""
    is_required: bool = False

    def describe(self) -> str:
        """What is looked for."""
        by_words: dict[tuple[str, ...], list[str]] = {}
        for offer in self.shipped:
            names = by_words.setdefault(offer.words, [])
            if short_name(offer.adapter.type) not in names:
                names.append(short_name(offer.adapter.type))
        return ", or ".join(
            ", ".join(names) + (f" on a topic with {' or '.join(map(repr, words))} in its name" if words else "")
            for words, names in by_words.items()
        )


ROLES = {name: Role(name, shipped, is_required=name in ("imu", "dvl")) for name, shipped in SHIPPED.items()}
SEQUENCE_ROLES = tuple(name for name in ROLES if name != SONAR)
"""Those that make a `Sequence`; sonar images are read by themselves."""


@dataclass(frozen=True)
class Choice:
    """The topic that plays a part, or why none does."""

    role: Role
    topic: str | None
    reason: str
    adapter: Adapter | None = None
    """How its messages are read."""
    candidates: tuple[str, ...] = field(default=())
    """The topics that fit, where they are several."""
    could_be: tuple[str, ...] = field(default=())
    """Topics that could be read for it, but whose names do not say that they play it."""
    is_off: bool = False
    """The user wants nothing to play it."""


def wanted_types(config: LogConfig = _DEFAULTS, roles: Iterable[str] = SEQUENCE_ROLES) -> frozenset[str]:
    """Types whose messages may be needed, without the ``msg``."""
    shipped = {short_name(offer.adapter.type) for name in roles for offer in ROLES[name].shipped}
    return config.types() | shipped | {short_name(TF)}


def choose_topic(role: Role, recording: Recording, config: LogConfig = _DEFAULTS, wanted: str | None = None) -> Choice:
    """The topic for a part, and how to read it; a reason instead of an error where there is none.

    Parameters
    ----------
    role, recording
        The part and the log.
    config
        What the user said about topics; its topic goes before a search by type.
    wanted
        The topic that the user chose, before that of the configuration.

    Raises
    ------
    LogError
        When the configuration names fields that the messages which it is about do not have.
    """
    choice = _choose(role, recording, config, wanted)
    for topic in _topics_meant(choice, recording, config, wanted):
        config.require_fields(role.name, topic.type_name, topic.definition())
    return choice


def _topics_meant(choice: Choice, recording: Recording, config: LogConfig, wanted: str | None) -> list[Topic]:
    """The topics that a table of the configuration is about; none where there is no table."""
    table, topics = config.table(choice.role.name), recording.topics
    if not table or choice.is_off or choice.candidates:
        return []
    named = choice.topic or wanted or table.get("topic")
    if named:
        meant = [topics[named]] if named in topics else []
    elif "type" in table:
        meant = [t for t in topics.values() if short_name(t.type_name) == short_name(table["type"])]
    else:
        meant = [t for t in topics.values() if any(_fits(choice.role, t, general=general) for general in (False, True))]
    return [t for t in meant if refusal(t) is None]


def _choose(role: Role, recording: Recording, config: LogConfig, wanted: str | None) -> Choice:
    table = config.table(role.name)
    if table.get("use") is False and wanted is None:
        return Choice(role, None, f"switched off in {config.source}", is_off=True)
    named = wanted or table.get("topic") or None
    if named is not None:
        return _named(role, recording, config, named, "by name" if wanted else f"in {config.source}")
    if "type" in table:
        fitting = [t for t in recording.topics.values() if short_name(t.type_name) == short_name(table["type"])]
        return _only(role, recording, config, fitting) or Choice(
            role, None, f"no {table['type']}, which {config.source} asks for"
        )
    return _by_type(role, recording, config)


def _named(role: Role, recording: Recording, config: LogConfig, name: str, how: str) -> Choice:
    topic = recording.topics.get(name)
    if topic is None:
        return Choice(role, None, f"{name} was chosen but is not in the log")
    adapter = adapter_for(role, topic, config)
    if isinstance(adapter, str):
        return Choice(role, None, f"{name} was chosen but {adapter}")
    return Choice(role, name, f"chosen {how}", adapter)


def _by_type(role: Role, recording: Recording, config: LogConfig) -> Choice:
    for general in (False, True):
        fitting = [t for t in recording.topics.values() if _fits(role, t, general=general)]
        if (choice := _only(role, recording, config, fitting)) is not None:
            return choice
    others = tuple(t.name for t in recording.topics.values() if not isinstance(adapter_for(role, t, config), str))
    passed_over = f"; {', '.join(others)} only if chosen: --topic {role.name}={others[0]}" if others else ""
    return Choice(role, None, f"no {role.describe()}{passed_over}", could_be=others)


def _fits(role: Role, topic: Topic, *, general: bool) -> bool:
    return any(
        short_name(offer.adapter.type) == short_name(topic.type_name)
        and (not offer.words or any(word in topic.name.lower() for word in offer.words))
        for offer in role.shipped
        if offer.is_general == general
    )


def _only(role: Role, recording: Recording, config: LogConfig, fitting: list[Topic]) -> Choice | None:
    """The only one of the topics that fit; None where none does."""
    adapters = {topic.name: adapter_for(role, topic, config) for topic in fitting}
    usable = {name: adapter for name, adapter in adapters.items() if not isinstance(adapter, str)}
    if len(usable) > 1:
        return Choice(role, None, f"{len(usable)} topics fit: {', '.join(usable)}", candidates=tuple(usable))
    for name, adapter in usable.items():
        as_said = f", read as {config.source} says" if config.table(role.name) else ""
        return Choice(role, name, f"the only {recording.topics[name].type_name} that fits{as_said}", adapter)
    reasons = [f"{name} {reason}" for name, reason in adapters.items()]
    return Choice(role, None, "; ".join(reasons)) if reasons else None


def adapter_for(role: Role, topic: Topic, config: LogConfig) -> Adapter | str:
    """How a topic would be read in a part, or why it cannot be."""
    if (reason := refusal(topic)) is not None:
        return reason
    table = config.table(role.name)
    if "type" in table and short_name(table["type"]) != short_name(topic.type_name):
        return f"is a {topic.type_name}, and {config.source} asks for a {table['type']}"
    adapters = config.adapters(role.name, topic.type_name)
    if not adapters:
        return f"is a {topic.type_name}, for which no adapter comes along: name type and fields in --log-config"
    missing = [adapter.missing_in(topic.definition()) for adapter in adapters]
    for adapter, paths in zip(adapters, missing, strict=True):
        if not paths:
            return adapter
    return f"has no field {', '.join(missing[-1])}"


def choose_topics(
    recording: Recording,
    wanted: Mapping[str, str],
    config: LogConfig = _DEFAULTS,
    roles: Iterable[str] = SEQUENCE_ROLES,
) -> dict[str, Choice]:
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
    choices = {name: choose_topic(ROLES[name], recording, config, wanted.get(name)) for name in roles}
    for choice in choices.values():
        _require(choice, recording, wanted, config)
    return choices


def advice(choice: Choice) -> str:
    """How to choose one of several topics, in the words of the command line, of Python, and of a configuration."""
    role, topic = choice.role.name, choice.candidates[0]
    return f"--topic {role}={topic} (topics={{{role!r}: {topic!r}}} in Python, [{role}] topic in a log configuration)"


def _require(choice: Choice, recording: Recording, wanted: Mapping[str, str], config: LogConfig) -> None:
    role, path = choice.role, recording.path
    if choice.candidates:
        raise LogError(f"{path}: for {role.name}, {choice.reason}; choose one: {advice(choice)}")
    is_asked_for = role.name in wanted or {"topic", "type"} & config.table(role.name).keys()
    if role.is_required and not recording.topics:
        raise MissingTopicError(f"{path}: has no messages: {recording.ending or 'see whether the recorder wrote any'}")
    if choice.topic is None and (role.is_required or (is_asked_for and not choice.is_off)):
        needed = " (IMU and Doppler log must both be in the log, for recognising in sonar images too)"
        raise MissingTopicError(
            f"{path}: nothing for {role.name}: {choice.reason}{needed if role.is_required else ''}; the log has "
            f"{topic_list(recording)}; what other types are is said in a log configuration, which "
            f"`sonar-graph inspect {path} --toml` begins"
        )


def topic_list(recording: Recording) -> str:
    """The topics of a log with their types, for a message."""
    entries = [
        f"{t.name} ({t.type_name or 'no type'}{'' if (reason := refusal(t)) is None else f', {reason}'})"
        for t in recording.topics.values()
    ]
    return ", ".join(entries) or "no messages at all"
