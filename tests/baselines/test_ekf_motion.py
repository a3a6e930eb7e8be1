from itertools import pairwise

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose

from baselines.ekf_motion import motion_since_node, motion_to_node, nothing_running
from baselines.ekf_prediction import VehicleModel
from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.dvl_preintegration import Preintegrator
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.sequence import NS_PER_S

T0_NS, SECONDS = 1_700_000_000 * NS_PER_S, 2.0
LEVER, GYRO_DENSITY = (-0.2, 0.1, -0.15), 1e-3
EARTH = (2e-3, -1e-3, 3e-3)
"""Turning fast enough to be seen."""
VEHICLE = VehicleModel(GYRO_DENSITY, LEVER, (0.0,) * 3, EARTH, (0.0,) * 3, 0, 0.0, 0.0, 9.8, False, 0.0, 1.0, 1.0)
X = np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.7])


@pytest.fixture(params=["linear", "hold-past"])
def odometry(request):
    """An IMU at 50 Hz, a DVL at 7 Hz that begins 13 ms later: some of its rows wait for the next IMU row."""
    rng = np.random.default_rng(2)
    imu_ns = T0_NS + np.arange(round(50 * SECONDS)) * (NS_PER_S // 50)
    dvl_ns = T0_NS + 13_000_000 + np.arange(round(7 * SECONDS) - 1) * (NS_PER_S // 7)
    rates, velocities = 0.3 * rng.normal(size=(len(imu_ns), 3)), rng.normal(size=(len(dvl_ns), 3))
    rows = Odometry(
        Calibration(
            imu=ImuCalibration(gyro_noise_density=GYRO_DENSITY),
            dvl=DvlCalibration(
                mounting=Mounting(translation_m=LEVER),
                velocity_sigma_m_s=(0.01, 0.02, 0.03),
                velocity_walk_density=5.0,
            ),
            odometry_interpolation=request.param,
        )
    )
    rows.add(Imu(imu_ns, rates, rates + 9.8), Dvl(dvl_ns, velocities, np.full((len(dvl_ns), 3, 3), np.nan)))
    return rows


def assert_preintegrated(motion, steps, x=X):
    """As the smoother's preintegration has it, its covariance turned into the node's axes."""
    earth = gtsam.Rot3.RzRyRx(x[3:]).matrix().T @ EARTH
    expected = Preintegrator(GYRO_DENSITY, np.array(LEVER)).integrate(steps, np.zeros(3), earth)
    turn = np.kron(np.eye(2), np.array(motion.dR))
    cov, rt = turn @ expected.covariance @ turn.T, np.array(motion.cov_rt)
    sigma = np.sqrt(np.diag(cov))
    assert_allclose(motion.dR, expected.i_T_j.rotation().matrix(), atol=1e-14)
    assert_allclose(motion.dp, expected.i_T_j.translation(), atol=1e-14)
    assert_allclose(motion.impulse, expected.mean_specific_force * expected.duration_s, rtol=1e-12)
    own = np.block([[np.array(motion.cov_tt), rt.T], [rt, np.array(motion.cov_rr)]])
    assert_allclose(own / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=1e-12)


def test_motion_to_a_node_is_the_preintegrated_one(odometry):
    nodes = odometry.nodes(0, T0_NS + 10 * NS_PER_S).tolist()
    for start_ns, node_ns in pairwise(nodes):
        motion = motion_to_node(odometry.columns(), VEHICLE, X, start_ns, node_ns)
        assert_preintegrated(motion, odometry.steps_between_nodes(start_ns, node_ns))


def instants(odometry):
    """Instants every 7 ms and on rows, each with its newest node."""
    stamps = np.concatenate(
        [np.arange(T0_NS + NS_PER_S // 5, T0_NS + NS_PER_S, 7_000_000), odometry.columns()[0][10:50]]
    )
    return [(int(odometry.newest_node(0, until)), until) for until in np.sort(stamps).tolist()]


def test_a_running_motion_is_the_preintegrated_one(odometry):
    """From one instant to the next, across nodes and DVL rows that come before they are nodes."""
    columns, running, waiting = odometry.columns(), nothing_running(), 0
    for node_ns, until_ns in instants(odometry):
        running, motion = motion_since_node(columns, VEHICLE, X, running, node_ns, until_ns)
        assert_preintegrated(motion, odometry.steps_since_node(node_ns, until_ns))
        waiting += columns[3][running.dvl_rows - 1] > node_ns
    assert waiting > 3


def test_a_running_motion_is_the_same_to_the_last_bit_as_one_from_the_node(odometry):
    columns, running = odometry.columns(), nothing_running()
    for node_ns, until_ns in instants(odometry):
        running, motion = motion_since_node(columns, VEHICLE, X, running, node_ns, until_ns)
        assert motion == motion_since_node(columns, VEHICLE, X, nothing_running(), node_ns, until_ns)[1]


def test_a_running_motion_begins_anew_when_the_attitude_that_turns_the_earth_rate_has_changed(odometry):
    columns, (node_ns, until_ns), turned = odometry.columns(), instants(odometry)[8], X + 0.3
    running, before = motion_since_node(columns, VEHICLE, X, nothing_running(), node_ns, until_ns - 1_000_000)
    _, motion = motion_since_node(columns, VEHICLE, turned, running, node_ns, until_ns)
    assert_preintegrated(motion, odometry.steps_since_node(node_ns, until_ns), turned)
    assert np.abs(np.array(before.dR) - np.eye(3)).max() > 1e-3
