"""Reading of logs: a `Sequence` from the topics of an MCAP file.

The topics are chosen by role (`sonar_graph.logs.roles`), their messages read by adapters (`sonar_graph.logs.adapters`),
and the calibration is gathered (`sonar_graph.logs.vehicle_setup`). The notes of the sequence, under ``log.*``, state what
was chosen, assumed and left out, and what looks wrong (docs/design/0004-logs.md).
"""

import logging
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Never

import numpy as np

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.devices import is_partial
from sonar_graph.errors import LogError
from sonar_graph.files import as_path, spelt
from sonar_graph.logs.adapters import (
    TIMES,
    Adapter,
    Dropped,
    FieldTable,
    GeodeticFields,
    LogConfig,
    Mask,
    MessageTable,
    Origin,
    Setup,
    as_log_config,
    changes_text,
    detection_warnings,
    shipped_like,
)
from sonar_graph.logs.checks import (
    LEAST_MOVED,
    UNFELT,
    UNLIKELY_ZEROS,
    axes_warning,
    gap_warnings,
    repeated_sightings,
    repeats,
    row_doubts,
    row_oddities,
    stamp_doubts,
    stamp_faults,
    unfelt_zeros,
    unlikely_zeros,
    way_by,
)
from sonar_graph.logs.live_record import LIVE_RATE, leave_out_dropped, recorded_config
from sonar_graph.logs.mcap import (
    Progress,
    Recording,
    TimeWindow,
    Topic,
    keeping,
    scan,
)
from sonar_graph.logs.roles import (
    NAVIGATION,
    SEQUENCE_ROLES,
    SONAR,
    Choice,
    Window,
    as_window,
    choose_topics,
    refuse_unknown,
    require_topics,
    wanted_types,
)
from sonar_graph.logs.sonar_images import sonar_frame
from sonar_graph.logs.vehicle_setup import (
    GIVEN,
    MOUNTING,
    MOUNTING_FIELDS,
    PartialCalibration,
    as_calibration,
    gathered,
    is_described,
    mounted_by,
    mounting_of,
    read_calibration,
    read_notes,
    recorded_name,
    static_frames,
    unplaced,
)
from sonar_graph.measurements import Block, Dvl, Imu
from sonar_graph.sequence import Sequence

LOG = logging.getLogger("sonar_graph.logs")
WARNED = (
    "log.ending",
    "log.damage",
    "log.start_pose",
    "log.stamps",
    "log.dropped",
    "log.doubtful",
    "log.warnings",
    "log.gaps",
)
"""Notes that `read_log` also logs: the user may have to act on them."""
FOUND_ANEW = frozenset(
    {
        "log.warnings",
        "log.gaps",
        "log.noise",
        "log.sensors",
        "log.doubtful",
        "log.compared",
    }
)
"""Notes about the rows of a log; those of an earlier reading may no longer hold."""

FEWEST_JUDGED = 10
"""Rows from which a single one is judged by those beside it."""
VALUES = {"positions": "position_m", "heading": "yaw_rad", "depth": "z_m"}
"""Column of each block that repeats where the sensor is stuck."""
NOISE_FIELDS = {
    "dvl": ("velocity_cov", "dvl.velocity_sigma_m_s"),
    "depth": ("variance_m2", "depth.sigma_m"),
    "heading": ("sigma_rad", "heading.sigma_rad"),
    "positions": ("covariance_m2", "positions.sigma_m"),
    "detections": ("range_azimuth_cov", "sonar.range_sigma_m and azimuth_sigma_rad"),
}
"""Column of each block that states its noise, and the calibration's fields that count where it is NaN."""


