"""Equations (4) to (7) of the paper's EKF-SLAM: state, prediction, observation and innovation, augmentation.

::

    x = [X, Y, Z, phi, theta, psi, c, p_1, ..., p_N]         (4)  p_i: landmark in the world, 3 numbers
    P = [ P_vv  P_vm ; P_vm^T  P_mm ]                        (5)
    z_hat = h(x_v, p)                                        (6)  range and azimuth
    e = z - z_hat, azimuth wrapped                           (7)

A motion (dR, dp) leads to the pose ``R' = R dR, X' = X + R dp``, with ``R = Rz(psi) Ry(theta) Rx(phi)``. C is the
covariance of its perturbation [theta, rho] in its last frame. All that is measured depends on the perturbation delta of
the pose after the motion, in the body's own axes, to which state and motion contribute ::

    delta = T dx_v + [theta; rho],      T = [ 0           dR^T W           ]
                                            [ dR^T R^T   -dR^T [dp]x W     ]

A point q of the body moves by ``R' (rho - [q]x theta)``: along a direction n, in body axes, ``H_b = [(q x n)^T, n^T]``.
The paper has no headings: c, the constant bias of a compass, is ours, and without headings nothing is learnt of it.
W, E: `sonar_graph.numerics.matrices`; E is infinite at a pitch of 90°, and no angles are nearer to it than `upright`
says. Derivation and choices that the paper leaves open: docs/theory/ekf_slam.md.
"""

import math

import numpy as np

from baselines.event_order import Motion
from baselines.sonar_update import GATED, Gate, SonarModel, admit, correction, far_view, polar_covariance
from sonar_graph.measurements import Floats
from sonar_graph.models import FLOOR_GATE, doubted, sonar_point, sonar_point_jacobian, wrap_angle, yaw_and_derivative
from sonar_graph.numerics import (
    I3,
    LOWER_LEFT,
    LOWER_RIGHT,
    O3,
    UPPER_RIGHT,
    Mat3,
    Mat6,
    Vec3,
    Vec6,
    body_rates_from_euler,
    compiled,
    cross,
    euler_from_rotation,
    euler_rates_from_body,
    inlined,
    mat,
    mat6,
    rotation_from_euler,
    skew,
    store,
    store6,
    vec,
)

POSE, COMPASS, MAP, LANDMARK = 6, 6, 7, 3
"""Length of x_v, place of c, that of p_1, and length of p_i."""
MOST_PITCH_RAD = 0.5 * math.pi - 1e-3
"""Nearer to 90° Euler angles count as singular."""

# -------------------------------------------------------------------------------- prediction


@inlined
def upright(angles: Vec3) -> Vec3:
    """Angles of a rotation, (phi, theta, psi), at which E is finite: by 1 mrad at most another attitude."""
    return Vec3(angles.x, max(-MOST_PITCH_RAD, min(angles.y, MOST_PITCH_RAD)), angles.z)


@compiled
def predict(x: Floats, P: Floats, dR_: Floats, dp_: Floats, C: Floats) -> None:
    """Carry state and covariance over a motion: ``P_vv <- F P_vv F^T + G C G^T``, ``P_vm <- F P_vm``."""
    dR, dp, angles = mat(dR_), vec(dp_), vec(x[3:])
    R, W = rotation_from_euler(angles), body_rates_from_euler(angles)
    X_after, angles_after = vec(x) + R @ dp, upright(euler_from_rotation(R @ dR))
    E = euler_rates_from_body(angles_after)
    F = Mat6(I3, -1.0 * (R @ skew(dp) @ W), O3, E @ dR.T @ W)
    G = Mat6(O3, R @ dR, E, O3)
    x[0], x[1], x[2] = X_after
    x[3], x[4], x[5] = angles_after
    store6(F @ mat6(P) @ F.T + G @ mat6(C) @ G.T, P)
    for c in range(POSE, len(x)):
        P_vc = F @ Vec6(Vec3(P[c, 0], P[c, 1], P[c, 2]), Vec3(P[c, 3], P[c, 4], P[c, 5]))
        P[c, 0], P[c, 1], P[c, 2] = P_vc.a
        P[c, 3], P[c, 4], P[c, 5] = P_vc.b
        for r in range(POSE):
            P[r, c] = P[c, r]


