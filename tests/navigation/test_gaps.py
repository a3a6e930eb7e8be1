"""Gaps of the Doppler log and holes of the IMU: covariances, limits, and what estimators make of them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

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
    Turns,
    closed_variance,
    error_in_hole,
    hole_ns,
    open_variance,
)
from sonar_graph.testing import check_consistent

from . import ways
from .rows import NS, T0_NS, at, dvl, imu, nees, stamps
from .ways import DVL, NOISY, QUIET, Vehicle, motion

WITH_OR_WITHOUT = pytest.mark.parametrize(
    "is_blind", [False, True], ids=["accelerometers", "walk"]
)


@WITH_OR_WITHOUT
def test_a_sample_that_ends_a_gap_counts_only_once_inertial_rows_cover_it(is_blind):
    """Before, there is no node at it, and the gap is as open as without it."""
    known = ways.calibration(
        {"accel_noise_density": 1e-2},
        velocity_sigma_m_s=(0.01,) * 3,
        velocity_walk_density=0.02,
    )
    imu, dvl = ways.rows()
    imu = ways.blinded(imu) if is_blind else imu
    seen = imu.between(0, at(ways.FOUND_S) - 1)
    until_s = ways.FOUND_S + 0.05
    open_gap = motion(
        seen, dvl.between(0, at(ways.LOST_S)), known, ways.LOST_S, until_s
    )
    found = motion(seen, dvl.between(0, at(ways.FOUND_S)), known, ways.LOST_S, until_s)
    assert found.i_T_j.equals(open_gap.i_T_j, 0.0)
    assert np.array_equal(found.covariance, open_gap.covariance)
    covered = motion(
        imu, dvl.between(0, at(ways.FOUND_S)), known, ways.LOST_S, ways.FOUND_S
    )
    assert np.trace(covered.covariance[3:, 3:]) < 0.5 * np.trace(
        open_gap.covariance[3:, 3:]
    )


def test_a_gap_that_ends_between_inertial_rows_uses_the_row_after_its_end_and_no_later_one():
    imu, dvl = ways.rows()
    late = Dvl(
        dvl.stamps_ns + NS // 20 * (dvl.stamps_ns >= at(ways.FOUND_S)),
        dvl.velocity,
        dvl.velocity_cov,
    )
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
    known = ways.calibration(
        velocity_walk_density=ways.STEADY if is_blind else ways.ANY_VELOCITY
    )
    found = motion(
        ways.blinded(imu) if is_blind else imu, noisy, known, ways.LOST_S, ways.FOUND_S
    )
    assert np.diag(found.covariance)[3:] == pytest.approx(
        [(0.01**2 + 0.03**2) * 5.0 * (5.0 + 2 * 0.5) / 4] * 3, rel=1e-3
    )


def test_too_few_samples_for_a_line_leave_a_walk():
    imu, dvl = ways.rows()
    known, few = (
        ways.calibration(velocity_walk_density=0.1),
        dvl.rows(dvl.stamps_ns >= at(ways.LOST_S - 1.0)),
    )
    found, walked = (
        motion(part, few, known, ways.LOST_S, ways.OPEN_S)
        for part in (imu, ways.blinded(imu))
    )
    assert found.i_T_j.equals(walked.i_T_j, 0.0)
    assert np.array_equal(found.covariance, walked.covariance)
    assert not motion(imu, dvl, known, ways.LOST_S, ways.OPEN_S).i_T_j.equals(
        walked.i_T_j, 0.1
    )


CHEAP = ImuCalibration(
    gyro_noise_density=3e-4,
    gyro_bias_sigma=1e-3,
    accel_noise_density=1e-2,
    accel_bias_sigma=0.02,
    mounting=QUIET.mounting,
)
"""Accelerometers are surer than a walk at first and less sure after some seconds."""


def total(found, sigma=CHEAP.gyro_bias_sigma):
    """Covariance of the translation with the part of the gyro bias."""
    by_bias = sigma * found.D_bias[3:]
    return found.covariance[3:, 3:] + by_bias @ by_bias.T


def ways_over(known, end_s):
    """Motion over the gap: as it is, by the accelerometers alone, and by a velocity that walks."""
    imu_rows, dvl_rows = Vehicle().rows()
    alone = known.model_copy(
        update={
            "dvl": known.dvl.model_copy(
                update={"velocity_walk_density": ways.ANY_VELOCITY}
            )
        }
    )
    return [
        motion(rows, dvl_rows, calibration, Vehicle.LOST_S, end_s)
        for rows, calibration in (
            (imu_rows, known),
            (imu_rows, alone),
            (ways.blinded(imu_rows), known),
        )
    ]


def test_an_open_gap_has_no_leap_however_long_it_lasts():
    """Mean and sigma change steadily from one inertial row to the next, and the sigma only grows."""
    ends_s = np.arange(Vehicle.LOST_S + 2.0, Vehicle.FOUND_S - 0.5, 0.02)
    found = [ways_over(Calibration(imu=CHEAP, dvl=DVL), end_s)[0] for end_s in ends_s]
    steps = np.diff([one.i_T_j.translation() for one in found], axis=0)
    sigmas = np.sqrt([np.linalg.eigvalsh(total(one)) for one in found])
    assert np.abs(np.diff(steps, axis=0)).max() < 2e-3
    assert min(np.linalg.eigvalsh(one.covariance)[0] for one in found) > 0.0
    assert (np.diff(sigmas, axis=0) > 0.0).all()
    assert np.diff(sigmas, axis=0).max() < 0.01


@pytest.mark.parametrize("end_s", [9.0, 12.0, 15.0, Vehicle.FOUND_S])
def test_a_gap_is_surer_than_by_accelerometers_alone_or_by_a_walk_alone(end_s):
    found, by_accelerometers, walked = (
        total(one) for one in ways_over(Calibration(imu=CHEAP, dvl=DVL), end_s)
    )
    for other in (by_accelerometers, walked):
        assert (
            np.linalg.eigvalsh(other - found).min()
            > -0.02 * np.linalg.eigvalsh(other).min()
        )


@pytest.mark.parametrize("end_s", [14.0, Vehicle.FOUND_S])
def test_perfect_accelerometers_leave_no_walk_and_useless_ones_nothing_else(end_s):
    found, by_accelerometers, _ = ways_over(Calibration(imu=QUIET, dvl=DVL), end_s)
    assert found.i_T_j.equals(by_accelerometers.i_T_j, 1e-3)
    useless = CHEAP.model_copy(update={"accel_noise_density": 1e4})
    found, _, walked = ways_over(Calibration(imu=useless, dvl=DVL), end_s)
    assert found.i_T_j.equals(walked.i_T_j, 1e-3)
    assert found.covariance == pytest.approx(walked.covariance, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("end_s", [14.0, Vehicle.FOUND_S])
def test_the_derivative_by_the_bias_is_that_of_both_parts(end_s):
    """But for the gain, which changes with the bias by a few percent."""
    (imu_rows, dvl_rows), step = Vehicle().rows(), 1e-6
    how = Calibration(imu=CHEAP, dvl=DVL), Vehicle.LOST_S, end_s
    base = motion(imu_rows, dvl_rows, *how)
    moved = [motion(imu_rows, dvl_rows, *how, bias=step * axis) for axis in np.eye(3)]
    columns = [ways.change_of(base, one) / step for one in moved]
    assert base.D_bias == pytest.approx(
        np.transpose(columns), abs=0.03 * np.abs(base.D_bias).max()
    )


def test_motions_in_one_gap_add_up_to_the_whole():
    (imu_rows, dvl_rows), known = Vehicle().rows(), Calibration(imu=CHEAP, dvl=DVL)
    odometry = Odometry(known)
    odometry.add(imu_rows, dvl_rows.between(0, at(Vehicle.LOST_S)))
    cuts_s = [Vehicle.LOST_S, 8.0, 11.0, 15.0]
    parts = [odometry.motion(at(a), at(b), np.zeros(3)) for a, b in pairwise(cuts_s)]
    whole = odometry.motion(at(cuts_s[0]), at(cuts_s[-1]), np.zeros(3))
    added = parts[0].then(parts[1]).then(parts[2])
    assert added.i_T_j.equals(whole.i_T_j, 1e-9)
    assert added.covariance == pytest.approx(whole.covariance, rel=1e-6, abs=1e-9)
    assert added.D_bias == pytest.approx(
        whole.D_bias, abs=1e-9 * np.abs(whole.D_bias).max()
    )


@pytest.mark.parametrize("is_closed", [False, True])
@pytest.mark.parametrize("gap_s", [8.0, 20.0])
def test_the_errors_of_walking_vehicles_are_as_large_as_their_covariance(
    gap_s, is_closed
):
    """Level vehicles whose velocity walks as the calibration has it, gyros and accelerometers with a bias each."""
    rng, rate_hz, q = np.random.default_rng(5), 20.0, 0.05
    before_s = 8.0
    imu_ns = stamps(rate_hz, before_s + gap_s + 2.0)
    every = round(rate_hz / 5.0)
    dvl_ns = imu_ns[::every]
    t = (dvl_ns - T0_NS) * 1e-9
    has_lock = (
        (t <= before_s) | (t > before_s + gap_s - 0.3) if is_closed else t <= before_s
    )
    sensors = CHEAP.model_copy(update={"mounting": ImuCalibration().mounting})
    known = Calibration(
        imu=sensors,
        dvl=DvlCalibration(velocity_walk_density=q, velocity_sigma_m_s=(0.005,) * 3),
    )
    n = len(imu_ns)
    squares = []
    for _ in range(150):
        # piecewise linear between rows, as interpolated
        force = q * np.sqrt(rate_hz) * rng.standard_normal((n, 3))
        middle = 0.5 * (force[1:] + force[:-1]) / rate_hz
        velocity = np.array([0.5, 0.0, 0.0]) + np.vstack(
            [np.zeros(3), np.cumsum(middle, axis=0)]
        )
        noise = np.sqrt(rate_hz) * rng.standard_normal((2, n, 3))
        biases = rng.standard_normal((2, 3))
        rate = (
            sensors.gyro_noise_density * noise[0] + sensors.gyro_bias_sigma * biases[0]
        )
        force = force + [0.0, 0.0, 9.80665] + sensors.accel_noise_density * noise[1]
        force += sensors.accel_bias_sigma * biases[1]
        log = dvl(
            dvl_ns, velocity[::every] + 0.005 * rng.standard_normal((len(dvl_ns), 3))
        )
        end_s = t[has_lock & (t > before_s)][0] if is_closed else before_s + gap_s
        found = motion(
            Imu(imu_ns, rate, force), log.rows(has_lock), known, before_s, end_s
        )
        first = round(before_s * rate_hz)
        last = round(end_s * rate_hz)
        way = (
            np.sum(
                0.5 * (velocity[first + 1 : last + 1] + velocity[first:last]), axis=0
            )
            / rate_hz
        )
        error = found.i_T_j.rotation().unrotate(found.i_T_j.translation() - way)
        squares.append(error @ np.linalg.solve(total(found), error))
    check_consistent(np.array(squares), 3, confidence=0.999)


@pytest.mark.parametrize("until_s", [16.0, 15.9, 14.0])
def test_accelerometers_carry_the_velocity_through_a_long_gap(until_s):
    """Closed or open; a straight line between the ends is wrong by metres."""
    truth = Vehicle().displacement(Vehicle.LOST_S, until_s)
    found, straight = (
        motion(
            *Vehicle().rows(), Calibration(imu=QUIET, dvl=log), Vehicle.LOST_S, until_s
        ).i_T_j.translation()
        for log in (DVL, DVL.model_copy(update={"gap_s": 100.0}))
    )
    assert found == pytest.approx(truth, abs=0.01)
    assert np.linalg.norm(straight - truth) > 0.5


@pytest.mark.parametrize("has_forces", [True, False])
@pytest.mark.parametrize("until_s", [16.0, 14.0])
def test_a_gap_is_crossed_alike_where_the_earth_turns_and_gyros_feel_it(
    until_s, has_forces
):
    """A hundred times as fast; its rate moves the Doppler log's place about the IMU's too, by 2 cm."""
    imu_rows, dvl_rows = Vehicle().imu(stamps(500.0, 20.1)), Vehicle().rows()[1]
    if not has_forces:
        unmeasured = np.full_like(imu_rows.specific_force, np.nan)
        imu_rows = replace(imu_rows, specific_force=unmeasured)
    earth = np.array([0.003, -0.004, 0.005])
    turn = Vehicle().attitude((imu_rows.stamps_ns - at(Vehicle.LOST_S)) * 1e-9)
    feeling = replace(
        imu_rows, angular_velocity=imu_rows.angular_velocity + turn.inv().apply(earth)
    )
    how = Calibration(imu=QUIET, dvl=DVL), Vehicle.LOST_S, until_s
    still, turning = (
        motion(imu_rows, dvl_rows, *how),
        motion(feeling, dvl_rows, *how, earth=earth),
    )
    # between rows without forces the velocity is linear in axes that turn
    tolerance = 1e-3 if has_forces else 4e-3
    off = still.i_T_j.localCoordinates(turning.i_T_j)
    assert np.abs(off).max() < tolerance


@pytest.mark.parametrize("until_s", [16.0, 14.0])
def test_the_covariance_of_a_gap_is_that_of_many_runs(until_s):
    """Noise of gyros, accelerometers and Doppler log, and an accelerometer bias of its own for each run."""
    (imu_rows, dvl_rows), ends = Vehicle().rows(), (Vehicle.LOST_S, until_s)
    truth = motion(
        imu_rows, dvl_rows, Calibration(imu=QUIET, dvl=DVL), *ends
    ).i_T_j.translation()
    rng, errors = np.random.default_rng(0), []
    for _ in range(400):
        noise = rng.standard_normal((2, len(imu_rows), 3)) * np.sqrt(Vehicle.IMU_HZ)
        rate = imu_rows.angular_velocity + NOISY.gyro_noise_density * noise[0]
        bias = NOISY.accel_bias_sigma * rng.standard_normal(3)
        force = imu_rows.specific_force + NOISY.accel_noise_density * noise[1] + bias
        velocity = dvl_rows.velocity + ways.SIGMA * rng.standard_normal(
            dvl_rows.velocity.shape
        )
        measured = (
            Imu(imu_rows.stamps_ns, rate, force),
            Dvl(dvl_rows.stamps_ns, velocity, dvl_rows.velocity_cov),
        )
        found = motion(*measured, Calibration(imu=NOISY, dvl=DVL), *ends)
        errors.append(
            found.i_T_j.rotation().unrotate(found.i_T_j.translation() - truth)
        )
    check_consistent(nees(errors, found.covariance[3:, 3:]), 3, confidence=0.999)


@pytest.mark.parametrize(("until_s", "share"), [(16.0, 12.0), (15.0, 3.0)])
def test_without_accelerometer_the_velocity_is_a_random_walk(until_s, share):
    imu_rows, dvl_rows = Vehicle().rows()
    exact = DVL.model_copy(
        update={"velocity_sigma_m_s": (0.0,) * 3, "velocity_walk_density": 0.05}
    )
    found = motion(
        ways.blinded(imu_rows),
        dvl_rows,
        Calibration(imu=QUIET, dvl=exact),
        Vehicle.LOST_S,
        until_s,
    )
    expected = 0.05**2 * (until_s - Vehicle.LOST_S) ** 3 / share
    assert np.diag(found.covariance)[3:] == pytest.approx([expected] * 3)


def test_nothing_changes_where_no_sample_is_missing():
    """The same bits whatever counts as a gap, between epochs and since one."""
    steady, ns = Vehicle(), stamps(Vehicle.DVL_HZ, 8.0)
    rows = steady.imu(stamps(Vehicle.IMU_HZ, 8.1)), steady.dvl(ns)
    for until_s in (7.0, 1.3):
        one, other = (
            motion(
                *rows,
                Calibration(imu=NOISY, dvl=DVL.model_copy(update={"gap_s": gap_s})),
                1.0,
                until_s,
            )
            for gap_s in (1.5, 100.0)
        )
        assert one.i_T_j.equals(other.i_T_j, 0.0)
        assert np.array_equal(one.covariance, other.covariance)


def brisk_rows(lost_s):
    """A level vehicle whose surge swings by 0.4 m/s within 3 s; the Doppler log, at 5 Hz, is lost after 6 s."""
    imu_ns = stamps(50.0, 12.0)
    dvl_ns = stamps(5.0, 12.0)
    t = (imu_ns - T0_NS) * 1e-9
    s = (dvl_ns - T0_NS) * 1e-9
    w = 2.0 * np.pi / 3.0
    force = np.column_stack([0.4 * w * np.cos(w * t), 0.0 * t, 9.80665 + 0.0 * t])
    velocity = np.column_stack([0.5 + 0.4 * np.sin(w * s), 0.0 * s, 0.0 * s])
    kept = (s <= 6.0) | (s > 6.0 + lost_s - 0.1)
    end_s = float(s[s > 6.0 + lost_s - 0.1][0])
    way_m = 0.5 * (end_s - 6.0) - 0.4 / w * (np.cos(w * end_s) - np.cos(w * 6.0))
    return imu(imu_ns, 0.0, force), dvl(dvl_ns[kept], velocity[kept]), end_s, way_m


@pytest.mark.parametrize("lost_s", [0.6, 0.8, 1.0, 1.2, 1.4, 2.0])
def test_a_short_loss_of_lock_is_crossed_with_its_covariance_on_a_brisk_vehicle(lost_s):
    """By the default calibration; a velocity that is linear for longer is far surer than it is right."""
    inertial, doppler, end_s, way_m = brisk_rows(lost_s)
    off = {}
    for name, log in (
        ("default", DvlCalibration()),
        ("linear", DvlCalibration(gap_s=10.0)),
    ):
        found = motion(inertial, doppler, Calibration(dvl=log), 6.0, end_s)
        off[name] = (found.i_T_j.x() - way_m) / found.covariance[3, 3] ** 0.5
    assert abs(off["default"]) < 2.0
    assert abs(off["linear"]) > 2.0 * abs(off["default"])


@pytest.mark.parametrize("turns_s", [(7.0, 9.0), (0.0, 6.5)])
def test_in_a_gap_the_body_keeps_its_velocity_not_the_place_of_the_doppler_log(turns_s):
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


@pytest.mark.parametrize("start_s", [6.5, 9.0, 12.0, 15.5])
def test_the_rest_of_a_closed_gap_errs_as_a_velocity_that_walks_between_both_ends(
    start_s,
):
    """Drawn Brownian bridges; the same for a single motion and for those over intervals."""
    imu_rows, dvl_rows = Vehicle().rows()
    calibration = Calibration(
        imu=QUIET, dvl=DVL.model_copy(update={"velocity_sigma_m_s": (0.0,) * 3})
    )
    odometry = Odometry(calibration)
    odometry.add(imu_rows, dvl_rows)
    start_ns, end_ns = at(start_s), at(Vehicle.FOUND_S)
    known_ns = int(odometry.reached_ns(end_ns))
    one = odometry.motion(start_ns, end_ns, np.zeros(3), None, known_ns)
    stamps_ns = np.array([start_ns, (start_ns + end_ns) // 2, end_ns])
    parts = odometry.motions(
        stamps_ns[:-1], stamps_ns[1:], np.full(2, known_ns), np.zeros(3), over_gaps=True
    )
    rng = np.random.default_rng(3)
    T = Vehicle.FOUND_S - Vehicle.LOST_S
    n = 1000
    steps = 0.1 * np.sqrt(T / n) * rng.standard_normal((4000, n))
    walk = np.cumsum(steps, axis=1)
    bridge = walk - np.linspace(1 / n, 1, n) * walk[:, -1:]
    last = round(n * (Vehicle.FOUND_S - start_s) / T)
    drawn_m2 = np.var(bridge[:, -last:].sum(axis=1) * T / n)
    assert np.diag(one.covariance)[3:] == pytest.approx(3 * [drawn_m2], rel=0.1)
    total = parts.C[:, 3:, 3:].sum(axis=0)
    assert np.diag(total) == pytest.approx(np.diag(one.covariance)[3:], rel=1e-6)


def over_closed_gap(imu_rows, dvl_rows, calibration, start_s):
    """Length and motion of a gap that a confirmed velocity ends."""
    odometry = Odometry(calibration)
    odometry.add(imu_rows, dvl_rows)
    end_ns = int(odometry.epochs(at(start_s), at(1e3))[0])
    known_ns = odometry.reached_ns(end_ns)
    found = odometry.motion(at(start_s), end_ns, np.zeros(3), None, known_ns)
    return found.duration_s, found


def at_rest(gap_s, imu_hz=20.0, turn=(0.0, 0.0, 0.0), sigma_m_s=0.0, walk=1e3, **noise):
    """Motion of a level vehicle at rest over a closed gap after 6 s, by gyros with a constant error."""
    imu_ns = stamps(imu_hz, 7.0 + gap_s)
    dvl_ns = stamps(5.0, 7.0 + gap_s)
    s = (dvl_ns - T0_NS) * 1e-9
    kept = (s < 6.01) | (s > 5.99 + gap_s)
    sensors = QUIET.model_copy(update={"mounting": Mounting(), **noise})
    log = DvlCalibration(
        velocity_sigma_m_s=(sigma_m_s,) * 3, velocity_walk_density=walk
    )
    return over_closed_gap(
        imu(imu_ns, turn),
        dvl(dvl_ns[kept], 0.0),
        Calibration(imu=sensors, dvl=log),
        6.0,
    )[1]


def test_what_the_square_of_a_gyro_bias_does_to_the_height_has_its_second_moment_in_the_covariance():
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


def test_a_line_with_less_doppler_noise_than_the_last_sample_replaces_it():
    """A sample of 50 mm/s twice off after a second of zeros; a vehicle that hardly walks, and exact accelerometers."""
    imu_ns = stamps(50.0, 9.0)
    dvl_ns = stamps(5.0, 6.0)
    velocity = np.zeros((len(dvl_ns), 3))
    velocity[-1, 0] = 0.1
    found = [
        motion(
            imu(imu_ns, 0.0),
            dvl(dvl_ns, velocity),
            Calibration(
                imu=QUIET,
                dvl=DvlCalibration(
                    velocity_sigma_m_s=(0.05,) * 3, velocity_walk_density=walk
                ),
            ),
            6.0,
            7.0,
        ).i_T_j.x()
        for walk in (0.02, 1e3)
    ]
    assert found[0] == pytest.approx(found[1], abs=1e-4)
    assert abs(found[1]) < 0.04


@pytest.mark.parametrize("gap_s", [3.0, 10.0])
def test_a_turn_with_a_constant_force_needs_no_fast_imu(gap_s):
    """On a circle rate and force are constant in the body: ten times as many rows change nothing."""
    w = 0.5
    v = 1.0
    found = []
    for imu_hz in (5.0, 50.0):
        imu_ns = stamps(imu_hz, 8.0 + gap_s)
        dvl_ns = stamps(5.0, 8.0 + gap_s)
        s = (dvl_ns - T0_NS) * 1e-9
        kept = (s < 6.01) | (s > 5.99 + gap_s)
        log = DvlCalibration(velocity_sigma_m_s=(0.0,) * 3, velocity_walk_density=1e3)
        known = Calibration(
            imu=NOISY.model_copy(update={"mounting": Mounting()}), dvl=log
        )
        rows = (
            imu(imu_ns, (0.0, 0.0, w), (0.0, v * w, 9.80665)),
            dvl(dvl_ns[kept], (v, 0.0, 0.0)),
        )
        found.append(over_closed_gap(*rows, known, 6.0))
    (lasts_s, coarse), (_, fine) = found
    true_m = v / w * np.array([np.sin(w * lasts_s), 1.0 - np.cos(w * lasts_s), 0.0])
    assert coarse.i_T_j.translation() == pytest.approx(true_m, abs=1e-4)
    scale = np.sqrt(np.diag(fine.covariance))
    off = (coarse.covariance - fine.covariance) / np.outer(scale, scale)
    assert np.abs(off).max() < 1e-2
    assert np.abs(off[:3, 3:]).max() < 3e-4


@pytest.mark.parametrize("shift_ms", [0, 1], ids=["with the IMU", "between its rows"])
@pytest.mark.parametrize("gap_s", [5.0, 60.0])
def test_the_rest_of_a_closed_gap_is_known_wherever_the_imu_cuts(shift_ms, gap_s):
    """The last 2 s of a gap in which a vehicle gets faster; the epoch that ends it is reached with the next IMU row."""
    imu_ns = stamps(100.0, 12.0 + gap_s)
    dvl_ns = stamps(5.0, 11.0 + gap_s) + shift_ms * NS // 1000
    s = (dvl_ns - T0_NS) * 1e-9
    kept = (s < 10.1) | (s > 9.9 + gap_s)
    faster_m_s = 0.02 * np.clip(s - 10.0, 0.0, None)
    velocity = np.column_stack([0.5 + faster_m_s, 0.0 * s, 0.0 * s])
    t = (imu_ns - T0_NS) * 1e-9
    force = np.column_stack([np.where(t > 10.0, 0.02, 0.0), 0.0 * t, 9.80665 + 0.0 * t])
    odometry = Odometry(Calibration())
    odometry.add(imu(imu_ns, 0.0, force), dvl(dvl_ns[kept], velocity[kept]))
    end_ns = int(odometry.epochs(at(11.0), int(imu_ns[-1]))[0])
    start_ns = end_ns - 2 * NS
    found = odometry.motion(start_ns, end_ns, np.zeros(3), None, int(imu_ns[-1]))
    end_s = (end_ns - T0_NS) * 1e-9
    assert found.i_T_j.x() == pytest.approx(1.0 + 0.04 * (end_s - 11.0), abs=0.02)
    assert found.covariance[3, 3] > 0.05**2


KNOWN_START = Start(position_sigma_m=(0.0,) * 3, rpy_sigma_rad=(0.0,) * 3)
UNSURE = Start(position_sigma_m=(1e-6,) * 3, rpy_sigma_rad=(1e-6,) * 3)
ESTIMATORS = ("dead-reckoning", "ekf-slam", "invariant-ekf", "isam2")


def estimates(name, blocks, start=KNOWN_START):
    """The last estimate of an estimator that is given blocks of rows until instants."""
    calibration = Calibration(imu=NOISY, dvl=DVL, start=start, use_gravity=False)
    estimator = load_estimator(name)(calibration, Odometry(calibration))
    return [
        estimator.process(Measurements(until_ns, *block)) for until_ns, block in blocks
    ][-1]


def cut(until_ns):
    """Rows between successive instants."""
    imu_rows, dvl_rows = Vehicle().rows()
    return [
        (end, (imu_rows.between(begin, end), dvl_rows.between(begin, end)))
        for begin, end in pairwise([0, *until_ns])
    ]


@pytest.mark.parametrize("until_s", [13.0, 18.0])
def test_every_estimator_moves_alike_over_a_gap(until_s):
    first, *others = [
        estimates(name, cut([at(until_s)]), UNSURE) for name in ESTIMATORS
    ]
    for other in others:
        assert other.world_T_body.translation() == pytest.approx(
            first.world_T_body.translation(), abs=1e-4
        )
        assert other.covariance == pytest.approx(first.covariance, rel=0.01, abs=1e-6)


@pytest.mark.parametrize("name", ESTIMATORS[:3])
def test_an_estimate_in_a_gap_does_not_depend_on_how_rows_are_cut(name):
    whole, pieces = (
        estimates(name, cut(ends))
        for ends in ([at(14.0)], [at(0.37 * k) for k in range(1, 37)] + [at(14.0)])
    )
    assert pieces.world_T_body.equals(whole.world_T_body, 1e-9)
    assert pieces.covariance == pytest.approx(whole.covariance, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_samples_out_of_order_give_the_same_estimate_as_in_order(name):
    """A block of each sensor overtakes the one before it."""
    blocks = [block for _, block in cut([at(2.0), at(2.45), at(2.55), at(5.0)])]
    blocks[1] = blocks[1][0], Vehicle().rows()[1].between(at(2.0), at(2.0) + NS // 4)
    found = [
        estimates(
            name, [(at(5.0) if k == 3 else at(2.0), blocks[k]) for k in order], UNSURE
        )
        for order in ([0, 1, 2, 3], [0, 2, 1, 3])
    ]
    assert found[1].world_T_body.equals(found[0].world_T_body, 1e-9)
    assert found[1].covariance == pytest.approx(
        found[0].covariance, rel=1e-6, abs=1e-12
    )


def at_rest_until(until_s, dvl_hz, count=0, imu_from_s=0.0, noise=0.0, **known):
    """Over an open gap from 10 s on, of a vehicle at rest with the last samples of a log."""
    samples_ns = stamps(dvl_hz, 10.0)
    log = dvl(samples_ns, noise)
    log = log.rows(slice(len(log) - count, None)) if count else log
    inertial = imu(stamps(20.0, until_s + 1.0 - imu_from_s, imu_from_s), 0.0)
    return motion(inertial, log, ways.calibration(**known), 10.0, until_s)


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
    """Else the velocity walks."""
    found = at_rest_until(17.0, dvl_hz, count, imu_from_s, velocity_walk_density=0.1)
    walk_m = np.sqrt(0.1**2 * 7.0**3 / 3.0)
    assert (np.sqrt(found.covariance[3, 3]) < 0.1 * walk_m) == is_line


def test_the_displacement_is_that_of_the_fitted_line():
    """Samples of the last five seconds, off gravity's line, are fitted by least squares, as numpy does."""
    noise = 0.01 * np.random.default_rng(0).standard_normal((41, 3))
    found = at_rest_until(17.0, 4.0, noise=noise)
    t = -np.arange(20, -1, -1) / 4.0
    slope, level = np.polyfit(t, noise[-21:], 1)
    assert found.i_T_j.translation() == pytest.approx(
        7.0 * level + 7.0**2 / 2 * slope, abs=1e-6
    )


