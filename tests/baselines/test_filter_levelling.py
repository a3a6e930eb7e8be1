"""Laws of gravity, depth and plane, and of the weight of measurements in a gap."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sonar_graph.calibration import (
    Calibration,
    ImuCalibration,
    PlanarMotion,
    Start,
)
from sonar_graph.sequence import Sequence
from sonar_graph.states import Outcome, Refusal

from .runs import (
    STANDARD_FORCE,
    T0_NS,
    depths,
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
def test_an_accelerating_vehicle_is_not_taken_for_a_tilted_one(kind):
    seconds = 10
    acceleration = 0.2
    doppler = dvl(seconds, rate_hz=10)
    velocity = np.outer((doppler.stamps_ns - T0_NS) * 1e-9, [acceleration, 0.0, 0.0])
    force = STANDARD_FORCE + np.array([acceleration, 0.0, 0.0])
    rows = imu(seconds, force=force, rate_hz=100), replace(doppler, velocity=velocity)
    estimate = estimate_after(
        kind, Calibration(start=Start(rpy_sigma_rad=(0.05, 0.05, 1e-3))), seconds, *rows
    )
    assert_allclose(estimate.world_T_body.rotation().rpy(), 0.0, atol=1e-6)
    assert estimate.world_T_body.translation()[0] == pytest.approx(
        0.5 * acceleration * seconds**2, abs=1e-6
    )


@slam_filters
@pytest.mark.parametrize(
    ("seconds", "noise", "doppler_variances"),
    [(10, 0.02, [1e-12] * 51), (1, 1e-9, [4e-4] + [4e-6] * 5)],
    ids=["of the accelerometers", "of the Doppler log at both ends"],
)
def test_gravity_counts_once_an_interval_with_its_own_variance(
    kind, seconds, noise, doppler_variances
):
    """At rest: after n intervals of a second a wide prior has become ``sigma^2 / n``, sigma that of one direction."""
    known = {
        "gyro_noise_density": 1e-9,
        "gyro_bias_sigma": 0.0,
        "accel_bias_sigma": 0.0,
    }
    calibration = Calibration(
        imu=ImuCalibration(accel_noise_density=noise, **known),
        start=Start(rpy_sigma_rad=(1.0, 1.0, 1e-3)),
    )
    variances = np.array(doppler_variances)
    log = replace(dvl(seconds), velocity_cov=variances[:, None, None] * np.eye(3))
    slam = run(kind, Sequence("at rest", calibration, imu(seconds + 0.1), log))
    expected = noise**2 + variances[0] + variances[-1]
    assert_allclose(
        height_and_tilt(slam)[2],
        expected / calibration.gravity_m_s2**2 / seconds,
        rtol=1e-3,
    )


@slam_filters
def test_planar_motion_keeps_height_and_tilt(kind):
    calibration = Calibration(
        planar=PlanarMotion(z_m=0.5),
        start=Start(position_m=(0.0, 0.0, 0.5)),
        imu=ImuCalibration(gyro_noise_density=0.01),
        use_gravity=False,
    )
    rows = imu(10, (0.01, -0.01, 0.1)), dvl(10, (0.3, 0.0, 0.02))
    held = estimate_after(kind, calibration, 10, *rows).world_T_body
    assert abs(held.translation()[2] - 0.5) < 0.01
    assert np.abs(held.rotation().rpy()[:2]).max() < 0.005
    assert held.rotation().yaw() == pytest.approx(1.0, abs=0.01)


@slam_filters
def test_a_logged_depth_variance_goes_before_the_calibration_s(
    kind,
):
    depth_m = {
        variance: in_a_gap(depths(np.array([later(1.0)]), 1.0, variance))
        for variance in (1e6, math.nan, -1e6)
    }
    runs = [run(kind, sequence) for sequence in depth_m.values()]
    assert [height_and_tilt(slam)[0] for slam in runs] == pytest.approx(
        [0.0, 1.0, 0.0], abs=1e-3
    )
    assert [
        [row.reason for row in slam.refused_rows() if row.sensor == "depth"]
        for slam in runs
    ] == [
        [],
        [],
        [Refusal.UNSOUND],
    ]


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


@slam_filters
def test_landmarks_of_one_frame_in_a_gap_share_its_error(kind):
    """Each of n counts with ``n (n + 1)`` times the motion's covariance, however they are ordered."""
    known = later(1.5, 1.5, 1.5)
    azimuths = (0.0, 0.5, -0.5)
    variances = []
    for n in (1, 3):
        stamps_ns = np.concatenate([known, later(9.0, 9.0, 9.0)[:n]])
        rows = seen(stamps_ns, 3.0, [*azimuths, *azimuths[:n]])
        rows = replace(
            rows, candidate_ids=np.array([[3], [4], [5], [3], [4], [5]])[: len(rows)]
        )
        log = run(kind, in_a_gap(detections=rows)).detections()
        assert log.outcomes == [Outcome.NEW] * 3 + [Outcome.USED] * n
        variances.append(log.innovation_covs[3, 0, 0])
    assert variances[1] / variances[0] == pytest.approx(3 * 4 / 2, rel=0.01)
