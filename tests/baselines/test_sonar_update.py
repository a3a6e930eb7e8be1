"""After a long gap of the Doppler log landmarks bring both filters back, as sure as they are right."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from baselines import sonar_update
from baselines.ekf_slam import EkfSlam
from baselines.filter_window import LOST
from baselines.invariant_ekf import InvariantEkf
from sonar_graph.measurements import NS_PER_S
from sonar_graph.navigation import Odometry
from sonar_graph.numerics.jit import compiled
from sonar_graph.numerics.mat3 import IDENTITY, ZERO
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.slam.landmarks.association import gate_threshold

from .filters import LEVEL, both, derivative, observed, rotation

APERTURE_RAD = 0.3
SONAR = sonar_update.SonarModel(
    IDENTITY, ZERO, gate_threshold(0.999, 2), APERTURE_RAD, 0.02**2, 0.01**2, False, 0.0, 1.0
)
LANDMARK = np.array([25.0, 12.0, -1.0])
BEFORE_S, LOST_S = 25.0, 120.0
AFTER_S = np.array([3.0, 10.0, 20.0])


def look(filter_, X, position_sigma_m, was_lost, wrong_m=0.0):
    """One exact look at the landmark from X, by a filter that expects to be at the origin.

    Returns the outcome, position and covariance after it, the innovation and its covariance.
    """

    def at(shift):
        bare = filter_.posed(filter_.state(LEVEL, []), rotation(shift[3:6]), shift[:3])
        return filter_.appended(bare, LANDMARK + shift[6:])

    state = filter_.posed(filter_.state(LEVEL, LANDMARK), np.eye(3), np.zeros(3))
    T = derivative(lambda shift: filter_.error(at(shift), state), 9)
    state.P[:] = T @ np.diag(np.repeat(np.square([position_sigma_m, 1e-3, 0.01]), 3)) @ T.T
    q = LANDMARK - X
    z = np.linalg.norm(q) + wrong_m, np.arctan2(q[1], q[0])
    after, seen = observed(
        filter_, state, [0], z, SONAR, np.full((2, 2), np.nan), np.zeros(6), np.zeros((6, 6)), was_lost
    )
    told = seen.outcomes[0], filter_.world(after)[1], filter_.covariance(after, 0)
    return *told, seen.innovations[0], seen.covs[0]


@pytest.mark.slow
@both
def test_one_look_finds_a_vehicle_that_is_far_from_where_it_was_expected(filter_):
    """And linearised where it was expected it is sure of a wrong place."""
    X = np.array([40.0, 20.0, -0.5])
    outcome, at, P, _, S = look(filter_, X, 30.0, was_lost=True)
    assert outcome == sonar_update.USED
    assert np.linalg.norm((at - X)[:2]) < 0.5
    assert (at - X) @ np.linalg.solve(P, at - X) < chi2.ppf(0.99, 3)
    assert S[0, 0] == pytest.approx(30.0**2, rel=0.01)
    _, at, P, _, _ = look(filter_, X, 30.0, was_lost=False)
    assert (at - X) @ np.linalg.solve(P, at - X) > 1000.0


@both
def test_a_vehicle_near_where_it_was_expected_sees_as_without_a_gap(filter_):
    X = np.array([0.1, -0.1, 0.05])
    with_gap, without = look(filter_, X, 0.2, True), look(filter_, X, 0.2, False)
    for one, other in zip(with_gap, without, strict=True):
        np.testing.assert_array_equal(one, other)


@both
def test_what_no_vehicle_in_reach_sees_is_refused(filter_):
    outcome, at, _, innovation, S = look(filter_, np.array([40.0, 20.0, -0.5]), 30.0, True, wrong_m=300.0)
    assert outcome == sonar_update.GATED
    assert at.tolist() == [0.0, 0.0, 0.0]
    assert innovation @ np.linalg.solve(S, innovation) > SONAR.gate


def test_the_noise_of_a_view_holds_that_of_many_beams_and_without_aperture_is_the_detection_s():
    """Of elevations anywhere in the aperture, for a length that is taken at elevation zero."""
    elevation = np.random.default_rng(3).uniform(-APERTURE_RAD / 2, APERTURE_RAD / 2, 200_000)
    V = sonar_update.far_polar_covariance(40.0, (0.0, 0.0, 0.0), APERTURE_RAD)
    assert V[0, 0] == pytest.approx(np.mean(np.square(40.0 * (1 - np.cos(elevation)))), rel=0.02)
    assert V[2, 2] == pytest.approx(np.var(elevation), rel=0.02)
    V = sonar_update.far_polar_covariance(40.0, (0.04, -0.003, 0.0009), 0.0)
    np.testing.assert_array_equal(V, [[0.04, -0.003, 0.0], [-0.003, 0.0009, 0.0], [0.0, 0.0, 0.0]])


@compiled
def is_inside(seen, sonar):
    return sonar_update.is_inside_gate(seen, sonar)


@pytest.mark.parametrize("direction", [(2.0, 1.0), (2.0, -1.0), (1.0, 0.0)])
def test_the_gate_is_an_ellipse_of_a_correlated_innovation(direction):
    """Range and azimuth correlated by 0.9: along the long axis far more passes than across it."""
    S = np.array([[4.0, 1.8], [1.8, 1.0]])
    e = np.array(direction) * np.sqrt(SONAR.gate / (direction @ np.linalg.solve(S, direction)))
    for share, expected in ((0.999, True), (1.001, False)):
        seen = sonar_update.DetectionRow(0, (1.0, 0.0), (1.0, 0.0, 1.0), share * e, S)
        assert is_inside(seen, SONAR) == expected


def test_linear_is_what_errs_by_less_than_the_noise():
    """Sagitta of an exact circle: across a beam of 10 m, sigma 1 m, a range is 5 cm longer."""
    G_z = np.diag([1.0, 10.0, 10.0])
    across = np.diag([0.0, 1.0, 0.0])
    longer_m = np.hypot(10.0, 1.0) - 10.0
    assert not sonar_update.is_beyond_linear(across, G_z, 10.0, ((1.05 * longer_m) ** 2, 0.0, 1.0))
    assert sonar_update.is_beyond_linear(across, G_z, 10.0, ((0.95 * longer_m) ** 2, 0.0, 1.0))
    both = np.diag([1.0, 1.0, 0.0])
    assert not sonar_update.is_beyond_linear(both, G_z, 10.0, (1.0, 0.0, 0.0101**2))
    assert sonar_update.is_beyond_linear(both, G_z, 10.0, (1.0, 0.0, 0.0099**2))
    assert not sonar_update.is_beyond_linear(1e6 * np.diag([0.0, 0.0, 1.0]), G_z, 10.0, (1e-4, 0.0, 1e-4))
    np.testing.assert_allclose(sonar_update.range_azimuth_jacobian(G_z, 10.0) @ [0.3, 0.2, 5.0], [0.3, 0.02])


TURNED = Rotation.from_euler("xyz", [0.4, -0.7, 1.9]).as_matrix()


@pytest.mark.parametrize("range_m", [10.0, 3.0])
def test_a_shift_and_what_is_linear_are_the_same_wherever_the_sonar_points(range_m):
    """A left inverse of the derivative, blind to elevation; (1) with 0.3 m along and 0.2 m across, 2 % on each side."""
    G_z, cov = TURNED @ np.diag([1.0, range_m, range_m]), TURNED @ np.diag([0.09, 0.04, 4.0]) @ TURNED.T
    np.testing.assert_allclose(sonar_update.range_azimuth_jacobian(G_z, range_m) @ G_z, np.eye(2, 3), atol=1e-12)
    longer_m, turned_rad = 0.04 / (2 * range_m), 0.3 * 0.2 / range_m**2
    for share, is_beyond in ((0.98, True), (1.02, False)):
        assert sonar_update.is_beyond_linear(cov, G_z, range_m, ((share * longer_m) ** 2, 7.0, 9.0)) == is_beyond
        assert sonar_update.is_beyond_linear(cov, G_z, range_m, (9.0, 7.0, (share * turned_rad) ** 2)) == is_beyond


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
    estimator, squares = kind(mission.calibration, Odometry(mission.calibration)), []
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
