"""Errors of many motions that depend on biases, and their derivatives, compiled (equations: `biased_odometry`).

With ``E = (R, t)``, ``theta = Log(R)`` and V the mean of ``Exp(s theta)`` over s in [0, 1]::

    Log(E) = (theta, V^-1 t),    V^-1 = I - [theta]x / 2 + a [theta]x^2
    a = (1 - y cot y) / |theta|^2,    y = |theta| / 2
    J = [ V^-T   0   ]     B: derivative of V^-1 t by theta
        [ B V^-T V^-T ]
"""

import gtsam
import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats
from sonar_graph.numerics import (
    I3,
    O3,
    Mat3,
    Mat6,
    Vec3,
    Vec6,
    chord_inverse,
    compiled,
    curvature,
    exp_and_mean,
    inlined,
    mat6,
    outer,
    rodrigues,
    rotation_log,
    skew,
    vec,
)


@compiled
def odometry_errors(
    poses_i: Floats, poses_j: Floats, changes: Floats, means: Floats, Ds: Floats, hs: Floats, whitening: Floats
) -> Floats:
    """Whitened errors, shape (n, 6), of n motions.

    Parameters
    ----------
    poses_i, poses_j
        Rows of R, and p, shape (n, 12) each.
    changes
        ``b - b_0``, shape (n, 11).
    means, Ds, hs, whitening
        ``i_T_j``, shape (n, 12) as the poses, D, shape (n, 6, 11), h, shape (n, 11), and W with ``W C W^T = I``.
    """
    errors = np.empty((len(means), 6))
    for k in range(len(means)):
        e = evaluated(poses_i[k], poses_j[k], changes[k], means[k], Ds[k], hs[k])[0]
        store_vector(mat6(whitening[k]) @ e, errors[k])
    return errors


@compiled
def odometry_derivatives(
    poses_i: Floats, poses_j: Floats, changes: Floats, means: Floats, Ds: Floats, hs: Floats, whitening: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """As `odometry_errors`, with the transposed derivatives by both poses, shape (n, 6, 6), and b, shape (n, 11, 6)."""
    n, biases = len(means), changes.shape[1]
    errors, by_i, by_j, by_b = np.empty((n, 6)), np.empty((n, 6, 6)), np.empty((n, 6, 6)), np.empty((n, biases, 6))
    for k in range(n):
        e, E, i_T_j, c, turn, up = evaluated(poses_i[k], poses_j[k], changes[k], means[k], Ds[k], hs[k])
        W = mat6(whitening[k])
        store_vector(W @ e, errors[k])
        J = W @ log_derivative(e.a, E[1])
        store_columns(J @ inverse_adjoint(i_T_j), -1.0, by_i[k])
        store_columns(J @ Mat6(I3, O3, O3, turn.T), 1.0, by_j[k])
        tilt, way = c
        undone = exp_and_mean(tilt)[1].T  # J(c)^-1 has the blocks V^T, 0, -V^T B, V^T
        below = undone @ log_derivative(tilt, way).c
        by_c, by_turn = J @ inverse_adjoint(E), J @ Vec6(up, Vec3(0.0, 0.0, 0.0))
        for m in range(biases):
            D_m = Vec6(vec(Ds[k, :3, m]), vec(Ds[k, 3:, m]))
            a = undone @ D_m.a
            column = by_c @ Vec6(a, undone @ D_m.b - below @ a)
            h = hs[k, m]
            store_vector(Vec6(-1.0 * column.a - h * by_turn.a, -1.0 * column.b - h * by_turn.b), by_b[k, m])
    return errors, by_i, by_j, by_b


@inlined
def evaluated(
    pose_i: Floats, pose_j: Floats, change: Floats, mean: Floats, D: Floats, h: Floats
) -> tuple[Vec6, tuple[Mat3, Vec3], tuple[Mat3, Vec3], tuple[Vec3, Vec3], Mat3, Vec3]:
    """e; E; ``X_i^-1 X_j Exp(-psi u)``; c as a turn and the translation of Exp(c); Exp(-psi u) and u."""
    R_i, p_i, R_j, p_j, R_m, p_m = *pose(pose_i), *pose(pose_j), *pose(mean)
    tilt, chord, psi = Vec3(0.0, 0.0, 0.0), Vec3(0.0, 0.0, 0.0), 0.0
    for m in range(len(change)):
        tilt = tilt + change[m] * vec(D[:3, m])
        chord = chord + change[m] * vec(D[3:, m])
        psi += h[m] * change[m]
    exp_tilt, V = exp_and_mean(tilt)
    way, up = V @ chord, R_j.z
    turn = exp_and_mean(-psi * up)[0]
    i_T_j = R_i.T @ R_j @ turn, R_i.T @ (p_j - p_i)
    corrected_R = R_m @ exp_tilt
    E = corrected_R.T @ i_T_j[0], corrected_R.T @ (i_T_j[1] - (R_m @ way + p_m))
    theta = rotation_log(E[0])
    return Vec6(theta, chord_inverse(theta) @ E[1]), E, i_T_j, (tilt, way), turn, up


@inlined
def pose(rows: Floats) -> tuple[Mat3, Vec3]:
    """R and p of the rows of R, and p, shape (12,)."""
    return Mat3(vec(rows[:3]), vec(rows[3:6]), vec(rows[6:9])), vec(rows[9:])


@inlined
def log_derivative(theta: Vec3, t: Vec3) -> Mat6:
    """J of the transform ``(Exp(theta), t)``: ``Log(T Exp(d)) ~ Log(T) + J d``."""
    x, along = theta @ theta, theta @ t
    a, slope = curvature(x)
    V_inverse = rodrigues(theta, x, -0.5, a)
    bent = slope * (along * theta - x * t) - 2.0 * a * t
    B = outer(bent, theta) + a * outer(theta, t) + (a * along) * I3 + 0.5 * (I3 @ skew(t))
    return Mat6(V_inverse.T, O3, B @ V_inverse.T, V_inverse.T)


@inlined
def inverse_adjoint(T: tuple[Mat3, Vec3]) -> Mat6:
    """``Ad(T^-1)``."""
    R, t = T
    return Mat6(R.T, O3, -1.0 * (R.T @ skew(t)), R.T)


@inlined
def store_vector(v: Vec6, out: Floats) -> None:
    """Write a vector into an array."""
    out[0], out[1], out[2] = v.a
    out[3], out[4], out[5] = v.b


@inlined
def store_columns(A: Mat6, sign: float, out: Floats) -> None:
    """Write a matrix into an array, transposed and with a sign."""
    T = A.T
    for r, (left, right) in enumerate(((T.a, T.b), (T.c, T.d))):
        for i, (v, w) in enumerate(((left.x, right.x), (left.y, right.y), (left.z, right.z))):
            store_vector(Vec6(sign * v, sign * w), out[3 * r + i])


def poses_of(values: gtsam.Values, keys: NDArray[np.uint64]) -> Floats:
    """Poses of a graph by the keys of keyframes, shape (...): rows of R, and p, shape (..., 12)."""
    known = np.fromiter(values.keys(), np.uint64)
    poses = np.asarray(gtsam.utilities.extractPose3(values))  # by ascending key
    return poses[np.searchsorted(known[known >> np.uint64(56) == ord("x")], keys)]


def pose_row(pose: gtsam.Pose3) -> Floats:
    """Rows of R, and p, shape (12,)."""
    return np.concatenate((pose.rotation().matrix().ravel(), pose.translation()))
