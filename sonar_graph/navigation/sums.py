"""Preintegration of steps: mean, covariance and bias derivative as sums.

Step k has duration dt, rate w, velocity v of the Doppler log at l in the body, noise densities n_g (gyros) and Q_k
(velocity). With E the Earth's rate in frame i, `Exp` and its mean `J_l`::

    w_k = w - b - R^T E,    R_k = R J_l(w_k dt),    s = dt R_k (v - w_k x l)
    A_k = Ad(R_k, p + s / 2) [I 0; [l]x I] = [R_k 0; M R_k],    M = [p + s / 2]x R_k + R_k [l]x
    C_i = sum_k dt A_k diag(n_g^2 I, Q_k) A_k^T,    D_i = -sum_k dt A_k[:, :3]
    p <- p + s,    R <- R Exp(w_k dt)

A noise of step k reaches the end through the adjoint of the pose in the middle of the step; errors kept in frame i are
not transported from step to step. One adjoint at the end takes both to frame j: ``C = Ad(j_T_i) C_i Ad(j_T_i)^T``.
docs/theory/preintegration.md.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.motion import Motions
from sonar_graph.navigation.steps import Rows, has_gap, put, rows_until, step_from
from sonar_graph.numerics import (
    I3,
    O3,
    ZERO,
    Mat6,
    Vec3,
    compiled,
    cross,
    diagonal,
    exp_and_mean,
    inverse_adjoint,
    skew,
    store,
    store6,
    vec,
)

NOWHERE = Vec3(np.nan, np.nan, np.nan)


def motions_over(
    rows: Rows,
    start_ns: Ints,
    end_ns: Ints,
    known_ns: Ints,
    longest_ns: int,
    bias: Floats,
    earth: Floats,
    body_p_dvl: Floats,
    gyro_density: float,
) -> Motions:
    """Motions over intervals, each from rows stamped no later than its ``known_ns``.

    Removed are the gyro bias (body frame) and the Earth's rotation (frame i), rad/s. An interval with more than
    ``longest_ns`` between Doppler samples is all NaN.
    """
    n = len(start_ns)
    out = np.empty((3 * n, 3)), np.empty((n, 3)), np.empty((6 * n, 6)), np.empty((6 * n, 3)), np.empty((n, 3))
    _write_motions(rows, start_ns, end_ns, known_ns, longest_ns, bias, earth, body_p_dvl, gyro_density, *out)
    dR, dp, C, D, impulse = out
    return Motions(dR.reshape(n, 3, 3), dp, C.reshape(n, 6, 6), D.reshape(n, 6, 3), impulse)


@compiled
def _write_motions(
    rows: Rows,
    start_ns: Ints,
    end_ns: Ints,
    known_ns: Ints,
    longest_ns: int,
    bias: Floats,
    earth: Floats,
    body_p_dvl: Floats,
    gyro_density: float,
    dR: Floats,
    dp: Floats,
    C: Floats,
    D: Floats,
    impulse: Floats,
) -> None:
    """Fill the columns of `Motions`, their matrices one below the other (reshaping is slow to compile)."""
    n, b, E, arm = len(start_ns), vec(bias), vec(earth), vec(body_p_dvl)
    for e in range(n):
        t, end = start_ns[e], end_ns[e]
        i, k = rows_until(rows.imu_ns, t), rows_until(rows.dvl_ns, t)
        imu_rows, dvl_rows = rows_until(rows.imu_ns, known_ns[e]), rows_until(rows.dvl_ns, known_ns[e])
        R, p, f, tt, rt, rr, D_t, D_r = I3, ZERO, ZERO, O3, O3, O3, O3, O3
        if has_gap(rows.dvl_ns, dvl_rows, k, t, end, longest_ns):
            t, R, p, f = end, np.nan * I3, NOWHERE, NOWHERE
        while t < end:
            t, dt, rate, v, Q, force, turn_psd = step_from(rows, imu_rows, dvl_rows, i, k, t, end)
            i += int(i < imu_rows and rows.imu_ns[i] <= t)
            k += int(k < dvl_rows and rows.dvl_ns[k] <= t)
            w, N_g = rate - b - R.T @ E, gyro_density**2 * I3 + diagonal(turn_psd)
            turn, mean = exp_and_mean(dt * w)
            R_k = R @ mean
            s = dt * (R_k @ (v - cross(w, arm)))
            M = skew(p + 0.5 * s) @ R_k + R_k @ skew(arm)
            RN, MN = R_k @ N_g, M @ N_g
            tt += dt * (RN @ R_k.T)
            rt += dt * (MN @ R_k.T)
            rr += dt * (MN @ M.T + R_k @ Q @ R_k.T)
            D_t, D_r = D_t - dt * R_k, D_r - dt * M
            f += dt * (R_k @ force)
            p, R = p + s, R @ turn
        to_j = inverse_adjoint(R, p)
        D_j = to_j @ Mat6(D_t, O3, D_r, O3)
        store(R, dR, 3 * e, 0)
        put(p, dp, e)
        put(f, impulse, e)
        store6(to_j @ Mat6(tt, rt.T, rt, rr) @ to_j.T, C, 6 * e)
        store(D_j.a, D, 6 * e, 0)
        store(D_j.c, D, 6 * e + 3, 0)
