"""Sensors feel the true motion, plus exactly the errors of the calibration."""

import gtsam
import numpy as np
import pytest
from scipy import stats

from sonar_graph.calibration import (
    DepthCalibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
)
from sonar_graph.measurements import Floats
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


def moving() -> VehiclePath:
    wander = smooth_noise(
        SECONDS,
        np.array([1.0, 1.0, 0.3, 0.3, 0.3, 1.0]),
        4.0,
        6,
        np.random.default_rng(2),
    )
    return VehiclePath.through(SECONDS, wander)


def still(
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0), duration_s: float = 60.0
) -> VehiclePath:
    return VehiclePath.through(
        np.linspace(0, duration_s, 121), np.tile([1.0, 2.0, -1.0, *rpy], (121, 1))
    )


def imu_of(
    calibration: ImuCalibration, rate_hz: float, duration_s: float, seed: int
) -> tuple[Floats, Floats]:
    """Errors of angular velocity and specific force at rest."""
    stamps_ns = sensors.regular_stamps(rate_hz, duration_s)
    imu = sensors.simulate_imu(
        still(), stamps_ns, calibration, G, np.random.default_rng(seed)
    )
    return imu.angular_velocity, imu.specific_force - [0, 0, G]


def points_of_mounting(
    path: VehiclePath, seconds: Floats, lever: tuple[float, float, float]
) -> Floats:
    motion = path.at(seconds)
    return motion.position + motion.world_R_body.apply(lever)


def test_sensors_on_a_lever_arm_feel_that_points_velocity_and_acceleration():
    path = moving()
    middle = np.linspace(5, 55, 31)
    motion = path.at(middle)
    no_lever = Mounting(rpy_rad=SKEWED.rpy_rad)
    world_R_sensor = (
        motion.world_R_body.as_matrix() @ gtsam.Rot3.RzRyRx(*SKEWED.rpy_rad).matrix()
    )
    before, at, after = (
        points_of_mounting(path, middle + d, SKEWED.translation_m)
        for d in (-1e-3, 0, 1e-3)
    )
    acceleration = (after - 2 * at + before) / 1e-3**2 + np.array([0, 0, G])
    before, after = (
        points_of_mounting(path, middle + d, SKEWED.translation_m)
        for d in (-1e-4, 1e-4)
    )
    for exact, expected, atol in (
        (
            lambda mounting: sensors.imu_readings(motion, mounting, G)[1],
            acceleration,
            1e-5,
        ),
        (
            lambda mounting: sensors.dvl_readings(motion, mounting),
            (after - before) / 2e-4,
            1e-7,
        ),
    ):
        expected = np.einsum("nji,nj->ni", world_R_sensor, expected)
        np.testing.assert_allclose(exact(SKEWED), expected, atol=atol)
        assert np.abs(exact(no_lever) - expected).max() > 0.01


def assert_sigma(samples: Floats, sigma: float, probability: float = 0.9999) -> None:
    """Two-sided: neither too small nor too large, and white."""
    n = samples.size
    low, high = stats.chi2.interval(probability, n)
    assert low < np.sum((samples / sigma) ** 2) < high
    assert abs(samples.mean()) < 4 * sigma / np.sqrt(n)
    assert abs(np.mean(samples[1:] * samples[:-1])) < 4 * sigma**2 / np.sqrt(n)


@pytest.mark.parametrize("rate_hz", [50.0, 200.0])
def test_imu_white_noise_has_the_stated_density_at_any_rate(rate_hz: float):
    calibration = EXACT_IMU.model_copy(
        update={"gyro_noise_density": 2e-3, "accel_noise_density": 5e-3}
    )
    for errors, density in zip(
        imu_of(calibration, rate_hz, 60, 5), (2e-3, 5e-3), strict=True
    ):
        for axis in errors.T:
            assert_sigma(axis, density * np.sqrt(rate_hz))


