"""Compilation of estimators' loops in a process of its own, while this one does something else.

The compiled code goes through the cache on the disk, where this process finds it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from typing import TYPE_CHECKING

from sonar_graph.estimator import load_estimator
from sonar_graph.evaluation.run import run_estimator

if TYPE_CHECKING:
    from sonar_graph.sequence import Sequence


@contextmanager
def compiled_beside(
    make_sequence: Callable[[], Sequence], names: list[str]
) -> Iterator[Callable[[], None]]:
    """Run estimators on a sequence in a process of its own at the first use, and drop the results.

    Parameters
    ----------
    make_sequence
        Makes, in that process, a short sequence with what the estimators will meet: loops are compiled when they are
        first called.
    names
        Installed estimators.

    Yields
    ------
    Callable
        Function that waits until the process is done. It returns at once where the cache already has the loops.

    Examples
    --------
    >>> from sonar_graph.evaluation import compiled_beside
    >>> from sonar_graph.testing import small_world
    >>> if __name__ == "__main__":  # in a script, because it starts a process
    ...     with compiled_beside(small_world, ["ekf-slam"]) as wait_until_compiled:
    ...         wait_until_compiled()
    """
    if not any(_needs_compiling(name) for name in names):
        yield _nothing_to_wait_for
        return
    process = get_context("spawn").Process(
        target=_run_silently, args=(make_sequence, names), daemon=True
    )
    process.start()
    try:
        yield process.join
    finally:
        process.terminate()
        process.join()


def _needs_compiling(name: str) -> bool:
    """True if the cache has no code of the module of an estimator."""
    # loads numba, which an estimator needs and a result does not
    from sonar_graph.numerics import needs_compiling

    return needs_compiling(sys.modules[load_estimator(name).__module__])


def _nothing_to_wait_for() -> None:
    """Return at once."""


def _run_silently(make_sequence: Callable[[], Sequence], names: list[str]) -> None:
    """Run estimators without a word: the other process shows its own progress on the same terminal."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
    sequence = make_sequence()
    for name in names:
        run_estimator(sequence, name)
