"""The ROS 2 messages that this package writes, as interface text.

`definition` gives the text which travels in a log beside the messages, so that any reader understands them without
ROS. Field names and order are those of ROS 2 Jazzy's ``common_interfaces`` and of ``marine_acoustic_msgs`` 2.1;
``sonar_graph_msgs`` is this package's own and documented in ``docs/design/0004-logs.md``.
"""

from __future__ import annotations

import re

_XYZ = "float64 x\nfloat64 y\nfloat64 z"

DEFINITIONS: dict[str, str] = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a",
    "geometry_msgs/Vector3": _XYZ,
    "geometry_msgs/Point": _XYZ,
    "geometry_msgs/Quaternion": f"{_XYZ}\nfloat64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": """\
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform""",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "nav_msgs/Odometry": """\
std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist""",
    "nav_msgs/Path": "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses",
    "sensor_msgs/Imu": """\
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance""",
    "sensor_msgs/FluidPressure": "std_msgs/Header header\nfloat64 fluid_pressure\nfloat64 variance",
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count",
    "sensor_msgs/PointCloud2": """\
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense""",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "marine_acoustic_msgs/Dvl": """\
uint8 DVL_MODE_BOTTOM=1
uint8 DVL_MODE_WATER=2
std_msgs/Header header
uint8 velocity_mode
uint8 dvl_type
geometry_msgs/Vector3 velocity
float64[9] velocity_covar
float64 altitude
float64 course_gnd
float64 speed_gnd
uint8 num_good_beams
float32 sound_speed
bool beam_ranges_valid
bool beam_velocities_valid
geometry_msgs/Vector3[4] beam_unit_vec
float64[4] range
float32[4] range_covar
float32[4] beam_quality
float32[4] beam_velocity
float32[4] beam_velocity_covar""",
    "marine_acoustic_msgs/PingInfo": """\
float32 frequency
float32 sound_speed
float32[] tx_beamwidths
float32[] rx_beamwidths""",
    "marine_acoustic_msgs/SonarImageData": """\
uint8 DTYPE_UINT8=0
uint8 DTYPE_INT8=1
uint8 DTYPE_UINT16=2
uint8 DTYPE_INT16=3
uint8 DTYPE_UINT32=4
uint8 DTYPE_INT32=5
uint8 DTYPE_UINT64=6
uint8 DTYPE_INT64=7
uint8 DTYPE_FLOAT32=8
uint8 DTYPE_FLOAT64=9
bool is_bigendian
uint32 dtype
uint32 beam_count
uint8[] data""",
    "marine_acoustic_msgs/ProjectedSonarImage": """\
std_msgs/Header header
marine_acoustic_msgs/PingInfo ping_info
geometry_msgs/Vector3[] beam_directions
float32[] ranges
marine_acoustic_msgs/SonarImageData image""",
    "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v",
    "visualization_msgs/MeshFile": "string filename\nuint8[] data",
    "visualization_msgs/Marker": """\
std_msgs/Header header
string ns
int32 id
int32 type
int32 action
geometry_msgs/Pose pose
geometry_msgs/Vector3 scale
std_msgs/ColorRGBA color
builtin_interfaces/Duration lifetime
bool frame_locked
geometry_msgs/Point[] points
std_msgs/ColorRGBA[] colors
string texture_resource
sensor_msgs/CompressedImage texture
visualization_msgs/UVCoordinate[] uv_coordinates
string text
string mesh_resource
visualization_msgs/MeshFile mesh_file
bool mesh_use_embedded_materials""",
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers",
    "sonar_graph_msgs/LandmarkDetections": """\
# Landmarks recognised in one sonar frame; n detections with k candidate identities each.
std_msgs/Header header
float64[] range_m
float64[] azimuth_rad          # atan2(y, x) in the sonar frame, positive to the left
float64[] covariance           # 4 a detection, row-major over (range, azimuth); NaN: unknown
int64[] candidate_ids          # k a detection, row-major; -1 fills unused places
float64[] id_probability       # k a detection; what is missing to 1 is "no known landmark"
int64[] track                  # the watch of one object that each belongs to, -1: none; empty: none at all""",
    "sonar_graph_msgs/LandmarkMap": """\
# Landmarks by identity, in the frame of the header.
std_msgs/Header header
int64[] ids
float64[] position             # 3 a landmark: x, y, z in metres
float64[] covariance           # 9 a landmark, row-major, square metres; NaN: unknown""",
}

_SEPARATOR = "=" * 80
_FIELD_TYPE = re.compile(r"^(\w+/\w+)(?:\[.*?\])?\s", re.MULTILINE)


def definition(type_name: str) -> str:
    """The interface text of a message with all that it depends on, as it stands in an MCAP schema.

    Parameters
    ----------
    type_name
        With or without the ``msg`` in the middle: ``sensor_msgs/msg/Imu``.
    """
    wanted = [short_name(type_name)]
    for name in wanted:
        wanted += [used for used in dict.fromkeys(_FIELD_TYPE.findall(DEFINITIONS[name])) if used not in wanted]
    first, *others = wanted
    sections = (f"{_SEPARATOR}\nMSG: {name}\n{DEFINITIONS[name]}" for name in others)
    return "\n".join([DEFINITIONS[first], *sections]) + "\n"


def short_name(type_name: str) -> str:
    """``sensor_msgs/Imu`` for ``sensor_msgs/msg/Imu``: how interface texts refer to each other."""
    return type_name.replace("/msg/", "/")
