"""Window and history against least squares on the rail and batch solutions in the basin."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from sonar_graph.models import RobustKernel
from sonar_graph.slam import factors
from sonar_graph.slam.smoother import (
    FactorGroup,
    Sightline,
    batch_solution,
    solve,
)
from sonar_graph.slam.smoother.factor_store import graph_of as graph_of_groups
from sonar_graph.slam.smoother.window import Thresholds, WholeWindow

from .fed import (
    FOREVER_S,
    NEVER_M,
    SONAR,
    assert_is_least_squares,
    in_the_basin,
    on_the_rail,
    ranged,
)
from .made import (
    counted,
    graph_of,
    isotropic,
    plain,
    point_prior,
    polar,
    pose_prior,
    smoother_with,
    values_of,
)
from .rail import STEP_S, Rail, rail

NODES = 21


END_S = (NODES - 1) * STEP_S

_, NUMBERS = rail(NODES)


def with_ranges(gone: list[tuple[int, int]], *new: tuple[int, int, float]) -> Rail:
    """The rail without ranges, by node and landmark, and with others."""
    return Rail(
        NUMBERS.displacements_m,
        [*(r for r in NUMBERS.ranges if r[:2] not in gone), *new],
    )


class Refusing:
    """A solver whose elimination fails while the estimate settles."""

    def __init__(self, solver: gtsam.ISAM2) -> None:
        self.solver = solver

    def update(self, graph: gtsam.NonlinearFactorGraph, *rest) -> gtsam.ISAM2Result:
        if not graph.size() and not rest[1]:
            raise RuntimeError("Indeterminant linear system detected")
        return self.solver.update(graph, *rest)

    def __getattr__(self, name: str):
        return getattr(self.solver, name)


@pytest.mark.parametrize("gives_up", [False, True])
def test_after_an_exchange_the_estimate_is_that_of_what_is_left(monkeypatch, gives_up):
    """Of six sightings that put a landmark a metre off, also when Cholesky gives up, a thousandth is left."""
    fed = in_the_basin(15, FOREVER_S)
    wrong: list[int] = []
    for k in range(9, 15):
        values = fed.smoother.values
        z = polar(values.atPose3(X(k)).compose(SONAR), values.atPoint3(L(3)))
        z += np.array([2.0, 0.5])
        R = np.diag([1e-4, 1e-4])
        new = factors.landmark_sighting(X(k), L(3), SONAR, z, R, plain)
        wrong.append(fed.smoother.add(new))
    for _ in range(5):
        fed.smoother.update(14.0)
    right = solve(graph_of(fed.given), fed.smoother.values).atPoint3(L(3))
    off_m = [np.linalg.norm(fed.smoother.values.atPoint3(L(3)) - right)]
    solved = counted(monkeypatch, batch_solution, "descended")
    if gives_up:
        fed.smoother._window.isam = Refusing(fed.smoother._window.isam)
    fed.smoother.exchange(14.0, wrong)
    off_m.append(np.linalg.norm(fed.smoother.values.atPoint3(L(3)) - right))
    assert solved or not gives_up
    assert off_m[0] > 0.5
    assert off_m[1] < 1e-3 * off_m[0]


@pytest.mark.parametrize("later_s", [0.0, 0.1])
def test_a_hold_that_is_over_ends_after_an_exchange(later_s):
    """A bounded window keeps its variables while factors are exchanged, and marginalises them at the next update.

    The end is least squares, with a range on the keyframe that was held exchanged for another.
    """
    late = (3, 4, 24.0)
    waiting = (NODES - 1, 4, 30.0)
    fed = on_the_rail(NODES, 1.1, held={X(3): FOREVER_S}, is_bounded=True)
    numbers = with_ranges([(3, 4)], late, waiting)
    removed = fed.handles_on(X(3), L(4))
    fed.add(ranged(*waiting))
    fed.smoother.hold({})
    fed.smoother.exchange(END_S + later_s, removed, [FactorGroup(ranged(*late))])
    assert fed.smoother.in_window([X(3)]) == [X(3)]
    assert_is_least_squares(fed, numbers, NODES)
    fed.smoother.update(END_S + later_s)
    assert not fed.smoother.in_window([X(3)])
    assert_is_least_squares(fed, numbers, NODES)


def test_drift_beyond_what_cholesky_takes_is_survived():
    """A pose uncertain by 20 m with millimetre steps: the plain solver gives up, the smoother agrees with algebra."""
    smoother = smoother_with(FOREVER_S, 1e-3, NEVER_M)
    sigmas = np.array([20.0, 0.002])
    wide, narrow = (
        gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-3] * 3 + [s] * 3)) for s in sigmas
    )
    steps = [
        gtsam.BetweenFactorPose3(X(k), X(k + 1), gtsam.Pose3(), narrow)
        for k in range(2)
    ]
    given = [gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), wide), *steps]
    for k, factor in enumerate(given):
        smoother.add_pose(X(k), gtsam.Pose3(), float(k))
        smoother.add({"chain": factor})
        smoother.update(float(k))
    with pytest.raises(RuntimeError, match="Indeterminate"):
        gtsam.ISAM2().update(graph_of(given), smoother.values)
    variance = sigmas[0] ** 2 + 2 * sigmas[1] ** 2
    assert smoother.marginals.marginalCovariance(X(2))[5, 5] == pytest.approx(
        variance, rel=1e-6
    )
    assert smoother.solve_history()[1].marginalCovariance(X(2))[5, 5] == pytest.approx(
        variance, rel=1e-6
    )


@pytest.mark.parametrize(("shift_m", "is_due"), [(0.09, False), (0.11, True)])
def test_a_bounded_window_restarts_when_a_landmark_has_moved(
    monkeypatch, shift_m, is_due
):
    solved = counted(monkeypatch, batch_solution, "descended")
    smoother = smoother_with(1e9, 1.0, 0.1, is_bounded=True)
    smoother.add_pose(X(0), gtsam.Pose3(), 0.0)
    smoother.add({"prior": pose_prior(X(0), gtsam.Pose3(), 1e-6)})
    smoother.add_landmark(L(1), np.zeros(3))
    smoother.add({"prior": point_prior(L(1), [shift_m, 0.0, 0.0], 0.01)})
    smoother.update(0.0)
    assert bool(solved) == is_due


def seen_from_origin(landmark: int, z: np.ndarray) -> FactorGroup:
    """One robust sighting from the first keyframe, with a prior that keeps the landmark determined."""
    key = L(landmark)
    noise = np.diag(np.square([0.1, 0.02]))
    made = factors.landmark_sighting(
        X(0), key, gtsam.Pose3(), z, noise, RobustKernel().robust()
    )
    made["prior"] = point_prior(key, np.array([10.0, 0.0, 0.0]), 5.0)
    return FactorGroup(made, (key, Sightline(X(0), gtsam.Pose3(), z)))


def test_sightings_in_one_factor_keep_their_information():
    """Ten sightings of two landmarks from one keyframe, with robust kernels; then two leave, and three of a factor stay."""
    rng = np.random.default_rng(3)
    z = np.array([10.0, 0.1]) + rng.normal(0.0, [0.2, 0.04], (10, 2))
    groups = {k: seen_from_origin(k % 2, polar) for k, polar in enumerate(z)}
    values = values_of(
        X0=gtsam.Pose3(), L0=np.array([10.0, 1.0, 0.0]), L1=np.array([10.0, 1.2, 0.0])
    )
    groups[10] = FactorGroup({"prior": pose_prior(X(0), gtsam.Pose3(), 0.1)})
    window = WholeWindow(Thresholds(1e-9, 1e-9))
    window.update(groups, values, removed=(), relinearises=True)
    assert window.isam.getFactorsUnsafe().nrFactors() == 3
    ordering = gtsam.Ordering([X(0), L(0), L(1)])
    for removed in ((), (3, 5)):
        window.update({}, gtsam.Values(), removed=removed, relinearises=True)
        for handle in removed:
            del groups[handle]
        held = window.isam.getFactorsUnsafe().linearize(values)
        apart = graph_of_groups(groups.values()).linearize(values)
        np.testing.assert_allclose(
            held.augmentedHessian(ordering),
            apart.augmentedHessian(ordering),
            rtol=1e-12,
            atol=1e-9,
        )


@pytest.mark.parametrize("is_wild", [True, False])
def test_an_update_that_makes_the_error_larger_is_undone(monkeypatch, is_wild):
    """Gauss-Newton on ``atan x`` leaps away from 0 where it starts beyond 1.39, and converges below it."""
    solved = counted(monkeypatch, batch_solution, "descended")
    smoother = smoother_with(FOREVER_S, 1e-9, NEVER_M)

    def error(_, values, jacobians):
        x = values.atPose3(X(0)).x()
        if jacobians is not None:
            jacobians[0] = np.array([[0.0, 0.0, 0.0, 1.0 / (1.0 + x * x), 0.0, 0.0]])
        return np.array([np.arctan(x)])

    start = gtsam.Pose3(gtsam.Rot3(), np.array([3.0 if is_wild else 1.2, 0.0, 0.0]))
    smoother.add_pose(X(0), start, 0.0)
    smoother.add({"prior": pose_prior(X(0), start, 1e3)})
    smoother.add({"bend": gtsam.CustomFactor(isotropic(1, 1e-2), [X(0)], error)})
    smoother.update(0.0)
    assert bool(solved) == is_wild
    assert abs(smoother.values.atPose3(X(0)).x()) < 0.5
