from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from sonar_graph.calibration import Calibration
from sonar_graph.errors import CalibrationError, MeasurementError
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.navigation.preintegration.motion import Preintegrator
from sonar_graph.navigation.preintegration.recursion import Steps

from .rows import (
    NS,
    T0_NS,
    dead_reckoned,
    dense_covariance,
    derivative,
    dvl,
    imu,
    part,
    random_steps,
    stamps,
    waves,
)

LEVER = np.array([-0.2, 0.1, -0.15])
BIAS = np.array([0.01, -0.02, 0.03])
GYRO_DENSITY = 3e-3
PREINTEGRATOR = Preintegrator(GYRO_DENSITY, LEVER)
seeds = st.integers(0, 2**32 - 1)


def at_rest(n):
    """Columns of steps, all but their durations."""
    return np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3))


def log(pose: gtsam.Pose3) -> np.ndarray:
    return gtsam.Pose3.Logmap(pose)


def same_pose(a: gtsam.Pose3, b: gtsam.Pose3, tolerance: float = 1e-10) -> bool:
    return bool(np.abs(log(a.between(b))).max() < tolerance)


@given(seeds)
@settings(max_examples=30)
def test_preintegration_equals_dead_reckoning(seed):
    steps = random_steps(seed)
    assert same_pose(PREINTEGRATOR.integrate(steps, BIAS).i_T_j, dead_reckoned(steps, BIAS, LEVER)[-1])


@given(seeds)
@settings(max_examples=15)
def test_covariance_equals_a_dense_recursion(seed):
    steps = random_steps(seed)
    expected, _ = dense_covariance(steps, BIAS, LEVER, GYRO_DENSITY)
    actual = PREINTEGRATOR.integrate(steps, BIAS).covariance
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((actual - expected) / scale).max() < 1e-5
    assert np.array_equal(actual, actual.T)


def test_rotation_and_displacement_are_correlated():
    """A gyro error at the start of a straight run shows as a displacement to the side."""
    steps = random_steps(1, rate_rad_s=0.0)
    cov = PREINTEGRATOR.integrate(steps, np.zeros(3)).covariance
    assert abs(cov[2, 4]) / np.sqrt(cov[2, 2] * cov[4, 4]) > 0.05


def test_covariance_is_that_of_many_noisy_runs():
    steps, runs, rng = random_steps(5, n=100), 400, np.random.default_rng(0)
    mean = PREINTEGRATOR.integrate(steps, BIAS)
    information = np.linalg.inv(mean.covariance)
    root_dt, roots = np.sqrt(steps.duration_s)[:, None], np.linalg.cholesky(steps.velocity_psd)
    nees = []
    for _ in range(runs):
        rate = steps.rate + GYRO_DENSITY / root_dt * rng.standard_normal((100, 3))
        velocity = steps.velocity + (roots @ rng.standard_normal((100, 3, 1)))[..., 0] / root_dt
        noisy = Steps(steps.duration_s, rate, velocity, steps.velocity_psd, steps.specific_force, steps.turn_psd)
        error = log(mean.i_T_j.between(PREINTEGRATOR.integrate(noisy, BIAS).i_T_j))
        nees.append(error @ information @ error)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * runs) / runs
    assert low < np.mean(nees) < high


@given(seeds)
@settings(max_examples=15)
def test_bias_derivative_equals_finite_differences(seed):
    steps = random_steps(seed)
    mean = PREINTEGRATOR.integrate(steps, BIAS)

    def moved(change):
        return log(mean.i_T_j.between(PREINTEGRATOR.integrate(steps, BIAS + change).i_T_j))

    numerical = derivative(moved, 3, 1e-5)
    assert np.abs(mean.D_bias - numerical).max() < 1e-5 * np.abs(numerical).max()


