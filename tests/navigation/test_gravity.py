"""Direction of gravity in a moving vehicle, the Earth's rotation, and roll and pitch of an up vector."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, ImuCalibration, Mounting
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import Floats, Imu
from sonar_graph.navigation.alignment.gravity import (
    angles_by_up,
    earth_rate_in_world,
    earth_up_and_level,
    gravity_direction,
    in_body_axes,
    roll_and_pitch,
    velocity_at_imu,
)
from sonar_graph.navigation.preintegration.motion import PreintegratedMotion, Preintegrator
from sonar_graph.navigation.preintegration.recursion import Steps
from sonar_graph.testing import check_consistent

from .rows import derivative
from .ways import acceleration_at, attitude, rate_at, velocity_at

G = 9.81
GRAVITY = np.array([0.0, 0.0, G])
IMU = ImuCalibration(accel_noise_density=2e-3, accel_bias_sigma=5e-3, gyro_noise_density=2e-3, gyro_bias_sigma=1e-3)
"""A gyro that drifts so fast that directions a second apart share next to nothing."""
T, N, FROM_S = 1.0, 2000, 2.0


def accelerated() -> tuple[PreintegratedMotion, Floats, Floats, Rotation]:
    """A turning, swaying vehicle's motion over T, its velocities in the body at both ends, and its last attitude."""
    t = FROM_S + (np.arange(N) + 0.5) * T / N
    force = attitude(t).inv().apply(acceleration_at(t) + GRAVITY)
    velocity = attitude(t).inv().apply(velocity_at(t))
    steps = Steps(np.full(N, T / N), rate_at(t), velocity, np.zeros((N, 3, 3)), force, np.zeros((N, 3)))
    motion, ends = Preintegrator(0.0, np.zeros(3)).integrate(steps, np.zeros(3)), np.array([FROM_S, FROM_S + T])
    return motion, *attitude(ends).inv().apply(velocity_at(ends)), attitude(ends)[1]


def tilt_sigma_at_rest(duration_s: float, velocity_sigma: float, imu: ImuCalibration) -> float:
    still = PreintegratedMotion(gtsam.Pose3(), np.eye(6), np.zeros((6, 3)), np.zeros(3), duration_s, GRAVITY)
    return gravity_direction(still, np.zeros(3), np.zeros(3), velocity_sigma, imu, G)[1]


def test_up_is_found_in_a_moving_vehicle():
    """And would be off by degrees, were the vehicle's own acceleration left in."""
    motion, v_i, v_j, end = accelerated()
    truth = end.inv().apply([0, 0, 1.0])
    up, _ = gravity_direction(motion, v_i, v_j, 0.01, IMU, G)
    assert np.linalg.norm(up) == pytest.approx(1)
    assert np.arccos(up @ truth) < 1e-4
    naive, _ = gravity_direction(motion, np.zeros(3), np.zeros(3), 0.01, IMU, G)
    assert np.arccos(naive @ truth) > np.radians(1)


def test_stated_sigma_is_that_of_many_noisy_intervals():
    """Two-sided, about both horizontal axes, with noise in force, bias, both velocities, and gyros."""
    motion, v_i, v_j, end = accelerated()
    level, rng, velocity_sigma, squares = end.inv().apply(np.eye(3)[:2]), np.random.default_rng(1), 0.004, []
    by_gyros = np.hypot(IMU.gyro_noise_density * np.sqrt(T / 3), IMU.gyro_bias_sigma * T / 2)
    for _ in range(1500):
        force = motion.mean_specific_force + IMU.accel_noise_density / np.sqrt(T) * rng.standard_normal(3)
        noisy = replace(motion, mean_specific_force=force + IMU.accel_bias_sigma * rng.standard_normal(3))
        scatter = velocity_sigma * rng.standard_normal((2, 3))
        up, sigma = gravity_direction(noisy, v_i + scatter[0], v_j + scatter[1], velocity_sigma, IMU, G)
        up = up + np.cross(by_gyros * rng.standard_normal(3), up)
        squares.append(np.sum((level @ up / sigma) ** 2))
    check_consistent(squares, 2, confidence=0.999)


@given(st.floats(0.2, 5.0), st.floats(0.0, 0.05))
@settings(max_examples=30)
def test_each_source_of_tilt_noise_falls_with_time_as_it_should(duration_s, velocity_sigma):
    """White force as 1 / sqrt(T), velocities as 1 / T, the bias not at all; the gyros' rises."""
    parts = [2e-3 / np.sqrt(duration_s), np.sqrt(2) * velocity_sigma / duration_s, 5e-3]
    by_gyros = IMU.gyro_noise_density * np.sqrt(duration_s / 3), IMU.gyro_bias_sigma * duration_s / 2
    expected = np.linalg.norm([np.linalg.norm(parts) / G, *by_gyros])
    assert tilt_sigma_at_rest(duration_s, velocity_sigma, IMU) == pytest.approx(expected)


@pytest.mark.parametrize("duration_s", [1.0, 5.0])
@pytest.mark.parametrize("gyro_density", [3.6e-5, 1.2e-4])
def test_tilt_settles_at_what_the_accelerometer_bias_allows(duration_s, gyro_density):
    """A scalar Kalman filter fed with many directions; as fresh noise the bias would be claimed several times less."""
    imu = ImuCalibration(accel_noise_density=1e-5, accel_bias_sigma=1e-2, gyro_noise_density=gyro_density)
    settled = []
    for sigma in (tilt_sigma_at_rest(duration_s, 1e-6, imu), 1e-2 / G):
        variance = 1.0
        for _ in range(20_000):
            predicted = variance + gyro_density**2 * duration_s
            variance = predicted * sigma**2 / (predicted + sigma**2)
        settled.append(np.sqrt(variance))
    assert settled[0] == pytest.approx(1e-2 / G, rel=0.03)
    assert settled[1] < 0.6 * settled[0]


