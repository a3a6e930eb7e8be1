from __future__ import annotations

import math

import numpy as np
import pytest

from sonar_graph.batch.permutation import Family, Group, detectable
from sonar_graph.batch.recorded import ALL_LOGS


def noise(scatter: float, seed: int, cases: int = 8) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, scatter, cases)


def found(groups: dict[Group, np.ndarray], *columns: str, limit: float = 0.0, share: float = 1.0) -> dict[str, float]:
    return detectable([Family(list(groups), np.stack(list(groups.values()), axis=1), share)], list(columns), limit)


ALONE = {("a", "isam2", "error"): noise(0.1, 0)}


def test_a_worsening_must_be_larger_beside_others_that_scatter():
    others = {(f"{n}", f"other {n}", "error"): noise(0.5, n + 1) for n in range(40)}
    assert found(ALONE | others, "error")["isam2"] > found(ALONE, "error")["isam2"]


def test_a_worsening_must_be_larger_where_families_share_the_five_per_cent():
    assert found(ALONE, "error", share=0.2)["isam2"] > found(ALONE, "error")["isam2"]


def test_what_is_allowed_comes_on_top():
    assert found(ALONE, "error", limit=math.log(1.5))["isam2"] > 0.5 > found(ALONE, "error")["isam2"]


def test_a_contestant_is_told_of_its_errors_alone():
    assert found(ALONE, "other") == {}


def test_the_error_of_the_median_scatter_stands_for_all():
    scatters = {"small": 0.01, "middle": 0.2, "large": 1.5}
    groups = {("a", "isam2", column): noise(scatter, 3) for column, scatter in scatters.items()}
    assert found(groups, *scatters) == found(groups, "middle")
    assert found(groups, "small")["isam2"] < found(groups, "middle")["isam2"] < found(groups, "large")["isam2"]


def test_over_several_logs_a_contestant_is_told_of_all_together():
    groups = {(log, "isam2", "error"): noise(1.0, n) for n, log in enumerate("abc")}
    together = {(ALL_LOGS, "isam2", "error"): noise(0.02, 5)}
    assert found(groups | together, "error")["isam2"] < 0.3 < found(groups, "error")["isam2"]


@pytest.mark.parametrize("scatter", [0.05, 0.2])
def test_what_is_said_to_be_found_is_found_in_four_of_five(scatter):
    own = noise(scatter, 9, 6)
    worsening = found({("a", "isam2", "error"): own}, "error")["isam2"]
    rng = np.random.default_rng(10)
    left = (own - own.mean()) * math.sqrt(6 / 5)
    batches = rng.choice(left, (200, 6)) * rng.choice([1.0, -1.0], (200, 6)) + math.log1p(worsening)
    shares = [Family([("a", "isam2", "error")], batch[:, None], 1.0).p_values[0] <= 0.05 for batch in batches]
    assert np.mean(shares) > 0.7
