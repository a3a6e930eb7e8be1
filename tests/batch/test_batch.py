"""A batch resumes, loses no run, and ends in time on Ctrl-C."""

import contextlib
import errno
import math
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from sonar_graph.batch import (
    RESULTS,
    Batch,
    Limits,
    Where,
    cluster,
    is_batch,
    read_batch,
    read_suite,
)
from sonar_graph.batch import batch as batch_module
from sonar_graph.batch.result_table import is_timing
from sonar_graph.batch.store import PlannedRun, RunOutcome, Store
from sonar_graph.errors import BatchError, EvaluationError
from sonar_graph.files import (
    deferred_interrupt,
    noticed_interrupts,
    terminations_as_interrupts,
)
from tests.dying import Died

from .conftest import BASIN, DEAD_RECKONING, HEADER


def opened(suite: Path, folder: Path) -> contextlib.AbstractContextManager[Batch]:
    return Batch.opened(read_suite(suite), folder)


def run_all(batch: Batch) -> None:
    batch.run(Where(1), Limits(600.0), lambda *_: None)


def table(folder: Path) -> list[dict[str, Any]]:
    """Rows without times."""
    rows = pq.read_table(folder / RESULTS).to_pylist()
    return [
        {key: value for key, value in row.items() if not is_timing(key)} for row in rows
    ]


def do_here(runs: list[PlannedRun], store: Store, *_others: Any) -> None:
    """As `run_batch`, with a result that the seed decides."""
    for run in runs:
        store.write(run.key, done(run))


def done(run: PlannedRun) -> RunOutcome:
    row = {"status": "ok", "causal.ate_raw_m": math.sqrt(1.0 + run.seed)}
    return RunOutcome(row, files={"runs/a.txt": b"a"})


@pytest.fixture
def suite(write_suite) -> Path:
    return write_suite(HEADER, BASIN, "seeds = 4\n", DEAD_RECKONING)


@pytest.fixture
def in_this_process(monkeypatch):
    monkeypatch.setattr(cluster, "run_batch", do_here)


def statuses_after(batch: Batch) -> Counter[str]:
    """Number of runs by status, after all of them were done."""
    run_all(batch)
    return Counter(str(row["status"]) for row in batch.rows().values())


def finished(suite: Path, folder: Path) -> list[dict[str, Any]]:
    with opened(suite, folder) as batch:
        assert statuses_after(batch) == {"ok": 4}
    return table(folder)


def test_resumed_batch_has_the_table_of_an_undisturbed_one(
    suite, tmp_path, in_this_process, monkeypatch
):
    undisturbed = finished(suite, tmp_path / "a")
    assert len({row["causal.ate_raw_m"] for row in undisturbed}) == 4
    begun: set[str] = set()

    def interrupted(runs, store, *_others):
        do_here(runs[:1], store)
        begun.add(runs[0].key)
        raise KeyboardInterrupt

    folder = tmp_path / "b"
    for count in (1, 2, 3):
        monkeypatch.setattr(cluster, "run_batch", interrupted)
        with opened(suite, folder) as batch, pytest.raises(KeyboardInterrupt):
            run_all(batch)
        statuses = [row["status"] for row in table(folder)]
        assert statuses == ["ok"] * count + ["not run"] * (4 - count)
        assert batch.resuming().startswith(f"{count} of 4 runs are done and kept")
    monkeypatch.setattr(cluster, "run_batch", do_here)
    assert finished(suite, folder) == undisturbed
    assert len(begun) == 3


