"""A suite from its file to its table: planned, resumed, done, collected."""

from __future__ import annotations

import contextlib
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from sonar_graph.batch.execution import Where, run_batch
from sonar_graph.batch.interrupts import deferred_interrupt
from sonar_graph.batch.lock import only_batch_in
from sonar_graph.batch.plan import plan_runs
from sonar_graph.batch.planned import Limits, Outcome, PlannedRun, Row
from sonar_graph.batch.results import write_results
from sonar_graph.batch.store import SUITE, Store
from sonar_graph.batch.suite import SuiteFile
from sonar_graph.errors import BatchError
from sonar_graph.evaluation.atomic import replacing


@dataclass(frozen=True)
class Batch:
    """A suite and the folder of its runs."""

    file: SuiteFile
    runs: list[PlannedRun]
    store: Store

    @classmethod
    @contextlib.contextmanager
    def opened(cls, file: SuiteFile, folder: Path, runs: list[PlannedRun] | None = None) -> Iterator[Batch]:
        """Plan a suite, find out what of it is done, and keep other batches out of the folder while the block runs.

        Parameters
        ----------
        runs
            The suite's plan, where it was made already.

        Raises
        ------
        BatchError
            When the suite has a mistake, another batch runs in the folder, or it holds the batch of another suite; no
            file in it is touched then.
        """
        runs = plan_runs(file) if runs is None else runs
        store = Store(folder)
        with only_batch_in(folder):
            _check_same_suite(file, folder)
            store.remove_partial()
            yield cls(file, runs, store)

    def rows(self) -> dict[str, Row]:
        """The rows of the runs that are done, by key."""
        return {run.key: row for run in self.runs if (row := self.store.row(run.key)) is not None}

    def discard_failed(self) -> None:
        """Forget runs that did not succeed, so that they are done anew."""
        for key, row in self.rows().items():
            if row["status"] != "ok":
                self.store.discard(key)

    def run(self, where: Where, limits: Limits, progress: Callable[[PlannedRun, Outcome], None]) -> Counter[str]:
        """Do what is not done, and write the table, also where the batch ends early.

        Suite and table in the folder are replaced as soon as a run of this plan is done, and not before: the table then
        names all runs, so that what a batch left that is killed can be read without the code that planned it.

        Returns
        -------
        How many runs have which status.

        Raises
        ------
        BatchError
            When the batch cannot go on; what is done is kept.
        """
        done = self.rows()
        missing = [run for run in self.runs if run.key not in done]
        is_begun = self._write_table_if_it_can_be()

        def begun(run: PlannedRun, outcome: Outcome) -> None:
            nonlocal is_begun
            is_begun = is_begun or self._write_table_if_it_can_be()
            progress(run, outcome)

        try:
            run_batch(missing, self.store, limits, where, begun)
        except (BatchError, KeyboardInterrupt) as error:
            self._write_table_if_it_can_be()  # why the batch ends is what has to be told
            if isinstance(error, BatchError):
                raise BatchError(f"{error}; {self.resuming()}") from error
            raise
        self._write_table()
        return Counter(str(row["status"]) for row in self.rows().values())

    def resuming(self) -> str:
        """How far it is and how to go on."""
        return f"{len(self.rows())} of {len(self.runs)} runs are done and kept; the same command goes on from there"

    def _write_table(self) -> None:
        with deferred_interrupt():
            with replacing(self.store.folder / SUITE) as partial:
                partial.write_text(self.file.text, encoding="utf-8")
            write_results(self.store, self.file.suite, self.runs)

    def _write_table_if_it_can_be(self) -> bool:
        """Whether there is something to tell and space to tell it."""
        if not any(self.store.row(run.key) for run in self.runs):
            return False
        with contextlib.suppress(OSError):
            self._write_table()
            return True
        return False


def _check_same_suite(file: SuiteFile, folder: Path) -> None:
    """Refuse the folder of another suite; one that was changed, and has its name still, goes on there."""
    try:
        name = tomllib.loads((folder / SUITE).read_text(encoding="utf-8")).get("name")
    except (OSError, ValueError):  # none, or none that could be gone on with
        return
    if name != file.suite.name:
        raise BatchError(
            f"{folder}: holds the batch of suite {name!r}, and {file.path} is suite {file.suite.name!r}; choose "
            f"another folder with -o, or, where it only has a new name, give it that name in {folder / SUITE} too"
        )


def limits_of(file: SuiteFile, timeout_s: float | None) -> Limits:
    """What a run of a suite may take; a timeout that is given goes before the suite's."""
    limits = Limits(file.suite.timeout_s, file.suite.memory_mb)
    return limits if timeout_s is None else replace(limits, timeout_s=timeout_s)
