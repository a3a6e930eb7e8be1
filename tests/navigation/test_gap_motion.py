"""Motion over gaps against derivatives by differences: of every sample, of biases, of the Earth's rotation."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.odometry import Odometry, motion_between_nodes, motion_since_node
from sonar_graph.navigation.preintegration.motion import Preintegrator

from .rows import NS, T0_NS, stamps

IMU_HZ, DVL_HZ = 10.0, 2.0
LOST_S, FOUND_S, OPEN_S, WAITS_S = 6.0, 11.0, 10.8, 1e-3
BODY_P_IMU, BODY_P_DVL = np.array([0.2, -0.1, 0.1]), np.array([-0.5, 0.3, -0.2])
SIGMA_M_S = (0.01, 0.02, 0.005)
NO_NOISE = {"gyro_noise_density": 0.0, "accel_noise_density": 0.0, "accel_bias_sigma": 0.0}
BOTH = pytest.mark.parametrize("until_s", [FOUND_S, OPEN_S], ids=["closed", "open"])
WITH_OR_WITHOUT = pytest.mark.parametrize("is_blind", [False, True], ids=["accelerometers", "walk"])


def attitude(t):
    """Rolling, pitching and turning, by hand."""
    return Rotation.from_euler(
        "ZYX", np.column_stack([0.2 * t + 0.1 * np.sin(t), 0.1 * np.sin(0.6 * t), 0.15 * np.cos(0.5 * t)])
    )


def rate_at(t):
    return (attitude(t - 1e-4).inv() * attitude(t + 1e-4)).as_rotvec() / 2e-4


def velocity_at(t):
    """Of the IMU's point in the world."""
    return np.column_stack([1.0 + 0.2 * np.sin(t), 0.4 * np.cos(0.5 * t), 0.1 * np.sin(0.8 * t)])


def acceleration_at(t):
    return np.column_stack([0.2 * np.cos(t), -0.2 * np.sin(0.5 * t), 0.08 * np.cos(0.8 * t)])


def at(seconds):
    return T0_NS + round(seconds * NS)


def rows(lever=BODY_P_DVL - BODY_P_IMU, dvl_hz=DVL_HZ):
    """Without the velocity in two gaps, which end when a row confirms one shortly before it."""
    imu_ns = stamps(IMU_HZ, 16.5)
    dvl_ns = np.union1d(stamps(dvl_hz, 16.0), [at(FOUND_S - WAITS_S), at(15.0 - WAITS_S)])
    t, s = ((ns - T0_NS) * 1e-9 for ns in (imu_ns, dvl_ns))
    force = attitude(t).inv().apply(acceleration_at(t) + np.array([0.0, 0.0, 9.8]))
    velocity = attitude(s).inv().apply(velocity_at(s)) + np.cross(rate_at(s), lever)
    kept = ((s <= LOST_S) | (s > FOUND_S - 2 * WAITS_S)) & ((s <= 12.0) | (s > 15.0 - 2 * WAITS_S))
    return Imu(imu_ns, rate_at(t), force), Dvl(dvl_ns[kept], velocity[kept], np.full((int(kept.sum()), 3, 3), np.nan))


def calibration(imu=None, body_p_imu=BODY_P_IMU, **dvl):
    sensors = ImuCalibration(**{**NO_NOISE, **(imu or {})}, mounting=Mounting(translation_m=tuple(body_p_imu)))
    doppler = {"velocity_sigma_m_s": (0.0,) * 3, "velocity_walk_density": 1e-9, **dvl}
    return Calibration(imu=sensors, dvl=DvlCalibration(**doppler, mounting=Mounting(translation_m=tuple(BODY_P_DVL))))


def motion(imu, dvl, known, start_s, until_s, bias=(0.0, 0.0, 0.0), earth=None):
    """From a node; to a node by the final motion, to anywhere else by the provisional one, which sees no later row."""
    odometry, preintegrator = Odometry(known), Preintegrator.from_calibration(known)
    odometry.add(imu, dvl)
    is_closed = at(until_s) in dvl.stamps_ns
    function = motion_between_nodes if is_closed else motion_since_node
    return function(odometry, preintegrator, at(start_s), at(until_s), np.array(bias), earth)


def blinded(imu):
    return Imu(imu.stamps_ns, imu.angular_velocity, np.full((len(imu), 3), np.nan))


def change_of(before, after):
    step = before.i_T_j.between(after.i_T_j)
    return np.r_[step.rotation().rpy(), step.translation()]


