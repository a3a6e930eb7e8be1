"""What a batch found, in sentences made from its numbers: failures first, then errors against the reference.

The head of a report: for one score, who is told apart from the reference on how many logs, and every median.

Batches of which not every planned run was done, or is there any more: what is said of them, what they cannot be.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np

from sonar_graph.batch import (
    GOING_ON,
    LEAST_PAIRS,
    Metric,
    PairedDifference,
    RecordedBatch,
    holm,
    least_p,
    quantile,
    quantile_error,
    summarise,
)
from sonar_graph.report.batch_tables import SIGNIFICANT, Tests, p_text
from sonar_graph.report.tables import Cell, Column, Table, absent, number, words
from sonar_graph.report.wording import quantile_text

SCORED = "scored_instants"
NAMED = 3
"""Logs that a warning names; of more it tells the number."""


def failures_told(batch: RecordedBatch) -> list[str]:
    """A sentence on each contestant with runs that did not end."""
    sentences = []
    for contestant in batch.contestants:
        runs = [run for run in batch.runs if run.contestant == contestant]
        failed = [run for run in runs if not run.ended]
        if failed:
            logs = _few(list(dict.fromkeys(run.log for run in failed)))
            sentences.append(f"{contestant}: {len(failed)} of {len(runs)} runs did not end ({logs}).")
    return sentences


def reference_told(batch: RecordedBatch) -> list[str]:
    """A warning where the reference never ended: then differences tell of its failure and of nothing else."""
    groups = {log: batch.group(log, batch.reference) for log in batch.logs}
    lost = [log for log, group in groups.items() if group and not any(run.ended for run in group)]
    if not lost:
        return []
    return [
        f"The reference {batch.reference} never ended on {_few(lost)}: whoever ended is better there, by no known "
        "amount."
    ]


def errors_told(batch: RecordedBatch, metrics: list[Metric], tests: Tests) -> list[str]:
    """For each log the first metric that it has: medians, then differences to the reference that are no chance."""
    sentences = []
    for log in batch.logs:
        found = next(
            (
                (metric, key)
                for metric in metrics
                if metric.is_error
                for key in metric.keys.values()
                if any(batch.is_asked(log, name, key) for name in batch.contestants)
            ),
            None,
        )
        sentences.append(
            f"{log}: no run has an error to compare." if found is None else _log_told(batch, log, *found, tests)
        )
    return sentences


def _log_told(batch: RecordedBatch, log: str, metric: Metric, key: str, tests: Tests) -> str:
    medians = [
        (quantile(values, 0.5), name, quantile_error(values, 0.5) * metric.factor)
        for name in batch.contestants
        if len(values := batch.values(log, name, key))
    ]
    listed = ", ".join(
        f"{name} {quantile_text(value * metric.factor, error)}"
        for value, name, error in sorted(medians)
        if value < math.inf
    )
    which = next(over for over, own in metric.keys.items() if own == key).lower()
    unit = f" in {metric.shown_unit}" if metric.shown_unit else ""
    opening = f"{log}, median {f'{which} ' if which else ''}error{unit} ({metric.label}): {listed}."
    return " ".join([opening, *_differences_told(batch, log, metric, key, tests)])


def _differences_told(batch: RecordedBatch, log: str, metric: Metric, key: str, tests: Tests) -> list[str]:
    told, alike = [], []
    for contestant in batch.contestants:
        if (key, log, contestant) not in tests:
            continue
        test, p_value = tests[key, log, contestant]
        if not p_value < SIGNIFICANT:
            alike.append(contestant)
        else:
            told.append(f"{contestant} {_side_told(batch, metric, test)} (p {_p(p_value)}).")
    if alike:
        told.append(f"Not told apart from {batch.reference}: {', '.join(alike)}.")
    return told


def _side_told(batch: RecordedBatch, metric: Metric, test: PairedDifference) -> str:
    """What the rank test is about: the side of most differences, not of their mean, which one run can turn."""
    counted = f"smaller in {test.smaller} of {test.counted}"
    if math.isnan(test.median) or test.median == 0:
        return f"differs from {batch.reference}, {counted}"
    side = f"is {'below' if test.median < 0 else 'above'} {batch.reference}"
    if math.isinf(test.median):
        return f"{side}, {counted}"
    size = quantile_text(abs(test.median) * metric.factor, test.median_error * metric.factor)
    return f"{side} by {size} in the median, {counted}"


def instants_told(batch: RecordedBatch) -> list[str]:
    """A warning where runs with the same log and seed are scored at different instants."""
    uneven = []
    for log in batch.logs:
        counts: dict[int | None, set[float]] = {}
        for run in batch.runs:
            if run.log == log and run.ended and SCORED in run.values:
                counts.setdefault(run.seed, set()).add(run.values[SCORED])
        if any(len(known) > 1 for known in counts.values()):
            uneven.append(log)
    if not uneven:
        return []
    return [f"Scored at different numbers of instants, which differences then mix in: {_few(uneven)}."]


def power_told(tests: Tests) -> list[str]:
    """A warning where there are too few pairs for any finding, even if every test of the family were at its best."""
    families: dict[str, dict[tuple[str, int], PairedDifference]] = {}
    for (key, log, _), (test, _) in tests.items():
        families.setdefault(key.rpartition(".")[2], {})[log, id(test)] = test
    blind: dict[str, str] = {}
    for family in families.values():
        best = holm(np.array([_best_p(test.pairs) for test in family.values()]))
        found = zip(family.items(), best.tolist(), strict=True)
        blind |= {log: test.counted for ((log, _), test), p_value in found if not p_value < SIGNIFICANT}
    if not blind:
        return []
    listed = _few([f"{log} ({counted})" for log, counted in blind.items()])
    return [f"Too few pairs for any corrected p value to fall below {SIGNIFICANT:g}: {listed}. Add seeds."]


def _best_p(pairs: int) -> float:
    return least_p(pairs) if pairs >= LEAST_PAIRS else math.nan


def _few(names: list[str]) -> str:
    """The first names, and how many more there are."""
    more = len(names) - NAMED
    return ", ".join(names) if more < 1 else f"{', '.join(names[:NAMED])} and {more} more"


def _p(p_value: float) -> str:
    text = p_text(p_value)
    return text if text.startswith("<") else f"= {text}"


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


def mark_of(found: tuple[PairedDifference, float] | None) -> str:
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


def missing_told(batch: RecordedBatch) -> list[str]:
    """How many runs are missing, whose, on which logs, and how to go on; nothing of a complete batch."""
    if not batch.missing:
        return []
    by_contestant = Counter(run.contestant for run in batch.missing)
    planned = by_contestant + Counter(run.contestant for run in batch.runs)
    names = [name for name in batch.contestants if by_contestant[name]]
    whose = ", ".join(f"{name} {by_contestant[name]} of {planned[name]}" for name in names)
    lacking = {run.log for run in batch.missing}
    logs = [log for log in batch.logs if log in lacking]
    more = f" and {len(logs) - NAMED} more" if len(logs) > NAMED else ""
    return [
        f"This batch is not complete: {batch.missing_count} ({whose}), on {'; '.join(logs[:NAMED])}{more}. All numbers "
        f"are of the other runs, and may change. To complete it, {GOING_ON}."
    ]


def lost_told(batch: RecordedBatch) -> list[str]:
    """How many runs have left their row and nothing else."""
    lost = [run.key for run in batch.runs if not run.log_file]
    if not lost:
        return []
    return [
        f"The table has {len(lost)} {'run' if len(lost) == 1 else 'runs'} whose folder is not here, first {lost[0]}: "
        "their numbers can be told and not be followed. Where it was removed, the bench command does them anew."
    ]


def marked(batch: RecordedBatch, table: Table) -> Table:
    """A table, with a caption that says so where runs are missing: tables are taken out of the page."""
    if not batch.missing:
        return table
    return replace(table, caption=f"{table.caption} Not complete: {batch.missing_count}.".lstrip())
