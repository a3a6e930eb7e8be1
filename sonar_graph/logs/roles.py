"""Roles and the topics that play them, chosen by the user or found by message type and, where that is general, name.

A role is a part of a `Sequence` (IMU, Doppler log, depth, heading, fixes, detections, truth) or the sonar images. Every
choice comes with its reason, for notes, error messages and `inspect_log` (docs/design/0004-logs.md).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from sonar_graph.errors import ArgumentError, LogError, MissingTopicError
from sonar_graph.logs.adapters import (
    SHIPPED,
    TRUTH_WORDS,
    Adapter,
    LogConfig,
    shipped_for,
)
from sonar_graph.logs.cdr import parse_definition, short_name
from sonar_graph.logs.mcap import Recording, TimeWindow, Topic

IMU = "sensor_msgs/msg/Imu"
DVL = "marine_acoustic_msgs/msg/Dvl"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
DETECTIONS = "sonar_graph_msgs/msg/LandmarkDetections"
LANDMARK_MAP = "sonar_graph_msgs/msg/LandmarkMap"
SONAR_IMAGE = "marine_acoustic_msgs/msg/ProjectedSonarImage"
HEADING = "sonar_graph_msgs/msg/Heading"
POINT = "geometry_msgs/msg/PointStamped"
DROPPED = "sonar_graph_msgs/msg/Dropped"
TF = "tf2_msgs/msg/TFMessage"
OTHER_WAYS = "record ROS 2 messages, or write tables for `sonar-graph convert csv`"
SONAR = "sonar"
"""The role of sonar images."""
LONGEST = 300
"""Characters of a refusal, without the names of files."""
_DEFAULTS = LogConfig()


ROLES = SHIPPED
"""Adapters by role."""
NAVIGATION = ("imu", "dvl")
"""Roles without which nothing is known of the motion but what images show."""
SEQUENCE_ROLES = tuple(name for name in ROLES if name != SONAR)
"""Roles that make a `Sequence`, called like its fields; sonar images are read by themselves."""


def may_play(role: str, topic: Topic) -> bool:
    """True where a topic's name allows a role: what is called truth is no measurement."""
    is_truth = any(word in topic.name.lower() for word in TRUTH_WORDS)
    return role in ("truth", "true_landmarks") or not is_truth


def fits(role: str, topic: Topic, *, general: bool) -> bool:
    """True where a topic fits one of the shipped adapters, of those that are general or of the others."""
    return may_play(role, topic) and any(
        topic.is_a(offer.adapter.type)
        and any(word in topic.name.lower() for word in offer.words or ("",))
        for offer in ROLES[role]
        if offer.is_general == general
    )


@dataclass(frozen=True)
class Choice:
    """The topic that plays a role, or the reason why none does."""

    role: str
    topic: str | None
    """None: no topic plays it, or several could."""
    reason: str
    adapter: Adapter | None = None
    """Adapter for its messages."""
    candidates: tuple[str, ...] = ()
    """Topics that fit, where they are several."""
    could_be: tuple[str, ...] = ()
    """Topics of a fitting type whose names do not show that they play the role."""
    is_off: bool = False
    """The user wants nothing to play it."""

    def advice(self) -> str:
        """Advice to choose one of several topics, on the command line, in Python and in a log configuration."""
        topic = self.candidates[0]
        in_python = f"(topics={{{self.role!r}: {topic!r}}} in Python, [{self.role}] topic in a log configuration)"
        return f"--topic {self.role}={topic} {in_python}"


def wanted_types(
    config: LogConfig = _DEFAULTS, roles: Iterable[str] = SEQUENCE_ROLES
) -> frozenset[str]:
    """Types whose messages may be needed, without the ``msg``."""
    shipped = [one.adapter.type for name in roles for one in ROLES[name]]
    return config.types() | set(map(short_name, [*shipped, TF, DROPPED]))


