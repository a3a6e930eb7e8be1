"""Tables beside those of errors: which runs ended, whether covariances hold, what runs cost, and each run."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from sonar_graph.batch.accuracy import group_anchor, summary_cells
from sonar_graph.batch.catalogue import KINDS, Metric
from sonar_graph.batch.recorded import RecordedBatch, RecordedRun
from sonar_graph.batch.rounding import supported
from sonar_graph.batch.statistics import Anees, anees, failure_rate, standard_error, summarise
from sonar_graph.batch.tables import Cell, Column, Table, absent, number, words
from sonar_graph.evaluation.wording import format_value

FAILURES = ("failed", "timeout", "memory", "killed")
COSTS = {
    "update_p50_ms": "Update, median (ms)",
    "update_p99_ms": "Update, 99 % (ms)",
    "wall_s": "Whole run (s)",
    "cpu_s": "Processor (s)",
    "peak_memory_mb": "Memory, rise (MB)",
}
LATEST = "_end"
"""Of columns with the normalised squared error at a run's last instant."""
SAME_AT_END = 0.1
"""Relative difference of a smoothed ANEES to the causal one up to which it is the same evidence, shown once."""
SAME_EVIDENCE = (
    "At the last instant a smoothed estimate has seen no more than the causal one: it is no second evidence, and is "
    "shown only where it differs by more than a tenth."
)


@dataclass(frozen=True)
class RunList:
    """The runs of one contestant on one log."""

    log: str
    anchor: str
    table: Table


def failure_table(batch: RecordedBatch) -> Table:
    """How many runs of each contestant came to an end, and how others ended."""
    columns = [
        Column("log", "Log", is_number=False),
        Column("contestant", "Estimator", is_number=False),
        Column("runs", "Runs"),
        Column("ended", "Ended well"),
        *(Column(status, status.capitalize(), "Did not") for status in FAILURES),
        Column("failure_rate", "Failure rate", parts=("", "low", "high")),
        *([Column("not_run", "Not run")] if batch.missing else []),
    ]
    missing = Counter((run.log, run.contestant) for run in batch.missing)
    rows = []
    for log in batch.logs:
        for contestant in batch.contestants:
            group, not_run = batch.group(log, contestant), missing[log, contestant]
            if group or not_run:
                row = [words(log), words(contestant), *_ending_cells(batch, log, contestant, group)]
                rows.append([*row, *([Cell(str(not_run), (not_run,))] if batch.missing else [])])
    return Table("failures", "Runs that ended", "Rates with 95 % intervals (Wilson).", columns, rows)


def _ending_cells(batch: RecordedBatch, log: str, contestant: str, group: list[RecordedRun]) -> list[Cell]:
    """How the runs of a group ended; runs that were not done are not in it."""
    if not group:
        return [Cell("0", (0,)), *[absent()] * (1 + len(FAILURES)), absent(3)]
    counts = Counter(run.status for run in group)
    rate = failure_rate(len(group) - counts["ok"], len(group))
    anchor = group_anchor(batch.logs.index(log), batch.contestants.index(contestant))
    share = f"{100 * rate.share:.0f} %"
    return [
        Cell(str(len(group)), (len(group),), link=f"#{anchor}"),
        Cell(str(counts["ok"]), (counts["ok"],)),
        *(Cell(str(counts[status]), (counts[status],)) for status in FAILURES),
        Cell(share, (rate.share, rate.low, rate.high), f"{100 * rate.low:.0f} to {100 * rate.high:.0f} %"),
    ]


def anees_of(batch: RecordedBatch, log: str, contestant: str, kind: str, what: str) -> Anees | None:
    """The ANEES of a group over its runs, at the last instant of each; None where no covariance is reported."""
    key = f"{kind}.nees_{what}{LATEST}"
    if not batch.is_asked(log, contestant, key):
        return None
    group = batch.group(log, contestant)
    dofs = {run.values[f"{key}_dof"] for run in group if f"{key}_dof" in run.values}
    return anees(batch.values(log, contestant, key), dofs.pop() if len(dofs) == 1 else math.nan)


def is_evidence(told: dict[str, Anees | None], kind: str) -> bool:
    """Whether an estimate's ANEES at the last instant says what that of the causal one has not said.

    Nothing comes after the last instant, so a smoothed estimate rests on the same measurements there as the causal one,
    and is the same but for a solver's last steps. It differs where a decision is made anew, as on doubtful identities.
    """
    causal, own = told["causal"], told[kind]
    if own is None or causal is None or kind == "causal":
        return own is not None
    if math.isnan(causal.mean):
        return not math.isnan(own.mean)
    return not abs(own.mean - causal.mean) <= SAME_AT_END * causal.mean


