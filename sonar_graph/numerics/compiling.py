"""Progress of compiling, for the user who waits for it, and the time that it takes, which no estimator needs."""

import logging
import sys
import threading
import time
from pathlib import Path
from types import ModuleType
from typing import Any

from numba.core import event
from numba.core.dispatcher import Dispatcher

from sonar_graph.numerics.matrices import COMPILED_IN

LOG = logging.getLogger(__name__)
NOTICE = "compiling for the first use, once: later uses find the code in their cache"
TELL_EVERY_S = 10.0


class _Progress(event.Listener):
    """Shows what is compiled: first in the log, then on a line of the terminal, or in the log every `TELL_EVERY_S`."""

    def __init__(self) -> None:
        self._depth = 0
        self._count = 0
        self._told_s = 0.0

    def on_start(self, event: Any) -> None:
        if not _is_ours(event):
            return
        dispatcher = event.data["dispatcher"]
        now_s = time.monotonic()
        terminal = _terminal()
        if not self._count:
            self._told_s = now_s
            # without an index no earlier run has compiled this file: the user waits, and should know why
            if not any(Path(dispatcher.stats.cache_path).glob("*.nbi")):
                LOG.warning(NOTICE)
        # compiled functions compile those that they call first
        self._depth += 1
        self._count += 1
        about = max(self._count, COMPILED_IN.total())
        line = f"compiling for the first use: {dispatcher.py_func.__name__} ({self._count} of about {about})"
        if terminal:
            print(f"\r\x1b[2K{line}", end="", file=terminal, flush=True)
        elif now_s - self._told_s >= TELL_EVERY_S:
            self._told_s = now_s
            LOG.warning(line)

    def on_end(self, event: Any) -> None:
        if _is_ours(event):
            self._depth -= 1
            if not self._depth and (terminal := _terminal()):
                print("\r\x1b[2K", end="", file=terminal, flush=True)


def needs_compiling(module: ModuleType) -> bool:
    """True if a module has compiled functions and the cache has the code of none of them."""
    functions: list[Any] = [
        value
        for value in vars(module).values()
        if isinstance(value, Dispatcher) and value.__module__ == module.__name__
    ]
    return bool(functions) and not any(
        function._cache._cache_file._load_index() for function in functions
    )


def _is_ours(event: Any) -> bool:
    """True for a function of ours with a name, which rules of operators have not."""
    function = event.data["dispatcher"].py_func
    return function.__module__ in COMPILED_IN and function.__name__ != "<lambda>"


def _terminal() -> Any:
    """Standard error where a user reads it, not as a progress bar redirects it."""
    return sys.__stderr__ if sys.__stderr__ and sys.__stderr__.isatty() else None


event.register("numba:compile", _Progress())  # type: ignore[no-untyped-call]  # numba has no types


class _Stopwatch(event.Listener, threading.local):
    """Seconds in which a thread compiles, loads what was compiled, or waits for another that does."""

    depth = 0
    began_s = 0.0
    total_s = 0.0

    def on_start(self, _event: Any) -> None:
        if not self.depth:
            self.began_s = time.perf_counter()
        self.depth += 1

    def on_end(self, _event: Any) -> None:
        self.depth -= 1
        if not self.depth:
            self.total_s += time.perf_counter() - self.began_s


_STOPWATCH = _Stopwatch()
event.register("numba:compiler_lock", _STOPWATCH)  # type: ignore[no-untyped-call]  # numba has no types


def compiling_s() -> float:
    """Seconds that this thread has spent compiling and loading compiled code until now."""
    return _STOPWATCH.total_s
