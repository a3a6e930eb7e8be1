"""A suite from its file to its table of results: planned, resumed, done, collected. Start with `run_suite`.

Decisions: docs/design/0011-batch.md.
"""

from __future__ import annotations

import contextlib
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from sonar_graph.batch.plan import plan_runs
from sonar_graph.batch.recorded import RESULTS, RecordedBatch, read_batch
from sonar_graph.batch.result_table import write_results
from sonar_graph.batch.store import (
    SUITE,
    Limits,
    PlannedRun,
    Progress,
    Row,
    RunOutcome,
    Store,
    Where,
)
from sonar_graph.batch.suite import SuiteFile, read_suite
from sonar_graph.errors import BatchError
from sonar_graph.files import (
    BATCH,
    deferred_interrupt,
    replacing,
    result_folder,
    result_written,
    terminations_as_interrupts,
    text_of,
)

NEEDED_PACKAGES = ("distributed", "pyarrow")
INSTALL = "pip install 'sonar-graph[bench]'"


def run_suite(
    path: Path | str,
    folder: Path | str,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    retry_failed: bool = False,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
) -> RecordedBatch:
    """Run a suite: logs or simulations, seeds, estimators and variants. Runs that are done already are kept.

    Needs the extra ``bench``. The same call resumes a batch that was interrupted, also with more seeds or estimators in
    the suite.

    Parameters
    ----------
    path
        The suite, a TOML file; its format is in `sonar_graph.batch.suite`.
    folder
        Folder for the batch. One suite has one folder.
    workers
        Number of processes on this machine; None: one for each core.
    scheduler
        Address of a Dask scheduler, such as ``tcp://10.0.0.5:8786``, to be used instead.
    retry_failed
        Do runs again that failed, timed out or were killed.
    overwrite
        Replace suite and table in the folder also where they are another suite's, or not this package's.
    progress
        Called at the start and after each run with the number of runs that are done, planned and failed.

    Returns
    -------
    RecordedBatch
        All runs with their scores. The folder has them as ``results.parquet``, and in ``runs/KEY`` what `compare`
        writes.

    Raises
    ------
    BatchError
        When the suite has a mistake (with file, line and key), another batch runs in the folder, it holds the batch of
        another suite, no worker can be had, or a package of the extra is missing. Runs that are done are kept.
    KeyboardInterrupt
        On Ctrl-C or SIGTERM, with the number of finished runs as message.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from sonar_graph.batch import plan_runs, read_suite, run_suite
    >>> folder = Path(tempfile.mkdtemp())
    >>> suite = folder / "lap.toml"
    >>> _ = suite.write_text('''
    ... name = "lap"
    ... reference = "dead-reckoning"
    ...
    ... [[logs]]
    ... name = "basin"
    ... generator = "basin"
    ... options = { duration_s = 120, laps = 1 }
    ... seeds = 2
    ...
    ... [[estimators]]
    ... name = "dead-reckoning"
    ... ''')
    >>> [(run.log, run.seed, run.estimator) for run in plan_runs(read_suite(suite))]
    [('basin', 0, 'dead-reckoning'), ('basin', 1, 'dead-reckoning')]
    >>> batch = run_suite(suite, folder / "lap", workers=1)  # doctest: +SKIP
    >>> batch.values("basin", "dead-reckoning", "causal.ate_se2_m").shape  # doctest: +SKIP
    (2,)
    """
    if workers is not None and scheduler is not None:
        raise BatchError(
            "workers are processes on this machine, a scheduler is that of a cluster; give one of them"
        )
    if lacking := [name for name in NEEDED_PACKAGES if find_spec(name) is None]:
        raise BatchError(f"bench needs {lacking[0]}, which is not installed: {INSTALL}")
    file = read_suite(Path(path))
    folder = Path(folder)
    with Batch.opened(file, folder, overwrite=overwrite) as batch:
        if retry_failed:
            batch.discard_failed()
        statuses = Counter(row["status"] for row in batch.rows().values())

        def report() -> None:
            if progress is not None:
                done = statuses.total()
                progress(done, len(batch.runs), done - statuses["ok"])

        def count(_run: PlannedRun, outcome: RunOutcome) -> None:
            statuses[outcome.row["status"]] += 1
            report()

        report()
        limits = Limits(file.suite.timeout_s, file.suite.memory_mb)
        try:
            with terminations_as_interrupts():
                batch.run(Where(workers, scheduler), limits, count)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(batch.resuming()) from None
    return read_batch(folder)


