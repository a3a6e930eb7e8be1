"""Runs watched from outside: ended when they exceed their time or memory, repeated once when they are killed.

A run is done in a process of its own (`sonar_graph.batch.one_run`), because native code cannot be stopped from within
and a crash must not end the batch or the Dask worker. The process is kept for the next run.
"""

from __future__ import annotations

import contextlib
import platform
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import psutil

from sonar_graph.batch.store import Limits, PlannedRun, Preparation, Row, RunOutcome
from sonar_graph.errors import BatchError
from sonar_graph.evaluation import describe_environment
from sonar_graph.files import READY, KilledError, OwnProcess

ONE_THREAD = dict.fromkeys(
    (f"{name}_NUM_THREADS" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA", "TBB")), "1"
) | {"VECLIB_MAXIMUM_THREADS": "1"}
# fixes the order of sets of texts, and with it the last digits of sums over them
ONE_ORDER = {"PYTHONHASHSEED": "0"}
# longest start of a process
START_S = 300.0
# longest warm-up: the first processes on a machine all compile kernels
WARM_UP_S = 3600.0
# name among the versions of a run whose estimator this package brings. Others are not warmed up: they may take
# any time, which then counts for their runs
OWN = "sonar-graph"
ATTEMPTS = 2
# length of the kept end of a run's log
LOG_CHARACTERS = 100_000


class Runner:
    """A process that does one run after the other.

    Raises `BatchError` when the process does not become ready in time.
    """

    def __init__(self) -> None:
        self._log = tempfile.TemporaryFile(mode="a+b")  # noqa: SIM115  it is open as long as the process runs
        self._process = OwnProcess(
            ("-m", "sonar_graph.batch.one_run"), ONE_THREAD | ONE_ORDER, self._log
        )
        self._is_busy = True
        self._is_foreign = False
        self._warm: set[str] = set()
        try:
            if self._wait(Limits(START_S)) != READY:
                raise KilledError(f"it was not ready after {START_S:g} s")
        except KilledError as error:
            said = self.log()[-2000:]
            self.end()
            raise BatchError(
                f"no process for runs on {platform.node()}: {error}; {said}"
            ) from error

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def is_fit(self) -> bool:
        """True if it can take a run: not after one of another package, which may have changed the process."""
        return not self._is_busy and not self._is_foreign and self._process.is_alive()

    def perform(self, run: PlannedRun, limits: Limits) -> RunOutcome:
        """Do one run, after a warm-up if it is the first of its estimator here.

        Raises `KilledError` when the process ended during the run; `BatchError` or `OSError` when the run could not be
        done at all.
        """
        self._is_foreign = OWN not in run.versions
        if not self._is_foreign and run.estimator not in self._warm:
            self._warm.add(run.estimator)
            answer = self._ask(Preparation(run), Limits(WARM_UP_S))
            if answer != READY:
                return RunOutcome(answer.row, log=self.log())
        # the messages of the warm-up are not of the run; the process appends, so its next line is the first
        self._log.truncate(0)
        began = time.monotonic()
        answer = self._ask(run, limits)
        wall_s = time.monotonic() - began
        return replace(answer, row=answer.row | {"wall_s": wall_s}, log=self.log())

    def _ask(self, request: PlannedRun | Preparation, limits: Limits) -> Any:
        self._is_busy = True
        self._process.send(request)
        return self._wait(limits)

    def log(self) -> str:
        """Output of the process since the run began."""
        self._log.seek(0)
        return self._log.read().decode("utf-8", "replace")[-LOG_CHARACTERS:]

    def end(self) -> None:
        """Kill the process and its children."""
        self._process.end()
        self._log.close()

    def _wait(self, limits: Limits) -> Any:
        """Answer to the last request; for a run that exceeds its limits an outcome, and the process stays busy."""
        deadline = time.monotonic() + limits.timeout_s
        while True:
            answer = self._process.look()
            if answer is not None:
                self._is_busy = False
                return answer
            if time.monotonic() > deadline:
                reason = f"took longer than {limits.timeout_s:g} s"
                return RunOutcome({"status": "timeout", "reason": reason})
            most_mb = limits.memory_mb
            if most_mb is not None and resident_mb(self._process.pid) > most_mb:
                reason = f"its processes needed more than {most_mb:g} MB"
                return RunOutcome({"status": "memory", "reason": reason})


class Runners:
    """Processes for runs, kept from one run to the next, for threads that do several runs at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle: list[Runner] = []
        self._busy: set[Runner] = set()
        self._is_ended = False

    def perform(self, run: PlannedRun, limits: Limits) -> RunOutcome:
        """Do a run in one of the processes; a run that is killed is done once more.

        The status in the row is ``killed``, ``timeout`` or ``memory`` where the run was ended.
        Raises `BatchError` or `OSError` when no run can be done here: other versions, no process, no space.
        """
        for _ in range(ATTEMPTS):
            with self._runner() as runner:
                try:
                    outcome = runner.perform(run, limits)
                    return replace(outcome, row=_here() | outcome.row)
                except KilledError as error:
                    reason = f"{error}, {ATTEMPTS} times"
                    log = runner.log()
        return RunOutcome(_here() | {"status": "killed", "reason": reason}, log=log)

    def end(self) -> None:
        """End all processes, also busy ones: threads that wait for their answers get an error."""
        with self._lock:
            self._is_ended = True
            runners = [*self._idle, *self._busy]
            self._idle.clear()
        for runner in runners:
            runner.end()

    @contextlib.contextmanager
    def _runner(self) -> Iterator[Runner]:
        """A process that is fit for a run; kept for the next one if it still is."""
        with self._lock:
            runner = self._idle.pop() if self._idle else None
        if runner is None or not runner.is_fit():
            runner = Runner()
        with self._lock:
            self._busy.add(runner)
            is_ended = self._is_ended
        try:
            if is_ended:
                raise BatchError("the batch was ended")
            yield runner
        finally:
            with self._lock:
                self._busy.discard(runner)
                # after a timeout the process is still busy with the run: it is ended, not kept
                is_kept = runner.is_fit() and not self._is_ended
                if is_kept:
                    self._idle.append(runner)
            if not is_kept:
                runner.end()


def _here() -> Row:
    """Versions of this machine, also for runs that ended without a row."""
    environment = describe_environment()
    return {"python": environment["python"], "machine": environment["machine"]}


# of a Dask worker, which may do several runs at a time, in threads
_runners = Runners()


def perform_watched(run: PlannedRun, limits: Limits) -> RunOutcome:
    """Do a run in one of the processes of this Dask worker, as `Runners.perform`."""
    return _runners.perform(run, limits)


def resident_mb(pid: int) -> float:
    """Resident memory, 10⁶ bytes, of a process with its children; of these without pages shared with it."""
    total_bytes = 0
    with contextlib.suppress(psutil.Error):
        process = psutil.Process(pid)
        total_bytes += process.memory_info().rss
        for child in process.children(recursive=True):
            with contextlib.suppress(psutil.Error):
                total_bytes += child.memory_full_info().uss
    return float(total_bytes / 1e6)
