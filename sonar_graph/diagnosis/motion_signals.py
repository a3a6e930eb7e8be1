"""Motion of the body by gyros, accelerometers and Doppler log, as the reference of the other sensors.

Up is felt: with C the turn by the gyros alone, over a second ``C u = mean(C f) - d(C v)/dt``, normalised, so that no
bias of a gyro adds up. Yaw is the integral of the gyros' rate about it. With v the velocity of the body's origin and e
the level forward axis::

    z(t) = int u.v dt,    p(t) = int (v.e + i v.(u x e)) exp(i yaw) dt

Complex numbers stand for level vectors. The integrals mean nothing across a hole of the IMU or a gap of the Doppler
log: rows are numbered by the part without one that they belong to, and references are unknown between parts.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.diagnosis.signals import (
    Match,
    SignalStretch,
    Values,
    root_mean_square,
)
from sonar_graph.measurements import NS_PER_S, Floats, Imu, Ints
from sonar_graph.navigation.alignment import InertialPath, holes_before
from sonar_graph.numerics import columns_at, running_integral
from sonar_graph.sequence import Sequence

UP_OVER_S = 1.0
"""Time over which the felt direction of up is averaged."""
STRETCH_S = 120.0
"""Rows are compared over so long at a time; longer, a drift of the gyros would bend the path."""
FEWEST_ROWS = 6
GAP_INTERVALS = 2.5
"""Typical intervals of the Doppler log from which an interval is a gap: two rows are missing, whatever the jitter."""
LEAST_LEVEL = 0.05
"""Squared cosine of the pitch below which forward is not a level direction."""


@dataclass(frozen=True, eq=False)
class FeltMotion:
    """Vectors at the rows of the Doppler log in the frame of the gyros' path, C, shape (n, 3) each."""

    velocity_m_s: Floats
    """C v."""
    rate_rad_s: Floats
    """C w."""
    gravity_m_s2: Floats
    """``mean(C f) - d(C v)/dt``."""
    impulse_m_s: Floats
    """``int C f dt``."""
    windows: "Windows"
    """Over which the derivatives are taken."""


