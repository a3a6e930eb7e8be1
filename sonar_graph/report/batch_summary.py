"""Findings of a batch in sentences made from its numbers, and the overview at the head of its page.

Failures and missing runs come first, then warnings, then errors against the reference.
"""

import math
from collections import Counter
from dataclasses import replace
from itertools import product

import numpy as np

from sonar_graph.batch import (
    GOING_ON,
    Metric,
    PairedDifference,
    RecordedBatch,
    summarise,
)
from sonar_graph.report.batch_tables import (
    GROUP_COLUMNS,
    SIGNIFICANT,
    Tests,
    unit_of,
    without_value,
)
from sonar_graph.states import counted
from sonar_graph.table import Cell, Column, Table, absent, number, words

SCORED = "scored_instants"
# largest number of logs that a warning names; others are counted
NAMED = 3
LOWER = "\N{DOWNWARDS ARROW}"
HIGHER = "\N{UPWARDS ARROW}"
DIFFERENT = "\N{NOT EQUAL TO}"


def warnings_of(batch: RecordedBatch) -> list[str]:
    """All that a reader must see first: what failed or is missing, then what puts numbers in doubt."""
    tellers = (
        missing_told,
        absent_told,
        failures_told,
        sensors_told,
        withheld_told,
        reference_told,
        instants_told,
    )
    return [sentence for told in tellers for sentence in told(batch)]


def failures_told(batch: RecordedBatch) -> list[str]:
    """A sentence on each contestant with runs that did not end."""
    sentences = []
    for contestant in batch.contestants:
        runs = [run for run in batch.runs if run.contestant == contestant]
        failed = [run for run in runs if not run.ended]
        # by contestant: a failure is first of all its own
        if failed:
            logs = _few(list(dict.fromkeys(run.log for run in failed)))
            sentences.append(
                f"{contestant}: {len(failed)} of {len(runs)} runs did not end ({logs})."
            )
    return sentences


def reference_told(batch: RecordedBatch) -> list[str]:
    """A warning where the reference never ended: differences then show its failure and nothing else."""
    # a reference that failed makes every difference infinite
    lost = [
        log
        for log in batch.logs
        if (group := batch.group(log, batch.reference))
        and not any(run.ended for run in group)
    ]
    if not lost:
        return []
    return [
        f"The reference {batch.reference} never ended on {_few(lost)}: whoever ended is better there, by no known "
        "amount."
    ]


def instants_told(batch: RecordedBatch) -> list[str]:
    """A warning where runs with the same log and seed are scored at different instants."""
    # other instants are another question: easy stretches may be missing in one run
    counts = {
        (run.log, run.seed, run.values[SCORED])
        for run in batch.runs
        if run.ended and SCORED in run.values
    }
    seeds = Counter((log, seed) for log, seed, _ in counts)
    lost = {log for (log, _), number in seeds.items() if number > 1}
    if not lost:
        return []
    uneven = [log for log in batch.logs if log in lost]
    return [
        f"Scored at different numbers of instants, which differences then mix in: {_few(uneven)}."
    ]


