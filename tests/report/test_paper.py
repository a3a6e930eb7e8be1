"""What is written for a paper: widths and fonts of journals, whole tables, and the protocol with captions."""

import re
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation import compare
from sonar_graph.files import PAPER, Manifest
from sonar_graph.report import write_paper
from sonar_graph.report.paper import COLUMN_IN, PAGE_IN
from sonar_graph.testing import small_world
from tests.recorded_batches import drawn_batch
from tests.synthetic import basin_comparison

KINDS = {"comparison": lambda: basin_comparison(60), "batch": drawn_batch}


@pytest.fixture(scope="module", params=KINDS)
def folder(request, tmp_path_factory) -> Path:
    return write_paper(
        KINDS[request.param](), tmp_path_factory.mktemp("result") / "paper"
    ).parent


def width_in(svg: Path) -> float:
    return float(re.search(r'width="([\d.]+)pt"', svg.read_text("utf-8"))[1]) / 72


def test_every_figure_is_written_as_svg_and_pdf(
    folder,
):
    figures = sorted((folder / "figures").glob("*.svg"))
    assert figures
    for svg in figures:
        assert (
            min(abs(width_in(svg) - wanted) for wanted in (COLUMN_IN, PAGE_IN)) < 0.01
        ), svg.name
        assert "<text" not in svg.read_text("utf-8"), "outlines need no font"
        pdf = svg.with_suffix(".pdf").read_bytes()
        assert b"/Type3" not in pdf
        assert b"/FontFile2" in pdf, "a TrueType font, embedded"


def test_the_same_result_gives_the_same_files_and_replaces_its_own(tmp_path):
    comparison = basin_comparison(60)
    write_paper(comparison, tmp_path)
    before = {
        path: path.read_bytes()
        for path in tmp_path.rglob("*.*")
        if not path.name.startswith(".")
    }
    write_paper(comparison, tmp_path)
    assert before == {
        path: path.read_bytes()
        for path in tmp_path.rglob("*.*")
        if not path.name.startswith(".")
    }
    assert Manifest.found(tmp_path).kind == PAPER
    (tmp_path / "protocol.txt").write_text("mine")
    with pytest.raises(
        EvaluationError,
        match=r"holds protocol\.txt, which sonar-graph did not write or others changed",
    ):
        write_paper(comparison, tmp_path)
    write_paper(comparison, tmp_path, overwrite=True)
    assert np.array_equal(
        before[tmp_path / "protocol.txt"], (tmp_path / "protocol.txt").read_bytes()
    )


def test_without_landmarks_and_truth_what_is_left_is_written(tmp_path):
    comparison = compare(small_world(), ["dead-reckoning"])
    write_paper(comparison, tmp_path)
    assert not (tmp_path / "figures" / "innovations.pdf").exists()
    assert (tmp_path / "figures" / "map.pdf").exists()
