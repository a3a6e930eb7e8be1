"""Gaps of the Doppler log and holes of the IMU: covariances, limits, and what estimators make of them."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
    Start,
)
from sonar_graph.estimator import load_estimator
from sonar_graph.measurements import Dvl, Imu, Measurements
from sonar_graph.navigation import Odometry
from sonar_graph.navigation.imu_gaps import (
    closed_variance,
    hole_ns,
    open_variance,
)
from sonar_graph.testing import check_consistent

from . import ways
from .rows import T0_NS, at, dvl, imu, stamps
from .ways import DVL, FOUND_LATE_S, LOST_S, NOISY, QUIET, motion, with_long_gap


def test_both_ends_of_a_gap_count_by_their_own_noise():
    """``T (T + 2 d) / 4`` of each one's variance, d the interval before the gap."""
    imu, dvl = ways.rows()
    sigma = np.where(dvl.stamps_ns <= at(ways.LOST_S), 0.01, 0.03)
    noisy = Dvl(dvl.stamps_ns, dvl.velocity, sigma[:, None, None] ** 2 * np.eye(3))
    found = motion(imu, noisy, ways.calibration(), ways.LOST_S, ways.FOUND_S)
    assert np.diag(found.covariance)[3:] == pytest.approx(
        [(0.01**2 + 0.03**2) * 5.0 * (5.0 + 2 * 0.5) / 4] * 3, rel=1e-3
    )


CHEAP = ImuCalibration(
    gyro_noise_density=3e-4,
    gyro_bias_sigma=1e-3,
    accel_noise_density=1e-2,
    accel_bias_sigma=0.02,
    mounting=QUIET.mounting,
)
"""Accelerometers are surer than a walk at first and less sure after some seconds."""


def total(found):
    """Covariance of the translation with the part of the gyro bias."""
    by_bias = CHEAP.gyro_bias_sigma * found.D_bias[3:]
    return found.covariance[3:, 3:] + by_bias @ by_bias.T


def ways_over(known, end_s):
    """Motion over the gap: as it is, by the accelerometers alone, and by a velocity that walks."""
    imu_rows, dvl_rows = with_long_gap()
    alone = known.model_copy(
        update={
            "dvl": known.dvl.model_copy(
                update={"velocity_walk_density": ways.ANY_VELOCITY}
            )
        }
    )
    return [
        motion(rows, dvl_rows, calibration, LOST_S, end_s)
        for rows, calibration in (
            (imu_rows, known),
            (imu_rows, alone),
            (ways.blinded(imu_rows), known),
        )
    ]


@pytest.mark.parametrize("end_s", [9.0, 12.0, 15.0, FOUND_LATE_S])
def test_a_gap_is_surer_than_by_accelerometers_alone_or_by_a_walk_alone(end_s):
    found, by_accelerometers, walked = (
        total(one) for one in ways_over(Calibration(imu=CHEAP, dvl=DVL), end_s)
    )
    for other in (by_accelerometers, walked):
        assert (
            np.linalg.eigvalsh(other - found).min()
            > -0.05 * np.linalg.eigvalsh(other).min()
        )


@pytest.mark.parametrize("is_closed", [False, True])
@pytest.mark.parametrize("gap_s", [8.0, 20.0])
def test_the_errors_of_walking_vehicles_are_as_large_as_their_covariance(
    gap_s, is_closed
):
    """Level vehicles whose velocity walks as the calibration has it, gyros and accelerometers with a bias each."""
    rng = np.random.default_rng(5)
    rate_hz = 20.0
    q = 0.05
    before_s = 8.0
    imu_ns = stamps(rate_hz, before_s + gap_s + 2.0)
    t = (imu_ns - T0_NS) * 1e-9
    found_s = before_s + gap_s - 0.3 if is_closed else np.inf
    has_lock = ((t <= before_s) | (t > found_s)) & (np.arange(len(t)) % 4 == 0)
    end_s = t[has_lock & (t > before_s)][0] if is_closed else before_s + gap_s
    sensors = CHEAP.model_copy(update={"mounting": Mounting()})
    known = Calibration(
        imu=sensors,
        dvl=DvlCalibration(velocity_walk_density=q, velocity_sigma_m_s=(0.005,) * 3),
    )
    squares = []
    for _ in range(150):
        white = rng.standard_normal((3, len(t), 3)) * np.sqrt(rate_hz)
        biases = rng.standard_normal((2, 3))
        # piecewise linear between rows, as interpolated
        walked = cumulative_trapezoid(q * white[0], t, axis=0, initial=0.0)
        velocity = np.array([0.5, 0.0, 0.0]) + walked
        rate = sensors.gyro_noise_density * white[1]
        rate += sensors.gyro_bias_sigma * biases[0]
        force = q * white[0] + [0.0, 0.0, 9.80665]
        force += sensors.accel_noise_density * white[2]
        force += sensors.accel_bias_sigma * biases[1]
        doppler = velocity + 0.005 * rng.standard_normal(velocity.shape)
        log = dvl(imu_ns, doppler).rows(has_lock)
        found = motion(Imu(imu_ns, rate, force), log, known, before_s, end_s)
        is_in = (t >= before_s - 1e-6) & (t <= end_s + 1e-6)
        way = np.trapezoid(velocity[is_in], t[is_in], axis=0)
        error = found.i_T_j.rotation().unrotate(found.i_T_j.translation() - way)
        squares.append(error @ np.linalg.solve(total(found), error))
    check_consistent(np.array(squares), 3, confidence=0.999)


