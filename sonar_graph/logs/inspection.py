"""Inspection of logs: topics with their times, the role that each would play, damage, warnings, and a configuration.

`inspect_log` reads what a run would read, so that rows left out and doubtful numbers are known before. The log
configuration that it begins makes, read back unchanged, the same choices (docs/tutorials/04_your_own_log.md).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Never

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.errors import CalibrationError, LogError, SonarGraphError
from sonar_graph.files import as_path
from sonar_graph.logs.adapters import (
    LogConfig,
    as_log_config,
    leaf_fields,
    plain_lines,
    shipped_like,
    table_text,
)
from sonar_graph.logs.cdr import (
    Struct,
    decode,
    parse_definition,
)
from sonar_graph.logs.checks import stamp_faults
from sonar_graph.logs.mcap import (
    STAMP_BYTES,
    Keep,
    Recording,
    Topic,
    keeping,
    scan,
)
from sonar_graph.logs.reading import Assembly
from sonar_graph.logs.roles import (
    NAVIGATION,
    ROLES,
    SEQUENCE_ROLES,
    SONAR,
    TF,
    Choice,
    Window,
    as_window,
    choose_each,
    refusal,
    refuse_unknown,
    require_topics,
    wanted_types,
)
from sonar_graph.logs.sonar_images import (
    describe_frames,
    read_sonar_frames,
    sonar_frame,
)
from sonar_graph.logs.vehicle_setup import (
    PartialCalibration,
    as_calibration,
    read_notes,
    recorded_name,
)
from sonar_graph.measurements import NS_PER_S, Ints

TIME = "builtin_interfaces/msg/Time"
_MOST_FIELDS = 24
_EXAMPLES = {
    "imu": (
        'angular_velocity = ["...", "...", "..."]',
        'linear_acceleration = ["...", "...", "..."]',
    ),
    "dvl": ('velocity = ["...", "...", "..."]',),
}
"""Keys of a table to fill in, for the roles that are needed."""


@dataclass(frozen=True)
class TopicSummary:
    """One topic with its times; of the sensors' headers where its messages have one, else of the recording."""

    name: str
    type_name: str
    encoding: str
    """Such as ``cdr`` or ``protobuf``."""
    messages: int = 0
    first_stamp_ns: int = 0
    last_stamp_ns: int = 0
    rate_hz: float = 0.0
    """Messages per second between the first and the last; 0 where all have one stamp."""
    largest_gap_s: float = 0.0
    """Longest time between successive stamps."""
    stamps_from: str = "log"
    """``header`` or ``log``."""
    jitter_s: float = 0.0
    """Scatter of the times between successive stamps: half of the central 68 %."""
    lag_s: float | None = None
    """Median of time of recording less stamp; None where messages have no stamps."""
    stamp_faults: tuple[str, ...] = ()
    """Faults of the stamps (`stamp_faults`)."""
    refusal: str | None = None
    """Reason why its messages cannot be decoded, which completes "/imu ..."; None: they can."""


@dataclass(frozen=True)
class RoleSummary:
    """The topic that plays a role."""

    role: str
    topic: str | None
    """None: no topic plays it, or several could."""
    reason: str
    candidates: tuple[str, ...] = ()
    """The topics that fit, where they are several."""


@dataclass(frozen=True)
class LogSummary:
    """Content of a log, and its faults.

    Examples
    --------
    >>> from sonar_graph import inspect_log, write_log
    >>> from sonar_graph.testing import small_world
    >>> write_log("dive.mcap", small_world())
    >>> summary = inspect_log("dive.mcap")
    >>> summary.damage, summary.warnings
    ((), ())
    """

    path: Path
    name: str | None
    """Name in the log's record."""
    topics: tuple[TopicSummary, ...]
    roles: tuple[RoleSummary, ...]
    calibration: str
    """Source of the calibration, or the reason why the one in the log cannot be used; empty where `unusable` names it."""
    notes: dict[str, str]
    damage: tuple[str, ...]
    """Lost or unreadable parts; empty for a sound file."""
    unusable: tuple[str, ...] = ()
    """Reasons why sound messages cannot be used as they are, such as a class without an identity, and what to do."""
    left_out: tuple[str, ...] = ()
    """Rows that are not fit for use, by role and reason."""
    warnings: tuple[str, ...] = ()
    """Sentences about what can be read but looks wrong, each after its role."""
    sonar: str | None = None
    """Size, sector and range of the sonar's first frames, or why they cannot be read."""
    sonar_fault: bool = False
    """True where they cannot be read."""
    toml: str = ""
    """The log configuration to start from; read back unchanged it makes the same choices."""

    @property
    def obstacles(self) -> tuple[str, ...]:
        """Needed roles that no topic plays, or several could, so that no estimator can run; such as ``no IMU``."""
        found = []
        for choice in self.roles:
            role = choice.role
            if choice.topic is not None or role not in NAVIGATION:
                continue
            if count := len(choice.candidates):
                advice = f"--topic {role}={choice.candidates[0]}"
                found.append(f"{count} topics for {role} (choose: {advice})")
            else:
                found.append(f"no {role.upper()}")
        return tuple(found)

    @property
    def has_images_alone(self) -> bool:
        """True for a log with sonar images and nothing that may be an IMU or Doppler log."""
        found = {role.role for role in self.roles if role.topic or role.candidates}
        return self.sonar is not None and not (
            self.sonar_fault or found & {"imu", "dvl"}
        )

    @property
    def duration_s(self) -> float:
        """Seconds between the first and the last stamp of the topics that play a role, or of all where none does."""
        used = {role.topic for role in self.roles}
        # a log that was played has the recorder's clock of another day
        by_header = [topic for topic in self.topics if topic.stamps_from == "header"]
        playing = [topic for topic in self.topics if topic.name in used]
        topics = playing or by_header or self.topics
        first_ns = min((topic.first_stamp_ns for topic in topics), default=0)
        last_ns = max((topic.last_stamp_ns for topic in topics), default=0)
        return (last_ns - first_ns) * 1e-9


