"""Detections of the sonar: range and azimuth of a landmark with derivatives and inverse; accepted identities.

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
from numpy.typing import NDArray

from sonar_graph.calibration import SonarCalibration
from sonar_graph.measurements import Floats, Ints, LandmarkDetections
from sonar_graph.numerics import (
    UPPER_RIGHT,
    Mat3,
    Vec3,
    Vec6,
    compilable,
    compiled,
    cross,
    inlined,
    mat,
    skew,
    store,
    store_row,
    store_row6,
    vec,
)
from sonar_graph.states import OUTCOME_NUMBERS, Outcome

FLOOR_GATE = 10.83
"""Gate for "the landmark stands on the floor": the 0.999 quantile of chi-square with one degree of freedom.

The test statistic is the squared difference between the floor's height and the landmark's height at elevation 0, over
its variance from elevation, pose and floor."""


Angle = TypeVar("Angle", float, Floats)


@compilable
def wrap_angle(angle_rad: Angle) -> Angle:
    """The same direction in (-pi, pi], of one angle or of an array."""
    # ceil, not floor: pi stays pi
    turns: Any = np.ceil((angle_rad - math.pi) / (2.0 * math.pi))
    return angle_rad - 2.0 * math.pi * turns


def polar_difference(z: Floats, expected: Floats) -> Floats:
    """``z - expected`` of ranges (m) and azimuths (rad, wrapped), shape (..., 2)."""
    e = z - expected
    components = e.T  # a view with range and azimuth on the first axis; of one difference, plain numbers
    components[1] = wrap_angle(components[1])
    return e


def polar_measurements(
    detections: LandmarkDetections, sonar: SonarCalibration
) -> tuple[Floats, Floats]:
    """Range (m) and azimuth (rad), shape (m, 2), and their covariances, (m, 2, 2): the calibration's without others."""
    z = np.empty((len(detections), 2))
    z[:, 0] = detections.range_m
    z[:, 1] = detections.azimuth_rad
    variances = (sonar.range_sigma_m**2, sonar.azimuth_sigma_rad**2)
    return z, whole_covariances(detections.range_azimuth_cov, *variances)


@compiled
def whole_covariances(given: Floats, range_m2: float, azimuth_rad2: float) -> Floats:
    """Covariances of range and azimuth, (m, 2, 2), symmetric; those with NaN are diagonal, of the variances."""
    noise = np.zeros((len(given), 2, 2))
    for k in range(len(given)):
        # a covariance off symmetry by rounding is made symmetric
        across = 0.5 * (given[k, 0, 1] + given[k, 1, 0])
        is_known = not math.isnan(given[k, 0, 0] + across + given[k, 1, 1])
        noise[k, 0, 0] = given[k, 0, 0] if is_known else range_m2
        noise[k, 1, 1] = given[k, 1, 1] if is_known else azimuth_rad2
        noise[k, 0, 1] = across if is_known else 0.0
        noise[k, 1, 0] = noise[k, 0, 1]
    return noise


class Polar(NamedTuple):
    """Range and azimuth of a point q in the sonar frame, and the rows of D_q."""

    range_m: float
    azimuth_rad: float
    range_by_q: Vec3
    azimuth_by_q: Vec3


@inlined
def polar(q: Vec3) -> Polar:
    """Range, azimuth and D_q of a point in the sonar frame."""
    h2 = q.x * q.x + q.y * q.y  # h^2
    range_m = math.sqrt(h2 + q.z * q.z)
    return Polar(
        range_m=range_m,
        azimuth_rad=math.atan2(q.y, q.x),
        range_by_q=Vec3(q.x / range_m, q.y / range_m, q.z / range_m),
        azimuth_by_q=Vec3(-q.y / h2, q.x / h2, 0.0),
    )


