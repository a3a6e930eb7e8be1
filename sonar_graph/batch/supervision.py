"""Runs watched from outside: ended when they take too long or too much memory, repeated once when they are killed.

A run is done in a process of its own kind (`sonar_graph.batch.one_run`), because native code cannot be stopped from
within, and because a crash must not take the Dask worker with it. The process is kept for the next run.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Any, BinaryIO

import psutil

from sonar_graph.batch.one_run import READY
from sonar_graph.batch.store import Limits, PlannedRun, Preparation, Row, RunOutcome
from sonar_graph.errors import BatchError
from sonar_graph.evaluation import describe_environment

ONE_THREAD = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"),
    *("VECLIB_MAXIMUM_THREADS", "TBB_NUM_THREADS"),
)
ONE_ORDER = {"PYTHONHASHSEED": "0"}
"""An estimator may sum over a set of texts: its order, and so the last digits, would be another one in each process."""
LOOK_EVERY_S = 0.2
START_S = 300.0
"""A process that is not ready by then is broken."""
WARM_UP_S = 3600.0
"""The first process on a machine compiles kernels, beside others that do the same."""
OWN = "sonar-graph"
"""Name among the versions of a run whose estimator this package brings. Others are not warmed up: they may take any
time, and that is their runs'."""
JOIN_S = 5.0
"""For the thread that listens to a process that was ended; what left the process's session may keep it listening."""
ATTEMPTS = 2
LOG_CHARACTERS = 100_000
"""Of a run's log its end is kept."""


class KilledError(Exception):
    """The process of a run ended by itself, or was ended by somebody else."""


def perform_watched(run: PlannedRun, limits: Limits) -> RunOutcome:
    """Do a run in one of this process's runners; one that is killed is done once more.

    Returns
    -------
    Its outcome; that of a run which is killed again, takes too long or needs too much memory is a row that says so.

    Raises
    ------
    BatchError, OSError
        When no run could be done here: other versions, no process, no space.
    """
    reason, log = "", ""
    for _ in range(ATTEMPTS):
        with _a_runner() as runner:
            try:
                outcome = runner.perform(run, limits)
                return replace(outcome, row=_here() | outcome.row)
            except KilledError as error:
                reason, log = str(error), runner.log()
    return RunOutcome({**_here(), "status": "killed", "reason": f"{reason}, {ATTEMPTS} times"}, log=log)


def _here() -> Row:
    """Where a run is done, also for those that cannot tell any more."""
    environment = describe_environment()
    return {"python": environment["python"], "machine": environment["machine"]}


_idle: list[Runner] = []
_idle_lock = threading.Lock()


@contextlib.contextmanager
def _a_runner() -> Any:
    """A process of one's own for the block; kept afterwards for the next run if it is fit for it."""
    with _idle_lock:
        runner = _idle.pop() if _idle else None
    if runner is None or not runner.is_fit():
        runner = Runner()
    try:
        yield runner
    finally:
        if runner.is_fit():
            with _idle_lock:
                _idle.append(runner)
        else:
            runner.end()