def moved(imu, dvl, column, delta):
    """Rows with one column changed."""
    if column == "velocity":
        return imu, Dvl(dvl.stamps_ns, dvl.velocity + delta, dvl.velocity_cov)
    rate, force = imu.angular_velocity, imu.specific_force
    return Imu(imu.stamps_ns, *((rate + delta, force) if column == "rate" else (rate, force + delta))), dvl


def spread_by(column, sigma, imu, dvl, *how):
    """``J Q J^T`` of white noise of every number of a column, J by differences."""
    values = {"rate": imu.angular_velocity, "force": imu.specific_force, "velocity": dvl.velocity}[column]
    base, total, step = motion(imu, dvl, *how), np.zeros((6, 6)), 1e-5
    for row, axis in np.ndindex(values.shape):
        delta = np.zeros_like(values)
        delta[row, axis] = step
        j = change_of(base, motion(*moved(imu, dvl, column, delta), *how)) / step
        total += np.outer(j, j) * sigma[axis] ** 2
    return total


def error_of_spread(column, sigma, imu, dvl, *how):
    """Largest error of the covariance, each element beside the standard deviations that belong to it."""
    truth, found = spread_by(column, sigma, imu, dvl, *how), motion(imu, dvl, *how).covariance
    deviation = np.sqrt(np.diag(truth))
    used = deviation > 1e-6
    return np.abs((found - truth)[np.ix_(used, used)] / np.outer(deviation[used], deviation[used])).max()


def density(per_root_hz):
    return [per_root_hz * np.sqrt(IMU_HZ)] * 3


@pytest.mark.parametrize(("until_s", "dvl_hz", "tolerance"), [(FOUND_S, 2.0, 0.02), (OPEN_S, 10.0, 0.15)])
def test_gyro_noise_spreads_a_gap_as_noise_of_every_sample_does(until_s, dvl_hz, tolerance):
    """IMU and Doppler log in one place: how noise of single rates acts on the lever between them is left out."""
    known = calibration({"gyro_noise_density": 1e-3}, BODY_P_DVL)
    measured = rows(np.zeros(3), dvl_hz)
    assert error_of_spread("rate", density(1e-3), *measured, known, LOST_S, until_s) < tolerance


@pytest.mark.parametrize(("until_s", "dvl_hz", "tolerance"), [(FOUND_S, 2.0, 0.04), (OPEN_S, 10.0, 0.06)])
def test_accelerometer_noise_spreads_a_gap_as_noise_of_every_sample_does(until_s, dvl_hz, tolerance):
    known = calibration({"accel_noise_density": 1e-2})
    measured = rows(dvl_hz=dvl_hz)
    assert error_of_spread("force", density(1e-2), *measured, known, LOST_S, until_s) < tolerance


def test_doppler_noise_spreads_an_open_gap_as_noise_of_every_sample_does():
    known = calibration(velocity_sigma_m_s=(0.01,) * 3)
    assert error_of_spread("velocity", [0.01] * 3, *rows(), known, LOST_S, OPEN_S) < 1e-6


@pytest.mark.parametrize(("is_blind", "tolerance"), [(False, 0.02), (True, 0.08)], ids=["accelerometers", "walk"])
def test_doppler_noise_spreads_a_chain_with_a_gap_as_noise_of_every_sample_does(is_blind, tolerance):
    """What the gap's ends share with their neighbours included."""
    known = calibration(velocity_sigma_m_s=SIGMA_M_S)
    imu, dvl = rows()
    imu = blinded(imu) if is_blind else imu
    assert error_of_spread("velocity", SIGMA_M_S, imu, dvl, known, 5.0, 12.0) < tolerance


@WITH_OR_WITHOUT
def test_a_sample_that_ends_a_gap_counts_only_once_inertial_rows_cover_it(is_blind):
    """Before, there is no node at it, and the gap is as open as without it."""
    known = calibration({"accel_noise_density": 1e-2}, velocity_sigma_m_s=(0.01,) * 3, velocity_walk_density=0.02)
    imu, dvl = rows()
    imu = blinded(imu) if is_blind else imu
    seen = imu.between(0, at(FOUND_S) - 1)
    until_s = FOUND_S + 0.05
    open_gap = motion(seen, dvl.between(0, at(LOST_S)), known, LOST_S, until_s)
    found = motion(seen, dvl.between(0, at(FOUND_S)), known, LOST_S, until_s)
    assert found.i_T_j.equals(open_gap.i_T_j, 0.0)
    assert np.array_equal(found.covariance, open_gap.covariance)
    covered = motion(imu, dvl.between(0, at(FOUND_S)), known, LOST_S, FOUND_S)
    assert np.trace(covered.covariance[3:, 3:]) < 0.5 * np.trace(open_gap.covariance[3:, 3:])


