from __future__ import annotations

import itertools
import math
import time

import numpy as np
import pytest
from scipy import stats

from sonar_graph.batch.statistics import exact_tail, least_p, near_tail, signed_rank_p

INF = math.inf
KINDS = ("distinct", "ties", "zeros", "infinite", "mostly zeros", "one size")


def drawn(kind: str, count: int, seed: int = 0, shift: float = 0.1) -> np.ndarray:
    """Differences of one kind."""
    rng = np.random.default_rng(seed)
    differences = rng.normal(shift, 1, count)
    if kind == "ties":
        differences = np.round(2 * differences) + 0.5
    elif kind == "zeros":
        differences[: count // 4] = 0.0
    elif kind == "infinite":
        differences[: count // 3] = np.copysign(INF, differences[: count // 3])
    elif kind == "mostly zeros":
        differences[: count - count // 8] = 0.0
    elif kind == "one size":
        differences = np.sign(differences)
    return differences


def finite(differences: np.ndarray) -> np.ndarray:
    """Infinite ones as the largest, all alike."""
    return np.where(np.isinf(differences), np.sign(differences) * 100.0, differences)


def ranks_of(differences: np.ndarray) -> np.ndarray:
    """Whole ranks of what is not zero."""
    doubled = np.rint(2 * stats.rankdata(np.abs(differences))).astype(np.int64)[differences != 0]
    return doubled // np.gcd.reduce(doubled)


def normal_p(differences: np.ndarray) -> float:
    """By a normal distribution with the variance that the ranks of what is not zero have."""
    ranks = stats.rankdata(np.abs(differences))[differences != 0]
    total = (np.sign(differences[differences != 0]) * ranks).sum()
    return float(2 * stats.norm.sf(abs(total) / math.sqrt((ranks**2).sum())))


def enumerated_p(differences: np.ndarray) -> float:
    """The signed-rank test by all sign patterns; zeros have a rank and no sign."""
    ranks = stats.rankdata(np.abs(differences))
    observed = abs((np.sign(differences) * ranks).sum())
    ranks = ranks[differences != 0]
    sums = [abs(np.dot(signs, ranks)) for signs in itertools.product((-1, 1), repeat=len(ranks))]
    return float(np.mean([total >= observed - 1e-9 for total in sums]))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("kind", ["distinct", "ties", "zeros", "infinite"])
def test_signed_rank_p_counts_sign_patterns(seed, kind):
    rng = np.random.default_rng(seed)
    differences = rng.normal(0.4, 1, 9)
    if kind == "ties":
        differences = np.round(differences) + 0.5
    elif kind == "zeros":
        differences[:2] = 0.0
    elif kind == "infinite":
        differences[:3] = [INF, -INF, INF]
    finite = np.where(np.isinf(differences), np.sign(differences) * 100.0, differences)
    assert signed_rank_p(differences) == pytest.approx(enumerated_p(finite), abs=1e-12)


def test_signed_rank_p_of_equal_runs_is_one_and_of_few_is_unknown():
    assert signed_rank_p(np.zeros(8)) == 1.0
    assert math.isnan(signed_rank_p(np.array([1.0, 2.0, 3.0, 4.0, 5.0])))
    assert signed_rank_p(np.arange(1.0, 9.0)) == pytest.approx(least_p(8))
    assert signed_rank_p(np.arange(1.0, 7.0)) == pytest.approx(least_p(6)) == 2**-5
    assert signed_rank_p(np.array([1.0, -2.0, -3.0, 4.0, 5.0, -6.0, -7.0, 8.0])) == 1.0


def test_signed_rank_p_of_many_with_a_zero_is_by_changes_of_sign():
    differences = np.append(0.0, np.arange(1.0, 8.0))
    assert signed_rank_p(differences) == pytest.approx(2 * 0.5**7)
    mixed = np.array([0.0, 1.0, 2.0, 3.0, -4.0, 5.0, 6.0])
    assert signed_rank_p(mixed) == pytest.approx(enumerated_p(mixed))


@pytest.mark.parametrize("count", [30, 60])
def test_without_ties_and_zeros_it_is_scipys_exact_test(count):
    differences = drawn("distinct", count, shift=0.3)
    assert signed_rank_p(differences) == pytest.approx(stats.wilcoxon(differences, method="exact").pvalue, rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_the_exact_tail_counts_in_whole_numbers(kind):
    ranks = ranks_of(drawn(kind, 80))
    counts = np.zeros(ranks.sum() + 1, dtype=object)
    counts[0] = 1
    for rank in ranks.tolist():
        counts[rank:] += counts[:-rank].copy()
    for most in (0, int(0.3 * ranks.sum()), int(0.5 * ranks.sum())):
        assert exact_tail(ranks, most) == pytest.approx(sum(counts[: most + 1]) / 2 ** len(ranks), rel=1e-9)


@pytest.mark.parametrize(("kind", "last"), [("distinct", 341), ("ties", 271)])
def test_it_is_exact_where_that_is_cheap(kind, last):
    for count, tail in ((last, exact_tail), (last + 1, near_tail)):
        differences = drawn(kind, count)
        ranks = ranks_of(differences)
        least = min(ranks[differences > 0].sum(), ranks[differences < 0].sum())
        assert signed_rank_p(differences) == pytest.approx(2 * tail(ranks, least), rel=1e-12)
        assert exact_tail(ranks, least) != pytest.approx(near_tail(ranks, least), rel=1e-7), "the check can fail"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [271, 341, 1000, 10_000])
def test_it_is_quick_however_many_pairs_there_are(kind, count):
    differences, spent = drawn(kind, count, shift=0.02), []
    for _ in range(3):
        before = time.process_time()
        signed_rank_p(differences)
        spent.append(time.process_time() - before)
    assert min(spent) < 0.1


@pytest.mark.parametrize("kind", ["distinct", "zeros", "ties"])
def test_of_very_many_it_is_as_the_normal_distribution_says(kind):
    differences = drawn(kind, 10_000, shift=0.0)
    assert signed_rank_p(differences) == pytest.approx(normal_p(differences), rel=2e-3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.42, 0.45, 0.48])
def test_what_is_not_exact_is_close_to_it(kind, share):
    ranks = ranks_of(drawn(kind, 300))
    most = int(share * ranks.sum())
    exact = exact_tail(ranks, most)
    assert 1e-4 < exact < 0.5
    assert near_tail(ranks, most) == pytest.approx(exact, rel=0.01)


def test_the_sum_has_the_variance_of_drawing_without_replacement():
    ranks, most = np.array([1, 2, 4, 7, 9, 9]), 13
    chance = 0.0
    for count in range(len(ranks) + 1):
        sums = np.array([sum(drawn) for drawn in itertools.combinations(ranks.tolist(), count)])
        below = stats.norm.cdf(most + 0.5, sums.mean(), sums.std()) if np.ptp(sums) else float(sums[0] <= most)
        chance += math.comb(len(ranks), count) / 2 ** len(ranks) * below
    assert near_tail(ranks, most) == pytest.approx(chance, rel=1e-9)


def test_equal_ranks_keep_their_steps():
    ranks = np.ones(500, dtype=np.int64)
    assert near_tail(ranks, 231) == pytest.approx(stats.binom.cdf(231, 500, 0.5), rel=1e-9)
    differences = np.repeat([1.0, -1.0], [5100, 4900])
    assert signed_rank_p(differences) == pytest.approx(stats.binomtest(5100, 10_000).pvalue, rel=1e-6)
    assert normal_p(differences) != pytest.approx(stats.binomtest(5100, 10_000).pvalue, rel=0.01), "the check can fail"
