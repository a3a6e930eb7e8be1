"""Rests drawn from noise, against roll, pitch and biases that were put in."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from sonar_graph.calibration import Calibration, ImuCalibration, Mounting
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.alignment.at_rest import align_at_rest, covariance_at_rest
from sonar_graph.navigation.alignment.gravity import InitialTilt

G, HZ, REST_S = 9.80665, 50, 20.0
EARTH, LATITUDE = 7.292115e-5, np.radians(40.0)
SENSORS = ImuCalibration(
    gyro_noise_density=2e-5, gyro_bias_walk_density=0.0, accel_noise_density=2e-3, accel_bias_sigma=5e-3
)
ROLL, PITCH = 0.3, -0.4
GYRO_BIAS = np.array([2e-4, -1e-4, 3e-4])
NOISELESS = np.random.default_rng(0)


def rest(rng, yaw=0.0, earth=0.0, noise=1.0, rest_s=REST_S) -> Imu:
    """What sensors with a noise say of a body with the attitude above."""
    n = round(rest_s * HZ)
    world_R_body = Rotation.from_euler("ZYX", [yaw, PITCH, ROLL])
    rate = world_R_body.inv().apply(earth * np.array([0.0, np.cos(LATITUDE), np.sin(LATITUDE)])) + GYRO_BIAS
    force = world_R_body.inv().apply([0, 0, G]) + noise * SENSORS.accel_bias_sigma * rng.standard_normal(3)
    white = noise * np.sqrt(HZ) * rng.standard_normal((2, n, 3))
    stamps_ns = np.arange(n) * (10**9 // HZ)
    return Imu(stamps_ns, rate + SENSORS.gyro_noise_density * white[0], force + SENSORS.accel_noise_density * white[1])


def nees(found: InitialTilt) -> float:
    error = np.array([found.roll_rad - ROLL, found.pitch_rad - PITCH, *(found.gyro_bias - GYRO_BIAS)])
    return float(error @ np.linalg.solve(found.covariance, error))


def band(runs: int) -> np.ndarray:
    return chi2.ppf([0.0005, 0.9995], 5 * runs) / (5 * runs)


def test_a_noiseless_rest_gives_what_was_put_in():
    found = align_at_rest(rest(NOISELESS, noise=0.0), Calibration(imu=SENSORS))
    assert [found.roll_rad, found.pitch_rad] == pytest.approx([ROLL, PITCH], abs=1e-12)
    assert found.gyro_bias == pytest.approx(GYRO_BIAS, abs=1e-15)
    assert found.stamp_ns == (round(REST_S * HZ) - 1) * (10**9 // HZ)
    assert found.bias_is_observed.all()


@pytest.mark.parametrize("latitude", [None, LATITUDE])
def test_what_is_claimed_is_what_many_rests_err_by(latitude):
    """With the Earth, at headings all around: its level part is in the covariance alone."""
    rng, runs = np.random.default_rng(3), 400
    known = Calibration(imu=SENSORS, earth_rate_latitude_rad=latitude)
    earth = 0.0 if latitude is None else EARTH
    found = [align_at_rest(rest(rng, rng.uniform(-np.pi, np.pi), earth), known) for _ in range(runs)]
    low, high = band(runs)
    assert low < np.mean([nees(one) for one in found]) / 5 < high


def test_the_earth_left_in_the_bias_is_noticed():
    rng, known = np.random.default_rng(4), Calibration(imu=SENSORS)
    found = [align_at_rest(rest(rng, rng.uniform(-np.pi, np.pi), EARTH), known) for _ in range(50)]
    assert np.mean([nees(one) for one in found]) / 5 > 5.0


def test_at_the_pole_the_earth_hides_nothing():
    """There its axis is vertical, so that all of it is known without a heading."""
    known = Calibration(imu=SENSORS, earth_rate_latitude_rad=np.pi / 2)
    level = align_at_rest(rest(NOISELESS, noise=0.0), known)
    without = align_at_rest(rest(NOISELESS, noise=0.0), Calibration(imu=SENSORS))
    up = Rotation.from_euler("ZYX", [0.0, PITCH, ROLL]).inv().apply([0, 0, 1.0])
    assert without.gyro_bias - level.gyro_bias == pytest.approx(EARTH * up, abs=1e-15)
    assert np.diag(level.covariance) == pytest.approx(np.diag(without.covariance), rel=2e-3)


def test_covariance_of_a_level_body_is_what_the_sensors_say():
    """By hand: sigma^2 / g^2 for both angles, N^2 / T + K^2 T / 3 for the biases, half of the Earth's level part."""
    sensors = ImuCalibration(
        gyro_noise_density=1e-4, gyro_bias_walk_density=1e-5, accel_noise_density=1e-3, accel_bias_sigma=1e-2
    )
    force = np.tile([0, 0, G], (200, 1))
    imu = Imu(np.arange(200) * 50_000_000, np.zeros((200, 3)), force)
    found = align_at_rest(imu, Calibration(imu=sensors, earth_rate_latitude_rad=LATITUDE)).covariance
    tilt = (1e-4 + 1e-6 / 10) / G**2
    up, level = EARTH * np.sin(LATITUDE), EARTH * np.cos(LATITUDE)
    bias = 1e-8 / 10 + 1e-10 * 10 / 3
    across = bias + up**2 * tilt + level**2 / 2
    assert np.diag(found) == pytest.approx([tilt, tilt, across, across, bias])
    assert found[0, 3] == pytest.approx(-up * tilt)  # roll moves up towards +y
    assert found[1, 2] == pytest.approx(up * tilt)  # pitch moves it towards -x


