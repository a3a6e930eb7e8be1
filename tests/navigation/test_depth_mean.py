import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.navigation.samples import weights_at_end


@given(
    st.lists(st.tuples(st.floats(0.01, 2.0), st.floats(1e-5, 1e-2)), min_size=1, max_size=12),
    st.floats(1e-8, 1e-2),
    st.floats(0.0, 1.0),
)
def test_weights_are_those_of_least_squares_with_a_shared_random_walk(samples, wander, last_s):
    """Two samples share the error of the way that both are carried: C_kl = q min(t_k, t_l) + r_k for k = l."""
    steps, variance = np.array(samples).T
    before_end = last_s + np.append(np.cumsum(steps[:0:-1])[::-1], 0.0)
    C = wander * np.minimum.outer(before_end, before_end) + np.diag(variance)
    ones = np.ones(len(variance))
    expected = np.linalg.solve(C, ones) / (ones @ np.linalg.solve(C, ones))
    weights, mean_variance = weights_at_end(variance, before_end, wander)
    assert weights == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert mean_variance == pytest.approx(1 / (ones @ np.linalg.solve(C, ones)), rel=1e-6)


def test_without_wander_weights_are_inverse_variances():
    weights, mean_variance = weights_at_end(np.array([1.0, 3.0]), np.array([4.0, 1.0]), 0.0)
    assert weights == pytest.approx([0.75, 0.25])
    assert mean_variance == pytest.approx(0.75)


def test_many_samples_do_not_know_the_end_better_than_a_filter_would():
    """1 cm samples at 5 Hz, a walk of 1 cm/s at 5 Hz: sqrt(q r dt), however long the interval."""
    r, q, dt = 1e-4, 2e-5, 0.2
    for n in (200, 2000):
        _, variance = weights_at_end(np.full(n, r), np.arange(n)[::-1] * dt, q)
        assert variance == pytest.approx(np.sqrt(q * r * dt), rel=0.4)
