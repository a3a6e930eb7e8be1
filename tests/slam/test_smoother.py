"""The window and the history are least squares of all factors; updates come when there is something to tell."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X

from sonar_graph.navigation.preintegration.motion import PreintegratedMotion
from sonar_graph.slam.models import factors
from sonar_graph.slam.smoother.batch_solution import solve

from .fed import FOREVER_S, NEVER_M, dense_covariance, in_the_basin, joint, on_the_rail, settled
from .graphs import graph_of
from .made import smoother_with
from .rail import rail


@pytest.mark.parametrize("lag_s", [FOREVER_S, 2.6, 0.6], ids=["all", "five poses", "one pose"])
def test_on_the_rail_the_window_is_least_squares(lag_s):
    """Marginalising is exact where nothing is linearised: mean and covariance of pose and landmarks to 1e-8."""
    nodes = 21
    fed, (_, numbers) = on_the_rail(nodes, lag_s), rail(nodes)
    mean, variance = numbers.solution(nodes)
    newest = fed.smoother.values.atPose3(X(nodes - 1)).translation()[0]
    assert newest == pytest.approx(mean[f"x{nodes - 1}"], abs=1e-8)
    assert joint(fed, [X(nodes - 1)])[3, 3] == pytest.approx(variance[f"x{nodes - 1}"], abs=1e-8)
    for i in (4, 7):
        assert fed.smoother.values.atPoint3(L(i))[0] == pytest.approx(mean[f"l{i}"], abs=1e-8)
        assert fed.smoother.covariance(L(i))[0, 0] == pytest.approx(variance[f"l{i}"], abs=1e-8)


def test_on_the_rail_the_history_is_least_squares_for_every_pose():
    nodes = 21
    fed, (_, numbers) = on_the_rail(nodes, 2.6), rail(nodes)
    mean, variance = numbers.solution(nodes)
    values, marginals = fed.smoother.solve_history()
    for k in range(nodes):
        assert values.atPose3(X(k)).translation()[0] == pytest.approx(mean[f"x{k}"], abs=1e-8)
        assert marginals.marginalCovariance(X(k))[3, 3] == pytest.approx(variance[f"x{k}"], abs=1e-8)


def test_every_factor_is_counted_once_in_the_window():
    """With nothing marginalised the window's covariance is the inverse of the sum of all information given."""
    fed = settled(in_the_basin(15, FOREVER_S), 14.0)
    keys = [X(14), L(3), L(8), B(0)]
    assert fed.smoother.graph.size() == len(fed.given)
    expected = dense_covariance(fed, fed.smoother.values, keys)
    assert np.allclose(joint(fed, keys), expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())


def test_every_factor_is_counted_once_in_the_history():
    fed = in_the_basin(15, 4.0)
    values, marginals = fed.smoother.solve_history()
    for key in (X(2), X(14), L(5), B(0)):
        expected = dense_covariance(fed, values, [key])
        assert np.allclose(marginals.marginalCovariance(key), expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    assert fed.smoother.graph.error(values) == pytest.approx(graph_of(fed.given).error(values))


def test_the_history_is_solved_anew_when_it_has_grown():
    fed = in_the_basin(8, FOREVER_S)
    before, _ = fed.smoother.solve_history()
    fed.add([gtsam.PriorFactorPoint3(L(3), np.array([3.5, 1.0, -1.0]), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3))])
    fed.smoother.update(7.0)
    after, _ = fed.smoother.solve_history()
    assert after.atPoint3(L(3)) == pytest.approx([3.5, 1.0, -1.0], abs=0.02)
    assert not np.allclose(before.atPoint3(L(3)), after.atPoint3(L(3)), atol=0.1)


def test_the_window_stays_near_the_batch_solution_when_poses_leave_it():
    """A fraction of a standard deviation, over eighty poses of which ten are kept."""
    fed = in_the_basin(80, 10.0)
    batch = solve(graph_of(fed.given), fed.smoother.values)
    cov = dense_covariance(fed, batch, [X(79)])
    off = gtsam.Pose3.Logmap(batch.atPose3(X(79)).between(fed.smoother.values.atPose3(X(79))))
    assert off @ np.linalg.solve(cov, off) < 0.3
    assert np.allclose(np.diag(joint(fed, [X(79)])), np.diag(cov), rtol=0.1)