def read_log(
    path: str | Path,
    *,
    calibration: Calibration | PartialCalibration | str | Path | None = None,
    topics: Mapping[str, str] | None = None,
    config: LogConfig | str | Path | None = None,
    window: Window | None = None,
    salvage: bool = False,
    progress: Progress | None = None,
    **unknown: Never,
) -> Sequence:
    """Read a log of ROS 2 messages as a `Sequence`.

    Stamps are those of the sensors' headers. The notes of the sequence, under ``log.*``, list the topics in use, the
    source of the calibration, the rows left out and the numbers in doubt. Those of `WARNED` are also logged as warnings
    of the logger ``sonar_graph.logs``, which Python prints where the program has set up no logging.

    Parameters
    ----------
    path
        An MCAP file.
    calibration
        A `Calibration` replaces everything that the file states. A `PartialCalibration`, or the path of a TOML or JSON
        file of one, goes before it, field by field.
        Without either the file's record holds; without a record, defaults with the mountings of ``/tf_static``.
    topics
        Topics by role (``imu``, ``dvl``, ``depth``, ``heading``, ``positions``, ``detections``, ``truth``,
        ``true_landmarks``), where several fit or nothing is found by type and name; they go before those of `config`.
    config
        Description of the topics of a foreign log, or the path of a TOML file with one.
    window
        Part of the recording to read: a `TimeWindow`, or start and end in seconds from its beginning, ``(0, 10)``.
        ``/tf_static`` and other latched topics are read whenever recorded.
    salvage
        Read what is whole of a file that is damaged in its middle; the note ``log.damage`` states what is lost.
    progress
        Called with the bytes read so far and the bytes in all.

    Returns
    -------
    Sequence
        Measurements, calibration, notes, and truth where the log has it.

    Raises
    ------
    MissingTopicError
        When the log has no IMU or no DVL, or no topic of a name in `topics`; listing the topics that it has.
    LogError
        When the file is not MCAP, is damaged in its middle without `salvage`, has nothing in the window, or a message
        breaks its own rules.
    CalibrationError
        When the calibration in the file is invalid, or becomes so by `calibration`, or that file cannot be read.
    ArgumentError
        When an argument is of another kind, such as a list of topics, or does not exist.

    See Also
    --------
    write_log : The inverse.
    inspect_log : A summary of a log that may lack what reading needs.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from sonar_graph.logs import read_log, write_log
    >>> from sonar_graph.testing import small_world
    >>> with TemporaryDirectory() as folder:
    ...     write_log(Path(folder) / "dive.mcap", small_world())
    ...     sequence = read_log(Path(folder) / "dive.mcap")
    >>> sequence
    Sequence('left turn': 20.0 s, 1001 imu, 101 dvl, 101 depth, 102 detections, 1001 truth, 3 true_landmarks)
    >>> sequence.notes["log.topics"]
    'imu: /imu/data; dvl: /dvl/data; ...'
    """
    call = "read_log"
    refuse_unknown(unknown, call)
    path = as_path(path, f"{call}(path)")
    given = as_calibration(calibration, call)
    part = as_window(window, call)
    recording, config = _scanned(path, as_log_config(config, call), part, progress)
    if not salvage:
        recording.require_sound()
    wanted = {} if topics is None else topics
    require_topics(recording, wanted, config, call)
    left_out = leave_out_dropped(recording)
    choices = choose_topics(recording, wanted, config)
    frame = sonar_frame(recording, wanted.get(SONAR), config)
    sequence = Assembly(recording, choices, given, frame).sequence()
    sequence.notes.update(left_out | _start_note(recording, part, given))
    for subject in WARNED:
        if subject in sequence.notes:
            LOG.warning("%s: %s: %s", path.name, subject, sequence.notes[subject])
    return sequence


def _start_note(
    recording: Recording,
    window: TimeWindow | None,
    given: Calibration | PartialCalibration | None,
) -> dict[str, str]:
    """Note about a stated start pose that is of an earlier instant than the part that was read; empty without."""
    begin = None if window is None else window.start
    beginning_ns = recording.beginning_ns
    if begin is None or beginning_ns is None or isinstance(given, Calibration):
        return {}
    late_s = (begin.resolve(beginning_ns) - beginning_ns) * 1e-9
    recorded = read_calibration(recording)
    is_stated = recorded is not None and "start" in recorded.model_fields_set
    if late_s <= 0 or not is_stated or (given and "start" in given.values):
        return {}
    return {
        "log.start_pose": f"the start pose that it states is of its beginning, {late_s:.3f} s before the part that was "
        "read; give the pose there as [start] position_m and rpy_rad in a file for --calibration"
    }


