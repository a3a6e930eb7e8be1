"""The recursion of preintegration as machine code: about 0.2 µs for a step, where matrix expressions take 5 µs.

The equations are those of `sonar_graph.navigation.dvl_preintegration`, with the rotation's perturbation kept in frame i
until the end (``theta_i = dR theta``), where it needs no transport::

    theta_i <- theta_i + dR J_l dt d
    eps     <- eps - [s]x theta_i + (dR D dt + dR J_l [l]x) dt d + dR J_l dt n,     s = dR J_l u dt

Arrays are made once before the loop, and
products of 3 × 3 matrices are written into arrays that exist: in compiled code a small allocation costs as much as the
arithmetic, and a call into BLAS several times that.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled

SERIES_ANGLE2 = 2.5e-3
"""Squared angle (rad²) below which four terms of each series are exact to 1e-16."""


@compiled
def integrate_steps(
    duration: Floats,
    rate: Floats,
    velocity: Floats,
    velocity_psd: Floats,
    force: Floats,
    bias: Floats,
    earth: Floats,
    lever: Floats,
    gyro_density: float,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Motion over all steps, from frame i to frame j.

    Parameters
    ----------
    duration, rate, velocity, velocity_psd, force
        The columns of `sonar_graph.navigation.odometry.Steps`.
    bias
        Gyro bias to remove, body frame, shape (3,), rad/s.
    earth
        Earth's rotation in frame i, shape (3,), rad/s.
    lever
        The DVL in the body frame, shape (3,), m.
    gyro_density
        White noise of the gyros, rad/s/√Hz.

    Returns
    -------
    dR (3, 3), dp (3,), covariance (6, 6) and bias Jacobian (6, 3) of the perturbation in frame j, and the integral of
    the specific force in frame i (3,), m/s.
    """
    dR, dp, impulse = np.eye(3), np.zeros(3), np.zeros(3)
    cov_tt, cov_rt, cov_rr = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    D_t, D_r = np.zeros((3, 3)), np.zeros((3, 3))
    turn, chord, turned, G_r = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    w, phi, u, step = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    work, moved = np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(duration)):
        dt = duration[k]
        for r in range(3):
            w[r] = rate[k, r] - bias[r] - (dR[0, r] * earth[0] + dR[1, r] * earth[1] + dR[2, r] * earth[2])
            phi[r] = w[r] * dt
        for r in range(3):
            a, b = (r + 1) % 3, (r + 2) % 3
            u[r] = velocity[k, r] - (w[a] * lever[b] - w[b] * lever[a])
        _rotations(phi, turn, chord)
        _product(dR, chord, turned)
        for r in range(3):
            step[r] = (turned[r, 0] * u[0] + turned[r, 1] * u[1] + turned[r, 2] * u[2]) * dt
        _chord_derivative(phi, u, dt, work)
        _product(dR, work, G_r)
        _add_crossed(turned, lever, G_r)

        _transport(cov_tt, cov_rt, cov_rr, step, moved)
        _add_gyro_noise(cov_tt, cov_rt, cov_rr, turned, G_r, gyro_density * gyro_density * dt)
        _add_doppler_noise(cov_rr, turned, velocity_psd[k], dt, work)
        _transport_bias(D_t, D_r, step, turned, G_r, dt)

        for r in range(3):
            impulse[r] += (turned[r, 0] * force[k, 0] + turned[r, 1] * force[k, 1] + turned[r, 2] * force[k, 2]) * dt
            dp[r] += step[r]
        _product(dR, turn, work)
        _copy(work, dR)
    cov, D = _in_last_frame(dR, cov_tt, cov_rt, cov_rr, D_t, D_r)
    return dR, dp, cov, D, impulse


