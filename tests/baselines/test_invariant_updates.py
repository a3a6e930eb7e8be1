import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from baselines.invariant_equations import (
    InvariantState,
    correct_depth,
    correct_plane,
    correct_up,
    landmark_covariance,
    observe_rows,
)
from baselines.sonar_update import GATED, NEW, NO_SLOT, PASSED_OVER, USED, Frame, no_outcomes
from sonar_graph.slam.models.sonar_model import locate, range_azimuth

from .invariant import D_BIAS, MOUNTING, SONAR, body_after, copied, gap_motion_of, moved_by, state_at

TWIST = np.array([0.02, -0.01, 0.05, 0.1, 0.02, -0.01])
NOISE = np.diag([0.02**2, 0.01**2])
MOTION_SIGMA = 0.01
ATTITUDE = np.array([0.1, 0.2, 0.3])


def motion():
    return gap_motion_of(TWIST, MOTION_SIGMA**2 * np.eye(6), D_BIAS)


def sonar_pose(state, xi_motion=None):
    R, X = body_after(state, TWIST, np.zeros(6) if xi_motion is None else xi_motion)
    return gtsam.Pose3(gtsam.Rot3(R), X).compose(MOUNTING)


def frame(state, slots, z, model=SONAR):
    m, (range_m, azimuth) = len(slots), np.array(z, float).T.copy()
    columns = np.array(slots), range_m, azimuth, np.array([NOISE] * m)
    outcomes, innovations, covs = told = no_outcomes(m)
    state = observe_rows(state, motion(), model, Frame(columns, 0, m, told, False))
    return state, outcomes.tolist(), innovations, covs


def bare(scale=0.003):
    return state_at(ATTITUDE, landmarks=np.empty((0, 3)), scale=scale)


@pytest.mark.slow
def test_a_new_landmark_has_the_covariance_of_many_draws():
    """Of state, bias, motion, range and azimuth, and an elevation anywhere in the aperture."""
    rng, aperture = np.random.default_rng(5), 0.05
    before = bare()
    after, outcomes, _, _ = frame(copied(before), [0], [[2.0, 0.3]], SONAR._replace(aperture_rad=aperture))
    assert outcomes == [NEW]
    assert_array_equal(after.P[:9, :9], before.P)
    root, draws = np.linalg.cholesky(before.P), []
    for _ in range(20_000):
        xi = root @ rng.normal(size=9)
        moved = moved_by(before, xi)
        theta_and_eps = np.kron(np.eye(2), gtsam.Rot3.Expmap(TWIST[:3]).matrix()) @ (MOTION_SIGMA * rng.normal(size=6))
        pose = sonar_pose(moved, theta_and_eps + D_BIAS @ xi[3:6])
        z = rng.multivariate_normal([2.0, 0.3], NOISE)
        draws.append(locate(pose, *z, rng.uniform(-0.5, 0.5) * aperture))
    sigma = np.std(draws, axis=0)
    expected, scale = np.cov(np.transpose(draws)), np.outer(sigma, sigma)
    assert_allclose(after.points[1], np.mean(draws, axis=0), atol=2e-3)
    assert_allclose(landmark_covariance(after, 1) / scale, expected / scale, atol=0.05)


def test_a_known_floor_fixes_the_height_of_a_new_landmark():
    state = state_at(np.zeros(3), landmarks=np.empty((0, 3)), scale=0.003)
    true = locate(sonar_pose(state), 2.0, 0.3, 0.05)
    model = SONAR._replace(has_floor=True, floor_z_m=true[2], floor_variance_m2=1e-6)
    state, _, _, _ = frame(state, [0], [[2.0, 0.3]], model)
    assert_allclose(state.points[1], true, atol=1e-3)
    assert landmark_covariance(state, 1)[2, 2] == pytest.approx(1e-6, rel=0.01)


def test_a_false_detection_far_above_the_floor_does_not_move_the_vehicle():
    before = bare()
    model = SONAR._replace(has_floor=True, floor_z_m=before.points[0, 2] - 5.0)
    after, outcomes, _, _ = frame(copied(before), [0], [[3.0, 0.3]], model)
    assert outcomes == [NEW]
    assert_array_equal(after.points[0], before.points[0])
    assert_allclose(after.points[1], locate(sonar_pose(before), 3.0, 0.3, 0.0), atol=1e-12)


