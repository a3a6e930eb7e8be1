"""State and covariance of EKF-SLAM: the paper's equations (4) and (5), their prediction, and how a correction enters.

::

    x = [X, Y, Z, phi, theta, psi, p_1, ..., p_N]            (4)  p_i: landmark in the world, 3 numbers

    P = [ P_vv    P_vm ]                                     (5)
        [ P_vm^T  P_mm ]

Prediction from one DVL stamp to the next, with the motion (dR, dp) that gyros and Doppler log measured in between::

    X'    = X + R dp                    R = Rz(psi) Ry(theta) Rx(phi)
    R'    = R dR                        the exact integral of the Euler kinematics for a constant rate
    P_vv' = F P_vv F^T + Q,  P_vm' = F P_vm

    F = [ I  -R [dp]x W  ]      Q = G cov G^T,  G = [ 0         R ]
        [ 0   E' dR^T W  ]                          [ E' dR^T   0 ]

W, E: see `baselines.euler`; cov: of the motion's perturbation [theta_i, eps], see `baselines.ekf_motion`.
Arrays have room for more landmarks than there are; ``n`` is the length of the state. Everything happens in place.
"""

from __future__ import annotations

import math

import numpy as np

from baselines.euler import euler_from_rates, euler_from_rotation, rates_from_euler, rotation_from_euler
from baselines.joint_correction import correct_jointly
from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.recursion import Integral
from sonar_graph.navigation.triples import (
    Matrix,
    Vector,
    matrix,
    place,
    plus,
    product,
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
from sonar_graph.slam.models import wrap_angle

POSE = 6
"""Numbers of x_v."""
LANDMARK = 3
"""Numbers of p_i."""


@inlined
def predict(x: Floats, P: Floats, n: int, motion: Integral) -> None:
    """Carry state and covariance over a motion."""
    angles = vector(x[3:])
    R, W = rotation_from_euler(angles), rates_from_euler(angles)
    angles_after = euler_from_rotation(product(R, motion.dR))
    E_dR = product(euler_from_rates(angles_after), transposed(motion.dR))
    X_by_angles, angles_by_angles = product(R, skew_times(scaled(-1.0, motion.dp), W)), product(E_dR, W)
    _set_triple(x, 0, transformed(vector(x), R, motion.dp))
    _set_triple(x, 3, angles_after)
    _predict_pose(P, X_by_angles, angles_by_angles, motion, R, E_dR)
    _predict_landmarks(P, n, X_by_angles, angles_by_angles)


@inlined
def _predict_pose(P: Floats, A: Matrix, B: Matrix, motion: Integral, R: Matrix, E_dR: Matrix) -> None:
    """``P_vv <- F P_vv F^T + Q`` with ``F = [[I, A], [0, B]]``."""
    XX, XE, EE = matrix(P[:, :3]), matrix(P[:, 3:]), matrix(P[3:, 3:])
    XE_carried = sum_of(XE, product(A, EE))
    XX = sum_of(sum_of(XX, product(XE_carried, transposed(A))), product(A, transposed(XE)))
    XX = sum_of(XX, sandwich(R, motion.cov_rr, R))
    XE = sum_of(product(XE_carried, transposed(B)), sandwich(R, motion.cov_rt, E_dR))
    EE = sum_of(sandwich(B, EE, B), sandwich(E_dR, motion.cov_tt, E_dR))
    place_symmetric(symmetric(XX), transposed(XE), symmetric(EE), P)


@inlined
def _predict_landmarks(P: Floats, n: int, A: Matrix, B: Matrix) -> None:
    """``P_vm <- F P_vm``, and its transpose."""
    for c in range(POSE, n):
        angles = (P[3, c], P[4, c], P[5, c])
        column = plus((P[0, c], P[1, c], P[2, c]), times(A, angles)) + times(B, angles)
        for r in range(POSE):
            P[r, c] = P[c, r] = column[r]


@inlined
def place_symmetric(first: Matrix, mixed: Matrix, second: Matrix, out: Floats) -> None:
    """Write ``[[first, mixed^T], [mixed, second]]``."""
    place(first, out, 0, 0)
    place(transposed(mixed), out, 0, 3)
    place(mixed, out, 3, 0)
    place(second, out, 3, 3)


@inlined
def pose_after(x: Floats, P: Floats, motion: Integral) -> tuple[Floats, Floats, Floats]:
    """The body a motion after the state, and the covariance of its perturbation [theta, rho].

    ``theta = dR^T (W d(angles) + theta_i)`` and ``rho = dR^T (R^T dX - [dp]x W d(angles) + eps)``.

    Returns
    -------
    world_R_body (3, 3), position (3,), covariance (6, 6).
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
    place_symmetric(
        symmetric(sandwich(j_R_i, tt, j_R_i)),
        sandwich(j_R_i, rt, j_R_i),
        symmetric(sandwich(j_R_i, rr, j_R_i)),
        own,
    )
    return np.array(product(R, motion.dR)), np.array(transformed(vector(x), R, motion.dp)), own


@inlined
def _set_triple(x: Floats, at: int, value: Vector) -> None:
    """Three numbers of the state."""
    x[at], x[at + 1], x[at + 2] = value


@inlined
def correct(x: Floats, P: Floats, n: int, cross_cov: Floats, S: float, innovation: float) -> None:
    """Correction by one number.

    ``w = P H^T / sqrt(S)``, ``P <- P - w w^T``, ``x <- x + w innovation / sqrt(S)``: the textbook's ``(I - K H) P`` in
    a form whose products commute, so that P stays symmetric to the last bit. Joseph's form, which also keeps P positive
    for a wrong gain, costs several times as much and is not needed for the optimal one in double precision.

    Parameters
    ----------
    cross_cov
        ``P H^T``, shape (n,); overwritten.
    S
        Innovation variance.
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
    """Correction by two numbers at once: as `correct`, with the Cholesky factor of S in place of the root.

    Parameters
    ----------
    cross_cov
        ``H P``, shape (2, n); overwritten.
    S
        Innovation covariance, shape (2, 2).
    innovation
        Shape (2,).
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
    """Correction by m numbers at once: as `correct_pair`, with shapes (m, n), (m, m) and (m,)."""
    correct_jointly(P, n, cross_cov, S, innovation, x)
    _wrap(x)


@inlined
def _wrap(x: Floats) -> None:
    """Keep roll and yaw in (-pi, pi]."""
    x[3], x[5] = wrap_angle(x[3]), wrap_angle(x[5])
