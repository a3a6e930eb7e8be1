"""Ctrl-C and SIGTERM: noticed where compiled code swallows them, deferred while files change, and reported in one line."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ended."""
AGAIN_S = 1e-3
"""After this time an interrupt is sent again that no Python code may see now."""
_Signal = tuple[int, FrameType | None]


@contextmanager
def _handling(
    handle: Callable[[_Signal, Callable[[], object]], object],
) -> Iterator[None]:
    """Give each Ctrl-C of the block to ``handle``, with what would have been done.

    Only the main thread has handlers, and one of another program's C code stays. A Ctrl-C that comes while numba makes
    Python objects of its results is sent again, and comes after them.
    """
    before = signal.getsignal(signal.SIGINT)
    if not callable(before):
        yield
        return
    usual: Callable[[int, FrameType | None], object] = before

    def interrupt(number: int, frame: FrameType | None) -> None:
        if _makes_results(frame):
            threading.Timer(AGAIN_S, _send, [threading.get_ident(), number]).start()
        else:
            handle((number, frame), lambda: usual(number, frame))

    with _handler(interrupt, signal.SIGINT):
        yield


@contextmanager
def _handler(
    handler: Callable[[int, FrameType | None], object], *numbers: signal.Signals
) -> Iterator[None]:
    """Handle signals in the block by a function; other threads than the main one have no handlers."""
    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, handler) for number in numbers if is_main}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _send(thread: int, number: int) -> None:
    if sys.platform == "win32":
        signal.raise_signal(number)
    else:
        signal.pthread_kill(thread, number)  # also wakes a thread that waits


def _makes_results(frame: FrameType | None) -> bool:
    """True where compiled code calls the two Python functions by which numba makes objects of its results.

    It expects no exception from them: one at this moment is a segmentation fault.
    """
    while frame is not None:
        code = frame.f_code
        makes_named_tuple = code.co_varnames[:1] == ("_cls",)
        if makes_named_tuple or code.co_name == "_numba_unpickle":
            return True
        frame = frame.f_back
    return False


@contextmanager
def noticed_interrupts() -> Iterator[Callable[[], None]]:
    """Give a function that raises `KeyboardInterrupt` if Ctrl-C came during the block.

    Compiled code may turn the exception into another, or swallow it, and its caller would go on or name a failure.
    """
    came: list[_Signal] = []

    def notice(signalled: _Signal, usual: Callable[[], object]) -> None:
        came.append(signalled)
        usual()

    def check() -> None:
        if came:
            raise KeyboardInterrupt

    with _handling(notice):
        yield check


@contextmanager
def interrupt_event() -> Iterator[threading.Event]:
    """Event that a Ctrl-C or SIGTERM of the block sets, which is then no error: it ends what has no end.

    Also in a process that a script began in the background, where Ctrl-C is otherwise ignored.
    """
    ended = threading.Event()
    with _handler(lambda *_: ended.set(), signal.SIGINT, signal.SIGTERM):
        yield ended


@contextmanager
def deferred_interrupt() -> Iterator[None]:
    """Defer a Ctrl-C that comes during the block to its end.

    Compiled code that cannot raise (some of pyarrow) swallows the exception, and files would be half replaced.

    Raises `KeyboardInterrupt` at the end of the block, when the signal came in between; an error of the block is its
    context.
    """
    came: list[Callable[[], object]] = []
    try:
        with _handling(lambda _, usual: came.append(usual)):
            yield
    finally:
        if came:  # also when the block fails: a caller that passes over its error must not pass over the interrupt
            came[0]()


@contextmanager
def terminations_as_interrupts() -> Iterator[None]:
    """Treat SIGTERM, by which SLURM, Kubernetes and ``timeout`` end a job, like Ctrl-C inside the block."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        handler = signal.getsignal(signal.SIGINT)
        (handler if callable(handler) else signal.default_int_handler)(number, frame)

    with _handler(interrupt, signal.SIGTERM):
        yield


def end_at_once(*_: object) -> None:
    """End the process as interrupted: a handler for when it begins and ends, which is no place for a traceback."""
    with contextlib.suppress(Exception):
        sys.stdout.flush()
    os.write(2, b"sonar-graph: interrupted\n")
    os._exit(INTERRUPTED)


@contextmanager
def loading() -> Iterator[None]:
    """End the process at a Ctrl-C within the block, while modules are imported."""
    with _handling(end_at_once):
        yield
