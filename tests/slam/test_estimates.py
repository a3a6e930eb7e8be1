"""Covariances against the inverse of the information of all factors, and requests that cannot be met."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X

from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.slam import Isam2
from sonar_graph.slam.prediction import AnchoredPose, Tie
from sonar_graph.slam.smoother import JointCovariance
from sonar_graph.states import FIRST_ANONYMOUS_ID, Outcome
from sonar_graph.testing.numerical import central_differences

from .graphs import dense_covariance, factors_of, gtsams_solution, off_sigmas
from .late_identities import assert_outcomes_account, run
from .made import random_covariance, some_motion, values_of
from .rail import STEP_S, rail

KEYFRAME = gtsam.Pose3(gtsam.Rot3.Ypr(0.4, -0.1, 0.05), np.array([3.0, -2.0, -1.0]))
BIAS = 1e-3 * np.arange(-5.0, 6.0) + some_motion(1, 5e-3).bias


@pytest.mark.parametrize("bias_key", [None, B(0)], ids=["no bias", "bias"])
def test_the_pose_and_its_covariance_are_those_of_keyframe_bias_and_motion(
    bias_key,
):
    """``J P J'`` with J by differences, P joint of keyframe and bias: what both share counts."""
    moved = some_motion(1, 5e-3)
    P = random_covariance(17, 0.01, 3)
    joint = JointCovariance(P, {B(0): 6, X(3): 0})
    found = AnchoredPose(7, Tie(X(3), bias_key, moved)).carried_on(
        values_of(X3=KEYFRAME, B0=BIAS), joint
    )

    def carried(state: Floats) -> gtsam.Pose3:
        pose = KEYFRAME.compose(gtsam.Pose3.Expmap(state[:6]))
        if bias_key is None:
            return pose.compose(moved.i_T_j)
        return pose.compose(moved.i_T_j).compose(
            gtsam.Pose3.Expmap(moved.D_bias @ (BIAS - moved.bias + state[6:]))
        )

    mean = carried(np.zeros(17))
    assert found.world_T_body.equals(mean, 1e-9)
    J = central_differences(
        lambda state: gtsam.Pose3.Logmap(mean.between(carried(state))), np.zeros(17)
    )
    expected = J @ P @ J.T + moved.covariance
    np.testing.assert_allclose(
        found.covariance, expected, rtol=1e-2, atol=1e-2 * np.abs(expected).max()
    )
    np.testing.assert_array_equal(found.covariance, found.covariance.T)
    if bias_key is not None:
        apart = np.zeros((17, 17))
        apart[:6, :6] = apart[6:, 6:] = 1.0
        assert (
            np.abs(J @ (P * (1.0 - apart)) @ J.T).max() > 0.05 * np.abs(expected).max()
        )


@cache
def ran(lag_s: float, history: str = "whole", kernel: str = "none") -> Isam2:
    return run(
        simulate_mission(MissionOptions(duration_s=40.0, imu="mti1", landmarks=6)),
        smoother__lag_s=lag_s,
        history__policy=history,
        kernel__shape=kernel,
        smoother__waiting_gain=0.0,
        keyframes__bias_interval_s=15.0,
    )


def dense(estimator: Isam2, values: gtsam.Values, keys: list[int]) -> Floats:
    return dense_covariance(factors_of(estimator.graph), values, keys)


def test_over_the_history_it_is_the_inverse_of_the_whole_information():
    """A keyframe is known by its number and by its stamp, and each variable once."""
    estimator = ran(5.0)
    stamps_ns = estimator.keyframe_stamps()
    values = gtsams_solution(estimator.graph, estimator.values)
    found = estimator.joint_covariance(
        [4, 0], [int(stamps_ns[2]), int(stamps_ns[0])], [5, 2], over="history"
    )
    keys = [L(2), L(5), X(0), X(2), X(4)]
    assert off_sigmas(found.matrix, dense(estimator, values, keys)) < 1e-4
    of_one = estimator.marginal(stamp_ns=int(stamps_ns[2]), over="history")
    assert np.array_equal(of_one, estimator.marginal(keyframe=2, over="history"))
    assert np.allclose(found.at(X(2), X(2)), of_one, rtol=1e-9)
    of_one = estimator.joint_covariance(landmarks=np.array([5])).matrix
    assert np.array_equal(of_one, estimator.marginal(landmark=5))
    assert np.array_equal(found.at(L(5), X(2)), found.matrix[3:6, 12:18])