@pytest.mark.parametrize("turns_s", [(7.0, 9.0), (0.0, 6.5)])
def test_in_a_gap_the_body_keeps_its_velocity_and_not_the_doppler_log(turns_s):
    """A vehicle on the spot begins or ends a turn in the gap; the log, a metre ahead of it, swings sideways."""
    imu_ns = stamps(50.0, 12.0)
    dvl_ns = stamps(5.0, 6.0)
    t = (imu_ns - T0_NS) * 1e-9
    rate = np.where((t > turns_s[0]) & (t < turns_s[1]), 0.3, 0.0)
    turn = np.column_stack([0.0 * t, 0.0 * t, rate])
    swing_m_s = 0.3 if turns_s[0] < 6.0 else 0.0
    log = DvlCalibration(mounting=Mounting(translation_m=(1.0, 0.0, 0.0)))
    rows = ways.blinded(imu(imu_ns, turn)), dvl(dvl_ns, (0.0, swing_m_s, 0.0))
    found = motion(*rows, Calibration(dvl=log), 6.0, 8.0)
    assert np.linalg.norm(found.i_T_j.translation()) < 1e-3
    assert found.i_T_j.rotation().yaw() > 0.1


def at_rest(gap_s, turn=(0.0, 0.0, 0.0), walk=1e3, **noise):
    """Motion of a level vehicle at rest over a closed gap after 6 s, by gyros with a constant error."""
    imu_ns = stamps(20.0, 7.0 + gap_s)
    dvl_ns = stamps(5.0, 7.0 + gap_s)
    s = (dvl_ns - T0_NS) * 1e-9
    kept = (s < 6.01) | (s > 5.99 + gap_s)
    sensors = QUIET.model_copy(update={"mounting": Mounting(), **noise})
    log = DvlCalibration(velocity_sigma_m_s=(0.0,) * 3, velocity_walk_density=walk)
    odometry = Odometry(Calibration(imu=sensors, dvl=log))
    odometry.add(imu(imu_ns, turn), dvl(dvl_ns[kept], 0.0))
    end_ns = int(odometry.epochs(at(6.0), at(1e3))[0])
    known_ns = odometry.reached_ns(end_ns)
    return odometry.motion(at(6.0), end_ns, np.zeros(3), None, known_ns)


def test_the_square_of_a_gyro_bias_counts_in_the_height_s_variance():
    """Gauss-Hermite points of two horizontal biases; where the line alone counts."""
    b = 2e-3
    gap_s = 40.0
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    weights = weights / weights.sum()
    moment_m2 = sum(
        w_x * w_y * at_rest(gap_s, turn=(b * x, b * y, 0.0)).i_T_j.z() ** 2
        for x, w_x in zip(nodes, weights, strict=True)
        for y, w_y in zip(nodes, weights, strict=True)
    )
    claimed = at_rest(gap_s, gyro_bias_sigma=b, walk=1e4).covariance
    assert claimed[5, 5] == pytest.approx(moment_m2, rel=0.1)


UNSURE = Start(position_sigma_m=(1e-6,) * 3, rpy_sigma_rad=(1e-6,) * 3)
ESTIMATORS = ("dead-reckoning", "ekf-slam", "invariant-ekf", "isam2")


def estimate(name, until_s):
    """Of an estimator that is given all rows until an instant."""
    calibration = Calibration(imu=NOISY, dvl=DVL, start=UNSURE, use_gravity=False)
    estimator = load_estimator(name)(calibration, Odometry(calibration))
    rows = (block.between(0, at(until_s)) for block in with_long_gap())
    return estimator.process(Measurements(at(until_s), *rows))


@pytest.mark.parametrize("until_s", [13.0, 18.0])
def test_every_estimator_moves_alike_over_a_gap(until_s):
    first, *others = [estimate(name, until_s) for name in ESTIMATORS]
    for other in others:
        assert other.world_T_body.translation() == pytest.approx(
            first.world_T_body.translation(), abs=1e-4
        )
        assert other.covariance == pytest.approx(first.covariance, rel=0.01, abs=1e-6)


@pytest.mark.parametrize(
    ("dvl_hz", "count", "imu_from_s", "is_line"),
    [
        *((4.0, 0, 0.0, True), (4.0, 0, 8.0, True), (4.0, 0, 9.4, False)),
        *(
            (2.0, 3, 0.0, False),
            (2.0, 4, 0.0, True),
            (10.0, 8, 0.0, False),
            (10.0, 12, 0.0, True),
        ),
    ],
)
def test_a_line_needs_four_samples_over_a_second_that_inertial_rows_cover(
    dvl_hz, count, imu_from_s, is_line
):
    """Over an open gap from 10 s on, of a vehicle at rest with the last samples of a log. Else the velocity walks."""
    log = dvl(stamps(dvl_hz, 10.0), 0.0).rows(slice(-count, None))
    inertial = imu(stamps(20.0, 18.0 - imu_from_s, imu_from_s), 0.0)
    known = ways.calibration(velocity_walk_density=0.1)
    found = motion(inertial, log, known, 10.0, 17.0)
    walk_m = np.sqrt(0.1**2 * 7.0**3 / 3.0)
    assert (np.sqrt(found.covariance[3, 3]) < 0.1 * walk_m) == is_line


