"""Motion while the Doppler log has no bottom lock, carried by the accelerometers.

An interval between successive DVL rows is a gap where it is longer than the calibration's ``dvl.gap_s``
(`sonar_graph.navigation.samples.longest_interval_ns`; with ``hold-past`` there is none). The motion over a gap comes
from `bridge`; `Preintegrator.bridge` calls it for `sonar_graph.navigation.odometry` (iSAM2, dead reckoning), and
``baselines/filter_motion.py`` for the two filters.

From epoch i (the stamp of the DVL row before the gap) on, with everything in frame i: R the rotation by the gyros, F
and P the velocity and position that the accelerometers gain from rest
(`sonar_graph.navigation.preintegration.joint_steps`), g gravity. The velocity of the IMU's point less F is then a
straight line whose slope is gravity, and a Doppler sample z at time t measures a point of it::

    y(t) = R z - F = v + g t

Closed: the sample j that ends the gap is there. The line joins both ends, ``displacement = P + T (y_i + y_j)/2``.

Open: nothing stamped later is there. The line is fitted by least squares to the samples of the last `WINDOW_NS` before
the epoch, and extrapolated: ``s = T (mean + slope (T / 2 - mean t)) = sum_k w_k y_k``. Noise
of gyros (density n) and accelerometers (a) in a window of length W enters through K(u), the sum of the weights w_k of
the samples with t_k <= (u - 1) W, u from 0 to 1. For many samples, evenly spaced, with ``r = T (T / 2 + W / 2) / W``::

    K(u) = T u - 6 r u (1 - u),    variance  a^2 W int K^2 du + (g n)^2 W^3 int (int K du)^2 du

Walk: where a specific force was not measured, or too little precedes the epoch, the velocity is a random walk of root
density q (m/s/√s) between its ends, ``q^2 T^3 / 12`` (closed), or from its last value on, ``q^2 T^3 / 3`` (open).

The covariance includes the noise of the samples, gyros and accelerometers, and the accelerometers' bias, constant over
the gap; the gyros' bias has a derivative. docs/theory/gaps.md.
"""

from typing import NamedTuple

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Ints
from sonar_graph.navigation.imu_gaps import force_outside_holes
from sonar_graph.navigation.preintegration.joint_steps import (
    AT_REST,
    NO_SLOPES,
    NO_SPREAD,
    Path,
    Slopes,
    Spread,
    push,
    pushed_path,
    pushed_slopes,
    pushed_spread,
    with_inertial_position,
    with_sample,
)
from sonar_graph.navigation.preintegration.recursion import (
    NO_MOTION,
    Columns,
    Integral,
    Step,
    cursor_at,
    extended,
    extended_by_bias,
    increment,
    mirrored,
    next_step,
    rate_of_turn,
)
from sonar_graph.navigation.samples import WINDOW_NS, longest_interval_ns, rows_until, value_among
from sonar_graph.numerics import (
    IDENTITY,
    ZERO,
    ZEROS,
    Matrix,
    Vector,
    compiled,
    cross,
    difference_of,
    gram,
    matrix,
    minus,
    multiple_of,
    plus,
    sandwich,
    scaled,
    skew_times,
    sum_of,
    times,
    times_skew,
    transposed,
    vector,
)

FEWEST, SHORTEST_S = 4, 1.0
"""Fewest samples of a line, and the shortest time that they span."""


class Sums(NamedTuple):
    """Sums over samples of 1, t and t², and of y and its derivatives by both biases, times 1 and times t."""

    n: float
    t: float
    tt: float
    y: Vector
    ty: Vector
    y_g: Matrix
    ty_g: Matrix
    y_a: Matrix
    ty_a: Matrix


NOTHING = Sums(0.0, 0.0, 0.0, ZERO, ZERO, ZEROS, ZEROS, ZEROS, ZEROS)


class Line(NamedTuple):
    """Fitted line of y(t)."""

    sums: Sums
    Q: Matrix
    """Sum of the samples' covariances, frame i."""
    is_known: bool
    """False where samples are too few or a force was not measured."""