def refusal(topic: Topic) -> str | None:
    """Reason why the messages of a topic cannot be decoded, which completes "/imu ..."; None: they can."""
    if topic.encoding == "ros1":
        return f"has ROS 1 messages: `sonar-graph convert rosbag {topic.file} -o OUT.mcap` makes a log of them"
    if topic.encoding != "cdr":
        return f"has messages in {topic.encoding or 'no named encoding'}; only ROS 2 CDR is read: {OTHER_WAYS}"
    if not topic.schema_encoding:
        return f"has no definition of its messages: {OTHER_WAYS}"
    if topic.schema_encoding == "ros2idl":
        return "has a definition in ros2idl; only ros2msg is read: record it where the type's .msg file is installed"
    if topic.schema_encoding != "ros2msg":
        return f"has a definition in {topic.schema_encoding}; only ros2msg is read: {OTHER_WAYS}"
    try:
        parse_definition(topic.type_name, topic.schema_text)
    except LogError as error:
        return f"has a definition that cannot be read: {error}"
    return None


def adapter_for(role: str, topic: Topic, config: LogConfig) -> Adapter | str:
    """Adapter for a topic in a role, or the reason why it is missing."""
    # first what no role can read
    if (reason := refusal(topic)) is not None:
        return reason
    table = config.table(role)
    if "type" in table and not topic.is_a(table["type"]):
        return f"is a {topic.type_name}, and {config.source} asks for a {table['type']}"
    lacking: list[str] = []
    for adapter in config.adapters(role, topic.type_name):
        lacking = adapter.missing_in(topic.definition())
        if not lacking:
            return adapter.refusal(topic) or adapter
    if lacking:
        return f"has no field {', '.join(lacking)}"
    if others := [other for other in ROLES if shipped_for(other, topic.type_name)]:
        roles = " or ".join(others)
        return f"is a {topic.type_name}; no adapter of role {role} reads it, it is a type of role {roles}"
    return f"is a {topic.type_name}, for which no adapter is shipped: name type and fields in --log-config"


def choose_topic(
    role: str,
    recording: Recording,
    config: LogConfig = _DEFAULTS,
    wanted: str | None = None,
) -> Choice:
    """Choose the topic for a role and its adapter; without one, the choice has a reason instead of an error.

    A topic that the user ``wanted`` goes before that of the configuration, and this before a search by type. A
    configuration that names fields which the messages do not have is refused.
    """
    table = config.table(role)
    topics = list(recording.topics.values())
    if table.get("use") is False and wanted is None:
        return Choice(role, None, f"switched off in {config.source}", is_off=True)
    named = wanted or table.get("topic")
    asked = table.get("type")
    if named:
        found = [topic for topic in topics if topic.name == named]
        searches = [found]
        adapter = adapter_for(role, found[0], config) if found else "is not in the log"
        if isinstance(adapter, str):
            choice = Choice(role, None, f"{named} was chosen but {adapter}")
        else:
            by = "by name" if wanted else f"in {config.source}"
            choice = Choice(role, named, f"chosen {by}", adapter)
    else:
        # a type that any sensor may send counts only where no other fits
        searches = [
            [t for t in topics if fits(role, t, general=g)] for g in (False, True)
        ]
        if asked:
            searches = [[topic for topic in topics if topic.is_a(asked)]]
        choices = (_only(role, config, fitting) for fitting in searches)
        choice = next(filter(None, choices), None) or _none_fits(role, topics, config)
    if table and not choice.candidates:
        for topic in [topic for fitting in searches for topic in fitting]:
            if refusal(topic) is None and choice.topic in (None, topic.name):
                config.require_fields(role, topic.type_name, topic.definition())
    return choice


