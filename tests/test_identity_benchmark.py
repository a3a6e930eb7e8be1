"""The tables of late, wrong and falsified identities: what they make of runs that fail, and of runs that are kept."""

from __future__ import annotations

import importlib
import itertools
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
FIGURES = ("smoothed", "causal", "landmarks", "time_s")


@pytest.fixture
def table(monkeypatch) -> Any:
    for folder in (BENCHMARKS, BENCHMARKS / "validation"):
        monkeypatch.syspath_prepend(str(folder))
    return importlib.import_module("identities")


@pytest.fixture
def kept(table) -> Any:
    return importlib.import_module("identity_runs")


@pytest.fixture
def falsified(table) -> Any:
    return importlib.import_module("mrclam_wrong_ids")


def judged(kept: Any, error_m: float | None) -> Any:
    nees = {"position": 1.0, "yaw": 2.0}
    if error_m is None:
        return kept.Judged("failed", "of a sudden", None, None, None, 0, None, None, None)
    return kept.Judged("ok", "", error_m, error_m, error_m, 4, nees, nees, nees)


def runs(kept: Any, *errors_m: float | None) -> list[dict[str, Any]]:
    """Dead reckoning off by 0.3 m, and one policy."""
    return [{"dead reckoning": judged(kept, 0.3), "iSAM2, robust": judged(kept, error)} for error in errors_m]


def test_a_mean_over_survivors_is_not_given(table, kept):
    clean = runs(kept, 0.1, 0.1, 0.1, 0.1)
    found = table.summarise(runs(kept, 0.1, None, 0.1, 2.0), clean, "iSAM2, robust")
    assert (found["failed"], found["lost"]) == (0.25, 0.5)
    for figure in ("smoothed_m", "causal_m", "landmarks_m", "above_clean_m", "loss", "final_nees_yaw"):
        assert np.isnan(found[figure])
    whole = table.summarise(runs(kept, 0.1, 0.3, 0.1, 2.0), clean, "iSAM2, robust")
    assert (whole["failed"], whole["lost"], whole["final_nees_yaw"]) == (0.0, 0.25, 2.0)
    assert whole["smoothed_m"] == pytest.approx(0.625)


def test_differences_are_paired_by_seed(table, kept):
    clean, wrong = runs(kept, 0.1, 0.2, 0.3), runs(kept, 0.15, 0.25, 0.35)
    found = table.summarise(wrong, clean, "iSAM2, robust")
    assert found["above_clean_m"] == pytest.approx(0.05)
    assert found["above_clean_error_m"] == pytest.approx(0, abs=1e-12)
    assert found["smoothed_error_m"] == pytest.approx(0.1 / np.sqrt(3))
    assert found["loss"] == pytest.approx(0.25)


def test_the_best_policy_is_the_one_whose_worst_case_is_best(table, kept, monkeypatch):
    monkeypatch.setattr(table, "ESTIMATORS", dict.fromkeys(("EKF-SLAM", "iSAM2, a", "iSAM2, b")))

    def told(ekf: float, a: float, b: float, b_map: float = 0.0) -> dict[str, dict[str, float]]:
        losses = {"EKF-SLAM": (ekf, ekf), "iSAM2, a": (a, 0.0), "iSAM2, b": (b, b_map)}
        return {
            name: {"loss": track, "landmark_loss": map_, "more_missing": 0.0} for name, (track, map_) in losses.items()
        }

    figures = {kept.Case(0.1): told(0, 0.1, 0.2), kept.Case(0.1, 5.0): told(0, 0.9, 0.3), kept.Case(0.2): told(0, 0, 9)}
    assert table.best_policy(figures) == ("iSAM2, b", 0.3)
    figures[kept.Case(0.1, 5.0, 5.0)] = told(0, 0.1, 0.1, b_map=0.8)
    assert table.best_policy(figures) == ("iSAM2, b", 0.8)
    figures[kept.Case(0.1, 20.0)] = told(0, 0.1, float("nan"))
    assert table.best_policy(figures) == ("iSAM2, a", 0.9)
    figures[kept.Case(0.1)]["iSAM2, a"]["more_missing"] = 0.01
    assert table.best_policy(figures)[1] == np.inf


def test_landmarks_that_are_not_found_are_no_gain(table, kept):
    """One of four landmarks, the best: a small error of the map, and three missing."""
    clean, wrong = runs(kept, 0.1, 0.2), runs(kept, 0.1, 0.05)
    wrong[1]["iSAM2, robust"] = replace(wrong[1]["iSAM2, robust"], landmarks=1)
    found = table.summarise(wrong, clean, "iSAM2, robust")
    assert (found["missing"], found["more_missing"]) == (1.5, 1.5)
    assert found["landmark_loss"] < 0


def collected(falsified: Any, failing: dict[tuple[str, float], int]) -> dict[str, Any]:
    """Every run as good as any other, but for some robots' of some estimators and shares."""
    cases = list(itertools.product(falsified.ROBOTS, (0.0, falsified.SHARE), falsified.ESTIMATORS))
    runs = [
        dict.fromkeys(FIGURES, np.nan if robot <= failing.get((label, share), 0) else 0.1)
        for robot, share, label in cases
    ]
    return falsified.collect(cases, runs)


def test_a_mean_of_recorded_runs_is_over_all_robots_and_none_that_counts_is_lost(falsified):
    share = falsified.SHARE
    figures = collected(falsified, {("isam2 robust", share): 1})
    assert figures["isam2_robust_smoothed_wrong"] is None
    assert figures["isam2_robust_growth"] is None
    assert (figures["isam2_robust_lost_wrong"], figures["isam2_robust_lost_right"]) == (1, 0)
    assert figures["isam2_gate_smoothed_wrong"] == pytest.approx(0.1)
    for failing, is_met in (
        ({}, True),
        ({("isam2 robust", share): 2, ("ekf-slam", 0.0): 5}, True),
        ({("isam2 gnc", share): 1}, False),
        ({("isam2 gate", 0.0): 1}, False),
    ):
        assert falsified.is_met(collected(falsified, failing)) is is_met


def test_what_is_kept_belongs_to_one_run_of_one_version(table, kept, tmp_path, monkeypatch):
    job = kept.Job(kept.Case(0.1), 3, True, tmp_path)
    name = "iSAM2, robust"
    others = [replace(job, seed=4), replace(job, is_quick=False), replace(job, case=kept.Case(0.1, 5.0))]
    files = [other.file(name) for other in (job, *others)] + [job.file("iSAM2, gate")]
    monkeypatch.setattr(kept, "source_version", lambda: "another")
    assert len({*files, job.file(name)}) == 6
    assert replace(job, folder=None).file(name) is None


@pytest.mark.slow
def test_a_command_that_is_given_again_gives_the_same_table_from_what_is_kept(tmp_path):
    script = BENCHMARKS / "validation" / "identities.py"
    asked = [sys.executable, str(script), "--quick", "--seeds", "2", "--kinds", "0", "--workers", "2"]
    asked += ["--keep", str(tmp_path)]
    first = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
    files = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    lost = sorted(files)[0]
    lost.unlink()
    assert subprocess.run(asked, capture_output=True, text=True, check=True).stdout == first
    assert {path for path in tmp_path.iterdir() if path.stat().st_mtime_ns != files[path]} == {lost}
    assert json.loads(first.splitlines()[-1])["runs"] == 2