@dataclass(frozen=True)
class Batch:
    """A suite and the folder of its runs."""

    file: SuiteFile
    runs: list[PlannedRun]
    store: Store

    @classmethod
    @contextlib.contextmanager
    def opened(
        cls, file: SuiteFile, folder: Path, *, overwrite: bool = False
    ) -> Iterator[Batch]:
        """Plan a suite, find its finished runs, and keep other batches out of the folder while the block runs.

        Raises
        ------
        BatchError
            When the suite has a mistake, another batch runs in the folder, or it holds the batch of another suite or
            others' files of its names; no file in it is touched then, and no folder is made for a suite with a mistake.
        """
        runs = plan_runs(file)
        store = Store(folder)
        with result_folder(
            folder, BATCH, overwrite=overwrite, refusal=BatchError
        ) as written:
            # no suite here, or none that can be resumed
            with contextlib.suppress(OSError, ValueError):
                name = tomllib.loads(text_of(folder / SUITE)).get("name")
                # one that was edited but has its name goes on here
                if name != file.suite.name and not overwrite:
                    raise BatchError(
                        f"{folder}: holds the batch of suite {name!r}, and {file.path} is suite {file.suite.name!r}; "
                        "choose another folder with -o, or, where it only has a new name, give --overwrite"
                    )
            with result_written(
                folder, BATCH
            ):  # from here on the folder is known as a batch's
                written.require(
                    [RESULTS] if _is_same(folder / SUITE, file) else [SUITE, RESULTS]
                )
            store.remove_partial()
            yield cls(file, runs, store)

    def rows(self) -> dict[str, Row]:
        """Rows of the runs that are done, by key."""
        rows = {run.key: self.store.row(run.key) for run in self.runs}
        return {key: row for key, row in rows.items() if row is not None}

    def discard_failed(self) -> None:
        """Remove runs that did not succeed, so that they are done again."""
        for key, row in self.rows().items():
            if row["status"] != "ok":
                self.store.discard(key)

    def run(self, where: Where, limits: Limits, progress: Progress) -> None:
        """Do the runs that are not done, and write the table, also if the batch ends early.

        Suite and table in the folder are replaced as soon as the first run of this plan is done, and not before. The
        table then names all runs, so a batch that is killed can be read without the code that planned it.

        Raises
        ------
        BatchError
            When the batch cannot go on; finished runs are kept.
        """
        from sonar_graph.batch import cluster  # Dask is of the extra `bench`

        done = self.rows()
        missing = [run for run in self.runs if run.key not in done]
        has_table = self._write_table_if_possible()

        def kept(run: PlannedRun, outcome: RunOutcome) -> None:
            nonlocal has_table
            has_table = has_table or self._write_table_if_possible()
            progress(run, outcome)

        try:
            cluster.run_batch(missing, self.store, limits, where, kept)
        except (BatchError, KeyboardInterrupt) as error:
            self._write_table_if_possible()  # an error here would hide the one that ends the batch
            if isinstance(error, BatchError):
                raise BatchError(f"{error}; {self.resuming()}") from error
            raise
        self._write_table()

    def resuming(self) -> str:
        """Sentence with the number of finished runs and how to resume."""
        return f"{len(self.rows())} of {len(self.runs)} runs are done and kept; the same command goes on from there"

    def _write_table(self) -> None:
        with deferred_interrupt(), result_written(self.store.folder, BATCH):
            if not _is_same(self.store.folder / SUITE, self.file):
                with replacing(self.store.folder / SUITE) as partial:
                    partial.write_text(self.file.text, encoding="utf-8")
            write_results(self.store, self.file.suite, self.runs)

    def _write_table_if_possible(self) -> bool:
        """Write the table if any run is done and there is space; True if it was written."""
        if not any(self.store.row(run.key) for run in self.runs):
            return False
        with contextlib.suppress(OSError):
            self._write_table()
            return True
        return False


def _is_same(path: Path, file: SuiteFile) -> bool:
    """True if a file is the suite, such as the user's own in the folder that it is written to."""
    return path.is_file() and path.read_bytes() == file.text.encode()
