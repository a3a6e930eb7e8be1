"""Where sightings alone put a point, seen from keyframes that are taken as they are.

A sonar measures range and azimuth. One sighting leaves the elevation to the aperture, or to a known floor; sightings
from other places narrow it.
"""

from __future__ import annotations

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.slam.models import locate_jacobians, range_azimuth_jacobians, wrap_angle
from sonar_graph.slam.sighting import Sighting, SightingFactors
from sonar_graph.slam.view import Source


def source(sighting: Sighting, values: gtsam.Values, maker: SightingFactors) -> Source:
    """The point as located by one sighting.

    With ``p = g(X, range, azimuth, elevation)``: ``cov = g_z diag(R, sigma_e²) g_z'``, sigma_e that of an elevation
    anywhere in the aperture; on a floor narrowed by its height, ``p_z ~ N(floor z, sigma²)``.
    """
    line = sighting.line
    range_m, azimuth_rad = line.z.tolist()
    X = values.atPose3(line.pose_key)
    elevation = maker.elevation_on(sighting.floor, X.compose(line.body_T_sonar), range_m, azimuth_rad)
    point, by_pose, by_polar = locate_jacobians(X, line.body_T_sonar, range_m, azimuth_rad, elevation)
    polar_cov = np.zeros((3, 3))
    polar_cov[:2, :2], polar_cov[2, 2] = sighting.noise, maker.elevation_sigma_rad**2
    cov = by_polar @ polar_cov @ by_polar.T
    if sighting.floor is not None:
        cov = cov - np.outer(cov[:, 2], cov[2]) / (cov[2, 2] + sighting.floor.sigma_m**2)
    return Source(line.pose_key, point, by_pose, cov)


def place(sightings: list[Sighting], values: gtsam.Values, maker: SightingFactors) -> tuple[Floats, Floats]:
    """The point of several sightings, shape (3,), m, and its covariance, shape (3, 3), m².

    That of the first, corrected by one after the other::

        K = P H' (H P H' + R)^-1,    p <- p + K (z - h(p)),    P <- (I - K H) P
    """
    first = source(sightings[0], values, maker)
    point, P = first.point, first.cov
    for sighting in sightings[1:]:
        line = sighting.line
        predicted, _, H = range_azimuth_jacobians(values.atPose3(line.pose_key), line.body_T_sonar, point)
        K = np.linalg.solve(H @ P @ H.T + sighting.noise, H @ P).T
        innovation = np.array([line.z[0] - predicted[0], wrap_angle(line.z[1] - predicted[1])])
        point, P = point + K @ innovation, P - K @ H @ P
    return point, P
