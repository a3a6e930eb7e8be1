"""Equations of both filters against numerical derivatives through numpy and gtsam, and the textbook's updates."""

import gtsam
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from baselines import ekf_equations, invariant_equations
from baselines.invariant_equations import InvariantState
from sonar_graph.numerics import mat3
from sonar_graph.numerics.jit import compiled
from sonar_graph.slam.models.sonar_model import locate, range_azimuth

from .filters import (
    LANDMARKS,
    NO_XI,
    SONAR,
    TWIST,
    Ekf,
    Invariant,
    attitudes,
    body_after,
    both,
    derivative,
    gap_motion_of,
    observed,
    rotation,
    sonar_pose,
    triples,
    twists,
    unwrapped,
    views,
)

A = 0.01 * np.random.default_rng(7).normal(size=(6, 6))
C, NO_C = A @ A.T, np.zeros((6, 6))
ANGLES, PORT = np.array([0.3, -0.5, 2.0]), np.array([0.1, 0.2, -0.3])
close = {"atol": 1e-5, "rtol": 1e-5}


def carried(filter_, state, twist, xi_motion=NO_XI):
    """The true state after a motion."""
    return filter_.posed(state, *body_after(filter_, state, twist, xi_motion))


def away_from_singular(angles, twist):
    R = gtsam.Rot3.RzRyRx(angles).matrix() @ rotation(twist[:3])
    assume(abs(mat3.euler_from_rotation(mat3.matrix(R))[1]) < 1.4)


def assert_covariance(actual, expected):
    assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max(), rtol=1e-5)
    assert_array_equal(actual, actual.T)


def assert_corrected(filter_, after, state, H, R, e, atol=1e-12):
    """By Joseph's form."""
    S = H @ state.P @ H.T + R
    K = state.P @ H.T @ np.linalg.inv(S)
    I_KH = np.eye(len(state.P)) - K @ H
    assert_allclose(filter_.error(after, filter_.moved(state, K @ e)), 0.0, atol=atol)
    assert_allclose(after.P, I_KH @ state.P @ I_KH.T + K @ R @ K.T, atol=atol)
    assert_array_equal(after.P, after.P.T)


@both
@given(attitudes, twists)
def test_prediction_has_the_numerical_covariance_of_state_and_motion(filter_, angles, twist):
    away_from_singular(angles, twist)
    state = filter_.state(angles)
    expected = carried(filter_, state, twist)
    F = derivative(lambda xi: filter_.error(carried(filter_, filter_.moved(state, xi), twist), expected), len(state.P))
    J = derivative(lambda v: filter_.error(carried(filter_, state, twist, v), expected), 6)
    after = filter_.predicted(state, twist, C)
    assert_allclose(filter_.error(after, expected), 0.0, atol=1e-12)
    assert_covariance(after.P, F @ state.P @ F.T + J @ C @ J.T)


@both
@given(attitudes, twists)
def test_the_pose_after_a_motion_has_the_numerical_covariance(filter_, angles, twist):
    """In the body's own perturbation, that of the contract."""
    state = filter_.state(angles)

    def pose(xi, xi_motion=NO_XI):
        R, X = body_after(filter_, filter_.moved(state, xi), twist, xi_motion)
        return gtsam.Pose3(gtsam.Rot3(R), X)

    n = len(state.P)
    estimate = pose(np.zeros(n))
    T = derivative(lambda xi: estimate.localCoordinates(pose(xi)), n)
    T_m = derivative(lambda v: estimate.localCoordinates(pose(np.zeros(n), v)), 6)
    R, X, cov = filter_.pose_after(state, twist, C)
    assert_allclose(R, estimate.rotation().matrix(), atol=1e-12)
    assert_allclose(X, estimate.translation(), atol=1e-12)
    assert_covariance(cov, T @ state.P @ T.T + T_m @ C @ T_m.T)


@both
@given(attitudes)
def test_points_have_the_numerical_covariance_of_their_coordinates(filter_, angles):
    state = filter_.state(angles)
    for k in range(3):
        G = derivative(lambda xi, k=k: np.vstack(filter_.world(filter_.moved(state, xi))[1:3])[k], len(state.P))
        assert_allclose(filter_.covariance(state, k), G @ state.P @ G.T, atol=1e-8)