@given(seeds)
@settings(max_examples=15)
def test_correction_equals_integrating_again(seed):
    """To first order; uncorrected, or corrected with the opposite sign, the motion is far off."""
    steps, change = random_steps(seed, n=150), np.array([4e-3, -3e-3, 5e-3])
    mean = PREINTEGRATOR.integrate(steps, BIAS)
    again = PREINTEGRATOR.integrate(steps, BIAS + change).i_T_j
    uncorrected = np.abs(log(mean.i_T_j.between(again))).max()
    opposite = np.abs(log(mean.corrected(BIAS - change).between(again))).max()
    corrected = np.abs(log(mean.corrected(BIAS + change).between(again))).max()
    assert corrected < 0.01 * uncorrected < 0.01 * opposite
    assert same_pose(mean.corrected(BIAS), mean.i_T_j)


@given(seeds, st.integers(1, 59))
@settings(max_examples=30)
def test_motions_compose(seed, cut):
    """a to c is a to b and then b to c: mean, covariance and bias derivative."""
    steps = random_steps(seed)
    whole = PREINTEGRATOR.integrate(steps, BIAS)
    first = PREINTEGRATOR.integrate(part(steps, 0, cut), BIAS)
    second = PREINTEGRATOR.integrate(part(steps, cut, 60), BIAS)
    F = second.i_T_j.inverse().AdjointMap()
    assert same_pose(first.i_T_j.compose(second.i_T_j), whole.i_T_j)
    assert np.allclose(F @ first.covariance @ F.T + second.covariance, whole.covariance, rtol=1e-9, atol=1e-15)
    assert np.allclose(F @ first.D_bias + second.D_bias, whole.D_bias, rtol=1e-9, atol=1e-12)
    impulse = first.mean_specific_force * first.duration_s
    impulse += second.mean_specific_force * second.duration_s @ first.i_T_j.rotation().matrix().T
    assert np.allclose(impulse, whole.mean_specific_force * whole.duration_s)


def test_turning_about_the_doppler_log_leaves_it_where_it_is():
    """The log reads zero; the body's origin goes round it."""
    n = 100
    rate = np.tile([0.3, -0.2, 0.9], (n, 1))
    steps = Steps(np.full(n, 0.01), rate, *at_rest(n)[1:])
    motion = PREINTEGRATOR.integrate(steps, np.zeros(3)).i_T_j
    assert np.allclose(motion.transformFrom(LEVER), LEVER, atol=1e-12)
    assert np.linalg.norm(motion.translation()) > 0.1


def test_gyro_noise_reaches_the_displacement_through_the_lever_arm():
    """Standing still with an exact log: the origin wanders by the angle times the arm."""
    n, arm_m = 1000, 2.0
    steps = Steps(np.full(n, 0.01), *at_rest(n))
    cov = Preintegrator(GYRO_DENSITY, np.array([arm_m, 0.0, 0.0])).integrate(steps, np.zeros(3)).covariance
    angle_variance = GYRO_DENSITY**2 * 10.0
    assert np.diag(cov)[:3] == pytest.approx([angle_variance] * 3)
    assert np.diag(cov)[3:] == pytest.approx([0.0, angle_variance * arm_m**2, angle_variance * arm_m**2])
    assert cov[2, 4] == pytest.approx(-angle_variance * arm_m)


def test_noises_of_a_straight_run_are_those_of_hand_algebra():
    """Heading sigma^2 t; sideways v^2 sigma^2 t^3 / 3 and the velocity's own psd t."""
    n, t, v, psd = 4000, 4.0, 0.5, 4e-6
    steps = Steps(
        np.full(n, t / n), np.zeros((n, 3)), np.tile([v, 0.0, 0.0], (n, 1)), np.tile(psd * np.eye(3), (n, 1, 1)),
        np.zeros((n, 3)), np.zeros((n, 3)),
    )  # fmt: skip
    cov = Preintegrator(GYRO_DENSITY, np.zeros(3)).integrate(steps, np.zeros(3)).covariance
    assert cov[2, 2] == pytest.approx(GYRO_DENSITY**2 * t)
    assert cov[3, 3] == pytest.approx(psd * t)
    assert cov[4, 4] == pytest.approx(psd * t + v**2 * GYRO_DENSITY**2 * t**3 / 3, rel=1e-3)


