"""State and error of the invariant filter, its prediction, and how a correction enters.

The state is one element of the group SE_{1+N}(3), a rotation and 1 + N points that all turn with the world, and a gyro
bias::

    R = world_R_body,    x_0 = X: the body,    x_1 ... x_N: landmarks,    b

The error is the right-invariant one: what the world would have to be moved by, not the body::

    R = Exp(theta) R^,    x_k = Exp(theta) x_k^ + J_l(theta) xi_k,    b = b^ + beta                            (1)

and P the covariance of ``xi = [theta, beta, xi_0, ..., xi_N]``. Prediction over a motion (dR, dp), whose perturbation
is ``Exp(theta_i) dR``, ``dp + eps`` with the derivatives D_t, D_r by the bias, has a transition that is the identity
but for the bias::

    R' = R dR,    X' = X + R dp                                                                               (2)

    xi' = xi + J ([D_t; D_r] beta + [theta_i; eps]),    J = [ R           0 ]  theta
                                                            [ 0           0 ]  beta                           (3)
                                                            [ [X']x R     R ]  xi_0
                                                            [ [x_k]x R    0 ]  xi_k

Arrays have exactly the size of the state. Source: docs/theory/invariant_ekf.md.

What the sensors see in the invariant filter: predictions, and H for the error xi of `baselines.invariant_equations`.

A measurement is taken a provisional motion (dR, dp) after the state. H is the derivative by xi, H_m that by the
motion's perturbation [theta_i, eps], through which the gyro bias acts as well: ``H_beta = H_m [D_t; D_r]``.

Landmark k. Its place in the axes of the state's body depends on no rotation of the world, by (1)::

    p_n = R^T (x_k - X) = p_n^ + R^^T (xi_k - xi_0),    p_b = dR^T (p_n - dp),    q = sonar_T_body p_b

Range and azimuth change along ``n = dR body_R_sonar D_q^T``, one row of D_q each
(`sonar_graph.slam.models.sonar_model`)::

    H_xi_k = n^T R^T = -H_xi_0,    H_theta = 0,    H_m = [ (n x (p_n - dp))^T   -n^T ]                        (4)

A new landmark at ``x = X + R s``, with ``s = dp + dR p_b`` and p_b by range, azimuth and elevation::

    xi_new = xi_0 + R [ -[s - dp]x   I ] [theta_i; eps] + R dR body_R_sonar (point's derivative) dz           (5)

Height of a point x_k, or of a body's point at ``a = X + R s``, k = 0, along ``n = R^T e_z``::

    H_theta = (a x e_z)^T,    H_xi_k = e_z^T,    H_m = [ ((s - dp) x n)^T   n^T ]  of a body's point          (6)

Direction u of the world's up, measured in the body: by how much R u misses the world's own up, with the same H always::

    y = (R^ u)_xy = [ -theta_y, theta_x ] + noise                                                             (7)

Each H is zero along a shift of vehicle and landmarks in x and y and a turn of all about the vertical, at any estimate:
what cannot be observed stays so, however often it is linearised.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filter_events import UP
from baselines.filter_inputs import SonarModel
from baselines.sonar_update import correct_jointly, point_seen, predicted_view
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
from sonar_graph.slam.models import sonar_point_jacobian

THETA, BIAS, BODY = 0, 3, 6
"""Where theta, beta and xi_0 begin in xi."""
BARE = 9
"""Numbers of xi without landmarks."""
POINT = 3
"""Numbers of one xi_k."""


class InvariantState(NamedTuple):
    """Estimate and covariance; arrays that the filter writes to."""

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

    Parameters
    ----------
    walk_variance
        By which the bias has walked meanwhile, each component, rad²/s².
    """
    R = matrix(state.R)
    place(product(R, motion.integral.dR), state.R, 0, 0)
    put(state.points[0], transformed(vector(state.points[0]), R, motion.integral.dp))
    J = motion_jacobian(state.points, R)
    D = by_bias(J, motion)
    P_bias = state.P[BIAS:BODY].copy()
    _add_products(state.P, D, P_bias, J, motion_matrix(motion.integral))
    for r in range(BIAS, BODY):
        state.P[r, r] += walk_variance


