"""Equations (4) to (7) of the paper's EKF-SLAM: state, prediction, observation and innovation, augmentation.

::

    x = [X, Y, Z, phi, theta, psi, p_1, ..., p_N]            (4)  p_i: landmark in the world, 3 numbers
    P = [ P_vv  P_vm ; P_vm^T  P_mm ]                        (5)
    z = h(x_v, p)                                            (6)  range and azimuth
    e = z_measured - z, azimuth wrapped                      (7)

Prediction over the motion (dR, dp, C) to the next DVL stamp, with ``R = Rz(psi) Ry(theta) Rx(phi)``::

    X' = X + R dp,  R' = R dR,   P_vv' = F P_vv F^T + G C G^T,  P_vm' = F P_vm
    F = [ I  -R [dp]x W  ]      G = [ 0         R ]
        [ 0   E' dR^T W  ]          [ E' dR^T   0 ]

Everything measured is a function of how far a point s of the body, a provisional motion after the state, moves along a
direction n (both in the axes of the state's body)::

    row(n, s) = [ (R n)^T   (s x n)^T W | ((s - dp) x n)^T   n^T ]     by X, (phi, theta, psi) | theta_i, eps

Update: ``S = H P H^T + R_z + H_m C H_m^T``, with ``H_v | H_m = row(-n, p_n)`` and ``H_p = (R n)^T`` for n of range and
azimuth each (`baselines.sonar_update`). Augmentation by a new landmark at ``g = X + R s``, with
``G_v | G_m = row(n, s)`` for the world's three axes n::

    P_pv = G_v P_v.,   P_pp = G_v P_vv G_v^T + G_m C G_m^T + G_z diag(R_z, elevation_sigma^2) G_z^T

W, E: `sonar_graph.numerics`. Arrays have room for more landmarks than there are; ``n`` is the length of the state.
Derivation and the choices the paper leaves open: docs/theory/ekf_slam.md.
"""

import math
from typing import NamedTuple

import numpy as np

from baselines.sonar_update import (
    GATED,
    NEW,
    NO_SLOT,
    PASSED_OVER,
    USED,
    DetectionRow,
    Frame,
    SonarModel,
    correct_jointly,
    detection_row,
    elevation_of_new,
    far_polar_covariance,
    is_beyond_linear,
    is_inside_gate,
    point_seen,
    polar_covariance,
    predicted_view,
    range_azimuth_jacobian,
)
from sonar_graph.measurements import Floats
from sonar_graph.navigation.preintegration import Integral
from sonar_graph.numerics import (
    Matrix,
    Vector,
    compiled,
    cross,
    dot,
    euler_from_rates,
    euler_from_rotation,
    inlined,
    matrix,
    minus,
    place,
    plus,
    product,
    rates_from_euler,
    rotation_from_euler,
    sandwich,
    scaled,
    skew_times,
    sum_of,
    symmetric,
    times,
    transformed,
    transposed,
    vector,
)
from sonar_graph.slam.models import FLOOR_GATE, sonar_point_jacobian, wrap_angle

POSE = 6
"""Length of x_v."""
LANDMARK = 3
"""Length of p_i."""


@inlined
def predict(x: Floats, P: Floats, n: int, motion: Integral) -> None:
    """Carry state and covariance over a motion, with ``F = [[I, A], [0, B]]`` on the pose."""
    angles = vector(x[3:])
    R, W = rotation_from_euler(angles), rates_from_euler(angles)
    angles_after = euler_from_rotation(product(R, motion.dR))
    E_dR = product(euler_from_rates(angles_after), transposed(motion.dR))
    A, B = product(R, skew_times(scaled(-1.0, motion.dp), W)), product(E_dR, W)
    _set_triple(x, 0, transformed(vector(x), R, motion.dp))
    _set_triple(x, 3, angles_after)
    XX, XE, EE = matrix(P[:, :3]), matrix(P[:, 3:]), matrix(P[3:, 3:])
    XE_carried = sum_of(XE, product(A, EE))
    XX = sum_of(sum_of(XX, product(XE_carried, transposed(A))), product(A, transposed(XE)))
    XX = sum_of(XX, sandwich(R, motion.cov_rr, R))
    XE = sum_of(product(XE_carried, transposed(B)), sandwich(R, motion.cov_rt, E_dR))
    EE = sum_of(sandwich(B, EE, B), sandwich(E_dR, motion.cov_tt, E_dR))
    _place_symmetric(symmetric(XX), transposed(XE), symmetric(EE), P)
    for c in range(POSE, n):
        carried = (P[3, c], P[4, c], P[5, c])
        column = plus((P[0, c], P[1, c], P[2, c]), times(A, carried)) + times(B, carried)
        for r in range(POSE):
            P[r, c] = P[c, r] = column[r]


