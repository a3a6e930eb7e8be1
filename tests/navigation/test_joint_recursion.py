"""What the loop does beyond slow turns on a resting Earth with sensors along the body's axes."""

import gtsam
import numpy as np
import pytest

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.preintegration.joint_preintegration import (
    DISPLACEMENT,
    ROTATION,
    JointMotion,
    JointPreintegrator,
)
from sonar_graph.navigation.preintegration.joint_recursion import RULES

from .joint_rows import ACCEL, GYRO, StepByStep, random_rows, step_by_step
from .rows import dvl, imu, stamps

BIAS = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.05])
EARTH = np.array([0.04, -0.07, 0.05])
"""A thousand times as fast, for its sign and axes to be seen."""
SIGMAS = (0.01, 0.02, 0.04)
every_rule = pytest.mark.parametrize("rule", sorted(RULES))


def ends(rows: tuple[Imu, Dvl]) -> tuple[int, int]:
    return int(rows[1].stamps_ns[0]), int(rows[1].stamps_ns[-1])


def with_doppler(rows: tuple[Imu, Dvl], velocity: np.ndarray, cov: np.ndarray) -> tuple[Imu, Dvl]:
    return rows[0], Dvl(rows[1].stamps_ns, velocity, np.broadcast_to(cov, (len(rows[1]), 3, 3)))


def assert_equals(motion: JointMotion, truth: StepByStep) -> None:
    expected = truth.covariance()
    sigmas = np.sqrt(np.diag(expected))
    assert np.allclose(motion.i_R_j.matrix(), truth.R, atol=1e-12)
    assert np.allclose(motion.velocity, truth.v, atol=1e-11)
    assert np.allclose(motion.position, truth.p, atol=1e-11)
    assert np.allclose(motion.displacement, truth.s, atol=1e-11)
    assert np.allclose(motion.covariance / np.outer(sigmas, sigmas), expected / np.outer(sigmas, sigmas), atol=1e-9)


@every_rule
@pytest.mark.parametrize("earth", [EARTH, -EARTH], ids=["east", "west"])
def test_earths_rotation_is_removed_step_by_step(rule, earth):
    rows = random_rows(11)
    motion = JointPreintegrator(GYRO, ACCEL, rule=rule).integrate(*rows, *ends(rows), BIAS, earth)
    assert_equals(motion, step_by_step(*rows, rule, BIAS, earth))


def test_attitude_on_a_turning_earth_is_what_is_left_of_the_gyros():
    """By hand: with constant rates w of the body and E of the Earth, ``R = Exp(-E t) Exp(w t)``."""
    rate, at = np.array([0.3, -0.5, 0.8]), stamps(500, 2.0)
    rows = imu(at, rate), dvl(at[::100], 0.0)
    motion = JointPreintegrator(GYRO, ACCEL).integrate(*rows, *ends(rows), None, EARTH)
    expected = gtsam.Rot3.Expmap(-2 * EARTH).compose(gtsam.Rot3.Expmap(2 * rate))
    assert motion.i_R_j.equals(expected, 1e-3)
    assert not motion.i_R_j.equals(gtsam.Rot3.Expmap(2 * rate), 0.1)


@every_rule
def test_a_fast_turn_is_exact_too(rule):
    """Steps of up to 0.4 rad, where the series of small angles no longer hold."""
    rows = random_rows(12, turn_rad_s=20.0)
    assert np.linalg.norm(rows[0].angular_velocity, axis=1).max() * 0.02 > 0.3
    motion = JointPreintegrator(GYRO, ACCEL, rule=rule).integrate(*rows, *ends(rows), BIAS)
    assert_equals(motion, step_by_step(*rows, rule, BIAS))


@every_rule
def test_gyro_noise_alone_spreads_every_rule_as_dead_reckoning(rule):
    """No other noise hides it."""
    rows = random_rows(13)
    rows = with_doppler(rows, rows[1].velocity, np.eye(3) * 1e-20)
    motion = JointPreintegrator(GYRO, 0.0, rule=rule).integrate(*rows, *ends(rows), BIAS)
    truth = step_by_step(*rows, rule, BIAS, accel_density=0.0)
    assert_equals(motion, truth)
    assert np.sqrt(np.trace(motion.covariance[DISPLACEMENT, DISPLACEMENT])) > 1e-4


