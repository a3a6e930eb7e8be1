from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sonar_graph.batch.plan import plan_runs, source_hash, source_hash_now, versions_of
from sonar_graph.batch.suite import read_suite

from .conftest import BASIN, DEAD_RECKONING, HEADER, WriteSuite

Hashed = Callable[[], str]


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "first" / "hashed_package"
    (folder / "inner").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise RuntimeError('imported')\n")
    (folder / "inner" / "data.json").write_text("{}")
    monkeypatch.syspath_prepend(folder.parent)
    return folder


@pytest.fixture
def hashed() -> Iterator[Hashed]:
    def anew() -> str:
        source_hash.cache_clear()
        return source_hash("hashed_package")

    yield anew
    source_hash.cache_clear()


def test_hash_changes_with_code_data_and_names(package: Path, hashed: Hashed) -> None:
    hashes = [hashed()]
    (package / "__init__.py").write_text("raise RuntimeError('Imported')\n")
    hashes.append(hashed())
    (package / "inner" / "data.json").write_text("[]")
    hashes.append(hashed())
    (package / "inner" / "data.json").rename(package / "data.json")
    hashes.append(hashed())
    (package / "more.py").touch()
    hashes.append(hashed())
    assert len(set(hashes)) == 5
    assert "" not in hashes


def test_hash_is_of_neither_bytecode_nor_hidden_files_nor_place(
    package: Path, hashed: Hashed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = hashed()
    (package / "__pycache__").mkdir()
    (package / "__pycache__" / "kernel.nbi").write_text("compiled")
    (package / ".swap").write_text("edited")
    assert hashed() == before
    moved = tmp_path / "second"
    shutil.copytree(package.parent, moved)
    shutil.rmtree(package)
    monkeypatch.syspath_prepend(moved)
    assert hashed() == before


def test_hash_of_a_module_is_of_its_file(tmp_path: Path, hashed: Hashed, monkeypatch: pytest.MonkeyPatch) -> None:
    assert hashed() == ""
    (tmp_path / "hashed_package.py").write_text("a = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    first = hashed()
    (tmp_path / "hashed_package.py").write_text("a = 2\n")
    assert len({"", first, hashed()}) == 3


def test_hash_is_taken_once_in_a_process(package: Path, hashed: Hashed) -> None:
    before = hashed()
    (package / "__init__.py").write_text("")
    assert source_hash("hashed_package") == before
    assert source_hash_now("hashed_package") == hashed() != before


def test_look_at_the_disk_sees_a_change_of_equal_size_and_time(package: Path, hashed: Hashed) -> None:
    before, code = hashed(), package / "__init__.py"
    state = code.stat()
    code.write_text("raise RuntimeError('Imported')\n")
    os.utime(code, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert (code.stat().st_size, code.stat().st_mtime_ns) == (state.st_size, state.st_mtime_ns)
    assert source_hash_now("hashed_package") != before


def test_files_that_differ_in_where_name_and_content_end_have_another_hash(package: Path, hashed: Hashed) -> None:
    """Without lengths, the names and contents of both packages are the same characters one after the other."""
    (package / "__init__.py").write_text("")
    (package / "inner" / "data.json").unlink()
    (package / "a").write_text("b")
    first = hashed()
    (package / "a").rename(package / "ab")
    (package / "ab").write_text("")
    assert hashed() != first


@pytest.mark.slow
def test_key_changes_with_a_changed_checkout(write_suite: WriteSuite, tmp_path: Path) -> None:
    """Another process has a copy of the package in which one comment was added, under the same version."""
    import baselines
    import sonar_graph

    for package in (sonar_graph, baselines):
        folder = Path(str(package.__file__)).parent
        shutil.copytree(folder, tmp_path / "copy" / folder.name, ignore=shutil.ignore_patterns("__pycache__"))
    suite = write_suite(HEADER, BASIN, DEAD_RECKONING, '[[estimators]]\nname = "isam2"\n')
    here = [run.key for run in plan_runs(read_suite(suite))]
    assert keys_by(tmp_path / "copy", suite) == here
    with (tmp_path / "copy" / "baselines" / "dead_reckoning.py").open("a") as file:
        file.write("# another\n")
    of_baselines = keys_by(tmp_path / "copy", suite)
    assert of_baselines[0] != here[0]
    assert of_baselines[1] == here[1]
    with (tmp_path / "copy" / "sonar_graph" / "states.py").open("a") as file:
        file.write("# another\n")
    assert not {*here, *of_baselines} & set(keys_by(tmp_path / "copy", suite))


def keys_by(code: Path, suite: Path) -> list[str]:
    """Keys as the package in a folder plans them."""
    program = (
        f"import sys; sys.path.insert(0, {str(code)!r})\n"
        "from pathlib import Path; from sonar_graph.batch import plan; from sonar_graph.batch.suite import read_suite\n"
        f"assert plan.__file__.startswith({str(code)!r})\n"
        f"print(*(run.key for run in plan.plan_runs(read_suite(Path({str(suite)!r})))))"
    )
    return subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout.split()


def test_estimator_of_another_package_has_the_hash_of_that(misbehaving: None) -> None:
    assert versions_of("dies")["estimator_source"] == source_hash("misbehaving") != ""
    assert versions_of("broken")["estimator_source"] == ""
    assert versions_of("isam2")["estimator_source"] == versions_of("dies")["source"] == source_hash("sonar_graph")


def test_code_behind_a_link_counts_and_links_in_a_circle_end(package: Path, hashed: Hashed, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "linked.py").write_text("a = 1\n")
    (package / "linked").symlink_to(elsewhere, target_is_directory=True)
    (elsewhere / "around").symlink_to(package, target_is_directory=True)
    before = hashed()
    (elsewhere / "linked.py").write_text("a = 2\n")
    assert hashed() != before
