"""Setup of the vehicle that a log states: mountings in ``/tf_static``, and calibration, name and notes in its record.

A calibration is gathered field by field. A user's file goes before the metadata record of the log, the record before
the mountings of ``/tf_static``, and these before defaults (docs/design/0004-logs.md).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from pydantic import ValidationError

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.errors import CalibrationError, LogError
from sonar_graph.files import as_path, read_json, read_toml
from sonar_graph.logs.adapters import ADAPTERS
from sonar_graph.logs.cdr import (
    Bytes,
    Value,
    encode,
    parse_definition,
)
from sonar_graph.logs.mcap import Recording, earlier_parts, keeping, scan
from sonar_graph.logs.roles import TF
from sonar_graph.measurements import Floats
from sonar_graph.settings import faults_in, parse

METADATA = "sonar_graph"
"""Name of the metadata record with name, calibration and notes."""
BODY_FRAME = "base_link"
BODY_FRAMES = (BODY_FRAME, "base_footprint")
"""Names of the body's frame; the first that is there counts."""
POSE_FIELDS = tuple(
    f"transforms.transform.{part}.{axis}"
    for part, axes in (("translation", "xyz"), ("rotation", "xyzw"))
    for axis in axes
)
FrameTree = dict[str, tuple[str, gtsam.Pose3 | str]]
"""Parent and ``parent_T_frame`` of each frame; instead of a pose the fault of one that cannot be."""
LARGEST_LEVER_M = 50.0
"""No underwater vehicle is as long; in millimetres most levers are."""
Values = Mapping[str, Any]
OPTIONAL = {name for name, value in Calibration().model_dump().items() if value is None}
"""Fields of a calibration that may be absent."""
GIVEN = "given by the caller"
"""Source of a calibration that replaces that of the log."""
MOUNTING = "mounting"
MOUNTING_FIELDS = {
    "imu": MOUNTING,
    "dvl": MOUNTING,
    "depth": "port_m",
    "positions": "antenna_m",
    "sonar": MOUNTING,
}
"""Field of each sensor's section that states where the sensor is."""


def static_frames(recording: Recording) -> FrameTree:
    """Frames of ``/tf_static``; of several transforms to one frame the last holds.

    Of a bag that is split by time, only the first file may have ``/tf_static``: the files before it are read too.
    """
    frames = _frames_in(recording)
    for part in () if frames else earlier_parts(recording.path):
        frames |= _frames_in(scan(part, keeping([TF])))
    return frames


def _frames_in(recording: Recording) -> FrameTree:
    frames: FrameTree = {}
    for topic in recording.topics.values():
        is_tree = topic.name.endswith("tf_static") and topic.is_a(TF)
        if not is_tree or not topic.is_ros2:
            continue
        for group in topic.messages():
            # (messages, transforms, 7)
            poses = np.stack([group[path] for path in POSE_FIELDS], axis=-1)
            children = group.strings("transforms.child_frame_id")
            parents = group.strings("transforms.header.frame_id")
            for message, names in enumerate(zip(children, parents, strict=True)):
                for i, (child, parent) in enumerate(zip(*names, strict=True)):
                    pose = _pose(poses[message, i])
                    frames[child.lstrip("/")] = (parent.lstrip("/"), pose)
    return frames


def _pose(numbers: Floats) -> gtsam.Pose3 | str:
    """Pose of a transform, from its `POSE_FIELDS`, or its fault."""
    translation_m, quaternion_xyzw = np.split(numbers, [3])
    length = math.hypot(*quaternion_xyzw)
    if not np.isfinite(numbers).all():
        return "has numbers that are not finite"
    if not 0.5 < length < 2.0:
        return f"has a quaternion of length {length:g}, and one of a rotation has 1"
    if abs(length - 1) > 1e-6:  # unit quaternions keep every bit
        quaternion_xyzw = quaternion_xyzw / length
    x, y, z, w = quaternion_xyzw
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), translation_m)


def mounting_of(frame: str, frames: FrameTree) -> Mounting | None:
    """``body_T_frame`` through all frames in between; None where the frame does not hang on the body.

    The body is ``base_link``, else ``base_footprint``, with or without a namespace before it; a sensor's frame is found
    without its namespace too, where one frame alone fits. A LogError names the transform that cannot be one.
    """
    try:
        body_T_sensor = _body_T(_as_in_tree(frame.lstrip("/"), frames), frames)
        if body_T_sensor is None:
            return None
        lever_m = math.hypot(*body_T_sensor.translation())
        # also where it is NaN
        if not lever_m < LARGEST_LEVER_M:
            raise LogError(f"is {lever_m:g} m from {BODY_FRAME}: millimetres?")
    except LogError as error:
        advice = "state the sensor's mounting in a file for --calibration"
        raise LogError(f"/tf_static: {frame}: {error}; {advice}") from None
    x_m, y_m, z_m = body_T_sensor.translation().tolist()
    roll, pitch, yaw = body_T_sensor.rotation().rpy().tolist()
    return Mounting(translation_m=(x_m, y_m, z_m), rpy_rad=(roll, pitch, yaw))


