"""Ctrl-C that comes at a bad moment and is not lost, and SIGTERM that counts like it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def terminations_as_interrupts() -> Iterator[None]:
    """Let SIGTERM, by which SLURM, Kubernetes and ``timeout`` end a job, do in the block what Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        handler = signal.getsignal(signal.SIGINT)
        (handler if callable(handler) else signal.default_int_handler)(number, frame)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def deferred_interrupt() -> Iterator[None]:
    """Let a Ctrl-C that comes during the block count at its end.

    Compiled code without a way to raise (pyarrow has some) swallows the exception, and the batch would go on.

    Raises
    ------
    KeyboardInterrupt
        At the end of the block, when the signal came meanwhile; an error of the block is its context.
    """
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield
        return
    came: list[tuple[int, FrameType | None]] = []
    signal.signal(signal.SIGINT, lambda number, frame: came.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if came:  # also where the block fails: whoever passes over its error would pass over the interrupt
            handler(*came[0])
