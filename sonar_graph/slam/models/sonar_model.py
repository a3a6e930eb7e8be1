"""Range and azimuth of a landmark in a sonar's own axes: the model, its inverse, and their derivatives.

With q the landmark in sonar axes, x along the centre of the aperture, y to the left, z up, h its distance from z::

    range = |q|,    azimuth = atan2(q_y, q_x)

    D_q   = [ q^T / |q|                             ]     D_q: derivative of (range, azimuth) by q, shape (2, 3)
            [ -q_y / h^2,    q_x / h^2,    0        ]     h^2 = q_x^2 + q_y^2

The inverse model needs the elevation, which a sonar does not measure: ``elevation = asin(q_z / |q|)``. On a floor of
known height it follows from range and azimuth. Azimuth has no derivative on the z axis (h = 0); a landmark there is
outside every aperture. From poses in the world: `sonar_graph.slam.models.views`.
"""

import math

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.numerics import compiled

FLOOR_GATE = 10.83
"""Gate for "the landmark stands on the floor": the 0.999 quantile of chi-square with one degree of freedom.

It gates the squared difference of the height at elevation 0 from the floor's, over its variance from elevation, pose
and floor."""


@compiled
def wrap_angle(angle_rad: float) -> float:
    """The same direction in (-pi, pi]."""
    return angle_rad - 2.0 * math.pi * math.ceil((angle_rad - math.pi) / (2.0 * math.pi))


@compiled
def project(q: Floats) -> tuple[Floats, Floats]:
    """(range m, azimuth rad), shape (2,), of a point in the sonar frame, and D_q, shape (2, 3)."""
    h2 = q[0] * q[0] + q[1] * q[1]
    range_m, D_q = math.sqrt(h2 + q[2] * q[2]), np.zeros((2, 3))
    D_q[0, 0], D_q[0, 1], D_q[0, 2] = q[0] / range_m, q[1] / range_m, q[2] / range_m
    D_q[1, 0], D_q[1, 1] = -q[1] / h2, q[0] / h2
    return np.array([range_m, math.atan2(q[1], q[0])]), D_q


def sonar_point(range_m: float, azimuth_rad: float, elevation_rad: float) -> Floats:
    """The point in the sonar frame with these spherical coordinates, shape (3,), m."""
    level = range_m * math.cos(elevation_rad)
    return np.array([level * math.cos(azimuth_rad), level * math.sin(azimuth_rad), range_m * math.sin(elevation_rad)])


def sonar_point_jacobian(range_m: float, azimuth_rad: float, elevation_rad: float) -> Floats:
    """Derivative of `sonar_point` by (range, azimuth, elevation), shape (3, 3)."""
    ca, sa, ce, se = math.cos(azimuth_rad), math.sin(azimuth_rad), math.cos(elevation_rad), math.sin(elevation_rad)
    level, height = range_m * ce, range_m * se
    return np.array([[ce * ca, -level * sa, -height * ca], [ce * sa, level * ca, -height * sa], [se, 0.0, level]])


def elevation_on_floor(
    world_T_sonar: gtsam.Pose3, range_m: float, azimuth_rad: float, floor_z_m: float, aperture_rad: float
) -> float | None:
    """Elevation (rad) at which a detected point lies on the floor.

    With the last row (a, b, c) of world_R_sonar and the floor at a height above the sonar::

        (a cos(azimuth) + b sin(azimuth)) cos(e) + c sin(e) = height / range

    which is ``A cos(e - e0) = height / range``: of its two solutions the one nearer to the centre beam. None where the
    floor, at a height ``floor_z_m`` in the world, is not within the full vertical aperture.
    """
    a, b, c = world_T_sonar.rotation().matrix()[2].tolist()
    level = a * math.cos(azimuth_rad) + b * math.sin(azimuth_rad)
    reach_m, height_m = range_m * math.hypot(level, c), floor_z_m - world_T_sonar.z()
    if reach_m <= 0.0 or not abs(height_m) <= reach_m:  # NaN where the floor's height is not known
        return None
    middle, half = math.atan2(c, level), math.acos(height_m / reach_m)
    nearest = min(wrap_angle(middle + half), wrap_angle(middle - half), key=abs)
    return nearest if abs(nearest) <= 0.5 * aperture_rad else None
