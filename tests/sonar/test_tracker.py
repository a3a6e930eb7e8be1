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
AREA = float(np.prod(WINDOW[:, 1] - WINDOW[:, 0]))
_mixing = np.random.default_rng(11).normal(size=(6, 6)) * 0.02
CORRELATED = _mixing @ _mixing.T
"""Covariance of a step whose rotation and translation are wrong together."""


def moved_by(x=0.0, y=0.0, yaw=0.0):
    pose = gtsam.Pose3(gtsam.Rot3.Rz(yaw), np.array([x, y, 0.0]))
    return SonarStep(pose, np.diag([1e-8] * 3 + [1e-6] * 3))


def run(tracker, frames, step=STILL):
    """Associations of frames, each a list of (range, azimuth)."""
    return [
        tracker.step(
            candidates_at([r for r, _ in seen], [a for _, a in seen]),
            step,
            (k + 1) * FRAME_NS,
        )
        for k, seen in enumerate(frames)
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
    r, a = ((1.8, 2.0), 0.06) if is_crowded else ((1.3, 2.5), 0.24)
    frames = [
        list(zip(rng.uniform(*r, n), rng.uniform(-a, a, n), strict=True))
        for n in counts
    ]
    shuffled = [[seen[i] for i in rng.permutation(len(seen))] for seen in frames]
    pairs = list(zip(run(Tracker(), frames), run(Tracker(), shuffled), strict=True))
    numbers = []
    for found, _ in pairs:
        assert found.matrix.shape == (len(found.ids), len(found.previous_ids) + 1)
        assert (found.matrix >= 0).all()
        assert np.allclose(found.matrix.sum(axis=1), 1.0)
        assert ((found.existence >= 0) & (found.existence <= 1)).all()
        goes_on = np.isin(found.ids, found.previous_ids)
        assert (
            found.matrix[goes_on, -1] == 0
        ).all()  # only a track that starts can be new
        assert (found.matrix[~goes_on, -1] > 0).all()
        numbers += found.ids[~goes_on].tolist()
        assert len(set(numbers)) == len(numbers)  # numbers are not used twice
        taken = found.candidate[found.candidate >= 0]
        assert len(np.unique(taken)) == len(taken)  # one candidate serves one track
    for name in ("position_m", "existence"):
        one, other = (np.sort(getattr(found, name), axis=0) for found in pairs[-1])
        assert np.allclose(one, other)


def test_association_and_existence_are_ratios_of_densities_by_hand():
    """Two tracks side by side, each seen again where it was; what may be of something new leaves a track itself.

    Then one track, and one candidate 2 cm behind it.
    """
    params = TrackingParams(drift_m=0.0, lifetime_s=1e12)
    found = run(Tracker(params), [[(2.0, 0.0), (2.0, 0.03)]] * 2)[-1]
    # A track starts with the noise of one candidate, and the next one adds its own: twice the variance.
    var_r = 2 * params.range_sigma_m**2
    var_a = 2 * params.azimuth_sigma_rad**2
    own = 0.1 / 0.6 * 0.9 / (2 * np.pi * np.sqrt(var_r * var_a))
    other = own * np.exp(-0.5 * 0.03**2 / var_a)
    none = 0.6 / AREA
    expected = np.array([[own + none, other, 0.0], [other, own + none, 0.0]]) / (
        own + other + none
    )
    assert found.matrix == pytest.approx(expected, rel=1e-6)
    found = run(Tracker(params), [[(2.0, 0.0)], [(2.02, 0.0)]])[-1]
    density = np.exp(-0.5 * 0.02**2 / var_r) / (2 * np.pi * np.sqrt(var_r * var_a))
    birth = 0.1 / 0.6
    likelihood = 0.1 + 0.9 * density * AREA / 0.5
    assert found.existence[0] == pytest.approx(
        birth * likelihood / (1 - birth + birth * likelihood), rel=1e-6
    )
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
    found = tracker.step(
        candidates_at([], []), STILL, frames * FRAME_NS + round(elapsed_s * 1e9)
    )
    faded = before * np.exp(-elapsed_s / lifetime_s)
    assert found.existence[0] == pytest.approx(
        faded * missed / (1 - faded + faded * missed), rel=1e-4
    )
    assert (found.matrix.tolist(), found.candidate.tolist()) == ([[1.0, 0.0]], [-1])
    assert found.frames_seen.tolist() == [frames]


def test_covariance_of_a_moved_track_is_that_of_samples_and_of_its_drift():
    rng = np.random.default_rng(9)
    step = SonarStep(moved_by(0.3, 0.1, 0.4).previous_T_sonar, CORRELATED)
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
    expected = np.cov(np.array(sampled).T) + 0.02**2 * np.eye(3)
    assert np.allclose(
        found.position_cov[0], expected, atol=0.06 * found.position_cov.max()
    )
    assert rested.position_cov[0] == pytest.approx(P + 0.02**2 * np.eye(3))


def test_a_correction_is_that_of_the_information_form():
    """P^-1 grows by H^T R^-1 H; H by differences of range and azimuth."""
    q = np.array([1.9, 0.2, -0.3])
    P = np.diag([1e-2, 3e-2, 2e-2])
    R = np.diag([9e-4, 2e-4])
    tracks = track_at(q, P)
    expected = Expected.of(tracks, R)

    def seen(point):
        return np.array([np.linalg.norm(point), np.arctan2(point[1], point[0])])

    H = np.column_stack([(seen(q + d) - seen(q - d)) / 2e-6 for d in 1e-6 * np.eye(3)])
    z = seen(q) + np.array([0.02, -0.01])
    after = corrected(tracks, expected, z[None], np.array([0]), R)
    information = np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H
    assert np.allclose(after.position_cov[0], np.linalg.inv(information), rtol=1e-5)
    gain = np.linalg.solve(information, H.T @ np.linalg.inv(R))
    assert after.position_m[0] == pytest.approx(q + gain @ [0.02, -0.01], abs=1e-7)


@pytest.mark.parametrize(
    ("inside_m", "ahead"), [(0.15, 1.0), (-0.15, -1.0)], ids=["too near", "too far"]
)
def test_what_leaves_the_image_ends_and_is_not_held_against_it(inside_m, ahead):
    tracker = Tracker(TrackingParams(lifetime_s=1e12))
    start_m = WINDOW[0, 0 if inside_m > 0 else 1] + inside_m
    before = run(tracker, [[(start_m, 0.0)]] * 10)[-1]
    tracker.skip(moved_by(0.2 * ahead))
    out = tracker.step(candidates_at([], []), moved_by(0.0), 20 * FRAME_NS)
    assert out.ended_ids.tolist() == before.ids.tolist() or out.existence[0] > 0.99
    gone = tracker.step(candidates_at([], []), moved_by(0.3 * ahead), 21 * FRAME_NS)
    assert "left the image" in out.ended_reasons + gone.ended_reasons