def test_of_a_bounded_history_it_is_the_inverse_of_the_windows_information():
    estimator = ran(5.0, "bounded")
    newest = len(estimator.keyframe_stamps()) - 1
    values = gtsams_solution(estimator.graph, estimator.values)
    found = estimator.joint_covariance([newest], (), [5, 2], over="history")
    expected = dense(estimator, values, [L(2), L(5), X(newest)])
    assert off_sigmas(found.matrix, expected) < 1e-4
    of_window = estimator.joint_covariance([newest], (), [5, 2]).matrix
    assert off_sigmas(of_window, found.matrix) < 0.05


REFUSED = [
    ({"keyframe": 999}, r"there is no keyframe 999; it has 0 to \d+"),
    ({"landmark": 77}, r"landmark 77 is not in the graph; it holds [\d, ]+$"),
    ({"stamp_ns": 5}, r"no keyframe at 5 ns; the nearest are at \d+ ns"),
    (
        {},
        r"marginal\(\) is of one variable; give one of keyframe, stamp_ns and landmark",
    ),
    (
        {"keyframe": 0, "over": "history"},
        "keyframe 0 has left the window, .*; none is known any more",
    ),
    ({"landmarks": ()}, "the covariance of nothing was asked for"),
    (
        {"landmarks": 4},
        r"landmarks: expected a list of integers, such as \[1, 2\], not 4",
    ),
    (
        {"landmarks": [4], "over": "whole"},
        'over is \'whole\'; expected "window" or "history"',
    ),
]
"""Of a marginal, or of a joint covariance where lists are asked for; over a history of one that is bounded."""


@pytest.mark.parametrize(("asked", "said"), REFUSED, ids=str)
def test_a_covariance_that_cannot_be_is_refused_with_what_is_known(asked, said):
    estimator = ran(5.0, "bounded" if asked.get("over") == "history" else "whole")
    is_joint = asked.keys() & {"landmarks", "keyframes", "stamps_ns"}
    with pytest.raises(EstimatorError, match=f"^isam2: {said}") as caught:
        (estimator.joint_covariance if is_joint else estimator.marginal)(**asked)
    assert "\n" not in str(caught.value)


def test_names_of_landmarks_without_names_are_refused_where_these_begin():
    sequence, _ = rail(8)
    ids = np.where(sequence.detections.candidate_ids == 4, FIRST_ANONYMOUS_ID, 7)
    named = replace(
        sequence, detections=replace(sequence.detections, candidate_ids=ids)
    )
    with pytest.raises(
        EstimatorError,
        match=rf"has identity {FIRST_ANONYMOUS_ID}; with identity.unknown.policy = ",
    ):
        run(named, 1 / STEP_S, identity__unknown__policy="associate")
    assert FIRST_ANONYMOUS_ID in run(named, 1 / STEP_S).landmarks().ids


@pytest.mark.parametrize("policy", ["robust", "gate", "max-mixture"])
@pytest.mark.parametrize("range_m", [1.1e5, 1e200])
def test_a_range_beyond_any_sonar_is_refused_and_changes_nothing(policy, range_m):
    sequence, _ = rail(8)
    seen = sequence.detections
    far = seen.range_m.copy()
    far[3] = range_m
    estimator = run(
        replace(sequence, detections=replace(seen, range_m=far)),
        1 / STEP_S,
        identity__policy=policy,
    )
    assert assert_outcomes_account(estimator, sequence)[Outcome.UNSOUND] == 1
    without = replace(sequence, detections=seen.rows(np.arange(len(seen)) != 3))
    known = run(without, 1 / STEP_S, identity__policy=policy)
    assert np.array_equal(estimator.landmarks().positions, known.landmarks().positions)
    assert np.array_equal(
        estimator.trajectory().positions, known.trajectory().positions
    )
