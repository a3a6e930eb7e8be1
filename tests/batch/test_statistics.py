from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats

from sonar_graph.batch.statistics import (
    anees,
    failure_rate,
    holm,
    mean_interval,
    paired,
    quantile,
    quantile_error,
    signed_rank_p,
    standard_error,
    summarise,
)

INF = math.inf
shares = st.floats(0, 1)


def closed_testing(p_values: list[float]) -> list[float]:
    """Holm by its other definition: a hypothesis falls when Bonferroni refuses every intersection that has it."""
    every = range(len(p_values))
    subsets = [s for size in range(1, len(p_values) + 1) for s in itertools.combinations(every, size)]
    return [max(min(1.0, len(s) * min(p_values[j] for j in s)) for s in subsets if i in s) for i in every]


@given(st.lists(shares, min_size=1, max_size=6))
def test_holm_is_closed_testing_with_bonferroni(p_values):
    assert holm(np.array(p_values)).tolist() == pytest.approx(closed_testing(p_values))


def test_holm_of_a_worked_example():
    corrected = holm(np.array([0.01, 0.04, 0.03, 0.005]))
    assert corrected.tolist() == pytest.approx([0.03, 0.06, 0.06, 0.02])


def test_holm_does_not_count_what_was_not_tested():
    corrected = holm(np.array([math.nan, 0.01, math.nan, 0.5]))
    assert corrected[[1, 3]].tolist() == pytest.approx([0.02, 0.5])
    assert np.isnan(corrected[[0, 2]]).all()


@given(st.integers(1, 60).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_failure_rate_solves_wilsons_equation(counts):
    failed, runs = counts
    rate = failure_rate(failed, runs)
    z = stats.norm.ppf(0.975)
    for bound in (rate.low, rate.high):
        assert (rate.share - bound) ** 2 == pytest.approx(z**2 * bound * (1 - bound) / runs, abs=1e-9)
    assert 0 <= rate.low <= rate.share <= rate.high <= 1


def test_no_failure_in_few_runs_is_no_proof_of_none():
    assert failure_rate(0, 10).high == pytest.approx(0.2775, abs=1e-4)


def test_one_false_finding_in_twenty_families_and_not_more():
    rng = np.random.default_rng(0)
    families = rng.normal(size=(300, 4, 10))
    single = np.array([[signed_rank_p(test) for test in family] for family in families])
    found = np.mean([(holm(p) < 0.05).any() for p in single])
    assert found < 0.05 + 2 * math.sqrt(0.05 * 0.95 / 300)
    assert np.mean((single < 0.05).any(axis=1)) > 0.12, "uncorrected tests find more: the check can fail"


@pytest.mark.parametrize("pairs", [6, 10, 25])
def test_the_interval_holds_the_mean_as_often_as_it_says(pairs):
    rng = np.random.default_rng(1)
    intervals = np.array([mean_interval(rng.normal(0.3, 1, pairs)) for _ in range(2000)])
    inside = np.mean((intervals[:, 0] < 0.3) & (intervals[:, 1] > 0.3))
    middle, half = intervals.mean(axis=1), 0.25 * np.ptp(intervals, axis=1)
    assert inside == pytest.approx(0.95, abs=0.017)
    assert np.mean(np.abs(middle - 0.3) < half) < 0.85, "intervals half as wide do not: the check can fail"


def test_the_interval_of_skewed_differences_holds_their_mean_more_often_than_students():
    draws = np.random.default_rng(2).lognormal(0, 1, (2000, 10))
    mean = math.exp(0.5)
    own = np.array([mean_interval(values) for values in draws])
    students = np.stack(stats.t.interval(0.95, 9, draws.mean(axis=1), stats.sem(draws, axis=1)), axis=1)
    held, held_by_student = (np.mean((low < mean) & (mean < high)) for low, high in (own.T, students.T))
    assert held > 0.89
    assert held_by_student < held - 0.03


@given(st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=30))
def test_the_interval_solves_halls_equation(listed):
    values = np.array(listed)
    n, mean, deviation = len(values), values.mean(), values.std(ddof=1)
    assume(deviation > max(1e-9, 1e-6 * np.abs(values).max()))
    g = stats.skew(values)
    for bound, side in zip(mean_interval(values), (1, -1), strict=True):
        w = (mean - bound) / deviation
        transformed = math.sqrt(n) * (w + g * w**2 / 3 + g**2 * w**3 / 27 + g / (6 * n))
        assert transformed == pytest.approx(side * stats.t.ppf(0.975, n - 1), rel=1e-6, abs=1e-6)


def test_the_interval_of_symmetric_differences_is_students():
    values = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0]) + 0.5
    assert mean_interval(values) == pytest.approx(stats.t.interval(0.95, 5, 0.5, stats.sem(values)))
    askew = mean_interval(np.append(values, 9.0))
    assert askew[1] - np.append(values, 9.0).mean() > np.append(values, 9.0).mean() - askew[0]


