"""Gaps of the Doppler log: covariance against the noise of every sample, limits, and what estimators make of them."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, Start
from sonar_graph.estimator import load_estimator
from sonar_graph.measurements import Dvl, Imu, Measurements
from sonar_graph.navigation.imu_gaps import NO_TURNS
from sonar_graph.navigation.odometry import Odometry, motion_between_nodes, motion_since_node
from sonar_graph.navigation.preintegration.dvl_gaps import integral, line_before
from sonar_graph.navigation.preintegration.motion import Preintegrator
from sonar_graph.testing import check_consistent

from . import vehicle, ways
from .rows import NS, at, dvl, imu, nees, stamps
from .vehicle import DVL, NOISY, QUIET, motion

WITH_OR_WITHOUT = pytest.mark.parametrize("is_blind", [False, True], ids=["accelerometers", "walk"])


@WITH_OR_WITHOUT
def test_a_sample_that_ends_a_gap_counts_only_once_inertial_rows_cover_it(is_blind):
    """Before, there is no node at it, and the gap is as open as without it."""
    known = ways.calibration({"accel_noise_density": 1e-2}, velocity_sigma_m_s=(0.01,) * 3, velocity_walk_density=0.02)
    imu, dvl = ways.rows()
    imu = ways.blinded(imu) if is_blind else imu
    seen = imu.between(0, at(ways.FOUND_S) - 1)
    until_s = ways.FOUND_S + 0.05
    open_gap = motion(seen, dvl.between(0, at(ways.LOST_S)), known, ways.LOST_S, until_s)
    found = motion(seen, dvl.between(0, at(ways.FOUND_S)), known, ways.LOST_S, until_s)
    assert found.i_T_j.equals(open_gap.i_T_j, 0.0)
    assert np.array_equal(found.covariance, open_gap.covariance)
    covered = motion(imu, dvl.between(0, at(ways.FOUND_S)), known, ways.LOST_S, ways.FOUND_S)
    assert np.trace(covered.covariance[3:, 3:]) < 0.5 * np.trace(open_gap.covariance[3:, 3:])


def test_a_gap_that_ends_between_inertial_rows_uses_the_row_after_its_end_and_no_later_one():
    imu, dvl = ways.rows()
    late = Dvl(dvl.stamps_ns + NS // 20 * (dvl.stamps_ns >= at(ways.FOUND_S)), dvl.velocity, dvl.velocity_cov)
    how = ways.calibration(), ways.LOST_S, ways.FOUND_S + 0.05
    base = motion(imu, late, *how).i_T_j
    for row_s, is_used in ((ways.FOUND_S + 0.1, True), (ways.FOUND_S + 0.2, False)):
        only = (imu.stamps_ns == at(row_s))[:, None] * np.ones(3)
        found = motion(*ways.spoilt(imu, late, "force", only), *how).i_T_j
        assert found.equals(base, 1e-6) != is_used


@WITH_OR_WITHOUT
def test_both_ends_of_a_gap_count_by_their_own_noise(is_blind):
    """``T (T + 2 d) / 4`` of each one's variance, d the interval before the gap."""
    imu, dvl = ways.rows()
    sigma = np.where(dvl.stamps_ns <= at(ways.LOST_S), 0.01, 0.03)
    noisy = Dvl(dvl.stamps_ns, dvl.velocity, sigma[:, None, None] ** 2 * np.eye(3))
    found = motion(ways.blinded(imu) if is_blind else imu, noisy, ways.calibration(), ways.LOST_S, ways.FOUND_S)
    assert np.diag(found.covariance)[3:] == pytest.approx(
        [(0.01**2 + 0.03**2) * 5.0 * (5.0 + 2 * 0.5) / 4] * 3, rel=1e-3
    )


def test_too_few_samples_for_a_line_leave_a_walk():
    imu, dvl = ways.rows()
    known, few = ways.calibration(velocity_walk_density=0.1), dvl.rows(dvl.stamps_ns >= at(ways.LOST_S - 1.0))
    found, walked = (motion(part, few, known, ways.LOST_S, ways.OPEN_S) for part in (imu, ways.blinded(imu)))
    assert found.i_T_j.equals(walked.i_T_j, 0.0)
    assert np.array_equal(found.covariance, walked.covariance)
    assert not motion(imu, dvl, known, ways.LOST_S, ways.OPEN_S).i_T_j.equals(walked.i_T_j, 0.1)