@pytest.mark.parametrize("latitude", [np.pi / 2, -LATITUDE])
def test_an_unknown_accelerometer_bias_spreads_as_it_moves_what_is_found(latitude):
    """``sigma^2 J J^T`` with J by differences, of all five; gyros without noise take over the tilt's error alone."""
    gyros = {"gyro_noise_density": 0.0, "accel_noise_density": 0.0}
    known = Calibration(imu=SENSORS.model_copy(update=gyros), earth_rate_latitude_rad=latitude)
    imu, step, ends = rest(NOISELESS, noise=0.0), 1e-4, []
    still = Calibration(imu=SENSORS, earth_rate_latitude_rad=latitude)
    for shift in (side * step * axis for axis in np.eye(3) for side in (1, -1)):
        found = align_at_rest(Imu(imu.stamps_ns, imu.angular_velocity, imu.specific_force + shift), still)
        ends.append([found.roll_rad, found.pitch_rad, *found.gyro_bias])
    J = (np.array(ends)[::2] - np.array(ends)[1::2]).T / (2 * step)
    up = Rotation.from_euler("ZYX", [0.0, PITCH, ROLL]).inv().apply([0, 0, 1.0])
    of_earth = np.zeros((5, 5))
    of_earth[2:, 2:] = 0.5 * (EARTH * np.cos(latitude)) ** 2 * (np.eye(3) - np.outer(up, up))
    expected, size = SENSORS.accel_bias_sigma**2 * J @ J.T, np.array([1.0, 1.0, EARTH, EARTH, EARTH])
    covariance = covariance_at_rest(up, REST_S, known) - of_earth
    assert covariance / np.outer(size, size) == pytest.approx(expected / np.outer(size, size), rel=1e-6, abs=1e-13)


def test_a_scale_error_of_all_accelerometers_changes_nothing():
    known = Calibration(imu=SENSORS, earth_rate_latitude_rad=LATITUDE)
    imu = rest(NOISELESS, noise=0.0)
    long = Imu(imu.stamps_ns, imu.angular_velocity, 1.04 * imu.specific_force)
    found, expected = align_at_rest(long, known), align_at_rest(imu, known)
    assert (found.roll_rad, found.pitch_rad) == pytest.approx((expected.roll_rad, expected.pitch_rad), abs=1e-12)
    assert found.gyro_bias == pytest.approx(expected.gyro_bias, abs=1e-15)
    assert found.covariance == pytest.approx(expected.covariance, rel=1e-9)


