"""Laws of what is observable: world frame, heading and gyro bias."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from baselines.invariant_ekf import InvariantEkf
from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    FloorPrior,
    ImuCalibration,
    SonarCalibration,
    Start,
)
from sonar_graph.evaluation.consistency import yaw_variances
from sonar_graph.sequence import Sequence
from sonar_graph.states import Outcome

from .runs import dvl, imu, later, run, seen, slam_filters


def started(sequence, **changes):
    """The same measurements with another start."""
    start = sequence.calibration.start.model_copy(update=changes)
    return replace(
        sequence, calibration=sequence.calibration.model_copy(update={"start": start})
    )


def test_the_world_s_frame_changes_nothing_but_the_frame(mission):
    turn = Rotation.from_euler("z", 2.0)
    shift = np.array([300.0, -200.0, 0.0])
    start = mission.calibration.start
    roll, pitch, yaw = start.rpy_rad
    moved = started(
        mission,
        position_m=tuple(turn.apply(start.position_m) + shift),
        rpy_rad=(roll, pitch, yaw + 2.0),
    )
    here = run(InvariantEkf, mission)
    there = run(InvariantEkf, moved)
    for one, other in (
        (here.trajectory(), there.trajectory()),
        (here.landmarks(), there.landmarks()),
    ):
        assert_allclose(other.positions, turn.apply(one.positions) + shift, atol=1e-6)
    into_body = (
        turn * here.trajectory().rotations()
    ).inv() * there.trajectory().rotations()
    assert_allclose(into_body.magnitude(), 0.0, atol=1e-7)
    assert_allclose(
        there.trajectory().covariances, here.trajectory().covariances, atol=1e-8
    )
    R = turn.as_matrix()
    assert_allclose(
        there.landmarks().covariances, R @ here.landmarks().covariances @ R.T, atol=1e-8
    )


@slam_filters
def test_a_robot_at_rest_learns_a_heading_only_in_the_plain_filter(
    kind,
):
    """Heading unknown to 0.3 rad. Julier and Uhlmann, "A counter example to the theory of SLAM", ICRA 2001."""
    rng = np.random.default_rng(0)
    t = later(*np.arange(0.2, 20.1, 0.2))
    calibration = Calibration(
        imu=ImuCalibration(gyro_noise_density=1e-7, gyro_bias_sigma=0.0),
        dvl=DvlCalibration(velocity_sigma_m_s=(1e-5, 1e-5, 1e-5)),
        start=Start(
            position_sigma_m=(1e-3, 1e-3, 1e-3), rpy_sigma_rad=(1e-3, 1e-3, 0.3)
        ),
        sonar=SonarCalibration(range_sigma_m=0.3, azimuth_sigma_rad=0.1),
        floor=FloorPrior(z_m=0.0, sigma_m=0.01),
    )
    detections = seen(
        t, 5.0 + 0.3 * rng.normal(size=len(t)), 0.4 + 0.1 * rng.normal(size=len(t))
    )
    slam = run(
        kind,
        Sequence("at rest", calibration, imu(20), dvl(20), None, detections),
        gate_probability=1.0,
    )
    assert slam.detections().outcomes.count(Outcome.USED) == len(t) - 1
    variances = yaw_variances(slam.trajectory())
    if kind is InvariantEkf:
        assert_allclose(variances, 0.3**2, rtol=1e-6)
    else:
        assert variances[-1] < min(0.95 * 0.3**2, variances[0])
