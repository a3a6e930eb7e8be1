"""What a batch left behind, as its report and its gate read it: ``results.parquet`` and the suite beside it.

The table names every run that is planned. One that it has as not done may have been done since, by a batch that was
killed: its row is then read from where the run is kept.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sonar_graph.batch.store import LOCK, LOG, NOT_RUN, ROW, RUNS, SUITE
from sonar_graph.errors import EvaluationError
from sonar_graph.files import read_json
from sonar_graph.measurements import Floats

RESULTS = "results.parquet"
SUITE_METADATA = b"sonar_graph.suite"
DEFAULT_VARIANT = ("", "default")
DEFAULT_METRICS = (
    "causal.ate_se2_m",
    "causal.ate_raw_m",
    "causal.rpe_10s_m",
    "causal.yaw_rmse_rad",
    "landmarks.se2_m",
)
GOING_ON = "give the bench command that began it again: it goes on from there"
ALL_LOGS = "all logs"
"""Stands for every log of a batch where they are taken together."""
NEEDED = ("key", "log", "estimator", "status")
WORDS = ("key", "suite", "log", "generator", "estimator", "variant", "status", "reason", "log_file", "machine")
OBJECTS = ("options", "params", "versions")


@dataclass(frozen=True)
class RecordedRun:
    """One row of the results."""

    key: str
    log: str
    """Name of the log or of the simulated world, with its options where these vary."""
    seed: int | None
    estimator: str
    variant: str
    status: str
    reason: str = ""
    log_file: str = ""
    texts: dict[str, str] = field(default_factory=dict)
    """All else that is no number: generator, options, params, versions, machine."""
    values: dict[str, float] = field(default_factory=dict)
    """Every number that is known, by column."""
    place: int = 0
    """In the plan: groups are told in its order, whichever of their runs are done."""

    @property
    def contestant(self) -> str:
        """Estimator, with the variant where it is not the default one."""
        return self.estimator if self.variant in DEFAULT_VARIANT else f"{self.estimator}/{self.variant}"

    @property
    def ended(self) -> bool:
        """Whether it came to an end, so that its numbers count."""
        return self.status == "ok"

    def value(self, key: str) -> float:
        """A score; infinity where the run did not end or has none."""
        return self.values.get(key, math.inf) if self.ended else math.inf


@dataclass(frozen=True)
class RecordedBatch:
    """All runs of a batch, and what its suite says about comparing them."""

    name: str
    runs: list[RecordedRun]
    """Those that were done, whatever came of them. Statistics are of these alone."""
    reference: str
    """Contestant with which the others are compared."""
    metrics: list[str]
    description: str = ""
    suite: str = ""
    """The suite's text."""
    missing: list[RecordedRun] = field(default_factory=list)
    """Those that are planned and were not done; not failures."""

    @cached_property
    def _groups(self) -> dict[tuple[str, str], list[RecordedRun]]:
        groups: dict[tuple[str, str], list[RecordedRun]] = {}
        for run in self.runs:
            groups.setdefault((run.log, run.contestant), []).append(run)
        return groups

    @cached_property
    def _log_scores(self) -> set[tuple[str, str]]:
        return {(key, run.log) for run in self.runs if run.ended for key in run.values}

    @cached_property
    def _contestant_scores(self) -> set[tuple[str, str]]:
        return {(key, run.contestant) for run in self.runs if run.ended for key in run.values}

    @cached_property
    def _ended_contestants(self) -> set[str]:
        return {run.contestant for run in self.runs if run.ended}

    @cached_property
    def logs(self) -> list[str]:
        """Names of logs, in the order of the plan."""
        return list(dict.fromkeys(run.log for run in self._planned))

    @cached_property
    def contestants(self) -> list[str]:
        """In the order of the plan."""
        return list(dict.fromkeys(run.contestant for run in self._planned))

    @property
    def _planned(self) -> list[RecordedRun]:
        return sorted([*self.runs, *self.missing], key=lambda run: run.place)

    def group(self, log: str, contestant: str) -> list[RecordedRun]:
        """Runs of one contestant on one log that were done, one a seed."""
        return self._groups.get((log, contestant), [])

    def values(self, log: str, contestant: str, key: str) -> Floats:
        """A score of one contestant on one log, shape (runs,); infinity where a run has none."""
        return np.array([run.value(key) for run in self.group(log, contestant)])

    def pairs(self, log: str, contestant: str, key: str) -> tuple[Floats, Floats]:
        """A score of one contestant and of the reference on the same log and seed, each shape (n,).

        With `ALL_LOGS` those of every log. Logs on which either cannot have the score have no pairs.
        """
        logs = self.logs if log == ALL_LOGS else [log]
        both = [pair for one in logs for pair in self._pairs_on(one, contestant, key)]
        values = np.array([(own.value(key), other.value(key)) for own, other in both]).reshape(-1, 2)
        return values[:, 0], values[:, 1]

    def cases(self, log: str, contestant: str, key: str) -> list[str | int]:
        """What each of `pairs` is a case of: its seed, and where there is none its log.

        Pairs with one seed on several logs depend on each other: worlds of a grid share what the seed drew.
        """
        logs = self.logs if log == ALL_LOGS else [log]
        runs = [own for one in logs for own, _ in self._pairs_on(one, contestant, key)]
        return [run.log if run.seed is None else run.seed for run in runs]

    def _pairs_on(self, log: str, contestant: str, key: str) -> list[tuple[RecordedRun, RecordedRun]]:
        if not all(self.is_asked(log, name, key) for name in (contestant, self.reference)):
            return []
        reference = {run.seed: run for run in self.group(log, self.reference)}
        return [(run, reference[run.seed]) for run in self.group(log, contestant) if run.seed in reference]

    def is_asked(self, log: str, contestant: str, key: str) -> bool:
        """Whether a score can be expected: the log has it for somebody, and the contestant on some log.

        A dead reckoning has no map and a log without truth no errors; neither is a failure. Of a contestant that never
        ended nobody knows what it would have, so everything is expected of it. Where none of its runs was done there is
        nothing to expect.
        """
        is_known = (key, contestant) in self._contestant_scores or contestant not in self._ended_contestants
        return (key, log) in self._log_scores and is_known and (log, contestant) in self._groups


