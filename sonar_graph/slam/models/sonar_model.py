"""Range and azimuth of a landmark, seen by a sonar on a body: the model, its inverse, and their derivatives.

With the landmark p in the world and the sonar at ``world_T_sonar = world_T_body body_T_sonar``::

    q       = sonar_R_world (p - world_p_sonar)
    range   = |q|
    azimuth = atan2(q_y, q_x)

    D_q     = [ q^T / |q|                             ]     D_q: derivative of (range, azimuth) by q, shape (2, 3)
              [ -q_y / h^2,    q_x / h^2,    0        ]     h^2 = q_x^2 + q_y^2

    by the body pose    D_q [ [q]x | -I ] Ad(sonar_T_body)      right perturbation [theta, rho], shape (2, 6)
    by the landmark     D_q sonar_R_world                       shape (2, 3)

Sonar axes: x along the centre of the aperture, y to the left, z up; h is the distance from the z axis.

The inverse model needs the elevation, which a sonar does not measure: ``elevation = asin(q_z / |q|)``. On a floor of
known height it follows from range and azimuth. Azimuth has no derivative on the z axis (h = 0); a landmark there is
outside every aperture.
"""

import math

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.numerics import compiled

FLOOR_GATE = 10.83
"""Gate for "the landmark stands on the floor": the 0.999 quantile of chi-square with one degree of freedom.

The landmark is placed at elevation 0 and its height compared with the floor's. It is not on the floor if the squared
difference, divided by its variance from elevation, pose and floor, exceeds the gate."""


@compiled
def wrap_angle(angle_rad: float) -> float:
    """The same direction in (-pi, pi]."""
    return angle_rad - 2.0 * math.pi * math.ceil((angle_rad - math.pi) / (2.0 * math.pi))


@compiled
def project(q: Floats) -> tuple[Floats, Floats]:
    """Range and azimuth of a point in the sonar frame.

    Parameters
    ----------
    q
        Shape (3,), m.

    Returns
    -------
    (range m, azimuth rad), shape (2,), and D_q, their derivative by q, shape (2, 3).
    """
    rho2 = q[0] * q[0] + q[1] * q[1]
    range_m = math.sqrt(rho2 + q[2] * q[2])
    z = np.array([range_m, math.atan2(q[1], q[0])])
    D_q = np.zeros((2, 3))
    for axis in range(3):
        D_q[0, axis] = q[axis] / range_m
    D_q[1, 0], D_q[1, 1] = -q[1] / rho2, q[0] / rho2
    return z, D_q


@compiled
def project_all(points: Floats, world_T_sonar: Floats) -> tuple[Floats, Floats, Floats]:
    """Range and azimuth of points of the world, shape (m, 3), from a sonar's pose, shape (4, 4).

    Returns
    -------
    (range m, azimuth rad), shape (m, 2); their derivatives by the right perturbation of the sonar's pose,
    ``D_q [[q]x | -I]``, shape (m, 2, 6), and by the point, ``D_q sonar_R_world``, shape (m, 2, 3).
    """
    T, m = world_T_sonar, len(points)
    view, by_sonar, by_point = np.empty((m, 2)), np.zeros((m, 2, 6)), np.empty((m, 2, 3))
    for k in range(m):
        dx, dy, dz = points[k, 0] - T[0, 3], points[k, 1] - T[1, 3], points[k, 2] - T[2, 3]
        x = T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz
        y = T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz
        z = T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz
        h2 = x * x + y * y
        r = math.sqrt(h2 + z * z)
        view[k, 0], view[k, 1] = r, math.atan2(y, x)
        by_sonar[k, 0, 3], by_sonar[k, 0, 4], by_sonar[k, 0, 5] = -x / r, -y / r, -z / r  # q^T [q]x = 0
        by_sonar[k, 1, 0], by_sonar[k, 1, 1], by_sonar[k, 1, 2] = x * z / h2, y * z / h2, -1.0
        by_sonar[k, 1, 3], by_sonar[k, 1, 4] = y / h2, -x / h2
        for i in range(2):
            for j in range(3):
                by_point[k, i, j] = -(
                    by_sonar[k, i, 3] * T[j, 0] + by_sonar[k, i, 4] * T[j, 1] + by_sonar[k, i, 5] * T[j, 2]
                )
    return view, by_sonar, by_point