@both
@pytest.mark.parametrize("m", [1, 2, 5])
@pytest.mark.parametrize("seed", range(3))
def test_a_correction_is_joseph_s_and_exactly_symmetric(filter_, seed, m):
    rng, state = np.random.default_rng(seed), filter_.state(ANGLES, seed=seed)
    H, root, e = rng.normal(size=(m, len(state.P))), 0.1 * rng.normal(size=(m, m)), 0.01 * rng.normal(size=m)
    R = root @ root.T + 1e-3 * np.eye(m)
    assert_corrected(filter_, filter_.corrected(state, H, R, e), state, H, R, e, 1e-11)


def seen_from(filter_, angles, twist, view):
    """A state whose second landmark is seen there, and its range and azimuth at errors of state and motion."""
    where = locate(sonar_pose(filter_, filter_.state(angles), twist), *view)
    state = filter_.state(angles, np.vstack([LANDMARKS[0], where]))

    def seen(xi, xi_motion=NO_XI):
        moved = filter_.moved(state, xi)
        z = range_azimuth(sonar_pose(filter_, moved, twist, xi_motion), filter_.world(moved)[2][1])
        return unwrapped(z - view[:2], 1)

    return state, seen


@both
@given(attitudes, twists, views)
def test_jacobians_of_the_observation_are_the_numerical_ones(filter_, angles, twist, view):
    state, seen = seen_from(filter_, angles, twist, view)
    z, H, H_m = filter_.observation(state, 2, twist)
    assert_allclose(unwrapped(z - view[:2], 1), 0.0, atol=1e-9)
    assert_allclose(H, derivative(seen, len(state.P)), **close)
    assert_allclose(H_m, derivative(lambda v: seen(np.zeros(len(state.P)), v), 6), **close)


@both
@given(attitudes, twists, views)
def test_jacobians_of_a_new_landmark_are_the_numerical_ones(filter_, angles, twist, view):
    state = filter_.state(angles)
    point, G, G_m, G_z = filter_.location(state, twist, view)
    estimate = filter_.appended(state, np.array(point))

    def error(xi=np.zeros(len(state.P)), xi_motion=NO_XI, off=np.zeros(3)):  # noqa: B008
        moved = filter_.moved(state, xi)
        located = locate(sonar_pose(filter_, moved, twist, xi_motion), *(view + off))
        return filter_.error(filter_.appended(moved, located), estimate)[-3:]

    assert_allclose(error(), 0.0, atol=1e-12)
    assert_allclose(G, derivative(error, len(state.P)), **close)
    assert_allclose(G_m, derivative(lambda v: error(xi_motion=v), 6), **close)
    assert_allclose(G_z, derivative(lambda d: error(off=d), 3), **close)


@both
@given(attitudes, twists)
def test_updates_by_a_detection_and_by_depth_are_the_textbook_s(filter_, angles, twist):
    """The log's noise is correlated and not quite symmetric; the pressure port is off the origin."""
    view, e, logged = np.array([2.0, 0.3, 0.05]), np.array([0.01, -0.005]), np.array([[4e-4, 15e-5], [5e-5, 1e-4]])
    R = (logged + logged.T) / 2
    state, seen = seen_from(filter_, angles, twist, view)
    zero = np.zeros(len(state.P))
    H, H_m = derivative(seen, len(zero)), derivative(lambda v: seen(zero, v), 6)
    after, told = observed(filter_, state, [1], view[:2] + e, SONAR._replace(gate=np.inf), logged, twist, C)
    assert_allclose(told.innovations[0], e, atol=1e-9)
    assert_allclose(told.covs[0], H @ state.P @ H.T + H_m @ C @ H_m.T + R, atol=1e-6, rtol=1e-5)
    assert_corrected(filter_, after, state, H, H_m @ C @ H_m.T + R, e, 1e-5)

    def height(xi, xi_motion=NO_XI):
        R, X = body_after(filter_, filter_.moved(state, xi), twist, xi_motion)
        return (X + R @ PORT)[2:]

    H, H_m = derivative(height, len(zero)), derivative(lambda v: height(zero, v), 6)
    after = filter_.corrected_by_depth(state, twist, C, mat3.vector(PORT), height(zero)[0] + 0.02, 3e-4)
    assert_corrected(filter_, after, state, H, H_m @ C @ H_m.T + 3e-4, np.array([0.02]), 1e-7)


# ---------------------------------------------------------------------------------------------- EKF-SLAM


