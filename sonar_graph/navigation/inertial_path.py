"""Attitude and velocity change by gyros and accelerometers alone, from the first sample on, at any instant.

The frame g is the IMU's own at its first sample. With C = g_R_imu, piecewise linear rates and the trapezoid rule::

    C <- C Exp((w_i + w_{i+1}) / 2 dt),    F(t) = int C f dt,    S(t) = int C dt,    P(t) = int [C f]x S dt

F is the change of velocity plus gravity's reaction, S what a constant accelerometer bias adds to it. A constant gyro
bias b turns C by ``Exp(S b)`` and adds ``-P b`` to F. Nothing here knows the world: which way is up is left to whoever
fits it.

In a hole of the samples (`sonar_graph.navigation.unmeasured_turns`) nobody knows how the body turned and what it felt.
The integrals go on over it, so that each part between two holes has a frame and beginnings of its own: only what lies
within one part can be compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.measurements import Floats, Imu, Ints
from sonar_graph.navigation.kernels import compiled, rotation_exp
from sonar_graph.navigation.unmeasured_turns import UNFELT_NS, row_after_hole


@dataclass(frozen=True, eq=False)
class InertialPath:
    """Integrals of one IMU's samples."""

    seconds: Floats
    """Of the samples since ``origin_ns``, shape (n,)."""
    origin_ns: int
    rotations: Floats
    """C, shape (n, 3, 3)."""
    impulse: Floats
    """F, shape (n, 3), m/s; NaN from the first sample on whose force was not measured."""
    turned_time: Floats
    """S, shape (n, 3, 3), s."""
    tilted_impulse: Floats
    """P, shape (n, 3, 3), m."""
    rate: Floats
    """Angular rate as measured, shape (n, 3), rad/s."""
    parts: Ints
    """How many holes came before each sample, shape (n,)."""

    @classmethod
    def of(cls, imu: Imu) -> InertialPath:
        """Integrate; of samples with one stamp the first counts."""
        stamps, first = np.unique(imu.stamps_ns, return_index=True)
        seconds = (stamps - stamps[0]) * 1e-9
        rate = imu.angular_velocity[first]
        integrals = _integrate(seconds, rate, imu.specific_force[first])
        return cls(seconds, int(stamps[0]), *integrals, rate, _parts(stamps))

    def since_origin(self, stamps_ns: Ints) -> Floats:
        """Seconds of other stamps on this path's axis, shape (k,)."""
        return np.asarray((stamps_ns - self.origin_ns) * 1e-9)

    def covers(self, seconds: Floats, margin_s: float = 0.0) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """About which instants samples reach so far either way without a hole."""
        earliest, latest = seconds - margin_s, seconds + margin_s
        inside = (earliest >= 0) & (latest <= self.seconds[-1])
        before = np.clip(np.searchsorted(self.seconds, earliest, side="right") - 1, 0, None)
        after = np.clip(np.searchsorted(self.seconds, latest), None, len(self.seconds) - 1)
        return np.asarray(inside & (self.parts[before] == self.parts[after]))

    def parts_at(self, seconds: Floats) -> Ints:
        """How many holes have ended before each instant, shape (k,)."""
        return np.asarray(self.parts[np.clip(np.searchsorted(self.seconds, seconds, side="right") - 1, 0, None)])

    def rotations_at(self, seconds: Floats) -> Floats:
        """C at instants within the samples, along the shortest arc between two, shape (k, 3, 3)."""
        after = np.clip(np.searchsorted(self.seconds, seconds), 1, len(self.seconds) - 1)
        share = (seconds - self.seconds[after - 1]) / (self.seconds[after] - self.seconds[after - 1])
        before = Rotation.from_matrix(self.rotations[after - 1])
        step = (before.inv() * Rotation.from_matrix(self.rotations[after])).as_rotvec()
        return np.asarray((before * Rotation.from_rotvec(share[:, None] * step)).as_matrix())

    def impulse_at(self, seconds: Floats) -> Floats:
        """F, shape (k, 3)."""
        return interpolated(seconds, self.seconds, self.impulse)

    def turned_time_at(self, seconds: Floats) -> Floats:
        """S, shape (k, 3, 3)."""
        return interpolated(seconds, self.seconds, self.turned_time)

    def tilted_impulse_at(self, seconds: Floats) -> Floats:
        """P, shape (k, 3, 3)."""
        return interpolated(seconds, self.seconds, self.tilted_impulse)

    def rate_at(self, seconds: Floats) -> Floats:
        """Angular rate, shape (k, 3)."""
        return interpolated(seconds, self.seconds, self.rate)


def _parts(stamps_ns: Ints) -> Ints:
    is_first = np.zeros(len(stamps_ns), dtype=np.int64)
    row = row_after_hole(stamps_ns, 0, len(stamps_ns) - 1, UNFELT_NS)
    while row >= 0:
        is_first[row] = 1
        row = row_after_hole(stamps_ns, row, len(stamps_ns) - 1, UNFELT_NS)
    return np.cumsum(is_first)


def interpolated(seconds: Floats, own_seconds: Floats, values: Floats) -> Floats:
    """Columns of shape (n, ...) linear between their instants, at other instants."""
    columns = values.reshape(len(values), -1)
    found = np.column_stack([np.interp(seconds, own_seconds, column) for column in columns.T])
    return found.reshape(len(seconds), *values.shape[1:])


@compiled
def _integrate(seconds: Floats, rate: Floats, force: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    n = len(seconds)
    rotations, impulse, turned, tilted = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    rotations[0] = np.eye(3)
    for i in range(1, n):
        half = 0.5 * (seconds[i] - seconds[i - 1])
        rotations[i] = rotations[i - 1] @ rotation_exp(half * (rate[i - 1] + rate[i]))
        before, after = rotations[i - 1] @ force[i - 1], rotations[i] @ force[i]
        impulse[i] = impulse[i - 1] + half * (before + after)
        turned[i] = turned[i - 1] + half * (rotations[i - 1] + rotations[i])
        for j in range(3):
            felt = np.cross(before, turned[i - 1, :, j]) + np.cross(after, turned[i, :, j])
            tilted[i, :, j] = tilted[i - 1, :, j] + half * felt
    return rotations, impulse, turned, tilted