def _last(name: str) -> str:
    return name.rpartition("/")[2]


def _as_in_tree(frame: str, frames: FrameTree) -> str:
    """Name of a frame in the tree: the same, or the only one that differs by a namespace in front."""
    if frame in frames or not frame or _last(frame) in BODY_FRAMES:
        return frame
    # drivers and robot descriptions disagree about namespaces
    alike = [
        name
        for name in frames
        if name.endswith(f"/{frame}") or frame.endswith(f"/{name}")
    ]
    return alike[0] if len(alike) == 1 else frame


def _body_T(frame: str, frames: FrameTree) -> gtsam.Pose3 | None:
    """``body_T_frame`` of the first body with which the frame shares an ancestor, or which is one; None without one."""
    above = _ancestors(frame, frames)
    for root in BODY_FRAMES:
        for body in (*above, *frames):
            above_body = _ancestors(body, frames)
            shared = next((name for name in above if name in above_body), None)
            if _last(body) == root and shared is not None:
                shared_T_frame = _pose_in(shared, above, frames)
                shared_T_body = _pose_in(shared, above_body, frames)
                return shared_T_body.inverse() * shared_T_frame
    return None


def _ancestors(frame: str, frames: FrameTree) -> list[str]:
    """A frame and all frames above it, up to the first that comes again in a circle."""
    names = [frame]
    while names[-1] in frames and frames[names[-1]][0] not in names:
        names.append(frames[names[-1]][0])
    return names


def _pose_in(ancestor: str, names: list[str], frames: FrameTree) -> gtsam.Pose3:
    """``ancestor_T_frame`` of the first of the names, where each frame hangs on the next."""
    pose = gtsam.Pose3()
    for name in names[: names.index(ancestor)]:
        parent, parent_T_name = frames[name]
        # only a fault on the way between sensor and body does harm
        if isinstance(parent_T_name, str):
            raise LogError(f"the transform from {parent} to {name} {parent_T_name}")
        pose = parent_T_name * pose
    return pose


def encode_mountings(calibration: Calibration) -> Bytes:
    """Encode the mountings of a calibration as one ``tf2_msgs/TFMessage``, shape (1, size), stamped zero."""
    poses = []
    for sensor, field in MOUNTING_FIELDS.items():
        place = getattr(getattr(calibration, sensor), field)
        mounting = place if field == MOUNTING else Mounting(translation_m=place)
        quaternion_xyzw = mounting.pose().rotation().toQuaternion().coeffs()
        poses.append([*mounting.translation_m, *quaternion_xyzw])
    columns = np.array(poses).T[:, None]  # (7, 1, sensors)
    values: dict[str, Value] = dict(zip(POSE_FIELDS, columns, strict=True))
    values["transforms.header.frame_id"] = BODY_FRAME
    values["transforms.child_frame_id"] = list(MOUNTING_FIELDS)
    return encode(parse_definition(TF), 1, values, {"transforms": len(poses)})


OTHER_FILES = {"matrix": "--model", "landmark": "--designs", "labels": "--labels"}
"""Options for other files of this package, by a field by which these are known."""


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
            faults = error.errors()
            # a needed field, unlike a kind of section, may still come from the log
            if not all(
                fault["type"] == "missing" and isinstance(fault["loc"][-1], str)
                for fault in faults
            ):
                advice = "".join(
                    f"; to leave {role} unused: use = false under [{role}] in the log configuration"
                    for role in ("depth", "heading", "positions")
                    if values.get(role) is False
                )
                for fault in faults:
                    if _is_of_log_config(fault["loc"]):
                        field = ".".join(map(str, fault["loc"]))
                        what = "is a key of a log configuration, not of a calibration: give it with --log-config"
                        raise CalibrationError(f"{source}: {field} {what}") from error
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
                recorded = recorded_fields(path)
            except LogError as error:
                raise CalibrationError(str(error)) from error
            if recorded is None:
                raise CalibrationError(
                    f"{path}: the log has no calibration; give one that was written by sonar-graph"
                )
            return cls(recorded, str(path))
        if path.suffix == ".json":
            remedy = 'give sections, such as {"imu": {"gyro_noise_density": 1e-4}}'
            values = read_json(path, CalibrationError, remedy)
        else:
            values = read_toml(path, CalibrationError)
        for field in OTHER_FILES.keys() & values.keys():
            fault = f"is not a calibration; give it with {OTHER_FILES[field]}"
            raise CalibrationError(f"{path}: {fault}")
        return cls.parse(values, str(path))

    def over(self, other: PartialCalibration) -> PartialCalibration:
        """These fields, and those of another where these are unset."""
        return PartialCalibration(
            _over(other.values, self.values), f"{self.source}, else {other.source}"
        )

    def before(self, source: str) -> str:
        """Source of a calibration whose fields here go before those of another source."""
        given = ", ".join(_paths(self.values))
        return f"from {self.source}: {given or 'nothing'}; else {source}"


