"""Loop of joint preintegration as machine code, with the rule for the velocity between two Doppler samples.

=============== ====================================== ================================ ==============================
rule            velocity between samples a and b       rotation that turns it           used by
=============== ====================================== ================================ ==============================
inertial        through both samples, in between the   at every IMU sample              this package, with an
                shape that the accelerometer measured                                   accelerometer
linear          linear from a to b, in the body        at every IMU sample              this package, gyro and Doppler
hold-previous   that of a                              at every IMU sample              AQUA-SLAM
zoh-previous    that of a                              in the middle of the interval    coug_fgo, tight integrator
zoh-current     that of b                              at the end of the interval       TURTLMap
trapezoid       mean of a and b                        in the middle of the interval    sonar-SLAM's dead reckoning
=============== ====================================== ================================ ==============================

The last four are for comparison: a hold is late or early by half an interval. Equations of a step and of a sample:
`sonar_graph.navigation.preintegration.joint_steps`.
"""

from enum import IntEnum
from typing import Literal, NamedTuple

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.preintegration.joint_steps import (
    AT_REST,
    NO_SLOPES,
    NO_SPREAD,
    Path,
    Push,
    Slopes,
    Spread,
    push,
    pushed_path,
    pushed_slopes,
    pushed_spread,
    with_inertial_position,
    with_sample,
)
from sonar_graph.navigation.samples import rows_until, value_at
from sonar_graph.numerics import (
    IDENTITY,
    ZERO,
    ZEROS,
    Matrix,
    Vector,
    compiled,
    cross,
    difference_of,
    inlined,
    matrix,
    minus,
    multiple_of,
    place,
    plus,
    product,
    sandwich,
    scaled,
    sum_of,
    symmetric,
    times,
    times_skew,
    transposed,
    vector,
)

DopplerRule = Literal["inertial", "linear", "hold-previous", "zoh-previous", "zoh-current", "trapezoid"]


class Turning(IntEnum):
    """Instant of the rotation that turns a velocity into frame i."""

    EVERY_SAMPLE = 0
    MIDDLE = 1
    END = 2


class Rule(NamedTuple):
    """A row of the table, for compiled code."""

    inertial: bool
    """True where the accelerometer shapes the velocity between samples."""
    interpolated: bool
    """True where the later sample's share grows from 0 to 1 over the interval."""
    share: float
    """The later sample's share where it is constant."""
    turning: int
    """A value of `Turning`."""


RULES: dict[DopplerRule, Rule] = {
    "inertial": Rule(True, False, 0.5, Turning.EVERY_SAMPLE.value),
    "linear": Rule(False, True, 0.5, Turning.EVERY_SAMPLE.value),
    "hold-previous": Rule(False, False, 0.0, Turning.EVERY_SAMPLE.value),
    "zoh-previous": Rule(False, False, 0.0, Turning.MIDDLE.value),
    "zoh-current": Rule(False, False, 1.0, Turning.END.value),
    "trapezoid": Rule(False, False, 0.5, Turning.MIDDLE.value),
}
EVERY_SAMPLE, MIDDLE = 0, 1
"""Values of `Turning` for compiled code."""


class Inertial(NamedTuple):
    """Inertial rows in body axes, and the biases and Earth rate to remove from them."""

    stamps: Ints
    rate: Floats
    force: Floats
    gyro_bias: Vector
    accel_bias: Vector
    earth: Vector
    """Earth's rotation in frame i, rad/s."""
    arm: Vector
    """From the IMU to the Doppler log, body axes, m."""
    gyro_psd: float
    """Squared noise density, (rad/s)²/Hz."""
    accel_psd: float
    """Squared noise density, (m/s²)²/Hz."""


class Interval(NamedTuple):
    """Two Doppler samples in body axes and their stamps."""

    start_ns: int
    end_ns: int
    z: Vector
    z_next: Vector


class Weights(NamedTuple):
    """``s = before z_a + after z_b`` over an interval between samples a and b."""

    before: Matrix
    after: Matrix


class Motion(NamedTuple):
    """From frame i to an instant."""

    path: Path
    spread: Spread
    slopes: Slopes
    weights: Weights
    """Weights of the current interval."""
    row: int
    """First inertial row after the instant."""


NO_WEIGHTS = Weights(ZEROS, ZEROS)
LONG_S = 0.4
"""Interval of Doppler samples above which the rule "inertial" takes the log's way about the IMU's point from the
gyros."""


