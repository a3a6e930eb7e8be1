from itertools import pairwise

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose

from baselines.filter_motion import (
    inflate_shared_motion,
    inflate_shared_motion_with_bias,
    motion_since_node,
    motion_since_node_with_bias,
    motion_to_node,
    motion_to_node_with_bias,
    no_provisional_motion,
    open_interval,
    up_at_node,
)
from baselines.filter_window import NODE, OPENED, GravityInterval, VehicleModel, vehicle_model
from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.measurements import NS_PER_S, Dvl, Imu
from sonar_graph.navigation import Preintegrator
from sonar_graph.navigation import odometry as node_motion
from sonar_graph.navigation.imu_gaps import NO_TURNS
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.navigation.preintegration.dvl_gaps import gap_values
from sonar_graph.navigation.preintegration.recursion import NO_MOTION, in_last_frame
from sonar_graph.numerics.jit import compiled
from sonar_graph.numerics.mat3 import matrix, vector

from .filters import motion_of, rotation

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
                mounting=Mounting(translation_m=LEVER), velocity_sigma_m_s=(0.01, 0.02, 0.03), velocity_walk_density=5.0
            ),
            odometry_interpolation=request.param,
        )
    )
    rows.add(Imu(imu_ns, rates, rates + 9.8), Dvl(dvl_ns, velocities, np.full((len(dvl_ns), 3, 3), np.nan)))
    return rows


def assert_preintegrated(motion, steps, x=X):
    """As the smoother's preintegration has it."""
    earth = gtsam.Rot3.RzRyRx(x[3:]).matrix().T @ EARTH
    assert_same_motion(motion, Preintegrator(GYRO_DENSITY, np.array(LEVER)).integrate(steps, np.zeros(3), earth))


def assert_same_motion(motion, expected):
    """The covariance of one turned into the axes of the other, those of the node."""
    turn = np.kron(np.eye(2), np.array(motion.dR))
    cov = turn @ expected.covariance @ turn.T
    sigma = np.sqrt(np.diag(cov))
    assert_allclose(motion.dR, expected.i_T_j.rotation().matrix(), atol=1e-14)
    assert_allclose(motion.dp, expected.i_T_j.translation(), atol=1e-14)
    assert_allclose(motion.impulse, expected.mean_specific_force * expected.duration_s, rtol=1e-12)
    assert_allclose(whole(motion) / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=1e-12)


def whole(motion) -> np.ndarray:
    """Covariance of [theta_i, eps]."""
    rt = np.array(motion.cov_rt)
    return np.block([[np.array(motion.cov_tt), rt.T], [rt, np.array(motion.cov_rr)]])


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


def test_a_running_motion_is_the_preintegrated_one_and_to_the_last_bit_the_one_from_the_node(odometry):
    """From one instant to the next, across nodes and DVL rows that come before they are nodes."""
    columns, running, waiting = odometry.columns(), no_provisional_motion(), 0
    for node_ns, until_ns in instants(odometry):
        running, motion = motion_since_node(columns, VEHICLE, X, running, node_ns, until_ns)
        assert_preintegrated(motion, odometry.steps_since_node(node_ns, until_ns))
        assert motion == motion_since_node(columns, VEHICLE, X, no_provisional_motion(), node_ns, until_ns)[1]
        waiting += columns[3][running.dvl_rows - 1] > node_ns
    assert waiting > 3


def test_a_running_motion_begins_anew_when_the_attitude_that_turns_the_earth_rate_has_changed(odometry):
    columns, (node_ns, until_ns), turned = odometry.columns(), instants(odometry)[8], X + 0.3
    running, before = motion_since_node(columns, VEHICLE, X, no_provisional_motion(), node_ns, until_ns - 1_000_000)
    _, motion = motion_since_node(columns, VEHICLE, turned, running, node_ns, until_ns)
    assert_preintegrated(motion, odometry.steps_since_node(node_ns, until_ns), turned)
    assert np.abs(np.array(before.dR) - np.eye(3)).max() > 1e-3


