"""Reading of logs: a `Sequence` from the topics of an MCAP file.

The topics are chosen by role (`sonar_graph.logs.roles`), their messages read by adapters (`sonar_graph.logs.adapters`),
and the calibration is gathered (`sonar_graph.logs.vehicle_setup`). The notes of the sequence, under ``log.*``, say what
was chosen, assumed and left out, and what looks wrong (docs/design/0004-logs.md).
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.errors import LogError
from sonar_graph.files import as_path, spelt
from sonar_graph.logs.adapters import (
    Adapter,
    DepthAdapter,
    Dropped,
    DvlAdapter,
    FieldTable,
    GeodeticFields,
    HeadingAdapter,
    LogConfig,
    MessageTable,
    Origin,
    PositionAdapter,
    TruthAdapter,
    changes_text,
    detection_warnings,
    shipped_like,
)
from sonar_graph.logs.cdr import short_name
from sonar_graph.logs.checks import (
    LEAST_MOVED,
    axes_warning,
    gap_warnings,
    gravity_warning,
    is_partial,
    repeated_sightings,
    repeats,
    spike_warning,
    stamp_faults,
    stuck_doubt,
    stuck_quantities,
    stuck_warning,
    way_by,
)
from sonar_graph.logs.live_record import LIVE_RATE, leave_out_dropped, recorded_config
from sonar_graph.logs.mcap import Keep, Progress, Recording, TimeWindow, scan
from sonar_graph.logs.roles import (
    ROLES,
    SEQUENCE_ROLES,
    SONAR,
    Choice,
    choose_topics,
    wanted_types,
)
from sonar_graph.logs.sonar_images import sonar_frame
from sonar_graph.logs.vehicle_setup import (
    PartialCalibration,
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
from sonar_graph.measurements import Block, Dvl, Floats, Imu, LandmarkDetections
from sonar_graph.sequence import Sequence

FOUND_ANEW = frozenset(
    {"log.warnings", "log.gaps", "log.noise", "log.sensors", "log.doubtful"}
)
"""Notes about the rows of a log; those of an earlier reading may no longer hold."""

NOISE_FIELDS = {
    "dvl": ("velocity_cov", "dvl.velocity_sigma_m_s"),
    "depth": ("variance_m2", "depth.sigma_m"),
    "heading": ("sigma_rad", "heading.sigma_rad"),
    "positions": ("covariance_m2", "positions.sigma_m"),
    "detections": ("range_azimuth_cov", "sonar.range_sigma_m and azimuth_sigma_rad"),
}
"""Column of each block that says its noise, and the calibration's fields that count where it is NaN."""


