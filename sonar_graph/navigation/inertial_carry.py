"""What gyros and accelerometers say of a velocity's course between Doppler rows, and how far it may be trusted.

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

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import compiled, rotation_exp
from sonar_graph.navigation.unmeasured_turns import UNFELT_NS, row_after_hole

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