def _scanned(
    path: Path,
    config: LogConfig | None,
    window: TimeWindow | None,
    progress: Progress | None,
) -> tuple[Recording, LogConfig]:
    """The messages of a log that may be needed, and the description of its topics: the given one, or its own."""
    types = wanted_types(config or LogConfig())
    recording = scan(path, keeping(types), window, progress)
    used = config or recorded_config(recording) or LogConfig()
    # the types of its own topics are known only now
    if not wanted_types(used) <= types:
        recording = scan(path, keeping(wanted_types(used)), window, progress)
    return recording, used


class Assembly:
    """Blocks of measurements from the chosen topics of a log, with an account of rows left out and warnings.

    ``sonar`` is the frame of the sonar that took images (`sonar_frame`).

    Raises LogError when no message of a needed topic is as its definition has it, and CalibrationError when the
    calibration in the log is invalid, or becomes so by the user's changes.
    """

    def __init__(
        self,
        recording: Recording,
        choices: Mapping[str, Choice],
        calibration: Calibration | PartialCalibration | None = None,
        sonar: str | None = None,
    ) -> None:
        self._recording = recording
        self._sonar = sonar
        self.topics: dict[str, Topic] = {}
        self.adapters: dict[str, Any] = {}
        self._blocks: dict[str, Any] = {}
        self._dropped: dict[str, Dropped] = {}
        self._left_out: dict[str, str] = {}
        self._tables: dict[str, MessageTable] = {}
        changes = []
        for role, choice in choices.items():
            if choice.topic is None or choice.adapter is None:
                continue
            topic = self.topics[role] = recording.topics[choice.topic]
            self.adapters[role] = choice.adapter
            self._read_table(role)
            shipped = shipped_like(role, topic.type_name, topic.definition())
            if change := changes_text(choice.adapter, shipped):
                changes.append(f"{role}: {change}")
        recorded = read_notes(recording)
        # the record of a live run has the rows that counted then, also stuck ones
        self._is_live = LIVE_RATE in recorded
        found = {
            "log.topics": "; ".join(
                f"{k}: {one.name}" for k, one in self.topics.items()
            ),
            "log.adapters": "; ".join(changes),
            "log.truth": "" if "truth" in self.topics else choices["truth"].reason,
        }
        self._notes = {k: note for k, note in recorded.items() if k not in FOUND_ANEW}
        self._notes |= {subject: text for subject, text in found.items() if text}
        self._notes |= recording.notes()
        self._missing: dict[str, str] = {}
        self._unplaced: list[str] = []
        self._is_start_stated = True
        is_described_ = is_described(recording)
        if isinstance(calibration, Calibration):
            self.calibration = calibration
            self._notes["log.calibration"] = GIVEN
        else:
            self._is_start_stated = is_described_
            self._gather(calibration)
        # wheels stop and turn evenly, which would look like a Doppler log without lock; rows of a log that this
        # package wrote were chosen before
        is_held = self.calibration.odometry_interpolation == "hold-past"
        dvl = self.adapters.get("dvl")
        self._may_lack_lock = False
        if dvl is not None and (is_held or is_described_):
            self.adapters["dvl"] = dvl.with_marks_alone()
        elif dvl is not None:
            self._may_lack_lock = dvl.lock == "found" and not dvl.are_zeros_measured

    def _read_table(self, role: str) -> None:
        topic = self.topics[role]
        try:
            self._tables[role] = self.adapters[role].table(topic)
        except LogError:
            if len(topic) or role in NAVIGATION:
                raise
            self._dropped[role] = topic.unsound

    def _frames(self) -> dict[str, str]:
        """Frame of each sensor that has a place on the vehicle."""
        frames = {}
        for role, table in self._tables.items():
            sensor = SONAR if role == "detections" else role
            frame = self.adapters[role].frame_in(table.groups)
            # a depth or a fix without a frame is in the world: there is no port or antenna to mount
            if sensor in MOUNTING_FIELDS and (
                frame or MOUNTING_FIELDS[sensor] == MOUNTING
            ):
                frames[sensor] = frame
        if self._sonar is not None:
            frames.setdefault(SONAR, self._sonar)
        return frames

    def _gather(self, given: PartialCalibration | None) -> None:
        """Gather the calibration of user, record, ``/tf_static`` and defaults, with its sources in the notes."""
        recorded = read_calibration(self._recording)
        values = {} if given is None else given.values
        if (
            recorded is not None
            and recorded.start.source != "stated"
            and values.get("start")
        ):
            # the record's start was not stated: what is stated now replaces it, and the rest is measured again
            of_others = recorded.model_dump(exclude_unset=True, exclude={"start"})
            recorded = Calibration.model_validate(of_others)
            self._notes.pop("log.start", None)
        stated = {} if recorded is None else recorded.model_dump(exclude_unset=True)
        is_recorded = self._is_start_stated
        self._is_start_stated &= not values.get("start")
        frames = self._frames()
        tree = static_frames(self._recording)
        in_record = mounted_by(stated)
        by_hand = in_record | mounted_by(values)
        mountings = {}
        for name, frame in frames.items():
            try:
                mounting = mounting_of(frame, tree)
            except LogError as error:
                # a fault in the tree does no harm where the mounting is stated
                if name in by_hand:
                    continue
                raise LogError(f"{self._recording.path}: {name}: {error}") from error
            if mounting is not None:
                mountings[name] = mounting
        mounted = mountings.keys() | by_hand
        self._missing = {k: frame for k, frame in frames.items() if k not in mounted}
        source = "from the log"
        if not is_recorded:
            source = f"{', '.join(sorted(stated))} {source}; else defaults"
            placed = _framed({k: frames[k] for k in mountings if k not in in_record})
            source = source if stated else "defaults"
            source += f"; mountings from /tf_static: {placed or 'none'}"
            if self._missing:
                left = _framed(self._missing)
                source += f"; not in the tree, taken as base_link: {left}"
        self._notes["log.calibration"] = given.before(source) if given else source
        # a record of this package states what is not zero
        if recorded is None:
            self._unplaced = [
                unplaced(*missing, has_tree=bool(tree))
                for missing in self._missing.items()
            ]
        self.calibration = gathered(given, recorded, mountings)

    @property
    def source(self) -> str:
        """Source of the calibration."""
        return self._notes["log.calibration"]

    def block(self, role: str) -> Any:
        """The measurements of a role; None where it has no topic, or none of its rows is fit."""
        if role in self._blocks or role not in self.topics:
            return self._blocks.get(role)
        adapter = self.adapters[role]
        rows = None
        dropped: Dropped = {}
        if role in self._tables:
            if said := adapter.assumption(self.calibration.gravity_m_s2):
                self._notes[f"log.{role}"] = said
            rows, dropped = adapter.read(self._tables[role], self.setup(role))
        if rows is not None and not self._is_live:
            is_wrong, reason, advice = self._contradicted(role, rows)
            if count := int(np.count_nonzero(is_wrong)):
                text = f"{count} of {len(rows)} rows {reason}: left out{advice}"
                self._left_out[role] = text
                dropped = dropped | {reason: count}
                rows = rows.rows(~is_wrong)
        self._blocks[role] = rows
        if dropped := self.topics[role].unsound | dropped:
            self._dropped[role] = dropped
        return rows

    def _contradicted(self, role: str, rows: Any) -> tuple[Mask, str, str]:
        """Mask of rows that other sensors contradict, shape (n,), the reason, and a setting that uses them."""
        none = np.zeros(len(rows), bool)
        imu = self.block("imu") if role != "imu" else None
        if role == "dvl" and imu is not None and self._may_lack_lock:
            advice = "; `are_zeros_measured = true` under [dvl] in a log configuration uses them"
            return unfelt_zeros(imu, rows, self.calibration), UNFELT, advice
        may_be_stuck = role in LEAST_MOVED and len(rows) > 1
        dvl = self.block("dvl") if may_be_stuck else None
        if imu is None or dvl is None:
            return none, "", ""
        # a sensor is stuck where it repeats its value while the vehicle moves
        moved = way_by(role, imu, dvl, self.calibration, rows.stamps_ns)
        least = LEAST_MOVED[role]
        if role == "detections":
            seen = np.column_stack((rows.range_m, rows.azimuth_rad))
            stuck = repeated_sightings(rows.stamps_ns, seen, moved, least)
        else:
            values = getattr(rows, VALUES[role]).reshape(len(rows), -1)
            stuck = repeats(values, moved, least)
            # a few rows are not beside enough others, and the first fix on the Earth is the origin, exactly 0
            is_on_earth = getattr(self.adapters[role], "geodetic", None) is not None
            if len(rows) >= FEWEST_JUDGED and not is_on_earth:
                zeros = unlikely_zeros(values, moved, least)
                if zeros.any():
                    return zeros, UNLIKELY_ZEROS, ""
        # times are counted from where estimators begin
        start_ns = max(imu.stamps_ns[0], dvl.stamps_ns[0])
        late_s = (rows.stamps_ns[np.argmax(stuck)] - start_ns) * 1e-9
        reason = f"that repeat the same value while the vehicle moves, the first {late_s:.3f} s after the start"
        return stuck, reason, ""

    def setup(self, role: str) -> Setup:
        """What reading a role needs beside its messages."""
        body_R_sensor = np.eye(3)
        if role == "heading":
            mounting: Mounting | None = self.calibration.imu.mounting
            # an orientation of another topic than the IMU's is of the sensor of its frame
            if self.topics[role] is not self.topics.get("imu"):
                frame = self.adapters[role].frame_in(self._tables[role].groups)
                mounting = mounting_of(frame, static_frames(self._recording))
            body_R_sensor = (mounting or Mounting()).rotation_matrix()
        origin = None
        if role in ("positions", "truth"):
            origin, said = common_origin(role, self.adapters, self._tables)
            if said:
                self._notes["log.origin"] = said
        return Setup(self.calibration, body_R_sensor, origin)

    def sequence(self, name: str | None = None) -> Sequence:
        """Everything that was chosen as one sequence, called ``name``, or as the log calls itself, or like the file.

        Raises LogError when IMU and DVL are not enough for any estimator, or a message breaks its own rules.
        """
        blocks = {role: self.block(role) for role in SEQUENCE_ROLES}
        for role in NAVIGATION:
            if blocks[role] is None:
                raise self._useless(role)
        imu = blocks["imu"]
        dvl = blocks["dvl"]
        require_use(str(self._recording.path), imu, dvl, OF_RECORDING)
        # compiles
        from sonar_graph.logs.measured_start import is_whole, with_measured_start

        if not (self._is_start_stated or is_whole(self.calibration.start)):
            self.calibration, self._notes["log.start"] = with_measured_start(
                self.calibration, blocks
            )
        stamps = [
            f"{role}: {text}"
            for role, table in self._tables.items()
            if role not in ("detections", "true_landmarks")
            for text in stamp_faults(table.stamps_ns, table.topic.log_times_ns)
        ]
        findings = {
            "log.dropped": self.left_out(),
            "log.stamps": stamps,
            "log.doubtful": self.doubts(),
            "log.warnings": self.warnings(),
            "log.gaps": gap_warnings(imu, dvl, self.calibration),
            "log.noise": unsaid_noise(blocks),
        }
        self._notes |= _texts(findings)
        own = recorded_name(self._recording) or spelt(self._recording.path.stem)
        return Sequence(
            name=name or own, calibration=self.calibration, notes=self._notes, **blocks
        )

    def _useless(self, role: str) -> LogError:
        """Refusal of a topic without a usable message."""
        topic = self.topics[role]
        faults = self._dropped.get(role, {})
        keys = ", ".join(filter(None, map(self.adapters[role].accepts, faults)))
        way_out = (
            f"; `{keys}` under [{role}] in a log configuration uses them"
            if keys
            else ""
        )
        return topic.error(
            f"none of its {len(topic)} messages can be used: {_counts(faults)}{way_out}"
        )

    def survey(self) -> tuple[list[str], list[str]]:
        """Rows left out and warnings of everything that was chosen, whether or not it is enough for a sequence."""
        blocks = {role: self.block(role) for role in SEQUENCE_ROLES}
        warnings = [*self.doubts(), *self.warnings()]
        if blocks["imu"] is not None and blocks["dvl"] is not None:
            warnings += gap_warnings(blocks["imu"], blocks["dvl"], self.calibration)
        return self.left_out(), warnings

    def left_out(self) -> list[str]:
        """Numbers of rows that were left out of the blocks read so far, by role and reason."""
        return [
            f"{role}: {_counts(dropped)}" for role, dropped in self._dropped.items()
        ]

    def doubts(self) -> Iterator[str]:
        """Sentences of `row_doubts` about the rows that were chosen."""
        imu = self.block("imu")
        if imu is not None:
            dvl = self.block("dvl")
            depth = self.block("depth")
            yield from row_doubts(imu, dvl, depth, self.calibration)
        for role in NAVIGATION:
            if (table := self._tables.get(role)) is not None:
                times_ns = table.topic.log_times_ns
                for text in stamp_doubts(table.stamps_ns, times_ns):
                    yield f"{role}: {text}"

    def warnings(self) -> Iterator[str]:
        """Sentences about messages that can be read but look wrong, each after its role."""
        yield from self._unplaced
        for role, table in self._tables.items():
            for text in self.adapters[role].warnings(table):
                yield f"{role}: {text}"
        imu = self.block("imu")
        dvl = self.block("dvl")
        oddities = [*row_oddities(imu, dvl, self.block("depth"), self.calibration)]
        if "dvl" in self._missing:
            oddities.append(("dvl", axes_warning(self.adapters["dvl"])))
        oddities += self._left_out.items()
        yield from (f"{role}: {text}" for role, text in oddities if text)
        blocks = {role: self.block(role) for role in NOISE_FIELDS}
        yield from unsaid_noise(blocks, only_partly=True)
        sigmas = self.calibration.dvl.velocity_sigma_m_s
        if dvl is not None and np.isnan(dvl.velocity_cov).any() and 0 in sigmas:
            yield (
                "dvl: velocity_sigma_m_s of the calibration is 0 on an axis, and rows have no covariance of their own: "
                "smoothers cannot use them; give [dvl] velocity_sigma_m_s above 0 in a file for --calibration"
            )
        detections = blocks["detections"]
        if detections is not None and imu is not None and dvl is not None:
            stamps_ns = (imu.stamps_ns, dvl.stamps_ns)
            first_ns = max(int(ns[0]) for ns in stamps_ns)
            # until the next row of odometry is due, the sensor that writes last is ahead
            steps_ns = [np.median(np.diff(ns)) for ns in stamps_ns if len(ns) > 1]
            due_ns = int(max(steps_ns, default=0))
            last_ns = min(int(ns[-1]) for ns in stamps_ns) + due_ns
            for text in detection_warnings(detections, first_ns, last_ns):
                yield f"detections: {text}"


