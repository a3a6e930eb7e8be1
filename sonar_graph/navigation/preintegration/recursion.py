"""Steps of gyro and Doppler rows, and the recursion of preintegration over them, as machine code.

Rows of both sensors are merged into steps of constant rate and velocity, on which every estimator moves. The equations
are those of `.preintegrator`, with the rotation's perturbation kept in frame i until the
end (``theta_i = dR theta``), where it needs no transport::

    theta_i <- theta_i + dR J_l dt d
    eps     <- eps - [s]x theta_i + (dR D dt + dR J_l [l]x) dt d + dR J_l dt n,     s = dR J_l u dt

Doppler noise is white in time with the spectral density ``velocity_cov * interval``; half of a sample's variance falls
on either side of its epoch. docs/theory/preintegration.md.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.imu_gaps import TurnValues, force_outside_holes, turn_psd
from sonar_graph.navigation.samples import between, bracket, rows_until
from sonar_graph.numerics import (
    IDENTITY,
    ZERO,
    ZEROS,
    Matrix,
    Vector,
    compiled,
    cross,
    difference_of,
    dot,
    gram,
    inlined,
    matrix,
    minus,
    multiple_of,
    place,
    plus,
    product,
    sandwich,
    scaled,
    skew_times,
    sum_of,
    symmetric,
    times,
    times_skew,
    transformed,
    transposed,
    vector,
)

SERIES_ANGLE2 = 2.5e-3
"""Squared angle (rad²) below which four terms of each series are exact to 1e-16."""


class Step(NamedTuple):
    """One row of `Steps`."""

    duration_s: float
    rate: Vector
    velocity: Vector
    velocity_psd: Matrix
    specific_force: Vector
    turn_psd: Vector


class Integral(NamedTuple):
    """Motion from frame i to frame j."""

    dR: Matrix
    dp: Vector
    impulse: Vector
    """Integral of the specific force in frame i, m/s."""
    cov_tt: Matrix
    """Covariance of theta_i; the perturbation [theta_i, eps] is that of the module's equations."""
    cov_rt: Matrix
    """Covariance of eps with theta_i."""
    cov_rr: Matrix
    """Covariance of eps; only the upper half is exact in its last bits, see `mirrored`."""


class Increment(NamedTuple):
    """The contribution of one step to an integral."""

    turn: Matrix
    """``Exp(phi)``."""
    displacement: Vector
    """``s``."""
    theta_by_rate: Matrix
    """``dR J_l``."""
    eps_by_rate: Matrix
    """``dR D dt + dR J_l [l]x``."""


NO_MOTION = Integral(IDENTITY, ZERO, ZERO, ZEROS, ZEROS, ZEROS)


@inlined
def increment(dR: Matrix, duration_s: float, rate: Vector, velocity: Vector, lever: Vector) -> Increment:
    """The contribution of a step after the rotation dR, from the rate without bias and Earth rate."""
    phi, u = scaled(duration_s, rate), minus(velocity, cross(rate, lever))
    turn, chord = exp_and_chord(phi)
    turned = product(dR, chord)
    by_rate = sum_of(product(dR, chord_derivative(phi, u, duration_s)), times_skew(turned, lever))
    return Increment(turn, scaled(duration_s, times(turned, u)), turned, by_rate)


@inlined
def rate_of_turn(step: Step, dR: Matrix, bias: Vector, earth: Vector) -> Vector:
    """Angular rate without gyro bias and Earth rate (in frame i), body axes."""
    return minus(minus(step.rate, bias), times(transposed(dR), earth))


@inlined
def extended(motion: Integral, step: Step, added: Increment, gyro_density: float) -> Integral:
    """The integral one step further."""
    G_t, G_r, s, dt = added.theta_by_rate, added.eps_by_rate, added.displacement, step.duration_s
    gyro = gyro_density * gyro_density * dt
    doppler = sandwich(G_t, step.velocity_psd, G_t)
    cov_rt = difference_of(motion.cov_rt, skew_times(s, motion.cov_tt))
    cov_rr = difference_of(motion.cov_rr, skew_times(s, transposed(motion.cov_rt)))
    cov_rr = sum_of(cov_rr, times_skew(cov_rt, s))
    cov_tt = sum_of(motion.cov_tt, multiple_of(gyro, gram(G_t)))
    cov_rt = sum_of(cov_rt, multiple_of(gyro, product(G_r, transposed(G_t))))
    cov_rr = sum_of(sum_of(cov_rr, multiple_of(gyro, gram(G_r))), multiple_of(dt, doppler))
    if step.turn_psd != ZERO:
        by_turn = scaled(dt, step.turn_psd)
        t, r = _columns_times(G_t, by_turn), _columns_times(G_r, by_turn)
        cov_tt = sum_of(cov_tt, product(t, transposed(G_t)))
        cov_rt = sum_of(cov_rt, product(r, transposed(G_t)))
        cov_rr = sum_of(cov_rr, product(r, transposed(G_r)))
    return Integral(
        product(motion.dR, added.turn),
        plus(motion.dp, s),
        plus(motion.impulse, scaled(dt, times(G_t, step.specific_force))),
        cov_tt,
        cov_rt,
        cov_rr,
    )


