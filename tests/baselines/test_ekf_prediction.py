"""What holds at a node: velocity at the IMU, roll and pitch from gravity, the plane of planar robots."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from baselines.ekf_equations import advance_to_node
from baselines.filter_events import GravityInterval, open_interval
from baselines.filter_inputs import VehicleModel
from sonar_graph.navigation.imu_gaps import NO_TURNS
from sonar_graph.navigation.preintegration.recursion import NO_MOTION
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


def test_gravity_corrects_with_the_velocity_noise_of_both_ends():
    """Level and at rest but for its prior: ``1 / P' = 1 / P + 1 / sigma^2``, sigma as the theory page has it."""
    duration_s, prior = 2.0, 0.02**2
    imu_ns = T0_NS + np.arange(4) * NS_PER_S
    dvl_ns = T0_NS + np.array([0, round(duration_s * NS_PER_S)])
    columns = columns_of(imu_ns, dvl_ns, rates=np.zeros((4, 3)), velocities=np.zeros((2, 3)))
    model = VEHICLE._replace(gravity_interval_ns=NS_PER_S, gyro_bias_sigma=2e-3)
    x, P, clock, interval = np.zeros(6), prior * np.eye(6), np.array([T0_NS, 0, 7, 7]), an_interval()
    open_interval(columns, LEVER, interval, clock)
    motion = NO_MOTION._replace(impulse=(0.0, 0.0, GRAVITY * duration_s))
    advance_to_node(columns, model, x, P, 6, clock, interval, int(dvl_ns[1]), motion)
    velocity_noise = VARIANCES.mean(axis=1).sum()
    tilt = (model.accel_noise_density**2 / duration_s + velocity_noise / duration_s**2) / GRAVITY**2
    tilt += model.gyro_noise_density**2 * duration_s / 3 + (model.gyro_bias_sigma * duration_s) ** 2 / 4
    expected = 1 / (1 / prior + 1 / tilt)
    assert_allclose(np.diag(P), [prior, prior, prior, expected, expected, prior], rtol=1e-9)
    assert_allclose(x, 0.0, atol=1e-12)
    assert clock.tolist() == [dvl_ns[1], dvl_ns[1], 0, 0]
    assert interval.velocity[3] == pytest.approx(VARIANCES[1].mean())


def test_a_plane_is_measured_in_height_roll_and_pitch_each_with_its_own_noise():
    """Independent numbers: ``x' = x + P / (P + R) (plane - x)`` for each of the three; the others stay."""
    model = VEHICLE._replace(is_planar=True, plane_z_m=0.5, plane_z_variance=4e-2, plane_tilt_variance=9e-4)
    before, prior = np.array([1.0, 2.0, 0.7, 0.05, -0.08, 0.3]), np.array([1e-2, 2e-2, 3e-2, 1e-3, 2e-3, 3e-3])
    x, P = before.copy(), np.diag(prior)
    columns = columns_of(T0_NS + np.arange(4), T0_NS + np.array([0, 2]))
    advance_to_node(columns, model, x, P, 6, np.array([T0_NS, 0, 7, 7]), an_interval(), T0_NS + 2, NO_MOTION)
    noise, plane = np.array([4e-2, 9e-4, 9e-4]), np.array([0.5, 0.0, 0.0])
    gain = prior[2:5] / (prior[2:5] + noise)
    assert_allclose(x[2:5], before[2:5] + gain * (plane - before[2:5]), atol=1e-12)
    assert_allclose(np.diag(P)[2:5], (1 - gain) * prior[2:5], atol=1e-15)
    assert_allclose(x[[0, 1, 5]], before[[0, 1, 5]], atol=1e-12)
    assert_allclose(np.diag(P)[[0, 1, 5]], prior[[0, 1, 5]], atol=1e-15)
    assert_allclose(P - np.diag(np.diag(P)), 0.0, atol=1e-15)
