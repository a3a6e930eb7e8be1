from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.logs.markers import UNKNOWN_DIAMETER_M, ellipsoids


@given(st.integers(0, 10_000))
def test_points_on_the_drawn_ellipsoid_have_the_same_mahalanobis_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(1, 3, 3)) + 2 * np.eye(3)
    covariances = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    diameters, quaternions = ellipsoids(covariances)
    sphere = rng.normal(size=(50, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    points = Rotation.from_quat(quaternions[0]).apply(sphere * diameters[0] / 2)
    squared = np.einsum("ni,ij,nj->n", points, np.linalg.inv(covariances[0]), points)
    np.testing.assert_allclose(squared, 7.814727903251179)  # chi-square table: 3 degrees of freedom, 0.95


def test_the_ellipsoid_holds_95_percent_of_samples() -> None:
    covariance = np.diag([1.0, 4.0, 0.25])
    diameters, quaternions = ellipsoids(covariance[None])
    samples = np.random.default_rng(0).multivariate_normal(np.zeros(3), covariance, 100_000)
    within = Rotation.from_quat(quaternions[0]).inv().apply(samples) / (diameters[0] / 2)
    assert abs(np.mean(np.sum(within**2, axis=1) < 1) - 0.95) < 0.003


def test_unknown_covariances_are_small_spheres_and_known_ones_beside_them_stay() -> None:
    diameters, _ = ellipsoids(np.array([np.full((3, 3), np.nan), np.eye(3)]))
    np.testing.assert_allclose(diameters[0], UNKNOWN_DIAMETER_M)
    np.testing.assert_allclose(diameters[1], 2 * np.sqrt(7.814727903251179))


def test_a_landmark_known_exactly_can_still_be_seen() -> None:
    assert (ellipsoids(np.zeros((1, 3, 3)))[0] > 0).all()
