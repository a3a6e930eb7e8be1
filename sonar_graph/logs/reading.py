"""From an MCAP log to a `Sequence`.

Whether what was read of a log is enough for an estimator, and where the calibration must stand in for it.

Chosen topics put together into a sequence, with an account of what was assumed, left out, and looks wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.errors import LogError
from sonar_graph.logs.adapters import (
    Adapter,
    DepthAdapter,
    DetectionArrayAdapter,
    DvlAdapter,
    ImuAdapter,
    LogConfig,
    TruthAdapter,
    changes_text,
    detection_warnings,
    read_detections,
    read_landmark_map,
    shipped_like,
)
from sonar_graph.logs.cdr import short_name
from sonar_graph.logs.checks import (
    axes_warning,
    gap_warnings,
    gravity_warning,
    is_partial,
    spike_warning,
    stamp_faults,
    stuck_warning,
)
from sonar_graph.logs.mcap import Keep, Progress, Recording, TimeWindow, Topic, scan
from sonar_graph.logs.message_table import Dropped, MessageTable
from sonar_graph.logs.roles import ROLES, Choice, choose_topics, wanted_types
from sonar_graph.logs.vehicle_setup import (
    PartialCalibration,
    gathered,
    mounted_by,
    mounting_of,
    read_calibration,
    read_notes,
    recorded_name,
    static_frames,
)
from sonar_graph.measurements import Block, Depth, Dvl, Floats, Imu, LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.states import Trajectory


def require_use(file: str, imu: Imu, dvl: Dvl) -> None:
    """Refuse measurements with which no estimator could begin.

    Raises
    ------
    LogError
        When IMU and Doppler log have no time in common, or too few beams make a velocity in every row.
    """
    if max(imu.stamps_ns[0], dvl.stamps_ns[0]) > min(imu.stamps_ns[-1], dvl.stamps_ns[-1]):
        raise LogError(
            f"{file}: IMU {_span(imu)}, DVL {_span(dvl)}: no common time; of another clock or unit? "
            f"See stamp, stamp_unit_s and stamp_offset_s of the log configuration"
        )
    if is_partial(dvl).all():
        raise LogError(
            f"{file}: DVL: too few valid beams in all {len(dvl)} rows; at least one row needs three, for a velocity in "
            f"all directions"
        )


def unsaid_noise(dvl: Dvl, depth: Depth | None, detections: LandmarkDetections | None) -> Iterator[str]:
    """Whose noise is the calibration's, because rows do not say it or say zero, less or no number."""
    yield from _unsaid("dvl", dvl, dvl.velocity_cov, "dvl.velocity_sigma_m_s")
    if depth is not None:
        yield from _unsaid("depth", depth, depth.variance_m2, "depth.sigma_m")
    if detections is not None:
        fields = "sonar.range_sigma_m and azimuth_sigma_rad"
        yield from _unsaid("detections", detections, detections.range_azimuth_cov, fields)


def _unsaid(role: str, rows: Block, covariances: Floats, fields: str) -> Iterator[str]:
    count = np.count_nonzero(np.isnan(covariances.reshape(len(rows), -1)).any(axis=1))
    if count:
        yield f"{role}: {count} of {len(rows)} rows say no covariance, {fields} of the calibration count"


def _span(rows: Block) -> str:
    first_s, last_s = rows.stamps_ns[0] * 1e-9, rows.stamps_ns[-1] * 1e-9
    return f"from {first_s:.3f} to {last_s:.3f} s"


_TABLES = frozenset({"imu", "dvl", "depth", "truth"})
"""Roles whose messages are read as one table."""
FOUND_ANEW = frozenset({"log.warnings", "log.gaps", "log.noise"})
"""Notes that say how a log's own rows are; those of an earlier reading may no longer hold."""
T = TypeVar("T")
A = TypeVar("A", bound=Adapter)


