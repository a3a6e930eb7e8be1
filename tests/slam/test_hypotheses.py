"""What a detection may be of before its place is looked at."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.slam.landmarks.association import LEAST_LANDMARKS, IdentityPosterior, RecogniserErrors

CHANCES = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=4).map(lambda p: [x / max(sum(p), 1.0) for x in p])


def statement(ids: list[int], probability: list[float]) -> IdentityPosterior:
    n = len(ids)
    rows = LandmarkDetections(
        np.zeros(1, dtype=int), np.ones(1), np.ones(1), np.ones((1, 2, 2)), np.array([ids]), np.array([probability])
    )
    assert n == len(probability)
    return IdentityPosterior.of(rows, 0)


@given(CHANCES, st.floats(0.001, 0.999), st.integers(LEAST_LANDMARKS, 60))
def test_weights_are_a_distribution_with_none_impossible(chances: list[float], q: float, count: int) -> None:
    ids = list(range(count))
    weights = np.exp(statement(ids[: len(chances)], chances).log_weights(ids, RecogniserErrors(wrong_id_probability=q)))
    assert weights.sum() == pytest.approx(1.0)
    assert weights.min() >= min(0.5 * q / count, 0.5 * q) * (1 - 1e-9)


def test_the_order_of_weights_is_that_of_the_posterior() -> None:
    weights = statement([5, 3, -1], [0.2, 0.7, 0.1]).log_weights([3, 4, 5], RecogniserErrors(wrong_id_probability=0.1))
    assert np.exp(weights) == pytest.approx([0.63 + 0.0025, 0.0025, 0.18 + 0.0025, 0.9 * 0.1 + 0.05])


def test_what_is_no_landmark_is_not_stated() -> None:
    assert statement([5, -1, 3], [0.0, 0.9, 0.1]).probability == {3: 0.1}
    assert statement([-1], [1.0]).favourite is None


@pytest.mark.parametrize(
    ("probability", "named"),
    [
        ([0.97, 0.01], 5),
        ([0.2, 0.2], None),
        ([0.4, 0.1], None),
        ([0.5, 0.5], None),
        ([0.1, 0.6], 3),
        ([0.0, 0.0], None),
    ],
)
def test_only_what_is_more_probable_than_all_else_is_named(probability: list[float], named: int | None) -> None:
    assert statement([5, 3][: len(probability)], probability).favourite == named