def test_mounting_is_taken_out():
    mounted = SENSORS.model_copy(update={"mounting": Mounting(rpy_rad=(0.0, 0.0, np.pi / 2))})
    imu, bare = rest(NOISELESS, noise=0.0), Calibration(imu=SENSORS)
    turn = Rotation.from_euler("z", -np.pi / 2)
    turned = Imu(imu.stamps_ns, turn.apply(imu.angular_velocity), turn.apply(imu.specific_force))
    found, expected = align_at_rest(turned, Calibration(imu=mounted)), align_at_rest(imu, bare)
    assert found.gyro_bias == pytest.approx(expected.gyro_bias, abs=1e-15)
    assert [found.roll_rad, found.pitch_rad] == pytest.approx([ROLL, PITCH])


def swaying(imu: Imu) -> Imu:
    sway = 0.02 * np.sin(2 * np.pi * 0.3 * imu.stamps_ns * 1e-9)
    return Imu(imu.stamps_ns, imu.angular_velocity, imu.specific_force + sway[:, None])


def rolling(imu: Imu) -> Imu:
    roll_rate = 0.001 * np.sin(2 * np.pi * 0.3 * imu.stamps_ns * 1e-9)
    return Imu(imu.stamps_ns, imu.angular_velocity + roll_rate[:, None] * [1, 0, 0], imu.specific_force)


def turning(imu: Imu) -> Imu:
    return Imu(imu.stamps_ns, imu.angular_velocity + np.array([0, 0, 0.05]), imu.specific_force)


def without_gravity(imu: Imu) -> Imu:
    return Imu(imu.stamps_ns, imu.angular_velocity, imu.specific_force / G)


def with_a_hole(imu: Imu) -> Imu:
    return imu.rows((imu.stamps_ns < 5e9) | (imu.stamps_ns > 7e9))


def without_force(imu: Imu) -> Imu:
    return Imu(imu.stamps_ns, imu.angular_velocity, np.full_like(imu.specific_force, np.nan))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (swaying, "Imu.specific_force: varies"),
        (rolling, "Imu.angular_velocity: varies"),
        (turning, "turns at 0.05"),
        (without_gravity, "check its unit"),
        (with_a_hole, "without a row"),
        (without_force, "needs accelerometers"),
        (lambda imu: imu.rows(slice(0, 50)), "too short"),
        (lambda imu: imu.rows(slice(0, 1)), "too short"),
    ],
)
def test_what_is_no_rest_is_refused(spoil, message):
    imu, known = rest(np.random.default_rng(5)), Calibration(imu=SENSORS)
    align_at_rest(imu, known)
    with pytest.raises(AlignmentError, match=message):
        align_at_rest(spoil(imu), known)


def test_a_drifting_vehicle_is_refused_by_its_doppler_log():
    imu, known = rest(np.random.default_rng(5)), Calibration(imu=SENSORS)
    stamps_ns, cov = np.arange(100) * 200_000_000, np.full((100, 3, 3), np.nan)
    noise = 0.01 * np.random.default_rng(6).standard_normal((100, 3))
    align_at_rest(imu, known, Dvl(stamps_ns, noise, cov))
    with pytest.raises(AlignmentError, match=r"Dvl\.velocity"):
        align_at_rest(imu, known, Dvl(stamps_ns, noise + np.array([0.1, 0, 0]), cov))


def test_a_nose_straight_up_is_refused():
    imu = Imu(np.arange(200) * 50_000_000, np.zeros((200, 3)), np.tile([-G, 0, 0], (200, 1)))
    with pytest.raises(AlignmentError, match="nose points straight"):
        align_at_rest(imu, Calibration(imu=SENSORS))
