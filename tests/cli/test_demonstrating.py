"""``demo`` goes from images to the paper's table."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from sonar_graph.cli.compare import DEMO
from sonar_graph.evaluation.storage import read_comparison
from sonar_graph.logs.reading import read_log
from sonar_graph.simulation.basin import FASTEST_M_S, PAPER_LAPS, BasinOptions, cruise_speed

Run = Callable[..., int]


@pytest.mark.slow
def test_demo_goes_from_images_to_the_papers_table(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sonar_graph.cli.compare.DEMO", DEMO | {"duration_s": 130.0, "laps": 1})
    assert run("demo", "-o", tmp_path) == 0
    told = capsys.readouterr().out
    assert f"Report: {tmp_path / 'report.html'}" in told
    assert "2014 paper x" in told
    sequence = read_log(tmp_path / "basin.mcap")
    assert sequence.detections is None, "the log holds images, not what is in them"
    comparison = read_comparison(tmp_path)
    assert comparison.recognition is not None
    assert comparison.recognition.frames > 600
    assert {run.estimator for run in comparison.runs if run.landmarks is not None and len(run.landmarks) == 4} == {
        "isam2",
        "ekf-slam",
    }


def test_demo_drives_the_three_laps_of_the_paper_with_images() -> None:
    options = BasinOptions.model_validate(DEMO)
    assert options.laps == PAPER_LAPS
    assert options.image is not None
    assert cruise_speed(options) < FASTEST_M_S