def test_a_held_twist_is_the_exact_planar_exponential():
    """Wheel odometry: v and w hold until their stamp; an arc of radius v / w."""
    v, w, seconds = 0.7, 1.3, 0.9
    calibration = Calibration(odometry_interpolation="hold-past")
    at = np.array([T0_NS, T0_NS + round(seconds * NS)])
    odometry = Odometry(calibration)
    odometry.add(imu(at, [[9.0, 9.0, 9.0], [0.0, 0.0, w]]), dvl(at, [[9.0, 9.0, 9.0], [v, 0.0, 0.0]]))
    steps = odometry.steps_between_nodes(int(at[0]), int(at[1]))
    motion = Preintegrator.from_calibration(calibration).integrate(steps, np.zeros(3)).i_T_j
    arc = [v / w * np.sin(w * seconds), v / w * (1 - np.cos(w * seconds)), 0.0]
    assert np.allclose(motion.translation(), arc, atol=1e-12)
    assert motion.rotation().yaw() == pytest.approx(w * seconds)


def test_earth_rate_is_taken_out_in_the_turning_body():
    """Gyros that feel a (greatly exaggerated) Earth measure the motion over the ground without it."""
    n, dt, earth_i = 2000, 0.002, np.array([0.01, 0.02, -0.015])
    steps = random_steps(3, n=n)
    over_ground = Steps(
        np.full(n, dt), steps.rate, steps.velocity, steps.velocity_psd, steps.specific_force, steps.turn_psd
    )
    truth = dead_reckoned(over_ground, np.zeros(3), LEVER)
    felt = np.array([pose.rotation().matrix().T @ earth_i for pose in truth[:-1]])
    measured = Steps(
        over_ground.duration_s,
        over_ground.rate + felt,
        steps.velocity,
        steps.velocity_psd,
        steps.specific_force,
        steps.turn_psd,
    )
    assert same_pose(PREINTEGRATOR.integrate(measured, np.zeros(3), earth_i).i_T_j, truth[-1])
    assert not same_pose(PREINTEGRATOR.integrate(measured, np.zeros(3)).i_T_j, truth[-1], 0.02)


@given(seeds)
@settings(max_examples=10)
def test_path_of_a_point_goes_through_the_poses(seed):
    steps, point = random_steps(seed, n=20), np.array([0.3, -0.1, 0.2])
    poses = dead_reckoned(steps, BIAS, LEVER)
    at_ends = np.array([pose.transformFrom(point) for pose in poses])
    ends_s = np.concatenate([[0.0], np.cumsum(steps.duration_s)])
    middles_s = (ends_s[1:] + ends_s[:-1]) / 2
    assert np.allclose(PREINTEGRATOR.path_of(point, steps, BIAS, ends_s), at_ends, atol=1e-10)
    middles = PREINTEGRATOR.path_of(point, steps, BIAS, middles_s)
    assert np.allclose(middles, (at_ends[1:] + at_ends[:-1]) / 2, atol=1e-10)


def test_a_path_ends_where_the_steps_end():
    steps = random_steps(2, n=5)
    end = dead_reckoned(steps, BIAS, LEVER)[-1].translation()
    assert np.allclose(PREINTEGRATOR.path_of(np.zeros(3), steps, BIAS, np.array([99.0])), [end])


def test_no_steps_are_no_motion():
    motion = PREINTEGRATOR.integrate(part(random_steps(0), 0, 0), BIAS)
    assert same_pose(motion.i_T_j, gtsam.Pose3())
    assert not motion.covariance.any()
    assert np.isnan(motion.mean_specific_force).all()


def test_unmeasured_force_does_not_touch_the_motion():
    steps = random_steps(4)
    without = Steps(
        steps.duration_s, steps.rate, steps.velocity, steps.velocity_psd, np.full((60, 3), np.nan), steps.turn_psd
    )
    measured, unmeasured = (PREINTEGRATOR.integrate(s, BIAS) for s in (steps, without))
    assert same_pose(measured.i_T_j, unmeasured.i_T_j, 1e-15)
    assert np.array_equal(measured.covariance, unmeasured.covariance)
    assert np.isnan(unmeasured.mean_specific_force).all()
    assert np.isfinite(measured.mean_specific_force).all()


