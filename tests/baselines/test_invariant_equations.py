import math

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from baselines.ekf_equations import moment_after
from baselines.ekf_equations import observation as plain_observation
from baselines.invariant_equations import (
    InvariantState,
    by_bias,
    correct,
    correct_depth,
    correct_plane,
    correct_up,
    height_of_body_point,
    height_of_point,
    landmark_covariance,
    location,
    motion_jacobian,
    observation,
    pose_after,
    predict,
    retract,
    up_innovation,
)
from sonar_graph.navigation.preintegration.recursion import NO_MOTION
from sonar_graph.numerics.mat3 import euler_from_rotation, matrix, rotation_from_euler, vector
from sonar_graph.slam.models.sonar_model import locate, range_azimuth

from .invariant import (
    D_BIAS,
    LANDMARKS,
    MOUNTING,
    SONAR,
    STEP,
    body_after,
    copied,
    derivative,
    error,
    gap_motion_of,
    gauge,
    moved_by,
    rotation,
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


PORT = np.array([0.1, 0.2, -0.3])
views = st.tuples(st.floats(1.0, 10.0), st.floats(-math.pi, math.pi), st.floats(-0.8, 0.8))
NO_XI, NO_MOTION_XI = np.zeros(15), np.zeros(6)


def motion(twist):
    return gap_motion_of(twist, np.zeros((6, 6)), D_BIAS)


def body(state, twist, xi, xi_motion):
    """The body at the measurement, when state and motion are off by so much."""
    moved = moved_by(state, xi)
    R, X = body_after(moved, twist, xi_motion + D_BIAS @ xi[3:6])
    return moved, gtsam.Pose3(gtsam.Rot3(R), X)


def unwrapped(difference):
    difference[1] = math.remainder(difference[1], 2 * math.pi)
    return difference


def check_jacobians(predict, size, H, H_m):
    """Against differences of ``predict(xi, xi_motion)``."""
    assert_allclose(H, derivative(lambda xi: predict(xi, NO_MOTION_XI), size), atol=1e-5, rtol=1e-5)
    assert_allclose(H_m, derivative(lambda v: predict(NO_XI[:size], v), 6), atol=1e-5, rtol=1e-5)


def seen_from(attitude, twist, view):
    """A state whose second landmark is seen there."""
    state = state_at(attitude)
    _, pose = body(state, twist, NO_XI, NO_MOTION_XI)
    state.points[2] = locate(pose.compose(MOUNTING), *view)
    return state


@given(rotation_vectors, twists, views)
def test_jacobians_of_the_observation_are_the_numerical_ones(attitude, twist, view):
    state = seen_from(attitude, twist, view)
    z, H, H_m = observation(state, 2, motion(twist), SONAR)
    assert_allclose(unwrapped(z - view[:2]), 0.0, atol=1e-9)

    def predict(xi, v):
        moved, pose = body(state, twist, xi, v)
        return unwrapped(range_azimuth(pose.compose(MOUNTING), moved.points[2]) - z)

    check_jacobians(predict, 15, H, H_m)


@given(rotation_vectors, twists, views)
def test_jacobians_of_a_new_landmark_are_the_numerical_ones(attitude, twist, view):
    """Of its xi: its place in the world that the error has turned back."""
    state = state_at(attitude)
    point, G, G_m, G_z = location(state, motion(twist), SONAR, view[:2], view[2])

    def located(xi, v, values=view):
        _, pose = body(state, twist, xi, v)
        return np.asarray(locate(pose.compose(MOUNTING), *values))

    def xi_of(xi, v):
        return located(xi, v) - gtsam.Rot3.Expmap(xi[:3]).matrix() @ np.array(point)

    assert_allclose(point, located(NO_XI, NO_MOTION_XI), atol=1e-12)
    check_jacobians(xi_of, 15, G, G_m)
    values = np.array(view)
    by_view = derivative(lambda d: located(NO_XI, NO_MOTION_XI, values + d), 3)
    assert_allclose(G_z, by_view, atol=1e-5, rtol=1e-5)


@given(rotation_vectors, twists)
def test_jacobians_of_heights_are_the_numerical_ones(attitude, twist):
    state = state_at(attitude)
    height_m, H, H_m = height_of_body_point(state, motion(twist), vector(PORT))

    def of_port(xi, v):
        return np.asarray(body(state, twist, xi, v)[1].transformFrom(PORT))[2:]

    assert_allclose(height_m, of_port(NO_XI, NO_MOTION_XI)[0], atol=1e-12)
    check_jacobians(of_port, 15, H, H_m)
    for k in range(3):
        height_m, H = height_of_point(state, k)
        assert height_m == state.points[k, 2]
        numerical = derivative(lambda xi, k=k: moved_by(state, xi).points[k, 2:], 15)
        assert_allclose(H, numerical, atol=1e-6)


@given(rotation_vectors, st.floats(-math.pi, math.pi))
def test_what_is_missed_of_the_up_direction_is_linear_in_the_error(attitude, turn):
    """The measured direction is the true one; the estimate is off."""
    estimate = state_at(attitude)
    direction = np.array([math.cos(turn), math.sin(turn), 0.3])

    def missed(xi):
        up = moved_by(estimate, xi).R.T @ [0.0, 0.0, 1.0]
        return up_innovation(estimate, vector(up))[0]

    numerical = derivative(missed, 15)
    _, H = up_innovation(estimate, vector(direction))
    assert_allclose(missed(NO_XI), 0.0, atol=1e-12)
    assert_allclose(H, numerical, atol=1e-6)


@given(rotation_vectors, twists, views)
def test_no_measurement_tells_where_the_world_is_or_which_way_it_is_turned(attitude, twist, view):
    """At any estimate, right or wrong: H N = 0 with one and the same N. Height and tilt are told."""
    state = seen_from(attitude, twist, view)
    rows = [
        observation(state, 2, motion(twist), SONAR)[1],
        height_of_body_point(state, motion(twist), vector(PORT))[1],
        height_of_point(state, 1)[1],
        up_innovation(state, (0.1, 0.2, 0.9))[1],
    ]
    H = np.vstack(rows)
    assert_allclose(H @ gauge(3), 0.0, atol=1e-10)
    assert np.linalg.norm(H @ gauge(3, "xyz-yaw")[:, 2]) > 1.0


def prior(variances):
    return InvariantState(np.eye(3), np.zeros((1, 3)), np.zeros(3), np.diag(variances))


def test_depth_up_and_plane_are_scalar_kalman_updates_where_nothing_correlates():
    """At the origin and level: ``1 / P' = 1 / P + 1 / R``, and the estimate moves by ``P / (P + R)``."""
    variances = np.array([1e-2, 2e-2, 3e-2, 1.0, 1.0, 1.0, 0.1, 0.2, 0.3])
    still = gap_motion_of(np.zeros(6), 0.02 * np.eye(6), np.zeros((6, 3)))

    state = prior(variances)
    correct_depth(state, still, (0.0, 0.0, 0.0), 0.01, 0.03)  # and 0.02 by the motion
    assert state.P[8, 8] == pytest.approx(1 / (1 / 0.3 + 1 / 0.05))
    assert state.points[0, 2] == pytest.approx(0.01 * 0.3 / 0.35)

    state = prior(variances)
    correct_up(state, (0.0, 0.001, 1.0), 0.05)  # the body's y axis points up by a milliradian: roll
    assert_allclose(np.diag(state.P)[:3], [1 / (1 / 1e-2 + 20), 1 / (1 / 2e-2 + 20), 3e-2])
    assert state.R[2, 1] == pytest.approx(0.001 * 1e-2 / 6e-2, rel=1e-3)

    state = prior(variances)
    correct_plane(state, 0.02, 0.05, 0.01)
    assert_allclose(np.diag(state.P)[[0, 1, 8]], [1 / (100 + 100), 1 / (50 + 100), 1 / (1 / 0.3 + 20)])
    assert state.points[0, 2] == pytest.approx(0.02 * 0.3 / 0.35)


# Observability of a run of 12 steps with height, up direction and two landmarks at each, by its linearisation at
# changing estimates. Three directions are unobservable: the world's x, y and heading.
STEPS = 12
OBSERVED_TWIST = np.array([0.05, -0.03, 0.25, 0.5, 0.1, -0.05])
D = 0.2 * np.random.default_rng(3).normal(size=(6, 3))


def estimates(wander):
    """Attitude, position and map at each step: the truth, and as far off as corrections throw estimates about."""
    rng = np.random.default_rng(1)
    R, X = rotation(np.array([0.1, -0.2, 0.5])), np.array([0.5, -0.5, 0.3])
    for _ in range(STEPS):
        off = wander * rng.normal(size=(2 + len(LANDMARKS), 3))
        yield rotation(off[0]) @ R, X + off[1], LANDMARKS + off[2:]
        R, X = R @ rotation(OBSERVED_TWIST[:3]), X + R @ OBSERVED_TWIST[3:]


def invariant(wander):
    """Rows H F ... F of the invariant filter, with the bias."""
    rows, F = [], np.eye(6 + 3 * 3)
    for R, X, landmarks in estimates(wander):
        state = InvariantState(R, np.vstack([X, landmarks]), np.zeros(3), np.eye(len(F)))
        still = gap_motion_of(np.zeros(6), np.zeros((6, 6)), np.zeros((6, 3)))
        seen = [observation(state, k, still, SONAR)[1] for k in (1, 2)]
        others = height_of_body_point(state, still, (0.0, 0.0, 0.0))[1], up_innovation(state, vector(R[2]))[1]
        rows += [H @ F for H in (*seen, *others)]
        after = np.vstack([X + R @ OBSERVED_TWIST[3:], landmarks])
        step = np.eye(len(F))
        step[:, 3:6] += by_bias(motion_jacobian(after, matrix(R)), gap_motion_of(OBSERVED_TWIST, np.zeros((6, 6)), D))
        F = step @ F
    return np.vstack(rows)


def plain(wander):
    """The same of the plain filter, whose state has Euler angles and no bias."""
    rows, F = [], np.eye(6 + 3 * 2)
    for R, X, landmarks in estimates(wander):
        x = np.concatenate([X, euler_from_rotation(matrix(R)), landmarks.ravel()])
        H = np.zeros((7, len(x)))
        for k, p in enumerate(landmarks):
            _, *seen = plain_observation(moment_after(x, NO_MOTION), vector(p), SONAR)
            for r, row in enumerate(seen):
                H[2 * k + r, :6], H[2 * k + r, 6 + 3 * k : 9 + 3 * k] = row.by_X + row.by_angles, np.negative(row.by_X)
        H[4:, 2:5] = np.eye(3)
        rows.append(H @ F)
        F = derivative(lambda d, x=x: carried(x + d) - carried(x), len(x)) @ F
    return np.vstack(rows)


def carried(x):
    R = np.array(rotation_from_euler(vector(x[3:])))
    angles = euler_from_rotation(matrix(R @ rotation(OBSERVED_TWIST[:3])))
    return np.concatenate([x[:3] + R @ OBSERVED_TWIST[3:], angles, x[6:]])


def unobservable(rows):
    singular = np.linalg.svd(rows, compute_uv=False)
    return int(np.sum(singular < 1e-6 * singular[0]))


@pytest.mark.parametrize("wander", [0.0, 0.1])
def test_the_invariant_filter_leaves_three_directions_open_at_any_estimates(wander):
    rows = invariant(wander)
    assert unobservable(rows) == 3
    assert np.abs(rows @ gauge(3)).max() < 1e-9


def test_the_plain_filter_does_so_at_the_truth_only():
    assert unobservable(plain(0.0)) == 3
    assert unobservable(plain(0.1)) == 2