MS = 1_000_000
STILL = ImuCalibration(turn_sigma_rad_s=(0.0, 0.0, 0.0))
UNMODELLED = Calibration(imu=STILL)
UNLIKE = ImuCalibration(
    turn_sigma_rad_s=(0.05, 0.06, 0.15), turn_time_s=(0.5, 0.55, 1.5)
)
BEGIN_S, END_S = 3.0, 5.0


def with_hole(begin_s=BEGIN_S, end_s=END_S, seconds=8.0):
    """A vehicle that turns evenly; the rows of a 100 Hz IMU but those of the hole."""
    rows = imu(stamps(100, seconds), [0.01, -0.02, 0.1])
    t = (rows.stamps_ns - T0_NS) * 1e-9
    return rows.rows((t <= begin_s + 1e-6) | (t >= end_s - 1e-6))


def moved(imu_rows, start_s, end_s, calibration=None, velocity=(0.4, 0.0, 0.0)):
    return motion(
        imu_rows,
        dvl(stamps(5, 8.0), velocity),
        calibration or Calibration(),
        start_s,
        end_s,
    )


def turn_variances(*how):
    return np.diag(moved(*how).covariance)[:3]


@pytest.mark.parametrize("length_s", [0.5, 2.0, 10.0])
def test_the_variances_are_those_of_drawn_rates(length_s):
    """Of the trapezoid by both ends, and of the first rate held; drawn by the covariance function of the process."""
    sigma, time_s, dt = 0.2, 1.5, length_s / 400
    t = np.arange(401) * dt
    u = np.abs(t[:, None] - t) / time_s
    root = np.linalg.cholesky(
        sigma**2 * ((1 + u) * np.exp(-u) + 1e-10 * np.eye(len(t)))
    )
    w = np.random.default_rng(0).standard_normal((6000, len(t))) @ root.T
    turned = dt * (w.sum(axis=1) - 0.5 * (w[:, 0] + w[:, -1]))
    closed = np.var(turned - length_s * (w[:, 0] + w[:, -1]) / 2)
    opened = np.var(turned - length_s * w[:, 0])
    assert closed_variance(sigma, time_s, length_s) == pytest.approx(closed, rel=0.06)
    assert open_variance(sigma, time_s, length_s) == pytest.approx(opened, rel=0.06)