@inlined
def _place_symmetric(first: Matrix, mixed: Matrix, second: Matrix, out: Floats) -> None:
    """Write ``[[first, mixed^T], [mixed, second]]``."""
    place(first, out, 0, 0)
    place(transposed(mixed), out, 0, 3)
    place(mixed, out, 3, 0)
    place(second, out, 3, 3)


@inlined
def pose_after(x: Floats, P: Floats, motion: Integral) -> tuple[Floats, Floats, Floats]:
    """Pose of the body a motion after the state, with the covariance of its perturbation [theta, rho].

    ``theta = dR^T (W d(angles) + theta_i)`` and ``rho = dR^T (R^T dX - [dp]x W d(angles) + eps)``.

    Returns world_R_body (3, 3), position (3,), covariance (6, 6).
    """
    angles = vector(x[3:])
    R, W = rotation_from_euler(angles), rates_from_euler(angles)
    V, node_R_world, j_R_i = skew_times(scaled(-1.0, motion.dp), W), transposed(R), transposed(motion.dR)
    XX, XE, EE = matrix(P[:, :3]), product(node_R_world, matrix(P[:, 3:])), matrix(P[3:, 3:])
    XE_carried = sum_of(XE, product(V, EE))
    tt = sum_of(sandwich(W, EE, W), motion.cov_tt)
    rt = sum_of(product(XE_carried, transposed(W)), motion.cov_rt)
    rr = sum_of(sandwich(node_R_world, XX, node_R_world), motion.cov_rr)
    rr = sum_of(rr, sum_of(product(XE_carried, transposed(V)), product(V, transposed(XE))))
    own = np.empty((POSE, POSE))
    _place_symmetric(
        symmetric(sandwich(j_R_i, tt, j_R_i)),
        sandwich(j_R_i, rt, j_R_i),
        symmetric(sandwich(j_R_i, rr, j_R_i)),
        own,
    )
    return np.array(product(R, motion.dR)), np.array(transformed(vector(x), R, motion.dp)), own


@inlined
def _set_triple(x: Floats, at: int, value: Vector) -> None:
    """Write three numbers of the state."""
    x[at], x[at + 1], x[at + 2] = value


@inlined
def correct(x: Floats, P: Floats, n: int, cross_cov: Floats, S: float, innovation: float) -> None:
    """Update by one number: ``w = P H^T / sqrt(S)``, ``P <- P - w w^T``, ``x <- x + w innovation / sqrt(S)``.

    The products commute, so that P stays symmetric to the last bit. ``cross_cov`` is ``P H^T`` (n,), overwritten.
    """
    root = math.sqrt(S)
    w, share = cross_cov, innovation / root
    for i in range(n):
        w[i] /= root
    for i in range(n):
        for j in range(n):
            P[i, j] -= w[i] * w[j]
        x[i] += w[i] * share
    _wrap(x)


@inlined
def correct_pair(x: Floats, P: Floats, n: int, cross_cov: Floats, S: Floats, innovation: Floats) -> None:
    """Update by two numbers at once: as `correct`, with the Cholesky factor of S (2, 2) in place of the root.

    ``cross_cov`` is ``H P`` (2, n), overwritten.
    """
    l_00 = math.sqrt(S[0, 0])
    l_10 = S[1, 0] / l_00
    l_11 = math.sqrt(S[1, 1] - l_10 * l_10)
    first, second = cross_cov[0], cross_cov[1]
    for i in range(n):
        first[i] /= l_00
        second[i] = (second[i] - l_10 * first[i]) / l_11
    y_0 = innovation[0] / l_00
    y_1 = (innovation[1] - l_10 * y_0) / l_11
    for i in range(n):
        for j in range(n):
            P[i, j] -= first[i] * first[j] + second[i] * second[j]
        x[i] += first[i] * y_0 + second[i] * y_1
    _wrap(x)


@compiled
def correct_by(x: Floats, P: Floats, n: int, cross_cov: Floats, S: Floats, innovation: Floats) -> None:
    """Update by m numbers at once: as `correct_pair`, with shapes (m, n), (m, m) and (m,)."""
    correct_jointly(P, n, cross_cov, S, innovation, x)
    _wrap(x)


