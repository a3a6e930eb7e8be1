"""A batch on this machine, or on a Dask scheduler that exists.

Each run is one task, done in a process of its own (`sonar_graph.batch.supervision`): here a thread waits for it, on a
scheduler a worker does. Its outcome travels back to the batch, which alone writes to the store: workers need no common
file system, except for logs, and a full disk is noticed in one place. Decisions: docs/design/0011-batch.md.
"""

import contextlib
import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    CancelledError,
    Future,
    ThreadPoolExecutor,
    as_completed,
)
from functools import partial
from typing import Any

from dask.system import CPU_COUNT
from distributed import Client
from distributed.scheduler import KilledWorker

from sonar_graph.batch.store import (
    Limits,
    PlannedRun,
    Progress,
    RunOutcome,
    Store,
    Where,
)
from sonar_graph.batch.supervision import Runners, perform_watched
from sonar_graph.errors import BatchError, SonarGraphError
from sonar_graph.files import refused

CONNECT_S = 30.0
CLOSE_S = 5.0
Submit = Callable[[PlannedRun, Limits], Future[Any]]


def run_batch(
    runs: Iterable[PlannedRun],
    store: Store,
    limits: Limits,
    where: Where,
    progress: Progress,
) -> None:
    """Do runs and keep each as soon as it is done; ``progress`` is called after that.

    Raises `BatchError` when there is no scheduler or no worker, workers cannot do any run, or nothing can be written.
    Runs that are done by then are kept. Raises `KeyboardInterrupt` on Ctrl-C, when the processes of runs have ended.
    """
    planned = list(runs)
    if not planned:
        return
    connected = (
        _on_this_machine(min(where.workers or CPU_COUNT, len(planned)))
        if where.scheduler is None
        else _on_scheduler(where.scheduler)
    )
    with connected as submit:
        futures = {submit(run, limits): run for run in planned}
        try:
            # no reference to a future is kept, which would keep the files of its run until the batch ends
            for future in as_completed(list(futures)):
                keep(futures.pop(future), future, store, progress)
        finally:
            # a scheduler that exists would go on with the runs of a batch that has ended early
            _within_seconds(lambda: [future.cancel() for future in futures])


def keep(
    run: PlannedRun, future: Future[Any], store: Store, progress: Progress
) -> None:
    """Write the outcome of a finished task to the store; a run whose workers were killed has the status ``killed``.

    Raises `BatchError` when the worker could not do the run at all, or the store cannot be written.
    """
    try:
        outcome = future.result()
    except KilledWorker:
        reason = "the workers that did it were killed, one after the other"
        outcome = RunOutcome({"status": "killed", "reason": reason}, log=f"{reason}\n")
    except CancelledError as error:
        raise BatchError("the scheduler was lost") from error
    except SonarGraphError as error:
        raise BatchError(str(error)) from error
    except (OSError, ImportError) as error:
        raise BatchError(f"a worker cannot do runs: {error}") from error
    assert isinstance(outcome, RunOutcome)
    with refused(store.folder, BatchError):
        store.write(run.key, outcome)
    progress(run, outcome)


@contextlib.contextmanager
def _on_this_machine(workers: int) -> Iterator[Submit]:
    """Do so many runs at a time, each in a process of this machine; the processes end with the block."""
    runners = Runners()
    with ThreadPoolExecutor(workers) as threads:
        try:
            yield lambda run, limits: threads.submit(runners.perform, run, limits)
        finally:
            # first the processes, for which the threads wait
            threads.shutdown(wait=False, cancel_futures=True)
            runners.end()


@contextlib.contextmanager
def _on_scheduler(address: str) -> Iterator[Submit]:
    """Let a scheduler that exists and has at least one worker do the runs.

    Raises `BatchError` without such a scheduler.
    """
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] == "distributed":
            # rows and errors report what Dask would print, a line for each attempt to reconnect
            logging.getLogger(name).setLevel(logging.CRITICAL)
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
        # impure: equal runs of another batch on the same scheduler are other tasks
        yield partial(client.get_executor(pure=False).submit, perform_watched)
    finally:
        _within_seconds(client.close)


def _within_seconds(end: Callable[[], object]) -> None:
    """End something that may wait for a lost partner; after `CLOSE_S` it is left alone."""

    def end_quietly() -> None:
        with contextlib.suppress(Exception):  # the first error is the one to report
            end()

    thread = threading.Thread(target=end_quietly, daemon=True)
    thread.start()
    thread.join(CLOSE_S)