class Runner:
    """A process that does one run after the other."""

    def __init__(self) -> None:
        self._log = tempfile.TemporaryFile(mode="a+b")  # noqa: SIM115  it is open as long as the process runs
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "sonar_graph.batch.one_run"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env=os.environ | dict.fromkeys(ONE_THREAD, "1") | ONE_ORDER,
            start_new_session=True,  # Ctrl-C in a terminal goes to the batch, which ends this one in its own way
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._requests: Any = self._process.stdin
        self._answers: SimpleQueue[Any] = SimpleQueue()
        self._is_busy = True
        self._warm: set[str] = set()
        collector_arguments = (self._process.stdout, self._answers)
        self._collector = threading.Thread(target=_collect, args=collector_arguments, daemon=True)
        self._collector.start()
        self._await_readiness()

    def _await_readiness(self) -> None:
        """Return when the process has loaded everything; one that does not come so far is ended."""
        try:
            answer = self._wait(Limits(START_S))
            reason = "" if answer == READY else f"it was not ready after {START_S:g} s"
        except KilledError as error:
            reason = str(error)
        if reason:
            said = self.log()[-2000:]
            self.end()
            raise BatchError(f"no process for runs on {platform.node()}: {reason}; {said}")

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def is_fit(self) -> bool:
        """Whether it can take a run."""
        return not self._is_busy and self._process.poll() is None

    def perform(self, run: PlannedRun, limits: Limits) -> RunOutcome:
        """Do one run, after a warm-up where it is the first of its estimator here.

        Raises
        ------
        KilledError
            When the process ended during the run.
        BatchError, OSError
            When the run could not be done at all.
        """
        if OWN in run.versions and run.estimator not in self._warm:
            self._warm.add(run.estimator)
            answer = self._ask(Preparation(run), Limits(WARM_UP_S))
            if answer != READY:
                return RunOutcome(answer.row, log=self.log())
        self._log.truncate(0)
        began = time.monotonic()
        answer = self._ask(run, limits)
        wall_s = time.monotonic() - began
        return replace(answer, row=answer.row | {"wall_s": wall_s}, log=self.log())

    def _ask(self, request: PlannedRun | Preparation, limits: Limits) -> Any:
        self._is_busy = True
        with contextlib.suppress(OSError):  # a process that is gone is told by its missing answer
            pickle.dump(request, self._requests)
            self._requests.flush()
        answer = self._wait(limits)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def log(self) -> str:
        """What the process printed since the run began."""
        self._log.seek(0)
        return self._log.read().decode("utf-8", "replace")[-LOG_CHARACTERS:]

    def end(self) -> None:
        """End the process now, and all that it started: they hold its pipe open."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()
        self._collector.join(JOIN_S)
        with contextlib.suppress(OSError):
            self._requests.close()
        self._log.close()

    def _wait(self, limits: Limits) -> Any:
        """The answer to what was asked; for a run that exceeds its limits an outcome, and the process stays busy."""
        deadline = time.monotonic() + limits.timeout_s
        while True:
            is_gone = self._process.poll() is not None
            with contextlib.suppress(Empty):
                answer = self._answers.get(timeout=LOOK_EVERY_S)
                if answer is None:
                    raise KilledError(self._ending())
                self._is_busy = False
                return answer
            if is_gone:  # what it started may live on and keep the end of its answers from being seen
                raise KilledError(self._ending())
            excess = self._excess(limits, deadline)
            if excess is not None:
                return RunOutcome(excess)

    def _excess(self, limits: Limits, deadline: float) -> Row | None:
        """The row of a run that exceeds its limits."""
        if time.monotonic() > deadline:
            return {"status": "timeout", "reason": f"took longer than {limits.timeout_s:g} s"}
        if limits.memory_mb is not None and _resident_mb(self.pid) > limits.memory_mb:
            return {"status": "memory", "reason": f"its processes needed more than {limits.memory_mb:g} MB"}
        return None

    def _ending(self) -> str:
        code = self._process.wait()
        if code >= 0:
            return f"its process ended with code {code}"
        return f"its process was ended by {signal.Signals(-code).name}"


def _resident_mb(pid: int) -> float:
    """Of a process and of all that it started; of these without what they may share with it."""
    total_bytes = 0
    with contextlib.suppress(psutil.Error):
        process = psutil.Process(pid)
        total_bytes += process.memory_info().rss
        for child in process.children(recursive=True):
            with contextlib.suppress(psutil.Error):
                total_bytes += child.memory_full_info().uss
    return float(total_bytes / 1e6)


def _collect(source: BinaryIO, answers: SimpleQueue[Any]) -> None:
    """Put what a process answers into a queue; None at its end."""
    with source, contextlib.suppress(EOFError, OSError, pickle.UnpicklingError):
        while True:
            answers.put(pickle.load(source))
    answers.put(None)