@pytest.mark.parametrize(
    ("variance", "power", "share"), [(closed_variance, 5, 30), (open_variance, 4, 4)]
)
def test_short_holes_follow_their_series_without_a_step(variance, power, share):
    lengths = np.geomspace(0.003, 0.3, 60)
    found = np.array([variance(1.0, 1.0, a) for a in lengths])
    assert found[0] == pytest.approx(lengths[0] ** power / share, rel=3e-3)
    slopes = np.diff(np.log(found)) / np.diff(np.log(lengths))
    assert np.all(np.abs(slopes - power) < 0.2)


def test_a_hole_is_longer_than_five_typical_intervals_and_a_twentieth_of_a_second():
    for interval_ms, longest_ms, hole_ms in ((10, 50, 51), (100, 499, 501)):
        ns = T0_NS + interval_ms * MS * np.arange(12)
        assert hole_ns(np.append(ns, ns[-1] + longest_ms * MS), 13, 12, 0) == 0
        assert hole_ns(np.append(ns, ns[-1] + hole_ms * MS), 13, 12, 0) == hole_ms * MS
    uneven = T0_NS + MS * np.cumsum([0, 10, 50, 10, 50, 120])
    # where half of those before are shorter than a fifth
    assert hole_ns(uneven, 6, 5, 0) == 120 * MS


