"""From an MCAP log to a `Sequence`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from sonar_graph.calibration import Calibration
from sonar_graph.errors import LogError
from sonar_graph.logs.container import Keep, Recording, scan
from sonar_graph.logs.decoding import (
    WATER_DENSITY_KG_M3,
    Dropped,
    read_depth,
    read_detections,
    read_dvl,
    read_imu,
    read_landmark_map,
    read_truth,
)
from sonar_graph.logs.message_definitions import short_name
from sonar_graph.logs.mountings import mounting_of, static_frames, with_mountings
from sonar_graph.logs.roles import PRESSURE, READ_TYPES, Choice, choose_topics
from sonar_graph.logs.table import Table
from sonar_graph.measurements import Depth
from sonar_graph.sequence import Sequence

METADATA = "sonar_graph"
"""The metadata record that carries name, calibration and notes."""

T = TypeVar("T")


def read_sequence(
    path: Path,
    *,
    calibration: Calibration | None = None,
    name: str | None = None,
    topics: Mapping[str, str] | None = None,
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
        fit or none is found by type and name.

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
    recording = scan(path, lambda kind: Keep.ALL if short_name(kind) in READ_TYPES else Keep.STAMP)
    recording.require_sound()
    return _Reader(recording, choose_topics(recording, topics or {})).sequence(calibration, name)


class _Reader:
    """Turns chosen topics into a sequence and keeps account of how."""

    def __init__(self, recording: Recording, choices: Mapping[str, Choice]) -> None:
        self._recording = recording
        self._record = recording.metadata.get(METADATA, {})
        self._topics = {role: recording.topics[c.topic] for role, c in choices.items() if c.topic is not None}
        self._tables = {
            role: Table(self._topics[role]) for role in ("imu", "dvl", "depth", "truth") if role in self._topics
        }
        self._dropped: dict[str, Dropped] = {}
        self._notes = read_notes(recording)
        self._notes["log.topics"] = "; ".join(f"{role}: {topic.name}" for role, topic in self._topics.items())
        if choices["truth"].topic is None:
            self._notes["log.truth"] = choices["truth"].reason
        if recording.ending:
            self._notes["log.ending"] = recording.ending

    def sequence(self, calibration: Calibration | None, name: str | None) -> Sequence:
        tables = self._tables
        calibration = self._calibration(calibration)
        sequence = Sequence(
            name=name or self._record.get("name") or self._recording.path.stem,
            calibration=calibration,
            imu=self._needed("imu", self._kept("imu", read_imu(tables["imu"]))),
            dvl=self._needed("dvl", self._kept("dvl", read_dvl(tables["dvl"]))),
            depth=self._depth(calibration),
            detections=self._kept("detections", read_detections(self._topics["detections"]))
            if "detections" in self._topics
            else None,
            truth=self._kept("truth", read_truth(tables["truth"])) if "truth" in tables else None,
            true_landmarks=read_landmark_map(self._topics["true_landmarks"])
            if "true_landmarks" in self._topics
            else None,
            notes=self._notes,
        )
        if self._dropped:
            self._notes["log.dropped"] = "; ".join(f"{role}: {_list(d)}" for role, d in self._dropped.items())
        return sequence

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

    def _depth(self, calibration: Calibration) -> Depth | None:
        if "depth" not in self._tables:
            return None
        if short_name(self._topics["depth"].type_name) == short_name(PRESSURE):
            g = calibration.gravity_m_s2
            self._notes["log.depth"] = (
                f"z = -(p - 101325 Pa) / ({WATER_DENSITY_KG_M3:g} kg/m3 x {g:g} m/s2), fresh water assumed"
            )
        return self._kept("depth", read_depth(self._tables["depth"], calibration))

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
        sensors = {role: self._tables[role].frame_id() for role in ("imu", "dvl")}
        if "depth" in self._topics and short_name(self._topics["depth"].type_name) == short_name(PRESSURE):
            sensors["depth"] = self._tables["depth"].frame_id()
        if "detections" in self._topics:
            sensors["sonar"] = self._topics["detections"].messages()[0].first_string("header.frame_id")
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
