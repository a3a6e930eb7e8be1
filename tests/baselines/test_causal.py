import gtsam
import numpy as np

from sonar_graph.estimator import CausalEstimates
from sonar_graph.states import Estimate


def estimate(stamp_ns, x):
    return Estimate(stamp_ns, gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0])), np.eye(6))


def test_an_instant_asked_for_twice_has_the_later_answer_and_time_never_runs_back():
    said = CausalEstimates()
    for stamp_ns, x in ((1, 0.1), (2, 0.2), (2, 0.3), (1, 0.4), (3, 0.5)):
        said.keep(estimate(stamp_ns, x))
    trajectory = said.trajectory()
    assert trajectory.stamps_ns.tolist() == [1, 2, 3]
    assert trajectory.positions[:, 0].tolist() == [0.1, 0.3, 0.5]


def test_before_the_first_estimate_the_trajectory_is_empty():
    assert len(CausalEstimates().trajectory()) == 0