@pytest.mark.parametrize("duration_s", [1.0, 30.0])
def test_what_the_gyros_do_meanwhile_is_in_the_tilt(duration_s):
    """Tilts that walk, and drift by a bias: at the end less their mean, which is what the accelerometers felt."""
    rng, steps, runs, density, bias = np.random.default_rng(2), 200, 20_000, 2e-4, 3e-5
    walk = np.cumsum(rng.normal(0, density * np.sqrt(duration_s / steps), (runs, steps)), axis=1)
    tilt = walk + rng.normal(0, bias, (runs, 1)) * np.linspace(0, duration_s, steps)
    noise = {"accel_noise_density": 1e-9, "accel_bias_sigma": 0.0}
    imu = ImuCalibration(gyro_noise_density=density, gyro_bias_sigma=bias, **noise)
    expected = (tilt[:, -1] - tilt.mean(axis=1)).std()
    assert tilt_sigma_at_rest(duration_s, 0.0, imu) == pytest.approx(expected, rel=0.03)


def test_without_forces_there_is_no_direction():
    unfelt = replace(accelerated()[0], mean_specific_force=np.full(3, np.nan))
    assert gravity_direction(unfelt, np.zeros(3), np.zeros(3), 0.01, IMU, G) is None


def test_velocity_at_the_imu_is_that_of_a_point_of_a_rigid_body():
    """Differences of the two points' positions on a turning body."""
    v_dvl, w, body_p_dvl, arm = np.array([[0.5, 0.1, 0], [0.15, -0.1, 0.3], [-0.2, 0.1, -0.1], [0.5, -0.1, 0.3]])
    moved = gtsam.Pose3.Expmap(1e-6 * np.concatenate([w, v_dvl])).transformFrom(arm)
    assert velocity_at_imu(v_dvl, w, body_p_dvl, body_p_dvl + arm) == pytest.approx((moved - arm) / 1e-6, abs=1e-5)


@pytest.mark.parametrize(("latitude_deg", "rate"), [(0, [0, 15.041, 0]), (90, [0, 0, 15.041]), (-90, [0, 0, -15.041])])
def test_the_earth_turns_north_at_the_equator_and_up_at_the_north_pole(latitude_deg, rate):
    """Degrees an hour; once a sidereal day."""
    known = Calibration(earth_rate_latitude_rad=np.radians(latitude_deg))
    found = np.degrees(earth_rate_in_world(known)) * 3600
    assert found == pytest.approx(rate, abs=1e-3)
    assert earth_up_and_level(known) == pytest.approx(earth_rate_in_world(known)[[2, 1]])
    assert 360 / np.linalg.norm(found) == pytest.approx(23.9345, abs=1e-4)
    assert earth_rate_in_world(Calibration()) is None
    assert earth_up_and_level(Calibration()) == (0.0, 0.0)


ATTITUDES = [(0.3, -0.4), (-2.8, 1.2), (0.0, 0.0), (1.5, -1.5)]


def up_of(roll: float, pitch: float, yaw: float = 0.7) -> np.ndarray:
    return Rotation.from_euler("ZYX", [yaw, pitch, roll]).inv().apply([0, 0, 1.0])


@pytest.mark.parametrize(("roll", "pitch"), ATTITUDES)
@pytest.mark.parametrize("length", [1.0, 9.8])
def test_up_in_the_body_has_the_roll_and_pitch_of_the_attitude(roll, pitch, length):
    assert roll_and_pitch(length * up_of(roll, pitch)) == pytest.approx((roll, pitch))


@pytest.mark.parametrize(("roll", "pitch"), ATTITUDES)
def test_the_derivative_is_that_of_turning_up_a_little(roll, pitch):
    """Along the sphere; a change of length is none of either angle."""
    up = up_of(roll, pitch)

    def angles(phi: np.ndarray) -> tuple[float, float]:
        return roll_and_pitch(Rotation.from_rotvec(phi).apply(up))

    by_turn = derivative(lambda phi: Rotation.from_rotvec(phi).apply(up), 3)
    assert angles_by_up(up) @ by_turn == pytest.approx(derivative(angles, 3), abs=1e-6)
    assert angles_by_up(up) @ up == pytest.approx([0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("pitch", [np.pi / 2 - 0.9e-3, -np.pi / 2 + 0.9e-3])
def test_a_nose_within_a_milliradian_of_the_vertical_has_no_roll(pitch):
    with pytest.raises(AlignmentError, match="nose points straight"):
        angles_by_up(up_of(0.3, pitch))
    angles_by_up(up_of(0.3, pitch - np.copysign(0.2e-3, pitch)))


def test_readings_are_turned_by_the_mounting():
    rpy, rng = (0.3, -0.5, 1.1), np.random.default_rng(0)
    rate, force = rng.standard_normal((2, 5, 3))
    known = Calibration(imu=ImuCalibration(mounting=Mounting(rpy_rad=rpy)))
    imu, turn = Imu(np.arange(5), rate, force), Rotation.from_euler("xyz", rpy)
    found = in_body_axes(imu, known)
    assert found.angular_velocity == pytest.approx(turn.apply(rate))
    assert found.specific_force == pytest.approx(turn.apply(force))


def test_a_single_force_that_was_not_measured_is_refused():
    force = np.ones((5, 3))
    force[3, 1] = np.nan
    with pytest.raises(AlignmentError, match="not finite in every row"):
        in_body_axes(Imu(np.arange(5), np.zeros((5, 3)), force), Calibration())
