from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.preintegration.joint_preintegration import (
    ACCEL,
    DISPLACEMENT,
    GYRO,
    JointMotion,
    JointPreintegrator,
    with_rate_noise,
)
from sonar_graph.navigation.preintegration.joint_recursion import RULES

from .rows import NS, T0_NS, derivative, stamps
from .test_gaps import DVL, QUIET, Vehicle, at

IMU_HZ, GYRO_DENSITY, ACCEL_DENSITY, SIGMA = 100.0, 2e-4, 1e-4, 0.003
BODY_T_IMU, BODY_T_DVL = QUIET.mounting.pose(), DVL.mounting.pose()
ARM = BODY_T_DVL.translation() - BODY_T_IMU.translation()
SENSORS = JointPreintegrator(GYRO_DENSITY, ACCEL_DENSITY, (SIGMA,) * 3, BODY_T_IMU, BODY_T_DVL)
others = pytest.mark.parametrize("rule", sorted(set(RULES) - {"inertial"}))


def rows(*doppler_s: float) -> tuple[Imu, Dvl]:
    vehicle = Vehicle()
    dvl_ns = T0_NS + np.round(np.array(doppler_s) * NS).astype(np.int64)
    return vehicle.imu(stamps(IMU_HZ, doppler_s[-1] + 0.1)), vehicle.dvl(dvl_ns)


def whole(rows: tuple[Imu, Dvl], sensors: JointPreintegrator = SENSORS, bias: np.ndarray | None = None) -> JointMotion:
    return sensors.integrate(*rows, int(rows[1].stamps_ns[0]), int(rows[1].stamps_ns[-1]), bias)


@pytest.mark.parametrize("doppler_s", [(6.0, 11.0), (6.0, 36.0), (5.8, 6.0, 16.0, 16.2, 36.0), (6.0, 16.0, 26.0, 26.5)])
def test_a_vehicle_that_turns_is_where_it_is_however_far_the_samples_are_apart(doppler_s):
    """The log swings about the IMU; as if it did not, the way is wrong by a centimetre to a metre."""
    motion = whole(rows(*doppler_s))
    truth = Vehicle().displacement(doppler_s[0], doppler_s[-1])
    assert motion.relative_pose().i_T_j.translation() == pytest.approx(truth, abs=1e-3)
    at_one_point = JointPreintegrator(0.0, 0.0, body_T_dvl=gtsam.Pose3(BODY_T_DVL.rotation(), np.zeros(3)))
    swung = BODY_T_DVL.translation() - motion.i_R_j.matrix() @ BODY_T_DVL.translation()
    wrong = whole(rows(*doppler_s), at_one_point).displacement + swung - truth
    assert np.linalg.norm(wrong) > 0.01


def test_derivatives_over_long_intervals_equal_differences():
    samples, bias = rows(5.8, 6.0, 9.0, 9.2, 11.0), np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.05])
    motion = whole(samples, bias=bias)
    numerical = derivative(lambda change: whole(samples, bias=bias + change).displacement, 6, 1e-5)
    actual = motion.D_parameters[DISPLACEMENT]
    for columns in (GYRO, ACCEL):
        scale = np.abs(numerical[:, columns]).max()
        assert np.abs(actual[:, columns] - numerical[:, columns]).max() < 5e-4 * scale


@pytest.mark.parametrize("doppler_s", [(6.0, 16.0), (6.0, 7.0, 8.0, 9.0, 10.0)])
def test_covariance_over_long_intervals_is_that_of_many_noisy_runs(doppler_s):
    """With gyros as poor as those of a phone, and a long arm: their noise at the ends counts as the samples' does."""
    inertial, doppler = rows(*doppler_s)
    far = gtsam.Pose3(BODY_T_IMU.rotation(), BODY_T_IMU.translation() + np.array([0.0, 0.7, 0.0]))
    sensors = JointPreintegrator(1e-3, 1e-4, (SIGMA,) * 3, far, BODY_T_DVL)
    exact, rng, squares = whole((inertial, doppler), sensors), np.random.default_rng(3), []
    P = exact.covariance[DISPLACEMENT, DISPLACEMENT]
    for _ in range(400):
        noise = rng.standard_normal((2, len(inertial), 3)) * np.sqrt(IMU_HZ)
        rate, force = inertial.angular_velocity + 1e-3 * noise[0], inertial.specific_force + 1e-4 * noise[1]
        velocity = doppler.velocity + SIGMA * rng.standard_normal(doppler.velocity.shape)
        noisy = Imu(inertial.stamps_ns, rate, force), Dvl(doppler.stamps_ns, velocity, doppler.velocity_cov)
        error = whole(noisy, sensors).displacement - exact.displacement
        squares.append(error @ np.linalg.solve(P, error))
    assert 0.87 < np.mean(squares) / 3 < 1.13


def test_noise_of_the_rate_is_across_the_arm_at_the_ends_of_long_intervals_alone():
    dvl_ns, arm = rows(0.0, 0.2, 0.4, 2.0, 2.2)[1].stamps_ns, np.array([2.0, 0.0, 0.0])
    cov = with_rate_noise(np.zeros((5, 3, 3)), dvl_ns, stamps(IMU_HZ, 3.0), 1e-3, arm)
    expected = (2e-3) ** 2 * IMU_HZ * np.diag([0.0, 1.0, 1.0])
    assert np.allclose(cov, [0 * expected, 0 * expected, expected, expected, 0 * expected], atol=1e-18)


