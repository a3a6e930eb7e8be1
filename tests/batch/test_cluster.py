"""Batches on real clusters. Kills at random moments, and the same through a scheduler of its own: the benchmark
`batch_faults`, whose short version is run here."""

import contextlib
import importlib
import json
import math
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from distributed import LocalCluster

from sonar_graph.batch import Limits, Where
from sonar_graph.batch import cluster as execution
from sonar_graph.batch.cluster import run_batch
from sonar_graph.batch.store import PlannedRun, RunOutcome, Store
from sonar_graph.errors import BatchError

from .conftest import BASIN, DEAD_RECKONING, HEADER

VALIDATION = Path(__file__).parents[2] / "benchmarks" / "validation"
MAIN = """
import signal
from sonar_graph.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # shells let what they start in the background ignore it
main()
"""
SLEEPS = '[[estimators]]\nname = "sleeps"\n'
GOING_ON = "runs are done and kept; the same command goes on from there"
pytestmark = pytest.mark.slow


def bench(suite: Path, folder: Path, *options: str) -> subprocess.Popen[str]:
    words = ["-c", MAIN, "bench", str(suite), "-o", str(folder), *options]
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, *words], start_new_session=True, **pipes)


def test_faults_lose_no_run_and_change_no_number():
    command = [sys.executable, str(VALIDATION / "batch_faults.py"), "--quick"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout.splitlines()[-1])
    expected = {"rows_equal": True, "runs_lost": 0, "all_ok": True}
    assert figures.items() >= expected.items()


def test_rows_that_differ_are_told_apart_and_times_are_not_compared(
    tmp_path, monkeypatch
):
    monkeypatch.syspath_prepend(str(VALIDATION))
    faults = importlib.import_module("batch_faults")

    def table(**row: float) -> object:
        rows = pa.Table.from_pylist([{"key": "a"} | row])
        pq.write_table(rows, tmp_path / "results.parquet")
        return faults.table(tmp_path)

    key = "causal.ate_raw_m"
    first = table(**{key: 0.1, "wall_s": 1.0})
    assert table(**{key: 0.1, "wall_s": 2.0}) == first
    assert table(**{key: math.nextafter(0.1, 1), "wall_s": 1.0}) != first


def wait_for_a_run(folder: Path, process: subprocess.Popen[str]) -> None:
    """Until the first run is kept."""
    while not list(folder.glob("runs/*/row.json")):
        assert process.poll() is None
        time.sleep(0.05)


@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_ends_in_seconds_says_how_to_go_on_and_leaves_no_process(
    write_suite, misbehaving, tmp_path, ended_by
):
    suite = write_suite(HEADER, BASIN, "seeds = 2\n", DEAD_RECKONING, SLEEPS)
    with bench(suite, tmp_path / "out", "--workers", "1") as process:
        wait_for_a_run(tmp_path / "out", process)
        time.sleep(1.0)
        family = psutil.Process(process.pid).children(recursive=True)
        assert family
        began = time.monotonic()
        process.send_signal(ended_by)
        _, said = process.communicate(timeout=60)
    assert time.monotonic() - began < 20
    assert process.returncode == 130
    assert said == f"sonar-graph: interrupted; 1 of 4 {GOING_ON}\n"
    _, alive = psutil.wait_procs(family, timeout=10)
    assert not alive
    statuses = pq.read_table(tmp_path / "out" / "results.parquet")["status"].to_pylist()
    assert statuses == ["ok", "not run", "not run", "not run"]


def test_scheduler_that_is_lost_is_told_and_what_is_done_is_kept(
    write_suite, misbehaving, tmp_path
):
    suite = write_suite(HEADER, BASIN, DEAD_RECKONING, SLEEPS)
    told = tmp_path / "scheduler.json"

    def dask(name: str, *options: str) -> subprocess.Popen[bytes]:
        words = [sys.executable, "-m", f"distributed.cli.dask_{name}", "--no-dashboard"]
        quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return subprocess.Popen([*words, "--scheduler-file", told, *options], **quiet)

    with dask("scheduler", "--host", "127.0.0.1", "--port", "0") as scheduler:
        while not told.exists():
            time.sleep(0.05)
        address = json.loads(told.read_text())["address"]
        with dask("worker", "--nthreads", "1") as worker:
            with bench(suite, tmp_path / "out", "--scheduler", address) as process:
                wait_for_a_run(tmp_path / "out", process)
                scheduler.kill()
                _, said = process.communicate(timeout=120)
            worker.terminate()
    assert process.returncode == 2
    (line,) = said.splitlines()
    assert "the scheduler was lost" in line
    assert line.endswith(f"1 of 2 {GOING_ON}")


def test_end_of_a_batch_leaves_the_equal_runs_of_another_on_the_scheduler(
    planned, tmp_path, monkeypatch
):
    """The first batch is waiting while the second one, of the same run, fails and cancels its requests."""
    done: list[str] = []
    run = planned()

    def told(planned_run, _outcome):
        done.append(planned_run.key)

    monkeypatch.setattr(execution, "perform_watched", wait_a_second)
    with LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=":0"
    ) as cluster:
        where = Where(scheduler=cluster.scheduler_address)
        first = threading.Thread(
            target=run_batch,
            args=([run], Store(tmp_path / "a"), Limits(9.0), where, told),
        )
        first.start()
        time.sleep(0.5)
        with contextlib.suppress(BatchError):
            run_batch([run], Store(tmp_path / "b"), Limits(0.0), where, told)
        first.join(20)
    assert not first.is_alive()
    assert done == [run.key]


def wait_a_second(_run: PlannedRun, limits: Limits) -> RunOutcome:
    """In place of a run; one without time cannot be done."""
    if limits.timeout_s == 0:
        raise BatchError("no time")
    time.sleep(1.0)
    return RunOutcome({"status": "ok"})


def test_missing_scheduler_is_one_line(write_suite, tmp_path):
    with bench(
        write_suite(), tmp_path / "out", "--scheduler", "tcp://127.0.0.1:9"
    ) as process:
        _, said = process.communicate(timeout=120)
    assert process.returncode == 2
    assert len(said.splitlines()) == 1
    assert "no Dask scheduler at tcp://127.0.0.1:9" in said
