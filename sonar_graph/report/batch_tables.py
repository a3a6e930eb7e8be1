"""Tables of a batch: failures, errors, differences to the reference, consistency, and runs that did not end.

Statistics: `sonar_graph.batch`. A metric is a family of tests, corrected by Holm (1979).
"""

import math
import re
from collections import Counter
from collections.abc import Iterator
from itertools import product

import numpy as np

from sonar_graph.batch import (
    ALL_LOGS,
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
    summarise,
)
from sonar_graph.evaluation import format_value
from sonar_graph.table import Cell, Column, Table, absent, count, number, words

SIGNIFICANT = 0.05
# by column, log and contestant: the differences, and their p value corrected over the tests of the metric
Tests = dict[tuple[str, str, str], tuple[PairedDifference, float]]
FAILURES = ("failed", "timeout", "memory", "killed")
QUANTILES = ("10_percent", "90_percent")
GROUP_COLUMNS = (
    Column("log", "Log", is_number=False),
    Column("contestant", "Estimator", is_number=False),
)


def unit_of(metric: Metric) -> str:
    """The shown unit in brackets, after a blank; empty without a unit."""
    return f" ({metric.shown_unit})" if metric.shown_unit else ""


def group_cells(batch: RecordedBatch, log: str, contestant: str) -> list[Cell]:
    """The cells of `GROUP_COLUMNS`."""
    return [words(log), words(contestant, run=batch.contestants.index(contestant))]


def groups_of(batch: RecordedBatch) -> Iterator[tuple[str, str, list[RecordedRun]]]:
    """Log, contestant and their runs, where there are any."""
    for log, contestant in product(batch.logs, batch.contestants):
        if group := batch.group(log, contestant):
            yield log, contestant, group


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
        places = product(metric.keys.values(), _compared_logs(batch), batch.contestants)
        for key, log, contestant in places:
            own, other = batch.pairs(log, contestant, key)
            if contestant == batch.reference or not len(own):
                continue
            numbers = (log, contestant, own.tobytes(), other.tobytes())
            same[key, log, contestant] = numbers
            if numbers not in distinct:
                is_all = log == ALL_LOGS
                cases = batch.cases(log, contestant, key) if is_all else None
                distinct[numbers] = paired(own, other, cases)
        p_values = holm(np.array([test.p_value for test in distinct.values()])).tolist()
        corrected = dict(zip(distinct, p_values, strict=True))
        for place, numbers in same.items():
            tests[place] = (distinct[numbers], corrected[numbers])
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
    for log, contestant in product(batch.logs, batch.contestants):
        group = batch.group(log, contestant)
        not_run = missing[log, contestant]
        if not group and not not_run:
            continue
        # a group that is planned and not begun has a row, or it would be overlooked
        cells = [count(0), *[absent()] * (1 + len(FAILURES)), absent(3)]
        if group:
            counts = Counter(run.status for run in group)
            rate = failure_rate(len(group) - counts["ok"], len(group))
            share = f"{100 * rate.share:.0f} %"
            interval = f"{100 * rate.low:.0f} to {100 * rate.high:.0f} %"
            cells = [count(counts[status]) for status in ("ok", *FAILURES)]
            cells.insert(0, count(len(group)))
            cells.append(Cell(share, (rate.share, rate.low, rate.high), interval))
        cells += [count(not_run)] if batch.missing else []
        rows.append([*group_cells(batch, log, contestant), *cells])
    caption = "Rates with 95 % intervals (Wilson)."
    return Table("failures", "Runs that ended", caption, columns, rows)


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
        failed = failed_of(group, "failed")
        row = [*group_cells(batch, log, contestant), count(len(group), failed)]
        for key in metric.keys.values():
            if batch.is_asked(log, contestant, key):
                told = summarise(batch.values(log, contestant, key))
                row += summary_cells(told, metric)
            else:
                row += [absent(2), absent(), absent(2)]
        rows.append(row)
    return _metric_table("accuracy", metric, _unit_note(metric), columns, rows)


def failed_of(group: list[RecordedRun], what: str) -> str:
    """The number of runs that did not end, with a word; empty where all did."""
    failed = sum(not run.ended for run in group)
    return f"{failed} {what}" if failed else ""


def without_value(told: SampleSummary) -> str:
    """The number of runs without a value; empty where all have one."""
    return f"{told.without} of {told.runs} without a value" if told.without else ""


