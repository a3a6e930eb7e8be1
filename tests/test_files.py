"""Nothing of the user's is lost: files of others, links, pipes, a second command, an end in the middle."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sonar_graph.errors import EvaluationError
from sonar_graph.files import (
    others_in,
    remove_written,
    replacing,
    result_folder,
    result_written,
    write_json,
    written_whole,
)
from tests.dying import Died, dies_after

KIND = "comparison"


def write(
    folder: Path,
    contents: dict[str, str],
    *,
    overwrite: bool = False,
    is_amended: bool = False,
    error: type[BaseException] | None = None,
) -> None:
    with result_written(folder, KIND, overwrite=overwrite) as written:
        if not is_amended:
            written.remove(written.names)
        for name, content in contents.items():
            with replacing(folder / name) as partial:
                partial.write_text(content)
        if error is not None:
            raise error


def contents(folder: Path) -> dict[str, str]:
    files = (
        path
        for path in folder.rglob("*")
        if path.is_file() and path.name not in (".lock", ".sonar_graph.json")
    )
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def test_a_result_replaces_what_an_earlier_one_wrote_and_leaves_all_else(tmp_path):
    write(tmp_path, {"a.json": "1", "runs/x/b.json": "1", "runs/y/b.json": "1"})
    (tmp_path / "runs" / "y" / "notes").write_text("mine")
    write(tmp_path, {"a.json": "2", "runs/z/b.json": "2"})
    assert contents(tmp_path) == {
        "a.json": "2",
        "runs/z/b.json": "2",
        "runs/y/notes": "mine",
    }
    assert not (tmp_path / "runs" / "x").exists()


@pytest.mark.parametrize("name", ["a.json", "runs/x/b.json"])
@pytest.mark.parametrize("is_changed", [False, True])
def test_files_of_others_are_replaced_only_with_overwrite(tmp_path, name, is_changed):
    new = {"a.json": "2", "runs/x/b.json": "2"}
    if is_changed:
        write(tmp_path, dict.fromkeys(new, "1"))
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(
        EvaluationError,
        match=rf"holds {name}, which sonar-graph did not write .*--overwrite",
    ):
        write(tmp_path, new)
    assert contents(tmp_path) == before
    write(tmp_path, {other: "2" for other in new if other != name})
    assert contents(tmp_path)[name] == "mine"
    write(tmp_path, new, overwrite=True)
    assert contents(tmp_path) == new


def test_links_are_never_followed(tmp_path, monkeypatch):
    mine = tmp_path / "mine"
    folder = tmp_path / "out"
    mine.mkdir()
    (mine / "b.json").write_text("mine")
    folder.mkdir()
    (folder / "runs").symlink_to(mine)
    for overwrite in (False, True):
        with pytest.raises(EvaluationError, match=r"holds runs/b\.json"):
            write(folder, {"runs/b.json": "2"}, overwrite=overwrite)
    (folder / "c.json").symlink_to(mine / "b.json")
    with pytest.raises(EvaluationError, match=r"holds c\.json"):
        write(folder, {"c.json": "2"})
    for name in (".partial-c.json", ".c.json.partial", "c.json.part"):
        (mine / name).symlink_to(mine / "b.json")
    write_json(mine / "c.json", {})
    monkeypatch.setattr("secrets.token_hex", lambda _: "0")
    (mine / ".c.json.0.partial.json").symlink_to(mine / "b.json")
    with pytest.raises(FileExistsError):
        write_json(mine / "c.json", {})
    assert (mine / "b.json").read_text() == "mine"
    assert not (folder / "b.json").exists()


def test_a_block_that_fails_changes_nothing_and_leaves_no_temporary_file(tmp_path):
    write(tmp_path, {"a.json": "1", "runs/x/b.json": "1"})
    before = contents(tmp_path)
    for error in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(error):
            write(tmp_path, {"a.json": "half", "runs/new/c.json": "half"}, error=error)
        assert contents(tmp_path) == before
    with pytest.raises(RuntimeError), written_whole(tmp_path / "log.mcap"):
        raise RuntimeError
    assert contents(tmp_path) == before
    assert not (tmp_path / "runs" / "new").exists()


@pytest.mark.parametrize("is_new", [False, True])
def test_an_interrupted_file_leaves_nothing_not_even_its_folder(
    tmp_path, monkeypatch, is_new
):
    """A signal has no better moment: the file is there, and the caller does not know yet."""
    path = tmp_path / "made" / "below" / "log.mcap"
    opened = os.open
    if not is_new:
        path.parent.mkdir(parents=True)
    before = list(tmp_path.rglob("*"))
    with pytest.raises(KeyboardInterrupt), replacing(path):
        raise KeyboardInterrupt
    assert list(tmp_path.rglob("*")) == before

    def interrupted(*given):
        descriptor = opened(*given)
        signal.raise_signal(signal.SIGINT)
        return descriptor

    monkeypatch.setattr("os.open", interrupted)
    with pytest.raises(KeyboardInterrupt), replacing(path):
        pytest.fail("it began")
    assert list(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("steps", range(60))
def test_killed_at_any_step_all_is_whole_and_known_as_ours(
    tmp_path, monkeypatch, steps
):
    folder = tmp_path / "out"
    mine = {f".{name}.{'0' * 24}.partial.json": "mine" for name in "ab"}
    before = {"a.json": "1", "runs/x/b.json": "1"}
    after = {"a.json": "{}\n", "runs/y/b.json": "2"}
    if steps % 2:
        write(folder, before)
    folder.mkdir(exist_ok=True)
    for name, content in mine.items():
        (folder / name).write_text(content)
    with monkeypatch.context() as patch, contextlib.suppress(Died):
        dies_after(steps // 2, patch)
        write(folder, after)
    whole = (before | mine).items() | after.items()
    partial = folder / ".sonar_graph.partial"
    found = contents(folder)
    assert {
        f for f in found.items() if not (folder / f[0]).is_relative_to(partial)
    } <= whole
    write(folder, {"a.json": "3"})
    assert contents(folder) == mine | {"a.json": "3"}


@pytest.mark.parametrize(
    "manifest",
    [
        "",
        "[]",
        '{"kind": "comparison"}',
        '{"format": 1, "kind": "x", "files": 3}',
        "[" * 9999,
    ],
)
def test_a_manifest_that_is_not_ours_is_refused(tmp_path, manifest):
    folder = tmp_path / "out"
    write(folder, {"a.json": "1"})
    (folder / ".sonar_graph.json").write_text(manifest)
    with pytest.raises(
        EvaluationError, match=r"\.sonar_graph\.json: is not as sonar-graph writes it"
    ):
        write(folder, {"a.json": "2"})
    (tmp_path / "mine").write_text("mine")
    for name in ("../mine", str(tmp_path / "mine")):
        files = f'{{"{name}": ["{"0" * 32}"]}}'
        (folder / ".sonar_graph.json").write_text(
            f'{{"format": "sonar_graph folder 1", "kind": "comparison", "files": {files}}}'
        )
        with pytest.raises(EvaluationError, match="not as sonar-graph writes it"):
            write(folder, {"a.json": "2"})
    assert (tmp_path / "mine").read_text() == "mine"


def test_a_folder_holds_one_kind_of_result(tmp_path):
    write(tmp_path, {"a.json": "1"})
    with (
        pytest.raises(
            EvaluationError, match="holds a comparison, and would become a batch"
        ),
        result_written(tmp_path, "batch"),
    ):
        pass


HOLDER = """
import subprocess, sys, time
from pathlib import Path
from sonar_graph.files import result_folder

