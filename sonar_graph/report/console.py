"""The comparison in the terminal: the few numbers that are read first."""

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table
from rich.text import Text

from sonar_graph.evaluation import (
    RAW,
    Comparison,
    headline_metric,
    label,
    score_keys,
)
from sonar_graph.report import sentences
from sonar_graph.report.given_map import located_line
from sonar_graph.table import ABSENT

# columns after the two position errors; those that no run has are left out
COLUMNS = {
    "causal.yaw_rmse_rad": "yaw",
    "causal.nees_position": "NEES\npos.",
    "causal.nees_yaw": "NEES\nyaw",
    "time.update_median_ms": "med.",
    "time.update_max_ms": "max",
}
MARKS = {"over-confident": " ▲", "over-cautious": " ▼"}
NEES_LEGEND = (
    "NEES: 1 fits; ▲ over-confident, ▼ over-cautious: outside what 95 % of consistent runs with as many independent "
    "samples have (the report has the bands)"
)
RECOGNISED_BEFORE = (
    "Sonar images: the detections are those that recognise put into the log; for pictures and outcomes in the report "
    "let compare recognise anew: --rule virtual-evidence"
)
# one draw of a chi-square of three, over three, is above 5.4 once in a thousand times
FAR_FROM_FITTING = 6.0
# advice, with the log's note on its own reference: where that lacks something, inspect cannot mend it
ASK_INSPECT = (
    "NEES far above 1 without landmarks at work: stamps, start or reference{} may be off; "
    "sonar-graph inspect LOG compares reference, clocks and sensors"
)


def error_columns(comparison: Comparison) -> dict[str, str]:
    """Headings of the position errors by score: the aligned ones first, in every log, then the causal one as it is."""
    metric = headline_metric(comparison)
    if metric is None:
        return {}
    kind = "raw" if metric == RAW else "aligned"
    return {
        f"causal.{metric}": f"causal\n{kind}",
        f"smoothed.{metric}": f"smoothed\n{kind}",
        # with a known map this is the one that counts
        f"causal.{RAW}": "causal\nraw",
    }


def summary(comparison: Comparison) -> Group:
    """The runs in rows with position error (causal and smoothed), yaw error, NEES and time; below, why runs failed.

    The numbers are those of the report. NEES is 1 for a consistent estimator and marked by `Score.verdict`. The lines
    below the table may be as wide as the terminal.
    """
    errors = error_columns(comparison)
    # columns that no run has would take the place of names
    present = score_keys(comparison)
    mapped = {} if errors else {"landmarks.se2_m": "map"}
    columns = {
        key: heading
        for key, heading in {**errors, **mapped, **COLUMNS}.items()
        if key in present
    }
    table = Table(
        box=SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column("estimator", no_wrap=True)
    for key, heading in columns.items():
        one = next(own[key] for own in comparison.scores.values() if key in own)
        head = f"{heading}\n({one.shown_unit})" if one.shown_unit else heading
        table.add_column(Text(head), justify="right", no_wrap=True)
    for name in (run.estimator for run in comparison.runs):
        cells = []
        for key in columns:
            score = comparison.score_of(name, key)
            shown = score.text() + MARKS.get(score.verdict, "") if score else ABSENT
            cells.append(Text(shown))
        table.add_row(Text(name), *cells)
    # the title of a table would be folded to the table's width
    title = Text(comparison.sequence.name, style="bold")
    return Group(title, table, Text("\n".join(["", *_lines_below(comparison)])))


def _lines_below(comparison: Comparison) -> list[str]:
    """Failures, warnings about the log, warnings of runs that may follow from these, and the meaning of the columns."""
    lines = sentences.failed_lines(comparison)
    # first, as the numbers above are not to be relied on
    doubtful = sentences.doubtful_lines(comparison)
    lines += doubtful
    lines += [
        line
        for line in sentences.doubt_lines(comparison.sequence.notes)
        if line not in doubtful
    ]
    lines += sentences.lost_runs(comparison)
    if located := located_line(comparison):
        scored = comparison.environment["scored instants"]
        lines.append(f"{located} Scored: {scored}")
    for told in (
        sentences.refusal_lines,
        sentences.withheld_lines,
        sentences.doubt_of_identities,
        sentences.outliers,
        sentences.shared_error,
        sentences.alike_errors,
        sentences.nameless_landmarks,
    ):
        lines += told(comparison)
    if comparison.recognition is not None:
        found = comparison.recognition
        named = found.naming(comparison.sequence.true_landmarks)
        warned = [f"{n} x {reason}" for reason, n in found.warned().items()]
        lines += [f"Sonar images: {line}" for line in [*named, *warned]]
    elif "detections.model" in comparison.sequence.notes:
        lines.append(RECOGNISED_BEFORE)
    has_detections = bool(comparison.sequence.detections)
    if not has_detections:
        lines.append(sentences.no_detections(comparison))
    metric = headline_metric(comparison)
    present = score_keys(comparison)
    if metric is None:
        if "landmarks.se2_m" in present:
            lines.append(f"map: {label('se2_m', comparison)}")
        why = comparison.environment["scored instants"].removeprefix("none: ")
        return [*lines, f"No position errors: {why}"]
    if metric != RAW:
        lines.append(f"aligned: {label(metric, comparison)}")
    if f"causal.{RAW}" in present:
        lines.append(f"raw: {label(RAW, comparison)}")
    lines.append(NEES_LEGEND)
    for name in (run.estimator for run in comparison.runs):
        score = comparison.score_of(name, "causal.nees_position")
        is_odometry = name == "dead-reckoning" or not has_detections
        if is_odometry and score is not None and score.value > FAR_FROM_FITTING:
            # odometry alone contradicts the reference: no estimator is to blame
            known = comparison.sequence.notes.get("truth")
            return [
                *lines,
                ASK_INSPECT.format(f" (the log says: {known})" if known else ""),
            ]
    return lines