class Assembly:
    """Reads the topics that were chosen.

    Parameters
    ----------
    recording
        The log.
    choices
        By role.
    calibration
        Instead of the one in the log; or what goes before that, field by field.

    Raises
    ------
    LogError
        When messages of a chosen topic are not what they should be.
    CalibrationError
        When the calibration in the log, or what it becomes by the user's changes, is not one.
    """

    def __init__(
        self,
        recording: Recording,
        choices: Mapping[str, Choice],
        calibration: Calibration | PartialCalibration | None = None,
    ) -> None:
        self._recording = recording
        self._topics = {role: recording.topics[c.topic] for role, c in choices.items() if c.topic is not None}
        self._adapters = {role: c.adapter for role, c in choices.items() if c.adapter is not None}
        self._dropped: dict[str, Dropped] = {}
        tables = {role: self._table(role, topic) for role, topic in self._topics.items() if role in _TABLES}
        self._tables = {role: table for role, table in tables.items() if table is not None}
        self._is_mounting_known = True
        self._notes = {key: note for key, note in read_notes(recording).items() if key not in FOUND_ANEW}
        self._notes["log.topics"] = "; ".join(f"{role}: {topic.name}" for role, topic in self._topics.items())
        changes = list(self._changes())
        if changes:
            self._notes["log.adapters"] = "; ".join(changes)
        if "truth" in choices and choices["truth"].topic is None:
            self._notes["log.truth"] = choices["truth"].reason
        self._notes |= recording.notes()
        self.calibration = self._calibration(calibration)

    def sequence(self, name: str | None = None) -> Sequence:
        """All that was chosen as one sequence, called ``name``, or as the log calls itself, or like the file.

        Raises
        ------
        LogError
            When no row of IMU or DVL is fit for use, both have no time in common, no velocity is whole, or a message
            breaks its own rules.
        """
        imu, dvl = self._needed("imu", self.imu()), self._needed("dvl", self.dvl())
        require_use(str(self._recording.path), imu, dvl)
        sequence = Sequence(
            name=name or recorded_name(self._recording) or self._recording.path.stem,
            calibration=self.calibration,
            imu=imu,
            dvl=dvl,
            depth=self.depth(),
            detections=self.detections(),
            truth=self.truth(),
            true_landmarks=self._kept("true_landmarks", (read_landmark_map(self._topics["true_landmarks"]), {}))
            if "true_landmarks" in self._topics
            else None,
            notes=self._notes,
        )
        if self._dropped:
            self._notes["log.dropped"] = "; ".join(self.left_out())
        stamps = list(self._stamp_faults())
        if stamps:
            self._notes["log.stamps"] = "; ".join(stamps)
        found = {
            "log.warnings": list(self.warnings()),
            "log.gaps": list(gap_warnings(imu, dvl, self.calibration)),
            "log.noise": list(unsaid_noise(dvl, sequence.depth, sequence.detections)),
        }
        self._notes |= {subject: "; ".join(texts) for subject, texts in found.items() if texts}
        return sequence

    def imu(self) -> Imu | None:
        """The inertial measurements; None where no topic or no row is fit."""
        return self._kept("imu", self._adapter("imu", ImuAdapter).read(self._tables["imu"]))

    def dvl(self) -> Dvl | None:
        """The Doppler velocities; None where no topic or no row is fit."""
        return self._kept("dvl", self._adapter("dvl", DvlAdapter).read(self._tables["dvl"]))

    def depth(self) -> Depth | None:
        """The heights; None where no topic or no row is fit."""
        if "depth" not in self._tables:
            return None
        adapter = self._adapter("depth", DepthAdapter)
        assumption = adapter.assumption(self.calibration.gravity_m_s2)
        if assumption:
            self._notes["log.depth"] = assumption
        return self._kept("depth", adapter.read(self._tables["depth"], self.calibration.gravity_m_s2))

    def detections(self) -> LandmarkDetections | None:
        """The landmark detections; None where no topic or no row is fit."""
        return self._detections

    @cached_property
    def _detections(self) -> LandmarkDetections | None:
        if "detections" not in self._topics:
            return None
        adapter, topic = self._adapters["detections"], self._topics["detections"]
        outcome = adapter.read(topic) if isinstance(adapter, DetectionArrayAdapter) else read_detections(topic)
        return self._kept("detections", outcome)

    def truth(self) -> Trajectory | None:
        """The reference poses; None where no topic or no row is fit."""
        if "truth" not in self._tables:
            return None
        return self._kept("truth", self._adapter("truth", TruthAdapter).read(self._tables["truth"]))

    def left_out(self) -> list[str]:
        """Rows that were left out of what was read so far, by role and reason."""
        return [f"{role}: {_list(dropped)}" for role, dropped in self._dropped.items()]

    def warnings(self) -> Iterator[str]:
        """What can be read but looks wrong."""
        for role, table in self._tables.items():
            yield from (f"{role}: {text}" for text in self._adapters[role].warnings(table))
        if "imu" in self._tables and (imu := self.imu()) is not None:
            yield from (f"imu: {text}" for text in self._inertial_warnings(imu))
        is_linear = self.calibration.odometry_interpolation == "linear"  # wheels may turn evenly
        if is_linear and "dvl" in self._tables and (dvl := self.dvl()) is not None:
            text = stuck_warning(dvl.stamps_ns, dvl.velocity, "velocity")
            yield from [f"dvl: {text}"] if text else []
        if "dvl" in self._tables and not self._is_mounting_known:
            text = axes_warning(self._adapters["dvl"])
            yield from [f"dvl: {text}"] if text else []

        yield from (f"detections: {text}" for text in self._detection_warnings())

    def _detection_warnings(self) -> Iterator[str]:
        odometry = [self._tables[role].stamps_ns for role in ("imu", "dvl") if role in self._tables]
        if (seen := self.detections()) is not None and len(odometry) == 2:
            first_ns, last_ns = max(stamps.min() for stamps in odometry), min(stamps.max() for stamps in odometry)
            yield from detection_warnings(seen, int(first_ns), int(last_ns))

    def _inertial_warnings(self, imu: Imu) -> Iterator[str]:
        text = gravity_warning(imu.specific_force, self.calibration.imu.mounting, self.calibration.gravity_m_s2)
        yield from [text] if text else []
        if self.calibration.odometry_interpolation == "linear":  # held rates may jump
            text = spike_warning(imu)
            yield from [text] if text else []
            text = stuck_warning(imu.stamps_ns, imu.angular_velocity, "angular rate")
            yield from [text] if text else []

    def _gaps(self) -> Iterator[str]:
        imu = self.imu() if "imu" in self._tables else None
        dvl = self.dvl() if "dvl" in self._tables else None
        if imu is not None and dvl is not None:
            yield from gap_warnings(imu, dvl, self.calibration)

    def _stamp_faults(self) -> Iterator[str]:
        for role, table in self._tables.items():
            yield from (f"{role}: {text}" for text in stamp_faults(table.stamps_ns, table.topic.log_times_ns))

    def survey(self) -> tuple[list[str], list[str]]:
        """What is left out and what looks wrong in all that was chosen, be it enough for a sequence or not."""
        gaps = list(self._gaps())
        self.depth(), self.detections(), self.truth()
        return self.left_out(), [*self.warnings(), *gaps]

    def _changes(self) -> Iterator[str]:
        """What was said about topics beyond the adapters that come along."""
        for role, adapter in self._adapters.items():
            topic = self._topics[role]
            text = changes_text(adapter, shipped_like(role, topic.type_name, topic.definition()))
            yield from [f"{role}: {text}"] if text else []

    def _adapter(self, role: str, kind: type[A]) -> A:
        adapter = self._adapters[role]
        assert isinstance(adapter, kind)  # each role has adapters of one kind
        return adapter

    def _table(self, role: str, topic: Topic) -> MessageTable | None:
        """None for a role that is not needed, where no message of its topic is sound."""
        try:
            return self._adapters[role].table(topic)
        except LogError:
            if len(topic) or ROLES[role].is_required:
                raise
            self._dropped[role] = topic.unsound
            return None

    def _kept(self, role: str, outcome: tuple[T, Dropped]) -> T:
        dropped = self._topics[role].unsound | outcome[1]
        if dropped:
            self._dropped[role] = dropped
        return outcome[0]

    def _needed(self, role: str, block: T | None) -> T:
        if block is None:
            topic = self._topics[role]
            faults = _list(self._dropped.get(role, {}))
            raise LogError(f"{topic.file}: topic {topic.name}: none of its {len(topic)} messages can be used: {faults}")
        return block

    def _calibration(self, given: Calibration | PartialCalibration | None) -> Calibration:
        if isinstance(given, Calibration):
            self._notes["log.calibration"] = "given by the caller"
            return given
        recorded = read_calibration(self._recording)
        said = mounted_by(given.values if given else {}) | mounted_by(
            recorded.model_dump(exclude_unset=True) if recorded else {}
        )
        sensors = self._frames()
        known = self._mountings(sensors)
        self._is_mounting_known = "dvl" in known.keys() | said
        of_log = "from the log" if recorded else _source_of_mountings(sensors, known, said)
        self._notes["log.calibration"] = (
            f"from {given.source}: {', '.join(given.fields()) or 'nothing'}; else {of_log}" if given else of_log
        )
        return gathered(given, recorded, known)

    def _frames(self) -> dict[str, str]:
        """The frame of each sensor, by the calibration's name for it."""
        frames = {
            role: self._adapters[role].frame_in(table.groups) for role, table in self._tables.items() if role != "truth"
        }
        if not frames.get("depth", "depth"):
            del frames["depth"]  # a pose in the world: there is no port to mount
        if "detections" in self._topics and (messages := self._topics["detections"].messages()):
            frames["sonar"] = self._adapters["detections"].frame_in(messages)
        return frames

    def _mountings(self, sensors: Mapping[str, str]) -> dict[str, Mounting]:
        tree = static_frames(self._recording)
        found = {name: mounting_of(frame, tree) for name, frame in sensors.items()}
        return {name: mounting for name, mounting in found.items() if mounting is not None}


