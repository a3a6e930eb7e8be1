"""How far a vehicle turns while no inertial row comes: against drawn processes, and what it must not touch."""

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.calibration import Calibration, ImuCalibration
from sonar_graph.errors import MeasurementError
from sonar_graph.navigation.imu_gaps import closed_variance, hole_ns, open_variance, turn_psd
from sonar_graph.navigation.odometry import Odometry, motion_between_nodes
from sonar_graph.navigation.preintegration.joint_preintegration import JointPreintegrator
from sonar_graph.navigation.preintegration.motion import Preintegrator

from .rows import NS, T0_NS, at, dvl, imu, stamps
from .vehicle import motion

MS = 1_000_000
STILL = ImuCalibration(turn_sigma_rad_s=(0.0, 0.0, 0.0))
UNMODELLED = Calibration(imu=STILL)
UNLIKE = ImuCalibration(turn_sigma_rad_s=(0.05, 0.06, 0.15), turn_time_s=(0.5, 0.55, 1.5))
BEGIN_S, END_S = 3.0, 5.0


def with_hole(begin_s=BEGIN_S, end_s=END_S, seconds=8.0):
    """A vehicle that turns evenly; the rows of a 100 Hz IMU but those of the hole."""
    rows = imu(stamps(100, seconds), [0.01, -0.02, 0.1])
    t = (rows.stamps_ns - T0_NS) * 1e-9
    return rows.rows((t <= begin_s + 1e-6) | (t >= end_s - 1e-6))


def moved(imu_rows, start_s, end_s, calibration=None, velocity=(0.4, 0.0, 0.0)):
    return motion(imu_rows, dvl(stamps(5, 8.0), velocity), calibration or Calibration(), start_s, end_s)


def turn_variances(*how):
    return np.diag(moved(*how).covariance)[:3]


@pytest.mark.parametrize("length_s", [0.5, 2.0, 10.0])
def test_the_variances_are_those_of_drawn_rates(length_s):
    """Of the trapezoid by both ends, and of the first rate held; drawn by the covariance function of the process."""
    sigma, time_s, dt = 0.2, 1.5, length_s / 400
    t = np.arange(401) * dt
    u = np.abs(t[:, None] - t) / time_s
    root = np.linalg.cholesky(sigma**2 * ((1 + u) * np.exp(-u) + 1e-10 * np.eye(len(t))))
    w = np.random.default_rng(0).standard_normal((6000, len(t))) @ root.T
    turned = dt * (w.sum(axis=1) - 0.5 * (w[:, 0] + w[:, -1]))
    closed = np.var(turned - length_s * (w[:, 0] + w[:, -1]) / 2)
    opened = np.var(turned - length_s * w[:, 0])
    assert closed_variance(sigma, time_s, length_s) == pytest.approx(closed, rel=0.06)
    assert open_variance(sigma, time_s, length_s) == pytest.approx(opened, rel=0.06)


@pytest.mark.parametrize(("variance", "power", "share"), [(closed_variance, 5, 30), (open_variance, 4, 4)])
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


def test_an_open_hole_lasts_from_the_last_known_row():
    """And one that only rows not yet known would close is open as well."""
    ns = T0_NS + 10 * MS * np.arange(12)
    later = np.append(ns, ns[-1] + NS)
    for known in (ns, later):
        assert hole_ns(known, 12, 12, int(ns[-1]) + 40 * MS) == 0
        assert hole_ns(known, 12, 12, int(ns[-1]) + 700 * MS) == 700 * MS


@pytest.mark.parametrize(
    ("span_s", "variance", "length_s"), [((2.0, 6.0), closed_variance, 2.0), ((BEGIN_S, 4.9), open_variance, 1.9)]
)
def test_the_turn_over_a_hole_is_as_unsure_as_the_vehicle_is_lively(span_s, variance, length_s):
    """Beside the gyros' noise, wherever Doppler rows cut the hole, about the axes of the body that turned meanwhile.

    While a hole lasts, as unsure as the last rate held.
    """
    rows, model = with_hole().between(0, at(span_s[1])), UNLIKE
    extra = turn_variances(rows, *span_s, Calibration(imu=model)) - turn_variances(rows, *span_s, UNMODELLED)
    expected = [variance(model.turn_sigma_rad_s[k], model.turn_time_s[k], length_s) for k in range(3)]
    assert extra == pytest.approx(expected, rel=0.06)
    assert expected[2] > 100 * model.gyro_noise_density**2 * 4.0


@pytest.mark.parametrize("until_s", [4.0, 3.46], ids=["closed", "open"])
@pytest.mark.parametrize("is_modelled", [True, False])
def test_a_coarse_gyros_rows_beside_a_hole_err_for_all_of_it(until_s, is_modelled):
    """Against rates drawn for a vehicle at rest, a hole of half a second."""
    known, rng = with_hole(3.0, 3.5).between(0, at(until_s)), np.random.default_rng(3)
    coarse = ImuCalibration(gyro_noise_density=1e-3, turn_sigma_rad_s=(1e-6 * is_modelled,) * 3)
    turned = []
    for _ in range(150):
        rates = rng.normal(0.0, 1e-3 / np.sqrt(0.01), (len(known), 3))
        found = moved(replace(known, angular_velocity=rates), 2.0, until_s, Calibration(imu=coarse))
        turned.append(found.i_T_j.rotation().rpy() / np.sqrt(np.diag(found.covariance)[:3]))
    nees = np.mean(np.square(turned))
    assert nees == pytest.approx(1.0, abs=0.2) if is_modelled else nees > 4.0


