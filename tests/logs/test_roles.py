from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from sonar_graph.errors import LogError, MissingTopicError
from sonar_graph.logs.inspection import inspect_log
from sonar_graph.logs.mcap.reader import scan
from sonar_graph.logs.mcap.topic import Keep
from sonar_graph.logs.reading import read_log
from sonar_graph.logs.roles import refusal

from .conftest import Bench

IMU = "sensor_msgs/msg/Imu"
IDL = "module sensor_msgs { module msg { struct Imu { double x; }; }; };"
FOREIGN = {
    "/json": ("Some", "jsonschema", b"{}", "json", "has messages in json; only ROS 2 CDR is read"),
    "/protobuf": ("pkg.Some", "protobuf", b"\x0a\xff", "protobuf", "has messages in protobuf; only ROS 2 CDR is read"),
    "/idl": (IMU, "ros2idl", IDL.encode(), "cdr", "has a definition in ros2idl; only ros2msg is read: record it again"),
    "/flat": (IMU, "flatbuffer", b"\0", "cdr", "has a definition in flatbuffer; only ros2msg is read"),
    "/wide": ("a/msg/B", "ros2msg", b"wstring s\n", "cdr", "cannot be read: the definition of a/B uses wstring"),
    "/loop": ("a/msg/B", "ros2msg", b"B[] b\n", "cdr", "cannot be read: the definition of a/B uses a/B within itself"),
    "/noise": (IMU, "ros2msg", b"\xff\xfe{", "cdr", "has a definition that cannot be read: the definition of"),
    "/bare": ("", "", b"", "cdr", "has no definition of its messages"),
    "/nothing": ("", "", b"", "", "has messages in no named encoding"),
}


def copy_with_foreign(source: Path, target: Path, *, without: tuple[str, ...] = ()) -> Path:
    """The log with channels of other kinds beside and between ours, two messages each."""
    with source.open("rb") as original, target.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        channels = {}
        for topic, (name, kind, text, encoding, _) in FOREIGN.items():
            schema = writer.register_schema(name, kind, text) if kind else 0
            channels[topic] = writer.register_channel(topic, encoding, schema)
        for at, (schema, channel, message) in enumerate(make_reader(original).iter_messages()):
            if channel.topic in without:
                continue
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
            if at < 2:
                for topic in FOREIGN:
                    writer.add_message(channels[topic], message.log_time, b"{}", message.publish_time)
        writer.finish()
    return target


@pytest.fixture
def mixed(bench: Bench, tmp_path: Path) -> Path:
    return copy_with_foreign(bench.write(*bench.basics()), tmp_path / "mixed.mcap")


def test_topics_that_cannot_be_decoded_are_counted_and_listed_with_the_reason(mixed: Path) -> None:
    topics = {topic.name: topic for topic in inspect_log(mixed).topics}
    assert {name for name, topic in topics.items() if topic.refusal} == set(FOREIGN)
    scanned = scan(mixed, lambda _: Keep.STAMP).topics
    for name, (*_, reason) in FOREIGN.items():
        assert topics[name].messages == len(scanned[name]) == 2
        assert reason in str(topics[name].refusal)
        assert topics[name].refusal == refusal(scanned[name])


def test_topics_of_other_kinds_do_not_touch_ours(mixed: Path, bench: Bench) -> None:
    alone, beside = read_log(bench.write(*bench.basics(), name="alone.mcap")), read_log(mixed)
    np.testing.assert_array_equal(alone.imu.stamps_ns, beside.imu.stamps_ns)
    np.testing.assert_array_equal(alone.imu.angular_velocity, beside.imu.angular_velocity)


def test_the_reason_is_given_where_nothing_else_plays_the_role(bench: Bench, tmp_path: Path) -> None:
    path = copy_with_foreign(bench.write(*bench.basics()), tmp_path / "mixed.mcap", without=("/imu",))
    with pytest.raises(MissingTopicError, match=r"nothing for imu: .*/idl has a definition in ros2idl"):
        read_log(path)


CUT_BEFORE = {"imu": "their definition does", "depth": "their definition does", "detections": "track"}
"""What eight bytes less leave out: the length of a list, or a part of a number."""


def broken_log(bench: Bench, tmp_path: Path, topic: str, which: set[int]) -> Path:
    """Some messages of a topic cut off by eight bytes."""
    entries = bench.basics(9)
    entries.append(("/pressure", "pressure", [bench.pressure(bench.t0_ns + i, 2e5) for i in range(9)]))
    detections = [bench.detections(bench.t0_ns + i, [1.0 + i], [3]) for i in range(9)]
    entries.append(("/landmarks", "detections", detections))
    source, target = bench.write(*entries, name="whole.mcap"), tmp_path / "broken.mcap"
    with source.open("rb") as original, target.open("wb") as stream:
        writer, channels, seen = Writer(stream), {}, 0
        writer.start("ros2", "test")
        for schema, channel, message in make_reader(original).iter_messages():
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            data = message.data
            if channel.topic == topic:
                data = data[:-8] if seen in which else data
                seen += 1
            writer.add_message(channels[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
    return target


@pytest.mark.parametrize(("topic", "role"), [("/imu", "imu"), ("/pressure", "depth"), ("/landmarks", "detections")])
def test_broken_messages_are_counted_and_the_others_are_as_if_alone(
    bench: Bench, tmp_path: Path, topic: str, role: str
) -> None:
    path = broken_log(bench, tmp_path, topic, {0, 4, 5})
    broken, whole = read_log(path), read_log(tmp_path / "whole.mcap")
    kept = [1, 2, 3, 6, 7, 8]
    np.testing.assert_array_equal(getattr(broken, role).stamps_ns, getattr(whole, role).stamps_ns[kept])
    column = {"imu": "angular_velocity", "depth": "z_m", "detections": "range_m"}[role]
    np.testing.assert_array_equal(getattr(getattr(broken, role), column), getattr(getattr(whole, role), column)[kept])
    assert broken.notes["log.dropped"] == f"{role}: 3 that end before {CUT_BEFORE[role]}"


@pytest.mark.parametrize(("topic", "role"), [("/pressure", "depth"), ("/landmarks", "detections")])
def test_a_topic_that_is_not_needed_and_wholly_broken_is_left_out(
    bench: Bench, tmp_path: Path, topic: str, role: str
) -> None:
    sequence = read_log(broken_log(bench, tmp_path, topic, set(range(9))))
    assert getattr(sequence, role) is None
    assert sequence.notes["log.dropped"] == f"{role}: 9 that end before {CUT_BEFORE[role]}"


def test_a_needed_topic_that_is_wholly_broken_is_an_error(bench: Bench, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"topic /imu: no message .* 9 that end before their definition does"):
        read_log(broken_log(bench, tmp_path, "/imu", set(range(9))))
