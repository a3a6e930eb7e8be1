"""Batches on real clusters. Kills at random moments, and the same through a scheduler of its own: the benchmark
`batch_faults`, whose short version is run here."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet as pq
import pytest

from .conftest import BASIN, DEAD_RECKONING, HEADER

VALIDATION = Path(__file__).parents[2] / "benchmarks" / "validation"
MAIN = """
import signal
from sonar_graph.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # shells let what they start in the background ignore it
main()
"""
pytestmark = pytest.mark.slow


def bench(suite: Path, folder: Path, *options: str) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-c",
        MAIN,
        "bench",
        str(suite),
        "-o",
        str(folder),
        *options,
    ]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def test_faults_lose_no_run_and_change_no_number():
    command = [sys.executable, str(VALIDATION / "batch_faults.py"), "--quick"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout.splitlines()[-1])
    assert (figures["rows_equal"], figures["runs_lost"], figures["all_ok"]) == (
        True,
        0,
        True,
    )


def wait_for_a_run(folder: Path, process: subprocess.Popen[str]) -> None:
    """Until the first run is kept."""
    while not list(folder.glob("runs/*/row.json")):
        assert process.poll() is None
        time.sleep(0.05)


@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_ends_in_seconds_says_how_to_go_on_and_leaves_no_process(
    write_suite, misbehaving, tmp_path, ended_by
):
    sleeps = '[[estimators]]\nname = "sleeps"\n'
    suite = write_suite(HEADER, BASIN, "seeds = 2\n", DEAD_RECKONING, sleeps)
    with bench(suite, tmp_path / "out", "--workers", "1") as process:
        wait_for_a_run(tmp_path / "out", process)
        time.sleep(1.0)
        family = psutil.Process(process.pid).children(recursive=True)
        assert family
        began = time.monotonic()
        os.kill(process.pid, ended_by)
        _, said = process.communicate(timeout=60)
    assert time.monotonic() - began < 20
    assert process.returncode == 130
    (line,) = said.splitlines()
    assert (
        line
        == "sonar-graph: interrupted; 1 of 4 runs are done and kept; the same command goes on from there"
    )
    _, alive = psutil.wait_procs(family, timeout=10)
    assert not alive
    statuses = pq.read_table(tmp_path / "out" / "results.parquet")["status"].to_pylist()
    assert statuses == ["ok", "not run", "not run", "not run"]


def test_scheduler_that_is_lost_is_told_and_what_is_done_is_kept(
    write_suite, misbehaving, tmp_path
):
    suite = write_suite(
        HEADER, BASIN, DEAD_RECKONING, '[[estimators]]\nname = "sleeps"\n'
    )
    told = ["--scheduler-file", str(tmp_path / "scheduler.json"), "--no-dashboard"]
    quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    dask = [
        sys.executable,
        "-m",
        "distributed.cli.dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
    ]
    with subprocess.Popen([*dask, *told], **quiet) as scheduler:
        while not (tmp_path / "scheduler.json").exists():
            time.sleep(0.05)
        address = json.loads((tmp_path / "scheduler.json").read_text())["address"]
        dask = [sys.executable, "-m", "distributed.cli.dask_worker", "--nthreads", "1"]
        with subprocess.Popen([*dask, *told], **quiet) as worker:
            with bench(suite, tmp_path / "out", "--scheduler", address) as process:
                wait_for_a_run(tmp_path / "out", process)
                scheduler.kill()
                _, said = process.communicate(timeout=120)
            worker.terminate()
    assert process.returncode == 2
    (line,) = said.splitlines()
    assert "the scheduler was lost" in line
    assert line.endswith(
        "1 of 2 runs are done and kept; the same command goes on from there"
    )


def test_missing_scheduler_is_one_line(write_suite, tmp_path):
    with bench(
        write_suite(), tmp_path / "out", "--scheduler", "tcp://127.0.0.1:9"
    ) as process:
        _, said = process.communicate(timeout=120)
    assert process.returncode == 2
    assert len(said.splitlines()) == 1
    assert "no Dask scheduler at tcp://127.0.0.1:9" in said
