"""Equations of both filters against numerical derivatives through numpy and gtsam, and the textbook's updates."""

from collections.abc import Callable
from typing import Any, NamedTuple

import gtsam
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from baselines import ekf_slam, invariant_ekf
from baselines.kalman import USED
from sonar_graph.calibration import PlanarMotion, Start
from sonar_graph.models import locate, range_azimuth
from sonar_graph.navigation import Odometry
from sonar_graph.testing.numerical import central_differences

from .filters import (
    ANTENNA,
    CALIBRATION,
    LANDMARKS,
    NOISE,
    NOTHING,
    PORT,
    STILL,
    Invariant,
    attitudes,
    begun,
    both,
    carried,
    motion_of,
    observe_one,
    pose_after,
    predict,
    random_covariance,
    rotation,
    sonar_after,
    triples,
    twists,
    update_depth,
    views,
    world_at,
)

C = random_covariance(6, 0.01, 7)
ANGLES = np.array([0.3, -0.5, 2.0])
UP = np.array([0.0, 0.0, 1.0])


def numerical(function, filter_, world, angles=()):
    """Derivatives of a function of world and motion's perturbation, by both."""
    n = filter_.bare + world.landmarks.size
    by_world = central_differences(
        lambda xi: function(filter_.moved(world, xi), NOTHING),
        np.zeros(n),
        angles=angles,
    )
    return by_world, central_differences(
        lambda eps: function(world, eps), NOTHING, angles=angles
    )


def assert_covariance(actual, expected):
    assert_allclose(actual, expected, atol=1e-6 * np.abs(expected).max(), rtol=1e-6)
    assert_array_equal(actual, actual.T)


def assert_corrected(filter_, slam, world, P, H, R, e):
    """By Joseph's form."""
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    I_KH = np.eye(len(P)) - K @ H
    estimate, covariance = filter_.estimate(slam)
    assert_allclose(
        filter_.error(estimate, filter_.moved(world, K @ e)), 0.0, atol=1e-7
    )
    assert_covariance(covariance, I_KH @ P @ I_KH.T + K @ R @ K.T)


@both
@given(attitudes, twists)
def test_prediction_has_the_numerical_covariance_of_state_and_motion(
    filter_, angles, twist
):
    """And of the walk of the biases, where there are any."""
    world = world_at(angles)
    motion = motion_of(twist, C)
    assume(abs(pose_after(world, motion).rotation().pitch()) < 1.4)
    expected = carried(world, motion)
    slam = begun(filter_, world)
    F, J = numerical(
        lambda true, eps: filter_.error(carried(true, motion, eps), expected),
        filter_,
        world,
    )
    _, P = filter_.estimate(slam)
    predict(slam, motion, 1e7)
    after, covariance = filter_.estimate(slam)
    assert_allclose(filter_.error(after, expected), 0.0, atol=1e-12)
    walked = np.zeros(len(P))
    if filter_ is Invariant:
        imu = CALIBRATION.imu
        walked[3:9] = 1e7 * imu.gyro_bias_walk_density**2
        walked[9:12] = 1e7 * imu.accel_bias_walk_density**2
    assert_covariance(covariance, F @ P @ F.T + J @ C @ J.T + np.diag(walked))


@both
@given(attitudes, twists)
def test_pose_and_landmarks_have_the_numerical_covariance_of_the_contract(
    filter_, angles, twist
):
    """The pose in the body's own perturbation, a landmark in the world's axes."""
    world = world_at(angles)
    motion = motion_of(twist, C)
    slam = begun(filter_, world)
    expected = pose_after(world, motion)
    _, P = filter_.estimate(slam)
    R, X, cov = slam.pose_after(motion)
    assert_allclose(R, expected.rotation().matrix(), atol=1e-12)
    assert_allclose(X, expected.translation(), atol=1e-12)
    T, T_m = numerical(
        lambda true, eps: expected.localCoordinates(pose_after(true, motion, eps)),
        filter_,
        world,
    )
    assert_covariance(cov, T @ P @ T.T + T_m @ C @ T_m.T)
    for slot, at in enumerate(LANDMARKS):
        G, _ = numerical(
            lambda true, _, slot=slot: true.landmarks[slot], filter_, world
        )
        positions, covariance = slam.points([slot])
        assert_array_equal(positions, at[None])
        assert_covariance(covariance, G @ P @ G.T)


