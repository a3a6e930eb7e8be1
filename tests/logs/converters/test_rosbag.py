import bz2
import os
import sqlite3
import sys
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, StoragePlugin
from rosbags.rosbag2 import CompressionMode as Compression
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sonar_graph.errors import LogError
from sonar_graph.logs import inspect_log, read_log, write_log
from sonar_graph.logs.convert import convert_rosbag, rosbag
from sonar_graph.logs.convert.rosbag import limited_bz2, limited_lz4, limited_zstd
from sonar_graph.testing import small_world
from tests.logs.conftest import decode, recorded, writing

from .copies import bare

T0_NS = 1_447_550_804_242_631_687
STEP_NS = 20_000_001


def messages(store: Any, *, ros1: bool) -> list[tuple[str, str, Any]]:
    """Topic, type and message: IMU, a camera whose fields have other names in ROS 2, and a latched transform."""
    types = store.types
    vector = types["geometry_msgs/msg/Vector3"]
    quaternion = types["geometry_msgs/msg/Quaternion"]
    time = types["builtin_interfaces/msg/Time"]
    header = types["std_msgs/msg/Header"]

    def head(row: int) -> Any:
        stamp = time(*divmod(T0_NS + row * STEP_NS, 10**9))
        return (
            header(seq=row, stamp=stamp, frame_id="imu")
            if ros1
            else header(stamp=stamp, frame_id="imu")
        )

    nine = np.arange(9.0)
    imu = "sensor_msgs/msg/Imu"
    fixed = (nine, vector(0, 0, 9.8), nine)
    rows = [
        types[imu](head(row), quaternion(0, 0, 0, 1), nine, vector(row, 2, 3), *fixed)
        for row in range(5)
    ]
    found = [("/imu", imu, row) for row in rows]
    move = types["geometry_msgs/msg/Transform"](vector(1, 2, 3), quaternion(0, 0, 0, 1))
    link = types["geometry_msgs/msg/TransformStamped"](head(0), "imu", move)
    found.append(
        (
            "/tf_static",
            "tf2_msgs/msg/TFMessage",
            types["tf2_msgs/msg/TFMessage"]([link]),
        )
    )
    if ros1:
        roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        matrices = np.array([0.5]), np.arange(9.0), np.arange(9.0), np.arange(12.0)
        camera = types["sensor_msgs/msg/CameraInfo"](
            head(0), 480, 640, "plumb_bob", *matrices, 1, 1, roi
        )
        found.append(("/camera", "sensor_msgs/msg/CameraInfo", camera))
    return found


def write_bag(writer: Any, store: Any, entries: list[tuple[str, str, Any]]) -> None:
    """Write messages one after another; the transform is latched in ROS 1."""
    ros1 = isinstance(writer, Ros1Writer)
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    connections: dict[str, Any] = {}
    with writer:
        for row, (topic, kind, message) in enumerate(entries):
            if topic not in connections:
                latched = {"latching": 1} if ros1 and topic == "/tf_static" else {}
                connections[topic] = writer.add_connection(
                    topic, kind, typestore=store, **latched
                )
            raw = message if isinstance(message, bytes) else serialize(message, kind)
            writer.write(connections[topic], T0_NS + row * STEP_NS, raw)


def ros1_store() -> Any:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(
        get_types_from_msg(
            "geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"
        )
    )
    return store


@pytest.fixture
def ros1_bag(tmp_path: Path) -> Path:
    store = ros1_store()
    write_bag(Ros1Writer(tmp_path / "old.bag"), store, messages(store, ros1=True))
    return tmp_path / "old.bag"


