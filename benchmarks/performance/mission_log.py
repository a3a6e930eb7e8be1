"""A long log as a vehicle would record it: four sensors and an imaging sonar, written with mcap's own writer."""

from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from sonar_graph.logs.cdr import Bytes, definition, encode, parse_definition
from sonar_graph.measurements import Floats, Ints

CHUNK_BYTES = 1 << 20
START_NS = 1_700_000_000_000_000_000
IMU, DVL, DEPTH, ODOMETRY, SONAR = (
    "/imu/data",
    "/dvl/data",
    "/depth/pressure",
    "/ground_truth/odometry",
    "/sonar/image",
)
TYPES = {
    IMU: "sensor_msgs/msg/Imu",
    DVL: "marine_acoustic_msgs/msg/Dvl",
    DEPTH: "sensor_msgs/msg/FluidPressure",
    ODOMETRY: "nav_msgs/msg/Odometry",
    SONAR: "marine_acoustic_msgs/msg/ProjectedSonarImage",
}
RATES_HZ = {IMU: 100.0, DVL: 8.0, DEPTH: 10.0, ODOMETRY: 50.0}
BINS, BEAMS = 512, 96
_RULE = "=" * 80
SONAR_DEFINITION = f"""\
std_msgs/Header header
marine_acoustic_msgs/PingInfo ping_info
geometry_msgs/Vector3[] beam_directions
float32[] ranges
marine_acoustic_msgs/SonarImageData image
{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
{_RULE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
{_RULE}
MSG: marine_acoustic_msgs/PingInfo
float32 frequency
float32 sound_speed
float32[] tx_beamwidths
float32[] rx_beamwidths
{_RULE}
MSG: marine_acoustic_msgs/SonarImageData
uint32 DTYPE_UINT8=0
bool is_bigendian
uint32 dtype
uint32 beam_count
uint8[] data
"""


def definition_of(topic: str) -> str:
    """The interface text that travels with a topic."""
    return SONAR_DEFINITION if topic == SONAR else definition(TYPES[topic])


def write_mission(
    path: Path,
    duration_s: float,
    frames: int,
    *,
    frame_repeats: int = 1,
    chunk_bytes: int = CHUNK_BYTES,
    **settings: Any,
) -> int:
    """Write the log; its payload in bytes.

    Parameters
    ----------
    path
        Of the MCAP file.
    duration_s
        Of the mission.
    frames
        Sonar images, equally spaced.
    frame_repeats
        How many times each image is stored, a nanosecond apart: a quick way to a large file.
    chunk_bytes, settings
        Of mcap's writer.
    """
    rng = np.random.default_rng(0)
    sensors = {topic: _sensor(topic, duration_s, rng) for topic in RATES_HZ}
    streams = [_messages(topic, *columns) for topic, columns in sensors.items()]
    streams.append(_sonar(duration_s, frames, frame_repeats, rng))
    size = 0
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk_bytes, **settings)
        writer.start("ros2", "benchmark")
        writer.add_metadata("mission", {"site": "basin", "depth_m": "12.5"})
        channels = {}
        for topic, kind in TYPES.items():
            schema = writer.register_schema(
                kind, "ros2msg", definition_of(topic).encode()
            )
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for time_ns, topic, payload in merge(*streams, key=lambda entry: entry[0]):
            writer.add_message(channels[topic], time_ns, payload, time_ns)
            size += len(payload)
        writer.finish()  # type: ignore[no-untyped-call]
    return size


Entry = tuple[int, str, bytes]


def _messages(topic: str, stamps_ns: Ints, payloads: Bytes) -> Iterator[Entry]:
    for time_ns, payload in zip(stamps_ns.tolist(), payloads, strict=True):
        yield time_ns, topic, payload.tobytes()


