"""A suite from its file to its table: planned, resumed, done, collected.

Ctrl-C that comes at a bad moment and is not lost, and SIGTERM that counts like it.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType

from sonar_graph.batch.cluster import Where, run_batch
from sonar_graph.batch.plan import plan_runs
from sonar_graph.batch.result_table import write_results
from sonar_graph.batch.store import SUITE, Limits, PlannedRun, Row, RunOutcome, Store, only_batch_in
from sonar_graph.batch.suite import SuiteFile
from sonar_graph.errors import BatchError
from sonar_graph.files import replacing


@contextmanager
def terminations_as_interrupts() -> Iterator[None]:
    """Let SIGTERM, by which SLURM, Kubernetes and ``timeout`` end a job, do in the block what Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        handler = signal.getsignal(signal.SIGINT)
        (handler if callable(handler) else signal.default_int_handler)(number, frame)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def deferred_interrupt() -> Iterator[None]:
    """Let a Ctrl-C that comes during the block count at its end.

    Compiled code without a way to raise (pyarrow has some) swallows the exception, and the batch would go on.

    Raises
    ------
    KeyboardInterrupt
        At the end of the block, when the signal came meanwhile; an error of the block is its context.
    """
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield
        return
    came: list[tuple[int, FrameType | None]] = []
    signal.signal(signal.SIGINT, lambda number, frame: came.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if came:  # also where the block fails: whoever passes over its error would pass over the interrupt
            handler(*came[0])


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

    def run(self, where: Where, limits: Limits, progress: Callable[[PlannedRun, RunOutcome], None]) -> Counter[str]:
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

        def begun(run: PlannedRun, outcome: RunOutcome) -> None:
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
