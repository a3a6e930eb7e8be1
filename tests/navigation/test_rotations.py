"""Rotations and constant twists against the matrix exponential."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from sonar_graph.numerics.rotations import SMALL_ANGLE_RAD, cross_matrix, left_jacobian, rotation_exp

ANGLES_RAD = [0.0, 1e-9, 0.99 * SMALL_ANGLE_RAD, 1.01 * SMALL_ANGLE_RAD, 0.01, 1.0, np.pi - 1e-6, np.pi, 5.0]


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_rotation_is_the_matrix_exponential_and_the_left_jacobian_its_mean(angle_rad):
    """Gauss-Legendre quadrature of Exp(s phi) over s in [0, 1]; its matrix is that of the cross product."""
    phi = angle_rad * np.array([0.48, -0.6, 0.64])
    nodes, weights = np.polynomial.legendre.leggauss(20)
    mean = sum(w / 2 * expm((1 + s) / 2 * cross_matrix(phi)) for s, w in zip(nodes, weights, strict=True))
    assert np.allclose(cross_matrix(phi) @ [0.5, 4.0, -1.0], np.cross(phi, [0.5, 4.0, -1.0]))
    assert np.allclose(rotation_exp(phi), expm(cross_matrix(phi)), rtol=0, atol=1e-14)
    assert np.allclose(left_jacobian(phi), mean, rtol=0, atol=2e-12)


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_constant_twist_moves_as_the_exponential_of_se3(phi, rho):
    motion = gtsam.Pose3.Expmap(np.array(phi + rho))
    assert np.allclose(rotation_exp(np.array(phi)), motion.rotation().matrix(), atol=1e-9)
    assert np.allclose(left_jacobian(np.array(phi)) @ np.array(rho), motion.translation(), atol=1e-9)
