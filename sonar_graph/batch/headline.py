"""The head of a report: for one score, who is told apart from the reference on how many logs, and every median."""

from __future__ import annotations

import math

import numpy as np

from sonar_graph.batch.accuracy import SIGNIFICANT, Tests
from sonar_graph.batch.catalogue import Metric
from sonar_graph.batch.recorded import RecordedBatch
from sonar_graph.batch.rounding import quantile_text
from sonar_graph.batch.statistics import Paired, summarise
from sonar_graph.batch.tables import Cell, Column, Table, absent, number, words

LOWER, HIGHER, DIFFERENT = "\N{DOWNWARDS ARROW}", "\N{UPWARDS ARROW}", "\N{NOT EQUAL TO}"
SIDES = {LOWER: "lower", HIGHER: "higher", DIFFERENT: "different"}


def head_metric(batch: RecordedBatch, metrics: list[Metric]) -> Metric | None:
    """The error that most logs have, of those the one that the suite names first; None where no run has an error."""
    known = {metric.name: len(_scored_logs(batch, metric)) for metric in metrics if metric.is_error}
    if not any(known.values()):
        return None
    return max((metric for metric in metrics if metric.is_error), key=lambda metric: known[metric.name])


def _scored_logs(batch: RecordedBatch, metric: Metric) -> list[str]:
    return [log for log in batch.logs if any(_asked(batch, log, key) for key in metric.keys.values())]


def _asked(batch: RecordedBatch, log: str, key: str) -> bool:
    return any(batch.is_asked(log, contestant, key) for contestant in batch.contestants)


def headlines(batch: RecordedBatch, metric: Metric, tests: Tests) -> list[str]:
    """For each estimate who is told apart from the reference, to which side, and on how many logs."""
    own = {place: test for place, test in tests.items() if place[0] in metric.keys.values() and place[1] in batch.logs}
    if own and not any(map(mark_of, own.values())):
        place = " on any one log" if len(batch.logs) > 1 else ""
        return [f"{metric.label}: no estimator is told apart from {batch.reference}{place}."]
    sentences = [_headline(batch, metric, own, over, key) for over, key in metric.keys.items()]
    return [sentence for sentence in sentences if sentence]


def _headline(batch: RecordedBatch, metric: Metric, tests: Tests, over: str, key: str) -> str:
    asked = [name for name in _shown(batch, metric, over) if any((key, log, name) in tests for log in batch.logs)]
    if not asked:
        return ""
    marks = {name: [mark_of(tests.get((key, log, name))) for log in batch.logs] for name in asked}
    told = [f"{word} with {names}" for mark, word in SIDES.items() if (names := _marked(marks, mark))]
    alike = ", ".join(name for name, own in marks.items() if not any(own))
    if alike:
        told.append(f"{'never' if len(batch.logs) > 1 else 'not'} told apart: {alike}")
    place = f" (on how many of {len(batch.logs)} logs)" if len(batch.logs) > 1 and len(told) > bool(alike) else ""
    return f"{f'{over} error' if over else 'Error'} beside that of {batch.reference}{place}: {'; '.join(told)}."


def _marked(marks: dict[str, list[str]], mark: str) -> str:
    """Contestants that have a mark, with the number of logs where there are several."""
    return ", ".join(
        f"{name} ({own.count(mark)})" if len(own) > 1 else name for name, own in marks.items() if mark in own
    )


def mark_of(found: tuple[Paired, float] | None) -> str:
    """An arrow to the side on which most differences to the reference are, where they are no chance; else nothing."""
    if found is None or not found[1] < SIGNIFICANT:
        return ""
    median = found[0].median
    return DIFFERENT if math.isnan(median) or median == 0 else LOWER if median < 0 else HIGHER


def overview_table(batch: RecordedBatch, metric: Metric, tests: Tests) -> Table:
    """Log by contestant: medians, and a mark where a contestant is told apart from the reference."""
    shown = [(over, key, name) for over, key in metric.keys.items() for name in _shown(batch, metric, over)]
    columns = [Column("log", "Log", is_number=False)]
    columns += [
        Column(f"{key} {name}", _heading(batch, name), over, ("", "p_holm"), contestant=name)
        for over, key, name in shown
    ]
    rows = [
        [words(log), *(_median_cell(batch, metric, tests, (key, log, name)) for _, key, name in shown)]
        for log in batch.logs
    ]
    unit = f" ({metric.shown_unit})" if metric.shown_unit else ""
    caption = (
        f"{LOWER} lower, {HIGHER} higher than {batch.reference} on the same seeds, beyond chance "
        f"(p below {SIGNIFICANT:g}, Holm); no arrow: not told apart."
    )
    return Table("overview", f"{metric.label}{unit}, median over runs", caption, columns, rows)


def _heading(batch: RecordedBatch, contestant: str) -> str:
    return f"{contestant} (reference)" if contestant == batch.reference else contestant


def _shown(batch: RecordedBatch, metric: Metric, over: str) -> list[str]:
    """Contestants that have the estimate; the smoothed one only where it is not the causal one everywhere."""
    key = metric.keys[over]
    asked = [name for name in batch.contestants if any(batch.is_asked(log, name, key) for log in batch.logs)]
    first = next(iter(metric.keys.values()))
    return asked if key == first else [name for name in asked if not _are_equal(batch, name, key, first)]


def _are_equal(batch: RecordedBatch, contestant: str, key: str, other: str) -> bool:
    return all(
        np.array_equal(batch.values(log, contestant, key), batch.values(log, contestant, other)) for log in batch.logs
    )


def _median_cell(batch: RecordedBatch, metric: Metric, tests: Tests, place: tuple[str, str, str]) -> Cell:
    key, log, contestant = place
    if not batch.is_asked(log, contestant, key):
        return absent(2)
    told = summarise(batch.values(log, contestant, key))
    found = tests.get(place)
    text = quantile_text(told.median * metric.factor, told.median_error * metric.factor)
    note = f"{told.without} of {told.runs} without a value" if told.without else ""
    return number(told.median, f"{text} {mark_of(found)}".rstrip(), found[1] if found else math.nan, note=note)
