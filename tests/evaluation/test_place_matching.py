"""Landmarks of unknown identity are matched as the best of all matchings says."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonar_graph.evaluation.metrics import landmark_errors, named_by_place
from sonar_graph.states import LandmarkMap

UNKNOWN = 3_000_000_000
FARTHEST_M = 1.0


def landmark_map(ids: list[int], xy: np.ndarray) -> LandmarkMap:
    positions = np.column_stack([np.asarray(xy).reshape(-1, 2), np.zeros(len(ids))])
    return LandmarkMap(np.array(ids, dtype=np.int64), positions, np.tile(np.eye(3), (len(ids), 1, 1)))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 4), m=st.integers(1, 4))
def test_it_is_the_best_of_all_matchings(seed, n, m):
    rng = np.random.default_rng(seed)
    estimated = landmark_map([UNKNOWN + k for k in range(n)], 1.2 * rng.standard_normal((n, 2)))
    true = landmark_map(list(range(m)), 1.2 * rng.standard_normal((m, 2)))
    squared = np.sum((estimated.positions[:, None] - true.positions[None]) ** 2, axis=-1)
    best = (0, 0.0)
    for order in permutations([*range(m), *[-1] * n], n):
        pairs = [(k, j) for k, j in enumerate(order) if j >= 0]
        if all(squared[pair] <= FARTHEST_M**2 for pair in pairs):
            best = max(best, (len(pairs), -float(sum(squared[pair] for pair in pairs))))
    named = named_by_place(estimated, true, FARTHEST_M)
    assert np.all(np.diff(named.ids) > 0)
    matched = landmark_errors(named, true)
    assert len(matched) == best[0]
    assert np.sum(matched.horizontal_m**2) == pytest.approx(-best[1])


def test_known_identities_stay_wherever_they_are():
    true = landmark_map([1, 2], np.array([[0.0, 0.0], [5.0, 0.0]]))
    estimated = landmark_map([1, UNKNOWN, UNKNOWN + 1], np.array([[5.0, 0.0], [0.0, 0.0], [5.1, 0.0]]))
    named = named_by_place(estimated, true, FARTHEST_M)
    assert named.ids.tolist() == [1, 2, UNKNOWN]
    assert named.positions[:, 0].tolist() == [5.0, 5.1, 0.0]


def test_unnamed_landmarks_are_never_taken_for_known_ones():
    true = landmark_map([1], np.zeros((1, 2)))
    assert len(landmark_errors(landmark_map([UNKNOWN], np.zeros((1, 2))), true)) == 0


def test_nothing_is_matched_with_nothing():
    empty, true = landmark_map([], np.empty((0, 2))), landmark_map([1], np.zeros((1, 2)))
    assert len(named_by_place(empty, true, FARTHEST_M)) == 0
    assert named_by_place(true, empty, FARTHEST_M).ids.tolist() == [1]
