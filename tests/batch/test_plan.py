"""The key of a run changes with all that decides its numbers, and with nothing else."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sonar_graph.batch.plan import source_hash, versions_of
from sonar_graph.batch.sources import LOG, fingerprint
from sonar_graph.errors import BatchError

from .conftest import BASIN, DEAD_RECKONING, HEADER

ISAM2 = '[[estimators]]\nname = "isam2"\n'
HEADER_OF_ISAM2 = HEADER.replace("dead-reckoning", "isam2")


def test_every_combination_is_planned_once_in_order(plan):
    runs = plan(
        HEADER,
        BASIN,
        "grid = { wrong_id_rate = [0.0, 0.1], frame_rate_hz = [1, 2] }\nseeds = 2\n",
        DEAD_RECKONING,
        ISAM2 + 'variant = "short"\ngrid = { smoother.lag_s = [5, 15] }\n',
    )
    assert len({run.key for run in runs}) == len(runs) == 4 * 2 * 3
    variants = ["default", "short, smoother.lag_s=5", "short, smoother.lag_s=15"]
    found = [(run.seed, run.variant) for run in runs[:6]]
    assert found == [(seed, variant) for seed in (0, 1) for variant in variants]
    assert runs[-1].log == "basin, wrong_id_rate=0.1, frame_rate_hz=2"
    assert runs[-1].options["wrong_id_rate"] == 0.1
    assert runs[-1].params["smoother"]["lag_s"] == 15


LAG = "params = { smoother.lag_s = 14 }\n"


PARK = '[[logs]]\nname = "park"\ndataset = "victoria-park"\n'
LANDMARKS = "landmarks = { frame_rate_hz = 3 }\n"
OTHERS = {
    "another simulation": (HEADER_OF_ISAM2, BASIN.replace("120", "121"), ISAM2),
    "another seed": (HEADER_OF_ISAM2, BASIN, "seeds = [1]\n", ISAM2),
    "another setting": (HEADER_OF_ISAM2, BASIN, ISAM2, LAG),
    "another rate": (HEADER_OF_ISAM2, "rate_hz = 1\n", BASIN, ISAM2),
    "another estimator": (HEADER, BASIN, DEAD_RECKONING),
    "a log": (HEADER, PARK, DEAD_RECKONING),
    "landmarks": (HEADER, PARK, "landmarks = {}\n", DEAD_RECKONING),
    "other landmarks": (HEADER, PARK, LANDMARKS, DEAD_RECKONING),
}


def test_a_run_s_key_changes_with_all_that_decides_its_numbers(plan):
    (run,) = plan(HEADER_OF_ISAM2, BASIN, ISAM2)
    assert run.content == fingerprint(run.kind, run.options)
    others = {plan(*parts)[0].key for parts in OTHERS.values()}
    assert len({run.key, *others}) == 1 + len(OTHERS)
    pool = BASIN.replace('"basin"\ngen', '"pool"\ngen')
    (same,) = plan(
        HEADER_OF_ISAM2.replace("short", "another") + "timeout_s = 9\n",
        pool.replace("laps = 1", "laps = 1, wrong_id_rate = 0.0"),
        "seeds = [0]\n",
        ISAM2,
        LAG.replace("14", "15.0"),
    )
    assert same.key == run.key


def test_a_run_s_key_changes_with_class_and_python_version(
    plan, misbehaving, tmp_path, monkeypatch
):
    suite = HEADER.replace("dead-reckoning", "dies")
    keys = set()

    def planned():
        versions_of.cache_clear()
        (run,) = plan(suite, BASIN, '[[estimators]]\nname = "dies"\n')
        keys.add(run.key)

    planned()
    points = tmp_path / "site" / "misbehaving-1.0.dist-info" / "entry_points.txt"
    points.write_text(points.read_text().replace(":Dies\n", ":Prints\n"))
    planned()
    with monkeypatch.context() as patch:
        patch.setattr("platform.python_version", lambda: "3.99.0")
        planned()
    versions_of.cache_clear()
    assert len(keys) == 3


def test_of_a_log_the_content_counts_and_not_the_place(tmp_path):
    (tmp_path / "other").mkdir()

    def hashed(name, content):
        (tmp_path / name).write_bytes(content)
        return fingerprint(LOG, {"log": str(tmp_path / name)})

    first, moved = hashed("a.mcap", b"log"), hashed("other/b.mcap", b"log")
    changed, again = hashed("c.mcap", b"lob"), hashed("a.mcap", b"lob")
    assert first == moved != changed == again


def test_of_a_folder_every_name_and_content_counts_also_behind_links(tmp_path):
    """Names and contents of the first three are the same characters one after the other."""

    def content_of(name):
        return fingerprint("mrclam", {"folder": str(tmp_path / name)})["folder"]

    found = []
    for name, files in (
        ("one", {"a": "b", "c": ""}),
        ("two", {"a": "", "bc": ""}),
        ("three", {"abc": ""}),
    ):
        (tmp_path / name).mkdir()
        for file, content in files.items():
            (tmp_path / name / file).write_text(content)
        found.append(content_of(name))
    (tmp_path / "three" / "run").symlink_to(tmp_path / "one", target_is_directory=True)
    found.append(content_of("three"))
    (tmp_path / "one" / "a").write_text("d")
    assert len({*found, content_of("three")}) == 5


def test_an_estimator_of_another_package_has_the_hash_of_that_package(
    plan, misbehaving
):
    theirs = versions_of("dies")
    assert theirs["estimator_source"] == source_hash("misbehaving") != ""
    own = source_hash("sonar_graph")
    assert versions_of("isam2")["estimator_source"] == theirs["source"] == own
    broken = '[[estimators]]\nname = "broken"\nparams = { a = 1 }\n'
    _, run = plan(HEADER, BASIN, DEAD_RECKONING, broken)
    assert (run.params, run.versions["estimator_source"]) == ({"a": 1}, "")


def test_the_request_is_the_suite_with_files_by_content(plan, tmp_path):
    grid = "grid = { wrong_id_rate = [0.1] }\n"
    (run,) = plan(HEADER_OF_ISAM2, BASIN, grid, ISAM2, LAG)
    assert run.asked == {
        "generator": "basin",
        "options": {"duration_s": 120, "laps": 1, "wrong_id_rate": 0.1},
        "files": {},
        "landmarks": None,
        "settings": {"smoother": {"lag_s": 14}},
        "rate_hz": 2.0,
    }
    (run,) = plan(HEADER, PARK, LANDMARKS, DEAD_RECKONING)
    assert run.asked["files"] == {"file": fingerprint("victoria-park", {})["file"]}
    assert run.asked["landmarks"] == {"frame_rate_hz": 3}
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "Robot1.dat").write_text("1\n")
    robots = '[[logs]]\nname = "x"\ndataset = "mrclam"\noptions = { folder = "robots", robot = 1 }\n'
    (run,) = plan(HEADER, robots, DEAD_RECKONING)
    assert run.asked["options"] == {"robot": 1}
    assert len(run.asked["files"]["folder"]) == 64


Hashed = Callable[[], str]


@pytest.fixture
def package(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "first" / "hashed_package"
    (folder / "inner").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise RuntimeError('imported')\n")
    (folder / "inner" / "data.json").write_text("{}")
    monkeypatch.syspath_prepend(folder.parent)
    return folder


@pytest.fixture
def hashed() -> Iterator[Hashed]:
    def anew():
        source_hash.cache_clear()
        return source_hash("hashed_package")

    yield anew
    source_hash.cache_clear()


def test_a_hash_changes_with_code_data_and_names(package, hashed, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "linked.py").write_text("a = 1\n")
    (elsewhere / "around").symlink_to(package, target_is_directory=True)
    data = package / "inner" / "data.json"
    changes = [
        lambda: (package / "__init__.py").write_text("raise TypeError('imported')\n"),
        lambda: data.write_text("[]"),
        lambda: data.rename(package / "data.json"),
        (package / "more.py").touch,
        lambda: (package / "linked").symlink_to(elsewhere, target_is_directory=True),
        lambda: (elsewhere / "linked.py").write_text("a = 2\n"),
    ]
    hashes = {"", hashed()}
    for change in changes:
        change()
        hashes.add(hashed())
    assert len(hashes) == len(changes) + 2


def test_hash_is_of_neither_bytecode_nor_hidden_files_nor_place(
    package, hashed, tmp_path, monkeypatch
):
    before = hashed()
    (package / "__pycache__").mkdir()
    (package / "__pycache__" / "kernel.nbi").write_text("compiled")
    (package / ".swap").write_text("edited")
    assert hashed() == before
    shutil.move(package.parent, tmp_path / "second")
    monkeypatch.syspath_prepend(tmp_path / "second")
    assert hashed() == before


def test_a_hash_is_taken_once_in_a_process(package, hashed):
    before = hashed()
    code = package / "__init__.py"
    state = code.stat()
    code.write_text("raise RuntimeError('Imported')\n")
    os.utime(code, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert code.stat().st_size == state.st_size
    assert source_hash("hashed_package") == before
    assert hashed() != before


ABSENT = '[[logs]]\nname = "x"\ndataset = "dlr"\noptions = { folder = "absent" }\n'


def test_an_absent_log_is_left_out_if_the_suite_states_its_source(plan):
    obtain = 'obtain = "the data set from its authors"\n'
    runs = plan(HEADER, BASIN, ABSENT, obtain, DEAD_RECKONING)
    assert [run.log for run in runs] == ["basin"]
    none = "no data of any log is here; get the data set from its authors"
    for parts, told in (
        ((BASIN, ABSENT), "absent is not in"),
        ((ABSENT, obtain), none),
    ):
        with pytest.raises(BatchError, match=told):
            plan(HEADER, *parts, DEAD_RECKONING)
