"""Preintegration of steps: mean, covariance and bias derivative as sums.

Step k has duration dt, rate w, velocity v of the Doppler log at l in the body, noise densities n_g (gyros) and Q_k
(velocity). With E the Earth's rate in frame i, `Exp` and its mean `J_l`::

    w_k = w - b - R^T E,    R_k = R J_l(w_k dt),    s = dt R_k (v - w_k x l),    c = p + s / 2 + R_k l
    A_k = Ad(R_k, c) = [R_k 0; [c]x R_k  R_k]
    C_i = sum_k dt A_k diag(N_g, Q_k) A_k^T,    D_i = -sum_k dt A_k[:, :3],    R_k N_g R_k^T = N = n_g^2 I
    p <- p + s,    R <- R Exp(w_k dt)

A noise of step k reaches the end through the adjoint of the log's pose in the middle of the step; errors kept in frame
i are not transported from step to step. One adjoint at the end takes both to j: ``C = Ad(j_T_i) C_i Ad(j_T_i)^T``.
In holes of the IMU N has more. Sums can be continued: the number of calls that made them changes no bit.
docs/theory/preintegration.md.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.motion import Motions
from sonar_graph.navigation.steps import Rows, has_gap, hole_from, put, row, rows_until, step_from
from sonar_graph.numerics import (
    I3,
    LOWER_LEFT,
    O3,
    Mat6,
    Vec3,
    compiled,
    cross,
    diagonal,
    exp_and_mean,
    mat,
    skew,
    store,
    store6,
    vec,
)

NOWHERE = Vec3(np.nan, np.nan, np.nan)


START = np.zeros((20, 3))
"""Sums of no steps: R, p and impulse; blocks tt, rt and rr of C_i (rotation, lower left, translation); those of D_i."""
START[:3] = np.eye(3)


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
    sums: Floats | None = None,
) -> Motions:
    """Motions over intervals, each from rows known at its ``known_ns``.

    Removed are the gyro bias (body frame) and the Earth's rotation (frame i), rad/s. An interval with more than
    ``longest_ns`` between Doppler samples is all NaN. ``sums``, shape (20 n, 3): those up to the starts, to be
    continued in place, the parts of `START` in their order, each for all intervals; None: of no steps.
    """
    n, is_new = len(start_ns), sums is None
    sums = np.zeros((20 * n, 3)) if sums is None else sums
    C, D = np.empty((n, 6, 6)), np.empty((n, 6, 3))
    write_motions(
        rows, start_ns, end_ns, known_ns, longest_ns, bias, earth, body_p_dvl, gyro_density, is_new, sums, C, D
    )
    dR, dp, impulse = sums[: 3 * n].reshape(n, 3, 3), sums[3 * n : 4 * n], sums[4 * n : 5 * n]
    return Motions(dR, dp, C, D, impulse)


@compiled
def write_motions(
    rows: Rows,
    start_ns: Ints,
    end_ns: Ints,
    known_ns: Ints,
    longest_ns: int,
    bias: Floats,
    earth: Floats,
    body_p_dvl: Floats,
    gyro_density: float,
    is_new: bool,
    sums: Floats,
    C: Floats,
    D: Floats,
) -> None:
    """Continue sums, and fill C and D of `Motions`."""
    n, b, E, arm, n2 = len(start_ns), vec(bias), vec(earth), vec(body_p_dvl), gyro_density**2 * I3
    for e in range(n):
        t, end = start_ns[e], end_ns[e]
        i, k = rows_until(rows.imu_ns, t), rows_until(rows.dvl_ns, t)
        imu_rows, dvl_rows = rows_until(rows.imu_ns, known_ns[e]), max(rows_until(rows.known_ns, known_ns[e]), 1)
        at = 5 * n + 3 * e
        R, p, f = I3 if is_new else mat(sums, (3 * e, 0)), row(sums, 3 * n + e), row(sums, 4 * n + e)
        tt, rt, rr = mat(sums, (at, 0)), mat(sums, (at + 3 * n, 0)), mat(sums, (at + 6 * n, 0))
        D_t, D_r = mat(sums, (at + 9 * n, 0)), mat(sums, (at + 12 * n, 0))
        if has_gap(rows.dvl_ns, dvl_rows, k, t, end, longest_ns):
            t, R, p, f = end, np.nan * I3, NOWHERE, NOWHERE
        while t < end:
            until, turn_psd, unfelt = hole_from(rows, imu_rows, dvl_rows, i, k, t, end)
            f += unfelt
            is_hole = turn_psd @ turn_psd > 0.0
            while t < until:
                t, dt, rate, v, Q, force = step_from(rows, imu_rows, dvl_rows, i, k, t, until)
                i += int(i < imu_rows and rows.imu_ns[i] <= t)
                k += int(k < dvl_rows and rows.dvl_ns[k] <= t)
                w = rate - b - R.T @ E
                turn, mean = exp_and_mean(dt * w)
                R_k = R @ mean
                s = dt * (R_k @ (v - cross(w, arm)))
                c = skew(p + 0.5 * s + R_k @ arm)
                tt += dt * n2
                rt += dt * (c @ n2)
                rr += dt * (R_k @ Q @ R_k.T - c @ n2 @ c)
                if is_hole:
                    N = R_k @ diagonal(turn_psd) @ R_k.T
                    tt += dt * N
                    rt += dt * (c @ N)
                    rr -= dt * (c @ N @ c)
                D_t, D_r = D_t - dt * R_k, D_r - dt * (c @ R_k)
                f += dt * (R_k @ force)
                p, R = p + s, R @ turn
        store(R, sums, (3 * e, 0))
        put(p, sums, 3 * n + e)
        put(f, sums, 4 * n + e)
        store(tt, sums, (at, 0))
        store(rt, sums, (at + 3 * n, 0))
        store(rr, sums, (at + 6 * n, 0))
        store(D_t, sums, (at + 9 * n, 0))
        store(D_r, sums, (at + 12 * n, 0))
        to_j = Mat6(R.T, O3, -1.0 * (R.T @ skew(p)), R.T)  # Ad of the inverse of (R, p)
        store6(to_j @ Mat6(tt, rt.T, rt, rr) @ to_j.T, C[e])
        store(to_j.a @ D_t, D[e])
        store(to_j.c @ D_t + to_j.d @ D_r, D[e], LOWER_LEFT)