def _source_of_mountings(sensors: Mapping[str, str], known: Mapping[str, Mounting], said: set[str]) -> str:
    """Where the places of sensors come from in a log without a calibration, in words."""
    missing = [f"{name} ({frame or 'unnamed'})" for name, frame in sensors.items() if name not in known.keys() | said]
    return f"defaults; mountings from /tf_static: {', '.join(known) or 'none'}" + (
        f"; not in the tree, taken as base_link: {', '.join(missing)}" if missing else ""
    )


def _list(dropped: Dropped) -> str:
    return ", ".join(f"{count} {fault}" for fault, count in dropped.items())


def read_log(
    path: Path,
    *,
    calibration: Calibration | PartialCalibration | None = None,
    name: str | None = None,
    topics: Mapping[str, str] | None = None,
    config: LogConfig | None = None,
    window: TimeWindow | None = None,
    salvage: bool = False,
    progress: Progress | None = None,
) -> Sequence:
    """Read a log of ROS 2 messages.

    Stamps are those of the sensors' headers. What was left out, which topic was used for what and where the
    calibration comes from is in the sequence's notes, under ``log.*``.

    Parameters
    ----------
    path
        An MCAP file.
    calibration
        A `Calibration` replaces all that the file says. A `PartialCalibration` goes before it, field by field.
        Without either: the file's record; where it has none, defaults with the mountings of ``/tf_static``.
    name
        Instead of the one in the file; without either, the file's name.
    topics
        Topics by role (``imu``, ``dvl``, ``depth``, ``detections``, ``truth``, ``true_landmarks``), where several
        fit or none is found by type and name; before those of `config`.
    config
        What the topics of a foreign log are; `read_log_config` reads one from a TOML file.
    window
        Only what was recorded then, with ``/tf_static`` and other latched topics whenever recorded.
    salvage
        Read what is whole of a file that is damaged in its middle; what is lost is in the notes, under ``log.damage``.
    progress
        Called with the bytes done and the bytes in all.

    Raises
    ------
    MissingTopicError
        When the log has no IMU or no DVL; listing the topics that it has.
    LogError
        When the file is not MCAP, is damaged in its middle without `salvage`, has nothing in the window, or a message
        breaks its own rules.
    CalibrationError
        When the calibration in the file, or what `calibration` makes of it, is not one.
    """
    path = Path(path)
    config = config or LogConfig()
    types = wanted_types(config)
    recording = scan(path, lambda kind: Keep.ALL if short_name(kind) in types else Keep.NONE, window, progress)
    if not salvage:
        recording.require_sound()
    sequence = Assembly(recording, choose_topics(recording, topics or {}, config), calibration).sequence(name)
    said = _start_elsewhere(recording, calibration, window)
    return replace(sequence, notes=sequence.notes | {"log.start": said}) if said else sequence


def _start_elsewhere(
    recording: Recording, given: Calibration | PartialCalibration | None, window: TimeWindow | None
) -> str | None:
    """That the start pose in the log is of another instant than the first one read; None where that is not so."""
    if window is None or window.start is None or recording.beginning_ns is None or isinstance(given, Calibration):
        return None
    recorded = read_calibration(recording)
    is_given = given is not None and "start" in given.values
    late_ns = window.start.resolve(recording.beginning_ns) - recording.beginning_ns
    if is_given or late_ns <= 0 or recorded is None or "start" not in recorded.model_fields_set:
        return None
    return (
        f"the start pose that it states is of its beginning, {late_ns * 1e-9:.3f} s before the part that was read; "
        "give the pose there as [start] position_m and rpy_rad in a file for --calibration"
    )
