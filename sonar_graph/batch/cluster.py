"""A batch on Dask: a cluster of this machine's processes, or a scheduler that exists.

Each run is one task. Its outcome travels back to the batch, which alone writes to the store: workers need no common
file system, except for logs, and a full disk is noticed in one place. Workers on this machine preload this module
(`dask_setup`). Decisions: docs/design/0011-batch.md.
"""

import contextlib
import logging
import signal
import threading
import uuid
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import dask
import psutil
from dask.system import CPU_COUNT
from distributed import Client, Future, LocalCluster, as_completed
from distributed.client import FutureCancelledError
from distributed.scheduler import KilledWorker

from sonar_graph.batch.store import (
    Limits,
    PlannedRun,
    Progress,
    RunOutcome,
    Store,
    Where,
)
from sonar_graph.batch.supervision import perform_watched
from sonar_graph.errors import BatchError, SonarGraphError

CONNECT_S = 30.0
CLOSE_S = 5.0
LOOPBACK = "127.0.0.1"
"""Address on which this machine's scheduler, workers and their pages listen: no other machine reaches them."""
DASK_SETTINGS = {
    "distributed.scheduler.allowed-failures": 1,
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.tick.limit": "1h",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.worker.preload": ["sonar_graph.batch.cluster"],
}
"""One retry after a worker is killed. Memory is watched by `supervision`, not by Dask. Dask's self-monitoring is made
for many small tasks and is slowed down here, because it takes time from the runs."""


def run_batch(
    runs: Iterable[PlannedRun],
    store: Store,
    limits: Limits,
    where: Where,
    progress: Progress,
) -> None:
    """Do runs and keep each as soon as it is done; ``progress`` is called after that.

    Raises `BatchError` when there is no scheduler or no worker, workers cannot do any run, or nothing can be written.
    Runs that are done by then are kept. Raises `KeyboardInterrupt` on Ctrl-C, when the workers have ended.
    """
    planned = list(runs)
    if not planned:
        return
    connected = (
        _local_client(min(where.workers or CPU_COUNT, len(planned)))
        if where.scheduler is None
        else _remote_client(where.scheduler)
    )
    with dask.config.set(DASK_SETTINGS), _silent_dask(), connected as client:
        # equal keys are one task for a scheduler, which other batches use too
        this_batch = uuid.uuid4().hex
        submitted = (
            client.submit(
                perform_watched,
                run,
                limits,
                key=f"run-{run.key}-{this_batch}",
                pure=False,
            )
            for run in planned
        )
        futures = dict(zip(submitted, planned, strict=True))
        try:
            for future in as_completed(list(futures)):
                keep(futures.pop(future), future, store, progress)
                # the scheduler would keep the outcome, with all files of the run, until the batch ends
                future.release()
        except FutureCancelledError as error:
            raise BatchError(f"the scheduler was lost: {error}") from error
        finally:
            # a scheduler that exists would go on with the runs of a batch that has ended early
            _within_seconds(lambda: client.cancel(list(futures)))


def keep(
    run: PlannedRun, future: Future[Any], store: Store, progress: Progress
) -> None:
    """Write the outcome of a finished task to the store; a run whose workers were killed has a row that says so.

    Raises `BatchError` when the worker could not do the run at all, or the store cannot be written.
    """
    try:
        outcome = future.result()
    except KilledWorker:
        reason = "the workers that did it were killed, one after the other"
        outcome = RunOutcome({"status": "killed", "reason": reason}, log=f"{reason}\n")
    except SonarGraphError as error:
        raise BatchError(str(error)) from error
    except (OSError, ImportError) as error:
        raise BatchError(f"a worker cannot do runs: {error}") from error
    assert isinstance(outcome, RunOutcome)
    try:
        store.write(run.key, outcome)
    except OSError as error:
        raise BatchError(
            f"{store.folder}: cannot be written: {error.strerror or error}"
        ) from error
    progress(run, outcome)


@contextlib.contextmanager
def _remote_client(address: str) -> Iterator[Client]:
    """Client of a scheduler that exists and has at least one worker.

    Raises `BatchError` when there is none.
    """
    try:
        client = Client(address, timeout=CONNECT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise BatchError(f"no Dask scheduler at {address}: {error}") from error
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError as error:
        client.close()
        raise BatchError(
            f"the scheduler at {address} has no worker after {CONNECT_S:g} s; start some"
        ) from error
    try:
        yield client
    finally:
        _within_seconds(client.close)


@contextlib.contextmanager
def _local_client(workers: int) -> Iterator[Client]:
    """Client of a cluster on this machine that lives as long as the block.

    Raises `BatchError` when no worker can be started.
    """
    try:
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            memory_limit=None,
            host=LOOPBACK,
            dashboard_address=f"{LOOPBACK}:0",
            worker_dashboard_address=f"{LOOPBACK}:0",
            silence_logs=logging.CRITICAL,
        )
    except RuntimeError as error:
        raise BatchError(
            f"no worker could be started ({error}); a script that runs a batch does so under "
            '`if __name__ == "__main__":`, since workers import it'
        ) from error
    client = Client(cluster)
    try:
        yield client
    finally:
        # taken before the cluster is closed, which forgets its workers
        pids = [
            nanny.pid for nanny in cluster.workers.values() if nanny.pid is not None
        ]
        workers_here = [psutil.Process(pid) for pid in pids if psutil.pid_exists(pid)]
        _within_seconds(client.close)
        _within_seconds(cluster.close)
        for process in workers_here:  # the processes of runs end when these do
            with contextlib.suppress(psutil.Error):
                process.kill()


def _within_seconds(end: Callable[[], object]) -> None:
    """End something that may wait for a lost partner; after `CLOSE_S` it is left alone."""

    def end_quietly() -> None:
        with contextlib.suppress(Exception):  # the first error is the one to report
            end()

    thread = threading.Thread(target=end_quietly, daemon=True)
    thread.start()
    thread.join(CLOSE_S)


@contextlib.contextmanager
def _silent_dask() -> Iterator[None]:
    """Suppress Dask's own messages; rows report workers that were lost."""
    names = [
        name
        for name in logging.root.manager.loggerDict
        if name.partition(".")[0] == "distributed"
    ]
    before = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


def dask_setup(_worker: object) -> None:
    """Let a new worker ignore Ctrl-C, which a terminal sends to it too; the batch ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
