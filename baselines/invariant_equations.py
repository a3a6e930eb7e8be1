"""Equations of the right-invariant EKF: state and error, prediction, measurement models, update, augmentation.

The state is a rotation and 1 + N points that turn with the world, one element of SE_{1+N}(3), and a gyro bias. The
error is right-invariant::

    R = Exp(theta) R^,    x_k = Exp(theta) x_k^ + J_l(theta) xi_k,    b = b^ + beta                            (1)

with x_0 = X the body, and P the covariance of ``xi = [theta, beta, xi_0, ..., xi_N]``. Prediction over a motion
(dR, dp) with perturbation [theta_i, eps] and derivatives D_t, D_r by the bias::

    R' = R dR,    X' = X + R dp,    xi' = xi + J ([D_t; D_r] beta + [theta_i; eps])                        (2), (3)
    rows of J:    theta [R 0],  beta [0 0],  xi_0 [[X']x R  R],  xi_k [[x_k]x R  0]

A measurement is a provisional motion (dR, dp) after the state: H is the derivative by xi, H_m that by [theta_i, eps],
and ``H_beta = H_m [D_t; D_r]`` (4). Landmark k in range and azimuth, with n and p_n of `baselines.sonar_update`::

    H_xi_k = n^T R^T = -H_xi_0,    H_theta = 0,    H_m = [ (n x (p_n - dp))^T   -n^T ]                        (5)

New landmark at ``x = X + R s``::

    xi_new = xi_0 + R [ -[s - dp]x   I ] [theta_i; eps] + R dR body_R_sonar (point's derivative) dz           (6)

Height of a point x_k, or of a body's point at ``a = X + R s``, k = 0, along ``n = R^T e_z``::

    H_theta = (a x e_z)^T,    H_xi_k = e_z^T,    H_m = [ ((s - dp) x n)^T   n^T ]  of a body's point          (7)

Direction u of the world's up in the body, and the innovation covariance::

    y = (R^ u)_xy = [ -theta_y, theta_x ] + noise                                                             (8)
    S = H P H^T + H_m C H_m^T + R_z                                                                           (9)

Every H is zero along a shift of everything in x and y and a turn about the vertical, at any estimate, so these
unobservable directions stay unobservable. Numbers and derivation: docs/theory/invariant_ekf.md.
"""

from typing import NamedTuple

import numpy as np

from baselines.filter_motion import UP
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
from sonar_graph.navigation.preintegration import GapMotion, Integral, exp_and_chord
from sonar_graph.numerics import (
    IDENTITY,
    Matrix,
    Vector,
    compiled,
    cross,
    inlined,
    matrix,
    minus,
    place,
    product,
    scaled,
    skew,
    skew_times,
    times,
    times_skew,
    transformed,
    transposed,
    vector,
)
from sonar_graph.slam.models import FLOOR_GATE, sonar_point_jacobian, wrap_angle

THETA, BIAS, BODY = 0, 3, 6
"""First index of theta, beta and xi_0 in xi."""
BARE = 9
"""Length of xi without landmarks."""
POINT = 3
"""Length of one xi_k."""


class InvariantState(NamedTuple):
    """Estimate and covariance, in arrays that the filter changes."""

    R: Floats
    """world_R_body, shape (3, 3)."""
    points: Floats
    """The body's position and those of the landmarks, shape (1 + N, 3), m."""
    bias: Floats
    """Of the gyros, body axes, shape (3,), rad/s."""
    P: Floats
    """Of xi, shape (9 + 3 N, 9 + 3 N)."""


@compiled
def predict(state: InvariantState, motion: GapMotion, walk_variance: float) -> None:
    """Carry estimate and covariance over a motion.

    ``walk_variance`` is the variance of the bias walk since, each component, rad²/s².
    """
    R = matrix(state.R)
    place(product(R, motion.integral.dR), state.R, 0, 0)
    put(state.points[0], transformed(vector(state.points[0]), R, motion.integral.dp))
    J = motion_jacobian(state.points, R)
    D = by_bias(J, motion)
    P_bias = state.P[BIAS:BODY].copy()
    # P <- (I + D E) P (I + D E)^T + J C J^T, E picks the bias: P + A B + (A B)^T with A = [D J] and
    # B = [P_bias + P_bb D^T / 2; C J^T / 2] is symmetric to the last bit
    P, from_bias = state.P, P_bias + 0.5 * (P_bias[:, BIAS:BODY].copy() @ D.T)
    from_motion = 0.5 * (motion_matrix(motion.integral) @ J.T)
    for i in range(len(P)):
        for j in range(i + 1):
            added = 0.0
            for k in range(3):
                added += D[i, k] * from_bias[k, j] + D[j, k] * from_bias[k, i]
            for k in range(6):
                added += J[i, k] * from_motion[k, j] + J[j, k] * from_motion[k, i]
            P[i, j] += added
            P[j, i] = P[i, j]
    for r in range(BIAS, BODY):
        P[r, r] += walk_variance