@compiled
def trace_point(
    duration: Floats, rate: Floats, velocity: Floats, bias: Floats, lever: Floats, point: Floats, offsets: Floats
) -> Floats:
    """Where a point of the body is at times after the first instant, in frame i, shape (n, 3); the mean motion only.

    Parameters
    ----------
    point
        In the body frame, shape (3,), m.
    offsets
        Seconds after the start of the steps, not decreasing, shape (n,). Motion within a step is taken as straight.
    """
    positions = np.empty((len(offsets), 3))
    dR, dp = np.eye(3), np.zeros(3)
    turn, chord, work = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    w, phi, u, step, before, after = np.empty(3), np.empty(3), np.empty(3), np.empty(3), point.copy(), point.copy()
    elapsed, n = 0.0, 0
    for k in range(len(duration)):
        dt = duration[k]
        for r in range(3):
            w[r] = rate[k, r] - bias[r]
            phi[r] = w[r] * dt
        for r in range(3):
            a, b = (r + 1) % 3, (r + 2) % 3
            u[r] = velocity[k, r] - (w[a] * lever[b] - w[b] * lever[a])
        _rotations(phi, turn, chord)
        for r in range(3):
            step[r] = (chord[r, 0] * u[0] + chord[r, 1] * u[1] + chord[r, 2] * u[2]) * dt
        for r in range(3):
            dp[r] += dR[r, 0] * step[0] + dR[r, 1] * step[1] + dR[r, 2] * step[2]
        _product(dR, turn, work)
        _copy(work, dR)
        for r in range(3):
            after[r] = dp[r] + dR[r, 0] * point[0] + dR[r, 1] * point[1] + dR[r, 2] * point[2]
        while n < len(offsets) and offsets[n] <= elapsed + dt:
            for r in range(3):
                positions[n, r] = before[r] + (offsets[n] - elapsed) / dt * (after[r] - before[r])
            n += 1
        for r in range(3):
            before[r] = after[r]
        elapsed += dt
    for m in range(n, len(offsets)):
        for r in range(3):
            positions[m, r] = before[r]
    return positions


