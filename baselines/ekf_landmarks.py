"""Landmarks in EKF-SLAM: the paper's observation (6) and innovation (7), and augmentation at first sight.

All happens at the instant of a frame, which lies a provisional motion (dR, dp, cov) after the state. With
``R_t = R dR``, ``p_t = X + R dp`` the body then, T from `perturbation_jacobian` and a landmark at
``p_b = R_t^T (p - p_t)`` in the body frame::

    z     = h(x_v, p)                                     (6)  range and azimuth, `sonar_graph.slam.models.project`
    e     = z_measured - z, azimuth wrapped               (7)
    H_b   = D_q sonar_R_body [ [p_b]x | -I ]              by the body's perturbation then
    H_v   = H_b T,   H_p = D_q sonar_R_body R_t^T         by the state
    S     = H P H^T + R + H_b cov H_b^T

A new landmark at ``p = g(x_v, z, elevation) = p_t + R_t p_b`` with ``G_b = R_t [ -[p_b]x | I ]``::

    P_pv = G_b T P_v.,   P_pp = (G_b T) P_vv (G_b T)^T + G_b cov G_b^T + G_z diag(R, elevation_sigma^2) G_z^T
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from baselines.ekf_state import LANDMARK, POSE, correct, correct_pair, perturbation_jacobian, place, product, product_3
from baselines.euler import rotation_from_euler
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import compiled, skew
from sonar_graph.slam.models import floor_elevation, project, sonar_point, sonar_point_jacobian, wrap_angle

USED, NEW, GATED, PASSED_OVER = 0, 1, 2, 3
"""What became of a detection, in compiled code."""
NO_SLOT = -1
"""The place of a detection that is not to be used."""


class SonarModel(NamedTuple):
    """What is known of sonar and floor."""

    body_R_sonar: Floats
    body_p_sonar: Floats
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


Motion = tuple[Floats, Floats, Floats]
"""Rotation (3, 3), displacement (3,), covariance of [rotation, translation] at the end (6, 6)."""
DetectionColumns = tuple[Ints, Floats, Floats, Floats]
"""Place of each row's landmark in the state, the first unused one for a new landmark, or NO_SLOT (m,); range in m and
azimuth in rad (m,); their covariance (m, 2, 2), NaN where the log does not say."""
SonarValues = tuple[Floats, Floats, float, float, float, float, bool, float, float]


class Moment(NamedTuple):
    """The body at the instant of a frame."""

    world_R_body: Floats
    position: Floats
    T: Floats
    """Derivative of the perturbation [theta, rho] by the pose state, shape (6, 6)."""
    cov: Floats
    """Of the provisional motion, shape (6, 6)."""


@compiled
def moment_after(x: Floats, motion: Motion) -> Moment:
    """The body a motion after the state."""
    dR, dp, cov = motion
    R = rotation_from_euler(x[3:POSE])
    position = np.empty(3)
    for r in range(3):
        position[r] = x[r] + R[r, 0] * dp[0] + R[r, 1] * dp[1] + R[r, 2] * dp[2]
    return Moment(product_3(R, dR), position, perturbation_jacobian(x[3:POSE], dR, dp), cov)


@compiled
def pose_after(x: Floats, P: Floats, motion: Motion) -> tuple[Floats, Floats, Floats]:
    """world_R_body, position, and the covariance of [theta, rho] a motion after the state: ``T P_vv T^T + cov``."""
    moment = moment_after(x, motion)
    own = product(product(moment.T, P[:POSE, :POSE]), moment.T.T)
    for r in range(POSE):
        for c in range(r + 1):
            own[r, c] = own[c, r] = 0.5 * (own[r, c] + own[c, r] + moment.cov[r, c] + moment.cov[c, r])
    return moment.world_R_body, moment.position, own


@compiled
def observe_rows(
    x: Floats,
    P: Floats,
    n: int,
    motion: Motion,
    sonar: SonarModel,
    detections: DetectionColumns,
    first: int,
    last: int,
    outcomes: Ints,
    innovations: Floats,
    covs: Floats,
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
        z, R = np.array([range_m[row], azimuth_rad[row]]), _noise(noise[row], sonar)
        moment = moment_after(x, motion)
        if at >= n:
            _augment(x, P, n, moment, sonar, z, R)
            n += LANDMARK
            outcomes[row] = NEW
        else:
            outcomes[row] = _observe(x, P, n, at, moment, sonar, z, R, innovations[row], covs[row])
    return n


@compiled
def _noise(logged: Floats, sonar: SonarModel) -> Floats:
    """Covariance of range and azimuth: as logged, or the calibration's."""
    if not math.isnan(logged[0, 0] + logged[0, 1] + logged[1, 0] + logged[1, 1]):
        return logged
    return np.array([[sonar.range_variance_m2, 0.0], [0.0, sonar.azimuth_variance]])


@compiled
def observation(moment: Moment, p: Floats, body_R_sonar: Floats, body_p_sonar: Floats) -> tuple[Floats, Floats, Floats]:
    """(6): predicted range and azimuth (2,), H_b (2, 6) and H_p (2, 3)."""
    R_t = moment.world_R_body
    p_b, q = np.zeros(3), np.zeros(3)
    for r in range(3):
        for k in range(3):
            p_b[r] += R_t[k, r] * (p[k] - moment.position[k])
    for r in range(3):
        for k in range(3):
            q[r] += body_R_sonar[k, r] * (p_b[k] - body_p_sonar[k])
    z, D_q = project(q)
    by_p_b = product(D_q, body_R_sonar.T)
    H_b = np.empty((2, POSE))
    place(product(by_p_b, skew(p_b)), H_b, 0, 0)
    place(-by_p_b, H_b, 0, 3)
    return z, H_b, product(by_p_b, R_t.T)