@inlined
def after(x: Floats, dR_: Floats, dp_: Floats) -> tuple[Mat3, Vec3, Mat6]:
    """R', X' and T of the pose after a motion."""
    dR, dp, angles = mat(dR_), vec(dp_), vec(x[3:])
    R, W = rotation_from_euler(angles), body_rates_from_euler(angles)
    return R @ dR, vec(x) + R @ dp, Mat6(O3, dR.T @ W, dR.T @ R.T, -1.0 * (dR.T @ skew(dp) @ W))


@compiled
def pose_after(x: Floats, dR: Floats, dp: Floats) -> tuple[Floats, Floats, Floats]:
    """Pose of the body a motion after the state, and the state's part in its perturbation: R' (3, 3), X' (3,), T."""
    (R, X, of_state), R_after, X_after, T = after(x, dR, dp), np.empty((3, 3)), np.empty(3), np.zeros((6, 6))
    store(R, R_after)
    X_after[0], X_after[1], X_after[2] = X
    store(of_state.b, T, UPPER_RIGHT)
    store(of_state.c, T, LOWER_LEFT)
    store(of_state.d, T, LOWER_RIGHT)
    return R_after, X_after, T


@inlined
def by_state(H_b: Vec6, R: Mat3, W: Mat3, dR: Mat3, dp: Vec3) -> Vec6:
    """``H_v = H_b T``."""
    n = dR @ H_b.b
    return Vec6(R @ n, W.T @ (dR @ H_b.a + cross(dp, n)))


@inlined
def write_row(H_v: Vec6, P: Floats, U_r: Floats) -> None:
    """``U_r = H_v P_v.``."""
    a, b = H_v
    for i in range(len(P)):
        U_r[i] = a.x * P[0, i] + a.y * P[1, i] + a.z * P[2, i] + (b.x * P[3, i] + b.y * P[4, i] + b.z * P[5, i])


# -------------------------------------------------------------------------------- observation and innovation


@compiled
def observe(
    x: Floats, P: Floats, at: int, dR_: Floats, dp_: Floats, C: Floats,
    body_R_sonar: Floats, body_p_sonar: Floats, z: Floats, R_z: Floats, gate: Gate, e: Floats, S: Floats,
) -> int:  # fmt: skip
    """Update by range and azimuth of the landmark at ``x[at : at + 3]``, where the gate admits it.

    Returns the outcome's number, and writes e of (7) and its covariance ``S = H P H^T + H_b C H_b^T + R_z``.
    """
    dR, dp, angles = mat(dR_), vec(dp_), vec(x[3:])
    R, W, B = rotation_from_euler(angles), body_rates_from_euler(angles), mat(body_R_sonar)
    p_b = dR.T @ (R.T @ (vec(x[at:]) - vec(x)) - dp)
    q = B.T @ (p_b - vec(body_p_sonar))
    level2 = q.x**2 + q.y**2
    r = math.sqrt(level2 + q.z**2)
    e[0], e[1] = z[0] - r, wrap_angle(z[1] - math.atan2(q.y, q.x))  # (6), (7)
    along = B @ ((1.0 / r) * q), B @ Vec3(-q.y / level2, q.x / level2, 0.0)  # p_b moves, range and azimuth grow
    H_b = Vec6(cross(along[0], p_b), -1.0 * along[0]), Vec6(cross(along[1], p_b), -1.0 * along[1])
    H_v, U = (by_state(H_b[0], R, W, dR, dp), by_state(H_b[1], R, W, dR, dp)), np.empty((2, len(x)))
    for a in range(2):
        write_row(H_v[a], P, U[a])
        for i in range(len(P)):
            U[a, i] -= H_v[a].a @ Vec3(P[at, i], P[at + 1, i], P[at + 2, i])
    for a in range(2):
        for b in range(2):
            U_X = Vec3(U[b, 0] - U[b, at], U[b, 1] - U[b, at + 1], U[b, 2] - U[b, at + 2])
            U_v = Vec6(U_X, Vec3(U[b, 3], U[b, 4], U[b, 5]))
            S[a, b] = R_z[a, b] + (H_v[a] @ U_v + H_b[a] @ (mat6(C) @ H_b[b]))
    S[1, 0] = S[0, 1]
    outcome, widened = admit(e, S, R_z, gate, at)
    if outcome != GATED:
        correct(x, P, U, S + widened, e)
    return outcome


