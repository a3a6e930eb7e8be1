"""Laws of prediction: paths, their covariances, biases and attitudes that come of motions alone."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from baselines.dead_reckoning import DeadReckoning
from baselines.ekf_slam import EkfSlam
from baselines.filter import motion_of
from sonar_graph.calibration import (
    Calibration,
    DepthCalibration,
    DvlCalibration,
    ImuCalibration,
    Start,
)
from sonar_graph.measurements import Measurements
from sonar_graph.states import Outcome

from .runs import (
    CIRCLE_S,
    CIRCLE_START,
    NO_FORCE,
    STANDARD_FORCE,
    begun,
    circle,
    circle_calibration,
    depths,
    dvl,
    estimate_after,
    every_filter,
    filters_with_bias,
    imu,
    later,
    seen,
)


@every_filter
def test_the_earth_s_rotation_is_removed_at_its_latitude(kind):
    latitude = 0.7
    earth = 7.292115e-5 * np.array([0.0, np.cos(latitude), np.sin(latitude)])
    felt = CIRCLE_START.pose().rotation().matrix().T @ earth
    rows = imu(CIRCLE_S, felt, NO_FORCE), dvl(CIRCLE_S)
    aware = circle_calibration().model_copy(
        update={"earth_rate_latitude_rad": latitude}
    )
    turned = [
        CIRCLE_START.pose()
        .between(estimate_after(kind, c, CIRCLE_S, *rows).world_T_body)
        .rotation()
        .rpy()
        for c in (aware, circle_calibration())
    ]
    assert np.abs(turned[0]).max() < 1e-9
    assert np.abs(turned[1]).max() > 5e-4


@every_filter
def test_the_start_s_covariance_is_that_of_its_perturbations(kind):
    """World-axis positions and angles, off the world's origin, come out as perturbations of the body."""
    start = Start(
        position_m=(10.0, -20.0, 3.0), rpy_rad=(0.2, -0.3, 2.0),
        position_sigma_m=(0.1, 0.02, 0.03), rpy_sigma_rad=(0.01, 0.02, 0.03),
    )  # fmt: skip
    calibration = Calibration(
        start=start,
        use_gravity=False,
        imu=ImuCalibration(gyro_noise_density=0.0, gyro_bias_sigma=0.0),
        dvl=DvlCalibration(velocity_sigma_m_s=(1e-9, 1e-9, 1e-9)),
    )
    covariance = estimate_after(kind, calibration, 1, imu(1), dvl(1)).covariance
    assert_allclose(covariance, start.covariance(), atol=1e-12)


@filters_with_bias
def test_a_bias_that_nothing_tells_widens_yaw_as_a_constant_and_a_walk_do(kind):
    def yaw_sigma(**noise):
        return np.sqrt(
            estimate_after(
                kind, circle_calibration(**noise), CIRCLE_S, *circle()
            ).covariance[2, 2]
        )

    none = yaw_sigma(gyro_bias_sigma=0.0, gyro_bias_walk_density=1.0)
    some = yaw_sigma(gyro_bias_sigma=1e-3, gyro_bias_walk_density=0.0)
    walking = yaw_sigma(gyro_bias_sigma=1e-3, gyro_bias_walk_density=1e-3)
    start_sigma = CIRCLE_START.rpy_sigma_rad[2]
    assert none == pytest.approx(
        np.hypot(1e-3 * np.sqrt(CIRCLE_S), start_sigma), rel=1e-3
    )
    assert some == pytest.approx(np.hypot(none, 1e-3 * CIRCLE_S), rel=1e-3)
    assert walking == pytest.approx(
        np.hypot(some, 1e-3 * np.sqrt(CIRCLE_S**3 / 3)), rel=0.02
    )


def test_dead_reckoning_ignores_detections_and_says_so():
    stamps_ns = later(*range(CIRCLE_S + 1))
    told = begun(DeadReckoning, circle_calibration())
    told.process(Measurements(int(stamps_ns[-1]), *circle(), None, seen(stamps_ns)))
    assert told.detections().outcomes == [Outcome.IGNORED] * (CIRCLE_S + 1)
    assert len(told.landmarks()) == 0


def test_a_gap_adds_what_an_unknown_gyro_bias_does_to_the_displacement():
    """``sigma^2 J J^T``, J the derivative of the displacement over the gap by the bias."""
    sigma = 0.01
    end_ns = later(3.0)
    slam = begun(
        EkfSlam,
        Calibration(use_gravity=False, imu=ImuCalibration(gyro_bias_sigma=sigma)),
    )
    gyro = imu(3, (0.05, -0.1, 0.2), STANDARD_FORCE + np.array([0.1, -0.2, 0.0]))
    covariance = slam.process(
        Measurements(end_ns, gyro, dvl(1, (0.4, 0.1, 0.0)))
    ).covariance

    motion = motion_of(slam.odometry.motion(slam.node_ns, end_ns, np.zeros(3)))
    J = motion.D[3:]
    motion.C[3:, 3:] += sigma**2 * J @ J.T
    expected = slam.pose_after(motion)[2]
    assert_allclose(covariance, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    # else the order would not be seen
    assert np.abs(J @ J.T - J.T @ J).max() > 0.05 * np.linalg.norm(J) ** 2
    assert sigma**2 * np.linalg.norm(J) ** 2 > 0.1 * np.trace(covariance[3:, 3:])


def test_a_pitch_beyond_the_vertical_is_told_before_the_prediction_folds_it_back():
    """A depth of a port ahead of the body lifts the pitch to 103 degrees in one update."""
    calibration = Calibration(
        use_gravity=False,
        depth=DepthCalibration(port_m=(1.0, 0.0, 0.0), sigma_m=0.01),
        start=Start(position_sigma_m=(1e-3,) * 3, rpy_sigma_rad=(1e-3, 1.0, 1e-3)),
    )
    slam = begun(EkfSlam, calibration)
    gyro = imu(6, force=NO_FORCE)
    still = dvl(6)
    seen = depths(np.array([later(1.3)]), -1.8)
    slam.process(Measurements(later(1.0), gyro, still))
    assert slam.withheld() == []
    slam.process(Measurements(later(3.0), depth=seen))
    (told,) = slam.withheld()
    assert told.startswith("pitch came to 103 deg")
