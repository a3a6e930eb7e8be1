"""Motion while the Doppler log has no bottom lock, carried by the accelerometers.

An interval between successive DVL rows is a gap where it is longer than the calibration's ``dvl.gap_s``. From epoch i,
the stamp of the row before the gap, with everything in frame i: the velocity of the IMU's point, less what the
accelerometers gain, is a straight line, whose slope is gravity. Doppler samples z_k at t_k measure points of it, and
weights w_k of their sum T give its integral over the gap. With W(t) the sum of the weights up to t::

    s = sum_k w_k R_k z_k + sum dt a R f,    a(t) = W(t) - max(t, 0)                                 (1)

Closed: the sample that ends the gap is known. The line joins both ends, ``w = T / 2`` each.

Open: nothing stamped later is known. The line is fitted by least squares to the n samples of the last `WINDOW_NS`
before the epoch: ``w_k = T (1 / n + (T / 2 - mean t) (t_k - mean t) / sum (t - mean t)^2)``.

Errors. With x(t) minus what s gains after t, an error theta of the gyros (in frame i) and an error n of the
accelerometers at t change s by ``[x]x theta + a R n``. White noise and constant biases give sums again::

    cov(s) = n_g^2 sum dt [x]x [x]x^T + n_a^2 sum dt a^2 I,    cov(s, theta) = n_g^2 sum dt [x]x     (2)
    D_gyro = -sum dt [x]x R,    D_accel = -sum dt a R                                                (3)

Prior: the velocity of the body's origin, in body axes, stays what the Doppler log measured, and walks with root density
q (m/s/√s) between both ends (closed) or from its last value on (open). Its displacement s_0 errs by
``W = q^2 T^3 / 12 I`` or ``q^2 T^3 / 3 I``, besides the noise C_0 of gyros and Doppler log. From u seconds before the end
of a closed gap to its end that is ``W = q^2 (u^3 / 3 - u^4 / (4 T)) I``, which the motion of a late or averaged
measurement counts. The line, with its C and D, corrects the prior as a measurement does in a Kalman filter. In the last
frame, with b the sigma of the gyro bias, and c for what a linear D leaves out::

    V = C - C_0 + b^2 (D - D_0) (D - D_0)^T + c I,    c = 2 (b T)^2 |b (D - D_0)|^2
    K = W (W + V)^-1,    s_0 + K (s - s_0),    D_0 + K (D - D_0)                                     (4)
    C_0 + K (C - C_0 + c I) K^T + (I - K) W (I - K)^T                                                (5)

Where a specific force was not measured, or too little precedes the epoch, there is no line and K = 0.

docs/theory/gaps.md has the derivation and the same equation numbers.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from sonar_graph.measurements import NS_PER_S, Floats, Ints
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.navigation.imu_gaps import UNFELT_NS, hole_ns
from sonar_graph.navigation.preintegration import (
    NOWHERE,
    Removed,
    Rows,
    Sensors,
    motion_over,
    rows_until,
    value_at,
)
from sonar_graph.navigation.samples import WINDOW_NS
from sonar_graph.numerics import (
    O3,
    ZERO,
    Mat3,
    Vec3,
    compiled,
    cross,
    exp_and_mean,
    mat,
    outer,
    row_of,
    skew,
    store,
    vec,
)

FEWEST = 4
"""Fewest samples of a line."""
SHORTEST_S = 1.0
"""Shortest time that they span."""


def closed_bridge(
    rows: Rows, sensors: Sensors, removed: Removed, start_ns: int, end_ns: int
) -> PreintegratedMotion:
    """Motion over a gap from an epoch to the next one."""
    k = int(rows.dvl_ns.searchsorted(start_ns))
    T = (end_ns - start_ns) * 1e-9
    # Each end also ends or begins a neighbouring interval, of length d, and errors add up:
    # ((T + d) / 2)^2 = (T / 2)^2 (1 + 2 d / T) + (d / 2)^2, the last term is the neighbour's own. The interval
    # after the gap is not known yet and taken as long as the one before. Of two successive gaps the later one
    # counts what they share.
    before_s = (rows.dvl_ns[k] - rows.dvl_ns[k - 1]) * 1e-9 if k > 0 else 0.0
    after_s = before_s if before_s * 1e9 <= sensors.longest_ns else 0.0
    squares_s2 = 0.25 * T * (T + 2.0 * np.array([before_s, after_s]))
    ends = LineFit(np.array([k, k + 1]), np.full(2, 0.5 * T), squares_s2)
    line = _by_accelerometers(rows, sensors, removed, ends, end_ns)
    # noise of such a density between the two rows has the variance of the line's samples
    doppler_cov = np.tensordot(squares_s2 / T**2, rows.cov[k : k + 2], 1)
    samples = Ends((k, k + 1), np.array([start_ns, end_ns]), doppler_cov)
    steady = _prior(rows, sensors, removed, samples, (start_ns, end_ns))
    walked_m2 = float(walked_until_end(sensors, T, T))
    return _corrected(steady, walked_m2, line, sensors.gyro_bias_sigma)


def end_of_gap(
    rows: Rows, sensors: Sensors, removed: Removed, start_ns: int, end_ns: int
) -> PreintegratedMotion:
    """Motion from an instant inside a closed gap to its end, by a velocity that is linear over the gap and walks."""
    k = int(rows.dvl_ns.searchsorted(end_ns))
    gap_s = (end_ns - rows.dvl_ns[k - 1]) * 1e-9
    steady = motion_over(rows, sensors, removed, start_ns, end_ns)
    walked_m2 = float(walked_until_end(sensors, gap_s, (end_ns - start_ns) * 1e-9))
    return _corrected(steady, walked_m2, None, sensors.gyro_bias_sigma)


def walked_until_end(sensors: Sensors, gap_s: ArrayLike, rest_s: ArrayLike) -> Floats:
    """Variance of one component of the displacement over the last part of a gap with both velocities known, m².

    The velocity is a Brownian bridge: the covariance of its values at s and s' before the end is ``q^2 (min(s, s') -
    s s' / T)``, whose double integral over ``0 <= s, s' <= u`` is ``q^2 (u^3 / 3 - u^4 / (4 T))``.
    """
    T = np.asarray(gap_s, np.float64)
    u = np.asarray(rest_s, np.float64)
    return sensors.velocity_walk_density**2 * (u**3 / 3.0 - u**4 / (4.0 * T))


def open_bridge(
    rows: Rows, sensors: Sensors, removed: Removed, start_ns: int, end_ns: int
) -> PreintegratedMotion:
    """Motion from an epoch to an instant in the gap after it, by rows that are known at that instant."""
    k = int(rows.dvl_ns.searchsorted(start_ns))
    # the epoch may be known later than the instant
    rows = rows.known(max(end_ns, int(rows.known_ns[k])))
    dvl_ns = rows.dvl_ns
    if (dvl_ns[k + 1 : k + 2] - start_ns <= sensors.longest_ns).any():
        # Velocities go on, inertial rows are missing: by velocities as far as they go.
        last_ns = min(int(dvl_ns[-1]), end_ns)
        sampled = motion_over(rows, sensors, removed, start_ns, last_ns)
        if last_ns == end_ns:
            return sampled
        return sampled.then(
            _open(rows, sensors, removed.after(sampled), last_ns, end_ns)
        )
    line = None
    first = int(dvl_ns.searchsorted(max(start_ns - WINDOW_NS, rows.imu_ns[0])))
    samples = np.arange(first, k + 1)
    t = (dvl_ns[samples] - start_ns) * 1e-9
    if len(t) >= FEWEST and -t[0] >= SHORTEST_S:
        T = (end_ns - start_ns) * 1e-9
        off = t - t.mean()
        slope = (0.5 * T - t.mean()) * off / (off @ off)
        weights_s = T * (1.0 / len(t) + slope)
        line = _by_accelerometers(
            rows, sensors, removed, LineFit(samples, weights_s, weights_s**2), end_ns
        )
    return _open(rows, sensors, removed, start_ns, end_ns, line)


class LineFit(NamedTuple):
    """Doppler samples that level and tilt the line of the velocity."""

    samples: Ints
    """Their rows: those until the epoch (open), or that at the epoch and that at the end (closed), shape (n,)."""
    weights_s: Floats
    """w_k, shape (n,)."""
    squares_s2: Floats
    """Factor of their noise in the variance of s, w_k² or more, shape (n,)."""


def _by_accelerometers(
    rows: Rows, sensors: Sensors, removed: Removed, fit: LineFit, end_ns: int
) -> PreintegratedMotion | None:
    """Motion by (1); None where a specific force was not measured."""
    cuts_ns = rows.dvl_ns[fit.samples]
    is_closed = bool(cuts_ns[-1] == end_ns)
    weights_s = fit.weights_s
    lever = sensors.body_p_dvl - sensors.body_p_imu
    rate = _rates_at(rows, cuts_ns)  # (n, 3)
    # of the IMU's point, (n, 3)
    velocity = rows.velocity[fit.samples] - np.cross(rate - removed.bias, lever)
    turned = weights_s[:, None] * velocity
    if is_closed:
        start_ns = int(cuts_ns[0])
        imu_rows = int(rows.imu_ns.searchsorted(end_ns)) + 1
        line = Line(cuts_ns, weights_s[:1], turned, start_ns, np.eye(3))
    else:
        start_ns = int(cuts_ns[-1])
        imu_rows = len(rows.imu_ns)
        turn = _turn_until(rows, sensors, removed, int(cuts_ns[0]), start_ns)
        jumps = np.vstack([turned, np.zeros(3)])
        i_R_first = np.ascontiguousarray(turn.T)
        line = Line(
            np.append(cuts_ns, end_ns), np.cumsum(weights_s), jumps, start_ns, i_R_first
        )
    sums = sum_along(rows, imu_rows, line, removed)
    if not math.isfinite(sum(sums.s)):
        return None

    T = (end_ns - start_ns) * 1e-9
    n_g2 = sensors.gyro_density**2
    R = sums.R[-1]  # i_R_j
    R_k = sums.R[: len(cuts_ns)]  # (n, 3, 3)
    swung_s = np.tensordot(weights_s, R_k, 1)
    # the Earth's rate turns the log about the IMU as well
    s = np.array(sums.s) + np.cross(removed.earth, swung_s @ lever)
    # of the body's origin, but for the constant l of the IMU
    way = s - R @ sensors.body_p_imu

    # x = y - way after the epoch, y before it
    y = np.array(sums.y)
    mixed = np.outer(way, y)
    xx = np.array(sums.yy) - mixed - mixed.T + T * np.outer(way, way)  # (3, 3)
    R_after = np.array(sums.R_after)
    xR = np.array(sums.yR) - gtsam.SO3.Hat(way) @ R_after  # (3, 3)
    D_accel = -np.array(sums.aR)
    cov_s_theta = n_g2 * gtsam.SO3.Hat(y - T * way)
    # (2): [x]x [x]x^T = |x|^2 I - x x^T
    cov_s = n_g2 * (np.trace(xx) * np.eye(3) - xx.T)
    cov_s += sensors.accel_density**2 * sums.aa * np.eye(3)
    cov_s += sensors.accel_bias_sigma**2 * D_accel @ D_accel.T
    of_samples = R_k @ rows.cov[fit.samples] @ R_k.transpose(0, 2, 1)  # (n, 3, 3)
    cov_s += np.tensordot(fit.squares_s2, of_samples, 1)
    C_i = np.block([[n_g2 * T * np.eye(3), cov_s_theta.T], [cov_s_theta, cov_s]])
    # (3); the gyro bias also turns the samples about the IMU's point
    D_i = np.vstack([-R_after, -xR - swung_s @ gtsam.SO3.Hat(lever)])
    to_j = np.kron(np.eye(2), R.T)
    C = to_j @ C_i @ to_j.T
    i_T_j = gtsam.Pose3(gtsam.Rot3(R), way + sensors.body_p_imu)
    mean_force = np.array(sums.v) / T
    return PreintegratedMotion(
        i_T_j, 0.5 * (C + C.T), to_j @ D_i, removed.bias, T, mean_force
    )


def _turn_until(
    rows: Rows, sensors: Sensors, removed: Removed, first_ns: int, epoch_ns: int
) -> Floats:
    """Rotation from an earlier instant to the epoch, in whose frame the Earth's rotation is known, shape (3, 3)."""
    turn = np.eye(3)
    # the Earth's rate in the earlier frame depends on the turn: twice more is exact to rounding
    for _ in range(3 if removed.earth.any() else 1):
        earlier = Removed(removed.bias, turn @ removed.earth)
        turn = (
            motion_over(rows, sensors, earlier, first_ns, epoch_ns)
            .i_T_j.rotation()
            .matrix()
        )
    return turn