@compiled
def _observe(
    x: Floats,
    P: Floats,
    n: int,
    at: int,
    moment: Moment,
    sonar: SonarModel,
    z: Floats,
    R: Floats,
    innovation: Floats,
    S: Floats,
) -> int:
    """Correct by a landmark that is in the state, where its innovation is inside the gate."""
    predicted, H_b, H_p = observation(moment, x[at : at + LANDMARK], sonar.body_R_sonar, sonar.body_p_sonar)
    innovation[0], innovation[1] = z[0] - predicted[0], wrap_angle(z[1] - predicted[1])  # (7)
    H_v = product(H_b, moment.T)
    U = _cross_covariance(P, n, at, H_v, H_p)
    motion_noise = product(product(H_b, moment.cov), H_b.T)
    for r in range(2):
        for c in range(2):
            S[r, c] = R[r, c] + motion_noise[r, c]
            for k in range(POSE):
                S[r, c] += U[r, k] * H_v[c, k]
            for k in range(LANDMARK):
                S[r, c] += U[r, at + k] * H_p[c, k]
    S[0, 1] = S[1, 0] = 0.5 * (S[0, 1] + S[1, 0])
    if not squared_distance(innovation, S) <= sonar.gate:
        return GATED
    correct_pair(x, P, n, U, S, innovation)
    return USED


@compiled
def _cross_covariance(P: Floats, n: int, at: int, H_v: Floats, H_p: Floats) -> Floats:
    """``H P``, shape (2, n): only the columns of pose and landmark in H are not zero."""
    U = np.zeros((2, n))
    for r in range(2):
        for k in range(POSE):
            for c in range(n):
                U[r, c] += H_v[r, k] * P[k, c]
        for k in range(LANDMARK):
            for c in range(n):
                U[r, c] += H_p[r, k] * P[at + k, c]
    return U


@compiled
def squared_distance(e: Floats, S: Floats) -> float:
    """``e^T S^-1 e`` for two numbers."""
    determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    return (S[1, 1] * e[0] * e[0] - (S[0, 1] + S[1, 0]) * e[0] * e[1] + S[0, 0] * e[1] * e[1]) / determinant


@compiled
def _augment(x: Floats, P: Floats, n: int, moment: Moment, sonar: SonarModel, z: Floats, R: Floats) -> None:
    """Append a landmark where it was seen; its elevation from the floor where there is one, else zero."""
    elevation = _elevation(moment, sonar, z)
    point, G_b, G_z = location(moment, sonar.body_R_sonar, sonar.body_p_sonar, z, elevation)
    noise = np.zeros((3, 3))
    place(R, noise, 0, 0)
    noise[2, 2] = sonar.aperture_rad**2 / 12.0
    G_v = product(G_b, moment.T)
    rows = product(G_v, P[:POSE, :n])
    own = (
        product(rows[:, :POSE], G_v.T)
        + product(product(G_b, moment.cov), G_b.T)
        + product_3(product_3(G_z, noise), G_z.T)
    )
    for r in range(LANDMARK):
        x[n + r] = point[r]
        for c in range(n):
            P[n + r, c] = P[c, n + r] = rows[r, c]
        for c in range(LANDMARK):
            P[n + r, n + c] = 0.5 * (own[r, c] + own[c, r])
    if sonar.has_floor:
        after = n + LANDMARK
        S = P[after - 1, after - 1] + sonar.floor_variance_m2
        correct(x, P, after, P[after - 1, :after].copy(), S, sonar.floor_z_m - x[after - 1])


@compiled
def _elevation(moment: Moment, sonar: SonarModel, z: Floats) -> float:
    """Elevation on the floor; 0 without one, or where it is outside the aperture."""
    if not sonar.has_floor:
        return 0.0
    R_sonar = product_3(moment.world_R_body, sonar.body_R_sonar)
    sonar_z = moment.position[2]
    for k in range(3):
        sonar_z += moment.world_R_body[2, k] * sonar.body_p_sonar[k]
    elevation = floor_elevation(R_sonar[2], sonar.floor_z_m - sonar_z, z[0], z[1], sonar.aperture_rad)
    return 0.0 if math.isnan(elevation) else elevation


@compiled
def location(
    moment: Moment, body_R_sonar: Floats, body_p_sonar: Floats, z: Floats, elevation_rad: float
) -> tuple[Floats, Floats, Floats]:
    """The point g (3,) that a detection shows, G_b (3, 6), and G_z by (range, azimuth, elevation) (3, 3)."""
    q = sonar_point(z[0], z[1], elevation_rad)
    R_t = moment.world_R_body
    p_b, point = body_p_sonar.copy(), moment.position.copy()
    for r in range(3):
        for k in range(3):
            p_b[r] += body_R_sonar[r, k] * q[k]
    for r in range(3):
        for k in range(3):
            point[r] += R_t[r, k] * p_b[k]
    G_b = np.empty((3, POSE))
    place(product_3(R_t, skew(-p_b)), G_b, 0, 0)
    place(R_t, G_b, 0, 3)
    G_z = product_3(product_3(R_t, body_R_sonar), sonar_point_jacobian(z[0], z[1], elevation_rad))
    return point, G_b, G_z
