"""Runs watched from outside: ended when they exceed their time or memory, repeated once when they are killed.

A run is done in a process of its own (`sonar_graph.batch.one_run`), because native code cannot be stopped from within
and a crash must not end the Dask worker. The process is kept for the next run.
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
"""Fixes the order of sets of texts, and with it the last digits of sums over them."""
LOOK_EVERY_S = 0.2
START_S = 300.0
"""Longest start of a process."""
WARM_UP_S = 3600.0
"""Longest warm-up: the first processes on a machine all compile kernels."""
OWN = "sonar-graph"
"""Name among the versions of a run whose estimator this package brings. Others are not warmed up: they may take any
time, which then counts for their runs."""
JOIN_S = 5.0
"""Longest wait for the thread that listens to an ended process, whose detached children may keep the pipe open."""
ATTEMPTS = 2
LOG_CHARACTERS = 100_000
"""Length of the kept end of a run's log."""


class KilledError(Exception):
    """The process of a run ended by itself or was killed."""


def perform_watched(run: PlannedRun, limits: Limits) -> RunOutcome:
    """Do a run in one of this process's runners; a run that is killed is done once more.

    The row of the outcome says where a run was killed again, took too long or needed too much memory.
    Raises `BatchError` or `OSError` when no run can be done here: other versions, no process, no space.
    """
    reason, log = "", ""
    for _ in range(ATTEMPTS):
        with _idle_lock:
            runner = _idle.pop() if _idle else None
        if runner is None or not runner.is_fit():
            runner = Runner()
        try:
            outcome = runner.perform(run, limits)
            return replace(outcome, row=_here() | outcome.row)
        except KilledError as error:
            reason, log = str(error), runner.log()
        finally:
            if runner.is_fit():
                with _idle_lock:
                    _idle.append(runner)
            else:
                runner.end()
    return RunOutcome({**_here(), "status": "killed", "reason": f"{reason}, {ATTEMPTS} times"}, log=log)


def _here() -> Row:
    """Versions of this machine, also for runs that ended without a row."""
    environment = describe_environment()
    return {"python": environment["python"], "machine": environment["machine"]}


_idle: list[Runner] = []
_idle_lock = threading.Lock()


class Runner:
    """A process that does one run after the other.

    Raises `BatchError` when the process does not become ready in time.
    """

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
        self._collector = threading.Thread(target=self._collect, args=(self._process.stdout,), daemon=True)
        self._collector.start()
        try:
            reason = "" if self._wait(Limits(START_S)) == READY else f"it was not ready after {START_S:g} s"
        except KilledError as error:
            reason = str(error)
        if reason:
            said = self.log()[-2000:]
            self.end()
            raise BatchError(f"no process for runs on {platform.node()}: {reason}; {said}")

    def _collect(self, source: BinaryIO) -> None:
        """Put the answers of the process into the queue; None at their end."""
        with source, contextlib.suppress(EOFError, OSError, pickle.UnpicklingError):
            while True:
                self._answers.put(pickle.load(source))
        self._answers.put(None)

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def is_fit(self) -> bool:
        """Tell whether it can take a run."""
        return not self._is_busy and self._process.poll() is None

    def perform(self, run: PlannedRun, limits: Limits) -> RunOutcome:
        """Do one run, after a warm-up if it is the first of its estimator here.

        Raises `KilledError` when the process ended during the run; `BatchError` or `OSError` when the run could not be
        done at all.
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
        with contextlib.suppress(OSError):  # a process that is gone is noticed by its missing answer
            pickle.dump(request, self._requests)
            self._requests.flush()
        answer = self._wait(limits)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def log(self) -> str:
        """Output of the process since the run began."""
        self._log.seek(0)
        return self._log.read().decode("utf-8", "replace")[-LOG_CHARACTERS:]

    def end(self) -> None:
        """Kill the process and its children, which hold its pipe open."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()
        self._collector.join(JOIN_S)
        with contextlib.suppress(OSError):
            self._requests.close()
        self._log.close()

    def _wait(self, limits: Limits) -> Any:
        """Answer to the last request; for a run that exceeds its limits an outcome, and the process stays busy."""
        deadline = time.monotonic() + limits.timeout_s
        while True:
            is_gone = self._process.poll() is not None
            with contextlib.suppress(Empty):
                answer = self._answers.get(timeout=LOOK_EVERY_S)
                if answer is None:
                    raise KilledError(self._ending())
                self._is_busy = False
                return answer
            if is_gone:  # its children may live on and keep the pipe open
                raise KilledError(self._ending())
            if time.monotonic() > deadline:
                return RunOutcome({"status": "timeout", "reason": f"took longer than {limits.timeout_s:g} s"})
            if limits.memory_mb is not None and resident_mb(self.pid) > limits.memory_mb:
                reason = f"its processes needed more than {limits.memory_mb:g} MB"
                return RunOutcome({"status": "memory", "reason": reason})

    def _ending(self) -> str:
        code = self._process.wait()
        if code >= 0:
            return f"its process ended with code {code}"
        return f"its process was ended by {signal.Signals(-code).name}"


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
