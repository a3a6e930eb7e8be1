"""Velocities from one or two Doppler beams, completed by what precedes and follows them.

A row that leaves a direction unmeasured (`sonar_graph.devices.dvl_beams`) waits for the next whole one. Then all rows k
from the whole row 0 to the whole row m are solved together. With R the rotation by the gyros and F the velocity that
the accelerometers gain from rest, both in frame 0, the velocity of the IMU's point less F is a straight line whose
slope is gravity, but for a random walk::

    y_k = R_k z_k - F_k,    y_k+1 = y_k + g T_k + N(0, q^2 T_k I),    z_k ~ N(measured, cov_k)            (1)

Gravity g is unknown and constant. Where a specific force was not measured R = I, F = 0, g = 0, and q is that of
``velocity_walk_density``. Least squares gives y and its joint covariance P; completed rows are ``R_k^T (y_k + F_k)``.
Rows 0 and m stay as they are to the bit. Completed rows err together, whereas odometry takes each row's noise as white:
each is given what it shares with the others, by weights w of half the intervals either side, and what row 0 shares with
the rows that it closed before, S, so that ``sum w^2 cov`` is the variance of the summed displacement::

    cov_k = sum_j w_j / w_k (P_kj + P_jk) / 2,    counted twice for j = 0 and m, which keep their own      (2)
    cov_k += (P_k0 cov_0^-1 S + its transpose) / w_k,    next S = sum_k w_k R_m^T P_mk R_m               (3)

The walk over a stretch of T seconds, turned by phi in all, has for q^2 the sum of::

    accelerometer noise          s_a^2
    gyro noise, tilting g        (g s_g T)^2 / 12           its integral in mid-stretch, both ends known: T^3 / 48
    gyro bias, tilting g         (g b T)^2 T / 16           peak of the parabola between both ends
    a bias that turns            (b_a phi)^2 T / 16         the same

b includes the Earth's rotation. A partial row before the first whole one, late, or in a stretch longer than
`LONGEST_STRETCH_NS` is not used. docs/theory/beams.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.imu_gaps import UNFELT_NS, row_after_hole
from sonar_graph.navigation.samples import VelocityRow, VelocityRows
from sonar_graph.numerics import running_rotations

EARTH_RATE_RAD_S = 7.3e-5
LONGEST_STRETCH_NS = 60_000_000_000
"""Longest stretch that is solved: its size stays small, and no accelerometer carries a velocity longer."""


class InertialRows(NamedTuple):
    """Rows of the IMU in body axes; specific forces are NaN where not measured, and not used near holes."""

    stamps_ns: Ints
    rate: Floats
    specific_force: Floats

    def at(self, values: Floats, stamps_ns: Ints) -> Floats:
        """Values of these rows at other stamps: linear between rows, the nearest beyond them."""
        seconds = (stamps_ns - self.stamps_ns[0]) * 1e-9
        known_s = (self.stamps_ns - self.stamps_ns[0]) * 1e-9
        return np.column_stack(
            [np.interp(seconds, known_s, values[:, axis]) for axis in range(3)]
        )

    def around(self, first_ns: int, last_ns: int) -> InertialRows | None:
        """The rows for an interval, none after it; None where a force was not measured in it."""
        first = max(int(np.searchsorted(self.stamps_ns, first_ns, side="right")) - 1, 0)
        known = int(np.searchsorted(self.stamps_ns, last_ns, side="right"))
        rows = slice(first, known)
        within = InertialRows(
            self.stamps_ns[rows], self.rate[rows], self.specific_force[rows]
        )
        # what is a hole depends on intervals before the first of these rows as well
        with_hole = row_after_hole(self.stamps_ns, first, known - 1, UNFELT_NS) >= 0
        if (
            with_hole
            or not len(within.stamps_ns)
            or not np.isfinite(within.specific_force).all()
        ):
            return None
        return within


class Carry(NamedTuple):
    """Rotation and velocity gained by gyros and accelerometers at n Doppler rows, in the frame of the first."""

    rotation: Floats
    """R, shape (n, 3, 3)."""
    velocity: Floats
    """F, shape (n, 3), m/s."""
    from_lever: Floats
    """Velocity of the IMU's point less that of the Doppler log, axes of each row, shape (n, 3), m/s."""
    walk_density: float
    """q, m/s/√s."""
    is_inertial: bool
    """False where a force was not measured: R = I, F = 0, g = 0."""


