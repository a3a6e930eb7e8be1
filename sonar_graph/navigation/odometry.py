"""Gyro and Doppler rows, merged into steps of constant rate and velocity.

Every estimator moves on these steps, so that no comparison hinges on how two sensors were interpolated.

Nodes. The stamps of the DVL rows are *nodes*: between two nodes the velocity is known on both sides and the motion is
final. A node counts as reached at time t when its own row and an IMU row at or after it are stamped at or before t.
Whatever happens between nodes (a detection, a depth sample, an estimate being asked for) is related to the newest
reached node by a provisional motion that uses nothing stamped later. Results therefore depend on stamps alone, not on
how a log is cut into blocks, and nothing peeks ahead.

Interpolation. ``linear``: rate and velocity are piecewise linear through the samples; the mean over a step is the value
at its middle. ``hold-past``: a sample is the mean over the interval that ends at its stamp.

Noise. Doppler samples are white: each perturbs the displacement by its weight (half the two intervals that it ends and
begins) times its error. The same total over any chain follows from a velocity noise that is white in time with
spectral density ``velocity_cov * interval``; half of a sample's variance falls on either side of its node.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.navigation.inertial_carry import InertialRows
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.partial_velocity import PartialVelocities
from sonar_graph.navigation.recursion import Step
from sonar_graph.navigation.triples import (
    Matrix,
    Vector,
    matrix,
    minus,
    multiple_of,
    place,
    plus,
    scaled,
    sum_of,
    vector,
)
from sonar_graph.navigation.velocity_gate import GATE, Refusal, RefusedRow, distances

Columns = tuple[Ints, Floats, Floats, Ints, Floats, Floats, bool]
"""IMU: stamps, rate, specific force. DVL: stamps, velocity, covariance. Whether a sample holds for what lies before."""


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

    def __len__(self) -> int:
        return len(self.duration_s)


_Rows = TypeVar("_Rows", Imu, Dvl)


class Odometry:
    """Keeps the rows that are still needed and turns them into steps.

    Parameters
    ----------
    calibration
        Mountings, DVL noise where the log has none, and the meaning of a sample.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._body_R_imu = _rotation(calibration.imu.mounting)
        self._body_R_dvl = _rotation(calibration.dvl.mounting)
        self._default_cov = np.diag(np.square(calibration.dvl.velocity_sigma_m_s))
        self._hold_past = calibration.odometry_interpolation == "hold-past"
        self._longest_ns = longest_interval_ns(calibration)
        self._partial = PartialVelocities(calibration)
        self._walk = calibration.dvl.velocity_walk_density
        self.settled_ns: int = _EARLIEST
        """Up to when motion is used and stays as it is."""
        self.refused: list[RefusedRow] = []
        """Rows that are not used, and why."""
        self._imu_ns: Ints = np.empty(0, np.int64)
        self._rate: Floats = np.empty((0, 3))
        self._force: Floats = np.empty((0, 3))
        self._dvl_ns: Ints = np.empty(0, np.int64)
        self._velocity: Floats = np.empty((0, 3))
        self._cov: Floats = np.empty((0, 3, 3))

    def add(self, imu: Imu | None, dvl: Dvl | None) -> bool:
        """Take in rows and place them by their stamps.

        Of rows with equal stamps the first counts. A row stamped at or before `settled_ns` is late, and a velocity may
        be an outlier (`sonar_graph.navigation.velocity_gate`): these become rows of `refused`.

        Returns
        -------
        Whether rows were placed before others that are there already: provisional motion has to be had anew.
        """
        placed_imu = imu is not None and self._add_imu(imu)
        placed_dvl = dvl is not None and self._add_dvl(dvl)
        return placed_imu or placed_dvl

    def _add_imu(self, rows: Imu) -> bool:
        imu = self._in_time(rows, self._imu_ns, "imu")
        if imu is None:
            return False
        rate, force = imu.angular_velocity, imu.specific_force
        if self._body_R_imu is not None:
            rate, force = rate @ self._body_R_imu.T, force @ self._body_R_imu.T
        comes_after = not len(self._imu_ns) or bool(imu.stamps_ns[0] > self._imu_ns[-1])
        self._imu_ns = np.concatenate([self._imu_ns, imu.stamps_ns])
        self._rate = np.concatenate([self._rate, rate])
        self._force = np.concatenate([self._force, force])
        if not comes_after:
            order = np.unique(self._imu_ns, return_index=True)[1]
            self._imu_ns, self._rate, self._force = self._imu_ns[order], self._rate[order], self._force[order]
        return not comes_after

    def _add_dvl(self, rows: Dvl) -> bool:
        dvl = self._in_time(rows, self._dvl_ns, "dvl")
        if dvl is None:
            return False
        velocity, cov = self._in_body(dvl)
        stamps_ns, velocity, cov = self._believed(dvl.stamps_ns, velocity, cov)
        if not len(stamps_ns):
            return False
        stamps_ns, velocity, cov = self._partial.completed(stamps_ns, velocity, cov, InertialRows(*self.columns()[:3]))
        if not len(stamps_ns):
            return False
        comes_after = not len(self._dvl_ns) or bool(stamps_ns[0] > self._dvl_ns[-1])
        self._dvl_ns = np.concatenate([self._dvl_ns, stamps_ns])
        self._velocity = np.concatenate([self._velocity, velocity])
        self._cov = np.concatenate([self._cov, cov])
        if not comes_after:
            order = np.unique(self._dvl_ns, return_index=True)[1]
            self._dvl_ns, self._velocity, self._cov = self._dvl_ns[order], self._velocity[order], self._cov[order]
        return not comes_after

    def _in_body(self, dvl: Dvl) -> tuple[Floats, Floats]:
        """Velocity and its covariance in body axes."""
        cov = np.where(np.isnan(dvl.velocity_cov), self._default_cov, dvl.velocity_cov)
        if self._body_R_dvl is None:
            return dvl.velocity, cov
        return dvl.velocity @ self._body_R_dvl.T, self._body_R_dvl @ cov @ self._body_R_dvl.T

    def _believed(self, stamps_ns: Ints, velocity: Floats, cov: Floats) -> tuple[Ints, Floats, Floats]:
        """Rows that are no outliers, each beside the one before it; held velocities may jump and are all believed."""
        if self._hold_past:
            return stamps_ns, velocity, cov
        k = int(np.searchsorted(self._dvl_ns, stamps_ns[0])) - 1
        before = (int(self._dvl_ns[k]), self._velocity[k], self._cov[k]) if k >= 0 else (_LATEST, velocity[0], cov[0])
        found = distances(stamps_ns, velocity, cov, *before, self._walk)
        is_outlier = found > GATE
        if not is_outlier.any():
            return stamps_ns, velocity, cov
        for stamp_ns, distance in zip(stamps_ns[is_outlier].tolist(), found[is_outlier].tolist(), strict=True):
            self.refused.append(RefusedRow("dvl", stamp_ns, Refusal.OUTLIER, distance))
        return stamps_ns[~is_outlier], velocity[~is_outlier], cov[~is_outlier]

    def _in_time(self, rows: _Rows, known_ns: Ints, sensor: str) -> _Rows | None:
        """Rows that can still be used, each stamp once."""
        if rows.stamps_ns[0] <= self.settled_ns:
            late = rows.between(_EARLIEST, self.settled_ns)
            new = [] if late is None else np.setdiff1d(late.stamps_ns, known_ns).tolist()
            self.refused += [RefusedRow(sensor, stamp_ns, Refusal.LATE, np.nan) for stamp_ns in new]
            later = rows.between(self.settled_ns, _LATEST)
            if later is None:
                return None
            rows = later
        if _has_repeats(rows.stamps_ns):
            rows = rows.rows(np.unique(rows.stamps_ns, return_index=True)[1])
        return rows

    def settle(self, node_ns: int) -> None:
        """Motion up to a node is used and stays as it is: rows up to there come too late from now on."""
        self.settled_ns = max(self.settled_ns, node_ns)

    def start_ns(self) -> int | None:
        """First node that IMU rows cover from both sides; None before there is one."""
        if not len(self._imu_ns) or not len(self._dvl_ns):
            return None
        first = np.searchsorted(self._dvl_ns, self._imu_ns[0])
        if first == len(self._dvl_ns) or self._dvl_ns[first] > self._imu_ns[-1]:
            return None
        return int(self._dvl_ns[first])

    def nodes(self, after_ns: int, until_ns: int) -> Ints:
        """Nodes after one instant that are reached at another, in order."""
        first, last = node_range(self._imu_ns, self._dvl_ns, after_ns, until_ns)
        return self._dvl_ns[first:last]

    def newest_node(self, after_ns: int, until_ns: int) -> int | None:
        """Last of `nodes`; None where there is none."""
        first, last = node_range(self._imu_ns, self._dvl_ns, after_ns, until_ns)
        return int(self._dvl_ns[last - 1]) if last > first else None

    def steps_between_nodes(self, start_ns: int, end_ns: int) -> Steps:
        """Final motion from one node to a later, reached one."""
        imu_rows = int(np.searchsorted(self._imu_ns, end_ns)) + 1
        dvl_rows = int(np.searchsorted(self._dvl_ns, end_ns, side="right"))
        return self._steps(start_ns, end_ns, imu_rows, dvl_rows)

    def steps_since_node(self, node_ns: int, until_ns: int) -> Steps:
        """Provisional motion from a reached node to any later instant, from rows stamped no later than that."""
        imu_rows = int(np.searchsorted(self._imu_ns, until_ns, side="right"))
        dvl_rows = int(np.searchsorted(self._dvl_ns, until_ns, side="right"))
        return self._steps(node_ns, until_ns, imu_rows, dvl_rows)

    def is_gap(self, start_ns: int, end_ns: int) -> bool:
        """Whether the velocity is not taken as linear, or held, over a time without samples."""
        return end_ns - start_ns > self._longest_ns

    def gaps(self, start_ns: int, end_ns: int) -> list[tuple[int, int]]:
        """Stamps of successive nodes with a gap in between, from one node to another."""
        first, last = np.searchsorted(self._dvl_ns, [start_ns, end_ns])
        within = self._dvl_ns[first : last + 1]
        before = np.flatnonzero(np.diff(within) > self._longest_ns)
        return list(zip(within[before].tolist(), within[before + 1].tolist(), strict=True)) if len(before) else []

    def _steps(self, start_ns: int, end_ns: int, imu_rows: int, dvl_rows: int) -> Steps:
        return Steps(*merge_rows(self.columns(), imu_rows, dvl_rows, start_ns, end_ns))

    def velocity_at_node(self, node_ns: int) -> tuple[Floats, Floats, Floats]:
        """DVL velocity (body axes), its covariance, and the angular rate at a node; shapes (3,), (3, 3), (3,)."""
        k = int(np.searchsorted(self._dvl_ns, node_ns))
        i = int(np.searchsorted(self._imu_ns, node_ns))
        if self._hold_past or i == 0:
            return self._velocity[k], self._cov[k], self._rate[i]
        return self._velocity[k], self._cov[k], np.array(value_at(self._imu_ns, self._rate, i, node_ns, False))

    def columns(self) -> Columns:
        """All rows, for compiled loops over many instants."""
        return (
            self._imu_ns,
            self._rate,
            self._force,
            self._dvl_ns,
            self._velocity,
            self._cov,
            self._hold_past,
        )

    def forget_before(self, node_ns: int) -> None:
        """Drop rows that no motion from this node on can need, gaps after it included."""
        self.settle(node_ns)
        needed_ns = node_ns if self._hold_past else node_ns - WINDOW_NS
        first_imu = max(int(np.searchsorted(self._imu_ns, needed_ns)) - 1, 0)
        first_dvl = max(int(np.searchsorted(self._dvl_ns, needed_ns)) - 1, 0)
        self._imu_ns, self._rate, self._force = (
            self._imu_ns[first_imu:],
            self._rate[first_imu:],
            self._force[first_imu:],
        )
        self._dvl_ns, self._velocity, self._cov = (
            self._dvl_ns[first_dvl:],
            self._velocity[first_dvl:],
            self._cov[first_dvl:],
        )