def _framed(frames: Mapping[str, str]) -> str:
    """Sensors with their frames, where these have other names."""
    return ", ".join(
        name if name == frame else f"{name} ({frame or 'unnamed'})"
        for name, frame in frames.items()
    )


def _texts(findings: Mapping[str, Iterable[str]]) -> dict[str, str]:
    """Notes of findings, one text a subject."""
    joined = {subject: "; ".join(texts) for subject, texts in findings.items()}
    return {subject: text for subject, text in joined.items() if text}


def row_notes(sequence: Sequence) -> dict[str, str]:
    """Notes of a sequence that no log was read for: what `read_log` would note about the same rows."""
    calibration = sequence.calibration
    imu = sequence.imu
    dvl = sequence.dvl
    oddities = row_oddities(imu, dvl, sequence.depth, calibration)
    doubts = list(row_doubts(imu, dvl, sequence.depth, calibration))
    is_held = calibration.odometry_interpolation == "hold-past"
    count = 0 if is_held else unfelt_zeros(imu, dvl, calibration).sum()
    if count:
        doubts.append(f"dvl: {count} of {len(dvl)} rows {UNFELT}: leave them out")
    findings = {
        "log.doubtful": doubts,
        "log.warnings": (f"{role}: {text}" for role, text in oddities if text),
        "log.gaps": gap_warnings(imu, dvl, calibration),
    }
    return _texts(findings)


