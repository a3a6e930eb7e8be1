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
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.joint_correction import correct_jointly
from sonar_graph.measurements import Floats
from sonar_graph.navigation.gap_motion import GapMotion
from sonar_graph.navigation.kernels import compiled, inlined, skew
from sonar_graph.navigation.recursion import Integral, exp_and_chord
from sonar_graph.navigation.triples import (
    Matrix,
    Vector,
    matrix,
    place,
    product,
    scaled,
    skew_times,
    times,
    times_skew,
    transformed,
    transposed,
    vector,
)

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