def _is_of_log_config(place: tuple[int | str, ...]) -> bool:
    """True of a field that no calibration has, where a log configuration has a key of its name."""
    if len(place) != 2:
        return False
    adapter = ADAPTERS.get(str(place[0]))
    section = Calibration.model_fields.get(str(place[0]))
    if adapter is None or section is None:
        return False
    key = str(place[1])
    own = getattr(section.annotation, "model_fields", {})
    return key in adapter.model_fields and key not in own


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
    # an unstated start is not set
    values = Calibration().model_dump(exclude={"start"})
    for sensor, mounting in mountings.items():
        field = MOUNTING_FIELDS[sensor]
        # a pressure port and an antenna have no axes
        has_axes = field == MOUNTING
        found = mounting.model_dump() if has_axes else mounting.translation_m
        values[sensor][field] = found
    if recorded is not None:
        values = _over(values, recorded.model_dump(exclude_unset=True))
    if given is None:
        return Calibration.model_validate(values)
    return parse(Calibration, _over(values, given.values), given.source)


def recorded_calibration(calibration: Calibration) -> str:
    """JSON of a calibration for a log's record, without the unstated part of the start."""
    said = calibration.start.model_fields_set
    exclude: dict[str, bool | set[str]] = {}
    if "start" not in calibration.model_fields_set:
        exclude["start"] = True
    elif said and "position_m" not in said:  # measured by a heading
        exclude["start"] = {"position_m"}
    return calibration.model_dump_json(exclude=exclude)


def recorded_fields(path: Path) -> dict[str, Any] | None:
    """Fields of a calibration that a log's record states, as JSON has them; None without one."""
    recorded = read_calibration(scan(path))
    if recorded is None:
        return None
    return recorded.model_dump(mode="json", exclude_unset=True)


def static_mounting(path: Path, frame: str) -> Mounting | None:
    """Mounting of a sensor's frame by a log's ``/tf_static``, or None; errors as of `mounting_of`."""
    return mounting_of(frame, static_frames(scan(path, keeping([TF]))))


def with_fields(recorded: Values, *changes: Values) -> str:
    """JSON of a record's calibration with further fields; later ones count."""
    for change in changes:
        recorded = _over(recorded, change)
    return json.dumps(recorded)


TAKEN_AS_ZERO = "mounting taken as zero"


def unplaced(sensor: str, frame: str, *, has_tree: bool) -> str:
    """Warning about a sensor whose place is not known, with what states it."""
    where = f"[{sensor}] {MOUNTING_FIELDS[sensor]} in a file for --calibration"
    taken = f"{TAKEN_AS_ZERO}; give"
    if not frame:
        return f"{sensor}: no frame in its messages: {taken} {where}"
    missing = f"{sensor}: no transform from {frame} to {BODY_FRAME}"
    if not has_tree:
        return f"{missing} (the log has no /tf_static): {taken} {where}"
    if sensor != "sonar":
        where += f", or frame_id under [{sensor}] in a log configuration"
    return f"{missing}: {taken} {where}"


def mounted_by(values: Values) -> set[str]:
    """Sensors whose mounting is given."""
    return {
        sensor
        for sensor, field in MOUNTING_FIELDS.items()
        if isinstance(values.get(sensor), Mapping) and field in values[sensor]
    }


def _over(values: Values, changes: Values) -> dict[str, Any]:
    """Values with changes, section by section; ``false`` takes away what may be absent (`OPTIONAL`)."""
    merged = dict(values)
    for name, change in changes.items():
        old = merged.get(name)
        if isinstance(old, Mapping) and isinstance(change, Mapping):
            merged[name] = _over(old, change)
        # TOML has no null
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
    values = _recorded(recording, "calibration", None)
    if values is None:
        return None
    return parse(Calibration, values, f"{recording.path}: metadata record {METADATA!r}")


def is_described(recording: Recording) -> bool:
    """True where a log's record states all of a calibration, as `write_log` does, not only what was added to it."""
    try:
        recorded = read_calibration(recording)
    except CalibrationError:
        return False
    stated = set() if recorded is None else recorded.model_fields_set
    # a start may be left to be measured, and no log need have a map
    return stated | {"start", "map"} == Calibration.model_fields.keys()


def read_notes(recording: Recording) -> dict[str, str]:
    """Notes in the log's record, which must be a JSON object."""
    notes = _recorded(recording, "notes", {})
    if not isinstance(notes, dict):
        raise LogError(
            f"{recording.path}: metadata record {METADATA!r}: notes must be a JSON object"
        )
    return {str(subject): str(note) for subject, note in notes.items()}


def with_notes(path: Path, notes: Mapping[str, str]) -> dict[str, str]:
    """Record of a log with further notes by subject, before its own; without a record the new one holds only notes.

    A log that cannot be read, or whose notes are no JSON object, is a LogError.
    """
    recording = scan(path)
    return recording.metadata.get(METADATA, {}) | {
        "notes": json.dumps(read_notes(recording) | dict(notes))
    }


def _recorded(recording: Recording, key: str, default: object) -> object:
    """Content of the log's record under a key."""
    text = recording.metadata.get(METADATA, {}).get(key)
    if text is None:
        return default
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise LogError(
            f"{recording.path}: metadata record {METADATA!r}: {key} is not JSON: {error}"
        ) from error
