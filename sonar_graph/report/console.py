"""The comparison in the terminal: the few numbers that are read first."""

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table
from rich.text import Text

from sonar_graph.evaluation import (
    RAW,
    SCORES,
    Comparison,
    headline_metric,
    label,
    score_keys,
    scores_across,
)
from sonar_graph.report import sentences
from sonar_graph.report.given_map import located_line

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
    "samples have (the page of compare or report has the bands)"
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
    headings = error_columns(comparison) or {"landmarks.se2_m": "map"}
    columns, rows = scores_across(comparison, headings | COLUMNS, before_unit="\n")
    table = Table(
        box=SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column("estimator", no_wrap=True)
    for column in columns:
        table.add_column(Text(column.heading), justify="right", no_wrap=True)
    for run, cells in zip(comparison.runs, rows, strict=True):
        shown = (Text(cell.text + MARKS.get(cell.note, "")) for cell in cells)
        table.add_row(Text(run.estimator), *shown)
    # the title of a table would be folded to the table's width
    title = Text(comparison.sequence.name, style="bold")
    return Group(title, table, Text("\n".join(["", *_lines_below(comparison)])))


def _lines_below(comparison: Comparison) -> list[str]:
    """Failures, warnings about the log, warnings of runs that may follow from these, and the meaning of the columns."""
    environment = comparison.environment
    sequence = comparison.sequence
    doubtful = sentences.doubtful_lines(comparison)
    noted = sentences.doubt_lines(sequence.notes)
    # doubtful ones first, as the numbers above are not to be relied on
    lines = [*sentences.failed_lines(comparison), *doubtful]
    lines += [line for line in noted if line not in doubtful]
    lines += sentences.lost_runs(comparison)
    if located := located_line(comparison):
        lines.append(f"{located} Scored: {environment['scored instants']}")
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
    if (found := comparison.recognition) is not None:
        warned = [f"{n} x {reason}" for reason, n in found.warned().items()]
        told_of_images = [*found.naming(sequence.true_landmarks), *warned]
        lines += [f"Sonar images: {line}" for line in told_of_images]
    elif "detections.model" in sequence.notes:
        lines.append(RECOGNISED_BEFORE)
    if not sequence.detections:
        lines.append(sentences.no_detections(comparison))
    metric = headline_metric(comparison)
    present = score_keys(comparison)
    if metric is None:
        if "landmarks.se2_m" in present:
            lines.append(f"map: {label(SCORES['landmarks.se2_m'].label, comparison)}")
        why = environment["scored instants"].removeprefix("none: ")
        return [*lines, *sentences.ends(comparison), f"No position errors: {why}"]
    if metric != RAW:
        lines.append(f"aligned: {label(SCORES[f'causal.{metric}'].label, comparison)}")
    if f"causal.{RAW}" in present:
        lines.append(f"raw: {label(SCORES[f'causal.{RAW}'].label, comparison)}")
    lines.append(NEES_LEGEND)
    # odometry alone that contradicts the reference: no estimator is to blame
    far = [
        run.estimator
        for run in comparison.runs
        if (score := comparison.score_of(run.estimator, "causal.nees_position"))
        and score.value > FAR_FROM_FITTING
    ]
    if far and (not sequence.detections or "dead-reckoning" in far):
        known = sequence.notes.get("truth")
        lines.append(ASK_INSPECT.format(f" (the log says: {known})" if known else ""))
    return lines
