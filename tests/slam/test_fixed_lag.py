"""Windows begun anew where Cholesky gives up."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from sonar_graph.slam.smoother import fixed_lag as new_window_module
from sonar_graph.slam.smoother.factor_store import GraphEdit
from sonar_graph.slam.smoother.fixed_lag import SmootherWindow, marginal, picked
from sonar_graph.slam.smoother.incremental import Smoother

from .made import smoother_with

PRIOR_M, TIGHT_M, WEAK_M = 3.0, 2e-8, 1e3


def isotropic(size: int, sigma: float) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Isotropic.Sigma(size, sigma)


def chain() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Three points: the first known to a metre, the second nearly the first, the third somewhere near."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(gtsam.PriorFactorPoint3(L(0), np.zeros(3), isotropic(3, PRIOR_M)))
    graph.push_back(gtsam.BetweenFactorPoint3(L(0), L(1), np.zeros(3), isotropic(3, TIGHT_M)))
    graph.push_back(gtsam.BetweenFactorPoint3(L(1), L(2), np.zeros(3), isotropic(3, WEAK_M)))
    for k in range(3):
        values.insert(L(k), np.zeros(3))
    return graph, values


def test_by_qr_a_marginal_has_the_sum_of_a_weak_chains_variances():
    graph, values = chain()
    (found,) = marginal(graph, values, [L(2)], is_by_qr=True)
    information = found.linearize(values).augmentedInformation()[:3, :3]
    assert np.linalg.inv(information) == pytest.approx((PRIOR_M**2 + TIGHT_M**2 + WEAK_M**2) * np.eye(3), rel=1e-9)


def test_cholesky_loses_it():
    graph, values = chain()
    (found,) = marginal(graph, values, [L(2)])
    assert not found.linearize(values).augmentedInformation()[:3, :3].any()


def begun_anew(tight_m: float) -> Smoother:
    """Three keyframes like the chain; a factor on the first, which has left, is exchanged for its like."""
    smoother = smoother_with(lag_s=0.5, relinearize_threshold=1e-6, stale_shift_m=1e9)
    handles = []
    for k, sigma in enumerate([PRIOR_M, tight_m, WEAK_M]):
        smoother.add_pose(X(k), gtsam.Pose3(), float(k))
        handles += smoother.add([factor(k, sigma)])
        if k:
            smoother.update(float(k))
    smoother.exchange(GraphEdit([handles[0]], [[factor(0, PRIOR_M)]], {}, []), 2.0)
    return smoother


def factor(k: int, sigma: float) -> gtsam.NonlinearFactor:
    if k == 0:
        return gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), isotropic(6, sigma))
    return gtsam.BetweenFactorPose3(X(k - 1), X(k), gtsam.Pose3(), isotropic(6, sigma))


def begun_after(outside: gtsam.NonlinearFactorGraph, tight_m: float, *, is_by_qr: bool) -> SmootherWindow:
    """A third and a fourth point, near each other; inside, the third is known to a kilometre."""
    _, solved = chain()
    solved.insert(L(3), np.zeros(3))
    inside = gtsam.NonlinearFactorGraph()
    inside.push_back(gtsam.PriorFactorPoint3(L(2), np.zeros(3), isotropic(3, WEAK_M)))
    inside.push_back(gtsam.BetweenFactorPoint3(L(2), L(3), np.zeros(3), isotropic(3, tight_m)))
    window = SmootherWindow(1e-6, 1e9)
    window.is_by_qr = is_by_qr
    window.begin_after(outside, solved, inside, picked(solved, [L(2), L(3)]), {L(2): 0.0, L(3): 0.0})
    return window


def test_what_lies_outside_counts_once_where_cholesky_gives_up_on_the_window():
    outside = gtsam.NonlinearFactorGraph()
    outside.push_back(gtsam.PriorFactorPoint3(L(2), np.zeros(3), isotropic(3, WEAK_M)))
    window = begun_after(outside, 1e-6, is_by_qr=False)
    assert window.is_by_qr
    assert window.isam.marginalCovariance(L(2)) == pytest.approx(0.5 * WEAK_M**2 * np.eye(3), rel=1e-5)


@pytest.mark.parametrize("is_by_qr", [False, True])
def test_a_marginal_holds_where_it_was_made_though_the_window_is_linearised_elsewhere(is_by_qr: bool):
    """One says 0 m and one 3 m, equally surely."""
    outside, values, inside = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.NonlinearFactorGraph()
    outside.push_back(gtsam.PriorFactorPoint3(L(2), np.zeros(3), isotropic(3, 1.0)))
    inside.push_back(gtsam.PriorFactorPoint3(L(2), np.full(3, 3.0), isotropic(3, 1.0)))
    values.insert(L(2), np.zeros(3))
    window = SmootherWindow(1e-6, 1e9)
    window.is_by_qr = is_by_qr
    window.begin_after(outside, values, inside, values, {L(2): 0.0})
    window.settle()
    assert window.isam.getLinearizationPoint().atPoint3(L(2)) == pytest.approx(np.full(3, 1.5), abs=1e-5)
    assert window.isam.calculateEstimate().atPoint3(L(2)) == pytest.approx(np.full(3, 1.5))


@pytest.mark.parametrize("is_by_qr", [False, True])
def test_a_window_that_cholesky_cholesky_cannot_begin_has_what_its_marginal_had_lost(is_by_qr: bool):
    """Two sources say where the third point is: the chain outside, and a prior inside."""
    outside, _ = chain()
    window = begun_after(outside, 0.1, is_by_qr=is_by_qr)
    expected = 1.0 / (1.0 / WEAK_M**2 + 1.0 / (PRIOR_M**2 + TIGHT_M**2 + WEAK_M**2))
    assert window.is_by_qr
    assert window.isam.marginalCovariance(L(2)) == pytest.approx(expected * np.eye(3), rel=1e-6)


def test_where_cholesky_gives_up_on_the_marginal_qr_makes_it(monkeypatch: pytest.MonkeyPatch):
    ways = []

    def giving_up(*arguments, is_by_qr: bool):
        ways.append(is_by_qr)
        if not is_by_qr:
            raise RuntimeError("Indeterminate linear system")
        return marginal(*arguments, is_by_qr=True)

    monkeypatch.setattr(new_window_module, "marginal", giving_up)
    smoother = begun_anew(0.1)
    assert ways == [False, True]
    assert smoother.covariance(X(2)) == pytest.approx((PRIOR_M**2 + 0.1**2 + WEAK_M**2) * np.eye(6), rel=1e-6)
    assert not smoother.withheld
