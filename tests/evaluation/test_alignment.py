from __future__ import annotations

import numpy as np
import pytest
from evo.core.geometry import umeyama_alignment
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation.metrics import align_se3, align_yaw, rmse, umeyama

seeds = st.integers(0, 2**32 - 1)


def cloud(seed: int, n: int = 30) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 3)) * [5.0, 3.0, 1.0]


@given(seeds, st.floats(-np.pi, np.pi))
def test_alignment_undoes_a_motion_that_it_allows(seed, angle):
    points, shift = cloud(seed), np.array([10.0, -3.0, 2.0])
    turns = Rotation.random(rng=seed).as_matrix(), Rotation.from_euler("z", angle).as_matrix()
    for align, turn in zip((align_se3, align_yaw), turns, strict=True):
        alignment = align(points, points @ turn.T + shift)
        np.testing.assert_allclose(alignment.rotation, turn, atol=1e-10)
        np.testing.assert_allclose(alignment.translation, shift, atol=1e-9)


@given(seeds, st.sampled_from([2, 3]))
def test_umeyama_agrees_with_evo(seed, dimension):
    points, targets = cloud(seed)[:, :dimension], cloud(seed + 1)[:, :dimension]
    R, t = umeyama(points, targets)
    expected_R, expected_t, _ = umeyama_alignment(points.T, targets.T)
    np.testing.assert_allclose(R, expected_R, atol=1e-9)
    np.testing.assert_allclose(t, expected_t, atol=1e-9)


def test_yaw_alignment_leaves_a_tilt_where_se3_removes_it():
    points = cloud(0)
    tilted = points @ Rotation.from_euler("x", 0.2).as_matrix().T
    assert rmse(align_se3(points, tilted).apply(points) - tilted) < 1e-10
    assert rmse(align_yaw(points, tilted).apply(points) - tilted) > 0.1


@given(seeds)
def test_more_freedom_never_fits_worse(seed):
    points, targets = cloud(seed), cloud(seed) + np.random.default_rng(seed + 1).normal(size=(30, 3))
    raw = rmse(points - targets)
    yaw = rmse(align_yaw(points, targets).apply(points) - targets)
    se3 = rmse(align_se3(points, targets).apply(points) - targets)
    assert se3 <= yaw + 1e-12
    assert yaw <= raw + 1e-12


@given(seeds, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_horizontal_part_of_yaw_alignment_is_the_best_se2(seed, turn, x, y):
    points, targets = cloud(seed), cloud(seed) + np.random.default_rng(seed + 1).normal(size=(30, 3))
    aligned = align_yaw(points, targets).apply(points)
    other = aligned @ Rotation.from_euler("z", turn).as_matrix().T + [x, y, 0.0]
    assert rmse((aligned - targets)[:, :2]) <= rmse((other - targets)[:, :2]) + 1e-12


def test_a_vehicle_that_did_not_move_is_aligned_by_translation():
    points = np.ones((5, 3))
    alignment = align_se3(points, points + 2.0)
    np.testing.assert_allclose(alignment.apply(points), points + 2.0)


@pytest.mark.parametrize("shapes", [((0, 3), (0, 3)), ((4, 3), (5, 3))])
def test_unpaired_points_are_refused(shapes):
    with pytest.raises(EvaluationError, match="paired points"):
        umeyama(np.zeros(shapes[0]), np.zeros(shapes[1]))
