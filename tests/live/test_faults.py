"""Faults of a running robot over the loopback with both ends real: nothing ends, and live equals log to the bit."""

import signal
import struct
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from sonar_graph import read_log, run_estimator, write_log
from sonar_graph.live import (
    LiveOptions,
    LiveRun,
    Publisher,
    definition_of,
    inbox,
    open_session,
    subscribe,
)
from sonar_graph.live.outlets import ZenohOutlet
from sonar_graph.logs import LiveRecord
from sonar_graph.simulation import MissionOptions, simulate_mission
from tests.live.traffic import free_endpoint, messages_of

pytest.importorskip("zenoh")
pytestmark = pytest.mark.slow
PACE = 2.5
SECOND = 10**9
STALLED = """
import sys, time
from sonar_graph.live import open_session
session = open_session([sys.argv[1]])
subscriber = session.declare_subscriber("0/sonar_graph/**", lambda sample: None)
print("listening", flush=True)
time.sleep(600)
"""


@pytest.fixture
def endpoint():
    return free_endpoint()


@pytest.fixture
def messages(tmp_path):
    write_log(
        tmp_path / "log.mcap",
        simulate_mission(MissionOptions(duration_s=20.0, frame_rate_hz=5.0)),
    )
    return messages_of(tmp_path / "log.mcap", np.random.default_rng(0), 0.0)


class Robot(threading.Thread):
    """Router and sender of messages, `PACE` times as fast as they were recorded, which may break off for a second."""

    def __init__(self, endpoint, messages, pace_at=lambda _: PACE, breaks_at_s=None):
        super().__init__(daemon=True)
        self.is_heard, self.is_done = threading.Event(), threading.Event()
        self._endpoint, self._messages, self._pace_at, self._breaks_at_s = (
            endpoint,
            messages,
            pace_at,
            breaks_at_s,
        )
        self._open()

    def _open(self):
        self.session = open_session(listen=[self._endpoint])
        kinds = {m.topic: m.type_name for m in self._messages}
        self._publishers = {
            topic: Publisher(self.session, 0, topic, kind)
            for topic, kind in kinds.items()
        }

    def run(self):
        self.is_heard.wait(30)
        first_ns = before_ns = self._messages[0].arrival_ns
        due_s = time.monotonic()
        for message in self._messages:
            at_s = (message.arrival_ns - first_ns) * 1e-9
            due_s += (message.arrival_ns - before_ns) * 1e-9 / self._pace_at(at_s)
            before_ns = message.arrival_ns
            time.sleep(max(0.0, due_s - time.monotonic()))
            if self._breaks_at_s is not None and at_s > self._breaks_at_s:
                self._breaks_at_s = None
                self.session.close()
                time.sleep(1.0)
                self._open()
                time.sleep(2.0)  # a client looks for its router once a second
                due_s = time.monotonic()
            self._publishers[message.topic].put(message.payload)
        self.is_done.set()


def lived(folder, endpoint, robot, listener=None, said=None):
    """A live run on what a robot sends: the run, its outcome, and the messages."""
    said = [] if said is None else said
    taken = {}
    with (
        open_session([endpoint]) as session,
        LiveRecord(folder / "record.mcap") as record,
    ):
        options = LiveOptions("ekf-slam", lateness_s=1.0)
        with LiveRun(
            record, definition_of, options, [ZenohOutlet(session, 0)], said.append
        ) as run:
            subscriptions = subscribe(session, 0, run.accept)
            if listener is not None:
                taken["subscription"] = listener(endpoint)
            time.sleep(0.5)
            robot.start()
            robot.is_heard.set()
            last_s = time.monotonic() + 90
            while not robot.is_done.is_set() and time.monotonic() < last_s:
                run.turn()
            until_s = time.monotonic() + 2.0
            while time.monotonic() < until_s:
                run.turn()
            for one in subscriptions:
                one.undeclare()
            outcome = run.finish()
            counts = run.counts()
    robot.session.close()
    return outcome, counts, said


def assert_equals_log(outcome, folder, at_least):
    log = read_log(folder / "record.mcap")
    again = run_estimator(log, "ekf-slam", instants_ns=log.instants(10.0)).causal
    common = np.intersect1d(outcome.causal.stamps_ns, again.stamps_ns)
    assert len(common) >= at_least
    for name in ("positions", "quaternions_xyzw", "covariances"):
        mine, theirs = (
            getattr(one, name)[np.searchsorted(one.stamps_ns, common)].tobytes()
            for one in (outcome.causal, again)
        )
        assert mine == theirs, name


def at_s(messages, message):
    return (message.arrival_ns - messages[0].arrival_ns) * 1e-9


