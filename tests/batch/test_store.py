"""Runs are kept whole or not at all, and a folder has one batch at a time."""

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import filelock
import pytest

from sonar_graph.batch.store import RunOutcome, Store, only_batch_in
from sonar_graph.errors import BatchError

OUTCOME = RunOutcome(
    {"status": "ok", "causal.ate_raw_m": 0.1}, {"runs/isam2/series.npz": b"123", "a.json": b"{}"}, "said"
)


class Died(BaseException):
    """Ends a process."""


def names(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_what_is_written_is_what_is_read(tmp_path):
    store = Store(tmp_path)
    assert store.row("k") is None
    store.write("k", OUTCOME)
    assert store.row("k") == OUTCOME.row
    assert names(tmp_path) == [f"runs/k/{name}" for name in ("a.json", "log.txt", "row.json", "runs/isam2/series.npz")]
    assert (tmp_path / store.log_file("k")).read_text() == "said"


@pytest.mark.parametrize("last", range(4))
def test_full_disk_leaves_nothing_of_the_run_and_all_of_the_others(tmp_path, monkeypatch, last):
    store = Store(tmp_path)
    store.write("done", OUTCOME)
    before = names(tmp_path)
    written = 0
    write, write_text = Path.write_bytes, Path.write_text

    def full(self: Path, *content: Any) -> int:
        nonlocal written
        if written == last:
            write(self, b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written += 1
        return (write if isinstance(content[0], bytes) else write_text)(self, *content)

    monkeypatch.setattr(Path, "write_bytes", full)
    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space"):
        store.write("next", OUTCOME)
    assert names(tmp_path) == before
    assert not list((tmp_path / "runs").glob(".*"))


def test_process_that_dies_before_the_rename_leaves_no_run(tmp_path, monkeypatch):
    store = Store(tmp_path)

    def die(_self: Path, _target: Path) -> None:
        raise Died

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", die)
        patch.setattr("shutil.rmtree", lambda *_arguments, **_options: None)  # a killed process cleans nothing up
        with pytest.raises(Died):
            store.write("k", OUTCOME)
    assert store.row("k") is None
    assert list((tmp_path / "runs").iterdir())
    store.remove_partial()
    assert not list((tmp_path / "runs").iterdir())


@pytest.mark.parametrize("act", ["discard", "write"])
def test_process_that_dies_while_it_removes_a_run_leaves_it_whole_or_not_at_all(tmp_path, monkeypatch, act):
    store = Store(tmp_path)
    store.write("k", OUTCOME)
    whole = names(store.run_folder("k"))

    def die(folder: Path, **_options: Any) -> None:
        next(path for path in folder.rglob("*.npz")).unlink()
        raise Died

    with monkeypatch.context() as patch:
        patch.setattr("shutil.rmtree", die)
        with pytest.raises(Died):
            store.discard("k") if act == "discard" else store.write("k", OUTCOME)
    assert (store.row("k") is None) == (not store.run_folder("k").exists())
    assert not store.run_folder("k").exists() or names(store.run_folder("k")) == whole
    store.remove_partial()
    store.write("k", OUTCOME)
    assert names(tmp_path) == [f"runs/k/{name}" for name in whole]


def test_row_that_the_machine_lost_or_that_is_of_another_run_counts_as_not_done(tmp_path):
    store = Store(tmp_path)
    store.write("k", OUTCOME)
    (store.run_folder("k") / "row.json").write_bytes(b"")
    assert store.row("k") is None
    for key in ("k", "other"):
        store.write(key, OUTCOME)
        assert store.row(key) == OUTCOME.row
    for old, new in (("k", "aside"), ("other", "k"), ("aside", "other")):
        store.run_folder(old).rename(store.run_folder(new))
    assert store.row("k") is store.row("other") is None


HOLDER = """
import subprocess, sys, time
from pathlib import Path
from sonar_graph.batch.store import only_batch_in

with only_batch_in(Path(sys.argv[1])):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], stdout=subprocess.DEVNULL)
    print(child.pid, flush=True)
    time.sleep(60)
"""


def test_second_process_is_refused_until_the_first_is_killed_although_its_children_live(tmp_path):
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        child = int(process.stdout.readline())
        try:
            with pytest.raises(BatchError) as refused, only_batch_in(tmp_path):
                pass
            assert str(refused.value).startswith(f"{tmp_path}: another batch is running in this folder; ")
            assert "\n" not in str(refused.value)
            process.kill()
            process.wait()
            os.kill(child, 0)
            with only_batch_in(tmp_path):
                assert (tmp_path / ".lock").exists()
        finally:
            process.kill()
            os.kill(child, 9)


def test_lock_is_of_one_folder_and_ends_with_the_block_also_by_an_error(tmp_path):
    (tmp_path / "other").mkdir()
    with pytest.raises(KeyboardInterrupt), only_batch_in(tmp_path):
        raise KeyboardInterrupt
    with only_batch_in(tmp_path), only_batch_in(tmp_path / "other"):
        pass


@pytest.mark.skipif(sys.platform == "win32", reason="other locks")
@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK])
def test_file_system_without_locks_is_refused(tmp_path, monkeypatch, number):
    import fcntl

    def no_lock(*_arguments: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", no_lock)
    assert filelock.FileLock is not filelock.SoftFileLock
    with pytest.raises(BatchError, match="cannot be locked against a second batch"), only_batch_in(tmp_path):
        pass
