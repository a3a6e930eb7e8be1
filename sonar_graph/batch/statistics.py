"""Statistics of many runs: spread, paired differences, the signed-rank test, failure rates, consistency.

A run that did not end, or gave no value, is never left out. It has the value infinity, the worst there is: quantiles
and rank tests work with it (Lachin 1999), and a mean over such a group does not exist.
Equations: docs/theory/batch_statistics.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from sonar_graph.evaluation import anees_interval
from sonar_graph.measurements import Floats
from sonar_graph.states import counted

# positive integers: ranks, doubled if there are ties, divided by their common divisor
Ranks = np.ndarray[tuple[int], np.dtype[np.int64]]
LEAST_PAIRS = 6
"""With fewer pairs no two-sided rank test reaches 5 %: 2 / 2⁵ = 0.06."""


def signed_rank_p(differences: Floats) -> float:
    """Two-sided p value of Wilcoxon's signed-rank test (zeros as Pratt 1959); infinite differences rank highest.

    The p value is the probability, given the ranks, that the sum of signed ranks is at least as far from zero as the
    observed one when every sign of a non-zero difference is drawn at random. Ties and zeros need no correction.

    NaN for fewer than 6, whose smallest possible p value is above 5 %.
    """
    if len(differences) < LEAST_PAIRS:
        return math.nan
    if not differences.any():
        return 1.0
    # tied ranks may end in .5: doubled, they are the integers that the exact distribution counts with
    doubled = np.rint(2 * stats.rankdata(np.abs(differences))).astype(np.int64)
    ranks = doubled // np.gcd.reduce(doubled[differences != 0])
    # infinite differences have the highest ranks: a lost run is worse than any other
    positive = int(ranks[differences > 0].sum())
    negative = int(ranks[differences < 0].sum())
    # Pratt 1959: zeros take part in the ranking and are left out only now
    signed = ranks[differences != 0]
    return min(1.0, 2 * exact_tail(signed, min(positive, negative)))


def exact_tail(ranks: Ranks, most: int) -> float:
    """Probability that the ranks with a positive sign sum up to at most ``most``.

    Each rank turns the distribution of the sum into the mean of itself and of itself shifted by the rank.
    """
    chances = np.zeros(most + 1)
    chances[0] = 1.0
    for rank in ranks.tolist():
        chances *= 0.5
        # numpy copies operands that overlap, so the addend is the distribution before this rank
        chances[rank:] += chances[: max(0, most + 1 - rank)]
    return float(chances.sum())


CONFIDENCE = 0.95
# quantiles shown beside the median
LOW = 0.1
HIGH = 0.9


@dataclass(frozen=True)
class SampleSummary:
    """Summary of the values of one group of runs."""

    runs: int
    without: int
    """Number of runs that did not end or gave no value."""
    mean: float
    """NaN if a run has no value."""
    standard_error: float
    """Standard error of the mean; NaN for one run."""
    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Rate:
    """A share of runs with its Wilson interval."""

    share: float
    low: float
    high: float


@dataclass(frozen=True)
class PairedDifference:
    """Differences from the reference on the same cases; negative: smaller than the reference.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.batch import paired
    >>> difference = paired(np.array([1.0, 2.0, 3.0]), np.array([1.5, 2.5, 2.0]))
    >>> difference.smaller, round(difference.mean, 3)
    (2, 0.0)
    """

    pairs: int
    """Number of differences: pairs of runs, or seeds if a seed has several pairs."""
    each: str
    """Unit of a difference: ``pair``, ``seed``, ``log``; ``case`` for a mixture of seeds and logs."""
    without: int
    """Number of differences for which a value is missing."""
    smaller: int
    """Number of differences below zero."""
    mean: float
    """NaN if a pair lacks a value."""
    interval: tuple[float, float]
    """`mean_interval`; NaN if there are too few pairs or no mean."""
    median: float
    """Infinite if half of the pairs have no value on one side; NaN if that holds for both sides."""
    p_value: float
    """Two-sided signed-rank test, not corrected for other tests; NaN for too few pairs."""

    @property
    def counted(self) -> str:
        """Number and unit of the differences, such as ``10 seeds``."""
        return counted(self.pairs, self.each)


@dataclass(frozen=True)
class Anees:
    """Average normalised squared error of independent runs, per degree of freedom, with its chi-square band.

    Examples
    --------
    >>> from sonar_graph.batch import Anees
    >>> Anees(runs=50, mean=2.1, band=(0.79, 1.24)).verdict
    'over-confident'
    """

    runs: int
    mean: float
    band: tuple[float, float]

    @property
    def verdict(self) -> str:
        """Verdict in one word; empty if nothing is known."""
        if math.isnan(self.mean) or math.isnan(self.band[0]):
            return ""
        if self.mean > self.band[1]:
            return "over-confident"
        return "over-cautious" if self.mean < self.band[0] else "consistent"


def summarise(values: Floats) -> SampleSummary:
    """Mean with standard error, median and quantiles of values, shape (n,); infinity for a run without a value.

    Quantiles are values that occur or lie between two that do (linear between order statistics, as numpy's default);
    they are infinite if they fall among runs without a value.
    """
    n = len(values)
    without = int(np.isinf(values).sum())
    # an average over the survivors would praise whoever fails where it is hard
    has_mean = n > 0 and not without
    low, median, high = (quantile(values, share) for share in (LOW, 0.5, HIGH))
    return SampleSummary(
        runs=n,
        without=without,
        mean=float(values.mean()) if has_mean else math.nan,
        standard_error=standard_error(values),
        median=median,
        low=low,
        high=high,
    )


def quantile(values: Floats, share: float) -> float:
    """Linear between order statistics, infinite if an infinite value takes part; NaN of nothing or between -∞ and ∞."""
    if not len(values):
        return math.nan
    ordered = np.sort(values)
    place = share * (len(values) - 1)
    below = float(ordered[math.floor(place)])
    above = float(ordered[math.ceil(place)])
    if math.isinf(below) and below == -above:
        return math.nan
    if below == above or not math.isfinite(above):
        return above
    return (
        below + (place - math.floor(place)) * (above - below)
        if math.isfinite(below)
        else below
    )


def standard_error(values: Floats) -> float:
    """Standard deviation over the root of the number; NaN for fewer than two values or infinite ones."""
    if len(values) < 2 or not np.isfinite(values).all():
        return math.nan
    return float(values.std(ddof=1) / math.sqrt(len(values)))


def failure_rate(failed: int, runs: int) -> Rate:
    """Share of runs that failed, with its 95 % interval (Wilson 1927).

    Examples
    --------
    >>> from sonar_graph.batch import failure_rate
    >>> rate = failure_rate(1, 20)
    >>> print(f"{rate.share:.2f}, {rate.low:.3f} to {rate.high:.3f}")
    0.05, 0.009 to 0.236
    """
    interval = stats.binomtest(failed, runs).proportion_ci(CONFIDENCE, method="wilson")
    return Rate(failed / runs, float(interval.low), float(interval.high))


def paired(
    own: Floats, reference: Floats, cases: Sequence[str | int] | None = None
) -> PairedDifference:
    """Compare paired values, each shape (n,), by their differences; infinity for a run without a value.

    A run without a value is worse than any run with one; two such runs are equal.

    Parameters
    ----------
    own, reference
        Values of the same cases, in the same order.
    cases
        Case of each pair: a seed, or the name of a log for runs without seeds. Pairs of one case depend on each other,
        so they count as one difference: their mean. If some are infinite, the side with more infinite ones decides.
        None: each pair is a case of its own.

    Examples
    --------
    Errors of six runs, in metres, beside the reference's on the same logs:

    >>> import numpy as np
    >>> from sonar_graph.batch import paired
    >>> own = np.array([0.11, 0.14, 0.12, 0.10, 0.15, 0.13])
    >>> difference = paired(own, own + np.array([0.02, 0.03, 0.01, 0.02, 0.03, 0.02]))
    >>> round(difference.mean, 3), difference.pairs
    (-0.022, 6)
    """
    lost = np.isinf(own) | np.isinf(reference)
    both = np.isinf(own) & np.isinf(reference)
    # two runs without a value are equal, but inf - inf is NaN
    differences = np.where(both, 0.0, own) - np.where(both, 0.0, reference)
    each = "pair"
    if cases is not None:
        # fromkeys: each case once, in the order of its first pair
        members = [
            np.array([one == case for one in cases]) for case in dict.fromkeys(cases)
        ]
        differences = np.array(
            [case_difference(differences[which]) for which in members]
        )
        lost = np.array([lost[which].any() for which in members], dtype=bool)
        kinds = {"log" if isinstance(case, str) else "seed" for case in cases}
        each = kinds.pop() if len(kinds) == 1 else "case"
    # a case is lost with any of its pairs
    without = int(lost.sum())
    has_mean = len(differences) > 0 and not without
    return PairedDifference(
        pairs=len(differences),
        each=each,
        without=without,
        smaller=int((differences < 0).sum()),
        mean=float(differences.mean()) if has_mean else math.nan,
        interval=mean_interval(differences) if has_mean else (math.nan, math.nan),
        median=quantile(differences, 0.5),
        p_value=signed_rank_p(differences),
    )


def case_difference(differences: Floats) -> float:
    """Mean of one case's differences; infinite to the side that has more infinite ones, without them if none has."""
    infinite = np.isinf(differences)
    # as many lost runs on one side as on the other cancel
    side = float(np.sign(differences[infinite]).sum())
    if side:
        return math.copysign(math.inf, side)
    return float(differences[~infinite].mean()) if not infinite.all() else 0.0


def mean_interval(values: Floats) -> tuple[float, float]:
    """95 % interval of the mean of values that may be skewed (Hall 1992); NaN for fewer than `LEAST_PAIRS`.

    Student's ``t`` assumes symmetry. With the sample's skewness ``g`` and ``W = (mean - true mean) / s``,
    ``W + g W² / 3 + g² W³ / 27 + g / (6 n)`` is symmetric to first order; times ``√n`` it is compared with Student's
    quantiles. Its roots are the bounds.
    """
    n = len(values)
    if n < LEAST_PAIRS:
        return math.nan, math.nan
    mean = float(values.mean())
    deviation = float(values.std(ddof=1))
    # the skewness of equal values would be 0 / 0
    if deviation <= 1e-12 * float(np.abs(values).max()):
        return mean, mean
    skewness = float((((values - mean) / values.std()) ** 3).mean())
    bound = float(stats.t.ppf(0.5 + CONFIDENCE / 2, n - 1)) / math.sqrt(n)
    low, high = (_unskewed(side * bound, skewness, n) for side in (1, -1))
    return mean - deviation * low, mean - deviation * high


def _unskewed(bound: float, skewness: float, n: int) -> float:
    """``W`` at which the cubic of `mean_interval` reaches a bound."""
    # without skewness the cubic is W itself, and its solution below would be 0 / 0
    if abs(skewness) < 1e-6:
        return bound
    return 3 * (math.cbrt(1 + skewness * (bound - skewness / (6 * n))) - 1) / skewness


def holm(p_values: Floats) -> Floats:
    """P values of a family of tests, corrected so that 5 % bounds the probability of any false finding (Holm 1979).

    In ascending order, the i-th of m (from 0) is multiplied by m - i; none may be below the one before it or above 1.
    NaN stays NaN and does not count.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.batch import holm
    >>> holm(np.array([0.01, 0.04, 0.5])).round(3)
    array([0.03, 0.08, 0.5 ])
    """
    corrected = np.full(len(p_values), np.nan)
    known = np.flatnonzero(~np.isnan(p_values))
    # the smallest p value has the largest factor
    order = known[np.argsort(p_values[known], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(factors * p_values[order]))
    return corrected


def anees(nees: Floats, dof: float) -> Anees:
    """Average over independent runs, with the chi-square band of a consistent estimator.

    ``nees`` is the normalised squared error of each run at one instant, divided by ``dof``, shape (n,); infinity: none.
    Unknown degrees of freedom (NaN) give no band.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.batch import anees
    >>> found = anees(np.array([0.8, 1.3, 0.9, 1.1, 1.2]), 3)
    >>> round(found.mean, 2), found.verdict
    (1.06, 'consistent')
    """
    n = len(nees)
    band = math.nan, math.nan
    if not n or np.isinf(nees).any():
        return Anees(n, math.nan, band)
    if not math.isnan(dof):
        band = anees_interval(n, int(dof), CONFIDENCE)
    return Anees(n, float(nees.mean()), band)