@compiled
def line_before(columns: Columns, body_p_imu: Vector, body_p_dvl: Vector, k: int, bias: Vector, earth: Vector) -> Line:
    """Fit to the samples before and at Doppler row k; the velocity is that of the IMU's point, earth is in frame i."""
    imu_ns, rate, force, dvl_ns, velocity, cov, hold_past, turns = columns
    lever, node_ns, t = minus(body_p_imu, body_p_dvl), dvl_ns[k], dvl_ns[k]
    row = rows_until(imu_ns, t - 1)
    path, slopes, sums, Q = AT_REST, NO_SLOPES, NOTHING, ZEROS
    while k >= 0 and dvl_ns[k] >= max(node_ns - WINDOW_NS, imu_ns[0]):
        while t > dvl_ns[k]:
            until = max(dvl_ns[k], imu_ns[row - 1]) if row > 0 else dvl_ns[k]
            middle = until + (t - until) // 2
            w = minus(value_among(imu_ns, rate, len(imu_ns), row, middle, hold_past), bias)
            f = value_among(imu_ns, force, len(imu_ns), row, middle, hold_past)
            f = force_outside_holes(f, turns, imu_ns, len(imu_ns), row, t)
            by = push(path.R, (until - t) * 1e-9, minus(w, times(transposed(path.R), earth)), f)
            slopes = pushed_slopes(slopes, by)
            path = pushed_path(path, by)
            row -= int(row > 0 and imu_ns[row - 1] >= until)
            t = until
        at_dvl = minus(value_among(imu_ns, rate, len(imu_ns), rows_until(imu_ns, t - 1), t, hold_past), bias)
        turned = times(path.R, plus(vector(velocity[k]), cross(at_dvl, lever)))
        y_g = difference_of(skew_times(turned, slopes.M), slopes.v_g)
        y_g = sum_of(y_g, times_skew(path.R, lever))
        point, at_s = minus(turned, path.v), path.elapsed_s
        sums = Sums(
            sums.n + 1.0,
            sums.t + at_s,
            sums.tt + at_s * at_s,
            plus(sums.y, point),
            plus(sums.ty, scaled(at_s, point)),
            sum_of(sums.y_g, y_g),
            sum_of(sums.ty_g, multiple_of(at_s, y_g)),
            sum_of(sums.y_a, slopes.M),
            sum_of(sums.ty_a, multiple_of(at_s, slopes.M)),
        )
        Q = sum_of(Q, sandwich(path.R, matrix(cov[k]), path.R))
        k -= 1
    y = sums.y[0] + sums.y[1] + sums.y[2]
    return Line(sums, Q, sums.n >= FEWEST and path.elapsed_s <= -SHORTEST_S and np.isfinite(y))


@compiled
def integral(
    line: Line, elapsed_s: float, gyro_density: float, accel_density: float
) -> tuple[Vector, Matrix, Matrix, Matrix]:
    """Displacement over a time after the epoch, its derivatives by gyro and accelerometer bias, and its covariance.

    ``w_k = T (1/n + (T/2 - mean t) (t_k - mean t) / S) = a + b t_k``.
    """
    sums = line.sums
    mean_t = sums.t / sums.n
    S = sums.tt - sums.t * mean_t
    reach = elapsed_s * (elapsed_s / 2.0 - mean_t)
    b = reach / S
    a = elapsed_s / sums.n - b * mean_t
    doppler = multiple_of((elapsed_s**2 / sums.n + reach * b) / sums.n, line.Q)
    window_s = -2.0 * mean_t
    r = reach / window_s
    A, B = elapsed_s / 2.0 - 3.0 * r, 2.0 * r
    C, D = elapsed_s - 6.0 * r, 6.0 * r
    by_gyro = window_s**3 * (A * A / 5.0 + A * B / 3.0 + B * B / 7.0)
    by_force = window_s * (C * C / 3.0 + C * D / 2.0 + D * D / 5.0)
    turning = skew_times(scaled(1.0 / S, minus(sums.ty, scaled(mean_t, sums.y))), IDENTITY)
    inertial = sum_of(
        multiple_of(by_gyro * gyro_density**2, gram(turning)), multiple_of(by_force * accel_density**2, IDENTITY)
    )
    return (
        plus(scaled(a, sums.y), scaled(b, sums.ty)),
        sum_of(multiple_of(a, sums.y_g), multiple_of(b, sums.ty_g)),
        sum_of(multiple_of(a, sums.y_a), multiple_of(b, sums.ty_a)),
        sum_of(doppler, inertial),
    )