@pytest.mark.parametrize("until_s", [16.0, 15.9, 14.0])
def test_accelerometers_carry_the_velocity_through_a_long_gap(until_s):
    """Closed or open; a straight line between the ends is wrong by metres."""
    truth = vehicle.Vehicle().displacement(vehicle.LOST_S, until_s)
    found, straight = (
        motion(*vehicle.rows(), Calibration(imu=QUIET, dvl=log), vehicle.LOST_S, until_s).i_T_j.translation()
        for log in (DVL, DVL.model_copy(update={"gap_s": 100.0}))
    )
    assert found == pytest.approx(truth, abs=0.01)
    assert np.linalg.norm(straight - truth) > 0.5


@pytest.mark.parametrize("until_s", [16.0, 14.0])
def test_the_covariance_of_a_gap_is_that_of_many_runs(until_s):
    """Noise of gyros, accelerometers and Doppler log, and an accelerometer bias of its own for each run."""
    (imu_rows, dvl_rows), ends = vehicle.rows(), (vehicle.LOST_S, until_s)
    truth = motion(imu_rows, dvl_rows, Calibration(imu=QUIET, dvl=DVL), *ends).i_T_j.translation()
    rng, errors = np.random.default_rng(0), []
    for _ in range(400):
        noise = rng.standard_normal((2, len(imu_rows), 3)) * np.sqrt(vehicle.IMU_HZ)
        rate = imu_rows.angular_velocity + NOISY.gyro_noise_density * noise[0]
        bias = NOISY.accel_bias_sigma * rng.standard_normal(3)
        force = imu_rows.specific_force + NOISY.accel_noise_density * noise[1] + bias
        velocity = dvl_rows.velocity + vehicle.SIGMA * rng.standard_normal(dvl_rows.velocity.shape)
        measured = Imu(imu_rows.stamps_ns, rate, force), Dvl(dvl_rows.stamps_ns, velocity, dvl_rows.velocity_cov)
        found = motion(*measured, Calibration(imu=NOISY, dvl=DVL), *ends)
        errors.append(found.i_T_j.rotation().unrotate(found.i_T_j.translation() - truth))
    check_consistent(nees(errors, found.covariance[3:, 3:]), 3, confidence=0.999)


@pytest.mark.parametrize(("until_s", "share"), [(16.0, 12.0), (15.0, 3.0)])
def test_without_accelerometer_the_velocity_is_a_random_walk(until_s, share):
    imu_rows, dvl_rows = vehicle.rows()
    exact = DVL.model_copy(update={"velocity_sigma_m_s": (0.0,) * 3, "velocity_walk_density": 0.05})
    found = motion(ways.blinded(imu_rows), dvl_rows, Calibration(imu=QUIET, dvl=exact), vehicle.LOST_S, until_s)
    expected = 0.05**2 * (until_s - vehicle.LOST_S) ** 3 / share
    assert np.diag(found.covariance)[3:] == pytest.approx([expected] * 3)


def test_nothing_changes_where_no_sample_is_missing():
    """The same bits with and without a model of gaps, between nodes and since one."""
    steady, ns = vehicle.Vehicle(), stamps(vehicle.DVL_HZ, 8.0)
    odometry = Odometry(Calibration(imu=NOISY, dvl=DVL))
    odometry.add(steady.imu(stamps(vehicle.IMU_HZ, 8.1)), steady.dvl(ns))
    bridging = Preintegrator.from_calibration(Calibration(imu=NOISY, dvl=DVL))
    plain = Preintegrator(bridging.gyro_noise_density, bridging.body_p_dvl)
    for function, until_s in ((motion_between_nodes, 7.0), (motion_since_node, 1.3)):
        one, other = (function(odometry, p, at(1.0), at(until_s), np.zeros(3), None) for p in (bridging, plain))
        assert one.i_T_j.equals(other.i_T_j, 0.0)
        assert np.array_equal(one.covariance, other.covariance)


KNOWN_START = Start(position_sigma_m=(0.0,) * 3, rpy_sigma_rad=(0.0,) * 3)
UNSURE = Start(position_sigma_m=(1e-6,) * 3, rpy_sigma_rad=(1e-6,) * 3)
ESTIMATORS = ("dead-reckoning", "ekf-slam", "invariant-ekf", "isam2")


