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
from sonar_graph.navigation.imu_gaps import SHORTEST_NS, UNFELT_NS, Turns, error_in_hole, hole_ns
from sonar_graph.numerics import ZERO, Mat3, Vec3, compiled, inlined


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
    known_ns: Ints
    """Stamps from which they are known: their own, or of the rows that completed or confirmed them; in order."""
    hold_past: bool
    """True where a sample is the mean over the interval that ends at its stamp; else linear."""
    turns: Turns
    """Model of the turn in holes of the IMU."""

    def known(self, at_ns: int) -> Rows:
        """Rows known at an instant, and the first of the Doppler log."""
        i, k = self.imu_ns.searchsorted(at_ns, side="right"), max(self.known_ns.searchsorted(at_ns, side="right"), 1)
        imu_ns, rate, force, dvl_ns, velocity, cov, known_ns, hold_past, turns = self
        return Rows(imu_ns[:i], rate[:i], force[:i], dvl_ns[:k], velocity[:k], cov[:k], known_ns[:k], hold_past, turns)


class Step(NamedTuple):
    """Motion between two successive stamps, as measured: no bias is removed."""

    until_ns: int
    duration_s: float
    rate: Vec3
    """rad/s."""
    velocity: Vec3
    """Of the DVL's origin, body axes, m/s."""
    Q: Mat3
    """Spectral density of its noise, m²/s."""
    force: Vec3
    """Specific force at the IMU, m/s²; NaN where not measured."""


class ImuHole(NamedTuple):
    """A hole of the IMU, or a stretch without one."""

    until_ns: int
    turn_psd: Vec3
    """Spectral density of what the rates miss, rad²/s; zero where there is none."""
    unfelt: Vec3
    """NaN where the specific force is not to be used, else zero."""


@compiled
def hole_from(rows: Rows, imu_rows: int, dvl_rows: int, i: int, k: int, t: int, end_ns: int) -> ImuHole:
    """The hole at t, of which i and k are the first rows after it, to its end (open: to the next stamp), or none.

    It stands outside of the loop over steps, which takes half as long without calls.
    """
    imu_ns, until = rows.imu_ns, end_ns
    if not rows.turns.is_modelled:
        return ImuHole(end_ns, ZERO, ZERO)
    if i < imu_rows:
        until = min(until, imu_ns[i])
    elif k < dvl_rows:
        until = min(until, rows.dvl_ns[k])
    length_ns = hole_ns(imu_ns, imu_rows, i, until)
    if length_ns > 0:
        unfelt = Vec3(np.nan, np.nan, np.nan) if length_ns > UNFELT_NS else ZERO
        return ImuHole(until, error_in_hole(rows.turns, imu_ns, imu_rows, i, t, until), unfelt)
    while i + 1 < imu_rows and imu_ns[i] < end_ns and imu_ns[i + 1] - imu_ns[i] <= SHORTEST_NS:
        i += 1
    return ImuHole(min(end_ns, imu_ns[i]) if i < imu_rows else until, ZERO, ZERO)


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
def row(A: Floats, k: int) -> Vec3:
    """Vector from the first three numbers of a row."""
    return Vec3(A[k, 0], A[k, 1], A[k, 2])


@inlined
def covariance(A: Floats, k: int) -> Mat3:
    """Matrix k of an array of them."""
    return Mat3(
        Vec3(A[k, 0, 0], A[k, 0, 1], A[k, 0, 2]),
        Vec3(A[k, 1, 0], A[k, 1, 1], A[k, 1, 2]),
        Vec3(A[k, 2, 0], A[k, 2, 1], A[k, 2, 2]),
    )


@inlined
def value_at(stamps: Ints, values: Floats, n: int, i: int, t: int, hold_past: bool) -> Vec3:
    """Value at t from the first n rows, where ``stamps[i - 1] < t <= stamps[i]``; outside them the nearest row's."""
    if i >= n:
        return row(values, n - 1)
    if hold_past or i == 0:
        return row(values, i)
    before = row(values, i - 1)
    share = (t - stamps[i - 1]) / (stamps[i] - stamps[i - 1])
    return before + share * (row(values, i) - before)


@inlined
def step_from(rows: Rows, imu_rows: int, dvl_rows: int, i: int, k: int, t: int, end_ns: int) -> Step:
    """The step from t, of which i and k are the first rows after it, to the next stamp of either sensor or the end.

    Only the first ``imu_rows`` and ``dvl_rows`` rows are used.
    """
    imu_ns, dvl_ns, hold_past, until = rows.imu_ns, rows.dvl_ns, rows.hold_past, end_ns
    if i < imu_rows:
        until = min(until, imu_ns[i])
    if k < dvl_rows:
        until = min(until, dvl_ns[k])
    middle = t + (until - t) // 2
    last = min(k, dvl_rows - 1)
    other = last if hold_past or k >= dvl_rows or last == 0 else last - 1
    interval_s = (dvl_ns[last] - dvl_ns[last - 1]) * 1e-9 if last > 0 else 0.0
    return Step(
        until,
        (until - t) * 1e-9,
        value_at(imu_ns, rows.rate, imu_rows, i, middle, hold_past),
        value_at(dvl_ns, rows.velocity, dvl_rows, k, middle, hold_past),
        interval_s * (0.5 * (covariance(rows.cov, last) + covariance(rows.cov, other))),
        value_at(imu_ns, rows.force, imu_rows, i, middle, hold_past),
    )


@inlined
def has_gap(dvl_ns: Ints, n: int, k: int, start_ns: int, end_ns: int, longest_ns: int) -> bool:
    """True where an interval, with row k the first Doppler row in it, has a longer time without any of the first n."""
    while k < n and dvl_ns[k] < end_ns:
        if dvl_ns[k] - start_ns > longest_ns:
            return True
        start_ns, k = dvl_ns[k], k + 1
    return end_ns - start_ns > longest_ns


@inlined
def put(v: Vec3, out: Floats, row: int) -> None:
    """Write a vector into a row of an array."""
    out[row, 0], out[row, 1], out[row, 2] = v.x, v.y, v.z
