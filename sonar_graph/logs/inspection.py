"""What is in a log: topics, their times and gaps, which part each would play, and what is damaged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonar_graph.errors import CalibrationError, SonarGraphError
from sonar_graph.logs.adapters.config import LogConfig
from sonar_graph.logs.assembly import Assembly
from sonar_graph.logs.cdr import decode
from sonar_graph.logs.container import STAMP_BYTES, Keep, Recording, Topic, scan
from sonar_graph.logs.log_record import read_calibration, read_notes, recorded_name
from sonar_graph.logs.message_definitions import definition, short_name
from sonar_graph.logs.mountings import static_frames
from sonar_graph.logs.refusal import refusal
from sonar_graph.logs.roles import ROLES, SEQUENCE_ROLES, SONAR, Choice, choose_topic, wanted_types
from sonar_graph.logs.schema import Struct, parse_definition
from sonar_graph.logs.sonar_reading import describe_frames, read_sonar_frames
from sonar_graph.logs.stamp_check import stamp_faults
from sonar_graph.logs.starting_config import starting_config
from sonar_graph.logs.table import NS_PER_S
from sonar_graph.logs.window import Window
from sonar_graph.measurements import Ints

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
    window: Window | None = None,
) -> LogSummary:
    """Summarise an MCAP file; what is wrong in it becomes part of the summary.

    Parameters
    ----------
    path
        The log.
    config, topics
        What the user says about topics, as of `read_sequence`.
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