def by_perturbation(R: Floats, q: Floats) -> Floats:
    """``R' [-[q]x  I]``: derivative of a point q of the body by delta, shape (3, 6)."""
    minus_q_x = np.array([[0.0, q[2], -q[1]], [-q[2], 0.0, q[0]], [q[1], -q[0], 0.0]])
    return np.concatenate((R @ minus_q_x, R), axis=1)


def location(
    x: Floats, motion: Motion, sonar: SonarModel, z: Floats, elevation_rad: float | None = None
) -> tuple[Floats, Floats, Floats, Floats]:
    """The point ``g(x_v, z, elevation) = X' + R' q`` that a detection shows, and its derivatives; None: on the floor.

    Returns g (3,); ``G_v = G_b T`` by x_v (3, 6); ``G_b = R' [-[q]x  I]`` by delta (3, 6); G_z by (range, azimuth,
    elevation) (3, 3).
    """
    R, X, T = pose_after(x, motion.dR, motion.dp)
    if elevation_rad is None:
        elevation_rad = sonar.elevation_of_new(R, X, z)
    q = sonar.body_p_sonar + sonar.body_R_sonar @ sonar_point(z[0], z[1], elevation_rad)
    G_b = by_perturbation(R, q)
    G_z = R @ sonar.body_R_sonar @ sonar_point_jacobian(z[0], z[1], elevation_rad)
    return X + R @ q, G_b @ T, G_b, G_z


def observe_far(
    x: Floats, P: Floats, at: int, motion: Motion, sonar: SonarModel, z: Floats, R_z: Floats
) -> tuple[int, Floats, Floats] | None:
    """Update as `observe` by a landmark far from where it is predicted, by the point seen (`far_view`); else None."""
    seen, G_v, G_b, G_z = location(x, motion, sonar, z, 0.0)
    H = np.zeros((LANDMARK, len(x)))
    H[:, :POSE], H[:, at : at + LANDMARK] = -G_v, np.eye(3)
    U, missed = H @ P, seen - x[at : at + LANDMARK]
    view = far_view(missed, U @ H.T + G_b @ motion.C @ G_b.T, G_z, sonar, z, R_z, at)
    if view is None:
        return None
    outcome, cov, e, S = view
    if outcome != GATED:
        correct(x, P, U, cov, missed)
    return outcome, e, S


# -------------------------------------------------------------------------------- update


@compiled
def correct(x: Floats, P: Floats, U: Floats, S: Floats, e: Floats) -> None:
    """Update by m numbers: ``x <- x + K e``, ``P <- P - K S K^T``, from ``U = H P`` (m, n); roll and yaw wrapped."""
    Ke = correction(P, U, S, e)
    for i in range(len(x)):
        x[i] += Ke[i]
    x[3], x[5] = wrap_angle(x[3]), wrap_angle(x[5])


@compiled
def correct_number(x: Floats, P: Floats, k: int, value: float, variance: float) -> None:
    """Update by a direct measurement of Z, of an angle, or of a coordinate of a landmark."""
    U, S, e = np.empty((1, len(x))), np.empty((1, 1)), np.empty(1)
    for i in range(len(x)):
        U[0, i] = P[k, i]
    S[0, 0] = P[k, k] + variance
    e[0] = wrap_angle(value - x[k]) if 3 <= k < POSE else value - x[k]
    correct(x, P, U, S, e)


@compiled
def correct_up(x: Floats, P: Floats, up: Floats, sigma: float) -> None:
    """Update roll and pitch by the direction of the world's up in the body, with the sigma of its tilt (rad)."""
    level = math.hypot(up[1], up[2])
    measured, sigmas = (math.atan2(up[1], up[2]), math.atan2(-up[0], level)), (sigma / level, sigma)
    for k in range(2):
        correct_number(x, P, 3 + k, measured[k], sigmas[k] ** 2)


