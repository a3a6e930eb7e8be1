"""What is in a log: topics, their times and gaps, which part each would play, and what is damaged.

The log configuration to start from: what would be used, and what might be for roles that nothing plays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sonar_graph.errors import CalibrationError, LogError, SonarGraphError
from sonar_graph.logs.adapters import LogConfig, comment, leaf_fields, plain_lines, shipped_like, table_text
from sonar_graph.logs.cdr import Struct, decode, definition, parse_definition, short_name
from sonar_graph.logs.checks import stamp_faults
from sonar_graph.logs.mcap import STAMP_BYTES, Keep, Recording, TimeWindow, Topic, scan
from sonar_graph.logs.message_table import NS_PER_S
from sonar_graph.logs.reading import Assembly
from sonar_graph.logs.roles import ROLES, SEQUENCE_ROLES, SONAR, TF, Choice, choose_topic, refusal, wanted_types
from sonar_graph.logs.sonar_frames import describe_frames, read_sonar_frames
from sonar_graph.logs.vehicle_setup import read_calibration, read_notes, recorded_name, static_frames
from sonar_graph.measurements import Ints

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


_FRAMES_NAMED = 6


@dataclass(frozen=True)
class TopicSummary:
    """One topic with its times; of the sensors' headers where its messages have one, else of the recording."""

    name: str
    type_name: str
    encoding: str
    """Such as ``cdr`` or ``protobuf``."""
    messages: int
    first_stamp_ns: int
    last_stamp_ns: int
    rate_hz: float
    """Messages per second between the first and the last; 0 where all have one stamp."""
    largest_gap_s: float
    """Longest time between successive stamps."""
    stamps_from: str
    """``header`` or ``log``."""
    jitter_s: float = 0.0
    """Scatter of the times between successive stamps: half of the central 68 %."""
    lag_s: float | None = None
    """Median time of recording less stamp; None where messages have no stamps."""
    stamp_faults: tuple[str, ...] = ()
    """What is wrong with the stamps."""
    refusal: str | None = None
    """Why its messages cannot be decoded, which completes "/imu ..."; None: they can."""


@dataclass(frozen=True)
class RoleSummary:
    """Which topic plays a part."""

    role: str
    topic: str | None
    """None: none does, or several could."""
    reason: str
    candidates: tuple[str, ...] = ()
    """The topics that fit, where they are several."""


@dataclass(frozen=True)
class LogSummary:
    """What a log holds."""

    path: Path
    name: str | None
    """As the log calls itself."""
    topics: tuple[TopicSummary, ...]
    roles: tuple[RoleSummary, ...]
    calibration: str
    """Where a calibration would come from, or why the one in the log cannot be used."""
    notes: dict[str, str]
    damage: tuple[str, ...]
    """What is lost or cannot be read; empty for a sound file."""
    left_out: tuple[str, ...] = ()
    """Rows that are not fit for use, by role and reason."""
    warnings: tuple[str, ...] = ()
    """What can be read but looks wrong."""
    sonar: str | None = None
    """Size, sector and range of the sonar's first frames."""
    toml: str = ""
    """The log configuration to start from; read back unchanged it makes the same choices."""

    @property
    def obstacles(self) -> tuple[str, ...]:
        """What keeps estimators from running on the log as it is: needed parts that no topic plays, or several could.

        Such as ``no IMU``.
        """
        needed = [role for role in self.roles if ROLES[role.role].is_required and role.topic is None]
        return tuple(
            f"{len(role.candidates)} topics for {role.role} (choose: --topic {role.role}={role.candidates[0]})"
            if role.candidates
            else f"no {role.role.upper()}"
            for role in needed
        )

    @property
    def duration_s(self) -> float:
        """Seconds between the first and the last stamp of the topics that play a part, or of all where none does."""
        used = {role.topic for role in self.roles}
        by_header = [topic for topic in self.topics if topic.stamps_from == "header"]  # not the recorder's clock
        topics = [topic for topic in self.topics if topic.name in used] or by_header or self.topics
        if not topics:
            return 0.0
        return (max(t.last_stamp_ns for t in topics) - min(t.first_stamp_ns for t in topics)) * 1e-9


def inspect_log(
    path: Path,
    config: LogConfig | None = None,
    topics: Mapping[str, str] | None = None,
    window: TimeWindow | None = None,
) -> LogSummary:
    """Summarise an MCAP file; what is wrong in it becomes part of the summary.

    Parameters
    ----------
    path
        The log.
    config, topics
        What the user says about topics, as of `read_log`.
    window
        Only what was recorded then.

    Raises
    ------
    LogError
        When there is no such file or it is not MCAP.
    """
    config = config or LogConfig()
    types = wanted_types(config)
    recording = scan(Path(path), lambda kind: Keep.ALL if short_name(kind) in types else Keep.STAMP, window)
    damage = [*recording.corrupt, *([recording.ending] if recording.ending else []), *recording.damage.remarks]
    choices = {name: choose_topic(role, recording, config, (topics or {}).get(name)) for name, role in ROLES.items()}
    calibration, notes = _calibration(recording), _notes(recording, damage)
    summaries = tuple(_summarise(topic) for topic in recording.topics.values())
    left_out, warnings = _trial(recording, {name: choices[name] for name in SEQUENCE_ROLES}, damage)
    return LogSummary(
        path=recording.path,
        name=recorded_name(recording),
        topics=summaries,
        roles=tuple(RoleSummary(c.role.name, c.topic, c.reason, c.candidates) for c in choices.values()),
        calibration=calibration,
        notes=notes,
        damage=tuple(damage),
        left_out=tuple(left_out),
        warnings=tuple(warnings),
        sonar=_sonar(recording.path, choices[SONAR], config),
        toml=starting_config(recording, list(choices.values()), config),
    )


