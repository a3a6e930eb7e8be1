"""What is written for a paper: widths and fonts of journals, whole tables, and the protocol with captions."""

import re
import shutil
from pathlib import Path

import pytest

from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation import Comparison, compare
from sonar_graph.files import PAPER, Manifest
from sonar_graph.report import write_paper
from sonar_graph.report.paper import COLUMN_IN, PAGE_IN
from sonar_graph.testing import small_world
from tests.recorded_batches import drawn_batch
from tests.synthetic import basin_comparison


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return basin_comparison(60)


@pytest.fixture(scope="module")
def folder(comparison, tmp_path_factory) -> Path:
    """What is written of a comparison."""
    return write_paper(comparison, tmp_path_factory.mktemp("result") / "paper").parent


def width_in(svg: Path) -> float:
    return float(re.search(r'width="([\d.]+)pt"', svg.read_text("utf-8"))[1]) / 72


def test_every_figure_is_written_as_svg_and_pdf(folder, tmp_path):
    write_paper(drawn_batch(), tmp_path)
    for written in (folder, tmp_path):
        figures = sorted((written / "figures").glob("*.svg"))
        assert figures
        for svg in figures:
            width = width_in(svg)
            assert min(abs(width - wanted) for wanted in (COLUMN_IN, PAGE_IN)) < 0.01
            assert "<text" not in svg.read_text("utf-8"), "outlines need no font"
            pdf = svg.with_suffix(".pdf").read_bytes()
            assert b"/Type3" not in pdf
            assert b"/FontFile2" in pdf, "a TrueType font, embedded"


def contents(folder: Path) -> dict[Path, bytes]:
    files = [path for path in folder.rglob("*.*") if not path.name.startswith(".")]
    return {path.relative_to(folder): path.read_bytes() for path in files}


def test_the_same_result_gives_the_same_files_and_replaces_its_own(
    comparison, folder, tmp_path
):
    paper = shutil.copytree(folder, tmp_path / "paper")
    write_paper(comparison, paper)
    assert contents(paper) == contents(folder)
    assert Manifest.found(paper).kind == PAPER
    (paper / "protocol.txt").write_text("mine")
    blind = compare(small_world(), ["dead-reckoning"])
    told = r"holds protocol\.txt, which sonar-graph did not write or others changed"
    with pytest.raises(EvaluationError, match=told):
        write_paper(blind, paper)
    write_paper(blind, paper, overwrite=True)
    assert (paper / "protocol.txt").read_text() != "mine"
    # of an earlier result, and of a run without landmarks
    innovations = Path("figures") / "innovations.pdf"
    assert innovations in contents(folder).keys() - contents(paper)
    assert (paper / "figures" / "map.pdf").exists()
