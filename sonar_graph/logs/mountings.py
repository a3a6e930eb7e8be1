"""Where sensors sit: ``/tf_static`` to mountings and back."""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.logs.cdr import Value, encode
from sonar_graph.logs.container import Recording
from sonar_graph.logs.layout import Bytes
from sonar_graph.logs.message_definitions import definition, short_name
from sonar_graph.logs.roles import TF
from sonar_graph.logs.schema import parse_definition

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
