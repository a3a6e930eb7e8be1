"""Laws of the identity rules, and of beliefs over tracks and places."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.sonar import EVIDENCE, Confusion, IdentityParams
from sonar_graph.sonar.bayes import (
    Beliefs,
    bounded_evidence,
    independent_share,
    jeffrey,
    predict,
)
from sonar_graph.sonar.tracker import Association

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_rules_are_their_equations_with_an_index_for_everything(seed):
    rng = np.random.default_rng(seed)
    before, association, C, scores = (
        rng.dirichlet(np.ones(columns), rows)
        for rows, columns in ((2, 5), (3, 3), (5, 4), (3, 4))
    )
    birth = rng.dirichlet(np.ones(5))
    sums = rng.normal(0, 30, (3, 5))
    counted = rng.uniform(0, 9, 3)
    looks = rng.uniform(1, 5)
    doubt, forgetting = rng.uniform(size=2)
    start, printed, ours = np.zeros((3, 3, 5))
    for m, k in np.ndindex(start.shape):
        carried = association[m, 2] * birth[k]
        carried += sum(association[m, j] * before[j, k] for j in range(2))
        start[m, k] = (1 - forgetting) * carried + forgetting * birth[k]
        ours[m, k] = birth[k] * np.exp(sums[m, k] / (counted[m] + looks))
    for m, k, j in np.ndindex(3, 5, 4):
        usual = sum(C[i, j] * start[m, i] for i in range(5))
        printed[m, k] += C[k, j] * start[m, k] / usual * scores[m, j]
    ours /= ours.sum(axis=1, keepdims=True)
    found = predict(before, association, birth, forgetting)
    np.testing.assert_allclose(found, start)
    np.testing.assert_allclose(jeffrey(start, scores, C), printed)
    found = bounded_evidence(birth, sums, counted, looks, doubt)
    np.testing.assert_allclose(found, (1 - doubt) * ours + doubt * birth)


def test_endless_evidence_leaves_a_doubt_and_the_order_of_frames_none():
    birth = np.array([0.25, 0.25, 0.5])
    sure = bounded_evidence(birth, np.array([[1e6, 0.0, 0.0]]), np.ones(1), 3.0, 0.01)
    np.testing.assert_allclose(sure, [[0.9925, 0.0025, 0.005]])
    places = [(0, 0, 0), (0, 0.2, 0), (0, 0.4, 0)]
    odds = [LOOKS_LIKE_1, *[np.array([[-1.0, 2.0, 0.0]])] * 2]
    forth, back = (_after(places, odds=one)[-1] for one in (odds, odds[::-1]))
    assert forth == pytest.approx(back)


def test_news_follow_from_the_autocorrelation_of_a_triangle():
    """By numerical convolution: a lens that sends and receives weighs its aperture by a triangle."""
    places = np.linspace(-0.5, 0.5, 2001)
    triangle = np.maximum(0.07 - np.abs(places), 0.0)
    rho = np.convolve(triangle, triangle, mode="same")
    moved = np.array([-1.0, 0.0, 0.01, 0.03, 0.0357, 0.05, 0.07, 0.09, 0.12, 0.14, 1.0])
    expected = 1 - np.interp(moved, places, rho / rho.max()) ** 2
    np.testing.assert_allclose(independent_share(moved, 0.14), expected, atol=1e-3)
    assert expected[4] == pytest.approx(0.5, abs=0.01)


CONFUSION = Confusion(
    ids=(1, 2), matrix=((0.9, 0.05, 0.05), (0.05, 0.9, 0.05), (0.05, 0.05, 0.9)),
    weights=(0.0,) * len(EVIDENCE), looks=2.0,
    range_sigma_m=0.01, across_sigma_m=0.006, range_bound_m=1e-3, across_bound_m=1e-3, bound_power=1.5,
)  # fmt: skip
LOOKS_LIKE_1 = np.array([[6.0, -3.0, 0.0]])
SIDEWAYS = np.array([[0.0, 1.0, 0.0]])


def _association(before: list[int], after: list[int]) -> Association:
    """Each track is itself, or new."""
    is_same = np.equal.outer(after, before)
    is_new = ~is_same.any(axis=1, keepdims=True)
    matrix = np.hstack([is_same, is_new]).astype(float)
    none = np.array([], int)
    ids = np.array(after), np.array(before, int)
    return Association(ids[0], *[none] * 4, 0, ids[1], matrix, none, none, ())


def _after(
    places: list[tuple[float, float, float]],
    rule: str = "virtual-evidence",
    odds: list[np.ndarray] | None = None,
    **settings: float,
) -> list:
    """Belief in landmark 1 after each frame of one track, looked at from these places."""
    params = IdentityParams.model_validate({"rule": rule} | settings)
    beliefs = Beliefs(CONFUSION, params)
    before = []
    found = []
    looked = np.array([True])
    for k, place in enumerate(places):
        now = _association(before, [7])
        seen = LOOKS_LIKE_1 if odds is None else odds[k]
        after, _ = beliefs.step(now, seen, looked, np.array(place), SIDEWAYS)
        found.append(float(after[0, 0]))
        before = [7]
    return found


def test_a_resting_sonar_learns_nothing_but_by_the_papers_rule():
    first, *rest = _after([(0, 0, 0)] * 20, unknown_prior=2 / 3)
    assert first > 0.3
    assert max(rest) <= first
    theirs = _after([(0, 0, 0)] * 200, "jeffrey")
    assert theirs[1] > theirs[0]
    assert theirs[-1] > 0.85


def test_looks_from_new_places_add_up_and_old_places_are_no_news():
    found = _after([(0, 0.07 * k, 0) for k in range(6)], unknown_prior=2 / 3)
    assert (np.diff(found) > 0).all()
    assert found[-1] > 0.9
    back = (0, 0, 0)
    there = (0, 0.14, 0)
    first, second, third, fourth = _after([back, there] * 2)
    assert second > first
    assert max(third, fourth) <= second
    # places beyond the limit are forgotten
    assert (np.diff(_after([back, there, back], most_looks=1)) > 0).all()


@pytest.mark.parametrize("is_reversed", [False, True])
def test_beliefs_follow_their_tracks(is_reversed):
    """Rows change places after the frame, or before it."""
    beliefs = Beliefs(CONFUSION)
    scores = np.array([[6.0, -3.0, 0.0], [-3.0, 6.0, 0.0]])
    view = np.zeros(3), np.tile(SIDEWAYS, (2, 1))
    orders = ([4, 3], [3, 4]) if is_reversed else ([3, 4], [4, 3])
    first, _ = beliefs.step(_association([], [3, 4]), scores, np.full(2, True), *view)
    change = _association(*orders)
    after, _ = beliefs.step(change, np.nan * scores, np.full(2, False), *view)
    np.testing.assert_allclose(after, first if is_reversed else first[::-1], atol=1e-3)


def test_motion_ahead_is_as_much_news_as_half_of_it_to_the_side():
    ahead = _after([(0, 0, 0), (0.1, 0, 0)], ahead_ratio=2.0)
    assert ahead == pytest.approx(_after([(0, 0, 0), (0, 0.05, 0)]))
    assert ahead[1] < _after([(0, 0, 0), (0, 0.1, 0)])[1]