@compiled
def preintegrate(
    imu: Inertial, dvl_ns: Ints, velocity: Floats, cov: Floats, rule: Rule
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Motion from the first to the last Doppler row (body axes), which the inertial rows cover.

    Returns R (3, 3); v, p, s as rows (3, 3); covariance (12, 12) of [theta in frame j, v, p, s] without the noise of
    the first and the last Doppler row; derivatives (12, 10) by gyro bias, accelerometer bias, scale, mounting; weights
    (3, 3) of the first and of the last row in s.
    """
    motion = Motion(AT_REST, NO_SPREAD, NO_SLOPES, NO_WEIGHTS, rows_until(imu.stamps, dvl_ns[0]))
    first, last, past_s = ZEROS, ZEROS, 0.0
    for k in range(len(dvl_ns) - 1):
        next_s = (dvl_ns[k + 1] - dvl_ns[k]) * 1e-9
        if rule.inertial:
            motion = _at_sample(motion, imu, dvl_ns[k], vector(velocity[k]), past_s, next_s)
        interval = Interval(dvl_ns[k], dvl_ns[k + 1], vector(velocity[k]), vector(velocity[k + 1]))
        here = multiple_of(0.5 * next_s, motion.path.R)
        motion = over_interval(motion, imu, interval, rule)
        weights = Weights(here, multiple_of(0.5 * next_s, motion.path.R)) if rule.inertial else motion.weights
        if k == 0:
            first = weights.before
        else:
            weight = sum_of(last, weights.before)
            mv, mp, ms, vv, vp, pp, sv, sp, ss = motion.spread
            spread = Spread(mv, mp, ms, vv, vp, pp, sv, sp, sum_of(ss, sandwich(weight, matrix(cov[k]), weight)))
            motion = Motion(motion.path, spread, motion.slopes, motion.weights, motion.row)
        last, past_s = weights.after, next_s
    if rule.inertial:
        motion = _at_sample(motion, imu, dvl_ns[-1], vector(velocity[len(dvl_ns) - 1]), past_s, 0.0)
        path, spread, slopes = with_inertial_position(motion.path, motion.spread, motion.slopes)
        motion = Motion(path, spread, slopes, NO_WEIGHTS, motion.row)
    return to_arrays(motion, first, last, imu.gyro_psd)


@inlined
def _at_sample(motion: Motion, imu: Inertial, at_ns: int, z: Vector, past_s: float, next_s: float) -> Motion:
    """Add a Doppler sample between two intervals; in long ones with the log's way about the IMU."""
    weight_s = 0.5 * (past_s + next_s)
    path, spread, slopes = with_sample(motion.path, motion.spread, motion.slopes, z, weight_s, imu.gyro_psd)
    motion = Motion(path, spread, slopes, motion.weights, motion.row)
    if past_s > LONG_S or next_s > LONG_S:
        past_s, next_s = past_s if past_s > LONG_S else 0.0, next_s if next_s > LONG_S else 0.0
        motion = with_lever_arm(motion, imu, at_ns, past_s, next_s)
    return motion


@inlined
def with_lever_arm(motion: Motion, imu: Inertial, at_ns: int, past_s: float, next_s: float) -> Motion:
    """One end of long intervals (0: not long): ``(R_b - R_a) l`` in place of the trapezoid of ``R (w x l)``."""
    R, weight_s = motion.path.R, 0.5 * (past_s + next_s)
    rate = minus(value_at(imu.stamps, imu.rate, motion.row, at_ns, False), imu.gyro_bias)
    rate = minus(rate, times(transposed(R), imu.earth))
    ends = (1.0 if past_s > 0.0 else 0.0) - (1.0 if next_s > 0.0 else 0.0)
    c = times(R, minus(scaled(ends, imu.arm), scaled(weight_s, cross(rate, imu.arm))))
    motion = _displaced(motion, c, imu.gyro_psd, motion.weights)
    M, N, v_g, p_g, s_g, s_a, s_scale, s_mounting = motion.slopes
    s_g = difference_of(s_g, multiple_of(weight_s, times_skew(R, imu.arm)))
    slopes = Slopes(M, N, v_g, p_g, s_g, s_a, s_scale, s_mounting)
    return Motion(motion.path, motion.spread, slopes, motion.weights, motion.row)


@inlined
def _displaced(motion: Motion, c: Vector, gyro_psd: float, weights: Weights) -> Motion:
    """Displaced by c at one instant."""
    by = Push(0.0, IDENTITY, ZEROS, ZEROS, ZERO, ZERO, c)
    spread = pushed_spread(motion.spread, by, gyro_psd * motion.path.elapsed_s, 0.0)
    return Motion(pushed_path(motion.path, by), spread, pushed_slopes(motion.slopes, by), weights, motion.row)


@inlined
def over_interval(motion: Motion, imu: Inertial, interval: Interval, rule: Rule) -> Motion:
    """Take the motion over all inertial steps between two Doppler samples.

    A rule with a fixed rotation adds the whole interval's displacement at the instant of that rotation.
    """
    motion = Motion(motion.path, motion.spread, motion.slopes, NO_WEIGHTS, motion.row)
    start_ns, end_ns, z, z_next = interval
    if rule.turning == EVERY_SAMPLE:
        motion = _stepped(motion, imu, interval, start_ns, end_ns, rule)
    else:
        at_ns = start_ns + (end_ns - start_ns) // 2 if rule.turning == MIDDLE else end_ns
        motion = _stepped(motion, imu, interval, start_ns, at_ns, rule)
        turned = multiple_of((end_ns - start_ns) * 1e-9, motion.path.R)
        weights = Weights(multiple_of(1.0 - rule.share, turned), multiple_of(rule.share, turned))
        motion = _displaced(motion, times(turned, _mixed(interval, rule.share)), imu.gyro_psd, weights)
        motion = _stepped(motion, imu, interval, at_ns, end_ns, rule)
    if rule.inertial:
        return motion
    weights = motion.weights
    M, N, v_g, p_g, s_g, s_a, s_scale, s_mounting = motion.slopes
    s_scale = plus(s_scale, plus(times(weights.before, z), times(weights.after, z_next)))
    s_mounting = difference_of(s_mounting, times_skew(weights.before, z))
    s_mounting = difference_of(s_mounting, times_skew(weights.after, z_next))
    slopes = Slopes(M, N, v_g, p_g, s_g, s_a, s_scale, s_mounting)
    return Motion(motion.path, motion.spread, slopes, weights, motion.row)


@inlined
def _stepped(motion: Motion, imu: Inertial, interval: Interval, t: int, end_ns: int, rule: Rule) -> Motion:
    """Inertial steps, cut at every row; with the Doppler displacement where its rotation changes at every row."""
    path, spread, slopes, (A, B), row = motion
    moving = not rule.inertial and rule.turning == EVERY_SAMPLE
    while t < end_ns:
        until = min(end_ns, imu.stamps[row]) if row < len(imu.stamps) else end_ns
        middle = t + (until - t) // 2
        rate = minus(value_at(imu.stamps, imu.rate, row, middle, False), imu.gyro_bias)
        force = minus(value_at(imu.stamps, imu.force, row, middle, False), imu.accel_bias)
        by = push(path.R, (until - t) * 1e-9, minus(rate, times(transposed(path.R), imu.earth)), force)
        if moving:
            span_ns = interval.end_ns - interval.start_ns
            later = (middle - interval.start_ns) / span_ns if rule.interpolated else rule.share
            A, B = sum_of(A, multiple_of(1.0 - later, by.G)), sum_of(B, multiple_of(later, by.G))
            by = Push(by.dt, by.turn, by.G, by.H, by.a, by.b, times(by.G, _mixed(interval, later)))
        spread = pushed_spread(spread, by, imu.gyro_psd * (path.elapsed_s + 0.5 * by.dt), imu.accel_psd)
        slopes = pushed_slopes(slopes, by)
        path = pushed_path(path, by)
        row += int(row < len(imu.stamps) and imu.stamps[row] <= until)
        t = until
    return Motion(path, spread, slopes, Weights(A, B), row)


@inlined
def _mixed(interval: Interval, later: float) -> Vector:
    """Velocity between the two samples, by the later one's share."""
    return plus(interval.z, scaled(later, minus(interval.z_next, interval.z)))


@inlined
def to_arrays(
    motion: Motion, first: Matrix, last: Matrix, gyro_psd: float
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Results of `preintegrate` as arrays, theta turned from frame i into frame j."""
    path, spread, slopes = motion.path, motion.spread, motion.slopes
    R, vectors, weights = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 3, 3))
    P, D = np.zeros((12, 12)), np.zeros((12, 10))
    j_R_i = transposed(path.R)
    place(path.R, R, 0, 0)
    place((path.v, path.p, path.s), vectors, 0, 0)
    place(first, weights[0], 0, 0)
    place(last, weights[1], 0, 0)
    place(multiple_of(gyro_psd * path.elapsed_s, IDENTITY), P, 0, 0)
    _place_pair(times_skew(j_R_i, spread.mv), P, 0, 3)
    _place_pair(times_skew(j_R_i, spread.mp), P, 0, 6)
    _place_pair(times_skew(j_R_i, spread.ms), P, 0, 9)
    _place_pair(spread.vp, P, 3, 6)
    _place_pair(spread.sv, P, 9, 3)
    _place_pair(spread.sp, P, 9, 6)
    place(symmetric(spread.vv), P, 3, 3)
    place(symmetric(spread.pp), P, 6, 6)
    place(symmetric(spread.ss), P, 9, 9)
    place(multiple_of(-1.0, product(j_R_i, slopes.M)), D, 0, 0)
    place(slopes.v_g, D, 3, 0)
    place(slopes.p_g, D, 6, 0)
    place(slopes.s_g, D, 9, 0)
    place(multiple_of(-1.0, slopes.M), D, 3, 3)
    place(multiple_of(-1.0, slopes.N), D, 6, 3)
    place(slopes.s_a, D, 9, 3)
    D[9, 6], D[10, 6], D[11, 6] = slopes.s_scale
    place(slopes.s_mounting, D, 9, 7)
    return R, vectors, P, D, weights[0], weights[1]


@inlined
def _place_pair(A: Matrix, out: Floats, row: int, column: int) -> None:
    place(A, out, row, column)
    place(transposed(A), out, column, row)
