"""The comparison in the terminal: the few numbers that are read first, and the counterpart of a published table."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table
from rich.text import Text

from sonar_graph.evaluation import ABSENT, LABELS, Comparison, RunResult, repeats_published
from sonar_graph.report.landmark_table import PAPER, LandmarkTable, landmark_table
from sonar_graph.report.warnings import (
    doubt_lines,
    doubt_of_identities,
    nameless_landmarks,
    refusal_lines,
    withheld_lines,
)
from sonar_graph.report.wording import (
    TOLERATED_FACTOR,
    consistency,
    display_unit,
    display_value,
    failed_runs,
    has_detections,
    headline_metric,
    lost_runs,
    no_detections,
    score_of,
)

COLUMNS = {
    "causal.yaw_rmse_rad": "yaw",
    "causal.nees_position": "NEES\npos.",
    "causal.nees_yaw": "NEES\nyaw",
    "time.update_median_ms": "median",
    "time.update_max_ms": "longest",
}
"""Columns after the two position errors; those that no run has are left out."""
NEES_LEGEND = (
    f"NEES: 1 fits; ▲ above {TOLERATED_FACTOR:g} over-confident, ▼ below {1 / TOLERATED_FACTOR:g} over-cautious"
)
RECOGNISED_BEFORE = (
    "Sonar images: the detections are those that recognise put into the log; for pictures and outcomes in the report "
    "let compare recognise anew: --rule virtual-evidence"
)
PUBLISHED_LEGEND = (
    f"{PAPER}: landmarks from its Table I, of which the errors are, and last minus first position from section III. "
    "It measured in a real basin and did not know the true path.\nAll else: this run."
)
FAR_FROM_FITTING = 6.0
"""One draw of a chi-square of three, over three, is above 5.4 once in a thousand times."""
ASK_INSPECT = (
    "NEES far above 1 without landmarks at work: stamps, start or reference may be off; "
    "sonar-graph inspect LOG compares reference, clocks and sensors"
)


def summary(comparison: Comparison) -> Group:
    """The runs in rows with position error (causal and smoothed), yaw error, NEES and time; below, why runs failed.

    What is below may be as wide as the terminal. The same numbers as in the report. NEES is 1 for a consistent
    estimator, and marked where `consistency` says more.
    """
    columns = _columns(comparison)
    title = Text(comparison.sequence.name, style="bold")
    table = Table(title=title, title_justify="left")
    table.box, table.padding = SIMPLE_HEAD, (0, 1, 0, 0)
    table.add_column("estimator", no_wrap=True)
    for key, heading in columns.items():
        table.add_column(Text(_heading(comparison, key, heading)), justify="right", no_wrap=True)
    for run in comparison.runs:
        table.add_row(Text(run.estimator), *(_cell(comparison, run, key) for key in columns))
    return Group(table, _notes(comparison))


def published_counterpart(comparison: Comparison) -> Group | None:
    """Table I of the 2014 paper and its counterpart; None where the run does not repeat that experiment.

    The same numbers as in the report.
    """
    found = landmark_table(comparison) if repeats_published(comparison.sequence) else None
    if found is None:
        return None
    return Group(_positions(found), _totals(found), Text(PUBLISHED_LEGEND))


def _positions(found: LandmarkTable) -> Table:
    """As in the paper: landmarks across; x and y of the truth and of each column down."""
    table = _plain_table(
        "Landmarks: position in metres (estimate minus truth)",
        ["", *(row.label.removesuffix(", x") for row in found.positions[::2])],
    )
    for axis in (0, 1):
        table.add_row(f"true {'xy'[axis]}", *(row.true for row in found.positions[axis::2]))
    for column, name in enumerate(found.columns):
        if found.has_map(column):
            for axis in (0, 1):
                table.add_row(f"{name} {'xy'[axis]}", *(row.cells[column] for row in found.positions[axis::2]))
    return table


def _totals(found: LandmarkTable) -> Table:
    """What they come to: a column a quantity."""
    table = _plain_table("", ["", "RMS", "RMS after\nSE(2)", "last minus\nfirst x", "last minus\nfirst y"])
    table.add_row("true", *(row.true for row in found.totals))
    for column, name in enumerate(found.columns):
        table.add_row(name, *(row.cells[column] for row in found.totals))
    return table


def _plain_table(title: str, headings: list[str]) -> Table:
    table = Table(title=Text(title, style="bold") if title else None, title_justify="left")
    table.box, table.padding = SIMPLE_HEAD, 0
    for number, heading in enumerate(headings):
        table.add_column(heading, no_wrap=True, justify="right" if number else "left")
    return table


def _columns(comparison: Comparison) -> dict[str, str]:
    metric = headline_metric(comparison)
    errors = {f"causal.{metric}": "causal", f"smoothed.{metric}": "smoothed"} if metric else {}
    present = {key for scores in comparison.scores.values() for key in scores}
    return {key: heading for key, heading in {**errors, **COLUMNS}.items() if key in present}


def _heading(comparison: Comparison, key: str, heading: str) -> str:
    units = {display_unit(scores[key]) for scores in comparison.scores.values() if key in scores}
    unit = next(iter(units), "")
    return f"{heading}\n({unit})" if unit else heading


def _notes(comparison: Comparison) -> Text:
    lines = [f"{run.estimator} failed: {run.reason}" for run in failed_runs(comparison)]
    lines += lost_runs(comparison)
    lines += refusal_lines(comparison)
    lines += withheld_lines(comparison)
    lines += doubt_of_identities(comparison)
    lines += nameless_landmarks(comparison)
    lines += doubt_lines(comparison.sequence.notes)
    lines += _recognition(comparison)
    if not has_detections(comparison):
        lines.append(no_detections(comparison))
    metric = headline_metric(comparison)
    if metric is None:
        lines.append("No position errors: the report says why.")
    else:
        lines.append(f"causal, smoothed: {LABELS[metric]}")
        lines.append(NEES_LEGEND)
        lines += _reference_doubt(comparison)
    return Text("\n".join(lines))


def _reference_doubt(comparison: Comparison) -> list[str]:
    """Where odometry alone contradicts the reference, no estimator is to blame."""
    for run in comparison.runs:
        score = score_of(comparison, run.estimator, "causal.nees_position")
        is_odometry = run.estimator == "dead-reckoning" or not has_detections(comparison)
        if is_odometry and score is not None and score.value > FAR_FROM_FITTING:
            return [ASK_INSPECT]
    return []


def _recognition(comparison: Comparison) -> list[str]:
    """What was recognised in the log's images, or how to see it where that was done before."""
    found = comparison.recognition
    if found is None:
        return [RECOGNISED_BEFORE] if "detections.model" in comparison.sequence.notes else []
    warned = [f"{n} x {reason}" for reason, n in found.warned().items()]
    return [f"Sonar images: {line}" for line in [*found.naming(comparison.sequence.true_landmarks), *warned]]


def _cell(comparison: Comparison, run: RunResult, key: str) -> Text:
    score = score_of(comparison, run.estimator, key)
    if score is None:
        return Text(ABSENT)
    mark = {"over-confident": " ▲", "over-cautious": " ▼"}.get(consistency(score), "")
    return Text(display_value(score) + mark)