@compiled
def _rotations(phi: Floats, turn: Floats, chord: Floats) -> None:
    """Exp(phi) and J_l(phi) at once: they share sine and cosine, and a sample's turn needs neither."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if angle2 < SERIES_ANGLE2:
        s1 = 1.0 - angle2 * (1.0 / 6.0 - angle2 * (1.0 / 120.0 - angle2 / 5040.0))
        s2 = 0.5 - angle2 * (1.0 / 24.0 - angle2 * (1.0 / 720.0 - angle2 / 40320.0))
        s3 = 1.0 / 6.0 - angle2 * (1.0 / 120.0 - angle2 * (1.0 / 5040.0 - angle2 / 362880.0))
    else:
        angle = np.sqrt(angle2)
        s1, s2 = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
        s3 = (1.0 - s1) / angle2
    _fill(phi, angle2, s1, s2, turn)
    _fill(phi, angle2, s2, s3, chord)


@compiled
def _fill(phi: Floats, angle2: float, a: float, b: float, out: Floats) -> None:
    """``I + a [phi]x + b [phi]x^2``, with ``[phi]x^2 = phi phi^T - |phi|^2 I``."""
    for r in range(3):
        for c in range(3):
            out[r, c] = b * phi[r] * phi[c]
        out[r, r] += 1.0 - b * angle2
    for r in range(3):
        c, other = (r + 1) % 3, (r + 2) % 3
        out[r, c] -= a * phi[other]
        out[c, r] += a * phi[other]


@compiled
def _copy(A: Floats, out: Floats) -> None:
    """``out = A``, 3 × 3; an assignment of arrays takes seconds to compile."""
    for r in range(3):
        for c in range(3):
            out[r, c] = A[r, c]


@compiled
def _product(A: Floats, B: Floats, out: Floats) -> None:
    """``out = A B``, 3 × 3."""
    for r in range(3):
        for c in range(3):
            out[r, c] = A[r, 0] * B[0, c] + A[r, 1] * B[1, c] + A[r, 2] * B[2, c]


@compiled
def _transposed_product(A: Floats, B: Floats, out: Floats) -> None:
    """``out = A^T B``, 3 × 3."""
    for r in range(3):
        for c in range(3):
            out[r, c] = A[0, r] * B[0, c] + A[1, r] * B[1, c] + A[2, r] * B[2, c]


@compiled
def _add_crossed(A: Floats, v: Floats, out: Floats) -> None:
    """``out += A [v]x``."""
    for r in range(3):
        for c in range(3):
            a, b = (c + 1) % 3, (c + 2) % 3
            out[r, c] += A[r, a] * v[b] - A[r, b] * v[a]


@compiled
def _subtract_cross(v: Floats, A: Floats, out: Floats) -> None:
    """``out -= [v]x A``."""
    for r in range(3):
        a, b = (r + 1) % 3, (r + 2) % 3
        for c in range(3):
            out[r, c] -= v[a] * A[b, c] - v[b] * A[a, c]


@compiled
def _chord_derivative(phi: Floats, u: Floats, scale: float, out: Floats) -> None:
    """Derivative of ``J_l(phi) u`` by phi, times scale; to second order in phi (a step turns by far less than 1 rad).

    ``-[u]x / 2 - ([phi]x [u]x + [phi x u]x) / 6``, with ``[phi]x [u]x = u phi^T - (phi . u) I``.
    """
    dot = phi[0] * u[0] + phi[1] * u[1] + phi[2] * u[2]
    for r in range(3):
        for c in range(3):
            out[r, c] = -scale * u[r] * phi[c] / 6.0
        out[r, r] += scale * dot / 6.0
    for r in range(3):
        c, other = (r + 1) % 3, (r + 2) % 3
        turn = scale * (0.5 * u[other] + (phi[r] * u[c] - phi[c] * u[r]) / 6.0)
        out[r, c] += turn
        out[c, r] -= turn


@compiled
def _transport(cov_tt: Floats, cov_rt: Floats, cov_rr: Floats, step: Floats, before: Floats) -> None:
    """``P <- F P F^T`` with ``F = [[I, 0], [-[step]x, I]]``; ``before`` is scratch; upper half of P_rr only."""
    _copy(cov_rt, before)
    _subtract_cross(step, cov_tt, cov_rt)
    for r in range(3):
        a, b = (r + 1) % 3, (r + 2) % 3
        for c in range(r, 3):
            d, e = (c + 1) % 3, (c + 2) % 3
            cov_rr[r, c] -= step[a] * before[c, b] - step[b] * before[c, a]
            cov_rr[r, c] -= step[d] * cov_rt[r, e] - step[e] * cov_rt[r, d]


@compiled
def _add_gyro_noise(cov_tt: Floats, cov_rt: Floats, cov_rr: Floats, G_t: Floats, G_r: Floats, variance: float) -> None:
    """``P += G G^T variance``; upper half of P_rr only."""
    for r in range(3):
        for c in range(r, 3):
            cov_tt[r, c] += variance * (G_t[r, 0] * G_t[c, 0] + G_t[r, 1] * G_t[c, 1] + G_t[r, 2] * G_t[c, 2])
            cov_tt[c, r] = cov_tt[r, c]
            cov_rr[r, c] += variance * (G_r[r, 0] * G_r[c, 0] + G_r[r, 1] * G_r[c, 1] + G_r[r, 2] * G_r[c, 2])
        for c in range(3):
            cov_rt[r, c] += variance * (G_r[r, 0] * G_t[c, 0] + G_r[r, 1] * G_t[c, 1] + G_r[r, 2] * G_t[c, 2])


@compiled
def _add_doppler_noise(cov_rr: Floats, turned: Floats, psd: Floats, dt: float, work: Floats) -> None:
    """``P_rr += turned psd turned^T dt``; upper half only."""
    _product(turned, psd, work)
    for r in range(3):
        for c in range(r, 3):
            cov_rr[r, c] += dt * (work[r, 0] * turned[c, 0] + work[r, 1] * turned[c, 1] + work[r, 2] * turned[c, 2])


@compiled
def _transport_bias(D_t: Floats, D_r: Floats, step: Floats, G_t: Floats, G_r: Floats, dt: float) -> None:
    """``D <- F D - G dt``."""
    _subtract_cross(step, D_t, D_r)
    for r in range(3):
        for c in range(3):
            D_t[r, c] -= G_t[r, c] * dt
            D_r[r, c] -= G_r[r, c] * dt


@compiled
def _in_last_frame(
    dR: Floats, cov_tt: Floats, cov_rt: Floats, cov_rr: Floats, D_t: Floats, D_r: Floats
) -> tuple[Floats, Floats]:
    """Covariance and bias Jacobian turned from frame i into frame j."""
    cov, D = np.empty((6, 6)), np.empty((6, 3))
    tt, rt, rr, work = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    D_t_j, D_r_j = np.empty((3, 3)), np.empty((3, 3))
    for r in range(3):
        for c in range(r):
            cov_rr[r, c] = cov_rr[c, r]
    _turn_back(dR, cov_tt, tt, work)
    _turn_back(dR, cov_rt, rt, work)
    _turn_back(dR, cov_rr, rr, work)
    _transposed_product(dR, D_t, D_t_j)
    _transposed_product(dR, D_r, D_r_j)
    for r in range(3):
        for c in range(3):
            cov[r, c] = 0.5 * (tt[r, c] + tt[c, r])
            cov[3 + r, c] = cov[c, 3 + r] = rt[r, c]
            cov[3 + r, 3 + c] = 0.5 * (rr[r, c] + rr[c, r])
            D[r, c], D[3 + r, c] = D_t_j[r, c], D_r_j[r, c]
    return cov, D


@compiled
def _turn_back(dR: Floats, A: Floats, out: Floats, work: Floats) -> None:
    """``out = dR^T A dR``."""
    _transposed_product(dR, A, work)
    _product(work, dR, out)
