"""What holds at a node: velocity at the IMU, roll and pitch from gravity, the plane of planar robots."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from baselines.ekf_equations import correct_state, correct_up
from baselines.filter_motion import open_interval, up_at_node
from baselines.filter_window import NODE, OPENED, GravityInterval, VehicleModel
from sonar_graph.navigation.imu_gaps import NO_TURNS
from sonar_graph.navigation.preintegration.recursion import NO_MOTION
from sonar_graph.numerics.jit import compiled
from sonar_graph.sequence import NS_PER_S

T0_NS = 1_700_000_000 * NS_PER_S
LEVER = (0.3, -0.2, 0.1)
GRAVITY = 9.8
VEHICLE = VehicleModel(
    gyro_noise_density=0.01,
    body_p_dvl=(0.0, 0.0, 0.0),
    dvl_p_imu=LEVER,
    earth_rate=(0.0, 0.0, 0.0),
    body_p_port=(0.0, 0.0, 0.0),
    gravity_interval_ns=0,
    accel_noise_density=2e-3,
    accel_bias_sigma=0.0,
    gravity_m_s2=GRAVITY,
    is_planar=False,
    plane_z_m=0.0,
    plane_z_variance=1.0,
    plane_tilt_variance=1.0,
)
RATES = np.array([[0.1, 0.2, 0.3], [-0.4, 0.5, 0.6], [0.7, -0.8, 0.9], [1.0, 1.1, -1.2]])
VELOCITIES = np.array([[1.0, 0.1, 0.2], [1.5, -0.3, 0.4]])
VARIANCES = np.array([[1e-4, 4e-4, 25e-4], [9e-4, 1e-4, 2e-4]])
"""Of the Doppler samples, by axis."""


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
    open_interval(columns_of(imu_ns, dvl_ns, hold_past=hold_past), LEVER, interval, clock)
    assert_allclose(interval.velocity[:3], VELOCITIES[0] + np.cross(expected_rate, LEVER), atol=1e-12)
    assert clock[1] == dvl_ns[0]


def test_a_component_of_the_velocity_has_the_mean_variance_of_the_three():
    imu_ns, dvl_ns = T0_NS + np.array([0, 100, 200, 300]), T0_NS + np.array([0, 200])
    columns, interval = columns_of(imu_ns, dvl_ns), an_interval()
    for node, mean in enumerate((1e-3, 4e-4)):  # (1 + 4 + 25) / 3 and (9 + 1 + 2) / 3
        open_interval(columns, LEVER, interval, np.array([dvl_ns[node], 0]))
        assert interval.velocity[3] == pytest.approx(mean)


@compiled
def up_measured(columns, vehicle, motion, clock, interval):
    return up_at_node(columns, vehicle, motion, clock, interval)


def test_gravity_has_the_velocity_noise_of_both_ends():
    """Level and at rest; sigma as the theory page has it. A node before the interval is over measures nothing."""
    duration_s = 2.0
    imu_ns = T0_NS + np.arange(4) * NS_PER_S
    dvl_ns = T0_NS + np.array([0, round(duration_s * NS_PER_S)])
    columns = columns_of(imu_ns, dvl_ns, rates=np.zeros((4, 3)), velocities=np.zeros((2, 3)))
    model = VEHICLE._replace(gravity_interval_ns=NS_PER_S, gyro_bias_sigma=2e-3)
    clock, interval = np.array([T0_NS, 0, 7, 7, 0]), an_interval()
    open_interval(columns, LEVER, interval, clock)
    assert np.isnan(up_measured(columns, model, NO_MOTION, clock, interval)[1])
    clock[NODE] = dvl_ns[1]
    motion = NO_MOTION._replace(impulse=(0.0, 0.0, GRAVITY * duration_s))
    up, sigma = up_measured(columns, model, motion, clock, interval)
    velocity_noise = VARIANCES.mean(axis=1).sum()
    tilt = (model.accel_noise_density**2 / duration_s + velocity_noise / duration_s**2) / GRAVITY**2
    tilt += model.gyro_noise_density**2 * duration_s / 3 + (model.gyro_bias_sigma * duration_s) ** 2 / 4
    assert sigma**2 == pytest.approx(tilt, rel=1e-9)
    assert_allclose(up, [0.0, 0.0, 1.0], atol=1e-12)
    assert clock[OPENED] == dvl_ns[1]
    assert interval.velocity[3] == pytest.approx(VARIANCES[1].mean())


def test_up_and_a_state_are_scalar_kalman_updates_where_nothing_correlates():
    """``x' = x + P / (P + R) (z - x)``; roll has the variance of the tilt over ``cos(theta)^2``."""
    before, prior = np.array([1.0, 2.0, 0.7, 0.05, -0.08, 0.3]), np.array([1e-2, 2e-2, 3e-2, 1e-3, 2e-3, 3e-3])
    roll, pitch, sigma = 0.1, -0.5, 0.03
    up = -np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)
    z, R = np.array([0.5, roll, pitch]), np.array([4e-2, (sigma / np.cos(pitch)) ** 2, sigma**2])
    x, P = before.copy(), np.diag(prior)
    corrected(x, P, up, sigma)
    gain = prior[2:5] / (prior[2:5] + R)
    assert_allclose(x[2:5], before[2:5] + gain * (z - before[2:5]), atol=1e-12)
    assert_allclose(P, np.diag([*prior[:2], *((1 - gain) * prior[2:5]), prior[5]]), atol=1e-15)
    assert_allclose(x[[0, 1, 5]], before[[0, 1, 5]], atol=1e-12)


@compiled
def corrected(x, P, up, sigma):
    correct_up(x, P, 6, up, sigma)
    correct_state(x, P, 6, 2, 0.5, 4e-2)
