"""``run``, ``compare``, ``report``, ``demo`` and ``estimators``: from a log to reports and results."""

import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonar_graph.cli.compare import DEMO
from sonar_graph.estimator import load_estimator
from sonar_graph.evaluation import read_comparison
from sonar_graph.logs import read_log, write_log
from sonar_graph.logs.convert import with_truth
from sonar_graph.simulation import BasinOptions, cruise_speed
from sonar_graph.simulation.basin import FASTEST_M_S, PAPER_LAPS
from sonar_graph.testing import small_world


@pytest.mark.usefixtures("unrendered")
def test_compare_writes_what_it_names_and_report_draws_it_again(
    run, dive, tmp_path, reply
):
    told = reply(0, "compare", dive, "-o", tmp_path, "--rate-hz", "1")
    page = tmp_path / "report.html"
    assert f"Report: {page}" in told.out.splitlines()
    assert told.err == ""
    results = "comparison.json", "result.mcap", "result.foxglove.json", "result.rviz"
    for name in ("report.html", *results):
        assert (tmp_path / name).stat().st_size > 1000
    for estimator in ("isam2", "ekf-slam", "dead-reckoning"):
        assert estimator in told.out
        there = {path.name for path in (tmp_path / "runs" / estimator).iterdir()}
        assert {"trajectory.tum", "causal.tum", "landmarks.csv"} <= there
    before = page.read_text()
    page.unlink()
    assert run("report", tmp_path) == 0
    assert len(page.read_text()) == pytest.approx(len(before), rel=0.01)


def without_truth(tmp_path: Path) -> Path:
    log = tmp_path / "untrue.mcap"
    write_log(log, replace(small_world(), truth=None))
    return log


@pytest.mark.usefixtures("unrendered")
@pytest.mark.parametrize("world", ["enu", "ned"])
def test_a_table_of_true_poses_scores_as_the_log_that_has_them(
    run, dive, tmp_path, reply, world
):
    """A table in north, east, down with the key that a log configuration has for it is the same truth."""
    truth = small_world().truth
    x, y, z = truth.positions.T
    places = (x, y, z) if world == "enu" else (y, x, -z)
    table = tmp_path / "xyz.txt"
    rows = np.column_stack([truth.stamps_ns * 1e-9, *places])
    np.savetxt(table, rows, "%.9f", footer="1800000000 nan 1 2", comments="")
    (tmp_path / "world.toml").write_text(f'[truth]\nworld = "{world}"\n')
    given = ("--truth", table, "--log-config", tmp_path / "world.toml")
    once = ("--estimators", "dead-reckoning")
    assert run("compare", dive, "-o", tmp_path / "own", *once) == 0
    log = without_truth(tmp_path)
    told = reply(0, "compare", log, "-o", tmp_path / "given", *once, *given).out
    assert "left out: truth: 1 " in told
    own, same = (
        read_comparison(tmp_path / name).scores["dead-reckoning"]["causal.ate_se2_m"]
        for name in ("own", "given")
    )
    # stamps of microseconds and places of nanometres
    assert same.value == pytest.approx(own.value, rel=1e-5)


@pytest.mark.parametrize(
    ("header", "columns"),
    [
        ("# timestamp tx ty tz qx qy qz qw", range(8)),
        ("time,x,y,z", range(4)),
        ("seq,time,pos_x,pos_y,pos_z", [8, 0, 1, 2, 3]),
    ],
)
def test_columns_of_true_poses_are_known_by_their_usual_names(
    tmp_path, header, columns
):
    world = small_world()
    truth = world.truth
    seconds = truth.stamps_ns * 1e-9
    poses = (truth.positions, truth.quaternions_xyzw)
    values = np.column_stack([seconds, *poses, np.arange(len(truth))])[:, columns]
    table = tmp_path / "poses.txt"
    mark = "," if "," in header else " "
    np.savetxt(table, values, "%.9f", mark, header=header, comments="")
    found = with_truth(world, table).truth
    assert np.abs(found.stamps_ns - truth.stamps_ns).max() < 1000
    np.testing.assert_allclose(found.positions, truth.positions, atol=1e-8)
    assert found.has_orientation == ("qw" in header)


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ("0 1 2 3\n1 1 2 3\n", r"stamp_offset_s = 17\d+\.\d+` under \[truth\]"),
        ("0 1 2 3 4\n", "5 cells; expected `t x y z qx qy qz qw`"),
        ("t,east,north,up\n0,1,2,3\n", "no columns x, y, z .* `position = "),
        ("0 nan nan nan\n", "none of its 1 rows can be used"),
    ],
)
def test_a_table_of_true_poses_that_cannot_be_is_refused_with_the_way_out(
    tmp_path, reply, rows, told
):
    log = without_truth(tmp_path)
    table = tmp_path / "poses.txt"
    table.write_text(rows)
    out = tmp_path / "out"
    answer = reply(2, "compare", log, "-o", out, "--truth", table).err
    assert str(table) in answer
    assert re.search(told, answer)
    assert not out.exists()


