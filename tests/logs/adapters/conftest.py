"""Logs as third-party drivers write them: their own message definitions, encoded by another library than ours."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sonar_graph.logs.cdr.definitions import definition
from tests.logs.conftest import header, vector, write_messages

T0_NS = 1_700_000_000_000_000_000
STEP_NS = 10**8

_RULE = "=" * 80
_HEADER = f"""{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_XYZ = "float64 x\nfloat64 y\nfloat64 z\n"
_VECTOR = f"{_RULE}\nMSG: geometry_msgs/Vector3\n{_XYZ}"
_WATER_LINKED_BEAM = f"""{_RULE}
MSG: dvl_msgs/DVLBeam
int64 id
float64 velocity
float64 distance
float64 rssi
float64 nsd
bool valid
"""


def water_linked(covariance: str = "") -> str:
    """dvl_msgs/DVL; the forks add a covariance after the figure of merit."""
    return f"""std_msgs/Header header
float64 time
geometry_msgs/Vector3 velocity
float64 fom
{covariance}
float64 altitude
DVLBeam[] beams
bool velocity_valid
int64 status
string form
{_HEADER}{_VECTOR}{_WATER_LINKED_BEAM}"""


UUV_DVL = f"""std_msgs/Header header
geometry_msgs/Vector3 velocity
float64[9] velocity_covariance
float64 altitude
DVLBeam[] beams
{_HEADER}{_VECTOR}{_RULE}
MSG: stonefish_ros2/DVLBeam
float64 range
float64 range_covariance
float64 velocity
float64 velocity_covariance
"""
TWIST = f"""std_msgs/Header header
geometry_msgs/TwistWithCovariance twist
{_HEADER}{_VECTOR}{_RULE}
MSG: geometry_msgs/TwistWithCovariance
geometry_msgs/Twist twist
float64[36] covariance
{_RULE}
MSG: geometry_msgs/Twist
geometry_msgs/Vector3 linear
geometry_msgs/Vector3 angular
"""
DETECTIONS = f"""std_msgs/Header header
vision_msgs/Detection3D[] detections
{_HEADER}{_RULE}
MSG: vision_msgs/Detection3D
std_msgs/Header header
vision_msgs/ObjectHypothesisWithPose[] results
vision_msgs/BoundingBox3D bbox
string id
{_RULE}
MSG: vision_msgs/ObjectHypothesisWithPose
vision_msgs/ObjectHypothesis hypothesis
geometry_msgs/PoseWithCovariance pose
{_RULE}
MSG: vision_msgs/ObjectHypothesis
string class_id
float64 score
{_RULE}
MSG: vision_msgs/BoundingBox3D
geometry_msgs/Pose center
geometry_msgs/Vector3 size
{_RULE}
MSG: geometry_msgs/PoseWithCovariance
geometry_msgs/Pose pose
float64[36] covariance
{_RULE}
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
{_RULE}
MSG: geometry_msgs/Point
{_XYZ}{_RULE}
MSG: geometry_msgs/Quaternion
{_XYZ}float64 w
{_VECTOR}"""
OCULUS_PING = f"""std_msgs/Header header
uint32 ping_id
uint32 ping_firing_date
float64 range
float64 gain_percent
float64 frequency
float64 speed_of_sound_used
float64 range_resolution
float64 temperature
float64 pressure
uint8 master_mode
bool has_gains
uint16 n_ranges
uint16 n_beams
uint32 step
uint8 sample_size
int16[] bearings
uint8[] ping_data
{_HEADER}"""
BARE_PD0 = "float64 timestamp\nfloat64[4] range\nfloat64[4] velocity\n"
FLOAT = "float64 data\n"
DEFINITIONS = {
    "dvl_msgs/msg/DVL": water_linked(),
    "stonefish_ros2/msg/DVL": UUV_DVL,
    "geometry_msgs/msg/TwistWithCovarianceStamped": TWIST,
    "vision_msgs/msg/Detection3DArray": DETECTIONS,
    "oculus_interfaces/msg/Ping": OCULUS_PING,
    "provider_dvl/msg/PD0Packet": BARE_PD0,
    "std_msgs/msg/Float64": FLOAT,
}
Entry = tuple[Any, ...]


class Foreign:
    """Builds logs of other people's messages."""

    t0_ns, step_ns = T0_NS, STEP_NS
    water_linked, vector = staticmethod(water_linked), staticmethod(vector)

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def header(self, row: int, frame_id: str = "sensor") -> dict[str, Any]:
        return header(T0_NS + row * STEP_NS, frame_id)

    def imu(self, rows: int = 5, force: tuple[float, ...] = (0, 0, 9.8), rate: tuple[float, ...] = (0, 0, 0)) -> Entry:
        messages = [
            {
                "header": self.header(i, "imu_link"),
                "angular_velocity": self.vector(*rate),
                "linear_acceleration": self.vector(*force),
            }
            for i in range(rows)
        ]
        return "/imu", "sensor_msgs/msg/Imu", messages

    def dvl(self, rows: int = 5, **other: Any) -> Entry:
        message = {"velocity": self.vector(1, 2, 3), "velocity_mode": 1, "num_good_beams": 4, **other}
        return "/dvl", "marine_acoustic_msgs/msg/Dvl", [{"header": self.header(i), **message} for i in range(rows)]

    def write(self, *entries: Entry, name: str = "log.mcap") -> Path:
        """Entries are topic, type, messages, and the definition where it is not the usual one."""
        rows = [
            (topic, kind, messages, text[0] if text else DEFINITIONS.get(kind) or definition(kind))
            for topic, kind, messages, *text in entries
        ]
        return write_messages(self._folder / name, rows, T0_NS)

    def config(self, text: str, name: str = "log.toml") -> Path:
        path = self._folder / name
        path.write_text(text, encoding="utf-8")
        return path


@pytest.fixture
def foreign(tmp_path: Path) -> Foreign:
    return Foreign(tmp_path)


@pytest.fixture
def read(foreign: Foreign) -> Callable[..., Any]:
    """Reads a log of these entries, with a configuration as text, as a sequence."""
    from sonar_graph.logs.adapters.log_config import read_log_config
    from sonar_graph.logs.reading import read_log

    def read_these(*entries: Entry, toml: str = "", **settings: Any) -> Any:
        return read_log(foreign.write(*entries), config=read_log_config(foreign.config(toml)), **settings)

    return read_these
