"""Laws of landmarks, for both filters: augmentation, floor, gate, innovation, and views from far away."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from baselines.events import read_detections
from baselines.filter import lockout_messages
from baselines.kalman import GATED, USED, far_covariance, is_far, judged, judged_far
from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.measurements import NS_PER_S
from sonar_graph.models import (
    FLOOR_GATE,
    RobustKernel,
    elevation_on_floor,
    locate,
    range_azimuth,
)
from sonar_graph.navigation import Odometry
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.states import DetectionLog, Outcome
from sonar_graph.testing.numerical import central_differences

from .filters import (
    BODY_M,
    CALIBRATION,
    MOTION_SIGMA,
    NOISE,
    STILL,
    TWIST,
    Ekf,
    World,
    begun,
    both,
    motion_of,
    random_covariance,
    rotation,
    sonar_after,
    world_at,
)

LEVEL, TILTED, MOTION = np.zeros(3), np.array([0.1, 0.2, 0.3]), motion_of(TWIST)


def bare(filter_, angles, scale):
    """An estimate without landmarks, and its covariance."""
    return world_at(angles, []), random_covariance(filter_.bare, scale)


def drawn(filter_, world, P, rng):
    """A true world, and the sonar there after a motion that errs."""
    true = filter_.moved(world, np.linalg.cholesky(P) @ rng.normal(size=len(P)))
    return true, sonar_after(true, MOTION, MOTION_SIGMA * rng.normal(size=6))


def assert_covariance_of(draws, actual):
    sigma = np.std(draws, axis=0)
    scale = np.outer(sigma, sigma)
    assert_allclose(actual / scale, np.cov(np.transpose(draws)) / scale, atol=0.05)


def with_landmark(filter_, angles=TILTED, view=(2.0, 0.3, 0.05), scale=0.002):
    """An estimate with one landmark and its covariance, and what is to be seen of it."""
    world = world_at(angles, locate(sonar_after(world_at(angles), MOTION), *view))
    return world, random_covariance(filter_.bare + 3, scale), np.array(view[:2])


def floored(z_m, sigma_m=1e-2):
    return CALIBRATION.model_copy(
        update={"floor": FloorPrior(z_m=z_m, sigma_m=sigma_m)}
    )


def augmented(filter_, angles, scale, z, calibration=CALIBRATION):
    """Filter that sees its first landmark, and this landmark with its covariance."""
    slam = begun(filter_, *bare(filter_, angles, scale), calibration)
    slam.augment(MOTION, np.array(z), NOISE)
    (position,), covariance = slam.points([0])
    return slam, position, covariance


@pytest.mark.slow
@both
def test_a_new_landmark_has_the_covariance_of_many_draws(filter_):
    """Of state, bias, motion, range and azimuth, and an elevation anywhere in the aperture."""
    rng, aperture, before = np.random.default_rng(5), 0.05, bare(filter_, TILTED, 0.003)
    sonar = CALIBRATION.sonar.model_copy(update={"elevation_aperture_rad": aperture})
    calibration = CALIBRATION.model_copy(update={"sonar": sonar})
    _, position, covariance = augmented(filter_, TILTED, 0.003, [2.0, 0.3], calibration)
    draws = []
    for _ in range(20_000):
        z = rng.multivariate_normal([2.0, 0.3], NOISE)
        draws.append(
            locate(
                drawn(filter_, *before, rng)[1], *z, rng.uniform(-0.5, 0.5) * aperture
            )
        )
    assert_allclose(position, np.mean(draws, axis=0), atol=2e-3)
    assert_covariance_of(draws, covariance)


@pytest.mark.slow
@both
def test_an_innovation_has_the_covariance_of_many_draws(filter_):
    rng = np.random.default_rng(7)
    world, P, z = with_landmark(filter_)
    outcome, e, S = begun(filter_, world, P).observe(
        MOTION, 0, z + np.array([0.01, -0.005]), NOISE
    )
    assert outcome == USED
    assert_allclose(e, [0.01, -0.005], atol=1e-9)
    views = []
    for _ in range(20_000):
        true, pose = drawn(filter_, world, P, rng)
        view = np.asarray(range_azimuth(pose, true.landmarks[0]))
        views.append(view + np.sqrt(np.diag(NOISE)) * rng.normal(size=2))
    assert_covariance_of(views, S)


@both
def test_a_known_floor_fixes_the_height_of_a_new_landmark(filter_):
    true = locate(sonar_after(world_at(LEVEL), MOTION), 2.0, 0.3, 0.05)
    _, position, covariance = augmented(
        filter_, LEVEL, 0.003, [2.0, 0.3], floored(true[2], 1e-3)
    )
    assert_allclose(position, true, atol=1e-3)
    assert covariance[2, 2] == pytest.approx(1e-6, rel=0.01)


@both
def test_without_a_floor_in_reach_a_new_landmark_is_on_the_centre_beam_and_the_vehicle_stays(
    filter_,
):
    world, P = bare(filter_, TILTED, 0.003)
    middle = locate(sonar_after(world, MOTION), 3.0, 0.3, 0.0)
    for calibration in (CALIBRATION, floored(BODY_M[2] - 5.0)):
        slam, position, _ = augmented(filter_, TILTED, 0.003, [3.0, 0.3], calibration)
        assert_allclose(position, middle, atol=1e-12)
        after, covariance = filter_.estimate(slam)
        assert_array_equal(after.X, world.X)
        assert_array_equal(covariance[: len(P), : len(P)], P)


@both
@pytest.mark.parametrize(
    ("share", "is_used"), [(0.5, True), (0.999, True), (1.001, False)]
)
@pytest.mark.parametrize("side", [-1, 1])
def test_a_floor_outside_the_aperture_counts_up_to_its_gate(
    filter_, side, share, is_used
):
    """The innovation's variance has the aperture's share, the pose's and the floor's."""
    _, position, covariance = augmented(filter_, TILTED, 0.002, [2.0, 0.3])
    variance, floor_variance = covariance[2, 2], 1e-4
    off_m = side * math.sqrt(share * FLOOR_GATE * (variance + floor_variance))
    floor_z_m = position[2] + off_m
    pose = sonar_after(world_at(TILTED), MOTION)
    assert (
        elevation_on_floor(
            pose, 2.0, 0.3, floor_z_m, CALIBRATION.sonar.elevation_aperture_rad
        )
        is None
    )
    _, after, cov = augmented(
        filter_, TILTED, 0.002, [2.0, 0.3], floored(floor_z_m, 1e-2)
    )
    if is_used:
        gain = variance / (variance + floor_variance)
        assert cov[2, 2] == pytest.approx(gain * floor_variance, rel=0.05)
        assert after[2] == pytest.approx(position[2] + gain * off_m, abs=0.01)
    else:
        assert_array_equal(after, position)
        assert_array_equal(cov, covariance)


def test_the_floor_s_gate_is_passed_by_999_of_1000_that_stand_on_it():
    assert pytest.approx(chi_square_quantile(0.999, 1), abs=5e-3) == FLOOR_GATE


@both
def test_a_gated_detection_changes_nothing_and_has_its_innovation(filter_):
    world, P, z = with_landmark(filter_)
    slam = begun(filter_, world, P)
    outcome, e, S = slam.observe(MOTION, 0, z + np.array([1.0, 0.0]), NOISE)
    assert outcome == GATED
    assert e[0] == pytest.approx(1.0)
    assert np.linalg.eigvalsh(S).min() > 0
    after, covariance = filter_.estimate(slam)
    assert_array_equal(after.landmarks, world.landmarks)
    assert_array_equal(covariance, P)


@both
def test_the_innovation_of_azimuth_wraps_around(filter_):
    world, P, _ = with_landmark(filter_, view=(3.0, math.pi - 0.004, 0.1))
    slam = begun(filter_, world, P)
    outcome, e, _ = slam.observe(MOTION, 0, np.array([3.0, -math.pi + 0.004]), NOISE)
    assert outcome == USED
    assert e[1] == pytest.approx(0.008, abs=1e-9)


@pytest.mark.parametrize("hole", [(0, 0), (1, 1), (0, 1)])
def test_noise_is_the_log_s_made_symmetric_and_where_it_has_a_hole_the_calibration_s(
    hole,
):
    logged = np.array([[[4e-4, 3e-5], [1e-5, 1e-4]]] * 2)
    logged[(1, *hole)] = math.nan
    assert_allclose(
        read_detections(*np.ones((2, 2)), logged, NOISE)[1],
        [[[4e-4, 2e-5], [2e-5, 1e-4]], NOISE],
    )


# ---------------------------------------------------------------------------------------------- views from far away

FAR_LANDMARK, APERTURE_RAD = np.array([25.0, 12.0, -1.0]), 0.3
TURNED = Rotation.from_euler("xyz", [0.4, -0.7, 1.9]).as_matrix()
AHEAD = CALIBRATION.model_copy(
    update={"sonar": SonarCalibration(elevation_aperture_rad=APERTURE_RAD)}
)
"""A sonar at the origin of the body."""


def look(filter_, X, position_sigma_m, may_be_far, wrong_m=0.0):
    """One exact look at the landmark from X, by a filter that expects to be at the origin.

    Returns its outcome, position and covariance after it, the innovation and its covariance.
    """
    here = World(np.eye(3), np.zeros(3), FAR_LANDMARK[None])

    def error(shift):
        return filter_.error(
            World(rotation(shift[3:6]), shift[:3], here.landmarks + shift[6:]), here
        )

    T = central_differences(error, np.zeros(9))
    P = T @ np.diag(np.repeat(np.square([position_sigma_m, 1e-3, 0.01]), 3)) @ T.T
    slam, q = begun(filter_, here, P, AHEAD), FAR_LANDMARK - X
    z = np.array([np.linalg.norm(q) + wrong_m, np.arctan2(q[1], q[0])])
    R_z = np.diag([AHEAD.sonar.range_sigma_m**2, AHEAD.sonar.azimuth_sigma_rad**2])
    judged = slam.observe_far(STILL, 0, z, R_z) if may_be_far else None
    outcome, e, S = judged or slam.observe(STILL, 0, z, R_z)
    _, at, covariance = slam.pose_after(STILL)
    return outcome, at, covariance[3:, 3:], e, S


@both
def test_one_look_finds_a_vehicle_that_is_far_from_where_it_was_expected(filter_):
    """And linearised where it was expected it is sure of a wrong place."""
    X = np.array([40.0, 20.0, -0.5])
    outcome, at, P, _, S = look(filter_, X, 30.0, may_be_far=True)
    assert outcome == USED
    assert np.linalg.norm((at - X)[:2]) < 0.5
    assert (at - X) @ np.linalg.solve(P, at - X) < chi2.ppf(0.99, 3)
    assert S[0, 0] == pytest.approx(30.0**2, rel=0.01)
    _, at, P, _, _ = look(filter_, X, 30.0, may_be_far=False)
    assert (at - X) @ np.linalg.solve(P, at - X) > 1000.0


@both
def test_a_vehicle_near_where_it_was_expected_sees_as_without_a_gap(filter_):
    X = np.array([0.1, -0.1, 0.05])
    with_gap, without = look(filter_, X, 0.2, True), look(filter_, X, 0.2, False)
    for one, other in zip(with_gap, without, strict=True):
        assert_array_equal(one, other)


@both
def test_what_no_vehicle_in_reach_sees_is_refused(filter_):
    outcome, at, _, e, S = look(
        filter_, np.array([40.0, 20.0, -0.5]), 30.0, True, wrong_m=300.0
    )
    assert outcome == GATED
    assert_allclose(at, 0.0, atol=1e-15)
    assert e @ np.linalg.solve(S, e) > chi_square_quantile(0.999, 2)


def far(cov, G_z, range_m, noise):
    """True where a detection with this covariance of range and azimuth is compared with the point seen."""
    return is_far(
        np.array(cov, float), np.array(G_z, float), range_m, np.array(noise, float)
    )


def test_the_noise_of_a_view_holds_that_of_many_beams_and_without_aperture_is_the_detection_s():
    """Of elevations anywhere in the aperture, for a length that is taken at elevation zero."""
    elevation = np.random.default_rng(3).uniform(
        -APERTURE_RAD / 2, APERTURE_RAD / 2, 200_000
    )
    V = far_covariance(np.zeros((2, 2)), 40.0, APERTURE_RAD)
    assert V[0, 0] == pytest.approx(
        np.mean(np.square(40.0 * (1 - np.cos(elevation)))), rel=0.02
    )
    assert V[2, 2] == pytest.approx(np.var(elevation), rel=0.02)
    noise = np.array([[0.04, -0.003], [-0.003, 0.0009]])
    assert_array_equal(far_covariance(noise, 40.0, 0.0), np.pad(noise, (0, 1)))


def test_gate_and_kernel_judge_a_far_view_by_its_shift_along_the_beam_and_across_it():
    G_z, R_z, z = (
        TURNED @ np.diag([1.0, 10.0, 10.0]),
        np.diag([0.04, 0.0009]),
        np.array([10.0, 0.3]),
    )
    e, cov, nothing = (
        TURNED @ [9.0, 7.0, 0.0],
        TURNED @ np.diag([1.0, 9.0, 1.0]) @ TURNED.T,
        np.zeros((3, 3)),
    )
    sonar = begun(Ekf, world_at(LEVEL), kernel_width=1.5, gate=1.0).sonar._replace(
        aperture_rad=0.0
    )
    told, noise = judged_far(e, cov, nothing, G_z, sonar, z, R_z)
    assert told.outcome == USED
    assert_allclose(told.e, [9.0, 0.7], atol=1e-12)
    assert_allclose(told.S, np.diag([1.04, 0.0909]), atol=1e-12)
    widened = judged(told.e, told.S, R_z, math.inf, 1.5)[1]
    assert_allclose(noise, G_z[:, :2] @ (R_z + widened) @ G_z[:, :2].T, atol=1e-12)
    assert (
        judged_far(e, cov, nothing, G_z, sonar._replace(gate=3.7), z, R_z)[0].outcome
        == GATED
    )
    assert judged_far(e, 1e-6 * cov, nothing, G_z, sonar, z, R_z)[0] is None


def test_linear_is_what_errs_by_less_than_the_noise():
    """Sagitta of an exact circle: across a beam of 10 m, sigma 1 m, a range is 5 cm longer."""
    G_z, longer_m = np.diag([1.0, 10.0, 10.0]), np.hypot(10.0, 1.0) - 10.0
    for share, is_linear in ((1.05, True), (0.95, False)):
        assert (
            far(
                np.diag([0.0, 1.0, 0.0]),
                G_z,
                10.0,
                np.diag([(share * longer_m) ** 2, 1.0]),
            )
            != is_linear
        )
    for sigma, is_linear in ((0.0101, True), (0.0099, False)):
        assert (
            far(np.diag([1.0, 1.0, 0.0]), G_z, 10.0, np.diag([1.0, sigma**2]))
            != is_linear
        )
    assert not far(1e6 * np.diag([0.0, 0.0, 1.0]), G_z, 10.0, np.diag([1e-4, 1e-4]))


@pytest.mark.parametrize("range_m", [10.0, 3.0])
def test_what_is_linear_is_the_same_wherever_the_sonar_points(range_m):
    """Blind to elevation; with 0.3 m along and 0.2 m across, 2 % on each side of linear."""
    G_z, cov = (
        TURNED @ np.diag([1.0, range_m, range_m]),
        TURNED @ np.diag([0.09, 0.04, 4.0]) @ TURNED.T,
    )
    longer_m, turned_rad = 0.04 / (2 * range_m), 0.3 * 0.2 / range_m**2
    for share, is_linear in ((0.98, False), (1.02, True)):
        assert (
            far(cov, G_z, range_m, np.diag([(share * longer_m) ** 2, 9.0])) != is_linear
        )
        assert (
            far(cov, G_z, range_m, np.diag([9.0, (share * turned_rad) ** 2]))
            != is_linear
        )


@pytest.mark.parametrize("direction", [(2.0, 1.0), (2.0, -1.0), (1.0, 0.0)])
def test_the_gate_is_an_ellipse_of_a_correlated_innovation(direction):
    """Range and azimuth correlated by 0.9: along the long axis far more passes than across it."""
    S, threshold = np.array([[4.0, 1.8], [1.8, 1.0]]), chi_square_quantile(0.999, 2)
    e = np.array(direction) * np.sqrt(
        threshold / (direction @ np.linalg.solve(S, direction))
    )
    assert admitted(0.999 * e, S, gate_probability=0.999)[0] == USED
    assert admitted(1.001 * e, S, gate_probability=0.999)[0] == GATED
    assert admitted(1e3 * e, S)[0] == USED


def admitted(e, S, R_z=NOISE, *, gate_probability=1.0, kernel_width=0.0):
    """Judgement by these settings."""
    gate = math.sqrt(chi2.ppf(gate_probability, 2))
    return judged(np.array(e, float), np.array(S), R_z, gate, kernel_width or math.inf)


def test_a_kernel_weighs_range_and_azimuth_each_as_in_the_graph():
    """By GTSAM's own weight at the innovation over its sigma; a correlation of the noise stays as it is."""
    kernel, R_z = (
        RobustKernel(shape="cauchy", width=1.2),
        np.array([[4e-4, 1e-5], [1e-5, 1e-4]]),
    )
    S, weight = np.array([[0.04, 0.01], [0.01, 0.09]]), kernel.estimator().weight
    for e in ([0.6, 0.3], [-0.1, -3.0], [0.0, 0.0], [1e4, 1e4]):
        outcome, widened = admitted(e, S, R_z, kernel_width=1.2)
        spread = [weight(abs(e[i]) / math.sqrt(S[i, i])) ** -0.5 for i in range(2)]
        assert outcome == USED
        assert_allclose(R_z + widened, R_z * np.outer(spread, spread), rtol=1e-12)
    assert_array_equal(admitted([9.0, 9.0], S, R_z)[1], 0.0)


