"""Sensors feel the true motion, plus exactly the errors of the calibration."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import (
    DepthCalibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
)
from sonar_graph.measurements import Floats, Ints
from sonar_graph.simulation import sensors
from sonar_graph.simulation.vehicle import VehiclePath, smooth_noise

G = 9.80665
SECONDS = np.linspace(0, 60, 121)
EXACT_IMU = ImuCalibration(
    gyro_noise_density=0,
    gyro_bias_sigma=0,
    gyro_bias_walk_density=0,
    accel_noise_density=0,
    accel_bias_sigma=0,
)
SKEWED = Mounting(translation_m=(0.3, -0.2, 0.1), rpy_rad=(0.3, -0.4, 0.8))


SWAY = np.array([1.0, 1.0, 0.3, 0.3, 0.3, 1.0])


PATH = VehiclePath.through(
    SECONDS, smooth_noise(SECONDS, SWAY, 4.0, 6, np.random.default_rng(2))
)


STILL = VehiclePath.through(SECONDS, np.zeros((121, 6)))


def point_on(seconds: Floats, lever_m: tuple[float, float, float]) -> Floats:
    """Place of a point of the moving vehicle."""
    motion = PATH.at(seconds)
    return motion.position + motion.world_R_body.apply(lever_m)


def imu_of(
    rate_hz: float, duration_s: float, seed: int, **stated: float
) -> tuple[Floats, Floats]:
    """Errors of angular velocity and specific force at rest."""
    stamps_ns = sensors.regular_stamps(rate_hz, duration_s)
    calibration = EXACT_IMU.model_copy(update=stated)
    rng = np.random.default_rng(seed)
    imu = sensors.simulate_imu(STILL, stamps_ns, calibration, G, rng)
    return imu.angular_velocity, imu.specific_force - [0, 0, G]


def test_sensors_on_a_lever_arm_feel_that_points_velocity_and_acceleration():
    middle = np.linspace(5, 55, 31)
    motion = PATH.at(middle)
    sensor_R_body = Rotation.from_euler("ZYX", SKEWED.rpy_rad[::-1]).inv()
    places = [point_on(middle + d, SKEWED.translation_m) for d in (-1e-3, 0, 1e-3)]
    acceleration = np.diff(places, 2, axis=0)[0] / 1e-3**2 + [0, 0, G]
    places = [point_on(middle + d, SKEWED.translation_m) for d in (-1e-4, 1e-4)]
    velocity = np.diff(places, axis=0)[0] / 2e-4

    def felt(mounting: Mounting) -> tuple[Floats, Floats]:
        force = sensors.imu_readings(motion, mounting, G)[1]
        return force, sensors.dvl_readings(motion, mounting)

    at_body = felt(Mounting(rpy_rad=SKEWED.rpy_rad))
    truth = acceleration, velocity
    for found, other, true, atol in zip(
        felt(SKEWED), at_body, truth, (1e-5, 1e-7), strict=True
    ):
        expected = sensor_R_body.apply(motion.world_R_body.inv().apply(true))
        np.testing.assert_allclose(found, expected, atol=atol)
        assert np.abs(other - expected).max() > 0.01


def assert_sigma(samples: Floats, sigma: float, probability: float = 0.9999) -> None:
    """Two-sided: neither too small nor too large, and white."""
    n = samples.size
    low, high = stats.chi2.interval(probability, n)
    assert low < np.sum((samples / sigma) ** 2) < high
    assert abs(samples.mean()) < 4 * sigma / np.sqrt(n)
    assert abs(np.mean(samples[1:] * samples[:-1])) < 4 * sigma**2 / np.sqrt(n)


@pytest.mark.parametrize("rate_hz", [50.0, 200.0])
def test_imu_white_noise_has_the_stated_density_at_any_rate(rate_hz):
    stated = {"gyro_noise_density": 2e-3, "accel_noise_density": 5e-3}
    errors = imu_of(rate_hz, 60, 5, **stated)
    for of_sensor, density in zip(errors, stated.values(), strict=True):
        for axis in of_sensor.T:
            assert_sigma(axis, density * np.sqrt(rate_hz))


def test_biases_are_drawn_with_their_sigmas_and_stay_constant_without_walk():
    stated = {"gyro_bias_sigma": 3e-3, "accel_bias_sigma": 0.02}
    errors = np.array([imu_of(10, 2, seed, **stated) for seed in range(200)])
    for bias, sigma in zip(np.moveaxis(errors, 1, 0), stated.values(), strict=True):
        np.testing.assert_allclose(bias, bias[:, :1] + 0 * bias, atol=1e-8)
        assert_sigma(bias[:, 0].ravel(), sigma)


def test_gyro_bias_walks_with_the_root_of_time():
    walk = np.array(
        [imu_of(20, 50, seed, gyro_bias_walk_density=1e-3)[0] for seed in range(200)]
    )
    np.testing.assert_allclose(walk[:, 0], 0, atol=1e-9)
    for second in (5, 20, 50):
        assert_sigma(walk[:, 20 * second].ravel(), 1e-3 * np.sqrt(second))


def test_dvl_noise_has_its_covariance_and_scale_errors_stretch_it():
    sigmas = (0.004, 0.008, 0.016)
    calibration = DvlCalibration(velocity_sigma_m_s=sigmas, mounting=SKEWED)
    stamps = sensors.regular_stamps(100, 60)
    exact = sensors.dvl_readings(PATH.at(sensors.seconds_since_start(stamps)), SKEWED)
    rng = np.random.default_rng(6)
    dvl = sensors.simulate_dvl(PATH, stamps, calibration, rng)
    np.testing.assert_allclose(np.sqrt(np.diag(dvl.velocity_cov[-1])), sigmas)
    for error, sigma in zip((dvl.velocity - exact).T, sigmas, strict=True):
        assert_sigma(error, sigma)
    quiet = calibration.model_copy(update={"velocity_sigma_m_s": (1e-15,) * 3})
    stretched = sensors.simulate_dvl(PATH, stamps, quiet, rng, scale_error=0.05)
    np.testing.assert_allclose(stretched.velocity, 1.05 * exact, atol=1e-12)


def test_dvl_dropouts_leave_gaps_of_their_length_at_their_rate():
    path = VehiclePath.through(60.0 * SECONDS, np.zeros((121, 6)))
    stamps = sensors.regular_stamps(7, 3600)

    def stamps_with(**faults: float) -> Ints:
        rng = np.random.default_rng(8)
        rows = sensors.simulate_dvl(path, stamps, DvlCalibration(), rng, **faults)
        return rows.stamps_ns

    assert len(stamps_with()) == len(stamps)
    # the run covers the same time
    lost = stamps_with(dropouts_per_hour=1e5)
    assert lost.tolist() == stamps[[0, -1]].tolist()
    faulty = stamps_with(dropouts_per_hour=60, dropout_s=5.0)
    # A sample is lost when a Poisson event lies within the 5 s before it.
    share = 1 - np.exp(-60 * 5 / 3600)
    assert 1 - len(faulty) / len(stamps) == pytest.approx(share, abs=0.03)
    gaps_s = np.diff(faulty) * 1e-9
    assert gaps_s[gaps_s > 0.2].min() > 4.9


def test_depth_is_the_height_of_the_port_with_the_stated_noise():
    calibration = DepthCalibration(sigma_m=0.02, port_m=(0.5, -0.3, 0.4))
    stamps = sensors.regular_stamps(50, 60)
    depth = sensors.simulate_depth(PATH, stamps, calibration, np.random.default_rng(9))
    seconds = sensors.seconds_since_start(stamps)
    assert_sigma(depth.z_m - point_on(seconds, calibration.port_m)[:, 2], 0.02)
    np.testing.assert_allclose(depth.variance_m2, 0.0004)
    assert np.std(depth.z_m - PATH.at(seconds).position[:, 2]) > 0.05
