"""A batch on Dask: a cluster of this machine's processes, or one that exists.

One task a run. What a run leaves travels back to the batch, which alone writes to the store: workers need no common
file system, except for logs, and a full disk is met in one place.

Loaded by the Dask workers of this machine: Ctrl-C in a terminal goes to them too, and the batch ends them itself.
"""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
import uuid
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import dask
import psutil
from dask.system import CPU_COUNT
from distributed import Client, Future, LocalCluster, as_completed
from distributed.client import FutureCancelledError
from distributed.scheduler import KilledWorker

from sonar_graph.batch.store import Limits, PlannedRun, RunOutcome, Store
from sonar_graph.batch.supervision import perform_watched
from sonar_graph.errors import BatchError, SonarGraphError

CONNECT_S = 30.0
CLOSE_S = 5.0
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
"""One retry for the run of a worker that is killed; memory is that of the runs' own processes, watched there; and
Dask's looking at itself, made for many small tasks, is rare: it takes time from the runs."""


@dataclass(frozen=True)
class Where:
    """Who does the runs."""

    workers: int | None = None
    """On this machine; None: one for each of its cores that this process may use."""
    scheduler: str | None = None
    """Address of a Dask scheduler that exists, in place of workers here."""

    @property
    def local_workers(self) -> int:
        """How many there are on this machine."""
        return self.workers or CPU_COUNT


Progress = Callable[[PlannedRun, RunOutcome], None]


def run_batch(runs: Iterable[PlannedRun], store: Store, limits: Limits, where: Where, progress: Progress) -> None:
    """Do runs and keep each as soon as it is done.

    Parameters
    ----------
    runs
        Those that are not done yet.
    progress
        Called after a run is kept.

    Raises
    ------
    BatchError
        When there is no scheduler or no worker, workers cannot do any run, or nothing can be written. What is done by
        then is kept.
    KeyboardInterrupt
        On Ctrl-C, after a few seconds in which workers are ended.
    """
    planned = list(runs)
    if not planned:
        return
    with dask.config.set(DASK_SETTINGS), _quiet(), _client(where, len(planned)) as client:
        this_batch = uuid.uuid4().hex  # tasks of equal keys are one for a scheduler, which other batches use too
        submitted = (
            client.submit(perform_watched, run, limits, key=f"run-{run.key}-{this_batch}", pure=False)
            for run in planned
        )
        futures = dict(zip(submitted, planned, strict=True))
        try:
            for future in as_completed(list(futures)):
                _keep(futures.pop(future), future, store, progress)
                future.release()
        except FutureCancelledError as error:
            raise BatchError(f"the scheduler was lost: {error}") from error
        finally:
            _within_seconds(lambda: client.cancel(list(futures)))


def _keep(run: PlannedRun, future: Future[Any], store: Store, progress: Progress) -> None:
    outcome = _outcome(future)
    try:
        store.write(run.key, outcome)
    except OSError as error:
        raise BatchError(f"{store.folder}: cannot be written: {error.strerror or error}") from error
    progress(run, outcome)


def _outcome(future: Future[Any]) -> RunOutcome:
    """What a run left; workers that were killed under it leave a row that says so."""
    try:
        outcome = future.result()
    except KilledWorker:
        reason = "the workers that did it were killed, one after the other"
        return RunOutcome({"status": "killed", "reason": reason}, log=f"{reason}\n")
    except SonarGraphError as error:
        raise BatchError(str(error)) from error
    except (OSError, ImportError) as error:
        raise BatchError(f"a worker cannot do runs: {error}") from error
    assert isinstance(outcome, RunOutcome)
    return outcome


@contextlib.contextmanager
def _client(where: Where, tasks: int) -> Iterator[Client]:
    """A client of the scheduler there is, or of a cluster that lives as long as the block.

    Raises
    ------
    BatchError
        When the scheduler cannot be reached, or no worker can be started here.
    """
    if where.scheduler is not None:
        client = _connected(where.scheduler)
        try:
            yield client
        finally:
            _within_seconds(client.close)
        return
    cluster = _local_cluster(min(where.local_workers, tasks))
    client = Client(cluster)
    try:
        yield client
    finally:
        workers = _worker_processes(cluster)
        _within_seconds(client.close)
        _within_seconds(cluster.close)
        for process in workers:
            with contextlib.suppress(psutil.Error):
                process.kill()


def _local_cluster(workers: int) -> LocalCluster:
    try:
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            memory_limit=None,
            dashboard_address=":0",
            silence_logs=logging.CRITICAL,
        )
    except RuntimeError as error:
        raise BatchError(
            f"no worker could be started ({error}); a script that runs a batch does so under "
            '`if __name__ == "__main__":`, since workers import it'
        ) from error


def _worker_processes(cluster: Any) -> list[psutil.Process]:
    """The processes of a cluster of this machine; runs' own processes end when these do."""
    pids = [nanny.pid for nanny in cluster.workers.values() if nanny.pid is not None]
    return [psutil.Process(pid) for pid in pids if psutil.pid_exists(pid)]


def _within_seconds(end: Callable[[], object]) -> None:
    """End something that may wait for what is gone; after some seconds it is left to itself."""

    def end_quietly() -> None:
        with contextlib.suppress(Exception):  # the first error is the one to tell
            end()

    thread = threading.Thread(target=end_quietly, daemon=True)
    thread.start()
    thread.join(CLOSE_S)


def _connected(address: str) -> Client:
    """A client of a scheduler that has at least one worker.

    Raises
    ------
    BatchError
        When there is none.
    """
    try:
        client = Client(address, timeout=CONNECT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise BatchError(f"no Dask scheduler at {address}: {error}") from error
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError as error:
        client.close()
        raise BatchError(f"the scheduler at {address} has no worker after {CONNECT_S:g} s; start some") from error
    return client


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without Dask's own messages: workers that come and go are told by rows."""
    names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]
    before = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


def dask_setup(_worker: object) -> None:
    """Leave the signal to the batch; Dask calls this when a worker starts."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
