"""Setup of the vehicle that a log states: mountings in ``/tf_static``, and calibration, name and notes in its record.

A calibration is gathered field by field. A user's file goes before the metadata record of the log, the record before
the mountings of ``/tf_static``, and these before defaults (docs/design/0004-logs.md).
"""

from __future__ import annotations

import json
import math
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
from sonar_graph.files import as_path, text_of
from sonar_graph.logs.cdr import (
    Bytes,
    Value,
    definition,
    encode,
    parse_definition,
    short_name,
)
from sonar_graph.logs.mcap import Keep, Recording, earlier_parts, scan
from sonar_graph.logs.roles import TF
from sonar_graph.measurements import Floats
from sonar_graph.settings import faults_in, parse

METADATA = "sonar_graph"
"""Name of the metadata record with name, calibration and notes."""
BODY_FRAME = "base_link"
BODY_FRAMES = (BODY_FRAME, "base_footprint")
"""Names of the body's frame, of which the first counts that is there."""
FrameTree = dict[str, tuple[str, gtsam.Pose3 | str]]
"""Parent and ``parent_T_frame`` of each frame; instead of a pose the fault of one that cannot be."""
LARGEST_LEVER_M = 1000.0
"""No vehicle is as long."""
Values = Mapping[str, Any]
OPTIONAL = {name for name, value in Calibration().model_dump().items() if value is None}
"""Fields of a calibration that may be absent."""
GIVEN = "given by the caller"
"""Source of a calibration that replaces that of the log."""
MOUNTING_FIELDS = {
    "imu": "mounting",
    "dvl": "mounting",
    "depth": "port_m",
    "positions": "antenna_m",
    "sonar": "mounting",
}
"""Field of each sensor's section that says where the sensor is."""


def static_frames(recording: Recording) -> FrameTree:
    """Frames of ``/tf_static``; of several transforms to one frame the last holds.

    Of a bag that is split by time, only the first file may have ``/tf_static``: the files before it are read too.
    """
    frames = _frames_in(recording)
    for part in () if frames else earlier_parts(recording.path):
        frames |= _frames_in(scan(part, _transforms))
    return frames


def _transforms(kind: str) -> Keep:
    return Keep.ALL if short_name(kind) == short_name(TF) else Keep.NONE


def _frames_in(recording: Recording) -> FrameTree:
    frames: FrameTree = {}
    for topic in recording.topics.values():
        if (
            not topic.name.endswith("tf_static")
            or short_name(topic.type_name) != short_name(TF)
            or not topic.is_ros2
        ):
            continue
        for group in topic.messages():
            translations = np.stack(
                [group[f"transforms.transform.translation.{axis}"] for axis in "xyz"],
                axis=-1,
            )
            rotations = np.stack(
                [group[f"transforms.transform.rotation.{axis}"] for axis in "wxyz"],
                axis=-1,
            )
            names = zip(
                group.strings("transforms.child_frame_id"),
                group.strings("transforms.header.frame_id"),
                strict=True,
            )
            for message, (children, parents) in enumerate(names):
                for i, (child, parent) in enumerate(
                    zip(children, parents, strict=True)
                ):
                    pose = _pose(translations[message, i], rotations[message, i])
                    frames[child.lstrip("/")] = parent.lstrip("/"), pose
    return frames


def _pose(translation_m: Floats, quaternion_wxyz: Floats) -> gtsam.Pose3 | str:
    """Pose of a transform, or its fault."""
    length = math.hypot(*quaternion_wxyz)
    if not np.isfinite([*quaternion_wxyz, *translation_m]).all():
        return "has numbers that are not finite"
    if not 0.5 < length < 2.0:
        return f"has a quaternion of length {length:g}, and one of a rotation has 1"
    if abs(length - 1) > 1e-6:  # unit quaternions keep every bit
        quaternion_wxyz = quaternion_wxyz / length
    return gtsam.Pose3(gtsam.Rot3.Quaternion(*quaternion_wxyz), translation_m)


