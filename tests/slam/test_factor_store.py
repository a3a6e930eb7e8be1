"""Factors put in and taken out again."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.slam.smoother.factor_store import History, Recent


def prior(number: int) -> gtsam.NonlinearFactor:
    return gtsam.PriorFactorPoint3(L(number), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1.0))


def contents(graph: gtsam.NonlinearFactorGraph) -> list[int]:
    return sorted(gtsam.Symbol(graph.at(i).keys()[0]).index() for i in range(graph.size()))


@pytest.mark.parametrize("kind", [History, Recent])
@given(choices=st.lists(st.integers(0, 30), max_size=60))
def test_what_was_put_in_and_not_taken_out_is_in(kind: type[History] | type[Recent], choices: list[int]):
    """Each number adds a factor or, where it names one of those that are in, takes that one out."""
    history, inside = kind(), {}
    for number, choice in enumerate(choices):
        if choice in inside:
            history.remove([inside.pop(choice)])
        else:
            inside[choice] = history.add(prior(choice))
        assert contents(history.graph) == sorted(inside)
        assert history.changes == number + 1
        for named, handle in inside.items():
            assert history.factor(handle).keys()[0] == L(named)


def test_what_has_left_is_in_marginals_and_what_waits_beside_them():
    """A handle ends with the first pose or bias of its factor that leaves; those on landmarks alone stay."""
    recent = Recent()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
    lone = recent.add(prior(3))
    old = recent.add(gtsam.BetweenFactorPose3(X(0), X(1), gtsam.Pose3(), noise))
    walk = recent.add(gtsam.BetweenFactorPoint3(B(0), B(1), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1.0)))
    new = recent.add(gtsam.BetweenFactorPose3(X(1), X(2), gtsam.Pose3(), noise))
    window = gtsam.NonlinearFactorGraph()
    for handle in (lone, walk, new):
        window.push_back(recent.factor(handle))
    recent.keep(window, gtsam.Values(), [X(0)])
    changes = recent.changes
    assert recent.graph.size() == 3
    with pytest.raises(KeyError):
        recent.factor(old)
    assert recent.factor(new).equals(window.at(2), 0)
    waiting = recent.add(prior(4))
    assert recent.graph.size() == 4
    recent.remove([new, waiting])
    assert recent.graph.size() == 2
    assert recent.changes == changes + 3
    recent.keep(window, gtsam.Values(), [B(0)])
    with pytest.raises(KeyError):
        recent.factor(walk)
    assert recent.factor(lone).equals(window.at(0), 0)