def _few(names: list[str], joint: str = ", ") -> str:
    """The first names, and the number of the others."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return joint.join(names[:NAMED]) + more


def head_metric(batch: RecordedBatch, metrics: list[Metric]) -> Metric | None:
    """The error that most logs have, of those the one that the suite names first; None where no run has an error."""

    def logs_with(metric: Metric) -> int:
        return sum(is_asked(batch, log, metric) for log in batch.logs)

    # an error that one log has is no headline for many
    errors = [metric for metric in metrics if metric.is_error]
    best = max(errors, key=logs_with, default=None)
    return best if best and logs_with(best) else None


def is_asked(batch: RecordedBatch, log: str, metric: Metric) -> bool:
    """True where some run on a log can have a metric."""
    places = product(batch.contestants, metric.keys.values())
    return any(batch.is_asked(log, name, key) for name, key in places)


def mark_of(found: tuple[PairedDifference, float] | None) -> str:
    """An arrow to the side of most differences to the reference where these are significant; else nothing."""
    if found is None or not found[1] < SIGNIFICANT:
        return ""
    # the rank test is about the side of most differences; one lost run can turn the mean
    median = found[0].median
    if math.isnan(median) or median == 0:
        return DIFFERENT
    return LOWER if median < 0 else HIGHER


def overview_table(batch: RecordedBatch, metric: Metric, tests: Tests) -> Table:
    """Logs down, contestants across: medians, with a mark where a contestant differs from the reference."""
    columns_shown = [
        (over, key, name)
        for over, key in metric.keys.items()
        for name in _shown(batch, metric, over)
    ]
    columns = [GROUP_COLUMNS[0]]
    for over, key, name in columns_shown:
        # arrows are against this column
        heading = f"{name} (reference)" if name == batch.reference else name
        run = batch.contestants.index(name)
        columns.append(Column(f"{key} {name}", heading, over, ("", "p_holm"), run=run))
    rows: list[list[Cell]] = []
    for log in batch.logs:
        rows.append([words(log)])
        for _, key, name in columns_shown:
            if not batch.is_asked(log, name, key):
                rows[-1].append(absent(2))
                continue
            # medians, because a mean over a group with a lost run does not exist
            told = summarise(batch.values(log, name, key))
            found = tests.get((key, log, name))
            text = f"{metric.text(told.median)} {mark_of(found)}".rstrip()
            p_value = found[1] if found else math.nan
            note = without_value(told)
            rows[-1].append(number(told.median, text, p_value, note=note))
    caption = (
        f"{LOWER} lower, {HIGHER} higher than {batch.reference} on the same seeds, beyond chance "
        f"(p below {SIGNIFICANT:g}, Holm); no arrow: not told apart.{too_few(metric, tests)}"
    )
    title = f"{metric.label}{unit_of(metric)}, median over runs"
    return Table("overview", title, caption, columns, rows)


def too_few(metric: Metric, tests: Tests) -> str:
    """A sentence where no difference could be significant with so few seeds, and how many can; else nothing.

    The least two-sided p of n differences is 2 / 2^n, and Holm multiplies it by the number of tests.
    """
    keys = metric.keys.values()
    own = {id(test): test for (key, _, _), (test, _) in tests.items() if key in keys}
    if not own:
        return ""
    most = max(test.pairs for test in own.values())
    needed = math.floor(1.0 + math.log2(len(own) / SIGNIFICANT)) + 1
    if most >= needed:
        return ""
    seeds = counted(most, "seed")
    return f" {seeds} cannot tell any difference apart: it takes at least {needed}."


def _shown(batch: RecordedBatch, metric: Metric, over: str) -> list[str]:
    """Contestants that have the estimate; the smoothed one only where it is not the causal one everywhere."""
    key = metric.keys[over]
    first = next(iter(metric.keys.values()))

    def is_shown(name: str) -> bool:
        if not any(batch.is_asked(log, name, key) for log in batch.logs):
            return False
        # the causal estimate is always shown: a vehicle acts on it
        return key == first or not all(
            np.array_equal(batch.values(log, name, key), batch.values(log, name, first))
            for log in batch.logs
        )

    return list(filter(is_shown, batch.contestants))


def missing_told(batch: RecordedBatch) -> list[str]:
    """The missing runs by contestant and log, and the way to complete the batch; nothing where it is complete."""
    if not batch.missing:
        return []
    # a reader needs to see whose numbers may change
    by_contestant = Counter(run.contestant for run in batch.missing)
    planned = by_contestant + Counter(run.contestant for run in batch.runs)
    names = [name for name in batch.contestants if by_contestant[name]]
    whose = ", ".join(
        f"{name} {by_contestant[name]} of {planned[name]}" for name in names
    )
    lacking = {run.log for run in batch.missing}
    logs = _few([log for log in batch.logs if log in lacking], "; ")
    return [
        f"This batch is not complete: {batch.missing_count} ({whose}), on {logs}. All numbers "
        f"are of the other runs, and may change. To complete it, {GOING_ON}."
    ]


def sensors_told(batch: RecordedBatch) -> list[str]:
    """What the sensors of each log contradict, grave findings first."""
    # grave findings first: they put all numbers of the log in doubt
    words = {"doubtful": "Doubtful", "sensors": "Warning"}
    found = {
        (word, run.log): run.texts[subject]
        for subject, word in words.items()
        for run in batch.runs
        if subject in run.texts
    }
    return [f"{word}: {log}: {text}" for (word, log), text in found.items()]


def withheld_told(batch: RecordedBatch) -> list[str]:
    """What estimators did not use, and what moved in a given map: a line for each log and text, grave ones first."""
    found: dict[tuple[str, str], list[str]] = {}
    for run in batch.runs:
        if "withheld" in run.texts:
            found.setdefault((run.log, run.texts["withheld"]), []).append(
                run.contestant
            )
    lines = [
        f"{'Doubtful' if 'beyond doubt' in text else 'Warning'}: {log}: {', '.join(dict.fromkeys(names))}: {text}"
        for (log, text), names in found.items()
    ]
    lines.sort(key=lambda line: "beyond doubt" not in line)
    if len(lines) > NAMED:
        more = f"{len(lines) - NAMED} more in the column `withheld` of results.parquet"
        return [*lines[:NAMED], more]
    return lines


def absent_told(batch: RecordedBatch) -> list[str]:
    """The logs that were left out because their data was not there, and where it is from."""
    return [
        f"Left out, because its data was not there: {name}. Get {source}."
        for name, source in batch.absent.items()
    ]


def lost_told(batch: RecordedBatch) -> list[str]:
    """The number of runs that are rows of the table but whose folders are gone."""
    # folders are removed to save space, while their rows stay
    lost = [run.key for run in batch.runs if not run.log_file]
    if not lost:
        return []
    return [
        f"The table has {counted(len(lost), 'run')} whose folder is not here, first {lost[0]}: "
        "their numbers can be told and not be followed. Where it was removed, the bench command does them anew."
    ]


def marked(batch: RecordedBatch, table: Table) -> Table:
    """The table, whose caption names missing runs: tables are also used outside the page."""
    if not batch.missing:
        return table
    caption = f"{table.caption} Not complete: {batch.missing_count}.".lstrip()
    return replace(table, caption=caption)
