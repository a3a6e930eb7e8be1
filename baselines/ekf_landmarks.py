"""Landmarks in EKF-SLAM: the paper's observation (6) and innovation (7), and augmentation at first sight.

All happens at the instant of a frame, which lies a provisional motion (dR, dp, cov) after the state. What a sensor sees
from there depends on state and motion through how far a point s fixed in the body (in the axes of the state's body)
moves along a direction n (in the same axes)::

    row(n, s) = [ (R n)^T   (s x n)^T W | ((s - dp) x n)^T   n^T ]     by X, (phi, theta, psi) | theta_i, eps

Observation and innovation, for a landmark at ``p_b = dR^T (p_n - dp)``, ``p_n = R^T (p - X)`` in the body frame then::

    z     = h(x_v, p)                                     (6)  range and azimuth, `sonar_graph.slam.models.project`
    e     = z_measured - z, azimuth wrapped               (7)
    H_v | H_m = row(-n, p_n),   H_p = (R n)^T             for n = dR body_R_sonar D_q^T of range and azimuth each
    S     = H P H^T + R_z + H_m cov H_m^T

A new landmark at ``p = g(x_v, z, elevation) = X + R s``, with ``G_v | G_m = row(n, s)`` for the world's three axes n::

    P_pv = G_v P_v.,   P_pp = G_v P_vv G_v^T + G_m cov G_m^T + G_z diag(R_z, elevation_sigma^2) G_z^T

On a floor of known height, the height p_z is measured once, then and there: innovation ``floor - p_z``, variance
``P_pp[z, z] + floor_sigma^2``. A point whose range and azimuth show no floor within the aperture has elevation 0, and
an innovation that the gate of the floor refuses unless the floor is near the aperture's edge: it is something in the
water, or a false detection, and must not move the vehicle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from baselines.ekf_state import LANDMARK, POSE, correct, correct_by, correct_pair
from baselines.euler import rates_from_euler, rotation_from_euler
from baselines.far_views import by_range_and_azimuth, is_beyond_linear, view_noise
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.recursion import Integral
from sonar_graph.navigation.triples import (
    Matrix,
    Vector,
    cross,
    dot,
    matrix,
    minus,
    place,
    plus,
    product,
    sandwich,
    scaled,
    symmetric,
    times,
    transformed,
    transposed,
    vector,
)
from sonar_graph.slam.models import (
    FLOOR_GATE,
    floor_elevation,
    project,
    sonar_point,
    sonar_point_jacobian,
    wrap_angle,
)

USED, NEW, GATED, PASSED_OVER = 0, 1, 2, 3
"""What became of a detection, in compiled code."""
NO_SLOT = -1
"""The place of a detection that is not to be used."""


class SonarModel(NamedTuple):
    """What is known of sonar and floor."""

    body_R_sonar: Matrix
    body_p_sonar: Vector
    gate: float
    """Squared Mahalanobis distance beyond which an innovation is refused."""
    aperture_rad: float
    range_variance_m2: float
    """Where the log does not say."""
    azimuth_variance: float
    """Where the log does not say, rad²."""
    has_floor: bool
    floor_z_m: float
    floor_variance_m2: float


DetectionColumns = tuple[Ints, Floats, Floats, Floats]
"""Place of each row's landmark in the state, the first unused one for a new landmark, or NO_SLOT (m,); range in m and
azimuth in rad (m,); their covariance (m, 2, 2), NaN where the log does not say."""
SonarValues = tuple[Matrix, Vector, float, float, float, float, bool, float, float]


class Moment(NamedTuple):
    """The state, and what lies between it and the instant of a frame."""

    X: Vector
    R: Matrix
    W: Matrix
    motion: Integral


class Row(NamedTuple):
    """Derivative of one number by the pose state and by the motion since."""

    by_X: Vector
    by_angles: Vector
    by_theta: Vector
    by_eps: Vector


@compiled
def moment_after(x: Floats, motion: Integral) -> Moment:
    """The state and a motion after it."""
    angles = vector(x[3:])
    return Moment(vector(x), rotation_from_euler(angles), rates_from_euler(angles), motion)


@inlined
def row_along(moment: Moment, n: Vector, s: Vector) -> Row:
    """``row(n, s)`` of the module's docstring."""
    by_angles = times(transposed(moment.W), cross(s, n))
    return Row(times(moment.R, n), by_angles, cross(minus(s, moment.motion.dp), n), n)


