import math

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from baselines.ekf_equations import (
    correct,
    correct_pair,
    correct_state,
    correct_up,
    location,
    moment_after,
    motion_covariance,
    observation,
    observe_rows,
    pose_after,
    predict,
)
from baselines.sonar_update import Frame, no_outcomes
from sonar_graph.numerics.jit import compiled
from sonar_graph.numerics.mat3 import (
    euler_from_rates,
    euler_from_rotation,
    matrix,
    product,
    rates_from_euler,
    rotation_from_euler,
    vector,
)
from sonar_graph.slam.models.sonar_model import locate, range_azimuth

from .invariant import MOUNTING, SONAR, derivative
from .motions import motion_of

N = 12
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
    F = derivative(lambda d: unwrapped(moved(x[:N] + d, motion) - moved(x[:N], motion)), N)
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

    T = derivative(lambda d: pose(x).localCoordinates(pose(x + d)), 6)
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


@given(attitudes)
def test_euler_angles_are_gtsam_s_and_their_rate_matrices_those_of_small_turns(angles):
    R, E = gtsam.Rot3.RzRyRx(angles), np.array(euler_from_rates(vector(angles)))
    assert_allclose(rotation_from_euler(vector(angles)), R.matrix(), atol=1e-14)
    assert_allclose(euler_from_rotation(rotation_from_euler(vector(angles))), angles, atol=1e-9)
    assert_allclose(product(matrix(E), rates_from_euler(vector(angles))), np.eye(3), atol=1e-12)

    def change(turn):
        after = euler_from_rotation(matrix(R.compose(gtsam.Rot3.Expmap(turn)).matrix()))
        return (np.array(after) - angles + np.pi) % (2 * np.pi) - np.pi

    assert_allclose(E, derivative(change, 3), atol=1e-5, rtol=1e-5)


NOISE = np.diag([0.02**2, 0.01**2])
MOTION_SIGMA, TWIST = 1e-3, np.array([0.02, -0.01, 0.05, 0.1, 0.02, -0.01])
MOTION = motion_of(TWIST, MOTION_SIGMA**2 * np.eye(6))
views = st.tuples(st.floats(1.0, 10.0), st.floats(-math.pi, math.pi), st.floats(-0.8, 0.8))


def sonar_at(x, xi=None):
    """The sonar at the instant of the frame, by gtsam; the motion perturbed on the left of its rotation, in place."""
    dR, dp, xi = gtsam.Rot3.Expmap(TWIST[:3]), TWIST[3:], np.zeros(6) if xi is None else xi
    motion = gtsam.Pose3(gtsam.Rot3.Expmap(xi[:3]).compose(dR), dp + xi[3:])
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(x[3:6]), x[:3]).compose(motion).compose(MOUNTING)


def numbers(rows):
    """Derivatives by the pose state (m, 6) and by the motion (m, 6)."""
    by_pose = np.array([row.by_X + row.by_angles for row in rows])
    return by_pose, np.array([row.by_theta + row.by_eps for row in rows])


def wrapped(view):
    view[1] = math.remainder(view[1], 2 * math.pi)
    return view


@given(attitudes, views)
def test_jacobians_of_the_observation_are_the_numerical_ones(angles, view):
    x = state(angles, 6)[:6]
    p = locate(sonar_at(x), *view)
    z, *rows = observation(moment_after(x, MOTION), vector(p), SONAR)
    H_v, H_m = numbers(rows)

    def missed(pose_state, point, xi=None):
        return wrapped(np.asarray(range_azimuth(sonar_at(pose_state, xi), point)) - z)

    assert_allclose(missed(x, p), 0.0, atol=1e-9)
    close = {"atol": 1e-5, "rtol": 1e-5}
    assert_allclose(H_v, derivative(lambda d: missed(x + d, p), 6), **close)
    assert_allclose(H_m, derivative(lambda d: missed(x, p, d), 6), **close)
    assert_allclose(-H_v[:, :3], derivative(lambda d: missed(x, p + d), 3), **close)