def displacement_error_m(interpolation: str, dvl_hz: float) -> float:
    """After 4 s of swaying, against steps of 0.5 ms."""
    fine, slow, quick = stamps(2000, 4.0), stamps(dvl_hz, 4.0), stamps(400, 4.0)
    means = [0.5 * (w[1:] + w[:-1]) for w in (waves(fine, 1, 0.2), waves(fine, 2, 0.1))]
    n = len(fine) - 1
    truth = dead_reckoned(
        Steps(np.full(n, 5e-4), *means, np.zeros((n, 3, 3)), means[0], np.zeros((n, 3))), np.zeros(3), np.zeros(3)
    )[-1]
    calibration = Calibration(odometry_interpolation=interpolation)
    odometry = Odometry(calibration)
    odometry.add(imu(quick, waves(quick, 1, 0.2)), dvl(slow, waves(slow, 2, 0.1)))
    steps = odometry.steps_between_nodes(int(slow[0]), int(slow[-1]))
    motion = Preintegrator.from_calibration(calibration).integrate(steps, np.zeros(3)).i_T_j
    return float(np.linalg.norm(motion.translation() - truth.translation()))


def test_linear_interpolation_is_of_second_order_and_a_hold_of_first():
    """Twice as many velocities: a quarter of the error, where a hold halves it."""
    linear, held = ([displacement_error_m(name, hz) for hz in (10, 20, 40)] for name in ("linear", "hold-past"))
    assert all(3.3 < coarse / fine < 5.0 for coarse, fine in pairwise(linear))
    assert all(1.5 < coarse / fine < 2.6 for coarse, fine in pairwise(held))
    assert linear[0] < 0.2 * held[0]


def test_mean_force_is_turned_by_the_attitude_in_the_middle_of_a_step():
    """Gravity in a vehicle that pitches at 0.1 rad/s, in steps of 0.1 s; their first attitudes err by 5 mrad."""
    n, dt, rate = 20, 0.1, np.array([0.0, 0.1, 0.0])
    middles = (np.arange(n) + 0.5) * dt
    force = np.array([gtsam.Rot3.Expmap(rate * t).unrotate(np.array([0.0, 0.0, 9.81])) for t in middles])
    steps = Steps(np.full(n, dt), np.tile(rate, (n, 1)), np.zeros((n, 3)), np.zeros((n, 3, 3)), force, np.zeros((n, 3)))
    motion = Preintegrator(1e-4, np.zeros(3)).integrate(steps, np.zeros(3))
    assert motion.mean_specific_force == pytest.approx([0.0, 0.0, 9.81], abs=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bias": np.zeros(6)}, r"bias: expected shape \(3,\), not \(6,\)"),
        ({"bias": np.array([0.0, np.nan, 0.0])}, "bias: expected finite numbers"),
        ({"bias": BIAS, "earth_rate": np.zeros(1)}, r"earth_rate: expected shape \(3,\)"),
    ],
)
def test_vectors_of_another_shape_are_refused(options, message):
    with pytest.raises(MeasurementError, match=message):
        PREINTEGRATOR.integrate(random_steps(1), **options)


@pytest.mark.parametrize(
    ("density", "lever", "message"),
    [
        (-1e-4, LEVER, "gyro_noise_density: expected finite numbers of zero or more"),
        (np.nan, LEVER, "gyro_noise_density: expected finite"),
        (1e-4, np.zeros(2), r"body_p_dvl: expected shape \(3,\), not \(2,\)"),
    ],
)
def test_impossible_sensors_are_refused(density, lever, message):
    with pytest.raises(CalibrationError, match=message):
        Preintegrator(density, lever)


def test_gaps_are_bridged_with_a_calibration_only():
    odometry = Odometry(Calibration())
    with pytest.raises(CalibrationError, match="from_calibration"):
        PREINTEGRATOR.bridge(odometry.columns(), 0, NS, True, BIAS)