MS = 1_000_000
STILL = ImuCalibration(turn_sigma_rad_s=(0.0, 0.0, 0.0))
UNMODELLED = Calibration(imu=STILL)
UNLIKE = ImuCalibration(
    turn_sigma_rad_s=(0.05, 0.06, 0.15), turn_time_s=(0.5, 0.55, 1.5)
)
BEGIN_S = 3.0
END_S = 5.0


def with_hole(begin_s=BEGIN_S, end_s=END_S):
    """A vehicle that turns evenly; the rows of a 100 Hz IMU but those of the hole."""
    rows = imu(stamps(100, 8.0), [0.01, -0.02, 0.1])
    t = (rows.stamps_ns - T0_NS) * 1e-9
    return rows.rows((t <= begin_s + 1e-6) | (t >= end_s - 1e-6))


def moved(imu_rows, start_s, end_s, calibration):
    return motion(
        imu_rows, dvl(stamps(5, 8.0), (0.4, 0.0, 0.0)), calibration, start_s, end_s
    )


def turn_variances(*how):
    return np.diag(moved(*how).covariance)[:3]


@pytest.mark.parametrize("length_s", [0.0045, 0.044, 0.046, 0.3, 2.0, 10.0])
def test_the_variances_are_those_of_the_process(length_s):
    """Of the trapezoid by both ends, and of the first rate held; by its covariance function, and series if short."""
    dt = length_s / 400
    t = np.arange(401) * dt
    u = np.abs(t[:, None] - t) / 1.5
    C = 0.2**2 * (1 + u) * np.exp(-u)
    turned = np.full(401, dt)
    turned[[0, -1]] /= 2
    for variance, held in ((closed_variance, [0, -1]), (open_variance, [0, 0])):
        missed = turned.copy()
        np.subtract.at(missed, held, length_s / 2)
        assert variance(0.2, 1.5, length_s) == pytest.approx(
            missed @ C @ missed, rel=3e-4, abs=0.0
        )


def test_a_hole_is_longer_than_five_intervals_and_a_twentieth_second():
    for interval_ms, longest_ms, hole_ms in ((10, 50, 51), (100, 499, 501)):
        ns = T0_NS + interval_ms * MS * np.arange(12)
        assert hole_ns(np.append(ns, ns[-1] + longest_ms * MS), 13, 12, 0) == 0
        assert hole_ns(np.append(ns, ns[-1] + hole_ms * MS), 13, 12, 0) == hole_ms * MS
    uneven = T0_NS + MS * np.cumsum([0, 10, 50, 10, 50, 120])
    # where half of those before are shorter than a fifth
    assert hole_ns(uneven, 6, 5, 0) == 120 * MS


@pytest.mark.parametrize(
    ("span_s", "variance", "length_s"),
    [((2.0, 6.0), closed_variance, 2.0), ((BEGIN_S, 4.9), open_variance, 1.9)],
)
def test_the_turn_over_a_hole_is_as_unsure_as_the_vehicle_is_lively(
    span_s, variance, length_s
):
    """Beside the gyros' noise, wherever Doppler rows cut the hole, about the axes of the body that turned meanwhile.

    While a hole lasts, as unsure as the last rate held.
    """
    rows = with_hole().between(0, at(span_s[1]))
    model = UNLIKE
    extra = turn_variances(rows, *span_s, Calibration(imu=model)) - turn_variances(
        rows, *span_s, UNMODELLED
    )
    expected = [
        variance(model.turn_sigma_rad_s[k], model.turn_time_s[k], length_s)
        for k in range(3)
    ]
    assert extra == pytest.approx(expected, rel=0.06)
    assert expected[2] > 100 * model.gyro_noise_density**2 * 4.0


@pytest.mark.parametrize(("until_s", "beside"), [(4.0, 2), (3.46, 1)])
def test_a_coarse_gyros_rows_beside_a_hole_err_for_all_of_it(until_s, beside):
    """Half a second, closed or open so far: a row has the weight ``(T + dt) / 2``, or ``T + dt / 2``, squared."""
    n = 1e-3
    coarse = ImuCalibration(gyro_noise_density=n, turn_sigma_rad_s=(1e-9,) * 3)
    rows = with_hole(3.0, 3.5).between(0, at(until_s))
    hole_s = min(until_s, 3.5) - 3.0
    by_rows = hole_s**2 / (beside * 0.01)
    assert turn_variances(rows, 2.0, until_s, Calibration(imu=coarse)) == pytest.approx(
        n**2 * (until_s - 2.0 + by_rows), rel=1e-3
    )
