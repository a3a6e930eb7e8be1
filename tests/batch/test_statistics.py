"""Statistics of many runs agree with other definitions, and hold with runs that failed."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy import stats

from sonar_graph.batch import statistics

INF = math.inf
shares = st.floats(0, 1)


def closed_testing(p_values: np.ndarray) -> list[float]:
    """Holm by its other definition: a hypothesis falls when Bonferroni refuses every intersection that has it."""
    every = range(len(p_values))
    sizes = range(1, len(p_values) + 1)
    subsets = [list(s) for n in sizes for s in itertools.combinations(every, n)]
    p_of = [(s, min(1.0, len(s) * min(p_values[s]))) for s in subsets]
    return [max(p for s, p in p_of if i in s) for i in every]


@given(st.lists(shares | st.just(math.nan), min_size=1, max_size=7))
def test_holm_is_closed_testing_with_bonferroni_of_what_was_tested(listed):
    p_values = np.array(listed)
    corrected = statistics.holm(p_values)
    is_known = ~np.isnan(p_values)
    expected = closed_testing(p_values[is_known])
    assert corrected[is_known].tolist() == pytest.approx(expected)
    assert np.isnan(corrected[~is_known]).all()


@given(st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=30))
def test_the_interval_solves_halls_equation(listed):
    values = np.array(listed)
    n = len(values)
    mean = values.mean()
    deviation = values.std(ddof=1)
    assume(deviation > max(1e-9, 1e-6 * np.abs(values).max()))
    g = stats.skew(values)
    t = stats.t.ppf(0.975, n - 1)
    w = (mean - np.array(statistics.mean_interval(values))) / deviation
    transformed = math.sqrt(n) * (w + g * w**2 / 3 + g**2 * w**3 / 27 + g / (6 * n))
    assert transformed.tolist() == pytest.approx([t, -t], rel=1e-6, abs=1e-6)


def test_the_interval_moves_with_the_differences():
    interval = statistics.mean_interval
    assert np.isnan(interval(np.arange(5.0))).all()
    assert np.isfinite(interval(np.arange(6.0))).all()
    values = np.random.default_rng(14).exponential(0.1, 12)
    near = pytest.approx(interval(values), abs=1e-6)
    for far in (1e3, -1e6):
        assert np.array(interval(values + far)) - far == near
    for pairs in (6, 7, 10, 49):  # the mean of equal values may be rounded
        low, high = interval(np.full(pairs, 0.1))
        assert low == high == pytest.approx(0.1)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=20), shares)
def test_quantiles_are_numpys_and_missing_runs_lie_at_their_ends(listed, share):
    values = np.array(listed)
    found = statistics.quantile(values, share)
    assert found == pytest.approx(np.quantile(values, share), rel=1e-9, abs=1e-6)
    for few, expected in (
        ([1.0, 2.0, 3.0, INF, INF], 3.0),
        ([1.0, 2.0, INF, INF], INF),
        ([-INF, 1.0], -INF),
        ([-INF, 1.0, 2.0], 1.0),
        ([], math.nan),
        ([-INF, INF], math.nan),
    ):
        found = statistics.quantile(np.array(few), 0.5)
        assert found == pytest.approx(expected, nan_ok=True), few


def test_what_logs_share_by_their_seed_is_no_finding():
    rng = np.random.default_rng(12)
    cases = list(range(10)) * 4
    found = []
    for _ in range(200):
        own = np.tile(rng.normal(size=10), 4) + rng.normal(0, 0.3, 40)
        told = (statistics.paired(own, np.zeros(40), of) for of in (None, cases))
        found.append([one.p_value < 0.05 for one in told])
    single, clustered = np.mean(found, axis=0)
    assert clustered < 0.05 + 2 * math.sqrt(0.05 * 0.95 / 200)
    # pairs taken as independent find more: the check can fail
    assert single > 0.2


# fmt: off
PAIRS = [
    # own, reference, cases, counted, without, smaller, median, mean
    ([1, 2],                  [0, 0],                 None,                  ("2 pairs", 0, 0, 1.5,      1.5)),
    ([INF, 1],                [INF, 2],               None,                  ("2 pairs", 1, 1, -0.5,     math.nan)),
    ([INF, 1, INF, 1],        [1, INF, 1, INF],       None,                  ("4 pairs", 4, 2, math.nan, math.nan)),
    ([1, 2],                  [0, 0],                 [3, 3],                ("1 seed",  0, 0, 1.5,      1.5)),
    ([1, 2],                  [0, 0],                 ["a", "b"],            ("2 logs",  0, 0, 1.5,      1.5)),
    ([1, 2, 3],               [0, 0, 0],              [1, 2, "a"],           ("3 cases", 0, 0, 2.0,      2.0)),
    ([1, INF, 2, 3],          [0, 0, 0, 0],           [0, 0, 1, 1],          ("2 seeds", 1, 0, INF,      math.nan)),
    ([1, 3, INF, 1, INF, INF], [0, 0, 5, INF, 1, INF], [0, 0, 1, 1, "a", "a"], ("3 cases", 2, 0, 2.0,   math.nan)),
]
# fmt: on


@pytest.mark.parametrize(("own", "reference", "cases", "expected"), PAIRS)
def test_pairs_of_one_case_make_one_difference(own, reference, cases, expected):
    """Pairs, runs without a value, cases in which the own value is smaller, median and mean of the differences."""
    told = statistics.paired(np.array(own, float), np.array(reference, float), cases)
    counts = (told.counted, told.without, told.smaller)
    assert counts == expected[:3]
    assert (told.median, told.mean) == pytest.approx(expected[3:], nan_ok=True)


@pytest.mark.parametrize(
    ("scale", "verdict", "least", "most"),
    [
        (1.0, "consistent", 0.92, 0.98),
        (4.0, "over-confident", 0.95, 1.0),
        (0.2, "over-cautious", 0.95, 1.0),
    ],
)
def test_anees_of_consistent_runs_lies_in_its_band(scale, verdict, least, most):
    squares = scale * np.random.default_rng(6).chisquare(2, (400, 15)) / 2
    verdicts = [statistics.anees(row, 2).verdict for row in squares]
    assert least < verdicts.count(verdict) / 400 <= most
    assert statistics.anees(squares[0], math.nan).verdict == "", "of several freedoms"


def enumerated_p(differences: np.ndarray) -> float:
    """The signed-rank test by all sign patterns; zeros have a rank and no sign, infinite ones are all alike."""
    ranks = stats.rankdata(np.abs(differences))
    observed = abs((np.sign(differences) * ranks).sum())
    ranks = ranks[differences != 0]
    signs = np.array(list(itertools.product((-1, 1), repeat=len(ranks))))
    return float(np.mean(np.abs(signs @ ranks) >= observed - 1e-9))


@given(
    st.lists(
        st.sampled_from([-INF, -2.5, -1, 0, 1, 2, 3, 4, INF]), min_size=6, max_size=9
    )
)
@example([0.0] * 8)
def test_the_exact_signed_rank_test_is_that_of_all_sign_patterns(listed):
    differences = np.array(listed)
    expected = enumerated_p(differences)
    assert statistics.signed_rank_p(differences) == pytest.approx(expected, abs=1e-12)
    assert math.isnan(statistics.signed_rank_p(differences[:5])), "too few"


@pytest.mark.parametrize("count", [30, 80])
def test_the_signed_rank_test_of_many_pairs_is_that_of_scipy(count):
    differences = np.random.default_rng(0).normal(0.3, 1, count)
    expected = stats.wilcoxon(differences, method="exact").pvalue
    assert statistics.signed_rank_p(differences) == pytest.approx(expected, rel=1e-9)
