"""Faults of a running robot over the loopback with both ends real: nothing ends, and live equals log to the bit."""

import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from sonar_graph import read_log, run_estimator, write_log
from sonar_graph.live import (
    Publisher,
    inbox,
    open_session,
    play_messages,
)
from sonar_graph.simulation import MissionOptions, simulate_mission
from tests.live.traffic import free_endpoint, lived, messages_of

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


def robot(endpoint, messages, wait=lambda _: None):
    """Router and sender of messages, `PACE` times as fast as they were recorded: a thread, and its session."""
    session = open_session(listen=[endpoint])
    kinds = {m.topic: m.type_name for m in messages}
    publishers = {
        topic: Publisher(session, 0, topic, kind) for topic, kind in kinds.items()
    }

    def put(message):
        wait(message)
        publishers[message.topic].put(message.payload)

    sent = (iter(messages), PACE, put, lambda: False)
    return threading.Thread(target=play_messages, args=sent, daemon=True), session


def assert_equals_log(outcome, folder):
    log = read_log(folder / "record.mcap")
    again = run_estimator(log, "ekf-slam", instants_ns=log.instants(10.0)).causal
    mine = outcome.causal
    stamps_ns = (mine.stamps_ns, again.stamps_ns)
    common, *rows = np.intersect1d(*stamps_ns, return_indices=True)
    assert len(common) >= 150
    for name in ("positions", "quaternions_xyzw", "covariances"):
        both = zip((mine, again), rows, strict=True)
        one, other = (getattr(path, name)[at].tobytes() for path, at in both)
        assert one == other, name


def at_s(messages, message):
    return (message.arrival_ns - messages[0].arrival_ns) * 1e-9


def test_a_doppler_log_that_stops_and_returns_is_named_both_times(
    tmp_path, endpoint, messages, monkeypatch
):
    monkeypatch.setattr(inbox, "SILENT_S", 0.5)
    last_s = time.monotonic() + 60

    def is_gone(message):
        return message.topic == "/dvl/data" and 8 < at_s(messages, message) < 14

    def wait(message):
        """A loaded machine takes longer to notice: the gap lasts until it has."""
        while at_s(messages, message) > 13 and time.monotonic() < last_s:
            if any(line.startswith("/dvl/data: nothing") for line in said):
                return
            time.sleep(0.05)

    left = [message for message in messages if not is_gone(message)]
    sender, router = robot(endpoint, left, wait)
    said = []
    outcome, counts = lived(tmp_path, endpoint, sender, said)
    router.close()
    assert any(line.startswith("/dvl/data: nothing since") for line in said)
    assert not counts["lost"]
    assert_equals_log(outcome, tmp_path)


def test_a_burst_at_ten_times_the_pace_beside_a_stalled_viewer_loses_nothing(
    tmp_path, endpoint, messages
):
    """A subscriber that is stopped does not hold up poses for another, nor the run."""
    first_ns = messages[0].arrival_ns
    burst_s = (0.0, 8.0, 8.6, 20.0)
    come = []
    for message in messages:
        due_s = np.interp(at_s(messages, message), (0.0, 8.0, 14.0, 25.4), burst_s)
        come.append(message._replace(arrival_ns=first_ns + int(due_s * 1e9)))
    sender, router = robot(endpoint, come)
    arrived = []
    with stalled(endpoint), open_session([endpoint]) as session:
        subscriber = session.declare_subscriber(
            "0/sonar_graph/odometry/**", lambda _: arrived.append(time.monotonic())
        )
        outcome, counts = lived(tmp_path, endpoint, sender, [])
        subscriber.undeclare()
    router.close()
    assert not counts["lost"]
    assert sum(counts["received"].values()) == len(messages)
    assert len(arrived) > 500
    assert max(np.diff(arrived)) < 2.0
    assert_equals_log(outcome, tmp_path)


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