def test_a_correction_keeps_roll_and_yaw_within_half_a_turn():
    x, P = np.array([0.0, 0.0, 0.0, 3.1, 0.0, -3.1]), np.eye(6)
    ekf_equations.correct(x, P, 6, P[3].copy(), 1.0, 0.1)
    ekf_equations.correct(x, P, 6, P[5].copy(), 1.0, -0.1)
    assert x[[3, 5]] == pytest.approx([3.2 - 2 * np.pi, -3.2 + 2 * np.pi])


@given(attitudes)
def test_euler_angles_are_gtsam_s_and_their_rate_matrices_those_of_small_turns(angles):
    R, E = gtsam.Rot3.RzRyRx(angles), np.array(mat3.euler_from_rates(mat3.vector(angles)))
    assert_allclose(mat3.rotation_from_euler(mat3.vector(angles)), R.matrix(), atol=1e-14)
    assert_allclose(mat3.euler_from_rotation(mat3.rotation_from_euler(mat3.vector(angles))), angles, atol=1e-9)
    assert_allclose(mat3.product(mat3.matrix(E), mat3.rates_from_euler(mat3.vector(angles))), np.eye(3), atol=1e-12)

    def change(turn):
        after = mat3.euler_from_rotation(mat3.matrix(R.compose(gtsam.Rot3.Expmap(turn)).matrix()))
        return unwrapped(np.array(after) - angles, 0, 1, 2)

    assert_allclose(E, derivative(change, 3), **close)


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
    ekf_equations.correct_up(x, P, 6, up, sigma)
    ekf_equations.correct_state(x, P, 6, 2, 0.5, 4e-2)


# ---------------------------------------------------------------------------------------------- invariant filter


@given(attitudes, st.one_of(triples(*[st.floats(-1.7, 1.7)] * 3), attitudes))
def test_an_error_moves_the_estimate_by_the_group_s_exponential(angles, turn):
    state = Invariant.state(angles)
    xi = np.concatenate([turn, np.linspace(-0.2, 0.4, 12)])
    expected, actual = Invariant.moved(state, xi), Invariant.changed(state, invariant_equations.retract, xi)
    assert_allclose(actual.R, expected.R, atol=1e-12)
    assert_allclose(actual.points, expected.points, atol=1e-11)
    assert_allclose(actual.bias, expected.bias, atol=1e-15)


def test_the_bias_walks():
    state, walked = Invariant.state(ANGLES), np.zeros((15, 15))
    walked[3:6, 3:6] = 0.04 * np.eye(3)
    difference = Invariant.predicted(state, TWIST, C, 0.04).P - Invariant.predicted(state, TWIST, C).P
    assert_allclose(difference, walked, atol=1e-12)


def gauge(axes):
    """Moves of the whole world along x and y (and z), and its turn about the vertical, as columns of xi."""
    N = np.zeros((15, axes + 1))
    N[2, axes] = 1.0
    for at in (6, 9, 12):
        N[at : at + axes, :axes] = np.eye(axes)
    return N


def rows_of_height_and_tilt(state, twist):
    height = invariant_equations.height_of_body_point(state, gap_motion_of(twist), mat3.vector(PORT))[1]
    return [height, *(invariant_equations.height_of_point(state, k)[1] for k in range(3))]


@given(attitudes, twists, views)
def test_no_measurement_tells_where_the_world_is_or_which_way_it_is_turned(angles, twist, view):
    """At any estimate, right or wrong: H N = 0 and F N = N with one and the same N. Height and tilt are told."""
    state = seen_from(Invariant, angles, twist, view)[0]
    rows = [Invariant.observation(state, 2, twist)[1], *rows_of_height_and_tilt(state, twist)]
    H = np.vstack([*rows, invariant_equations.up_innovation(state, (0.1, 0.2, 0.9))[1]])
    assert_allclose(H @ gauge(2), 0.0, atol=1e-10)
    assert np.linalg.norm(H @ gauge(3)[:, 2]) > 1.0
    known = gauge(3) @ gauge(3).T
    assert_allclose(Invariant.predicted(state._replace(P=known), twist, NO_C).P, known, atol=1e-12)


