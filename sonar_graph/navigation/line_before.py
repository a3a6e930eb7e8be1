"""The straight line on which the velocity less the accelerometers' gain lay before bottom lock was lost.

Backwards from node i, in frame i, every Doppler sample z_k of the last seconds gives ``y_k = R_k z_k - F_k``, which is
``v + g t_k`` but for noise (`sonar_graph.navigation.gap_motion`). The line is fitted by least squares; over the next T
seconds it moves the vehicle by::

    s = T (mean + slope (T / 2 - mean t)) = sum_k w_k y_k

Its covariance: the samples' noise by their weights, and what gyros and accelerometers did in the W seconds before the
node. With ``w(t)`` the weights a second, s from 0 to 1 over the window and ``r = T (T / 2 + W / 2) / W``::

    K(s) = int w dt = T s - 6 r s (1 - s)          weight of an acceleration in the displacement
    a^2 W int K^2 ds                               white force noise of density a
    (g n)^2 W^3 int (int K ds)^2 ds                tilt that walks with density n, backwards from the node
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_graph.navigation.interpolation import rows_until, value_among
from sonar_graph.navigation.joint_state import AT_REST, NO_SLOPES, push, pushed_path, pushed_slopes
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.stamped_rows import WINDOW_NS
from sonar_graph.navigation.steps import Columns
from sonar_graph.navigation.triples import (
    IDENTITY,
    ZERO,
    ZEROS,
    Matrix,
    Vector,
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
from sonar_graph.navigation.unmeasured_turns import felt

FEWEST, SHORTEST_S = 4, 1.0
"""Samples, and the time that they span."""


class Sums(NamedTuple):
    """Over samples: of 1, t and t², and of a column of numbers times 1 and times t."""

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
    """Fitted, with what its integral over the time to come needs."""

    sums: Sums
    Q: Matrix
    """Sum of the samples' covariances, frame i."""
    is_known: bool


@compiled
def line_before(columns: Columns, body_p_imu: Vector, body_p_dvl: Vector, k: int, bias: Vector, earth: Vector) -> Line:
    """Fit to the samples before and at Doppler row k; the velocity is that of the IMU's point.

    Parameters
    ----------
    earth
        Earth's rotation in frame i, rad/s.
    """
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
            f = felt(f, turns, imu_ns, len(imu_ns), row, t)
            by = push(path.R, (until - t) * 1e-9, minus(w, times(transposed(path.R), earth)), f)
            slopes = pushed_slopes(slopes, by)
            path = pushed_path(path, by)
            row -= int(row > 0 and imu_ns[row - 1] >= until)
            t = until
        at_dvl = minus(value_among(imu_ns, rate, len(imu_ns), rows_until(imu_ns, t - 1), t, hold_past), bias)
        turned = times(path.R, plus(vector(velocity[k]), cross(at_dvl, lever)))
        y_g = difference_of(skew_times(turned, slopes.M), slopes.v_g)
        y_g = sum_of(y_g, times_skew(path.R, lever))
        sums = _with(sums, path.elapsed_s, minus(turned, path.v), y_g, slopes.M)
        Q = sum_of(Q, sandwich(path.R, matrix(cov[k]), path.R))
        k -= 1
    y = sums.y[0] + sums.y[1] + sums.y[2]
    return Line(sums, Q, sums.n >= FEWEST and path.elapsed_s <= -SHORTEST_S and np.isfinite(y))


@compiled
def _with(sums: Sums, t: float, y: Vector, y_g: Matrix, y_a: Matrix) -> Sums:
    return Sums(
        sums.n + 1.0,
        sums.t + t,
        sums.tt + t * t,
        plus(sums.y, y),
        plus(sums.ty, scaled(t, y)),
        sum_of(sums.y_g, y_g),
        sum_of(sums.ty_g, multiple_of(t, y_g)),
        sum_of(sums.y_a, y_a),
        sum_of(sums.ty_a, multiple_of(t, y_a)),
    )


@compiled
def integral(
    line: Line, elapsed_s: float, gyro_density: float, accel_density: float
) -> tuple[Vector, Matrix, Matrix, Matrix]:
    """Displacement over the time after the node, its derivatives by gyro and accelerometer bias, its covariance.

    ``w_k = T (1/n + (T/2 - mean t) (t_k - mean t) / S) = a + b t_k``.
    """
    sums = line.sums
    mean_t = sums.t / sums.n
    S = sums.tt - sums.t * mean_t
    reach = elapsed_s * (elapsed_s / 2.0 - mean_t)
    b = reach / S
    a = elapsed_s / sums.n - b * mean_t
    doppler = multiple_of((elapsed_s**2 / sums.n + reach * b) / sums.n, line.Q)
    by_gyro, by_force = _weights_in_window(elapsed_s, -2.0 * mean_t, reach)
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


@inlined
def _weights_in_window(elapsed_s: float, window_s: float, reach: float) -> tuple[float, float]:
    """``W^3 int (int K)^2`` and ``W int K^2`` of the module's docstring."""
    r = reach / window_s
    A, B = elapsed_s / 2.0 - 3.0 * r, 2.0 * r
    C, D = elapsed_s - 6.0 * r, 6.0 * r
    by_gyro = window_s**3 * (A * A / 5.0 + A * B / 3.0 + B * B / 7.0)
    return by_gyro, window_s * (C * C / 3.0 + C * D / 2.0 + D * D / 5.0)