def read_log(
    path: str | Path,
    *,
    calibration: Calibration | PartialCalibration | str | Path | None = None,
    name: str | None = None,
    topics: Mapping[str, str] | None = None,
    config: LogConfig | None = None,
    window: TimeWindow | None = None,
    salvage: bool = False,
    progress: Progress | None = None,
) -> Sequence:
    """Read a log of ROS 2 messages as a `Sequence`.

    Stamps are those of the sensors' headers. The notes of the sequence, under ``log.*``, say which topic was used for
    what, where the calibration comes from, what was left out and what looks wrong.

    Parameters
    ----------
    path
        An MCAP file.
    calibration
        A `Calibration` replaces everything that the file says. A `PartialCalibration`, or the path of a TOML or JSON
        file of one, goes before it, field by field.
        Without either the file's record holds; without a record, defaults with the mountings of ``/tf_static``.
    name
        Name of the sequence, instead of the one in the file; without either, the file's name.
    topics
        Topics by role (``imu``, ``dvl``, ``depth``, ``heading``, ``positions``, ``detections``, ``truth``,
        ``true_landmarks``), where several fit or none is found by type and name; they go before those of `config`.
    config
        Description of the topics of a foreign log; `read_log_config` reads one from a TOML file.
    window
        Part of the recording to read; ``/tf_static`` and other latched topics are read whenever recorded.
    salvage
        Read what is whole of a file that is damaged in its middle; the note ``log.damage`` says what is lost.
    progress
        Called with the bytes read so far and the bytes in all.

    Returns
    -------
    Sequence
        Measurements, calibration, notes, and truth where the log has it.

    Raises
    ------
    MissingTopicError
        When the log has no IMU or no DVL; listing the topics that it has.
    LogError
        When the file is not MCAP, is damaged in its middle without `salvage`, has nothing in the window, or a message
        breaks its own rules.
    CalibrationError
        When the calibration in the file is invalid, or becomes so by `calibration`, or that file cannot be read.
    TypeError
        When `path` or `calibration` is something else.

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
    path = as_path(path, "read_log(path)")
    if not isinstance(calibration, Calibration | PartialCalibration | None):
        calibration = PartialCalibration.read(
            as_path(calibration, "read_log(path, calibration=FILE or Calibration)")
        )
    recording, config = _scanned(path, config, window, progress)
    if not salvage:
        recording.require_sound()
    left_out = leave_out_dropped(recording)
    choices = choose_topics(recording, topics or {}, config)
    frame = sonar_frame(recording, (topics or {}).get(SONAR), config)
    sequence = Assembly(recording, choices, calibration, frame).sequence(name)
    sequence.notes.update(left_out)
    if (
        window is not None
        and window.start is not None
        and recording.beginning_ns is not None
    ):
        late_ns = window.start.resolve(recording.beginning_ns) - recording.beginning_ns
        given = (
            calibration.values if isinstance(calibration, PartialCalibration) else {}
        )
        recorded = (
            None
            if isinstance(calibration, Calibration)
            else read_calibration(recording)
        )
        if (
            late_ns > 0
            and "start" not in given
            and recorded is not None
            and "start" in recorded.model_fields_set
        ):
            sequence.notes["log.start_pose"] = (
                f"the start pose that it states is of its beginning, {late_ns * 1e-9:.3f} s before the part that was "
                "read; give the pose there as [start] position_m and rpy_rad in a file for --calibration"
            )
    return sequence


def _scanned(
    path: Path,
    config: LogConfig | None,
    window: TimeWindow | None,
    progress: Progress | None,
) -> tuple[Recording, LogConfig]:
    """The messages of a log that may be needed, and the description of its topics: the given one, or its own."""
    types = wanted_types(config or LogConfig())
    recording = scan(
        path,
        lambda kind: Keep.ALL if short_name(kind) in types else Keep.NONE,
        window,
        progress,
    )
    own = recorded_config(recording) if config is None else None
    if own is None or wanted_types(own) <= types:
        return recording, config or own or LogConfig()
    types = wanted_types(own)
    return scan(
        path,
        lambda kind: Keep.ALL if short_name(kind) in types else Keep.NONE,
        window,
        progress,
    ), own


class Assembly:
    """Blocks of measurements from the chosen topics of a log, with an account of rows left out and warnings.

    ``sonar`` is the frame of the sonar that took images (`sonar_frame`).

    Raises LogError when no message of a needed topic is what its definition says, and CalibrationError when the
    calibration in the log is invalid, or becomes so by the user's changes.
    """

    def __init__(
        self,
        recording: Recording,
        choices: Mapping[str, Choice],
        calibration: Calibration | PartialCalibration | None = None,
        sonar: str | None = None,
    ) -> None:
        self._recording, self._sonar = recording, sonar
        self.topics = {
            role: recording.topics[c.topic]
            for role, c in choices.items()
            if c.topic is not None
        }
        self.adapters: dict[str, Any] = {
            role: c.adapter for role, c in choices.items() if c.adapter is not None
        }
        self._blocks: dict[str, Any] = {}
        self._dropped: dict[str, Dropped] = {}
        self._stuck: dict[str, str] = {}
        self._tables: dict[str, MessageTable] = {}
        for role, topic in self.topics.items():
            if self.adapters[role].reads_table:
                try:
                    self._tables[role] = self.adapters[role].table(topic)
                except LogError:
                    if len(topic) or ROLES[role].is_required:
                        raise
                    self._dropped[role] = topic.unsound
        self._notes = {
            key: note
            for key, note in read_notes(recording).items()
            if key not in FOUND_ANEW
        }
        # the record is of what the live run used
        self._is_live = LIVE_RATE in self._notes
        self._notes["log.topics"] = "; ".join(
            f"{role}: {topic.name}" for role, topic in self.topics.items()
        )
        changes = {
            role: changes_text(
                self.adapters[role],
                shipped_like(role, topic.type_name, topic.definition()),
            )
            for role, topic in self.topics.items()
        }
        if text := "; ".join(
            f"{role}: {change}" for role, change in changes.items() if change
        ):
            self._notes["log.adapters"] = text
        if "truth" in choices and choices["truth"].topic is None:
            self._notes["log.truth"] = choices["truth"].reason
        self._notes |= recording.notes()
        self._is_mounting_known = self._is_start_stated = True
        self._unplaced: dict[str, str] = {}
        self._has_tree = False
        self.mounted: dict[str, str] = {}
        """Frame in ``/tf_static`` of each sensor whose mounting is from there."""
        self.calibration = (
            calibration
            if isinstance(calibration, Calibration)
            else self._gathered(calibration)
        )
        if isinstance(calibration, Calibration):
            self._notes["log.calibration"] = "given by the caller"
        dvl = self.adapters.get("dvl")
        # wheels stop, and turn evenly
        is_held = self.calibration.odometry_interpolation == "hold-past"
        if isinstance(dvl, DvlAdapter) and (is_held or is_described(recording)):
            self.adapters["dvl"] = dvl.with_marks_alone()

    def _gathered(self, given: PartialCalibration | None) -> Calibration:
        """The calibration of user, record, ``/tf_static`` and defaults, with its sources in the notes."""
        recorded = read_calibration(self._recording)
        said = set() if recorded is None else recorded.model_fields_set
        is_recorded = is_described(self._recording)
        self._is_start_stated = is_recorded and not (
            given and given.values.get("start")
        )
        in_record = (
            mounted_by(recorded.model_dump(exclude_unset=True)) if recorded else set()
        )
        stated = in_record | (mounted_by(given.values) if given else set())
        frames = {
            role: self.adapters[role].frame_in(table.groups)
            for role, table in self._tables.items()
            if role not in ("truth", "heading")
        }
        for role in ("depth", "positions"):
            if not frames.get(role, role):
                del frames[role]  # in the world: there is no port or antenna to mount
        if "detections" in self.topics and (
            messages := self.topics["detections"].messages()
        ):
            frames["sonar"] = self.adapters["detections"].frame_in(messages)
        elif self._sonar is not None:
            frames["sonar"] = self._sonar
        tree = static_frames(self._recording)
        mountings = {}
        for name, frame in frames.items():
            try:
                found = mounting_of(frame, tree)
            except LogError as error:
                if name not in stated:
                    raise LogError(
                        f"{self._recording.path}: {name}: {error}"
                    ) from error
                found = None
            if found is not None:
                mountings[name] = found
        self.mounted = {
            name: frames[name] for name in mountings if name not in in_record
        }
        mounted = mountings.keys() | stated
        self._is_mounting_known = "dvl" in mounted
        if recorded is None:  # a record of this package states what is not zero
            self._unplaced = {
                name: frame for name, frame in frames.items() if name not in mounted
            }
            self._has_tree = bool(tree)
        source = "from the log"
        if not is_recorded:
            source = (
                f"{', '.join(sorted(said))} from the log; else defaults"
                if said
                else "defaults"
            )
            source += (
                f"; mountings from /tf_static: {', '.join(self.mounted) or 'none'}"
            )
            missing = [
                f"{name} ({frame or 'unnamed'})"
                for name, frame in frames.items()
                if name not in mounted
            ]
            source += (
                f"; not in the tree, taken as base_link: {', '.join(missing)}"
                if missing
                else ""
            )
        if given:
            source = f"from {given.source}: {', '.join(given.fields()) or 'nothing'}; else {source}"
        self._notes["log.calibration"] = source
        return gathered(given, recorded, mountings)

    def block(self, role: str) -> Any:
        """The measurements of a role; None where it has no topic, or none of its rows is fit."""
        if role in self._blocks or role not in self.topics:
            return self._blocks.get(role)
        topic, adapter = self.topics[role], self.adapters[role]
        source: Any = self._tables.get(role) if adapter.reads_table else topic
        dropped: Dropped = {}
        if source is None:
            self._blocks[role] = None
        else:
            if isinstance(adapter, DepthAdapter) and (
                said := adapter.assumption(self.calibration.gravity_m_s2)
            ):
                self._notes["log.depth"] = said
            self._blocks[role], dropped = rows_of(
                adapter, source, self.calibration, *self.axes_and_origin(role)
            )
        if self._blocks[role] is not None and role in LEAST_MOVED and not self._is_live:
            self._blocks[role], stuck = self._without_repeats(role, self._blocks[role])
            dropped = dropped | stuck
        if dropped := topic.unsound | dropped:
            self._dropped[role] = dropped
        return self._blocks[role]

    def _without_repeats(self, role: str, rows: Any) -> tuple[Any, Dropped]:
        """Rows without those of a sensor that is stuck while the vehicle moves, and their number."""
        imu, dvl = self.block("imu"), self.block("dvl")
        if imu is None or dvl is None or len(rows) < 2:
            return rows, {}
        moved = way_by(role, imu, dvl, self.calibration, rows.stamps_ns)
        least = LEAST_MOVED[role]
        if isinstance(rows, LandmarkDetections):
            seen = np.column_stack((rows.range_m, rows.azimuth_rad))
            stuck = repeated_sightings(rows.stamps_ns, seen, moved, least)
        else:
            values = {
                "positions": "position_m",
                "heading": "yaw_rad",
                "depth": "z_m",
            }[role]
            stuck = repeats(getattr(rows, values).reshape(len(rows), -1), moved, least)
        if not stuck.any():
            return rows, {}
        first = int(np.argmax(stuck))
        late_s = (
            rows.stamps_ns[first] - max(imu.stamps_ns[0], dvl.stamps_ns[0])
        ) * 1e-9
        text = f"that repeat the same value while the vehicle moves, the first {late_s:.3f} s after the start"
        self._stuck[role] = (
            f"{np.count_nonzero(stuck)} of {len(rows)} rows {text.removeprefix('that ')}: left out"
        )
        return rows.rows(np.flatnonzero(~stuck)), {text: int(np.count_nonzero(stuck))}

    def axes_and_origin(self, role: str) -> tuple[Floats, Origin | None]:
        """``body_R_sensor`` of an orientation, and the origin of positions on the Earth, for `rows_of`."""
        R = (
            self._heading_mounting().pose().rotation().matrix()
            if role == "heading"
            else np.eye(3)
        )
        return R, self._origin() if role in ("positions", "truth") else None

    def _heading_mounting(self) -> Mounting:
        """Mounting of the sensor of an orientation: the IMU's where it is its topic, else that of its frame."""
        if self.topics["heading"] is self.topics.get("imu"):
            return self.calibration.imu.mounting
        frame = self.adapters["heading"].frame_in(self._tables["heading"].groups)
        return mounting_of(frame, static_frames(self._recording)) or Mounting()

    def _origin(self) -> Origin | None:
        """Origin of the world in degrees and metres: the configured one, or the first fix; None without any.

        The note ``log.origin`` has it.
        """
        origin, said = common_origin(self.adapters, self._tables)
        if said:
            self._notes["log.origin"] = said
        return origin

    def sequence(self, name: str | None = None) -> Sequence:
        """Everything that was chosen as one sequence, called ``name``, or as the log calls itself, or like the file.

        Raises LogError when IMU and DVL are not enough for any estimator, or a message breaks its own rules.
        """
        for role in ("imu", "dvl"):
            if self.block(role) is None:
                topic = self.topics[role]
                faults = self._dropped.get(role, {})
                keys = [
                    key
                    for fault in faults
                    if (key := self.adapters[role].accepts(fault)) is not None
                ]
                way_out = (
                    f"; `{', '.join(keys)}` under [{role}] in a log configuration uses them"
                    if keys
                    else ""
                )
                raise topic.error(
                    f"none of its {len(topic)} messages can be used: {_counts(faults)}{way_out}"
                )
        require_use(str(self._recording.path), self.block("imu"), self.block("dvl"))
        blocks = {role: self.block(role) for role in SEQUENCE_ROLES}
        stamps = [
            f"{role}: {text}"
            for role, table in self._tables.items()
            for text in stamp_faults(table.stamps_ns, table.topic.log_times_ns)
        ]
        from sonar_graph.logs.measured_start import (  # compiles
            is_whole,
            with_measured_start,
        )

        if not (self._is_start_stated or is_whole(self.calibration.start)):
            self.calibration, self._notes["log.start"] = with_measured_start(
                self.calibration, blocks
            )
        findings = {
            "log.dropped": self.left_out(),
            "log.stamps": stamps,
            "log.doubtful": list(self.doubts()),
            "log.warnings": list(self.warnings()),
            "log.gaps": list(
                gap_warnings(blocks["imu"], blocks["dvl"], self.calibration)
            ),
            "log.noise": list(unsaid_noise(blocks)),
        }
        self._notes |= {
            subject: "; ".join(texts) for subject, texts in findings.items() if texts
        }
        name = (
            name or recorded_name(self._recording) or spelt(self._recording.path.stem)
        )
        return Sequence(
            name=name, calibration=self.calibration, notes=self._notes, **blocks
        )

    def survey(self) -> tuple[list[str], list[str]]:
        """Rows left out and warnings of everything that was chosen, whether or not it is enough for a sequence."""
        imu, dvl, *_ = (self.block(role) for role in SEQUENCE_ROLES)
        gaps = (
            gap_warnings(imu, dvl, self.calibration)
            if imu is not None and dvl is not None
            else ()
        )
        return self.left_out(), [*self.doubts(), *self.warnings(), *gaps]

    def left_out(self) -> list[str]:
        """Numbers of rows that were left out of the blocks read so far, by role and reason."""
        return [
            f"{role}: {_counts(dropped)}" for role, dropped in self._dropped.items()
        ]

    def doubts(self) -> Iterator[str]:
        """Sentences about IMU and Doppler log with which no result is to be relied on, each after its role.

        Axes of the accelerometers that gravity contradicts, and quantities that are stuck.
        """
        imu = self.block("imu")
        dvl = self.block("dvl")
        if imu is None:
            return
        mounting = self.calibration.imu.mounting
        g = self.calibration.gravity_m_s2
        if gravity := gravity_warning(imu.specific_force, mounting, g):
            yield f"imu: {gravity}"
        # wheels turn evenly, and their rates jump
        if dvl is None or self.calibration.odometry_interpolation != "linear":
            return
        for quantity, stuck in stuck_quantities(imu, dvl).items():
            role = "dvl" if quantity == "velocity" else "imu"
            stamps_ns = dvl.stamps_ns if role == "dvl" else imu.stamps_ns
            if doubt := stuck_doubt(stamps_ns, stuck, quantity):
                yield f"{role}: {doubt}"

    def warnings(self) -> Iterator[str]:
        """Sentences about messages that can be read but look wrong, each after its role."""
        yield from (
            unplaced(name, frame, has_tree=self._has_tree)
            for name, frame in self._unplaced.items()
        )
        for role, table in self._tables.items():
            yield from (
                f"{role}: {text}" for text in self.adapters[role].warnings(table)
            )
        imu, dvl, depth, detections = (
            self.block(role) for role in ("imu", "dvl", "depth", "detections")
        )
        # otherwise rates jump, and wheels turn evenly
        is_linear = self.calibration.odometry_interpolation == "linear"
        found: list[tuple[str, str | None]] = []
        if imu is not None and is_linear:
            columns = (
                ("angular rate", imu.angular_velocity),
                ("specific force", imu.specific_force),
            )
            found += [
                ("imu", spike_warning(imu.stamps_ns, values, quantity))
                for quantity, values in columns
            ]
            found += [
                ("imu", stuck_warning(imu.stamps_ns, values, quantity))
                for quantity, values in columns
            ]
        if dvl is not None and is_linear:
            found.append(
                ("dvl", stuck_warning(dvl.stamps_ns, dvl.velocity, "velocity"))
            )
        if depth is not None:
            found.append(
                (
                    "depth",
                    stuck_warning(
                        depth.stamps_ns, depth.z_m[:, None], "height", is_coarse=True
                    ),
                )
            )
        if "dvl" in self._tables and not self._is_mounting_known:
            found.append(("dvl", axes_warning(self.adapters["dvl"])))
        yield from (
            f"{role}: {text}" for role, text in [*found, *self._stuck.items()] if text
        )
        yield from unsaid_noise(
            {role: self.block(role) for role in NOISE_FIELDS}, only_partly=True
        )
        stamps = [
            self._tables[role].stamps_ns
            for role in ("imu", "dvl")
            if role in self._tables
        ]
        if detections is not None and len(stamps) == 2:
            first_ns, last_ns = (
                max(ns.min() for ns in stamps),
                min(ns.max() for ns in stamps),
            )
            texts = detection_warnings(detections, int(first_ns), int(last_ns))
            yield from (f"detections: {text}" for text in texts)


