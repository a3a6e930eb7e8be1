"""Watches weighed: the error is linear in the weights, and with all weights 1 the graph is the one that is chosen."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.slam.landmarks.association import IdentityPosterior
from sonar_graph.slam.landmarks.mixture import TrackedObject
from sonar_graph.slam.landmarks.mixture_history import LEAST_WEIGHT, WeighedHistory, earliest
from sonar_graph.slam.landmarks.sighting import Sighting, SightingFactors
from sonar_graph.slam.smoother.batch_solution import Sightline, solve

MAKER = SightingFactors(SonarCalibration(elevation_aperture_rad=0.3), lambda noise: noise)
MOUNTED = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.4, 0.0), np.array([0.3, 0.0, -0.1]))
IDS = [7, 9, 7, 9]
NOISE = {"independent": np.diag([4e-4, 1e-4]), "correlated": np.array([[4e-4, 1e-4], [1e-4, 1e-4]])}
FLOORS = {"floor": FloorPrior(z_m=-1.0, sigma_m=0.05), "no floor": None}


def history(noise: str, floor: str):
    """Two landmarks, two watches each of three sightings; the earliest of landmark 7 is in its second watch."""
    rng = np.random.default_rng(1)
    values, rest = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for k in range(3):
        pose = gtsam.Pose3.Expmap(0.1 * rng.standard_normal(6))
        values.insert(X(k), pose)
        rest.push_back(gtsam.PriorFactorPose3(X(k), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 0.1)))
    for landmark_id in set(IDS):
        values.insert(L(landmark_id), np.array([3.0, 0.2, -1.0]) + 0.1 * rng.standard_normal(3))
    watches = []
    for row, _ in enumerate(IDS):
        z = np.array([3.0, 0.1]) + 0.02 * rng.standard_normal((3, 2))
        sightings = [
            Sighting(100 - 10 * row + k, row, Sightline(X(k), MOUNTED, z[k]), NOISE[noise], FLOORS[floor])
            for k in range(3)
        ]
        watches.append(TrackedObject(IdentityPosterior({}), sightings))
    return rest, watches, values


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("noise", NOISE)
def test_each_watch_counts_by_its_weight_and_the_beginning_of_landmarks_in_full(noise: str, floor: str) -> None:
    rest, watches, values = history(noise, floor)
    weighed = WeighedHistory(rest, watches, IDS, MAKER)
    first = {7: watches[2].sightings[0], 9: watches[3].sightings[0]}
    said_once = rest.error(values) + sum(
        factor.error(values) for i, sighting in first.items() for factor in MAKER.beginning(sighting, L(i))
    )
    alone = [
        sum(factor.error(values) for sighting in watch.sightings for factor in MAKER.measured(sighting, L(i)))
        for watch, i in zip(watches, IDS, strict=True)
    ]
    for weights in ([1.0, 1.0, 1.0, 1.0], [0.0, 1.0, 0.3, 0.02], [0.5, 0.25, 0.0, 0.9]):
        expected = said_once + np.maximum(weights, LEAST_WEIGHT) @ alone
        assert weighed.graph(np.array(weights)).error(values) == pytest.approx(expected, rel=1e-9)


def test_a_watch_of_no_weight_moves_a_landmark_by_micrometres_and_holds_its_own() -> None:
    rest, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    rest.push_back(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    values.insert(X(0), gtsam.Pose3())
    watches = []
    for row, (landmark_id, range_m) in enumerate([(7, 3.0), (7, 4.0), (9, 5.0)]):
        line = Sightline(X(0), gtsam.Pose3(), np.array([range_m, 0.0]))
        watches.append(TrackedObject(IdentityPosterior({}), [Sighting(row, row, line, NOISE["independent"], None)]))
        if not values.exists(L(landmark_id)):
            values.insert(L(landmark_id), np.array([range_m, 0.0, 0.0]))
    found = solve(WeighedHistory(rest, watches, [7, 7, 9], MAKER).graph(np.array([1.0, 0.0, 0.0])), values)
    assert np.linalg.norm(found.atPoint3(L(7))) == pytest.approx(3.0, abs=1e-5)
    assert np.linalg.norm(found.atPoint3(L(9))) == pytest.approx(5.0, abs=1e-5)


def test_of_sightings_of_one_frame_the_earliest_is_the_first_in_the_journal() -> None:
    line = Sightline(X(0), MOUNTED, np.array([3.0, 0.1]))
    watches = [
        TrackedObject(IdentityPosterior({}), [Sighting(100, row, line, NOISE["independent"], None)])
        for row in (5, 3, 4)
    ]
    assert earliest(watches, [7, 7, 7])[7].row == 3


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("noise", NOISE)
def test_with_all_weights_one_it_is_the_history_as_it_is_made(noise: str, floor: str) -> None:
    rest, watches, values = history(noise, floor)
    made = gtsam.NonlinearFactorGraph(rest)
    for watch, i in zip(watches, IDS, strict=True):
        for sighting in watch.sightings:
            is_first = sighting in (watches[2].sightings[0], watches[3].sightings[0])
            for factor in MAKER.make(sighting, L(i), is_first=is_first):
                made.push_back(factor)
    weighed = WeighedHistory(rest, watches, IDS, MAKER).graph(np.ones(4))
    expected, found = (graph.linearize(values) for graph in (made, weighed))
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(made)
    for theirs, ours in zip(expected.hessian(ordering), found.hessian(ordering), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6)