def in_view(angles, motion, view):
    """A world whose second landmark is seen there."""
    where = locate(sonar_after(world_at(angles), motion), *view)
    return world_at(angles, np.vstack([LANDMARKS[0], where]))


class Kind(NamedTuple):
    """A measurement a motion after the state: its value by world and perturbation, and the update by it."""

    value: Callable[..., Any]
    update: Callable[..., Any]
    widths: float = np.inf
    """Standard deviations from which on Huber's kernel widens the noise."""


KINDS = {
    "detection": Kind(
        lambda true, *of: range_azimuth(sonar_after(true, *of), true.landmarks[1]),
        lambda slam, motion, z, R: observe_one(slam, motion, 1, z, R),
    ),
    "depth": Kind(
        lambda *of: pose_after(*of).transformFrom(PORT)[2:],
        lambda slam, motion, z, R: update_depth(slam, motion, z.item(), R.item()),
    ),
    "heading": Kind(
        lambda true, *of: np.array(
            [pose_after(true, *of).rotation().yaw() + true.bias[9]]
        ),
        lambda slam, motion, z, R: slam.update_heading(
            motion, z.item() - 2 * np.pi, R.item()
        ),
        1.345,
    ),
    "fix": Kind(
        lambda *of: pose_after(*of).transformFrom(ANTENNA),
        lambda slam, *of: slam.update_position(*of),
        1.628,
    ),
}


def updated(filter_, kind, world, motion, deviations):
    """Update by a value so many standard deviations off, against the textbook's with numerical derivatives."""
    slam = begun(filter_, world, gate=1.0)
    _, P = filter_.estimate(slam)
    z = kind.value(world, motion, NOTHING)
    H, H_m = numerical(
        lambda true, eps: kind.value(true, motion, eps),
        filter_,
        world,
        [len(z) - 1] if len(z) < 3 else (),
    )
    R_z = random_covariance(len(z), 0.05) + 1e-3 * np.eye(len(z))
    noise = H_m @ motion.C @ H_m.T
    S = H @ P @ H.T + noise + R_z
    e = np.zeros(len(z))
    e[-1] = deviations / np.sqrt(np.linalg.inv(S)[-1, -1])
    told = kind.update(slam, motion, z + e, R_z)
    R = noise + max(deviations / kind.widths, 1.0) * R_z
    assert_corrected(filter_, slam, world, P, H, R, e)
    return told, (USED, e, S)


@both
@pytest.mark.parametrize("kind", KINDS)
@given(attitudes, twists, views)
def test_updates_are_the_textbook_s_with_numerical_derivatives(
    filter_, kind, angles, twist, view
):
    motion = motion_of(twist, C)
    world = in_view(angles, motion, view)
    assume(abs(pose_after(world, motion).rotation().pitch()) < 1.4)
    told, expected = updated(filter_, KINDS[kind], world, motion, 0.05)
    if kind == "detection":
        for one, other in zip(told, expected, strict=True):
            assert_allclose(one, other, rtol=1e-6, atol=1e-8)


@both
@pytest.mark.parametrize("kind", ["heading", "fix"])
@pytest.mark.parametrize("deviations", [1.3, 1.6, 5.0])
def test_outlying_headings_and_fixes_have_the_kernel_s_noise(filter_, kind, deviations):
    """Five standard deviations S off, ``R`` is ``5 / k R``, k 1.345 of a heading and 1.628 of a fix; below k it is R."""
    updated(filter_, KINDS[kind], world_at(ANGLES), STILL, deviations)


