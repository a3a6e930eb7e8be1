"""What is written for a paper: widths and fonts of journals, whole tables, and the protocol with captions."""

import re
from pathlib import Path

import pytest

from sonar_graph.evaluation import compare
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


def test_without_landmarks_and_truth_what_is_left_is_written(tmp_path):
    comparison = compare(small_world(), ["dead-reckoning"])
    write_paper(comparison, tmp_path)
    assert not (tmp_path / "figures" / "innovations.pdf").exists()
    assert (tmp_path / "figures" / "map.pdf").exists()
