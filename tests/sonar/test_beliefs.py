from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.sonar.bayes import Beliefs, IdentityParams
from sonar_graph.sonar.confusion import Confusion
from sonar_graph.sonar.track_filter import Association

CONFUSION = Confusion(
    ids=(1, 2),
    matrix=((0.9, 0.05, 0.05), (0.05, 0.9, 0.05), (0.05, 0.05, 0.9)),
    sharpness=20.0,
    threshold=0.8,
    range_sigma_m=0.01,
    azimuth_sigma_rad=0.003,
)
LOOKS_LIKE_1 = np.array([[0.9, 0.05, 0.05]])
SIDEWAYS = np.array([[0.0, 1.0, 0.0]])


def _association(before: list[int], after: list[int]) -> Association:
    matrix = np.array([[float(track == old) for old in before] + [float(track not in before)] for track in after])
    n = len(after)
    return Association(
        0, np.array(before, int), np.array(after), matrix.reshape(n, len(before) + 1), np.zeros(n, int), np.ones(n),
        np.tile([2.0, 0, 0], (n, 1)), np.zeros((n, 3, 3)), np.full(n, 5), np.array([], int), (),
    )  # fmt: skip


def _after(rule: str, places: list[tuple[float, float, float] | None], **settings: float) -> list[float]:
    """Belief in landmark 1 after each frame of one track."""
    params = IdentityParams.model_validate({"rule": rule} | settings)
    beliefs, before, found = Beliefs(CONFUSION, params), [], []
    for place in places:
        looked = None if place is None else np.array(place)
        found.append(float(beliefs.step(_association(before, [7]), LOOKS_LIKE_1, [looked], SIDEWAYS)[0, 0]))
        before = [7]
    return found


def test_a_resting_sonar_learns_nothing_from_more_frames():
    first, *rest = _after("virtual-evidence", [(0, 0, 0)] * 20)
    assert first > 0.3
    assert max(rest) <= first


def test_looks_from_new_places_add_up():
    found = _after("virtual-evidence", [(0, 0.07 * k, 0) for k in range(6)])
    assert (np.diff(found) > 0).all()
    assert found[-1] > 0.98


def test_coming_back_to_an_old_place_is_no_news():
    away_and_back = _after("virtual-evidence", [(0, 0, 0), (0, 0.1, 0), (0, 0, 0), (0, 0.1, 0)])
    assert away_and_back[1] > away_and_back[0]
    assert away_and_back[3] <= away_and_back[1]


def test_motion_ahead_counts_less_than_motion_to_the_side():
    ahead = _after("virtual-evidence", [(0, 0, 0), (0.03, 0, 0)])
    aside = _after("virtual-evidence", [(0, 0, 0), (0, 0.03, 0)])
    assert ahead[0] < ahead[1] < aside[1]


def test_a_frame_without_a_look_changes_hardly_anything():
    found = _after("virtual-evidence", [(0, 0, 0), None])
    assert found[1] == pytest.approx(found[0], abs=1e-3)


def test_the_papers_rule_counts_every_frame_and_saturates():
    found = _after("jeffrey", [(0, 0, 0)] * 200)
    assert found[1] > found[0]
    assert found[-1] == pytest.approx(1.0, abs=0.01)  # C' b = s is solved by b = (1, 0, 0) here


def test_beliefs_follow_their_tracks_when_rows_change_places():
    beliefs = Beliefs(CONFUSION)
    scores = np.array([[0.9, 0.05, 0.05], [0.05, 0.9, 0.05]])
    place, sideways = np.zeros(3), np.tile(SIDEWAYS, (2, 1))
    first = beliefs.step(_association([], [3, 4]), scores, [place, place], sideways)
    after = beliefs.step(_association([3, 4], [4, 3]), 0 * scores, [None, None], sideways)
    np.testing.assert_allclose(after, first[::-1], atol=1e-3)


def test_beliefs_follow_their_numbers_when_the_tracks_before_come_in_another_order():
    beliefs = Beliefs(CONFUSION)
    scores = np.array([[0.9, 0.05, 0.05], [0.05, 0.9, 0.05]])
    place, sideways = np.zeros(3), np.tile(SIDEWAYS, (2, 1))
    first = beliefs.step(_association([], [3, 4]), scores, [place, place], sideways)
    after = beliefs.step(_association([4, 3], [3, 4]), 0 * scores, [None, None], sideways)
    np.testing.assert_allclose(after, first, atol=1e-3)


def test_a_new_track_that_is_not_looked_at_has_the_prior():
    found = Beliefs(CONFUSION, IdentityParams(unknown_prior=0.6)).step(
        _association([], [7]), np.zeros((1, 3)), [None], SIDEWAYS
    )
    np.testing.assert_allclose(found, [[0.2, 0.2, 0.6]])


def test_temper_is_a_share_of_the_log_odds():
    whole, half = (_after("virtual-evidence", [(0, 0, 0)], temper=temper)[0] for temper in (1.0, 0.5))
    prior = np.log(0.25 / 0.75)
    # Against the two others together, whose own odds stay as the base and the matrix are symmetric.
    assert prior < np.log(half / (1 - half)) < np.log(whole / (1 - whole))


def test_hardly_any_motion_waits_until_it_adds_up():
    """4 mm each: a hundredth of a frame; after 16 mm a seventh."""
    found = _after("virtual-evidence", [(0, 0.004 * k, 0) for k in range(6)])
    assert found[1] <= found[0]
    assert found[2] <= found[1]
    assert max(found[3:]) > found[0]


def test_places_beyond_the_limit_are_forgotten():
    back = [(0, 0, 0), (0, 0.14, 0), (0, 0, 0)]
    assert (np.diff(_after("virtual-evidence", back, most_looks=1)) > 0).all()
    remembered = _after("virtual-evidence", back)
    assert remembered[2] <= remembered[1]


def test_a_belief_fades_by_the_share_that_is_set_and_only_when_looked_at():
    kept, faded = (_after("virtual-evidence", [(0, 0, 0), None, (0, 1, 0)], forgetting=e) for e in (0.0, 1 - 1e-12))
    assert kept[1] == faded[1] == pytest.approx(kept[0])
    assert kept[2] > kept[0]
    assert faded[2] == pytest.approx(kept[0])  # as if it were the first look


@pytest.mark.parametrize("rule", ["virtual-evidence", "jeffrey"])
def test_scores_without_a_look_do_not_count(rule: str):
    found = _after(rule, [(0, 0, 0), None, None, None], forgetting=0.0)
    assert found[1:] == pytest.approx([found[0]] * 3)


def test_what_is_kept_of_a_track_ends_with_it():
    beliefs = Beliefs(CONFUSION)
    beliefs.step(_association([], [7]), LOOKS_LIKE_1, [np.zeros(3)], SIDEWAYS)
    beliefs.step(_association([7], [8]), LOOKS_LIKE_1, [np.zeros(3)], SIDEWAYS)
    assert list(beliefs._looks) == [8]
