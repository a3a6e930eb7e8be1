from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import filelock
import pytest

from sonar_graph.batch.store import only_batch_in
from sonar_graph.errors import BatchError

HOLDER = """
import subprocess, sys, time
from pathlib import Path
from sonar_graph.batch.store import only_batch_in

with only_batch_in(Path(sys.argv[1])):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], stdout=subprocess.DEVNULL)
    print(child.pid, flush=True)
    time.sleep(60)
"""


@contextmanager
def another_process_in(folder: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A process that has the lock, and the number of its child, which has not."""
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        try:
            yield process, child
        finally:
            process.kill()
            os.kill(child, 9)


def test_second_process_is_refused_in_one_line_that_says_what_to_do(tmp_path: Path) -> None:
    with another_process_in(tmp_path), pytest.raises(BatchError) as refused, only_batch_in(tmp_path):
        pass
    assert str(refused.value).startswith(f"{tmp_path}: another batch is running in this folder; ")
    assert "\n" not in str(refused.value)


def test_killed_batch_leaves_no_lock_although_its_children_live(tmp_path: Path) -> None:
    with another_process_in(tmp_path) as (process, child):
        process.kill()
        process.wait()
        os.kill(child, 0)
        with only_batch_in(tmp_path):
            assert (tmp_path / ".lock").exists()


def test_lock_ends_with_the_block_also_by_an_error(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), only_batch_in(tmp_path):
        raise KeyboardInterrupt
    with only_batch_in(tmp_path):
        pass


def test_other_folders_are_free(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    with only_batch_in(tmp_path), only_batch_in(tmp_path / "other"):
        pass


@pytest.mark.skipif(sys.platform == "win32", reason="other locks")
@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK])
def test_file_system_without_locks_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    import fcntl

    def no_lock(*_arguments: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", no_lock)
    assert filelock.FileLock is not filelock.SoftFileLock
    with pytest.raises(BatchError, match="cannot be locked against a second batch"), only_batch_in(tmp_path):
        pass
