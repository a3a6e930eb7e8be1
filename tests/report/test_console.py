from __future__ import annotations

import io
import re
from dataclasses import replace
from typing import Any

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


def test_a_failure_is_told_with_its_reason_as_it_is():
    text = printed(with_failure(basin_comparison(60), "ekf-slam", "no [bold] odometry"))
    assert "ekf-slam failed: no [bold] odometry" in text


def test_without_truth_columns_of_errors_are_left_out():
    text = printed(basin_comparison(60, truth=False))
    assert "causal" not in text
    assert "median" in text


def test_a_nees_is_marked_by_the_rule_of_the_legend():
    comparison = basin_comparison(60)
    for value, shown in ((2.1, "2.10 ▲"), (1.9, "1.90"), (0.6, "0.600"), (0.4, "0.400 ▼")):
        score = Score(value, "1", "By hand.", better="inside")
        row = next(
            line
            for line in printed(with_score(comparison, "isam2", "causal.nees_yaw", score)).splitlines()
            if "isam2" in line
        )
        assert shown in row
        assert any(mark in shown for mark in "▲▼") or not re.search(f"{shown} [▲▼]", row)
    assert "▲ above 2 over-confident, ▼ below 0.5 over-cautious" in printed(comparison)


def test_a_log_without_detections_is_told():
    comparison = basin_comparison(60)
    assert "corrects the drift." not in printed(comparison)
    blind = replace(comparison, sequence=replace(comparison.sequence, detections=None))
    assert "without them nothing corrects the drift." in " ".join(printed(blind, 120).split())


def test_a_log_that_is_cut_off_or_has_holes_is_told():
    comparison = basin_comparison(60)
    notes = {"log.ending": "the file is cut off at byte 7", "log.damage": "bytes 3 to 5: chunk 2 is lost"}
    cut = replace(comparison, sequence=replace(comparison.sequence, notes=notes))
    assert "Log: the file is cut off at byte 7" in printed(cut)
    assert "Log: bytes 3 to 5: chunk 2 is lost" in printed(cut)


def test_what_looks_wrong_in_a_log_is_told_and_so_is_what_was_left_out_of_it():
    comparison = basin_comparison(60)
    notes = {
        "log.warnings": "imu: 1 angular rate stands out",
        "log.gaps": "dvl: no velocity 10.000 to 30.000 s after the start",
        "log.dropped": "dvl: 5 with values that are not finite",
        "log.noise": "dvl: 5 of 5 rows say no covariance",
    }
    text = printed(replace(comparison, sequence=replace(comparison.sequence, notes=notes)))
    assert "Warning: imu: 1 angular rate stands out" in text
    assert "Warning: dvl: no velocity 10.000 to 30.000 s after the start" in text
    assert "Log, left out: dvl: 5 with values that are not finite" in text
    assert "say no covariance" not in text


def test_a_nees_outside_its_interval_is_marked():
    comparison = basin_comparison(60)
    score = Score(3.0, "1", "By hand.", (0.9, 1.1), "inside")
    assert "3 ▲" not in printed(comparison)
    assert "3 ▲" in printed(with_score(comparison, "isam2", "causal.nees_position", score))


def test_what_stands_below_the_table_may_be_as_wide_as_the_terminal():
    reason = "no odometry covers the stamps of any of the sonar frames that the log holds"
    text = printed(with_failure(basin_comparison(60, truth=False), "isam2", reason), width=100)
    assert f"isam2 failed: {reason}" in text


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
