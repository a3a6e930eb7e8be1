"""Where sightings alone put a point: least squares by scipy, and its covariance."""

import math

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from scipy.optimize import least_squares

from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.measurements import Floats
from sonar_graph.slam.landmarks.sighting import Sighting, SightingFactors, place, source
from sonar_graph.slam.smoother.batch_solution import Sightline

APERTURE_RAD = 0.3
MOUNTED = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.4, 0.0), np.array([0.3, 0.0, -0.1]))
POINT = np.array([3.0, 0.5, -1.7])
R = np.diag([0.02**2, 0.01**2])
MAKER = SightingFactors(SonarCalibration(elevation_aperture_rad=APERTURE_RAD), lambda noise: noise)


def polar(pose: gtsam.Pose3, point: Floats) -> Floats:
    """Range, azimuth and elevation."""
    x, y, z = pose.compose(MOUNTED).transformTo(point)
    return np.array([math.hypot(x, y, z), math.atan2(y, x), math.asin(z / math.hypot(x, y, z))])


def seen(
    poses: list[gtsam.Pose3], floor: FloorPrior | None, noise: Floats
) -> tuple[list[Sighting], gtsam.Values, list[Floats]]:
    values, sightings, measured = gtsam.Values(), [], []
    for k, pose in enumerate(poses):
        values.insert(X(k), pose)
        z = polar(pose, POINT)[:2] + noise[k]
        measured.append(z)
        sightings.append(Sighting(k, k, Sightline(X(k), MOUNTED, z), R, floor))
    return sightings, values, measured


def around(count: int) -> list[gtsam.Pose3]:
    """Poses on an arc, at different heights, that look at the point."""
    angles = np.linspace(0.0, 0.8, count)
    return [
        gtsam.Pose3(gtsam.Rot3.Yaw(a), POINT - [2.2 * math.cos(a), 2.2 * math.sin(a), -1.0 - 0.3 * math.sin(5 * a)])
        for a in angles.tolist()
    ]


@pytest.mark.parametrize("floor", [None, FloorPrior(z_m=-1.7, sigma_m=0.02)], ids=["no floor", "floor"])
def test_a_point_is_that_of_least_squares(floor: FloorPrior | None):
    """With the elevation at the first sighting, or the floor, as a prior; to a tenth of a sigma."""
    poses = around(6)
    noise = 0.5 * np.random.default_rng(0).standard_normal((6, 2)) * np.sqrt(np.diag(R))
    sightings, values, measured = seen(poses, floor, noise)
    sigma_e = APERTURE_RAD / math.sqrt(12)

    def residuals(p: Floats) -> Floats:
        rows = [(polar(pose, p)[:2] - z) / np.sqrt(np.diag(R)) for pose, z in zip(poses, measured, strict=True)]
        first = polar(poses[0], p)[2]
        middle = MAKER.elevation_on(floor, poses[0].compose(MOUNTED), *measured[0].tolist())
        rows.append(np.array([(first - middle) / sigma_e]))
        if floor:
            rows.append(np.array([(p[2] - floor.z_m) / floor.sigma_m]))
        return np.concatenate(rows)

    best = least_squares(residuals, POINT)
    point, cov = place(sightings, values, MAKER)
    sigma = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    assert np.abs((point - best.x) / sigma).max() < 0.1
    assert np.sqrt(np.diag(cov)) == pytest.approx(sigma, rel=0.05)


def test_one_sighting_leaves_the_elevation_to_the_aperture_and_others_narrow_it():
    sightings, values, _ = seen(around(6), None, np.zeros((6, 2)))
    widest = [math.sqrt(np.linalg.eigvalsh(place(sightings[:n], values, MAKER)[1])[-1]) for n in (1, 3, 6)]
    range_m = sightings[0].line.z[0]
    assert widest[0] == pytest.approx(range_m * APERTURE_RAD / math.sqrt(12), rel=0.01)
    assert widest[0] > 1.3 * widest[1] > 1.3 * widest[2]


def test_a_located_points_derivative_is_that_of_differences():
    (sighting, *_), values, _ = seen(around(2), None, np.zeros((2, 2)))
    found = source(sighting, values, MAKER)
    for k, axis in enumerate(np.eye(6)):
        turned = gtsam.Values()
        turned.insert(X(0), values.atPose3(X(0)).compose(gtsam.Pose3.Expmap(1e-6 * axis)))
        assert (source(sighting, turned, MAKER).point - found.point) / 1e-6 == pytest.approx(
            found.by_pose[:, k], abs=1e-4
        )