_EARLIEST, _LATEST = np.iinfo(np.int64).min, np.iinfo(np.int64).max
WINDOW_NS = 5_000_000_000
"""Rows kept before a node, where gravity is found should bottom lock be lost there: enough for 1 mm/s² with samples of
5 mm/s at 7 Hz, short enough for an accelerometer's bias not to have turned."""


def longest_interval_ns(calibration: Calibration) -> int:
    """Between velocity samples that is no gap; held samples leave none."""
    return _LATEST if calibration.odometry_interpolation == "hold-past" else round(calibration.dvl.gap_s * 1e9)


def _rotation(mounting: Mounting) -> Floats | None:
    """body_R_sensor, None for a sensor whose axes are the body's."""
    return mounting.pose().rotation().matrix() if any(mounting.rpy_rad) else None


@compiled
def _has_repeats(stamps: Ints) -> bool:
    """Whether two rows share a stamp: nothing can be interpolated between them."""
    return bool(np.any(stamps[1:] == stamps[:-1]))


@inlined
def rows_until(stamps: Ints, instant_ns: int) -> int:
    """Number of rows stamped at or before an instant; numpy's search takes its side as text, slow to compile."""
    low, high = 0, len(stamps)
    while low < high:
        middle = (low + high) // 2
        if stamps[middle] <= instant_ns:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def _bracket(stamps: Ints, n: int, i: int, t: int, hold_past: bool) -> tuple[int, int, float]:
    """Rows before and after t and the share of the later, where ``stamps[i - 1] < t <= stamps[i]``.

    Outside the first n rows the nearest end's value holds.
    """
    if i >= n:
        return n - 1, n - 1, 0.0
    if hold_past or i == 0:
        return i, i, 0.0
    return i - 1, i, (t - stamps[i - 1]) / (stamps[i] - stamps[i - 1])