def test_a_doppler_log_that_stops_and_returns_is_named_both_times(
    tmp_path, endpoint, messages, monkeypatch
):
    monkeypatch.setattr(inbox, "SILENT_S", 0.5)
    said = []

    def pace_at(at_s):
        """A loaded machine takes longer to notice: the gap lasts until it has."""
        is_noticed = any(line.startswith("/dvl/data: nothing") for line in said)
        return 0.3 if 8 < at_s < 14 and not is_noticed else PACE

    robot = Robot(
        endpoint,
        [
            m
            for m in messages
            if m.topic != "/dvl/data" or not 8 < at_s(messages, m) < 14
        ],
        pace_at,
    )
    outcome, counts, said = lived(tmp_path, endpoint, robot, said=said)
    assert any(line.startswith("/dvl/data: nothing since") for line in said)
    assert not counts["lost"]
    assert_equals_log(outcome, tmp_path, 150)


def test_a_sender_that_ends_is_missed(tmp_path, endpoint, messages, monkeypatch):
    monkeypatch.setattr(inbox, "SILENT_S", 0.5)
    outcome, _, said = lived(
        tmp_path,
        endpoint,
        Robot(endpoint, [m for m in messages if at_s(messages, m) < 10]),
    )
    missed = [line.partition(":")[0] for line in said if ": nothing since " in line]
    assert {"/imu/data", "/dvl/data"} <= set(missed)
    assert_equals_log(outcome, tmp_path, 50)


def test_a_clock_that_is_set_ahead_by_a_minute_costs_messages_by_name_only(
    tmp_path, endpoint, messages
):
    def stepped(message):
        if at_s(messages, message) < 10 or message.topic == "/tf_static":
            return message
        seconds = struct.unpack_from("<i", message.payload, 4)[0] + 60
        return message._replace(
            payload=message.payload[:4]
            + struct.pack("<i", seconds)
            + message.payload[8:]
        )

    outcome, counts, _ = lived(
        tmp_path, endpoint, Robot(endpoint, [stepped(m) for m in messages])
    )
    assert any("a clock was set" in reason for reason in counts["dropped"])
    assert not counts["lost"]
    assert_equals_log(outcome, tmp_path, 100)


def test_a_burst_at_ten_times_the_pace_loses_nothing(tmp_path, endpoint, messages):
    robot = Robot(
        endpoint, messages, pace_at=lambda at_s: 10 * PACE if 8 < at_s < 14 else PACE
    )
    outcome, counts, _ = lived(tmp_path, endpoint, robot)
    assert not counts["lost"]
    assert sum(counts["received"].values()) == len(messages)
    assert_equals_log(outcome, tmp_path, 150)


def test_after_a_router_that_restarts_the_run_goes_on(tmp_path, endpoint, messages):
    robot = Robot(endpoint, messages, breaks_at_s=10.0)
    outcome, counts, _ = lived(tmp_path, endpoint, robot)
    received = sum(counts["received"].values())
    # what was sent while it looked for the router is missing
    assert received > 0.9 * len(messages)
    assert outcome.causal.stamps_ns[-1] - outcome.causal.stamps_ns[0] > 18 * SECOND
    assert_equals_log(outcome, tmp_path, 150)


def test_a_viewer_that_stalls_delays_nobody(tmp_path, endpoint, messages):
    """A subscriber that is stopped does not hold up poses for another, nor the run."""
    arrived = []

    def listener(where):
        viewer = subprocess.Popen(
            [sys.executable, "-c", STALLED, where], stdout=subprocess.PIPE, text=True
        )
        assert viewer.stdout.readline() == "listening\n"
        viewer.send_signal(signal.SIGSTOP)
        session = open_session([where])
        subscriber = session.declare_subscriber(
            "0/sonar_graph/odometry/**",
            lambda s: arrived.append((time.monotonic(), s.payload.to_bytes())),
        )
        stalled.append((viewer, session, subscriber))
        return subscriber

    stalled = []
    try:
        outcome, counts, _ = lived(
            tmp_path, endpoint, Robot(endpoint, messages), listener
        )
    finally:
        for viewer, session, _ in stalled:
            viewer.kill()
            viewer.communicate()
            session.close()
    assert not counts["lost"]
    assert len(arrived) > 500
    assert max(np.diff([at for at, _ in arrived])) < 2.0
    assert_equals_log(outcome, tmp_path, 150)


@pytest.mark.parametrize("may_drop", [True, False])
def test_only_a_dropping_publisher_is_not_blocked_by_a_slow_reader(endpoint, may_drop):
    with open_session(listen=[endpoint]) as router:
        publisher = Publisher(
            router,
            0,
            "/sonar_graph/odometry",
            "nav_msgs/msg/Odometry",
            may_drop=may_drop,
        )
        with subprocess.Popen(
            [sys.executable, "-c", STALLED, endpoint], stdout=subprocess.PIPE, text=True
        ) as viewer:
            assert viewer.stdout.readline() == "listening\n"
            time.sleep(0.5)
            viewer.send_signal(signal.SIGSTOP)
            sender = threading.Thread(
                target=lambda: [publisher.put(bytes(1 << 20)) for _ in range(100)],
                daemon=True,
            )
            sender.start()
            sender.join(3.0)
            assert sender.is_alive() == (not may_drop)
            viewer.kill()
        sender.join(30.0)
