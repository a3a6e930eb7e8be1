"""Batch solutions against GTSAM's own optimiser, and landmarks stuck behind a sonar."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from sonar_graph.slam import factors
from sonar_graph.slam.smoother import Marginals, Smoother, batch_solution
from sonar_graph.slam.smoother.batch_solution import (
    misplaced,
    placed_again,
    solve,
    solve_in_sight,
)
from sonar_graph.slam.smoother.factor_store import Sightline, Sightlines

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
    values_of,
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
    ours, theirs = solve(graph, initial), gtsams_solution(graph, initial)
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


def test_where_nothing_lowers_the_error_the_initial_values_are_returned():
    def unwise(_, values, jacobians):
        """A derivative of the wrong sign: every step, however short, goes up."""
        if jacobians is not None:
            jacobians[0] = -np.eye(3)
        return values.atPoint3(L(0))

    initial = values_of(L0=np.ones(3))
    graph = graph_of(
        [gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), [L(0)], unwise)]
    )
    assert solve(graph, initial).equals(initial, 0.0)


def after_a_lost_heading(
    lost_rad: float = 0.2,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Two keyframes that know each other's heading to 2e-5 rad, after a turn that is not known as well."""
    step, places = (
        gtsam.Pose3(gtsam.Rot3.Yaw(0.2), np.array([1.0, 0.1, 0.05])),
        {0: (4, 1, 0.5), 1: (4, -1, 0.3)},
    )
    poses = [gtsam.Pose3(), step, step.compose(step)]
    graph, values = graph_of([pose_prior(X(0), poses[0], 0.01)]), gtsam.Values()
    for k, (turn_rad, way_m) in enumerate([(lost_rad, 0.2), (2e-5, 0.01)]):
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([turn_rad, way_m], 3))
        graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), step, noise))
    for k, pose in enumerate(poses):
        values.insert(X(k), pose)
    for landmark, place in places.items():
        values.insert(L(landmark), np.array(place, dtype=float))
        for k in (1, 2):
            seen_at, noise = (
                poses[k].transformTo(values.atPoint3(L(landmark))),
                gtsam.noiseModel.Isotropic,
            )
            z = gtsam.Unit3(seen_at), float(np.linalg.norm(seen_at))
            graph.add(
                gtsam.BearingRangeFactor3D(X(k), L(landmark), *z, noise.Sigma(3, 0.03))
            )
    return graph, values


@pytest.mark.parametrize("lost_rad", [0.2, 2.0])
def test_marginals_that_cholesky_refuses_are_those_of_the_whole_information_matrix(
    lost_rad,
):
    graph, values = after_a_lost_heading(lost_rad)
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(graph.linearize(values))
    A, _ = graph.linearize(values).jacobian(ordering)
    scale = 1.0 / np.linalg.norm(A, axis=0)
    inverse = np.linalg.pinv(A * scale) * scale[:, None]
    sizes = [
        6 if gtsam.symbolChr(key) == ord("x") else 3
        for key in map(ordering.at, range(ordering.size()))
    ]
    blocks = np.split(inverse, np.cumsum(sizes)[:-1])
    ours = Marginals(graph, values)
    for key, block in zip(
        map(ordering.at, range(ordering.size())), blocks, strict=True
    ):
        expected = block @ block.T
        np.testing.assert_allclose(
            ours.marginalCovariance(key), expected, rtol=1e-5, atol=1e-9
        )
        np.testing.assert_allclose(
            ours.jointMarginalCovariance([key]).fullMatrix(),
            expected,
            rtol=1e-5,
            atol=1e-9,
        )


def test_cholesky_refuses_these_marginals_when_they_are_made_or_when_it_is_asked():
    graph, values = after_a_lost_heading(2.0)
    with pytest.raises(RuntimeError, match="Indeterminate"):
        gtsam.Marginals(graph.linearize(values), values)
    graph, values = after_a_lost_heading(0.2)
    by_cholesky = gtsam.Marginals(graph.linearize(values), values)
    for key in (L(0), L(1)):
        with pytest.raises(RuntimeError, match="Indeterminate"):
            by_cholesky.marginalCovariance(key)