@compiled
def motion_jacobian(points: Floats, R: Matrix) -> Floats:
    """J of (3), shape (9 + 3 N, 6), from the points after the motion and R before it."""
    J = np.zeros((BODY + POINT * len(points), 6))
    place(R, J, THETA, 0)
    place(R, J, BODY, 3)
    for k in range(len(points)):
        place(skew_times(vector(points[k]), R), J, BODY + POINT * k, 0)
    return J


@compiled
def by_bias(J: Floats, motion: GapMotion) -> Floats:
    """``J [D_t; D_r]``, shape (9 + 3 N, 3)."""
    D = np.empty((6, 3))
    place(motion.D_t, D, 0, 0)
    place(motion.D_r, D, 3, 0)
    return J @ D


@inlined
def motion_matrix(motion: Integral) -> Floats:
    """Covariance of [theta_i, eps], shape (6, 6)."""
    C = np.empty((6, 6))
    place(motion.cov_tt, C, 0, 0)
    place(transposed(motion.cov_rt), C, 0, 3)
    place(motion.cov_rt, C, 3, 0)
    place(motion.cov_rr, C, 3, 3)
    return C


@compiled
def correct(state: InvariantState, cross_cov: Floats, S: Floats, innovation: Floats) -> None:
    """Update by m numbers: ``xi = K e`` with ``K = P H^T S^-1``, ``P <- P - K S K^T``, estimate moved by (1).

    ``cross_cov`` is ``H P`` (m, 9 + 3 N), overwritten; S is (m, m) and the innovation (m,).
    """
    xi = np.zeros(len(state.P))
    correct_jointly(state.P, len(xi), cross_cov, S, innovation, xi)
    retract(state, xi)


@compiled
def retract(state: InvariantState, xi: Floats) -> None:
    """Move the estimate by an error, (1)."""
    turn, chord = exp_and_chord(vector(xi))
    place(product(turn, matrix(state.R)), state.R, 0, 0)
    for k in range(len(state.points)):
        shift = times(chord, vector(xi[BODY + POINT * k :]))
        put(state.points[k], transformed(shift, turn, vector(state.points[k])))
    for r in range(3):
        state.bias[r] += xi[BIAS + r]


@compiled
def pose_after(state: InvariantState, motion: GapMotion) -> tuple[Floats, Floats, Floats]:
    """Pose of the body a motion after the state, with the covariance of its own perturbation [theta, rho].

    In the body, ``theta_body = R'^T theta`` and ``rho = R'^T (xi_0 - [X']x theta)``.

    Returns world_R_body (3, 3), position (3,), covariance (6, 6).
    """
    R = matrix(state.R)
    R_after = product(R, motion.integral.dR)
    X_after = transformed(vector(state.points[0]), R, motion.integral.dp)
    body = np.empty((1, 3))
    put(body[0], X_after)
    J = motion_jacobian(body, R)
    F = np.eye(BARE)
    F[:, BIAS:BODY] += by_bias(J, motion)
    P = F @ state.P[:BARE, :BARE].copy() @ F.T + J @ motion_matrix(motion.integral) @ J.T
    T, body_R_world = np.zeros((6, BARE)), transposed(R_after)
    place(body_R_world, T, 0, THETA)
    place(times_skew(body_R_world, scaled(-1.0, X_after)), T, 3, THETA)
    place(body_R_world, T, 3, BODY)
    cov = T @ P @ T.T
    return np.array(R_after), np.array(X_after), 0.5 * (cov + cov.T)


def landmark_covariance(state: InvariantState, k: int) -> Floats:
    """Covariance of a point's coordinates in the world, ``xi_k - [x_k]x theta``, shape (3, 3), m²."""
    at = BODY + POINT * k
    own = np.r_[THETA:BIAS, at : at + POINT]
    G = np.hstack([-skew(state.points[k]), np.eye(POINT)])
    return np.asarray(G @ state.P[np.ix_(own, own)] @ G.T)


@inlined
def put(out: Floats, v: Vector) -> None:
    """Write three numbers."""
    out[0], out[1], out[2] = v


