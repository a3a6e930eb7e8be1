"""Preintegration of steps: mean, covariance and bias derivative as sums.

Step k has duration dt, rate w, velocity v of the Doppler log at l in the body, noise densities n_g (gyros) and Q_k
(velocity). With E the Earth's rate in frame i, `Exp` and its mean `J_l`::

    w_k = w - b - R^T E,    R_k = R J_l(w_k dt),    s = dt R_k (v - w_k x l),    c = p + s / 2 + R_k l
    A_k = Ad(R_k, c) = [R_k 0; [c]x R_k  R_k]
    C_i = sum_k dt A_k diag(N_g, Q_k) A_k^T,    D_i = -sum_k dt A_k[:, :3],    R_k N_g R_k^T = N = n_g^2 I
    p <- p + s,    R <- R Exp(w_k dt)

A noise of step k reaches the end through the adjoint of the log's pose in the middle of the step; errors kept in frame
i are not transported from step to step. One adjoint at the end takes both to j: ``C = Ad(j_T_i) C_i Ad(j_T_i)^T``.
In holes of the IMU N_g has more. Sums can be continued: the number of calls that made them changes no bit.
docs/theory/preintegration.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.motion import Motions
from sonar_graph.navigation.steps import Rows, Step, has_gap, in_hole, may_be_in_hole, put, row, rows_until, step_from
from sonar_graph.numerics import (
    I3,
    ZERO,
    Mat3,
    Mat6,
    Vec3,
    block,
    compiled,
    cross,
    diagonal,
    exp_and_mean,
    inlined,
    inverse_adjoint,
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
    n = len(start_ns)
    if sums is None:
        sums = np.zeros((20 * n, 3))
        sums[: 3 * n].reshape(n, 3, 3)[:] = START[:3]
    C, D = np.empty((6 * n, 6)), np.empty((6 * n, 3))
    _write_motions(rows, start_ns, end_ns, known_ns, longest_ns, bias, earth, body_p_dvl, gyro_density, sums, C, D)
    dR, dp, impulse = sums[: 3 * n].reshape(n, 3, 3), sums[3 * n : 4 * n], sums[4 * n : 5 * n]
    return Motions(dR, dp, C.reshape(n, 6, 6), D.reshape(n, 6, 3), impulse)


class Sums(NamedTuple):
    """Sums of the steps so far: pose, impulse f, and the blocks of C_i and D_i, t rotation and r translation."""

    R: Mat3
    p: Vec3
    f: Vec3
    tt: Mat3
    rt: Mat3
    rr: Mat3
    D_t: Mat3
    D_r: Mat3


@inlined
def sums_of(sums: Floats, n: int, e: int) -> Sums:
    """Sums of interval e of n."""
    at, n3 = 5 * n + 3 * e, 3 * n
    tt, rt, rr = block(sums, at, 0), block(sums, at + n3, 0), block(sums, at + 2 * n3, 0)
    D_t, D_r = block(sums, at + 3 * n3, 0), block(sums, at + 4 * n3, 0)
    return Sums(block(sums, 3 * e, 0), row(sums, 3 * n + e), row(sums, 4 * n + e), tt, rt, rr, D_t, D_r)


@inlined
def put_sums(each: Sums, sums: Floats, n: int, e: int) -> None:
    """Write the sums of interval e of n."""
    store(each.R, sums, 3 * e, 0)
    put(each.p, sums, 3 * n + e)
    put(each.f, sums, 4 * n + e)
    store(each.tt, sums, 5 * n + 3 * e, 0)
    store(each.rt, sums, 8 * n + 3 * e, 0)
    store(each.rr, sums, 11 * n + 3 * e, 0)
    store(each.D_t, sums, 14 * n + 3 * e, 0)
    store(each.D_r, sums, 17 * n + 3 * e, 0)


@inlined
def with_step(each: Sums, step: Step, turn_psd: Vec3, bias: Vec3, earth: Vec3, arm: Vec3, gyro_psd: float) -> Sums:
    """Sums with one more step, whose rates miss noise of a spectral density ``turn_psd`` besides the gyros' own."""
    R, p, f, tt, rt, rr, D_t, D_r = each
    dt, w, N = step.duration_s, step.rate - bias - R.T @ earth, gyro_psd * I3
    turn, mean = exp_and_mean(dt * w)
    R_k = R @ mean
    if turn_psd @ turn_psd > 0.0:
        N = N + R_k @ diagonal(turn_psd) @ R_k.T
    s = dt * (R_k @ (step.velocity - cross(w, arm)))
    c = skew(p + 0.5 * s + R_k @ arm)
    rr_k = R_k @ step.Q @ R_k.T - c @ N @ c
    return Sums(
        R @ turn,
        p + s,
        f + dt * (R_k @ step.force),
        tt + dt * N,
        rt + dt * (c @ N),
        rr + dt * rr_k,
        D_t - dt * R_k,
        D_r - dt * (c @ R_k),
    )