@every_rule
def test_sensors_at_an_angle_are_rows_turned_into_the_body(rule):
    """Velocity and specific force as vectors, the covariance on both sides: its axes turn along. No long interval."""
    rows = random_rows(109)
    body_R_imu, body_R_dvl = gtsam.Rot3.RzRyRx(0.2, -0.4, 2.0), gtsam.Rot3.RzRyRx(3.0, 0.3, 0.8)
    A, B = body_R_imu.matrix(), body_R_dvl.matrix()
    own = Imu(rows[0].stamps_ns, rows[0].angular_velocity @ A, rows[0].specific_force @ A)
    log = with_doppler(rows, rows[1].velocity @ B, np.diag(np.square(SIGMAS)))[1]
    arms = np.array([0.3, -0.1, 0.2]), np.array([-0.2, 0.1, 0.4])
    mounts = gtsam.Pose3(body_R_imu, arms[0]), gtsam.Pose3(body_R_dvl, arms[1])
    mounted = JointPreintegrator(GYRO, ACCEL, body_T_imu=mounts[0], body_T_dvl=mounts[1], rule=rule)
    motion = mounted.integrate(own, log, *ends(rows), BIAS, EARTH)
    turned = with_doppler(rows, rows[1].velocity, B @ np.diag(np.square(SIGMAS)) @ B.T)
    assert_equals(motion, step_by_step(*turned, rule, BIAS, EARTH))
    assert np.array_equal(motion.body_p_imu, arms[0])
    assert np.array_equal(motion.body_p_dvl, arms[1])


@every_rule
def test_where_the_log_says_no_covariance_its_sigmas_hold_along_its_own_axes(rule):
    rows = random_rows(15)
    mounting = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.5, -0.3, 1.0), np.zeros(3))
    sensors = JointPreintegrator(GYRO, ACCEL, SIGMAS, body_T_dvl=mounting, rule=rule)
    said = np.where(np.arange(len(rows[1]))[:, None, None] % 2, np.diag(np.square(SIGMAS)), np.nan)
    B = mounting.rotation().matrix()
    motion = sensors.integrate(*with_doppler(rows, rows[1].velocity @ B, said), *ends(rows), BIAS)
    assert_equals(
        motion, step_by_step(*with_doppler(rows, rows[1].velocity, B @ np.diag(np.square(SIGMAS)) @ B.T), rule, BIAS)
    )


def test_a_calibration_gives_each_number_its_place():
    calibration = Calibration(
        imu=ImuCalibration(
            gyro_noise_density=GYRO,
            accel_noise_density=ACCEL,
            mounting=Mounting(translation_m=(0.1, 0.2, 0.3), rpy_rad=(0.2, -0.4, 2.0)),
        ),
        dvl=DvlCalibration(
            velocity_sigma_m_s=SIGMAS, mounting=Mounting(translation_m=(-0.1, 0.4, 0.0), rpy_rad=(3.0, 0.3, 0.8))
        ),
    )
    rows = random_rows(16)
    rows = with_doppler(rows, rows[1].velocity, np.full((3, 3), np.nan))
    imu_pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.2, -0.4, 2.0), np.array([0.1, 0.2, 0.3]))
    dvl_pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(3.0, 0.3, 0.8), np.array([-0.1, 0.4, 0.0]))
    for rule in RULES:
        actual, expected = (
            sensors.integrate(*rows, *ends(rows), BIAS)
            for sensors in (
                JointPreintegrator.from_calibration(calibration, rule),
                JointPreintegrator(GYRO, ACCEL, SIGMAS, imu_pose, dvl_pose, rule),
            )
        )
        assert np.allclose(actual.covariance, expected.covariance, rtol=1e-12, atol=0)
        assert np.allclose(actual.displacement, expected.displacement, atol=1e-14)
        assert np.allclose(actual.body_p_imu, (0.1, 0.2, 0.3))
        assert np.allclose(actual.body_p_dvl, (-0.1, 0.4, 0.0))
    assert np.allclose(expected.covariance[ROTATION, ROTATION], np.eye(3) * GYRO**2 * expected.duration_s)