@compiled
def observation(state: InvariantState, k: int, motion: GapMotion, sonar: SonarModel) -> tuple[Floats, Floats, Floats]:
    """Predicted range and azimuth (2,), H (2, 9 + 3 N) and H_m (2, 6) of (5)."""
    R, X = matrix(state.R), vector(state.points[0])
    z, p_n, by_range, by_azimuth = predicted_view(X, R, motion.integral, sonar, vector(state.points[k]))
    H, H_m, at = np.zeros((2, len(state.P))), np.empty((2, 6)), BODY + POINT * k
    for r, n in enumerate((by_range, by_azimuth)):
        put(H[r, at:], times(R, n))
        put(H[r, BODY:], times(R, scaled(-1.0, n)))
        put(H_m[r], cross(n, minus(p_n, motion.integral.dp)))
        put(H_m[r, 3:], scaled(-1.0, n))
    H[:, BIAS:BODY] += by_bias(H_m, motion)
    return z, H, H_m


@compiled
def location(
    state: InvariantState, motion: GapMotion, sonar: SonarModel, z: tuple[float, float], elevation_rad: float
) -> tuple[Vector, Floats, Floats, Floats]:
    """The point that a detection shows, and by (6) the derivatives of its xi.

    Returns the point; G by xi, shape (3, 9 + 3 N); G_m by the motion, shape (3, 6); G_z by (range, azimuth, elevation),
    shape (3, 3).
    """
    R, dR, dp = matrix(state.R), motion.integral.dR, motion.integral.dp
    s = point_seen(motion.integral, sonar, z, elevation_rad)
    G, G_m, G_z = np.zeros((3, len(state.P))), np.empty((3, 6)), np.empty((3, 3))
    place(IDENTITY, G, 0, BODY)
    place(times_skew(R, minus(dp, s)), G_m, 0, 0)
    place(R, G_m, 0, 3)
    G[:, BIAS:BODY] += by_bias(G_m, motion)
    by_view = product(dR, product(sonar.body_R_sonar, matrix(sonar_point_jacobian(z[0], z[1], elevation_rad))))
    place(product(R, by_view), G_z, 0, 0)
    return transformed(vector(state.points[0]), R, s), G, G_m, G_z


@compiled
def height_of_body_point(
    state: InvariantState, motion: GapMotion, body_p_point: Vector
) -> tuple[float, Floats, Floats]:
    """Height of a point of the body, H (1, 9 + 3 N) and H_m (1, 6) of (7)."""
    R, turned = matrix(state.R), times(motion.integral.dR, body_p_point)
    a = transformed(transformed(vector(state.points[0]), R, motion.integral.dp), R, turned)
    H, H_m = np.zeros((1, len(state.P))), np.empty((1, 6))
    put(H[0, THETA:], cross(a, UP))
    put(H[0, BODY:], UP)
    put(H_m[0], cross(turned, R[2]))
    put(H_m[0, 3:], R[2])
    H[:, BIAS:BODY] += by_bias(H_m, motion)
    return a[2], H, H_m


@compiled
def height_of_point(state: InvariantState, k: int) -> tuple[float, Floats]:
    """Height of x_k and H (1, 9 + 3 N) of (7)."""
    H, x = np.zeros((1, len(state.P))), vector(state.points[k])
    put(H[0, THETA:], cross(x, UP))
    put(H[0, BODY + POINT * k :], UP)
    return x[2], H


@compiled
def up_innovation(state: InvariantState, up: Vector) -> tuple[Floats, Floats]:
    """Innovation y (2,) and H (2, 9 + 3 N) of (8)."""
    H, seen = np.zeros((2, len(state.P))), times(matrix(state.R), up)
    H[0, THETA + 1], H[1, THETA] = -1.0, 1.0
    return np.array(seen[:2]), H


@compiled
def observe_rows(state: InvariantState, motion: GapMotion, sonar: SonarModel, frame: Frame) -> InvariantState:
    """Update by the rows of a frame, a motion after the state, one after the other; new landmarks make it larger."""
    outcomes = frame.outcomes[0]
    for row in range(frame.first, frame.last):
        seen = detection_row(frame, row, sonar)
        k = 1 + seen.slot
        if seen.slot == NO_SLOT:
            outcomes[row] = PASSED_OVER
        elif k == len(state.points):
            state = augmented(state, motion, sonar, seen)
            outcomes[row] = NEW
        elif frame.was_lost:
            outcomes[row] = observe_far(state, k, motion, sonar, seen)
        else:
            outcomes[row] = _observe(state, k, motion, sonar, seen)
    return state


@compiled
def _observe(state: InvariantState, k: int, motion: GapMotion, sonar: SonarModel, seen: DetectionRow) -> int:
    """Update by a landmark of the state where its innovation is inside the gate."""
    _, z, R_z, innovation, S = seen
    predicted, H, H_m = observation(state, k, motion, sonar)
    innovation[0], innovation[1] = z[0] - predicted[0], wrap_angle(z[1] - predicted[1])
    cross_cov = H @ state.P
    S[:] = _symmetric(cross_cov @ H.T + _motion_noise(H_m, motion) + np.array([[R_z[0], R_z[1]], [R_z[1], R_z[2]]]))
    if not is_inside_gate(seen, sonar):
        return GATED
    correct(state, cross_cov, S, innovation)
    return USED


