"""Live over the loopback: programs that are not ours read what is sent, and feed what is received."""

import struct
import threading
import time
from contextlib import contextmanager
from itertools import count

import mcap_ros2._dynamic as ros2
import numpy as np
import pytest

from sonar_graph import Sequence, read_log, write_log
from sonar_graph.live import (
    Message,
    Publisher,
    definition_of,
    open_session,
    play_messages,
    subscribe,
)
from sonar_graph.live.foxglove_link import FoxgloveLink
from sonar_graph.live.outlets import DETECTED, TOPICS
from sonar_graph.live.zenoh_link import parse_key, topic_key, type_hash
from sonar_graph.logs import PartialCalibration
from sonar_graph.simulation import MissionOptions, simulate_mission
from tests.live.traffic import free_endpoint, lived, messages_of

zenoh = pytest.importorskip("zenoh")


@pytest.fixture
def endpoint():
    return free_endpoint()


def test_type_hashes_are_those_of_ros():
    """RIHS01 of std_msgs/String, as every installation of ROS 2 since Iron prints it."""
    expected = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert type_hash("std_msgs/msg/String") == expected


def test_a_key_gives_topic_and_type_again():
    key = topic_key(7, "/nav/imu/data", "sensor_msgs/msg/Imu", "RIHS01_x")
    assert key == "7/nav/imu/data/sensor_msgs::msg::dds_::Imu_/RIHS01_x"
    assert parse_key(key) == ("/nav/imu/data", "sensor_msgs/msg/Imu")
    assert parse_key("0/some/thing/else") is None


@pytest.fixture
def mission(tmp_path) -> Sequence:
    world = simulate_mission(MissionOptions(duration_s=10.0, frame_rate_hz=5.0))
    write_log(tmp_path / "log.mcap", world)
    return world


def read_by_ros(kind, payload):
    short = kind.replace("/msg/", "/")
    return ros2.generate_dynamic(short, definition_of(kind))[short](payload)


def test_strangers_feed_it_and_read_every_topic(tmp_path, mission, endpoint):
    """At 2.5 times the pace of the log."""
    messages = messages_of(tmp_path / "log.mcap", np.random.default_rng(0), 0.0)
    known = mission.calibration.model_dump(mode="json")
    given = PartialCalibration(known, "of the mission")
    newest: dict[str, bytes] = {}

    def hear(sample):
        newest[str(sample.key_expr)] = sample.payload.to_bytes()

    with stranger(endpoint) as put, open_session([endpoint]) as listener:
        listener.declare_subscriber("0/**", hear)
        sent = (iter(messages), 2.5, put, lambda: False)
        robot = threading.Thread(target=play_messages, args=sent, daemon=True)
        outcome, _ = lived(tmp_path, endpoint, robot, [], calibration=given)
    recorded = read_log(tmp_path / "record.mcap")
    assert len(recorded.imu) == len(mission.imu)
    assert len(outcome.causal) >= 0.9 * mission.duration_s * 10
    read = {}
    for topic, kind in TOPICS.items():
        if topic != DETECTED:  # there are no images
            key = topic_key(0, topic, kind, type_hash(kind))
            read[topic] = read_by_ros(kind, newest[key])
    last = read["/sonar_graph/odometry"]
    at_ns = last.header.stamp.sec * 10**9 + last.header.stamp.nanosec
    place = last.pose.pose.position
    truth = mission.truth.at(np.array([at_ns]))
    assert np.linalg.norm(truth.positions[0] - [place.x, place.y, place.z]) < 0.1


def test_a_foxglove_bridge_feeds_it_and_may_break_off(tmp_path, mission):
    """The server of foxglove-sdk in place of a bridge, which ends in the middle and comes back."""
    foxglove = pytest.importorskip("foxglove")
    pytest.importorskip("websockets")
    messages = messages_of(tmp_path / "log.mcap", np.random.default_rng(0), 0.0)
    wanted = ("/imu/data", "/dvl/data")
    expected = [m[:3] for m in messages if m.topic in wanted]
    port = int(free_endpoint().rpartition(":")[2])
    context = foxglove.Context()
    channels = {}
    for topic, kind in {m.topic: m.type_name for m in messages}.items():
        data = definition_of(kind).encode()
        schema = foxglove.Schema(name=kind, encoding="ros2msg", data=data)
        form = {"message_encoding": "cdr", "context": context}
        channels[topic] = foxglove.Channel(topic, schema=schema, **form)
    server = started(foxglove, port, context)
    got: list[Message] = []

    def sent(rows):
        for message in messages[rows]:
            channels[message.topic].log(message.payload)
        n = sum(message.topic in wanted for message in messages[: rows.stop])
        until(lambda: len(got) == n)

    half = len(messages) // 2
    try:
        with FoxgloveLink(f"ws://127.0.0.1:{port}") as link:
            link.listen(got.append, lambda _, kind: "Imu" in kind or "Dvl" in kind)
            time.sleep(0.5)
            sent(slice(0, half))
            server.stop()
            server = started(foxglove, port, context)
            until(lambda: link.breaks == 1)
            time.sleep(2.0)
            sent(slice(half, None))
            kind = "sensor_msgs/msg/Imu"
            assert link.definition_of(kind) == definition_of(kind)
    finally:
        server.stop()
    assert [m[:3] for m in got] == expected


def started(foxglove, port, context):
    """The server on its port, which the system may still hold for a while."""
    where = {"host": "127.0.0.1", "port": port, "context": context}
    last_s = time.monotonic() + 20.0
    while True:
        try:
            return foxglove.start_server(**where, message_backlog_size=100_000)
        except RuntimeError:
            if time.monotonic() > last_s:
                raise
            time.sleep(0.1)


def until(holds):
    last_s = time.monotonic() + 20.0
    while not holds() and time.monotonic() < last_s:
        time.sleep(0.01)
    assert holds()


def test_a_router_that_ends_and_comes_back_is_heard_again(endpoint):
    got = []
    router = open_session(listen=[endpoint])
    with open_session([endpoint]) as session:
        subscriptions = subscribe(session, 0, got.append)
        for round_number in (1, 2):
            publisher = Publisher(router, 0, "/imu/data", "sensor_msgs/msg/Imu")

            def is_heard(publisher=publisher, senders=round_number):
                publisher.put(b"row")
                return len({message.sender for message in got}) == senders

            until(is_heard)
            router.close()
            router = open_session(listen=[endpoint])
        assert subscriptions
    router.close()


@contextmanager
def stranger(endpoint):
    """What sends messages of a plain zenoh program in the form of rmw_zenoh, which is the router too."""
    config = zenoh.Config()
    for key, value in (("mode", '"router"'), ("listen/endpoints", f'["{endpoint}"]')):
        config.insert_json5(key, value)
    numbers = count()
    with zenoh.open(config) as session:

        def put(message):
            package, _, name = message.type_name.split("/")
            key = f"0{message.topic}/{package}::msg::dds_::{name}_/RIHS01_{'0' * 64}"
            about = (next(numbers), time.time_ns(), 16, message.topic.encode())
            attachment = struct.pack("<qqB16s", *about)
            session.put(key, message.payload, attachment=attachment)

        yield put
