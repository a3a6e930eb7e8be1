"""Runs are kept whole or not at all, and nothing else is removed with them."""

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from sonar_graph.batch.store import RunOutcome, Store
from sonar_graph.errors import BatchError

OUTCOME = RunOutcome(
    {"status": "ok", "causal.ate_raw_m": 0.1},
    {"runs/isam2/series.npz": b"123", "a.json": b"{}"},
    "said",
)


class Died(BaseException):
    """Ends a process."""


def names(folder: Path) -> list[str]:
    return sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file()
    )


def test_what_is_written_is_what_is_read(tmp_path):
    store = Store(tmp_path)
    assert store.row("k") is None
    store.write("k", OUTCOME)
    assert store.row("k") == OUTCOME.row
    assert names(tmp_path) == [
        f"runs/k/{name}"
        for name in (
            ".sonar_graph.json",
            "a.json",
            "log.txt",
            "row.json",
            "runs/isam2/series.npz",
        )
    ]
    assert (tmp_path / store.log_file("k")).read_text() == "said"


@pytest.mark.parametrize("last", range(5))
def test_full_disk_leaves_nothing_of_the_run_and_all_of_the_others(
    tmp_path, monkeypatch, last
):
    store = Store(tmp_path)
    store.write("done", OUTCOME)
    before = names(tmp_path)
    written = 0
    write = Path.write_bytes
    write_text = Path.write_text

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
        # a killed process cleans nothing up
        patch.setattr("sonar_graph.batch.store.remove_written", lambda _: None)
        with pytest.raises(Died):
            store.write("k", OUTCOME)
    assert store.row("k") is None
    assert list((tmp_path / "runs").iterdir())
    store.remove_partial()
    assert not list((tmp_path / "runs").iterdir())


@pytest.mark.parametrize("act", ["discard", "write"])
def test_a_process_killed_during_removal_leaves_a_run_whole_or_gone(
    tmp_path, monkeypatch, act
):
    store = Store(tmp_path)
    store.write("k", OUTCOME)
    whole = names(store.run_folder("k"))

    def die(folder: Path, **_options: Any) -> None:
        next(path for path in folder.rglob("*.npz")).unlink()
        raise Died

    with monkeypatch.context() as patch:
        patch.setattr("sonar_graph.batch.store.remove_written", die)
        with pytest.raises(Died):
            store.discard("k") if act == "discard" else store.write("k", OUTCOME)
    assert (store.row("k") is None) == (not store.run_folder("k").exists())
    assert not store.run_folder("k").exists() or names(store.run_folder("k")) == whole
    store.remove_partial()
    store.write("k", OUTCOME)
    assert names(tmp_path) == [f"runs/k/{name}" for name in whole]


def test_a_lost_or_foreign_row_counts_as_not_done(
    tmp_path,
):
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


def test_files_of_others_are_never_removed(tmp_path):
    store = Store(tmp_path)
    store.write("k", OUTCOME)
    folder = store.run_folder("k")
    others = [
        folder / "notes.txt",
        *(tmp_path / "runs" / name / "a" for name in ("mine", ".partial-mine")),
    ]
    for path in others:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    (folder / "log.txt").write_text("mine")
    for name in ("log.txt", "notes.txt"):
        told = rf"runs/k: would be replaced, and holds {name}, .*move it away"
        for act in (lambda: store.discard("k"), lambda: store.write("k", OUTCOME)):
            with pytest.raises(BatchError, match=told):
                act()
        (folder / "log.txt").write_text(OUTCOME.log)
    store.remove_partial()
    assert [path.read_text() for path in others] == ["mine"] * 3
    assert store.row("k") == OUTCOME.row
    others[0].unlink()
    store.discard("k")
    assert not folder.exists()
