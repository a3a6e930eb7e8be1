from __future__ import annotations

from pathlib import Path

import pytest

from sonar_graph.batch import plan
from sonar_graph.batch.plan import plan_runs, versions_of
from sonar_graph.batch.sources import LOG, fingerprint
from sonar_graph.batch.store import PlannedRun
from sonar_graph.batch.suite import read_suite
from sonar_graph.errors import BatchError

from .conftest import BASIN, DEAD_RECKONING, HEADER, WriteSuite

ISAM2 = '[[estimators]]\nname = "isam2"\n'
HEADER_OF_ISAM2 = HEADER.replace("dead-reckoning", "isam2")


def planned(write_suite: WriteSuite, *parts: str) -> list[PlannedRun]:
    return plan_runs(read_suite(write_suite(*parts)))


def key(write_suite: WriteSuite, *parts: str) -> str:
    (run,) = planned(write_suite, *parts)
    return run.key


def test_every_combination_is_planned_once_in_order(write_suite: WriteSuite) -> None:
    runs = planned(
        write_suite,
        HEADER,
        BASIN,
        "grid = { wrong_id_rate = [0.0, 0.1], frame_rate_hz = [1, 2] }\nseeds = 2\n",
        DEAD_RECKONING,
        ISAM2 + 'variant = "short"\ngrid = { smoother.lag_s = [5, 15] }\n',
    )
    assert len({run.key for run in runs}) == len(runs) == 4 * 2 * 3
    assert [run.variant for run in runs[:3]] == ["default", "short, smoother.lag_s=5", "short, smoother.lag_s=15"]
    assert [run.seed for run in runs[:6]] == [0, 0, 0, 1, 1, 1]
    assert runs[-1].log == "basin, wrong_id_rate=0.1, frame_rate_hz=2"
    assert runs[-1].options["wrong_id_rate"] == 0.1
    assert runs[-1].params["smoother"]["lag_s"] == 15


@pytest.mark.parametrize(
    "parts",
    [
        (HEADER_OF_ISAM2, BASIN.replace("120", "121"), ISAM2),
        (HEADER_OF_ISAM2, BASIN, "seeds = [1]\n", ISAM2),
        (HEADER_OF_ISAM2, BASIN, ISAM2, "params = { smoother.lag_s = 14 }\n"),
        (HEADER_OF_ISAM2, "rate_hz = 1\n", BASIN, ISAM2),
        (HEADER, BASIN, DEAD_RECKONING),
    ],
)
def test_key_changes_with_all_that_decides_the_numbers(write_suite: WriteSuite, parts: tuple[str, ...]) -> None:
    assert key(write_suite, *parts) != key(write_suite, HEADER_OF_ISAM2, BASIN, ISAM2)


def test_key_changes_with_the_version(write_suite: WriteSuite, monkeypatch: pytest.MonkeyPatch) -> None:
    before = key(write_suite)
    monkeypatch.setattr(plan, "versions_of", lambda _name: {"sonar_graph": "another"})
    assert key(write_suite) != before


def test_key_changes_with_landmarks_on_a_log(write_suite: WriteSuite) -> None:
    log = '[[logs]]\nname = "park"\ndataset = "victoria-park"\n'
    placed = [
        key(write_suite, HEADER, log, f"landmarks = {{ {text} }}\n", DEAD_RECKONING)
        for text in ("", "frame_rate_hz = 3")
    ]
    assert len({key(write_suite, HEADER, log, DEAD_RECKONING), *placed}) == 3


def test_key_does_not_change_with_names_or_with_defaults_written_out(write_suite: WriteSuite) -> None:
    same = key(
        write_suite,
        HEADER_OF_ISAM2.replace("short", "another") + "timeout_s = 9\n",
        BASIN.replace('"basin"\ngen', '"pool"\ngen').replace("laps = 1", "laps = 1, wrong_id_rate = 0.0"),
        "seeds = [0]\n",
        ISAM2,
        "params = { smoother.lag_s = 15.0 }\n",
    )
    assert same == key(write_suite, HEADER_OF_ISAM2, BASIN, ISAM2)


