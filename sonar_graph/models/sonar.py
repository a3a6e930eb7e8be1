"""Range and azimuth of a landmark: the model, its derivatives and its inverse.

With q the landmark in sonar axes, x along the centre of the aperture, y to the left, z up, h its distance from z::

    range = |q|,    azimuth = atan2(q_y, q_x)

    D_q   = [ q^T / |q|                             ]     D_q: derivative of (range, azimuth) by q, shape (2, 3)
            [ -q_y / h^2,    q_x / h^2,    0        ]     h^2 = q_x^2 + q_y^2

For a landmark p of the world and a sonar at ``world_T_sonar = (R, t)``::

    q = R^T (p - t)
    by the sonar's pose    D_q [ [q]x | -I ]              right perturbation [theta, rho], shape (2, 6)
    by the body's pose     D_q [ [q]x | -I ] Ad(sonar_T_body)
    by the landmark        D_q R^T                        shape (2, 3)

The inverse model needs the elevation, ``asin(q_z / |q|)``, which a sonar does not measure. On a floor of known height
the elevation follows from range and azimuth. Azimuth has no derivative on the z axis (h = 0), which lies outside every
aperture. Derivation: docs/theory/models.md.
"""

import math
from typing import Any, NamedTuple, TypeVar

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.numerics import compiled, cross_matrix

FLOOR_GATE = 10.83
"""Gate for "the landmark stands on the floor": the 0.999 quantile of chi-square with one degree of freedom.

The test statistic is the squared difference between the floor's height and the landmark's height at elevation 0, over
its variance from elevation, pose and floor."""


Angle = TypeVar("Angle", float, Floats)


@compiled
def wrap_angle(angle_rad: Angle) -> Angle:
    """The same direction in (-pi, pi], of one angle or of an array."""
    turns: Any = np.ceil((angle_rad - math.pi) / (2.0 * math.pi))
    return angle_rad - 2.0 * math.pi * turns


@compiled
def project(q: Floats) -> tuple[Floats, Floats]:
    """(range m, azimuth rad), shape (2,), of a point in the sonar frame, and D_q, shape (2, 3)."""
    x = q[0]
    y = q[1]
    h2 = x * x + y * y
    range_m = math.sqrt(h2 + q[2] * q[2])
    D_q = np.zeros((2, 3))
    D_q[0, 0] = x / range_m
    D_q[0, 1] = y / range_m
    D_q[0, 2] = q[2] / range_m
    D_q[1, 0] = -y / h2
    D_q[1, 1] = x / h2
    return np.array([range_m, math.atan2(y, x)]), D_q


@compiled
def project_points(q: Floats) -> tuple[Floats, Floats]:
    """`project` of m points in the sonar frame, shape (m, 3): shapes (m, 2) and (m, 2, 3)."""
    z = np.empty((len(q), 2))
    D_q = np.empty((len(q), 2, 3))
    for k in range(len(q)):
        z[k], D_q[k] = project(q[k])
    return z, D_q


class View(NamedTuple):
    """Expected range and azimuth of m points of the world, with derivatives."""

    z: Floats
    """Range (m) and azimuth (rad), shape (m, 2)."""
    by_sonar: Floats
    """Derivative by the right perturbation [theta, rho] of the sonar's pose, shape (m, 2, 6)."""
    by_point: Floats
    """Derivative by the points, shape (m, 2, 3)."""


@compiled
def _view(points: Floats, R: Floats, t: Floats) -> tuple[Floats, Floats, Floats]:
    m = len(points)
    z = np.empty((m, 2))
    by_sonar = np.empty((m, 2, 6))
    by_point = np.empty((m, 2, 3))
    R_T = R.T.copy()
    for k in range(m):
        q = R_T @ (points[k] - t)
        z[k], D_q = project(q)
        # D_q [q]x: the row of range is q^T [q]x / |q| = 0
        by_sonar[k, 0, :3] = 0.0
        by_sonar[k, 1, 0] = D_q[1, 1] * q[2]
        by_sonar[k, 1, 1] = -D_q[1, 0] * q[2]
        by_sonar[k, 1, 2] = -1.0
        by_sonar[k, :, 3:] = -D_q
        by_point[k] = D_q @ R_T
    return z, by_sonar, by_point


def view_points(world_T_sonar: gtsam.Pose3, points: Floats) -> View:
    """Expected range and azimuth of points of the world, shape (m, 3), and their derivatives."""
    R = np.ascontiguousarray(world_T_sonar.rotation().matrix())
    return View(*_view(np.ascontiguousarray(points), R, world_T_sonar.translation()))


def range_azimuth(world_T_sonar: gtsam.Pose3, p_world: Floats) -> Floats:
    """Range (m) and azimuth (rad) of one point of the world, shape (2,)."""
    return view_points(world_T_sonar, p_world[None]).z[0]


def range_azimuth_jacobians(
    world_T_body: gtsam.Pose3, body_T_sonar: gtsam.Pose3, p_world: Floats
) -> tuple[Floats, Floats, Floats]:
    """Range and azimuth with derivatives, as `view_from_body`."""
    R, X = _as_arrays(world_T_body)
    return view_from_body(R, X, Mount(*_as_arrays(body_T_sonar)), np.ascontiguousarray(p_world))


def _as_arrays(pose: gtsam.Pose3) -> tuple[Floats, Floats]:
    return np.ascontiguousarray(pose.rotation().matrix()), pose.translation()


class Mount(NamedTuple):
    """Sonar in the body, as arrays."""

    body_R_sonar: Floats
    body_p_sonar: Floats


