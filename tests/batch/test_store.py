"""Runs are kept whole or not at all, and nothing else is removed with them."""

import contextlib
from pathlib import Path

import pytest

from sonar_graph.batch.store import RunOutcome, Store
from sonar_graph.errors import BatchError
from tests.dying import Died, dies_after

OUTCOME = RunOutcome(
    {"status": "ok", "causal.ate_raw_m": 0.1},
    {"runs/isam2/series.npz": b"123", "a.json": b"{}"},
    "said",
)


def names(folder: Path) -> set[str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix() for path in files}


def test_what_is_written_is_what_is_read(tmp_path):
    store = Store(tmp_path)
    assert store.row("k") is None
    store.write("k", OUTCOME)
    assert store.row("k") == OUTCOME.row
    own = {f"runs/k/{name}" for name in (".sonar_graph.json", "log.txt", "row.json")}
    assert names(tmp_path) == own | {f"runs/k/{name}" for name in OUTCOME.files}
    assert (tmp_path / store.log_file("k")).read_text() == "said"


@pytest.mark.parametrize("act", ["discard", "write"])
@pytest.mark.parametrize("steps", range(40))
def test_a_process_that_dies_leaves_a_run_whole_or_gone(
    tmp_path, monkeypatch, act, steps
):
    store = Store(tmp_path)
    store.write("k", OUTCOME)
    whole = names(tmp_path)
    with monkeypatch.context() as patch, contextlib.suppress(Died):
        dies_after(steps, patch)
        store.discard("k") if act == "discard" else store.write("k", OUTCOME)
    is_whole = store.run_folder("k").exists()
    assert store.row("k") == (OUTCOME.row if is_whole else None)
    store.remove_partial()
    assert names(tmp_path) == (whole if is_whole else set())
    store.write("k", OUTCOME)
    assert names(tmp_path) == whole


def test_a_lost_or_foreign_row_counts_as_not_done(tmp_path):
    store = Store(tmp_path)
    store.write("k", OUTCOME)
    (store.run_folder("k") / "row.json").write_bytes(b"")
    assert store.row("k") is None
    store.write("k", OUTCOME)
    assert store.row("k") == OUTCOME.row
    store.run_folder("k").rename(store.run_folder("other"))
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