def carry(imu: InertialRows, stamps_ns: Ints, calibration: Calibration) -> Carry:
    """Integrate from the first to each of the Doppler rows, with IMU rows stamped no later than the last."""
    n = len(stamps_ns)
    felt = imu.around(int(stamps_ns[0]), int(stamps_ns[-1]))
    if felt is None:
        # without forces the velocity walks as a vehicle's does
        still = np.tile(np.eye(3), (n, 1, 1))
        nothing = np.zeros((n, 3))
        return Carry(
            still, nothing, nothing, calibration.dvl.velocity_walk_density, False
        )
    times_ns = np.union1d(stamps_ns, felt.stamps_ns[felt.stamps_ns > stamps_ns[0]])
    # rates and forces are linear between rows, so that a step takes those in its middle
    middles_ns = times_ns[:-1] + np.diff(times_ns) // 2
    dt = (np.diff(times_ns) * 1e-9)[:, None]
    turns = felt.at(felt.rate, middles_ns) * dt
    gains = felt.at(felt.specific_force, middles_ns) * dt
    rotation = running_rotations(turns)
    in_middle = rotation[:-1] @ Rotation.from_rotvec(0.5 * turns).as_matrix()
    velocity = np.zeros((len(times_ns), 3))
    gained = in_middle @ gains[:, :, None]  # (steps, 3, 1)
    velocity[1:] = np.cumsum(gained[:, :, 0], axis=0)
    at = np.searchsorted(times_ns, stamps_ns)
    lever = np.subtract(
        calibration.imu.mounting.translation_m, calibration.dvl.mounting.translation_m
    )
    from_lever = np.cross(felt.at(felt.rate, stamps_ns), lever)
    stretch_s = float(stamps_ns[-1] - stamps_ns[0]) * 1e-9
    turned_rad = float(np.linalg.norm(turns, axis=1).sum())
    density = walk_density(calibration, stretch_s, turned_rad)
    return Carry(rotation[at], velocity[at], from_lever, density, True)


def walk_density(
    calibration: Calibration, stretch_s: float, turned_rad: float
) -> float:
    """Q of a stretch, m/s/√s, by the module's table."""
    sensors = calibration.imu
    bias2 = sensors.gyro_bias_sigma**2 + EARTH_RATE_RAD_S**2
    tilting = (
        sensors.gyro_noise_density**2 * stretch_s**2 / 12.0
        + bias2 * stretch_s**3 / 16.0
    )
    by_turning = (sensors.accel_bias_sigma * turned_rad) ** 2 * stretch_s / 16.0
    # a tilt adds a share of gravity to the velocity
    by_gyro = calibration.gravity_m_s2**2 * tilting
    return float(np.sqrt(sensors.accel_noise_density**2 + by_gyro + by_turning))