@both
def test_an_outlier_moves_a_filter_with_a_kernel_less_and_what_agrees_as_much(filter_):
    world, P, z = with_landmark(filter_)
    for off, shares in ((0.0, (1.0, 1.0)), (1.0, (0.0, 0.1))):
        moved = []
        for kernel_width in (0.0, 1.5):
            slam = begun(filter_, world, P, gate=1.0, kernel_width=kernel_width)
            slam.observe(MOTION, 0, z + np.array([1e-6 + off, 0.0]), NOISE)
            moved.append(
                np.linalg.norm(filter_.estimate(slam)[0].landmarks - world.landmarks)
            )
        assert shares[0] - 1e-3 < moved[1] / moved[0] < shares[1] + 1e-3


def log_of(squared):
    """Log of detections at these squared distances along the range; NaN: without an innovation."""
    e = np.column_stack([np.sqrt(squared), np.zeros(len(squared))])
    stamps_ns = np.arange(len(squared))
    outcomes = [Outcome.USED] * len(squared)
    return DetectionLog(
        stamps_ns, stamps_ns, e, np.tile(np.eye(2), (len(squared), 1, 1)), outcomes
    )


def test_a_lock_out_is_named_where_outliers_are_far_more_than_noise_and_a_tenth_explain():
    rng = np.random.default_rng(0)
    noise = chi2.ppf(rng.random(2000), 2)
    tenth = np.where(rng.random(2000) < 0.1, 1e3, noise)
    third = np.where(rng.random(2000) < 0.33, 1e3, noise)
    new = np.full(50, np.nan)
    assert lockout_messages(log_of(new)) == []
    for squared in (noise, tenth, np.full(1, 1e3), noise[:3]):
        assert lockout_messages(log_of(np.concatenate([new, squared]))) == []
    (message,) = lockout_messages(log_of(np.concatenate([new, third])))
    outliers = int(np.sum(third > chi2.ppf(0.999, 2)))
    assert message.startswith(
        f"{outliers} of 2000 detections of known landmarks lie outside"
    )
    assert "kernel_width = 0" in message