def test_the_last_velocity_held_keeps_its_error():
    known = calibration(velocity_sigma_m_s=(0.01,) * 3)
    imu, dvl = rows()
    assert error_of_spread("velocity", [0.01] * 3, blinded(imu), dvl, known, LOST_S, OPEN_S) < 0.15


@BOTH
def test_an_accelerometer_bias_spreads_a_gap_as_moving_all_forces_does(until_s):
    imu, dvl = rows()
    how = calibration({"accel_bias_sigma": 0.02}), LOST_S, until_s
    base, step = motion(imu, dvl, *how), 1e-4
    J = [change_of(base, motion(*moved(imu, dvl, "force", step * axis), *how))[3:] / step for axis in np.eye(3)]
    assert base.covariance[3:, 3:] == pytest.approx(0.02**2 * np.transpose(J) @ J, rel=1e-3, abs=1e-8)


@BOTH
def test_a_bias_that_is_removed_is_as_if_it_had_not_been(until_s):
    for imu in (rows()[0], blinded(rows()[0])):
        dvl, bias, known = rows()[1], np.array([0.03, -0.02, 0.04]), calibration(velocity_sigma_m_s=SIGMA_M_S)
        clean = motion(imu, dvl, known, LOST_S, until_s)
        biased = motion(*moved(imu, dvl, "rate", bias), known, LOST_S, until_s, bias)
        assert biased.i_T_j.equals(clean.i_T_j, 1e-9)
        assert biased.covariance == pytest.approx(clean.covariance, abs=1e-12)


@pytest.mark.parametrize(("start_s", "until_s"), [(LOST_S, FOUND_S), (LOST_S, OPEN_S), (5.0, 16.0)])
@WITH_OR_WITHOUT
def test_the_bias_derivative_is_that_of_integrating_again(is_blind, start_s, until_s):
    """Over one gap, and over a chain with two."""
    imu, dvl = rows()
    imu = blinded(imu) if is_blind else imu
    how = calibration(), start_s, until_s
    base, step = motion(imu, dvl, *how), 1e-6
    J = [change_of(base, motion(*moved(imu, dvl, "rate", -step * axis), *how)) / step for axis in np.eye(3)]
    assert base.D_bias == pytest.approx(np.transpose(J), rel=1e-3, abs=0.02)


@pytest.mark.parametrize(("start_s", "until_s"), [(LOST_S, FOUND_S), (LOST_S, OPEN_S), (5.0, 16.0)])
@WITH_OR_WITHOUT
def test_earths_rotation_is_removed_as_if_it_stood_still(is_blind, start_s, until_s):
    """Exaggerated twentyfold, and known in the frame of the first node."""
    imu, dvl = rows()
    world_earth = np.array([0.0, 1e-3, 8e-4])
    turning = attitude((imu.stamps_ns - T0_NS) * 1e-9).inv().apply(world_earth)
    lever = BODY_P_IMU - BODY_P_DVL
    at_dvl = attitude((dvl.stamps_ns - T0_NS) * 1e-9).inv().apply(world_earth)
    felt = moved(*moved(imu, dvl, "rate", turning), "velocity", -np.cross(at_dvl, lever))
    if is_blind:
        imu, felt = blinded(imu), (blinded(felt[0]), dvl)
    known = calibration(body_p_imu=BODY_P_IMU)
    earth = attitude(np.array([start_s])).inv().apply(world_earth)[0]
    still = motion(imu, dvl, known, start_s, until_s)
    found = motion(*felt, known, start_s, until_s, earth=earth)
    assert found.i_T_j.equals(still.i_T_j, 3e-3)
    assert found.i_T_j.rotation().equals(still.i_T_j.rotation(), 4e-4)


def test_motion_over_two_gaps_is_that_of_the_vehicle():
    seconds = np.linspace(5.0, 16.0, 20001)
    track = np.trapezoid(velocity_at(seconds), seconds, axis=0)
    ends = attitude(np.array([5.0, 16.0]))
    start, end = ends[0], ends[1]
    truth = start.inv().apply(track - (end.apply(BODY_P_IMU) - start.apply(BODY_P_IMU)))
    found = motion(*rows(), calibration(), 5.0, 16.0)
    assert found.i_T_j.translation() == pytest.approx(truth, abs=0.03)
    assert found.i_T_j.rotation().matrix() == pytest.approx((start.inv() * end).as_matrix(), abs=2e-3)


