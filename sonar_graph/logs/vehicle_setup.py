"""Where sensors sit: ``/tf_static`` to mountings and back.

What the calibration of a run comes from, field by field.

What a user's file says goes before what the log's own record says, that before the mountings of ``/tf_static``, and
those before defaults.

What a log written by this package says about itself: name, calibration and notes, in a metadata record.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.errors import CalibrationError, LogError
from sonar_graph.logs.cdr import Bytes, Value, definition, encode, parse_definition, short_name
from sonar_graph.logs.mcap import Keep, Recording, scan
from sonar_graph.logs.roles import TF
from sonar_graph.settings import faults_in

BODY_FRAME = "base_link"
FrameTree = dict[str, tuple[str, gtsam.Pose3]]
"""Each frame's parent and ``parent_T_frame``."""


def static_frames(recording: Recording) -> FrameTree:
    """The frames of ``/tf_static``; of several transforms to one frame the last holds."""
    frames: FrameTree = {}
    for topic in recording.topics.values():
        if not topic.name.endswith("tf_static") or short_name(topic.type_name) != short_name(TF) or not topic.is_ros2:
            continue
        for group in topic.messages():
            translations = np.stack([group[f"transforms.transform.translation.{axis}"] for axis in "xyz"], axis=-1)
            rotations = np.stack([group[f"transforms.transform.rotation.{axis}"] for axis in "wxyz"], axis=-1)
            names = zip(
                group.strings("transforms.child_frame_id"), group.strings("transforms.header.frame_id"), strict=True
            )
            for message, (children, parents) in enumerate(names):
                for i, (child, parent) in enumerate(zip(children, parents, strict=True)):
                    rotation = gtsam.Rot3.Quaternion(*rotations[message, i])
                    frames[_plain(child)] = _plain(parent), gtsam.Pose3(rotation, translations[message, i])
    return frames


def _plain(frame: str) -> str:
    return frame.lstrip("/")


def mounting_of(frame: str, frames: FrameTree) -> Mounting | None:
    """``body_T_frame`` through all frames in between; None where the tree does not reach from the body to the frame."""
    body_T_sensor, name = gtsam.Pose3(), _plain(frame)
    for _ in range(len(frames) + 1):
        if name == BODY_FRAME:
            return _mounting(body_T_sensor)
        if name not in frames:
            break
        name, parent_T_frame = frames[name]
        body_T_sensor = parent_T_frame * body_T_sensor
    return None


def _mounting(body_T_sensor: gtsam.Pose3) -> Mounting:
    x_m, y_m, z_m = body_T_sensor.translation().tolist()
    roll, pitch, yaw = body_T_sensor.rotation().rpy().tolist()
    return Mounting(translation_m=(x_m, y_m, z_m), rpy_rad=(roll, pitch, yaw))


def with_mountings(calibration: Calibration, mountings: dict[str, Mounting]) -> Calibration:
    """A calibration with other mountings of ``imu``, ``dvl``, ``sonar``, or the port of ``depth``."""
    sections = {
        name: getattr(calibration, name).model_copy(
            update={"port_m": mounting.translation_m} if name == "depth" else {"mounting": mounting}
        )
        for name, mounting in mountings.items()
    }
    return calibration.model_copy(update=sections)


def encode_mountings(calibration: Calibration) -> Bytes:
    """One ``tf2_msgs/TFMessage`` with the mountings of a calibration, shape (1, size); stamped zero."""
    mountings = {
        "imu": calibration.imu.mounting,
        "dvl": calibration.dvl.mounting,
        "depth": Mounting(translation_m=calibration.depth.port_m),
        "sonar": calibration.sonar.mounting,
    }
    quaternions = Rotation.from_matrix([m.pose().rotation().matrix() for m in mountings.values()]).as_quat()
    translations = np.array([m.translation_m for m in mountings.values()])
    values: dict[str, Value] = {"transforms.header.frame_id": BODY_FRAME, "transforms.child_frame_id": list(mountings)}
    values |= {f"transforms.transform.translation.{axis}": translations[None, :, i] for i, axis in enumerate("xyz")}
    values |= {f"transforms.transform.rotation.{axis}": quaternions[None, :, i] for i, axis in enumerate("xyzw")}
    return encode(parse_definition(TF, definition(TF)), 1, values, {"transforms": len(mountings)})


Values = Mapping[str, Any]
MOUNTING_FIELDS = {"imu": "mounting", "dvl": "mounting", "depth": "port_m", "sonar": "mounting"}
"""Where each sensor's place is in its section."""