@pytest.mark.usefixtures("unrendered")
def test_names_that_are_not_utf_8_are_read_and_escaped(run, dive, tmp_path, reply):
    odd = dive.rename(tmp_path / "odd\udcff.mcap")
    out = tmp_path / "out\udcff"
    assert run("compare", odd, "-o", out, "--estimators", "dead-reckoning") == 0
    assert "out\\udcff/report.html" in reply(0, "report", out).out


def test_a_signal_ends_a_comparison_in_one_line_and_leaves_nothing_of_it(
    basin, tmp_path
):
    out = tmp_path / "out"
    words = [sys.executable, "-m", "sonar_graph", "compare", basin, "-o", out]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([*words, "--rate-hz", "10"], **pipes) as process:
        while process.poll() is None and not (out / ".lock").exists():
            time.sleep(0.01)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (130, b"sonar-graph: interrupted\n")
    assert not out.exists()


@pytest.mark.usefixtures("unrendered")
def test_failed_run_is_written_and_reported_by_exit_code(
    dive, tmp_path, monkeypatch, reply
):
    def fail(*_):
        raise RuntimeError("the filter is tired")

    monkeypatch.setattr("baselines.dead_reckoning.DeadReckoning.process", fail)
    words = "--estimators", "dead-reckoning,ekf-slam"
    told = reply(1, "compare", dive, "-o", tmp_path, *words).out
    for text in (told, (tmp_path / "report.html").read_text()):
        assert "the filter is tired" in text
    runs = json.loads((tmp_path / "comparison.json").read_text())["runs"]
    found = {name: run["status"] for name, run in runs.items()}
    assert found == {"dead-reckoning": "failed", "ekf-slam": "ok"}


def written(out: Path) -> dict[str, Any]:
    """What a comparison has of its sequence."""
    return json.loads((out / "comparison.json").read_text())["sequence"]


def test_run_uses_the_given_calibration_field_by_field(run, dive, tmp_path):
    moved = tmp_path / "moved.toml"
    moved.write_text("[start]\nposition_m = [100.0, 0.0, -1.0]\n")
    out = tmp_path / "out"
    words = "--estimator", "dead-reckoning", "-o", out, "--calibration", moved
    # the truth contradicts the moved start
    assert run("run", dive, *words) == 3
    assert [path.name for path in (out / "runs").iterdir()] == ["dead-reckoning"]
    said = written(out)
    of_log = read_log(dive).calibration.model_dump(mode="json")
    of_log["start"]["position_m"] = [100.0, 0.0, -1.0]
    assert said["calibration"].items() <= of_log.items()
    told = f"from {moved}: start.position_m; else from the log"
    assert said["notes"]["log.calibration"] == told


@pytest.mark.usefixtures("unrendered")
def test_run_and_compare_begin_with_grave_findings(dive, tmp_path, reply):
    """Before what follows from it: refused rows, and a map that is far off."""
    log = tmp_path / "spoilt.mcap"
    out = tmp_path / "out"
    sequence = read_log(dive)
    degrees = np.degrees(sequence.imu.angular_velocity)
    imu = replace(sequence.imu, angular_velocity=degrees)
    write_log(log, replace(sequence, imu=imu))
    told = []
    for command, option in (("run", "--estimator"), ("compare", "--estimators")):
        told.append(reply(3, command, log, option, "ekf-slam", "-o", out).out)
    for text in (*told, (out / "report.html").read_text()):
        _, _, first = text.partition("Doubtful: ")
        assert first.startswith("gyro: unit: rates look 57 times too large")