@inlined
def _wrap(x: Floats) -> None:
    """Keep roll and yaw in (-pi, pi]."""
    x[3], x[5] = wrap_angle(x[3]), wrap_angle(x[5])


class Moment(NamedTuple):
    """Pose of the state, and the motion from it to the instant of a frame."""

    X: Vector
    R: Matrix
    W: Matrix
    motion: Integral


class MeasurementRow(NamedTuple):
    """Derivative of one number by the pose state and by the motion since."""

    by_X: Vector
    by_angles: Vector
    by_theta: Vector
    by_eps: Vector


@compiled
def moment_after(x: Floats, motion: Integral) -> Moment:
    """The moment a motion after the state."""
    angles = vector(x[3:])
    return Moment(vector(x), rotation_from_euler(angles), rates_from_euler(angles), motion)


@inlined
def row_along(moment: Moment, n: Vector, s: Vector) -> MeasurementRow:
    """The derivatives ``row(n, s)``."""
    by_angles = times(transposed(moment.W), cross(s, n))
    return MeasurementRow(times(moment.R, n), by_angles, cross(minus(s, moment.motion.dp), n), n)


@compiled
def motion_covariance(motion: Integral, one: MeasurementRow, other: MeasurementRow) -> float:
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


@inlined
def correct_up(x: Floats, P: Floats, n: int, up: Vector, sigma: float) -> None:
    """Update roll and pitch by the direction of the world's up in the body."""
    level = math.hypot(up[1], up[2])
    correct_state(x, P, n, 3, math.atan2(up[1], up[2]), (sigma / level) ** 2)
    correct_state(x, P, n, 4, math.atan2(-up[0], level), sigma**2)


@inlined
def correct_state(x: Floats, P: Floats, n: int, at: int, value: float, variance: float) -> None:
    """Update by a direct measurement of Z or of an angle."""
    innovation = value - x[at] if at < 3 else wrap_angle(value - x[at])
    correct(x, P, n, P[at, :n].copy(), P[at, at] + variance, innovation)


@inlined
def correct_depth(x: Floats, P: Floats, n: int, motion: Integral, port: Vector, z_m: float, variance_m2: float) -> None:
    """Update by the height of the pressure port, ``(X + R s)_z`` with ``s = dp + dR port``: row(n, s) along up."""
    moment = moment_after(x, motion)
    s = transformed(motion.dp, motion.dR, port)
    row = row_along(moment, moment.R[2], s)
    U = np.zeros(n)
    add_covariances(P, n, 0, row.by_X, U)
    add_covariances(P, n, 3, row.by_angles, U)
    S = dot(row.by_X, vector(U)) + dot(row.by_angles, vector(U[3:])) + motion_covariance(motion, row, row) + variance_m2
    correct(x, P, n, U, S, z_m - x[2] - dot(moment.R[2], s))


@inlined
def augment(x: Floats, P: Floats, n: int, moment: Moment, sonar: SonarModel, seen: DetectionRow) -> None:
    """Append a landmark where it was seen.

    On a floor of known height its height is measured once, with the variance ``P_pp[z, z] + floor_sigma^2``, unless the
    floor's gate refuses it: a point far from the floor is something in the water or a false detection.
    """
    elevation_rad = elevation_of_new(moment.X, moment.R, moment.motion, sonar, seen.z)
    point, G, G_z = location(moment, sonar, seen.z, elevation_rad)
    noise = polar_covariance(seen.R_z, sonar.aperture_rad)
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
        n += LANDMARK
        innovation, S = sonar.floor_z_m - x[n - 1], P[n - 1, n - 1] + sonar.floor_variance_m2
        if innovation * innovation <= FLOOR_GATE * S:
            correct(x, P, n, P[n - 1, :n].copy(), S, innovation)


@compiled
def location(
    moment: Moment, sonar: SonarModel, z: tuple[float, float], elevation_rad: float
) -> tuple[Vector, tuple[MeasurementRow, MeasurementRow, MeasurementRow], Matrix]:
    """The point g that a detection shows, its ``G_v | G_m``, and G_z by (range, azimuth, elevation)."""
    motion = moment.motion
    s = point_seen(motion, sonar, z, elevation_rad)
    G = (row_along(moment, moment.R[0], s), row_along(moment, moment.R[1], s), row_along(moment, moment.R[2], s))
    world_R_sonar = product(product(moment.R, motion.dR), sonar.body_R_sonar)
    G_z = product(world_R_sonar, matrix(sonar_point_jacobian(z[0], z[1], elevation_rad)))
    return transformed(moment.X, moment.R, s), G, G_z


