"""The test of many groups keeps its level, has power, and knows how much."""

import itertools
import math

import numpy as np
import pytest
from permutation import (
    ALL_SIGNS,
    DRAWN,
    Family,
    Group,
    clipped,
    detectable,
    families,
    with_all_logs,
)
from regression_gate import movable, worse_groups
from scipy import stats

from sonar_graph.batch.recorded import ALL_LOGS


def family(beyond: np.ndarray, share: float = 1.0) -> Family:
    return Family(
        [(f"log {n}", "isam2", "error") for n in range(beyond.shape[1])], beyond, share
    )


def test_one_group_has_the_p_value_of_the_t_test_or_the_share_of_sign_changes_with_a_larger_mean():
    beyond = np.array([0.3, 0.1, 0.5])
    expected = stats.ttest_1samp(beyond, 0.0, alternative="greater").pvalue
    assert family(beyond[:, None]).p_values[0] == pytest.approx(
        expected, abs=3 * math.sqrt(expected / 2000)
    )
    beyond = np.array([0.5, 0.4, -0.3, 0.35, 0.25])
    means = [
        np.mean(np.array(signs) * beyond)
        for signs in itertools.product([1, -1], repeat=5)
    ]
    assert family(beyond[:, None]).p_values[0] == np.mean(
        np.array(means) >= beyond.mean() - 1e-12
    )


def test_p_values_are_of_all_changes_or_those_that_are_drawn_shared_by_families_and_not_above_one():
    up = np.linspace(1.0, 2.0, ALL_SIGNS + 1)[:, None]
    assert family(up[:-1]).p_values[0] == 2.0**-10
    many = np.linspace(1.0, 2.0, 30)[:, None]
    assert family(many).p_values[0] == 1 / (DRAWN + 1) == 1 / 2000
    beyond = np.array([[0.3], [0.1], [0.5], [0.2], [0.3], [0.35]])
    assert family(beyond, 0.5).p_values[0] == 2 * family(beyond).p_values[0]
    assert family(-beyond, 0.25).p_values.tolist() == [1.0]


def test_groups_that_go_together_cost_no_correction_and_others_do():
    rng = np.random.default_rng(0)
    own = np.array([0.5, 0.4, -0.3, 0.35, 0.25, 0.6, -0.1, 0.4])[:, None]
    alone = family(own).p_values[0]
    assert family(np.repeat(own, 30, axis=1)).p_values[0] == alone
    assert family(np.hstack([own, rng.normal(0, 0.4, (8, 60))])).p_values[0] > 5 * alone


def test_a_lost_run_counts_as_one_bad_run():
    beyond = np.array([0.1, -0.1, 0.12, 0.09, 4.6])[:, None]
    assert clipped(beyond)[:, 0].tolist() == pytest.approx(
        [0.1, -0.1, 0.12, 0.09, 0.15]
    )
    assert np.array_equal(clipped(-beyond), -clipped(beyond))


def test_all_logs_have_one_ratio_a_seed_and_logs_without_seeds_are_cases():
    grid = {
        (log, "isam2", "error"): {0: value, 1: 2 * value}
        for log, value in (("a", 1.0), ("b", 3.0))
    }
    assert with_all_logs(grid)[ALL_LOGS, "isam2", "error"] == {0: 2.0, 1: 4.0}
    recorded = {(log, "isam2", "error"): {log: 1.0} for log in "abc"}
    together = with_all_logs(recorded)
    assert together[ALL_LOGS, "isam2", "error"] == {"a": 1.0, "b": 1.0, "c": 1.0}
    (tested,) = families(together)
    assert tested.groups == [(ALL_LOGS, "isam2", "error")]


def test_families_by_signs_and_by_rotations_of_the_same_cases_share_what_there_is():
    def of(name: str, *cases: int) -> dict[Group, dict[int, float]]:
        return {("a", name, "error"): dict.fromkeys(cases, 0.1)}

    tested = families(
        of("isam2", *range(6)) | of("ekf-slam", *range(4)) | of("other", 0, 1)
    )
    assert [(one.cases, one.share) for one in tested] == [(6, 0.5), (4, 0.5)]
    assert ("a", "other", "error") not in [
        group for one in tested for group in one.groups
    ]
    tested = families(
        of("isam2", 0, 1, 2) | of("other", 0, 1, 2) | of("ekf-slam", 2, 3, 4)
    )
    assert [(len(one.groups), one.cases, one.share) for one in tested] == [
        (2, 3, 0.5),
        (1, 3, 0.5),
    ]
    assert not any(np.isnan(one.beyond).any() for one in tested)


