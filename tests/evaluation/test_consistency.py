from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from sonar_graph.evaluation import consistency
from sonar_graph.states import DetectionLog, Estimate, Outcome, Trajectory

angles = st.floats(-3.0, 3.0)
tilts = st.floats(-1.2, 1.2)


def random_covariance(seed: int, size: int = 6, scale: float = 1e-3) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(size, size)) * scale
    return root @ root.T


def single(pose: gtsam.Pose3, covariance: np.ndarray) -> Trajectory:
    return Trajectory.from_estimates([Estimate(0, pose, covariance)])


def numerical_covariance(pose: gtsam.Pose3, covariance: np.ndarray) -> np.ndarray:
    """Of world position and yaw, by differences through gtsam's own exponential."""
    step = 1e-6
    columns = []
    for axis in np.eye(6):
        plus, minus = pose.retract(step * axis), pose.retract(-step * axis)
        yaw = plus.rotation().yaw() - minus.rotation().yaw()
        columns.append(np.append(plus.translation() - minus.translation(), yaw) / (2 * step))
    J = np.array(columns).T
    return J @ covariance @ J.T


@settings(max_examples=50)
@given(st.integers(0, 10_000), tilts, tilts, angles)
def test_world_covariances_equal_numerical_propagation(seed, roll, pitch, yaw):
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array([1.0, 2.0, 3.0]))
    trajectory = single(pose, random_covariance(seed))
    expected = numerical_covariance(pose, random_covariance(seed))
    scale = np.abs(expected).max()
    np.testing.assert_allclose(consistency.world_position_covs(trajectory)[0], expected[:3, :3], atol=1e-6 * scale)
    assert consistency.yaw_variances(trajectory)[0] == pytest.approx(expected[3, 3], abs=1e-6 * scale)


def test_yaw_variance_is_not_merely_the_one_about_the_bodys_z():
    tilted = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.6, 0.5, 0.0), np.zeros(3))
    covariance = np.diag([0.0, 4e-4, 1e-4, 1.0, 1.0, 1.0])
    assert abs(consistency.yaw_variances(single(tilted, covariance))[0] / 1e-4 - 1) > 0.5


@pytest.mark.parametrize("dof", [2, 3])
def test_nees_of_samples_from_the_reported_covariance_is_chi_square(dof):
    rng = np.random.default_rng(7)
    n = 4000
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 1.0), np.array([3.0, -2.0, 1.0]))
    covariance = random_covariance(1)
    errors = rng.multivariate_normal(np.zeros(6), covariance, size=n)
    estimate = Trajectory.from_estimates([Estimate(i, pose, covariance) for i in range(n)])
    truth = Trajectory.from_estimates([Estimate(i, pose.retract(e), covariance) for i, e in enumerate(errors)])
    series = consistency.error_series(estimate, truth, dof)
    low, high = consistency.anees_interval(n, dof, 0.999)
    assert low < consistency.mean_normalised(series.nees_position, dof) < high
    low, high = consistency.anees_interval(n, 1, 0.999)
    assert low < consistency.mean_normalised(series.nees_yaw, 1) < high
    below_median = np.mean(series.nees_position < chi2.ppf(0.5, dof))
    assert below_median == pytest.approx(0.5, abs=0.03)


def test_half_the_covariance_doubles_nees_and_leaves_the_band():
    errors, covs = np.random.default_rng(0).normal(size=(500, 3)), np.tile(np.eye(3), (500, 1, 1))
    honest = consistency.normalised_squares(errors, covs)
    boastful = consistency.normalised_squares(errors, covs / 2)
    np.testing.assert_allclose(boastful, 2 * honest)
    low, high = consistency.anees_interval(500, 3)
    assert low < consistency.mean_normalised(honest, 3) < high < consistency.mean_normalised(boastful, 3)


def test_planar_nees_ignores_height():
    pose, above = gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 5.0]))
    covariance = np.diag([1e-2] * 3 + [1e-2] * 3)
    planar = consistency.error_series(single(above, covariance), single(pose, covariance), 2)
    spatial = consistency.error_series(single(above, covariance), single(pose, covariance), 3)
    assert planar.nees_position[0] == pytest.approx(1.0)
    assert spatial.nees_position[0] == pytest.approx(1.0 + 2500.0)


def test_unknown_or_singular_covariances_have_no_nees():
    covs = np.array([np.full((2, 2), np.nan), np.zeros((2, 2)), np.eye(2)])
    squares = consistency.normalised_squares(np.ones((3, 2)), covs)
    np.testing.assert_array_equal(np.isnan(squares), [True, True, False])
    assert squares[2] == pytest.approx(2.0)
    assert np.isnan(consistency.mean_normalised(squares[:2], 2))


def test_anees_interval_of_fifty_runs_is_the_textbooks():
    # Bar-Shalom et al. 2001, example 5.4.2: 50 runs of 2 degrees of freedom, chi-square(100) in [74.2, 129.6].
    low, high = consistency.anees_interval(50, 2)
    assert (100 * low, 100 * high) == pytest.approx((74.2, 129.6), abs=0.05)


@given(st.integers(1, 500), st.integers(1, 6))
def test_anees_interval_contains_one_and_narrows_with_runs(runs, dof):
    low, high = consistency.anees_interval(runs, dof)
    narrower_low, narrower_high = consistency.anees_interval(4 * runs, dof)
    assert low < narrower_low < 1 < narrower_high < high


def test_average_over_runs_stays_inside_the_band_as_often_as_it_says():
    nees = np.random.default_rng(3).chisquare(3, size=(50, 2000))
    average = consistency.anees_over_runs(nees, 3)
    low, high = consistency.anees_interval(50, 3)
    assert np.mean((average > low) & (average < high)) == pytest.approx(0.95, abs=0.02)


def test_nis_takes_used_detections_only():
    outcomes = [Outcome.NEW, Outcome.USED, Outcome.GATED]
    covs = np.array([np.full((2, 2), np.nan), np.diag([4.0, 1.0]), np.eye(2)])
    log = DetectionLog(np.arange(3), np.ones(3, int), np.array([[np.nan] * 2, [2.0, 3.0], [9.0, 9.0]]), covs, outcomes)
    np.testing.assert_allclose(consistency.nis(log), [1.0 + 9.0])


def test_nis_of_an_empty_log_is_empty():
    log = DetectionLog(np.empty(0, int), np.empty(0, int), np.empty((0, 2)), np.empty((0, 2, 2)), [])
    assert consistency.nis(log).shape == (0,)
