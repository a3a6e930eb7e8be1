"""Shipped adapters: message types of common drivers, with the conventions by which these fill them.

For one log, a few lines of TOML describe a type (docs/tutorials/04_your_own_log.md). For everybody it is added here:
make an adapter of its role, whose attributes are field paths and conventions (`Adapter` and its subclasses), and put
it into `SHIPPED` (docs/design/0004-logs.md).
"""

from dataclasses import dataclass

from sonar_graph.logs.adapters.adapter import Adapter, CovarianceFields
from sonar_graph.logs.adapters.aiding_messages import (
    GeodeticFields,
    HeadingAdapter,
    PositionAdapter,
)
from sonar_graph.logs.adapters.dvl_messages import DvlAdapter
from sonar_graph.logs.adapters.landmark_messages import (
    DetectionArrayAdapter,
    DetectionListsAdapter,
    LandmarkMapAdapter,
)
from sonar_graph.logs.adapters.sonar_messages import SonarAdapter
from sonar_graph.logs.adapters.vehicle_messages import (
    DepthAdapter,
    ImuAdapter,
    TruthAdapter,
)

TRUTH_WORDS = ("truth",)
_DVL_WORDS = ("dvl", "doppler")
_DEPTH_WORDS = ("depth",)
_HEADING_WORDS = ("heading", "compass", "ahrs")
_FIX_WORDS = ("fix", "gps", "gnss", "usbl")
_LANDMARK_WORDS = ("landmark", "sonar")
Z_DOWN_TYPES = frozenset({"marine_acoustic_msgs/msg/Dvl", "dvl_msgs/msg/DVL"})
"""Types whose definition or instrument has z downwards, which not all drivers follow."""


@dataclass(frozen=True)
class Shipped:
    """An adapter, and the topics for which it is taken without being asked for."""

    adapter: Adapter
    words: tuple[str, ...] = ()
    """Words of which the topic's name must contain one; none: any name fits."""
    is_general: bool = False
    """The type says little about the sensor: the adapter counts only where no topic of a more telling type fits."""


def _xyz(prefix: str) -> tuple[str, str, str]:
    return f"{prefix}.x", f"{prefix}.y", f"{prefix}.z"


def _poses(type_name: str, prefix: str, covariance: str | None) -> TruthAdapter:
    orientation = (*_xyz(f"{prefix}.orientation"), f"{prefix}.orientation.w")
    return TruthAdapter(
        type=type_name,
        position=_xyz(f"{prefix}.position"),
        orientation=orientation,
        covariance=covariance,
    )


def _water_linked(*covariance: str, meaning: str = "variance") -> DvlAdapter:
    return DvlAdapter(
        type="dvl_msgs/msg/DVL",
        velocity=_xyz("velocity"),
        covariance=CovarianceFields.model_validate(
            {"fields": covariance, "meaning": meaning}
        ),
        valid_where={"velocity_valid": True},
        altitude="altitude",
    )


