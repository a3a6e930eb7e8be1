"""The scores of a comparison as rows: metrics down, estimators across, in a fixed order with nothing left out."""

from __future__ import annotations

from dataclasses import dataclass

from sonar_graph.evaluation.results import Comparison, Score
from sonar_graph.evaluation.wording import ABSENT, consistency, display_unit, display_value

BLOCKS = {
    "causal": "Causal: what was known at each instant",
    "smoothed": "Smoothed: what is known at the end about each instant",
    "landmarks": "Landmarks",
    "detections": "Detections",
    "time": "Time",
    "memory": "Memory",
}
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
DIRECTIONS = {"lower": "lower is better", "higher": "higher is better", "inside": "1 is consistent", "none": ""}


@dataclass(frozen=True)
class Cell:
    """One value as shown, with what is to be said about it."""

    text: str
    note: str = ""


@dataclass(frozen=True)
class Row:
    """One metric for every run, in the order of the runs."""

    key: str
    label: str
    unit: str
    direction: str
    expected: str
    """Interval in which a consistent estimator's value lies; empty where there is none, or it differs by run."""
    protocols: dict[str, str]
    """How the number was got, with the runs for which it was got so: one entry where all agree."""
    cells: list[Cell]


def score_blocks(comparison: Comparison) -> dict[str, list[Row]]:
    """Every score of the comparison in rows, by title of their block; blocks without a score are left out."""
    keys = {key for scores in comparison.scores.values() for key in scores}
    blocks: dict[str, list[Row]] = {}
    for key in sorted(keys, key=_position):
        prefix = key.partition(".")[0]
        blocks.setdefault(BLOCKS.get(prefix, prefix), []).append(_row(comparison, key))
    return blocks


def _position(key: str) -> tuple[int, int, str]:
    prefix, _, metric = key.partition(".")
    return _index(list(BLOCKS), prefix), _index(list(LABELS), metric), key


def _index(names: list[str], name: str) -> int:
    return names.index(name) if name in names else len(names)


def _row(comparison: Comparison, key: str) -> Row:
    scores = {run.estimator: comparison.scores.get(run.estimator, {}).get(key) for run in comparison.runs}
    known = {name: score for name, score in scores.items() if score is not None}
    example = next(iter(known.values()))
    intervals = {_expected(score) for score in known.values()}
    expected = intervals.pop() if len(intervals) == 1 else ""
    return Row(
        key=key,
        label=LABELS.get(key.partition(".")[2], key),
        unit=display_unit(example),
        direction=DIRECTIONS[example.better],
        expected=expected,
        protocols=_protocols(known),
        cells=[_cell(score, own_interval=not expected) for score in scores.values()],
    )


def _expected(score: Score) -> str:
    if score.interval is None:
        return ""
    lowest, highest = (display_value(score, bound) for bound in score.interval)
    return f"expected {lowest} to {highest}"


def _cell(score: Score | None, own_interval: bool) -> Cell:
    if score is None:
        return Cell(ABSENT)
    interval = _expected(score) if own_interval else ""
    return Cell(display_value(score), "; ".join(filter(None, [consistency(score), interval])))


def _protocols(known: dict[str, Score]) -> dict[str, str]:
    runs: dict[str, list[str]] = {}
    for name, score in known.items():
        runs.setdefault(score.protocol, []).append(name)
    return {protocol: "" if len(runs) == 1 else ", ".join(names) for protocol, names in runs.items()}
