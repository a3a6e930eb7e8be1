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
as white noise; an open one gets the growth since its last row. Errors about the three axes are independent.

Derivation and what is left out: docs/theory/gaps.md.
"""

from typing import NamedTuple

import numpy as np

from sonar_graph.calibration import HOLE_INTERVALS, ROWS_BEFORE, SHORTEST_HOLE_S, UNTYPICAL_S, ImuCalibration
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import Vec3, compiled, vec

UNTYPICAL_NS = round(UNTYPICAL_S * 1e9)
UNFELT_NS = 100_000_000
"""Specific force counts as not measured in longer holes: in shorter ones a vehicle turns by less than 1e-4 rad
unseen."""
SHORTEST_NS = round(SHORTEST_HOLE_S * 1e9)
SHORT = 0.03
"""T / c below which two terms of a series are exact to 1e-3 and differences of large numbers are not."""


class Turns(NamedTuple):
    """Model of the turns of a vehicle unseen in holes of its IMU."""

    is_modelled: bool
    sigma: Floats
    """Of the rate about each body axis, shape (3,), rad/s."""
    time_s: Floats
    """Its time, shape (3,)."""
    gyro_density: float
    """rad/s/√Hz."""


def turns_of(imu: ImuCalibration) -> Turns:
    """The numbers of a calibration."""
    is_modelled = any(sigma > 0 for sigma in imu.turn_sigma_rad_s)
    return Turns(is_modelled, np.array(imu.turn_sigma_rad_s), np.array(imu.turn_time_s), imu.gyro_noise_density)


ONES = Vec3(1.0, 1.0, 1.0)
UNTURNED = Turns(False, np.ones(3), np.ones(3), 0.0)
"""With it no interval is a hole."""


@compiled
def typical_ns(stamps: Ints, row: int) -> int:
    """Median of the `ROWS_BEFORE` intervals before a row, of an even number the shorter; 0 where there is none."""
    first = max(row - ROWS_BEFORE, 0)
    for k in range(first, row):
        shorter = same = 0
        for m in range(first, row):
            shorter += int(stamps[m + 1] - stamps[m] < stamps[k + 1] - stamps[k])
            same += int(stamps[m + 1] - stamps[m] == stamps[k + 1] - stamps[k])
        if 2 * shorter < row - first <= 2 * (shorter + same):
            return stamps[k + 1] - stamps[k]
    return 0


@compiled
def hole_ns(stamps: Ints, rows: int, row: int, until_ns: int) -> int:
    """Length of the hole before a row; 0 where there is none.

    Only the first ``rows`` stamps are known; ``row = rows`` means a hole that is open, and lasts until ``until_ns`` so
    far.
    """
    if row <= 0:
        return 0
    last = min(row, rows) - 1
    length_ns = (stamps[row] if row < rows else until_ns) - stamps[last]
    if length_ns <= SHORTEST_NS:
        return 0
    typical = typical_ns(stamps, last)
    return length_ns if length_ns > (HOLE_INTERVALS * typical if typical > 0 else UNTYPICAL_NS) else 0


def row_after_hole(stamps: Ints, first: int, last: int, longest_ns: int) -> int:
    """The row after the first hole between two rows that lasts longer; -1 where there is none."""
    for row in (first + 1 + np.flatnonzero(np.diff(stamps[first : last + 1]) > longest_ns)).tolist():
        if hole_ns(stamps, len(stamps), row, stamps[row]) > 0:
            return int(row)
    return -1


@compiled
def error_in_hole(turns: Turns, stamps: Ints, rows: int, row: int, t: int, until_ns: int) -> Vec3:
    """Spectral density of the rates' error: the mean over a closed hole, the growth of an open one since t; rad²/s."""
    last, n2 = min(row, rows) - 1, turns.gyro_density**2
    typical_s = typical_ns(stamps, last) * 1e-9
    by_row = n2 / typical_s if typical_s > 0.0 else 0.0
    s, c = vec(turns.sigma), vec(turns.time_s)
    if row < rows:
        T = (stamps[row] - stamps[last]) * 1e-9
        grown = Vec3(closed_variance(s.x, c.x, T), closed_variance(s.y, c.y, T), closed_variance(s.z, c.z, T))
        return (1.0 / T) * grown + 0.5 * by_row * T * ONES
    T, before_s = (until_ns - stamps[last]) * 1e-9, (t - stamps[last]) * 1e-9
    grown = Vec3(open_variance(s.x, c.x, T), open_variance(s.y, c.y, T), open_variance(s.z, c.z, T))
    grown -= Vec3(
        open_variance(s.x, c.x, before_s), open_variance(s.y, c.y, before_s), open_variance(s.z, c.z, before_s)
    )
    return (1.0 / (T - before_s)) * grown + by_row * (T + before_s) * ONES


@compiled
def closed_variance(sigma: float, time_s: float, length_s: float) -> float:
    """Variance of the angle turned, with rates linear between both ends, rad²."""
    a = length_s / time_s
    if a < SHORT:
        return (sigma * time_s) ** 2 * a**5 / 30.0 * (1.0 - 0.625 * a)
    by_end = (6.0 + a * (6.0 + a * (2.5 + 0.5 * a))) * np.exp(-a)
    return (sigma * time_s) ** 2 * (0.5 * a * a - 6.0 + by_end)


@compiled
def open_variance(sigma: float, time_s: float, length_s: float) -> float:
    """Variance of the angle turned, with the last rate held, rad²."""
    a = length_s / time_s
    if a < SHORT:
        return (sigma * time_s) ** 2 * a**4 / 4.0 * (1.0 - 8.0 / 15.0 * a)
    by_end = (6.0 + a * (6.0 + 2.0 * a)) * np.exp(-a)
    return (sigma * time_s) ** 2 * (a * a - 6.0 + by_end)
