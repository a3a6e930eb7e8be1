"""From an MCAP log to a `Sequence`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from sonar_graph.calibration import Calibration
from sonar_graph.errors import LogError
from sonar_graph.logs.adapters.adapter import Adapter
from sonar_graph.logs.adapters.config import LogConfig
from sonar_graph.logs.adapters.detection_array import DetectionArrayAdapter
from sonar_graph.logs.adapters.doppler import DvlAdapter
from sonar_graph.logs.adapters.inertial import ImuAdapter
from sonar_graph.logs.adapters.reference import TruthAdapter
from sonar_graph.logs.adapters.vertical import DepthAdapter
from sonar_graph.logs.container import Keep, Recording, scan
from sonar_graph.logs.decoding import read_detections, read_landmark_map
from sonar_graph.logs.message_definitions import short_name
from sonar_graph.logs.mountings import mounting_of, static_frames, with_mountings
from sonar_graph.logs.roles import Choice, choose_topics, wanted_types
from sonar_graph.logs.table import Dropped
from sonar_graph.measurements import Depth, LandmarkDetections
from sonar_graph.sequence import Sequence

METADATA = "sonar_graph"
"""The metadata record that carries name, calibration and notes."""

TABLES = frozenset({"imu", "dvl", "depth", "truth"})
"""Roles whose messages are read as one table."""

T = TypeVar("T")
A = TypeVar("A", bound=Adapter)


def read_sequence(
    path: Path,
    *,
    calibration: Calibration | None = None,
    name: str | None = None,
    topics: Mapping[str, str] | None = None,
    config: LogConfig | None = None,
) -> Sequence:
    """Read a log of ROS 2 messages.

    Stamps are those of the sensors' headers. What was left out, which topic was used for what and where the
    calibration comes from is in the sequence's notes, under ``log.*``.

    Parameters
    ----------
    path
        An MCAP file.
    calibration
        Instead of the one in the file; without either, defaults with the mountings of ``/tf_static``.
    name
        Instead of the one in the file; without either, the file's name.
    topics
        Topics by role (``imu``, ``dvl``, ``depth``, ``detections``, ``truth``, ``true_landmarks``), where several
        fit or none is found by type and name; before those of `config`.
    config
        What the topics of a foreign log are; `read_log_config` reads one from a TOML file.

    Raises
    ------
    MissingTopicError
        When the log has no IMU or no DVL; listing the topics that it has.
    LogError
        When the file is not MCAP, is damaged in its middle, or a message breaks its own rules.
    CalibrationError
        When the calibration in the file is not one.
    """
    path = Path(path)
    config = config or LogConfig()
    types = wanted_types(config)
    recording = scan(path, lambda kind: Keep.ALL if short_name(kind) in types else Keep.STAMP)
    recording.require_sound()
    return _Reader(recording, choose_topics(recording, topics or {}, config)).sequence(calibration, name)


class _Reader:
    """Turns chosen topics into a sequence and keeps account of how."""

    def __init__(self, recording: Recording, choices: Mapping[str, Choice]) -> None:
        self._recording = recording
        self._record = recording.metadata.get(METADATA, {})
        self._topics = {role: recording.topics[c.topic] for role, c in choices.items() if c.topic is not None}
        self._adapters = {role: c.adapter for role, c in choices.items() if c.adapter is not None}
        self._tables = {
            role: self._adapters[role].table(topic) for role, topic in self._topics.items() if role in TABLES
        }
        self._dropped: dict[str, Dropped] = {}
        self._notes = read_notes(recording)
        self._notes["log.topics"] = "; ".join(f"{role}: {topic.name}" for role, topic in self._topics.items())
        if choices["truth"].topic is None:
            self._notes["log.truth"] = choices["truth"].reason
        if recording.ending:
            self._notes["log.ending"] = recording.ending

    def sequence(self, calibration: Calibration | None, name: str | None) -> Sequence:
        calibration = self._calibration(calibration)
        sequence = Sequence(
            name=name or self._record.get("name") or self._recording.path.stem,
            calibration=calibration,
            imu=self._needed("imu", self._kept("imu", self._adapter("imu", ImuAdapter).read(self._tables["imu"]))),
            dvl=self._needed("dvl", self._kept("dvl", self._adapter("dvl", DvlAdapter).read(self._tables["dvl"]))),
            depth=self._depth(calibration),
            detections=self._detections(),
            truth=self._kept("truth", self._adapter("truth", TruthAdapter).read(self._tables["truth"]))
            if "truth" in self._tables
            else None,
            true_landmarks=read_landmark_map(self._topics["true_landmarks"])
            if "true_landmarks" in self._topics
            else None,
            notes=self._notes,
        )
        if self._dropped:
            self._notes["log.dropped"] = "; ".join(f"{role}: {_list(d)}" for role, d in self._dropped.items())
        warnings = [
            f"{role}: {text}" for role, table in self._tables.items() for text in self._adapters[role].warnings(table)
        ]
        if warnings:
            self._notes["log.warnings"] = "; ".join(warnings)
        return sequence

    def _adapter(self, role: str, kind: type[A]) -> A:
        adapter = self._adapters[role]
        assert isinstance(adapter, kind)  # each role has adapters of one kind
        return adapter

    def _kept(self, role: str, outcome: tuple[T, Dropped]) -> T:
        if outcome[1]:
            self._dropped[role] = outcome[1]
        return outcome[0]

    def _needed(self, role: str, block: T | None) -> T:
        if block is None:
            topic = self._topics[role]
            faults = _list(self._dropped.get(role, {}))
            raise LogError(f"{topic.file}: topic {topic.name}: none of its {len(topic)} messages can be used: {faults}")
        return block

    def _detections(self) -> LandmarkDetections | None:
        if "detections" not in self._topics:
            return None
        adapter, topic = self._adapters["detections"], self._topics["detections"]
        outcome = adapter.read(topic) if isinstance(adapter, DetectionArrayAdapter) else read_detections(topic)
        return self._kept("detections", outcome)

    def _depth(self, calibration: Calibration) -> Depth | None:
        if "depth" not in self._tables:
            return None
        adapter = self._adapter("depth", DepthAdapter)
        assumption = adapter.assumption(calibration.gravity_m_s2)
        if assumption:
            self._notes["log.depth"] = assumption
        return self._kept("depth", adapter.read(self._tables["depth"], calibration.gravity_m_s2))

    def _calibration(self, given: Calibration | None) -> Calibration:
        recorded = read_calibration(self._recording)
        if given is not None:
            self._notes["log.calibration"] = "given by the caller"
            return given
        if recorded is not None:
            self._notes["log.calibration"] = "from the log"
            return recorded
        return self._default_calibration()

    def _default_calibration(self) -> Calibration:
        frames = static_frames(self._recording)
        sensors: dict[str, str] = {}
        for role in ("imu", "dvl"):
            sensors[role] = self._adapters[role].frame_in(self._tables[role].groups)
        if "depth" in self._tables and (frame := self._adapters["depth"].frame_in(self._tables["depth"].groups)):
            sensors["depth"] = frame
        if "detections" in self._topics:
            sensors["sonar"] = self._adapters["detections"].frame_in(self._topics["detections"].messages())
        found = {name: mounting_of(frame, frames) for name, frame in sensors.items()}
        known = {name: mounting for name, mounting in found.items() if mounting is not None}
        missing = [f"{name} ({sensors[name]!r})" for name in sensors if name not in known]
        self._notes["log.calibration"] = f"defaults; mountings from /tf_static: {', '.join(known) or 'none'}" + (
            f"; not in the tree, taken as base_link: {', '.join(missing)}" if missing else ""
        )
        return with_mountings(Calibration(), known)


def _list(dropped: Dropped) -> str:
    return ", ".join(f"{count} {fault}" for fault, count in dropped.items())


def read_calibration(recording: Recording) -> Calibration | None:
    """The calibration that a log carries, or None.

    Raises
    ------
    CalibrationError
        When it is not one.
    """
    text = recording.metadata.get(METADATA, {}).get("calibration")
    if text is None:
        return None
    return Calibration.parse(_json(recording, "calibration", text), f"{recording.path}: metadata record {METADATA!r}")


def read_notes(recording: Recording) -> dict[str, str]:
    """The notes that a log carries.

    Raises
    ------
    LogError
        When they are not a JSON object.
    """
    notes = _json(recording, "notes", recording.metadata.get(METADATA, {}).get("notes", "{}"))
    if not isinstance(notes, dict):
        raise LogError(f"{recording.path}: metadata record {METADATA!r}: notes must be a JSON object")
    return {str(subject): str(note) for subject, note in notes.items()}


def _json(recording: Recording, key: str, text: str) -> object:
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise LogError(f"{recording.path}: metadata record {METADATA!r}: {key} is not JSON: {error}") from error
