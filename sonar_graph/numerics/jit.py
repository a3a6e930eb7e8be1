"""Compilation of loops over samples and pixels to machine code, with a cache that follows what the code calls."""

import hashlib
import sys
from collections import Counter
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba.extending
from numba.core.dispatcher import Dispatcher

Compiled = TypeVar("Compiled")
COMPILED_IN: Counter[str] = Counter()
"""Number of compiled functions of each module."""


def compiled(function: Compiled, *, forceinline: bool = False) -> Compiled:
    """Compile to machine code at the first call; the code is cached beside the source.

    It is compiled again when the contents of its file change, or of a file whose compiled functions it can call.
    """
    assert isinstance(function, FunctionType)
    COMPILED_IN[function.__module__] += 1
    made = numba.njit(cache=True, error_model="numpy", forceinline=forceinline)(
        function
    )
    if isinstance(made, Dispatcher):  # a plain function with NUMBA_DISABLE_JIT
        # numba's own stamp is of the function's file alone, and in its older versions of the file's time
        cached = cast(Any, made)._cache._cache_file
        cached._source_stamp = _digest(function.__globals__)
        cached._load_index = partial(_readable, cached._load_index)
    return cast(Compiled, made)


def _readable(load_index: Callable[[], dict[Any, str]]) -> dict[Any, str]:
    """Index of cached code; empty where it names a class that another version of the package had."""
    try:
        return load_index()
    except (AttributeError, ImportError):
        return {}


def inlined(function: Compiled) -> Compiled:
    """Compile as `compiled`, and inline into every caller: for the steps of a loop over samples.

    There, tuples stay in registers only within one function. Elsewhere it just costs compile time in every caller.
    """
    return compiled(function, forceinline=True)


def compilable(function: Compiled) -> Compiled:
    """Leave a function to Python, where arrays of any kind need no compilation; compiled functions can call it too."""
    return cast(Compiled, cast(Any, numba.extending).register_jitable(function))


def _digest(module: dict[str, Any]) -> str:
    """Digest of the files of a module and of all modules with compiled functions that it names, directly or not.

    Numbers that these modules name are part of it, since the code holds their values.
    """
    parts: dict[str, str] = {}
    waiting = [module]
    while waiting:
        names = waiting.pop()
        if names["__name__"] in parts:  # modules may name each other in a circle
            continue
        numbers = sorted(
            (name, repr(value))
            for name, value in names.items()
            if isinstance(value, int | float)
        )
        status = Path(names["__file__"]).stat()
        parts[names["__name__"]] = repr(
            (_contents(names["__file__"], status.st_mtime_ns, status.st_size), numbers)
        )
        for value in names.values():
            of = (
                value
                if isinstance(value, ModuleType)
                else sys.modules.get(getattr(value, "__module__", None) or "")
            )
            if of is not None and of.__name__ in COMPILED_IN:
                waiting.append(vars(of))
    return hashlib.sha256(
        "".join(parts[name] for name in sorted(parts)).encode()
    ).hexdigest()


@cache
def _contents(path: str, _mtime_ns: int, _size: int) -> str:
    """Digest of a file, read again in a process when the file has changed."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
