import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from baselines.ekf_equations import correct, correct_pair, pose_after, predict
from sonar_graph.numerics.mat3 import euler_from_rates, euler_from_rotation, matrix, rotation_from_euler, vector

from .motions import motion_of

N = 12
STEP = 1e-6
ROTATION, DISPLACEMENT = np.array([0.05, -0.1, 0.3]), np.array([0.4, -0.1, 0.05])
attitudes = st.builds(
    lambda *angles: np.array(angles), st.floats(-3.1, 3.1), st.floats(-1.3, 1.3), st.floats(-3.1, 3.1)
)
motions = st.builds(lambda *v: np.array(v), *[st.floats(-0.5, 0.5)] * 6)


def state(angles, n=N):
    x = np.zeros(n + 3)
    x[:n] = np.linspace(-3, 3, n)
    x[3:6] = angles
    return x


def random_covariance(n=N, seed=0, scale=0.1):
    A = scale * np.random.default_rng(seed).normal(size=(n, n))
    P = np.zeros((n + 3, n + 3))
    P[:n, :n] = A @ A.T
    return P


def moved(x, motion, xi=None):
    """The mean after a motion, by gtsam; the motion perturbed at its end."""
    world_T_i = gtsam.Pose3(gtsam.Rot3.RzRyRx(x[3:6]), x[:3])
    i_T_j = gtsam.Pose3(gtsam.Rot3.Expmap(motion[:3]), motion[3:])
    after = world_T_i.compose(i_T_j)
    if xi is not None:
        after = after.compose(gtsam.Pose3(gtsam.Rot3.Expmap(xi[:3]), xi[3:]))
    return np.concatenate([after.translation(), euler_from_rotation(matrix(after.rotation().matrix())), x[6:]])


def unwrapped(difference):
    difference = difference.copy()
    difference[3:6] = (difference[3:6] + np.pi) % (2 * np.pi) - np.pi
    return difference


def numerical(function, size):
    units = np.eye(size)
    return np.array([unwrapped(function(STEP * u) - function(-STEP * u)) / (2 * STEP) for u in units]).T


def predicted(x, P, motion, cov, n=N):
    x, P = x.copy(), P.copy()
    predict(x, P, n, motion_of(motion, cov))
    return x, P


def far_from_singular(angles, motion):
    after = np.array(rotation_from_euler(vector(angles))) @ gtsam.Rot3.Expmap(motion[:3]).matrix()
    return abs(euler_from_rotation(matrix(after))[1]) < 1.4


@given(attitudes, motions)
def test_prediction_transports_the_covariance_by_the_numerical_jacobian(angles, motion):
    if not far_from_singular(angles, motion):
        return
    x, P = state(angles), random_covariance()
    F = numerical(lambda d: moved(x[:N] + d, motion), N)
    x_after, P_after = predicted(x, P, motion, np.zeros((6, 6)))
    assert_allclose(unwrapped(x_after[:N] - moved(x[:N], motion)), 0.0, atol=1e-12)
    assert_allclose(P_after[:N, :N], F @ P[:N, :N] @ F.T, atol=1e-5, rtol=1e-5)


def test_motion_noise_is_that_of_many_perturbed_motions():
    rng = np.random.default_rng(1)
    motion, angles = np.concatenate([ROTATION, DISPLACEMENT]), np.array([0.2, -0.6, 2.0])
    A = 3e-3 * rng.normal(size=(6, 6))
    _, P = predicted(state(angles), np.zeros((N + 3, N + 3)), motion, A @ A.T)
    x = state(angles)[:6]
    spread = np.cov(np.array([moved(x, motion, A @ rng.normal(size=6))[:6] for _ in range(20_000)]).T)
    sigma = np.sqrt(np.diag(spread))
    assert_allclose(P[:6, :6] / np.outer(sigma, sigma), spread / np.outer(sigma, sigma), atol=0.04)