def common_origin(
    adapters: Mapping[str, Adapter], tables: Mapping[str, FieldTable]
) -> tuple[Origin | None, str | None]:
    """Origin that fixes and true positions on the Earth share, in degrees and metres, and a note about it.

    The configured one, or the first fix; None without any. Adapters and tables are by role.
    """
    of_earth: dict[str, GeodeticFields] = {}
    for role in ("positions", "truth"):
        adapter = adapters.get(role)
        if (
            role in tables
            and isinstance(adapter, PositionAdapter | TruthAdapter)
            and adapter.geodetic is not None
        ):
            of_earth[role] = adapter.geodetic
    said = [
        fields.origin_deg_m
        for fields in of_earth.values()
        if fields.origin_deg_m is not None
    ]
    found = [
        fix
        for role, fields in of_earth.items()
        if (fix := fields.first_fix(tables[role])) is not None
    ]
    if not said and not found:
        return None, None
    latitude_deg, longitude_deg, height_m = origin = (said or found)[0]
    return origin, (
        f"of the world, x east, y north: latitude {latitude_deg:.8f}°, longitude {longitude_deg:.8f}°, height "
        f"{height_m:.3f} m, {'as configured' if said else 'the first fix'}"
    )


def rows_of(
    adapter: Any,
    source: Any,
    calibration: Calibration,
    body_R_sensor: Floats,
    origin: Origin | None,
) -> tuple[Any, Dropped]:
    """Rows of a table of messages, or of a topic where the adapter reads that, and the numbers left out by reason.

    ``body_R_sensor`` is of the sensor of an orientation; ``origin`` of the world, in degrees and metres.
    """
    if isinstance(adapter, DepthAdapter):
        return adapter.read(source, calibration.gravity_m_s2)
    if isinstance(adapter, HeadingAdapter):
        return adapter.read(source, body_R_sensor)
    if isinstance(adapter, PositionAdapter):
        return adapter.read(source, origin, calibration.positions.sigma_m)
    if isinstance(adapter, TruthAdapter):
        return adapter.read(source, origin)
    found: tuple[Any, Dropped] = adapter.read(source)
    return found