def test_an_observation_is_textbook_and_says_what_it_expected():
    """Innovation and its covariance by draws of what there is to draw."""
    rng, state = np.random.default_rng(7), state_at(ATTITUDE, scale=0.002)
    z = np.asarray(range_azimuth(sonar_pose(state), state.points[2])) + np.array([0.01, -0.005])
    root, seen = np.linalg.cholesky(state.P), []
    for _ in range(20_000):
        xi = root @ rng.normal(size=15)
        moved = moved_by(state, xi)
        turn = np.kron(np.eye(2), gtsam.Rot3.Expmap(TWIST[:3]).matrix())
        pose = sonar_pose(moved, turn @ (MOTION_SIGMA * rng.normal(size=6)) + D_BIAS @ xi[3:6])
        seen.append(np.asarray(range_azimuth(pose, moved.points[2])) + np.sqrt(np.diag(NOISE)) * rng.normal(size=2))
    before = copied(state)
    after, outcomes, innovations, covs = frame(state, [1], [z])
    assert outcomes == [USED]
    assert_allclose(innovations[0], [0.01, -0.005], atol=1e-9)
    sigma = np.std(seen, axis=0)
    assert_allclose(covs[0] / np.outer(sigma, sigma), np.cov(np.transpose(seen)) / np.outer(sigma, sigma), atol=0.05)
    assert np.trace(after.P) < np.trace(before.P)


def test_what_is_gated_or_passed_over_changes_nothing():
    before = state_at(ATTITUDE, scale=0.002)
    predicted = np.asarray(range_azimuth(sonar_pose(before), before.points[1]))
    after, outcomes, innovations, _ = frame(copied(before), [0, NO_SLOT], [predicted + np.array([0.5, 0.0]), predicted])
    assert outcomes == [GATED, PASSED_OVER]
    assert innovations[0, 0] == pytest.approx(0.5)
    assert np.isnan(innovations[1]).all()
    for part, same in zip(after, before, strict=True):
        assert_array_equal(part, same)


def test_an_azimuth_past_half_a_turn_is_a_small_innovation():
    state = state_at(ATTITUDE, scale=0.002)
    state.points[2] = locate(sonar_pose(state), 3.0, np.pi - 0.001, 0.1)
    _, outcomes, innovations, _ = frame(state, [1], [[3.0, -np.pi + 0.001]])
    assert outcomes == [USED]
    assert innovations[0, 1] == pytest.approx(0.002, abs=1e-9)


def prior(variances):
    return InvariantState(np.eye(3), np.zeros((1, 3)), np.zeros(3), np.diag(variances))


def test_depth_up_and_plane_are_scalar_kalman_updates_where_nothing_correlates():
    """At the origin and level: ``1 / P' = 1 / P + 1 / R``, and the estimate moves by ``P / (P + R)``."""
    variances = np.array([1e-2, 2e-2, 3e-2, 1.0, 1.0, 1.0, 0.1, 0.2, 0.3])
    still = gap_motion_of(np.zeros(6), 0.02 * np.eye(6), np.zeros((6, 3)))

    state = prior(variances)
    correct_depth(state, still, (0.0, 0.0, 0.0), 0.01, 0.03)  # and 0.02 by the motion
    assert state.P[8, 8] == pytest.approx(1 / (1 / 0.3 + 1 / 0.05))
    assert state.points[0, 2] == pytest.approx(0.01 * 0.3 / 0.35)

    state = prior(variances)
    correct_up(state, (0.0, 0.001, 1.0), 0.05)  # the body's y axis points up by a milliradian: roll
    assert_allclose(np.diag(state.P)[:3], [1 / (1 / 1e-2 + 20), 1 / (1 / 2e-2 + 20), 3e-2])
    assert state.R[2, 1] == pytest.approx(0.001 * 1e-2 / 6e-2, rel=1e-3)

    state = prior(variances)
    correct_plane(state, 0.02, 0.05, 0.01)
    assert_allclose(np.diag(state.P)[[0, 1, 8]], [1 / (100 + 100), 1 / (50 + 100), 1 / (1 / 0.3 + 20)])
    assert state.points[0, 2] == pytest.approx(0.02 * 0.3 / 0.35)
