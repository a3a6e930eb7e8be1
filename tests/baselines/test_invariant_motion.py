import numpy as np
import pytest
from numpy.testing import assert_allclose

from baselines.filter_motion import (
    inflate_shared_motion_with_bias,
    motion_since_node_with_bias,
    motion_to_node_with_bias,
)
from baselines.filter_window import vehicle_model
from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.odometry import Odometry, motion_between_nodes
from sonar_graph.navigation.odometry import motion_since_node as provisional_motion
from sonar_graph.navigation.preintegration.motion import Preintegrator
from sonar_graph.navigation.preintegration.recursion import in_last_frame

NS = 1_000_000_000
T0_NS = 1_700_000_000 * NS
CALIBRATION = Calibration(
    imu=ImuCalibration(gyro_noise_density=1e-3, accel_noise_density=1e-2),
    dvl=DvlCalibration(velocity_sigma_m_s=(0.01, 0.02, 0.03), mounting=Mounting(translation_m=(-0.4, 0.1, -0.2))),
    earth_rate_latitude_rad=0.6,
)
VEHICLE = vehicle_model(CALIBRATION, 1.0)
ATTITUDE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
BIAS = np.array([0.01, -0.02, 0.03])


@pytest.fixture(scope="module")
def odometry():
    """Ten seconds of turning, with four of them without bottom lock."""
    seconds = np.arange(0, 10.001, 0.02)
    dvl_s = np.r_[0.01:4:0.15, 8.01:10:0.15]
    rate = 0.3 * np.column_stack([np.sin(1.1 * seconds), np.cos(0.7 * seconds), 0.5 + np.sin(0.3 * seconds)])
    force = np.column_stack([0.1 * np.sin(seconds), 0.1 * np.cos(seconds), 9.8 + 0 * seconds])
    velocity = np.column_stack([0.5 + 0.1 * np.sin(dvl_s), 0.1 * np.cos(dvl_s), 0.02 * dvl_s])
    rows = Odometry(CALIBRATION)
    imu_ns, dvl_ns = (T0_NS + np.round(s * NS).astype(np.int64) for s in (seconds, dvl_s))
    rows.add(Imu(imu_ns, rate, force), Dvl(dvl_ns, velocity, np.full((len(dvl_s), 3, 3), np.nan)))
    return rows


def earth():
    return ATTITUDE.T @ VEHICLE.earth_rate


def check_same(motion, expected):
    """Against preintegration for the other estimators, which gives all at the motion's end."""
    dR, dp, cov, D, impulse = in_last_frame(*motion)
    assert_allclose(dR, expected.i_T_j.rotation().matrix(), atol=1e-12)
    assert_allclose(dp, expected.i_T_j.translation(), atol=1e-12)
    assert_allclose(cov, expected.covariance, atol=1e-15, rtol=1e-9)
    assert_allclose(D, expected.D_bias, atol=1e-12)
    assert_allclose(impulse, expected.mean_specific_force * expected.duration_s, atol=1e-9)


@pytest.mark.parametrize("node", [3, 26])
def test_motion_to_a_node_is_that_of_every_estimator(odometry, node):
    """Between samples and over a gap, with bias, Earth rate and lever arm."""
    nodes = odometry.nodes(0, T0_NS + 10 * NS)
    start_ns, end_ns = nodes[node], nodes[node + 1]
    assert odometry.is_gap(start_ns, end_ns) == (node == 26)
    motion = motion_to_node_with_bias(odometry.columns(), VEHICLE, ATTITUDE, BIAS, start_ns, end_ns)
    preintegrator = Preintegrator.from_calibration(CALIBRATION)
    check_same(motion, motion_between_nodes(odometry, preintegrator, start_ns, end_ns, BIAS, earth()))


@pytest.mark.parametrize(("node", "later_s"), [(3, 0.07), (26, 2.5)])
def test_motion_since_a_node_is_that_of_every_estimator(odometry, node, later_s):
    start_ns = odometry.nodes(0, T0_NS + 10 * NS)[node]
    until_ns = start_ns + round(later_s * NS)
    motion = motion_since_node_with_bias(odometry.columns(), VEHICLE, ATTITUDE, BIAS, start_ns, until_ns)
    preintegrator = Preintegrator.from_calibration(CALIBRATION)
    check_same(motion, provisional_motion(odometry, preintegrator, start_ns, until_ns, BIAS, earth()))


def test_what_is_told_again_in_a_gap_counts_less_and_less(odometry):
    """``k (k + 1)`` times the covariance; mean and derivative stay."""
    start_ns, end_ns = odometry.nodes(0, T0_NS + 10 * NS)[26:28]
    motion = motion_to_node_with_bias(odometry.columns(), VEHICLE, ATTITUDE, BIAS, start_ns, end_ns)
    again = inflate_shared_motion_with_bias(motion, 3)
    assert_allclose(again.integral.cov_rr, 12 * np.array(motion.integral.cov_rr), rtol=1e-12)
    assert_allclose(again.integral.cov_tt, 12 * np.array(motion.integral.cov_tt), rtol=1e-12)
    assert (again.integral.dp, again.D_t, again.D_r) == (motion.integral.dp, motion.D_t, motion.D_r)
