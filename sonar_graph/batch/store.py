"""Runs on disk: each written once, whole or not at all, under its key.

::

    DIR/.lock                   held by the batch that runs
    DIR/suite.toml              the suite, as it was given, once a run of it is done
    DIR/results.parquet         one row for each planned run
    DIR/runs/KEY/row.json       the row of a run
    DIR/runs/KEY/log.txt        what its process printed, tracebacks with it
    DIR/runs/KEY/...            what `sonar-graph compare` writes, where the run came so far

A run's folder is filled under another name and then renamed, and has another name again before it is removed. So a
folder that has its name is complete.
"""

from __future__ import annotations

import contextlib
import shutil
import uuid
from pathlib import Path

from sonar_graph.batch.planned import Outcome, Row
from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation.strict_json import read_json, write_json

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

    def write(self, key: str, outcome: Outcome) -> None:
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