@compiled
def motion_covariance(motion: Integral, one: Row, other: Row) -> float:
    """``H_m cov H_m^T`` of two numbers."""
    theta = plus(times(motion.cov_tt, other.by_theta), times(transposed(motion.cov_rt), other.by_eps))
    eps = plus(times(motion.cov_rt, other.by_theta), times(motion.cov_rr, other.by_eps))
    return dot(one.by_theta, theta) + dot(one.by_eps, eps)


@inlined
def add_covariances(P: Floats, n: int, at: int, factors: Vector, out: Floats) -> None:
    """``out += factors^T P[at : at + 3]``, shape (n,)."""
    for k in range(3):
        factor = factors[k]
        for c in range(n):
            out[c] += factor * P[at + k, c]


@compiled
def observe_rows(
    x: Floats,
    P: Floats,
    n: int,
    motion: Integral,
    sonar: SonarModel,
    detections: DetectionColumns,
    first: int,
    last: int,
    outcomes: Ints,
    innovations: Floats,
    covs: Floats,
    was_lost: bool = False,
) -> int:
    """Take in some rows, all of one instant, one after the other.

    Parameters
    ----------
    motion
        From the state to that instant.
    first, last
        Rows from the first up to, without, the last.
    outcomes, innovations, covs
        Written: USED, NEW, GATED or PASSED_OVER, shape (m,); innovations (m, 2) and their covariances (m, 2, 2), which
        stay as they are where nothing is predicted.
    was_lost
        Whether the Doppler log has lost the bottom: from then on views are linearised as in `baselines.far_views`,
        where it takes that.

    Returns
    -------
    Length of the state.
    """
    slots, range_m, azimuth_rad, noise = detections
    for row in range(first, last):
        if slots[row] == NO_SLOT:
            outcomes[row] = PASSED_OVER
            continue
        at = POSE + LANDMARK * slots[row]
        z, R_z = (range_m[row], azimuth_rad[row]), logged_noise(noise[row], sonar)
        moment = moment_after(x, motion)
        if at >= n:
            _augment(x, P, n, moment, sonar, z, R_z)
            n += LANDMARK
            outcomes[row] = NEW
        elif was_lost:
            outcomes[row] = _observe_far(x, P, n, at, moment, sonar, z, R_z, innovations[row], covs[row])
        else:
            outcomes[row] = _observe(x, P, n, at, moment, sonar, z, R_z, innovations[row], covs[row])
    return n


Noise = tuple[float, float, float]
"""Variance of the range, covariance, variance of the azimuth."""


@inlined
def logged_noise(logged: Floats, sonar: SonarModel) -> Noise:
    """Of range and azimuth: as logged, or the calibration's."""
    if math.isnan(logged[0, 0] + logged[0, 1] + logged[1, 0] + logged[1, 1]):
        return sonar.range_variance_m2, 0.0, sonar.azimuth_variance
    return logged[0, 0], 0.5 * (logged[0, 1] + logged[1, 0]), logged[1, 1]


@compiled
def observation(moment: Moment, p: Vector, sonar: SonarModel) -> tuple[Floats, Row, Row]:
    """(6): predicted range and azimuth (2,), and ``H_v | H_m`` of each; ``H_p`` is the opposite of its ``by_X``."""
    motion = moment.motion
    p_n = times(transposed(moment.R), minus(p, moment.X))
    p_b = times(transposed(motion.dR), minus(p_n, motion.dp))
    q = times(transposed(sonar.body_R_sonar), minus(p_b, sonar.body_p_sonar))
    z, D_q = project(np.array(q))
    node_R_sonar = product(motion.dR, sonar.body_R_sonar)
    by_range, by_azimuth = times(node_R_sonar, vector(D_q[0])), times(node_R_sonar, vector(D_q[1]))
    return z, row_along(moment, scaled(-1.0, by_range), p_n), row_along(moment, scaled(-1.0, by_azimuth), p_n)


