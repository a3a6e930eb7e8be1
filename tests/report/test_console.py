from __future__ import annotations

import io
import re
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from sonar_graph.evaluation.results import Comparison, Score
from sonar_graph.evaluation.scored_instants import published_maps
from sonar_graph.report.console import published_counterpart, summary
from sonar_graph.report.landmark_table import landmark_table
from tests.synthetic import basin_comparison, with_failure, with_score


def printed(comparison: Comparison, width: int = 80, shown: Any = None) -> str:
    options: dict[str, Any] = {"file": io.StringIO(), "width": width, "color_system": None}
    console = Console(**options)
    console.print(summary(comparison) if shown is None else shown)
    return console.file.getvalue()


def test_the_terminal_shows_the_numbers_of_the_report_in_80_columns():
    comparison = basin_comparison(60)
    text = printed(comparison)
    keys = ("causal.ate_se2_m", "smoothed.ate_se2_m", "causal.yaw_rmse_rad", "causal.nees_yaw", "time.update_max_ms")
    for name, scores in comparison.scores.items():
        row = next(line for line in text.splitlines() if name in line)
        assert all(scores[key].text() in row for key in keys)
    assert "…" not in text
    assert "corrects the drift." not in text


def test_a_failure_is_told_with_its_reason_as_it_is_and_as_wide_as_the_terminal():
    reason = "no [bold] odometry covers the stamps of any of the sonar frames that the log holds"
    text = printed(with_failure(basin_comparison(60, truth=False), "isam2", reason), width=100)
    assert f"isam2 failed: {reason}" in text
    assert "causal" not in text, "without truth columns of errors are left out"
    assert "median" in text


@pytest.mark.parametrize(
    ("value", "interval", "shown"),
    [
        *((2.1, None, "2.10 ▲"), (1.9, None, "1.90"), (0.6, None, "0.600"), (0.4, None, "0.400 ▼")),
        *((1.3, (0.9, 1.1), "1.30 ▲"), (2.1, (0.9, 2.2), "2.10")),
    ],
)
def test_a_nees_is_marked_by_the_rule_of_the_legend_or_its_interval(value, interval, shown):
    score = Score(value, "1", "By hand.", interval, "inside")
    text = printed(with_score(basin_comparison(60), "isam2", "causal.nees_yaw", score))
    row = next(line for line in text.splitlines() if "isam2" in line)
    assert shown in row
    assert any(mark in shown for mark in "▲▼") or not re.search(f"{shown} [▲▼]", row)
    assert "▲ above 2 over-confident, ▼ below 0.5 over-cautious" in text


def test_what_is_lost_or_looks_wrong_in_a_log_is_told():
    sequence = basin_comparison(60).sequence
    notes = {
        "log.ending": "the file is cut off at byte 7",
        "log.damage": "bytes 3 to 5: chunk 2 is lost",
        "log.warnings": "imu: 1 angular rate stands out",
        "log.gaps": "dvl: no velocity 10.000 to 30.000 s after the start",
        "log.dropped": "dvl: 5 with values that are not finite",
        "log.noise": "dvl: 5 of 5 rows say no covariance",
    }
    text = printed(replace(basin_comparison(60), sequence=replace(sequence, detections=None, notes=notes)), 120)
    for line in (
        "Log: the file is cut off at byte 7",
        "Log: bytes 3 to 5: chunk 2 is lost",
        "Warning: imu: 1 angular rate stands out",
        "Warning: dvl: no velocity 10.000 to 30.000 s after the start",
        "Log, left out: dvl: 5 with values that are not finite",
        "without them nothing corrects the drift.",
    ):
        assert line in " ".join(text.split())
    assert "say no covariance" not in text


def test_the_published_table_has_a_counterpart_in_80_columns_with_the_numbers_of_the_report():
    comparison = basin_comparison(60)
    assert published_counterpart(comparison) is None
    same = replace(comparison, sequence=replace(comparison.sequence, true_landmarks=published_maps()[1]))
    text, table = printed(same, 80, published_counterpart(same)), landmark_table(same)
    assert "…" not in text
    assert table is not None
    for row in table.rows:
        assert all(cell.text in text for cell in row[1:])
    assert "dead-reckoning x" not in text


def test_odometry_far_from_its_reference_asks_for_inspect_and_nothing_else_does():
    comparison, hint = basin_comparison(60), "sonar-graph inspect LOG compares reference"
    blind = replace(comparison, sequence=replace(comparison.sequence, detections=None))
    cases = [
        (comparison, "dead-reckoning", 30.0, True),
        (comparison, "dead-reckoning", 4.0, False),
        (comparison, "isam2", 30.0, False),  # landmarks may be the cause
        (blind, "isam2", 30.0, True),
    ]
    for case, name, nees, is_told in cases:
        score = Score(nees, "1", "By hand.", better="inside")
        text = printed(with_score(case, name, "causal.nees_position", score), 200)
        assert (hint in text) == is_told, (name, nees)
    told = replace(blind, sequence=replace(blind.sequence, notes={"truth": "of the same sensors"}))
    text = printed(
        with_score(told, "isam2", "causal.nees_position", Score(30.0, "1", "By hand.", better="inside")), 200
    )
    assert "stamps, start or reference (of the same sensors) may be off" in text