IMU = ImuAdapter(
    type="sensor_msgs/msg/Imu",
    angular_velocity=_xyz("angular_velocity"),
    angular_velocity_status="angular_velocity_covariance[0]",
    linear_acceleration=_xyz("linear_acceleration"),
    linear_acceleration_status="linear_acceleration_covariance[0]",
)
ORIENTATION_OF_IMU = HeadingAdapter(
    type="sensor_msgs/msg/Imu",
    orientation=(*_xyz("orientation"), "orientation.w"),
    variance=CovarianceFields(fields=("orientation_covariance[8]",)),
    needs_variance=True,
    status="orientation_covariance[0]",
)
HEADING = HeadingAdapter(
    type="sonar_graph_msgs/msg/Heading",
    yaw="yaw_rad",
    variance=CovarianceFields(fields=("sigma_rad",), meaning="standard deviation"),
)
HEADING_QUATERNION = HeadingAdapter(
    type="geometry_msgs/msg/QuaternionStamped",
    orientation=(*_xyz("quaternion"), "quaternion.w"),
)
SATELLITE_FIELDS = GeodeticFields(
    latitude="latitude",
    longitude="longitude",
    height="altitude",
    status="status.status",
)
SATELLITE_FIX = PositionAdapter(
    type="sensor_msgs/msg/NavSatFix",
    geodetic=SATELLITE_FIELDS,
    covariance=CovarianceFields(fields=("position_covariance",)),
    covariance_type="position_covariance_type",
)
FIX_POSE = PositionAdapter(
    type="geometry_msgs/msg/PoseWithCovarianceStamped",
    position=_xyz("pose.pose.position"),
    covariance=CovarianceFields(fields=("pose.covariance",)),
    frame_id_field=None,
)
FIX_POINT = PositionAdapter(
    type="geometry_msgs/msg/PointStamped", position=_xyz("point"), frame_id_field=None
)
MARINE_DVL = DvlAdapter(
    type="marine_acoustic_msgs/msg/Dvl",
    velocity=_xyz("velocity"),
    covariance=CovarianceFields(fields=("velocity_covar",)),
    valid_where={"velocity_mode": 1, "beam_velocities_valid": True},
    may_be_unfilled=("velocity_mode", "beam_velocities_valid"),
    good_beams="num_good_beams",
    altitude="altitude",
)
UUV_SIMULATOR_DVLS = [
    DvlAdapter(
        type=f"{package}/msg/DVL",
        velocity=_xyz("velocity"),
        covariance=CovarianceFields(
            fields=("velocity_covariance",), negative="invalid", zero="unknown"
        ),
        altitude="altitude",
    )
    for package in (
        "uuv_sensor_ros_plugins_msgs",
        "stonefish_ros2",
        "cola2_msgs",
        "smarc_msgs",
    )
]
TWIST = DvlAdapter(
    type="geometry_msgs/msg/TwistWithCovarianceStamped",
    velocity=_xyz("twist.twist.linear"),
    covariance=CovarianceFields(fields=("twist.covariance",), negative="found"),
)
ODOMETRY_TWIST = TWIST.model_copy(
    update={
        "type": "nav_msgs/msg/Odometry",
        "frame_id_field": "child_frame_id",
        "other_frame_id_field": "header.frame_id",
    }
)
PRESSURE = DepthAdapter(
    type="sensor_msgs/msg/FluidPressure",
    pressure="fluid_pressure",
    variance=CovarianceFields(fields=("variance",)),
)
HEIGHT_OF_POSE = DepthAdapter(
    type="geometry_msgs/msg/PoseStamped", height="pose.position.z", frame_id_field=None
)
HEIGHT_OF_POSE_WITH_COVARIANCE = DepthAdapter(
    type="geometry_msgs/msg/PoseWithCovarianceStamped",
    height="pose.pose.position.z",
    variance=CovarianceFields(fields=("pose.covariance[14]",)),
    frame_id_field=None,
)
ODOMETRY_TRUTH = _poses("nav_msgs/msg/Odometry", "pose.pose", "pose.covariance")
POSE_TRUTH = _poses("geometry_msgs/msg/PoseStamped", "pose", None)
POSE_WITH_COVARIANCE_TRUTH = _poses(
    "geometry_msgs/msg/PoseWithCovarianceStamped", "pose.pose", "pose.covariance"
)
POINT_TRUTH = TruthAdapter(
    type="geometry_msgs/msg/PointStamped", position=_xyz("point")
)
SATELLITE_TRUTH = TruthAdapter(
    type="sensor_msgs/msg/NavSatFix", geodetic=SATELLITE_FIELDS
)
PROJECTED_SONAR_IMAGE = SonarAdapter(
    type="marine_acoustic_msgs/msg/ProjectedSonarImage",
    data="image.data",
    ranges="ranges",
    directions=_xyz("beam_directions"),
    sample_type="image.dtype",
    big_endian="image.is_bigendian",
)
OCULUS_PING = SonarAdapter(
    type="oculus_interfaces/msg/Ping",
    data="ping_data",
    range_resolution="range_resolution",
    bearings="bearings",
    bearing_unit_deg=0.01,
    sample_bytes="sample_size",
    row_gains="has_gains",
    row_bytes="step",
)
SHIPPED: dict[str, tuple[Shipped, ...]] = {
    "imu": (Shipped(IMU),),
    "dvl": (
        Shipped(MARINE_DVL),
        Shipped(_water_linked("cov.x", "cov.y", "cov.z")),
        Shipped(_water_linked("covariance")),
        Shipped(_water_linked("fom", meaning="standard deviation")),
        *map(Shipped, UUV_SIMULATOR_DVLS),
        Shipped(TWIST, _DVL_WORDS, is_general=True),
        Shipped(ODOMETRY_TWIST, _DVL_WORDS, is_general=True),
    ),
    "depth": (
        Shipped(PRESSURE),
        Shipped(HEIGHT_OF_POSE_WITH_COVARIANCE, _DEPTH_WORDS),
        Shipped(HEIGHT_OF_POSE, _DEPTH_WORDS),
    ),
    "heading": (
        Shipped(HEADING),
        Shipped(HEADING_QUATERNION, _HEADING_WORDS),
        Shipped(ORIENTATION_OF_IMU, is_general=True),
    ),
    "positions": (
        Shipped(SATELLITE_FIX),
        Shipped(FIX_POSE, _FIX_WORDS, is_general=True),
        Shipped(FIX_POINT, _FIX_WORDS, is_general=True),
    ),
    "detections": (
        Shipped(DetectionListsAdapter(type="sonar_graph_msgs/msg/LandmarkDetections")),
        Shipped(
            DetectionArrayAdapter(type="vision_msgs/msg/Detection3DArray"),
            _LANDMARK_WORDS,
            is_general=True,
        ),
    ),
    "truth": (
        Shipped(ODOMETRY_TRUTH, TRUTH_WORDS),
        Shipped(POSE_WITH_COVARIANCE_TRUTH, TRUTH_WORDS, is_general=True),
        Shipped(POSE_TRUTH, TRUTH_WORDS, is_general=True),
        Shipped(POINT_TRUTH, TRUTH_WORDS, is_general=True),
        Shipped(SATELLITE_TRUTH, TRUTH_WORDS, is_general=True),
    ),
    "true_landmarks": (
        Shipped(
            LandmarkMapAdapter(type="sonar_graph_msgs/msg/LandmarkMap"), TRUTH_WORDS
        ),
    ),
    "sonar": (Shipped(PROJECTED_SONAR_IMAGE), Shipped(OCULUS_PING)),
}
"""Adapters by role; of several for one type the first is taken whose fields the messages have."""