def common_origin(
    role: str, adapters: Mapping[str, Adapter], tables: Mapping[str, FieldTable]
) -> tuple[Origin | None, str | None]:
    """Origin that fixes and true positions on the Earth share, in degrees and metres, and a note about it.

    The configured one, or the first fix; None without any. Heights that count from the first fix would contradict the
    depths, which count from the surface: the height of the origin of fixes is NaN then, and theirs are not used. Adapters
    and tables are by role.
    """
    of_earth: dict[str, GeodeticFields] = {}
    for one in ("positions", "truth"):
        fields = getattr(adapters.get(one), "geodetic", None)
        if one in tables and fields is not None:
            of_earth[one] = fields
    said = [fields.origin_deg_m for fields in of_earth.values() if fields.origin_deg_m]
    fixes = [fields.first_fix(tables[one]) for one, fields in of_earth.items()]
    origin = next((place for place in (*said, *fixes) if place is not None), None)
    if origin is None:
        return None, None
    latitude_deg, longitude_deg, height_m = origin
    text = (
        f"of the world, x east, y north: latitude {latitude_deg:.8f}°, longitude {longitude_deg:.8f}°, height "
        f"{height_m:.3f} m, {'as configured' if said else 'the first fix'}"
    )
    if said or "depth" not in adapters or "positions" not in of_earth:
        return origin, text
    of_fixes = (latitude_deg, longitude_deg, math.nan)
    text += "; depths give the height, not the fixes, without `origin_deg_m` in geodetic under [positions]"
    return of_fixes if role == "positions" else origin, text