class Line(NamedTuple):
    """Line of the velocity, from the first of its Doppler samples to the end of the motion."""

    cuts_ns: Ints
    """Stamps of the samples and the end, shape (m + 1,)."""
    W: Floats
    """Sum of the samples' weights in each interval between cuts, shape (m,), s."""
    jumps: Floats
    """``w_k z_k`` at the cuts, body axes, shape (m + 1, 3), m."""
    origin_ns: int
    """Instant of frame i, one of the cuts; what lies before only shapes s."""
    R_0: Floats
    """Rotation from the first cut to frame i, shape (3, 3)."""


class LineSums(NamedTuple):
    """Sums along a line in frame i; y is s so far, in the middle of each step."""

    R: Floats
    """At the cuts, shape (m + 1, 3, 3)."""
    v: Vec3
    """``sum dt R f`` after the origin, m/s."""
    s: Vec3
    """Of (1), m."""
    y: Vec3
    """``sum dt y`` after the origin."""
    yy: Mat3
    """``sum dt y y^T``."""
    yR: Mat3
    """``sum dt [y]x R``."""
    R_after: Mat3
    """``sum dt R`` after the origin."""
    aa: float
    """``sum dt a^2``."""
    aR: Mat3
    """``sum dt a R``."""


@compiled
def sum_along(rows: Rows, imu_rows: int, line: Line, removed: Removed) -> LineSums:
    """Sums along a line from the first ``imu_rows`` inertial rows, linear between them."""
    imu_ns = rows.imu_ns
    cuts_ns = line.cuts_ns
    m = len(line.W)
    R_cuts = np.empty((m + 1, 3, 3))
    b = vec(removed.bias)
    E = vec(removed.earth)
    R = mat(line.R_0)
    v = ZERO
    s = ZERO
    y = ZERO
    yy = O3
    yR = O3
    R_after = O3
    aa = 0.0
    aR = O3
    t = cuts_ns[0]
    i = rows_until(imu_ns, t)
    for k in range(m):
        store(R, R_cuts[k])
        s += R @ row_of(line.jumps, k)
        while t < cuts_ns[k + 1]:
            until = min(cuts_ns[k + 1], imu_ns[i]) if i < imu_rows else cuts_ns[k + 1]
            middle = t + (until - t) // 2
            dt = (until - t) * 1e-9
            w_k = value_at(imu_ns, rows.rate, imu_rows, i, middle, False) - b - R.T @ E
            f = value_at(imu_ns, rows.force, imu_rows, i, middle, False)
            if (
                rows.turns.is_modelled
                and hole_ns(imu_ns, imu_rows, i, until) > UNFELT_NS
            ):
                f = NOWHERE
            turn, mean = exp_and_mean(dt * w_k)
            R_k = R @ mean
            # before the origin a step turns the samples of the window, not the motion
            after = 1.0 if middle > line.origin_ns else 0.0
            a = line.W[k] - after * ((middle - line.origin_ns) * 1e-9)
            F = dt * (R_k @ f)
            # second order in a step: the force turns while its share a falls
            ds = a * F - (after * dt**3 / 12.0) * (R_k @ cross(w_k, f))
            y_k = s + 0.5 * ds + (after * dt / 12.0) * F
            v += after * F
            y += (after * dt) * y_k
            yy += outer(dt * y_k, y_k)
            yR += dt * (skew(y_k) @ R_k)
            R_after += (after * dt) * R_k
            aa += dt * a * a
            aR += (dt * a) * R_k
            s += ds
            R = R @ turn
            i += int(i < imu_rows and imu_ns[i] <= until)
            t = until
    store(R, R_cuts[m])
    s += R @ row_of(line.jumps, m)
    return LineSums(R_cuts, v, s, y, yy, yR, R_after, aa, aR)


