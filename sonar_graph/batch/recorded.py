"""Results of a batch, as its report and its gate read them: ``results.parquet`` and the suite beside it.

The table names every planned run. A run that it lists as not done may have been done since by a batch that was killed;
its row is then read from the run's own folder.
"""

import contextlib
import json
import math
import tomllib
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sonar_graph.batch.store import LOG, NOT_RUN, ROW, RUNS, SUITE
from sonar_graph.batch.suite import DEFAULT_METRICS
from sonar_graph.errors import EvaluationError
from sonar_graph.files import BATCH, Manifest, read_json
from sonar_graph.measurements import Floats

RESULTS = "results.parquet"
SUITE_METADATA = b"sonar_graph.suite"
DEFAULT_VARIANT = ("", "default")
GOING_ON = "give the bench command that began it again: it goes on from there"
ALL_LOGS = "all logs"
"""Name for all logs of a batch taken together."""
NEEDED = ("key", "log", "estimator", "status")
FIELDS = ("key", "log", "estimator", "variant", "status", "reason", "log_file")


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
    """Other columns that are no numbers: generator, options, params, versions, machine."""
    values: dict[str, float] = field(default_factory=dict)
    """Every finite number, by column."""
    place: int = 0
    """Position in the plan, which gives the order of groups."""

    @property
    def contestant(self) -> str:
        """Estimator, with the variant unless it is the default one."""
        own = "" if self.variant in DEFAULT_VARIANT else f"/{self.variant}"
        return f"{self.estimator}{own}"

    @property
    def ended(self) -> bool:
        """True if the run succeeded, so that its numbers count."""
        return self.status == "ok"

    def value(self, key: str) -> float:
        """A score; infinity if the run did not end or has none."""
        return self.values.get(key, math.inf) if self.ended else math.inf


@dataclass(frozen=True)
class RecordedBatch:
    """All runs of a batch, and its suite's choices for comparing them."""

    name: str
    runs: list[RecordedRun]
    """Runs that were done, whether they succeeded or not. Statistics are of these alone."""
    reference: str
    """Contestant with which the others are compared."""
    metrics: list[str]
    description: str = ""
    suite: str = ""
    """The suite's text."""
    missing: list[RecordedRun] = field(default_factory=list)
    """Runs that are planned and were not done; no failures."""

    @cached_property
    def _groups(self) -> dict[tuple[str, str], list[RecordedRun]]:
        groups: dict[tuple[str, str], list[RecordedRun]] = {}
        for run in self.runs:
            groups.setdefault((run.log, run.contestant), []).append(run)
        return groups

    @cached_property
    def _known_scores(
        self,
    ) -> tuple[set[tuple[str, str]], set[tuple[str, str]], set[str]]:
        """Scores by log, scores by contestant, and contestants with a run that ended."""
        ended = [run for run in self.runs if run.ended]
        return (
            {(key, run.log) for run in ended for key in run.values},
            {(key, run.contestant) for run in ended for key in run.values},
            {run.contestant for run in ended},
        )

    @cached_property
    def logs(self) -> list[str]:
        """Names of logs, in the order of the plan."""
        return list(dict.fromkeys(run.log for run in self._planned))

    @cached_property
    def absent(self) -> dict[str, str]:
        """Source of each log of the suite that was left out, because its files were not there, by its name."""
        with contextlib.suppress(ValueError):
            # the suite names logs that no row can name
            entries = tomllib.loads(self.suite).get("logs", [])
            return {
                entry["name"]: entry["obtain"]
                for entry in entries
                if entry.get("obtain")
                # a log of a grid has values after its name and a comma, such as `tracks, wrong_id_rate=0.05`
                and not any(
                    f"{log}, ".startswith(f"{entry['name']}, ") for log in self.logs
                )
            }
        return {}

    @cached_property
    def contestants(self) -> list[str]:
        """Names of contestants, in the order of the plan."""
        return list(dict.fromkeys(run.contestant for run in self._planned))

    @property
    def _planned(self) -> list[RecordedRun]:
        return sorted([*self.runs, *self.missing], key=lambda run: run.place)

    def group(self, log: str, contestant: str) -> list[RecordedRun]:
        """Finished runs of one contestant on one log, one for each seed."""
        return self._groups.get((log, contestant), [])

    def values(self, log: str, contestant: str, key: str) -> Floats:
        """A score of one contestant on one log, shape (runs,); infinity for a run without one."""
        return np.array([run.value(key) for run in self.group(log, contestant)])

    def pairs(self, log: str, contestant: str, key: str) -> tuple[Floats, Floats]:
        """A score of one contestant and of the reference on the same log and seed, each shape (n,).

        `ALL_LOGS` gives those of every log. Logs on which either cannot have the score have no pairs.
        """
        both = [
            (own.value(key), reference.value(key))
            for own, reference in self._pairs(log, contestant, key)
        ]
        values = np.array(both).reshape(-1, 2)
        return values[:, 0], values[:, 1]

    def cases(self, log: str, contestant: str, key: str) -> list[str | int]:
        """Case of each of `pairs`: its seed, or its log if it has no seed.

        Pairs with one seed on several logs depend on each other: worlds of a grid share the draws of the seed.
        """
        runs = [own for own, _ in self._pairs(log, contestant, key)]
        return [run.log if run.seed is None else run.seed for run in runs]

    def _pairs(
        self, log: str, contestant: str, key: str
    ) -> list[tuple[RecordedRun, RecordedRun]]:
        pairs = []
        # all logs together are pooled by seed
        for one in self.logs if log == ALL_LOGS else [log]:
            contestants = contestant, self.reference
            if all(self.is_asked(one, name, key) for name in contestants):
                # the same seed draws the same world for both
                reference = {run.seed: run for run in self.group(one, self.reference)}
                runs = self.group(one, contestant)
                pairs += [
                    (run, reference[run.seed]) for run in runs if run.seed in reference
                ]
        return pairs

    def is_asked(self, log: str, contestant: str, key: str) -> bool:
        """True if a score can be expected: some contestant has it on this log, and this contestant on some log.

        Dead reckoning has no map, and a log without truth has no errors; neither is a failure. A contestant none of
        whose runs ended is expected to have every score. Without finished runs on the log nothing is expected.
        """
        # without this a missing score would count as a failure of whoever cannot have it
        on_log, of_contestant, ended = self._known_scores
        is_known = (key, contestant) in of_contestant or contestant not in ended
        return (key, log) in on_log and is_known and (log, contestant) in self._groups

    @property
    def missing_count(self) -> str:
        """Sentence part with the number of runs that were not done."""
        planned = len(self.runs) + len(self.missing)
        return f"{len(self.missing)} of {planned} runs {'has' if len(self.missing) == 1 else 'have'} not been done"


