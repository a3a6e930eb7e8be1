"""Motion of the body by gyros, accelerometers and Doppler log, as the reference of the other sensors.

Up is felt: with C the turn by the gyros alone, over a second ``C u = mean(C f) - d(C v)/dt``, normalised, so that no
bias of a gyro adds up. Yaw is the integral of the gyros' rate about it. With v the velocity of the body's origin and e
the level forward axis::

    z(t) = int u.v dt,    p(t) = int (v.e + i v.(u x e)) exp(i yaw) dt

Complex numbers stand for level vectors.
"""

from dataclasses import dataclass

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import NS_PER_S, Floats, Imu, Ints
from sonar_graph.navigation.alignment import InertialPath
from sonar_graph.sequence import Sequence

UP_OVER_S = 1.0
"""Time over which the felt direction of up is averaged."""


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Motion of the body's origin at the rows of the Doppler log."""

    origin_ns: int
    seconds: Floats
    """Since ``origin_ns``, shape (n,)."""
    up: Floats
    """Shape (n, 3), in the body."""
    velocity: Floats
    """Shape (n, 3), in the body, m/s."""
    yaw_rad: Floats
    """Shape (n,), since the first row."""
    height_m: Floats
    """Shape (n,), since the first row."""
    path_m: Floats
    """Complex, shape (n,), level, in axes that are the body's at the first row."""
    gap_s: float
    """Longest time between two rows that is no gap."""

    @classmethod
    def of(cls, sequence: Sequence) -> "BodyMotion | None":
        """Integrate over the common time of IMU and Doppler log; None where they have less than three rows."""
        imu, dvl, calibration = sequence.imu, sequence.dvl, sequence.calibration
        origin_ns = sequence.start_ns
        t = np.asarray((dvl.stamps_ns - origin_ns) / NS_PER_S, np.float64)
        body_R_imu = calibration.imu.mounting.pose().rotation().matrix()
        unbiased = imu.angular_velocity - calibration.imu.gyro_bias_rad_s
        path = InertialPath.of(
            Imu(
                imu.stamps_ns,
                unbiased @ body_R_imu.T,
                imu.specific_force @ body_R_imu.T,
            )
        )
        imu_s = path.seconds + (path.origin_ns - origin_ns) / NS_PER_S
        rate = path.rate
        rows = (
            (t >= imu_s[0]) & (t <= imu_s[-1]) & np.isfinite(dvl.velocity).all(axis=1)
        )
        rows[1:] &= np.diff(t) > 0
        t = t[rows]
        if len(t) < 3:
            return None
        is_held = calibration.odometry_interpolation == "hold-past"
        dvl_pose = calibration.dvl.mounting.pose()
        C = path.rotations_at(path.since_origin(dvl.stamps_ns[rows]))  # (n, 3, 3)
        v = dvl.velocity[rows] @ dvl_pose.rotation().matrix().T
        v = v - np.cross(columns_at(t, imu_s, rate), dvl_pose.translation())
        up = np.einsum(
            "nji,nj->ni",
            C,
            felt_up(path, t, imu_s, np.einsum("nij,nj->ni", C, v), calibration),
        )
        up_at_imu = np.einsum(
            "nji,nj->ni",
            path.rotations,
            columns_at(imu_s, t, np.einsum("nij,nj->ni", C, up)),
        )
        level = np.maximum(up_at_imu[:, 1] ** 2 + up_at_imu[:, 2] ** 2, 0.05)
        yaw_rate = (rate[:, 1] * up_at_imu[:, 1] + rate[:, 2] * up_at_imu[:, 2]) / level
        yaw_rad = np.asarray(
            np.interp(t, imu_s, integral(imu_s, yaw_rate, is_held=is_held)), np.float64
        )
        ahead = np.array([1.0, 0.0, 0.0]) - up[:, :1] * up
        ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1), 1e-9)[:, None]
        left = np.cross(up, ahead)
        level_v = np.sum(v * ahead, axis=1) + 1j * np.sum(v * left, axis=1)
        return cls(
            origin_ns,
            t,
            up,
            v,
            yaw_rad,
            integral(t, np.sum(v * up, axis=1), is_held=is_held),
            integral(t, level_v * np.exp(1j * yaw_rad), is_held=is_held),
            max(calibration.dvl.gap_s, 3.0 * float(np.median(np.diff(t)))),
        )

    def at(self, seconds: Floats, values: Floats) -> Floats:
        """Values of the rows at other times; NaN outside and in gaps."""
        after = np.clip(
            np.searchsorted(self.seconds, seconds), 1, len(self.seconds) - 1
        )
        is_gap = self.seconds[after] - self.seconds[after - 1] > self.gap_s
        is_outside = (seconds < self.seconds[0]) | (seconds > self.seconds[-1])
        found = np.interp(seconds, self.seconds, values)
        return np.where(is_gap | is_outside, np.nan, found)

    def since_origin(self, stamps_ns: Ints) -> Floats:
        """Seconds of stamps on this motion's axis."""
        return np.asarray((stamps_ns - self.origin_ns) / NS_PER_S)


def felt_up(
    path: InertialPath, t: Floats, imu_s: Floats, v: Floats, calibration: Calibration
) -> Floats:
    """Up in the frame of the path at times t, shape (n, 3); v is C v. The body's z without gravity in the forces."""
    if not (np.isfinite(path.impulse).all() and calibration.use_gravity):
        return np.asarray(
            path.rotations_at(np.clip(t - imu_s[0], 0.0, path.seconds[-1]))[:, :, 2]
        )
    begin = np.clip(t - UP_OVER_S / 2, imu_s[0], imu_s[-1])
    end = np.clip(t + UP_OVER_S / 2, imu_s[0], imu_s[-1])
    gained = columns_at(end, imu_s, path.impulse) - columns_at(
        begin, imu_s, path.impulse
    )
    up = gained / (end - begin)[:, None] - np.gradient(smoothed(t, v), t, axis=0)
    return np.asarray(up / np.maximum(np.linalg.norm(up, axis=1), 1e-9)[:, None])


def integral(t: Floats, values: Floats, *, is_held: bool = False) -> Floats:
    """Running integral from zero: by the trapezoid rule, or of values that hold for the time before them."""
    means = values[1:] if is_held else (values[1:] + values[:-1]) / 2
    steps = means * np.diff(t)
    return np.concatenate([np.zeros(1), np.cumsum(steps)])


def columns_at(at: Floats, t: Floats, values: Floats) -> Floats:
    """Columns of values at other times, linear in between."""
    return np.column_stack([np.interp(at, t, column) for column in values.T])


def means_about(at: Floats, t: Floats, values: Floats) -> Floats:
    """Means of columns over `UP_OVER_S` about other times."""
    total = np.column_stack([integral(t, column) for column in values.T])
    begin = np.clip(at - UP_OVER_S / 2, t[0], t[-1])
    end = np.clip(at + UP_OVER_S / 2, t[0], t[-1])
    span = np.maximum(end - begin, 1e-9)
    return (columns_at(end, t, total) - columns_at(begin, t, total)) / span[:, None]


def smoothed(t: Floats, values: Floats) -> Floats:
    """Columns averaged over `UP_OVER_S`, or as they are where rows are farther apart."""
    return (
        means_about(t, t, values) if np.median(np.diff(t)) < UP_OVER_S / 2 else values
    )
