"""The table of falsified identities on real data: what it makes of runs that fail."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
NOTHING = dict.fromkeys(("smoothed", "causal", "landmarks", "time_s"), float("nan"))


@pytest.fixture
def table(monkeypatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCHMARKS / "validation"))
    return importlib.import_module("mrclam_wrong_ids")


def collected(table: Any, failing: dict[tuple[str, float], int]) -> dict[str, Any]:
    """Every run as good as any other, but for some robots' of some estimators and shares."""
    cases = [
        (robot, share, label) for robot in table.ROBOTS for share in (0.0, table.SHARE) for label in table.ESTIMATORS
    ]
    good = dict.fromkeys(("smoothed", "causal", "landmarks", "time_s"), 0.1)
    runs = [NOTHING if robot <= failing.get((label, share), 0) else good for robot, share, label in cases]
    return table.collect(cases, runs)


def test_a_mean_is_over_all_robots_or_not_given(table):
    figures = collected(table, {("isam2 robust", table.SHARE): 1})
    assert figures["isam2_robust_smoothed_wrong"] is None
    assert figures["isam2_robust_growth"] is None
    assert (figures["isam2_robust_lost_wrong"], figures["isam2_robust_lost_right"]) == (1, 0)
    assert figures["isam2_gate_smoothed_wrong"] == pytest.approx(0.1)


def test_it_passes_only_where_no_run_that_counts_is_lost(table):
    share = table.SHARE
    assert table.is_met(collected(table, {}))
    assert table.is_met(collected(table, {("isam2 robust", share): 2, ("ekf-slam", 0.0): 5}))
    assert not table.is_met(collected(table, {("isam2 gnc", share): 1}))
    assert not table.is_met(collected(table, {("isam2 gate", 0.0): 1}))
