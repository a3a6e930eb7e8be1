"""Tables of a batch: failures, errors, differences to the reference, consistency, costs, and each run.

Statistics: `sonar_graph.batch`. A metric is a family of tests, corrected by Holm (1979).
"""

import math
from collections import Counter
from collections.abc import Iterator

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
from sonar_graph.evaluation import (
    between,
    format_value,
    quantile_text,
    supported,
    with_error,
)
from sonar_graph.table import Cell, Column, Table, absent, count, number, words

SIGNIFICANT = 0.05
# by column, log and contestant: the differences, and their p value corrected over the tests of the metric
Tests = dict[tuple[str, str, str], tuple[PairedDifference, float]]
FAILURES = ("failed", "timeout", "memory", "killed")
COSTS = {
    "update_p50_ms": "Update, median (ms)",
    "update_p99_ms": "Update, 99 % (ms)",
    "wall_s": "Whole run (s)",
    "cpu_s": "Processor (s)",
    "peak_memory_mb": "Memory, rise (MB)",
}
QUANTILES = ("10_percent", "90_percent")
# end of the names of columns with the normalised squared error at a run's last instant
LATEST = "_end"
# relative difference of a smoothed ANEES to the causal one up to which it is the same evidence, shown once
SAME_AT_END = 0.1
SAME_EVIDENCE = (
    "At the last instant a smoothed estimate has seen no more than the causal one: it is no second evidence, and is "
    "shown only where it differs by more than a tenth."
)
GROUP_COLUMNS = (
    Column("log", "Log", is_number=False),
    Column("contestant", "Estimator", is_number=False),
)


def unit_of(metric: Metric) -> str:
    """The shown unit in brackets, after a blank; empty where there is none."""
    return f" ({metric.shown_unit})" if metric.shown_unit else ""


def group_cells(batch: RecordedBatch, log: str, contestant: str) -> list[Cell]:
    """The cells of `GROUP_COLUMNS`."""
    return [words(log), words(contestant, run=batch.contestants.index(contestant))]


def groups_of(batch: RecordedBatch) -> Iterator[tuple[str, str, list[RecordedRun]]]:
    """Log, contestant and their runs, where there are any."""
    for log in batch.logs:
        for contestant in batch.contestants:
            if group := batch.group(log, contestant):
                yield log, contestant, group


def runs_cell(batch: RecordedBatch, log: str, contestant: str, note: str = "") -> Cell:
    """The number of a group's runs, with a link to their list."""
    return count(
        len(batch.group(log, contestant)),
        note,
        link=f"#{group_anchor(batch, log, contestant)}",
    )


def group_anchor(batch: RecordedBatch, log: str, contestant: str) -> str:
    """The place on the page where the runs of a group are listed."""
    return f"runs-{batch.logs.index(log)}-{batch.contestants.index(contestant)}"


def all_tests(batch: RecordedBatch, metrics: list[Metric]) -> Tests:
    """Every contestant against the reference in every error; a filter's two estimates, being equal, are one test.

    For all logs together each seed gives one difference.
    """
    tests: Tests = {}
    for metric in metrics:
        # times depend on the load of the machine, so a test of them would judge the machine
        if not metric.is_error:
            continue
        # a filter's smoothed numbers are its causal ones: a second test of them would cost others
        # significance
        distinct: dict[tuple[str, str, bytes, bytes], PairedDifference] = {}
        same = {}
        for key in metric.keys.values():
            for log in _compared_logs(batch):
                for contestant in batch.contestants:
                    own, other = batch.pairs(log, contestant, key)
                    if contestant == batch.reference or not len(own):
                        continue
                    place = same[key, log, contestant] = (
                        log,
                        contestant,
                        own.tobytes(),
                        other.tobytes(),
                    )
                    if place not in distinct:
                        cases = (
                            batch.cases(log, contestant, key)
                            if log == ALL_LOGS
                            else None
                        )
                        distinct[place] = paired(own, other, cases)
        p_values = holm(np.array([test.p_value for test in distinct.values()])).tolist()
        corrected = dict(zip(distinct, p_values, strict=True))
        tests |= {
            place: (distinct[numbers], corrected[numbers])
            for place, numbers in same.items()
        }
    return tests