def test_full_disk_is_told_and_loses_no_run_that_is_done(
    suite, tmp_path, in_this_process, monkeypatch
):
    folder = tmp_path / "out"

    def no_space(*_arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    class Full(Store):
        def write(self, key, outcome):
            if len(list((self.folder / "runs").iterdir())) == 2:
                no_space()
            super().write(key, outcome)

    def kept(runs, store, *_others):
        for run in runs:
            future: Future[RunOutcome] = Future()
            future.set_result(done(run))
            cluster.keep(run, future, store, lambda *_: None)

    told = "No space left.*2 of 4 runs are done and kept; the same command"
    with opened(suite, folder) as batch, monkeypatch.context() as patch:
        patch.setattr(cluster, "run_batch", kept)
        patch.setattr(batch_module, "write_results", no_space)
        with pytest.raises(BatchError, match=told):
            run_all(replace(batch, store=Full(folder)))
    stamps = {path: path.stat().st_mtime_ns for path in folder.glob("runs/*/row.json")}
    finished(suite, folder)
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps


def test_what_a_killed_batch_did_is_read_with_what_it_did_not_do(
    suite, tmp_path, in_this_process, monkeypatch
):
    folder = tmp_path / "out"
    told = r"before any of its runs was done; give the bench command .* again"
    with monkeypatch.context() as patch:
        kill(suite, folder, 0, patch)
        assert is_batch(folder)
        with pytest.raises(EvaluationError, match=told):
            read_batch(folder)
        kill(suite, folder, 3, patch)
    batch = read_batch(folder)
    found = [(run.seed, run.status) for run in (*batch.runs, *batch.missing)]
    assert found == [(0, "ok"), (1, "ok"), (2, "ok"), (3, "not run")]
    finished(suite, folder)
    whole = read_batch(folder)
    assert not whole.missing
    assert whole.runs[:3] == batch.runs


def test_a_changed_suite_resumes_in_its_folder(
    suite, tmp_path, in_this_process, monkeypatch
):
    folder = tmp_path / "out"

    def refused(told):
        with pytest.raises(BatchError, match=told), opened(suite, folder):
            pass

    def contents():
        return [(folder / name).read_bytes() for name in ("suite.toml", RESULTS)]

    text = suite.read_text()
    suite.write_text(text + '[[estimators]]\nname = "no such"\n')
    refused("no estimator is called 'no such'")
    assert not folder.exists(), "a suite with a mistake makes no folder"
    suite.write_text(text)
    before = finished(suite, folder)
    text = text.replace("seeds = 4", "seeds = 5")
    suite.write_text(text)
    with opened(suite, folder) as batch:
        assert len(batch.rows()) == 4
        run_all(batch)
    assert table(folder)[:4] == before
    kept = contents()
    assert kept[0] == text.encode()
    suite.write_text(text.replace("short", "other"))
    refused(
        r"holds the batch of suite 'short', and .* is suite 'other'; choose another"
    )
    suite.write_text(text.replace("duration_s = 120", "duration_s = 125"))
    kill(suite, folder, 0, monkeypatch)
    assert contents() == kept
    kill(suite, folder, 1, monkeypatch)
    assert contents()[0] == suite.read_bytes()
    assert [row["status"] for row in table(folder)] == ["ok", *["not run"] * 4]


def test_failed_runs_are_kept_until_they_are_discarded(
    suite, tmp_path, in_this_process
):
    late = RunOutcome({"status": "timeout", "reason": "took longer than 1 s"})
    with opened(suite, tmp_path) as batch:
        batch.store.write(batch.runs[0].key, late)
        for _ in range(2):
            assert statuses_after(batch) == {"ok": 3, "timeout": 1}
        batch.discard_failed()
        assert statuses_after(batch) == {"ok": 4}


def kill(
    suite: Path, folder: Path, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some runs are done and reported, and then the process is gone."""

    def killed(runs, store, *others):
        for run in runs[:count]:
            do_here([run], store)
            others[-1](run, RunOutcome({"status": "ok"}))
        raise Died

    monkeypatch.setattr(cluster, "run_batch", killed)
    with opened(suite, folder) as batch, pytest.raises(Died):
        run_all(batch)


@pytest.fixture
def handler(request) -> Iterator[Any]:
    """The handler of interrupts, Python's own or another one; tests must leave it, and that of terminations, as is."""
    numbers = signal.SIGINT, signal.SIGTERM
    before = [signal.getsignal(number) for number in numbers]
    given = getattr(request, "param", signal.default_int_handler)
    signal.signal(signal.SIGINT, given)
    yield given
    left = [signal.getsignal(number) for number in numbers]
    signal.signal(signal.SIGINT, before[0])
    assert left == [given, before[1]]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_or_termination_within_the_block_is_told_at_its_end(handler, number):
    steps: list[str] = []

    def interrupted_block():
        with terminations_as_interrupts(), deferred_interrupt():
            try:
                signal.raise_signal(number)
            except KeyboardInterrupt:
                pytest.fail("swallowed here, and lost")
            steps.append("went on")

    with pytest.raises(KeyboardInterrupt):
        interrupted_block()
    assert steps == ["went on"]


def test_an_interrupt_swallowed_by_compiled_code_is_noticed(handler):
    with noticed_interrupts() as check:
        check()
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            check()


INTERRUPTED_BOXING = """
import ctypes, signal, time
from typing import NamedTuple
import numba, numpy as np
from sonar_graph.files import noticed_interrupts, terminations_as_interrupts

class Pair(NamedTuple):
    first: int
    second: int

send = ctypes.CDLL(None)["raise"]
send.argtypes = [ctypes.c_int]
send.restype = ctypes.c_int

@numba.njit
def interrupted(number):
    send(number)
    return 1, Pair(2, 3), np.zeros(3)

for number in (signal.SIGINT, signal.SIGINT, signal.SIGTERM):
    try:
        with terminations_as_interrupts(), noticed_interrupts():
            print(interrupted(number)[1])
            time.sleep(10.0)
    except KeyboardInterrupt:
        print("interrupted")
"""


def test_an_interrupt_while_results_are_made_comes_after_them():
    command = [sys.executable, "-c", INTERRUPTED_BOXING]
    script = subprocess.run(command, capture_output=True, text=True, check=False)
    expected = "Pair(first=2, second=3)\ninterrupted\n" * 3
    assert script.stdout == expected, script


@pytest.mark.parametrize(
    "handler", [signal.default_int_handler, signal.SIG_IGN], indirect=True
)
def test_termination_counts_like_an_interrupt(handler):
    with pytest.raises(KeyboardInterrupt), terminations_as_interrupts():
        signal.raise_signal(signal.SIGTERM)
    if handler is signal.SIG_IGN:
        with deferred_interrupt():
            signal.raise_signal(signal.SIGINT)
