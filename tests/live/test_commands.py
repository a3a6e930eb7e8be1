"""``live`` and ``play`` as commands: mistakes in one line, and a rehearsal with a crash in it."""

import re
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from sonar_graph import read_log, write_log
from sonar_graph.cli import main
from sonar_graph.cli.live import unheard_lines
from sonar_graph.live import Prediction
from sonar_graph.live.outlets import Status
from sonar_graph.simulation import MissionOptions, simulate_mission
from tests.live.traffic import free_endpoint

pytest.importorskip("zenoh")
COMMAND = [sys.executable, "-m", "sonar_graph"]


def said(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code, capsys.readouterr().err


def test_a_record_that_is_there_is_not_written_over(tmp_path, capsys):
    (tmp_path / "record.mcap").write_bytes(b"precious")
    code, line = said(capsys, "live", "-o", tmp_path)
    assert code == 2
    assert "name another folder" in line
    assert (tmp_path / "record.mcap").read_bytes() == b"precious"


@pytest.mark.parametrize(
    ("option", "value", "told"),
    [
        ("--connect", "tcp/127.0.0.1:1", "tcp/127.0.0.1:1: zenoh cannot connect"),
        ("--connect", "ws://127.0.0.1:1", "ws://127.0.0.1:1: cannot connect"),
        ("--connect", "127.0.0.1", "127.0.0.1: no endpoint of zenoh"),
        ("--connect", "7447", "7447: no endpoint of zenoh"),
        ("--estimator", "isam3", "isam2"),
    ],
)
def test_a_mistake_is_named_before_anything_is_written(
    tmp_path, capsys, option, value, told
):
    if value.startswith("ws"):
        pytest.importorskip("websockets")
    code, line = said(capsys, "live", "-o", tmp_path / "dive", option, value)
    assert code == 2
    assert line.count("\n") == 1
    assert told in line
    assert not (tmp_path / "dive").exists()


def test_a_log_that_nobody_listens_to_is_not_played_away(tmp_path, capsys):
    log = tmp_path / "log.mcap"
    write_log(log, simulate_mission(MissionOptions(duration_s=6.0)))
    where = free_endpoint()
    code, line = said(capsys, "play", log, "--listen", where, "--wait", "0.2")
    assert code == 2
    assert f"start `sonar-graph live -o DIR --connect {where} --domain 0" in line
    assert "a longer --wait waits longer" in line


def test_topics_that_nobody_listens_to_are_named():
    heard, unheard = (SimpleNamespace(is_heard=is_heard) for is_heard in (True, False))
    topics = {"/imu": heard, "/depth": unheard, "/tf_static": unheard}
    assert unheard_lines(topics) == ["nobody listens to /depth"]
    assert unheard_lines({"/imu": heard}) == []


def test_the_status_has_sigmas_along_the_axes_of_the_world():
    turned = np.eye(4)
    turned[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    turned[:3, 3] = [3.0, -4.0, -1.0]
    covariance = np.diag([0.0, 0.0, 0.0, 0.25, 0.01, 0.0001])  # ahead, left, up
    status = Status(landmarks=4, detected_ns=9_500_000_000, estimates=20)
    for second in (2, 10):
        pose = (turned, covariance, np.eye(4), np.zeros(3))
        status.predicted(Prediction(second * 10**9, *pose))
    assert status.line(dropped=3, latency_ms=12.4, period_s=2.0) == (
        "8 s | x 3.00 ± 0.10, y -4.00 ± 0.50, z -1.00 ± 0.01 m | 1 poses/s, 10 estimates/s"
        " | 4 landmarks, last seen 0.5 s ago | 3 dropped | latency 12 ms"
    )
    # counts are since the line before; after the end of a log there is none
    for dropped, told in (
        (3, "0 poses/s, 0 estimates/s"),
        (3, ""),
        (4, "| 4 dropped |"),
    ):
        line = status.line(dropped=dropped, latency_ms=0.0, period_s=1.0)
        assert told in line
        assert bool(told) == bool(line)


@pytest.mark.slow
def test_a_live_run_equals_the_run_on_its_record(tmp_path):
    """With both ends as commands: play, live, SIGKILL, live, Ctrl-C, run."""
    log = tmp_path / "log.mcap"
    write_log(log, simulate_mission(MissionOptions(duration_s=40.0, frame_rate_hz=5.0)))
    where = free_endpoint()
    go = tmp_path / "go"
    player = subprocess.Popen([*COMMAND, "play", log, "--listen", where, "--after", go])
    time.sleep(3.0)
    first, second, again = (tmp_path / name for name in ("first", "second", "again"))
    try:
        killed = begun(first, where, "--calibration", str(log))
        live = begun(second, where, "--calibration", str(log))
        go.touch()
        time.sleep(12.0)
        killed.kill()
        killed.communicate()
        assert player.wait(120) == 0
        time.sleep(1.0)
        live.send_signal(signal.SIGINT)
        output, _ = live.communicate(timeout=120)
    finally:
        player.kill()
    assert live.returncode == 0, output
    assert re.search(r"\d s \| x .* ± .* landmarks, .* latency \d+ ms", output)
    assert "report.html" in output
    assert (second / "report.html").is_file()
    assert read_log(first / "record.mcap").duration_s > 5.0
    subprocess.run([*COMMAND, "run", second / "record.mcap", "-o", again], check=True)
    for name in ("causal.tum", "trajectory.tum", "landmarks.csv"):
        mine, theirs = (
            (folder / "runs/isam2" / name).read_bytes() for folder in (second, again)
        )
        assert mine == theirs
        assert mine.count(b"\n") > 5


def begun(folder, where, *options):
    command = [*COMMAND, "live", "-o", str(folder), "--connect", where, *options]
    live = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    for line in live.stdout:
        if "listening" in line:
            return live
    raise AssertionError("live ended before it listened")
