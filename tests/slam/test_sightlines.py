"""Landmarks behind the sonar that saw them are found and started where their sightings say."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from sonar_graph.slam.models import factors
from sonar_graph.slam.smoother.batch_solution import Sightline, Sightlines, solve

from .made import smoother_with

BODY_T_SONAR = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, 0.4, 0.0), np.array([0.8, 0.1, -0.2]))
POSE = gtsam.Pose3(gtsam.Rot3.Ypr(2.0, 0.05, -0.03), np.array([3.0, -4.0, -1.0]))
Z = np.array([2.0, 0.3])


def world_point(range_m: float, azimuth_rad: float) -> np.ndarray:
    """On the fan's centre plane, seen from the sonar."""
    in_fan = [range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad), 0.0]
    return POSE.compose(BODY_T_SONAR).transformFrom(np.array(in_fan))


def one_pose(landmark: np.ndarray) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(X(0), POSE)
    values.insert(L(1), landmark)
    return values


def seen(*sightings: np.ndarray) -> Sightlines:
    lines = Sightlines()
    for z in sightings:
        lines.add(L(1), Sightline(X(0), BODY_T_SONAR, z))
    return lines


@pytest.mark.parametrize(
    ("off_rad", "is_behind"), [(0.0, False), (1.5, False), (-1.5, False), (1.7, True), (3.1, True)]
)
def test_behind_begins_at_a_right_angle_to_what_was_measured(off_rad, is_behind):
    values = one_pose(world_point(5.0, Z[1] + off_rad))
    assert seen(Z).turned_away(values) == ([L(1)] if is_behind else [])


def test_the_camera_of_the_azimuth_factor_goes_blind_exactly_there():
    camera = factors.landmark_sighting(X(0), L(1), BODY_T_SONAR, Z, np.diag([1e-4, 1e-4]), lambda noise: noise)[0]
    for off_rad in np.linspace(-3, 3, 25):
        values = one_pose(world_point(5.0, Z[1] + off_rad))
        is_blind = not np.any(camera.linearize(values).jacobian()[0])
        assert bool(seen(Z).turned_away(values)) == is_blind


def test_a_sighting_that_is_taken_away_no_longer_counts():
    values = one_pose(world_point(5.0, Z[1]))
    opposite = np.array([2.0, Z[1] + np.pi])
    lines = seen(Z, opposite)
    extra = Sightline(X(0), BODY_T_SONAR, opposite)
    lines.add(L(1), extra)
    assert lines.turned_away(values) == [L(1)]
    lines.remove(L(1), extra)
    lines.add(L(1), Sightline(X(0), BODY_T_SONAR, Z))
    assert lines.turned_away(values) == []
    alone = Sightline(X(0), BODY_T_SONAR, opposite)
    lines.add(L(2), alone)
    lines.remove(L(2), alone)
    assert lines.turned_away(values) == []


def test_a_landmark_that_most_sightings_have_ahead_is_left_alone():
    values = one_pose(world_point(5.0, Z[1]))
    opposite = np.array([2.0, Z[1] + np.pi])
    assert seen(Z, Z, opposite).turned_away(values) == []
    assert seen(Z, opposite, opposite).turned_away(values) == [L(1)]


def test_a_landmark_is_placed_where_most_of_its_sightings_say():
    lines = seen(Z, Z, np.array([9.0, -1.0]))
    placed = lines.placed_anew(one_pose(np.zeros(3)), [L(1)])
    assert placed.atPoint3(L(1)) == pytest.approx(world_point(*Z))
    assert placed.atPose3(X(0)).equals(POSE, 1e-12)


def test_a_landmark_stuck_behind_comes_round_in_the_solution_of_the_history():
    smoother = smoother_with(lag_s=10.0, relinearize_threshold=1e-3, stale_shift_m=0.1)
    smoother.add_pose(X(0), POSE, 0.0)
    smoother.add([gtsam.PriorFactorPose3(X(0), POSE, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3))])
    smoother.add_landmark(L(1), world_point(1.9, Z[1] + 0.9 * np.pi))
    cov = np.diag([1e-4, 1e-4])
    smoother.add(factors.landmark_sighting(X(0), L(1), BODY_T_SONAR, Z, cov, lambda noise: noise, 0.07))
    stuck = solve(smoother.graph, smoother.values)
    assert np.linalg.norm(stuck.atPoint3(L(1)) - world_point(*Z)) > 3.0
    smoother.sightlines.add(L(1), Sightline(X(0), BODY_T_SONAR, Z))
    values, _ = smoother.solve_history()
    assert values.atPoint3(L(1)) == pytest.approx(world_point(*Z), abs=1e-6)
    assert smoother.graph.error(values) == pytest.approx(0.0, abs=1e-9)


def test_a_new_start_that_ends_higher_is_not_taken():
    """One sharp sighting ahead against two dull ones behind: most lie behind, yet the landmark is where it is best."""
    smoother = smoother_with(lag_s=10.0, relinearize_threshold=1e-3, stale_shift_m=0.1)
    smoother.add_pose(X(0), POSE, 0.0)
    smoother.add([gtsam.PriorFactorPose3(X(0), POSE, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3))])
    smoother.add_landmark(L(1), world_point(*Z))
    opposite = np.array([2.0, Z[1] + 0.95 * np.pi])
    for z, sigma in ((Z, 1e-3), (opposite, 0.3), (opposite, 0.3)):
        smoother.add(factors.landmark_sighting(X(0), L(1), BODY_T_SONAR, z, np.eye(2) * sigma**2, lambda n: n, 0.07))
        smoother.sightlines.add(L(1), Sightline(X(0), BODY_T_SONAR, z))
    assert smoother.sightlines.turned_away(smoother.values) == [L(1)]
    elsewhere = solve(smoother.graph, smoother.sightlines.placed_anew(smoother.values, [L(1)]))
    values, _ = smoother.solve_history()
    assert np.linalg.norm(elsewhere.atPoint3(L(1)) - world_point(*Z)) > 1.0
    assert np.linalg.norm(values.atPoint3(L(1)) - world_point(*Z)) < 0.01
    assert smoother.graph.error(values) < smoother.graph.error(elsewhere)
