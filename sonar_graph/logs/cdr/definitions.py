"""Definitions of ROS 2 messages: those that this package writes, and the parsing of those in a log.

A definition is ``ros2msg`` text (https://mcap.dev/spec/registry#ros2msg): the message's own fields, then those of the
types that it uses, each after a line of ``=`` and a line ``MSG: package/Type``. It travels with the messages, so that
any reader understands them without ROS. Field names and order are those of ROS 2 Jazzy's ``common_interfaces`` and of
``marine_acoustic_msgs`` 2.1; ``sonar_graph_msgs`` is this package's own (``docs/design/0004-logs.md``).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

from sonar_graph.errors import LogError

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
    "geometry_msgs/PointStamped": "std_msgs/Header header\ngeometry_msgs/Point point",
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
    "diagnostic_msgs/KeyValue": "string key\nstring value",
    "diagnostic_msgs/DiagnosticStatus": """\
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values""",
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
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
    "sonar_graph_msgs/Heading": """\
# Yaw of the body in the world, x east where it has a compass.
std_msgs/Header header
float64 yaw_rad                # Rz(yaw) Ry(pitch) Rx(roll), positive to the left
float64 sigma_rad              # standard deviation; NaN: unknown""",
    "sonar_graph_msgs/Dropped": """\
# A message of a record that the estimator was not given when it was live.
string topic
uint64 log_time                # time of its arrival, nanoseconds, which names it in its topic
string reason""",
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
    """Interface text of a type such as ``sensor_msgs/msg/Imu``, with all types that it uses, as in an MCAP schema."""
    wanted = [short_name(type_name)]
    for name in wanted:
        wanted += [
            used
            for used in dict.fromkeys(_FIELD_TYPE.findall(DEFINITIONS[name]))
            if used not in wanted
        ]
    first, *others = wanted
    sections = (f"{_SEPARATOR}\nMSG: {name}\n{DEFINITIONS[name]}" for name in others)
    return "\n".join([DEFINITIONS[first], *sections]) + "\n"


def short_name(type_name: str) -> str:
    """Type name as interface texts use it: ``sensor_msgs/Imu`` for ``sensor_msgs/msg/Imu``."""
    return type_name.replace("/msg/", "/")


# fmt: off
PRIMITIVES = {
    "bool": "?", "byte": "u1", "char": "u1", "float32": "f4", "float64": "f8",
    "uint8": "u1", "uint16": "u2", "uint32": "u4", "uint64": "u8",
    "int8":  "i1", "int16":  "i2", "int32":  "i4", "int64":  "i8",
}
# fmt: on
"""Type in numpy of each primitive, without the byte order."""
STRING = "string"
_MOST_FIELDS = 10_000
_DEEPEST = 50
_SHOWN = 80
"""Characters of a faulty line in an error."""
_LONGEST_TEXT = 1 << 20
_SECTION = re.compile(r"^=+\n[ \t]*MSG:[ \t]*(\S+)\n", re.MULTILINE)
_FIELD = re.compile(
    r"^(?P<type>[\w/]+)(?:<=\d+)?(?P<array>\[(?P<length>(?:<=)?\d{0,12})\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)$"
)


@dataclass(frozen=True, eq=False)
class Struct:
    """A message type with its fields in order."""

    name: str
    fields: tuple[Field, ...]


@dataclass(frozen=True)
class Field:
    """One field of a message type."""

    name: str
    kind: str | Struct
    """Key of `PRIMITIVES`, `STRING`, or a nested type."""
    length: int | None
    """Number of values: 1 for a single value, None for a sequence."""
    is_array: bool
    """True for an array or sequence."""


def parse_definition(type_name: str, text: str) -> Struct:
    """Tree of a message type, such as ``sensor_msgs/msg/Imu``, from its ``ros2msg`` text with all dependencies.

    Relative type names in the text belong to the package of the type. A LogError names the line that is not a field, or
    the type whose definition is not in the text.
    """
    found = _parsed(type_name, text)
    if isinstance(found, str):
        raise LogError(found)
    return found


@lru_cache(maxsize=256)
def _parsed(type_name: str, text: str) -> Struct | str:
    """Tree of a message type, or the fault of its text; both are remembered, since every role asks."""
    if len(text) > _LONGEST_TEXT:
        return f"the definition of {type_name} has {len(text)} characters, and at most {_LONGEST_TEXT} are read"
    own, *rest = _SECTION.split(
        "\n".join(stripped for line in text.splitlines() if (stripped := line.rstrip()))
        + "\n"
    )
    texts = {
        short_name(name): body for name, body in zip(rest[::2], rest[1::2], strict=True)
    }
    root = short_name(type_name)
    texts[root] = own
    try:
        return _Parser(texts).struct(root, ())
    except LogError as error:
        return str(error)


class _Parser:
    """Tree of types from their texts; each type is parsed once."""

    def __init__(self, texts: dict[str, str]) -> None:
        self._texts = texts
        self._done: dict[str, Struct] = {}
        self._sizes: dict[str, int] = {}

    def struct(self, name: str, users: tuple[str, ...]) -> Struct:
        """Type of some name; ``users`` are the types around it, from the outermost on."""
        if name in users:
            raise LogError(
                f"the definition of {users[0]} uses {name} within itself, which no ROS 2 message can"
            )
        if len(users) > _DEEPEST:
            raise LogError(
                f"the definition of {users[0]} nests types more than {_DEEPEST} deep; no real one does"
            )
        if name in self._done:
            return self._done[name]
        fields: dict[str, Field] = {}
        for line in (
            line.split("#", 1)[0].strip() for line in self._texts[name].splitlines()
        ):
            match = _FIELD.match(line)
            if line and (match is None or match["length"] == "0"):
                raise LogError(
                    f"the definition of {name} has the line {line[:_SHOWN]!r}, which is no ros2msg field"
                )
            if match is None or match["rest"].startswith(
                "="
            ):  # an empty line, a constant
                continue
            kind = self._kind(match["type"], name, users)
            length = (
                1
                if match["array"] is None
                else int(match["length"])
                if match["length"].isdigit()
                else None
            )
            if match["name"] in fields:
                raise LogError(
                    f"the definition of {name} has two fields called {match['name']}"
                )
            fields[match["name"]] = Field(
                match["name"], kind, length, is_array=match["array"] is not None
            )
        struct = self._done[name] = Struct(name, tuple(fields.values()))
        self._sizes[name] = sum(
            self._sizes[entry.kind.name] if isinstance(entry.kind, Struct) else 1
            for entry in struct.fields
        )
        # nested definitions grow exponentially
        if self._sizes[name] > _MOST_FIELDS:
            raise LogError(
                f"the definition of {name} has more than {_MOST_FIELDS} fields; no real one has"
            )
        return struct

    def _kind(self, type_name: str, owner: str, users: tuple[str, ...]) -> str | Struct:
        """Primitive, string or nested type of a field of ``owner``."""
        if type_name in PRIMITIVES or type_name == STRING:
            return type_name
        package = owner.split("/", 1)[0]
        wanted = short_name(type_name)
        # old definitions write Header without its package
        wanted = {"Header": "std_msgs/Header"}.get(
            wanted, wanted if "/" in wanted else f"{package}/{wanted}"
        )
        if (
            wanted not in self._texts
            and wanted.startswith("builtin_interfaces/")
            and wanted in DEFINITIONS
        ):
            # some recorders leave these two out
            self._texts[wanted] = DEFINITIONS[wanted]
        if wanted not in self._texts:
            raise LogError(
                f"the definition of {owner} uses {type_name}, whose own definition is not in the log"
            )
        return self.struct(wanted, (*users, owner))
