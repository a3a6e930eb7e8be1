"""Writing of logs: a `Sequence` and sonar images as ROS 2 messages in an MCAP file.

The functions ``*_messages`` are the reverse of the adapters; result logs for viewers use them too. What is written is
read back to the bit (docs/design/0004-logs.md).
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.files import as_path
from sonar_graph.images import SonarFrames
from sonar_graph.logs.adapters import SAMPLE_TYPES, body_to_ros
from sonar_graph.logs.cdr import (
    Bytes,
    Value,
    encode,
    parse_definition,
)
from sonar_graph.logs.mcap import Outgoing, recording
from sonar_graph.logs.roles import (
    DETECTIONS,
    DVL,
    HEADING,
    IMU,
    LANDMARK_MAP,
    ODOMETRY,
    POINT,
    POSE_WITH_COVARIANCE,
    SONAR_IMAGE,
    TF,
)
from sonar_graph.logs.vehicle_setup import (
    BODY_FRAME,
    METADATA,
    encode_mountings,
    recorded_calibration,
)
from sonar_graph.measurements import (
    NO_TRACK,
    NS_PER_S,
    Depth,
    Dvl,
    Floats,
    Heading,
    Imu,
    Ints,
    LandmarkDetections,
    PositionFixes,
)
from sonar_graph.sequence import Sequence, require_sequence
from sonar_graph.states import LandmarkMap, Trajectory

WORLD_FRAME = "map"
NOT_MEASURED = np.array([-1.0] + [0.0] * 8)
"""Covariance by which ROS marks values as not measured."""
_SECONDS = np.iinfo(np.int32)
Columns = dict[str, Value]
"""Columns of messages by the paths of their fields."""


def write_log(
    path: str | Path, sequence: Sequence, more: Iterable[Outgoing] = ()
) -> None:
    """Write a log of ROS 2 messages from which `read_log` gives the same sequence.

    Parameters
    ----------
    path
        The MCAP file; one that exists is replaced.
    sequence
        Its calibration, name and notes go into the metadata record ``sonar_graph``, the mountings into ``/tf_static``.
    more
        Messages that do not fit into memory at once, such as images: entries in the order of time, each taken when the
        one before is written.

    Raises
    ------
    LogError
        When the file cannot be written, or a stamp does not fit into a ROS 2 message.
    TypeError
        When the arguments are swapped.

    See Also
    --------
    read_log : The inverse.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from sonar_graph.logs import read_log, write_log
    >>> from sonar_graph.testing import small_world
    >>> with TemporaryDirectory() as folder:
    ...     write_log(Path(folder) / "dive.mcap", small_world())
    ...     copy = read_log(Path(folder) / "dive.mcap")
    >>> bool((copy.dvl.velocity == small_world().dvl.velocity).all())
    True
    """
    path = as_path(path, "write_log(path, sequence)")
    require_sequence(sequence, "write_log(path, sequence)")
    # latched messages come first: players send them before any sensor
    first_ns = int(min(sequence.imu.stamps_ns[0], sequence.dvl.stamps_ns[0]))
    mountings = encode_mountings(sequence.calibration)
    messages = [static_message("/tf_static", TF, first_ns, mountings)]
    if sequence.true_landmarks is not None:
        landmarks = sequence.true_landmarks
        messages.append(
            landmark_map_message("/ground_truth/landmarks", landmarks, first_ns)
        )
    messages.append(imu_messages("/imu/data", sequence.imu))
    messages.append(dvl_messages("/dvl/data", sequence.dvl))
    if sequence.depth is not None:
        messages.append(depth_messages("/depth/pose", sequence.depth))
    if sequence.heading is not None:
        messages.append(heading_messages("/heading", sequence.heading))
    if sequence.positions is not None:
        messages.append(fix_messages("/fixes/pose", sequence.positions))
    if sequence.detections is not None:
        messages += detection_messages("/sonar/landmarks", sequence.detections)
    if sequence.truth is not None:
        messages.append(truth_messages(sequence.truth))
    # what no ROS message holds: without it a reader would have to guess noise and start
    record = {
        "name": sequence.name,
        "calibration": recorded_calibration(sequence.calibration),
        "notes": json.dumps(sequence.notes),
    }
    with recording(path, {METADATA: record}) as out:
        out.write(messages, more)


def imu_messages(topic: str, imu: Imu) -> Outgoing:
    """``sensor_msgs/Imu`` without orientation."""
    # ROS marks an acceleration that was not measured by -1 in its covariance
    unmeasured = np.isnan(imu.specific_force).all(axis=1)
    values: Columns = {
        # not measured, but a quaternion of zeros is invalid and viewers refuse it
        "orientation.w": 1.0,
        "orientation_covariance": NOT_MEASURED[None, :],
        "linear_acceleration_covariance": np.outer(unmeasured, NOT_MEASURED),
    }
    values |= fields("angular_velocity", "xyz", imu.angular_velocity)
    values |= fields("linear_acceleration", "xyz", imu.specific_force)
    return stamped(topic, IMU, imu.stamps_ns, "imu", values)


def dvl_messages(topic: str, dvl: Dvl) -> Outgoing:
    """``marine_acoustic_msgs/Dvl`` over the bottom, without single beams."""
    # an unknown covariance is NaN here, and -1 in ROS
    covariances = dvl.velocity_cov.reshape(-1, 9).copy()
    covariances[np.isnan(covariances).any(axis=1)] = NOT_MEASURED
    values = fields("velocity", "xyz", dvl.velocity)
    values |= {"velocity_mode": 1, "velocity_covar": covariances, "num_good_beams": 4}
    # not known; 0 is what drivers leave that do not fill it
    values["sound_speed"] = np.nan
    return stamped(topic, DVL, dvl.stamps_ns, "dvl", values)


def depth_messages(topic: str, depth: Depth) -> Outgoing:
    """``PoseWithCovarianceStamped`` whose z alone counts; it keeps every bit of a height, a pressure does not."""
    covariances = np.zeros((len(depth), 6, 6))
    # zeros mean unknown in ROS
    covariances[:, 2, 2] = np.nan_to_num(depth.variance_m2, posinf=np.inf)
    values = {"pose.pose.position.z": depth.z_m}
    return _upright_poses(topic, depth.stamps_ns, values, covariances)


def heading_messages(topic: str, heading: Heading) -> Outgoing:
    """``sonar_graph_msgs/Heading``; it keeps every bit of an angle, a quaternion does not."""
    values = {"yaw_rad": heading.yaw_rad, "sigma_rad": heading.sigma_rad}
    return stamped(topic, HEADING, heading.stamps_ns, WORLD_FRAME, values)


def fix_messages(topic: str, fixes: PositionFixes) -> Outgoing:
    """``PoseWithCovarianceStamped`` whose position counts, and the upper left of the covariance."""
    is_known = ~np.isnan(fixes.covariance_m2).any(axis=(1, 2))
    covariances = np.zeros((len(fixes), 6, 6))
    covariances[is_known, :3, :3] = fixes.covariance_m2[is_known]
    values = fields("pose.pose.position", "xyz", fixes.position_m)
    return _upright_poses(topic, fixes.stamps_ns, values, covariances)


def _upright_poses(
    topic: str, stamps_ns: Ints, values: Mapping[str, Value], covariances: Floats
) -> Outgoing:
    """Poses without a turn, measured in part; covariances of shape (n, 6, 6)."""
    pose: Columns = {
        "pose.pose.orientation.w": 1.0,
        "pose.covariance": covariances.reshape(-1, 36),
    }
    return stamped(
        topic, POSE_WITH_COVARIANCE, stamps_ns, WORLD_FRAME, {**values, **pose}
    )


def detection_messages(topic: str, detections: LandmarkDetections) -> list[Outgoing]:
    """``sonar_graph_msgs/LandmarkDetections``, one a frame; frames with equally many detections share an entry."""
    # rows of one stamp are one sonar frame
    stamps_ns, first, counts = np.unique(
        detections.stamps_ns, return_index=True, return_counts=True
    )
    is_tracked = bool(np.any(detections.track != NO_TRACK))
    columns = {
        "range_m": detections.range_m,
        "azimuth_rad": detections.azimuth_rad,
        "covariance": detections.range_azimuth_cov,
        "candidate_ids": detections.candidate_ids,
        "id_probability": detections.id_probability,
        "track": detections.track[:, None]
        if is_tracked
        else np.empty((len(detections), 0), np.int64),
    }
    entries = []
    # all messages of an entry have one size, which depends on the number of detections
    for count in np.unique(counts).tolist():
        frames = counts == count
        rows = first[frames][:, None] + np.arange(count)
        values = {
            k: column[rows].reshape(len(rows), -1) for k, column in columns.items()
        }
        at_ns = stamps_ns[frames]
        entries.append(stamped(topic, DETECTIONS, at_ns, "sonar", values))
    return entries


def pose_columns(trajectory: Trajectory) -> Columns:
    """Columns of a ``PoseWithCovariance`` called ``pose``, with zeros for an unknown covariance."""
    # covariances are in body axes here, in world axes in ROS
    covariances = body_to_ros(trajectory.covariances, trajectory.matrices)
    values = fields("pose.pose.position", "xyz", trajectory.positions)
    values |= fields("pose.pose.orientation", "xyzw", trajectory.quaternions_xyzw)
    return values | {"pose.covariance": covariances.reshape(-1, 36)}


def odometry_messages(
    topic: str, trajectory: Trajectory, body_frame: str = BODY_FRAME
) -> Outgoing:
    """``nav_msgs/Odometry`` without a twist."""
    values = pose_columns(trajectory) | {"child_frame_id": body_frame}
    return stamped(topic, ODOMETRY, trajectory.stamps_ns, WORLD_FRAME, values)


def point_messages(topic: str, trajectory: Trajectory) -> Outgoing:
    """``geometry_msgs/PointStamped``, of a trajectory whose orientations are not known."""
    values = fields("point", "xyz", trajectory.positions)
    return stamped(topic, POINT, trajectory.stamps_ns, WORLD_FRAME, values)


def truth_messages(truth: Trajectory, body_frame: str = BODY_FRAME) -> Outgoing:
    """The true poses, or the points of a truth without orientations."""
    if truth.has_orientation:
        return odometry_messages("/ground_truth/odometry", truth, body_frame)
    return point_messages("/ground_truth/point", truth)


def pose_messages(topic: str, trajectory: Trajectory) -> Outgoing:
    """``geometry_msgs/PoseWithCovarianceStamped``."""
    values = pose_columns(trajectory)
    return stamped(
        topic, POSE_WITH_COVARIANCE, trajectory.stamps_ns, WORLD_FRAME, values
    )


def landmark_map_message(topic: str, landmarks: LandmarkMap, stamp_ns: int) -> Outgoing:
    """One ``sonar_graph_msgs/LandmarkMap``."""
    values = {
        "ids": landmarks.ids[None, :],
        "position": landmarks.positions.reshape(1, -1),
        "covariance": landmarks.covariances.reshape(1, -1),
    }
    return stamped(topic, LANDMARK_MAP, np.array([stamp_ns]), WORLD_FRAME, values)


def static_message(
    topic: str, type_name: str, stamp_ns: int, payload: Bytes
) -> Outgoing:
    """One latched message that is encoded already."""
    return Outgoing(topic, type_name, np.array([stamp_ns]), payload, is_latched=True)


def sonar_image_messages(
    topic: str,
    frames: SonarFrames,
    *,
    frequency_hz: float = 0.0,
    sound_speed_m_s: float = 0.0,
) -> Outgoing:
    """``marine_acoustic_msgs/ProjectedSonarImage``, one a frame, which `read_sonar_frames` reads back.

    A beam points to ``(x, y, z) = (0, -sin azimuth, cos azimuth)``: z forward, x up, y to the right. Samples keep their
    type, little-endian, all beams of the first range first. Ranges are float32 in this message.

    Parameters
    ----------
    topic
        Name of the topic, such as ``/sonar/image``.
    frames
        A block of frames.
    frequency_hz, sound_speed_m_s
        Frequency of the sonar, and the speed of sound that it took; 0: unknown.

    Raises
    ------
    LogError
        When the samples have a type that the message does not know, or a stamp does not fit into it.
    """
    count, beams, _ = frames.intensity.shape
    kind = f"{frames.intensity.dtype.kind}{frames.intensity.dtype.itemsize}"
    if kind not in SAMPLE_TYPES:
        raise LogError(
            f"{topic}: samples of type {frames.intensity.dtype} cannot be written; give {SAMPLE_TYPES}"
        )
    # drivers send all beams of a range side by side
    samples = np.ascontiguousarray(
        frames.intensity.transpose(0, 2, 1), dtype=f"<{kind}"
    )
    values = {
        "ping_info.frequency": frequency_hz,
        "ping_info.sound_speed": sound_speed_m_s,
        "beam_directions.y": -np.sin(frames.azimuths_rad)[None, :],
        "beam_directions.z": np.cos(frames.azimuths_rad)[None, :],
        "ranges": frames.ranges_m[None, :],
        "image.dtype": SAMPLE_TYPES.index(kind),
        "image.beam_count": beams,
        "image.data": samples.reshape(count, -1).view(np.uint8),
    }
    lengths = {"beam_directions": beams}
    return stamped(topic, SONAR_IMAGE, frames.stamps_ns, "sonar", values, lengths)


def header(stamps_ns: Ints, frame_id: str, prefix: str = "header") -> Columns:
    """Columns of a message's header.

    Raises `LogError` when a stamp lies outside what ROS 2 can express (years 1901 to 2038).
    """
    # also before 1970 nanoseconds are positive
    seconds, nanoseconds = np.divmod(stamps_ns, NS_PER_S)
    if len(seconds) and not (
        _SECONDS.min <= seconds.min() and seconds.max() <= _SECONDS.max
    ):
        raise LogError(
            f"stamp {stamps_ns.max()} ns: ROS 2 stamps have 32-bit seconds; give stamps of another epoch"
        )
    return {
        f"{prefix}.stamp.sec": seconds,
        f"{prefix}.stamp.nanosec": nanoseconds,
        f"{prefix}.frame_id": frame_id,
    }


def fields(prefix: str, names: str, columns: Floats) -> Columns:
    """Fields from columns side by side: ``fields("velocity", "xyz", v)``."""
    return {f"{prefix}.{name}": columns[..., i] for i, name in enumerate(names)}


def outgoing(
    topic: str,
    type_name: str,
    stamps_ns: Ints,
    values: Mapping[str, Value],
    lengths: Mapping[str, int] | None = None,
    *,
    is_latched: bool = False,
) -> Outgoing:
    """Messages recorded at their stamps; values and lengths as for `encode`."""
    payloads = encode(parse_definition(type_name), len(stamps_ns), values, lengths)
    return Outgoing(topic, type_name, stamps_ns, payloads, is_latched)


def stamped(
    topic: str,
    type_name: str,
    stamps_ns: Ints,
    frame_id: str,
    values: Mapping[str, Value],
    lengths: Mapping[str, int] | None = None,
) -> Outgoing:
    """Messages with a header each, recorded at their stamps."""
    columns = header(stamps_ns, frame_id) | dict(values)
    return outgoing(topic, type_name, stamps_ns, columns, lengths)