def test_biases_are_drawn_with_their_sigmas_and_stay_constant_without_walk():
    calibration = EXACT_IMU.model_copy(
        update={"gyro_bias_sigma": 3e-3, "accel_bias_sigma": 0.02}
    )
    gyro, accel = map(
        np.array,
        zip(*(imu_of(calibration, 10, 2, seed) for seed in range(200)), strict=True),
    )
    for bias, sigma in ((gyro, 3e-3), (accel, 0.02)):
        np.testing.assert_allclose(bias, bias[:, :1] + np.zeros_like(bias), atol=1e-8)
        assert_sigma(bias[:, 0].ravel(), sigma)


def test_gyro_bias_walks_with_the_root_of_time():
    calibration = EXACT_IMU.model_copy(update={"gyro_bias_walk_density": 1e-3})
    walk = np.array([imu_of(calibration, 20, 50, seed)[0] for seed in range(200)])
    np.testing.assert_allclose(walk[:, 0], 0, atol=1e-9)
    for second in (5, 20, 50):
        assert_sigma(walk[:, 20 * second].ravel(), 1e-3 * np.sqrt(second))


def test_dvl_noise_has_its_covariance_and_scale_errors_stretch_it():
    calibration = DvlCalibration(
        velocity_sigma_m_s=(0.004, 0.008, 0.016), mounting=SKEWED
    )
    path = moving()
    stamps = sensors.regular_stamps(100, 60)
    exact = sensors.dvl_readings(path.at(sensors.seconds_since_start(stamps)), SKEWED)
    dvl = sensors.simulate_dvl(path, stamps, calibration, np.random.default_rng(6))
    for axis in range(3):
        assert_sigma(
            (dvl.velocity - exact)[:, axis],
            float(np.sqrt(dvl.velocity_cov[0, axis, axis])),
        )
    np.testing.assert_allclose(
        np.sqrt(np.diag(dvl.velocity_cov[-1])), calibration.velocity_sigma_m_s
    )
    quiet = calibration.model_copy(update={"velocity_sigma_m_s": (1e-15, 1e-15, 1e-15)})
    stretched = sensors.simulate_dvl(
        path, stamps, quiet, np.random.default_rng(0), scale_error=0.05
    )
    np.testing.assert_allclose(stretched.velocity, 1.05 * exact, atol=1e-12)


def test_dvl_dropouts_leave_gaps_of_their_length_at_their_rate():
    path = still(duration_s=3600.0)
    stamps = sensors.regular_stamps(7, 3600)
    faulty, whole, lost = (
        sensors.simulate_dvl(
            path, stamps, DvlCalibration(), np.random.default_rng(8), **faults
        )
        for faults in (
            {"dropouts_per_hour": 60, "dropout_s": 5.0},
            {},
            {"dropouts_per_hour": 1e5},
        )
    )
    assert len(whole) == len(stamps)
    # the run covers the same time
    assert lost.stamps_ns.tolist() == stamps[[0, -1]].tolist()
    # A sample is lost when a Poisson event lies within the 5 s before it.
    assert 1 - len(faulty) / len(stamps) == pytest.approx(
        1 - np.exp(-60 * 5 / 3600), abs=0.03
    )
    gaps_s = np.diff(faulty.stamps_ns) * 1e-9
    assert gaps_s[gaps_s > 0.2].min() > 4.9


def test_depth_is_the_height_of_the_port_with_the_stated_noise():
    calibration = DepthCalibration(sigma_m=0.02, port_m=(0.5, -0.3, 0.4))
    path = moving()
    stamps = sensors.regular_stamps(50, 60)
    depth = sensors.simulate_depth(path, stamps, calibration, np.random.default_rng(9))
    seconds = sensors.seconds_since_start(stamps)
    error = depth.z_m - points_of_mounting(path, seconds, calibration.port_m)[:, 2]
    assert_sigma(error, 0.02)
    np.testing.assert_allclose(depth.variance_m2, 0.0004)
    assert np.std(depth.z_m - path.at(seconds).position[:, 2]) > 0.05
