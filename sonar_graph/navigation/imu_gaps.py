"""Holes of the IMU: uncertainty of the turn while no inertial row comes.

A hole is an interval between inertial rows of more than `HOLE_INTERVALS` typical ones and `SHORTEST_HOLE_S`; typical is
the median of the `ROWS_BEFORE` intervals before, so that nothing stamped later decides. In a hole the rate is linear
between the rows w_0 and w_T beside it (closed), or held from the last one (open). What that misses is taken, about each
body axis, for a Gauss-Markov process of second order with sigma s and time c. With ``a = T / c`` the angle turned over
the length T errs by the variance::

    closed  T (w_0 + w_T) / 2     s^2 c^2 (a^2 / 2 - 6 + (6 + 6 a + 5/2 a^2 + a^3 / 2) exp(-a))
    open    T w_0                 s^2 c^2 (a^2 - 6 + (6 + 6 a + 2 a^2) exp(-a))

The rows beside a hole stand for all of it, and so does their noise: of density n at intervals of dt it adds
``n^2 T^2 / (2 dt)`` to a closed hole and ``n^2 T^2 / dt`` to an open one. Over a closed hole all this is spread evenly
as white noise; a step in an open one gets what has grown meanwhile. Errors about the three axes are independent.

Derivation and what is left out: docs/theory/gaps.md.
"""

from typing import NamedTuple

import numpy as np

from sonar_graph.calibration import (
    HOLE_INTERVALS,
    ROWS_BEFORE,
    SHORTEST_HOLE_S,
    UNTYPICAL_S,
    ImuCalibration,
)
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import Vec3, compilable

UNTYPICAL_NS = round(UNTYPICAL_S * 1e9)
SHORTEST_NS = round(SHORTEST_HOLE_S * 1e9)
UNFELT_NS = 100_000_000
"""Specific force counts as not measured in longer holes: in shorter ones a vehicle turns by less than 1e-4 rad
unmeasured."""
SHORT = 0.03
"""T / c below which two terms of a series are exact to 1e-3 and differences of large numbers are not."""


class Turns(NamedTuple):
    """Model of the turns of a vehicle in holes of its IMU."""

    is_modelled: bool
    sigma: Floats
    """Of the rate about each body axis, shape (3,), rad/s."""
    time_s: Floats
    """Its time, shape (3,)."""
    gyro_density: float
    """rad/s/√Hz."""


def turns_of(imu: ImuCalibration) -> Turns:
    """The numbers of a calibration."""
    sigma = np.array(imu.turn_sigma_rad_s)
    return Turns(
        bool((sigma > 0).any()),
        sigma,
        np.array(imu.turn_time_s),
        imu.gyro_noise_density,
    )


UNTURNED = Turns(False, np.ones(3), np.ones(3), 0.0)
"""With it no interval is a hole."""


@compilable
def typical_ns(stamps: Ints, row: int) -> int:
    """Median of the `ROWS_BEFORE` intervals before a row, of an even number the shorter; 0 without intervals."""
    first = max(row - ROWS_BEFORE, 0)
    for k in range(first, row):
        interval = stamps[k + 1] - stamps[k]
        shorter = 0
        same = 0
        for m in range(first, row):
            other = stamps[m + 1] - stamps[m]
            shorter += int(other < interval)
            same += int(other == interval)
        if 2 * shorter < row - first <= 2 * (shorter + same):
            return interval
    return 0


@compilable
def hole_ns(stamps: Ints, rows: int, row: int, until_ns: int) -> int:
    """Length of the hole before a row; 0 without a hole.

    Only the first ``rows`` stamps are known; ``row = rows`` means a hole that is open, and lasts until ``until_ns`` so
    far.
    """
    if row <= 0:
        return 0
    last = min(row, rows) - 1
    length_ns = (stamps[row] if row < rows else until_ns) - stamps[last]
    if length_ns <= SHORTEST_NS:
        return 0
    # rows may be lost or jitter: only intervals far longer than usual are holes
    typical = typical_ns(stamps, last)
    longest_ns = HOLE_INTERVALS * typical if typical > 0 else UNTYPICAL_NS
    return length_ns if length_ns > longest_ns else 0


def row_after_hole(stamps: Ints, first: int, last: int, longest_ns: int) -> int:
    """The row after the first hole between two rows that lasts longer; -1 without one."""
    intervals = np.diff(stamps[first : last + 1])
    for row in (first + 1 + np.flatnonzero(intervals > longest_ns)).tolist():
        if hole_ns(stamps, len(stamps), row, stamps[row]) > 0:
            return int(row)
    return -1


@compilable
def error_in_hole(
    turns: Turns, stamps: Ints, rows: int, row: int, t: int, until_ns: int
) -> Vec3:
    """Spectral density of the rates' error: the mean over a closed hole, the growth of an open one since t; rad²/s."""
    last = min(row, rows) - 1
    typical_s = typical_ns(stamps, last) * 1e-9
    by_row = turns.gyro_density**2 / typical_s if typical_s > 0.0 else 0.0  # n^2 / dt
    is_open = row >= rows
    T = ((until_ns if is_open else stamps[row]) - stamps[last]) * 1e-9
    # open: what has grown since t, of a variance that counts from the last row
    before_s = (t - stamps[last]) * 1e-9
    noise = by_row * (T + before_s) if is_open else 0.5 * by_row * T
    return Vec3(
        density_about(turns, 0, is_open, before_s, T) + noise,
        density_about(turns, 1, is_open, before_s, T) + noise,
        density_about(turns, 2, is_open, before_s, T) + noise,
    )


@compilable
def density_about(
    turns: Turns, axis: int, is_open: bool, before_s: float, length_s: float
) -> float:
    """What turning about an axis adds: its variance over a closed hole, or its growth in an open one, over time."""
    sigma = turns.sigma[axis]
    time_s = turns.time_s[axis]
    if not is_open:
        return closed_variance(sigma, time_s, length_s) / length_s
    before = open_variance(sigma, time_s, before_s)
    grown = open_variance(sigma, time_s, length_s) - before
    return grown / (length_s - before_s)


@compilable
def closed_variance(sigma: float, time_s: float, length_s: float) -> float:
    """Variance of the angle turned, with rates linear between both ends, rad²."""
    a = length_s / time_s
    if a < SHORT:
        return (sigma * time_s) ** 2 * a**5 / 30.0 * (1.0 - 0.625 * a)
    by_end = (6.0 + a * (6.0 + a * (2.5 + 0.5 * a))) * np.exp(-a)
    return (sigma * time_s) ** 2 * (0.5 * a * a - 6.0 + by_end)


@compilable
def open_variance(sigma: float, time_s: float, length_s: float) -> float:
    """Variance of the angle turned, with the last rate held, rad²."""
    a = length_s / time_s
    if a < SHORT:
        return (sigma * time_s) ** 2 * a**4 / 4.0 * (1.0 - 8.0 / 15.0 * a)
    by_end = (6.0 + a * (6.0 + 2.0 * a)) * np.exp(-a)
    return (sigma * time_s) ** 2 * (a * a - 6.0 + by_end)