def _none_fits(role: str, topics: list[Topic], config: LogConfig) -> Choice:
    """Choice of no topic, with those that the user may choose by name."""
    if asked := config.table(role).get("type"):
        return Choice(role, None, f"no {asked}, which {config.source} asks for")
    others = tuple(
        topic.name
        for topic in topics
        if may_play(role, topic)
        and not isinstance(adapter_for(role, topic, config), str)
    )
    reason = f"no topic of a known type, such as {ROLES[role][0].adapter.type}"
    if others:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        reason += f"; {others[0]}{more} only if chosen: --topic {role}={others[0]}"
    return Choice(role, None, reason, could_be=others)


def _only(role: str, config: LogConfig, fitting: list[Topic]) -> Choice | None:
    """Choose the only usable topic of those that fit; None where none fits."""
    usable: dict[str, Adapter] = {}
    reasons = []
    for topic in fitting:
        adapter = adapter_for(role, topic, config)
        if isinstance(adapter, str):
            reasons.append(f"{topic.name} {adapter}")
        else:
            usable[topic.name] = adapter
    if len(usable) > 1:
        reason = f"{len(usable)} topics fit: {', '.join(usable)}"
        return Choice(role, None, reason, candidates=tuple(usable))
    for name, adapter in usable.items():
        as_told = f", read as {config.source} says" if config.table(role) else ""
        reason = f"the only {adapter.type} that fits{as_told}"
        return Choice(role, name, reason, adapter)
    return Choice(role, None, "; ".join(reasons)) if reasons else None


Window = TimeWindow | tuple[float | str | None, float | str | None]
"""Part of a log: also start and end alone, in seconds from its beginning or as dates; None: no limit."""


def as_window(value: Window | None, call: str) -> TimeWindow | None:
    """A time window; an `ArgumentError` that names the ``call`` where a value is no time."""
    if isinstance(value, TimeWindow | None):
        return value
    if isinstance(value, tuple | list) and len(value) == 2:
        limits = (None if limit is None else str(limit) for limit in value)
        return TimeWindow.parse(*limits)
    raise ArgumentError(
        f"{call}(path, window=(START, END)): expected two times, in seconds from the log's beginning such as (0, 10), "
        f"not {value!r:.60}"
    )


_IN_PYTHON = {
    "log_config": "config",
    "topic": "topics",
    "start": "window",
    "end": "window",
}
"""Arguments of functions by the options of the commands."""


def refuse_unknown(unknown: Mapping[str, object], call: str) -> None:
    """Refuse arguments that a function does not have; those called like an option of a command are named."""
    for name in unknown:
        fault = f"{call} has no argument {name}="
        if name in _IN_PYTHON:
            option = name.replace("_", "-")
            fault += f"; `--{option}` of the commands is {_IN_PYTHON[name]}="
        raise ArgumentError(fault)


def require_roles(wanted: Mapping[str, str]) -> None:
    """Refuse topics that are chosen for roles that do not exist."""
    if unknown := wanted.keys() - ROLES.keys():
        raise LogError(
            f"there is no role {', '.join(sorted(unknown))}; topics are chosen for {', '.join(ROLES)}"
        )


def require_topics(
    recording: Recording, wanted: Mapping[str, str], config: LogConfig, call: str
) -> None:
    """Refuse roles that do not exist, and topics that are not in a log, by an error that lists those that are."""
    given: object = wanted
    if not isinstance(given, Mapping):
        raise ArgumentError(
            f"{call}(path, topics={{'imu': '/imu/data'}}): expected topics by role, not {type(given).__name__}"
        )
    require_roles(wanted)
    for role, topic in wanted.items():
        if topic not in recording.topics:
            reason = f"{topic} was chosen but is not in the log"
            raise _missing(recording, role, reason, config)


_OF_THE_DRIVER = (
    "stamp",
    "stamp_unit_s",
    "stamp_offset_s",
    "frame_id_field",
    "frame_id",
    "rotation",
)
"""Settings of an adapter that hold for all that one message brings."""


