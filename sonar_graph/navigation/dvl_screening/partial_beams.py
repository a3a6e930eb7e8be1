"""Velocities from one or two Doppler beams, completed by what precedes and follows them.

A row that leaves a direction unmeasured (`sonar_graph.devices.dvl_beams`) waits for the next whole one. Then all rows k
from the whole row 0 to the whole row m are solved together. With R the rotation by the gyros and F the velocity that
the accelerometers gain from rest, both in frame 0, the velocity of the IMU's point less F is a straight line whose
slope is gravity (`sonar_graph.navigation.dvl_screening.partial_beams`), give or take a random walk::

    y_k = R_k z_k - F_k,    y_k+1 = y_k + g T_k + N(0, q^2 T_k I),    z_k ~ N(measured, cov_k)            (1)

Gravity g is unknown and constant. Where a specific force was not measured R = I, F = 0, g = 0, and q is that of
``velocity_walk_density``. Least squares gives y and its joint covariance P; completed rows are ``R_k^T (y_k + F_k)``.
Rows 0 and m stay as they are to the bit.

Errors of completed rows are not independent, whereas odometry takes each row's noise as white. A displacement sums them
with weights w (half the intervals either side), so that each completed row is given what it shares with the others::

    cov_k = sum_j w_j / w_k (P_kj + P_jk) / 2,    counted twice for j = 0 and m, which keep their own      (2)

A whole row between two stretches is shared by the rows completed on both its sides. With S the covariance of row 0
with the summed displacement of the rows that it closed before, axes of row 0, the later stretch counts that as well::

    cov_k += (P_k0 cov_0^-1 S + its transpose) / w_k,    next S = sum_k w_k R_m^T P_mk R_m               (3)

With both ``sum w^2 cov`` is the variance of the summed displacement.

A partial row before the first whole one, late, or in a stretch longer than `LONGEST_STRETCH_NS` is passed over.

What gyros and accelerometers say of a velocity's course between Doppler rows, and how far it may be trusted.

From the first row on, in its frame: R the rotation, F the integral of the turned specific force. The velocity of the
IMU's point less F is ``v + g t`` with gravity g. Left out of this line, and taken for a random walk of root density
``walk_density`` (q) instead, with the sum of these for q^2, over a stretch of T seconds turned by phi in all, are

    accelerometer noise          s_a^2
    gyro noise, tilting g        (g s_g T)^2 / 12           its integral in mid-stretch, both ends known: T^3 / 48
    gyro bias, tilting g         (g b T)^2 T / 16           peak of the parabola between both ends
    a bias that turns            (b_a phi)^2 T / 16         the same

b holds the Earth's rotation too. Variances of a walk between two known ends peak at ``q^2 T / 4``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.imu_gaps import UNFELT_NS, row_after_hole
from sonar_graph.numerics import compiled, rotation_exp

EARTH_RATE_RAD_S = 7.3e-5


class InertialRows(NamedTuple):
    """Of the IMU, body axes; specific forces are NaN where not measured, and not used about holes."""

    stamps_ns: Ints
    rate: Floats
    specific_force: Floats


class Carry(NamedTuple):
    """At n rows, the first of which is the frame of all."""

    rotation: Floats
    """Shape (n, 3, 3)."""
    velocity: Floats
    """F, shape (n, 3), m/s."""
    from_lever: Floats
    """The IMU's velocity less that of the Doppler log, axes of each row, shape (n, 3), m/s."""
    walk_density: float
    """m/s/√s."""
    is_inertial: bool
    """Whether a line with gravity as its slope is left; else nothing is carried and R is the identity."""


def carry(imu: InertialRows, stamps_ns: Ints, calibration: Calibration) -> Carry:
    """From the first to each of the rows, with IMU rows stamped no later than the last."""
    known = int(np.searchsorted(imu.stamps_ns, stamps_ns[-1], side="right"))
    first = max(int(np.searchsorted(imu.stamps_ns, stamps_ns[0], side="right")) - 1, 0)
    with_hole = row_after_hole(imu.stamps_ns, first, known - 1, UNFELT_NS) >= 0  # typical is told by rows before
    rows = slice(first, known)
    imu = InertialRows(imu.stamps_ns[rows], imu.rate[rows], imu.specific_force[rows])
    if not len(imu.stamps_ns) or with_hole or not np.isfinite(imu.specific_force).all():
        return _nothing(len(stamps_ns), calibration.dvl.velocity_walk_density)
    times_ns = np.union1d(stamps_ns, imu.stamps_ns[imu.stamps_ns > stamps_ns[0]])
    middles_ns = times_ns[:-1] + np.diff(times_ns) // 2
    turns = _at(imu, imu.rate, middles_ns) * (np.diff(times_ns) * 1e-9)[:, None]
    gains = _at(imu, imu.specific_force, middles_ns) * (np.diff(times_ns) * 1e-9)[:, None]
    rotation, velocity, turned_rad = _carried(turns, gains)
    at = np.searchsorted(times_ns, stamps_ns)
    arm = np.subtract(calibration.imu.mounting.translation_m, calibration.dvl.mounting.translation_m)
    density = _walk_density(calibration, float(stamps_ns[-1] - stamps_ns[0]) * 1e-9, turned_rad)
    return Carry(rotation[at], velocity[at], np.cross(_at(imu, imu.rate, stamps_ns), arm), density, True)


