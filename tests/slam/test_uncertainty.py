"""Covariances that are asked for, against the inverse of the information of all factors, by numpy."""

from functools import cache

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X

from sonar_graph.errors import EstimatorError
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.slam import Isam2

from .graphs import information
from .made import isam2_params


@cache
def ran(lag_s: float, history: str = "whole", kernel: str = "none") -> Isam2:
    sequence = simulate_mission(MissionOptions(duration_s=40.0, imu="mti1", landmarks=6))
    params = isam2_params(
        smoother__lag_s=lag_s,
        history__policy=history,
        kernel__shape=kernel,
        smoother__waiting_gain=0.0,
        keyframes__bias_interval_s=15.0,
    )
    estimator = Isam2(sequence.calibration, params)
    for step in sequence.replay(sequence.instants(2.0)):
        estimator.process(step)
    return estimator


def dense(estimator: Isam2, values: gtsam.Values, keys: list[int]) -> np.ndarray:
    """Block of the inverse of the sum of all factors' information."""
    graph = estimator.graph
    every = sorted(graph.keyVector())
    sizes = [len(values.zeroVectors().at(key)) for key in every]
    starts = dict(zip(every, np.cumsum([0, *sizes]).tolist(), strict=False))
    wanted = np.concatenate([np.arange(starts[k], starts[k] + sizes[every.index(k)]) for k in keys])
    total = information([graph.at(i) for i in range(graph.size())], values, every)
    return np.linalg.inv(total)[np.ix_(wanted, wanted)]


def off(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest deviation, in standard deviations of both components."""
    sigmas = np.sqrt(np.diag(expected))
    return float(np.abs((found - expected) / np.outer(sigmas, sigmas)).max())


KEYFRAMES, LANDMARKS = [4, 0, 2], [5, 2]


def keys() -> list[int]:
    return [L(2), L(5), X(0), X(2), X(4)]


def test_over_the_history_it_is_the_inverse_of_the_whole_information():
    estimator = ran(5.0)
    values, _ = estimator._smoother.solve_history()
    found = estimator.joint_covariance(KEYFRAMES, (), LANDMARKS, over="history")
    assert off(found.matrix, dense(estimator, values, keys())) < 1e-6
    for key in keys():
        assert off(found.at(key, key), dense(estimator, values, [key])) < 1e-6
    assert np.array_equal(found.at(L(5), X(2)), found.matrix[3:6, 12:18])


def test_over_the_window_it_is_the_same_where_variables_are_linearised_if_nothing_was_marginalised():
    estimator = ran(1e9)
    found = estimator.joint_covariance(KEYFRAMES, (), LANDMARKS)
    linearised = estimator._smoother._window.isam.getLinearizationPoint()
    assert off(found.matrix, dense(estimator, linearised, keys())) < 1e-6
    assert 1e-4 < off(found.matrix, dense(estimator, estimator.values, keys())) < 0.02


def test_over_a_short_window_it_is_nearly_that_of_the_history():
    estimator = ran(5.0)
    newest = len(estimator.keyframe_stamps()) - 1
    short, whole = (
        estimator.joint_covariance([newest], (), LANDMARKS, over=over).matrix for over in ("window", "history")
    )
    assert 1e-9 < off(short, whole) < 0.05


def test_of_a_bounded_history_it_is_the_inverse_of_the_windows_information():
    estimator = ran(5.0, "bounded")
    newest = len(estimator.keyframe_stamps()) - 1
    values, _ = estimator._smoother.solve_history()
    found = estimator.joint_covariance([newest], (), [5, 2], over="history")
    assert off(found.matrix, dense(estimator, values, [L(2), L(5), X(newest)])) < 1e-6
    assert off(estimator.joint_covariance([newest], (), [5, 2]).matrix, found.matrix) < 0.05


def test_a_keyframe_is_known_by_its_stamp_as_by_its_number():
    estimator = ran(5.0)
    stamps = estimator.keyframe_stamps()
    by_number = estimator.marginal(keyframe=3, over="history")
    assert np.array_equal(estimator.marginal(stamp_ns=int(stamps[3]), over="history"), by_number)
    assert not np.allclose(estimator.marginal(stamp_ns=int(stamps[2]), over="history"), by_number)
    assert by_number.shape == (6, 6)
    joint = estimator.joint_covariance([3], [int(stamps[3])], [2], over="history")
    assert joint.matrix.shape == (9, 9)
    assert np.allclose(joint.at(X(3), X(3)), by_number, rtol=1e-9)


def test_a_landmarks_marginal_is_that_of_the_map():
    estimator = ran(5.0)
    found = estimator.landmarks()
    for i, cov in zip(found.ids.tolist(), found.covariances, strict=True):
        assert np.allclose(estimator.marginal(landmark=i, over="history"), cov, rtol=1e-9)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda e: e.marginal(keyframe=999), r"there is no keyframe 999; it has 0 to \d+"),
        (lambda e: e.marginal(keyframe=-1), r"there is no keyframe -1; it has 0 to \d+"),
        (lambda e: e.marginal(landmark=77), r"landmark 77 is not in the graph; it holds [\d, ]+$"),
        (lambda e: e.marginal(landmark=-1), r"landmark -1 is not in the graph"),
        (lambda e: e.marginal(stamp_ns=5), r"no keyframe at 5 ns; the nearest are at \d+ ns"),
        (
            lambda e: e.marginal(stamp_ns=int(e.keyframe_stamps()[1]) + 1),
            r"no keyframe at \d+ ns; the nearest are at \d+ and \d+ ns",
        ),
        (
            lambda e: e.marginal(keyframe=0),
            r'keyframe 0 has left the window, which holds \d+ to \d+; ask over="history"',
        ),
        (lambda e: e.marginal(), "give one of keyframe, stamp_ns and landmark"),
        (lambda e: e.marginal(keyframe=1, landmark=2), "give one of keyframe, stamp_ns and landmark"),
        (lambda e: e.joint_covariance(), "the covariance of nothing was asked for"),
    ],
)
def test_what_is_not_known_is_told_with_what_is(ask, message):
    with pytest.raises(EstimatorError, match=message):
        ask(ran(5.0))


def test_what_a_bounded_history_has_given_up_is_told():
    with pytest.raises(EstimatorError, match=r"keyframe 0 has left the window, .*; none is known any more"):
        ran(5.0, "bounded").marginal(keyframe=0, over="history")


def test_before_there_is_anything_it_says_so():
    with pytest.raises(EstimatorError, match="there is no keyframe 0; none was set yet"):
        Isam2(simulate_mission(MissionOptions(duration_s=6.0)).calibration).marginal(keyframe=0)


def test_asking_leaves_the_estimate_as_it_was():
    estimator = ran(5.0)
    before = estimator.values.atPose3(X(len(estimator.keyframe_stamps()) - 1)).matrix()
    for over in ("window", "history"):
        estimator.joint_covariance([len(estimator.keyframe_stamps()) - 1], (), LANDMARKS, over=over)
    assert np.array_equal(estimator.values.atPose3(X(len(estimator.keyframe_stamps()) - 1)).matrix(), before)
    assert estimator.values.exists(B(0))