def estimates(name, blocks, start=KNOWN_START):
    """The last estimate of an estimator that is given blocks of rows until instants."""
    estimator = load_estimator(name)(Calibration(imu=NOISY, dvl=DVL, start=start, use_gravity=False))
    return [estimator.process(Measurements(until_ns, *block)) for until_ns, block in blocks][-1]


def cut(until_ns):
    """Rows between successive instants."""
    imu_rows, dvl_rows = vehicle.rows()
    return [
        (end, (imu_rows.between(begin, end), dvl_rows.between(begin, end))) for begin, end in pairwise([0, *until_ns])
    ]


@pytest.mark.parametrize("until_s", [13.0, 18.0])
def test_every_estimator_moves_alike_over_a_gap(until_s):
    first, *others = [estimates(name, cut([at(until_s)]), UNSURE) for name in ESTIMATORS]
    for other in others:
        assert other.world_T_body.translation() == pytest.approx(first.world_T_body.translation(), abs=1e-4)
        assert other.covariance == pytest.approx(first.covariance, rel=0.01, abs=1e-6)


@pytest.mark.parametrize("name", ESTIMATORS[:3])
def test_an_estimate_in_a_gap_does_not_depend_on_how_rows_are_cut(name):
    whole, pieces = (
        estimates(name, cut(ends)) for ends in ([at(14.0)], [at(0.37 * k) for k in range(1, 37)] + [at(14.0)])
    )
    assert pieces.world_T_body.equals(whole.world_T_body, 1e-9)
    assert pieces.covariance == pytest.approx(whole.covariance, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_samples_out_of_order_give_the_same_estimate_as_in_order(name):
    """A block of each sensor overtakes the one before it."""
    blocks = [block for _, block in cut([at(2.0), at(2.45), at(2.55), at(5.0)])]
    blocks[1] = blocks[1][0], vehicle.rows()[1].between(at(2.0), at(2.0) + NS // 4)
    found = [
        estimates(name, [(at(5.0) if k == 3 else at(2.0), blocks[k]) for k in order], UNSURE)
        for order in ([0, 1, 2, 3], [0, 2, 1, 3])
    ]
    assert found[1].world_T_body.equals(found[0].world_T_body, 1e-9)
    assert found[1].covariance == pytest.approx(found[0].covariance, rel=1e-6, abs=1e-12)


ZERO, NODE_S, RATE_HZ, EVEN = (0.0, 0.0, 0.0), 10.0, 20.0, 1e-4 * np.eye(3)


def fitted(dvl_hz, velocity=0.0, count=0, imu_rows=None, cov=EVEN):
    """Line at the last sample of a vehicle at rest."""
    imu_rows = imu_rows or imu(stamps(RATE_HZ, NODE_S + 1.0), ZERO)
    samples = dvl(stamps(dvl_hz, NODE_S)[-count:], velocity, cov)
    inertial = imu_rows.stamps_ns, imu_rows.angular_velocity.copy(), imu_rows.specific_force.copy()
    columns = (*inertial, samples.stamps_ns, samples.velocity.copy(), samples.velocity_cov.copy(), False, NO_TURNS)
    return line_before(columns, ZERO, ZERO, len(samples) - 1, ZERO, ZERO)


def test_a_line_takes_covered_samples_of_the_last_five_seconds_four_at_least_over_a_second():
    assert fitted(4.0).sums.n == 21
    assert fitted(4.0, imu_rows=imu(stamps(RATE_HZ, 4.0, NODE_S - 3.0), ZERO)).sums.n == 13
    for dvl_hz, count, is_known in ((2.0, 3, False), (2.0, 4, True), (10.0, 8, False), (10.0, 12, True)):
        assert fitted(dvl_hz, count=count).is_known == is_known


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
    turning = imu(stamps(RATE_HZ, NODE_S + 1.0), (0.0, 0.0, 0.3))
    cov = np.diag([4e-4, 1e-4, 2e-4])
    found = fitted(4.0, imu_rows=turning, cov=cov).Q
    R = Rotation.from_rotvec(np.outer(-np.arange(21) / 4.0, [0.0, 0.0, 0.3])).as_matrix()
    assert np.array(found) == pytest.approx((R @ cov @ R.transpose(0, 2, 1)).sum(axis=0), rel=1e-6, abs=1e-12)