def test_the_noise_of_rows_goes_by_the_interval_that_is_typical():
    """By hand: density 2, rows 10 ms apart but for one lost, and the third of three steps of an open hole."""
    ns = T0_NS + MS * np.array([0, 10, 20, 30, 50, 60, 70, 80, 90])
    turns = ((1e-9,) * 3, (1.0,) * 3, 2.0)
    until_ns = int(ns[-1]) + 300 * MS
    opened = turn_psd(turns, ns, 9, 9, until_ns - 100 * MS, until_ns)
    assert opened == pytest.approx((4.0 / 0.01 * (0.3**2 - 0.2**2) / 0.1,) * 3)
    closed = turn_psd(turns, np.append(ns, until_ns), 10, 9, until_ns - 100 * MS, until_ns)
    assert closed == pytest.approx((4.0 / 0.01 * 0.3 / 2,) * 3)
    alone = turn_psd(turns, ns[:1], 1, 1, int(ns[0]) + 2000 * MS, int(ns[0]) + 2100 * MS)
    assert max(alone) < 1e-15


def test_in_a_hole_with_doppler_rows_the_way_is_by_these():
    """Longer than a gap: the vehicle gets faster while nothing but the Doppler log tells."""
    velocity = np.where((stamps(5, 8.0) - T0_NS)[:, None] * 1e-9 > 4.1, [0.6, 0.0, 0.0], [0.4, 0.0, 0.0])
    found = moved(imu(stamps(100, BEGIN_S), 0.0), BEGIN_S, 7.1, None, velocity)
    assert found.i_T_j.translation()[0] == pytest.approx(0.4 * 1.0 + 0.5 * 0.2 + 0.6 * 2.9, abs=1e-6)
    assert np.sqrt(found.covariance[3, 3]) < 0.05


def test_nothing_changes_where_rows_are_lost_or_jittered_or_samples_held():
    """To the bit, with and without the model: a lost row, three in a row, stamps that wander by a third."""
    whole = imu(stamps(100, 8.0), [0.01, -0.02, 0.1])
    lost = whole.rows(~np.isin(np.arange(len(whole)), [50, 300, 301, 302, 420]))
    jitter = np.random.default_rng(1).integers(-3 * MS, 3 * MS, len(whole))
    jittered = replace(whole, stamps_ns=whole.stamps_ns + jitter * (np.arange(len(whole)) > 0))
    held = Calibration(odometry_interpolation="hold-past")
    for rows, known in ((whole, Calibration()), (lost, Calibration()), (jittered, Calibration()), (with_hole(), held)):
        unmodelled = known.model_copy(update={"imu": STILL})
        assert np.array_equal(turn_variances(rows, 1.0, 7.0, known), turn_variances(rows, 1.0, 7.0, unmodelled))


def test_specific_force_is_not_measured_in_a_hole():
    """Interpolated over it, it would be taken for gravity; over 80 ms it still is."""
    for end_s, span_s, is_felt in ((END_S, (1.0, 3.0), True), (END_S, (2.0, 6.0), False), (3.08, (2.0, 6.0), True)):
        assert (np.isfinite(moved(with_hole(end_s=end_s), *span_s).mean_specific_force) == is_felt).all()


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
    assert len(forgetful.columns()[0]) < len(whole.columns()[0])
    ends, preintegrator = (at(15.0), at(18.0), np.zeros(3), None), Preintegrator.from_calibration(Calibration())
    one, other = (motion_between_nodes(told, preintegrator, *ends).covariance for told in (whole, forgetful))
    assert np.array_equal(one, other)
    assert one[2, 2] > 1e-3


def test_joint_preintegration_refuses_a_hole_and_names_it():
    samples, joint = dvl(stamps(5, 8.0), 0.4, 1e-4 * np.eye(3)), JointPreintegrator(1e-4, 1e-3)
    with pytest.raises(MeasurementError, match=rf"no row for 2 s after {at(BEGIN_S)} ns"):
        joint.integrate(with_hole(), samples, at(2.0), at(6.0))
    assert joint.integrate(with_hole(), samples, at(1.0), at(3.0)).duration_s == 2.0
    tolerant = replace(joint, longest_hole_s=2.5)
    assert tolerant.integrate(with_hole(), samples, at(2.0), at(6.0)).duration_s == 4.0
    for rows in (with_hole(end_s=BEGIN_S + 0.05), imu(stamps(8, 8.0), 0.0)):
        assert joint.integrate(rows, samples, at(2.0), at(6.0)).duration_s == 4.0