class Windows(NamedTuple):
    """A time about each row of the Doppler log, at least to its neighbours: the velocity is known best at rows."""

    begin_s: Floats
    end_s: Floats

    @classmethod
    def about(cls, t: Floats, parts: Ints) -> "Windows":
        """Windows of `UP_OVER_S` about times t, or longer, which end where a part does, shape (n,)."""
        first = t[np.searchsorted(parts, parts)]
        last = t[np.searchsorted(parts, parts, side="right") - 1]
        before = np.append(t[0], t[:-1])
        after = np.append(t[1:], t[-1])
        begin_s = np.minimum(t - UP_OVER_S / 2, before)
        end_s = np.maximum(t + UP_OVER_S / 2, after)
        return cls(np.maximum(begin_s, first), np.minimum(end_s, last))

    def rates(self, at: Callable[[Floats], Floats]) -> Floats:
        """Mean rates of change of a quantity, shape (n, 3); NaN for a row that is a part of its own."""
        duration_s = self.end_s - self.begin_s
        duration_s = np.where(duration_s > 0.0, duration_s, np.nan)
        return (at(self.end_s) - at(self.begin_s)) / duration_s[:, None]


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Motion of the body's origin at the rows of the Doppler log."""

    origin_ns: int
    seconds: Floats
    """Since ``origin_ns``, shape (n,)."""
    parts: Ints
    """Number of holes of the IMU and gaps of the Doppler log before each row, shape (n,)."""
    up: Floats
    """Shape (n, 3), in the body."""
    yaw_rad: Floats
    """Shape (n,), since the first row."""
    height_m: Floats
    """Shape (n,), since the first row."""
    path_m: Values
    """Complex, shape (n,), level, in axes that are the body's at the first row."""
    ahead_m: Floats
    """Way ahead, shape (n,), backwards negative, since the first row."""
    imu_s: Floats
    """Since ``origin_ns``, shape (m,), of the IMU's rows."""
    imu_yaw_rad: Floats
    """The yaw there, shape (m,)."""
    felt: "FeltMotion | None" = None
    """None without gravity in the forces."""

    @classmethod
    def of(cls, sequence: Sequence) -> "BodyMotion | None":
        """Integrate over the common time of IMU and Doppler log; None where they have less than three rows."""
        dvl = sequence.dvl
        calibration = sequence.calibration
        imu = sequence.imu
        body_R_imu = calibration.imu.mounting.rotation_matrix()
        unbiased = imu.angular_velocity - calibration.imu.gyro_bias_rad_s
        force = filled(imu.specific_force) - calibration.imu.accel_bias_m_s2
        force = force @ body_R_imu.T
        path = InertialPath.of(Imu(imu.stamps_ns, unbiased @ body_R_imu.T, force))
        t = path.since_origin(dvl.stamps_ns)  # (n,)
        rows = path.covers(t)
        # stamps may repeat: of such rows the first counts
        rows[1:] &= np.diff(t) > 0
        t = t[rows]
        if len(t) < 3:
            return None
        dvl_pose = calibration.dvl.mounting.pose()
        rate = path.linear_at(t, path.rate)  # (n, 3)
        v = dvl.velocity[rows] @ dvl_pose.rotation().matrix().T
        v = v - np.cross(rate, dvl_pose.translation())
        intervals = np.diff(t)
        longest_s = max(
            calibration.dvl.gap_s, GAP_INTERVALS * float(np.median(intervals))
        )
        # the one place where integrals break: every reference and stretch goes by these parts
        breaks = (intervals > longest_s) | (np.diff(path.parts_at(t)) > 0)
        parts = np.concatenate([[0], np.cumsum(breaks)])
        windows = Windows.about(t, parts)
        C = path.rotations_at(t)  # (n, 3, 3)
        velocity = np.einsum("nij,nj->ni", C, v)
        gravity = felt_gravity(path, t, velocity, windows, calibration)
        up_in_path = C[:, :, 2]
        felt = None
        if gravity is not None:
            size = np.maximum(np.linalg.norm(gravity, axis=1), 1e-9)
            up_in_path = gravity / size[:, None]
            rate_in_path = np.einsum("nij,nj->ni", C, rate)
            impulse = path.linear_at(t, path.impulse)
            felt = FeltMotion(velocity, rate_in_path, gravity, impulse, windows)
        up = np.einsum("nji,nj->ni", C, up_in_path)
        is_held = calibration.odometry_interpolation == "hold-past"
        # at the IMU's rate, since turns are faster than rows of the Doppler log
        yaw_at_imu = running_integral(
            path.seconds, yaw_rate(path, t, up_in_path), is_held=is_held
        )
        yaw_rad = np.interp(t, path.seconds, yaw_at_imu)
        ahead = np.array([1.0, 0.0, 0.0]) - up[:, :1] * up
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-9)[:, None]
        left = np.cross(up, ahead)
        level_v = np.sum(v * ahead, axis=1) + 1j * np.sum(v * left, axis=1)
        return cls(
            origin_ns=path.origin_ns,
            seconds=t,
            parts=parts,
            up=up,
            yaw_rad=np.asarray(yaw_rad, np.float64),
            height_m=running_integral(t, np.sum(v * up, axis=1), is_held=is_held),
            path_m=running_integral(t, level_v * np.exp(1j * yaw_rad), is_held=is_held),
            ahead_m=running_integral(t, level_v.real, is_held=is_held),
            imu_s=path.seconds,
            imu_yaw_rad=yaw_at_imu,
            felt=felt,
        )

    def turned(self, seconds: Floats) -> Floats:
        """Yaw at other times, by the IMU's rows: the Doppler log's may be slow; NaN as of `reference`."""
        known = self.reference(self.yaw_rad)(seconds)
        at_imu = np.interp(seconds, self.imu_s, self.imu_yaw_rad)
        return np.where(np.isnan(known), np.nan, at_imu)

    def reference(self, values: Values) -> Callable[[Floats], Values]:
        """Values of the rows at other times, linear; NaN outside and between parts."""

        def at(seconds: Floats) -> Values:
            row = np.searchsorted(self.seconds, seconds)
            after = np.clip(row, 1, len(self.seconds) - 1)
            is_between = self.parts[after] != self.parts[after - 1]
            # the first row of a part belongs to it
            is_between &= self.seconds[after] != seconds
            found = np.interp(seconds, self.seconds, values, left=np.nan, right=np.nan)
            return np.where(is_between, np.nan, found)

        return at

    def between_rows(self, found: Match, values: Values) -> Match:
        """A comparison with an integral of the Doppler log, `height_m` or `path_m`, with the errors by its interval T.

        Between rows the velocity counts as linear. The integral of a sine of frequency w is too small by ``(w T)^2 / 12``;
        ``(w T)^2`` is the ratio of second differences of the velocity and the velocity. A velocity that changes at once
        may do so at any time between two rows, ``T / sqrt(12)``; the fewer do, the less these errors average out.
        """
        interval_s = float(np.median(np.diff(self.seconds)))
        found = replace(found, interval_s=interval_s)
        velocity = np.asarray(np.diff(values) / np.diff(self.seconds), values.dtype)
        change = np.diff(velocity)
        bent = np.diff(change)
        inside = self.parts[3:] == self.parts[:-3]
        if not np.any(bent[inside]):
            return found
        squares = np.abs(bent[inside]) ** 2
        typical = float(np.sqrt(squares.mean()))
        scale_error = typical / (12.0 * max(root_mean_square([velocity]), 1e-9))
        sudden = min(typical / max(root_mean_square([change]), 1e-9), 1.0)
        count = squares.sum() ** 2 / np.sum(squares**2)
        late_s = interval_s * sudden / np.sqrt(12.0 * count)
        lag = replace(found.lag, sigma=float(np.hypot(found.lag.sigma, late_s)))
        return replace(found, lag=lag).less_certain(scale_error)

    def part_at(self, seconds: Floats) -> Ints:
        """Part of the last row before each instant, shape (n,)."""
        row = np.searchsorted(self.seconds, seconds, side="right") - 1
        return self.parts[np.maximum(row, 0)]

    def since_origin(self, stamps_ns: Ints) -> Floats:
        """Seconds of stamps on this motion's axis."""
        return (stamps_ns - self.origin_ns) / NS_PER_S

    def stretches(
        self,
        seconds: Floats,
        y: Values,
        reference: Callable[[Floats], Values],
        longest_s: float = STRETCH_S,
    ) -> list[SignalStretch]:
        """Rows of a sensor within each part, in stretches of at most ``longest_s``."""
        first = np.flatnonzero(np.diff(self.parts, prepend=-1))
        last = np.append(first[1:] - 1, len(self.parts) - 1)
        found = list[SignalStretch]()
        for begin, end in zip(self.seconds[first], self.seconds[last], strict=True):
            count = max(1, int(np.ceil((end - begin) / longest_s)))
            inside = np.flatnonzero((seconds >= begin) & (seconds <= end))
            share = (seconds[inside] - begin) / max(end - begin, 1e-9)
            which = np.minimum((share * count).astype(int), count - 1)
            stretches = (inside[which == part] for part in range(count))
            found += [
                SignalStretch(seconds[rows], y[rows], reference)
                for rows in stretches
                if len(rows) >= FEWEST_ROWS
            ]
        return found


