"""Batch solutions against GTSAM's own optimiser, and landmarks stuck behind a sonar."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from sonar_graph.slam import factors
from sonar_graph.slam.smoother import FactorGroup, Sightline, Smoother, solve
from sonar_graph.slam.smoother.batch_solution import misplaced, placed_again
from sonar_graph.slam.smoother.factor_store import Sightlines

from .fed import FOREVER_S, SONAR, in_the_basin
from .graphs import gtsams_solution
from .made import (
    cauchy,
    graph_of,
    huber,
    plain,
    pose_prior,
    scattered,
    smoother_with,
)


def round_trip(
    seed: int, kernel=plain
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A noisy graph of a vehicle on a circle, and values that are far from its solution."""
    fed = in_the_basin(12, FOREVER_S, seed=seed, kernel=kernel)
    sigmas = {"x": 0.2, "l": 0.3, "b": 0.0}
    return graph_of(fed.given), scattered(
        fed.smoother.values, np.random.default_rng(seed), sigmas
    )


@pytest.mark.parametrize("kernel", [plain, huber])
@pytest.mark.parametrize("seed", range(4))
def test_the_solution_costs_what_gtsams_own_optimiser_finds(seed, kernel):
    graph, initial = round_trip(seed, kernel)
    ours = solve(graph, initial)
    theirs = gtsams_solution(graph, initial)
    assert graph.error(initial) > 100 * graph.error(theirs)
    assert graph.error(ours) == pytest.approx(graph.error(theirs), rel=1e-6)
    assert ours.atPose3(X(11)).equals(theirs.atPose3(X(11)), 1e-3)


def test_damping_recovers_from_an_indeterminate_step():
    """A landmark behind the camera has no derivative at all; the rest is solved all the same."""
    graph, initial = round_trip(2)
    graph.push_back(
        factors.landmark_sighting(
            X(0), L(9), SONAR, np.array([2.0, 0.0]), np.eye(2), plain
        )["azimuth"]
    )
    initial.insert(L(9), SONAR.transformFrom(np.array([-2.0, 0.0, 0.0])))
    with pytest.raises(RuntimeError):
        graph.linearize(initial).optimize()
    final = solve(graph, initial)
    rest, start = round_trip(2)
    assert rest.error(final) == pytest.approx(
        rest.error(gtsams_solution(rest, start)), rel=1e-4
    )


BODY_T_SONAR = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, 0.4, 0.0), np.array([0.8, 0.1, -0.2]))
POSE = gtsam.Pose3(gtsam.Rot3.Ypr(2.0, 0.05, -0.03), np.array([3.0, -4.0, -1.0]))
Z = np.array([2.0, 0.3])


def world_point(range_m: float, azimuth_rad: float) -> np.ndarray:
    """On the fan's centre plane, seen from the sonar."""
    in_fan = np.array(
        [range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad), 0.0]
    )
    return POSE.compose(BODY_T_SONAR).transformFrom(in_fan)


def smoother_at(
    landmark: np.ndarray, *sightings: tuple[np.ndarray, float], kernel=plain
) -> Smoother:
    """A known pose, and sightings of a landmark with their sigmas."""
    smoother = smoother_with(lag_s=10.0, relinearize_threshold=1e-3, stale_shift_m=0.1)
    smoother.add_pose(X(0), POSE, 0.0)
    smoother.add({"prior": pose_prior(X(0), POSE, 1e-3)})
    smoother.add_landmark(L(1), landmark)
    for z, sigma in sightings:
        made = factors.landmark_sighting(
            X(0), L(1), BODY_T_SONAR, z, np.eye(2) * sigma**2, kernel, 0.07
        )
        smoother.add(FactorGroup(made, (L(1), Sightline(X(0), BODY_T_SONAR, z))))
    return smoother


def seen(*sightings: np.ndarray) -> Sightlines:
    return {L(1): [Sightline(X(0), BODY_T_SONAR, z) for z in sightings]}


@pytest.mark.parametrize("wrong", [4, 6])
def test_a_few_wrong_first_sightings_do_not_hold_a_landmark(
    wrong,
):
    """By a kernel that saturates, and twelve right sightings 40 m away; the same ones without a kernel need no help."""
    rng = np.random.default_rng(wrong)
    far = np.array([42.0, Z[1] + 0.4])
    right = [Z + 0.01 * rng.standard_normal(2) for _ in range(12)]
    sightings = [*(far + 0.01 * rng.standard_normal(2) for _ in range(wrong)), *right]
    smoother = smoother_at(
        world_point(*far), *((z, 0.02) for z in sightings), kernel=cauchy
    )
    lines = seen(*sightings)
    stuck = solve(smoother.graph, smoother.values)
    assert misplaced(stuck, lines) == [L(1)]
    assert np.linalg.norm(stuck.atPoint3(L(1)) - world_point(*far)) < 5.0
    values, _ = smoother.solve_history()
    assert np.linalg.norm((values.atPoint3(L(1)) - world_point(*Z))[:2]) < 0.1
    assert smoother.graph.error(values) < smoother.graph.error(stuck)
    assert misplaced(values, lines) == []


def test_a_new_start_that_ends_higher_is_not_taken():
    """One sharp sighting ahead against two dull ones behind: most lie behind, yet the landmark is where it is best."""
    opposite = np.array([2.0, Z[1] + 0.95 * np.pi])
    smoother = smoother_at(world_point(*Z), (Z, 1e-3), (opposite, 0.3), (opposite, 0.3))
    lines = seen(Z, opposite, opposite)
    assert misplaced(smoother.values, lines) == [L(1)]
    elsewhere = solve(smoother.graph, placed_again(smoother.values, lines, [L(1)]))
    values, _ = smoother.solve_history()
    assert np.linalg.norm(elsewhere.atPoint3(L(1)) - world_point(*Z)) > 1.0
    assert np.linalg.norm(values.atPoint3(L(1)) - world_point(*Z)) < 0.01
    assert smoother.graph.error(values) < smoother.graph.error(elsewhere)