@compiled
def observe_far(state: InvariantState, k: int, motion: GapMotion, sonar: SonarModel, seen: DetectionRow) -> int:
    """Update by a landmark that may be far from where it is predicted, (2) of `baselines.sonar_update`.

    ``Exp(theta)`` turns both points: the seen less the predicted place is ``J_r(theta) (xi_k - xi_new)``, without H of
    theta however far they are apart.
    """
    _, z, R_z, innovation, S = seen
    point, G, G_m, G_z = location(state, motion, sonar, z, 0.0)
    missed, H, at = np.array(point) - state.points[k], -G, BODY + POINT * k
    for r in range(POINT):
        H[r, at + r] += 1.0
    cross_cov = H @ state.P
    cov = _symmetric(cross_cov @ H.T + _motion_noise(G_m, motion))
    if not is_beyond_linear(cov, G_z, z[0], R_z):
        return int(_observe(state, k, motion, sonar, seen))
    cov += _symmetric(G_z @ far_polar_covariance(z[0], R_z, sonar.aperture_rad) @ G_z.T)
    B = range_azimuth_jacobian(G_z, z[0])
    innovation[:], S[:] = B @ missed, _symmetric(B @ cov @ B.T)
    if not is_inside_gate(seen, sonar):
        return GATED
    correct(state, cross_cov, cov, missed)
    return USED


@compiled
def augmented(state: InvariantState, motion: GapMotion, sonar: SonarModel, seen: DetectionRow) -> InvariantState:
    """The state with a new landmark where it was seen, on a floor of known height within the floor's gate."""
    elevation_rad = elevation_of_new(vector(state.points[0]), matrix(state.R), motion.integral, sonar, seen.z)
    point, G, G_m, G_z = location(state, motion, sonar, seen.z, elevation_rad)
    view = np.array(polar_covariance(seen.R_z, sonar.aperture_rad))
    n, cross_cov = len(state.P), G @ state.P
    points, P = np.empty((len(state.points) + 1, 3)), np.empty((n + POINT, n + POINT))
    points[:-1], P[:n, :n] = state.points, state.P
    put(points[-1], point)
    P[n:, :n], P[:n, n:] = cross_cov, cross_cov.T
    P[n:, n:] = _symmetric(cross_cov @ G.T + _motion_noise(G_m, motion) + G_z @ view @ G_z.T)
    larger = InvariantState(state.R, points, state.bias, P)
    if sonar.has_floor:
        height_m, H = height_of_point(larger, len(points) - 1)
        innovation, floor_cross_cov = np.array([sonar.floor_z_m - height_m]), H @ P
        S = floor_cross_cov @ H.T + sonar.floor_variance_m2
        if innovation[0] ** 2 <= FLOOR_GATE * S[0, 0]:
            correct(larger, floor_cross_cov, S, innovation)
    return larger


@compiled
def correct_depth(
    state: InvariantState, motion: GapMotion, body_p_port: Vector, z_m: float, variance_m2: float
) -> None:
    """Update by the height of the pressure port."""
    predicted, H, H_m = height_of_body_point(state, motion, body_p_port)
    cross_cov = H @ state.P
    correct(state, cross_cov, cross_cov @ H.T + _motion_noise(H_m, motion) + variance_m2, np.array([z_m - predicted]))


@compiled
def correct_up(state: InvariantState, up: Vector, variance: float) -> None:
    """Update by the direction of the world's up, measured in the body, with the variance of its tilt (rad²)."""
    missed, H = up_innovation(state, up)
    cross_cov = H @ state.P
    correct(state, cross_cov, _symmetric(cross_cov @ H.T + variance * np.eye(2)), missed)


@compiled
def correct_plane(state: InvariantState, z_m: float, z_variance: float, tilt_variance: float) -> None:
    """Update by the plane on which the vehicle stays: height and tilt."""
    height_m, H = height_of_point(state, 0)
    cross_cov = H @ state.P
    correct(state, cross_cov, cross_cov @ H.T + z_variance, np.array([z_m - height_m]))
    correct_up(state, UP, tilt_variance)


@compiled
def _motion_noise(H_m: Floats, motion: GapMotion) -> Floats:
    """``H_m C H_m^T``."""
    return H_m @ motion_matrix(motion.integral) @ H_m.T


@compiled
def _symmetric(A: Floats) -> Floats:
    """``(A + A^T) / 2``."""
    return 0.5 * (A + A.T)