def test_prediction_touches_nothing_beyond_the_state():
    x, P = state(np.zeros(3)), random_covariance()
    x[N:], P[N:], P[:, N:] = 7.0, 7.0, 7.0
    x_after, P_after = predicted(x, P, np.concatenate([ROTATION, DISPLACEMENT]), np.eye(6))
    assert_array_equal(x_after[N:], 7.0)
    assert_array_equal(P_after[N:], 7.0)
    assert_array_equal(P_after[:, N:], 7.0)


@given(attitudes, motions)
def test_the_pose_after_a_motion_has_the_numerical_covariance(angles, motion):
    """That of the state by numerical derivatives, and that of the motion, which is given at its end."""
    x, P, own = state(angles, 6)[:6], random_covariance(6)[:6, :6], random_covariance(6, seed=1, scale=0.01)[:6, :6]

    def pose(values):
        i_T_j = gtsam.Pose3(gtsam.Rot3.Expmap(motion[:3]), motion[3:])
        return gtsam.Pose3(gtsam.Rot3.RzRyRx(values[3:6]), values[:3]).compose(i_T_j)

    T = np.array(
        [
            (pose(x).localCoordinates(pose(x + STEP * u)) - pose(x).localCoordinates(pose(x - STEP * u))) / (2 * STEP)
            for u in np.eye(6)
        ]
    ).T
    world_R_body, position, cov = pose_after(x, P, motion_of(motion, own))
    assert_allclose(world_R_body, pose(x).rotation().matrix(), atol=1e-12)
    assert_allclose(position, pose(x).translation(), atol=1e-12)
    assert_allclose(cov, T @ P @ T.T + own, atol=1e-7, rtol=1e-6)
    assert_array_equal(cov, cov.T)


def joseph(x, P, H, R, innovation):
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    I_KH = np.eye(len(x)) - K @ H
    return x + K @ innovation, I_KH @ P @ I_KH.T + K @ R @ K.T


@pytest.mark.parametrize("seed", range(5))
def test_a_correction_is_joseph_s_and_exactly_symmetric(seed):
    rng = np.random.default_rng(seed)
    x, P = state(np.array([0.1, 0.2, 0.3])), random_covariance(seed=seed)
    H, R, e = rng.normal(size=(2, N)), np.diag([0.01, 0.02]), rng.normal(size=2) * 0.01
    expected_x, expected_P = joseph(x[:N], P[:N, :N], H, R, e)
    pair_x, pair_P = x.copy(), P.copy()
    correct_pair(pair_x, pair_P, N, H @ P[:N, :N], H @ P[:N, :N] @ H.T + R, e)
    assert_allclose(pair_x[:N], expected_x, atol=1e-12)
    assert_allclose(pair_P[:N, :N], expected_P, atol=1e-12)
    assert_array_equal(pair_P, pair_P.T)

    single_x, single_P = joseph(x[:N], P[:N, :N], H[:1], R[:1, :1], e[:1])
    correct(x, P, N, P[:N, :N] @ H[0], H[0] @ P[:N, :N] @ H[0] + R[0, 0], e[0])
    assert_allclose(x[:N], single_x, atol=1e-12)
    assert_allclose(P[:N, :N], single_P, atol=1e-12)
    assert_array_equal(P, P.T)


def test_a_correction_keeps_roll_and_yaw_within_half_a_turn():
    x, P = state(np.array([3.1, 0.0, -3.1])), np.eye(N + 3)
    correct(x, P, N, P[3, :N].copy(), 1.0, 0.1)
    correct(x, P, N, P[5, :N].copy(), 1.0, -0.1)
    assert x[3] == pytest.approx(3.2 - 2 * np.pi)
    assert x[5] == pytest.approx(-3.2 + 2 * np.pi)


def test_start_covariance_and_pose_covariance_are_inverse_transforms():
    angles, sigma = (0.3, -0.4, 1.0), np.array([0.1, 0.2, 0.3])
    E, P = np.array(euler_from_rates(angles)), np.zeros((6, 6))
    P[3:, 3:] = E @ np.diag(sigma**2) @ E.T
    _, _, cov = pose_after(state(angles, 6), P, motion_of(np.zeros(6), np.zeros((6, 6))))
    assert_allclose(cov[:3, :3], np.diag(sigma**2), atol=1e-12)
