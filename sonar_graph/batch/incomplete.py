"""Batches of which not every planned run was done, or is there any more: what is said of them, what they cannot be."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

from sonar_graph.batch.recorded import GOING_ON, RecordedBatch
from sonar_graph.batch.tables import Table
from sonar_graph.errors import EvaluationError

NAMED = 3
"""Logs that a warning names; of more it tells the number."""


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
        f"This batch is not complete: {_count_told(batch)} ({whose}), on {'; '.join(logs[:NAMED])}{more}. All numbers "
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
    return replace(table, caption=f"{table.caption} Not complete: {_count_told(batch)}.".lstrip())


def require_complete(batch: RecordedBatch, subject: str | Path, purpose: str) -> None:
    """Refuse a batch with missing runs.

    Parameters
    ----------
    subject
        What the message begins with.
    purpose
        What the batch cannot do, for the message.

    Raises
    ------
    EvaluationError
        When a planned run was not done.
    """
    if batch.missing:
        raise EvaluationError(f"{subject}: the batch {batch.name!r} cannot {purpose}, {_count_told(batch)}; {GOING_ON}")


def _count_told(batch: RecordedBatch) -> str:
    planned = len(batch.runs) + len(batch.missing)
    return f"{len(batch.missing)} of {planned} runs {'has' if len(batch.missing) == 1 else 'have'} not been done"