def _compared_logs(batch: RecordedBatch) -> list[str]:
    return [*batch.logs, ALL_LOGS] if len(batch.logs) > 1 else batch.logs


def failure_table(batch: RecordedBatch) -> Table:
    """Runs of each contestant that came to an end, and the endings of the others; runs not done are counted apart."""
    columns = [
        *GROUP_COLUMNS,
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
            group = batch.group(log, contestant)
            not_run = missing[log, contestant]
            if not group and not not_run:
                continue
            # a group that is planned and not begun has a row, or it would be overlooked
            cells = [count(0), *[absent()] * (1 + len(FAILURES)), absent(3)]
            if group:
                counts = Counter(run.status for run in group)
                rate = failure_rate(len(group) - counts["ok"], len(group))
                interval = f"{100 * rate.low:.0f} to {100 * rate.high:.0f} %"
                cells = [
                    runs_cell(batch, log, contestant),
                    *(count(counts[status]) for status in ("ok", *FAILURES)),
                ]
                cells.append(
                    Cell(
                        f"{100 * rate.share:.0f} %",
                        (rate.share, rate.low, rate.high),
                        interval,
                    )
                )
            cells += [count(not_run)] if batch.missing else []
            rows.append([*group_cells(batch, log, contestant), *cells])
    return Table(
        "failures",
        "Runs that ended",
        "Rates with 95 % intervals (Wilson).",
        columns,
        rows,
    )


def accuracy_table(batch: RecordedBatch, metric: Metric) -> Table:
    """One metric: mean with standard error, median, and the range of the middle 80 % of runs."""
    columns = [*GROUP_COLUMNS, Column("runs", "Runs")]
    for over, key in metric.keys.items():
        columns += [
            Column(f"{key}_mean", "Mean ± s.e.", over, ("", "se")),
            Column(f"{key}_median", "Median", over),
            Column(key, "10 to 90 %", over, QUANTILES),
        ]
    rows = []
    for log, contestant, group in groups_of(batch):
        # beside the count, because the mean is missing for this reason
        failed = sum(not run.ended for run in group)
        row = [
            *group_cells(batch, log, contestant),
            runs_cell(batch, log, contestant, f"{failed} failed" if failed else ""),
        ]
        for key in metric.keys.values():
            if batch.is_asked(log, contestant, key):
                row += summary_cells(
                    summarise(batch.values(log, contestant, key)), metric.factor
                )
            else:
                row += [absent(2), absent(), absent(2)]
        rows.append(row)
    return _metric_table("accuracy", metric, _unit_note(metric), columns, rows)


def summary_cells(told: SampleSummary, factor: float = 1.0) -> list[Cell]:
    """Mean with its error, median, and range of the middle 80 %."""
    note = f"{told.without} of {told.runs} without a value" if told.without else ""
    text = with_error(told.mean * factor, told.standard_error * factor)
    mean = number(told.mean, text, told.standard_error, note=note)
    median = number(
        told.median, quantile_text(told.median * factor, told.median_error * factor)
    )
    # one run has no spread
    if told.runs == 1:
        return [mean, median, absent(2)]
    low = quantile_text(told.low * factor, told.low_error * factor)
    high = quantile_text(told.high * factor, told.high_error * factor)
    return [mean, median, number(told.low, f"{low} to {high}", told.high)]


def difference_table(batch: RecordedBatch, metric: Metric, tests: Tests) -> Table:
    """One metric: differences to the reference on the same log and seed."""
    columns = [*GROUP_COLUMNS, Column("pairs", "Compared", parts=("", "of"))]
    for over, key in metric.keys.items():
        columns += [
            Column(f"{key}_difference", "Mean difference", over, ("", "low", "high")),
            Column(f"{key}_median_difference", "Median", over),
            Column(f"{key}_smaller", "Smaller in", over),
            Column(f"{key}_p_holm", "p (Holm)", over, ("", "single")),
        ]
    rows = []
    for log in _compared_logs(batch):
        for contestant in batch.contestants:
            own = [tests.get((key, log, contestant)) for key in metric.keys.values()]
            # the first error that there is gives the number of pairs, which is the same for all
            known = [found[0] for found in own if found is not None]
            if not known:
                continue
            without = max(test.without for test in known)
            note = f"{without} without a value" if without else ""
            pairs = Cell(known[0].counted, (known[0].pairs, known[0].each), note=note)
            cells = [
                cell
                for found in own
                for cell in _difference_cells(found, metric.factor)
            ]
            rows.append([*group_cells(batch, log, contestant), pairs, *cells])
    caption = f"{_unit_note(metric)} Contestant minus {batch.reference}: negative means smaller than the reference."
    return _metric_table("difference", metric, caption, columns, rows)


def _difference_cells(
    found: tuple[PairedDifference, float] | None, factor: float
) -> list[Cell]:
    """Mean with its interval, median, count of smaller ones, and p value."""
    if found is None:
        return [absent(3), absent(), absent(), absent(2)]
    test, p_holm = found
    error, (low, high) = test.rounding_error * factor, test.interval
    note = "" if math.isnan(low) else between(low * factor, high * factor, error)
    median = quantile_text(test.median * factor, test.median_error * factor)
    # half of the pairs have no value on one side: a word is clearer than an infinite number
    if math.isinf(test.median):
        median = (
            "worse: no value" if test.median > 0 else "better: reference has no value"
        )
    return [
        number(test.mean, supported(test.mean * factor, error), low, high, note=note),
        number(test.median, median),
        Cell(f"{test.smaller} of {test.counted}", (test.smaller,)),
        number(p_holm, p_text(p_holm), test.p_value),
    ]


def p_text(p_value: float) -> str:
    """A p value with two digits, down to one in a thousand; with more where it would else look like 5 % and is not."""
    # more digits would claim a precision that few seeds do not give
    if p_value < 1e-3:
        return "< 0.001"
    if not p_value < 0.995:
        return "1.0"
    # two digits of 0.0496 are 0.05, which looks like no finding
    texts = [f"{p_value:.{digits}g}" for digits in range(2, 18)]
    return next(
        text
        for text in texts
        if np.sign(float(text) - SIGNIFICANT) == np.sign(p_value - SIGNIFICANT)
    )


def _metric_table(
    kind: str,
    metric: Metric,
    caption: str,
    columns: list[Column],
    rows: list[list[Cell]],
) -> Table:
    prefix = metric.keys[""].partition(".")[0] if "" in metric.keys else ""
    name = (
        "-".join(filter(None, [kind, prefix, metric.name]))
        .replace("_", "-")
        .replace(".", "-")
    )
    unit = f", {metric.shown_unit}" if metric.shown_unit else ""
    return Table(name, f"{metric.label}{unit}", caption, columns, rows)


def _unit_note(metric: Metric) -> str:
    converted = " Degrees here, radians in the CSV." if metric.unit == "rad" else ""
    return f"{metric.protocol}{' ' + metric.direction.capitalize() + '.' if metric.direction else ''}{converted}"


def anees_of(
    batch: RecordedBatch, log: str, contestant: str, kind: str, what: str
) -> Anees | None:
    """The ANEES of a group over its runs, at the last instant of each; None where no covariance is reported."""
    key = f"{kind}.nees_{what}{LATEST}"
    if not batch.is_asked(log, contestant, key):
        return None
    group = batch.group(log, contestant)
    # runs of one log have the same freedom; else no band is right for their average
    dofs = {run.values[f"{key}_dof"] for run in group if f"{key}_dof" in run.values}
    return anees(
        batch.values(log, contestant, key), dofs.pop() if len(dofs) == 1 else math.nan
    )


def is_evidence(told: dict[str, Anees | None], kind: str) -> bool:
    """True where an estimate's ANEES at the last instant adds to that of the causal one.

    At the last instant a smoothed estimate rests on the same measurements as the causal one, and is the same but for a
    solver's last steps. It differs where a decision is made anew, as on doubtful identities.
    """
    causal = told["causal"]
    own = told[kind]
    if own is None or causal is None or kind == "causal":
        return own is not None
    # NaN is the mean of a group with a failed run, which compares as unequal to itself
    if math.isnan(causal.mean):
        return not math.isnan(own.mean)
    return not abs(own.mean - causal.mean) <= SAME_AT_END * causal.mean


def consistency_table(batch: RecordedBatch) -> Table:
    """ANEES at the last instant of runs that are independent, with its band; a smoothed one only where it differs."""
    told = {
        (log, contestant, what): {
            kind: anees_of(batch, log, contestant, kind, what) for kind in KINDS
        }
        for log in batch.logs
        for contestant in batch.contestants
        for what in ("position", "yaw")
    }
    kinds = [
        kind for kind in KINDS if any(is_evidence(one, kind) for one in told.values())
    ]
    columns = [
        *GROUP_COLUMNS,
        Column("of", "Of", is_number=False),
        Column("runs", "Runs"),
        Column("band", "Expected", parts=("low", "high")),
    ]
    for kind in kinds:
        over = kind.capitalize()
        columns += [
            Column(f"{kind}_anees", "ANEES", over),
            Column(f"{kind}_verdict", "Reading", over, is_number=False),
        ]
    rows = []
    for (log, contestant, what), both in told.items():
        known = [one for one in both.values() if one is not None]
        if not known:
            continue
        low, high = known[0].band
        failed = sum(not run.ended for run in batch.group(log, contestant))
        cells = [*group_cells(batch, log, contestant), words(what)]
        cells.append(
            count(known[0].runs, f"{failed} failed: no average" if failed else "")
        )
        cells.append(number(low, f"{low:.2f} to {high:.2f}", high))
        for kind in kinds:
            one = both[kind]
            values = batch.values(log, contestant, f"{kind}.nees_{what}{LATEST}")
            if one is None:
                cells += [absent(), words("")]
            elif not is_evidence(both, kind):
                cells += [number(one.mean, "as causal"), words("")]
            else:
                cells += [
                    number(one.mean, supported(one.mean, standard_error(values))),
                    words(one.verdict),
                ]
        rows.append(cells)
    caption = (
        "Average over runs of the normalised squared error at the last instant, per degree of freedom: 1 is "
        "consistent, above is over-confident. Expected: the chi-square band that holds 95 % of consistent estimators. "
        f"{SAME_EVIDENCE}"
    )
    return Table("consistency", "ANEES of independent runs", caption, columns, rows)


def cost_table(batch: RecordedBatch) -> Table:
    """Time and memory: median and the range of the middle 80 % of runs."""
    columns = [*GROUP_COLUMNS]
    # columns that no run has are left out
    known = [key for key in COSTS if any(key in run.values for run in batch.runs)]
    for key in known:
        columns.append(Column(f"{key}_median", "Median", COSTS[key]))
        columns.append(Column(key, "10 to 90 %", COSTS[key], QUANTILES))
    rows = []
    for log, contestant, _ in groups_of(batch):
        cells = [
            summary_cells(summarise(batch.values(log, contestant, key)))[1:]
            for key in known
        ]
        rows.append(
            [
                *group_cells(batch, log, contestant),
                *(cell for pair in cells for cell in pair),
            ]
        )
    caption = (
        "Measured while other runs went on beside them: compare within this batch only."
    )
    return Table("costs", "Time and memory", caption, columns, rows)


def run_lists(batch: RecordedBatch, metrics: list[Metric]) -> list[tuple[str, Table]]:
    """Every run: logs, each with the table of one contestant, whose name is the `group_anchor`."""
    lists = []
    for log, contestant, group in groups_of(batch):
        shown = [
            (metric, over, key)
            for metric in metrics
            for over, key in metric.keys.items()
            # a column of dashes would hide those with numbers
            if any(math.isfinite(run.value(key)) for run in group)
        ]
        columns = [
            Column("seed", "Seed"),
            Column("key", "Run", is_number=False),
            Column("status", "Status", is_number=False),
            *(
                Column(key, f"{metric.label}{unit_of(metric)}", over)
                for metric, over, key in shown
            ),
        ]
        rows = []
        for run in group:
            seed = absent() if run.seed is None else count(run.seed)
            row = [
                seed,
                words(run.key, run.log_file),
                Cell(run.status, (run.status,), note=run.reason),
            ]
            for metric, _, key in shown:
                value = run.value(key)
                row.append(
                    absent()
                    if math.isinf(value)
                    else number(value, format_value(value * metric.factor))
                )
            rows.append(row)
        name = group_anchor(batch, log, contestant)
        lists.append((log, Table(name, f"{log}, {contestant}", "", columns, rows)))
    return lists