def _counts(dropped: Dropped) -> str:
    return ", ".join(f"{count} {fault}" for fault, count in dropped.items())


OF_RECORDING = ' The time of recording is stamp = "log" under [imu] and [dvl].'


def require_use(file: str, imu: Imu, dvl: Dvl, advice: str = "") -> None:
    """Refuse an IMU and a Doppler log without common time, or without a row of velocity in all directions.

    ``advice``: a sentence on what else can be done about the times.
    """
    if max(imu.stamps_ns[0], dvl.stamps_ns[0]) > min(
        imu.stamps_ns[-1], dvl.stamps_ns[-1]
    ):
        raise LogError(
            f"{file}: IMU {_span(imu)}, DVL {_span(dvl)}: no common time; of another clock or unit?"
            f"{_likely_unit(imu, dvl) or advice} See stamp, stamp_unit_s and stamp_offset_s of the log configuration"
        )
    if is_partial(dvl.velocity_cov).all():
        largest_m2_s2 = float(np.nanmax(dvl.velocity_cov))
        raise LogError(
            f"{file}: DVL: none of its {len(dvl)} rows measures a velocity in all directions: too few valid beams (three "
            f"are needed), or variances of up to {largest_m2_s2:.3g} m²/s² in another unit: `covariance = false` under "
            "[dvl] in a log configuration takes the calibration's noise"
        )


