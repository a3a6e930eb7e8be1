"""The line on which the velocity lay before bottom lock was lost: its samples, and how sure it is."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.measurements import Imu
from sonar_graph.navigation.imu_gaps import NO_TURNS
from sonar_graph.navigation.preintegration.dvl_gaps import integral, line_before

from .rows import dvl, imu, stamps

ZERO = (0.0, 0.0, 0.0)
IMU_HZ, NODE_S = 20.0, 10.0
ISOTROPIC = 1e-4 * np.eye(3)


def fitted(dvl_hz, velocity=0.0, count=0, imu_rows=None, cov=ISOTROPIC):
    """Line at the last sample of a vehicle at rest."""
    imu_rows = imu_rows or imu(stamps(IMU_HZ, NODE_S + 1.0), ZERO)
    ns = stamps(dvl_hz, NODE_S)[-count:]
    samples = dvl(ns, velocity, cov)
    inertial = imu_rows.stamps_ns, imu_rows.angular_velocity.copy(), imu_rows.specific_force.copy()
    columns = (*inertial, samples.stamps_ns, samples.velocity.copy(), samples.velocity_cov.copy(), False, NO_TURNS)
    return line_before(columns, ZERO, ZERO, len(ns) - 1, ZERO, ZERO)


def test_the_line_is_fitted_to_the_last_five_seconds():
    assert fitted(4.0).sums.n == 21


def test_samples_before_the_first_inertial_row_are_left_out():
    late = stamps(IMU_HZ, 4.0, NODE_S - 3.0)
    assert fitted(4.0, imu_rows=imu(late, ZERO)).sums.n == 13


@pytest.mark.parametrize(
    ("dvl_hz", "count", "is_known"), [(2.0, 3, False), (2.0, 4, True), (10.0, 8, False), (10.0, 12, True)]
)
def test_a_line_takes_four_samples_and_a_second(dvl_hz, count, is_known):
    assert fitted(dvl_hz, count=count).is_known == is_known


def test_no_line_where_a_force_was_not_measured():
    rows = imu(stamps(IMU_HZ, NODE_S + 1.0), ZERO)
    force = rows.specific_force.copy()
    force[-40] = np.nan
    assert not fitted(4.0, imu_rows=Imu(rows.stamps_ns, rows.angular_velocity, force)).is_known


def test_the_displacement_is_that_of_the_fitted_line():
    """At rest, y is gravity's line; samples off it are fitted by least squares, as numpy does."""
    noise = 0.01 * np.random.default_rng(0).standard_normal((41, 3))
    found, *_ = integral(fitted(4.0, noise), 7.0, 0.0, 0.0)
    t = -np.arange(20, -1, -1) / 4.0
    slope, level = np.polyfit(t, noise[-21:] - np.outer(t, [0.0, 0.0, 9.80665]), 1)
    assert found == pytest.approx(7.0 * level + 7.0**2 / 2 * slope, abs=1e-6)


def test_noise_in_the_window_weighs_as_its_integrals_say():
    """`K` and its integral summed numerically; gyros tilt gravity, level errors apart."""
    T, n = 7.0, 200_001
    line = fitted(10.0)
    W = -2.0 * line.sums.t / line.sums.n
    s = np.linspace(0.0, 1.0, n)
    r = T * (T / 2 + W / 2) / W
    K = T * s - 6 * r * s * (1 - s)
    by_force = W * np.trapezoid(K**2, s)
    tilted = np.concatenate([[0.0], np.cumsum((K[1:] + K[:-1]) / 2 * np.diff(s))])
    by_gyro = 9.80665**2 * W**3 * np.trapezoid(tilted**2, s)
    quiet, forced, turned = (integral(line, T, *noise)[3] for noise in ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0)))
    assert np.subtract(forced, quiet) == pytest.approx(by_force * np.eye(3), rel=1e-6)
    assert np.subtract(turned, quiet) == pytest.approx(by_gyro * np.diag([1.0, 1.0, 0.0]), rel=1e-6)


def test_noise_of_a_turning_log_is_turned_to_the_node():
    turning = imu(stamps(IMU_HZ, NODE_S + 1.0), (0.0, 0.0, 0.3))
    cov = np.diag([4e-4, 1e-4, 2e-4])
    found = fitted(4.0, imu_rows=turning, cov=cov).Q
    R = Rotation.from_rotvec(np.outer(-np.arange(21) / 4.0, [0.0, 0.0, 0.3])).as_matrix()
    assert np.array(found) == pytest.approx((R @ cov @ R.transpose(0, 2, 1)).sum(axis=0), rel=1e-6, abs=1e-12)