def test_an_open_gap_uses_nothing_stamped_later():
    imu, dvl = rows()
    known = calibration({"gyro_noise_density": 1e-3, "accel_noise_density": 1e-2}, velocity_sigma_m_s=SIGMA_M_S)
    until_s = OPEN_S + 0.03
    whole, cut = (motion(part, dvl, known, LOST_S, until_s) for part in (imu, imu.between(0, at(until_s))))
    assert whole.i_T_j.equals(cut.i_T_j, 0.0)
    assert np.array_equal(whole.covariance, cut.covariance)


@pytest.mark.parametrize(
    ("pings_s", "tolerance"),
    [((5.0, 7.0, 9.0, 11.5), 0.02), ((5.0, 11.0, 12.0), 0.02), ((5.0, 5.5, 8.0, 8.5, 11.5), 0.15)],
    ids=["pings alone", "long and short", "two pings between"],
)
def test_gaps_that_follow_each_other_spread_together_as_noise_of_every_sample_does(pings_s, tolerance):
    """The sum of all counts once what two of them share; intervals of samples at its ends count as if they went on."""
    known = calibration(velocity_sigma_m_s=SIGMA_M_S, gap_s=0.9)
    imu, dvl = rows()
    s = (stamps(DVL_HZ, 16.0) - T0_NS) * 1e-9
    velocity = attitude(s).inv().apply(velocity_at(s)) + np.cross(rate_at(s), BODY_P_DVL - BODY_P_IMU)
    there = np.isin(s, pings_s)
    few = Dvl(at(0.0) + np.rint(s[there] * NS).astype(np.int64), velocity[there], dvl.velocity_cov[: there.sum()])
    assert error_of_spread("velocity", SIGMA_M_S, imu, few, known, pings_s[0], pings_s[-1]) < tolerance


def test_the_first_gap_of_a_log_has_no_neighbour():
    known = calibration(velocity_sigma_m_s=(0.01,) * 3, gap_s=0.9)
    imu, dvl = rows()
    alone = motion(imu, dvl.rows(np.isin(dvl.stamps_ns, [at(5.0), at(LOST_S)])), known, 5.0, LOST_S)
    assert np.diag(alone.covariance)[3:] == pytest.approx([0.01**2 * 2 / 4] * 3, rel=1e-6)


def test_a_gap_that_ends_between_inertial_rows_uses_the_row_after_its_end_and_no_later_one():
    imu, dvl = rows()
    late = Dvl(dvl.stamps_ns + NS // 20 * (dvl.stamps_ns >= at(FOUND_S)), dvl.velocity, dvl.velocity_cov)
    how = calibration(), LOST_S, FOUND_S + 0.05
    base = motion(imu, late, *how).i_T_j
    for row_s, is_used in ((FOUND_S + 0.1, True), (FOUND_S + 0.2, False)):
        only = (imu.stamps_ns == at(row_s))[:, None] * np.ones(3)
        found = motion(*moved(imu, late, "force", only), *how).i_T_j
        assert found.equals(base, 1e-6) != is_used


@WITH_OR_WITHOUT
def test_both_ends_of_a_gap_count_by_their_own_noise(is_blind):
    """``T (T + 2 d) / 4`` of each one's variance, d the interval before the gap."""
    imu, dvl = rows()
    sigma = np.where(dvl.stamps_ns <= at(LOST_S), 0.01, 0.03)
    noisy = Dvl(dvl.stamps_ns, dvl.velocity, sigma[:, None, None] ** 2 * np.eye(3))
    found = motion(blinded(imu) if is_blind else imu, noisy, calibration(), LOST_S, FOUND_S)
    assert np.diag(found.covariance)[3:] == pytest.approx(
        [(0.01**2 + 0.03**2) * 5.0 * (5.0 + 2 * 0.5) / 4] * 3, rel=1e-3
    )


def test_too_few_samples_for_a_line_leave_a_walk():
    imu, dvl = rows()
    known, few = calibration(velocity_walk_density=0.1), dvl.rows(dvl.stamps_ns >= at(LOST_S - 1.0))
    found, walked = (motion(part, few, known, LOST_S, OPEN_S) for part in (imu, blinded(imu)))
    assert found.i_T_j.equals(walked.i_T_j, 0.0)
    assert np.array_equal(found.covariance, walked.covariance)
    assert not motion(imu, dvl, known, LOST_S, OPEN_S).i_T_j.equals(walked.i_T_j, 0.1)