def test_what_was_asked_before_changes_no_marginal():
    graph, values = after_a_lost_heading()
    asked_first = Marginals(graph, values)
    asked_last = Marginals(graph, values)
    first = {
        key: asked_first.marginalCovariance(key) for key in (L(0), L(1), X(0), X(2))
    }
    last = {key: asked_last.marginalCovariance(key) for key in (X(2), X(0), L(1), L(0))}
    for key, cov in first.items():
        np.testing.assert_array_equal(cov, last[key])


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
        smoother.add(made, (L(1), Sightline(X(0), BODY_T_SONAR, z)))
    return smoother


def seen(*sightings: np.ndarray) -> Sightlines:
    return {L(1): [Sightline(X(0), BODY_T_SONAR, z) for z in sightings]}


def test_behind_begins_at_a_right_angle_to_what_was_measured_where_the_azimuths_camera_goes_blind():
    camera = factors.landmark_sighting(
        X(0), L(1), BODY_T_SONAR, Z, np.diag([1e-4, 1e-4]), plain
    )["azimuth"]
    for off_rad in [*np.linspace(-3, 3, 25), -1.57, 1.57, 1.572]:
        values, is_behind = (
            values_of(X0=POSE, L1=world_point(5.0, Z[1] + off_rad)),
            abs(off_rad) > np.pi / 2,
        )
        assert misplaced(values, seen(Z)) == ([L(1)] if is_behind else [])
        assert np.any(camera.linearize(values).jacobian()[0]) != is_behind


def test_a_landmark_is_turned_away_where_at_least_half_of_its_sightings_have_it_behind():
    values, opposite = (
        values_of(X0=POSE, L1=world_point(*Z)),
        np.array([2.0, Z[1] + np.pi]),
    )
    assert misplaced(values, seen(Z, opposite)) == [L(1)]
    assert misplaced(values, seen(Z, opposite, Z)) == []


def test_a_landmark_is_placed_where_most_of_its_sightings_say():
    placed = placed_again(
        values_of(X0=POSE, L1=np.zeros(3)), seen(Z, Z, np.array([9.0, -1.0])), [L(1)]
    )
    assert placed.atPoint3(L(1)) == pytest.approx(world_point(*Z))
    assert placed.atPose3(X(0)).equals(POSE, 1e-12)


def test_a_landmark_stuck_behind_comes_round_in_the_solution_of_the_history():
    smoother = smoother_at(world_point(1.9, Z[1] + 0.9 * np.pi), (Z, 0.01))
    stuck = solve(smoother.graph, smoother.values)
    assert np.linalg.norm(stuck.atPoint3(L(1)) - world_point(*Z)) > 3.0
    values, _ = smoother.solve_history()
    assert values.atPoint3(L(1)) == pytest.approx(world_point(*Z), abs=1e-6)
    assert smoother.graph.error(values) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("wrong", [4, 6])
def test_a_landmark_that_a_few_wrong_sightings_began_comes_to_the_many_right_ones(
    wrong: int,
):
    """By a kernel that saturates, and twelve right sightings 40 m away; the same ones without a kernel need no help."""
    rng, far = np.random.default_rng(wrong), np.array([42.0, Z[1] + 0.4])
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


@pytest.mark.parametrize("most", [1, 2, 4])
def test_a_solution_tries_no_more_steps_than_two_descents_may(most, monkeypatch):
    """Sightlines astern of a sonar that looks ahead: landmarks stay behind, and each new start ends lower."""
    tried = []
    step = batch_solution.damped_step
    monkeypatch.setattr(batch_solution, "placed_again", lambda values, *_: values)
    monkeypatch.setattr(
        batch_solution, "damped_step", lambda *given: tried.append(1) or step(*given)
    )
    graph, initial = round_trip(1)
    astern = [Sightline(X(k), SONAR, np.array([2.0, np.pi])) for k in range(12)]
    lines = {key: astern for key in initial.keys() if gtsam.symbolChr(key) == ord("l")}  # noqa: SIM118
    freely = solve_in_sight(graph, initial, lines)
    needed = len(tried)
    tried.clear()
    monkeypatch.setattr(batch_solution, "MAX_STEPS", most)
    bounded = solve_in_sight(graph, initial, lines)
    assert most <= len(tried) <= 2 * most < needed
    assert graph.error(freely) < graph.error(bounded) < graph.error(initial)
