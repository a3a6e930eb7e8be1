"""Gyro and Doppler rows, merged into steps of constant rate and velocity.

Every estimator moves on these steps, so that no comparison hinges on how two sensors were interpolated
(`sonar_graph.navigation.interpolation`).

Noise. Doppler samples are white: each perturbs the displacement by its weight (half the two intervals that it ends and
begins) times its error. The same total over any chain follows from a velocity noise that is white in time with
spectral density ``velocity_cov * interval``; half of a sample's variance falls on either side of its node.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.interpolation import between, bracket, rows_until
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.recursion import Step
from sonar_graph.navigation.triples import Matrix, matrix, multiple_of, place, sum_of
from sonar_graph.navigation.unmeasured_turns import TurnValues, felt, turn_psd

Columns = tuple[Ints, Floats, Floats, Ints, Floats, Floats, bool, TurnValues]
"""IMU: stamps, rate, specific force. DVL: stamps, velocity, covariance. Whether a sample holds for what lies before.
How the vehicle turns where no gyro tells."""


class Cursor(NamedTuple):
    """An instant among the rows."""

    stamp_ns: int
    imu_row: int
    """First row after it."""
    dvl_row: int
    """First row after it."""


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
    """Spectral density of rates that were not measured, body axes, shape (n, 3), rad²/s; zero where they were."""

    def __len__(self) -> int:
        return len(self.duration_s)


@inlined
def _velocity_psd(dvl_ns: Ints, cov: Floats, n: int, k: int, hold_past: bool) -> Matrix:
    """Spectral density of the velocity noise between rows k - 1 and k; past row n - 1, that of the last interval."""
    last = min(k, n - 1)
    interval_s = (dvl_ns[last] - dvl_ns[last - 1]) * 1e-9 if last > 0 else 0.0
    other = last if hold_past or k >= n or last == 0 else last - 1
    return multiple_of(interval_s, multiple_of(0.5, sum_of(matrix(cov[last]), matrix(cov[other]))))


@inlined
def cursor_at(columns: Columns, instant_ns: int) -> Cursor:
    """The cursor with which motion from an instant begins."""
    return Cursor(instant_ns, rows_until(columns[0], instant_ns), rows_until(columns[3], instant_ns))


@inlined
def next_step(columns: Columns, imu_rows: int, dvl_rows: int, cursor: Cursor, end_ns: int) -> tuple[Cursor, Step]:
    """The step from a cursor to the next stamp of either sensor, or to the end: each sensor's mean over it.

    Parameters
    ----------
    columns
        Of `Odometry.columns`, of which only the first ``imu_rows`` and ``dvl_rows`` rows are used.
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
    step = Step(
        (until - t) * 1e-9,
        between(rate, before, after, share),
        between(velocity, *bracket(dvl_ns, dvl_rows, k, middle, hold_past)),
        _velocity_psd(dvl_ns, cov, dvl_rows, k, hold_past),
        felt(between(force, before, after, share), turns, imu_ns, imu_rows, i, until),
        turn_psd(turns, imu_ns, imu_rows, i, t, until),
    )
    past_imu = i < imu_rows and imu_ns[i] <= until
    past_dvl = k < dvl_rows and dvl_ns[k] <= until
    return Cursor(until, i + int(past_imu), k + int(past_dvl)), step


@compiled
def are_nodes(imu_ns: Ints, dvl_ns: Ints, start_ns: int, end_ns: int) -> bool:
    """Whether an interval, the earlier end first, begins and ends at Doppler rows that IMU rows cover."""
    if end_ns < start_ns or not len(imu_ns) or start_ns < imu_ns[0] or end_ns > imu_ns[-1]:
        return False
    first, last = np.searchsorted(dvl_ns, start_ns), np.searchsorted(dvl_ns, end_ns)
    return bool(last < len(dvl_ns) and dvl_ns[first] == start_ns and dvl_ns[last] == end_ns)


@compiled
def merge_rows(
    columns: Columns, imu_rows: int, dvl_rows: int, start_ns: int, end_ns: int
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Cut (start, end] at every stamp of either sensor and take each sensor's mean over each piece."""
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
