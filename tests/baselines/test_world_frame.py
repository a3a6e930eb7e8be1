"""Laws of what is observable: world frame, heading and gyro bias."""

import numpy as np
from numpy.testing import assert_allclose

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


@slam_filters
def test_a_robot_at_rest_learns_a_heading_only_in_the_plain_filter(kind):
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
