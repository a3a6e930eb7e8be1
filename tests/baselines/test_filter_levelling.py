"""Laws of gravity, depth and plane, and of the weight of measurements in a gap."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Start,
)
from sonar_graph.sequence import Sequence
from sonar_graph.states import Outcome

from .runs import (
    NO_FORCE,
    STANDARD_FORCE,
    dvl,
    estimate_after,
    height_and_tilt,
    imu,
    in_a_gap,
    later,
    run,
    seen,
    slam_filters,
)


@slam_filters
@pytest.mark.parametrize("is_felt", [True, False])
def test_gravity_tells_roll_and_pitch_and_nothing_else_does(kind, is_felt):
    """Start level, lie tilted."""
    R = np.array(Start(rpy_rad=(0.1, -0.07, 0.0)).pose().rotation().matrix())
    rows = imu(20, force=R.T @ STANDARD_FORCE if is_felt else NO_FORCE), dvl(20)
    estimate = estimate_after(
        kind, Calibration(start=Start(rpy_sigma_rad=(0.2, 0.2, 1e-3))), 20, *rows
    )
    sigma = np.sqrt(np.diag(estimate.covariance)[:2])
    expected = [0.1, -0.07] if is_felt else [0.0, 0.0]
    assert_allclose(
        estimate.world_T_body.rotation().rpy()[:2],
        expected,
        atol=1e-3 if is_felt else 1e-9,
    )
    assert sigma.max() < 2.5e-3 if is_felt else sigma.min() > 0.19


@slam_filters
def test_gravity_counts_once_an_interval_with_its_own_variance(kind):
    """At rest: after n intervals a wide prior has become ``sigma^2 / n``, sigma that of one direction."""
    seconds = 10
    noise = 0.02
    known = {
        "gyro_noise_density": 1e-9,
        "gyro_bias_sigma": 0.0,
        "accel_bias_sigma": 0.0,
    }
    calibration = Calibration(
        imu=ImuCalibration(accel_noise_density=noise, **known),
        dvl=DvlCalibration(velocity_sigma_m_s=(1e-6, 1e-6, 1e-6)),
        start=Start(rpy_sigma_rad=(1.0, 1.0, 1e-3)),
    )
    slam = run(kind, Sequence("at rest", calibration, imu(seconds), dvl(seconds)))
    assert_allclose(
        height_and_tilt(slam)[2],
        noise**2 / calibration.gravity_m_s2**2 / seconds,
        rtol=1e-3,
    )


@slam_filters
def test_gravity_has_the_velocity_noise_of_both_ends_of_its_interval(kind):
    """At rest for one interval of a second, a Doppler log that grows ten times as exact, and a wide prior."""
    known = {
        "gyro_noise_density": 1e-9,
        "gyro_bias_sigma": 0.0,
        "accel_bias_sigma": 0.0,
        "accel_noise_density": 1e-9,
    }
    calibration = Calibration(
        imu=ImuCalibration(**known), start=Start(rpy_sigma_rad=(1.0, 1.0, 1e-3))
    )
    doppler = dvl(1)
    variances = np.array([4e-4] + [4e-6] * 5)
    doppler = replace(doppler, velocity_cov=variances[:, None, None] * np.eye(3))
    slam = run(kind, Sequence("at rest", calibration, imu(1.1), doppler))
    expected = (variances[0] + variances[-1]) / calibration.gravity_m_s2**2
    assert_allclose(height_and_tilt(slam)[2], expected, rtol=1e-3)


@slam_filters
def test_detections_in_a_gap_count_less_and_after_it_in_full(kind):
    """``k (k + 1)`` times the motion's covariance, which is nearly all of the innovation's."""
    sequence = in_a_gap(
        detections=seen(later(1.5, 9.0, 9.001, 13.0, 13.1, 21.0), 3.0, 0.0)
    )
    log = run(kind, sequence).detections()
    assert log.outcomes == [Outcome.NEW, *[Outcome.USED] * 5]
    variances = log.innovation_covs[:, 0, 0]
    assert variances[2] / variances[1] == pytest.approx(3.0, rel=0.01)
    assert variances[4] < 1e-3 * variances[1]
    assert variances[5] == pytest.approx(variances[1], rel=0.01), (
        "the next gap counts anew"
    )
