"""One batch at a time in a folder: two would remove each other's half-written runs, and write one table."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from sonar_graph.batch.store import LOCK
from sonar_graph.errors import BatchError


@contextmanager
def only_batch_in(folder: Path) -> Iterator[None]:
    """Keep every other batch out of a folder while the block runs.

    The operating system holds the lock and gives it up with the process, however that ends. The file stays behind and
    means nothing.

    Raises
    ------
    BatchError
        When another batch runs there, or the file system has no locks.
    """
    lock = FileLock(folder / LOCK, timeout=0, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        raise BatchError(
            f"{folder}: another batch is running in this folder; wait for its end, or choose another folder with -o"
        ) from None
    except (OSError, NotImplementedError) as error:
        raise BatchError(
            f"{folder}: cannot be locked against a second batch ({error}); choose another file system with -o"
        ) from error
    try:
        yield
    finally:
        lock.release()