def _open(
    rows: Rows,
    sensors: Sensors,
    removed: Removed,
    start_ns: int,
    end_ns: int,
    line: PreintegratedMotion | None = None,
) -> PreintegratedMotion:
    """Motion after the last sample, by the velocity that it measured and the line."""
    k = int(rows.dvl_ns.searchsorted(start_ns))
    T = (end_ns - start_ns) * 1e-9
    # noise of this density, a second apart, has the variance of T times the last velocity
    samples = Ends((k, k), np.array([start_ns - NS_PER_S, start_ns]), T * rows.cov[k])
    steady = _prior(rows, sensors, removed, samples, (start_ns, end_ns))
    walked_m2 = sensors.velocity_walk_density**2 * T**3 / 3.0
    return _corrected(steady, walked_m2, line, sensors.gyro_bias_sigma)


class Ends(NamedTuple):
    """Two Doppler samples of the prior."""

    rows: tuple[int, int]
    """Rows that measured their velocities."""
    stamps_ns: Ints
    """Shape (2,)."""
    cov: Floats
    """Of both, shape (3, 3), m²/s²."""


def _prior(
    rows: Rows,
    sensors: Sensors,
    removed: Removed,
    ends: Ends,
    interval_ns: tuple[int, int],
) -> PreintegratedMotion:
    """Motion by a velocity of the body's origin that is linear between two samples, and steady after them."""
    measured = list(ends.rows)
    rate = _rates_at(rows, rows.dvl_ns[measured])  # (2, 3)
    # the origin keeps its velocity when the vehicle turns, the log beside it does not
    swing = np.cross(rate - removed.bias - removed.earth, sensors.body_p_dvl)
    two_samples = rows._replace(
        dvl_ns=ends.stamps_ns,
        velocity=rows.velocity[measured] - swing,
        cov=np.array([ends.cov, ends.cov]),
        known_ns=ends.stamps_ns,
    )
    at_origin = sensors._replace(body_p_dvl=np.zeros(3))
    steady = motion_over(two_samples, at_origin, removed, *interval_ns)
    # the bias changes the swing by b x l; minus the derivative of the turn is the integral of the rotation
    D = steady.D_bias.copy()
    D[3:] += D[:3] @ gtsam.SO3.Hat(sensors.body_p_dvl)
    return replace(steady, D_bias=D)