@compiled
def project_points(q: Floats) -> tuple[Floats, Floats]:
    """(range m, azimuth rad) of m points in the sonar frame, shape (m, 3): shape (m, 2), and D_q, (m, 2, 3)."""
    z = np.empty((len(q), 2))
    D_q = np.empty((len(q), 2, 3))
    for k in range(len(q)):
        seen = polar(Vec3(q[k, 0], q[k, 1], q[k, 2]))
        z[k, 0] = seen.range_m
        z[k, 1] = seen.azimuth_rad
        store_row(seen.range_by_q, D_q[k], 0, 0)
        store_row(seen.azimuth_by_q, D_q[k], 1, 0)
    return z, D_q


class Mount(NamedTuple):
    """Sonar in the body, as arrays."""

    body_R_sonar: Floats
    body_p_sonar: Floats


class Sight(NamedTuple):
    """Range and azimuth of a point of the world from a body, and their derivatives.

    ``_by_body``: by the right perturbation [theta, rho] of the body's pose; ``_by_point``: by the point.
    """

    range_m: float
    azimuth_rad: float
    range_by_body: Vec6
    azimuth_by_body: Vec6
    range_by_point: Vec3
    azimuth_by_point: Vec3


@inlined
def sight_of(R: Mat3, X: Vec3, mount: Mount, p: Vec3) -> Sight:
    """Range and azimuth of a point p of the world from a body at ``world_T_body = (R, X)``."""
    body_R_sonar = mat(mount.body_R_sonar)
    q = R.T @ (p - X)  # in body axes
    seen = polar(body_R_sonar.T @ (q - vec(mount.body_p_sonar)))
    # derivatives n by q; the body's perturbation moves q by [q]x theta - rho
    range_n = body_R_sonar @ seen.range_by_q
    azimuth_n = body_R_sonar @ seen.azimuth_by_q
    return Sight(
        range_m=seen.range_m,
        azimuth_rad=seen.azimuth_rad,
        range_by_body=Vec6(cross(range_n, q), -1.0 * range_n),
        azimuth_by_body=Vec6(cross(azimuth_n, q), -1.0 * azimuth_n),
        range_by_point=R @ range_n,
        azimuth_by_point=R @ azimuth_n,
    )


class PointViews(NamedTuple):
    """Expected range and azimuth of m points of the world, with derivatives."""

    z: Floats
    """Range (m) and azimuth (rad), shape (m, 2)."""
    by_pose: Floats
    """Derivative by the right perturbation [theta, rho] of the pose, shape (m, 2, 6)."""
    by_point: Floats
    """Derivative by the points, shape (m, 2, 3)."""


@compiled
def views_from_body(R: Floats, X: Floats, mount: Mount, points: Floats) -> PointViews:
    """`sight_of` of m points of the world, shape (m, 3), as arrays."""
    m = len(points)
    z = np.empty((m, 2))
    by_pose = np.empty((m, 2, 6))
    by_point = np.empty((m, 2, 3))
    for k in range(m):
        sight = sight_of(
            mat(R), vec(X), mount, Vec3(points[k, 0], points[k, 1], points[k, 2])
        )
        z[k, 0] = sight.range_m
        z[k, 1] = sight.azimuth_rad
        store_row6(sight.range_by_body, by_pose[k], 0, 0)
        store_row6(sight.azimuth_by_body, by_pose[k], 1, 0)
        store_row(sight.range_by_point, by_point[k], 0, 0)
        store_row(sight.azimuth_by_point, by_point[k], 1, 0)
    return PointViews(z, by_pose, by_point)


AT_SONAR = Mount(np.eye(3), np.zeros(3))


def view_points(world_T_sonar: gtsam.Pose3, points: Floats) -> PointViews:
    """Expected range and azimuth of points of the world, shape (m, 3), and derivatives, by the sonar's own pose."""
    return views_from_body(
        *_as_arrays(world_T_sonar), AT_SONAR, np.ascontiguousarray(points)
    )


def range_azimuth(world_T_sonar: gtsam.Pose3, p_world: Floats) -> Floats:
    """Range (m) and azimuth (rad) of one point of the world, shape (2,)."""
    return view_points(world_T_sonar, p_world[None]).z[0]