class GapModel(NamedTuple):
    """Numbers of sensors and vehicle."""

    longest_ns: int
    """Longest interval between samples over which the velocity is linear."""
    gyro_noise_density: float
    accel_noise_density: float
    accel_bias_sigma: float
    velocity_walk_density: float
    body_p_imu: Vector
    body_p_dvl: Vector


GapValues = tuple[int, float, float, float, float, Vector, Vector]


def gap_values(calibration: Calibration) -> GapValues:
    """Fields of `GapModel` from a calibration, as a plain tuple, which enters compiled code faster."""
    imu, dvl = calibration.imu, calibration.dvl
    return (
        longest_interval_ns(calibration),
        imu.gyro_noise_density,
        imu.accel_noise_density,
        imu.accel_bias_sigma,
        dvl.velocity_walk_density,
        imu.mounting.translation_m,
        dvl.mounting.translation_m,
    )


NO_GAPS: GapValues = (int(np.iinfo(np.int64).max), 0.0, 0.0, 0.0, 0.0, ZERO, ZERO)
"""Values with which no interval is a gap: the velocity is linear or held."""


class GapMotion(NamedTuple):
    """Motion of the body from frame i, and its derivatives by the gyro bias, of [theta_i, eps]."""

    integral: Integral
    D_t: Matrix
    D_r: Matrix


@compiled
def bridge(
    columns: Columns, values: GapValues, start_ns: int, end_ns: int, is_closed: bool, bias: Vector, earth: Vector
) -> GapMotion:
    """Motion over a gap.

    It begins at an epoch and ends at the next one (closed), or at an instant before it, from rows stamped no later
    (open). Removed are the gyro bias (body axes) and the Earth's rotation (frame i), rad/s; ``values`` are those of
    `gap_values`.
    """
    model = GapModel(*values)
    if is_closed or not _is_sampled(columns, model, start_ns, end_ns):
        motion, is_known = bridge_by_accelerometers(columns, model, start_ns, end_ns, is_closed, bias, earth)
        if is_known:
            return motion
    return bridge_by_walk(columns, model, start_ns, end_ns, is_closed, bias, earth)


@compiled
def bridge_by_accelerometers(
    columns: Columns, model: GapModel, start_ns: int, end_ns: int, is_closed: bool, bias: Vector, earth: Vector
) -> tuple[GapMotion, bool]:
    """The motion, and False where a force was not measured or no line is known."""
    dvl_ns = columns[3]
    elapsed_s = (end_ns - start_ns) * 1e-9
    k, gyro_psd = rows_until(dvl_ns, start_ns) - 1, model.gyro_noise_density**2
    path, spread, slopes = AT_REST, NO_SPREAD, NO_SLOPES
    is_known, doppler = True, ZEROS
    if is_closed:
        path, spread, slopes = with_sample(
            path, spread, slopes, _velocity_at_imu(columns, model, k, bias), elapsed_s / 2, gyro_psd
        )
    else:
        line = line_before(columns, model.body_p_imu, model.body_p_dvl, k, bias, earth)
        is_known = line.is_known
        s, s_g, s_a, doppler = integral(line, elapsed_s, model.gyro_noise_density, model.accel_noise_density)
        path = Path(0.0, IDENTITY, path.v, path.p, s)
        slopes = Slopes(slopes.M, slopes.N, slopes.v_g, slopes.p_g, s_g, s_a, slopes.s_scale, slopes.s_mounting)
    span_ns = start_ns, end_ns
    path, spread, slopes = carry_through(columns, model, path, spread, slopes, span_ns, is_closed, bias, earth)
    if is_closed:
        first_s, last_s = _neighbours_s(dvl_ns, k, model.longest_ns)
        first, last = matrix(columns[5][k]), sandwich(path.R, matrix(columns[5][k + 1]), path.R)
        by_first = multiple_of(elapsed_s * (elapsed_s + 2.0 * first_s) / 4.0, first)
        doppler = sum_of(by_first, multiple_of(elapsed_s * (elapsed_s + 2.0 * last_s) / 4.0, last))
        z = _velocity_at_imu(columns, model, k + 1, bias)
        path, spread, slopes = with_sample(path, spread, slopes, z, elapsed_s / 2, gyro_psd)
    path, spread, slopes = with_inertial_position(path, spread, slopes)
    by_bias = multiple_of(model.accel_bias_sigma**2, gram(slopes.s_a))
    ss = sum_of(spread.ss, sum_of(doppler, by_bias))
    s_g = slopes.s_g
    if is_closed:
        both = sum_of(IDENTITY, path.R)
        s_g = sum_of(s_g, multiple_of(elapsed_s / 2, times_skew(both, minus(model.body_p_imu, model.body_p_dvl))))
    motion = motion_of_origin(path, spread.ms, slopes.M, s_g, ss, gyro_psd, model.body_p_imu)
    return motion, is_known and np.isfinite(path.s[0] + path.s[1] + path.s[2])