def test_an_open_hole_lasts_from_the_last_known_row():
    """And one that only rows not yet known would close is open as well."""
    ns = T0_NS + 10 * MS * np.arange(12)
    later = np.append(ns, ns[-1] + NS)
    for known in (ns, later):
        assert hole_ns(known, 12, 12, int(ns[-1]) + 40 * MS) == 0
        assert hole_ns(known, 12, 12, int(ns[-1]) + 700 * MS) == 700 * MS


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
    rows, model = with_hole().between(0, at(span_s[1])), UNLIKE
    extra = turn_variances(rows, *span_s, Calibration(imu=model)) - turn_variances(
        rows, *span_s, UNMODELLED
    )
    expected = [
        variance(model.turn_sigma_rad_s[k], model.turn_time_s[k], length_s)
        for k in range(3)
    ]
    assert extra == pytest.approx(expected, rel=0.06)
    assert expected[2] > 100 * model.gyro_noise_density**2 * 4.0


@pytest.mark.parametrize("until_s", [4.0, 3.46], ids=["closed", "open"])
@pytest.mark.parametrize("is_modelled", [True, False])
def test_a_coarse_gyros_rows_beside_a_hole_err_for_all_of_it(until_s, is_modelled):
    """Against rates drawn for a vehicle at rest, a hole of half a second."""
    known, rng = with_hole(3.0, 3.5).between(0, at(until_s)), np.random.default_rng(3)
    coarse = ImuCalibration(
        gyro_noise_density=1e-3, turn_sigma_rad_s=(1e-6 * is_modelled,) * 3
    )
    turned = []
    for _ in range(150):
        rates = rng.normal(0.0, 1e-3 / np.sqrt(0.01), (len(known), 3))
        found = moved(
            replace(known, angular_velocity=rates),
            2.0,
            until_s,
            Calibration(imu=coarse),
        )
        turned.append(
            found.i_T_j.rotation().rpy() / np.sqrt(np.diag(found.covariance)[:3])
        )
    nees = np.mean(np.square(turned))
    assert nees == pytest.approx(1.0, abs=0.2) if is_modelled else nees > 4.0


