"""A window that starts again, or stays with QR, goes on with what all factors say."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X

from sonar_graph.calibration import Calibration, Start
from sonar_graph.navigation.preintegration.motion import PreintegratedMotion
from sonar_graph.slam.models import factors
from sonar_graph.slam.smoother.batch_solution import solve
from sonar_graph.slam.smoother.incremental import FIRST_RESTART

from .fed import (
    FOREVER_S,
    NEVER_M,
    SONAR,
    Fed,
    counted_solves,
    dense_covariance,
    in_the_basin,
    joint,
    on_the_rail,
    plain,
    settled,
)
from .graphs import graph_of
from .made import smoother_with
from .rail import rail


@pytest.mark.parametrize("lag_s", [FOREVER_S, 6.0])
def test_a_restart_leaves_what_the_batch_gives(monkeypatch, lag_s):
    """Just after a restart newest pose, landmarks and bias, and their joint covariance, are those of all factors."""
    sizes = counted_solves(monkeypatch)
    size = next(n for n in range(5, 40) if len(in_the_basin(n, lag_s).given) >= FIRST_RESTART)
    assert not sizes
    fed = in_the_basin(size, lag_s, stale_shift_m=1e-9)
    assert sizes == [len(fed.given)]
    keys = [X(size - 1), L(3), L(5), L(8), B(0)]
    batch = solve(graph_of(fed.given), fed.smoother.values)
    for key in keys[1:]:
        assert np.allclose(fed.smoother.values.atPoint3(key), batch.atPoint3(key), atol=1e-4)
    assert fed.smoother.values.atPose3(keys[0]).equals(batch.atPose3(keys[0]), 1e-4)
    expected = dense_covariance(fed, batch, keys)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((joint(fed, keys) - expected) / scale).max() < 1e-3


def test_a_restart_freezes_nothing_that_is_within_the_lag(monkeypatch):
    """Of a window that keeps all, with biases come and gone, no linear factor is left and it settles on the batch."""
    sizes = counted_solves(monkeypatch)
    fed = settled(in_the_basin(40, FOREVER_S, stale_shift_m=1e-9, bias_steps=7), 39.0)
    assert len(sizes) >= 2
    batch = solve(graph_of(fed.given), fed.smoother.values)
    graph = graph_of(fed.given)
    assert graph.error(fed.smoother.values) == pytest.approx(graph.error(batch), rel=1e-4)
    expected = dense_covariance(fed, batch, [X(39), L(3), B(5)])
    assert np.allclose(np.diag(joint(fed, [X(39), L(3), B(5)])), np.diag(expected), rtol=1e-3)


def test_on_the_rail_restarts_change_nothing(monkeypatch):
    nodes = 61
    sizes = counted_solves(monkeypatch)
    fed, (_, numbers) = on_the_rail(nodes, 3.1, stale_shift_m=1e-9), rail(nodes)
    assert len(sizes) >= 3
    mean, variance = numbers.solution(nodes)
    assert fed.smoother.values.atPose3(X(nodes - 1)).translation()[0] == pytest.approx(mean[f"x{nodes - 1}"], abs=1e-7)
    assert joint(fed, [X(nodes - 1)])[3, 3] == pytest.approx(variance[f"x{nodes - 1}"], rel=1e-6)
    assert fed.smoother.covariance(L(7))[0, 0] == pytest.approx(variance["l7"], rel=1e-6)


def test_restarts_grow_apart_with_the_graph(monkeypatch):
    sizes = counted_solves(monkeypatch)
    in_the_basin(60, 6.0, stale_shift_m=1e-9)
    assert len(sizes) > 2
    assert all(later >= 1.2 * earlier for earlier, later in pairwise(sizes))


def test_drift_beyond_what_cholesky_takes_is_survived():
    """A pose uncertain by 20 m with millimetre steps: the plain solver gives up, the smoother agrees with algebra."""
    plain = gtsam.ISAM2()
    sigmas = np.array([20.0, 0.002])
    smoother = smoother_with(FOREVER_S, 1e-3, NEVER_M)
    wide, narrow = (gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-3] * 3 + [s] * 3)) for s in sigmas)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(3):
        factor = (
            gtsam.BetweenFactorPose3(X(k - 1), X(k), gtsam.Pose3(), narrow)
            if k
            else gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), wide)
        )
        graph.push_back(factor)
        values.insert(X(k), gtsam.Pose3())
        smoother.add_pose(X(k), gtsam.Pose3(), float(k))
        smoother.add([factor])
        smoother.update(float(k))
    with pytest.raises(RuntimeError, match="Indeterminate"):
        plain.update(graph, values)
    variance = sigmas[0] ** 2 + 2 * sigmas[1] ** 2
    assert smoother.covariance(X(2))[5, 5] == pytest.approx(variance, rel=1e-6)
    _, marginals = smoother.solve_history()
    assert marginals.marginalCovariance(X(2))[5, 5] == pytest.approx(variance, rel=1e-6)


@pytest.mark.parametrize(("shift_m", "is_due"), [(0.09, False), (0.11, True)])
def test_the_window_restarts_once_a_landmark_has_moved_by_the_stale_shift(monkeypatch, shift_m, is_due):
    sizes = counted_solves(monkeypatch)
    smoother = smoother_with(1e9, 1.0, 0.1)
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    smoother.add_pose(X(0), gtsam.Pose3(), 0.0)
    smoother.add([gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), tight)] * FIRST_RESTART)
    smoother.add_landmark(L(1), np.zeros(3))
    there = np.array([shift_m, 0.0, 0.0])
    smoother.add([gtsam.PriorFactorPoint3(L(1), there, gtsam.noiseModel.Isotropic.Sigma(3, 0.01))])
    smoother.update(0.0)
    assert bool(sizes) == is_due


def test_a_start_that_is_hardly_known_is_smoothed_to_the_end(monkeypatch):
    """100 m of doubt and millimetre odometry: Cholesky gives up, and the window stays with QR through its restarts."""
    sizes = counted_solves(monkeypatch)
    calibration_ = Calibration(start=Start(position_sigma_m=(100.0,) * 3))
    fed = Fed(30.0, stale_shift_m=1e-9)
    fed.smoother.add_pose(X(0), gtsam.Pose3(), 0.0)
    fed.add([factors.start_prior(X(0), calibration_)])
    cov, step = np.diag([1e-10] * 3 + [1e-6] * 3), gtsam.Pose3(gtsam.Rot3.Rz(0.02), np.array([0.1, 0.0, 0.0]))
    motion = PreintegratedMotion(step, cov, np.zeros((6, 3)), np.zeros(3), 1.0, np.zeros(3))
    truth, landmark = gtsam.Pose3(), np.array([3.0, 1.0, -1.0])
    fed.smoother.add_landmark(L(1), landmark + np.array([0.3, -0.2, 0.1]))
    for k in range(1, 100):
        truth = truth.compose(step)
        fed.smoother.add_pose(X(k), fed.smoother.values.atPose3(X(k - 1)).compose(step), float(k))
        q = truth.compose(SONAR).transformTo(landmark)
        z = np.array([np.linalg.norm(q), np.arctan2(q[1], q[0])])
        fed.add([factors.odometry(X(k - 1), X(k), motion)])
        fed.add(factors.landmark_sighting(X(k), L(1), SONAR, z, np.diag([4e-4, 8e-5]), plain, 0.3 if k == 1 else None))
        fed.smoother.update(float(k))
    assert len(sizes) > 2
    assert np.linalg.norm(fed.smoother.values.atPose3(X(99)).translation() - truth.translation()) < 0.05