@both
@given(attitudes, twists, views)
def test_a_new_landmark_has_the_numerical_covariance_and_correlations(
    filter_, angles, twist, view
):
    world = world_at(angles)
    motion = motion_of(twist, C)
    slam = begun(filter_, world)
    view = view * [1.0, 1.0, 0.0]

    def located(true, eps, off=np.zeros(3)):  # noqa: B008
        point = locate(sonar_after(true, motion, eps), *(view + off))
        return true._replace(landmarks=np.vstack([true.landmarks, point]))

    expected = located(world, NOTHING)
    G, G_m = numerical(
        lambda true, eps: filter_.error(located(true, eps), expected), filter_, world
    )
    G_z = central_differences(
        lambda off: filter_.error(located(world, NOTHING, off), expected), np.zeros(3)
    )
    _, P = filter_.estimate(slam)
    slam.augment(motion, view[:2], NOISE)
    after, covariance = filter_.estimate(slam)
    assert_allclose(after.landmarks, expected.landmarks, atol=1e-12)
    V = np.diag([*np.diag(NOISE), CALIBRATION.sonar.elevation_aperture_rad**2 / 12])
    assert_covariance(covariance, G @ P @ G.T + G_m @ C @ G_m.T + G_z @ V @ G_z.T)


@both
def test_up_and_plane_are_scalar_kalman_updates(filter_):
    """At the origin and level: ``1 / P' = 1 / P + 1 / R``, and the estimate moves by ``P / (P + R)``."""
    start = Start(rpy_sigma_rad=(0.1, 0.2, 0.3), position_sigma_m=(0.1, 0.2, 0.5))
    calibration = CALIBRATION.model_copy(update={"start": start})
    roll, pitch, _, _, _, z = np.square((*start.rpy_sigma_rad, *start.position_sigma_m))
    still = motion_of(np.zeros(6), np.zeros((6, 6)), np.zeros((6, 3)))

    def after(update):
        slam = filter_.kind(calibration, Odometry(calibration))
        update(slam)
        R, X, cov = slam.pose_after(still)
        return gtsam.Rot3(R).rpy(), X, np.diag(cov)

    # the body's y axis points up by a milliradian: roll
    rpy, _, variances = after(
        lambda slam: slam.update_up(
            np.array([0.0, 0.001, 1.0]), np.sqrt(0.05), np.eye(3)
        )
    )
    assert_allclose(
        variances[:2], [1 / (1 / roll + 20), 1 / (1 / pitch + 20)], rtol=1e-5
    )
    assert rpy[0] == pytest.approx(0.001 * roll / (roll + 0.05), rel=1e-3)
    plane = PlanarMotion(z_m=0.02, z_sigma_m=np.sqrt(0.05), tilt_sigma_rad=0.1)
    _, X, variances = after(lambda slam: slam.update_plane(plane))
    assert_allclose(
        variances[[0, 1, 5]],
        [1 / (1 / roll + 100), 1 / (1 / pitch + 100), 1 / (1 / z + 20)],
        rtol=1e-3,
    )
    assert X[2] == pytest.approx(0.02 * z / (z + 0.05))


# ---------------------------------------------------------------------------------------------- EKF-SLAM


def test_a_correction_keeps_roll_and_yaw_within_half_a_turn():
    x = np.array([0.0, 0.0, 0.0, 3.1, 0.0, -3.1, 0.0])
    P = np.eye(7)
    ekf_slam.update(x, P, np.eye(7)[[3, 5]], np.array([0.2, -0.2]), np.eye(2))
    assert x[[3, 5]] == pytest.approx([3.2 - 2 * np.pi, -3.2 + 2 * np.pi])


# ---------------------------------------------------------------------------------------------- invariant filter


@given(attitudes, st.one_of(triples(*[st.floats(-1.7, 1.7)] * 3), attitudes))
def test_an_error_moves_the_estimate_by_the_group_s_exponential(angles, turn):
    """A measurement of the whole error without noise."""
    world = world_at(angles)
    xi = np.concatenate([turn, np.linspace(-0.2, 0.4, 20)])
    expected = Invariant.moved(world, xi)
    state = Invariant.state(world, np.eye(23))
    invariant_ekf.update(state, np.eye(23), xi, 1e-15 * np.eye(23))
    assert_allclose(state.R, expected.R, atol=1e-12)
    assert_allclose(
        state.points, np.vstack([expected.X, expected.landmarks]), atol=1e-11
    )
    assert_allclose(state.bias, expected.bias, atol=1e-14)


