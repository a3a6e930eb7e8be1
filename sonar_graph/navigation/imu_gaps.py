"""How far a vehicle may turn, and that nothing is felt, while no inertial row comes.

A hole is an interval between inertial rows of more than `HOLE_INTERVALS` typical ones and `SHORTEST_HOLE_S`; typical is
the median of the `ROWS_BEFORE` intervals before, so that nothing stamped later decides. In a hole the rate is taken as
everywhere, linear between the rows w_0 and w_T beside it, or held from the last. What that misses is the affair of the
vehicle, not of the gyros' noise. About each body axis its rate is taken for a Gauss-Markov process of second order,
sigma s, time c, which has an angular acceleration (s / c) as vehicles have::

    k(u) = s^2 (1 + u / c) exp(-u / c)
    K    = int_0^T k du,    D = 2 int_0^T (T - u) k du

The angle turned, ``int w dt``, has variance D, and covariance K with the rate at either end. With ``a = T / c`` the
guesses err by::

    closed  T (w_0 + w_T) / 2     D - 2 T K + T^2 (k(0) + k(T)) / 2
                                  = s^2 c^2 (a^2 / 2 - 6 + (6 + 6 a + 5/2 a^2 + a^3 / 2) exp(-a))
    open    T w_0                 D - 2 T K + T^2 k(0)
                                  = s^2 c^2 (a^2 - 6 + (6 + 6 a + 2 a^2) exp(-a))

short ones by ``s^2 c^2 a^5 / 30`` and ``s^2 c^2 a^4 / 4``, long ones by a rate that was guessed wrong from end to end.
The rows beside it stand for the whole hole, and so does their noise. Gyros of density n at intervals of dt have
``n^2 / dt`` in one row, hence the angle ``n^2 T^2 / (2 dt)`` more in a closed hole and ``n^2 T^2 / dt`` in an open one:
0.8 and 1.1 degrees for 2 s of a coarse gyro (1e-3 rad/s/sqrt(Hz) at 100 Hz), where ``n^2 T`` is 0.08 squared.

Over a closed hole all this is spread evenly, as white noise is; an open one gets what it has grown by since its last
row. Errors about the three axes are independent.

Left out: the noise of the very first row of a log with a hole after it, since nothing tells its interval; and that two
motions which share a hole share its errors.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.calibration import HOLE_INTERVALS, ROWS_BEFORE, SHORTEST_HOLE_S, UNTYPICAL_S, ImuCalibration
from sonar_graph.measurements import Ints
from sonar_graph.numerics import ZERO, Vector, compiled, inlined, plus, scaled

UNTYPICAL_NS = round(UNTYPICAL_S * 1e9)
UNFELT_NS = 100_000_000
"""Holes from here on leave specific force unmeasured: below, a vehicle turns by less than 1e-4 rad unseen."""
SHORTEST_NS = round(SHORTEST_HOLE_S * 1e9)
SHORT = 0.03
"""Length over time below which two terms of a series are exact to 1e-3 and differences of large numbers are not."""
TurnValues = tuple[Vector, Vector, float]
"""About each body axis: standard deviation of the rate, rad/s, and its time, s. White noise of the gyros, rad/s/√Hz."""
NO_TURNS: TurnValues = (ZERO, (1.0, 1.0, 1.0), 0.0)
"""No interval is a hole."""


def turn_values(imu: ImuCalibration) -> TurnValues:
    """What a calibration says."""
    return imu.turn_sigma_rad_s, imu.turn_time_s, imu.gyro_noise_density


@compiled
def hole_ns(stamps: Ints, rows: int, row: int, until_ns: int) -> int:
    """Length of the hole before a row; 0 where there is none.

    Parameters
    ----------
    rows
        How many of the stamps are known.
    row
        First row after an instant; ``rows``: none is known, and the hole, if any, is open.
    until_ns
        Up to when it has lasted then.
    """
    if row <= 0:
        return 0
    last = min(row, rows) - 1
    length_ns = (stamps[row] if row < rows else until_ns) - stamps[last]
    if length_ns <= SHORTEST_NS:
        return 0
    first, shorter = max(last - ROWS_BEFORE, 0), 0
    for k in range(first, last):
        shorter += int(HOLE_INTERVALS * (stamps[k + 1] - stamps[k]) < length_ns)
    is_hole = 2 * shorter >= last - first if last > first else length_ns > UNTYPICAL_NS
    return length_ns if is_hole else 0


@compiled
def row_after_hole(stamps: Ints, first: int, last: int, longest_ns: int) -> int:
    """The row after the first hole between two rows that lasts longer; -1 where there is none."""
    for row in range(first + 1, last + 1):
        if stamps[row] - stamps[row - 1] > longest_ns and hole_ns(stamps, len(stamps), row, stamps[row]) > 0:
            return row
    return -1


@inlined
def felt(force: Vector, turns: TurnValues, stamps: Ints, rows: int, row: int, until_ns: int) -> Vector:
    """The specific force up to an instant; NaN in a hole."""
    if turns[0] != ZERO and hole_ns(stamps, rows, row, until_ns) > UNFELT_NS:
        return np.nan, np.nan, np.nan
    return force


@inlined
def turn_psd(turns: TurnValues, stamps: Ints, rows: int, row: int, t: int, until_ns: int) -> Vector:
    """Spectral density of what the rates between two instants, none of the rows within, miss; rad²/s."""
    psd = ZERO
    if turns[0] != ZERO:
        length_ns = hole_ns(stamps, rows, row, until_ns)
        if length_ns > 0:
            row_variance = _row_variance(turns[2], stamps, min(row, rows) - 1)
            psd = _in_hole(turns, row_variance, length_ns * 1e-9, (until_ns - t) * 1e-9, row < rows)
    return psd


@compiled
def _row_variance(gyro_density: float, stamps: Ints, row: int) -> float:
    """Noise of one rate by the typical interval before it, (rad/s)²; zero where there is none."""
    first = max(row - ROWS_BEFORE, 0)
    if row <= first:
        return 0.0
    return gyro_density * gyro_density / (np.median(np.diff(stamps[first : row + 1])) * 1e-9)


@compiled
def _in_hole(turns: TurnValues, row_variance: float, length_s: float, step_s: float, is_closed: bool) -> Vector:
    """Of a closed hole, evenly; of an open one what the last step adds."""
    (x, y, z), (c_x, c_y, c_z), _ = turns
    if is_closed:
        by_rows = 0.5 * row_variance * length_s
        grown = closed_variance(x, c_x, length_s), closed_variance(y, c_y, length_s), closed_variance(z, c_z, length_s)
        return plus(scaled(1.0 / length_s, grown), (by_rows, by_rows, by_rows))
    before_s = length_s - step_s
    by_row = row_variance * (length_s + before_s)
    grown = (
        open_variance(x, c_x, length_s) - open_variance(x, c_x, before_s),
        open_variance(y, c_y, length_s) - open_variance(y, c_y, before_s),
        open_variance(z, c_z, length_s) - open_variance(z, c_z, before_s),
    )
    return plus(scaled(1.0 / step_s, grown), (by_row, by_row, by_row))


@compiled
def closed_variance(sigma: float, time_s: float, length_s: float) -> float:
    """Of the angle turned, by rates linear between both ends, rad²."""
    a = length_s / time_s
    if a < SHORT:
        return (sigma * time_s) ** 2 * a**5 / 30.0 * (1.0 - 0.625 * a)
    by_end = (6.0 + a * (6.0 + a * (2.5 + 0.5 * a))) * np.exp(-a)
    return (sigma * time_s) ** 2 * (0.5 * a * a - 6.0 + by_end)


@compiled
def open_variance(sigma: float, time_s: float, length_s: float) -> float:
    """Of the angle turned, by the last rate held, rad²."""
    a = length_s / time_s
    if a < SHORT:
        return (sigma * time_s) ** 2 * a**4 / 4.0 * (1.0 - 8.0 / 15.0 * a)
    by_end = (6.0 + a * (6.0 + 2.0 * a)) * np.exp(-a)
    return (sigma * time_s) ** 2 * (a * a - 6.0 + by_end)
