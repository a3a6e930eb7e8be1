"""Sightings in the graph whatever came and went, and the points that they place."""

import math

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.measurements import Floats
from sonar_graph.slam.landmarks import AmendableJournal, LandmarkGraph, SightingFactors
from sonar_graph.slam.landmarks.landmark_graph import Assignment
from sonar_graph.slam.landmarks.sighting import Sighting
from sonar_graph.slam.landmarks.unknown import place
from sonar_graph.slam.smoother import Sightline
from sonar_graph.states import Outcome

from .made import graph_of, plain, polar, pose_prior, smoother_with, values_of

POSES = 5


PLACES = {7: np.array([3.0, 0.5, -0.8]), 9: np.array([3.0, -0.4, -0.8])}


APERTURE_RAD = 0.3
MAKER = SightingFactors(SonarCalibration(elevation_aperture_rad=APERTURE_RAD), plain)
NOISE = np.diag([0.02**2, 0.01**2])


FLOOR = FloorPrior(z_m=-0.8, sigma_m=0.05)


def begun() -> LandmarkGraph:
    """Keyframes whose poses are known, and no landmark yet."""
    smoother = smoother_with(1e9, 0.1, 1e9)
    for k in range(POSES):
        pose = gtsam.Pose3(
            gtsam.Rot3.Ypr(0.1 * k, 0.2, 0.0), np.array([0.2 * k, 0.1 * k, 0.0])
        )
        smoother.add_pose(X(k), pose, float(k))
        smoother.add({"prior": pose_prior(X(k), pose, 0.01)})
    smoother.update(float(POSES))
    return LandmarkGraph(smoother, MAKER, AmendableJournal())


def sighting_of(
    landmark_id: int, k: int, floor: FloorPrior | None, landmarks: LandmarkGraph
) -> Sighting:
    z = polar(landmarks.smoother.values.atPose3(X(k)), PLACES[landmark_id])
    row = landmarks.journal.record(k, landmark_id, Outcome.WAITING)
    sighting = Sighting(k, row, Sightline(X(k), gtsam.Pose3(), z), NOISE, floor)
    landmarks.apply([Assignment(sighting, Outcome.WAITING)], float(POSES))
    return sighting


def change(
    landmarks: LandmarkGraph, changes: list[tuple[Sighting, int | None]]
) -> None:
    """Give sightings to landmarks, or to none."""
    later = {Outcome.WAITING: Outcome.USED_LATER}
    landmarks.apply(
        [
            Assignment(
                s,
                later.get(landmarks.state(s).outcome, Outcome.MOVED)
                if i
                else Outcome.TAKEN_BACK,
                i,
            )
            for s, i in changes
        ],
        float(POSES),
    )


def errors(
    graph: gtsam.NonlinearFactorGraph, ids: list[int], landmarks: LandmarkGraph
) -> list[float]:
    rng = np.random.default_rng(0)
    found = []
    for _ in range(4):
        values = gtsam.Values()
        for k in range(POSES):
            pose = landmarks.smoother.values.atPose3(X(k))
            values.insert(
                X(k), pose.compose(gtsam.Pose3.Expmap(0.1 * rng.standard_normal(6)))
            )
        for i in PLACES:
            point = PLACES[i] + 0.3 * rng.standard_normal(3)
            if i in ids:
                values.insert(L(i), point)
        found.append(graph.error(values))
    return found


@pytest.mark.parametrize("floor", [None, FLOOR], ids=["no floor", "floor"])
@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.lists(st.sampled_from([7, 9, None]), min_size=POSES, max_size=POSES),
        min_size=1,
        max_size=3,
    )
)
def test_whatever_came_and_went_the_graph_is_that_of_what_is_left(
    floor: FloorPrior | None, stages: list
) -> None:
    """Each stage gives each sighting to a landmark or none; the first to come is often not the earliest."""
    landmarks = begun()
    seen = [sighting_of(7, k, floor, landmarks) for k in range(POSES)]
    of = dict[Sighting, int]()
    for stage in stages:
        change(
            landmarks,
            [
                (s, i)
                for s, i in zip(seen, stage, strict=True)
                if landmarks.state(s).landmark_id != i
            ],
        )
        of = {s: i for s, i in zip(seen, stage, strict=True) if i is not None}
        expected = graph_of(landmarks.smoother.graph.at(k) for k in range(POSES))
        ids = sorted(set(of.values()))
        for i in ids:
            mine = sorted(
                (s for s, landmark in of.items() if landmark == i),
                key=lambda s: s.stamp_ns,
            )
            for s in mine:
                expected.push_back(
                    graph_of(MAKER.make(s, L(i), is_first=s is mine[0]).values())
                )
        assert landmarks.smoother.graph.nrFactors() == expected.nrFactors()
        assert errors(landmarks.smoother.graph, ids, landmarks) == pytest.approx(
            errors(expected, ids, landmarks)
        )
        assert landmarks.ids == landmarks.smoother.landmark_ids == ids


MOUNTED = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.4, 0.0), np.array([0.3, 0.0, -0.1]))
POINT = np.array([3.0, 0.5, -1.7])


@pytest.mark.parametrize(
    "floor", [None, FloorPrior(z_m=-1.7, sigma_m=0.02)], ids=["no floor", "floor"]
)
def test_a_point_is_that_of_least_squares(floor: FloorPrior | None):
    """With the elevation at the first sighting, or the floor, as a prior; to a tenth of a sigma.

    Poses are on an arc, at different heights, and look at the point.
    """
    sigmas = np.sqrt(np.diag(NOISE))
    poses = []
    for a in np.linspace(0.0, 0.8, 6).tolist():
        off = [2.2 * math.cos(a), 2.2 * math.sin(a), -1.0 - 0.3 * math.sin(5 * a)]
        poses.append(gtsam.Pose3(gtsam.Rot3.Yaw(a), POINT - off).compose(MOUNTED))
    noise = 0.5 * np.random.default_rng(0).standard_normal((6, 2)) * sigmas
    measured = [polar(pose, POINT) + e for pose, e in zip(poses, noise, strict=True)]
    sightings = [
        Sighting(k, k, Sightline(X(k), MOUNTED, z), NOISE, floor)
        for k, z in enumerate(measured)
    ]
    values = values_of(
        **{f"X{k}": pose.compose(MOUNTED.inverse()) for k, pose in enumerate(poses)}
    )

    def residuals(p: Floats) -> Floats:
        rows = [
            (polar(pose, p) - z) / sigmas
            for pose, z in zip(poses, measured, strict=True)
        ]
        elevation = math.asin(poses[0].transformTo(p)[2] / polar(poses[0], p)[0])
        middle = MAKER.elevation_on(floor, poses[0], measured[0])
        rows.append(np.array([(elevation - middle) / (APERTURE_RAD / math.sqrt(12))]))
        if floor:
            rows.append(np.array([(p[2] - floor.z_m) / floor.sigma_m]))
        return np.concatenate(rows)

    best = least_squares(residuals, POINT)
    point, cov = place(sightings, values, MAKER)
    sigma = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    assert np.abs((point - best.x) / sigma).max() < 0.1
    assert np.sqrt(np.diag(cov)) == pytest.approx(sigma, rel=0.05)
