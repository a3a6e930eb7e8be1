"""The scores of a comparison as tables: all of them, metrics down, estimators across; and those that are read first."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from sonar_graph.table import ABSENT, Cell, Column, Table, absent, number, words

if TYPE_CHECKING:
    from sonar_graph.evaluation.results import Comparison, Score
    from sonar_graph.sequence import Sequence

FITTED = "truth.world"
"""Note of a sequence whose truth was brought into the world of the estimates."""
HEIGHTS = "truth.height"
"""Note of a sequence whose truth has positions without heights."""
NO_HEIGHTS = (
    "its heights are all alike, so not measured: errors and NEES are of x and y"
)
NOT_ALIGNED = "not aligned"
RAW = "ate_raw_m"
AS_PUBLISHED = "as published"

TRAJECTORY_LABELS = {
    "ate_raw_m": "Position error, not aligned (ATE, RMS)",
    "ate_yaw_m": "Position error, yaw and translation aligned (ATE, RMS)",
    "ate_se2_m": "Horizontal position error, SE(2) aligned (ATE, RMS)",
    "rpe_10s_m": "Drift over 10 s (RPE, RMS)",
    "rpe_10s_rad": "Yaw drift over 10 s (RPE, RMS)",
    "yaw_rmse_rad": "Yaw error (RMS)",
    "nees_position": "Position NEES per degree of freedom",
    "nees_yaw": "Yaw NEES",
}
SCORES = {
    "causal": TRAJECTORY_LABELS
    | {"own_map_m": "Horizontal position error on its own map as it was then (RMS)"},
    "smoothed": TRAJECTORY_LABELS,
    "landmarks": {
        "raw_m": "Horizontal landmark error, not aligned (RMS)",
        "se2_m": "Horizontal landmark error, SE(2) aligned (RMS)",
        "count": "Landmarks mapped",
        "nees": "Landmark NEES per degree of freedom",
    },
    "detections": {
        "used": "Detections used",
        "refused": "Detections refused",
        "unnamed": "Detections of no landmark that is probable enough",
        "nis": "NIS per degree of freedom",
    },
    "time": {
        "update_median_ms": "Per update, median",
        "update_p99_ms": "Per update, 99th percentile",
        "update_max_ms": "Per update, longest",
        "total_s": "Whole run",
        "real_time_factor": "Real-time factor: log duration over run time",
    },
    "memory": {"peak_mb": "Peak memory added by the run"},
}
"""Label of every score, by the parts of its key before and after the point."""
SCORE_KEYS = tuple(
    f"{block}.{name}" for block, labels in SCORES.items() for name in labels
)
"""Every key that a score can have, in the order of tables."""
LABELS = {name: label for block in SCORES.values() for name, label in block.items()}
BLOCKS = {
    "causal": "Causal: what was known at each instant",
    "smoothed": "Smoothed: what is known at the end about each instant",
    "landmarks": "Landmarks",
    "detections": "Detections",
    "time": "Time",
    "memory": "Memory",
}
HEADLINES = {
    "ate_se2_m": "RMS after SE(2) alignment",
    "ate_yaw_m": "RMS after alignment of yaw and translation",
    "ate_raw_m": "RMS, not aligned",
}
"""Position errors that can stand in the headline, best suited first, with their names there."""
# scores of the compact table after the errors of positions and map, most important first
COMPACT = {
    "causal.nees_position": "Position NEES",
    "causal.nees_yaw": "Yaw NEES",
    "causal.yaw_rmse_rad": "Yaw error",
    "detections.nis": "NIS",
    "detections.used": "Detections used",
    "time.update_median_ms": "Update, median",
    "time.update_max_ms": "Update, longest",
}
# scores that the compact table shows beside the name of the estimator
MOST_SCORES = 5
DIRECTIONS = {
    "lower": "lower is better",
    "higher": "higher is better",
    "inside": "1 is consistent",
    "none": "",
}


def unaligned(sequence: Sequence) -> str:
    """Words for scores and pictures in which no run is aligned; the truth may have been, once for all runs."""
    is_fitted = FITTED in sequence.notes
    return "the truth brought into the estimates' world" if is_fitted else NOT_ALIGNED


def label(metric: str, comparison: Comparison, labels: dict[str, str] = LABELS) -> str:
    """Label of a score in a comparison, with what was brought where; ``labels``: or `HEADLINES`."""
    return labels[metric].replace(NOT_ALIGNED, unaligned(comparison.sequence))


def score_keys(comparison: Comparison) -> list[str]:
    """All keys of scores in the order of the table: those of `SCORE_KEYS`, then others by name."""
    found = set[str]().union(*comparison.scores.values())
    return [
        *(key for key in SCORE_KEYS if key in found),
        *sorted(found.difference(SCORE_KEYS)),
    ]


def headline_metric(comparison: Comparison) -> str | None:
    """The position error that most runs have, without its ``causal.`` or ``smoothed.``; None where no run has one."""

    # runs may lack different errors: the headline is about the one that most have
    def count(metric: str) -> int:
        return len(list(filter(None, scores_of(comparison, f"causal.{metric}"))))

    best = max(HEADLINES, key=count)
    return best if count(best) else None


def scores_of(comparison: Comparison, key: str) -> list[Score | None]:
    """One score of each run; None where a run lacks it, or it is not a number."""
    return [comparison.score_of(run.estimator, key) for run in comparison.runs]


def compact_table(comparison: Comparison, *, aligned: bool = True) -> Table:
    """The scores that are read first: runs down, errors and NEES across, at most `MOST_SCORES` of them.

    Scores that no run has are left out. Beside a NEES stands what the covariance is judged to be, where it misfits;
    beside a filter with the settings of its publication, that it is "as published".

    Parameters
    ----------
    comparison
        Runs with their scores.
    aligned
        Position and map errors after alignment to the truth, as in `aligned_to_truth`, instead of before.
    """
    metric = headline_metric(comparison)
    # only this error has a version before alignment
    if metric and not aligned:
        metric = RAW
    world = "aligned" if aligned and metric != RAW else unaligned(comparison.sequence)
    headings = {
        f"causal.{metric}": f"Position error, {world}",
        f"smoothed.{metric}": f"Smoothed, {world}",
    }
    headings[f"landmarks.{'se2_m' if aligned else 'raw_m'}"] = f"Map error, {world}"
    columns, cells = scores_across(comparison, headings | COMPACT, most=MOST_SCORES)
    rows = []
    for index, run in enumerate(comparison.runs):
        # whoever compares must see that a filter lacks what its neighbours have
        note = AS_PUBLISHED if run.is_as_published else ""
        name = replace(words(run.estimator, run=index), note=note)
        rows.append([name, *cells[index]])
    caption = (
        f"Position error: {label(metric, comparison, HEADLINES)}, causal. NEES 1: covariances fit."
        if metric
        else ""
    )
    columns = [Column("estimator", "Estimator", is_number=False), *columns]
    return Table("compact", "Scores at a glance", caption, columns, rows)


def scores_across(
    comparison: Comparison,
    headings: dict[str, str],
    *,
    most: int | None = None,
    before_unit: str = " ",
) -> tuple[list[Column], list[list[Cell]]]:
    """Columns of the first scores with these headings that some run has, and below them the cells of each run.

    The note of a cell is the verdict on a covariance that misfits.
    """
    # a column of dashes would take the place of one with numbers
    known = {key: found for key in headings if any(found := scores_of(comparison, key))}
    columns: list[Column] = []
    rows: list[list[Cell]] = [[] for _ in comparison.runs]
    for key in list(known)[:most]:
        unit = next(filter(None, known[key])).shown_unit
        heading = headings[key] + (f"{before_unit}({unit})" if unit else "")
        columns.append(Column(key, heading))
        for row, score in zip(rows, known[key], strict=True):
            if score is None:
                row.append(absent())
                continue
            verdict = "" if score.verdict == "consistent" else score.verdict
            row.append(number(score.value, score.text(), note=verdict))
    return columns, rows


def run_columns(comparison: Comparison) -> list[Column]:
    """A column for each run, in its colour, with a word where it failed."""
    return [
        Column(
            run.estimator,
            run.estimator,
            run=index,
            warning="failed" if run.status == "failed" else "",
        )
        for index, run in enumerate(comparison.runs)
    ]


def score_table(comparison: Comparison) -> Table:
    """Every score of every run; a dash where a run lacks one.

    Beside the numbers stands what a covariance is judged to be, and at the end of the row the interval in which the
    value of a consistent estimator lies, where it is the same for all runs.
    """
    columns = [
        Column("metric", "Metric", is_number=False),
        Column("unit", "Unit", is_number=False),
    ]
    columns += [*run_columns(comparison), Column("reading", "Reading", is_number=False)]
    rows: list[list[Cell]] = []
    sections: dict[int, str] = {}
    for key in score_keys(comparison):
        prefix, _, metric = key.partition(".")
        block = BLOCKS.get(prefix, prefix)
        if block not in sections.values():
            sections[len(rows)] = block
        scores = [
            comparison.scores.get(run.estimator, {}).get(key) for run in comparison.runs
        ]
        known = [score for score in scores if score is not None]
        # one interval for all stands in the last column, others beside their values
        intervals = {_expected(score) for score in known}
        common = intervals.pop() if len(intervals) == 1 else ""
        name = label(metric, comparison) if metric in LABELS else key
        row = [words(name), words(known[0].shown_unit)]
        for score in scores:
            if score is None:
                row.append(Cell(ABSENT))
                continue
            own = "" if common else _expected(score)
            note = "; ".join(filter(None, [score.verdict, own]))
            row.append(Cell(score.text(), (score.value,), note))
        reading = filter(None, [DIRECTIONS[known[0].better], common])
        rows.append([*row, words("; ".join(reading))])
    title = "Scores by metric and estimator"
    return Table("scores", title, "", columns, rows, sections)


def _expected(score: Score) -> str:
    """The interval of a consistent estimator's value, in words."""
    if score.interval is None:
        return ""
    lowest, highest = map(score.text, score.interval)
    return f"expected {lowest} to {highest}"