def test_the_noise_of_rows_goes_by_the_interval_that_is_typical():
    """By hand: density 2, rows 10 ms apart but for one lost, and the third of three steps of an open hole."""
    ns = T0_NS + MS * np.array([0, 10, 20, 30, 50, 60, 70, 80, 90])
    turns = Turns(True, np.full(3, 1e-9), np.ones(3), 2.0)
    until_ns = int(ns[-1]) + 300 * MS
    opened = error_in_hole(turns, ns, 9, 9, until_ns - 100 * MS, until_ns)
    assert opened == pytest.approx((4.0 / 0.01 * (0.3**2 - 0.2**2) / 0.1,) * 3)
    closed = error_in_hole(
        turns, np.append(ns, until_ns), 10, 9, until_ns - 100 * MS, until_ns
    )
    assert closed == pytest.approx((4.0 / 0.01 * 0.3 / 2,) * 3)
    alone = error_in_hole(
        turns, ns[:1], 1, 1, int(ns[0]) + 2000 * MS, int(ns[0]) + 2100 * MS
    )
    assert max(alone) < 1e-15


def test_in_a_hole_with_doppler_rows_the_way_is_by_these():
    """Longer than a gap: the vehicle gets faster while nothing but the Doppler log tells."""
    velocity = np.where(
        (stamps(5, 8.0) - T0_NS)[:, None] * 1e-9 > 4.1, [0.6, 0.0, 0.0], [0.4, 0.0, 0.0]
    )
    found = moved(imu(stamps(100, BEGIN_S), 0.0), BEGIN_S, 7.1, None, velocity)
    assert found.i_T_j.translation()[0] == pytest.approx(
        0.4 * 1.0 + 0.5 * 0.2 + 0.6 * 2.9, abs=1e-6
    )
    assert np.sqrt(found.covariance[3, 3]) < 0.05