@compiled
def correct_depth(
    x: Floats, P: Floats, dR_: Floats, dp_: Floats, C: Floats, port: Floats, z_m: float, variance: float
) -> None:
    """Update by the height of the pressure port q, ``(X' + R' q)_z``: along the body's up, ``n = R'^T e_z``."""
    dR, dp, angles = mat(dR_), vec(dp_), vec(x[3:])
    R, W, q = rotation_from_euler(angles), body_rates_from_euler(angles), vec(port)
    up = (R @ dR).z
    H_b = Vec6(cross(q, up), up)
    H_v = by_state(H_b, R, W, dR, dp)
    U, S, e = np.empty((1, len(x))), np.empty((1, 1)), np.empty(1)
    write_row(H_v, P, U[0])
    share = H_v.a @ Vec3(U[0, 0], U[0, 1], U[0, 2]) + H_v.b @ Vec3(U[0, 3], U[0, 4], U[0, 5])
    S[0, 0] = share + H_b @ (mat6(C) @ H_b) + variance
    e[0] = z_m - (x[2] + R.z @ dp + up @ q)
    correct(x, P, U, S, e)


def correct_heading(x: Floats, P: Floats, motion: Motion, yaw_rad: float, variance_rad2: float) -> None:
    """Update by a compass, ``psi' + c`` (`yaw_and_derivative`)."""
    R, _, T = pose_after(x, motion.dR, motion.dp)
    yaw, by_turn = yaw_and_derivative(R)
    H_b = np.array([[*by_turn, 0.0, 0.0, 0.0]])
    e = np.array([wrap_angle(yaw_rad - yaw - x[COMPASS])])
    correct_robustly(x, P, motion, T, H_b, 1.0, e, np.array([[variance_rad2]]))


def correct_position(x: Floats, P: Floats, motion: Motion, q: Floats, position_m: Floats, cov_m2: Floats) -> None:
    """Update by the position of a point q of the body, ``X' + R' q``."""
    R, X, T = pose_after(x, motion.dR, motion.dp)
    correct_robustly(x, P, motion, T, by_perturbation(R, q), 0.0, position_m - X - R @ q, cov_m2)


def correct_robustly(
    x: Floats, P: Floats, motion: Motion, T: Floats, H_b: Floats, by_compass: float, e: Floats, R: Floats
) -> None:
    """Update by m numbers that depend on delta and c, ``H = [H_b T, by_compass, 0]``, of which some are outliers."""
    H = np.zeros((len(e), len(x)))
    H[:, :POSE], H[:, COMPASS] = H_b @ T, by_compass
    U = H @ P
    correct(x, P, U, doubted(e, U @ H.T + H_b @ motion.C @ H_b.T + R, R), e)


# -------------------------------------------------------------------------------- augmentation


def augment(x: Floats, P: Floats, motion: Motion, sonar: SonarModel, z: Floats, R_z: Floats) -> tuple[Floats, Floats]:
    """State and covariance with a new landmark where it was seen, on a floor of known height within the floor's gate.

    ``P_pv = G_v P_v.``,  ``P_pp = G_v P_vv G_v^T + G_b C G_b^T + G_z diag(R_z, elevation_sigma^2) G_z^T``.
    """
    p, G_v, G_b, G_z = location(x, motion, sonar, z)
    P_pv = G_v @ P[:POSE]
    P_pp = P_pv[:, :POSE] @ G_v.T + G_b @ motion.C @ G_b.T + G_z @ polar_covariance(R_z, sonar.aperture_rad) @ G_z.T
    P_p = np.concatenate((P_pv, 0.5 * (P_pp + P_pp.T)), axis=1)
    x, P = np.concatenate((x, p)), np.concatenate((np.concatenate((P, P_pv.T), axis=1), P_p))
    if (sonar.floor_z_m - x[-1]) ** 2 <= FLOOR_GATE * (P[-1, -1] + sonar.floor_variance_m2):
        correct_number(x, P, len(x) - 1, sonar.floor_z_m, sonar.floor_variance_m2)
    return x, P
