"""Sums of turned vectors along a motion, and what noise and biases of the IMU make of them.

Velocity and position that the accelerometers gain, and displacement by Doppler samples z_k with the accelerometers in
between, are sums over steps and samples. With T the duration, t the time since the first instant and W(t) the sum of
the weights of the samples up to t::

    v = sum dt R f,    p = sum dt (T - t) R f,    s = sum_k w_k R_k z_k + sum dt (W(t) - t) R f

Without accelerometers, ``s = sum dt R v_d`` with a velocity v_d between the samples. For each sum, with a(t) the share
of the specific force and x(t) minus what the sum gains after t, errors at t of the gyros (theta, in frame i) and of the
accelerometers change it by ``[x]x theta`` and ``a R``. White noise and constant biases give sums again::

    cov(b, c) = n_g^2 sum dt [x_b]x [x_c]x^T + n_a^2 sum dt a_b a_c I,    cov(b, theta) = n_g^2 sum dt [x_b]x
    D_gyro = - sum dt [x_b]x R,    D_accel = - sum dt a_b R

docs/theory/preintegration.md, docs/theory/gaps.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.imu_gaps import UNFELT_NS, hole_ns
from sonar_graph.navigation.steps import Rows, row, rows_until, value_at
from sonar_graph.numerics import O3, ZERO, Vec3, compiled, cross, exp_and_mean, inlined, mat, store, vec


class Line(NamedTuple):
    """Times in order, from which to which a motion goes, and its displacement s."""

    cuts_ns: Ints
    """Shape (m + 1,)."""
    is_inertial: bool
    """True where the accelerometers shape the velocity between the samples; else it is linear over each interval."""
    W: Floats
    """Sum of the samples' weights in each interval, shape (m,), s."""
    jumps: Floats
    """``w_k z_k`` at the cuts, body axes, shape (m + 1, 3), m."""
    v_start: Floats
    """v_d at the start of each interval, body axes, shape (m, 3), m/s."""
    v_end: Floats
    """The same at its end."""
    origin_ns: int
    """Instant of frame i, one of the cuts; what lies before only shapes s."""


class Sums(NamedTuple):
    """Sums v, p, s in frame i, stacked to vectors of nine numbers, and their moments about zero."""

    R: Floats
    """At the cuts, shape (m + 1, 3, 3)."""
    whole: Floats
    """v, p and s, shape (9,)."""
    turned_s: Floats
    """``sum dt (1 - c) R`` and ``sum dt c R`` with c growing from 0 to 1 over each interval, shape (2, m, 3, 3)."""
    yy: Floats
    """``sum dt y y^T`` with y the sums so far, shape (9, 9)."""
    y: Floats
    """``sum dt y`` after the origin, shape (9,)."""
    yR: Floats
    """``sum dt y R``, shape (9, 3, 3)."""
    R_after: Floats
    """``sum dt R`` after the origin, shape (3, 3)."""
    aa: Floats
    """``sum dt a a^T``, shape (3, 3)."""
    aR: Floats
    """``sum dt a R``, shape (3, 3, 3)."""


def sums_along(rows: Rows, imu_rows: int, line: Line, R_0: Floats, bias: Floats, earth: Floats) -> Sums:
    """Sums along a line from the first ``imu_rows`` inertial rows, with the first rotation R_0.

    Removed are the gyro bias (body axes) and the Earth's rotation (frame i), rad/s.
    """
    m = len(line.W)
    R, turned_s, whole = np.empty((3 * m + 3, 3)), np.empty((6 * m, 3)), np.empty(9)
    by_y, by_time, by_a = np.zeros((18, 9)), np.zeros((2, 9)), np.zeros((3, 12))
    _write_sums(rows, imu_rows, line, R_0, bias, earth, R, turned_s, whole, by_y, by_time, by_a)
    return Sums(
        R.reshape(m + 1, 3, 3),
        whole,
        turned_s.reshape(2, m, 3, 3),
        by_y[:9],
        by_time[0],
        by_y[9:].reshape(3, 3, 9).transpose(2, 0, 1).reshape(9, 3, 3),
        by_time[1].reshape(3, 3),
        by_a[:, 9:],
        by_a[:, :9].reshape(3, 3, 3),
    )