def inspect_log(
    path: str | Path,
    config: LogConfig | str | Path | None = None,
    topics: Mapping[str, str] | None = None,
    window: Window | None = None,
    calibration: Calibration | PartialCalibration | str | Path | None = None,
    **unknown: Never,
) -> LogSummary:
    """Summarise an MCAP file; faults of the log become part of the summary.

    Parameters
    ----------
    path
        The log.
    config, topics, window, calibration
        As of `read_log`; mountings of the calibration are not missed in ``/tf_static``.

    Returns
    -------
    LogSummary
        Topics, roles, calibration, damage, rows left out, warnings, and the log configuration to start from.

    Raises
    ------
    LogError
        When there is no such file, it is not MCAP, `config` names fields that the messages do not have, or `topics` one
        that is not in the log.
    ArgumentError
        When an argument is of another kind, or does not exist.

    See Also
    --------
    read_log : Reads the log as a `Sequence`.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from dataclasses import replace
    >>> from sonar_graph.logs import inspect_log, write_log
    >>> from sonar_graph.testing import small_world
    >>> world = small_world()
    >>> wrong_axes = replace(world.imu, specific_force=world.imu.specific_force[:, [0, 2, 1]])
    >>> with TemporaryDirectory() as folder:
    ...     write_log(Path(folder) / "dive.mcap", replace(world, imu=wrong_axes))
    ...     summary = inspect_log(Path(folder) / "dive.mcap")
    >>> sorted((topic.name, topic.rate_hz) for topic in summary.topics if topic.messages > 100)
    [('/depth/pose', 5.0), ('/dvl/data', 5.0), ('/ground_truth/odometry', 50.0), ('/imu/data', 50.0)]
    >>> summary.warnings[0].split(":")[1]
    " gravity is felt along +y (9.81 m/s2) instead of the body's +z"
    """
    call = "inspect_log"
    refuse_unknown(unknown, call)
    path = as_path(path, f"{call}(path)")
    config = as_log_config(config, call) or LogConfig()
    given = as_calibration(calibration, call)
    wanted = {} if topics is None else topics
    recording = scan(
        path,
        keeping(wanted_types(config), Keep.STAMP),
        as_window(window, call),
    )
    require_topics(recording, wanted, config, call)
    damage = [*recording.corrupt, *recording.damage.remarks]
    if recording.ending:
        damage.insert(len(recording.corrupt), recording.ending)
    choices = choose_each(recording, wanted, config, ROLES)
    calibrated = ""
    try:
        notes = read_notes(recording)
    except SonarGraphError as error:
        notes = {}
        damage.append(str(error))
    summaries = tuple(_summarise(topic) for topic in recording.topics.values())
    left_out = list[str]()
    warnings = list[str]()
    unusable = list[str]()
    try:
        frame = sonar_frame(recording, choices[SONAR].topic, config)
        measuring = {name: choices[name] for name in SEQUENCE_ROLES}
        assembly = Assembly(recording, measuring, given, frame)
        calibrated = assembly.source
        left_out, warnings = assembly.survey()
    except CalibrationError as error:
        calibrated = f"unusable: {error}"
    except SonarGraphError as error:
        unusable.append(str(error))
    sonar = None
    sonar_fault = False
    if (sonar_topic := choices[SONAR].topic) is not None:
        try:
            # the first frames show the setting
            frames = next(read_sonar_frames(recording.path, sonar_topic, config), None)
            sonar = describe_frames(frames) if frames else None
        except SonarGraphError as error:
            sonar = f"cannot be read: {error}"
            sonar_fault = True
    return LogSummary(
        path=recording.path,
        name=recorded_name(recording),
        topics=summaries,
        roles=tuple(
            RoleSummary(c.role, c.topic, c.reason, c.candidates)
            for c in choices.values()
        ),
        calibration=calibrated,
        notes=notes,
        damage=tuple(damage),
        unusable=tuple(unusable),
        left_out=tuple(left_out),
        warnings=tuple(warnings),
        sonar=sonar,
        sonar_fault=sonar_fault,
        toml=starting_config(recording, list(choices.values()), config),
    )