def range_azimuth_jacobians(
    world_T_body: gtsam.Pose3, body_T_sonar: gtsam.Pose3, p_world: Floats
) -> tuple[Floats, Floats, Floats]:
    """Range and azimuth of one point of the world, shape (2,), with derivatives.

    These are by the right perturbation [theta, rho] of the body's pose, shape (2, 6), and by the point, shape (2, 3).
    """
    mount = Mount(*_as_arrays(body_T_sonar))
    view = views_from_body(
        *_as_arrays(world_T_body), mount, np.ascontiguousarray(p_world)[None]
    )
    return view.z[0], view.by_pose[0], view.by_point[0]


def _as_arrays(pose: gtsam.Pose3) -> tuple[Floats, Floats]:
    return np.ascontiguousarray(pose.rotation().matrix()), pose.translation()


def body_point_jacobian(R: Floats, q: Floats) -> Floats:
    """``R [-[q]x  I]``, shape (3, 6): a point q of the body moves so in the world by [theta, rho] of its pose."""
    return np.hstack((-R @ gtsam.SO3.Hat(q), R))


@compiled
def locate_from_body(
    R: Floats, X: Floats, mount: Mount, z: Floats, elevation_rad: float
) -> tuple[Floats, Floats, Floats]:
    """The point of the world, shape (3,), at range and azimuth z and an elevation from a body at (R, X).

    Returns as well its derivative by the right perturbation [theta, rho] of the body's pose, shape (3, 6), and by
    (range, azimuth, elevation), shape (3, 3).
    """
    world_R_body = mat(R)
    body_R_sonar = mat(mount.body_R_sonar)
    # in body axes
    q = vec(mount.body_p_sonar) + body_R_sonar @ _point_at(z[0], z[1], elevation_rad)
    p = vec(X) + world_R_body @ q
    by_body = np.empty((3, 6))  # R [-[q]x  I]
    store(-1.0 * (world_R_body @ skew(q)), by_body)
    store(world_R_body, by_body, UPPER_RIGHT)
    by_polar = np.empty((3, 3))
    store(
        world_R_body @ body_R_sonar @ _point_jacobian(z[0], z[1], elevation_rad),
        by_polar,
    )
    return np.array([p.x, p.y, p.z]), by_body, by_polar


@inlined
def _point_at(range_m: float, azimuth_rad: float, elevation_rad: float) -> Vec3:
    """The point in the sonar frame with these spherical coordinates."""
    level_m = range_m * math.cos(elevation_rad)
    return Vec3(
        level_m * math.cos(azimuth_rad),
        level_m * math.sin(azimuth_rad),
        range_m * math.sin(elevation_rad),
    )


@inlined
def _point_jacobian(range_m: float, azimuth_rad: float, elevation_rad: float) -> Mat3:
    """Derivative of `_point_at` by (range, azimuth, elevation)."""
    ca = math.cos(azimuth_rad)
    sa = math.sin(azimuth_rad)
    ce = math.cos(elevation_rad)
    se = math.sin(elevation_rad)
    r = range_m
    return Mat3(
        Vec3(ce * ca, -r * ce * sa, -r * se * ca),
        Vec3(ce * sa, r * ce * ca, -r * se * sa),
        Vec3(se, 0.0, r * ce),
    )


def locate(
    world_T_sonar: gtsam.Pose3, range_m: float, azimuth_rad: float, elevation_rad: float
) -> Floats:
    """The point of the world at these spherical coordinates of the sonar, shape (3,), m."""
    in_sonar = np.array(_point_at(range_m, azimuth_rad, elevation_rad))
    return world_T_sonar.transformFrom(in_sonar)


def locate_jacobians(
    world_T_body: gtsam.Pose3,
    body_T_sonar: gtsam.Pose3,
    range_m: float,
    azimuth_rad: float,
    elevation_rad: float,
) -> tuple[Floats, Floats, Floats]:
    """A located point with derivatives, as `locate_from_body`."""
    R, X = _as_arrays(world_T_body)
    return locate_from_body(
        R,
        X,
        Mount(*_as_arrays(body_T_sonar)),
        np.array([range_m, azimuth_rad]),
        elevation_rad,
    )