def _sensor(
    topic: str, duration_s: float, rng: np.random.Generator
) -> tuple[Ints, Bytes]:
    count = round(duration_s * RATES_HZ[topic])
    stamps_ns = START_NS + np.arange(count, dtype=np.int64) * round(
        1e9 / RATES_HZ[topic]
    )
    fields = {IMU: _imu, DVL: _dvl, DEPTH: _depth, ODOMETRY: _odometry}[topic](
        count, rng
    )
    values = {**_header(stamps_ns, topic), **fields}
    return stamps_ns, encode(
        parse_definition(TYPES[topic], definition_of(topic)), count, values
    )


def _header(stamps_ns: Ints, topic: str) -> dict[str, object]:
    frame = topic.split("/")[1] + "_link"
    return {
        "header.stamp.sec": stamps_ns // 10**9,
        "header.stamp.nanosec": stamps_ns % 10**9,
        "header.frame_id": frame,
    }


def _vector(prefix: str, values: Floats, axes: str = "xyz") -> dict[str, Floats]:
    return {f"{prefix}.{axis}": values[:, i] for i, axis in enumerate(axes)}


def _imu(count: int, rng: np.random.Generator) -> dict[str, object]:
    return {
        **_vector("angular_velocity", rng.normal(0, 0.01, (count, 3))),
        **_vector("linear_acceleration", rng.normal([0, 0, 9.81], 0.02, (count, 3))),
        "orientation_covariance": np.array([-1.0, *[0.0] * 8]),
    }


def _dvl(count: int, rng: np.random.Generator) -> dict[str, object]:
    return {
        **_vector("velocity", rng.normal([0.5, 0, 0], 0.01, (count, 3))),
        "velocity_covar": np.diag([1e-4] * 3).ravel(),
        "velocity_mode": 1,
        "num_good_beams": 4,
        "range": rng.uniform(5, 6, (count, 4)),
    }


def _depth(count: int, rng: np.random.Generator) -> dict[str, object]:
    return {"fluid_pressure": 2e5 + rng.normal(0, 100, count), "variance": 1e4}


def _odometry(count: int, rng: np.random.Generator) -> dict[str, object]:
    yaw_rad = np.cumsum(rng.normal(0, 1e-3, count))
    quaternions = np.column_stack(
        [np.zeros((count, 2)), np.sin(yaw_rad / 2), np.cos(yaw_rad / 2)]
    )
    return {
        **_vector(
            "pose.pose.position", np.cumsum(rng.normal(0, 0.01, (count, 3)), axis=0)
        ),
        **_vector("pose.pose.orientation", quaternions, "xyzw"),
        "pose.covariance": np.diag(np.full(6, 0.01)).ravel(),
        **_vector("twist.twist.linear", rng.normal(0, 0.3, (count, 3))),
    }


def _sonar(
    duration_s: float, frames: int, repeats: int, rng: np.random.Generator
) -> Iterator[Entry]:
    """Speckle with echoes that move through the fan."""
    kind = parse_definition(TYPES[SONAR], SONAR_DEFINITION)
    stamps_ns = START_NS + (
        np.arange(frames) * duration_s * 1e9 / max(frames, 1)
    ).astype(np.int64)
    directions = np.linspace(-0.5, 0.5, BEAMS)
    speckle = (
        (20 * rng.gamma(2.0, 1.0, (64 * BINS, BEAMS))).clip(0, 255).astype(np.uint8)
    )
    for i, stamp_ns in enumerate(stamps_ns.tolist()):
        start = int(rng.integers(0, 63 * BINS))
        image = speckle[start : start + BINS].copy()
        image[i % BINS, i % BEAMS] = 255
        values = {
            **_header(np.array([stamp_ns]), SONAR),
            "ping_info.frequency": 750e3,
            "beam_directions.x": np.zeros((1, BEAMS)),
            "beam_directions.y": np.sin(directions)[None],
            "beam_directions.z": np.cos(directions)[None],
            "ranges": np.linspace(0.1, 20, BINS)[None],
            "image.beam_count": BEAMS,
            "image.data": image.reshape(1, -1),
        }
        payload = encode(kind, 1, values, {"beam_directions": BEAMS})[0].tobytes()
        for repeat in range(repeats):
            yield stamp_ns + repeat, SONAR, payload
