import math

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from sonar_graph.slam.models.sonar_model import (
    elevation_on_floor,
    locate,
    locate_jacobians,
    project,
    range_azimuth,
    range_azimuth_jacobians,
    sonar_point,
    sonar_point_jacobian,
    wrap_angle,
)

STEP = 1e-6
TOLERANCE = 1e-7
angles = st.floats(-3.0, 3.0)
coordinates = st.floats(-20.0, 20.0)
poses = st.builds(
    lambda *v: gtsam.Pose3.Expmap(np.array(v)), angles, angles, angles, coordinates, coordinates, coordinates
)
tiny = st.floats(-1e-7, 1e-7)
near_identity = st.builds(lambda *v: gtsam.Pose3.Expmap(np.array(v)), tiny, tiny, tiny, tiny, tiny, tiny)
any_pose = poses | near_identity
views = st.tuples(st.floats(0.5, 15.0), st.floats(-math.pi, math.pi), st.floats(-1.2, 1.2))


def numerical(function, size):
    """Central differences of a function of a small vector; a second row is an angle."""
    columns = []
    for unit in np.eye(size):
        change = function(STEP * unit) - function(-STEP * unit)
        if change.shape == (2,):
            change[1] = math.remainder(change[1], 2 * math.pi)
        columns.append(change / (2 * STEP))
    return np.array(columns).T


@given(any_pose, any_pose, views)
def test_jacobian_by_the_body_pose_is_the_numerical_one(world_T_body, body_T_sonar, view):
    p = locate(world_T_body.compose(body_T_sonar), *view)

    def moved(xi):
        return range_azimuth(world_T_body.compose(gtsam.Pose3.Expmap(xi)).compose(body_T_sonar), p)

    _, H_pose, _ = range_azimuth_jacobians(world_T_body, body_T_sonar, p)
    # differences of points up to 40 m away carry their rounding, over a level distance rho
    assert_allclose(H_pose, numerical(moved, 6), atol=1e-5, rtol=1e-5)


@given(any_pose, any_pose, views)
def test_jacobian_by_the_landmark_is_the_numerical_one(world_T_body, body_T_sonar, view):
    world_T_sonar = world_T_body.compose(body_T_sonar)
    p = locate(world_T_sonar, *view)
    _, _, H_landmark = range_azimuth_jacobians(world_T_body, body_T_sonar, p)
    assert_allclose(H_landmark, numerical(lambda d: range_azimuth(world_T_sonar, p + d), 3), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("azimuth", [math.pi - 1e-8, -math.pi + 1e-8, math.pi])
def test_jacobians_hold_where_azimuth_wraps_around(azimuth):
    q = sonar_point(3.0, azimuth, 0.1)
    _, _, H_landmark = range_azimuth_jacobians(gtsam.Pose3(), gtsam.Pose3(), q)
    assert_allclose(H_landmark, numerical(lambda d: range_azimuth(gtsam.Pose3(), q + d), 3), atol=TOLERANCE)


def test_the_numerical_check_finds_a_bearing_row_without_its_inverse_square():
    q = sonar_point(3.0, 0.4, 0.1)
    _, D_q = project(q)
    faulty = D_q.copy()
    faulty[1] *= q[0] ** 2 + q[1] ** 2
    true = numerical(lambda d: range_azimuth(gtsam.Pose3(), q + d), 3)
    assert_allclose(D_q, true, atol=TOLERANCE)
    assert np.abs(faulty - true).max() > 0.1


def test_the_numerical_check_finds_a_missing_adjoint():
    world_T_body = gtsam.Pose3.Expmap(np.array([0.1, -0.2, 0.7, 1.0, 2.0, 3.0]))
    body_T_sonar = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.5, 0.0), np.array([0.4, 0.1, -0.2]))
    p = locate(world_T_body.compose(body_T_sonar), 2.0, 0.3, -0.05)

    def moved(xi):
        return range_azimuth(world_T_body.compose(gtsam.Pose3.Expmap(xi)).compose(body_T_sonar), p)

    _, H_pose, _ = range_azimuth_jacobians(world_T_body, body_T_sonar, p)
    by_sonar_pose, true = H_pose @ body_T_sonar.AdjointMap(), numerical(moved, 6)
    assert_allclose(H_pose, true, atol=TOLERANCE)
    assert np.abs(by_sonar_pose - true).max() > 0.1


