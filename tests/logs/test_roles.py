from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from sonar_graph.errors import LogError, MissingTopicError
from sonar_graph.logs.inspection import inspect_log
from sonar_graph.logs.mcap.reader import scan
from sonar_graph.logs.mcap.topic import Keep
from sonar_graph.logs.reading import read_log
from sonar_graph.logs.roles import refusal

from .conftest import Bench
from .containers import channel_for, writing

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


Change = Callable[[str, int, bytes], bytes | None]


def copied(source: Path, change: Change, *, beside: bool = False) -> Path:
    """Copy of a log with changed messages, by topic and number; with ``beside``, channels of other kinds among ours."""
    target, seen = source.with_name("copy.mcap"), Counter[str]()
    with source.open("rb") as original, writing(target) as writer:
        channels = {}
        for topic, (name, kind, text, encoding, _) in FOREIGN.items() if beside else ():
            schema = writer.register_schema(name, kind, text) if kind else 0
            channels[topic] = writer.register_channel(topic, encoding, schema)
        others = list(channels.values())
        for schema, channel, message in make_reader(original).iter_messages():
            data = change(channel.topic, seen[channel.topic], message.data)
            seen[channel.topic] += 1
            if data is None:
                continue
            if channel.topic not in channels:
                channels[channel.topic] = channel_for(writer, channel.topic, schema.name, schema.data)
            writer.add_message(channels[channel.topic], message.log_time, data, message.publish_time)
            for other in others if seen.total() <= 2 else ():
                writer.add_message(other, message.log_time, b"{}", message.publish_time)
    return target


def test_topics_that_cannot_be_decoded_are_counted_and_listed_with_the_reason_and_do_not_touch_ours(
    bench: Bench,
) -> None:
    path = bench.write(*bench.basics())
    mixed = copied(path, lambda *message: message[-1], beside=True)
    topics = {topic.name: topic for topic in inspect_log(mixed).topics}
    assert {name for name, topic in topics.items() if topic.refusal} == set(FOREIGN)
    scanned = scan(mixed, lambda _: Keep.STAMP).topics
    for name, (*_, reason) in FOREIGN.items():
        assert topics[name].messages == len(scanned[name]) == 2
        assert reason in str(topics[name].refusal)
        assert topics[name].refusal == refusal(scanned[name])
    alone, beside = read_log(path), read_log(mixed)
    np.testing.assert_array_equal(alone.imu.stamps_ns, beside.imu.stamps_ns)
    np.testing.assert_array_equal(alone.imu.angular_velocity, beside.imu.angular_velocity)
    without = copied(path, lambda topic, _, data: None if topic == "/imu" else data, beside=True)
    with pytest.raises(MissingTopicError, match=r"nothing for imu: .*/idl has a definition in ros2idl"):
        read_log(without)


# topic, role, column, and what eight bytes less leave out: a part of a number, or the length of a list
BROKEN = [
    ("/imu", "imu", "angular_velocity", "their definition does"),
    ("/pressure", "depth", "z_m", "their definition does"),
    ("/landmarks", "detections", "range_m", "track"),
]


@pytest.mark.parametrize(("topic", "role", "column", "end"), BROKEN)
def test_broken_messages_are_counted_and_the_others_are_as_if_alone(
    bench: Bench, topic: str, role: str, column: str, end: str
) -> None:
    path = bench.write(
        *bench.basics(9),
        ("/pressure", "pressure", [bench.pressure(bench.t0_ns + i, 2e5) for i in range(9)]),
        ("/landmarks", "detections", [bench.detections(bench.t0_ns + i, [1.0 + i], [3]) for i in range(9)]),
    )
    whole = getattr(read_log(path), role)
    broken = read_log(copied(path, lambda name, i, data: data[:-8] if name == topic and i in (0, 4, 5) else data))
    kept = [1, 2, 3, 6, 7, 8]
    np.testing.assert_array_equal(getattr(broken, role).stamps_ns, whole.stamps_ns[kept])
    np.testing.assert_array_equal(getattr(getattr(broken, role), column), getattr(whole, column)[kept])
    assert broken.notes["log.dropped"] == f"{role}: 3 that end before {end}"
    wholly = copied(path, lambda name, _, data: data[:-8] if name == topic else data)
    if role == "imu":
        with pytest.raises(LogError, match=rf"topic /imu: no message .* 9 that end before {end}"):
            read_log(wholly)
    else:
        sequence = read_log(wholly)
        assert getattr(sequence, role) is None
        assert sequence.notes["log.dropped"] == f"{role}: 9 that end before {end}"
