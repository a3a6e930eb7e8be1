"""Definitions of messages of common drivers, for bags that have none.

The sqlite3 bags of ROS 2 Humble and before hold no definitions. A driver changed its messages over the years; the
definition counts with which the first messages have the right length.
"""

from sonar_graph.logs.cdr.definitions import DEFINITIONS, definition

_HEADER = "std_msgs/Header header"
_VELOCITY = "geometry_msgs/Vector3 velocity"
_SEPARATOR = f"\n{'=' * 80}\nMSG: "


def _with(fields: tuple[str, ...], **own: str) -> str:
    """Definition of a message, with that of the driver's own type (``package__Type``)."""
    used = (
        f"{_SEPARATOR}{name.replace('__', '/')}\n{text}" for name, text in own.items()
    )
    return "".join(["\n".join(fields), *used])


_A50_BEAM = "int64 id\nfloat64 velocity\nfloat64 distance\nfloat64 rssi\nfloat64 nsd\nbool valid"
_A50_END = (
    "float64 altitude",
    "dvl_msgs/DVLBeam[] beams",
    "bool velocity_valid",
    "int64 status",
    "string form",
)
_A50 = [
    _with(
        (_HEADER, "float64 time", _VELOCITY, "float64 fom", *covariance, *_A50_END),
        dvl_msgs__DVLBeam=_A50_BEAM,
    )
    for covariance in (
        (),
        ("float64[9] covariance",),
        ("float64[] covariance",),
        ("geometry_msgs/Vector3[] cov",),
    )
]
_A50_POSITION = _with(
    (_HEADER, "float64 time", "geometry_msgs/Point position", "float64 pos_std", "float64 roll", "float64 pitch",
     "float64 yaw", "string type", "int64 status", "string format")
)  # fmt: skip
_SIMULATOR_BEAM = "float64 range\nfloat64 range_covariance\nfloat64 velocity\nfloat64 velocity_covariance"
_SIMULATOR_PACKAGES = (
    "uuv_sensor_ros_plugins_msgs",
    "stonefish_ros2",
    "cola2_msgs",
    "smarc_msgs",
)


def _simulator(package: str) -> list[str]:
    """Message of the simulators that follow UUV Simulator; a beam has a pose in some."""
    fields = (
        _HEADER,
        _VELOCITY,
        "float64[9] velocity_covariance",
        "float64 altitude",
        f"{package}/DVLBeam[] beams",
    )
    beams = (_SIMULATOR_BEAM, f"{_SIMULATOR_BEAM}\ngeometry_msgs/PoseStamped pose")
    return [_with(fields, **{f"{package}__DVLBeam": beam}) for beam in beams]


DRIVER_DEFINITIONS: dict[str, list[str]] = {
    "dvl_msgs/msg/DVL": _A50,
    "dvl_msgs/msg/DVLDR": [_A50_POSITION],
    **{f"{package}/msg/DVL": _simulator(package) for package in _SIMULATOR_PACKAGES},
    **{
        name: [definition(name)]
        for name in (known.replace("/", "/msg/") for known in DEFINITIONS)
        if name.startswith(("marine_acoustic_msgs/", "sonar_graph_msgs/"))
    },
}
"""Definitions by type; of several the first fits that a message follows."""
