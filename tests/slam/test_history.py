import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.slam.history import History


def prior(number: int) -> gtsam.NonlinearFactor:
    return gtsam.PriorFactorPoint3(L(number), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1.0))


def contents(graph: gtsam.NonlinearFactorGraph) -> list[int]:
    return sorted(gtsam.Symbol(graph.at(i).keys()[0]).index() for i in range(graph.size()))


@given(st.lists(st.integers(0, 30), max_size=60))
def test_what_was_put_in_and_not_taken_out_is_in(choices: list[int]):
    """Each number adds a factor or, where it names one of those that are in, takes that one out."""
    history, inside = History(), {}
    for number, choice in enumerate(choices):
        if choice in inside:
            history.remove([inside.pop(choice)])
        else:
            inside[choice] = history.add(prior(choice))
        assert contents(history.graph) == sorted(inside)
        assert history.changes == number + 1
        for named, handle in inside.items():
            assert history.factor(handle).keys()[0] == L(named)
