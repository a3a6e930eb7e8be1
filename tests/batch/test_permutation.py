"""The test of many groups keeps its level, has power, and knows how much."""

import itertools
import math

import numpy as np
import pytest
from permutation import (
    Family,
    clipped,
    families,
    with_all_logs,
)
from scipy import stats

from sonar_graph.batch import ALL_LOGS


def family(beyond: np.ndarray, share: float = 1.0) -> Family:
    return Family(
        [(f"log {n}", "isam2", "error") for n in range(beyond.shape[1])], beyond, share
    )


def test_one_group_has_the_p_value_of_a_t_test_or_of_sign_changes():
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
