"""Where the start is not stated, errors are those of the estimator, not of the unknown world."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.evaluation import Comparison, judge
from sonar_graph.evaluation.metrics import Alignment
from sonar_graph.report import doubt_lines
from sonar_graph.report.comparison_page import render_report
from sonar_graph.report.sentences import remarks
from sonar_graph.states import Trajectory
from tests.synthetic import basin_comparison, only

FAR = Alignment(
    Rotation.from_euler("z", 140, degrees=True).as_matrix(),
    np.array([4.6e5, -4.7e6, 30.0]),
)
UNKNOWN = Calibration()


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
    sequence = known.sequence
    truth = sequence.truth
    places = world.apply(truth.positions)
    turned = (Rotation.from_matrix(world.rotation) * truth.rotations()).as_quat()
    moved = replace(truth, positions=places, quaternions_xyzw=turned)
    if not orientation:
        moved = Trajectory.of_positions(truth.stamps_ns, places)
    landmarks = world.map(sequence.true_landmarks)
    given = {"calibration": calibration, "truth": moved, "true_landmarks": landmarks}
    return judge(replace(sequence, **given), known.instants_ns, known.runs)


@pytest.mark.parametrize("orientation", [True, False])
def test_errors_of_an_unknown_world_are_those_of_a_known_one(known, orientation):
    found = judged(known, UNKNOWN, FAR, orientation=orientation)

    def differs(name, key):
        values = (one.scores[name][key].value for one in (found, known))
        return abs(np.subtract(*values))

    for name in ("isam2", "ekf-slam", "dead-reckoning"):
        assert differs(name, "causal.ate_se2_m") < 1e-6
        # the fit to the best path takes away a part of its error, and no more
        assert differs(name, "causal.ate_raw_m") < 0.05
    assert differs("isam2", "landmarks.se2_m") < 1e-6
    nees = known.scores["isam2"]["causal.nees_position"].value
    assert differs("isam2", "causal.nees_position") < 0.3 * nees
    told = "no start, so the truth was brought into the world of the estimates: turned by -140"
    assert told in remarks(found)[0]
    lines = doubt_lines(found.sequence.notes)
    assert any(line.startswith("Truth: the log states no start") for line in lines)
    protocol = found.scores["isam2"]["causal.ate_raw_m"].protocol
    assert "the truth brought into the estimates' world" in protocol


@pytest.mark.usefixtures("unrendered")
def test_every_word_of_the_page_says_what_was_brought_where(known):
    fitted = "the truth brought into the estimates&#39; world"
    alone = only(known, "isam2")
    told = render_report(judged(alone, UNKNOWN, FAR))
    assert "not aligned" not in told
    assert told.count(fitted) >= 8
    plain = render_report(alone)
    assert fitted not in plain
    assert "not aligned" in plain