BEFORE_S, LOST_S, AFTER_S = 25.0, 120.0, np.array([3.0, 10.0, 20.0])


def nees_after_gap(filter_, seed, forgets_gap):
    """NEES of position at `AFTER_S`; where the gap is forgotten, views are linearised at the predicted place."""
    options = MissionOptions(
        seed=seed,
        duration_s=BEFORE_S + LOST_S + 22.0,
        frame_rate_hz=0.5,
        false_detections_per_frame=0,
    )
    mission = simulate_mission(options)
    start_ns = mission.start_ns
    seconds = (mission.dvl.stamps_ns - start_ns) / NS_PER_S
    lost = mission.dvl.rows((seconds <= BEFORE_S) | (seconds >= BEFORE_S + LOST_S))
    first_after = np.searchsorted(
        lost.stamps_ns, start_ns + (BEFORE_S + LOST_S) * NS_PER_S
    )
    closed_ns = lost.stamps_ns[first_after + 1]  # the second row confirms the first
    after_ns = closed_ns + np.round(AFTER_S * NS_PER_S).astype(np.int64)
    sequence = Sequence(
        "gap", mission.calibration, mission.imu, lost, None, mission.detections
    )
    params = filter_.kind.Params(far_views=not forgets_gap)
    estimator, squares = (
        filter_.kind(mission.calibration, Odometry(mission.calibration), params),
        [],
    )
    for window in sequence.replay(np.r_[closed_ns + NS_PER_S // 50, after_ns]):
        estimate = estimator.process(window)
        if window.end_ns in after_ns:
            world_T_body = estimate.world_T_body
            error = (
                world_T_body.translation()
                - mission.truth.at(np.array([window.end_ns])).positions[0]
            )
            error = world_T_body.rotation().unrotate(error)
            squares.append(error @ np.linalg.solve(estimate.covariance[3:, 3:], error))
    return np.array(squares)


@pytest.mark.slow
@both
def test_after_a_long_gap_landmarks_make_the_position_as_sure_as_it_is_right(filter_):
    """Over short missions, two-sided 99.9 % of a chi-square; instants of a run share their errors and count as one."""
    squares = np.array([nees_after_gap(filter_, seed, False) for seed in range(5)])
    low, high = chi2.ppf([0.0005, 0.9995], 3 * len(squares))
    for total in squares.sum(axis=0):
        assert low < total < high
    assert nees_after_gap(filter_, 0, True).min() > high