def test_estimators_lists_every_setting(reply):
    shown = reply(0, "estimators").out
    for name in ("isam2", "invariant-ekf", "ekf-slam", "dead-reckoning"):
        settings = load_estimator(name).Params.model_fields
        assert all(word in shown for word in (name, *settings))


def test_start_and_end_cut_the_log(run, dive, tmp_path, reply):
    part = "--start", "5", "--end", "15"
    words = ("-o", tmp_path, "--estimator", "dead-reckoning", *part)
    # the start that the log states is another
    assert run("run", dive, *words) == 3
    notes = written(tmp_path)["notes"]
    assert notes["log.part"] == "5.000 s to 15.000 s of the recording"
    assert ", 10.0 s" in reply(3, "inspect", dive, *part).out


def test_a_damaged_log_is_refused_with_the_option_that_reads_it(
    run, dive, tmp_path, reply
):
    content = bytearray(dive.read_bytes())
    content[len(content) // 3] ^= 1
    dive.write_bytes(content)
    out = tmp_path / "out"
    words = ("run", dive, "-o", out, "--estimator", "dead-reckoning")
    assert re.search(r"is damaged: bytes .* is lost: .*--salvage", reply(2, *words).err)
    # the rest begins elsewhere than the log states
    assert run(*words, "--salvage") == 3
    assert "is lost" in written(out)["notes"]["log.damage"]


@pytest.mark.slow
def test_demo_goes_from_images_to_the_papers_table(tmp_path, monkeypatch, reply):
    short = DEMO | {"duration_s": 130.0, "laps": 1}
    monkeypatch.setattr("sonar_graph.cli.compare.DEMO", short)
    told = reply(0, "demo", "-o", tmp_path).out
    assert f"Report: {tmp_path / 'report.html'}" in told
    assert "2014 paper" in (tmp_path / "report.html").read_text("utf-8")
    sequence = read_log(tmp_path / "basin.mcap")
    assert sequence.detections is None, "the log holds images, not what is in them"
    comparison = read_comparison(tmp_path)
    assert comparison.recognition is not None
    assert comparison.recognition.frames > 240
    maps = {run.estimator: len(run.landmarks or ()) for run in comparison.runs}
    assert [name for name, n in maps.items() if n == 4] == [
        *("isam2", "ekf-slam", "invariant-ekf")
    ]


def test_demo_drives_the_three_laps_of_the_paper_with_images():
    options = BasinOptions.model_validate(DEMO)
    assert options.laps == PAPER_LAPS
    assert options.image is not None
    assert cruise_speed(options) < FASTEST_M_S


PAGE = Path(__file__).parents[2] / "docs" / "theory" / "datasets.md"


@pytest.mark.slow
@pytest.mark.recording
def test_the_documented_commands_convert_inspect_and_reckon(
    recordings, tmp_path, monkeypatch, reply
):
    """A pool run with a Doppler log of unknown axes: the commands and the file of the page, and no code."""
    section = PAGE.read_text(encoding="utf-8").split("## SONIA")[1]
    (toml,) = re.findall(r"```toml\n(.*?)```", section, re.DOTALL)
    (tmp_path / "sonia.toml").write_text(toml, encoding="utf-8")
    bag = "sonia_imu_dvl.bag"
    (tmp_path / bag).symlink_to(recordings / "bags" / bag)
    monkeypatch.chdir(tmp_path)
    # the gyros' bias puts what `inspect` and `run` give in doubt
    lines = re.findall(r"^    sonar-graph (.*)$", section, re.MULTILINE)
    _, told, _ = [
        reply(0 if line.startswith("convert") else 3, *line.split()).out
        for line in lines
    ]
    offset = r"DVL against IMU: time offset [+-]0\.\d+ ± 0\.\d+ s: no need to act"
    assert re.search(offset, told)
    path = np.loadtxt("sonia/runs/dead-reckoning/causal.tum")[:, 1:4]
    assert np.all(np.ptp(path, axis=0)[:2] < 5), "the vehicle stays in the pool"
    assert 35 < np.linalg.norm(np.diff(path, axis=0), axis=1).sum() < 50