def drawn(rng: np.random.Generator, seeds: int, *, lost: float, worse: float = 0.0):
    errors = rng.normal(0, 0.1, (2, 3, 2, seeds)) + math.log(100) * (
        rng.random((2, 3, 2, seeds)) < lost
    )
    ratios = errors[1] - errors[0]
    ratios[0] += math.log1p(worse)
    groups = {
        (f"log {n}", f"contestant {c}", "error"): ratios[c, n]
        for c in range(3)
        for n in range(2)
    }
    return with_all_logs(
        {group: dict(enumerate(values.tolist())) for group, values in groups.items()}
    )


def share_of_failures(
    seeds: int, *, lost: float, worse: float = 0.0, batches: int = 150
) -> float:
    rng = np.random.default_rng(7)
    batch = [drawn(rng, seeds, lost=lost, worse=worse) for _ in range(batches)]
    return float(
        np.mean(
            [bool(worse_groups(ratios, families(movable(ratios)))) for ratios in batch]
        )
    )


@pytest.mark.parametrize("lost", [0.0, 0.1])
@pytest.mark.parametrize("seeds", [1, 3, 5, 8])
def test_another_draw_of_the_same_fails_in_no_more_than_five_per_cent(seeds, lost):
    assert (
        share_of_failures(seeds, lost=lost) <= stats.binom.ppf(0.999, 150, 0.05) / 150
    )


@pytest.mark.parametrize(("seeds", "least"), [(3, 0.6), (5, 0.8), (8, 0.95)])
def test_half_as_large_again_is_found_with_few_seeds(seeds, least):
    assert share_of_failures(seeds, lost=0.0, worse=0.5, batches=60) >= least


def test_the_statistic_is_students_with_a_variance_that_like_groups_support():
    beyond = np.random.default_rng(3).normal(0.1, 0.2, (6, 4))
    groups = [
        ("a", "isam2", "error"),
        ("b", "isam2", "error"),
        (ALL_LOGS, "isam2", "error"),
        ("a", "isam2", "other"),
    ]
    scored = clipped(beyond)
    squares = (scored**2).mean(axis=0)
    supporting = np.array(
        [math.sqrt(squares[0] * squares[1])] * 2 + [squares[2], squares[3]]
    )
    mean = scored.mean(axis=0)
    spread = (2.0 * supporting + ((scored - mean) ** 2).sum(axis=0)) / (2.0 + 6 - 1)
    assert Family(groups, beyond, 1.0).statistics[0] == pytest.approx(
        math.sqrt(6) * mean / np.sqrt(spread)
    )


def noise(scatter: float, seed: int, cases: int = 8) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, scatter, cases)


def found(
    groups: dict[Group, np.ndarray],
    *columns: str,
    limit: float = 0.0,
    share: float = 1.0,
) -> dict[str, float]:
    return detectable(
        [Family(list(groups), np.stack(list(groups.values()), axis=1), share)],
        list(columns),
        limit,
    )


ALONE = {("a", "isam2", "error"): noise(0.1, 0)}


def test_a_worsening_must_be_larger_beside_what_scatters_shares_or_is_allowed():
    alone = found(ALONE, "error")["isam2"]
    others = {(f"{n}", f"other {n}", "error"): noise(0.5, n + 1) for n in range(40)}
    assert found(ALONE | others, "error")["isam2"] > alone
    assert found(ALONE, "error", share=0.2)["isam2"] > alone
    assert found(ALONE, "error", limit=math.log(1.5))["isam2"] > 0.5 > alone


def test_a_contestant_is_told_of_its_errors_alone_of_median_scatter_and_over_all_logs():
    assert found(ALONE, "other") == {}
    scatters = {"small": 0.01, "middle": 0.2, "large": 1.5}
    groups = {
        ("a", "isam2", column): noise(scatter, 3)
        for column, scatter in scatters.items()
    }
    assert found(groups, *scatters) == found(groups, "middle")
    assert (
        found(groups, "small")["isam2"]
        < found(groups, "middle")["isam2"]
        < found(groups, "large")["isam2"]
    )
    logs = {(log, "isam2", "error"): noise(1.0, n) for n, log in enumerate("abc")}
    together = {(ALL_LOGS, "isam2", "error"): noise(0.02, 5)}
    assert (
        found(logs | together, "error")["isam2"] < 0.3 < found(logs, "error")["isam2"]
    )


@pytest.mark.parametrize("scatter", [0.05, 0.2])
def test_what_is_said_to_be_found_is_found_in_four_of_five(scatter):
    own = noise(scatter, 9, 6)
    worsening = found({("a", "isam2", "error"): own}, "error")["isam2"]
    rng = np.random.default_rng(10)
    left = (own - own.mean()) * math.sqrt(6 / 5)
    batches = rng.choice(left, (200, 6)) * rng.choice(
        [1.0, -1.0], (200, 6)
    ) + math.log1p(worsening)
    shares = [
        Family([("a", "isam2", "error")], batch[:, None], 1.0).p_values[0] <= 0.05
        for batch in batches
    ]
    assert np.mean(shares) > 0.7
