"""Laws of tracks: existence, association, and the filter of points at rest."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.sonar import SonarStep
from sonar_graph.sonar.tracker import (
    Expected,
    Tracker,
    TrackingParams,
    TrackStates,
    corrected,
)

from .polar_images import WINDOW, candidates_at

FRAME_NS = 100_000_000
STILL = SonarStep.none()
NOTHING = candidates_at([], [])


def moved_by(x=0.0, y=0.0, yaw=0.0):
    pose = gtsam.Pose3(gtsam.Rot3.Rz(yaw), np.array([x, y, 0.0]))
    return SonarStep(pose, np.diag([1e-8] * 3 + [1e-6] * 3))


def run(tracker, frames):
    """Associations of frames from one place, each an array of (range, azimuth)."""
    return [
        tracker.step(candidates_at(*np.reshape(seen, (-1, 2)).T), STILL, k * FRAME_NS)
        for k, seen in enumerate(frames, 1)
    ]


def track_at(q, P) -> TrackStates:
    return TrackStates(
        np.array([0]), np.array([q]), np.array([P]), np.array([0.5]), np.array([1])
    )


@given(
    st.lists(st.integers(0, 6), min_size=1, max_size=5),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)
def test_the_association_is_a_distribution_whatever_the_order(counts, seed, is_crowded):
    """Places are drawn and not chosen: between two candidates equally far from a track there is no better one."""
    rng = np.random.default_rng(seed)
    low, high = (
        ((1.8, -0.06), (2.0, 0.06)) if is_crowded else ((1.3, -0.24), (2.5, 0.24))
    )
    frames = [rng.uniform(low, high, (n, 2)) for n in counts]
    associations = run(Tracker(), frames)
    numbers = []
    for found in associations:
        assert found.matrix.shape == (len(found.ids), len(found.previous_ids) + 1)
        assert (found.matrix >= 0).all()
        assert np.allclose(found.matrix.sum(axis=1), 1.0)
        assert ((found.existence >= 0) & (found.existence <= 1)).all()
        is_new = ~np.isin(found.ids, found.previous_ids)
        # only a track that starts can be new
        np.testing.assert_array_equal(found.matrix[:, -1] > 0, is_new)
        numbers += found.ids[is_new].tolist()
        taken = found.candidate[found.candidate >= 0]
        assert len(np.unique(taken)) == len(taken)  # one candidate serves one track
    assert len(set(numbers)) == len(numbers)  # numbers are not used twice
    shuffled = run(Tracker(), [rng.permutation(seen) for seen in frames])
    for name in ("position_m", "existence"):
        one, other = (
            np.sort(getattr(each[-1], name), axis=0)
            for each in (associations, shuffled)
        )
        assert np.allclose(one, other)


def test_association_and_existence_are_ratios_of_densities_by_hand():
    """Two tracks side by side, each seen again where it was; what may be of something new leaves a track itself.

    Then one track, and one candidate 2 cm behind it.
    """
    params = TrackingParams(drift_m=0.0, lifetime_s=1e12)
    area = np.prod(np.diff(WINDOW))
    # A track starts with the noise of one candidate, and the next one adds its own: twice the variance.
    var_r = 2 * params.range_sigma_m**2
    var_a = 2 * params.azimuth_sigma_rad**2
    peak = 1 / (2 * np.pi * np.sqrt(var_r * var_a))
    birth = 0.1 / 0.6
    own = birth * 0.9 * peak
    other = own * np.exp(-0.5 * 0.03**2 / var_a)
    none = 0.6 / area
    found = run(Tracker(params), [[(2.0, 0.0), (2.0, 0.03)]] * 2)[-1]
    expected = np.array([[own + none, other, 0.0], [other, own + none, 0.0]])
    assert found.matrix == pytest.approx(expected / (own + other + none), rel=1e-6)
    found = run(Tracker(params), [[(2.0, 0.0)], [(2.02, 0.0)]])[-1]
    density = peak * np.exp(-0.5 * 0.02**2 / var_r)
    exists = birth * (0.1 + 0.9 * density * area / 0.5)
    expected = exists / (1 - birth + exists)
    assert found.existence[0] == pytest.approx(expected, rel=1e-6)
    # between two equally certain places
    assert found.position_m[0] == pytest.approx([2.01, 0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize(
    ("range_m", "frames", "lifetime_s", "elapsed_s", "missed"),
    [(1.9, 1, 1e12, 0.1, 0.1), (1.26, 3, 1e12, 0.1, 0.55), (1.9, 1, 10.0, 10.0, 0.1)],
    ids=["inside", "on the edge: missed with half the probability", "after a lifetime"],
)
def test_a_missed_track_loses_existence_as_bayes_says(
    range_m, frames, lifetime_s, elapsed_s, missed
):
    tracker = Tracker(TrackingParams(lifetime_s=lifetime_s, least_existence=0.0))
    before = run(tracker, [[(range_m, 0.0)]] * frames)[-1].existence[0]
    stamp_ns = frames * FRAME_NS + round(elapsed_s * 1e9)
    found = tracker.step(NOTHING, STILL, stamp_ns)
    faded = before * np.exp(-elapsed_s / lifetime_s)
    expected = faded * missed / (1 - faded + faded * missed)
    assert found.existence[0] == pytest.approx(expected, rel=1e-4)
    assert (found.matrix.tolist(), found.candidate.tolist()) == ([[1.0, 0.0]], [-1])
    assert found.frames_seen.tolist() == [frames]


def test_covariance_of_a_moved_track_is_that_of_samples_and_of_its_drift():
    """The rotation and the translation of the step are wrong together."""
    rng = np.random.default_rng(9)
    mixing = 0.02 * rng.normal(size=(6, 6))
    step = SonarStep(moved_by(0.3, 0.1, 0.4).previous_T_sonar, mixing @ mixing.T)
    q = np.array([2.0, 0.3, -0.2])
    P = np.diag([1e-3, 2e-3, 4e-3])
    found, rested = (track_at(q, P).moved(motion, 0.02) for motion in (step, STILL))
    points = rng.multivariate_normal(q, P, 8_000)
    noise = rng.multivariate_normal(np.zeros(6), step.covariance, 8_000)
    sampled = [
        step.previous_T_sonar.retract(n).transformTo(p)
        for n, p in zip(noise, points, strict=True)
    ]
    assert np.allclose(found.position_m[0], np.mean(sampled, axis=0), atol=1e-2)
    drift = 0.02**2 * np.eye(3)
    atol = 0.06 * found.position_cov.max()
    assert np.allclose(
        found.position_cov[0], np.cov(np.transpose(sampled)) + drift, atol=atol
    )
    assert rested.position_cov[0] == pytest.approx(P + drift)


def test_a_correction_is_that_of_the_information_form():
    """P^-1 grows by H^T R^-1 H; H by differences of range and azimuth."""
    q = np.array([1.9, 0.2, -0.3])
    P = np.diag([1e-2, 3e-2, 2e-2])
    R = np.diag([9e-4, 2e-4])
    off = np.array([0.02, -0.01])
    tracks = track_at(q, P)

    def seen(point):
        return np.array([np.linalg.norm(point), np.arctan2(point[1], point[0])])

    H = np.column_stack([(seen(q + d) - seen(q - d)) / 2e-6 for d in 1e-6 * np.eye(3)])
    z = np.array([seen(q) + off])
    after = corrected(tracks, Expected.of(tracks, R), z, np.array([0]), R)
    information = np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H
    assert np.allclose(after.position_cov[0], np.linalg.inv(information), rtol=1e-5)
    moved = np.linalg.solve(information, H.T @ np.linalg.solve(R, off))
    assert after.position_m[0] == pytest.approx(q + moved, abs=1e-7)


@pytest.mark.parametrize(
    ("inside_m", "ahead"), [(0.15, 1.0), (-0.15, -1.0)], ids=["too near", "too far"]
)
def test_what_leaves_the_image_ends_and_is_not_held_against_it(inside_m, ahead):
    tracker = Tracker(TrackingParams(lifetime_s=1e12))
    start_m = WINDOW[0, 0 if inside_m > 0 else 1] + inside_m
    before = run(tracker, [[(start_m, 0.0)]] * 10)[-1]
    tracker.skip(moved_by(0.2 * ahead))
    out = tracker.step(NOTHING, STILL, 20 * FRAME_NS)
    assert out.ended_ids.tolist() == before.ids.tolist() or out.existence[0] > 0.99
    gone = tracker.step(NOTHING, moved_by(0.3 * ahead), 21 * FRAME_NS)
    assert "left the image" in out.ended_reasons + gone.ended_reasons