def test_the_interval_of_equal_differences_is_a_point_and_of_few_unknown():
    assert mean_interval(np.full(8, 0.25)) == (0.25, 0.25)
    assert np.isnan(mean_interval(np.arange(5.0))).all()
    assert np.isfinite(mean_interval(np.arange(6.0))).all()


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=20), shares)
def test_quantile_of_finite_values_is_numpys(values, share):
    assert quantile(np.array(values), share) == pytest.approx(float(np.quantile(values, share)), rel=1e-9, abs=1e-6)


def test_runs_without_a_value_are_the_worst_ones_in_quantiles():
    assert quantile(np.array([1.0, 2.0, 3.0, INF, INF]), 0.5) == 3.0
    assert quantile(np.array([1.0, 2.0, INF, INF]), 0.5) == INF
    assert quantile(np.array([INF, 1.0]), 0.1) == INF
    assert math.isnan(quantile(np.empty(0), 0.5))


def test_a_group_with_a_run_without_a_value_has_no_mean():
    complete, short = summarise(np.array([1.0, 2.0, 3.0, 4.0])), summarise(np.array([1.0, 2.0, INF, 4.0]))
    assert complete.mean == 2.5
    assert complete.standard_error == pytest.approx(stats.sem([1.0, 2.0, 3.0, 4.0]))
    assert math.isnan(short.mean)
    assert math.isnan(short.standard_error)
    assert (short.runs, short.without, short.median) == (4, 1, 3.0)


def test_two_values_that_agree_by_chance_do_not_make_digits():
    few, many = np.array([10.54003, 10.54024]), np.tile([10.54003, 10.54024], 5)
    assert summarise(few).median_error == pytest.approx(0.105, abs=1e-3)
    assert summarise(many).median_error == pytest.approx(0.5 * np.ptp(few))
    assert paired(few, np.zeros(2)).rounding_error == pytest.approx(0.105, abs=1e-3)
    assert paired(many, np.zeros(10)).rounding_error == pytest.approx(stats.sem(many))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_the_error_of_a_quantile_is_how_much_it_scatters(share):
    draws = np.random.default_rng(8).normal(size=(600, 40))
    scatter = np.quantile(draws, share, axis=1).std()
    errors = [quantile_error(values, share) for values in draws]
    assert np.mean(errors) == pytest.approx(scatter, rel=0.2)


def test_one_lost_run_does_not_take_the_digits_of_the_median():
    values = np.append(np.random.default_rng(9).normal(0.2, 0.01, 19), 5000.0)
    assert standard_error(values) > 100
    assert summarise(values).median_error < 0.01
    assert paired(values, np.zeros(20)).median_error < 0.01


def test_the_error_of_a_median_beside_runs_without_a_value_is_that_of_the_lower_side():
    values = np.array([1.0, 2.0, 3.0, 4.0, INF, INF, INF])
    assert quantile_error(values, 0.5) == pytest.approx(math.sqrt(7) / 2)
    assert math.isnan(quantile_error(values, 0.9))


def test_standard_error_of_one_run_is_unknown():
    assert math.isnan(standard_error(np.array([1.0])))


def test_pairing_takes_away_what_hard_seeds_cost_everybody():
    rng = np.random.default_rng(4)
    hardness = rng.normal(0, 5, 20)
    reference = hardness + rng.normal(0, 0.1, 20)
    own = hardness - 0.3 + rng.normal(0, 0.1, 20)
    told = paired(own, reference)
    assert told.p_value < 0.001
    assert told.interval[0] < -0.3 < told.interval[1] < 0
    assert told.smaller >= 18
    assert paired(rng.permutation(own), reference).p_value > 0.05, "without pairs the seeds hide it"


def test_failing_where_it_was_worse_makes_nobody_better():
    rng = np.random.default_rng(5)
    reference = rng.normal(1, 0.1, 12)
    own = reference - 0.05 + rng.normal(0, 0.1, 12)
    worst = np.argsort(own - reference)[-4:]
    survivors = own.copy()
    survivors[worst] = INF
    whole, told = paired(own, reference), paired(survivors, reference)
    kept = np.delete(np.arange(12), worst)
    assert paired(own[kept], reference[kept]).mean < whole.mean, "over survivors it would look better"
    assert math.isnan(told.mean)
    assert math.isnan(told.interval[0])
    assert told.without == 4
    assert told.median >= whole.median - 1e-12
    assert told.smaller <= whole.smaller


def test_what_logs_share_by_their_seed_is_no_finding():
    rng = np.random.default_rng(12)
    cases = list(range(10)) * 4
    single, clustered = [], []
    for _ in range(200):
        own = np.tile(rng.normal(size=10), 4) + rng.normal(0, 0.3, 40)
        single.append(paired(own, np.zeros(40)).p_value < 0.05)
        clustered.append(paired(own, np.zeros(40), cases).p_value < 0.05)
    assert np.mean(clustered) < 0.05 + 2 * math.sqrt(0.05 * 0.95 / 200)
    assert np.mean(single) > 0.2, "pairs taken as independent find more: the check can fail"


