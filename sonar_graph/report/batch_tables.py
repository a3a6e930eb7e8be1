"""Tables of errors: how large they are, and how they differ from the reference's.

Tables beside those of errors: which runs ended, whether covariances hold, what runs cost, and each run.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from sonar_graph.batch import (
    ALL_LOGS,
    KINDS,
    Anees,
    Metric,
    PairedDifference,
    RecordedBatch,
    RecordedRun,
    SampleSummary,
    anees,
    failure_rate,
    holm,
    paired,
    standard_error,
    summarise,
)
from sonar_graph.evaluation import format_value
from sonar_graph.report.tables import Cell, Column, Table, absent, number, words
from sonar_graph.report.wording import between, quantile_text, supported, with_error

SIGNIFICANT = 0.05
QUANTILES = ("10_percent", "90_percent")
Tests = dict[tuple[str, str, str], tuple[PairedDifference, float]]
"""By column, log and contestant: the differences, and their p value corrected over the tests of the metric."""


def all_tests(batch: RecordedBatch, metrics: list[Metric]) -> Tests:
    """Every contestant against the reference in every error; a metric is a family of tests."""
    tests: Tests = {}
    for metric in metrics:
        if metric.is_error:
            tests |= _family(batch, metric)
    return tests


def _family(batch: RecordedBatch, metric: Metric) -> Tests:
    """Tests of one metric, with p values corrected over them; a filter's two estimates are one test."""
    found = {
        (key, log, contestant): batch.pairs(log, contestant, key)
        for key in metric.keys.values()
        for log in _compared_logs(batch)
        for contestant in batch.contestants
        if contestant != batch.reference and len(batch.pairs(log, contestant, key)[0])
    }
    same = {place: (*place[1:], own.tobytes(), other.tobytes()) for place, (own, other) in found.items()}
    first = {same[place]: place for place in reversed(found)}
    distinct = {numbers: _tested(batch, *first[numbers]) for numbers in dict.fromkeys(same.values())}
    corrected = dict(zip(distinct, holm(np.array([test.p_value for test in distinct.values()])).tolist(), strict=True))
    return {place: (distinct[same[place]], corrected[same[place]]) for place in found}


def _tested(batch: RecordedBatch, key: str, log: str, contestant: str) -> PairedDifference:
    """The test of one column; of all logs together one difference a seed."""
    cases = batch.cases(log, contestant, key) if log == ALL_LOGS else None
    return paired(*batch.pairs(log, contestant, key), cases)


def _compared_logs(batch: RecordedBatch) -> list[str]:
    return [*batch.logs, ALL_LOGS] if len(batch.logs) > 1 else batch.logs


def accuracy_table(batch: RecordedBatch, metric: Metric) -> Table:
    """One metric: mean with standard error, median, and the range of the middle 80 % of runs."""
    columns = [*_first_columns(), Column("runs", "Runs")]
    for over, key in metric.keys.items():
        columns += [
            Column(f"{key}_mean", "Mean ± s.e.", over, ("", "se")),
            Column(f"{key}_median", "Median", over),
            Column(key, "10 to 90 %", over, QUANTILES),
        ]
    rows = [
        [
            *_first_cells(log, contestant),
            _runs_cell(batch, log, contestant),
            *(cell for key in metric.keys.values() for cell in _summary_cells(batch, log, contestant, key, metric)),
        ]
        for log in batch.logs
        for contestant in batch.contestants
        if batch.group(log, contestant)
    ]
    return Table(f"accuracy-{_slug(metric)}", _title(metric), _unit_note(metric), columns, rows)


def difference_table(batch: RecordedBatch, metric: Metric, tests: Tests) -> Table:
    """One metric: differences to the reference on the same log and seed."""
    columns = [*_first_columns(), Column("pairs", "Compared", parts=("", "of"))]
    for over, key in metric.keys.items():
        columns += [
            Column(f"{key}_difference", "Mean difference", over, ("", "low", "high")),
            Column(f"{key}_median_difference", "Median", over),
            Column(f"{key}_smaller", "Smaller in", over),
            Column(f"{key}_p_holm", "p (Holm)", over, ("", "single")),
        ]
    rows = [
        [
            *_first_cells(log, contestant),
            _pairs_cell(metric, tests, log, contestant),
            *(
                cell
                for key in metric.keys.values()
                for cell in _difference_cells(tests.get((key, log, contestant)), metric)
            ),
        ]
        for log in _compared_logs(batch)
        for contestant in batch.contestants
        if any((key, log, contestant) in tests for key in metric.keys.values())
    ]
    caption = f"{_unit_note(metric)} Contestant minus {batch.reference}: negative means smaller than the reference."
    return Table(f"difference-{_slug(metric)}", _title(metric), caption, columns, rows)