@compiled
def observe_rows(x: Floats, P: Floats, n: int, motion: Integral, sonar: SonarModel, frame: Frame) -> int:
    """Update by the rows of a frame, a motion after the state, one after the other; returns the state's length."""
    outcomes = frame.outcomes[0]
    for row in range(frame.first, frame.last):
        seen, moment = detection_row(frame, row, sonar), moment_after(x, motion)
        at = POSE + LANDMARK * seen.slot
        if seen.slot == NO_SLOT:
            outcomes[row] = PASSED_OVER
        elif at >= n:
            augment(x, P, n, moment, sonar, seen)
            n += LANDMARK
            outcomes[row] = NEW
        elif frame.was_lost:
            outcomes[row] = observe_far(x, P, n, at, moment, sonar, seen)
        else:
            outcomes[row] = _observe(x, P, n, at, moment, sonar, seen)
    return n


@compiled
def observation(moment: Moment, p: Vector, sonar: SonarModel) -> tuple[Floats, MeasurementRow, MeasurementRow]:
    """(6): predicted range and azimuth (2,), and ``H_v | H_m`` of each; ``H_p`` is the opposite of its ``by_X``."""
    z, p_n, by_range, by_azimuth = predicted_view(moment.X, moment.R, moment.motion, sonar, p)
    return z, row_along(moment, scaled(-1.0, by_range), p_n), row_along(moment, scaled(-1.0, by_azimuth), p_n)


@inlined
def _observe(x: Floats, P: Floats, n: int, at: int, moment: Moment, sonar: SonarModel, seen: DetectionRow) -> int:
    """Update by a landmark of the state where its innovation is inside the gate."""
    predicted, by_range, by_azimuth = observation(moment, vector(x[at:]), sonar)
    _, z, R_z, innovation, S = seen
    innovation[0], innovation[1] = z[0] - predicted[0], wrap_angle(z[1] - predicted[1])  # (7)
    U = np.zeros((2, n))
    _add_row_covariances(P, n, at, by_range, U[0])
    _add_row_covariances(P, n, at, by_azimuth, U[1])
    motion = moment.motion
    S[0, 0] = _variance_share(U[0], at, by_range) + R_z[0] + motion_covariance(motion, by_range, by_range)
    S[0, 1] = _variance_share(U[0], at, by_azimuth) + R_z[1] + motion_covariance(motion, by_range, by_azimuth)
    S[1, 1] = _variance_share(U[1], at, by_azimuth) + R_z[2] + motion_covariance(motion, by_azimuth, by_azimuth)
    S[1, 0] = S[0, 1]
    if not is_inside_gate(seen, sonar):
        return GATED
    correct_pair(x, P, n, U, S, innovation)
    return USED


@compiled
def observe_far(x: Floats, P: Floats, n: int, at: int, moment: Moment, sonar: SonarModel, seen: DetectionRow) -> int:
    """Update by a landmark that may be far from where it is predicted, (2) of `baselines.sonar_update`."""
    _, z, R_z, innovation, S = seen
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
        return int(_observe(x, P, n, at, moment, sonar, seen))
    cov += G_z @ far_polar_covariance(z[0], R_z, sonar.aperture_rad) @ G_z.T
    B = range_azimuth_jacobian(G_z, z[0])
    innovation[:], S[:] = B @ missed, B @ cov @ B.T
    if not is_inside_gate(seen, sonar):
        return GATED
    correct_by(x, P, n, U, cov, missed)
    return USED


@inlined
def _add_row_covariances(P: Floats, n: int, at: int, row: MeasurementRow, out: Floats) -> None:
    """``out += H P`` for a row of H with a landmark, shape (n,); only columns of pose and landmark are not zero."""
    add_covariances(P, n, 0, row.by_X, out)
    add_covariances(P, n, 3, row.by_angles, out)
    add_covariances(P, n, at, scaled(-1.0, row.by_X), out)


@inlined
def _variance_share(U: Floats, at: int, row: MeasurementRow) -> float:
    """``U H^T`` for a row of H with a landmark."""
    return dot(row.by_X, minus(vector(U), vector(U[at:]))) + dot(row.by_angles, vector(U[3:]))
