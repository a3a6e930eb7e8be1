"""From a log to reports and results."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

Run = Callable[..., int]


@pytest.fixture(scope="module")
def compared(run: Run, basin_content: bytes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ``compare`` writes for a log."""
    folder = tmp_path_factory.mktemp("compared")
    log = folder / "basin.mcap"
    log.write_bytes(basin_content)
    assert run("compare", log, "-o", folder / "out", "--rate-hz", "1") == 0
    return folder / "out"


def test_compare_writes_report_numbers_results_and_runs(compared: Path) -> None:
    for name in ("report.html", "comparison.json", "result.mcap", "result.foxglove.json", "result.rviz"):
        assert (compared / name).stat().st_size > 1000
    for estimator in ("isam2", "ekf-slam", "dead-reckoning"):
        there = {path.name for path in (compared / "runs" / estimator).iterdir()}
        assert {"trajectory.tum", "causal.tum", "landmarks.csv", "result.json"} <= there
        assert json.loads((compared / "runs" / estimator / "result.json").read_text())["status"] == "ok"


def test_compare_says_where_the_report_is_and_nothing_on_stderr(
    run: Run, basin: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("compare", basin, "-o", tmp_path, "--estimators", "dead-reckoning") == 0
    told = capsys.readouterr()
    assert f"Report: {tmp_path / 'report.html'}" in told.out.splitlines()
    assert "dead-reckoning" in told.out
    assert told.err == ""


def test_report_draws_the_same_page_again(run: Run, compared: Path) -> None:
    page = compared / "report.html"
    before = page.read_text()
    page.unlink()
    assert run("report", compared) == 0
    assert len(page.read_text()) == pytest.approx(len(before), rel=0.01)


def test_failed_run_is_written_and_reported_by_exit_code(
    run: Run, basin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from baselines.dead_reckoning import DeadReckoning

    def fail(*_: object) -> None:
        raise RuntimeError("the filter is tired")

    monkeypatch.setattr(DeadReckoning, "process", fail)
    assert run("compare", basin, "-o", tmp_path, "--estimators", "dead-reckoning,ekf-slam") == 1
    assert "the filter is tired" in capsys.readouterr().err
    assert "the filter is tired" in (tmp_path / "report.html").read_text()
    assert json.loads((tmp_path / "runs" / "dead-reckoning" / "result.json").read_text())["status"] == "failed"
    assert json.loads((tmp_path / "runs" / "ekf-slam" / "result.json").read_text())["status"] == "ok"


def test_run_writes_one_estimator(run: Run, basin: Path, tmp_path: Path) -> None:
    assert run("run", basin, "--estimator", "dead-reckoning", "-o", tmp_path) == 0
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["dead-reckoning"]


def test_calibration_file_goes_before_that_of_the_log_field_by_field(run: Run, basin: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved.toml"
    moved.write_text("[start]\nposition_m = [100.0, 0.0, -1.0]\n")
    arguments = ("run", basin, "--estimator", "dead-reckoning", "-o", tmp_path / "out")
    calibrations = []
    for more in ((), ("--calibration", moved)):
        assert run(*arguments, *more) == 0
        said = json.loads((tmp_path / "out" / "comparison.json").read_text())["sequence"]
        calibrations.append(said["calibration"])
    first = (tmp_path / "out" / "runs" / "dead-reckoning" / "causal.tum").read_text().splitlines()[1].split()
    assert float(first[1]) == pytest.approx(100, abs=3)
    of_log, changed = calibrations
    assert changed["start"].pop("position_m") != of_log["start"].pop("position_m")
    assert changed == of_log
    assert said["notes"]["log.calibration"] == f"from {moved}: start.position_m; else from the log"


def test_estimators_lists_every_setting(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    from sonar_graph.estimator import load_estimator

    assert run("estimators") == 0
    shown = capsys.readouterr().out
    for name in ("isam2", "invariant-ekf", "ekf-slam", "dead-reckoning"):
        assert name in shown
        for setting in load_estimator(name).Params.model_fields:
            assert setting in shown