def summary_cells(told: SampleSummary, metric: Metric) -> list[Cell]:
    """Mean with its error, median, and range of the middle 80 %."""
    text = metric.text(told.mean)
    if math.isfinite(told.standard_error):
        text += f" ± {metric.text(told.standard_error)}"
    mean = number(told.mean, text, told.standard_error, note=without_value(told))
    median = number(told.median, metric.text(told.median))
    # one run has no spread
    if told.runs == 1:
        return [mean, median, absent(2)]
    spread = f"{metric.text(told.low)} to {metric.text(told.high)}"
    return [mean, median, number(told.low, spread, told.high)]


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
    for log, contestant in product(_compared_logs(batch), batch.contestants):
        own = [tests.get((key, log, contestant)) for key in metric.keys.values()]
        # the first error that there is gives the number of pairs, which is the same for all
        known = [found[0] for found in own if found is not None]
        if not known:
            continue
        without = max(test.without for test in known)
        note = f"{without} without a value" if without else ""
        pairs = Cell(known[0].counted, (known[0].pairs, known[0].each), note)
        row = [*group_cells(batch, log, contestant), pairs]
        for found in own:
            row += _difference_cells(found, metric)
        rows.append(row)
    caption = f"{_unit_note(metric)} Contestant minus {batch.reference}: negative means smaller than the reference."
    return _metric_table("difference", metric, caption, columns, rows)


def _difference_cells(
    found: tuple[PairedDifference, float] | None, metric: Metric
) -> list[Cell]:
    """Mean with its interval, median, count of smaller ones, and p value."""
    if found is None:
        return [absent(3), absent(), absent(), absent(2)]
    test, p_holm = found
    low, high = test.interval
    note = "" if math.isnan(low) else f"{metric.text(low)} to {metric.text(high)}"
    median = metric.text(test.median)
    # half of the pairs have no value on one side: a word is clearer than an infinite number
    if math.isinf(test.median):
        median = (
            "worse: no value" if test.median > 0 else "better: reference has no value"
        )
    return [
        number(test.mean, metric.text(test.mean), low, high, note=note),
        number(test.median, median),
        Cell(f"{test.smaller} of {test.counted}", (test.smaller,)),
        number(p_holm, "< 0.001" if p_holm < 1e-3 else f"{p_holm:.3f}", test.p_value),
    ]


def _metric_table(
    kind: str,
    metric: Metric,
    caption: str,
    columns: list[Column],
    rows: list[list[Cell]],
) -> Table:
    prefix = metric.keys.get("", "").partition(".")[0]
    name = re.sub("[_.]", "-", "-".join(filter(None, [kind, prefix, metric.name])))
    unit = f", {metric.shown_unit}" if metric.shown_unit else ""
    return Table(name, f"{metric.label}{unit}", caption, columns, rows)


def _unit_note(metric: Metric) -> str:
    direction = f" {metric.direction.capitalize()}." if metric.direction else ""
    converted = " Degrees here, radians in the CSV." if metric.unit == "rad" else ""
    return f"{metric.protocol}{direction}{converted}"


def anees_of(
    batch: RecordedBatch, log: str, contestant: str, what: str
) -> Anees | None:
    """The causal ANEES of a group over its runs, at the last instant of each; None where no covariance is reported."""
    key = f"causal.nees_{what}_end"
    if not batch.is_asked(log, contestant, key):
        return None
    group = batch.group(log, contestant)
    # runs of one log have the same freedom; else no band is right for their average
    dofs = {run.values[f"{key}_dof"] for run in group if f"{key}_dof" in run.values}
    dof = dofs.pop() if len(dofs) == 1 else math.nan
    return anees(batch.values(log, contestant, key), dof)


def consistency_table(batch: RecordedBatch) -> Table:
    """ANEES at the last instant of runs that are independent, with its band.

    At the last instant a smoothed estimate rests on the same measurements as the causal one: it is no second evidence.
    """
    columns = [
        *GROUP_COLUMNS,
        Column("of", "Of", is_number=False),
        Column("runs", "Runs"),
        Column("band", "Expected", parts=("low", "high")),
        Column("anees", "ANEES"),
        Column("verdict", "Reading", is_number=False),
    ]
    rows = []
    for log, contestant, group in groups_of(batch):
        for what in ("position", "yaw"):
            found = anees_of(batch, log, contestant, what)
            if found is None:
                continue
            low, high = found.band
            rows.append(
                [
                    *group_cells(batch, log, contestant),
                    words(what),
                    count(found.runs, failed_of(group, "failed: no average")),
                    number(low, f"{low:.2f} to {high:.2f}", high),
                    number(found.mean, format_value(found.mean)),
                    words(found.verdict),
                ]
            )
    caption = (
        "Average over runs of the normalised squared error of the causal estimate at the last instant, per degree of "
        "freedom: 1 is consistent, above is over-confident. Expected: the chi-square band that holds 95 % of consistent "
        "estimators."
    )
    return Table("consistency", "ANEES of independent runs", caption, columns, rows)


def unended_table(batch: RecordedBatch) -> Table:
    """Runs that did not end, each with its reason and its log."""
    columns = [
        *GROUP_COLUMNS,
        Column("seed", "Seed"),
        Column("key", "Run", is_number=False),
        Column("status", "Status", is_number=False),
        Column("reason", "Reason", is_number=False),
    ]
    rows = [
        [
            *group_cells(batch, run.log, run.contestant),
            absent() if run.seed is None else count(run.seed),
            words(run.key, run.log_file),
            words(run.status),
            words(run.reason),
        ]
        for run in batch.runs
        if not run.ended
    ]
    return Table("unended", "Runs that did not end, and why", "", columns, rows)