def _likely_unit(imu: Imu, dvl: Dvl) -> str:
    """Question about the unit of the sensor that lasts a thousand, million or milliard times as long as the other."""
    imu_ns = int(np.ptp(imu.stamps_ns))
    dvl_ns = int(np.ptp(dvl.stamps_ns))
    shorter_ns = min(imu_ns, dvl_ns)
    longer = "imu" if imu_ns > dvl_ns else "dvl"
    for unit in ("ms", "us", "ns"):
        # the two last about as long as each other where the unit is right
        ratio = max(imu_ns, dvl_ns) * TIMES[unit] / max(shorter_ns, 1)
        if 0.1 < ratio < 10.0:
            return f' Perhaps stamp_unit_s = "{unit}" under [{longer}].'
    return ""


def _span(rows: Block) -> str:
    return f"from {rows.stamps_ns[0] * 1e-9:.3f} to {rows.stamps_ns[-1] * 1e-9:.3f} s"


def unsaid_noise(
    blocks: Mapping[str, Any], *, only_partly: bool = False
) -> Iterator[str]:
    """Sensors with rows of unknown covariance, for which the noise of the calibration counts; blocks by role.

    With ``only_partly`` those whose other rows state one: a sensor that mostly knows its noise and here does not.
    """
    for role, (column, fields) in NOISE_FIELDS.items():
        if blocks.get(role) is None:
            continue
        covariances = getattr(blocks[role], column)
        n = len(covariances)
        is_unknown = np.isnan(covariances.reshape(n, -1)).any(axis=1)
        count = np.count_nonzero(is_unknown)
        if count and not (only_partly and count == n):
            yield f"{role}: {count} of {n} rows say no covariance, {fields} of the calibration count"
