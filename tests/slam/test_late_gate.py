"""The gate on what comes late: the chi-square distance of the innovation, its covariance by differences."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from sonar_graph.measurements import Floats
from sonar_graph.slam.landmarks.sighting import Sighting
from sonar_graph.slam.landmarks.tracked import LateGate
from sonar_graph.slam.smoother.batch_solution import Sightline
from sonar_graph.slam.smoother.incremental import Smoother

from .made import smoother_with

THRESHOLD = 9.21
MOUNTED = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.3, 0.1), np.array([0.3, 0.0, -0.1]))
POINT = np.array([3.0, 0.6, -0.8])
STEP = 1e-6
NOISES = {"as uncertain as the graph": 1.0, "much more": 30.0, "much less": 1e-3}


def smoother() -> Smoother:
    """A pose and a landmark that are each known to some centimetres, and together by a sighting."""
    found = smoother_with(1e9, 1e-6, 1e9)
    found.add_pose(X(0), gtsam.Pose3(), 0.0)
    found.add_landmark(L(7), POINT)
    sigmas = np.array([0.01, 0.01, 0.02, 0.05, 0.04, 0.03])
    found.add([gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(sigmas))])
    found.add([gtsam.PriorFactorPoint3(L(7), POINT, gtsam.noiseModel.Isotropic.Sigma(3, 0.06))])
    distance = float(np.linalg.norm(MOUNTED.transformTo(POINT)))
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.02)
    found.add([gtsam.RangeFactorWithTransform3D(X(0), L(7), distance, noise, MOUNTED)])
    found.update(0.0)
    return found


def polar(pose: gtsam.Pose3, point: Floats) -> Floats:
    x, y, z = pose.compose(MOUNTED).transformTo(point)
    return np.array([np.sqrt(x * x + y * y + z * z), np.arctan2(y, x)])


def expected_cov(of: Smoother) -> Floats:
    columns = [
        (polar(gtsam.Pose3.Expmap(STEP * e), POINT) - polar(gtsam.Pose3.Expmap(-STEP * e), POINT)) / (2 * STEP)
        for e in np.eye(6)
    ] + [
        (polar(gtsam.Pose3(), POINT + STEP * e) - polar(gtsam.Pose3(), POINT - STEP * e)) / (2 * STEP)
        for e in np.eye(3)
    ]
    H, joint = np.column_stack(columns), of.joint_covariance([X(0), L(7)])
    P = np.block([[joint.at(a, b) for b in (X(0), L(7))] for a in (X(0), L(7))])
    return H @ P @ H.T


@pytest.mark.parametrize("scale", NOISES.values(), ids=NOISES)
def test_what_passes_is_within_the_threshold_of_expectation_and_noise(scale: float) -> None:
    graph = smoother()
    expected = expected_cov(graph)
    R = scale * np.trace(expected) / 2 * np.array([[1.0, 0.2], [0.2, 0.5]])
    whole = np.linalg.cholesky(expected + R)
    sightings = [
        Sighting(k, k, Sightline(X(0), MOUNTED, polar(gtsam.Pose3(), POINT) + whole @ off), R, None)
        for k, off in enumerate(
            np.sqrt(share * THRESHOLD) * np.array([np.cos(angle), np.sin(angle)])
            for angle in np.linspace(0.0, 6.0, 7)
            for share in (0.99, 1.01)
        )
    ]
    assert LateGate(graph, THRESHOLD).inside(sightings, 7) == [True, False] * 7
    assert all(LateGate(graph, np.inf).inside(sightings, 7))
    assert all(LateGate(graph, THRESHOLD).inside(sightings, 8)), "of a landmark that is not in the graph"