def mounting_of(frame: str, frames: FrameTree) -> Mounting | None:
    """``body_T_frame`` through all frames in between; None where the frame does not hang on the body.

    The body is ``base_link``, else ``base_footprint``, with or without a namespace before it; a sensor's frame is found
    without its namespace too, where one frame alone fits. A LogError names the transform that cannot be one.
    """
    above = _above(_as_in_tree(frame.lstrip("/"), frames), frames)
    body_T_sensor = next(
        (
            pose
            for root in BODY_FRAMES
            if (pose := _from(root, above, frames)) is not None
        ),
        None,
    )
    if isinstance(body_T_sensor, str):
        raise _unusable(frame, body_T_sensor)
    if body_T_sensor is None:
        return None
    if not (lever_m := math.hypot(*body_T_sensor.translation())) < LARGEST_LEVER_M:
        raise _unusable(frame, f"is {lever_m:g} m from {BODY_FRAME}")
    x_m, y_m, z_m = body_T_sensor.translation().tolist()
    roll, pitch, yaw = body_T_sensor.rotation().rpy().tolist()
    return Mounting(translation_m=(x_m, y_m, z_m), rpy_rad=(roll, pitch, yaw))


def _last(name: str) -> str:
    return name.rpartition("/")[2]


def _as_in_tree(frame: str, frames: FrameTree) -> str:
    """Name of a frame in the tree: the same, or the only one that differs by a namespace in front."""
    if frame in frames or not frame or _last(frame) in BODY_FRAMES:
        return frame
    alike = [
        name
        for name in frames
        if name.endswith(f"/{frame}") or frame.endswith(f"/{name}")
    ]
    return alike[0] if len(alike) == 1 else frame


def _above(frame: str, frames: FrameTree) -> dict[str, gtsam.Pose3 | str]:
    """``ancestor_T_frame`` of a frame and all its ancestors, or the fault of a transform on the way to one."""
    above: dict[str, gtsam.Pose3 | str] = {frame: gtsam.Pose3()}
    name = frame
    while name in frames and frames[name][0] not in above:
        parent, parent_T_name = frames[name]
        name_T_frame = above[name]
        if isinstance(name_T_frame, str):
            above[parent] = name_T_frame
        elif isinstance(parent_T_name, str):
            above[parent] = f"the transform from {parent} to {name} {parent_T_name}"
        else:
            above[parent] = parent_T_name * name_T_frame
        name = parent
    return above


def _from(
    root: str, above: dict[str, gtsam.Pose3 | str], frames: FrameTree
) -> gtsam.Pose3 | str | None:
    """``body_T_frame`` of a body with a root's name above the frame, or beside it below a common ancestor.

    A fault of a transform in between is given in its place; None where no such body is in the tree.
    """
    body = next((name for name in above if _last(name) == root), None)
    if body is not None:
        return above[body]
    for beside in (name for name in frames if _last(name) == root):
        body_above = _above(beside, frames)
        shared = next((name for name in above if name in body_above), None)
        if shared is None:
            continue
        shared_T_frame = above[shared]
        shared_T_body = body_above[shared]
        if isinstance(shared_T_frame, str) or isinstance(shared_T_body, str):
            return shared_T_frame if isinstance(shared_T_frame, str) else shared_T_body
        return shared_T_body.inverse() * shared_T_frame
    return None


def _unusable(frame: str, fault: str) -> LogError:
    return LogError(
        f"/tf_static: {frame}: {fault}; state the sensor's mounting in a file for --calibration"
    )


def encode_mountings(calibration: Calibration) -> Bytes:
    """Encode the mountings of a calibration as one ``tf2_msgs/TFMessage``, shape (1, size), stamped zero."""
    mountings = {
        "imu": calibration.imu.mounting,
        "dvl": calibration.dvl.mounting,
        "depth": Mounting(translation_m=calibration.depth.port_m),
        "sonar": calibration.sonar.mounting,
        "positions": Mounting(translation_m=calibration.positions.antenna_m),
    }
    quaternions = Rotation.from_matrix(
        [m.pose().rotation().matrix() for m in mountings.values()]
    ).as_quat()
    translations = np.array([m.translation_m for m in mountings.values()])
    values: dict[str, Value] = {
        "transforms.header.frame_id": BODY_FRAME,
        "transforms.child_frame_id": list(mountings),
    }
    values |= {
        f"transforms.transform.translation.{axis}": translations[None, :, i]
        for i, axis in enumerate("xyz")
    }
    values |= {
        f"transforms.transform.rotation.{axis}": quaternions[None, :, i]
        for i, axis in enumerate("xyzw")
    }
    return encode(
        parse_definition(TF, definition(TF)), 1, values, {"transforms": len(mountings)}
    )


OTHER_FILES = (
    ({"ids", "matrix"}, "a model of recognition", "--model"),
    ({"landmark"}, "a file of landmark designs", "--designs"),
    ({"log", "labels"}, "a file of labels", "--labels"),
)
"""Fields by which other files of this package are known, what these are, and the option for them."""


