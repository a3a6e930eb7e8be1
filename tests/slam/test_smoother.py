"""Window and history against least squares on the rail and batch solutions in the basin."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X

from sonar_graph.calibration import Calibration, Start
from sonar_graph.navigation.preintegration.motion import PreintegratedMotion
from sonar_graph.slam.models import factors
from sonar_graph.slam.smoother.batch_solution import solve
from sonar_graph.slam.smoother.factor_store import GraphEdit
from sonar_graph.slam.smoother.incremental import FIRST_RESTART

from .fed import (
    FOREVER_S,
    NEVER_M,
    SONAR,
    Fed,
    counted_solves,
    dense_covariance,
    in_the_basin,
    joint,
    on_the_rail,
    plain,
    settled,
)
from .graphs import graph_of
from .made import smoother_with
from .rail import RANGE_SIGMA_M, STEP_S, Rail, rail


@pytest.mark.parametrize("lag_s", [FOREVER_S, 2.6, 0.6], ids=["all", "five poses", "one pose"])
def test_on_the_rail_the_window_is_least_squares(lag_s):
    """Marginalising is exact where nothing is linearised: mean and covariance of pose and landmarks to 1e-8."""
    nodes = 21
    fed, (_, numbers) = on_the_rail(nodes, lag_s), rail(nodes)
    mean, variance = numbers.solution(nodes)
    newest = fed.smoother.values.atPose3(X(nodes - 1)).translation()[0]
    assert newest == pytest.approx(mean[f"x{nodes - 1}"], abs=1e-8)
    assert joint(fed, [X(nodes - 1)])[3, 3] == pytest.approx(variance[f"x{nodes - 1}"], abs=1e-8)
    for i in (4, 7):
        assert fed.smoother.values.atPoint3(L(i))[0] == pytest.approx(mean[f"l{i}"], abs=1e-8)
        assert fed.smoother.covariance(L(i))[0, 0] == pytest.approx(variance[f"l{i}"], abs=1e-8)


def test_on_the_rail_the_history_is_least_squares_for_every_pose():
    nodes = 21
    fed, (_, numbers) = on_the_rail(nodes, 2.6), rail(nodes)
    mean, variance = numbers.solution(nodes)
    values, marginals = fed.smoother.solve_history()
    for k in range(nodes):
        assert values.atPose3(X(k)).translation()[0] == pytest.approx(mean[f"x{k}"], abs=1e-8)
        assert marginals.marginalCovariance(X(k))[3, 3] == pytest.approx(variance[f"x{k}"], abs=1e-8)


def test_the_history_is_solved_anew_when_it_has_grown():
    fed = in_the_basin(8, FOREVER_S)
    before, _ = fed.smoother.solve_history()
    fed.add([gtsam.PriorFactorPoint3(L(3), np.array([3.5, 1.0, -1.0]), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3))])
    fed.smoother.update(7.0)
    after, _ = fed.smoother.solve_history()
    assert after.atPoint3(L(3)) == pytest.approx([3.5, 1.0, -1.0], abs=0.02)
    assert not np.allclose(before.atPoint3(L(3)), after.atPoint3(L(3)), atol=0.1)


def test_factors_wait_until_they_are_worth_an_update():
    fed = in_the_basin(5, 6.0)
    before = fed.smoother.values.atPoint3(L(3))
    fed.add([gtsam.PriorFactorPoint3(L(3), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.01))])
    assert not fed.smoother.is_due
    fed.smoother.waiting_gain += 0.1
    assert fed.smoother.is_due
    assert np.array_equal(fed.smoother.values.atPoint3(L(3)), before)
    fed.smoother.update(4.0)
    assert not fed.smoother.is_due
    assert np.linalg.norm(fed.smoother.values.atPoint3(L(3)) - before) > 0.5


@pytest.mark.parametrize("lag_s", [FOREVER_S, 3.0])
def test_biases_in_a_row_are_least_squares(lag_s):
    """Old ones leave the window; the newest is that of all: scalars by hand, prior, walk, and a reading of each."""
    smoother, sigma, walk, reading = smoother_with(lag_s, 1e-6, NEVER_M), 1.0, 0.5, 0.3
    A, b = [np.eye(8)[0] / sigma], [0.0]
    for k in range(8):
        smoother.add_pose(X(k), gtsam.Pose3(), float(k))
        smoother.add([gtsam.PriorFactorPose3(X(k), gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6))])
        smoother.add_bias(B(k), np.zeros(3))
        smoother.add([factors.bias_walk(B(k - 1), B(k), walk) if k else factors.bias_prior(B(0), sigma)])
        noise = gtsam.noiseModel.Isotropic.Sigma(3, reading)
        smoother.add([gtsam.PriorFactorPoint3(B(k), np.full(3, np.sin(k)), noise)])
        smoother.update(float(k))
        if k:
            A.append((np.eye(8)[k] - np.eye(8)[k - 1]) / walk)
            b.append(0.0)
        A.append(np.eye(8)[k] / reading)
        b.append(np.sin(k) / reading)
    cov = np.linalg.inv(np.transpose(A) @ A)
    assert smoother.values.atPoint3(B(7)) == pytest.approx([(cov @ np.transpose(A) @ b)[7]] * 3, abs=1e-9)
    assert np.diag(smoother.covariance(B(7))) == pytest.approx([cov[7, 7]] * 3, abs=1e-9)


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


def test_covariances_are_those_of_where_the_window_has_settled():
    """A landmark that is pulled away by decimetres lies at other angles to all that see it."""
    fed, keys = in_the_basin(12, FOREVER_S), [X(11), L(3)]
    fed.add([gtsam.PriorFactorPoint3(L(5), np.array([2.6, 4.3, -0.8]), gtsam.noiseModel.Isotropic.Sigma(3, 0.01))])
    fed.smoother.update(11.0)
    joint(fed, keys)
    fed.smoother.settle(11.0)
    expected = dense_covariance(fed, fed.smoother.values, keys)
    assert np.allclose(joint(fed, keys), expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())


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


def assert_is_least_squares(fed: Fed, numbers: Rail, nodes: int, landmarks: list[int]) -> None:
    mean, variance = numbers.solution(nodes)
    newest = X(nodes - 1)
    assert fed.smoother.values.atPose3(newest).translation()[0] == pytest.approx(mean[f"x{nodes - 1}"], abs=1e-8)
    assert joint(fed, [newest])[3, 3] == pytest.approx(variance[f"x{nodes - 1}"], abs=1e-8)
    for i in landmarks:
        assert fed.smoother.values.atPoint3(L(i))[0] == pytest.approx(mean[f"l{i}"], abs=1e-8)
        assert fed.smoother.covariance(L(i))[0, 0] == pytest.approx(variance[f"l{i}"], abs=1e-8)


def assert_history_is_least_squares(fed: Fed, numbers: Rail, nodes: int) -> None:
    mean, _ = numbers.solution(nodes)
    values, _ = fed.smoother.solve_history()
    assert values.atPose3(X(1)).translation()[0] == pytest.approx(mean["x1"], abs=1e-8)


def without(numbers: Rail, gone: list[tuple[int, int]]) -> Rail:
    return Rail(numbers.displacements_m, [r for r in numbers.ranges if (r[0], r[1]) not in gone])


@pytest.mark.parametrize(
    ("lag_s", "oldest", "solves"), [(FOREVER_S, 7, 0), (2.6, 17, 0), (2.6, 7, 1)], ids=["all", "recent", "marginalised"]
)
def test_what_is_taken_out_was_never_there(monkeypatch, lag_s, oldest, solves):
    """Least squares without those ranges; the history is solved only for what has left the window."""
    nodes = 21
    fed, (_, numbers) = on_the_rail(nodes, lag_s), rail(nodes)
    fed.smoother.solve_history()
    gone = [(k, i) for k in range(oldest, nodes) for i in (4, 7)]
    sizes = counted_solves(monkeypatch)
    removed = [handle for k, i in gone for handle in fed.handles_on(X(k), L(i))]
    assert len(removed) == 2 * len(gone)
    fed.smoother.exchange(GraphEdit(removed, [], {}, []), (nodes - 1) * STEP_S)
    assert len(sizes) == solves
    assert_is_least_squares(fed, without(numbers, gone), nodes, [4, 7])
    assert_history_is_least_squares(fed, without(numbers, gone), nodes)


class Refusing:
    """A window whose elimination gives up while the estimate settles."""

    def __init__(self, window: gtsam.IncrementalFixedLagSmoother) -> None:
        self.window = window

    def update(self, *news) -> None:
        if not news:
            raise RuntimeError("Indeterminant linear system detected")
        self.window.update(*news)

    def __getattr__(self, name: str):
        return getattr(self.window, name)


@pytest.mark.parametrize("gives_up", [False, True])
def test_after_wrong_factors_are_taken_out_the_estimate_is_that_of_the_others_at_once(monkeypatch, gives_up):
    """Six sightings that put a landmark a metre off; a thousandth of that is left, also when Cholesky gives up."""
    fed = in_the_basin(15, FOREVER_S)
    wrong: list[int] = []
    for k in range(9, 15):
        q = fed.smoother.values.atPose3(X(k)).compose(SONAR).transformTo(fed.smoother.values.atPoint3(L(3)))
        z = np.array([np.linalg.norm(q) + 2.0, np.arctan2(q[1], q[0]) + 0.5])
        new = factors.landmark_sighting(X(k), L(3), SONAR, z, np.diag([1e-4, 1e-4]), plain)
        wrong += fed.smoother.add(new)
    for _ in range(5):
        fed.smoother.update(14.0)
    batch = solve(graph_of(fed.given), fed.smoother.values)
    off_m = [np.linalg.norm(fed.smoother.values.atPoint3(L(3)) - batch.atPoint3(L(3)))]
    sizes = counted_solves(monkeypatch)
    if gives_up:
        fed.smoother._window.isam = Refusing(fed.smoother._window.isam)
    fed.smoother.exchange(GraphEdit(wrong, [], {}, []), 14.0)
    off_m.append(np.linalg.norm(fed.smoother.values.atPoint3(L(3)) - batch.atPoint3(L(3))))
    assert off_m[0] > 0.5
    assert off_m[1] < 1e-3 * off_m[0]
    assert len(sizes) == int(gives_up)


def test_a_landmark_without_factors_leaves_the_graph_and_can_come_back():
    nodes = 21
    fed, (_, numbers) = on_the_rail(nodes, 2.6), rail(nodes)
    gone = [(k, 7) for k in range(1, nodes)]
    removed = [handle for k, i in gone for handle in fed.handles_on(X(k), L(i))]
    fed.smoother.exchange(GraphEdit(removed, [], {}, [L(7)]), (nodes - 1) * STEP_S)
    assert_is_least_squares(fed, without(numbers, gone), nodes, [4])
    assert_history_is_least_squares(fed, without(numbers, gone), nodes)
    assert not fed.smoother.values.exists(L(7))
    (distance,) = (r for k, i, r in numbers.ranges if (k, i) == (nodes - 1, 7))
    z, R = np.array([distance, 0.0]), np.diag([RANGE_SIGMA_M**2, 1e6])
    again = factors.landmark_sighting(X(nodes - 1), L(7), gtsam.Pose3(), z, R, plain, 3e-4)
    point = fed.smoother.values.atPose3(X(nodes - 1)).translation() + distance * np.eye(3)[0]
    fed.smoother.exchange(GraphEdit([], [again], {L(7): point}, []), (nodes - 1) * STEP_S)
    assert_is_least_squares(fed, without(numbers, gone[:-1]), nodes, [4, 7])
    assert_history_is_least_squares(fed, without(numbers, gone[:-1]), nodes)


def test_a_held_keyframe_takes_late_factors_without_solving_the_history(monkeypatch):
    nodes = 21
    fed, (_, numbers) = on_the_rail(nodes, 0.6, held={X(3): FOREVER_S}), rail(nodes)
    sizes = counted_solves(monkeypatch)
    late = 24.0
    z, R = np.array([late, 0.0]), np.diag([RANGE_SIGMA_M**2, 1e6])
    new = factors.landmark_sighting(X(3), L(4), gtsam.Pose3(), z, R, plain)
    (handles,) = fed.smoother.exchange(GraphEdit([], [new], {}, []), (nodes - 1) * STEP_S)
    assert not sizes
    assert_is_least_squares(fed, Rail(numbers.displacements_m, [*numbers.ranges, (3, 4, late)]), nodes, [4, 7])
    assert_history_is_least_squares(fed, Rail(numbers.displacements_m, [*numbers.ranges, (3, 4, late)]), nodes)
    fed.smoother.exchange(GraphEdit(handles, [], {}, []), (nodes - 1) * STEP_S)
    assert len(sizes) == 1  # that of the smoothed result above
    assert_is_least_squares(fed, numbers, nodes, [4, 7])
    assert_history_is_least_squares(fed, numbers, nodes)


def test_a_keyframe_and_all_later_ones_are_held_until_the_time_given():
    nodes = 21
    fed = on_the_rail(nodes, 1.1, held={X(3): (nodes - 1) * STEP_S})
    for k in range(3, nodes):
        assert fed.smoother.covariance(X(k))[3, 3] > 0
    with pytest.raises(IndexError):
        fed.smoother.covariance(X(2))
    fed = on_the_rail(nodes, 1.1, held={X(3): 8.0})
    with pytest.raises(IndexError):
        fed.smoother.covariance(X(17))
    assert fed.smoother.covariance(X(18))[3, 3] > 0


@pytest.mark.parametrize("later_s", [0.0, 0.1])
@pytest.mark.parametrize("is_bounded", [False, True])
def test_a_hold_that_is_over_ends_at_an_exchange_only_where_what_left_can_be_taken_out(is_bounded, later_s):
    """A bounded window would have given up what the exchange takes out; it lets go at the next update instead.

    Either way the end is least squares, with a range on the keyframe that was held exchanged for another.
    """
    nodes, late_m, waiting_m = 21, 24.0, 30.0
    end_s = (nodes - 1) * STEP_S
    fed = on_the_rail(nodes, 1.1, held={X(3): FOREVER_S}, is_bounded=is_bounded)
    _, numbers = rail(nodes)
    ranges = [r for r in numbers.ranges if r[:2] != (3, 4)] + [(3, 4, late_m), (nodes - 1, 4, waiting_m)]
    removed, R = fed.handles_on(X(3), L(4)), np.diag([RANGE_SIGMA_M**2, 1e6])
    waiting, late = (
        factors.landmark_sighting(X(k), L(4), gtsam.Pose3(), np.array([z, 0.0]), R, plain)
        for k, z in ((nodes - 1, waiting_m), (3, late_m))
    )
    fed.add(waiting)
    fed.smoother.hold({})
    fed.smoother.exchange(GraphEdit(removed, [late], {}, []), end_s + later_s)
    assert fed.smoother.in_window([X(3)]) == ([X(3)] if is_bounded else [])
    assert_is_least_squares(fed, Rail(numbers.displacements_m, ranges), nodes, [4, 7])
    fed.smoother.update(end_s + later_s)
    assert not fed.smoother.in_window([X(3)])
    assert_is_least_squares(fed, Rail(numbers.displacements_m, ranges), nodes, [4, 7])


@pytest.mark.parametrize("is_bounded", [False, True], ids=["whole", "bounded"])
@pytest.mark.parametrize("start_s", [0.001, 3.137, 30.7, 1.7e9])
def test_a_held_keyframe_stays_however_its_time_is_rounded(start_s: float, is_bounded: bool) -> None:
    """Its age is exactly the lag then; differences of times near 0 are rounded up as often as down."""
    smoother, sigmas = smoother_with(2.0, 1e-3, 1e9, is_bounded=is_bounded), gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    smoother.add_pose(X(0), gtsam.Pose3(), start_s)
    smoother.add([gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), sigmas)])
    smoother.hold({X(0): np.inf})
    for k in range(1, 400):
        smoother.add_pose(X(k), gtsam.Pose3(), start_s + 0.1 * k)
        smoother.add([gtsam.BetweenFactorPose3(X(k - 1), X(k), gtsam.Pose3(), sigmas)])
        smoother.update(start_s + 0.1 * k)
        assert smoother.in_window([X(0)]) == [X(0)]
    smoother.hold({})
    smoother.update(start_s + 40.0)
    assert smoother.in_window([X(0)]) == []


@pytest.mark.parametrize("lag_s", [FOREVER_S, 6.0])
def test_a_restart_leaves_what_the_batch_gives(monkeypatch, lag_s):
    """Just after a restart newest pose, landmarks and bias, and their joint covariance, are those of all factors."""
    sizes = counted_solves(monkeypatch)
    size = next(n for n in range(5, 40) if len(in_the_basin(n, lag_s).given) >= FIRST_RESTART)
    assert not sizes
    fed = in_the_basin(size, lag_s, stale_shift_m=1e-9)
    assert sizes == [len(fed.given)]
    keys = [X(size - 1), L(3), L(5), L(8), B(0)]
    batch = solve(graph_of(fed.given), fed.smoother.values)
    for key in keys[1:]:
        assert np.allclose(fed.smoother.values.atPoint3(key), batch.atPoint3(key), atol=1e-4)
    assert fed.smoother.values.atPose3(keys[0]).equals(batch.atPose3(keys[0]), 1e-4)
    expected = dense_covariance(fed, batch, keys)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((joint(fed, keys) - expected) / scale).max() < 1e-3


def test_on_the_rail_restarts_change_nothing(monkeypatch):
    nodes = 61
    sizes = counted_solves(monkeypatch)
    fed, (_, numbers) = on_the_rail(nodes, 3.1, stale_shift_m=1e-9), rail(nodes)
    assert len(sizes) >= 3
    mean, variance = numbers.solution(nodes)
    assert fed.smoother.values.atPose3(X(nodes - 1)).translation()[0] == pytest.approx(mean[f"x{nodes - 1}"], abs=1e-7)
    assert joint(fed, [X(nodes - 1)])[3, 3] == pytest.approx(variance[f"x{nodes - 1}"], rel=1e-6)
    assert fed.smoother.covariance(L(7))[0, 0] == pytest.approx(variance["l7"], rel=1e-6)


def test_drift_beyond_what_cholesky_takes_is_survived():
    """A pose uncertain by 20 m with millimetre steps: the plain solver gives up, the smoother agrees with algebra."""
    plain = gtsam.ISAM2()
    sigmas = np.array([20.0, 0.002])
    smoother = smoother_with(FOREVER_S, 1e-3, NEVER_M)
    wide, narrow = (gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-3] * 3 + [s] * 3)) for s in sigmas)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(3):
        factor = (
            gtsam.BetweenFactorPose3(X(k - 1), X(k), gtsam.Pose3(), narrow)
            if k
            else gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), wide)
        )
        graph.push_back(factor)
        values.insert(X(k), gtsam.Pose3())
        smoother.add_pose(X(k), gtsam.Pose3(), float(k))
        smoother.add([factor])
        smoother.update(float(k))
    with pytest.raises(RuntimeError, match="Indeterminate"):
        plain.update(graph, values)
    variance = sigmas[0] ** 2 + 2 * sigmas[1] ** 2
    assert smoother.covariance(X(2))[5, 5] == pytest.approx(variance, rel=1e-6)
    _, marginals = smoother.solve_history()
    assert marginals.marginalCovariance(X(2))[5, 5] == pytest.approx(variance, rel=1e-6)


@pytest.mark.parametrize(("shift_m", "is_due"), [(0.09, False), (0.11, True)])
def test_the_window_restarts_once_a_landmark_has_moved_by_the_stale_shift(monkeypatch, shift_m, is_due):
    sizes = counted_solves(monkeypatch)
    smoother = smoother_with(1e9, 1.0, 0.1)
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    smoother.add_pose(X(0), gtsam.Pose3(), 0.0)
    smoother.add([gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), tight)] * FIRST_RESTART)
    smoother.add_landmark(L(1), np.zeros(3))
    there = np.array([shift_m, 0.0, 0.0])
    smoother.add([gtsam.PriorFactorPoint3(L(1), there, gtsam.noiseModel.Isotropic.Sigma(3, 0.01))])
    smoother.update(0.0)
    assert bool(sizes) == is_due


def test_a_start_that_is_hardly_known_is_smoothed_to_the_end(monkeypatch):
    """100 m of doubt and millimetre odometry: Cholesky gives up, and the window stays with QR through its restarts."""
    sizes = counted_solves(monkeypatch)
    calibration_ = Calibration(start=Start(position_sigma_m=(100.0,) * 3))
    fed = Fed(30.0, stale_shift_m=1e-9)
    fed.smoother.add_pose(X(0), gtsam.Pose3(), 0.0)
    fed.add([factors.start_prior(X(0), calibration_)])
    cov, step = np.diag([1e-10] * 3 + [1e-6] * 3), gtsam.Pose3(gtsam.Rot3.Rz(0.02), np.array([0.1, 0.0, 0.0]))
    motion = PreintegratedMotion(step, cov, np.zeros((6, 3)), np.zeros(3), 1.0, np.zeros(3))
    truth, landmark = gtsam.Pose3(), np.array([3.0, 1.0, -1.0])
    fed.smoother.add_landmark(L(1), landmark + np.array([0.3, -0.2, 0.1]))
    for k in range(1, 100):
        truth = truth.compose(step)
        fed.smoother.add_pose(X(k), fed.smoother.values.atPose3(X(k - 1)).compose(step), float(k))
        q = truth.compose(SONAR).transformTo(landmark)
        z = np.array([np.linalg.norm(q), np.arctan2(q[1], q[0])])
        fed.add([factors.odometry(X(k - 1), X(k), motion)])
        fed.add(factors.landmark_sighting(X(k), L(1), SONAR, z, np.diag([4e-4, 8e-5]), plain, 0.3 if k == 1 else None))
        fed.smoother.update(float(k))
    assert len(sizes) > 2
    assert np.linalg.norm(fed.smoother.values.atPose3(X(99)).translation() - truth.translation()) < 0.05