@given(attitudes, views)
def test_jacobians_of_the_augmentation_are_the_numerical_ones(angles, view):
    x, view = state(angles, 6)[:6], np.array(view)
    point, rows, G_z = location(moment_after(x, MOTION), SONAR, (view[0], view[1]), view[2])
    G_v, G_m = numbers(rows)

    def located(pose_state, values, xi=None):
        return np.asarray(locate(sonar_at(pose_state, xi), *values))

    assert_allclose(point, located(x, view), atol=1e-12)
    close = {"atol": 1e-5, "rtol": 1e-5}
    assert_allclose(G_v, derivative(lambda d: located(x + d, view), 6), **close)
    assert_allclose(G_m, derivative(lambda d: located(x, view, d), 6), **close)
    assert_allclose(G_z, derivative(lambda d: located(x, view + d), 3), **close)


def test_the_covariance_of_a_motion_is_that_of_its_six_numbers():
    A = 0.01 * np.random.default_rng(7).normal(size=(6, 6))
    cov, turn = A @ A.T, np.kron(np.eye(2), gtsam.Rot3.Expmap(TWIST[:3]).matrix())
    motion = motion_of(TWIST, cov)
    _, *rows = observation(moment_after(state(np.array([0.1, 0.2, 0.3])), motion), (2.0, 1.0, 0.5), SONAR)
    _, H_m = numbers(rows)
    actual = [[motion_covariance(motion, one, other) for other in rows] for one in rows]
    assert_allclose(actual, H_m @ turn @ cov @ turn.T @ H_m.T, rtol=1e-12)


def test_the_update_by_a_detection_is_the_textbook_s():
    n, R, e = 9, np.array([[4e-4, 1e-4], [1e-4, 1e-4]]), np.array([0.01, -0.005])
    x, P = state(np.array([0.1, -0.2, 0.5]), n), random_covariance(n, scale=0.02)
    x[6:9] = p = locate(sonar_at(x), 2.0, 0.3, 0.05)
    z, *rows = observation(moment_after(x, MOTION), vector(p), SONAR)
    H_v, H_m = numbers(rows)
    H = np.hstack([H_v, -H_v[:, :3]])
    S = H @ P[:n, :n] @ H.T + R + MOTION_SIGMA**2 * H_m @ H_m.T
    K = P[:n, :n] @ H.T @ np.linalg.inv(S)
    expected = x[:n] + K @ e, (np.eye(n) - K @ H) @ P[:n, :n]
    _, innovations, covs = outcomes = no_outcomes(1)
    columns = np.array([0]), np.array([z[0] + e[0]]), np.array([z[1] + e[1]]), R[None]
    observe_rows(x, P, n, MOTION, SONAR, Frame(columns, 0, 1, outcomes, False))
    assert_allclose(innovations[0], e, atol=1e-12)
    assert_allclose(covs[0], S, rtol=1e-9)
    assert_allclose(x[:n], expected[0], atol=1e-12)
    assert_allclose(P[:n, :n], expected[1], atol=1e-12)


def test_up_and_a_state_are_scalar_kalman_updates_where_nothing_correlates():
    """``x' = x + P / (P + R) (z - x)``; roll has the variance of the tilt over ``cos(theta)^2``."""
    before, prior = np.array([1.0, 2.0, 0.7, 0.05, -0.08, 0.3]), np.array([1e-2, 2e-2, 3e-2, 1e-3, 2e-3, 3e-3])
    roll, pitch, sigma = 0.1, -0.5, 0.03
    up = -np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)
    z, R = np.array([0.5, roll, pitch]), np.array([4e-2, (sigma / np.cos(pitch)) ** 2, sigma**2])
    x, P = before.copy(), np.diag(prior)
    corrected(x, P, up, sigma)
    gain = prior[2:5] / (prior[2:5] + R)
    assert_allclose(x[2:5], before[2:5] + gain * (z - before[2:5]), atol=1e-12)
    assert_allclose(P, np.diag([*prior[:2], *((1 - gain) * prior[2:5]), prior[5]]), atol=1e-15)
    assert_allclose(x[[0, 1, 5]], before[[0, 1, 5]], atol=1e-12)


@compiled
def corrected(x, P, up, sigma):
    correct_up(x, P, 6, up, sigma)
    correct_state(x, P, 6, 2, 0.5, 4e-2)
