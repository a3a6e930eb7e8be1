"""What is done, under which limits, and what comes of it: the words that batch, workers and processes share.

Runs on disk: each written once, whole or not at all, under its key.

::

    DIR/.lock                   held by the batch that runs
    DIR/suite.toml              the suite, as it was given, once a run of it is done
    DIR/results.parquet         one row for each planned run
    DIR/runs/KEY/row.json       the row of a run
    DIR/runs/KEY/log.txt        what its process printed, tracebacks with it
    DIR/runs/KEY/...            what `sonar-graph compare` writes, where the run came so far

A run's folder is filled under another name and then renamed, and has another name again before it is removed. So a
folder that has its name is complete.

One batch at a time in a folder: two would remove each other's half-written runs, and write one table.
"""

from __future__ import annotations

import contextlib
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout

from sonar_graph.errors import BatchError, EvaluationError
from sonar_graph.files import read_json, write_json

Status = Literal["ok", "failed", "timeout", "memory", "killed"]
NOT_RUN = "not run"
"""In place of the status of a run that is planned and was not done: the table has a row for it too."""
Row = dict[str, str | int | float | None]
"""Of the table of results, by column."""


@dataclass(frozen=True)
class PlannedRun:
    """One run: all that a process needs to do it, and nothing that it would have to ask for."""

    key: str
    """Of everything that decides its outcome: content of the log or options of the simulator, seed, estimator,
    settings, rate, versions, source. Equal keys, equal numbers."""
    suite: str
    log: str
    """Name with the values of its grid."""
    kind: str
    """Generator, data set, or ``mcap``."""
    options: dict[str, Any]
    content: dict[str, Any]
    """`sonar_graph.batch.sources.fingerprint` of kind and options when the run was planned."""
    landmarks: dict[str, Any] | None
    seed: int | None
    estimator: str
    variant: str
    overrides: dict[str, Any]
    """Settings that were given; an estimator may tell them from equal defaults."""
    params: dict[str, Any]
    """All settings; of an estimator that cannot be loaded those that were given."""
    rate_hz: float
    versions: dict[str, str]
    asked: dict[str, Any]
    """What the suite states of it, of files their content, without what it leaves to defaults: two runs of one name are
    comparable where these are equal, though a default or the code was changed between them."""


@dataclass(frozen=True)
class Preparation:
    """What a process is asked before the first run of an estimator, and before the clock of that run starts."""

    run: PlannedRun


@dataclass(frozen=True)
class Limits:
    """What a run may take."""

    timeout_s: float
    memory_mb: float | None = None
    """Resident memory of its process and of those that it starts, 10⁶ bytes; None: no limit but the machine's."""


@dataclass(frozen=True)
class RunOutcome:
    """What a run left: a row of what was measured, files by their path within its folder, and its log."""

    row: Row
    files: dict[str, bytes] = field(default_factory=dict)
    log: str = ""


RUNS, ROW, LOG = "runs", "row.json", "log.txt"
KEY = "key"
SUITE, LOCK = "suite.toml", ".lock"
_PARTIAL = ".partial-"


class Store:
    """The runs in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / RUNS).mkdir(parents=True, exist_ok=True)

    def remove_partial(self) -> None:
        """Remove what a batch that was killed left half written or half removed; nothing else may be writing."""
        for path in (self.folder / RUNS).glob(f"{_PARTIAL}*"):
            shutil.rmtree(path)

    def row(self, key: str) -> Row | None:
        """What was measured in a run; None where it is not done, or its row was lost or is that of another run."""
        try:
            row = dict(read_json(self.run_folder(key) / ROW))
        except EvaluationError:
            return None
        return row if row.pop(KEY, None) == key else None

    def write(self, key: str, outcome: RunOutcome) -> None:
        """Keep a run.

        Raises
        ------
        OSError
            When there is no space; nothing of the run is left then, and no other run is touched.
        """
        partial = self._partial_folder(key)
        try:
            for name, content in {**outcome.files, LOG: outcome.log.encode()}.items():
                path = partial / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
            write_json(partial / ROW, {KEY: key, **outcome.row})
            self.discard(key)
            partial.rename(self.run_folder(key))
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    def discard(self, key: str) -> None:
        """Remove a run, so that it is done anew."""
        gone = self._partial_folder(key)
        with contextlib.suppress(FileNotFoundError):
            self.run_folder(key).rename(gone)
        shutil.rmtree(gone, ignore_errors=True)

    def run_folder(self, key: str) -> Path:
        """Where a run is."""
        return self.folder / RUNS / key

    def _partial_folder(self, key: str) -> Path:
        """A name of its own for what is not whole."""
        return self.folder / RUNS / f"{_PARTIAL}{key}-{uuid.uuid4().hex[:8]}"

    def log_file(self, key: str) -> str:
        """Where the log of a run is, from the store's folder on."""
        return f"{RUNS}/{key}/{LOG}"


@contextmanager
def only_batch_in(folder: Path) -> Iterator[None]:
    """Keep every other batch out of a folder while the block runs.

    The operating system holds the lock and gives it up with the process, however that ends. The file stays behind and
    means nothing.

    Raises
    ------
    BatchError
        When another batch runs there, or the file system has no locks.
    """
    lock = FileLock(folder / LOCK, timeout=0, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        raise BatchError(
            f"{folder}: another batch is running in this folder; wait for its end, or choose another folder with -o"
        ) from None
    except (OSError, NotImplementedError) as error:
        raise BatchError(
            f"{folder}: cannot be locked against a second batch ({error}); choose another file system with -o"
        ) from error
    try:
        yield
    finally:
        lock.release()
