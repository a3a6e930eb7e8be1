import json
import re
import zipfile
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.tools import file_interface

from sonar_graph.calibration import Calibration
from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation import (
    Comparison,
    compare,
    read_comparison,
    write_comparison,
)
from sonar_graph.files import COMPARISON, replacing, result_written
from sonar_graph.states import Refusal, RefusedRow
from tests.synthetic import late, outlier, with_run

from .conftest import Offset, straight_sequence


@pytest.fixture
def comparison(install) -> Comparison:
    """One run that went well but for refused rows, one that failed."""
    install(other=Offset)
    settings = {"offset": {"offset_m": 0.4}}
    found = compare(straight_sequence(), ["offset", "broken"], settings)
    rows = [outlier(k * 10**9, 50.0 + k) for k in range(8)] + [late(3)]
    said = {"refused": rows, "withheld": ["landmark 3; open: z"]}
    return with_run(found, replace(found.runs[0], **said))


@pytest.fixture
def folder(comparison, tmp_path) -> Path:
    write_comparison(comparison, tmp_path)
    return tmp_path


def assert_same(left: Any, right: Any, where: str = "") -> None:
    """Equal all the way down; arrays exactly, NaN equal to NaN."""
    if is_dataclass(left):
        left, right = vars(left), vars(right)
    if isinstance(left, (list, RefusedRow)):
        left, right = dict(enumerate(left)), dict(enumerate(right))
    if isinstance(left, dict):
        assert list(left) == list(right), where
        for key in left:
            assert_same(left[key], right[key], f"{where}[{key}]")
    elif isinstance(left, (np.ndarray, float)):
        np.testing.assert_array_equal(left, right, err_msg=where)
    else:
        assert left == right, where


def test_reading_returns_what_was_written(comparison, folder):
    restored = read_comparison(str(folder))
    for name in ("runs", "scores", "errors", "environment", "instants_ns"):
        assert_same(getattr(comparison, name), getattr(restored, name), name)
    names = "name notes truth true_landmarks detections start_ns end_ns calibration"
    for name in names.split():
        values = [getattr(one.sequence, name) for one in (comparison, restored)]
        assert_same(*values, name)
    assert isinstance(restored.sequence.calibration, Calibration)


def test_json_is_strict_and_has_units_protocol_and_counts(folder):
    text = (folder / "comparison.json").read_text("utf-8")
    assert not re.search(r"\b(NaN|Infinity)\b", text)
    runs = json.loads(text)["runs"]
    score = runs["offset"]["scores"]["causal.ate_raw_m"]
    assert score["value"] == pytest.approx(0.4)
    assert score["unit"] == "m"
    assert "not aligned" in score["protocol"]
    assert runs["offset"]["params"]["offset_m"] == 0.4
    assert runs["broken"]["status"] == "failed"
    assert "diverged" in runs["broken"]["reason"]
    many, one = runs["offset"]["refused"]
    assert (many["sensor"], many["reason"]) == ("dvl", Refusal.OUTLIER.value)
    assert (many["count"], many["first_ns"], many["last_ns"]) == (8, 0, 7 * 10**9)
    assert many["least_and_largest_distance"] == [50.0, 57.0]
    assert one["least_and_largest_distance"] is None


def test_a_result_folder_is_readable_without_this_package(folder):
    good = folder / "runs" / "offset"
    names = {
        path.relative_to(good.parent).as_posix() for path in good.parent.glob("*/*")
    }
    files = "causal.tum", "landmarks.csv", "series.npz", "trajectory.tum"
    assert names == {"broken/series.npz", *(f"offset/{name}" for name in files)}
    for name, offset_m in (("causal.tum", 0.4), ("trajectory.tum", 0.2)):
        path = file_interface.read_tum_trajectory_file(good / name)
        np.testing.assert_allclose(path.positions_xyz[:, 1], offset_m)
    landmarks = (good / "landmarks.csv").read_text("utf-8").splitlines()
    assert [row.split(",")[0] for row in landmarks] == ["id", "7", "9", "20"]
    for path in folder.rglob("*.npz"):
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                assert b"'descr': '|O'" not in archive.read(name)[:200], name


def test_no_page_of_an_earlier_comparison_stays_beside_later_numbers(
    comparison, folder
):
    page = folder / "report.html"
    with result_written(folder, COMPARISON), replacing(page) as partial:
        partial.write_text("an earlier page")
    write_comparison(comparison, folder)
    assert not page.exists()
    page.write_text("mine")
    write_comparison(comparison, folder)
    assert page.read_text() == "mine"


def test_a_name_that_leaves_the_folder_is_refused(comparison, tmp_path):
    object.__setattr__(comparison.runs[0], "estimator", "../elsewhere")
    with pytest.raises(EvaluationError, match="cannot name a folder"):
        write_comparison(comparison, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("file", "content", "named"),
    [
        ("comparison.json", b"{", r"comparison\.json"),
        ("comparison.json", b'{"format": "something else"}', "something else"),
        ("runs/offset/series.npz", b"PK cut off", r"series\.npz"),
        (
            "sequence.npz",
            "truth.positions",
            "truth lacks positions",
        ),  # the name of a column to leave out
    ],
)
def test_damage_is_named(folder, file, content, named):
    path = folder / file
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        with np.load(path) as archive:
            kept = {name: archive[name] for name in archive.files if name != content}
        np.savez(path, **kept)
    with pytest.raises(EvaluationError, match=named):
        read_comparison(folder)


@pytest.mark.parametrize(
    ("way", "value"),
    [
        ("sequence notes log.note", 3),
        ("environment numpy", None),
        ("runs offset status", "well"),
    ],
)
def test_a_value_of_another_type_is_refused_before_a_page_is_drawn(folder, way, value):
    content = json.loads((folder / "comparison.json").read_text())
    *tables, name = way.split()
    table = content
    for key in tables:
        table = table[key]
    table[name] = value
    (folder / "comparison.json").write_text(json.dumps(content))
    with pytest.raises(EvaluationError, match="not as written; compare anew"):
        read_comparison(folder)