def consistency_table(batch: RecordedBatch) -> Table:
    """ANEES at the last instant of runs that are independent, with its band; a smoothed one only where it differs."""
    columns = [
        Column("log", "Log", is_number=False),
        Column("contestant", "Estimator", is_number=False),
        Column("of", "Of", is_number=False),
        Column("runs", "Runs"),
        Column("band", "Expected", parts=("low", "high")),
    ]
    told = {
        (log, contestant, what): {kind: anees_of(batch, log, contestant, kind, what) for kind in KINDS}
        for log in batch.logs
        for contestant in batch.contestants
        for what in ("position", "yaw")
    }
    kinds = [kind for kind in KINDS if any(is_evidence(one, kind) for one in told.values())]
    for kind in kinds:
        over = kind.capitalize()
        columns += [Column(f"{kind}_anees", "ANEES", over), Column(f"{kind}_verdict", "Reading", over, is_number=False)]
    rows = [_consistency_row(batch, place, one, kinds) for place, one in told.items() if any(one.values())]
    caption = (
        "Average over runs of the normalised squared error at the last instant, per degree of freedom: 1 is "
        "consistent, above is over-confident. Expected: the chi-square band that holds 95 % of consistent estimators. "
        f"{SAME_EVIDENCE}"
    )
    return Table("consistency", "ANEES of independent runs", caption, columns, rows)


def _consistency_row(
    batch: RecordedBatch, place: tuple[str, str, str], told: dict[str, Anees | None], kinds: list[str]
) -> list[Cell]:
    log, contestant, what = place
    known = [one for one in told.values() if one is not None]
    low, high = known[0].band
    failed = sum(not run.ended for run in batch.group(log, contestant))
    cells = [words(log), words(contestant), words(what)]
    cells.append(Cell(str(known[0].runs), (known[0].runs,), f"{failed} failed: no average" if failed else ""))
    cells.append(number(low, f"{low:.2f} to {high:.2f}", high))
    for kind in kinds:
        one, values = told[kind], batch.values(log, contestant, f"{kind}.nees_{what}{LATEST}")
        if one is None:
            cells += [absent(), words("")]
        elif not is_evidence(told, kind):
            cells += [number(one.mean, "as causal"), words("")]
        else:
            cells += [number(one.mean, supported(one.mean, standard_error(values))), words(one.verdict)]
    return cells


def cost_table(batch: RecordedBatch) -> Table:
    """Time and memory: median and the range of the middle 80 % of runs."""
    columns = [Column("log", "Log", is_number=False), Column("contestant", "Estimator", is_number=False)]
    known = [key for key in COSTS if any(key in run.values for run in batch.runs)]
    for key in known:
        columns += [
            Column(f"{key}_median", "Median", COSTS[key]),
            Column(key, "10 to 90 %", COSTS[key], ("10_percent", "90_percent")),
        ]
    rows = [
        [
            words(log),
            words(contestant),
            *(cell for key in known for cell in summary_cells(summarise(batch.values(log, contestant, key)))[1:]),
        ]
        for log in batch.logs
        for contestant in batch.contestants
        if batch.group(log, contestant)
    ]
    caption = "Measured while other runs went on beside them: compare within this batch only."
    return Table("costs", "Time and memory", caption, columns, rows)


def run_lists(batch: RecordedBatch, metrics: list[Metric]) -> list[RunList]:
    """Every run, by log and contestant."""
    return [
        RunList(log, group_anchor(i, j), _run_table(f"{log}, {contestant}", f"runs-{i}-{j}", group, metrics))
        for i, log in enumerate(batch.logs)
        for j, contestant in enumerate(batch.contestants)
        if (group := batch.group(log, contestant))
    ]


def _run_table(title: str, name: str, group: list[RecordedRun], metrics: list[Metric]) -> Table:
    shown = [(metric, over, key) for metric in metrics for over, key in metric.keys.items() if _has(group, key)]
    columns = [
        Column("seed", "Seed"),
        Column("key", "Run", is_number=False),
        Column("status", "Status", is_number=False),
        *(Column(key, f"{metric.label}{_in(metric)}", over) for metric, over, key in shown),
    ]
    rows = [[*_identity_cells(run), *(_score_cell(run, metric, key) for metric, _, key in shown)] for run in group]
    return Table(name, title, "", columns, rows)


def _identity_cells(run: RecordedRun) -> list[Cell]:
    seed = number(math.nan if run.seed is None else run.seed, str(run.seed))
    return [seed, words(run.key, run.log_file), Cell(run.status, (run.status,), note=run.reason)]


def _score_cell(run: RecordedRun, metric: Metric, key: str) -> Cell:
    value = run.value(key)
    return absent() if math.isinf(value) else number(value, format_value(value * metric.factor))


def _has(group: list[RecordedRun], key: str) -> bool:
    return any(math.isfinite(run.value(key)) for run in group)


def _in(metric: Metric) -> str:
    return f" ({metric.shown_unit})" if metric.shown_unit else ""
