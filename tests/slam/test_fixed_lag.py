"""Windows restarted where Cholesky gives up, and factors put in and taken out again."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L

from sonar_graph.slam.smoother.window import FixedLagWindow, Thresholds, marginal

from .made import graph_of, isotropic, point_prior, values_of

PRIOR_M = 3.0
TIGHT_M = 2e-8
WEAK_M = 1e3
CHAIN_M2 = PRIOR_M**2 + TIGHT_M**2 + WEAK_M**2
ORIGIN = np.zeros(3)


def near(i: int, j: int, sigma_m: float) -> gtsam.NonlinearFactor:
    return gtsam.BetweenFactorPoint3(L(i), L(j), ORIGIN, isotropic(3, sigma_m))


def chain() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Three points: the first known to a metre, the second nearly the first, the third somewhere near."""
    graph = graph_of(
        [point_prior(L(0), ORIGIN, PRIOR_M), near(0, 1, TIGHT_M), near(1, 2, WEAK_M)]
    )
    return graph, values_of(L0=ORIGIN, L1=ORIGIN, L2=ORIGIN)


def test_by_qr_a_marginal_has_the_variance_that_cholesky_loses():
    graph, values = chain()
    ((by_qr,), (by_cholesky,)) = (
        marginal(graph, values, [L(2)], is_by_qr=by) for by in (True, False)
    )
    information, lost = (
        found.linearize(values).augmentedInformation()[:3, :3]
        for found in (by_qr, by_cholesky)
    )
    assert np.linalg.inv(information) == pytest.approx(CHAIN_M2 * np.eye(3), rel=1e-9)
    assert not lost.any()


PRIOR = graph_of([point_prior(L(2), ORIGIN, WEAK_M)])


@pytest.mark.parametrize(
    ("outside", "variance_m2"),
    [(PRIOR, WEAK_M**2), (chain()[0], CHAIN_M2)],
    ids=["factor", "marginal"],
)
def test_a_window_counts_factors_outside_of_it_once(outside, variance_m2):
    """A third and a fourth point, near each other; inside, the third is known to a kilometre."""
    _, solved = chain()
    solved.insert(L(3), ORIGIN)
    inside = graph_of([point_prior(L(2), ORIGIN, WEAK_M), near(2, 3, 0.1)])
    inside.push_back(outside)
    window = FixedLagWindow(Thresholds(1e-6, 1e-6), is_by_qr=True)
    window.begin(inside, {}, solved, {L(2): 0.0, L(3): 0.0})
    expected = 1.0 / (1.0 / WEAK_M**2 + 1.0 / variance_m2)
    assert window.isam.marginalCovariance(L(2)) == pytest.approx(
        expected * np.eye(3), rel=1e-6
    )
