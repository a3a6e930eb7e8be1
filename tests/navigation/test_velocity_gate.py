"""The distance of a velocity from the last one believed, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from sonar_graph.devices.dvl_beams import UNMEASURED_M_S
from sonar_graph.navigation.dvl_screening.dvl_gate import GATE, VelocityVerdict, judge

NS = 10**9
WALK = 0.1
COVS = np.array([np.diag([1.0, 2.0, 3.0]) * 1e-4, np.diag([4.0, 5.0, 6.0]) * 1e-4])


def expected(seconds: float, u: list[float], v: list[float]) -> float:
    """The formula of the module: each axis has ``Q_u + Q_v + q t + (w t |u|)^2`` with w t at most 2."""
    turning = min(0.3 * seconds, 2.0) * np.linalg.norm(u)
    variances = np.diag(COVS.sum(axis=0)) + WALK**2 * seconds + turning**2
    return float(np.sum(np.subtract(v, u) ** 2 / variances))


def judged(
    stamps_ns: list[int],
    velocity: list[list[float]],
    partial: tuple[int, ...] = (),
    known: tuple[int, ...] = (),
    gate: float = GATE,
) -> VelocityVerdict:
    """Rows with the covariances above in turn; those known before are at rest."""
    cov = COVS[np.arange(len(stamps_ns)) % 2].copy()
    cov[list(partial)] += np.diag([0.0, UNMEASURED_M_S**2, UNMEASURED_M_S**2])
    n = len(known)
    before = np.array(known, np.int64), np.zeros((n, 3)), np.tile(COVS[1], (n, 1, 1))
    return judge(np.array(stamps_ns), np.array(velocity), cov, *before, WALK, gate)


def found(stamps_ns: list[int], velocity: list[list[float]], **others: tuple[int, ...]) -> np.ndarray:
    return judged(stamps_ns, velocity, **others).distance


@pytest.mark.parametrize("seconds", [0.1, 1.0, 5.0, 30.0])
def test_the_distance_is_that_of_the_formula(seconds):
    u, v = [0.6, -0.2, 0.3], [0.9, 0.4, -0.2]
    assert found([0, round(seconds * NS)], [u, v]) == pytest.approx([0.0, expected(seconds, u, v)])


def test_correlated_noise_counts_as_such():
    rng = np.random.default_rng(0)
    for _ in range(20):
        Q_u, Q_v = (1e-4 * (root @ root.T) for root in rng.standard_normal((2, 3, 3)))
        u, v = 0.1 * rng.standard_normal((2, 3))
        before = np.array([0]), u[None], Q_u[None]
        (distance,) = judge(np.array([NS // 2]), v[None], Q_v[None], *before, WALK, GATE).distance
        S = Q_u + Q_v + np.eye(3) * (WALK**2 * 0.5 + 0.15**2 * (u @ u))
        assert distance == pytest.approx((v - u) @ np.linalg.solve(S, v - u))


def test_one_beam_of_any_direction_is_compared_along_it():
    """Variances of ten orders of magnitude, turned."""
    turn = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    Q = turn @ np.diag([1e-4, UNMEASURED_M_S**2, UNMEASURED_M_S**2]) @ turn.T
    before = np.array([0]), np.zeros((1, 3)), COVS[:1] * 0.0
    (distance,) = judge(np.array([NS // 10]), 0.5 * turn[:, :1].T, Q[None], *before, WALK, GATE).distance
    assert distance == pytest.approx(0.25 / (1e-4 + WALK**2 * 0.1), rel=1e-5)


def test_the_gate_is_the_quantile_that_a_true_velocity_passes_but_once_in_a_billion():
    assert chi2(3).isf(1e-9) == pytest.approx(GATE, abs=0.05)


def test_the_first_row_of_all_has_nothing_to_be_compared_with():
    assert found([5], [[9.0, 0.0, 0.0]]) == pytest.approx([0.0])
    assert found([5], [[9.0, 0.0, 0.0]], known=(5, 7)) == pytest.approx([0.0])
    (distance,) = found([NS], [[9.0, 0.0, 0.0]], known=(-NS, 0, NS, 2 * NS))
    assert distance == pytest.approx(81.0 / (COVS[:, 0, 0].sum() + WALK**2))
    (distance,) = found([NS], [[9.0, 0.0, 0.0]], known=(0, NS - 1))
    assert distance == pytest.approx(81.0 / COVS[:, 0, 0].sum(), rel=1e-6)


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
    d = found([0, NS // 10, 2 * NS // 10], velocity, partial=(1,))
    assert d[1] == pytest.approx(0.05**2 / (5e-4 + WALK**2 * 0.1 + (0.03 * 0.5) ** 2))
    assert d[2] == pytest.approx(0.1**2 / (2e-4 + WALK**2 * 0.2 + (0.06 * 0.5) ** 2))


def test_a_distance_at_the_gate_is_believed():
    """Just inside it becomes the one that others are compared with, just outside it does not."""
    spread = np.sqrt(1e-4 + 4e-4 + WALK**2 * 0.1)
    for factor, believed in ((1 - 1e-9, True), (1 + 1e-9, False)):
        jump = factor * np.sqrt(GATE) * spread
        d = found([0, NS // 10, 2 * NS // 10], [[0.0] * 3, [jump, 0.0, 0.0], [jump, 0.0, 0.0]])
        assert (d[2] == 0.0) == believed


def test_rows_are_plain_where_none_is_an_outlier_or_measured_a_part():
    at, calm, jump = [0, NS // 10], [[0.5, 0.0, 0.0]] * 2, [[0.5, 0.0, 0.0], [9.0, 0.0, 0.0]]
    assert judged(at, calm).is_plain
    for verdict, outlier, partial in (
        (judged(at, jump), [False, True], [False, False]),
        (judged(at, calm, partial=(1,)), [False, False], [False, True]),
        (judged(at, jump, partial=(1,)), [False, True], [False, True]),
    ):
        assert not verdict.is_plain
        assert verdict.is_outlier.tolist() == outlier
        assert verdict.is_partial.tolist() == partial


def test_without_a_gate_every_row_is_believed():
    verdict = judged([0, NS // 10, NS // 5], [[0.0] * 3, [9.0, 0.0, 0.0], [9.0, 0.0, 0.0]], gate=np.inf)
    assert verdict.is_plain
    assert verdict.distance[2] == 0.0