def test_a_chain_over_long_intervals_has_the_displacement_of_the_whole():
    samples = rows(6.0, 7.0, 9.0, 9.2, 12.0)
    first, second = (SENSORS.integrate(*samples, at(a), at(b)) for a, b in ((6.0, 9.0), (9.0, 12.0)))
    chained = first.displacement + first.i_R_j.matrix() @ second.displacement
    assert chained == pytest.approx(whole(samples).displacement, abs=1e-9)


def test_an_unknown_accelerometer_bias_counts_in_the_relative_pose():
    """As much as integrating with another bias on each axis moves it; over short intervals it hardly does."""
    sigma, exact = 5e-3, whole(rows(6.0, 16.0))
    plain, counted = exact.relative_pose(), exact.relative_pose(accel_bias_sigma=sigma)
    moved = [
        whole(rows(6.0, 16.0), bias=np.r_[0, 0, 0, sigma * axis]).relative_pose().i_T_j.translation()
        for axis in np.eye(3)
    ]
    offsets = np.column_stack([exact.i_R_j.unrotate(m - plain.i_T_j.translation()) for m in moved])
    expected = np.zeros((6, 6))
    expected[3:, 3:] = offsets @ offsets.T
    assert np.allclose(counted.covariance - plain.covariance, expected, rtol=1e-3, atol=1e-9)
    assert np.sqrt(np.trace(expected)) > 0.05
    short = whole(rows(*np.arange(6.0, 16.1, 0.2)))
    added = np.trace(short.relative_pose(sigma).covariance - short.relative_pose().covariance)
    assert added < 1e-4 * np.trace(short.relative_pose().covariance[3:, 3:])


@others
def test_rules_that_know_nothing_of_a_gap_refuse_it(rule):
    samples = rows(6.0, 6.2, 8.0, 8.2)
    sensors = JointPreintegrator(GYRO_DENSITY, ACCEL_DENSITY, rule=rule)
    with pytest.raises(MeasurementError, match=rf"no row for 1.8 s after {at(6.2)} ns.*longest_s \(1.5 s\).*inertial"):
        whole(samples, sensors)
    sensors.integrate(*samples, at(6.0), at(6.2))
    whole(samples, replace(sensors, longest_s=1.9))
    whole(samples)


@others
def test_a_calibration_says_what_a_gap_is(rule):
    calibration = Calibration(imu=ImuCalibration(), dvl=DvlCalibration(gap_s=0.7))
    sensors = JointPreintegrator.from_calibration(calibration, rule)
    whole(rows(6.0, 6.7), sensors)
    with pytest.raises(MeasurementError, match=r"longest_s \(0.7 s\)"):
        whole(rows(6.0, 6.8), sensors)


def turning(rate: np.ndarray, arm: tuple[float, float, float]) -> tuple[Imu, Dvl, JointPreintegrator]:
    """Nothing but rates, 20 Hz, and Doppler samples of zero at 0, 4 and 7 s."""
    inertial_ns, doppler_ns = stamps(20.0, 7.0), T0_NS + np.array([0, 4, 7]) * NS
    log = Dvl(doppler_ns, np.zeros((3, 3)), np.zeros((3, 3, 3)))
    sensors = JointPreintegrator(1e-3, 0.0, body_T_dvl=gtsam.Pose3(gtsam.Rot3(), np.array(arm)))
    return Imu(inertial_ns, rate * np.ones((len(inertial_ns), 3)), np.zeros((len(inertial_ns), 3))), log, sensors


def test_gyro_noise_spreads_the_swing_about_the_imu_as_noise_of_every_row_does():
    """Row by row by differences; to a tenth, since what a rate and the attitude share at an end is not counted."""
    inertial, log, sensors = turning(np.array([0.1, -0.2, 0.8]), (1.0, 0.2, -0.3))
    exact, expected = whole((inertial, log), sensors), np.zeros((3, 3))
    for row in range(len(inertial)):
        for axis in range(3):
            rate = inertial.angular_velocity.copy()
            rate[row, axis] += 1e-6
            moved = whole((Imu(inertial.stamps_ns, rate, inertial.specific_force), log), sensors)
            J = (moved.displacement - exact.displacement) / 1e-6
            expected += np.outer(J, J) * sensors.gyro_noise_density**2 * 20.0
    sigmas = np.sqrt(np.diag(expected))
    off = (exact.covariance[DISPLACEMENT, DISPLACEMENT] - expected) / np.outer(sigmas, sigmas)
    assert np.abs(off).max() < 0.1


def test_earths_rotation_swings_no_doppler_log():
    """At rest on the Earth gyros read its rate, and the log stays where it is."""
    earth = np.array([0.04, -0.07, 0.05])
    inertial, log, sensors = turning(earth, (1.0, 0.2, -0.3))
    ends = int(log.stamps_ns[0]), int(log.stamps_ns[-1])
    still = sensors.integrate(inertial, log, *ends, earth_rate=earth)
    assert np.abs(still.displacement).max() < 1e-12
