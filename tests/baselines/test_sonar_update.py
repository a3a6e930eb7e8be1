"""After a long gap of the Doppler log landmarks bring both filters back, as sure as they are right."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from baselines.ekf_equations import observe_rows as observe_by_ekf
from baselines.ekf_slam import EkfSlam
from baselines.filter_window import LOST
from baselines.invariant_ekf import InvariantEkf
from baselines.invariant_equations import InvariantState, landmark_covariance
from baselines.invariant_equations import observe_rows as observe_by_invariant
from baselines.sonar_update import (
    GATED,
    USED,
    Frame,
    SonarModel,
    correct_jointly,
    far_polar_covariance,
    is_beyond_linear,
    no_outcomes,
    range_azimuth_jacobian,
)
from sonar_graph.navigation.preintegration.dvl_gaps import GapMotion
from sonar_graph.navigation.preintegration.recursion import NO_MOTION
from sonar_graph.numerics.mat3 import IDENTITY, ZERO, ZEROS, skew
from sonar_graph.sequence import NS_PER_S, Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.slam.landmarks.association import gate_threshold

APERTURE_RAD = 0.3
SONAR = SonarModel(IDENTITY, ZERO, gate_threshold(0.999, 2), APERTURE_RAD, 0.02**2, 0.01**2, False, 0.0, 1.0)
LANDMARK = np.array([25.0, 12.0, -1.0])
BEFORE_S, LOST_S = 25.0, 120.0
AFTER_S = np.array([3.0, 10.0, 20.0])


def by_ekf(P, seen, was_lost):
    x, told = np.zeros(9), no_outcomes(1)
    outcomes, innovation, S = told
    x[6:] = LANDMARK
    observe_by_ekf(x, P, 9, NO_MOTION, SONAR, Frame(seen, 0, 1, told, was_lost))
    return outcomes[0], x[:3], P[:3, :3], innovation[0], S[0]


def by_invariant(P, seen, was_lost):
    outcomes, innovation, S = told = no_outcomes(1)
    own = np.r_[3:6, 9:12, 0:3, 6:9]  # [angles, bias, X, p] from [X, angles, p, bias]; the body is at the origin
    wide = np.zeros((12, 12))
    wide[:9, :9] = P
    turned = np.eye(12)
    turned[9:, :3] = skew(LANDMARK)
    state = InvariantState(
        np.eye(3), np.vstack([np.zeros(3), LANDMARK]), np.zeros(3), turned @ wide[np.ix_(own, own)] @ turned.T
    )
    still = GapMotion(NO_MOTION, ZEROS, ZEROS)
    state = observe_by_invariant(state, still, SONAR, Frame(seen, 0, 1, told, was_lost))
    return outcomes[0], state.points[0], landmark_covariance(state, 0), innovation[0], S[0]


FILTERS = pytest.mark.parametrize("observe", [by_ekf, by_invariant], ids=["ekf-slam", "invariant-ekf"])


def look(observe, X, position_sigma_m, was_lost, wrong_m=0.0):
    """One exact look at the landmark from X, by a filter that expects to be at the origin."""
    P = np.diag(np.repeat(np.square([position_sigma_m, 1e-3, 0.01]), 3))
    q = LANDMARK - X
    z = np.hypot(np.hypot(q[0], q[1]), q[2]) + wrong_m, np.arctan2(q[1], q[0])
    seen = np.array([0]), np.array([z[0]]), np.array([z[1]]), np.full((1, 2, 2), np.nan)
    return observe(P, seen, was_lost)


@pytest.mark.slow
@FILTERS
def test_one_look_finds_a_vehicle_that_is_far_from_where_it_was_expected(observe):
    """And linearised where it was expected it is sure of a wrong place."""
    X = np.array([40.0, 20.0, -0.5])
    outcome, at, P, _, S = look(observe, X, 30.0, was_lost=True)
    assert outcome == USED
    assert np.linalg.norm((at - X)[:2]) < 0.5
    assert (at - X) @ np.linalg.solve(P, at - X) < chi2.ppf(0.99, 3)
    assert S[0, 0] == pytest.approx(30.0**2, rel=0.01)
    _, at, P, _, _ = look(observe, X, 30.0, was_lost=False)
    assert (at - X) @ np.linalg.solve(P, at - X) > 1000.0


@FILTERS
def test_a_vehicle_near_where_it_was_expected_sees_as_without_a_gap(observe):
    X = np.array([0.1, -0.1, 0.05])
    with_gap, without = look(observe, X, 0.2, True), look(observe, X, 0.2, False)
    for one, other in zip(with_gap, without, strict=True):
        np.testing.assert_array_equal(one, other)


@FILTERS
def test_what_no_vehicle_in_reach_sees_is_refused(observe):
    outcome, at, _, innovation, S = look(observe, np.array([40.0, 20.0, -0.5]), 30.0, True, wrong_m=300.0)
    assert outcome == GATED
    assert at.tolist() == [0.0, 0.0, 0.0]
    assert innovation @ np.linalg.solve(S, innovation) > SONAR.gate


def test_the_noise_of_a_view_holds_that_of_many_beams():
    """Of elevations anywhere in the aperture, for a length that is taken at elevation zero."""
    elevation = np.random.default_rng(3).uniform(-APERTURE_RAD / 2, APERTURE_RAD / 2, 200_000)
    V = far_polar_covariance(40.0, (0.0, 0.0, 0.0), APERTURE_RAD)
    assert V[0, 0] == pytest.approx(np.mean(np.square(40.0 * (1 - np.cos(elevation)))), rel=0.02)
    assert V[2, 2] == pytest.approx(np.var(elevation), rel=0.02)


def test_linear_is_what_errs_by_less_than_the_noise():
    """Sagitta of an exact circle: across a beam of 10 m, sigma 1 m, a range is 5 cm longer."""
    G_z = np.diag([1.0, 10.0, 10.0])
    across = np.diag([0.0, 1.0, 0.0])
    longer_m = np.hypot(10.0, 1.0) - 10.0
    assert not is_beyond_linear(across, G_z, 10.0, ((1.05 * longer_m) ** 2, 0.0, 1.0))
    assert is_beyond_linear(across, G_z, 10.0, ((0.95 * longer_m) ** 2, 0.0, 1.0))
    both = np.diag([1.0, 1.0, 0.0])
    assert not is_beyond_linear(both, G_z, 10.0, (1.0, 0.0, 0.0101**2))
    assert is_beyond_linear(both, G_z, 10.0, (1.0, 0.0, 0.0099**2))
    assert not is_beyond_linear(1e6 * np.diag([0.0, 0.0, 1.0]), G_z, 10.0, (1e-4, 0.0, 1e-4))
    np.testing.assert_allclose(range_azimuth_jacobian(G_z, 10.0) @ [0.3, 0.2, 5.0], [0.3, 0.02])


TURNED = Rotation.from_euler("xyz", [0.4, -0.7, 1.9]).as_matrix()


def test_the_noise_of_a_view_is_the_detections_where_the_aperture_is_none():
    V = far_polar_covariance(40.0, (0.04, -0.003, 0.0009), 0.0)
    np.testing.assert_array_equal(V, [[0.04, -0.003, 0.0], [-0.003, 0.0009, 0.0], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize("range_m", [10.0, 3.0])
def test_a_shift_is_the_same_in_range_and_azimuth_wherever_the_sonar_points(range_m):
    """A left inverse of the derivative by range and azimuth, blind to elevation."""
    G_z = TURNED @ np.diag([1.0, range_m, range_m])
    np.testing.assert_allclose(range_azimuth_jacobian(G_z, range_m) @ G_z, np.eye(2, 3), atol=1e-12)


@pytest.mark.parametrize("range_m", [10.0, 3.0])
def test_what_is_linear_does_not_depend_on_where_the_sonar_points(range_m):
    """By (1) with 0.3 m along and 0.2 m across: two per cent of the sigma on either side."""
    G_z, cov = TURNED @ np.diag([1.0, range_m, range_m]), TURNED @ np.diag([0.09, 0.04, 4.0]) @ TURNED.T
    longer_m, turned_rad = 0.04 / (2 * range_m), 0.3 * 0.2 / range_m**2
    for share, is_beyond in ((0.98, True), (1.02, False)):
        assert is_beyond_linear(cov, G_z, range_m, ((share * longer_m) ** 2, 7.0, 9.0)) == is_beyond
        assert is_beyond_linear(cov, G_z, range_m, (9.0, 7.0, (share * turned_rad) ** 2)) == is_beyond


def nees_after_gap(kind, seed, forgets_gap):
    """NEES of position at `AFTER_S`; where the gap is forgotten, views are linearised at the predicted place."""
    options = MissionOptions(
        seed=seed, duration_s=BEFORE_S + LOST_S + 22.0, frame_rate_hz=0.5, false_detections_per_frame=0
    )
    mission = simulate_mission(options)
    start_ns = mission.start_ns
    seconds = (mission.dvl.stamps_ns - start_ns) / NS_PER_S
    lost = mission.dvl.rows((seconds <= BEFORE_S) | (seconds >= BEFORE_S + LOST_S))
    first_after = np.searchsorted(lost.stamps_ns, start_ns + (BEFORE_S + LOST_S) * NS_PER_S)
    closed_ns = lost.stamps_ns[first_after + 1]  # the second row confirms the first
    after_ns = closed_ns + np.round(AFTER_S * NS_PER_S).astype(np.int64)
    sequence = Sequence("gap", mission.calibration, mission.imu, lost, None, mission.detections)
    estimator, squares = kind(mission.calibration), []
    for window in sequence.replay(np.r_[closed_ns + NS_PER_S // 50, after_ns]):
        estimate = estimator.process(window)
        if forgets_gap:
            estimator._clock[LOST] = 0
        if window.end_ns in after_ns:
            world_T_body = estimate.world_T_body
            error = world_T_body.translation() - mission.truth.at(np.array([window.end_ns])).positions[0]
            error = world_T_body.rotation().unrotate(error)
            squares.append(error @ np.linalg.solve(estimate.covariance[3:, 3:], error))
    return np.array(squares)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [EkfSlam, InvariantEkf])
def test_after_a_long_gap_landmarks_make_the_position_as_sure_as_it_is_right(kind):
    """Over short missions, two-sided 99.9 % of a chi-square; instants of a run share their errors and count as one."""
    squares = np.array([nees_after_gap(kind, seed, False) for seed in range(5)])
    low, high = chi2.ppf([0.0005, 0.9995], 3 * len(squares))
    for total in squares.sum(axis=0):
        assert low < total < high
    assert nees_after_gap(kind, 0, True).min() > high


@pytest.mark.parametrize("m", [1, 2, 5])
def test_a_joint_correction_is_the_textbooks_and_symmetric_to_the_last_bit(m):
    """``K = P H^T S^-1``, ``P - K S K^T`` and ``K e`` by numpy's solver; room beyond the state is left alone."""
    rng, n, room = np.random.default_rng(m), 7, 9
    A, H = rng.standard_normal((n, n)), rng.standard_normal((m, n))
    before = np.full((room, room), 3.0)
    before[:n, :n] = A @ A.T
    before[:n, :n] = 0.5 * (before[:n, :n] + before[:n, :n].T)
    P, shifted, e = before.copy(), np.arange(float(room)), rng.standard_normal(m)
    S = H @ before[:n, :n] @ H.T + np.eye(m)
    K = np.linalg.solve(S, H @ before[:n, :n]).T
    correct_jointly(P, n, H @ before[:n, :n], S, e, shifted)
    np.testing.assert_allclose(P[:n, :n], before[:n, :n] - K @ S @ K.T, atol=1e-11)
    np.testing.assert_allclose(shifted[:n], np.arange(n) + K @ e, atol=1e-11)
    assert np.array_equal(P, P.T)
    assert np.array_equal(P[n:], before[n:])
    assert np.array_equal(shifted[n:], np.arange(n, room))