def test_nothing_changes_where_rows_are_lost_or_jittered_or_samples_held():
    """To the bit, with and without the model: a lost row, three in a row, stamps that wander by a third."""
    whole = imu(stamps(100, 8.0), [0.01, -0.02, 0.1])
    lost = whole.rows(~np.isin(np.arange(len(whole)), [50, 300, 301, 302, 420]))
    jitter = np.random.default_rng(1).integers(-3 * MS, 3 * MS, len(whole))
    jittered = replace(
        whole, stamps_ns=whole.stamps_ns + jitter * (np.arange(len(whole)) > 0)
    )
    held = Calibration(odometry_interpolation="hold-past")
    for rows, known in (
        (whole, Calibration()),
        (lost, Calibration()),
        (jittered, Calibration()),
        (with_hole(), held),
    ):
        unmodelled = known.model_copy(update={"imu": STILL})
        assert np.array_equal(
            turn_variances(rows, 1.0, 7.0, known),
            turn_variances(rows, 1.0, 7.0, unmodelled),
        )


def test_specific_force_is_not_measured_in_a_hole():
    """Interpolated over it, it would be taken for gravity; over 80 ms it still is."""
    for end_s, span_s, is_felt in (
        (END_S, (1.0, 3.0), True),
        (END_S, (2.0, 6.0), False),
        (3.08, (2.0, 6.0), True),
    ):
        assert (
            np.isfinite(moved(with_hole(end_s=end_s), *span_s).mean_specific_force)
            == is_felt
        ).all()


