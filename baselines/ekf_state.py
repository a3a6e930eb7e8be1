"""State and covariance of EKF-SLAM: the paper's equations (4) and (5), their prediction, and how a correction enters.

::

    x = [X, Y, Z, phi, theta, psi, p_1, ..., p_N]            (4)  p_i: landmark in the world, 3 numbers

    P = [ P_vv    P_vm ]                                     (5)
        [ P_vm^T  P_mm ]

Prediction from one DVL stamp to the next, with the motion (dR, dp) that gyros and Doppler log measured in between::

    X'    = X + R dp                    R = Rz(psi) Ry(theta) Rx(phi)
    R'    = R dR                        the exact integral of the Euler kinematics for a constant rate
    P_vv' = F P_vv F^T + Q,  P_vm' = F P_vm

    F = [ I  -R [dp]x W  ]      Q = G cov G^T,  G = [ 0   R' ]      W, E: see `baselines.euler`; cov: of the motion's
        [ 0   E' dR^T W  ]                          [ E'  0  ]      perturbation [rotation, translation] at its end

Arrays have room for more landmarks than there are; ``n`` is the length of the state. Everything happens in place.
"""

from __future__ import annotations

import math

import numpy as np

from baselines.euler import euler_from_rates, euler_from_rotation, rates_from_euler, rotation_from_euler
from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled
from sonar_graph.slam.models import wrap_angle

POSE = 6
"""Numbers of x_v."""
LANDMARK = 3
"""Numbers of p_i."""


@compiled
def product(A: Floats, B: Floats) -> Floats:
    """``A B`` of small matrices; calling BLAS would cost more than the arithmetic."""
    rows, inner, columns = A.shape[0], A.shape[1], B.shape[1]
    C = np.zeros((rows, columns))
    for r in range(rows):
        for k in range(inner):
            for c in range(columns):
                C[r, c] += A[r, k] * B[k, c]
    return C


@compiled
def product_3(A: Floats, B: Floats) -> Floats:
    """``A B`` of 3 × 3 matrices."""
    C = np.empty((3, 3))
    for r in range(3):
        for c in range(3):
            C[r, c] = A[r, 0] * B[0, c] + A[r, 1] * B[1, c] + A[r, 2] * B[2, c]
    return C


@compiled
def place(A: Floats, out: Floats, row: int, column: int) -> None:
    """Write a small matrix into a larger one; an assignment of arrays would take seconds to compile."""
    for r in range(A.shape[0]):
        for c in range(A.shape[1]):
            out[row + r, column + c] = A[r, c]


@compiled
def cross(v: Floats, B: Floats) -> Floats:
    """``[v]x B`` for a 3 × 3 matrix."""
    C = np.empty((3, 3))
    for c in range(3):
        C[0, c] = v[1] * B[2, c] - v[2] * B[1, c]
        C[1, c] = v[2] * B[0, c] - v[0] * B[2, c]
        C[2, c] = v[0] * B[1, c] - v[1] * B[0, c]
    return C


@compiled
def transition(angles: Floats, dR: Floats, dp: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Attitude after a motion, and the blocks of F and G that are neither zero nor identity.

    Returns
    -------
    R' (3, 3), ``dX'/d(phi, theta, psi)`` (3, 3), ``d(phi, theta, psi)'/d(phi, theta, psi)`` (3, 3), and E' (3, 3).
    """
    R, W = rotation_from_euler(angles), rates_from_euler(angles)
    R_after = product_3(R, dR)
    E_after = euler_from_rates(euler_from_rotation(R_after))
    position_D_angles = product_3(R, cross(-dp, W))
    angles_D_angles = product_3(E_after, product_3(dR.T, W))
    return R_after, position_D_angles, angles_D_angles, E_after


@compiled
def predict(x: Floats, P: Floats, n: int, dR: Floats, dp: Floats, cov: Floats) -> None:
    """Carry state and covariance over a motion.

    Parameters
    ----------
    dR, dp, cov
        Rotation, displacement and covariance [rotation, translation] from body frame to body frame.
    """
    R = rotation_from_euler(x[3:POSE])
    R_after, position_D_angles, angles_D_angles, E_after = transition(x[3:POSE], dR, dp)
    angles = euler_from_rotation(R_after)
    for r in range(3):
        x[r] += R[r, 0] * dp[0] + R[r, 1] * dp[1] + R[r, 2] * dp[2]
        x[3 + r] = angles[r]
    _transport_rows(P, n, position_D_angles, angles_D_angles)
    _transport_pose_columns(P, position_D_angles, angles_D_angles)
    _add_motion_noise(P, R_after, E_after, cov)
    for r in range(POSE):
        for c in range(POSE, n):
            P[c, r] = P[r, c]


@compiled
def _transport_rows(P: Floats, n: int, A: Floats, B: Floats) -> None:
    """``P[:6] <- F P[:6]``."""
    for c in range(n):
        phi, theta, psi = P[3, c], P[4, c], P[5, c]
        for r in range(3):
            P[r, c] += A[r, 0] * phi + A[r, 1] * theta + A[r, 2] * psi
            P[3 + r, c] = B[r, 0] * phi + B[r, 1] * theta + B[r, 2] * psi


@compiled
def _transport_pose_columns(P: Floats, A: Floats, B: Floats) -> None:
    """``P_vv <- P_vv F^T``."""
    for r in range(POSE):
        phi, theta, psi = P[r, 3], P[r, 4], P[r, 5]
        for c in range(3):
            P[r, c] += A[c, 0] * phi + A[c, 1] * theta + A[c, 2] * psi
            P[r, 3 + c] = B[c, 0] * phi + B[c, 1] * theta + B[c, 2] * psi


@compiled
def _add_motion_noise(P: Floats, R_after: Floats, E_after: Floats, cov: Floats) -> None:
    """``P_vv += G cov G^T``, then equal to its transpose to the last bit."""
    Q_XX = product_3(product_3(R_after, cov[3:, 3:]), R_after.T)
    Q_EX = product_3(product_3(E_after, cov[:3, 3:]), R_after.T)
    Q_EE = product_3(product_3(E_after, cov[:3, :3]), E_after.T)
    for r in range(3):
        for c in range(3):
            P[r, c] += Q_XX[r, c]
            P[3 + r, c] += Q_EX[r, c]
            P[c, 3 + r] += Q_EX[r, c]
            P[3 + r, 3 + c] += Q_EE[r, c]
    for r in range(POSE):
        for c in range(r):
            P[r, c] = P[c, r] = 0.5 * (P[r, c] + P[c, r])


@compiled
def perturbation_jacobian(angles: Floats, dR: Floats, dp: Floats) -> Floats:
    """Derivative of the body's perturbation [theta, rho] after a motion by the pose state before it, shape (6, 6).

    ``theta = dR^T W d(angles)`` and ``rho = dR^T (R^T dX - [dp]x W d(angles))``. With no motion it turns P_vv into the
    covariance of [theta, rho].
    """
    R, W = rotation_from_euler(angles), rates_from_euler(angles)
    T = np.zeros((POSE, POSE))
    place(product_3(dR.T, W), T, 0, 3)
    place(product_3(R, dR).T, T, 3, 0)
    place(product_3(dR.T, cross(-dp, W)), T, 3, 3)
    return T


@compiled
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


@compiled
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
def _wrap(x: Floats) -> None:
    """Keep roll and yaw in (-pi, pi]."""
    x[3], x[5] = wrap_angle(x[3]), wrap_angle(x[5])