@dataclass(frozen=True)
class PartialCalibration:
    """What a user says; all else is left to the log. ``false`` takes away what may be absent, such as ``floor``."""

    values: Values
    source: str
    """Names the file in errors and notes."""

    @classmethod
    def parse(cls, values: Values, source: str) -> PartialCalibration:
        """Check plain values as TOML and JSON give them; what is not said may be needed, but not yet.

        Raises
        ------
        CalibrationError
            Naming the source, each wrong field, what was expected, and the fields that exist.
        """
        try:
            Calibration.model_validate(_over(Calibration().model_dump(), values))
        except ValidationError as error:
            if any(not _is_missing_field(fault["type"], fault["loc"]) for fault in error.errors()):
                raise CalibrationError(f"{source}: {faults_in(error, Calibration)}") from error
        return cls(values, source)

    @classmethod
    def read(cls, path: Path) -> PartialCalibration:
        """Read a TOML or JSON file (by its suffix) whose fields go before the log's own.

        Raises
        ------
        CalibrationError
            When the file is neither TOML nor JSON, or a field does not fit.
        """
        kind = "JSON" if path.suffix == ".json" else "TOML"
        try:
            text = path.read_text(encoding="utf-8")
            values = json.loads(text) if kind == "JSON" else tomllib.loads(text)
        except (json.JSONDecodeError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise CalibrationError(f"{path}: not {kind}: {error}") from error
        if not isinstance(values, dict):
            raise CalibrationError(
                f"{path}: expected an object with sections such as imu, not {json.dumps(values):.40}"
            )
        return cls.parse(values, str(path))

    def fields(self) -> list[str]:
        """Paths of all that is said, such as ``dvl.mounting.translation_m``."""
        return list(_paths(self.values))


def gathered(
    given: PartialCalibration | None, recorded: Calibration | None, mountings: Mapping[str, Mounting]
) -> Calibration:
    """The calibration from what there is, by precedence.

    Parameters
    ----------
    given
        What the user says.
    recorded
        What the log's record says; fields that it leaves out count as not said.
    mountings
        Those of ``/tf_static``, by sensor.

    Raises
    ------
    CalibrationError
        When all together is none; naming the user's source.
    """
    values = with_mountings(Calibration(), dict(mountings)).model_dump()
    if recorded is not None:
        values = _over(values, recorded.model_dump(exclude_unset=True))
    if given is None:
        return Calibration.model_validate(values)
    return Calibration.parse(_over(values, given.values), given.source)


def mounted_by(values: Values) -> set[str]:
    """Sensors whose place is said."""
    return {
        sensor
        for sensor, field in MOUNTING_FIELDS.items()
        if isinstance(values.get(sensor), Mapping) and field in values[sensor]
    }


def _over(values: Values, changes: Values) -> dict[str, Any]:
    merged = dict(values)
    for name, change in changes.items():
        old = merged.get(name)
        if isinstance(old, Mapping) and isinstance(change, Mapping):
            merged[name] = _over(old, change)
        elif change is False and name in merged and not isinstance(old, bool):
            merged[name] = None
        else:
            merged[name] = change
    return merged


def _paths(values: Values, prefix: str = "") -> Iterator[str]:
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _paths(value, f"{prefix}{name}.")
        else:
            yield prefix + name


def _is_missing_field(kind: str, place: tuple[int | str, ...]) -> bool:
    """Whether a field is missing, and not an element of a list."""
    return kind == "missing" and isinstance(place[-1], str)


METADATA = "sonar_graph"
"""The metadata record that carries name, calibration and notes."""


def recorded_name(recording: Recording) -> str | None:
    """The name that a log gives itself, or None."""
    return recording.metadata.get(METADATA, {}).get("name")


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


def with_notes(path: Path, notes: Mapping[str, str]) -> dict[str, str]:
    """A log's record as it is, with further notes.

    Parameters
    ----------
    path
        The log; one without a record is given one that holds only notes.
    notes
        By subject; they go before those of the log.

    Raises
    ------
    LogError
        When the log cannot be read, or its notes are no JSON object.
    """
    recording = scan(path, lambda _: Keep.NONE)
    return recording.metadata.get(METADATA, {}) | {"notes": json.dumps(read_notes(recording) | dict(notes))}


def _json(recording: Recording, key: str, text: str) -> object:
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise LogError(f"{recording.path}: metadata record {METADATA!r}: {key} is not JSON: {error}") from error
