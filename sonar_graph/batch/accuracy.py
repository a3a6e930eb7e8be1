"""Tables of errors: how large they are, and how they differ from the reference's."""

from __future__ import annotations

import math

import numpy as np

from sonar_graph.batch.catalogue import Metric
from sonar_graph.batch.recorded import ALL_LOGS, RecordedBatch
from sonar_graph.batch.rounding import between, quantile_text, supported, with_error
from sonar_graph.batch.statistics import Paired, Summary, holm, paired, summarise
from sonar_graph.batch.tables import Cell, Column, Table, absent, number, words

SIGNIFICANT = 0.05
QUANTILES = ("10_percent", "90_percent")
Tests = dict[tuple[str, str, str], tuple[Paired, float]]
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


def _tested(batch: RecordedBatch, key: str, log: str, contestant: str) -> Paired:
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


def summary_cells(told: Summary, factor: float = 1.0) -> list[Cell]:
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


def _difference_cells(found: tuple[Paired, float] | None, metric: Metric) -> list[Cell]:
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
