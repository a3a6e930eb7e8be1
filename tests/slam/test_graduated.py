"""Graduated non-convexity; truth: GTSAM's own, and the minimum found by trying every subset."""

from itertools import product

import gtsam
import numpy as np
import pytest

from sonar_graph.slam.landmarks.mixture_history import graduated_weights, truncated_weights

C2 = 9.0


def problem(seed: int):
    """A point on a line, measured twelve times with a sigma of 1, four of them far off."""
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.standard_normal(8), 8.0 + 30.0 * rng.random(4)])


def graph_of(z, weights=None) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for value, weight in zip(z, np.ones(len(z)) if weights is None else weights, strict=True):
        noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0 / np.sqrt(max(weight, 1e-12)))
        graph.push_back(gtsam.PriorFactorPoint3(0, np.array([value, 0.0, 0.0]), noise))
    return graph


def start() -> gtsam.Values:
    values = gtsam.Values()
    values.insert(0, np.array([12.0, 0.0, 0.0]))
    return values


def ours(z):
    def squared(values):
        return (values.atPoint3(0)[0] - z) ** 2

    values, weights = graduated_weights(lambda w: graph_of(z, w), squared, np.full(len(z), C2), start())
    return values.atPoint3(0)[0], weights


@pytest.mark.parametrize("seed", range(5))
def test_it_keeps_what_gtsams_keeps(seed: int) -> None:
    z = problem(seed)
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    theirs = gtsam.GncLMOptimizer(graph_of(z), start(), params)
    theirs.setInlierCostThresholds(C2 / 2)
    point = theirs.optimize().atPoint3(0)[0]
    found, weights = ours(z)
    assert found == pytest.approx(point, abs=1e-3)
    np.testing.assert_allclose(weights, theirs.getWeights(), atol=1e-2)


@pytest.mark.parametrize("seed", range(5))
def test_it_finds_the_least_truncated_cost_of_all_subsets(seed: int) -> None:
    z = problem(seed)
    costs = {}
    for kept in product([False, True], repeat=len(z)):
        inside = z[list(kept)]
        if len(inside):
            costs[kept] = ((inside - inside.mean()) ** 2).sum() + C2 * (len(z) - len(inside))
    found, weights = ours(z)
    assert tuple((weights > 0.5).tolist()) == min(costs, key=costs.__getitem__)
    assert abs(np.mean(z) - found) > 3.0, "without weights the answer would be another one"


def test_weights_are_one_inside_and_none_outside_of_the_band() -> None:
    r2 = np.array([0.0, C2 / 3 * 0.99, C2, C2 * 3 * 1.01])
    np.testing.assert_allclose(truncated_weights(r2, np.full(4, C2), 0.5), [1, 1, np.sqrt(0.75) - 0.5, 0])