def group_anchor(log_index: int, contestant_index: int) -> str:
    """Where on the page the single runs of a group are listed."""
    return f"runs-{log_index}-{contestant_index}"


def _first_columns() -> list[Column]:
    return [Column("log", "Log", is_number=False), Column("contestant", "Estimator", is_number=False)]


def _first_cells(log: str, contestant: str) -> list[Cell]:
    return [words(log), words(contestant)]


def _runs_cell(batch: RecordedBatch, log: str, contestant: str) -> Cell:
    group = batch.group(log, contestant)
    failed = sum(not run.ended for run in group)
    anchor = group_anchor(batch.logs.index(log), batch.contestants.index(contestant))
    return Cell(str(len(group)), (len(group),), note=f"{failed} failed" if failed else "", link=f"#{anchor}")


def _summary_cells(batch: RecordedBatch, log: str, contestant: str, key: str, metric: Metric) -> list[Cell]:
    if not batch.is_asked(log, contestant, key):
        return [absent(2), absent(), absent(2)]
    return summary_cells(summarise(batch.values(log, contestant, key)), metric.factor)


def summary_cells(told: SampleSummary, factor: float = 1.0) -> list[Cell]:
    """Mean with its error, median, and range of the middle 80 %."""
    note = f"{told.without} of {told.runs} without a value" if told.without else ""
    mean = number(
        told.mean, with_error(told.mean * factor, told.standard_error * factor), told.standard_error, note=note
    )
    median = number(told.median, quantile_text(told.median * factor, told.median_error * factor))
    if told.runs == 1:
        return [mean, median, absent(2)]
    low = quantile_text(told.low * factor, told.low_error * factor)
    high = quantile_text(told.high * factor, told.high_error * factor)
    return [mean, median, number(told.low, f"{low} to {high}", told.high)]


def _pairs_cell(metric: Metric, tests: Tests, log: str, contestant: str) -> Cell:
    found = [tests[place][0] for key in metric.keys.values() if (place := (key, log, contestant)) in tests]
    without = max(test.without for test in found)
    return Cell(found[0].counted, (found[0].pairs, found[0].each), note=f"{without} without a value" if without else "")


def _difference_cells(found: tuple[PairedDifference, float] | None, metric: Metric) -> list[Cell]:
    if found is None:
        return [absent(3), absent(), absent(), absent(2)]
    test, p_holm = found
    factor, error = metric.factor, test.rounding_error * metric.factor
    low, high = test.interval
    note = "" if math.isnan(low) else between(low * factor, high * factor, error)
    return [
        number(test.mean, supported(test.mean * factor, error), low, high, note=note),
        number(test.median, _median(test.median * factor, test.median_error * factor)),
        Cell(f"{test.smaller} of {test.counted}", (test.smaller,)),
        number(p_holm, p_text(p_holm), test.p_value),
    ]


def _median(value: float, error: float) -> str:
    if math.isinf(value):
        return "worse: no value" if value > 0 else "better: reference has no value"
    return quantile_text(value, error)


def p_text(p_value: float) -> str:
    """A p value with two digits, down to one in a thousand; with more where it would else look like 5 % and is not."""
    if p_value < 1e-3:
        return "< 0.001"
    if not p_value < 0.995:
        return "1.0"
    texts = [f"{p_value:.{digits}g}" for digits in range(2, 18)]
    return next(text for text in texts if np.sign(float(text) - SIGNIFICANT) == np.sign(p_value - SIGNIFICANT))


def _title(metric: Metric) -> str:
    unit = f", {metric.shown_unit}" if metric.shown_unit else ""
    return f"{metric.label}{unit}"


def _unit_note(metric: Metric) -> str:
    converted = " Degrees here, radians in the CSV." if metric.unit == "rad" else ""
    return f"{metric.protocol}{' ' + metric.direction.capitalize() + '.' if metric.direction else ''}{converted}"


def _slug(metric: Metric) -> str:
    prefix = metric.keys[""].partition(".")[0] if "" in metric.keys else ""
    return "-".join(filter(None, [prefix, metric.name])).replace("_", "-").replace(".", "-")


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
