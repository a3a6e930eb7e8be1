"""The distance of a velocity from the last one believed, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from sonar_graph.navigation.velocity_gate import GATE, distances

NS = 10**9
WALK = 0.1
COVS = np.array([np.diag([1.0, 2.0, 3.0]) * 1e-4, np.diag([4.0, 5.0, 6.0]) * 1e-4])


def expected(seconds: float, u: list[float], v: list[float]) -> float:
    """The formula of the module: each axis has ``Q_u + Q_v + q t + (w t |u|)^2`` with w t at most 2."""
    turning = min(0.3 * seconds, 2.0) * np.linalg.norm(u)
    variances = np.diag(COVS.sum(axis=0)) + WALK**2 * seconds + turning**2
    return float(np.sum(np.subtract(v, u) ** 2 / variances))


def found(
    stamps_ns: list[int], velocity: list[list[float]], partial: list[bool] | None = None, **before: object
) -> np.ndarray:
    """With the first row as the one before, unless another is given."""
    n = len(stamps_ns)
    cov = np.array([COVS[k % 2] for k in range(n)])
    last = before.get("last", (np.iinfo(np.int64).max, np.zeros(3), np.zeros((3, 3))))
    return distances(np.array(stamps_ns), np.array(velocity), cov, np.array(partial or [False] * n), *last, WALK)


@pytest.mark.parametrize("seconds", [0.1, 1.0, 5.0, 30.0])
def test_the_distance_is_that_of_the_formula(seconds):
    u, v = [0.6, -0.2, 0.3], [0.9, 0.4, -0.2]
    assert found([0, round(seconds * NS)], [u, v]) == pytest.approx([0.0, expected(seconds, u, v)])


def test_correlated_noise_counts_as_such():
    Q = 1e-4 * np.array([[2.0, 1.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.5, 1.0]])
    v = np.array([0.1, -0.1, 0.05])
    d = distances(np.array([0, NS]), np.array([np.zeros(3), v]), np.array([Q, Q]), np.zeros(2, bool), NS, v, Q, 0.0)
    assert d[1] == pytest.approx(v @ np.linalg.solve(2 * Q, v))


def test_the_gate_is_the_quantile_that_a_true_velocity_passes_but_once_in_a_billion():
    assert chi2(3).isf(1e-9) == pytest.approx(GATE, abs=0.05)


def test_the_first_row_of_all_has_nothing_to_be_compared_with():
    assert found([5], [[9.0, 0.0, 0.0]]) == pytest.approx([0.0])
    assert found([5], [[9.0, 0.0, 0.0]], last=(5, np.zeros(3), COVS[1])) == pytest.approx([0.0])
    (distance,) = found([NS], [[9.0, 0.0, 0.0]], last=(0, np.zeros(3), COVS[1]))
    assert distance == pytest.approx(expected(1.0, [0.0] * 3, [9.0, 0.0, 0.0]))


def test_rows_are_compared_with_the_last_one_believed():
    """The second is not believed; the third is like the first, the fourth like the third."""
    velocity = [[0.5, 0.0, 0.0], [9.0, 0.0, 0.0], [0.6, 0.0, 0.0], [0.7, 0.0, 0.0]]
    d = found([0, NS // 10, 2 * NS // 10, 3 * NS // 10], velocity)
    variances = [2e-4 + WALK**2 * 0.2 + (0.06 * 0.5) ** 2, 5e-4 + WALK**2 * 0.1 + (0.03 * 0.6) ** 2]
    assert d[1] > GATE
    assert d[2] == pytest.approx(0.1**2 / variances[0])
    assert d[3] == pytest.approx(0.1**2 / variances[1])


def test_a_row_that_measured_a_part_is_compared_but_nothing_with_it():
    velocity = [[0.5, 0.0, 0.0], [0.55, 0.0, 0.0], [0.6, 0.0, 0.0]]
    d = found([0, NS // 10, 2 * NS // 10], velocity, [False, True, False])
    assert d[1] == pytest.approx(expected(0.1, velocity[0], velocity[1]))
    assert d[2] == pytest.approx(0.1**2 / (2e-4 + WALK**2 * 0.2 + (0.06 * 0.5) ** 2))


def test_a_distance_at_the_gate_is_believed():
    """Just inside it becomes the one that others are compared with, just outside it does not."""
    spread = np.sqrt(1e-4 + 4e-4 + WALK**2 * 0.1)
    for factor, believed in ((1 - 1e-9, True), (1 + 1e-9, False)):
        jump = factor * np.sqrt(GATE) * spread
        d = found([0, NS // 10, 2 * NS // 10], [[0.0] * 3, [jump, 0.0, 0.0], [jump, 0.0, 0.0]])
        assert (d[2] == 0.0) == believed