def sonar_point(range_m: float, azimuth_rad: float, elevation_rad: float) -> Floats:
    """The point in the sonar frame with these spherical coordinates, shape (3,), m."""
    level = range_m * math.cos(elevation_rad)
    return np.array([level * math.cos(azimuth_rad), level * math.sin(azimuth_rad), range_m * math.sin(elevation_rad)])


def sonar_point_jacobian(range_m: float, azimuth_rad: float, elevation_rad: float) -> Floats:
    """Derivative of `sonar_point` by (range, azimuth, elevation), shape (3, 3)."""
    ca, sa, ce, se = math.cos(azimuth_rad), math.sin(azimuth_rad), math.cos(elevation_rad), math.sin(elevation_rad)
    return np.array(
        [
            [ce * ca, -range_m * ce * sa, -range_m * se * ca],
            [ce * sa, range_m * ce * ca, -range_m * se * sa],
            [se, 0.0, range_m * ce],
        ]
    )


def range_azimuth(world_T_sonar: gtsam.Pose3, p_world: Floats) -> Floats:
    """Range (m) and azimuth (rad) at which a sonar sees a point, shape (2,)."""
    return project_all(p_world[None], world_T_sonar.matrix())[0][0]


def range_azimuth_jacobians(
    world_T_body: gtsam.Pose3, body_T_sonar: gtsam.Pose3, p_world: Floats
) -> tuple[Floats, Floats, Floats]:
    """Range and azimuth with derivatives.

    Returns
    -------
    (range m, azimuth rad), shape (2,); the derivative by the body pose's right perturbation [theta, rho], shape (2, 6);
    the derivative by the landmark, shape (2, 3).
    """
    (z,), (by_sonar,), (by_point,) = project_all(p_world[None], world_T_body.compose(body_T_sonar).matrix())
    return z, by_sonar @ body_T_sonar.inverse().AdjointMap(), by_point


def locate(world_T_sonar: gtsam.Pose3, range_m: float, azimuth_rad: float, elevation_rad: float) -> Floats:
    """The point in the world that a sonar sees there, shape (3,), m."""
    return np.asarray(world_T_sonar.transformFrom(sonar_point(range_m, azimuth_rad, elevation_rad)))


def locate_jacobians(
    world_T_body: gtsam.Pose3, body_T_sonar: gtsam.Pose3, range_m: float, azimuth_rad: float, elevation_rad: float
) -> tuple[Floats, Floats, Floats]:
    """A located point with derivatives.

    Returns
    -------
    The point, shape (3,), m; its derivative by the body pose's right perturbation [theta, rho], shape (3, 6); its
    derivative by (range, azimuth, elevation), shape (3, 3).
    """
    world_T_sonar = world_T_body.compose(body_T_sonar)
    R_body, R_sonar = world_T_body.rotation().matrix(), world_T_sonar.rotation().matrix()
    point = locate(world_T_sonar, range_m, azimuth_rad, elevation_rad)
    p_body = np.asarray(world_T_body.transformTo(point), dtype=np.float64)
    by_pose = R_body @ np.hstack([-gtsam.SO3.Hat(p_body), np.eye(3)])
    return point, by_pose, R_sonar @ sonar_point_jacobian(range_m, azimuth_rad, elevation_rad)


def elevation_on_floor(
    world_T_sonar: gtsam.Pose3, range_m: float, azimuth_rad: float, floor_z_m: float, aperture_rad: float
) -> float | None:
    """Elevation (rad) at which a detected point lies on the floor.

    With the last row (a, b, c) of world_R_sonar and the floor at a height above the sonar::

        (a cos(azimuth) + b sin(azimuth)) cos(e) + c sin(e) = height / range

    which is ``A cos(e - e0) = height / range``: of its two solutions the one nearer to the centre beam.

    Parameters
    ----------
    floor_z_m
        World z of the floor.
    aperture_rad
        Full vertical opening of the sonar.

    Returns
    -------
    None when the floor is not within the aperture at that range and azimuth.
    """
    a, b, c = world_T_sonar.rotation().matrix()[2].tolist()
    level = a * math.cos(azimuth_rad) + b * math.sin(azimuth_rad)
    reach_m, height_m = range_m * math.hypot(level, c), floor_z_m - world_T_sonar.z()
    if reach_m <= 0.0 or not abs(height_m) <= reach_m:  # NaN where the floor's height is not known
        return None
    middle, half = math.atan2(c, level), math.acos(height_m / reach_m)
    nearest = min(wrap_angle(middle + half), wrap_angle(middle - half), key=abs)
    return nearest if abs(nearest) <= 0.5 * aperture_rad else None