def holes_beside(stamps_ns: Ints, seconds: Floats, at: Floats) -> tuple[Ints, Ints]:
    """Number of holes until the sample before each instant, and the one after it, shape (k,); in a hole they differ.

    ``stamps_ns`` and ``seconds``: the samples' stamps, also on the axis of the instants.
    """
    holes = holes_before(stamps_ns)
    before = np.searchsorted(seconds, at, side="right") - 1
    after = np.searchsorted(seconds, at)
    last = len(holes) - 1
    return holes[np.maximum(before, 0)], holes[np.minimum(after, last)]


def filled(values: Floats) -> Floats:
    """Rows, some of them not measured, shape (n, 3), with these linear between the others."""
    is_measured = np.isfinite(values).all(axis=1)
    if is_measured.all() or not is_measured.any():
        return values
    row = np.arange(len(values), dtype=np.float64)
    return columns_at(row, row[is_measured], values[is_measured])


def yaw_rate(path: InertialPath, t: Floats, up_in_path: Floats) -> Floats:
    """Rate about the vertical at the IMU's samples, shape (n,), rad/s, with up known at times t."""
    up_at_imu = columns_at(path.seconds, t, up_in_path)
    up = np.einsum("nji,nj->ni", path.rotations, up_at_imu)
    along = path.rate[:, 1] * up[:, 1] + path.rate[:, 2] * up[:, 2]
    return along / np.maximum(up[:, 1] ** 2 + up[:, 2] ** 2, LEAST_LEVEL)


def felt_gravity(
    path: InertialPath,
    t: Floats,
    v: Floats,
    windows: Windows,
    calibration: Calibration,
) -> Floats | None:
    """Gravity in the frame of the path at times t, shape (n, 3), upwards; v is C v. None without it in the forces."""
    if not (np.isfinite(path.impulse).all() and calibration.use_gravity):
        return None
    force = windows.rates(lambda at: path.linear_at(at, path.impulse))
    # what moves the vehicle is no gravity
    accelerated = windows.rates(lambda at: columns_at(at, t, v))
    gravity = force - accelerated
    return filled(gravity) if np.isfinite(gravity).any() else None
