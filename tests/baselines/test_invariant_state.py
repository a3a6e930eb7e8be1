import gtsam
import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from baselines.invariant_equations import InvariantState, correct, landmark_covariance, pose_after, predict, retract

from .invariant import (
    D_BIAS,
    STEP,
    body_after,
    copied,
    derivative,
    error,
    gap_motion_of,
    gauge,
    moved_by,
    rotation_vectors,
    state_at,
    twists,
)

NO_NOISE = np.zeros((6, 6))
ATTITUDE, TWIST = np.array([0.3, -0.5, 2.0]), np.array([0.05, -0.1, 0.3, 0.4, -0.1, 0.05])


def after(state, twist, xi_motion, reference_bias):
    """The true state after a motion, when the bias differs from the one that was removed."""
    R, X = body_after(state, twist, xi_motion + D_BIAS @ (state.bias - reference_bias))
    return InvariantState(R, np.vstack([X, state.points[1:]]), state.bias, state.P)


@given(rotation_vectors, rotation_vectors)
def test_an_error_moves_the_estimate_by_the_group_s_exponential(attitude, turn):
    state = state_at(attitude)
    xi = np.concatenate([turn, np.linspace(-0.2, 0.4, 12)])
    expected = moved_by(state, xi)
    retract(state, xi)
    assert_allclose(state.R, expected.R, atol=1e-12)
    assert_allclose(state.points, expected.points, atol=1e-11)
    assert_allclose(state.bias, expected.bias, atol=1e-15)


@given(rotation_vectors, twists)
def test_prediction_transports_the_covariance_by_the_numerical_jacobian(attitude, twist):
    state = state_at(attitude)
    expected = after(state, twist, np.zeros(6), state.bias)
    F = derivative(lambda xi: error(after(moved_by(state, xi), twist, np.zeros(6), state.bias), expected), len(state.P))
    predicted = copied(state)
    predict(predicted, gap_motion_of(twist, NO_NOISE, D_BIAS), 0.0)
    assert_allclose(predicted.R, expected.R, atol=1e-12)
    assert_allclose(predicted.points, expected.points, atol=1e-12)
    assert_array_equal(predicted.bias, state.bias)
    assert_allclose(predicted.P, F @ state.P @ F.T, atol=1e-7)
    assert_array_equal(predicted.P, predicted.P.T)


@given(rotation_vectors, twists)
def test_motion_noise_enters_by_the_numerical_jacobian(attitude, twist):
    """The covariance is given at the motion's end; [theta_i, eps] are in the frame where it begins."""
    state = state_at(attitude, scale=0.0)
    A = 0.01 * np.random.default_rng(2).normal(size=(6, 6))
    expected = after(state, twist, np.zeros(6), state.bias)
    J = derivative(lambda v: error(after(state, twist, v, state.bias), expected), 6)
    turn = np.kron(np.eye(2), gtsam.Rot3.Expmap(twist[:3]).matrix())
    predict(state, gap_motion_of(twist, A @ A.T, np.zeros((6, 3))), 0.0)
    assert_allclose(state.P, J @ turn @ A @ A.T @ turn.T @ J.T, atol=1e-9)


def test_the_bias_walks():
    state = state_at(ATTITUDE)
    still = copied(state)
    motion = gap_motion_of(TWIST, NO_NOISE, D_BIAS)
    predict(still, motion, 0.0)
    predict(state, motion, 0.04)
    walked = np.zeros_like(state.P)
    walked[3:6, 3:6] = 0.04 * np.eye(3)
    assert_allclose(state.P - still.P, walked, atol=1e-12)


@given(rotation_vectors, twists)
def test_what_a_motion_does_to_moves_of_the_whole_world_depends_on_no_estimate(attitude, twist):
    """F leaves them as they are, wherever it is taken: with P = N N^T before there is P = N N^T after."""
    N = gauge(3, "xyz-yaw")
    state = state_at(attitude)
    state.P[:] = N @ N.T
    predict(state, gap_motion_of(twist, NO_NOISE, D_BIAS), 0.0)
    assert_allclose(state.P, N @ N.T, atol=1e-12)


def joseph(P, H, R, innovation):
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    I_KH = np.eye(len(P)) - K @ H
    return K @ innovation, I_KH @ P @ I_KH.T + K @ R @ K.T


@pytest.mark.parametrize("m", [1, 2])
@pytest.mark.parametrize("seed", range(3))
def test_a_correction_is_joseph_s_and_exactly_symmetric(seed, m):
    rng = np.random.default_rng(seed)
    state = state_at(ATTITUDE, seed=seed)
    H, R, e = rng.normal(size=(m, len(state.P))), np.diag([0.01, 0.02][:m]), 0.01 * rng.normal(size=m)
    xi, P = joseph(state.P, H, R, e)
    expected = moved_by(state, xi)
    correct(state, H @ state.P, H @ state.P @ H.T + R, e)
    assert_allclose(state.P, P, atol=1e-12)
    assert_array_equal(state.P, state.P.T)
    assert_allclose(state.R, expected.R, atol=1e-12)
    assert_allclose(state.points, expected.points, atol=1e-12)
    assert_allclose(state.bias, expected.bias, atol=1e-12)


@given(rotation_vectors, twists)
def test_the_pose_after_a_motion_has_the_numerical_covariance(attitude, twist):
    """In the body's own perturbation, that of the contract: of the state by differences, of the motion as given."""
    state = state_at(attitude)
    A = 0.01 * np.random.default_rng(2).normal(size=(6, 6))

    def body(xi):
        moved = moved_by(state, xi)
        R, X = body_after(moved, twist, D_BIAS @ (moved.bias - state.bias))
        return gtsam.Pose3(gtsam.Rot3(R), X)

    estimate = body(np.zeros(len(state.P)))
    T = derivative(lambda xi: np.asarray(estimate.localCoordinates(body(xi))), len(state.P))
    R, X, cov = pose_after(state, gap_motion_of(twist, A @ A.T, D_BIAS))
    assert_allclose(R, estimate.rotation().matrix(), atol=1e-12)
    assert_allclose(X, estimate.translation(), atol=1e-12)
    assert_allclose(cov, T @ state.P @ T.T + A @ A.T, atol=1e-7)


@given(rotation_vectors)
def test_a_landmark_has_the_numerical_covariance_of_its_coordinates(attitude):
    state = state_at(attitude)
    for k in (1, 2):
        G = derivative(lambda xi, k=k: moved_by(state, xi).points[k], len(state.P), STEP)
        assert_allclose(landmark_covariance(state, k), G @ state.P @ G.T, atol=1e-8)
