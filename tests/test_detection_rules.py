"""What a row of detections may say: at the very edge of each rule, and where numbers are none."""

import gtsam
import numpy as np
import pytest

from sonar_graph.measurements import FIRST_TOO_LARGE_ID, no_posterior, possible_ranges, too_large


def test_a_range_is_above_zero_and_at_most_100_km():
    assert possible_ranges(np.array([1e-9, 1.0, 100_000.0])).all()
    assert not possible_ranges(np.array([0.0, -1.0, np.nextafter(100_000.0, np.inf), np.inf, np.nan])).any()


def test_posteriors_that_were_rounded_to_single_precision_still_are():
    exact = np.random.default_rng(1).dirichlet(np.ones(20), 1000)
    assert not no_posterior(exact.astype(np.float32).astype(np.float64)).any()


@pytest.mark.parametrize("row", [[0.5, 0.500002], [-1e-9, 0.5], [0.5, np.nan], [np.inf, 0.0], [2.0, -1.5]])
def test_what_is_no_posterior_is_told_from_one_beside_it(row):
    assert no_posterior(np.array([row, [0.0, 0.0], [1.0, 0.0], [0.5, 0.5]])).tolist() == [True, False, False, False]


def test_the_largest_identity_is_the_last_that_a_key_gives_back():
    largest = FIRST_TOO_LARGE_ID - 1
    assert gtsam.Symbol(gtsam.symbol("l", largest)).index() == largest
    with pytest.raises((ValueError, RuntimeError)):
        gtsam.symbol("l", FIRST_TOO_LARGE_ID)
    ids = np.array([[-1, largest], [FIRST_TOO_LARGE_ID, -1], [3, 2**63 - 1]])
    assert too_large(ids).tolist() == [False, True, True]