def is_batch(folder: Path) -> bool:
    """True if a batch was begun in a folder."""
    return Manifest.found(folder).kind == BATCH or any(
        (folder / name).is_file() for name in (RESULTS, SUITE)
    )


def read_batch(folder: Path, reference: str | None = None) -> RecordedBatch:
    """Read the batch in a folder.

    Parameters
    ----------
    reference
        Contestant to compare with; None: the suite's, or without a suite that of the first row.

    Raises
    ------
    EvaluationError
        When there are no results, no run was done yet, the table lacks a column, or the reference is not planned.
    """
    path = folder / RESULTS
    if not path.is_file():
        why = "; it needs a folder that bench wrote to"
        if is_batch(folder):
            why = f": the batch was ended before any of its runs was done; {GOING_ON}"
        raise EvaluationError(f"{folder}: no {RESULTS} in it{why}")
    try:
        # loaded here, because a comparison needs no extra
        import pyarrow as pa  # of the extra `bench`
        import pyarrow.parquet as pq
    except ModuleNotFoundError as error:
        raise EvaluationError(
            f"{path}: reading it needs pyarrow; pip install 'sonar-graph[bench]'"
        ) from error
    try:
        with path.open("rb") as stream:  # pyarrow takes names of files in UTF-8 alone
            # without its threads: a process that ends while one of them starts is aborted
            table = pq.ParquetFile(stream, pre_buffer=False).read(use_threads=False)
    except (pa.ArrowInvalid, OSError) as error:
        raise EvaluationError(
            f"{path}: cannot be read as Parquet ({error}); run bench again, it resumes"
        ) from error
    if absent := [name for name in NEEDED if name not in table.column_names]:
        raise EvaluationError(
            f"{path}: no column {', '.join(absent)}; expected results that bench wrote"
        )
    rows = table.to_pylist()
    if not rows:
        raise EvaluationError(f"{path}: has no rows; run bench again, it resumes")
    # the most frequent one first
    key, count = Counter(row["key"] for row in rows).most_common()[0]
    if count > 1:
        raise EvaluationError(
            f"{path}: run {key} has more than one row; run bench again, it resumes"
        )
    planned = [_recorded(row, place, folder) for place, row in enumerate(rows)]
    runs = [run for run in planned if run.status != NOT_RUN]
    if not runs:
        raise EvaluationError(
            f"{folder}: none of its {len(planned)} runs has been done yet; {GOING_ON}"
        )
    # a table that another program wrote has no such metadata
    about = json.loads((table.schema.metadata or {}).get(SUITE_METADATA, b"{}"))
    chosen = (
        reference
        or str(about.get("reference") or "").removesuffix("/default")
        or planned[0].contestant
    )
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


def _recorded(row: dict[str, Any], place: int, folder: Path) -> RecordedRun:
    """A run from its row of the table; from its own folder if it was done after the table was written."""
    if row["status"] == NOT_RUN:
        # a batch that was killed could not write its table again
        kept = Path(RUNS) / str(row["key"])
        with contextlib.suppress(EvaluationError):
            row = (
                row
                | {"reason": None, "log_file": f"{kept.as_posix()}/{LOG}"}
                | read_json(folder / kept / ROW)
            )
    elif not (
        row.get("log_file") and (folder / row["log_file"]).is_file()
    ):  # its folder was moved or removed
        row["log_file"] = None
    fields: dict[str, Any] = {name: str(row.pop(name, None) or "") for name in FIELDS}
    seed = row.pop("seed", None)
    texts = {
        name: value
        if isinstance(value, str)
        else json.dumps(value, sort_keys=True, default=str)
        for name, value in row.items()
        if value and isinstance(value, str | dict | list)
    }
    # null stands for what was not measured
    values = {
        name: float(value)
        for name, value in row.items()
        if isinstance(value, int | float) and math.isfinite(value)
    }
    return RecordedRun(
        **fields,
        seed=None if seed is None else int(seed),
        texts=texts,
        values=values,
        place=place,
    )