@compiled
def _write_sums(
    rows: Rows,
    imu_rows: int,
    line: Line,
    R_0: Floats,
    bias: Floats,
    earth: Floats,
    R_cuts: Floats,
    turned_s: Floats,
    whole: Floats,
    by_y: Floats,
    by_time: Floats,
    by_a: Floats,
) -> None:
    """Fill the columns of `Sums`, matrices one below the other (views of arrays are slow to compile)."""
    cuts_ns, is_inertial, W, jumps, v_start, v_end, origin_ns = line
    imu_ns, m, y, r, a = rows.imu_ns, len(W), np.empty(9), np.empty(9), np.empty(3)
    R, v, p, s, b, E = mat(R_0), ZERO, ZERO, ZERO, vec(bias), vec(earth)
    t, T = cuts_ns[0], (cuts_ns[m] - origin_ns) * 1e-9
    i = rows_until(imu_ns, t)
    for k in range(m):
        store(R, R_cuts, (3 * k, 0))
        s += R @ row(jumps, k)
        z, slope, before, after = row(v_start, k), row(v_end, k) - row(v_start, k), O3, O3
        while t < cuts_ns[k + 1]:
            until = min(cuts_ns[k + 1], imu_ns[i]) if i < imu_rows else cuts_ns[k + 1]
            middle, dt = t + (until - t) // 2, (until - t) * 1e-9
            w = value_at(imu_ns, rows.rate, imu_rows, i, middle, False) - b - R.T @ E
            f = value_at(imu_ns, rows.force, imu_rows, i, middle, False)
            if rows.turns.is_modelled and hole_ns(imu_ns, imu_rows, i, until) > UNFELT_NS:
                f = Vec3(np.nan, np.nan, np.nan)
            turn, mean = exp_and_mean(dt * w)
            R_k = R @ mean
            share = (middle - cuts_ns[k]) / (cuts_ns[k + 1] - cuts_ns[k])
            before, after = before + (dt * (1.0 - share)) * R_k, after + (dt * share) * R_k

            h = 1.0 if middle > origin_ns else 0.0
            t_s = h * ((middle - origin_ns) * 1e-9)
            F, moment = dt * (R_k @ f), (h * dt**3 / 12.0) * (R_k @ cross(w, f))
            bent = (h * dt / 12.0) * F  # mean over the step of what a falling share adds
            a[0], a[1], a[2] = h, T - t_s, W[k] - t_s if is_inertial else 0.0
            dv, dp, ds = a[0] * F, a[1] * F - moment, dt * (R_k @ (z + share * slope))
            y_s = s + 0.5 * ds
            if is_inertial:
                ds = a[2] * F - moment
                y_s = s + 0.5 * ds + bent
            nine(v + 0.5 * dv, p + 0.5 * dp + bent, y_s, y)
            nine(R_k.x, R_k.y, R_k.z, r)
            for j in range(9):
                by_time[0, j] += h * dt * y[j]
                by_time[1, j] += h * dt * r[j]
                for c in range(9):
                    by_y[j, c] += dt * y[j] * y[c]
                    by_y[9 + j, c] += dt * r[j] * y[c]
            for j in range(3):
                for c in range(9):
                    by_a[j, c] += dt * a[j] * r[c]
                for c in range(3):
                    by_a[j, 9 + c] += dt * a[j] * a[c]
            v, p, s, R = v + dv, p + dp, s + ds, R @ turn
            i += int(i < imu_rows and imu_ns[i] <= until)
            t = until
        store(before, turned_s, (3 * k, 0))
        store(after, turned_s, (3 * (m + k), 0))
    store(R, R_cuts, (3 * m, 0))
    nine(v, p, s + R @ row(jumps, m), whole)


@inlined
def nine(a: Vec3, b: Vec3, c: Vec3, out: Floats) -> None:
    """Write three vectors into an array, one after the other."""
    out[0], out[1], out[2] = a.x, a.y, a.z
    out[3], out[4], out[5] = b.x, b.y, b.z
    out[6], out[7], out[8] = c.x, c.y, c.z


CROSS = np.zeros((3, 3, 3))
"""``(a x b)_i = CROSS_ijk a_j b_k``."""
CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]], CROSS[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = 1.0, -1.0
I3 = np.eye(3)


def hat(vectors: Floats) -> Floats:
    """``[v]x`` of vectors, shape (..., 3, 3)."""
    return np.einsum("ijk,...j->...ik", CROSS, vectors)


class Spread(NamedTuple):
    """Errors of v, p and s, frame i."""

    C: Floats
    """Covariance, shape (9, 9)."""
    C_theta: Floats
    """Covariance with theta, shape (9, 3)."""
    D_gyro: Floats
    """Derivative by the gyro bias, shape (9, 3)."""
    D_accel: Floats
    """Derivative by the accelerometer bias, shape (9, 3)."""


def spread(sums: Sums, end: Floats, T: float, gyro_density: float, accel_density: float) -> Spread:
    """Errors of sums whose levers x are ``y - end``, shape (9,), in the T seconds after the origin and y before."""
    xx = (sums.yy - np.outer(end, sums.y) - np.outer(sums.y, end) + T * np.outer(end, end)).reshape(3, 3, 3, 3)
    by_gyro = np.trace(xx, axis1=1, axis2=3)[:, None, :, None] * I3[:, None] - xx.transpose(0, 3, 2, 1)
    by_accel = sums.aa[:, None, :, None] * I3[:, None]
    xR = (sums.yR - end[:, None, None] * sums.R_after).reshape(3, 3, 3, 3)
    return Spread(
        (gyro_density**2 * by_gyro + accel_density**2 * by_accel).reshape(9, 9),
        gyro_density**2 * hat((sums.y - T * end).reshape(3, 3)).reshape(9, 3),
        -np.einsum("ijk,mjkc->mic", CROSS, xR).reshape(9, 3),
        -sums.aR.reshape(9, 3),
    )