@compiled
def node_range(imu_ns: Ints, dvl_ns: Ints, after_ns: int, until_ns: int) -> tuple[int, int]:
    """Rows of the DVL that are nodes after one instant and reached at another: first, and one past the last."""
    seen = np.searchsorted(imu_ns, until_ns, side="right")
    if seen == 0:
        return 0, 0
    covered_ns = min(until_ns, imu_ns[seen - 1])
    first = np.searchsorted(dvl_ns, after_ns, side="right")
    return int(first), max(int(first), int(np.searchsorted(dvl_ns, covered_ns, side="right")))


@inlined
def value_at(stamps: Ints, values: Floats, i: int, t: int, hold_past: bool) -> Vector:
    """Value at t, where ``stamps[i - 1] < t <= stamps[i]``; the nearest end's value outside the rows."""
    return value_among(stamps, values, len(stamps), i, t, hold_past)


@inlined
def value_among(stamps: Ints, values: Floats, rows: int, i: int, t: int, hold_past: bool) -> Vector:
    """The same, of the first rows only."""
    return _between(values, *_bracket(stamps, rows, i, t, hold_past))


@inlined
def _between(values: Floats, before: int, after: int, share: float) -> Vector:
    """Between two rows."""
    a, b = vector(values[before]), vector(values[after])
    return plus(a, scaled(share, minus(b, a)))


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
    imu_ns, rate, force, dvl_ns, velocity, cov, hold_past = columns
    t, i, k = cursor
    until = end_ns
    if i < imu_rows:
        until = min(until, imu_ns[i])
    if k < dvl_rows:
        until = min(until, dvl_ns[k])
    middle = t + (until - t) // 2
    before, after, share = _bracket(imu_ns, imu_rows, i, middle, hold_past)
    step = Step(
        (until - t) * 1e-9,
        _between(rate, before, after, share),
        _between(velocity, *_bracket(dvl_ns, dvl_rows, k, middle, hold_past)),
        _velocity_psd(dvl_ns, cov, dvl_rows, k, hold_past),
        _between(force, before, after, share),
    )
    past_imu = i < imu_rows and imu_ns[i] <= until
    past_dvl = k < dvl_rows and dvl_ns[k] <= until
    return Cursor(until, i + int(past_imu), k + int(past_dvl)), step


@compiled
def merge_rows(
    columns: Columns, imu_rows: int, dvl_rows: int, start_ns: int, end_ns: int
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Cut (start, end] at every stamp of either sensor and take each sensor's mean over each piece."""
    cursor = cursor_at(columns, start_ns)
    most = max(imu_rows - cursor.imu_row, 0) + max(dvl_rows - cursor.dvl_row, 0) + 1
    duration, rates, velocities = np.empty(most), np.empty((most, 3)), np.empty((most, 3))
    psds, forces = np.empty((most, 3, 3)), np.empty((most, 3))
    n = 0
    while cursor.stamp_ns < end_ns:
        cursor, step = next_step(columns, imu_rows, dvl_rows, cursor, end_ns)
        duration[n] = step.duration_s
        rates[n, 0], rates[n, 1], rates[n, 2] = step.rate
        velocities[n, 0], velocities[n, 1], velocities[n, 2] = step.velocity
        forces[n, 0], forces[n, 1], forces[n, 2] = step.specific_force
        place(step.velocity_psd, psds[n], 0, 0)
        n += 1
    return duration[:n], rates[:n], velocities[:n], psds[:n], forces[:n]
