import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from sonar_graph.logs.convert.planar import (
    planar_trajectory,
    range_azimuth,
    stepped_calibration,
    stepped_odometry,
    twists_of_steps,
    velocity_cov_of_steps,
)

metres = st.floats(-10, 10)
turns = st.one_of(st.floats(-3.1, 3.1), st.floats(-2e-4, 2e-4), st.just(0.0))


def motion_of(velocity, rate, duration):
    twist = np.array([[0, -rate, velocity[0]], [rate, 0, velocity[1]], [0, 0, 0]])
    return expm(twist * duration)


@given(metres, metres, turns, st.sampled_from([0.1, 1.0, 7.0]))
def test_twist_held_over_the_step_makes_the_step(dx, dy, turn, duration):
    velocity, rate = twists_of_steps(np.array([[dx, dy, turn]]), duration)
    made = motion_of(velocity[0], rate[0], duration)
    assert np.allclose(made, gtsam.Pose2(dx, dy, turn).matrix(), rtol=0, atol=1e-11)


def test_twist_is_the_logarithm_of_another_library():
    for step in [(1.0, 0.2, 0.3), (-0.4, 2.0, -1.7), (0.5, 0.1, 1e-3)]:
        velocity, rate = twists_of_steps(np.array([step]), 1.0)
        assert np.allclose([*velocity[0], rate[0]], gtsam.Pose2.Logmap(gtsam.Pose2(*step)), rtol=0, atol=1e-10)


def test_the_chord_alone_would_not_make_the_step():
    velocity = np.array([1.0, 0.0])
    assert not np.allclose(motion_of(velocity, 0.3, 1.0), gtsam.Pose2(1.0, 0.0, 0.3).matrix(), atol=1e-2)


def test_velocity_noise_makes_the_noise_of_the_step():
    rng = np.random.default_rng(3)
    step = np.array([[0.8, -0.1, 0.6]])
    S = np.array([[4e-4, 1e-4], [1e-4, 2e-4]])
    cov = np.zeros((1, 3, 3))
    cov[0, :2, :2] = S
    velocity_cov = velocity_cov_of_steps(step, cov, 2.0)[0]
    velocity, rate = twists_of_steps(step, 2.0)
    draws = rng.multivariate_normal(velocity[0], velocity_cov, 4000)
    V = np.column_stack([motion_of(axis, rate[0], 2.0)[:2, 2] for axis in np.eye(2)])
    reached = draws @ V.T
    assert np.allclose(np.cov(reached.T), S, rtol=0.1, atol=1e-5)


def test_calibrated_turn_noise_is_the_mean_variance_over_a_step():
    covs = np.tile(1e-4 * np.eye(3), (2, 1, 1))
    covs[:, 2, 2] = [1e-4, 3e-4]
    _, dvl = stepped_odometry(np.zeros((2, 3)), covs, 2)
    density = stepped_calibration(dvl, covs, 2).imu.gyro_noise_density
    assert density**2 * 2 == pytest.approx(2e-4)


def test_run_begins_with_a_row_without_motion():
    imu, dvl = stepped_odometry(np.array([[1.0, 0.0, 0.1]]), np.zeros((1, 3, 3)), 1)
    assert imu.stamps_ns.tolist() == dvl.stamps_ns.tolist() == [0, 1_000_000_000]
    assert not dvl.velocity[0].any()
    assert not imu.angular_velocity[0].any()
    assert np.isnan(imu.specific_force).all()


@given(st.floats(0.5, 20), st.floats(-3.1, 3.1), st.floats(0.01, 0.2), st.floats(0.01, 0.2), st.floats(-0.9, 0.9))
def test_polar_covariance_is_the_numerical_jacobians(distance, azimuth, sx, sy, rho):
    point = distance * np.array([[np.cos(azimuth), np.sin(azimuth)]])
    S = np.array([[[sx**2, rho * sx * sy], [rho * sx * sy, sy**2]]])
    r, a, cov = range_azimuth(point, S)
    assert np.allclose([r[0], a[0]], [distance, azimuth])
    J = np.empty((2, 2))
    for axis in range(2):
        offset = 1e-6 * np.eye(2)[axis]
        ahead, behind = range_azimuth(point + offset, S), range_azimuth(point - offset, S)
        turn = np.angle(np.exp(1j * (ahead[1] - behind[1])))
        J[:, axis] = [(ahead[0] - behind[0])[0] / 2e-6, turn[0] / 2e-6]
    assert np.allclose(cov[0], J @ S[0] @ J.T, rtol=1e-6, atol=1e-9)


def test_planar_poses_turn_about_the_vertical():
    trajectory = planar_trajectory(np.array([0, 1]), np.array([[1.0, 2.0, 0.0], [3.0, 4.0, np.pi / 2]]))
    assert np.allclose(trajectory.positions, [[1, 2, 0], [3, 4, 0]])
    assert np.allclose(trajectory.rotations().apply([1, 0, 0]), [[1, 0, 0], [0, 1, 0]])