class PartialVelocities:
    """Completes rows in their order, one block after the other.

    ``calibration``: noise of the IMU, lever arms, and the walk of the vehicle's velocity.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._whole: VelocityRow | None = None
        """The newest whole row."""
        self._shared = np.zeros((3, 3))
        """S of equation (3), m²/s: what it shares with the rows that it closed; zero where it closed no stretch."""
        self._waiting: list[VelocityRow] = []
        self._not_used_ns: list[int] = []

    @property
    def not_completed_ns(self) -> list[int]:
        """Stamps of the rows that are not used, and of those that wait."""
        return [*self._not_used_ns, *(row.stamp_ns for row in self._waiting)]

    @property
    def is_waiting(self) -> bool:
        """True while a row waits for the next whole one."""
        return bool(self._waiting)

    def remember(self, rows: VelocityRows) -> None:
        """Remember rows that are all whole, while none waits: `completed` would return them as they are."""
        stamp_ns = int(rows.stamps_ns[-1])
        self._remember(VelocityRow(stamp_ns, rows.velocity[-1], rows.cov[-1]))

    def completed(
        self, rows: VelocityRows, is_partial: NDArray[np.bool_], imu: InertialRows
    ) -> VelocityRows:
        """The rows that can be used now, all with a whole velocity; they may be older than those given.

        Rows come in order and without NaN; ``is_partial`` marks those that leave a direction unmeasured, shape (n,).
        """
        usable: list[VelocityRow] = []
        for stamp_ns, velocity, cov, partial in zip(
            *rows, is_partial.tolist(), strict=True
        ):
            row = VelocityRow(int(stamp_ns), velocity, cov)
            newest = self._waiting[-1] if self._waiting else self._whole
            if not partial:
                usable += [*self.close_stretch(row, imu), row]
            elif newest is not None and row.stamp_ns > newest.stamp_ns:
                self._waiting.append(row)
            else:
                self._not_used_ns.append(row.stamp_ns)
        return VelocityRows.of(usable)

    def close_stretch(self, row: VelocityRow, imu: InertialRows) -> list[VelocityRow]:
        """The rows that waited for a whole one, completed."""
        within = [
            waiting for waiting in self._waiting if waiting.stamp_ns < row.stamp_ns
        ]
        self._waiting = [
            waiting for waiting in self._waiting if waiting.stamp_ns > row.stamp_ns
        ]
        whole = self._whole
        shared = self._shared
        self._remember(row)
        # rows before the first whole one cannot be completed
        if not within or whole is None:
            return []
        if row.stamp_ns - whole.stamp_ns > LONGEST_STRETCH_NS:
            self._not_used_ns += [waiting.stamp_ns for waiting in within]
            return []
        self._whole = row
        completed, self._shared = solve_stretch(
            [whole, *within, row], shared, imu, self._calibration
        )
        return completed

    def _remember(self, row: VelocityRow) -> None:
        """Make a whole row the newest one, unless it is older."""
        if self._whole is None or row.stamp_ns > self._whole.stamp_ns:
            self._whole = row
            self._shared = np.zeros((3, 3))


def solve_stretch(
    rows: list[VelocityRow], shared: Floats, imu: InertialRows, calibration: Calibration
) -> tuple[list[VelocityRow], Floats]:
    """All rows but the first and the last, completed, and S of the last; ``shared``: S of the first."""
    stamps_ns = np.array([row.stamp_ns for row in rows], dtype=np.int64)
    by = carry(imu, stamps_ns, calibration)
    intervals_s = np.diff(stamps_ns) * 1e-9
    y, P = least_squares(rows, by, intervals_s)
    # the intervals at the ends are taken to go on as they are
    before_s = np.r_[intervals_s[:1], intervals_s]
    after_s = np.r_[intervals_s, intervals_s[-1:]]
    w = 0.5 * (before_s + after_s)
    w_0 = w[0] * np.eye(3) + np.linalg.solve(rows[0].cov, shared)
    completed = []
    for k in range(1, len(rows) - 1):
        P_k = P[3 * k : 3 * k + 3].reshape(3, -1, 3)  # with all rows, (3, n, 3)
        once = np.einsum("ajb,j->ab", P_k[:, 1:-1], w[1:-1])
        with_ends = P_k[:, 0] @ w_0 + w[-1] * P_k[:, -1]
        total = once + 2.0 * with_ends
        cov_k = 0.5 * (total + total.T) / w[k]  # (2) and (3), axes of frame 0
        R = by.rotation[k]
        velocity = R.T @ (y[k] + by.velocity[k]) - by.from_lever[k]
        # sharing may leave a direction of one row below zero
        variances, axes = np.linalg.eigh(R.T @ cov_k @ R)
        cov = np.asarray((axes * np.maximum(variances, 1e-12)) @ axes.T)
        completed.append(VelocityRow(rows[k].stamp_ns, velocity, cov))
    R = by.rotation[-1]
    P_m = P[-3:].reshape(3, -1, 3)
    shared_next = np.einsum("akb,k->ab", P_m[:, 1:-1], w[1:-1])  # axes of frame 0
    return completed, R.T @ shared_next @ R


def least_squares(
    rows: list[VelocityRow], by: Carry, intervals_s: Floats
) -> tuple[Floats, Floats]:
    """Equation (1): y, shape (n, 3), and its joint covariance, shape (3n, 3n)."""
    n = len(rows)
    size = 3 * n + (3 if by.is_inertial else 0)
    information = np.zeros((size, size))
    vector = np.zeros(size)
    for k, row in enumerate(rows):
        R = by.rotation[k]
        at = slice(3 * k, 3 * k + 3)
        measured = np.linalg.inv(R @ row.cov @ R.T)
        information[at, at] += measured
        y_measured = R @ (row.velocity + by.from_lever[k]) - by.velocity[k]
        vector[at] += measured @ y_measured
    # y_k+1 - y_k - g T_k is a walk
    for k, interval_s in enumerate(intervals_s.tolist()):
        step = np.zeros((3, size))
        step[:, 3 * k : 3 * k + 3] = -np.eye(3)
        step[:, 3 * k + 3 : 3 * k + 6] = np.eye(3)
        if by.is_inertial:
            step[:, 3 * n :] = -interval_s * np.eye(3)
        information += step.T @ step / (by.walk_density**2 * interval_s)
    P = np.linalg.inv(information)
    y: Floats = (P @ vector)[: 3 * n].reshape(n, 3)
    return y, np.asarray(P[: 3 * n, : 3 * n])
