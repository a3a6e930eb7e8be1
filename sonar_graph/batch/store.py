"""Runs on disk, and the records that the batch, its workers and the processes of runs exchange.

::

    DIR/.lock                   held by the batch that runs
    DIR/.sonar_graph.json       manifest of the folder (`sonar_graph.files`); each run has its own
    DIR/suite.toml              the suite as it was given, written when its first run is done
    DIR/results.parquet         one row for each planned run
    DIR/runs/KEY/row.json       the row of a run
    DIR/runs/KEY/log.txt        output of its process, with tracebacks
    DIR/runs/KEY/...            files of `sonar-graph compare`, if the run came that far

A run's folder is filled under a temporary name and then renamed, and is renamed again before it is removed. A folder
with its final name is therefore complete. Decisions: docs/design/0011-batch.md.
"""

import contextlib
import re
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

from sonar_graph.errors import BatchError, EvaluationError
from sonar_graph.files import (
    COMPARISON,
    MANIFEST,
    Manifest,
    digest_of,
    others_in,
    read_json,
    refused,
    remove_written,
    strict_json,
)

Status = Literal["ok", "failed", "timeout", "memory", "killed"]
# status in the table of a run that is planned and not done yet
NOT_RUN = "not run"
# a row of the results by column
Row = dict[str, str | int | float | None]


@dataclass(frozen=True)
class PlannedRun:
    """One run with everything that a process needs to do it."""

    key: str
    """Hash of everything that decides the outcome: content of the log or options of the simulator, seed, estimator,
    settings, rate, versions, source. Equal keys give equal numbers."""
    suite: str
    log: str
    """Name, with the values of its grid."""
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
    """Settings as the suite gives them; an estimator may distinguish them from equal defaults."""
    params: dict[str, Any]
    """All settings; for an estimator that cannot be loaded, those that were given."""
    rate_hz: float
    versions: dict[str, str]
    asked: dict[str, Any]
    """What the suite states of this run, files by their content, without defaults. Two runs of one name are comparable
    when these are equal, even if a default or the code changed in between."""


@dataclass(frozen=True)
class Preparation:
    """Request for a warm-up, sent before the first run of an estimator and outside its measured time."""

    run: PlannedRun


@dataclass(frozen=True)
class Limits:
    """Limits of time and memory for one run."""

    timeout_s: float
    memory_mb: float | None = None
    """Resident memory of the run's process and its children, 10⁶ bytes; None: no limit but the machine's."""


@dataclass(frozen=True)
class RunOutcome:
    """Result of a run: its row, its files by path within its folder, and its log."""

    row: Row
    files: dict[str, bytes] = field(default_factory=dict)
    log: str = ""


@dataclass(frozen=True)
class Where:
    """Place where the runs are done: workers on this machine, or a Dask scheduler that exists."""

    workers: int | None = None
    """Number of workers on this machine; None: one for each core that this process may use."""
    scheduler: str | None = None
    """Address of a scheduler, used in place of local workers."""


# called after a run is kept
Progress = Callable[[PlannedRun, RunOutcome], None]
RUNS = "runs"
ROW = "row.json"
LOG = "log.txt"
KEY = "key"
SUITE = "suite.toml"
_PARTIAL = ".partial-"
_PARTIAL_NAME = re.compile(r"\.partial-\w+-[0-9a-f]{8}")


class Store:
    """The runs in a folder, each written once, whole or not at all, under its key.

    Raises `BatchError` when the folder cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with refused(folder, BatchError, "choose another folder with -o"):
            (folder / RUNS).mkdir(parents=True, exist_ok=True)

    def remove_partial(self) -> None:
        """Remove what a killed batch left half written or half removed; nothing else may be writing."""
        for path in (self.folder / RUNS).glob(f"{_PARTIAL}*"):
            if (
                _PARTIAL_NAME.fullmatch(path.name)
                and path.is_dir()
                and not path.is_symlink()
            ):
                remove_written(path)

    def row(self, key: str) -> Row | None:
        """Row of a run; None if it is not done, or its row is lost or belongs to another run."""
        try:
            # a machine that lost power may have kept the folder and not its content
            row = dict(read_json(self.run_folder(key) / ROW))
        except EvaluationError:
            return None
        return row if row.pop(KEY, None) == key else None

    def write(self, key: str, outcome: RunOutcome) -> None:
        """Keep a run.

        Raises `OSError` when there is no space; nothing of the run is left then, and no other run is touched.
        Raises `BatchError` as `discard` does.
        """
        # filled under another name: a folder with its final name is complete
        partial = self._partial_folder(key)
        row = strict_json({KEY: key, **outcome.row}) + "\n"
        contents = {**outcome.files, LOG: outcome.log.encode(), ROW: row.encode()}
        digests = {
            name: [digest_of(BytesIO(content))] for name, content in contents.items()
        }
        partial.mkdir()
        try:
            # before the files, so that what a killed batch leaves here can be removed by its manifest
            Manifest(kind=COMPARISON, files=digests).write(partial / MANIFEST)
            for name, content in contents.items():
                path = partial / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
            self.discard(key)
            partial.rename(self.run_folder(key))
        finally:
            if partial.exists():
                remove_written(partial)

    def discard(self, key: str) -> None:
        """Remove a run, so that it is done again.

        Raises `BatchError` when its folder holds files that this package did not write, or that were changed since.
        """
        folder = self.run_folder(key)
        gone = self._partial_folder(key)
        if others := others_in(folder):
            raise BatchError(
                f"{folder}: would be replaced, and holds {others[0]}, which is not as the run wrote it; move it away"
            )
        with contextlib.suppress(FileNotFoundError):
            # renamed first: a batch killed while it removes a run must not leave half of it under its key
            folder.rename(gone)
            remove_written(gone)

    def run_folder(self, key: str) -> Path:
        """Folder of a run."""
        return self.folder / RUNS / key

    def _partial_folder(self, key: str) -> Path:
        return self.folder / RUNS / f"{_PARTIAL}{key}-{secrets.token_hex(4)}"

    def log_file(self, key: str) -> str:
        """Path of a run's log, relative to the store's folder."""
        return f"{RUNS}/{key}/{LOG}"