def is_batch(folder: Path) -> bool:
    """Whether a batch was begun in a folder."""
    return any((folder / name).is_file() for name in (RESULTS, SUITE, LOCK))


def read_batch(folder: Path, reference: str | None = None) -> RecordedBatch:
    """The batch in a folder.

    Parameters
    ----------
    reference
        Contestant to compare with; None: the suite's, and without a suite that of the first row.

    Raises
    ------
    EvaluationError
        When there are no results, no run was done yet, the table lacks a column, or the reference is not planned.
    """
    planned, about = _read_table(folder / RESULTS)
    runs = [run for run in planned if run.status != NOT_RUN]
    if not runs:
        raise EvaluationError(f"{folder}: none of its {len(planned)} runs has been done yet; {GOING_ON}")
    chosen = reference or _plain_name(about.get("reference")) or planned[0].contestant
    batch = RecordedBatch(
        name=about.get("name") or runs[0].texts.get("suite") or folder.name,
        runs=runs,
        reference=chosen,
        metrics=list(about.get("metrics") or DEFAULT_METRICS),
        description=about.get("description", ""),
        suite=(folder / SUITE).read_text("utf-8") if (folder / SUITE).is_file() else "",
        missing=[run for run in planned if run.status == NOT_RUN],
    )
    if chosen not in batch.contestants:
        raise EvaluationError(
            f"{folder}: no run of the reference {chosen!r}; there are runs of: {', '.join(batch.contestants)}"
        )
    return batch


def _plain_name(reference: str | None) -> str | None:
    """A reference as contestants are called."""
    return reference.removesuffix("/default") if reference else None


def _read_table(path: Path) -> tuple[list[RecordedRun], dict[str, Any]]:
    """The runs, and what the suite says about comparing them."""
    if not path.is_file():
        raise EvaluationError(_absence_told(path))
    try:
        import pyarrow as pa  # only batches need it
        import pyarrow.parquet as pq
    except ModuleNotFoundError as error:
        raise EvaluationError(f"{path}: reading it needs pyarrow; pip install 'sonar-graph[bench]'") from error
    try:
        table = pq.read_table(path)
    except (pa.ArrowInvalid, OSError) as error:
        raise EvaluationError(f"{path}: cannot be read as Parquet ({error}); run bench again, it resumes") from error
    missing = [name for name in NEEDED if name not in table.column_names]
    if missing:
        raise EvaluationError(f"{path}: no column {', '.join(missing)}; expected results that bench wrote")
    if not table.num_rows:
        raise EvaluationError(f"{path}: has no rows; run bench again, it resumes")
    if repeated := [key for key, count in Counter(table["key"].to_pylist()).items() if count > 1]:
        raise EvaluationError(f"{path}: run {repeated[0]} has more than one row; run bench again, it resumes")
    about = json.loads((table.schema.metadata or {}).get(SUITE_METADATA, b"{}"))
    rows = [_row_now(row, path.parent) for row in table.to_pylist()]
    return [_run(row, place) for place, row in enumerate(rows)], about


def _absence_told(path: Path) -> str:
    """What a folder without a table is."""
    if not is_batch(path.parent):
        return f"{path.parent}: no {path.name} in it; it needs a folder that bench wrote to"
    return f"{path.parent}: no {path.name} in it: the batch was ended before any of its runs was done; {GOING_ON}"


def _row_now(row: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A row of the table, with what was measured if the run was done after the table was written.

    A run that is not where the table says has no log.
    """
    if row["status"] != NOT_RUN:
        is_here = row.get("log_file") and (folder / row["log_file"]).is_file()
        return row if is_here else row | {"log_file": None}
    kept = Path(RUNS) / str(row["key"])
    with contextlib.suppress(EvaluationError):
        return row | {"reason": None, "log_file": f"{kept.as_posix()}/{LOG}"} | read_json(folder / kept / ROW)
    return row


def _run(row: dict[str, Any], place: int) -> RecordedRun:
    words = {name: str(row.pop(name, None) or "") for name in WORDS}
    seed = row.pop("seed", None)
    objects = {name: _as_text(row.pop(name)) for name in OBJECTS if row.get(name)}
    numbers = {name: float(value) for name, value in row.items() if isinstance(value, int | float)}
    others = {name: value for name, value in row.items() if isinstance(value, str)}
    known = {name: words[name] for name in ("suite", "generator", "machine") if words[name]}
    return RecordedRun(
        key=words["key"],
        log=words["log"],
        seed=None if seed is None else int(seed),
        estimator=words["estimator"],
        variant=words["variant"],
        status=words["status"],
        reason=words["reason"],
        log_file=words["log_file"],
        texts=known | objects | others,
        values={name: value for name, value in numbers.items() if math.isfinite(value)},
        place=place,
    )


def _as_text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True, default=str)


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