def _trial(recording: Recording, choices: Mapping[str, Choice], damage: list[str]) -> tuple[list[str], list[str]]:
    """Read what was chosen, as a run would, for what is left out and what looks wrong."""
    try:
        return Assembly(recording, choices).survey()
    except CalibrationError:
        return [], []  # told where the calibration comes from
    except SonarGraphError as error:
        damage.append(str(error))
        return [], []


def _sonar(path: Path, choice: Choice, config: LogConfig) -> str | None:
    """What the first frames of the sonar are like."""
    if choice.topic is None:
        return None
    try:
        frames = next(read_sonar_frames(path, choice.topic, config), None)
    except SonarGraphError as error:
        return f"cannot be read: {error}"
    return describe_frames(frames) if frames else None


def _summarise(topic: Topic) -> TopicSummary:
    recorded = _stamps_from_headers(topic)
    log_times_ns = topic.log_times_ns
    stamps_ns = np.sort(log_times_ns if recorded is None else np.where(recorded == 0, log_times_ns, recorded))
    span_s = float(stamps_ns[-1] - stamps_ns[0]) * 1e-9
    steps_s = np.diff(stamps_ns) * 1e-9
    low, high = np.quantile(steps_s, [0.16, 0.84]) if len(steps_s) else (0.0, 0.0)
    return TopicSummary(
        name=topic.name,
        type_name=topic.type_name,
        encoding=topic.encoding,
        messages=len(topic),
        first_stamp_ns=int(stamps_ns[0]),
        last_stamp_ns=int(stamps_ns[-1]),
        rate_hz=(len(topic) - 1) / span_s if span_s > 0 else 0.0,
        largest_gap_s=float(steps_s.max(initial=0)),
        stamps_from="log" if recorded is None else "header",
        jitter_s=float(high - low) / 2,
        lag_s=None if recorded is None else _lag_s(recorded, log_times_ns),
        stamp_faults=() if recorded is None else tuple(stamp_faults(recorded, log_times_ns)),
        refusal=refusal(topic),
    )


def _lag_s(stamps_ns: Ints, log_times_ns: Ints) -> float | None:
    """Of messages with a stamp."""
    stamped = (stamps_ns != 0) | (log_times_ns == 0)
    return float(np.median((log_times_ns - stamps_ns)[stamped])) * 1e-9 if stamped.any() else None


def _stamps_from_headers(topic: Topic) -> Ints | None:
    """Stamps as they stand at the beginning of each message, or None where not every message has one there."""
    try:
        first = topic.definition().fields[:1] if topic.is_ros2 else ()
        if not first or not isinstance(first[0].kind, Struct) or first[0].is_array:
            return None
        if first[0].kind.name != "std_msgs/Header" or min(topic.stacks, default=0) < STAMP_BYTES:
            return None
        return _decode_stamps(topic)
    except SonarGraphError:
        return None


def _decode_stamps(topic: Topic) -> Ints | None:
    time = parse_definition("builtin_interfaces/msg/Time", definition("builtin_interfaces/msg/Time"))
    stamps_ns = np.empty(len(topic), np.int64)
    parts = [(rows, payloads[:, :STAMP_BYTES]) for stack in topic.stacks.values() for rows, payloads in stack]
    decoded = decode(time, parts)
    if decoded.unsound:
        return None
    for group in decoded.groups:
        stamps_ns[group.rows] = group["sec"].astype(np.int64) * NS_PER_S + group["nanosec"]
    return stamps_ns


def _calibration(recording: Recording) -> str:
    try:
        if read_calibration(recording) is not None:
            return "in the log"
        frames = static_frames(recording)
    except SonarGraphError as error:
        return f"unusable: {error}"
    if frames:
        names = ", ".join(list(frames)[:_FRAMES_NAMED]) + (", ..." if len(frames) > _FRAMES_NAMED else "")
        return f"none in the log; defaults with the mountings of /tf_static ({names})"
    return (
        "none in the log and no /tf_static; defaults, with every sensor at base_link: sonar_graph/calibration.py lists "
        "them with units, comparison.json with the results, and --calibration FILE gives others"
    )


def _notes(recording: Recording, damage: list[str]) -> dict[str, str]:
    try:
        return read_notes(recording)
    except SonarGraphError as error:
        damage.append(str(error))
        return {}