@given(any_pose, any_pose, views)
def test_jacobians_of_the_inverse_model_are_the_numerical_ones(world_T_body, body_T_sonar, view):
    point, G_pose, G_view = locate_jacobians(world_T_body, body_T_sonar, *view)
    assert_allclose(point, locate(world_T_body.compose(body_T_sonar), *view))

    def moved(xi):
        return locate(world_T_body.compose(gtsam.Pose3.Expmap(xi)).compose(body_T_sonar), *view)

    world_T_sonar = world_T_body.compose(body_T_sonar)
    assert_allclose(G_pose, numerical(moved, 6), atol=1e-6, rtol=1e-6)
    assert_allclose(G_view, numerical(lambda d: locate(world_T_sonar, *(np.array(view) + d)), 3), atol=1e-6)


@given(views)
def test_spherical_coordinates_and_points_have_inverse_jacobians(view):
    z, D_q = project(sonar_point(*view))
    assert_allclose(D_q @ sonar_point_jacobian(*view), np.eye(2, 3), atol=1e-9)
    assert z[0] == pytest.approx(view[0])
    assert math.remainder(z[1] - view[1], 2 * math.pi) == pytest.approx(0.0, abs=1e-12)


@given(any_pose, views)
def test_a_located_point_is_seen_where_it_was_located(world_T_sonar, view):
    z = range_azimuth(world_T_sonar, locate(world_T_sonar, *view))
    assert z[0] == pytest.approx(view[0], rel=1e-9)
    assert math.remainder(z[1] - view[1], 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


@given(st.floats(-100.0, 100.0))
def test_a_wrapped_angle_is_the_same_direction(angle):
    wrapped = wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.remainder(wrapped - angle, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)


@given(st.floats(-3.14, 3.14))
def test_an_angle_within_half_a_turn_stays_to_the_last_bit(angle):
    assert wrap_angle(angle) == angle


def test_range_and_azimuth_are_those_of_a_compass_and_a_ruler():
    left_of_a_sonar_that_looks_north = range_azimuth(
        gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 2), np.array([1.0, 2.0, 0.0])), np.array([-2.0, 6.0, 0.0])
    )
    assert_allclose(left_of_a_sonar_that_looks_north, [5.0, math.atan2(3.0, 4.0)])


@given(
    st.floats(-0.3, 0.3), st.floats(0.2, 0.9), st.floats(-3, 3), st.floats(-0.2, 0.2), st.floats(-0.12, 0.12),
    st.floats(1.0, 3.0),
)  # fmt: skip
def test_elevation_on_the_floor_is_that_of_a_point_on_it(roll, pitch, yaw, azimuth, elevation, range_m):
    world_T_sonar = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array([1.0, -2.0, 3.0]))
    floor_z = locate(world_T_sonar, range_m, azimuth, elevation)[2]
    found = elevation_on_floor(world_T_sonar, range_m, azimuth, floor_z, 0.244)
    assert found is not None
    assert abs(found) <= abs(elevation) + 1e-7
    assert locate(world_T_sonar, range_m, azimuth, found)[2] == pytest.approx(floor_z, abs=1e-9)


@pytest.mark.parametrize("floor_z", [-0.2, -5.0, 4.0])
def test_a_floor_outside_the_aperture_gives_no_elevation(floor_z):
    world_T_sonar = gtsam.Pose3(gtsam.Rot3.Pitch(math.radians(30)), np.zeros(3))
    assert elevation_on_floor(world_T_sonar, 2.0, 0.0, -1.0, 0.244) == pytest.approx(0.0, abs=1e-12)
    assert elevation_on_floor(world_T_sonar, 2.0, 0.0, floor_z, 0.244) is None