def _summarise(topic: Topic) -> TopicSummary:
    if not len(topic):  # none of its messages is as its definition has it
        counts = (f"{count} messages {fault}" for fault, count in topic.unsound.items())
        lost = f"has {', '.join(counts)}"
        return TopicSummary(topic.name, topic.type_name, topic.encoding, refusal=lost)
    log_times_ns = topic.log_times_ns
    header_ns = _header_stamps(topic)
    stamps_ns = np.sort(log_times_ns)
    lag_s = None
    faults: tuple[str, ...] = ()
    if header_ns is not None:
        # data sets begin at 0: recorded at 0, a stamp of 0 is right
        is_stamped = (header_ns != 0) | (log_times_ns == 0)
        stamps_ns = np.sort(np.where(is_stamped, header_ns, log_times_ns))
        if is_stamped.any():
            lag_s = float(np.median((log_times_ns - header_ns)[is_stamped])) * 1e-9
        faults = tuple(stamp_faults(header_ns, log_times_ns))
    span_s = float(stamps_ns[-1] - stamps_ns[0]) * 1e-9
    steps_s = np.diff(stamps_ns) * 1e-9
    # gaps must not count as jitter
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
        stamps_from="log" if header_ns is None else "header",
        jitter_s=float(high - low) / 2,
        lag_s=lag_s,
        stamp_faults=faults,
        refusal=refusal(topic),
    )


def _header_stamps(topic: Topic) -> Ints | None:
    """Stamps at the beginning of each message, shape (n,); None where not every message begins with a header."""
    try:
        first = topic.definition().fields[:1] if topic.is_ros2 else ()
    except SonarGraphError:
        return None
    kind = first[0].kind if first and not first[0].is_array else None
    is_header = isinstance(kind, Struct) and kind.name == "std_msgs/Header"
    if not is_header or min(topic.stacks, default=0) < STAMP_BYTES:
        return None
    decoded = decode(
        parse_definition(TIME),
        [
            (rows, payloads[:, :STAMP_BYTES])
            for stack in topic.stacks.values()
            for rows, payloads in stack
        ],
    )
    stamps_ns = np.empty(len(topic), np.int64)
    for group in decoded.groups:
        seconds = group["sec"].astype(np.int64)
        stamps_ns[group.rows] = seconds * NS_PER_S + group["nanosec"]
    return None if decoded.unsound else stamps_ns


def starting_config(
    recording: Recording, choices: list[Choice], config: LogConfig
) -> str:
    """TOML that makes the same choices when it is read back unchanged; comments name other possible topics."""
    parts = [
        f"# Topics of {recording.path.name}. Every key in a table of a known type may be left out."
    ]
    for choice in choices:
        role = choice.role
        table = config.table(role)
        named = choice.candidates or choice.could_be
        if choice.topic is not None and choice.adapter is not None:
            topic = recording.topics[choice.topic]
            base = shipped_like(role, topic.type_name, topic.definition())
            parts.append(table_text(role, choice.topic, choice.adapter, base))
        elif table:  # kept as it is, also where nothing in this log fits it
            lines = [_comment(choice.reason), f"[{role}]", *plain_lines(table)]
            parts.append("\n".join(lines))
        elif named:
            topics = (f'topic = "{name}"' for name in named)
            parts.append(_comment(f"[{role}]  # one of", *topics))
        elif role in NAVIGATION:
            parts.append(_comment(*_to_fill_in(role, recording)))
        else:
            parts.append(_comment(f"[{role}]  # nothing found"))
    used = {choice.topic for choice in choices}
    if any(choice.topic is None and choice.role in NAVIGATION for choice in choices):
        for topic in recording.topics.values():
            if topic.name in used or not topic.is_ros2 or topic.is_a(TF):
                continue
            fields = [f"  {path}{size}" for path, size in _leaves(topic).items()]
            more = len(fields) - _MOST_FIELDS
            fields[_MOST_FIELDS:] = [f"  and {more} more"] if more > 0 else []
            head = f"{topic.name} is a {topic.type_name} with the fields"
            parts.append(_comment(head, *fields))
    return "\n\n".join(parts) + "\n"


def _to_fill_in(role: str, recording: Recording) -> Iterator[str]:
    """Lines of a table for a topic of an unknown type whose name contains the role, or for any."""
    yield f"[{role}]  # no topic of a known type; the fields of other topics are listed below"
    likely = (t for t in recording.topics.values() if role in t.name.lower())
    topic = next((topic for topic in likely if topic.is_ros2), None)
    yield f'topic = "{topic.name if topic else "/..."}"'
    yield f'type = "{topic.type_name if topic else "package/msg/Type"}"'
    if topic and "header.stamp.sec" not in _leaves(topic):
        yield 'stamp = "log"  # messages without a header: when they were recorded'
    yield from _EXAMPLES[role]


def _comment(*lines: str) -> str:
    return "\n".join(f"# {line}".rstrip() for line in lines)


def _leaves(topic: Topic) -> dict[str, str]:
    """Paths of a type's fields, with ``[n]`` or ``[]`` for arrays and sequences; none where it cannot be read."""
    try:
        return dict(leaf_fields(topic.definition()))
    except LogError:
        return {}