@given(attitudes)
def test_up_has_the_numerical_derivative_and_the_textbook_s_update(
    angles,
):
    """With the bias of the accelerometers, by half a turn between both ends."""
    world = world_at(angles)
    i_R_j = rotation(np.array([0.1, -0.2, 0.5]))
    e = np.array([0.01, -0.02])
    A = 0.5 * (np.eye(3) + i_R_j.T) / CALIBRATION.gravity_m_s2
    slam = begun(Invariant, world)
    _, P = Invariant.estimate(slam)

    def missed(true, _):
        """Horizontal part of the true direction, as the estimate turns it into the world."""
        return (world.R @ (true.R.T @ UP + A @ (true.bias[6:9] - world.bias[6:9])))[:2]

    H, _ = numerical(missed, Invariant, world)
    up = world.R.T @ np.array([*e, 1.0]) + A @ world.bias[6:9]
    slam.update_up(up, 0.03, i_R_j)
    assert_corrected(Invariant, slam, world, P, H, 0.03**2 * np.eye(2), e)


@both
@given(attitudes, twists, views)
def test_an_update_by_a_point_seen_far_off_is_the_textbook_s(
    filter_, angles, twist, view
):
    """By ``0 = g(x_v, z) - p``, which is compared where range and azimuth are not linear enough; turns cancel in it."""
    motion = motion_of(twist, C)
    R_z = 1e-6 * np.eye(2)
    e = np.array([0.02, -0.01, 0.03])
    view = view * [1.0, 1.0, 0.0]
    where = locate(sonar_after(world_at(angles), motion), *view)
    world = world_at(angles, np.vstack([LANDMARKS[0], where - e]))
    slam = begun(filter_, world, gate=1.0)
    _, P = filter_.estimate(slam)

    def seen(true, eps, off=np.zeros(3)):  # noqa: B008
        point = locate(sonar_after(true, motion, eps), *(view + off))
        return filter_.error(
            true._replace(landmarks=point[None]), world._replace(landmarks=where[None])
        )[-3:]

    H, H_m = numerical(
        lambda true, eps: filter_.error(true, world)[-3:] - seen(true, eps),
        filter_,
        world,
    )
    G_z = central_differences(lambda off: seen(world, NOTHING, off), np.zeros(3))
    aperture = CALIBRATION.sonar.elevation_aperture_rad
    V = np.diag([1e-6 + view[0] ** 2 * aperture**4 / 320.0, 1e-6, aperture**2 / 12.0])
    judged = slam.observe_far(motion, 1, view[:2], R_z)
    assume(judged is not None)
    assert_corrected(filter_, slam, world, P, H, H_m @ C @ H_m.T + G_z @ V @ G_z.T, e)


def gauge(axes):
    """Moves of the whole world along x and y (and z), and its turn about the vertical, as columns of xi."""
    N = np.zeros((23, axes + 1))
    N[2, axes] = 1.0
    for at in (14, 17, 20):
        N[at : at + axes, :axes] = np.eye(axes)
    return N


@given(attitudes, twists, views)
def test_no_measurement_tells_where_the_world_is_or_which_way_it_is_turned(
    angles, twist, view
):
    """At any estimate, right or wrong: of ``P = N N^T`` prediction and updates leave all. Height and tilt are observable."""
    motion = motion_of(twist, np.zeros((6, 6)))
    world = in_view(angles, motion, view)
    known = gauge(2) @ gauge(2).T
    slam = begun(Invariant, world, known, gate=1.0)
    observe_one(slam, motion, 1, view[:2] + 0.1, NOISE)
    update_depth(slam, motion, 0.3, 1e-2)
    slam.update_up(np.array([0.1, 0.2, 0.9]), 0.1, np.eye(3))
    slam.update_plane(PlanarMotion())
    assert_allclose(slam.state()[1].P, known, atol=1e-10)
    predict(slam, motion)
    assert_allclose(slam.state()[1].P, known, atol=1e-10)
    known = gauge(3) @ gauge(3).T
    slam = begun(Invariant, world, known)
    update_depth(slam, motion, 0.3, 1e-2)
    assert np.abs(slam.state()[1].P - known).max() > 0.5
