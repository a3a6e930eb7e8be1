"""Sightings in the graph whatever came and went, and the points that they place."""

import math

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from scipy.optimize import least_squares

from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.measurements import Floats
from sonar_graph.slam.landmarks import SightingFactors
from sonar_graph.slam.landmarks.sighting import Sighting
from sonar_graph.slam.landmarks.unknown import place
from sonar_graph.slam.smoother import Sightline

from .made import plain, polar, values_of

APERTURE_RAD = 0.3
MAKER = SightingFactors(SonarCalibration(elevation_aperture_rad=APERTURE_RAD), plain)
NOISE = np.diag([0.02**2, 0.01**2])


MOUNTED = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.4, 0.0), np.array([0.3, 0.0, -0.1]))
POINT = np.array([3.0, 0.5, -1.7])


@pytest.mark.parametrize(
    "floor", [None, FloorPrior(z_m=-1.7, sigma_m=0.02)], ids=["no floor", "floor"]
)
def test_a_point_is_that_of_least_squares(floor):
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
