"""Compilation of loops in a process of its own, while this one does something else.

The compiled code goes through the cache on the disk, where this process finds it.
"""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from types import ModuleType

from sonar_graph.numerics.compiling import needs_compiling


@contextmanager
def compiled_beside(
    work: Callable[[], object], modules: list[ModuleType]
) -> Iterator[Callable[[], None]]:
    """Do short work in a process of its own at the first use, so that the loops which it calls get compiled.

    Parameters
    ----------
    work
        Function that can be pickled; what it returns or raises is dropped.
    modules
        Modules with compiled functions. Nothing is done where the cache has code of each of them.

    Yields
    ------
    Callable
        Function that waits until the work is done.
    """
    if not any(needs_compiling(module) for module in modules):
        yield lambda: None
        return
    process = get_context("spawn").Process(
        target=_do_silently, args=(work,), daemon=True
    )
    process.start()
    try:
        yield process.join
    finally:
        process.terminate()
        process.join()


def _do_silently(work: Callable[[], object]) -> None:
    """Work without a word: the other process shows its own progress on the same terminal."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
    work()
