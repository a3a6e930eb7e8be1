"""Compilation of loops over samples and pixels to machine code, with a cache that follows changed callees."""

import logging
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar, cast

import numba
from numba.core import event

LOG = logging.getLogger(__name__)
NOTICE = "compiling, once: the first use takes minutes, later ones find the code in __pycache__"
Compiled = TypeVar("Compiled")
_sources: set[Path] = set()


def compiled(function: Compiled) -> Compiled:
    """Compile to machine code at the first call; the code is cached beside the source.

    numba drops cached code when the function's own file changes, but not when a function that it calls in another file
    does. Callees are decorated before their callers (their modules are imported first), so code older than the newest
    file seen so far is removed here.
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
    source = Path(function.__code__.co_filename)
    _sources.add(source)
    newest_ns = max(path.stat().st_mtime_ns for path in _sources)
    for index in (source.parent / "__pycache__").glob(f"{source.stem}.{function.__qualname__}-*.nbi"):
        if index.stat().st_mtime_ns < newest_ns:
            index.unlink(missing_ok=True)
    return cast(Compiled, numba.njit(cache=True, error_model="numpy", forceinline=forceinline)(function))


def nothing_is_cached(folders: Iterable[Path]) -> bool:
    """True where no folder of sources has compiled code of any function."""
    return not any(any((folder / "__pycache__").glob("*.nbi")) for folder in folders)


class _Notice(event.Listener):
    """Logs once, before the first compilation of a process, that it takes long, where nothing is cached yet."""

    def __init__(self) -> None:
        self._is_first = True

    def on_start(self, event: Any) -> None:
        source = Path(event.data["dispatcher"].py_func.__code__.co_filename)
        if self._is_first and source in _sources:
            self._is_first = False
            if nothing_is_cached({source.parent for source in _sources}):
                LOG.warning(NOTICE)

    def on_end(self, event: Any) -> None:
        """Required by numba; nothing to log."""


event.register("numba:compile", _Notice())  # type: ignore[no-untyped-call]  # numba has no types


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