@given(attitudes, st.floats(-np.pi, np.pi))
def test_what_is_missed_of_height_and_up_is_linear_in_the_error(angles, turn):
    """The measured direction is the true one; the estimate is off."""
    state, direction = Invariant.state(angles), (np.cos(turn), np.sin(turn), 0.3)

    def missed(xi):
        up = Invariant.moved(state, xi).R.T @ [0.0, 0.0, 1.0]
        return invariant_equations.up_innovation(state, mat3.vector(up))[0]

    assert_allclose(missed(np.zeros(15)), 0.0, atol=1e-12)
    assert_allclose(invariant_equations.up_innovation(state, direction)[1], derivative(missed, 15), atol=1e-6)
    for k in range(3):
        height_m, H = invariant_equations.height_of_point(state, k)
        assert height_m == state.points[k, 2]
        assert_allclose(H, derivative(lambda xi, k=k: Invariant.moved(state, xi).points[k, 2:], 15), atol=1e-6)


def test_depth_up_and_plane_are_scalar_kalman_updates_where_nothing_correlates():
    """At the origin and level: ``1 / P' = 1 / P + 1 / R``, and the estimate moves by ``P / (P + R)``."""
    prior = InvariantState(
        np.eye(3), np.zeros((1, 3)), np.zeros(3), np.diag([1e-2, 2e-2, 3e-2, 1.0, 1.0, 1.0, 0.1, 0.2, 0.3])
    )
    still = gap_motion_of(np.zeros(6), 0.02 * np.eye(6), np.zeros((6, 3)))
    state = Invariant.changed(prior, invariant_equations.correct_depth, still, (0.0, 0.0, 0.0), 0.01, 0.03)
    assert state.P[8, 8] == pytest.approx(1 / (1 / 0.3 + 1 / 0.05))  # 0.02 by the motion
    assert state.points[0, 2] == pytest.approx(0.01 * 0.3 / 0.35)
    # the body's y axis points up by a milliradian: roll
    state = Invariant.changed(prior, invariant_equations.correct_up, (0.0, 0.001, 1.0), 0.05)
    assert_allclose(np.diag(state.P)[:3], [1 / (1 / 1e-2 + 20), 1 / (1 / 2e-2 + 20), 3e-2])
    assert state.R[2, 1] == pytest.approx(0.001 * 1e-2 / 6e-2, rel=1e-3)
    state = Invariant.changed(prior, invariant_equations.correct_plane, 0.02, 0.05, 0.01)
    assert_allclose(np.diag(state.P)[[0, 1, 8]], [1 / (100 + 100), 1 / (50 + 100), 1 / (1 / 0.3 + 20)])
    assert state.points[0, 2] == pytest.approx(0.02 * 0.3 / 0.35)


# ---------------------------------------------------------------------------------------------- observability


@both
@pytest.mark.parametrize("wander", [0.0, 0.1])
def test_only_the_invariant_filter_leaves_three_directions_open_at_any_estimates(filter_, wander):
    """The world's x, y and heading, over 12 steps with height, up direction and two landmarks at each.

    Rows H F ... F at estimates that are true, or as far off as corrections throw estimates about.
    """
    rng, twist, n = (
        np.random.default_rng(1),
        np.array([0.05, -0.03, 0.25, 0.5, 0.1, -0.05]),
        len(filter_.state(ANGLES).P),
    )
    R, X, rows, F = rotation([0.1, -0.2, 0.5]), np.array([0.5, -0.5, 0.3]), [], np.eye(n)
    for _ in range(12):
        off = wander * rng.normal(size=(4, 3))
        state = filter_.state(ANGLES, LANDMARKS + off[2:])
        state = filter_.posed(state, rotation(off[0]) @ R, X + off[1])
        told = [filter_.observation(state, k, NO_XI)[1] for k in (1, 2)]

        def height_and_up(xi, state=state):
            R, X, *_ = filter_.world(filter_.moved(state, xi))
            return np.array([X[2], *R[2]])

        told.append(derivative(height_and_up, n))
        rows.append(np.vstack(told) @ F)
        after = carried(filter_, state, twist)
        step = derivative(
            lambda xi, s=state, a=after: filter_.error(carried(filter_, filter_.moved(s, xi), twist), a), n
        )
        F, R, X = step @ F, R @ rotation(twist[:3]), X + R @ twist[3:]
    singular = np.linalg.svd(np.vstack(rows), compute_uv=False)
    unobservable = np.sum(singular < 1e-6 * singular[0])
    assert unobservable == (2 if filter_ is Ekf and wander else 3)
    if filter_ is Invariant:
        assert np.abs(np.vstack(rows) @ gauge(2)).max() < 1e-6
