"""What a batch found, in sentences made from its numbers: failures first, then errors against the reference."""

from __future__ import annotations

import math

import numpy as np

from sonar_graph.batch.accuracy import SIGNIFICANT, Tests, p_text
from sonar_graph.batch.catalogue import Metric
from sonar_graph.batch.recorded import RecordedBatch
from sonar_graph.batch.rounding import quantile_text
from sonar_graph.batch.signed_rank import LEAST_PAIRS, least_p
from sonar_graph.batch.statistics import Paired, holm, quantile, quantile_error

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


def _side_told(batch: RecordedBatch, metric: Metric, test: Paired) -> str:
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
    families: dict[str, dict[tuple[str, int], Paired]] = {}
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