def test_a_ros_1_bag_becomes_a_ros_2_log(ros1_bag, tmp_path):
    told = []
    new = tmp_path / "new.mcap"
    done = convert_rosbag(ros1_bag, new, lambda *given: told.append(given))
    assert (done.topics, done.messages, done.left_out) == (3, 7, {})
    assert told
    assert all(total == 7 and at <= total for at, total in told)
    found = decode(new)
    stamps = [head_ns(message) for message in found["/imu"]]
    assert stamps == [T0_NS + row * STEP_NS for row in range(5)]
    assert [m.angular_velocity.x for m in found["/imu"]] == [0, 1, 2, 3, 4]
    assert found["/camera"][0].k == list(range(9))
    entries: dict[str, list[Any]] = {}
    for schema, channel, message in recorded(new):
        entry = schema.data.decode(), channel.metadata, message.log_time
        entries.setdefault(channel.topic, []).append(entry)
    texts, offers, times_ns = zip(*entries["/imu"], strict=True)
    assert "seq" not in texts[0]
    assert offers[0] == {}
    assert list(times_ns) == stamps
    assert "float64[] d\n" in entries["/camera"][0][0]
    assert "durability: 1" in entries["/tf_static"][0][1]["offered_qos_profiles"]


def head_ns(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


PACKED = [
    *((Compression.FILE, plugin) for plugin in StoragePlugin),
    *((Compression.MESSAGE, plugin) for plugin in StoragePlugin),
    (Compression.STORAGE, StoragePlugin.MCAP),
]


@pytest.mark.parametrize(("mode", "plugin"), PACKED, ids=str)
@pytest.mark.parametrize(("size", "is_read"), [(1000, True), (1 << 20, False)])
def test_input_beyond_the_limit_of_unpacking_is_refused(
    tmp_path, monkeypatch, mode, plugin, size, is_read
):
    monkeypatch.setattr(rosbag, "LARGEST_BYTES", 1 << 18)
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = tmp_path / "bag"
    writer = Ros2Writer(folder, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    kind = "std_msgs/msg/String"
    write_bag(writer, store, [("/a", kind, store.types[kind]("a" * size))])
    if is_read:
        assert convert_rosbag(folder, tmp_path / "new.mcap").messages == 1
        return
    is_file = mode == Compression.FILE
    remedy = "unpack it with `zstd -d`" if is_file else "`ros2 bag convert`"
    with pytest.raises(LogError, match=rf"{1 << 18}.*{remedy}"):
        convert_rosbag(folder, tmp_path / "new.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]


@pytest.mark.parametrize(
    ("pack", "unpack"),
    [
        (bz2.compress, limited_bz2),
        (lz4.frame.compress, limited_lz4),
        (zstandard.compress, limited_zstd),
    ],
)  # fmt: skip
def test_a_chunk_that_is_cut_off_is_no_chunk(pack, unpack):
    content = np.random.default_rng(0).bytes(300_000)
    packed = pack(content)
    assert unpack(packed) == content
    with pytest.raises(LogError, match="a chunk is cut off"):
        unpack(packed[:-200])


@pytest.mark.parametrize("name", ["bag.bag", "bag/metadata.yaml"])
def test_a_pipe_in_the_place_of_a_bag_or_in_it_is_refused(tmp_path, name):
    (tmp_path / "bag").mkdir()
    os.mkfifo(tmp_path / name)
    source = tmp_path / name.split("/")[0]
    with pytest.raises(LogError, match=f"{name} cannot be read: it is a pipe"):
        convert_rosbag(source, tmp_path / "new.mcap")


def test_a_custom_type_keeps_its_definition(tmp_path):
    store = ros1_store()
    kind = "provider_dvl/msg/Packet"
    text = "Header header\nfloat64[4] velocity\n"
    store.register(get_types_from_msg(text, kind))
    header = messages(store, ros1=True)[3][2].header
    whole = store.types[kind](header, np.arange(4.0))
    entries = [("/dvl", kind, content) for content in (whole, b"cut")]
    write_bag(Ros1Writer(tmp_path / "own.bag"), store, entries)
    done = convert_rosbag(tmp_path / "own.bag", tmp_path / "own.mcap")
    assert done.shortcomings() == ["left out: /dvl: 1 messages are not of their type"]
    (found,) = decode(tmp_path / "own.mcap")["/dvl"]
    assert found.velocity == [0, 1, 2, 3]
    assert head_ns(found) == T0_NS + 3 * STEP_NS


def test_without_the_library_the_command_that_installs_it_is_named(
    ros1_bag, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(
        LogError, match=r"not installed: pip install 'sonar-graph\[rosbag\]'"
    ):
        convert_rosbag(ros1_bag, tmp_path / "new.mcap")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("broken.bag", b"#ROSBAG V2.0\nnonsense", r"broken\.bag cannot be read as a bag.*rosbag reindex"),
        ("text.txt", b"hello", r"text\.txt is no bag but a text that begins with 'hello'; give a ROS 1 \.bag"),
        ("a.mcap", b"\x89MCAP0\r\n", r"a\.mcap is already an MCAP file: .* `sonar-graph inspect .*a\.mcap`"),
        ("a.bag", b"\x89MCAP0\r\n", r"a\.bag is already an MCAP file: read it directly"),
    ],
)  # fmt: skip
def test_what_is_no_bag_is_refused_and_leaves_nothing(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(LogError, match=message):
        convert_rosbag(tmp_path / name, tmp_path / "new.mcap")
    assert [p.name for p in tmp_path.iterdir()] == [name]


# --- bags without definitions, ROS 1 in MCAP, messages that are compressed by themselves ------------------------------

A50 = {
    "": "",
    "with a matrix": "float64[9] covariance\n",
    "with a list": "float64[] covariance\n",
    "with rows": "geometry_msgs/Vector3[] cov\n",
}
"""Lines after the figure of merit in the versions of dvl_msgs/DVL."""


def a50_store(extra: str) -> Any:
    store = get_typestore(Stores.ROS2_HUMBLE)
    beam = "int64 id\nfloat64 velocity\nfloat64 distance\nfloat64 rssi\nfloat64 nsd\nbool valid\n"
    text = (
        f"std_msgs/Header header\nfloat64 time\ngeometry_msgs/Vector3 velocity\nfloat64 fom\n{extra}float64 altitude\n"
        "dvl_msgs/DVLBeam[] beams\nbool velocity_valid\nint64 status\nstring form\n"
    )
    store.register(
        get_types_from_msg(beam, "dvl_msgs/msg/DVLBeam")
        | get_types_from_msg(text, "dvl_msgs/msg/DVL")
    )
    return store


def a50_messages(store: Any, extra: str) -> list[tuple[str, str, Any]]:
    types = store.types
    vector = types["geometry_msgs/msg/Vector3"]
    covariance = {"": [], A50["with rows"]: [[vector(1e-4, 0, 0)] * 3]}
    more = covariance.get(extra, [np.full(9, 1e-4)])
    beam = types["dvl_msgs/msg/DVLBeam"](1, 0.1, 2.0, -50.0, -90.0, True)
    kind = "dvl_msgs/msg/DVL"
    # the header of an IMU message
    heads = [message.header for _, _, message in messages(store, ros1=False)[:5]]
    rows = [
        types[kind](
            head, 0.0, vector(row, 0.1, 0), 0.01, *more, 2.0, [beam] * row, True, 0, "v"
        )
        for row, head in enumerate(heads)
    ]
    return [("/dvl/data", kind, row) for row in rows]


def write_undefined(
    folder: Path, store: Any, entries: list[tuple[str, str, Any]]
) -> Path:
    """A sqlite3 bag as Humble writes it: without definitions."""
    writer = Ros2Writer(folder, version=8, storage_plugin=StoragePlugin.SQLITE3)
    write_bag(writer, store, entries)
    (database,) = folder.glob("*.db3")
    with sqlite3.connect(database) as connection:
        connection.execute("drop table message_definitions")
        connection.execute("update schema set schema_version = 3")
    return folder


@pytest.mark.parametrize("version", A50)
def test_messages_of_known_drivers_are_defined_where_a_bag_does_not(tmp_path, version):
    store = a50_store(A50[version])
    entries = messages(store, ros1=False) + a50_messages(store, A50[version])
    bag = write_undefined(tmp_path / "bag", store, entries)
    (database,) = bag.glob("*.db3")
    done = convert_rosbag(database if version else bag, tmp_path / "new.mcap")
    assert (done.topics, done.messages, done.left_out) == (3, 11, {})
    sequence = read_log(tmp_path / "new.mcap")
    assert sequence.imu.angular_velocity[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert sequence.dvl.velocity[:, 0].tolist() == [0, 1, 2, 3, 4]


def test_unknown_types_are_defined_by_files_of_their_package(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    text = "std_msgs/Header header\nfloat64 depth\n"
    kind = "own_msgs/msg/Depth"
    store.register(get_types_from_msg(text, kind))
    imu = messages(store, ros1=False)
    depth = store.types[kind](imu[0][2].header, 3.5)
    bag = write_undefined(tmp_path / "bag", store, [*imu, ("/depth", kind, depth)])
    new = tmp_path / "new.mcap"
    told = "add --definitions FOLDER, which holds own_msgs/msg/Depth.msg"
    assert told in convert_rosbag(bag, new).left_out["/depth"]
    package = tmp_path / "ws" / "src" / "own_msgs" / "msg"
    package.mkdir(parents=True)
    with pytest.raises(LogError, match=r"holds no \.msg files"):
        convert_rosbag(bag, new, definitions=tmp_path / "ws")
    (package / "Depth.msg").write_text(text)
    assert convert_rosbag(bag, new, definitions=tmp_path / "ws").left_out == {}
    assert decode(new)["/depth"][0].depth == 3.5


def test_ros_1_messages_in_mcap_become_those_of_ros_2(tmp_path):
    store = ros1_store()
    path = tmp_path / "old.mcap"
    channels: dict[str, int] = {}
    with writing(path, "ros1") as writer:
        for row, (topic, kind, message) in enumerate(messages(store, ros1=True)):
            if topic not in channels:
                text = store.generate_msgdef(kind)[0].encode()
                name = kind.replace("/msg/", "/")
                schema = writer.register_schema(name, "ros1msg", text)
                channels[topic] = writer.register_channel(topic, "ros1", schema)
            at_ns = T0_NS + row * STEP_NS
            payload = bytes(store.serialize_ros1(message, kind))
            writer.add_message(channels[topic], at_ns, payload, at_ns)
    refusals = {topic.name: topic.refusal for topic in inspect_log(path).topics}
    assert f"`sonar-graph convert rosbag {path} -o OUT.mcap`" in refusals["/imu"]
    done = convert_rosbag(path, tmp_path / "new.mcap")
    assert (done.topics, done.messages, done.left_out) == (3, 7, {})
    found = decode(tmp_path / "new.mcap")
    assert [m.angular_velocity.x for m in found["/imu"]] == [0, 1, 2, 3, 4]
    assert found["/tf_static"][0].transforms[0].transform.translation.y == 2
    with pytest.raises(LogError, match="already an MCAP file: read it directly"):
        convert_rosbag(tmp_path / "new.mcap", tmp_path / "again.mcap")


def test_messages_that_are_compressed_one_by_one_are_read_as_they_are(tmp_path):
    """`ros2 bag record --compression-mode message --compression-format zstd`, storage MCAP."""
    write_log(tmp_path / "dive.mcap", small_world())
    packers = [zstandard.ZstdCompressor(write_content_size=n != 3) for n in range(7)]

    def packed_payload(row: int, payload: bytes) -> bytes:
        return packers[row % 7].compress(payload)

    bare(tmp_path / "dive.mcap", tmp_path / "packed.mcap", packed_payload)
    packed = read_log(tmp_path / "packed.mcap")
    for role, block in read_log(tmp_path / "dive.mcap").blocks().items():
        for name, column in vars(block).items():
            np.testing.assert_array_equal(getattr(getattr(packed, role), name), column)
