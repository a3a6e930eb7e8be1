"""Windows begun anew where Cholesky gives up, and factors put in and taken out again."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.slam.smoother import Sightline
from sonar_graph.slam.smoother.factor_store import FactorGroup, FactorStore
from sonar_graph.slam.smoother.window import FixedLagWindow, Thresholds, marginal

from .graphs import factors_of
from .made import graph_of, isotropic, point_prior, pose_prior, values_of

PRIOR_M, TIGHT_M, WEAK_M = 3.0, 2e-8, 1e3
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


def test_by_qr_a_marginal_has_the_sum_of_a_weak_chains_variances_which_cholesky_loses():
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


def factor(k: int, sigma: float) -> gtsam.NonlinearFactor:
    if k == 0:
        return pose_prior(X(0), gtsam.Pose3(), sigma)
    return gtsam.BetweenFactorPose3(X(k - 1), X(k), gtsam.Pose3(), isotropic(6, sigma))


PRIOR = graph_of([point_prior(L(2), ORIGIN, WEAK_M)])


@pytest.mark.parametrize(
    ("outside", "variance_m2", "is_by_qr"),
    [(PRIOR, WEAK_M**2, True), (chain()[0], CHAIN_M2, True)],
    ids=["factor", "marginal"],
)
def test_a_window_counts_factors_outside_of_it_once(outside, variance_m2, is_by_qr):
    """A third and a fourth point, near each other; inside, the third is known to a kilometre."""
    _, solved = chain()
    solved.insert(L(3), ORIGIN)
    inside = graph_of([point_prior(L(2), ORIGIN, WEAK_M), near(2, 3, 0.1)])
    inside.push_back(outside)
    window = FixedLagWindow(Thresholds(1e-6, 1e-6), 1e9, is_by_qr=is_by_qr)
    window.begin(inside, {}, solved, {L(2): 0.0, L(3): 0.0})
    expected = 1.0 / (1.0 / WEAK_M**2 + 1.0 / variance_m2)
    assert window.isam.marginalCovariance(L(2)) == pytest.approx(
        expected * np.eye(3), rel=1e-6
    )


@pytest.mark.parametrize("is_by_qr", [False, True])
def test_a_marginal_holds_where_it_was_made_though_the_window_is_linearised_elsewhere(
    is_by_qr: bool,
):
    """One prior is at 0 m, of a point that has left, and one at 3 m, equally certain."""
    graph = graph_of(
        [
            point_prior(L(1), ORIGIN, 0.6),
            near(1, 2, 0.8),
            point_prior(L(2), np.full(3, 3.0), 1.0),
        ]
    )
    window = FixedLagWindow(Thresholds(1e-6, 1e-6), 1e9, is_by_qr=is_by_qr)
    window.begin(graph, {}, values_of(L1=ORIGIN, L2=ORIGIN), {L(2): 0.0})
    for _ in range(2):
        window.update({}, gtsam.Values(), {L(2): 0.0}, 1e9, removed=())
    assert not window.holds(L(1))
    assert window.linearised_at.atPoint3(L(2)) == pytest.approx(
        np.full(3, 1.5), abs=1e-5
    )
    assert window.estimate().atPoint3(L(2)) == pytest.approx(np.full(3, 1.5))


@given(choices=st.lists(st.integers(0, 30), max_size=60))
def test_what_was_put_in_and_not_taken_out_is_in(choices: list[int]):
    """Each number adds a group or, where it names one of those that are in, takes that one out."""
    store, inside = FactorStore(), {}
    for number, choice in enumerate(choices):
        if choice in inside:
            store.remove([inside.pop(choice)])
        else:
            prior = point_prior(L(choice), ORIGIN)
            line = Sightline(X(number), gtsam.Pose3(), ORIGIN[:2])
            inside[choice] = store.add(
                FactorGroup({"one": prior, "two": prior}, (L(choice), line))
            )
        assert [f.keys()[0] for f in factors_of(store.graph())][::2] == [
            L(named) for named in inside
        ]
        assert store.graph().size() == 2 * len(inside)
        assert store.sightlines().keys() == set(map(L, inside))
        for named, handle in inside.items():
            assert [f.keys()[0] for f in store.factors([handle])] == [L(named)] * 2
        assert store.graph(left_out=set(list(inside.values())[1:])).size() == 2 * bool(
            inside
        )


def test_a_group_leaves_with_its_oldest_pose_or_bias_and_those_on_landmarks_alone_stay():
    store = FactorStore()
    walk = gtsam.BetweenFactorPoint3(B(0), B(1), ORIGIN, isotropic(3, 1.0))
    made = {
        "prior": point_prior(L(3), ORIGIN),
        "old": factor(1, 1.0),
        "walk": walk,
        "odometry": factor(2, 1.0),
    }
    lone, old, walked, later = (
        store.add(FactorGroup({name: each})) for name, each in made.items()
    )
    sighting = store.add(
        FactorGroup(
            {"range": made["prior"]}, (L(3), Sightline(X(1), gtsam.Pose3(), ORIGIN[:2]))
        )
    )
    store.leave([X(0)])
    assert store.graph().size() == 4
    assert store.factors([sighting]) == [made["prior"]]
    with pytest.raises(KeyError):
        store.factors([old])
    store.remove([later])
    store.leave([B(0), X(1)])
    assert store.factors([lone]) == [made["prior"]]
    assert store.graph().size() == 1
    with pytest.raises(KeyError):
        store.factors([walked])