def _nothing(n: int, walk_density: float) -> Carry:
    return Carry(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((n, 3)), walk_density, False)


def _at(imu: InertialRows, values: Floats, stamps_ns: Ints) -> Floats:
    """Linear between rows, the nearest beyond them."""
    seconds, known_s = (stamps_ns - imu.stamps_ns[0]) * 1e-9, (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
    return np.column_stack([np.interp(seconds, known_s, values[:, axis]) for axis in range(3)])


def _walk_density(calibration: Calibration, stretch_s: float, turned_rad: float) -> float:
    imu, g = calibration.imu, calibration.gravity_m_s2
    bias2 = imu.gyro_bias_sigma**2 + EARTH_RATE_RAD_S**2
    by_gyro = g**2 * (imu.gyro_noise_density**2 * stretch_s**2 / 12.0 + bias2 * stretch_s**3 / 16.0)
    by_turning = (imu.accel_bias_sigma * turned_rad) ** 2 * stretch_s / 16.0
    return float(np.sqrt(imu.accel_noise_density**2 + by_gyro + by_turning))


@compiled
def _carried(turns: Floats, gains: Floats) -> tuple[Floats, Floats, float]:
    """R and F at the ends of all pieces, and the angle turned in all."""
    n = len(turns)
    rotation, velocity = np.empty((n + 1, 3, 3)), np.zeros((n + 1, 3))
    rotation[0] = np.eye(3)
    turned_rad = 0.0
    for k in range(n):
        velocity[k + 1] = velocity[k] + rotation[k] @ (rotation_exp(0.5 * turns[k]) @ gains[k])
        rotation[k + 1] = rotation[k] @ rotation_exp(turns[k])
        turned_rad += np.sqrt(np.sum(turns[k] ** 2))
    return rotation, velocity, turned_rad


LONGEST_STRETCH_NS = 60_000_000_000
"""What is solved at once stays small, and no accelerometer carries a velocity longer."""
Rows = tuple[Ints, Floats, Floats]
"""Stamps, shape (n,), velocities (n, 3) and covariances (n, 3, 3), body axes."""


class PartialVelocities:
    """Completes rows in their order, one block after the other.

    Parameters
    ----------
    calibration
        Noise of the IMU, lever arms, and the walk of the vehicle's velocity.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._whole: _Row | None = None
        self._waiting: list[_Row] = []
        self._passed_over_ns: list[int] = []

    @property
    def not_completed_ns(self) -> list[int]:
        """Stamps of the rows that were passed over, and of those that wait."""
        return [*self._passed_over_ns, *(row.stamp_ns for row in self._waiting)]

    @property
    def is_waiting(self) -> bool:
        """Whether a row waits for the next whole one."""
        return bool(self._waiting)

    def remember(self, stamps_ns: Ints, velocity: Floats, covs: Floats) -> None:
        """Take note of rows that are all whole, while none waits: `completed` would give them back as they are."""
        if self._whole is None or stamps_ns[-1] > self._whole.stamp_ns:
            self._whole = _Row(int(stamps_ns[-1]), velocity[-1], covs[-1])

    def completed(
        self, stamps_ns: Ints, velocity: Floats, covs: Floats, partial: NDArray[np.bool_], imu: InertialRows
    ) -> Rows:
        """The rows that can be used now, all with a whole velocity; they may be older than those given.

        Parameters
        ----------
        stamps_ns, velocity, covs
            In order; no NaN.
        partial
            Which of them leave a direction unmeasured, shape (n,).
        imu
            All rows known; of those after a stamp nothing is used for it.
        """
        usable: list[_Row] = []
        for stamp_ns, v, cov, is_part in zip(stamps_ns.tolist(), velocity, covs, partial.tolist(), strict=True):
            row = _Row(stamp_ns, v, cov)
            if is_part:
                self._wait(row)
            else:
                usable += [*self._closed_by(row, imu), row]
        return (
            np.array([row.stamp_ns for row in usable], dtype=np.int64),
            np.array([row.velocity for row in usable]).reshape(-1, 3),
            np.array([row.cov for row in usable]).reshape(-1, 3, 3),
        )

    def _wait(self, row: _Row) -> None:
        newest_ns = self._waiting[-1].stamp_ns if self._waiting else self._whole.stamp_ns if self._whole else None
        if newest_ns is not None and row.stamp_ns > newest_ns:
            self._waiting.append(row)
        else:
            self._passed_over_ns.append(row.stamp_ns)

    def _closed_by(self, row: _Row, imu: InertialRows) -> list[_Row]:
        """The rows that waited for this one."""
        within = [waiting for waiting in self._waiting if waiting.stamp_ns < row.stamp_ns]
        self._waiting = [waiting for waiting in self._waiting if waiting.stamp_ns > row.stamp_ns]
        whole = self._whole
        if whole is None or row.stamp_ns > whole.stamp_ns:
            self._whole = row
        if not within or whole is None:
            return []
        if row.stamp_ns - whole.stamp_ns > LONGEST_STRETCH_NS:
            self._passed_over_ns += [waiting.stamp_ns for waiting in within]
            return []
        completed, self._whole = _solved([whole, *within, row], imu, self._calibration)
        return completed


class _Row(NamedTuple):
    stamp_ns: int
    velocity: Floats
    cov: Floats
    with_closed: Floats = np.zeros((3, 3))
    """S of equation (3), m^2/s: none where the row closed no stretch."""


def _solved(rows: list[_Row], imu: InertialRows, calibration: Calibration) -> tuple[list[_Row], _Row]:
    """All rows but the first and the last, completed, and the last with what it shares with them."""
    stamps_ns = np.array([row.stamp_ns for row in rows], dtype=np.int64)
    by = carry(imu, stamps_ns, calibration)
    y, P = _least_squares(rows, by, np.diff(stamps_ns) * 1e-9)
    weights_s = _weights(stamps_ns)
    first_weight_s = weights_s[0] * np.eye(3) + np.linalg.solve(rows[0].cov, rows[0].with_closed)
    completed = []
    for k in range(1, len(rows) - 1):
        R = by.rotation[k]
        shared = _shared(P, weights_s, first_weight_s, k)
        velocity = R.T @ (y[k] + by.velocity[k]) - by.from_lever[k]
        completed.append(_Row(rows[k].stamp_ns, velocity, _positive(R.T @ shared @ R)))
    R = by.rotation[-1]
    with_closed = np.einsum("akb,k->ab", P[-3:].reshape(3, -1, 3)[:, 1:-1], weights_s[1:-1])
    return completed, rows[-1]._replace(with_closed=R.T @ with_closed @ R)


def _least_squares(rows: list[_Row], by: Carry, intervals_s: Floats) -> tuple[Floats, Floats]:
    """Equation (1): y, shape (n, 3), and its joint covariance, shape (3n, 3n)."""
    n = len(rows)
    size = 3 * n + (3 if by.is_inertial else 0)
    information, vector = np.zeros((size, size)), np.zeros(size)
    for k, row in enumerate(rows):
        R, at = by.rotation[k], slice(3 * k, 3 * k + 3)
        measured = np.linalg.inv(R @ row.cov @ R.T)
        information[at, at] += measured
        vector[at] += measured @ (R @ (row.velocity + by.from_lever[k]) - by.velocity[k])
    for k, interval_s in enumerate(intervals_s.tolist()):
        step = np.zeros((3, size))
        step[:, 3 * k : 3 * k + 3], step[:, 3 * k + 3 : 3 * k + 6] = -np.eye(3), np.eye(3)
        if by.is_inertial:
            step[:, 3 * n :] = -interval_s * np.eye(3)
        information += step.T @ step / (by.walk_density**2 * interval_s)
    P = np.linalg.inv(information)
    y: Floats = (P @ vector)[: 3 * n].reshape(n, 3)
    return y, np.asarray(P[: 3 * n, : 3 * n])


def _weights(stamps_ns: Ints) -> Floats:
    """Half the intervals either side, seconds; the ends are taken to go on as they are."""
    intervals_s = np.diff(stamps_ns) * 1e-9
    return 0.5 * (np.concatenate([intervals_s[:1], intervals_s]) + np.concatenate([intervals_s, intervals_s[-1:]]))


def _shared(P: Floats, weights_s: Floats, first_weight_s: Floats, k: int) -> Floats:
    """Equations (2) and (3), axes of frame 0; the weight of row 0 is a matrix, since (3) is one more share of it."""
    with_all = P[3 * k : 3 * k + 3].reshape(3, -1, 3)
    once = np.einsum("ajb,j->ab", with_all[:, 1:-1], weights_s[1:-1])
    total = once + 2.0 * (with_all[:, 0] @ first_weight_s + weights_s[-1] * with_all[:, -1])
    return np.asarray(0.5 * (total + total.T) / weights_s[k])


def _positive(cov: Floats) -> Floats:
    """The nearest covariance: what rows share may leave a direction of one of them below zero."""
    variances, axes = np.linalg.eigh(cov)
    return np.asarray((axes * np.maximum(variances, 1e-12)) @ axes.T)
