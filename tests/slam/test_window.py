"""How far variables of a window are from where it was linearised, and where its factors are."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L

from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.fixed_lag import SmootherWindow


def pulled(shift: list[float], threshold: float) -> SmootherWindow:
    """Landmark 1 stays, landmark 2 is pulled after it was linearised."""
    window, values, graph = SmootherWindow(threshold, 1e9), gtsam.Values(), gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    for i in (1, 2):
        values.insert(L(i), np.zeros(3))
        graph.push_back(gtsam.PriorFactorPoint3(L(i), np.zeros(3), noise))
    window.begin(graph, values, {L(1): 0.0, L(2): 0.0})
    pull(window, 2.0 * np.array(shift))
    return window


def pull(window: SmootherWindow, point: Floats) -> None:
    more = gtsam.NonlinearFactorGraph()
    more.push_back(gtsam.PriorFactorPoint3(L(2), point, gtsam.noiseModel.Isotropic.Sigma(3, 1.0)))
    window.update(more, gtsam.Values(), {}, [])


@pytest.mark.parametrize("shift", [[0.3, 0.1, 0.2], [-0.3, 0.1, 0.0], [0.0, -0.2, -0.3]])
def test_the_largest_shift_is_the_largest_component_in_either_direction(shift: list[float]) -> None:
    window = pulled(shift, threshold=10.0)
    assert window.largest_shift([L(1)]) == pytest.approx(0.0, abs=1e-12)
    assert window.largest_shift([L(1), L(2)]) == pytest.approx(0.3)
    assert window.largest_shift([]) == 0.0


def test_every_update_linearises_anew_what_has_moved() -> None:
    window, nothing = pulled([-0.3, 0.0, 0.0], threshold=1e-3), (gtsam.NonlinearFactorGraph(), gtsam.Values(), {}, [])
    window.update(*nothing)
    assert window.largest_shift([L(2)]) < 1e-3
    window.update(*nothing)  # what is left out every other time was left out at one of both
    pull(window, np.array([1.0, 0.0, 0.0]))
    assert window.largest_shift([L(2)]) > 0.1
    window.update(*nothing)
    assert window.largest_shift([L(2)]) < 1e-3


def test_factors_are_found_from_the_first_place_on_until_they_are_taken_out() -> None:
    window, values, graph = SmootherWindow(1e-3, 1e9), gtsam.Values(), gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    values.insert(L(1), np.zeros(3))
    factors = [gtsam.PriorFactorPoint3(L(1), np.full(3, x), noise) for x in (1.0, 2.0, 3.0)]
    for factor in factors:
        graph.push_back(factor)
    window.begin(graph, values, {L(1): 0.0})
    assert window.slots(factors[::-1]) == [2, 1, 0]
    window.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), {}, [0])
    assert window.slots(factors[1:]) == [1, 2]
    assert window.slots(factors[:1]) is None
    assert window.slots(factors[:2]) is None
    assert window.slots([]) == []
    assert window.isam.calculateEstimate().atPoint3(L(1)) == pytest.approx(np.full(3, 2.5))


def test_what_settles_is_linearised_where_it_is() -> None:
    window = pulled([-0.3, 0.0, 0.0], threshold=1e-3)
    window.settle()
    assert window.largest_shift([L(2)]) < 1e-3
    assert window.isam.calculateEstimate().atPoint3(L(2))[0] == pytest.approx(-0.3)