def test_a_gap_of_the_doppler_log_with_a_hole_in_it_is_a_walk():
    """Accelerometers that were not there do not carry the velocity."""
    ns, calibration = stamps(5, 8.0), Calibration()
    log = dvl(ns[(ns <= at(2.6)) | (ns >= at(5.4))], [0.4, 0.0, 0.0])
    whole, holed = (
        np.diag(motion(rows, log, calibration, 2.6, 5.4).covariance)[3]
        for rows in (imu(stamps(100, 8.0), 0.0), with_hole())
    )
    walk = calibration.dvl.velocity_walk_density**2 * 2.8**3 / 12
    assert whole < 0.5 * walk < walk < holed


def test_forgetting_rows_in_a_hole_changes_nothing():
    """What is typical is told by rows long before a node in a long hole."""
    whole, forgetful = Odometry(Calibration()), Odometry(Calibration())
    for odometry in (whole, forgetful):
        odometry.add(with_hole(2.0, 16.0, 20.0), dvl(stamps(5, 20.0), (0.4, 0.0, 0.0)))
    forgetful.forget_before(at(15.0))
    one, other = (
        told.motion(at(15.0), at(18.0), np.zeros(3)).covariance
        for told in (whole, forgetful)
    )
    assert np.array_equal(one, other)
    assert one[2, 2] > 1e-3