@inlined
def _columns_times(A: Matrix, v: Vector) -> Matrix:
    """``A diag(v)``."""
    x, y, z = A
    return (
        (x[0] * v[0], x[1] * v[1], x[2] * v[2]),
        (y[0] * v[0], y[1] * v[1], y[2] * v[2]),
        (z[0] * v[0], z[1] * v[1], z[2] * v[2]),
    )


@inlined
def extended_by_bias(D_t: Matrix, D_r: Matrix, step: Step, added: Increment) -> tuple[Matrix, Matrix]:
    """Derivatives of [theta_i, eps] by the gyro bias, one step further.

    ``D_r <- D_r - [s]x D_t - dt (eps by rate)``, ``D_t <- D_t - dt (theta_i by rate)``.
    """
    D_r = difference_of(D_r, skew_times(added.displacement, D_t))
    D_t = difference_of(D_t, multiple_of(step.duration_s, added.theta_by_rate))
    return D_t, difference_of(D_r, multiple_of(step.duration_s, added.eps_by_rate))


@inlined
def mirrored(A: Matrix) -> Matrix:
    """Symmetric matrix from the upper half."""
    return A[0], (A[0][1], A[1][1], A[1][2]), (A[0][2], A[1][2], A[2][2])


@compiled
def integrate_steps(
    duration: Floats,
    rate: Floats,
    velocity: Floats,
    velocity_psd: Floats,
    force: Floats,
    turn_psd: Floats,
    bias: Floats,
    earth: Floats,
    lever: Floats,
    gyro_density: float,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Motion over all steps (the columns of `Steps`), from frame i to frame j.

    Removed are the gyro bias (body frame) and the Earth's rotation (frame i), rad/s. Returns dR (3, 3), dp (3,),
    covariance (6, 6) and bias Jacobian (6, 3) of the perturbation in frame j, and the integral of the specific force in
    frame i (3,), m/s.
    """
    motion, D_t, D_r = NO_MOTION, ZEROS, ZEROS
    body_bias, earth_i, arm = vector(bias), vector(earth), vector(lever)
    for k in range(len(duration)):
        psd = matrix(velocity_psd[k])
        step = Step(duration[k], vector(rate[k]), vector(velocity[k]), psd, vector(force[k]), vector(turn_psd[k]))
        added = increment(
            motion.dR, step.duration_s, rate_of_turn(step, motion.dR, body_bias, earth_i), step.velocity, arm
        )
        D_t, D_r = extended_by_bias(D_t, D_r, step, added)
        motion = extended(motion, step, added, gyro_density)
    return in_last_frame(motion, D_t, D_r)


@compiled
def trace_point(
    duration: Floats, rate: Floats, velocity: Floats, bias: Floats, lever: Floats, point: Floats, offsets: Floats
) -> Floats:
    """Positions of a point of the body at increasing times (s) after the first instant, in frame i, shape (n, 3), m.

    Motion within a step is taken as straight.
    """
    positions = np.empty((len(offsets), 3))
    dR, dp = IDENTITY, ZERO
    body_bias, arm, p = vector(bias), vector(lever), vector(point)
    before, elapsed, n = p, 0.0, 0
    for k in range(len(duration)):
        dt, w = duration[k], minus(vector(rate[k]), body_bias)
        turn, chord = exp_and_chord(scaled(dt, w))
        step = scaled(dt, times(chord, minus(vector(velocity[k]), cross(w, arm))))
        dp, dR = plus(dp, times(dR, step)), product(dR, turn)
        after = transformed(dp, dR, p)
        while n < len(offsets) and offsets[n] <= elapsed + dt:
            along = scaled((offsets[n] - elapsed) / dt, minus(after, before))
            positions[n, 0], positions[n, 1], positions[n, 2] = plus(before, along)
            n += 1
        before = after
        elapsed += dt
    for m in range(n, len(offsets)):
        positions[m, 0], positions[m, 1], positions[m, 2] = before
    return positions


@inlined
def exp_and_chord(phi: Vector) -> tuple[Matrix, Matrix]:
    """Exp(phi) and J_l(phi), which share sine and cosine; small turns need neither."""
    angle2 = dot(phi, phi)
    s1, s2, s3 = sine_series(angle2)
    return rotation_series(phi, angle2, s1, s2), rotation_series(phi, angle2, s2, s3)


@inlined
def sine_series(angle2: float) -> Vector:
    """``sum_n (-x)^n / (2n + k)!`` for k = 1, 2, 3: sin(t)/t, (1 - cos(t))/t^2, (t - sin(t))/t^3 with ``x = t^2``."""
    if angle2 < SERIES_ANGLE2:
        s1 = 1.0 - angle2 * (1.0 / 6.0 - angle2 * (1.0 / 120.0 - angle2 / 5040.0))
        s2 = 0.5 - angle2 * (1.0 / 24.0 - angle2 * (1.0 / 720.0 - angle2 / 40320.0))
        s3 = 1.0 / 6.0 - angle2 * (1.0 / 120.0 - angle2 * (1.0 / 5040.0 - angle2 / 362880.0))
    else:
        angle = np.sqrt(angle2)
        s1, s2 = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
        s3 = (1.0 - s1) / angle2
    return s1, s2, s3


@inlined
def rotation_series(phi: Vector, angle2: float, a: float, b: float) -> Matrix:
    """``I + a [phi]x + b [phi]x^2``, with ``[phi]x^2 = phi phi^T - |phi|^2 I``."""
    x, y, z = phi
    d = 1.0 - b * angle2
    return (
        (d + b * x * x, b * x * y - a * z, b * x * z + a * y),
        (b * y * x + a * z, d + b * y * y, b * y * z - a * x),
        (b * z * x - a * y, b * z * y + a * x, d + b * z * z),
    )


@inlined
def chord_derivative(phi: Vector, u: Vector, scale: float) -> Matrix:
    """Derivative of ``J_l(phi) u`` by phi, times scale; to second order in phi (a step turns by far less than 1 rad).

    ``-[u]x / 2 - ([phi]x [u]x + [phi x u]x) / 6``, with ``[phi]x [u]x = u phi^T - (phi . u) I``.
    """
    v, d = cross(phi, u), scale * dot(phi, u) / 6.0
    x, y, z = (scale * (0.5 * u[0] + v[0] / 6.0), scale * (0.5 * u[1] + v[1] / 6.0), scale * (0.5 * u[2] + v[2] / 6.0))
    a, b, c = scaled(-scale, u)
    return (
        (a * phi[0] / 6.0 + d, a * phi[1] / 6.0 + z, a * phi[2] / 6.0 - y),
        (b * phi[0] / 6.0 - z, b * phi[1] / 6.0 + d, b * phi[2] / 6.0 + x),
        (c * phi[0] / 6.0 + y, c * phi[1] / 6.0 - x, c * phi[2] / 6.0 + d),
    )


@compiled
def in_last_frame(motion: Integral, D_t: Matrix, D_r: Matrix) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Arrays of `integrate_steps`: covariance and bias Jacobian turned from frame i into frame j."""
    j_R_i = transposed(motion.dR)
    rt = sandwich(j_R_i, motion.cov_rt, j_R_i)
    cov, D, dR = np.empty((6, 6)), np.empty((6, 3)), np.empty((3, 3))
    place(motion.dR, dR, 0, 0)
    place(symmetric(sandwich(j_R_i, motion.cov_tt, j_R_i)), cov, 0, 0)
    place(transposed(rt), cov, 0, 3)
    place(rt, cov, 3, 0)
    place(symmetric(sandwich(j_R_i, mirrored(motion.cov_rr), j_R_i)), cov, 3, 3)
    place(product(j_R_i, D_t), D, 0, 0)
    place(product(j_R_i, D_r), D, 3, 0)
    return dR, np.array(motion.dp), cov, D, np.array(motion.impulse)


Columns = tuple[Ints, Floats, Floats, Ints, Floats, Floats, bool, TurnValues]
"""IMU: stamps, rate, specific force. DVL: stamps, velocity, covariance. True where a sample holds for the interval
before it. Turn values for holes of the IMU."""


class Cursor(NamedTuple):
    """An instant among the rows."""

    stamp_ns: int
    imu_row: int
    """First IMU row after it."""
    dvl_row: int
    """First DVL row after it."""


@dataclass(frozen=True, eq=False)
class Steps:
    """Motion of the body in n successive steps, as measured (no bias removed)."""

    duration_s: Floats
    """Shape (n,)."""
    rate: Floats
    """Mean angular rate in the body frame, shape (n, 3), rad/s."""
    velocity: Floats
    """Mean velocity of the DVL's origin, body axes, shape (n, 3), m/s."""
    velocity_psd: Floats
    """Spectral density of its noise, body axes, shape (n, 3, 3), m²/s."""
    specific_force: Floats
    """Mean specific force at the IMU, body axes, shape (n, 3), m/s²; NaN where not measured."""
    turn_psd: Floats
    """Spectral density of the rates' error in holes of the IMU, body axes, shape (n, 3), rad²/s; zero elsewhere."""

    def __len__(self) -> int:
        return len(self.duration_s)


@inlined
def cursor_at(columns: Columns, instant_ns: int) -> Cursor:
    """The cursor with which motion from an instant begins."""
    return Cursor(instant_ns, rows_until(columns[0], instant_ns), rows_until(columns[3], instant_ns))


@inlined
def next_step(columns: Columns, imu_rows: int, dvl_rows: int, cursor: Cursor, end_ns: int) -> tuple[Cursor, Step]:
    """The step from a cursor to the next stamp of either sensor, or to the end: each sensor's mean over it.

    Only the first ``imu_rows`` and ``dvl_rows`` rows are used. The velocity noise after the last DVL row is that of the
    last interval.
    """
    imu_ns, rate, force, dvl_ns, velocity, cov, hold_past, turns = columns
    t, i, k = cursor
    until = end_ns
    if i < imu_rows:
        until = min(until, imu_ns[i])
    if k < dvl_rows:
        until = min(until, dvl_ns[k])
    middle = t + (until - t) // 2
    before, after, share = bracket(imu_ns, imu_rows, i, middle, hold_past)
    last = min(k, dvl_rows - 1)
    interval_s = (dvl_ns[last] - dvl_ns[last - 1]) * 1e-9 if last > 0 else 0.0
    other = last if hold_past or k >= dvl_rows or last == 0 else last - 1
    step = Step(
        (until - t) * 1e-9,
        between(rate, before, after, share),
        between(velocity, *bracket(dvl_ns, dvl_rows, k, middle, hold_past)),
        multiple_of(interval_s, multiple_of(0.5, sum_of(matrix(cov[last]), matrix(cov[other])))),
        force_outside_holes(between(force, before, after, share), turns, imu_ns, imu_rows, i, until),
        turn_psd(turns, imu_ns, imu_rows, i, t, until),
    )
    past_imu = i < imu_rows and imu_ns[i] <= until
    past_dvl = k < dvl_rows and dvl_ns[k] <= until
    return Cursor(until, i + int(past_imu), k + int(past_dvl)), step


@compiled
def are_nodes(imu_ns: Ints, dvl_ns: Ints, start_ns: int, end_ns: int) -> bool:
    """True where an interval, the earlier end first, begins and ends at Doppler rows that IMU rows cover."""
    if end_ns < start_ns or not len(imu_ns) or start_ns < imu_ns[0] or end_ns > imu_ns[-1]:
        return False
    first, last = np.searchsorted(dvl_ns, start_ns), np.searchsorted(dvl_ns, end_ns)
    return bool(last < len(dvl_ns) and dvl_ns[first] == start_ns and dvl_ns[last] == end_ns)


@compiled
def merge_rows(
    columns: Columns, imu_rows: int, dvl_rows: int, start_ns: int, end_ns: int
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Columns of `Steps`: (start, end] cut at every stamp of either sensor, with each sensor's mean over each piece."""
    cursor = cursor_at(columns, start_ns)
    most = max(imu_rows - cursor.imu_row, 0) + max(dvl_rows - cursor.dvl_row, 0) + 1
    duration, rates, velocities = np.empty(most), np.empty((most, 3)), np.empty((most, 3))
    psds, forces, turns = np.empty((most, 3, 3)), np.empty((most, 3)), np.empty((most, 3))
    n = 0
    while cursor.stamp_ns < end_ns:
        cursor, step = next_step(columns, imu_rows, dvl_rows, cursor, end_ns)
        duration[n] = step.duration_s
        rates[n, 0], rates[n, 1], rates[n, 2] = step.rate
        velocities[n, 0], velocities[n, 1], velocities[n, 2] = step.velocity
        forces[n, 0], forces[n, 1], forces[n, 2] = step.specific_force
        turns[n, 0], turns[n, 1], turns[n, 2] = step.turn_psd
        place(step.velocity_psd, psds[n], 0, 0)
        n += 1
    return duration[:n], rates[:n], velocities[:n], psds[:n], forces[:n], turns[:n]