def test_pairs_of_one_case_make_one_difference():
    own, cases = np.array([1.0, 3.0, INF, 1.0, INF, INF]), [0, 0, 1, 1, "a", "a"]
    reference = np.array([0.0, 0.0, 5.0, INF, 1.0, INF])
    told = paired(own, reference, cases)
    assert (told.pairs, told.without, told.smaller) == (3, 2, 0)
    assert told.median == 2.0, "of 2, 0 (each failed once) and infinity"
    assert math.isnan(told.mean)
    own, reference = np.arange(12.0), np.array([1.0, 0.0] * 6)
    halves = paired(own, reference, [i // 2 for i in range(12)])
    assert halves == replace(paired((own - reference).reshape(6, 2).mean(axis=1), np.zeros(6)), each="seed")


@pytest.mark.parametrize(
    ("cases", "counted"), [(None, "2 pairs"), ([3, 3], "1 seed"), ([3, 4], "2 seeds"), (["a", "b"], "2 logs")]
)
def test_differences_say_what_they_are_of(cases, counted):
    assert paired(np.ones(2), np.zeros(2), cases).counted == counted
    assert paired(np.ones(3), np.zeros(3), [1, 2, "a"]).counted == "3 cases"


def test_two_failures_on_one_seed_are_equal():
    told = paired(np.array([INF, 1.0]), np.array([INF, 2.0]))
    assert (told.smaller, told.without, told.median) == (1, 1, -0.5)


def test_anees_of_consistent_runs_lies_in_its_band_and_of_confident_ones_does_not():
    rng = np.random.default_rng(6)
    consistent = [anees(rng.chisquare(2, 15) / 2, 2).verdict for _ in range(400)]
    confident = [anees(4 * rng.chisquare(2, 15) / 2, 2).verdict for _ in range(50)]
    cautious = [anees(0.2 * rng.chisquare(2, 15) / 2, 2).verdict for _ in range(50)]
    assert 0.92 < np.mean([verdict == "consistent" for verdict in consistent]) < 0.98
    assert np.mean([verdict == "over-confident" for verdict in confident]) > 0.95
    assert np.mean([verdict == "over-cautious" for verdict in cautious]) > 0.95


def test_anees_is_not_of_survivors_and_has_no_band_without_its_degrees_of_freedom():
    assert math.isnan(anees(np.array([1.0, INF]), 2).mean)
    assert anees(np.array([1.0, INF]), 2).verdict == ""
    assert anees(np.array([9.0, 9.0]), math.nan).verdict == ""


@pytest.mark.parametrize("far", [1e3, -1e6])
def test_the_interval_moves_with_the_differences_however_far(far):
    values = np.random.default_rng(14).exponential(0.1, 12)
    moved = np.array(mean_interval(values + far)) - far
    assert moved == pytest.approx(mean_interval(values), abs=1e-6)


@pytest.mark.parametrize("pairs", [6, 7, 10, 49])
def test_the_interval_of_equal_differences_is_a_point_where_their_mean_is_rounded(pairs):
    low, high = mean_interval(np.full(pairs, 0.1))
    assert low == high == pytest.approx(0.1)


def test_five_values_may_agree_by_chance_and_six_do_not():
    alike = np.tile([10.54003, 10.54024], 3)
    for values in (alike, -alike):
        five, six = paired(values[:5], np.zeros(5)), paired(values, np.zeros(6))
        assert five.rounding_error == pytest.approx(0.105, abs=1e-3)
        assert five.median_error == pytest.approx(0.105, abs=1e-3)
        assert six.rounding_error == pytest.approx(stats.sem(alike))
        assert six.median_error < 1e-3


def test_a_seed_that_failed_on_one_of_its_logs_is_without_a_value():
    told = paired(np.array([1.0, INF, 2.0, 3.0]), np.zeros(4), [0, 0, 1, 1])
    assert (told.pairs, told.without) == (2, 1)
    assert math.isnan(told.mean)


def test_each_quantile_has_the_error_of_its_own():
    values = np.random.default_rng(15).lognormal(0, 1, 30)
    told = summarise(values)
    assert told.low_error == quantile_error(values, 0.1) != told.high_error
    assert told.high_error == quantile_error(values, 0.9) != told.median_error


def test_a_quantile_beside_runs_that_only_the_reference_lost_is_infinite_to_the_other_side():
    assert quantile(np.array([-INF, 1.0]), 0.5) == -INF
    assert quantile(np.array([-INF, -INF, 1.0, 2.0]), 0.5) == -INF
    assert quantile(np.array([-INF, 1.0, 2.0]), 0.5) == 1.0


def test_where_each_side_lost_half_of_the_seeds_nothing_can_be_said():
    own, other = np.array([INF, 1.0] * 5), np.array([1.0, INF] * 5)
    assert math.isnan(paired(own, other).median)
    assert math.isnan(paired(other, own).median)
    assert math.isnan(quantile(np.array([-INF, INF]), 0.5))
