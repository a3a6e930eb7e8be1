import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from sonar_graph.numerics.mat3 import (
    euler_from_rates,
    euler_from_rotation,
    matrix,
    product,
    rates_from_euler,
    rotation_from_euler,
)

attitudes = st.tuples(st.floats(-3.1, 3.1), st.floats(-1.4, 1.4), st.floats(-3.1, 3.1))
STEP = 1e-6


@given(attitudes)
def test_rotation_is_gtsam_s_yaw_pitch_roll(angles):
    assert_allclose(rotation_from_euler(angles), gtsam.Rot3.RzRyRx(np.array(angles)).matrix(), atol=1e-14)


@given(attitudes)
def test_angles_come_back_from_their_rotation(angles):
    assert_allclose(euler_from_rotation(rotation_from_euler(angles)), angles, atol=1e-9)


@given(attitudes)
def test_a_small_turn_of_the_body_changes_the_angles_by_the_rate_matrix(angles):
    R, E = gtsam.Rot3.RzRyRx(np.array(angles)), np.array(euler_from_rates(angles))
    for axis, unit in enumerate(np.eye(3)):
        ahead, behind = (
            np.array(euler_from_rotation(matrix(R.compose(gtsam.Rot3.Expmap(s * unit)).matrix())))
            for s in (STEP, -STEP)
        )
        change = (ahead - behind + np.pi) % (2 * np.pi) - np.pi
        assert_allclose(E[:, axis], change / (2 * STEP), atol=1e-5, rtol=1e-5)


@given(attitudes)
def test_the_two_rate_matrices_are_inverse(angles):
    assert_allclose(product(euler_from_rates(angles), rates_from_euler(angles)), np.eye(3), atol=1e-12)