def choose_each(
    recording: Recording,
    wanted: Mapping[str, str],
    config: LogConfig = _DEFAULTS,
    roles: Iterable[str] = SEQUENCE_ROLES,
) -> dict[str, Choice]:
    """Choose the topic for each role (`choose_topic`).

    Of several orientations that of the topic in use as IMU is the heading, with the stamps and axes stated for the IMU.
    """
    choices = {
        name: choose_topic(name, recording, config, wanted.get(name)) for name in roles
    }
    imu = choices.get("imu")
    heading = choices.get("heading")
    if imu is None or imu.topic is None or heading is None:
        return choices
    if imu.topic in heading.candidates:
        adapter = adapter_for(heading.role, recording.topics[imu.topic], config)
        if not isinstance(adapter, str):
            reason = "the orientation of the topic in use as IMU"
            heading = Choice(heading.role, imu.topic, reason, adapter)
    if heading.topic == imu.topic and heading.adapter is not None:
        # one message brings both, so stamps and axes hold for both
        unsaid = [key for key in _OF_THE_DRIVER if key not in config.table("heading")]
        adapter = heading.adapter.model_copy(
            update={key: getattr(imu.adapter, key) for key in unsaid}
        )
        heading = replace(heading, adapter=adapter)
    return choices | {"heading": heading}


def choose_topics(
    recording: Recording,
    wanted: Mapping[str, str],
    config: LogConfig = _DEFAULTS,
    roles: Iterable[str] = SEQUENCE_ROLES,
) -> dict[str, Choice]:
    """Choose the topic for each role; a LogError where several fit one, or ``wanted`` names no role.

    A needed role without a topic, and a topic that is named but not there, are a MissingTopicError, which lists the
    topics that are.
    """
    path = recording.path
    require_roles(wanted)
    choices = choose_each(recording, wanted, config, roles)
    for name, choice in choices.items():
        is_required = name in NAVIGATION
        if choice.candidates:
            raise LogError(
                f"{path}: for {name}, {choice.reason}; choose one: {choice.advice()}"
            )
        if is_required and not recording.topics:
            raise MissingTopicError(
                f"{path}: has no messages: {recording.ending or 'see whether the recorder wrote any'}"
            )
        is_asked_for = name in wanted or {"topic", "type"} & config.table(name).keys()
        is_needed = is_required or (is_asked_for and not choice.is_off)
        if choice.topic is None and is_needed:
            raise _missing(recording, name, choice.reason, config)
    return choices


def _missing(
    recording: Recording, role: str, reason: str, config: LogConfig
) -> MissingTopicError:
    """Refusal of a log that lacks a role, with as many of its topics as `LONGEST` allows."""
    path = recording.path
    topics = []
    way_out = f"; `sonar-graph inspect {path} --toml` begins a log configuration"
    for topic in recording.topics.values():
        fault = refusal(topic) or ""
        if "`" in fault and fault in reason:
            way_out = ""  # the reason has its own
        said = f", {fault}" if fault and fault not in reason else ""
        topics.append(f"{topic.name} ({topic.type_name or 'no type'}{said})")
    way_out += images_alone(recording, config)
    begin = f"{path.name}: nothing for {role}: {reason}"
    spare = LONGEST - len(begin) - len(way_out.replace(str(path), path.name))
    # name as many topics as fit into one line
    for count in range(len(topics), 0, -1):
        more = f" and {len(topics) - count} more" if count < len(topics) else ""
        listed = f"; the log has {', '.join(topics[:count])}{more}"
        if len(listed) <= spare:
            way_out = listed + way_out
            break
    return MissingTopicError(f"{path}: nothing for {role}: {reason}{way_out}")


def images_alone(recording: Recording, config: LogConfig) -> str:
    """Words for the end of a sentence about a log that lacks a role, on what its sonar images are good for."""
    if choose_topic(SONAR, recording, config).topic is None:
        return ""
    path = recording.path
    return (
        f"; `sonar-graph recognise {path}` needs its sonar images only, and `sonar-graph join {path} NAV` brings in "
        "IMU and Doppler log of another file"
    )
