"""Logs and MCAP files written by other libraries than ours, to be read and damaged, and a small sequence."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Channel, ChunkIndex, Message, Schema
from mcap.writer import Writer as ContainerWriter
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, ImuCalibration, Mounting
from sonar_graph.logs.cdr import definition
from sonar_graph.logs.mcap import Keep, Recording, TimeWindow, Topic, scan
from sonar_graph.measurements import (
    Depth,
    Dvl,
    Heading,
    Imu,
    LandmarkDetections,
    PositionFixes,
)
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap, Trajectory

T0_NS = 1_700_000_000_123_456_789
TYPES = {
    "imu": "sensor_msgs/msg/Imu",
    "dvl": "marine_acoustic_msgs/msg/Dvl",
    "pressure": "sensor_msgs/msg/FluidPressure",
    "odometry": "nav_msgs/msg/Odometry",
    "detections": "sonar_graph_msgs/msg/LandmarkDetections",
}
Entry = tuple[Any, ...]
"""Topic, type or a word for it, messages, and the definition where it is not the usual one."""
Stored = tuple[int, bytes]
"""Log time and payload of a message."""


def header(ns: int, frame_id: str = "sensor") -> dict[str, Any]:
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": frame_id}


def vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def quaternion(rotation: Rotation) -> dict[str, float]:
    return dict(zip("xyzw", rotation.as_quat().tolist(), strict=True))


def tree(link: str, xyz: tuple[float, ...] = (0, 0, 0), **rotation: float) -> Entry:
    """One frame below the body; what is not given of its quaternion is zero."""
    turn = dict.fromkeys("xyzw", 0.0) | rotation
    transform = {
        "header": header(0, "base_link"),
        "child_frame_id": link,
        "transform": {"translation": vector(*xyz), "rotation": turn},
    }
    return "/tf_static", "tf2_msgs/msg/TFMessage", [{"transforms": [transform]}]


class Bench:
    """Builds logs message by message with mcap-ros2-support."""

    t0_ns = T0_NS
    definitions: ClassVar[dict[str, str]] = {}
    """Of types that ROS does not have."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def imu(self, ns: int, rate: tuple[float, ...] = (0, 0, 0.1)) -> dict[str, Any]:
        return {
            "header": header(ns, "imu_link"),
            "angular_velocity": vector(*rate),
            "linear_acceleration": vector(0.1, 0.2, 9.8),
        }

    def dvl(self, ns: int) -> dict[str, Any]:
        message = {"header": header(ns, "dvl_link"), "velocity": vector(0.5, 0, 0)}
        return message | {"velocity_mode": 1, "num_good_beams": 4}

    def pressure(self, ns: int) -> dict[str, Any]:
        return {"header": header(ns, "pressure_link"), "fluid_pressure": 2e5}

    def odometry(self, ns: int) -> dict[str, Any]:
        pose = {"orientation": quaternion(Rotation.identity())}
        return {"header": header(ns, "map"), "pose": {"pose": pose}}

    def detections(
        self, ns: int, ranges: list[float], ids: list[int], track: tuple[int, ...] = ()
    ) -> dict[str, Any]:
        count = len(ranges)
        share = min(0.5, count / max(len(ids), 1))
        return {
            "header": header(ns, "sonar_link"),
            "range_m": ranges,
            "azimuth_rad": [0.1] * count,
            "covariance": [0.01, 0, 0, 0.02] * count,
            "candidate_ids": ids,
            "id_probability": [share] * len(ids),
            "track": list(track),
        }

    def basics(self, samples: int = 5) -> list[Entry]:
        """The topics that every log needs."""
        stamps = [self.t0_ns + i * 10**8 for i in range(samples)]
        return [
            ("/imu", "imu", [self.imu(s) for s in stamps]),
            ("/dvl", "dvl", [self.dvl(s) for s in stamps]),
        ]

    def write(self, *entries: Entry, name: str = "log.mcap") -> Path:
        """A log of ten messages a second on each topic."""
        path = self._folder / name
        with path.open("wb") as stream:
            writer = Writer(stream)
            for topic, word, messages, *text in entries:
                kind = TYPES.get(word, word)
                text = text or [self.definitions.get(kind) or definition(kind)]
                schema = writer.register_msgdef(kind, *text)
                for i, message in enumerate(messages):
                    at_ns = self.t0_ns + i * 10**8
                    writer.write_message(topic, schema, message, at_ns, at_ns)
            writer.finish()
        return path


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def decode(path: Path, *topics: str) -> dict[str, list[Any]]:
    """Messages of a log, or of some topics, by topic, as mcap-ros2-support reads them."""
    found: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics or None):
            found.setdefault(channel.topic, []).append(message)
    return found


@pytest.fixture(scope="session")
def make_sequence() -> Callable[..., Sequence]:
    return sequence_with