def _rates_at(rows: Rows, stamps_ns: Ints) -> Floats:
    """Angular rates at instants, shape (n, 3), the same numbers however many rows come before and after."""
    return np.column_stack(
        [np.interp(stamps_ns, rows.imu_ns, column) for column in rows.rate.T]
    )


def _corrected(
    steady: PreintegratedMotion,
    walked_m2: float,
    line: PreintegratedMotion | None,
    gyro_bias_sigma: float,
) -> PreintegratedMotion:
    """Steady motion whose velocity walks, corrected by the line: (4) and (5)."""
    W = walked_m2 * np.eye(3)
    K = np.zeros((3, 3))
    bent_m2 = 0.0  # c
    if line is None:
        line = steady
    else:
        # b (D - D_0), (3, 3)
        by_bias = gyro_bias_sigma * (line.D_bias - steady.D_bias)[3:]
        bent = gyro_bias_sigma * line.duration_s * float(np.linalg.norm(by_bias, 2))
        bent_m2 = 2.0 * bent**2
        # a line fitted to many samples may have less Doppler noise than the last sample
        variances, axes = np.linalg.eigh((line.covariance - steady.covariance)[3:, 3:])
        V = (
            (axes * np.maximum(variances, 0.0)) @ axes.T
            + by_bias @ by_bias.T
            + bent_m2 * np.eye(3)
        )
        K = walked_m2 * np.linalg.inv(W + V)
    i_R_j = steady.i_T_j.rotation()
    steady_p = steady.i_T_j.translation()
    # s - s_0 in the last frame
    off = i_R_j.unrotate(line.i_T_j.translation() - steady_p)
    i_T_j = gtsam.Pose3(i_R_j, steady_p + i_R_j.rotate(K @ off))
    G = np.eye(6)  # both have the same turn
    G[3:, 3:] = K
    rest = np.eye(3) - K
    covariance = steady.covariance + G @ (line.covariance - steady.covariance) @ G.T
    covariance[3:, 3:] += rest @ W @ rest.T + bent_m2 * K @ K.T
    D_bias = steady.D_bias + G @ (line.D_bias - steady.D_bias)
    return replace(
        line, i_T_j=i_T_j, covariance=0.5 * (covariance + covariance.T), D_bias=D_bias
    )


def remaining_motion(
    before: PreintegratedMotion, whole: PreintegratedMotion
) -> PreintegratedMotion:
    """The rest of a whole motion after a first part of it, with the growth of its error."""
    motion = before.i_T_j.between(whole.i_T_j)
    A = motion.inverse().AdjointMap()
    # growth of the error; rounding may leave an eigenvalue below zero
    grown = whole.covariance - A @ before.covariance @ A.T
    variances, axes = np.linalg.eigh(0.5 * (grown + grown.T))
    duration_s = whole.duration_s - before.duration_s
    impulse = whole.mean_specific_force * whole.duration_s
    if before.duration_s > 0.0:
        impulse = impulse - before.mean_specific_force * before.duration_s
    return replace(
        whole,
        i_T_j=motion,
        covariance=(axes * np.maximum(variances, 0.0)) @ axes.T,
        D_bias=whole.D_bias - A @ before.D_bias,
        duration_s=duration_s,
        mean_specific_force=before.i_T_j.rotation().unrotate(impulse / duration_s),
    )