def test_an_update_without_news_changes_nothing():
    fed = settled(in_the_basin(20, 6.0), 19.0)
    keys = [X(19), L(3), B(0)]
    before, cov = gtsam.Values(fed.smoother.values), joint(fed, keys)
    assert not fed.smoother.is_due
    fed.smoother.update(19.0)
    fed.smoother.update(19.0)
    assert fed.smoother.values.equals(before, 1e-6)
    assert np.allclose(joint(fed, keys), cov, rtol=1e-4)


def test_factors_wait_until_they_are_worth_an_update():
    fed = in_the_basin(5, 6.0)
    before = fed.smoother.values.atPoint3(L(3))
    fed.add([gtsam.PriorFactorPoint3(L(3), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.01))])
    assert not fed.smoother.is_due
    fed.smoother.waiting_gain += 0.1
    assert fed.smoother.is_due
    assert np.array_equal(fed.smoother.values.atPoint3(L(3)), before)
    fed.smoother.update(4.0)
    assert not fed.smoother.is_due
    assert np.linalg.norm(fed.smoother.values.atPoint3(L(3)) - before) > 0.5


def test_a_new_variable_does_not_wait():
    smoother = smoother_with(6.0, 1e-6, NEVER_M, waiting_gain=1e9)
    smoother.waiting_gain = 1e8
    assert not smoother.is_due
    smoother.add_landmark(L(1), np.zeros(3))
    assert smoother.is_due


@pytest.mark.parametrize("lag_s", [FOREVER_S, 3.0])
def test_biases_in_a_row_are_least_squares(lag_s):
    """Old ones leave the window; the newest is that of all: scalars by hand, prior, walk, and a reading of each."""
    smoother, sigma, walk, reading = smoother_with(lag_s, 1e-6, NEVER_M), 1.0, 0.5, 0.3
    A, b = [np.eye(8)[0] / sigma], [0.0]
    for k in range(8):
        smoother.add_pose(X(k), gtsam.Pose3(), float(k))
        smoother.add([gtsam.PriorFactorPose3(X(k), gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6))])
        smoother.add_bias(B(k), np.zeros(3))
        smoother.add([factors.bias_walk(B(k - 1), B(k), walk) if k else factors.bias_prior(B(0), sigma)])
        noise = gtsam.noiseModel.Isotropic.Sigma(3, reading)
        smoother.add([gtsam.PriorFactorPoint3(B(k), np.full(3, np.sin(k)), noise)])
        smoother.update(float(k))
        if k:
            A.append((np.eye(8)[k] - np.eye(8)[k - 1]) / walk)
            b.append(0.0)
        A.append(np.eye(8)[k] / reading)
        b.append(np.sin(k) / reading)
    cov = np.linalg.inv(np.transpose(A) @ A)
    assert smoother.values.atPoint3(B(7)) == pytest.approx([(cov @ np.transpose(A) @ b)[7]] * 3, abs=1e-9)
    assert np.diag(smoother.covariance(B(7))) == pytest.approx([cov[7, 7]] * 3, abs=1e-9)


def test_an_older_bias_leaves_the_window_once_the_lag_is_over():
    """The next one takes its place; the old stays in what the history gives."""
    fed = in_the_basin(5, 3.0)
    fed.smoother.add_bias(B(1), np.zeros(3))
    fed.add([factors.bias_walk(B(0), B(1), 1e-3)])
    D_bias = np.vstack([-np.eye(3), np.zeros((3, 3))])
    motion = PreintegratedMotion(gtsam.Pose3(), 1e-4 * np.eye(6), D_bias, np.zeros(3), 1.0, np.zeros(3))
    for k in range(5, 12):
        fed.smoother.add_pose(X(k), fed.smoother.values.atPose3(X(k - 1)), float(k))
        fed.add([factors.odometry_with_bias(X(k - 1), X(k), B(1), motion)])
        fed.smoother.update(float(k))
    assert fed.smoother.covariance(B(1)).shape == (3, 3)
    with pytest.raises(IndexError, match="not in the BayesTree"):
        fed.smoother.covariance(B(0))
    values, marginals = fed.smoother.solve_history()
    assert np.allclose(marginals.marginalCovariance(B(0)), dense_covariance(fed, values, [B(0)]), rtol=1e-6)
