"""Faults of a running robot over the loopback with both ends real: nothing ends, and live equals log to the bit."""

import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager

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
    """Router and sender of messages, `PACE` times as fast as they were recorded."""

    def __init__(self, endpoint, messages, pace_at=lambda _: PACE):
        super().__init__(daemon=True)
        self.is_done = threading.Event()
        self.session = open_session(listen=[endpoint])
        self._messages = messages
        self._pace_at = pace_at
        kinds = {m.topic: m.type_name for m in messages}
        self._publishers = {
            topic: Publisher(self.session, 0, topic, kind)
            for topic, kind in kinds.items()
        }

    def run(self):
        before_ns = self._messages[0].arrival_ns
        due_s = time.monotonic()
        for message in self._messages:
            pace = self._pace_at(at_s(self._messages, message))
            due_s += (message.arrival_ns - before_ns) * 1e-9 / pace
            before_ns = message.arrival_ns
            time.sleep(max(0.0, due_s - time.monotonic()))
            self._publishers[message.topic].put(message.payload)
        self.is_done.set()


def lived(folder, endpoint, robot, said):
    """The outcome of a live run on what a robot sends, and its counts."""
    options = LiveOptions("ekf-slam", lateness_s=1.0)
    with ExitStack() as stack:
        session = stack.enter_context(open_session([endpoint]))
        record = stack.enter_context(LiveRecord(folder / "record.mcap"))
        outlets = [ZenohOutlet(session, 0)]
        run = stack.enter_context(
            LiveRun(record, definition_of, options, outlets, said.append)
        )
        subscriptions = subscribe(session, 0, run.accept)
        time.sleep(0.5)
        robot.start()
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
    return outcome, counts


def assert_equals_log(outcome, folder, at_least):
    log = read_log(folder / "record.mcap")
    again = run_estimator(log, "ekf-slam", instants_ns=log.instants(10.0)).causal
    mine = outcome.causal
    common, ours, theirs = np.intersect1d(
        mine.stamps_ns, again.stamps_ns, return_indices=True
    )
    assert len(common) >= at_least
    for name in ("positions", "quaternions_xyzw", "covariances"):
        one, other = getattr(mine, name)[ours], getattr(again, name)[theirs]
        assert one.tobytes() == other.tobytes(), name


def at_s(messages, message):
    return (message.arrival_ns - messages[0].arrival_ns) * 1e-9


def test_a_doppler_log_that_stops_and_returns_is_named_both_times(
    tmp_path, endpoint, messages, monkeypatch
):
    monkeypatch.setattr(inbox, "SILENT_S", 0.5)
    said = []

    def is_gone(message):
        return message.topic == "/dvl/data" and 8 < at_s(messages, message) < 14

    def pace_at(at_s):
        """A loaded machine takes longer to notice: the gap lasts until it has."""
        is_noticed = any(line.startswith("/dvl/data: nothing") for line in said)
        return 0.3 if 8 < at_s < 14 and not is_noticed else PACE

    left = [message for message in messages if not is_gone(message)]
    outcome, counts = lived(tmp_path, endpoint, Robot(endpoint, left, pace_at), said)
    assert any(line.startswith("/dvl/data: nothing since") for line in said)
    assert not counts["lost"]
    assert_equals_log(outcome, tmp_path, 150)


def test_a_burst_at_ten_times_the_pace_beside_a_stalled_viewer_loses_nothing(
    tmp_path, endpoint, messages
):
    """A subscriber that is stopped does not hold up poses for another, nor the run."""
    robot = Robot(endpoint, messages, lambda at_s: 10 * PACE if 8 < at_s < 14 else PACE)
    arrived = []
    with stalled(endpoint), open_session([endpoint]) as session:
        subscriber = session.declare_subscriber(
            "0/sonar_graph/odometry/**", lambda _: arrived.append(time.monotonic())
        )
        outcome, counts = lived(tmp_path, endpoint, robot, [])
        subscriber.undeclare()
    assert not counts["lost"]
    assert sum(counts["received"].values()) == len(messages)
    assert len(arrived) > 500
    assert max(np.diff(arrived)) < 2.0
    assert_equals_log(outcome, tmp_path, 150)


@contextmanager
def stalled(endpoint):
    """A subscriber of all that a live run sends, in a process that is stopped."""
    viewer = subprocess.Popen(
        [sys.executable, "-c", STALLED, endpoint], stdout=subprocess.PIPE, text=True
    )
    try:
        assert viewer.stdout.readline() == "listening\n"
        time.sleep(0.5)
        viewer.send_signal(signal.SIGSTOP)
        yield
    finally:
        viewer.kill()
        viewer.communicate()


@pytest.mark.parametrize("may_drop", [True, False])
def test_only_a_dropping_publisher_is_not_blocked_by_a_slow_reader(endpoint, may_drop):
    with open_session(listen=[endpoint]) as router:
        topic = ("/sonar_graph/odometry", "nav_msgs/msg/Odometry")
        publisher = Publisher(router, 0, *topic, may_drop=may_drop)
        sender = threading.Thread(
            target=lambda: [publisher.put(bytes(1 << 20)) for _ in range(100)],
            daemon=True,
        )
        with stalled(endpoint):
            sender.start()
            sender.join(3.0)
            assert sender.is_alive() == (not may_drop)
        sender.join(30.0)
