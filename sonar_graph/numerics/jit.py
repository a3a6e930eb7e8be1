"""Compilation of loops over samples and pixels to machine code, with a cache that follows what the code calls."""

import hashlib
import logging
import sys
import threading
import time
from collections import Counter
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba
from numba.core import event
from numba.core.dispatcher import Dispatcher

LOG = logging.getLogger(__name__)
NOTICE = "compiling for the first use, once: later uses find the code in their cache"
TELL_EVERY_S = 10.0
Compiled = TypeVar("Compiled")
_compiled_in: Counter[str] = Counter()
"""Number of compiled functions of each module."""


def compiled(function: Compiled) -> Compiled:
    """Compile to machine code at the first call; the code is cached beside the source.

    It is compiled again when the contents of its file change, or of a file whose compiled functions it can call.
    """
    return _compiled(function, forceinline=False)


def inlined(function: Compiled) -> Compiled:
    """Compile as `compiled`, and inline into every caller: for the steps of a loop over samples.

    In such a loop a call that passes tuples costs as much as the arithmetic of a step, and tuples stay in registers
    only within one function. Elsewhere inlining gains nothing and costs compile time, since the code is compiled in
    every caller.
    """
    return _compiled(function, forceinline=True)


def _compiled(function: Compiled, *, forceinline: bool) -> Compiled:
    assert isinstance(function, FunctionType)
    _compiled_in[function.__module__] += 1
    made = numba.njit(cache=True, error_model="numpy", forceinline=forceinline)(function)
    if isinstance(made, Dispatcher):  # a plain function with NUMBA_DISABLE_JIT
        # numba's own stamp is of the function's file alone, and in its older versions of the file's time
        cast(Any, made)._cache._cache_file._source_stamp = _digest(function.__globals__)
    return cast(Compiled, made)


def _digest(module: dict[str, Any]) -> str:
    """Digest of the files of a module and of all modules with compiled functions that it names, directly or not.

    Numbers that these modules name are part of it, since the code holds their values.
    """
    parts: dict[str, str] = {}
    waiting = [module]
    while waiting:
        names = waiting.pop()
        if names["__name__"] in parts:
            continue
        numbers = sorted((name, repr(value)) for name, value in names.items() if isinstance(value, int | float))
        status = Path(names["__file__"]).stat()
        parts[names["__name__"]] = repr((_contents(names["__file__"], status.st_mtime_ns, status.st_size), numbers))
        for value in names.values():
            of = value if isinstance(value, ModuleType) else sys.modules.get(getattr(value, "__module__", None) or "")
            if of is not None and of.__name__ in _compiled_in:
                waiting.append(vars(of))
    return hashlib.sha256("".join(parts[name] for name in sorted(parts)).encode()).hexdigest()


@cache
def _contents(path: str, _mtime_ns: int, _size: int) -> str:
    """Digest of a file, read anew in a process when it has changed."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


class _Progress(event.Listener):
    """Says what is compiled: first in the log, then on a line of the terminal, or every `TELL_EVERY_S` in the log."""

    def __init__(self) -> None:
        self._depth, self._count, self._told_s = 0, 0, 0.0

    def on_start(self, event: Any) -> None:
        dispatcher, now_s, terminal = event.data["dispatcher"], time.monotonic(), _terminal()
        if dispatcher.py_func.__module__ not in _compiled_in:
            return
        if not self._count:
            self._told_s = now_s
            if not any(Path(dispatcher._cache.cache_path).glob("*.nbi")):
                LOG.warning(NOTICE)
        self._depth, self._count = self._depth + 1, self._count + 1
        about = max(self._count, _compiled_in.total())
        line = f"compiling for the first use: {dispatcher.py_func.__name__} ({self._count} of about {about})"
        if terminal:
            print(f"\r\x1b[2K{line}", end="", file=terminal, flush=True)
        elif now_s - self._told_s >= TELL_EVERY_S:
            self._told_s = now_s
            LOG.warning(line)

    def on_end(self, event: Any) -> None:
        if event.data["dispatcher"].py_func.__module__ in _compiled_in:
            self._depth -= 1
            if not self._depth and (terminal := _terminal()):
                print("\r\x1b[2K", end="", file=terminal, flush=True)


def _terminal() -> Any:
    """Standard error where a user reads it, not as a progress bar redirects it."""
    return sys.__stderr__ if sys.__stderr__ and sys.__stderr__.isatty() else None


event.register("numba:compile", _Progress())  # type: ignore[no-untyped-call]  # numba has no types


class _Stopwatch(event.Listener, threading.local):
    """Seconds in which a thread compiles, loads what was compiled, or waits for another that does."""

    depth, began_s, total_s = 0, 0.0, 0.0

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
