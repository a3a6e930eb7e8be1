"""Rests drawn from noise, against roll, pitch and biases that were put in, and limits of a rest."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.alignment.at_rest import align_at_rest, covariance_at_rest
from sonar_graph.navigation.alignment.gravity import InitialTilt
from sonar_graph.testing import check_consistent

from .rows import derivative, dvl

G, HZ, REST_S = 9.80665, 50, 20.0
EARTH, LATITUDE = 7.292115e-5, np.radians(40.0)
SENSORS = ImuCalibration(
    gyro_noise_density=2e-5, gyro_bias_walk_density=0.0, accel_noise_density=2e-3, accel_bias_sigma=5e-3
)
ROLL, PITCH = 0.3, -0.4
GYRO_BIAS = np.array([2e-4, -1e-4, 3e-4])
NOISELESS = np.random.default_rng(0)
UP = Rotation.from_euler("ZYX", [0.0, PITCH, ROLL]).inv().apply([0, 0, 1.0])
KNOWN = Calibration(imu=SENSORS)


def rest(rng, yaw=0.0, earth=0.0, noise=1.0, rest_s=REST_S) -> Imu:
    """What sensors with a noise say of a body with the attitude above."""
    n = round(rest_s * HZ)
    world_R_body = Rotation.from_euler("ZYX", [yaw, PITCH, ROLL])
    rate = world_R_body.inv().apply(earth * np.array([0.0, np.cos(LATITUDE), np.sin(LATITUDE)])) + GYRO_BIAS
    force = world_R_body.inv().apply([0, 0, G]) + noise * SENSORS.accel_bias_sigma * rng.standard_normal(3)
    white = noise * np.sqrt(HZ) * rng.standard_normal((2, n, 3))
    stamps_ns = np.arange(n) * (10**9 // HZ)
    return Imu(stamps_ns, rate + SENSORS.gyro_noise_density * white[0], force + SENSORS.accel_noise_density * white[1])


def changed(imu: Imu, rate=0.0, force=0.0, times=1.0) -> Imu:
    return Imu(imu.stamps_ns, imu.angular_velocity + rate, times * imu.specific_force + force)


def error_of(found: InitialTilt) -> np.ndarray:
    return np.array([found.roll_rad - ROLL, found.pitch_rad - PITCH, *(found.gyro_bias - GYRO_BIAS)])


def nees(found: InitialTilt) -> float:
    return float(error_of(found) @ np.linalg.solve(found.covariance, error_of(found)))


def test_a_noiseless_rest_gives_what_was_put_in():
    found = align_at_rest(rest(NOISELESS, noise=0.0), KNOWN)
    assert error_of(found) == pytest.approx(np.zeros(5), abs=1e-12)
    assert found.stamp_ns == (round(REST_S * HZ) - 1) * (10**9 // HZ)
    assert found.bias_is_observed.all()


@pytest.mark.parametrize("latitude", [None, LATITUDE])
def test_what_is_claimed_is_what_many_rests_err_by(latitude):
    """With the Earth, at headings all around: its level part is in the covariance alone."""
    rng, known = np.random.default_rng(3), Calibration(imu=SENSORS, earth_rate_latitude_rad=latitude)
    earth = 0.0 if latitude is None else EARTH
    found = [align_at_rest(rest(rng, rng.uniform(-np.pi, np.pi), earth), known) for _ in range(400)]
    check_consistent([nees(one) for one in found], 5, confidence=0.999)


def test_the_earth_left_in_the_bias_is_noticed():
    rng = np.random.default_rng(4)
    found = [align_at_rest(rest(rng, rng.uniform(-np.pi, np.pi), EARTH), KNOWN) for _ in range(50)]
    assert np.mean([nees(one) for one in found]) / 5 > 5.0


def test_at_the_pole_the_earth_hides_nothing():
    """There its axis is vertical, so that all of it is known without a heading."""
    level = align_at_rest(rest(NOISELESS, noise=0.0), Calibration(imu=SENSORS, earth_rate_latitude_rad=np.pi / 2))
    without = align_at_rest(rest(NOISELESS, noise=0.0), KNOWN)
    assert without.gyro_bias - level.gyro_bias == pytest.approx(EARTH * UP, abs=1e-15)
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
    still = Calibration(imu=SENSORS, earth_rate_latitude_rad=latitude)
    quiet = {"gyro_noise_density": 0.0, "accel_noise_density": 0.0}
    imu = rest(NOISELESS, noise=0.0)
    J = derivative(lambda shift: error_of(align_at_rest(changed(imu, force=shift), still)), 3, 1e-4)
    of_earth = np.zeros((5, 5))
    of_earth[2:, 2:] = 0.5 * (EARTH * np.cos(latitude)) ** 2 * (np.eye(3) - np.outer(UP, UP))
    expected, size = SENSORS.accel_bias_sigma**2 * J @ J.T, np.array([1.0, 1.0, EARTH, EARTH, EARTH])
    known = still.model_copy(update={"imu": SENSORS.model_copy(update=quiet)})
    covariance = covariance_at_rest(UP, REST_S, known) - of_earth
    assert covariance / np.outer(size, size) == pytest.approx(expected / np.outer(size, size), rel=1e-6, abs=1e-13)


def test_scale_and_mounting_of_the_accelerometers_do_not_matter():
    """A scale error of all three, and readings of an IMU that is mounted on its side."""
    mounted = SENSORS.model_copy(update={"mounting": Mounting(rpy_rad=(0.0, 0.0, np.pi / 2))})
    imu, turn = rest(NOISELESS, noise=0.0), Rotation.from_euler("z", -np.pi / 2)
    turned = Imu(imu.stamps_ns, turn.apply(imu.angular_velocity), 1.04 * turn.apply(imu.specific_force))
    found, expected = (
        align_at_rest(rows, Calibration(imu=sensors, earth_rate_latitude_rad=LATITUDE))
        for rows, sensors in ((turned, mounted), (imu, SENSORS))
    )
    assert error_of(found) == pytest.approx(error_of(expected), abs=1e-12)
    assert found.covariance == pytest.approx(expected.covariance, rel=1e-9)


def sway(imu: Imu) -> np.ndarray:
    return np.sin(2 * np.pi * 0.3 * imu.stamps_ns * 1e-9)[:, None]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda imu: changed(imu, force=0.02 * sway(imu)), "Imu.specific_force: varies"),
        (lambda imu: changed(imu, rate=0.001 * sway(imu) * [1, 0, 0]), "Imu.angular_velocity: varies"),
        (lambda imu: changed(imu, rate=[0, 0, 0.05]), "turns at 0.05"),
        (lambda imu: changed(imu, times=1 / G), "check its unit"),
        (lambda imu: changed(imu, force=np.nan), "needs accelerometers"),
        (lambda imu: imu.rows((imu.stamps_ns < 5e9) | (imu.stamps_ns > 7e9)), "without a row"),
        (lambda imu: imu.rows(slice(0, 50)), "too short"),
        (lambda imu: imu.rows(slice(0, 1)), "too short"),
        (lambda imu: changed(imu, force=np.array([-G, 0, 0]) - imu.specific_force), "nose points straight"),
    ],
)
def test_what_is_no_rest_is_refused(spoil, message):
    imu = rest(np.random.default_rng(5))
    assert not refusal(imu)
    assert message in refusal(spoil(imu))


def noisy(seed: int, rest_s: float = 20.0, times: float = 1.0) -> Imu:
    """Noise of so many times the density that is known."""
    return rest(np.random.default_rng(seed), noise=times, rest_s=rest_s)


def refusal(imu: Imu, known: Calibration = KNOWN, log: Dvl | None = None) -> str:
    try:
        align_at_rest(imu, known, log)
    except AlignmentError as error:
        return str(error)
    return ""


def test_two_seconds_are_enough_and_less_are_not():
    """From the first to the last of the samples."""
    assert not refusal(noisy(0, 2.0 + 1 / HZ))
    assert "2.0 s of IMU is too short; give 2 s" in refusal(noisy(0, 2.0))


def test_a_quarter_of_a_second_without_a_row_is_no_hole_and_more_is():
    imu, seconds = noisy(1), noisy(1).stamps_ns * 1e-9
    assert not refusal(imu.rows((seconds < 5.01) | (seconds > 5.23)))
    assert "0.28 s without a row" in refusal(imu.rows((seconds < 5.01) | (seconds > 5.27)))


def test_half_more_noise_than_known_is_let_pass_even_where_chance_adds_to_it():
    """20 s are 39 blocks: 114 squares sum to 1.76 times their number once in a million, and 1.5 sqrt(1.76) is 1.99."""
    assert not any(refusal(noisy(seed, times=1.7)) for seed in range(20))
    assert all(refusal(noisy(seed, times=2.5)) for seed in range(20))


def test_a_last_sample_alone_is_no_mean():
    """3.5 sigmas of a single sample would be 18 of a block's mean."""
    imu = rest(NOISELESS, noise=0.0, rest_s=2.0 + 1 / HZ)
    imu.specific_force[-1] += 3.5 * SENSORS.accel_noise_density * np.sqrt(HZ)
    assert not refusal(imu)


