"""Laws of landmarks in a frame of detections, for both filters: augmentation, floor, gate, innovation, order."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from baselines.sonar_update import GATED, NEW, NO_SLOT, PASSED_OVER, USED
from sonar_graph.slam.landmarks.association import gate_threshold
from sonar_graph.slam.models.sonar_model import FLOOR_GATE, elevation_on_floor, locate, range_azimuth

from .filters import BODY_M, LEVEL, MOTION_SIGMA, NOISE, SONAR, TWIST, both, observed, sonar_pose

TILTED = np.array([0.1, 0.2, 0.3])


def drawn(filter_, state, rng):
    """A true state, and the sonar there after a motion that errs."""
    true = filter_.moved(state, np.linalg.cholesky(state.P) @ rng.normal(size=len(state.P)))
    return true, sonar_pose(filter_, true, TWIST, MOTION_SIGMA * rng.normal(size=6))


def assert_covariance_of(draws, actual):
    sigma = np.std(draws, axis=0)
    scale = np.outer(sigma, sigma)
    assert_allclose(actual / scale, np.cov(np.transpose(draws)) / scale, atol=0.05)


def with_landmark(filter_, angles=TILTED, view=(2.0, 0.3, 0.05), scale=0.002):
    """A state with one landmark, and what is to be seen of it."""
    pose = sonar_pose(filter_, filter_.state(angles, [], scale))
    return filter_.state(angles, [locate(pose, *view)], scale), np.array(view[:2])


def assert_same_state(one, other):
    for part, same in zip(one, other, strict=True):
        assert_array_equal(part, same)


@pytest.mark.slow
@both
def test_a_new_landmark_has_the_covariance_of_many_draws(filter_):
    """Of state, bias, motion, range and azimuth, and an elevation anywhere in the aperture."""
    rng, aperture, before = np.random.default_rng(5), 0.05, filter_.state(TILTED, [], 0.003)
    after, seen = observed(filter_, before, [0], [[2.0, 0.3]], SONAR._replace(aperture_rad=aperture))
    assert seen.outcomes.tolist() == [NEW]
    draws = []
    for _ in range(20_000):
        z = rng.multivariate_normal([2.0, 0.3], NOISE)
        draws.append(locate(drawn(filter_, before, rng)[1], *z, rng.uniform(-0.5, 0.5) * aperture))
    assert_allclose(filter_.world(after)[2][0], np.mean(draws, axis=0), atol=2e-3)
    assert_covariance_of(draws, filter_.covariance(after, 1))


@pytest.mark.slow
@both
def test_an_innovation_has_the_covariance_of_many_draws(filter_):
    rng = np.random.default_rng(7)
    state, z = with_landmark(filter_)
    after, seen = observed(filter_, state, [0], [z + np.array([0.01, -0.005])])
    assert seen.outcomes.tolist() == [USED]
    assert_allclose(seen.innovations[0], [0.01, -0.005], atol=1e-9)
    views = []
    for _ in range(20_000):
        true, pose = drawn(filter_, state, rng)
        view = np.asarray(range_azimuth(pose, filter_.world(true)[2][0]))
        views.append(view + np.sqrt(np.diag(NOISE)) * rng.normal(size=2))
    assert_covariance_of(views, seen.covs[0])
    assert np.trace(filter_.covariance(after, 0)) < np.trace(filter_.covariance(state, 0))


@both
def test_a_known_floor_fixes_the_height_of_a_new_landmark(filter_):
    state = filter_.state(LEVEL, [], 0.003)
    true = locate(sonar_pose(filter_, state), 2.0, 0.3, 0.05)
    sonar = SONAR._replace(has_floor=True, floor_z_m=true[2], floor_variance_m2=1e-6)
    after, _ = observed(filter_, state, [0], [[2.0, 0.3]], sonar)
    assert_allclose(filter_.world(after)[2][0], true, atol=1e-3)
    assert filter_.covariance(after, 1)[2, 2] == pytest.approx(1e-6, rel=0.01)


@both
def test_without_a_floor_in_reach_a_new_landmark_is_on_the_centre_beam_and_the_vehicle_stays(filter_):
    state = filter_.state(TILTED, [], 0.003)
    middle = locate(sonar_pose(filter_, state), 3.0, 0.3, 0.0)
    for sonar in (SONAR, SONAR._replace(has_floor=True, floor_z_m=BODY_M[2] - 5.0)):
        after, seen = observed(filter_, state, [0], [[3.0, 0.3]], sonar)
        assert seen.outcomes.tolist() == [NEW]
        assert_allclose(filter_.world(after)[2][0], middle, atol=1e-12)
        assert_array_equal(filter_.world(after)[1], filter_.world(state)[1])
        assert_array_equal(filter_.covariance(after, 0), filter_.covariance(state, 0))


@both
@pytest.mark.parametrize(("share", "is_used"), [(0.5, True), (0.999, True), (1.001, False)])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_floor_outside_the_aperture_counts_up_to_its_gate(filter_, side, share, is_used):
    """The innovation's variance has the aperture's share, the pose's and the floor's."""
    state, floor_variance = filter_.state(TILTED, [], 0.002), 1e-4
    bare, _ = observed(filter_, state, [0], [[2.0, 0.3]])
    height_m, variance = filter_.world(bare)[2][0, 2], filter_.covariance(bare, 1)[2, 2]
    off_m = side * math.sqrt(share * FLOOR_GATE * (variance + floor_variance))
    sonar = SONAR._replace(has_floor=True, floor_z_m=height_m + off_m, floor_variance_m2=floor_variance)
    pose = sonar_pose(filter_, state)
    assert elevation_on_floor(pose, 2.0, 0.3, sonar.floor_z_m, sonar.aperture_rad) is None
    after, _ = observed(filter_, state, [0], [[2.0, 0.3]], sonar)
    if is_used:
        gain = variance / (variance + floor_variance)
        assert filter_.covariance(after, 1)[2, 2] == pytest.approx(gain * floor_variance, rel=0.05)
        assert filter_.world(after)[2][0, 2] == pytest.approx(height_m + gain * off_m, abs=0.01)
    else:
        assert_same_state(after, bare)


def test_the_floor_s_gate_is_passed_by_999_of_1000_that_stand_on_it():
    assert pytest.approx(gate_threshold(0.999, 1), abs=5e-3) == FLOOR_GATE


@both
def test_a_gated_or_passed_over_row_changes_nothing_and_has_its_innovation_or_none(filter_):
    state, z = with_landmark(filter_)
    after, seen = observed(filter_, state, [0, NO_SLOT], [z + np.array([1.0, 0.0]), z])
    assert seen.outcomes.tolist() == [GATED, PASSED_OVER]
    assert seen.innovations[0, 0] == pytest.approx(1.0)
    assert np.linalg.eigvalsh(seen.covs[0]).min() > 0
    assert np.isnan(seen.innovations[1]).all()
    assert_same_state(after, state)


@both
def test_the_innovation_of_azimuth_wraps_around(filter_):
    state, _ = with_landmark(filter_, view=(3.0, math.pi - 0.004, 0.1))
    _, seen = observed(filter_, state, [0], [[3.0, -math.pi + 0.004]])
    assert seen.outcomes.tolist() == [USED]
    assert seen.innovations[0, 1] == pytest.approx(0.008, abs=1e-9)


@both
def test_the_rows_of_a_frame_are_taken_in_their_order(filter_):
    z = [[2.0, 0.3], [2.001, 0.301], [2.0, 0.3], [2.5, -0.3]]
    after, seen = observed(filter_, filter_.state(LEVEL, [], 0.02), [0, 0, NO_SLOT, 1], z)
    assert seen.outcomes.tolist() == [NEW, USED, PASSED_OVER, NEW]
    assert len(filter_.world(after)[2]) == 2


@both
@pytest.mark.parametrize("hole", [(0, 0), (1, 1), (0, 1)])
def test_noise_that_the_log_does_not_give_is_the_calibration_s(filter_, hole):
    logged = NOISE.copy()
    logged[hole] = math.nan
    state, sonar = filter_.state(LEVEL, [], 0.02), SONAR._replace(range_variance_m2=NOISE[0, 0])
    given, missing = (observed(filter_, state, [0], [[2.0, 0.3]], sonar, noise)[0] for noise in (NOISE, logged))
    assert_same_state(given, missing)
