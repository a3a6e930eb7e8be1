"""Values of a sensor between its rows, against numpy's interpolation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.navigation.samples import rows_until, value_among, value_at

STAMPS = np.array([0, 10, 14, 30, 31], dtype=np.int64)
VALUES = np.random.default_rng(0).standard_normal((5, 3))
instants = st.integers(-5, 40)


def first_at_or_after(t: int) -> int:
    return rows_until(STAMPS, t - 1)


@given(instants)
def test_rows_until_an_instant_are_those_stamped_at_or_before_it(t):
    assert rows_until(STAMPS, t) == np.count_nonzero(t >= STAMPS)
    assert rows_until(STAMPS[:0], t) == 0


@given(instants)
def test_values_are_linear_between_rows_and_constant_beyond_them(t):
    expected = [np.interp(t, STAMPS, VALUES[:, axis]) for axis in range(3)]
    assert value_at(STAMPS, VALUES, first_at_or_after(t), t, False) == pytest.approx(expected)


@given(instants)
def test_held_values_are_those_of_the_interval_that_ends_next(t):
    row = min(int(np.searchsorted(STAMPS, t)), 4)
    assert value_at(STAMPS, VALUES, first_at_or_after(t), t, True) == pytest.approx(VALUES[row])


@given(instants, st.integers(1, 5), st.booleans())
def test_rows_that_are_not_to_be_used_do_not_matter(t, known, hold_past):
    """As if there were only the first."""
    among = value_among(STAMPS, VALUES, known, first_at_or_after(t), t, hold_past)
    i = rows_until(STAMPS[:known], t - 1)
    alone = value_at(STAMPS[:known], VALUES[:known], i, t, hold_past)
    if first_at_or_after(t) >= known:
        alone = VALUES[known - 1]
    assert among == pytest.approx(alone)