@pytest.mark.parametrize("block", [0, 7])
def test_a_push_of_half_a_second_is_noticed_in_the_first_block_too(block):
    imu = noisy(2)
    push = 0.1 * np.outer(imu.stamps_ns // 500_000_000 == block, [1, 0, 0])
    assert "Imu.specific_force: varies" in refusal(changed(imu, force=push))


def test_a_rest_turns_by_a_bias_at_most_and_feels_gravity_but_for_a_twentieth():
    imu = rest(NOISELESS, noise=0.0)
    for rate, rests in ((0.019, True), (0.021, False), (-0.021, False)):
        assert (not refusal(changed(imu, rate=[0.0, rate, 0.0] - GYRO_BIAS))) == rests
    for share, rests in ((0.96, True), (1.04, True), (0.94, False), (1.06, False), (9.8, False)):
        assert (not refusal(changed(imu, times=share))) == rests


def doppler(seconds: list[float], velocity: object) -> Dvl:
    return dvl(np.round(np.array(seconds) * 1e9).astype(np.int64), velocity)


def test_a_speed_is_none_within_five_sigmas_of_its_mean():
    """By hand: 0.02 + 5 sqrt(3) 0.05 / sqrt(n) m/s is 0.27 of three rows and 0.145 of twelve."""
    known = Calibration(imu=SENSORS, dvl=DvlCalibration(velocity_sigma_m_s=(0.05,) * 3))
    for rows, speed, rests in ((3, 0.26, True), (3, 0.28, False), (12, 0.14, True), (12, 0.15, False)):
        log = doppler(np.linspace(1, 9, rows).tolist(), [0.6 * speed, 0.0, -0.8 * speed])
        assert (not refusal(noisy(3), known, log)) == rests


def test_velocities_count_from_the_first_to_the_last_of_the_rest():
    for second, rests in ((-0.01, True), (0.0, False), (19.98, False), (19.99, True)):
        assert (not refusal(noisy(3), KNOWN, doppler([second], [0.5, 0.0, 0.0]))) == rests