@compiled
def carry_through(
    columns: Columns,
    model: GapModel,
    path: Path,
    spread: Spread,
    slopes: Slopes,
    span_ns: tuple[int, int],
    is_closed: bool,
    bias: Vector,
    earth: Vector,
) -> tuple[Path, Spread, Slopes]:
    """Take path, covariances and derivatives over all inertial rows of a gap."""
    imu_ns, rate, force, hold_past, turns = columns[0], columns[1], columns[2], columns[6], columns[7]
    t, end_ns = span_ns
    rows = rows_until(imu_ns, end_ns - 1) + 1 if is_closed else rows_until(imu_ns, end_ns)
    rows, row = min(rows, len(imu_ns)), rows_until(imu_ns, t)
    gyro_psd, accel_psd = model.gyro_noise_density**2, model.accel_noise_density**2
    while t < end_ns:
        until = min(end_ns, imu_ns[row]) if row < rows else end_ns
        middle = t + (until - t) // 2
        w = minus(value_among(imu_ns, rate, rows, row, middle, hold_past), bias)
        f = value_among(imu_ns, force, rows, row, middle, hold_past)
        f = force_outside_holes(f, turns, imu_ns, rows, row, until)
        by = push(path.R, (until - t) * 1e-9, minus(w, times(transposed(path.R), earth)), f)
        spread = pushed_spread(spread, by, gyro_psd * (path.elapsed_s + 0.5 * by.dt), accel_psd)
        slopes = pushed_slopes(slopes, by)
        path = pushed_path(path, by)
        row += int(row < rows and imu_ns[row] <= until)
        t = until
    return path, spread, slopes


@compiled
def _velocity_at_imu(columns: Columns, model: GapModel, k: int, bias: Vector) -> Vector:
    """Velocity of the IMU's point at a Doppler row, body axes."""
    imu_ns, rate, t = columns[0], columns[1], columns[3][k]
    w = minus(value_among(imu_ns, rate, len(imu_ns), rows_until(imu_ns, t - 1), t, columns[6]), bias)
    return plus(vector(columns[4][k]), cross(w, minus(model.body_p_imu, model.body_p_dvl)))


@compiled
def _neighbours_s(dvl_ns: Ints, k: int, longest_ns: int) -> tuple[float, float]:
    """Lengths of the intervals beside the gap after row k whose errors add to its own.

    Each end also ends or begins a neighbouring interval, of length d, and errors add up:
    ``((T + d) / 2)^2 = (T / 2)^2 (1 + 2 d / T) + (d / 2)^2``, of which the last is the neighbour's own. The interval
    after the gap is not known yet and taken as long as the one before. Of two successive gaps the later one counts what
    they share.
    """
    before_ns = dvl_ns[k] - dvl_ns[k - 1] if k > 0 else 0
    return before_ns * 1e-9, (before_ns if before_ns <= longest_ns else 0) * 1e-9


