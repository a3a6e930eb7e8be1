"""Joint covariances: those of all factors, computed once between updates."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from .fed import FOREVER_S, dense_covariance, in_the_basin, joint, settled


def test_one_computation_of_covariances_serves_until_the_next_update():
    """Asked for more than before, it is made for all; what it says does not depend on who asked first."""
    fed = in_the_basin(12, FOREVER_S)
    alone = fed.smoother.joint_covariance([X(11), L(3)])
    pose = alone.at(X(11), X(11)).copy()
    both = fed.smoother.joint_covariance([X(11), L(3), L(5)])
    assert np.allclose(both.at(X(11), X(11)), pose, rtol=1e-9)
    assert np.allclose(both.at(L(5), L(5)), fed.smoother.covariance(L(5)), rtol=1e-6)
    assert fed.smoother.joint_covariance([L(5)]) is both
    fed.add([gtsam.PriorFactorPoint3(L(5), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3))])
    fed.smoother.update(11.0)
    assert fed.smoother.joint_covariance([L(5)]).at(L(5), L(5))[0, 0] < 1e-5


def test_covariances_are_those_of_where_the_window_has_settled():
    """A landmark that is pulled away by decimetres lies at other angles to all that see it."""
    fed, keys = in_the_basin(12, FOREVER_S), [X(11), L(3)]
    fed.add([gtsam.PriorFactorPoint3(L(5), np.array([2.6, 4.3, -0.8]), gtsam.noiseModel.Isotropic.Sigma(3, 0.01))])
    fed.smoother.update(11.0)
    joint(fed, keys)
    fed.smoother.settle(11.0)
    expected = dense_covariance(fed, fed.smoother.values, keys)
    assert np.allclose(joint(fed, keys), expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())


def counted_marginals(monkeypatch: pytest.MonkeyPatch) -> list[set[int]]:
    """Keys of each joint covariance that is computed from now on."""
    asked: list[set[int]] = []
    compute = gtsam.ISAM2.jointMarginalCovariance

    def counting(isam, keys):
        asked.append(set(keys))
        return compute(isam, keys)

    monkeypatch.setattr(gtsam.ISAM2, "jointMarginalCovariance", counting)
    return asked


def test_landmarks_asked_for_before_an_update_come_with_the_first_question_after_it(monkeypatch):
    """Successive frames show mostly the same: one computation an update, and it is that of all factors."""
    fed, asked = settled(in_the_basin(6, FOREVER_S), 5.0), counted_marginals(monkeypatch)
    joint(fed, [X(5), L(3)])
    joint(fed, [X(5), L(5)])
    fed.smoother.update(5.0)
    joint(fed, [X(5)])
    joint(fed, [L(5), X(5)])
    assert asked == [{X(5), L(3)}, {X(5), L(3), L(5)}, {X(5), L(3), L(5)}]
    keys = [X(5), L(5)]
    expected = dense_covariance(fed, fed.smoother.values, keys)
    assert np.allclose(joint(fed, keys), expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())


def test_what_was_asked_for_is_known_after_settling(monkeypatch):
    fed, asked = in_the_basin(6, FOREVER_S), counted_marginals(monkeypatch)
    joint(fed, [X(5), L(3)])
    fed.smoother.settle(5.0)
    fed.smoother.update(5.0)
    joint(fed, [X(5)])
    assert asked == [{X(5), L(3)}] * 2


def test_landmarks_that_are_no_longer_asked_for_are_let_go(monkeypatch):
    """Remembered over one update, not for ever; poses not at all, since they may have left the window."""
    fed, asked = in_the_basin(6, FOREVER_S), counted_marginals(monkeypatch)
    joint(fed, [X(4), L(3), L(5)])
    fed.smoother.update(5.0)
    joint(fed, [X(5), L(5)])
    fed.smoother.update(5.0)
    joint(fed, [X(5)])
    assert asked == [{X(4), L(3), L(5)}, {X(5), L(3), L(5)}, {X(5), L(5)}]


@pytest.mark.parametrize("lag_s", [FOREVER_S, 1.1], ids=["in the window", "not in it"])
def test_a_joint_covariance_of_any_poses_is_that_of_all_factors(lag_s):
    fed = in_the_basin(15, lag_s)
    values, _ = fed.smoother.solve_history()
    keys = [X(2), X(9), L(5)]
    found = fed.smoother.joint_covariance_of_any(keys)
    expected = dense_covariance(fed, values, keys)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    matrix = np.block([[found.at(a, b) for b in keys] for a in keys])
    assert np.abs((matrix - expected) / scale).max() < 1e-2