def test_measurements_over_one_gap_tell_ever_nearer_what_one_exact_one_would_and_never_more():
    """A telescoping sum by hand: ``1 / (k (k + 1)) = 1 / k - 1 / (k + 1)``, so that n of them tell ``n / (n + 1)``."""
    root = np.random.default_rng(4).normal(size=(6, 6))
    motion = motion_of(np.array([0.3, -0.2, 0.5, 1.0, 2.0, -0.5]), root @ root.T)
    told, n = np.zeros((6, 6)), 12
    for k in range(1, n + 1):
        again = inflate_shared_motion(motion, k)
        told += np.linalg.inv(whole(again))
        assert (again.dR, again.dp, again.impulse) == (motion.dR, motion.dp, motion.impulse)
        assert_allclose(told @ whole(motion), k / (k + 1) * np.eye(6), atol=1e-9)


LOST_S, FOUND_S = 1.0, 2.2


def lost(rate_error=(0.0, 0.0, 0.0), calibration=None):
    """Turning and surging without bottom lock for 1.2 s; gyros read an error."""
    imu_ns, dvl_ns = (T0_NS + np.arange(round(hz * 3)) * (NS_PER_S // hz) for hz in (50, 10))
    t, s = (imu_ns - T0_NS) / NS_PER_S, (dvl_ns - T0_NS) / NS_PER_S
    rates = np.column_stack([0.5 + 0.4 * np.sin(2 * t), 0.9 * np.cos(t), 0.8 + 0.0 * t])
    rates += np.array(rate_error)
    forces = np.column_stack([0.5 * np.cos(t), 0.3 * np.sin(2 * t), 9.8 + 0.2 * np.sin(t)])
    velocities = np.column_stack([0.5 * np.sin(s), 0.2 * np.cos(s), -0.3 * s])
    has_lock = (s <= LOST_S) | (s >= FOUND_S)
    rows = Odometry(calibration or Calibration())
    rows.add(
        Imu(imu_ns, rates, forces), Dvl(dvl_ns[has_lock], velocities[has_lock], np.full((has_lock.sum(), 3, 3), np.nan))
    )
    return rows


IMU_PLACE = (0.3, 0.1, -0.2)


def calibration_with_gaps(gap_s=0.5):
    return Calibration(
        imu=ImuCalibration(mounting=Mounting(translation_m=IMU_PLACE), gyro_noise_density=GYRO_DENSITY),
        dvl=DvlCalibration(mounting=Mounting(translation_m=LEVER), gap_s=gap_s),
    )


def vehicle_with_gaps(bias_sigma, gap_s=0.5):
    return VEHICLE._replace(gap=gap_values(calibration_with_gaps(gap_s)), gyro_bias_sigma=bias_sigma)


def over_gap(rows, vehicle, until_s, node_s=LOST_S):
    node_ns, until_ns = (T0_NS + round(s * NS_PER_S) for s in (node_s, until_s))
    if until_s >= FOUND_S:
        return motion_to_node(rows.columns(), vehicle, X, node_ns, until_ns)
    return motion_since_node(rows.columns(), vehicle, X, no_provisional_motion(), node_ns, until_ns)[1]


@pytest.mark.parametrize("until_s", [FOUND_S, 2.0], ids=["closed", "open"])
def test_motion_over_a_gap_is_that_of_the_smoother(until_s):
    """Where the gyro bias is known, and the Earth too."""
    known = calibration_with_gaps()
    rows, bridging = lost(calibration=known), Preintegrator.from_calibration(known)
    expected = (node_motion.motion_between_nodes if until_s >= FOUND_S else node_motion.motion_since_node)(
        rows,
        bridging,
        *(T0_NS + round(s * NS_PER_S) for s in (LOST_S, until_s)),
        np.zeros(3),
        gtsam.Rot3.RzRyRx(X[3:]).matrix().T @ EARTH,
    )
    assert_same_motion(over_gap(rows, vehicle_with_gaps(0.0), until_s), expected)


@pytest.mark.parametrize("until_s", [FOUND_S, 2.0], ids=["closed", "open"])
def test_a_gap_adds_what_an_unknown_gyro_bias_does_to_the_displacement(until_s):
    """``sigma^2 J J^T``, J by gyros that err by one axis after the other."""
    sigma, step = 0.02, 1e-5
    known, unknown = (over_gap(lost(), vehicle_with_gaps(s), until_s) for s in (0.0, sigma))
    ends = [
        [np.array(over_gap(lost(side * step * axis), vehicle_with_gaps(0.0), until_s).dp) for side in (-1, 1)]
        for axis in np.eye(3)
    ]
    J = np.column_stack([(after - before) / (2 * step) for before, after in ends])
    added = np.array(unknown.cov_rr) - np.array(known.cov_rr)
    assert_allclose(added, sigma**2 * J @ J.T, atol=5e-3 * sigma**2 * np.linalg.norm(J) ** 2)
    assert np.abs(J @ J.T - J.T @ J).max() > 0.05 * np.linalg.norm(J) ** 2  # else the order would not be seen
    assert (unknown.cov_tt, unknown.cov_rt) == (known.cov_tt, known.cov_rt)


@pytest.mark.parametrize(("until_s", "node_s"), [(0.9, 0.8), (2.4, 2.3)])
def test_an_interval_as_long_as_the_longest_is_no_gap(until_s, node_s):
    """Its bits are those without any model of gaps; in one that is longer they are not."""
    gapless, over, beyond = (
        over_gap(lost(), vehicle, until_s, node_s)
        for vehicle in (VEHICLE, vehicle_with_gaps(0.01, 0.1), vehicle_with_gaps(0.01, 0.0999))
    )
    assert over == gapless
    assert beyond != gapless


BIAS = np.array([0.01, -0.02, 0.03])


@pytest.mark.parametrize(("node_s", "until_s"), [(LOST_S, FOUND_S), (LOST_S, 2.0), (0.3, 0.4), (0.3, 0.37)])
def test_motion_with_its_derivative_by_the_bias_is_that_of_every_estimator(node_s, until_s):
    """To a node and to an instant, between samples and over a gap, with bias, Earth rate and lever arms."""
    known = calibration_with_gaps()
    rows, preintegrator = lost(calibration=known), Preintegrator.from_calibration(known)
    R = np.ascontiguousarray(gtsam.Rot3.RzRyRx(X[3:]).matrix())
    stamps_ns = [T0_NS + round(s * NS_PER_S) for s in (node_s, until_s)]
    ours, theirs = motion_since_node_with_bias, node_motion.motion_since_node
    if until_s in (FOUND_S, 0.4):
        ours, theirs = motion_to_node_with_bias, node_motion.motion_between_nodes
    motion = ours(rows.columns(), vehicle_with_gaps(0.0), R, BIAS, *stamps_ns)
    expected = theirs(rows, preintegrator, *stamps_ns, BIAS, R.T @ EARTH)
    dR, dp, cov, D, impulse = in_last_frame(*motion)
    assert_allclose(dR, expected.i_T_j.rotation().matrix(), atol=1e-12)
    assert_allclose(dp, expected.i_T_j.translation(), atol=1e-12)
    assert_allclose(cov, expected.covariance, atol=1e-15, rtol=1e-9)
    assert_allclose(D, expected.D_bias, atol=1e-12)
    assert_allclose(impulse, expected.mean_specific_force * expected.duration_s, atol=1e-9)
    again = inflate_shared_motion_with_bias(motion, 3)
    assert (again.D_t, again.D_r) == (motion.D_t, motion.D_r)
    assert again.integral == inflate_shared_motion(motion.integral, 3)


IMU_LEVER, GRAVITY = (0.3, -0.2, 0.1), 9.8
RATES = np.array([[0.1, 0.2, 0.3], [-0.4, 0.5, 0.6], [0.7, -0.8, 0.9], [1.0, 1.1, -1.2]])
VELOCITIES = np.array([[1.0, 0.1, 0.2], [1.5, -0.3, 0.4]])
VARIANCES = np.array([[1e-4, 4e-4, 25e-4], [9e-4, 1e-4, 2e-4]])
"""Of the Doppler samples, by axis: means 1e-3 and 4e-4."""


def columns_of(imu_ns, dvl_ns, *, rates=RATES, velocities=VELOCITIES, hold_past=False):
    cov = np.array([np.diag(row) for row in VARIANCES])
    force = np.tile([0.0, 0.0, GRAVITY], (len(imu_ns), 1))
    return np.array(imu_ns), rates, force, np.array(dvl_ns), velocities, cov, hold_past, NO_TURNS


def an_interval():
    return GravityInterval(np.empty((3, 3)), np.empty(3), np.empty(4))


@pytest.mark.parametrize(
    ("dvl_ns", "hold_past", "expected_rate"),
    [
        (100, False, RATES[1]),
        (100, True, RATES[1]),
        (125, False, 0.75 * RATES[1] + 0.25 * RATES[2]),
        (125, True, RATES[2]),
    ],
)
def test_an_interval_begins_with_the_velocity_of_the_imu_s_point(dvl_ns, hold_past, expected_rate):
    """``v + w x l``; a held rate belongs to what lies before its stamp, on which the node may be."""
    imu_ns, dvl_ns = T0_NS + np.array([0, 100, 200, 300]), T0_NS + np.array([dvl_ns, 290])
    interval, clock = an_interval(), np.array([dvl_ns[0], 0, 0, 0])
    open_interval(columns_of(imu_ns, dvl_ns, hold_past=hold_past), IMU_LEVER, interval, clock)
    assert_allclose(interval.velocity[:3], VELOCITIES[0] + np.cross(expected_rate, IMU_LEVER), atol=1e-12)
    assert interval.velocity[3] == pytest.approx(1e-3)
    assert clock[1] == dvl_ns[0]


def test_the_arm_from_dvl_to_imu_is_that_of_a_turning_rigid_body():
    """From the calibration's mountings: both points move as ``v + w x p`` says."""
    v, imu_ns, dvl_ns = np.array([0.4, -0.2, 0.1]), T0_NS + np.array([0, 100, 200, 300]), T0_NS + np.array([100, 290])
    interval, clock = an_interval(), np.array([dvl_ns[0], 0, 0, 0])
    columns = columns_of(imu_ns, dvl_ns, velocities=np.array([v + np.cross(RATES[1], LEVER)] * 2))
    open_interval(columns, vehicle_model(calibration_with_gaps(), 1.0).dvl_p_imu, interval, clock)
    assert_allclose(interval.velocity[:3], v + np.cross(RATES[1], IMU_PLACE), atol=1e-12)


@compiled
def up_measured(columns, vehicle, motion, clock, interval):
    return up_at_node(columns, vehicle, motion, clock, interval)


def test_gravity_is_that_of_a_turning_vehicle_with_the_velocity_noise_of_both_ends():
    """Level at first; sigma as the theory page has it. A node before the interval is over measures nothing."""
    duration_s = 2.0
    imu_ns = T0_NS + np.arange(4) * NS_PER_S
    dvl_ns = T0_NS + np.array([0, round(duration_s * NS_PER_S)])
    columns = columns_of(imu_ns, dvl_ns, rates=np.zeros((4, 3)), velocities=np.zeros((2, 3)))
    model = VEHICLE._replace(
        gravity_interval_ns=NS_PER_S, gyro_bias_sigma=2e-3, accel_noise_density=2e-3, dvl_p_imu=IMU_LEVER
    )
    clock, interval = np.array([T0_NS, 0, 7, 7, 0]), an_interval()
    open_interval(columns, IMU_LEVER, interval, clock)
    one, other = rotation([0.4, 0.0, 0.1]), rotation([0.0, 0.3, 0.5])
    motion = NO_MOTION._replace(dR=matrix(one), impulse=(0.0, 0.0, 0.8 * GRAVITY))
    assert np.isnan(up_measured(columns, model, motion, clock, interval)[1])
    clock[NODE] = dvl_ns[1]
    motion = NO_MOTION._replace(dR=matrix(other), impulse=vector(one.T @ [0.0, 0.0, (duration_s - 0.8) * GRAVITY]))
    up, sigma = up_measured(columns, model, motion, clock, interval)
    velocity_noise = VARIANCES.mean(axis=1).sum()
    tilt = (model.accel_noise_density**2 / duration_s + velocity_noise / duration_s**2) / GRAVITY**2
    tilt += model.gyro_noise_density**2 * duration_s / 3 + (model.gyro_bias_sigma * duration_s) ** 2 / 4
    assert sigma**2 == pytest.approx(tilt, rel=1e-9)
    assert_allclose(up, (one @ other)[2], atol=1e-12)
    assert clock[OPENED] == dvl_ns[1]
    assert interval.velocity[3] == pytest.approx(VARIANCES[1].mean())
