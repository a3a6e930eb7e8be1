"""Rows of gyros, accelerometers and Doppler log, merged into steps of constant rate, velocity and specific force.

An interval is cut at every stamp of either sensor; each step has the mean of both over its length. ``linear``: the
value in the middle of the step, linear between samples, held past the last known one. ``hold-past``: the sample that
ends the interval. Doppler noise is white in time: between samples T apart with covariances R_1, R_2 its spectral
density is ``Q = T (R_1 + R_2) / 2``. docs/theory/preintegration.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.imu_gaps import UNFELT_NS, Turns, error_in_hole, hole_ns
from sonar_graph.numerics.jit import compiled, inlined
from sonar_graph.numerics.matrices import ZERO, Mat3, Vec3, mat, store, vec


class Rows(NamedTuple):
    """Rows of both sensors, body axes, each in the order of their stamps."""

    imu_ns: Ints
    rate: Floats
    """Shape (n, 3), rad/s."""
    force: Floats
    """Specific force, shape (n, 3), m/s²; NaN where not measured."""
    dvl_ns: Ints
    velocity: Floats
    """Velocity of the DVL's origin, shape (n, 3), m/s."""
    cov: Floats
    """Its covariance, shape (n, 3, 3), m²/s²."""
    hold_past: bool
    """True where a sample is the mean over the interval that ends at its stamp; else linear."""
    turns: Turns
    """Model of the turn in holes of the IMU."""


class Steps(NamedTuple):
    """Motion in n successive steps as measured: no bias is removed."""

    duration_s: Floats
    """Shape (n,)."""
    rate: Floats
    """Shape (n, 3), rad/s."""
    velocity: Floats
    """Of the DVL's origin, body axes, shape (n, 3), m/s."""
    velocity_psd: Floats
    """Spectral density Q of its noise, shape (n, 3, 3), m²/s."""
    force: Floats
    """Specific force at the IMU, shape (n, 3), m/s²; NaN where not measured."""
    turn_psd: Floats
    """Spectral density of what the rates miss in holes of the IMU, shape (n, 3), rad²/s; zero elsewhere."""


@inlined
def rows_until(stamps: Ints, instant_ns: int) -> int:
    """Number of rows stamped at or before an instant (numpy's search with a side is slow to compile)."""
    low, high = 0, len(stamps)
    while low < high:
        middle = (low + high) // 2
        if stamps[middle] <= instant_ns:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def value_at(stamps: Ints, values: Floats, n: int, i: int, t: int, hold_past: bool) -> Vec3:
    """Value at t from the first n rows, where ``stamps[i - 1] < t <= stamps[i]``; outside them the nearest row's."""
    if i >= n:
        return vec(values[n - 1])
    if hold_past or i == 0:
        return vec(values[i])
    before = vec(values[i - 1])
    share = (t - stamps[i - 1]) / (stamps[i] - stamps[i - 1])
    return before + share * (vec(values[i]) - before)


@inlined
def velocity_noise(rows: Rows, n: int, k: int) -> Mat3:
    """Q from the first n Doppler rows before row k; after the last one that of the last interval."""
    last = min(k, n - 1)
    other = last if rows.hold_past or k >= n or last == 0 else last - 1
    interval_s = (rows.dvl_ns[last] - rows.dvl_ns[last - 1]) * 1e-9 if last > 0 else 0.0
    return interval_s * (0.5 * (mat(rows.cov[last]) + mat(rows.cov[other])))


@inlined
def has_gap(dvl_ns: Ints, n: int, k: int, start_ns: int, end_ns: int, longest_ns: int) -> bool:
    """True where an interval, with row k the first Doppler row in it, has a longer time without any of the first n."""
    while k < n and dvl_ns[k] < end_ns:
        if dvl_ns[k] - start_ns > longest_ns:
            return True
        start_ns, k = dvl_ns[k], k + 1
    return end_ns - start_ns > longest_ns


@inlined
def put(v: Vec3, out: Floats, m: int) -> None:
    """Write a vector into a row of an array."""
    out[m, 0], out[m, 1], out[m, 2] = v.x, v.y, v.z


@compiled
def steps_over(rows: Rows, start_ns: Ints, end_ns: Ints, known_ns: Ints, longest_ns: int) -> tuple[Ints, Steps]:
    """Steps of n intervals one after another, each from rows stamped no later than its ``known_ns``.

    Those of interval e are ``first[e]`` to ``first[e + 1]``. One with a time of more than ``longest_ns`` between
    Doppler samples is a single step that is NaN.
    """
    imu_ns, dvl_ns, hold_past = rows.imu_ns, rows.dvl_ns, rows.hold_past
    n, most, m = len(start_ns), 0, 0
    for e in range(n):
        most += rows_until(imu_ns, end_ns[e]) - rows_until(imu_ns, start_ns[e]) + 1
        most += rows_until(dvl_ns, end_ns[e]) - rows_until(dvl_ns, start_ns[e])
    first, duration_s, rate, velocity = (
        np.zeros(n + 1, np.int64),
        np.empty(most),
        np.empty((most, 3)),
        np.empty((most, 3)),
    )
    velocity_psd, force, turn_psd = np.empty((most, 3, 3)), np.empty((most, 3)), np.empty((most, 3))
    for e in range(n):
        t, end = start_ns[e], end_ns[e]
        i, k = rows_until(imu_ns, t), rows_until(dvl_ns, t)
        imu_rows, dvl_rows = rows_until(imu_ns, known_ns[e]), rows_until(dvl_ns, known_ns[e])
        if has_gap(dvl_ns, dvl_rows, k, t, end, longest_ns):
            duration_s[m], t, m = np.nan, end, m + 1
        while t < end:
            until = end
            if i < imu_rows:
                until = min(until, imu_ns[i])
            if k < dvl_rows:
                until = min(until, dvl_ns[k])
            middle = t + (until - t) // 2
            f, by_hole = value_at(imu_ns, rows.force, imu_rows, i, middle, hold_past), ZERO
            length_ns = hole_ns(imu_ns, imu_rows, i, until) if rows.turns.is_modelled else 0
            if length_ns > 0:
                by_hole = error_in_hole(rows.turns, imu_ns, imu_rows, i, t, until)
            if length_ns > UNFELT_NS:
                f = Vec3(np.nan, np.nan, np.nan)
            duration_s[m] = (until - t) * 1e-9
            put(value_at(imu_ns, rows.rate, imu_rows, i, middle, hold_past), rate, m)
            put(value_at(dvl_ns, rows.velocity, dvl_rows, k, middle, hold_past), velocity, m)
            store(velocity_noise(rows, dvl_rows, k), velocity_psd[m], 0, 0)
            put(f, force, m)
            put(by_hole, turn_psd, m)
            if i < imu_rows and imu_ns[i] <= until:
                i += 1
            if k < dvl_rows and dvl_ns[k] <= until:
                k += 1
            t, m = until, m + 1
        first[e + 1] = m
    return first, Steps(duration_s, rate, velocity, velocity_psd, force, turn_psd)