with result_folder(Path(sys.argv[1]), "comparison"):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], stdout=subprocess.DEVNULL)
    print(child.pid, flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_refused_until_the_first_is_killed(
    tmp_path,
):
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as process:
        child = int(process.stdout.readline())
        try:
            with (
                pytest.raises(EvaluationError) as refused,
                result_folder(tmp_path, KIND),
            ):
                pass
            assert str(refused.value).startswith(
                f"{tmp_path}: another command is writing to this folder; "
            )
            process.kill()
            process.wait()
            os.kill(child, 0)
            with result_folder(tmp_path, KIND):
                assert (tmp_path / ".lock").exists()
        finally:
            process.kill()
            os.kill(child, 9)


@pytest.mark.parametrize("content", ["", "mine"])
def test_a_file_with_the_name_of_the_lock_stays(tmp_path, content):
    (tmp_path / ".lock").write_text(content)
    with result_folder(tmp_path, KIND):
        pass
    assert (tmp_path / ".lock").read_text() == content
    write(tmp_path, {"a.json": "1"})
    assert others_in(tmp_path) == ([".lock"] if content else [])
    remove_written(tmp_path)
    assert (tmp_path / ".lock").exists() == bool(content)


@pytest.mark.parametrize(
    "act", [lambda folder: write(folder, {"a.json": "2"}), remove_written]
)
def test_what_is_behind_a_linked_folder_is_not_removed(tmp_path, act):
    folder = tmp_path / "out"
    mine = tmp_path / "mine"
    write(folder, {"a.json": "1", "runs/x/b.json": "1"})
    (folder / "runs").rename(mine)
    (folder / "runs").symlink_to(mine)
    act(folder)
    assert (mine / "x" / "b.json").read_text() == "1"
    assert (folder / "runs").is_symlink()


def test_a_lock_that_is_a_link_or_a_folder_is_refused(tmp_path):
    (tmp_path / "mine").write_text("mine")
    for folder, make in (
        (tmp_path / "a", lambda lock: lock.symlink_to(tmp_path / "mine")),
        (tmp_path / "b", Path.mkdir),
    ):
        folder.mkdir()
        make(folder / ".lock")
        with (
            pytest.raises(
                EvaluationError, match=r"\.lock: cannot be opened .*choose another"
            ),
            result_folder(folder, KIND),
        ):
            pass
    assert (tmp_path / "mine").read_text() == "mine"