@inlined
def _observe(
    x: Floats,
    P: Floats,
    n: int,
    at: int,
    moment: Moment,
    sonar: SonarModel,
    z: tuple[float, float],
    R_z: Noise,
    innovation: Floats,
    S: Floats,
) -> int:
    """Correct by a landmark that is in the state, where its innovation is inside the gate."""
    predicted, by_range, by_azimuth = observation(moment, vector(x[at:]), sonar)
    innovation[0], innovation[1] = z[0] - predicted[0], wrap_angle(z[1] - predicted[1])  # (7)
    U = np.zeros((2, n))
    _add_row_covariances(P, n, at, by_range, U[0])
    _add_row_covariances(P, n, at, by_azimuth, U[1])
    motion = moment.motion
    S[0, 0] = _variance_share(U[0], at, by_range) + R_z[0] + motion_covariance(motion, by_range, by_range)
    S[0, 1] = _variance_share(U[0], at, by_azimuth) + R_z[1] + motion_covariance(motion, by_range, by_azimuth)
    S[1, 1] = _variance_share(U[1], at, by_azimuth) + R_z[2] + motion_covariance(motion, by_azimuth, by_azimuth)
    S[1, 0] = S[0, 1]
    if not squared_distance(innovation, S) <= sonar.gate:
        return GATED
    correct_pair(x, P, n, U, S, innovation)
    return USED


@compiled
def _observe_far(
    x: Floats,
    P: Floats,
    n: int,
    at: int,
    moment: Moment,
    sonar: SonarModel,
    z: tuple[float, float],
    R_z: Noise,
    innovation: Floats,
    S: Floats,
) -> int:
    """Correct by a landmark that may be far from where it is predicted, inside the gate: `baselines.far_views`."""
    point, G, by_view = location(moment, sonar, z, 0.0)
    G_z = np.array(by_view)
    U, cov, missed = np.empty((LANDMARK, n)), np.empty((LANDMARK, LANDMARK)), np.empty(LANDMARK)
    for r in range(LANDMARK):
        missed[r], U[r] = point[r] - x[at + r], P[at + r, :n]
        add_covariances(P, n, 0, scaled(-1.0, G[r].by_X), U[r])
        add_covariances(P, n, 3, scaled(-1.0, G[r].by_angles), U[r])
    for r in range(LANDMARK):
        for c in range(r + 1):
            share = dot(G[c].by_X, vector(U[r])) + dot(G[c].by_angles, vector(U[r, 3:]))
            cov[r, c] = cov[c, r] = U[r, at + c] - share + motion_covariance(moment.motion, G[r], G[c])
    if not is_beyond_linear(cov, G_z, z[0], R_z):
        return int(_observe(x, P, n, at, moment, sonar, z, R_z, innovation, S))
    cov += G_z @ view_noise(z[0], R_z, sonar.aperture_rad) @ G_z.T
    B = by_range_and_azimuth(G_z, z[0])
    innovation[:], S[:] = B @ missed, B @ cov @ B.T
    if not squared_distance(innovation, S) <= sonar.gate:
        return GATED
    correct_by(x, P, n, U, cov, missed)
    return USED


@inlined
def _add_row_covariances(P: Floats, n: int, at: int, row: Row, out: Floats) -> None:
    """``out += H P`` for a row of H with a landmark, shape (n,): only columns of pose and landmark are not zero."""
    add_covariances(P, n, 0, row.by_X, out)
    add_covariances(P, n, 3, row.by_angles, out)
    add_covariances(P, n, at, scaled(-1.0, row.by_X), out)


@inlined
def _variance_share(U: Floats, at: int, row: Row) -> float:
    """``U H^T`` for a row of H with a landmark."""
    return dot(row.by_X, minus(vector(U), vector(U[at:]))) + dot(row.by_angles, vector(U[3:]))