@compiled
def _add_steps(
    rows: Rows, imu_rows: int, dvl_rows: int, t: int, end: int, bias: Floats, earth: Floats, body_p_dvl: Floats,
    gyro_psd: float, sums: Floats, n: int, e: int,
) -> int:  # fmt: skip
    """Add steps to the sums of interval e, up to its end or a hole of the IMU; returns the instant reached."""
    b, E, arm, each = vec(bias), vec(earth), vec(body_p_dvl), sums_of(sums, n, e)
    i, k = rows_until(rows.imu_ns, t), rows_until(rows.dvl_ns, t)
    while t < end and not may_be_in_hole(rows, imu_rows, i, end):
        step = step_from(rows, imu_rows, dvl_rows, i, k, t, end)
        t = step.until_ns
        i += int(i < imu_rows and rows.imu_ns[i] <= t)
        k += int(k < dvl_rows and rows.dvl_ns[k] <= t)
        each = with_step(each, step, ZERO, b, E, arm, gyro_psd)
    put_sums(each, sums, n, e)
    return t


@compiled
def _add_step_in_hole(
    rows: Rows, imu_rows: int, dvl_rows: int, t: int, end: int, bias: Floats, earth: Floats, body_p_dvl: Floats,
    gyro_psd: float, sums: Floats, n: int, e: int,
) -> int:  # fmt: skip
    """Add one step as `_add_steps`, where there may be a hole; apart from it, since calls make a loop slow."""
    i, k = rows_until(rows.imu_ns, t), rows_until(rows.dvl_ns, t)
    step, turn_psd = in_hole(rows, imu_rows, i, t, step_from(rows, imu_rows, dvl_rows, i, k, t, end))
    noise = vec(bias), vec(earth), vec(body_p_dvl), gyro_psd
    put_sums(with_step(sums_of(sums, n, e), step, turn_psd, *noise), sums, n, e)
    return step.until_ns


@compiled
def _write_motions(
    rows: Rows, start_ns: Ints, end_ns: Ints, known_ns: Ints, longest_ns: int, bias: Floats, earth: Floats,
    body_p_dvl: Floats, gyro_density: float, sums: Floats, C: Floats, D: Floats,
) -> None:  # fmt: skip
    """Continue sums, and fill C and D of `Motions`; matrices one below the other (reshaping is slow to compile)."""
    n, noise = len(start_ns), (bias, earth, body_p_dvl, gyro_density**2)
    for e in range(n):
        t, end = start_ns[e], end_ns[e]
        imu_rows, dvl_rows = rows_until(rows.imu_ns, known_ns[e]), max(rows_until(rows.known_ns, known_ns[e]), 1)
        if has_gap(rows.dvl_ns, dvl_rows, rows_until(rows.dvl_ns, t), t, end, longest_ns):
            t = end
            store(np.nan * I3, sums, 3 * e, 0)
            put(NOWHERE, sums, 3 * n + e)
            put(NOWHERE, sums, 4 * n + e)
        while t < end:
            t = _add_steps(rows, imu_rows, dvl_rows, t, end, *noise, sums, n, e)
            if t < end:
                t = _add_step_in_hole(rows, imu_rows, dvl_rows, t, end, *noise, sums, n, e)
        R, p, _, tt, rt, rr, D_t, D_r = sums_of(sums, n, e)
        to_j = inverse_adjoint(R, p)
        store6(to_j @ Mat6(tt, rt.T, rt, rr) @ to_j.T, C, 6 * e)
        store(to_j.a @ D_t, D, 6 * e, 0)
        store(to_j.c @ D_t + to_j.d @ D_r, D, 6 * e + 3, 0)