def elevation_on_floor(
    world_T_sonar: gtsam.Pose3,
    range_m: float,
    azimuth_rad: float,
    floor_z_m: float,
    aperture_rad: float,
) -> float | None:
    """Elevation (rad) at which a detected point lies on the floor.

    With the last row (a, b, c) of world_R_sonar and the floor at a height above the sonar::

        (a cos(azimuth) + b sin(azimuth)) cos(e) + c sin(e) = height / range

    which is ``A cos(e - e0) = height / range``: of its two solutions the one nearer to the centre beam. None where the
    floor, at a height ``floor_z_m`` in the world, is not within the full vertical aperture.
    """
    up = np.ascontiguousarray(world_T_sonar.rotation().matrix()[2])
    elevation_rad = floor_elevation(
        up, floor_z_m - world_T_sonar.z(), range_m, azimuth_rad
    )
    return elevation_rad if abs(elevation_rad) <= 0.5 * aperture_rad else None


@compiled
def floor_elevation(
    up: Floats, height_m: float, range_m: float, azimuth_rad: float
) -> float:
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
    # False for a NaN height: the floor is not known
    is_reached = reach_m > 0.0 and abs(height_m) <= reach_m
    if not is_reached:
        return math.nan
    # the solutions are e0 - half and e0 + half, where the ray of elevation e0 climbs most steeply
    middle = math.atan2(up[2], level)  # e0
    half = math.acos(height_m / reach_m)
    one = wrap_angle(middle + half)
    other = wrap_angle(middle - half)
    return one if abs(one) <= abs(other) else other


ACCEPTED = -1
"""In place of an outcome."""
MINIMUM_PROBABILITY = 0.7
"""Default of every estimator: a wrong identity, which may spoil a landmark for good, weighs more than a lost one."""
NO_IDENTITY = OUTCOME_NUMBERS[Outcome.NO_IDENTITY]
REPEATED = OUTCOME_NUMBERS[Outcome.REPEATED]
UNSOUND = OUTCOME_NUMBERS[Outcome.UNSOUND]


def identify(
    detections: LandmarkDetections,
    minimum_probability: float,
    *,
    are_sound: bool = False,
) -> tuple[Ints, NDArray[np.int8]]:
    """Most probable identity of each row, shape (n,), and `ACCEPTED` or the `OUTCOME_NUMBERS` of its refusal, (n,).

    Refused is an unsound row, and a posterior that is too low or NaN, or of no identity (-1). A landmark is in one
    place: of several rows of one frame with one identity the most probable is accepted, the first of equals.
    ``are_sound``: True where unsound rows have been left out.
    """
    ids = np.empty(len(detections), np.int64)
    outcomes = np.full(len(detections), ACCEPTED, np.int8)
    # several operations of NumPy: as long as all else here
    if not are_sound:
        outcomes[~detections.are_sound()] = UNSOUND
    rows = (detections.stamps_ns, detections.candidate_ids, detections.id_probability)
    _write_identities(*rows, minimum_probability, ids, outcomes)
    return ids, outcomes


@compiled
def _write_identities(
    stamps_ns: Ints,
    candidates: Ints,
    posterior: Floats,
    minimum: float,
    ids: Ints,
    outcomes: NDArray[np.int8],
) -> None:
    """Fill what `identify` returns; outcomes other than `ACCEPTED` stay."""
    p = np.empty(len(ids))
    for row in range(len(ids)):
        # of equal posteriors the first
        best = 0
        for k in range(1, candidates.shape[1]):
            if posterior[row, k] > posterior[row, best]:
                best = k
        ids[row] = candidates[row, best]
        p[row] = posterior[row, best]
        # not (p >= minimum): a NaN is refused too
        if outcomes[row] == ACCEPTED and not (p[row] >= minimum and ids[row] >= 0):
            outcomes[row] = NO_IDENTITY
        # rows of one frame follow each other
        other = row - 1
        while other >= 0 and stamps_ns[other] == stamps_ns[row]:
            if (
                ids[other] == ids[row]
                and outcomes[other] == ACCEPTED
                and outcomes[row] == ACCEPTED
            ):
                outcomes[row if p[row] <= p[other] else other] = REPEATED
            other -= 1
