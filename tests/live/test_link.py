"""Live over the loopback: programs that are not ours read what is sent, and feed what is received."""

import struct
import threading
import time
from contextlib import ExitStack
from itertools import count

import mcap_ros2._dynamic as ros2
import numpy as np
import pytest

from sonar_graph import Sequence, read_log, write_log
from sonar_graph.errors import LogError
from sonar_graph.live import (
    LiveOptions,
    LiveRun,
    Message,
    Publisher,
    definition_of,
    open_link,
    open_session,
    play_messages,
    subscribe,
)
from sonar_graph.live.foxglove_link import FoxgloveLink
from sonar_graph.live.outlets import DETECTED, TOPICS, zenoh_outlet
from sonar_graph.live.zenoh_link import parse_key, topic_key, type_hash
from sonar_graph.logs import LiveRecord, PartialCalibration
from sonar_graph.simulation import MissionOptions, simulate_mission
from tests.live.traffic import free_endpoint, messages_of

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


@pytest.mark.parametrize(
    ("where", "fault"),
    [
        ("tcp/127.0.0.1:1", "zenoh cannot connect"),
        ("ws://127.0.0.1:1", "cannot connect"),
    ],
)
def test_a_router_or_bridge_that_is_not_there_is_named(where, fault):
    pytest.importorskip("websockets")
    with pytest.raises(LogError, match=f"{where}: {fault}"):
        open_link([where], 0)


@pytest.fixture
def mission(tmp_path) -> Sequence:
    world = simulate_mission(MissionOptions(duration_s=10.0, frame_rate_hz=5.0))
    write_log(tmp_path / "log.mcap", world)
    return world


def foreign_publisher(endpoint, messages, ready):
    """A plain zenoh program in the form of rmw_zenoh, which is the router too, at 2.5 times the pace of the log."""
    config = zenoh.Config()
    for key, value in (("mode", '"router"'), ("listen/endpoints", f'["{endpoint}"]')):
        config.insert_json5(key, value)
    with zenoh.open(config) as session:
        ready["router"].set()
        ready["subscribed"].wait(60)
        numbers = count()

        def put(message):
            package, _, name = message.type_name.split("/")
            key = f"0{message.topic}/{package}::msg::dds_::{name}_/RIHS01_{'0' * 64}"
            about = (next(numbers), time.time_ns(), 16, message.topic.encode())
            attachment = struct.pack("<qqB16s", *about)
            session.put(key, message.payload, attachment=attachment)

        play_messages(iter(messages), 2.5, put, lambda: False)
        ready["done"].set()
        ready["end"].wait(60)


def read_by_ros(kind, payload):
    short = kind.replace("/msg/", "/")
    return ros2.generate_dynamic(short, definition_of(kind))[short](payload)


def test_strangers_feed_it_and_read_every_topic(tmp_path, mission, endpoint):
    ready = {
        name: threading.Event() for name in ("router", "subscribed", "done", "end")
    }
    messages = messages_of(tmp_path / "log.mcap", np.random.default_rng(0), 0.0)
    robot = threading.Thread(target=foreign_publisher, args=(endpoint, messages, ready))
    robot.start()
    heard: dict[str, list[bytes]] = {}
    try:
        assert ready["router"].wait(10)
        with ExitStack() as stack:
            listener = stack.enter_context(open_session([endpoint]))
            session = stack.enter_context(open_session([endpoint]))
            listener.declare_subscriber(
                "0/**",
                lambda s: heard.setdefault(str(s.key_expr), []).append(
                    s.payload.to_bytes()
                ),
            )
            record = stack.enter_context(LiveRecord(tmp_path / "record.mcap"))
            known = mission.calibration.model_dump(mode="json")
            given = PartialCalibration(known, "of the mission")
            options = LiveOptions("ekf-slam", lateness_s=1.0, calibration=given)
            outlets = [zenoh_outlet(session, 0)]
            run = stack.enter_context(
                LiveRun(record, definition_of, options, outlets, lambda _: None)
            )
            subscriptions = subscribe(session, 0, run.accept)
            time.sleep(0.5)
            ready["subscribed"].set()
            last_s = time.monotonic() + 60
            while not ready["done"].is_set() and time.monotonic() < last_s:
                run.turn()
            for _ in range(20):
                run.turn()
            for one in subscriptions:
                one.undeclare()
            outcome = run.finish()
    finally:
        ready["subscribed"].set()
        ready["end"].set()
        robot.join()
    record_read = read_log(tmp_path / "record.mcap")
    assert len(record_read.imu) == len(mission.imu)
    assert len(outcome.causal) >= 0.9 * mission.duration_s * 10
    newest = {}
    for topic, kind in TOPICS.items():
        if topic == DETECTED:
            continue  # there are no images
        key = topic_key(0, topic, kind, type_hash(kind))
        assert key in heard, f"nothing was heard of {topic}"
        newest[topic] = [read_by_ros(kind, payload) for payload in heard[key]][-1]
    last = newest["/sonar_graph/odometry"]
    at_ns = last.header.stamp.sec * 10**9 + last.header.stamp.nanosec
    place = last.pose.pose.position
    truth = mission.truth.at(np.array([at_ns]))
    assert np.linalg.norm(truth.positions[0] - [place.x, place.y, place.z]) < 0.1


def test_a_foxglove_bridge_feeds_it_and_may_break_off(tmp_path, mission):
    """The server of foxglove-sdk in place of a bridge, which ends in the middle and comes back."""
    foxglove = pytest.importorskip("foxglove")
    pytest.importorskip("websockets")
    messages = messages_of(tmp_path / "log.mcap", np.random.default_rng(0), 0.0)
    port = int(free_endpoint().rpartition(":")[2])
    context = foxglove.Context()
    channels = {}
    for topic, kind in {m.topic: m.type_name for m in messages}.items():
        data = definition_of(kind).encode()
        schema = foxglove.Schema(name=kind, encoding="ros2msg", data=data)
        channels[topic] = foxglove.Channel(
            topic, schema=schema, message_encoding="cdr", context=context
        )
    server = started(foxglove, port, context)
    got: list[Message] = []

    def send(some):
        for message in some:
            channels[message.topic].log(message.payload)

    def has_all(some):
        return len(got) == sum(wanted(message) for message in some)

    half = len(messages) // 2
    try:
        with FoxgloveLink(f"ws://127.0.0.1:{port}") as link:
            link.listen(got.append, lambda _, kind: "Imu" in kind or "Dvl" in kind)
            time.sleep(0.5)
            send(messages[:half])
            until(lambda: has_all(messages[:half]))
            server.stop()
            server = started(foxglove, port, context)
            until(lambda: link.breaks == 1)
            time.sleep(2.0)
            send(messages[half:])
            until(lambda: has_all(messages))
            kind = "sensor_msgs/msg/Imu"
            assert link.definition_of(kind) == definition_of(kind)
    finally:
        server.stop()
    same = [(m.topic, m.type_name, m.payload) for m in messages if wanted(m)]
    assert [(m.topic, m.type_name, m.payload) for m in got] == same


def started(foxglove, port, context, longest_s=20.0):
    """The server on its port, which the system may still hold for a while."""
    where = {"host": "127.0.0.1", "port": port, "context": context}
    last_s = time.monotonic() + longest_s
    while True:
        try:
            return foxglove.start_server(**where, message_backlog_size=100_000)
        except RuntimeError:
            if time.monotonic() > last_s:
                raise
            time.sleep(0.1)


def wanted(message):
    return message.topic in ("/imu/data", "/dvl/data")


def until(holds, longest_s=20.0):
    last_s = time.monotonic() + longest_s
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