@inlined
def squared_distance(e: Floats, S: Floats) -> float:
    """``e^T S^-1 e`` for two numbers."""
    determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    return (S[1, 1] * e[0] * e[0] - (S[0, 1] + S[1, 0]) * e[0] * e[1] + S[0, 0] * e[1] * e[1]) / determinant


@inlined
def _augment(
    x: Floats, P: Floats, n: int, moment: Moment, sonar: SonarModel, z: tuple[float, float], R_z: Noise
) -> None:
    """Append a landmark where it was seen; its elevation from the floor where there is one, else zero."""
    point, G, G_z = location(moment, sonar, z, _elevation(moment, sonar, z))
    noise = ((R_z[0], R_z[1], 0.0), (R_z[1], R_z[2], 0.0), (0.0, 0.0, sonar.aperture_rad**2 / 12.0))
    own = np.empty((LANDMARK, LANDMARK))
    place(symmetric(sandwich(G_z, noise, G_z)), own, 0, 0)
    for r in range(LANDMARK):
        x[n + r] = point[r]
        P[n + r, :n] = 0.0
        add_covariances(P, n, 0, G[r].by_X, P[n + r])
        add_covariances(P, n, 3, G[r].by_angles, P[n + r])
        for c in range(n):
            P[c, n + r] = P[n + r, c]
    for r in range(LANDMARK):
        for c in range(r + 1):
            own[r, c] += motion_covariance(moment.motion, G[r], G[c])
            own[r, c] += dot(G[c].by_X, vector(P[n + r])) + dot(G[c].by_angles, vector(P[n + r, 3:]))
            P[n + r, n + c] = P[n + c, n + r] = own[r, c]
    if sonar.has_floor:
        _stand_on_floor(x, P, n + LANDMARK, sonar)


@inlined
def _stand_on_floor(x: Floats, P: Floats, n: int, sonar: SonarModel) -> None:
    """Correct the height of the landmark at the end by the floor's, where it can stand there."""
    innovation, S = sonar.floor_z_m - x[n - 1], P[n - 1, n - 1] + sonar.floor_variance_m2
    if innovation * innovation <= FLOOR_GATE * S:
        correct(x, P, n, P[n - 1, :n].copy(), S, innovation)


@inlined
def _elevation(moment: Moment, sonar: SonarModel, z: tuple[float, float]) -> float:
    """Elevation on the floor; 0 without one, or where it is outside the aperture."""
    if not sonar.has_floor:
        return 0.0
    motion = moment.motion
    place_n = transformed(motion.dp, motion.dR, sonar.body_p_sonar)
    world_R_sonar = product(product(moment.R, motion.dR), sonar.body_R_sonar)
    height_m = sonar.floor_z_m - transformed(moment.X, moment.R, place_n)[2]
    elevation = floor_elevation(np.array(world_R_sonar[2]), height_m, z[0], z[1], sonar.aperture_rad)
    return 0.0 if math.isnan(elevation) else elevation


@compiled
def location(
    moment: Moment, sonar: SonarModel, z: tuple[float, float], elevation_rad: float
) -> tuple[Vector, tuple[Row, Row, Row], Matrix]:
    """The point g that a detection shows, ``G_v | G_m`` of its coordinates, G_z by (range, azimuth, elevation)."""
    motion = moment.motion
    p_b = transformed(sonar.body_p_sonar, sonar.body_R_sonar, vector(sonar_point(z[0], z[1], elevation_rad)))
    s = transformed(motion.dp, motion.dR, p_b)
    G = (row_along(moment, moment.R[0], s), row_along(moment, moment.R[1], s), row_along(moment, moment.R[2], s))
    world_R_sonar = product(product(moment.R, motion.dR), sonar.body_R_sonar)
    G_z = product(world_R_sonar, matrix(sonar_point_jacobian(z[0], z[1], elevation_rad)))
    return transformed(moment.X, moment.R, s), G, G_z
