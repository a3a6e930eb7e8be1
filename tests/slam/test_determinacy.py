"""What factors leave open, from how the factors were made."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from sonar_graph.slam.smoother.observability import LEAST_SAID, left_open

from .graphs import graph_of


def values() -> gtsam.Values:
    found = gtsam.Values()
    found.insert(X(0), gtsam.Pose3())
    found.insert(L(1), np.array([2.0, 0.0, 0.0]))
    return found


def along(direction: list[float], sigma: float) -> gtsam.NonlinearFactor:
    """A landmark is at its estimate, to sigma, along one direction."""
    J = np.array([direction]) / np.linalg.norm(direction)

    def error(_, found, jacobians):
        if jacobians is not None:
            jacobians[0] = J
        return J @ (found.atPoint3(L(1)) - [2.0, 0.0, 0.0])

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sigma), [L(1)], error)


@pytest.mark.parametrize("tilt", [1e-2, 1e-4, 1e-6])
def test_nearly_the_same_is_not_the_same(tilt: float) -> None:
    """Two directions apart by a small angle hold both, however badly; the same direction twice holds one."""
    made = [along([0.0, 0.0, 1.0], 0.1), along([1.0, 1.0, 0.0], 0.1)]
    assert left_open(graph_of([*made, along([1.0, 1.0 + tilt, 0.0], 0.1)]), values(), [L(1)]) == []
    (open_,) = left_open(graph_of([*made, along([1.0, 1.0, 0.0], 0.1)]), values(), [L(1)])
    np.testing.assert_allclose(open_.directions @ [1.0, 1.0, 0.0], 0.0, atol=1e-9)


@pytest.mark.parametrize("sigma", [1e-6, 1.0, 1e6])
def test_what_is_open_does_not_depend_on_how_surely_the_rest_is_held(sigma: float) -> None:
    made = [along([0.0, 0.0, 1.0], sigma), along([1.0, 0.0, 0.0], 1.0)]
    (open_,) = left_open(graph_of(made), values(), [L(1)])
    np.testing.assert_allclose(np.abs(open_.directions), [[0.0, 1.0, 0.0]], atol=1e-9)
    assert left_open(graph_of([*made, along([0.0, 1.0, 0.0], 1.0)]), values(), [L(1)]) == []


def test_a_range_leaves_open_what_is_across_it() -> None:
    """Of the landmark when the pose is known; what is said too weakly counts as not said."""
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
    distance = gtsam.RangeFactor3D(X(0), L(1), 2.0, noise)
    (across,) = left_open(graph_of([distance]), values(), [L(1)])
    assert np.linalg.matrix_rank(across.directions) == 2
    np.testing.assert_allclose(across.directions[:, 0], 0.0, atol=1e-9)
    weak = [along([0.0, 1.0, 0.0], 0.9 / LEAST_SAID), along([0.0, 0.0, 1.0], 1.1 / LEAST_SAID)]
    assert left_open(graph_of([distance, *weak]), values(), [L(1)]) == []
    (left,) = left_open(graph_of([distance, *weak]), values(), [L(1)], LEAST_SAID)
    assert left.axes() == "z"