@compiled
def motion_jacobian(points: Floats, R: Matrix) -> Floats:
    """J of (3), shape (9 + 3 N, 6).

    Parameters
    ----------
    points
        After the motion.
    R
        Before it.
    """
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


@inlined
def _add_products(P: Floats, D: Floats, P_bias: Floats, J: Floats, C: Floats) -> None:
    """``P <- (I + D E) P (I + D E)^T + J C J^T``, where E picks the bias: symmetric to the last bit.

    ``P + A B + (A B)^T`` with ``A = [D J]`` and ``B = [P_bias + P_bb D^T / 2; C J^T / 2]``.
    """
    from_bias = P_bias + 0.5 * (P_bias[:, BIAS:BODY].copy() @ D.T)
    from_motion = 0.5 * (C @ J.T)
    for i in range(len(P)):
        for j in range(i + 1):
            added = 0.0
            for k in range(3):
                added += D[i, k] * from_bias[k, j] + D[j, k] * from_bias[k, i]
            for k in range(6):
                added += J[i, k] * from_motion[k, j] + J[j, k] * from_motion[k, i]
            P[i, j] += added
            P[j, i] = P[i, j]


@compiled
def correct(state: InvariantState, cross_cov: Floats, S: Floats, innovation: Floats) -> None:
    """Correction by m numbers: ``xi = K e`` with ``K = P H^T S^-1``, ``P <- P - K S K^T``, estimate moved by (1).

    Parameters
    ----------
    cross_cov
        ``H P``, shape (m, 9 + 3 N); overwritten.
    S
        Innovation covariance, shape (m, m).
    innovation
        Measured minus predicted, shape (m,).
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
    """The body a motion after the state, and the covariance of its own perturbation [theta, rho].

    With the points after the motion, (3) gives the error xi' there. In the body, ``theta_body = R'^T theta`` and
    ``rho = R'^T (xi_0 - [X']x theta)``.

    Returns
    -------
    world_R_body (3, 3), position (3,), covariance (6, 6).
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
    T = _body_from_error(R_after, X_after)
    cov = T @ P @ T.T
    return np.array(R_after), np.array(X_after), 0.5 * (cov + cov.T)


@inlined
def _body_from_error(R: Matrix, X: Vector) -> Floats:
    """The body's own perturbation [theta, rho] by [theta, beta, xi_0], shape (6, 9)."""
    body_R_world = transposed(R)
    T = np.zeros((6, BARE))
    place(body_R_world, T, 0, THETA)
    place(times_skew(body_R_world, scaled(-1.0, X)), T, 3, THETA)
    place(body_R_world, T, 3, BODY)
    return T


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
    """Predicted range and azimuth (2,), H (2, 9 + 3 N) and H_m (2, 6) of (4)."""
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
    """The point that a detection shows, and by (5) the derivatives of its xi.

    Returns
    -------
    The point; G by xi, shape (3, 9 + 3 N); G_m by the motion, shape (3, 6); G_z by (range, azimuth, elevation), shape
    (3, 3).
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
    """Height of a point of the body, H (1, 9 + 3 N) and H_m (1, 6) of (6)."""
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
    """Height of x_k and H (1, 9 + 3 N) of (6)."""
    H, x = np.zeros((1, len(state.P))), vector(state.points[k])
    put(H[0, THETA:], cross(x, UP))
    put(H[0, BODY + POINT * k :], UP)
    return x[2], H


@compiled
def missed_up(state: InvariantState, up: Vector) -> tuple[Floats, Floats]:
    """Y (2,) and H (2, 9 + 3 N) of (7)."""
    H, seen = np.zeros((2, len(state.P))), times(matrix(state.R), up)
    H[0, THETA + 1], H[1, THETA] = -1.0, 1.0
    return np.array(seen[:2]), H
