"""No run is lost and no number changes when a batch is killed, its workers are killed, or its disk is full.

The same suite is run undisturbed; killed with SIGKILL at random moments and resumed each time; with two processes of
runs killed on the way; with a disk that is full for a while; and through a scheduler of its own on the
loopback address. All tables must be equal, timings aside. A run is lost when it was done once and is not in the end.
"""

import contextlib
import errno
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1]))
import psutil
import pyarrow.parquet as pq
from common import conclude, make_parser, note, print_table

from sonar_graph.batch import RESULTS, Batch, Limits, Where, read_suite
from sonar_graph.batch.result_table import is_timing
from sonar_graph.batch.store import RunOutcome, Store
from sonar_graph.errors import BatchError

SUITE = """
name = "faults"
reference = "dead-reckoning"

[[logs]]
name = "short basin"
generator = "basin"
options = {{ duration_s = 130, laps = 1, wrong_id_rate = 0.05 }}
seeds = {seeds}

[[estimators]]
name = "isam2"

[[estimators]]
name = "ekf-slam"

[[estimators]]
name = "dead-reckoning"
"""
WORKERS = 2
MOST_NEW_RUNS = 4
LONGEST_DELAY_S = 1.0
START_S = 120.0


def command(suite: Path, folder: Path, *options: str) -> list[str]:
    """The command line of a batch."""
    code = "from sonar_graph.cli.main import main; main()"
    where = options or ("--workers", str(WORKERS))
    return [sys.executable, "-c", code, "bench", str(suite), "-o", str(folder), *where]


def done(folder: Path) -> set[str]:
    """Keys of the runs that are kept."""
    return {
        path.parent.name
        for path in folder.glob("runs/*/row.json")
        if not path.parent.name.startswith(".")
    }


def table(folder: Path) -> list[dict[str, Any]]:
    """The rows without timings."""
    rows: list[dict[str, Any]] = pq.read_table(folder / RESULTS).to_pylist()
    return [
        {name: value for name, value in row.items() if not is_timing(name)}
        for row in rows
    ]


def finish(suite: Path, folder: Path, *options: str) -> list[dict[str, Any]]:
    """Run a batch to its end, and read its table."""
    ended = subprocess.run(
        command(suite, folder, *options), capture_output=True, text=True
    )
    if ended.returncode:
        raise RuntimeError(ended.stderr)
    return table(folder)


@contextlib.contextmanager
def started(suite: Path, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A batch on its way."""
    with subprocess.Popen(
        command(suite, folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        yield process


def await_runs(process: subprocess.Popen[bytes], folder: Path, count: int) -> None:
    """Until so many runs are kept, or the batch has ended."""
    while process.poll() is None and len(done(folder)) < count:
        time.sleep(0.02)


def killed_batches(suite: Path, folder: Path, kills: int, chance: random.Random) -> int:
    """Kill the batch again and again; how many runs that were done are gone."""
    kept: set[str] = set()
    for number in range(kills):
        with started(suite, folder) as process:
            await_runs(process, folder, len(kept) + chance.randint(0, MOST_NEW_RUNS))
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(chance.uniform(0, LONGEST_DELAY_S))
            kept |= done(folder)
            process.send_signal(signal.SIGKILL)
        note(f"kill {number + 1} of {kills}: {len(done(folder))} runs kept")
    finish(suite, folder)
    return len(kept - done(folder))


def killed_workers(suite: Path, folder: Path) -> None:
    """Kill a process of a run, and later another one, while they work."""
    with started(suite, folder) as process:
        for count in (2, 5):
            await_runs(process, folder, count)
            kill_one(process.pid)
        process.wait()


def kill_one(batch: int) -> None:
    with contextlib.suppress(psutil.Error):
        victims = [
            child
            for child in psutil.Process(batch).children(recursive=True)
            if is_runner(child.cmdline())
        ]
        if victims:
            victims[0].kill()


def is_runner(arguments: list[str]) -> bool:
    return "sonar_graph.batch.one_run" in arguments


class FullDisk(Store):
    """A store that finds no space from some write on."""

    left = 3

    def write(self, key: str, outcome: RunOutcome) -> None:
        """Writing as on a full disk: a part, then an error."""
        self.left -= 1
        if self.left < 0:
            (self.folder / "runs" / f".partial-{key}-full").mkdir()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        super().write(key, outcome)


def full_disk(suite: Path, folder: Path) -> int:
    """Number of runs lost when the disk is full for a while; the batch must say so."""
    with Batch.opened(read_suite(suite), folder) as batch:
        full = Batch(batch.file, batch.runs, FullDisk(folder))
        try:
            full.run(Where(WORKERS), Limits(3600.0), lambda _run, _outcome: None)
        except BatchError as error:
            note(str(error))
        else:
            raise RuntimeError("a full disk went unnoticed")
    kept = done(folder)
    finish(suite, folder)
    return len(kept - done(folder))


@contextlib.contextmanager
def own_scheduler() -> Iterator[str]:
    """The address of a scheduler on the loopback address, with two workers, all processes of their own."""
    with tempfile.TemporaryDirectory() as scratch, contextlib.ExitStack() as processes:
        told = Path(scratch) / "scheduler.json"
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        options = [
            "--host",
            "127.0.0.1",
            "--port",
            "0",
            "--no-dashboard",
            "--scheduler-file",
            str(told),
        ]
        dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
        commands = [[*dask, *options]]
        worker = [
            sys.executable,
            "-m",
            "distributed.cli.dask_worker",
            "--scheduler-file",
            str(told),
        ]
        commands += [[*worker, "--nthreads", "1", "--no-dashboard"]] * WORKERS
        for arguments in commands:
            process = processes.enter_context(subprocess.Popen(arguments, **quiet))  # type: ignore[call-overload]
            processes.callback(process.terminate)
            await_file(told)
        yield json.loads(told.read_text())["address"]


def await_file(path: Path) -> None:
    deadline = time.monotonic() + START_S
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.1)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--kills", type=int, default=10, help="of the whole batch (default: 10)"
    )
    parser.add_argument(
        "--random", type=int, default=0, help="seed of the moments (default: 0)"
    )
    arguments = parser.parse_args()
    kills, seeds = (2, 4) if arguments.quick else (arguments.kills, 16)
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        suite = root / "suite.toml"
        suite.write_text(SUITE.format(seeds=seeds))
        undisturbed = finish(suite, root / "undisturbed")
        lost = {
            "batch killed": killed_batches(
                suite, root / "batch", kills, random.Random(arguments.random)
            )
        }
        killed_workers(suite, root / "workers")
        lost["workers killed"] = len(undisturbed) - len(done(root / "workers"))
        lost["disk full"] = full_disk(suite, root / "full")
        with own_scheduler() as address:
            finish(suite, root / "scheduler", "--scheduler", address)
        lost["own scheduler"] = len(undisturbed) - len(done(root / "scheduler"))
        again = finish(suite, root / "again")
        names = ("batch", "workers", "full", "scheduler")
        equal = dict(
            zip(
                lost, [table(root / name) == undisturbed for name in names], strict=True
            )
        )
        equal["run again"], lost["run again"] = again == undisturbed, 0
    print_table(
        ("", "runs lost", "rows equal"),
        [(name, lost[name], equal[name]) for name in equal],
    )
    figures = {
        "runs": len(undisturbed),
        "kills": kills,
        "rows_equal": all(equal.values()),
        "runs_lost": sum(lost.values()),
        "all_ok": all(row["status"] == "ok" for row in undisturbed),
    }
    figures["passed"] = (
        figures["rows_equal"] and figures["runs_lost"] == 0 and figures["all_ok"]
    )
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
