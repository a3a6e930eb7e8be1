"""Where nobody stated the start, errors are those of the estimator, not of the unknown world."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, Start
from sonar_graph.evaluation.comparison import judge
from sonar_graph.evaluation.metrics import Alignment
from sonar_graph.evaluation.results import Comparison
from sonar_graph.evaluation.tables import FITTED
from sonar_graph.report.comparison_page import render_report
from sonar_graph.report.sentences import doubt_lines, remarks
from sonar_graph.states import Trajectory
from tests.synthetic import basin_comparison

FAR = Alignment(
    Rotation.from_euler("z", 140, degrees=True).as_matrix(),
    np.array([4.6e5, -4.7e6, 30.0]),
)
UNKNOWN = Calibration()
ONLY_HEADING = Calibration(start=Start(rpy_rad=(0.0, 0.0, 0.0)))
STATED = Calibration(start=Start(position_m=(0.0, 0.0, 0.0), rpy_rad=(0.0, 0.0, 0.0)))


@pytest.fixture(scope="module")
def known() -> Comparison:
    return basin_comparison()


def judged(
    known: Comparison,
    calibration: Calibration,
    world: Alignment,
    *,
    orientation: bool = True,
) -> Comparison:
    """The same runs where the truth is of another world."""
    truth, sequence = known.sequence.truth, known.sequence
    turned = (Rotation.from_matrix(world.rotation) * truth.rotations()).as_quat()
    moved = Trajectory(
        truth.stamps_ns, world.apply(truth.positions), turned, truth.covariances
    )
    if not orientation:
        moved = Trajectory.of_positions(moved.stamps_ns, moved.positions)
    landmarks = world.map(sequence.true_landmarks)
    given = replace(
        sequence, calibration=calibration, truth=moved, true_landmarks=landmarks
    )
    return judge(given, known.instants_ns, known.runs)


def value(comparison: Comparison, name: str, key: str) -> float:
    return comparison.scores[name][f"causal.{key}"].value


@pytest.mark.parametrize("orientation", [True, False])
def test_errors_of_an_unknown_world_are_those_of_a_known_one(known, orientation):
    found = judged(known, UNKNOWN, FAR, orientation=orientation)
    for name in ("isam2", "ekf-slam", "dead-reckoning"):
        assert value(found, name, "ate_se2_m") == pytest.approx(
            value(known, name, "ate_se2_m"), abs=1e-6
        )
        # the fit to the best path takes away a part of its error, and no more
        assert value(found, name, "ate_raw_m") == pytest.approx(
            value(known, name, "ate_raw_m"), abs=0.05
        )
    scored = found.scores["isam2"]
    assert scored["landmarks.se2_m"].value == pytest.approx(
        known.scores["isam2"]["landmarks.se2_m"].value, abs=1e-6
    )
    assert value(found, "isam2", "nees_position") == pytest.approx(
        value(known, "isam2", "nees_position"), rel=0.3
    )
    assert (
        "no start, so the truth was brought into the world of the estimates: turned by -140"
        in remarks(found)[0]
    )
    assert any(
        line.startswith("Truth: the log states no start")
        for line in doubt_lines(found.sequence.notes)
    )
    assert (
        "the truth brought into the estimates' world"
        in found.scores["isam2"]["causal.ate_raw_m"].protocol
    )


def test_a_start_that_is_stated_is_held_against_the_truth(known):
    found = judged(known, STATED, FAR)
    assert FITTED not in found.sequence.notes
    assert value(found, "isam2", "ate_raw_m") > 1e6


def test_a_heading_that_was_measured_is_kept_and_only_the_position_fitted(known):
    beside = Alignment(np.eye(3), FAR.translation)
    found = judged(known, ONLY_HEADING, beside)
    assert value(found, "isam2", "ate_raw_m") == pytest.approx(
        value(known, "isam2", "ate_raw_m"), abs=0.05
    )
    assert "no position of the start" in found.sequence.notes[FITTED]
    turned = judged(known, ONLY_HEADING, FAR)
    assert value(turned, "isam2", "ate_raw_m") > 3.0


def test_every_word_of_the_page_says_what_was_brought_where(known):
    fitted, told = (
        "the truth brought into the estimates&#39; world",
        render_report(judged(known, UNKNOWN, FAR)),
    )
    assert "not aligned" not in told
    assert told.count(fitted) >= 10
    plain = render_report(known)
    assert fitted not in plain
    assert "not aligned" in plain


def test_judging_again_moves_nothing(known):
    once = judged(known, UNKNOWN, FAR)
    again = judge(once.sequence, once.instants_ns, once.runs)
    np.testing.assert_array_equal(
        again.sequence.truth.positions, once.sequence.truth.positions
    )