@compiled
def body_point_jacobian(R: Floats, q: Floats) -> Floats:
    """``R [-[q]x  I]``, shape (3, 6): a point q of the body moves so in the world by [theta, rho] of its pose."""
    J = np.empty((3, 6))
    J[:, :3] = -R @ cross_matrix(q)
    J[:, 3:] = R
    return J


@compiled
def view_from_body(R: Floats, X: Floats, mount: Mount, p: Floats) -> tuple[Floats, Floats, Floats]:
    """Range and azimuth, shape (2,), of a point p of the world from a body at ``world_T_body = (R, X)``.

    Returns as well their derivative by the right perturbation [theta, rho] of the body's pose, shape (2, 6), and by the
    point, shape (2, 3).
    """
    q = R.T @ (p - X)  # in body axes
    z, D_q = project(mount.body_R_sonar.T @ (q - mount.body_p_sonar))
    N = D_q @ mount.body_R_sonar.T  # derivative by q, which moves by -[-[q]x  I] [theta; rho]
    by_body = np.empty((2, 6))
    by_body[:, :3] = N @ cross_matrix(q)
    by_body[:, 3:] = -N
    return z, by_body, N @ R.T


@compiled
def locate_from_body(
    R: Floats, X: Floats, mount: Mount, z: Floats, elevation_rad: float
) -> tuple[Floats, Floats, Floats]:
    """The point of the world, shape (3,), at range and azimuth z and an elevation from a body at (R, X).

    Returns as well its derivative by the right perturbation [theta, rho] of the body's pose, shape (3, 6), and by
    (range, azimuth, elevation), shape (3, 3).
    """
    q = mount.body_p_sonar + mount.body_R_sonar @ sonar_point(z[0], z[1], elevation_rad)  # in body axes
    by_polar = R @ mount.body_R_sonar @ sonar_point_jacobian(z[0], z[1], elevation_rad)
    return X + R @ q, body_point_jacobian(R, q), by_polar


@compiled
def sonar_point(range_m: float, azimuth_rad: float, elevation_rad: float) -> Floats:
    """The point in the sonar frame with these spherical coordinates, shape (3,), m."""
    level_m = range_m * math.cos(elevation_rad)
    x = level_m * math.cos(azimuth_rad)
    y = level_m * math.sin(azimuth_rad)
    return np.array([x, y, range_m * math.sin(elevation_rad)])


@compiled
def sonar_point_jacobian(range_m: float, azimuth_rad: float, elevation_rad: float) -> Floats:
    """Derivative of `sonar_point` by (range, azimuth, elevation), shape (3, 3)."""
    ca = math.cos(azimuth_rad)
    sa = math.sin(azimuth_rad)
    ce = math.cos(elevation_rad)
    se = math.sin(elevation_rad)
    r = range_m
    return np.array(
        [
            [ce * ca, -r * ce * sa, -r * se * ca],
            [ce * sa, r * ce * ca, -r * se * sa],
            [se, 0.0, r * ce],
        ]
    )


def locate(world_T_sonar: gtsam.Pose3, range_m: float, azimuth_rad: float, elevation_rad: float) -> Floats:
    """The point of the world at these spherical coordinates of the sonar, shape (3,), m."""
    return np.asarray(world_T_sonar.transformFrom(sonar_point(range_m, azimuth_rad, elevation_rad)))


def locate_jacobians(
    world_T_body: gtsam.Pose3, body_T_sonar: gtsam.Pose3, range_m: float, azimuth_rad: float, elevation_rad: float
) -> tuple[Floats, Floats, Floats]:
    """A located point with derivatives, as `locate_from_body`."""
    R, X = _as_arrays(world_T_body)
    return locate_from_body(R, X, Mount(*_as_arrays(body_T_sonar)), np.array([range_m, azimuth_rad]), elevation_rad)


def elevation_on_floor(
    world_T_sonar: gtsam.Pose3, range_m: float, azimuth_rad: float, floor_z_m: float, aperture_rad: float
) -> float | None:
    """Elevation (rad) at which a detected point lies on the floor.

    With the last row (a, b, c) of world_R_sonar and the floor at a height above the sonar::

        (a cos(azimuth) + b sin(azimuth)) cos(e) + c sin(e) = height / range

    which is ``A cos(e - e0) = height / range``: of its two solutions the one nearer to the centre beam. None where the
    floor, at a height ``floor_z_m`` in the world, is not within the full vertical aperture.
    """
    up = np.ascontiguousarray(world_T_sonar.rotation().matrix()[2])
    elevation_rad = floor_elevation(up, floor_z_m - world_T_sonar.z(), range_m, azimuth_rad)
    return elevation_rad if abs(elevation_rad) <= 0.5 * aperture_rad else None


@compiled
def floor_elevation(up: Floats, height_m: float, range_m: float, azimuth_rad: float) -> float:
    """Elevation (rad) of `elevation_on_floor` in any aperture; NaN where the floor is out of reach.

    Parameters
    ----------
    up
        Last row (a, b, c) of world_R_sonar, shape (3,).
    height_m
        Height of the floor above the sonar.
    """
    level = up[0] * math.cos(azimuth_rad) + up[1] * math.sin(azimuth_rad)
    reach_m = range_m * math.hypot(level, up[2])
    is_reached = reach_m > 0.0 and abs(height_m) <= reach_m  # False for a NaN height: the floor is not known
    if not is_reached:
        return math.nan
    middle = math.atan2(up[2], level)
    half = math.acos(height_m / reach_m)
    one = wrap_angle(middle + half)
    other = wrap_angle(middle - half)
    return one if abs(one) <= abs(other) else other
