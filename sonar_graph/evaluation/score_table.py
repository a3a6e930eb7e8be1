"""The scores of a comparison as a table: metrics down, estimators across, in a fixed order with nothing left out."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sonar_graph.evaluation.digits import ABSENT
from sonar_graph.evaluation.tables import Cell, Column, Table, words

if TYPE_CHECKING:
    from sonar_graph.evaluation.results import Comparison, Score

LABELS = {
    "ate_raw_m": "Position error, not aligned (ATE, RMS)",
    "ate_yaw_m": "Position error, yaw and translation aligned (ATE, RMS)",
    "ate_se2_m": "Horizontal position error, SE(2) aligned (ATE, RMS)",
    "ate_se3_m": "Position error, SE(3) aligned (ATE, RMS)",
    "rpe_1s_m": "Drift over 1 s (RPE, RMS)",
    "rpe_10s_m": "Drift over 10 s (RPE, RMS)",
    "rpe_1s_rad": "Yaw drift over 1 s (RPE, RMS)",
    "rpe_10s_rad": "Yaw drift over 10 s (RPE, RMS)",
    "yaw_rmse_rad": "Yaw error (RMS)",
    "return_error_m": "Return error: last position",
    "nees_position": "Position NEES per degree of freedom",
    "nees_yaw": "Yaw NEES",
    "raw_m": "Horizontal landmark error, not aligned (RMS)",
    "se2_m": "Horizontal landmark error, SE(2) aligned (RMS)",
    "count": "Landmarks mapped",
    "nees": "Landmark NEES per degree of freedom",
    "used": "Detections used",
    "refused": "Detections refused",
    "unnamed": "Detections of no landmark that is probable enough",
    "nis": "NIS per degree of freedom",
    "update_median_ms": "Per update, median",
    "update_p99_ms": "Per update, 99th percentile",
    "update_max_ms": "Per update, longest",
    "total_s": "Whole run",
    "real_time_factor": "Real-time factor: log duration over run time",
    "peak_mb": "Peak memory added by the run",
}
BLOCKS = {
    "causal": "Causal: what was known at each instant",
    "smoothed": "Smoothed: what is known at the end about each instant",
    "landmarks": "Landmarks",
    "detections": "Detections",
    "time": "Time",
    "memory": "Memory",
}
DIRECTIONS = {"lower": "lower is better", "higher": "higher is better", "inside": "1 is consistent", "none": ""}


def score_keys(comparison: Comparison) -> list[str]:
    """All keys of scores in the order of the table: known ones as in `BLOCKS` and `LABELS`, then others by name."""

    def place(names: list[str], name: str) -> int:
        return names.index(name) if name in names else len(names)

    keys = {key for scores in comparison.scores.values() for key in scores}
    blocks, metrics = list(BLOCKS), list(LABELS)
    return sorted(
        keys, key=lambda key: (place(blocks, key.partition(".")[0]), place(metrics, key.partition(".")[2]), key)
    )


def run_columns(comparison: Comparison) -> list[Column]:
    """A column for each run, in its colour, with a word where it failed."""
    return [
        Column(run.estimator, run.estimator, run=index, warning="failed" if run.status == "failed" else "")
        for index, run in enumerate(comparison.runs)
    ]


def score_table(comparison: Comparison) -> Table:
    """Every score of every run; a dash where a run lacks one.

    Beside the numbers stands what a covariance is judged to be, and at the end of the row the interval in which the
    value of a consistent estimator lies, where it is the same for all runs.
    """
    columns = [Column("metric", "Metric", is_number=False), Column("unit", "Unit", is_number=False)]
    columns += [*run_columns(comparison), Column("reading", "Reading", is_number=False)]
    rows: list[list[Cell]] = []
    sections: dict[int, str] = {}
    for key in score_keys(comparison):
        prefix, _, metric = key.partition(".")
        block = BLOCKS.get(prefix, prefix)
        if block not in sections.values():
            sections[len(rows)] = block
        scores = [comparison.scores.get(run.estimator, {}).get(key) for run in comparison.runs]
        known = [score for score in scores if score is not None]
        intervals = {_expected(score) for score in known}
        common = intervals.pop() if len(intervals) == 1 else ""
        cells = []
        for score in scores:
            if score is None:
                cells.append(Cell(ABSENT))
                continue
            own = "" if common else _expected(score)
            cells.append(Cell(score.text(), (score.value,), note="; ".join(filter(None, [score.verdict, own]))))
        direction = DIRECTIONS[known[0].better]
        reading = f"{direction}; {common}" if direction and common else direction + common
        rows.append([words(LABELS.get(metric, key)), words(known[0].shown_unit), *cells, words(reading)])
    return Table("scores", "Scores by metric and estimator", "", columns, rows, sections)


def _expected(score: Score) -> str:
    """The interval of a consistent estimator's value, in words."""
    if score.interval is None:
        return ""
    lowest, highest = map(score.text, score.interval)
    return f"expected {lowest} to {highest}"