@dataclass(frozen=True)
class PartialCalibration:
    """Fields that a user gives; the others are left to the log. ``false`` takes away an optional one (``floor``)."""

    values: Values
    source: str
    """Name of the file in errors and notes."""

    @classmethod
    def parse(cls, values: Values, source: str) -> PartialCalibration:
        """Check values as TOML and JSON give them; needed fields may still come from the log.

        A CalibrationError names the source, each wrong field, what was expected, and the fields that exist.
        """
        try:
            Calibration.model_validate(_over(Calibration().model_dump(), values))
        except ValidationError as error:
            absent = [
                fault["type"] == "missing" and isinstance(fault["loc"][-1], str)
                for fault in error.errors()
            ]
            if not all(absent):
                unused = [
                    role
                    for role in ("depth", "heading", "positions")
                    if values.get(role) is False
                ]
                advice = "".join(
                    f"; to leave {r} unused: use = false under [{r}] in the log configuration"
                    for r in unused
                )
                raise CalibrationError(
                    f"{source}: {faults_in(error, Calibration)}{advice}"
                ) from error
        return cls(values, source)

    @classmethod
    def read(cls, path: Path) -> PartialCalibration:
        """Read a TOML or JSON file (by its suffix), or the calibration of a log, whose fields go before the log's own.

        A file that cannot be read, is neither, or has a field that does not fit is a CalibrationError.
        """
        if path.suffix == ".mcap":
            try:
                recorded = read_calibration(scan(path, lambda _: Keep.NONE))
            except LogError as error:
                raise CalibrationError(str(error)) from error
            if recorded is None:
                raise CalibrationError(
                    f"{path}: the log has no calibration; give one that was written by sonar-graph"
                )
            return cls(recorded.model_dump(mode="json", exclude_unset=True), str(path))
        kind = "JSON" if path.suffix == ".json" else "TOML"
        try:
            text = text_of(path)
            values = json.loads(text) if kind == "JSON" else tomllib.loads(text)
        except OSError as error:
            raise CalibrationError(
                f"{path}: cannot be read: {error.strerror}"
            ) from error
        except (ValueError, RecursionError) as error:
            raise CalibrationError(f"{path}: not {kind}: {error}") from error
        if not isinstance(values, dict):
            what = "expected an object with sections such as imu"
            raise CalibrationError(f"{path}: {what}, not {json.dumps(values):.40}")
        for fields, what, option in OTHER_FILES:
            if fields <= values.keys():
                raise CalibrationError(
                    f"{path}: is {what}, not a calibration; give it with {option}"
                )
        return cls.parse(values, str(path))

    def over(self, other: PartialCalibration) -> PartialCalibration:
        """These fields, and those of another where these say nothing."""
        return PartialCalibration(
            _over(other.values, self.values), f"{self.source}, else {other.source}"
        )

    def fields(self) -> list[str]:
        """Paths of the fields that are given, such as ``dvl.mounting.translation_m``."""
        return list(_paths(self.values))

    def before(self, source: str) -> str:
        """Source of a calibration of which these fields go before those of another source."""
        return f"from {self.source}: {', '.join(self.fields()) or 'nothing'}; else {source}"


def as_calibration(
    value: Calibration | PartialCalibration | str | Path | None, call: str
) -> Calibration | PartialCalibration | None:
    """The given fields of a calibration, also those in a file; an `ArgumentError` that names the ``call`` for others."""
    if isinstance(value, Calibration | PartialCalibration | None):
        return value
    return PartialCalibration.read(
        as_path(value, f"{call}(path, calibration=FILE or Calibration)")
    )


def gathered(
    given: PartialCalibration | None,
    recorded: Calibration | None,
    mountings: Mapping[str, Mounting],
) -> Calibration:
    """Gather a calibration, field by field: what the user gives, what the record set, ``/tf_static``, and defaults.

    Mountings of ``/tf_static`` are by sensor; of ``depth`` and ``positions`` only the translation counts.
    Fields that together are no calibration are a CalibrationError, which names the user's source.
    """
    # a start that nobody states is not set
    values = Calibration().model_dump(exclude={"start"})
    for sensor, mounting in mountings.items():
        is_place = MOUNTING_FIELDS[sensor] != "mounting"
        values[sensor][MOUNTING_FIELDS[sensor]] = (
            mounting.translation_m if is_place else mounting.model_dump()
        )
    if recorded is not None:
        values = _over(values, recorded.model_dump(exclude_unset=True))
    if given is None:
        return Calibration.model_validate(values)
    return parse(Calibration, _over(values, given.values), given.source)


