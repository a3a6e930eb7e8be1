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
from sonar_graph.navigation.steps import Rows, put, rows_until, value_at
from sonar_graph.numerics import O3, ZERO, Vec3, compiled, cross, exp_and_mean, mat, store, vec


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
    velocity: Floats
    """v_d at the start of each interval and at its end, body axes, shape (2, m, 3), m/s."""
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


@compiled
def sums_along(rows: Rows, imu_rows: int, line: Line, R_0: Floats, bias: Floats, earth: Floats) -> Sums:
    """Sums along a line from the first ``imu_rows`` inertial rows, with the first rotation R_0.

    Removed are the gyro bias (body axes) and the Earth's rotation (frame i), rad/s.
    """
    cuts_ns, imu_ns, m = line.cuts_ns, rows.imu_ns, len(line.W)
    R_cuts, turned_s, y, r, a = (
        np.empty((m + 1, 3, 3)),
        np.zeros((2, m, 3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(3),
    )
    yy, yR, aR = np.zeros((9, 9)), np.zeros((9, 3, 3)), np.zeros((3, 3, 3))
    y_after, R_after, aa = np.zeros(9), np.zeros((3, 3)), np.zeros((3, 3))
    R, v, p, s, b, E = mat(R_0), ZERO, ZERO, ZERO, vec(bias), vec(earth)
    t, T = cuts_ns[0], (cuts_ns[m] - line.origin_ns) * 1e-9
    i = rows_until(imu_ns, t)
    for k in range(m):
        store(R, R_cuts[k], 0, 0)
        s += R @ vec(line.jumps[k])
        z, slope, before, after = vec(line.velocity[0, k]), vec(line.velocity[1, k]) - vec(line.velocity[0, k]), O3, O3
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

            h = 1.0 if middle > line.origin_ns else 0.0
            t_s = h * ((middle - line.origin_ns) * 1e-9)
            F, moment = dt * (R_k @ f), (h * dt**3 / 12.0) * (R_k @ cross(w, f))
            a[0], a[1], a[2] = h, h * (T - t_s), line.W[k] - t_s if line.is_inertial else 0.0
            dv, dp = a[0] * F, a[1] * F - moment
            ds = a[2] * F - moment if line.is_inertial else dt * (R_k @ (z + share * slope))
            bent = (h * dt / 12.0) * F  # mean over the step of what a falling share adds
            put(v + 0.5 * dv, y, 0)
            put(p + 0.5 * dp + bent, y, 1)
            put(s + 0.5 * ds + bent if line.is_inertial else s + 0.5 * ds, y, 2)
            store(R_k, r, 0, 0)
            add_moments(
                dt,
                h,
                y.reshape(9),
                r.reshape(9),
                a,
                yy,
                y_after,
                yR.reshape(9, 9),
                R_after.reshape(9),
                aa,
                aR.reshape(3, 9),
            )
            v, p, s, R = v + dv, p + dp, s + ds, R @ turn
            i += int(i < imu_rows and imu_ns[i] <= until)
            t = until
        store(before, turned_s[0, k], 0, 0)
        store(after, turned_s[1, k], 0, 0)
    store(R, R_cuts[m], 0, 0)
    put(v, y, 0)
    put(p, y, 1)
    put(s + R @ vec(line.jumps[m]), y, 2)
    return Sums(R_cuts, y.reshape(9), turned_s, yy, y_after, yR, R_after, aa, aR)


@compiled
def add_moments(
    dt: float,
    h: float,
    y: Floats,
    R: Floats,
    a: Floats,
    yy: Floats,
    y_after: Floats,
    yR: Floats,
    R_after: Floats,
    aa: Floats,
    aR: Floats,
) -> None:
    """Add a step to the moments of `Sums`."""
    for j in range(9):
        dy = dt * y[j]
        y_after[j] += h * dy
        R_after[j] += h * dt * R[j]
        for k in range(9):
            yy[j, k] += dy * y[k]
            yR[j, k] += dy * R[k]
    for j in range(3):
        for k in range(3):
            aa[j, k] += dt * a[j] * a[k]
        for k in range(9):
            aR[j, k] += dt * a[j] * R[k]


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
