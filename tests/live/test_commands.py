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


def test_a_router_that_is_not_there_is_named_before_anything_is_written(
    tmp_path, capsys
):
    code, line = said(
        capsys, "live", "-o", tmp_path / "dive", "--connect", "tcp/127.0.0.1:1"
    )
    assert code == 2
    assert "tcp/127.0.0.1:1" in line
    assert not (tmp_path / "dive").exists()


@pytest.mark.parametrize("where", ["127.0.0.1", "7447"])
def test_an_endpoint_that_is_none_is_named(tmp_path, capsys, where):
    code, line = said(capsys, "live", "-o", tmp_path / "dive", "--connect", where)
    assert code == 2
    assert line.count("\n") == 1
    assert f"{where}: no endpoint of zenoh" in line


def test_an_estimator_that_does_not_exist_is_refused_at_once(tmp_path, capsys):
    code, line = said(capsys, "live", "-o", tmp_path / "dive", "--estimator", "isam3")
    assert code == 2
    assert "isam2" in line
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
    heard = SimpleNamespace(is_heard=True)
    unheard = SimpleNamespace(is_heard=False)
    topics = {"/imu": heard, "/depth": unheard, "/tf_static": unheard}
    assert unheard_lines(topics) == ["nobody listens to /depth"]
    assert unheard_lines({"/imu": heard}) == []


def test_the_status_has_sigmas_along_the_axes_of_the_world():
    turned = np.eye(4)
    turned[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    turned[:3, 3] = [3.0, -4.0, -1.0]
    covariance = np.diag([0.0, 0.0, 0.0, 0.25, 0.01, 0.0001])  # ahead, left, up
    status = Status(landmarks=4, detected_ns=9_500_000_000, estimates=20)
    for stamp_ns in (2_000_000_000, 10_000_000_000):
        status.predicted(
            Prediction(stamp_ns, turned, covariance, np.eye(4), np.zeros(3))
        )
    line = status.line(dropped=3, latency_ms=12.4, period_s=2.0)
    assert line == (
        "8 s | x 3.00 ± 0.10, y -4.00 ± 0.50, z -1.00 ± 0.01 m | 1 poses/s, 10 estimates/s"
        " | 4 landmarks, last seen 0.5 s ago | 3 dropped | latency 12 ms"
    )
    again = status.line(dropped=3, latency_ms=0.0, period_s=1.0)
    assert "0 poses/s, 0 estimates/s" in again  # counts are since the line before
    # after the end of a log
    assert status.line(dropped=3, latency_ms=0.0, period_s=1.0) == ""
    assert "| 4 dropped |" in status.line(dropped=4, latency_ms=0.0, period_s=1.0)


@pytest.mark.slow
def test_a_live_run_equals_the_run_on_its_record(
    tmp_path,
):
    """With both ends as commands: play, live, SIGKILL, live, Ctrl-C, run."""
    world = simulate_mission(MissionOptions(duration_s=40.0, frame_rate_hz=5.0))
    write_log(tmp_path / "log.mcap", world)
    where = free_endpoint()
    go = tmp_path / "go"
    player = subprocess.Popen(
        [*COMMAND, "play", tmp_path / "log.mcap", "--listen", where, "--after", go]
    )
    time.sleep(3.0)
    options = ("--calibration", str(tmp_path / "log.mcap"))
    try:
        killed = begun(tmp_path / "first", where, *options)
        live = begun(tmp_path / "second", where, *options)
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
    assert (tmp_path / "second" / "report.html").is_file()
    assert read_log(tmp_path / "first" / "record.mcap").duration_s > 5.0
    done = subprocess.run(
        [*COMMAND, "run", tmp_path / "second/record.mcap", "-o", tmp_path / "again"],
        check=False,
    )
    assert done.returncode == 0
    for name in ("causal.tum", "trajectory.tum", "landmarks.csv"):
        mine, theirs = (
            (tmp_path / folder / "runs/isam2" / name).read_bytes()
            for folder in ("second", "again")
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