def sequence_with(seed: int = 0, samples: int = 20, candidates: int = 2) -> Sequence:
    """Every field filled with different numbers; some covariances known, some not."""
    rng = np.random.default_rng(seed)
    row = np.arange(samples)
    stamps = T0_NS + np.sort(rng.choice(10**10, samples, replace=False))

    def normal(*shape: int) -> Any:
        return rng.normal(size=(samples, *shape))

    covs = normal(3, 3)
    covs = covs @ covs.transpose(0, 2, 1)
    covs[::3] = np.nan
    force = normal(3)
    force[::4] = np.nan
    quaternions = normal(4)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    mounting = Mounting(translation_m=(0.1, 0.2, 0.3), rpy_rad=(0.1, 0, 1))
    return Sequence(
        name="a name with spaces and ψ",
        calibration=Calibration(imu=ImuCalibration(mounting=mounting)),
        imu=Imu(stamps, normal(3), force),
        dvl=Dvl(stamps, normal(3), covs),
        depth=Depth(stamps, normal(), np.where(row % 2, np.nan, 0.01)),
        heading=Heading(stamps, 10 * normal(), np.where(row % 3, 0.1, np.nan)),
        positions=PositionFixes(stamps, normal(3), covs),
        detections=LandmarkDetections(
            np.sort(rng.choice(stamps, samples)),
            rng.uniform(1, 5, samples),
            normal(),
            normal(2, 2),
            rng.integers(-1, 9, (samples, candidates)),
            rng.uniform(0, 1 / candidates, (samples, candidates)),
            row % 4 - 1 + 10**12 * (row % 2),
        ),
        truth=Trajectory.without_covariances(stamps, normal(3), quaternions),
        true_landmarks=LandmarkMap(
            np.array([3, 7]), rng.normal(size=(2, 3)), np.full((2, 3, 3), np.nan)
        ),
        notes={"source": "made up", "seed": str(seed)},
    )


# --- MCAP files -------------------------------------------------------------------------------------------------------

BYTES_TEXT = b"uint8[] data\n"


@contextmanager
def writing(
    path: Path, profile: str = "ros2", **settings: Any
) -> Iterator[ContainerWriter]:
    """A started file of mcap's own writer, finished at the end."""
    with path.open("wb") as stream:
        writer = ContainerWriter(stream, **settings)
        writer.start(profile, "test")
        yield writer
        writer.finish()


def write(
    path: Path, count: int = 400, *, chunk_size: int = 4096, **settings: Any
) -> list[Stored]:
    """Messages of three lengths on /bytes, 1 ns apart, between others in JSON; what was written on /bytes."""
    rng = np.random.default_rng(0)
    written = [(1000 + i, rng.bytes([20, 50, 80][i % 3])) for i in range(count)]
    with writing(path, chunk_size=chunk_size, **settings) as writer:
        schema = writer.register_schema("test_msgs/msg/Bytes", "ros2msg", BYTES_TEXT)
        other = writer.register_schema("Some", "jsonschema", b"{}")
        channel = writer.register_channel("/bytes", "cdr", schema)
        silent = writer.register_channel("/json", "json", other)
        writer.register_channel("/never", "cdr", schema)
        writer.add_metadata("sonar_graph", {"name": "x"})
        for time_ns, payload in written:
            writer.add_message(channel, time_ns, payload, time_ns)
            writer.add_message(silent, time_ns, b'{"a": 1}', time_ns)
    return written


Change = Callable[[str, int, bytes], bytes | None]
"""Payload in a copy, of a message by topic, number and payload; None: it is left out."""


def recorded(path: Path) -> list[tuple[Schema | None, Channel, Message]]:
    with path.open("rb") as stream:
        return list(make_reader(stream).iter_messages())


def copy(
    messages: Iterable[tuple[Schema | None, Channel, Message]],
    writer: ContainerWriter,
    change: Change = lambda *message: message[-1],
) -> None:
    """Write messages of a log into another file, without its metadata."""
    seen = Counter[str]()
    channels: dict[str, int] = {}
    for schema, channel, message in messages:
        topic = channel.topic
        data = change(topic, seen[topic], message.data)
        seen[topic] += 1
        if topic not in channels and schema is not None:
            kind = writer.register_schema(schema.name, schema.encoding, schema.data)
            about = channel.message_encoding, kind, channel.metadata
            channels[topic] = writer.register_channel(topic, *about)
        if data is not None:
            times = message.publish_time, message.sequence
            writer.add_message(channels[topic], message.log_time, data, *times)


def write_apart(path: Path, count: int = 100) -> None:
    """/a and /b in chunks of their own, by turns, a second apart from second 1 on; /tf_static is in the first chunk."""
    with writing(path) as writer:
        channels = []
        for topic in ("/a", "/b", "/tf_static"):
            kind = writer.register_schema(
                f"test_msgs/msg/{topic[1:]}", "ros2msg", BYTES_TEXT
            )
            channels.append(writer.register_channel(topic, "cdr", kind))
        writer.add_message(channels[2], 10**9, b"static", 10**9)
        for i in range(count):
            writer.add_message(channels[i % 2], (1 + i) * 10**9, bytes([i]), 10**9)
            writer.flush()


def entries(topic: Topic) -> list[Stored]:
    """Log times and payloads, in order."""
    payloads = {
        row: payload.tobytes()
        for stacks in topic.stacks.values()
        for stack in stacks
        for row, payload in zip(*stack, strict=True)
    }
    times_ns = topic.log_times_ns.tolist()
    return [(time_ns, payloads[row]) for row, time_ns in enumerate(times_ns)]


def scan_all(path: Path, window: TimeWindow | None = None) -> Recording:
    return scan(path, lambda _: Keep.ALL, window)


def read(path: Path) -> list[Stored]:
    """Messages on /bytes."""
    topics = scan_all(path).topics
    return entries(topics["/bytes"]) if "/bytes" in topics else []


def chunk_indexes(path: Path) -> list[ChunkIndex]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def flip(path: Path, at: int, bit: int = 4) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= bit
    path.write_bytes(content)


def cut(path: Path, at: int) -> None:
    path.write_bytes(path.read_bytes()[:at])