def _counts(dropped: Dropped) -> str:
    return ", ".join(f"{count} {fault}" for fault, count in dropped.items())


def require_use(file: str, imu: Imu, dvl: Dvl) -> None:
    """Refuse an IMU and a Doppler log without common time, or without a row of velocity in all directions."""
    if max(imu.stamps_ns[0], dvl.stamps_ns[0]) > min(
        imu.stamps_ns[-1], dvl.stamps_ns[-1]
    ):
        raise LogError(
            f"{file}: IMU {_span(imu)}, DVL {_span(dvl)}: no common time; of another clock or unit? "
            f"See stamp, stamp_unit_s and stamp_offset_s of the log configuration"
        )
    if is_partial(dvl).all():
        raise LogError(
            f"{file}: DVL: too few valid beams in all {len(dvl)} rows; at least one row needs three, for a velocity in "
            f"all directions"
        )


def _span(rows: Block) -> str:
    return f"from {rows.stamps_ns[0] * 1e-9:.3f} to {rows.stamps_ns[-1] * 1e-9:.3f} s"


def unsaid_noise(
    blocks: Mapping[str, Any], *, only_partly: bool = False
) -> Iterator[str]:
    """Sensors with rows of unknown covariance, for which the noise of the calibration counts; blocks by role.

    With ``only_partly`` those of which other rows say one: a sensor that mostly knows its noise and here does not.
    """
    for role, (column, fields) in NOISE_FIELDS.items():
        if (block := blocks.get(role)) is not None:
            covariances = getattr(block, column)
            count = np.count_nonzero(
                np.isnan(covariances.reshape(len(covariances), -1)).any(axis=1)
            )
            if count and not (only_partly and count == len(covariances)):
                yield f"{role}: {count} of {len(covariances)} rows say no covariance, {fields} of the calibration count"