def recorded_calibration(calibration: Calibration) -> str:
    """JSON of a calibration for a log's record, without what nobody stated of the start."""
    said = calibration.start.model_fields_set
    exclude: dict[str, bool | set[str]] = {}
    if "start" not in calibration.model_fields_set:
        exclude["start"] = True
    elif said and "position_m" not in said:  # measured by a heading
        exclude["start"] = {"position_m"}
    return calibration.model_dump_json(exclude=exclude)


def recorded_fields(path: Path) -> dict[str, Any]:
    """Fields of a calibration that a log's record states, as JSON has them."""
    recorded = read_calibration(scan(path, lambda _: Keep.NONE))
    return (
        {} if recorded is None else recorded.model_dump(mode="json", exclude_unset=True)
    )


def static_mounting(path: Path, frame: str) -> Mounting | None:
    """Mounting of a sensor's frame by a log's ``/tf_static``, or None; errors as of `mounting_of`."""
    return mounting_of(frame, static_frames(scan(path, _transforms)))


def with_fields(recorded: Values, *changes: Values) -> str:
    """JSON of a record's calibration with further fields, of which the later ones count."""
    for change in changes:
        recorded = _over(recorded, change)
    return json.dumps(recorded)


def unplaced(sensor: str, frame: str, *, has_tree: bool) -> str:
    """Warning about a sensor whose place is not known, with what states it."""
    key = f"[{sensor}] {MOUNTING_FIELDS[sensor]}"
    where = f"{key} in a file for --calibration"
    if not frame:
        return (
            f"{sensor}: no frame in its messages: mounting taken as zero; give {where}"
        )
    tree = "" if has_tree else " (the log has no /tf_static)"
    other = (
        f", or frame_id under [{sensor}] in a log configuration"
        if has_tree and sensor != "sonar"
        else ""
    )
    return f"{sensor}: no transform from {frame} to {BODY_FRAME}{tree}: mounting taken as zero; give {where}{other}"


def mounted_by(values: Values) -> set[str]:
    """Sensors whose mounting is given."""
    sections = {
        sensor: values[sensor]
        for sensor in MOUNTING_FIELDS
        if isinstance(values.get(sensor), Mapping)
    }
    return {
        sensor
        for sensor, section in sections.items()
        if MOUNTING_FIELDS[sensor] in section
    }


def _over(values: Values, changes: Values) -> dict[str, Any]:
    """Values with changes, section by section; ``false`` takes away what may be absent (`OPTIONAL`)."""
    merged = dict(values)
    for name, change in changes.items():
        old = merged.get(name)
        if isinstance(old, Mapping) and isinstance(change, Mapping):
            merged[name] = _over(old, change)
        elif change is False and name in OPTIONAL:
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


def recorded_name(recording: Recording) -> str | None:
    """Name in the log's record, or None."""
    return recording.metadata.get(METADATA, {}).get("name")


def read_calibration(recording: Recording) -> Calibration | None:
    """Calibration in the log's record, or None; an invalid one is a `CalibrationError`."""
    text = recording.metadata.get(METADATA, {}).get("calibration")
    if text is None:
        return None
    return parse(
        Calibration,
        _json(recording, "calibration", text),
        f"{recording.path}: metadata record {METADATA!r}",
    )


def is_described(recording: Recording) -> bool:
    """Tell whether a log's record states all of a calibration, as `write_log` does, not only what was added to it."""
    try:
        recorded = read_calibration(recording)
    except CalibrationError:
        return False
    return (
        recorded is not None
        and recorded.model_fields_set | {"start"} == Calibration.model_fields.keys()
    )


def read_notes(recording: Recording) -> dict[str, str]:
    """Notes in the log's record, which must be a JSON object."""
    notes = _json(
        recording, "notes", recording.metadata.get(METADATA, {}).get("notes", "{}")
    )
    if not isinstance(notes, dict):
        raise LogError(
            f"{recording.path}: metadata record {METADATA!r}: notes must be a JSON object"
        )
    return {str(subject): str(note) for subject, note in notes.items()}


def with_notes(path: Path, notes: Mapping[str, str]) -> dict[str, str]:
    """Record of a log with further notes by subject, before its own; without a record the new one holds only notes.

    A log that cannot be read, or whose notes are no JSON object, is a LogError.
    """
    recording = scan(path, lambda _: Keep.NONE)
    return recording.metadata.get(METADATA, {}) | {
        "notes": json.dumps(read_notes(recording) | dict(notes))
    }


def _json(recording: Recording, key: str, text: str) -> object:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise LogError(
            f"{recording.path}: metadata record {METADATA!r}: {key} is not JSON: {error}"
        ) from error