@compiled
def motion_of_origin(
    path: Path, ms: Vector, M: Matrix, s_g: Matrix, ss: Matrix, gyro_psd: float, lever: Vector
) -> GapMotion:
    """From the IMU's point to the body's origin: ``dp = s - (R - I) l``, ``eps = ds + [R l]x theta``.

    ``cov(ds, theta) = -[ms]x``, M the integral of R, s_g the derivative of s by the gyro bias, ss its covariance.
    """
    turned = times(path.R, lever)
    tt = multiple_of(gyro_psd * path.elapsed_s, IDENTITY)
    st = times_skew(multiple_of(-1.0, IDENTITY), ms)
    rt = sum_of(st, skew_times(turned, tt))
    rr = sum_of(difference_of(ss, times_skew(st, turned)), skew_times(turned, transposed(rt)))
    D_t = multiple_of(-1.0, M)
    dp = minus(path.s, minus(turned, lever))
    whole = Integral(path.R, dp, path.v, tt, rt, mirrored(rr))
    return GapMotion(whole, D_t, sum_of(s_g, skew_times(turned, D_t)))


@compiled
def _is_sampled(columns: Columns, model: GapModel, start_ns: int, end_ns: int) -> bool:
    """True where velocities go on after an epoch and inertial rows are missing instead.

    A sample that ends a gap of the velocity, but is no epoch yet, does not count.
    """
    dvl_ns = columns[3]
    row = rows_until(dvl_ns, start_ns)
    return bool(row < len(dvl_ns) and dvl_ns[row] <= end_ns and dvl_ns[row] - start_ns <= model.longest_ns)


@compiled
def bridge_by_walk(
    columns: Columns, model: GapModel, start_ns: int, end_ns: int, is_closed: bool, bias: Vector, earth: Vector
) -> GapMotion:
    """Motion with the velocity linear between the ends or held since the last sample, and a random walk about that.

    An open gap may hold samples, where motion could not be settled for want of inertial rows.
    """
    imu_ns, dvl_ns, cov = columns[0], columns[3], columns[5]
    is_over = not is_closed and _is_sampled(columns, model, start_ns, end_ns)
    k = rows_until(dvl_ns, end_ns if is_over else start_ns) - 1
    since_ns = max(dvl_ns[k], start_ns)
    elapsed_s = (end_ns - since_ns) * 1e-9
    walk = (model.velocity_walk_density * elapsed_s) ** 2
    psd = sum_of(multiple_of(elapsed_s, matrix(cov[k])), multiple_of(walk / 3.0, IDENTITY))
    imu_rows, dvl_rows = rows_until(imu_ns, end_ns), k + 1
    if is_closed:
        imu_rows, dvl_rows = min(rows_until(imu_ns, end_ns - 1) + 1, len(imu_ns)), k + 2
        first_s, last_s = _neighbours_s(dvl_ns, k, model.longest_ns)
        by_first = multiple_of((elapsed_s + 2.0 * first_s) / 4.0, matrix(cov[k]))
        by_last = multiple_of((elapsed_s + 2.0 * last_s) / 4.0, matrix(cov[k + 1]))
        psd = sum_of(sum_of(by_first, by_last), multiple_of(walk / 12.0, IDENTITY))
    motion, D_t, D_r, cursor = NO_MOTION, ZEROS, ZEROS, cursor_at(columns, start_ns)
    while cursor.stamp_ns < end_ns:
        is_sampled = cursor.stamp_ns < since_ns
        cursor, own = next_step(columns, imu_rows, dvl_rows, cursor, end_ns)
        of_velocity = own.velocity_psd if is_sampled else psd
        step = Step(own.duration_s, own.rate, own.velocity, of_velocity, own.specific_force, own.turn_psd)
        turn = rate_of_turn(step, motion.dR, bias, earth)
        added = increment(motion.dR, step.duration_s, turn, step.velocity, model.body_p_dvl)
        D_t, D_r = extended_by_bias(D_t, D_r, step, added)
        motion = extended(motion, step, added, model.gyro_noise_density)
    whole = Integral(motion.dR, motion.dp, motion.impulse, motion.cov_tt, motion.cov_rt, mirrored(motion.cov_rr))
    return GapMotion(whole, D_t, D_r)