def test_of_a_log_the_content_counts_and_not_the_place(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    paths = [tmp_path / "a.mcap", tmp_path / "other" / "b.mcap", tmp_path / "c.mcap"]
    for path, content in zip(paths, (b"log", b"log", b"lob"), strict=True):
        path.write_bytes(content)
    first, moved, changed = (fingerprint(LOG, {"log": str(path)}) for path in paths)
    assert first == moved
    assert first != changed
    paths[0].write_bytes(b"lob")
    assert fingerprint(LOG, {"log": str(paths[0])}) == changed


def test_folders_whose_files_end_elsewhere_have_another_content(tmp_path: Path) -> None:
    """Names and contents of both are the same characters one after the other."""
    for name, files in (("one", {"a": "b", "c": ""}), ("two", {"a": "", "bc": ""}), ("three", {"abc": ""})):
        (tmp_path / name).mkdir()
        for file, content in files.items():
            (tmp_path / name / file).write_text(content)
    folders = [fingerprint("mrclam", {"folder": str(tmp_path / name)})["folder"] for name in ("one", "two", "three")]
    assert len(set(folders)) == 3


def test_key_changes_with_the_class_behind_the_name(write_suite: WriteSuite, misbehaving: None, tmp_path: Path) -> None:
    suite = (HEADER.replace("dead-reckoning", "dies"), BASIN, '[[estimators]]\nname = "dies"\n')
    before = key(write_suite, *suite)
    points = tmp_path / "site" / "misbehaving-1.0.dist-info" / "entry_points.txt"
    points.write_text(points.read_text().replace("misbehaving:Dies\n", "misbehaving:Prints\n"))
    versions_of.cache_clear()
    assert key(write_suite, *suite) != before
    versions_of.cache_clear()


def test_key_changes_with_the_version_of_python(write_suite: WriteSuite, monkeypatch: pytest.MonkeyPatch) -> None:
    before = key(write_suite)
    versions_of.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr("platform.python_version", lambda: "3.99.0")
        assert key(write_suite) != before
    versions_of.cache_clear()


def test_run_has_the_content_that_its_key_is_made_of(write_suite: WriteSuite) -> None:
    (run,) = planned(write_suite)
    assert run.content == fingerprint(run.kind, run.options)


def test_estimator_that_cannot_be_loaded_is_planned(write_suite: WriteSuite, misbehaving: None) -> None:
    runs = planned(write_suite, HEADER, BASIN, DEAD_RECKONING, '[[estimators]]\nname = "broken"\nparams = { a = 1 }\n')
    assert runs[1].params == {"a": 1}


def test_settings_that_exclude_each_other_are_told_with_line_and_key(write_suite: WriteSuite) -> None:
    text = 'params = { identity.policy = "gnc" }\ngrid = { history.policy = ["whole", "bounded"] }\n'
    with pytest.raises(BatchError, match=r'line 11: estimators\.0\.grid\.history: .*"gnc", which chooses anew'):
        planned(write_suite, HEADER_OF_ISAM2, BASIN, ISAM2, text)


def test_what_was_asked_for_is_what_the_suite_states(write_suite: WriteSuite) -> None:
    (run,) = planned(
        write_suite,
        HEADER_OF_ISAM2,
        BASIN,
        "grid = { wrong_id_rate = [0.1] }\n",
        ISAM2,
        "params = { smoother.lag_s = 14 }\n",
    )
    assert run.asked == {
        "generator": "basin",
        "options": {"duration_s": 120, "laps": 1, "wrong_id_rate": 0.1},
        "files": {},
        "landmarks": None,
        "settings": {"smoother": {"lag_s": 14}},
        "rate_hz": 2.0,
    }


def test_files_are_asked_for_by_content_and_landmarks_as_they_are_stated(
    write_suite: WriteSuite, tmp_path: Path
) -> None:
    park = '[[logs]]\nname = "park"\ndataset = "victoria-park"\nlandmarks = { frame_rate_hz = 3 }\n'
    (run,) = planned(write_suite, HEADER, park, DEAD_RECKONING)
    assert run.asked["files"] == {"file": fingerprint("victoria-park", {})["file"]}
    assert run.asked["landmarks"] == {"frame_rate_hz": 3}
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "Robot1.dat").write_text("1\n")
    robots = '[[logs]]\nname = "x"\ndataset = "mrclam"\noptions = { folder = "robots", robot = 1 }\n'
    (run,) = planned(write_suite, HEADER, robots, DEAD_RECKONING)
    assert run.asked["options"] == {"robot": 1}
    assert len(run.asked["files"]["folder"]) == 64


def test_content_of_a_folder_has_what_lies_behind_links(tmp_path: Path) -> None:
    for name in ("data", "elsewhere"):
        (tmp_path / name).mkdir()
    (tmp_path / "elsewhere" / "a.csv").write_text("1")
    (tmp_path / "data" / "run").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    before = fingerprint("mrclam", {"folder": str(tmp_path / "data")})
    (tmp_path / "elsewhere" / "a.csv").write_text("2")
    assert fingerprint("mrclam", {"folder": str(tmp_path / "data")}) != before
