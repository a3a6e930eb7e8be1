from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from baselines.dead_reckoning import DeadReckoning
from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting, Start
from sonar_graph.measurements import Dvl, Imu, LandmarkDetections, Measurements
from sonar_graph.sequence import NS_PER_S
from sonar_graph.states import Outcome
from sonar_graph.testing.laws import CHECKS

T0_NS = 1_700_000_000 * NS_PER_S
SECONDS, IMU_HZ, DVL_HZ = 20, 50, 5
YAW_RATE, SPEED = 0.1, 0.3
LEVER = np.array([0.2, 0.1, -0.3])
START = Start(position_m=(1.0, 2.0, -3.0), rpy_rad=(0.0, 0.0, 0.5))


def stamps(rate_hz):
    return T0_NS + np.arange(SECONDS * rate_hz + 1) * (NS_PER_S // rate_hz)


def calibration(**imu):
    return Calibration(
        imu=ImuCalibration(gyro_noise_density=1e-3, **imu),
        dvl=DvlCalibration(velocity_sigma_m_s=(0.02, 0.02, 0.02), mounting=Mounting(translation_m=tuple(LEVER))),
        start=START,
    )


def circle(gyro_error=0.0, velocity_error=0.0):
    """A level circle; the DVL off the centre of the body."""
    imu_ns, dvl_ns = stamps(IMU_HZ), stamps(DVL_HZ)
    rate, force = np.tile([0.0, 0.0, YAW_RATE], (len(imu_ns), 1)), np.full((len(imu_ns), 3), np.nan)
    swung = np.cross([0.0, 0.0, YAW_RATE], LEVER)
    velocity = np.tile(np.array([SPEED, 0.0, 0.0]) + swung, (len(dvl_ns), 1))
    no_cov = np.full((len(dvl_ns), 3, 3), np.nan)
    return Imu(imu_ns, rate + gyro_error, force), Dvl(dvl_ns, velocity + velocity_error, no_cov)


def circle_pose(seconds):
    turn = YAW_RATE * seconds
    chord = SPEED / YAW_RATE * np.array([np.sin(turn), 1 - np.cos(turn), 0.0])
    return START.pose().compose(gtsam.Pose3(gtsam.Rot3.Yaw(turn), chord))


def final(estimator, imu, dvl):
    return estimator.process(Measurements(int(stamps(1)[-1]), imu, dvl))


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_the_contract_is_kept(check):
    check(DeadReckoning)


def test_a_circle_is_a_circle():
    estimator, (imu, dvl) = DeadReckoning(calibration()), circle()
    for end_ns in stamps(2)[1:]:
        estimate = estimator.process(
            Measurements(int(end_ns), imu.between(T0_NS - 1, end_ns), dvl.between(T0_NS - 1, end_ns))
        )
        assert estimate.world_T_body.equals(circle_pose((end_ns - T0_NS) * 1e-9), 1e-9)


@pytest.mark.slow
def test_the_covariance_is_that_of_many_runs_with_a_constant_bias():
    bias_sigma, noise = 2e-3, 1e-3
    known = calibration(gyro_bias_sigma=bias_sigma, gyro_bias_walk_density=0.0)
    start = START.model_copy(update={"position_sigma_m": (1e-6,) * 3, "rpy_sigma_rad": (1e-6,) * 3})
    known = known.model_copy(update={"start": start})
    rng = np.random.default_rng(2)
    clean = circle()
    mean = final(DeadReckoning(known), *clean)
    errors = []
    for _ in range(600):
        gyro_error = bias_sigma * rng.normal(size=3) + noise * np.sqrt(IMU_HZ) * rng.normal(size=(len(clean[0]), 3))
        run = final(DeadReckoning(known), *circle(gyro_error, 0.02 * rng.normal(size=(len(clean[1]), 3))))
        between = mean.world_T_body.between(run.world_T_body)
        turn = Rotation.from_matrix(between.rotation().matrix()).as_rotvec()
        errors.append(np.concatenate([turn, between.translation()]))
    spread, sigma = np.cov(np.array(errors).T), np.sqrt(np.diag(mean.covariance))
    assert_allclose(spread / np.outer(sigma, sigma), mean.covariance / np.outer(sigma, sigma), atol=0.2)


def test_a_bias_that_is_not_there_is_not_considered():
    def yaw_sigma(**imu):
        return np.sqrt(final(DeadReckoning(calibration(**imu)), *circle()).covariance[2, 2])

    none = yaw_sigma(gyro_bias_sigma=0.0, gyro_bias_walk_density=1.0)
    some = yaw_sigma(gyro_bias_sigma=1e-3, gyro_bias_walk_density=0.0)
    walking = yaw_sigma(gyro_bias_sigma=1e-3, gyro_bias_walk_density=1e-3)
    assert none == pytest.approx(np.hypot(1e-3 * np.sqrt(SECONDS), 1e-3), rel=1e-3)
    assert some == pytest.approx(np.hypot(none, 1e-3 * SECONDS), rel=1e-3)
    assert walking == pytest.approx(np.hypot(some, 1e-3 * np.sqrt(SECONDS**3 / 3)), rel=0.02)


def test_the_earth_s_rotation_is_removed_at_its_latitude():
    latitude = 0.7
    still, rest = circle()
    earth = 7.292115e-5 * np.array([0.0, np.cos(latitude), np.sin(latitude)])
    felt = START.pose().rotation().matrix().T @ earth
    still = replace(still, angular_velocity=np.tile(felt, (len(still), 1)))
    rest = replace(rest, velocity=np.zeros_like(rest.velocity))
    aware = calibration().model_copy(update={"earth_rate_latitude_rad": latitude})
    turned = [
        START.pose().between(final(DeadReckoning(c), still, rest).world_T_body).rotation().rpy()
        for c in (aware, calibration())
    ]
    assert np.abs(turned[0]).max() < 1e-9
    assert np.abs(turned[1]).max() > 5e-4


def test_detections_are_ignored_and_told_so():
    imu, dvl = circle()
    seen = LandmarkDetections(
        stamps(1), np.ones(SECONDS + 1), np.zeros(SECONDS + 1), np.full((SECONDS + 1, 2, 2), np.nan),
        np.full((SECONDS + 1, 1), 3), np.ones((SECONDS + 1, 1)),
    )  # fmt: skip
    with_them, without = DeadReckoning(calibration()), DeadReckoning(calibration())
    end_ns = int(stamps(1)[-1])
    seeing = with_them.process(Measurements(end_ns, imu, dvl, None, seen))
    assert seeing.world_T_body.equals(without.process(Measurements(end_ns, imu, dvl)).world_T_body, 0.0)
    assert with_them.detections().outcomes == [Outcome.IGNORED] * (SECONDS + 1)
    assert len(with_them.landmarks()) == 0
