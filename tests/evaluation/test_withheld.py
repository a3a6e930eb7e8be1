"""What an estimator withheld is told to the user in its own words: terminal, page and files, from failed runs too."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from gtsam.symbol_shorthand import L

from sonar_graph.estimator import load_estimator, withheld_of
from sonar_graph.evaluation.comparison import compare
from sonar_graph.evaluation.results import MOST_ROWS_NAMED, Comparison
from sonar_graph.evaluation.run import run_estimator
from sonar_graph.evaluation.storage import read_comparison, write_comparison
from sonar_graph.measurements import Measurements
from sonar_graph.report.comparison_page import render_report
from sonar_graph.report.findings import withheld_lines
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.slam.landmarks.sighting import SightingFactors
from sonar_graph.states import Estimate
from tests.report.test_console import printed
from tests.synthetic import basin_comparison, with_run

MESSAGE = "landmark 3, from keyframe 1 at 1.000 s: 1 range; open: z; an elevation is missing; withheld"


def withholding(messages: list[str]) -> Comparison:
    comparison = basin_comparison(60)
    return with_run(comparison, replace(comparison.runs[0], withheld=messages))


def test_terminal_page_and_files_say_what_was_withheld(tmp_path: Path) -> None:
    comparison = withholding([MESSAGE])
    line = f"Warning: isam2: {MESSAGE}"
    assert withheld_lines(comparison) == [line]
    assert line in printed(comparison, 200)
    page = render_report(comparison)
    assert page.index(line) < page.index("<nav")
    write_comparison(comparison, tmp_path)
    assert json.loads((tmp_path / "runs" / "isam2" / "result.json").read_text())["withheld"] == [MESSAGE]
    assert [run.withheld for run in read_comparison(tmp_path).runs] == [[MESSAGE], [], []]


def test_of_many_the_first_are_told_and_the_others_counted() -> None:
    lines = withheld_lines(withholding([f"{MESSAGE} {k}" for k in range(MOST_ROWS_NAMED + 2)]))
    assert len(lines) == MOST_ROWS_NAMED + 1
    assert lines[-1] == "Warning: isam2 withheld 2 more: runs/isam2/result.json has all"


def test_nothing_is_said_where_nothing_was_withheld() -> None:
    assert withheld_lines(basin_comparison(60)) == []


def test_a_landmark_that_isam2_could_not_place_reaches_the_comparison(monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = simulate_mission(MissionOptions(duration_s=20.0, imu="mti1"))
    placed = SightingFactors._placed
    first = {int(sequence.detections.most_probable()[0][0])}

    def without(self: SightingFactors, sighting: Any, key: int) -> Any:
        return [] if {key} == {L(id_) for id_ in first} else placed(self, sighting, key)

    monkeypatch.setattr(SightingFactors, "_placed", without)
    (line, *_) = withheld_lines(compare(sequence, ["isam2", "dead-reckoning"]))
    assert line.startswith("Warning: isam2: landmark ")
    assert line.endswith("; withheld")


@pytest.mark.parametrize("can_tell", [True, False])
def test_a_failed_run_says_what_it_withheld_before(
    install: Callable[..., None], make_sequence: Callable[..., Sequence], offset_estimator: Any, can_tell: bool
) -> None:
    class Fails(offset_estimator):
        def process(self, _measurements: Measurements) -> Estimate | None:
            raise ZeroDivisionError("singular")

        def withheld(self) -> list[str]:
            if not can_tell:
                raise ValueError("not even that")
            return [MESSAGE]

    install(fails=Fails)
    result = run_estimator(make_sequence(), "fails")
    assert result.status == "failed"
    assert result.withheld == ([MESSAGE] if can_tell else [])


def test_the_method_is_optional(make_sequence: Callable[..., Sequence]) -> None:
    assert withheld_of(load_estimator("dead-reckoning")(make_sequence().calibration)) == []
