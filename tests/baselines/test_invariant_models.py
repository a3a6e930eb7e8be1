import math

import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from baselines.invariant_equations import height_of_body_point, height_of_point, location, observation, up_innovation
from sonar_graph.numerics.mat3 import vector
from sonar_graph.slam.models.sonar_model import locate, range_azimuth

from .invariant import (
    D_BIAS,
    MOUNTING,
    SONAR,
    body_after,
    derivative,
    gap_motion_of,
    gauge,
    moved_by,
    rotation_vectors,
    state_at,
    twists,
)

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
