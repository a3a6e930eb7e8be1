"""Rows of sensors along made-up motions, derivatives by differences, and dead reckoning step by step."""

from functools import partial
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.navigation import Odometry
from sonar_graph.testing.numerical import central_differences

NS = 1_000_000_000
T0_NS = 1_700_000_000 * NS


def stamps(rate_hz: float, seconds: float, offset_s: float = 0.0) -> Ints:
    n = round(seconds * rate_hz) + 1
    return T0_NS + np.round((np.arange(n) / rate_hz + offset_s) * NS).astype(np.int64)


def at(seconds: float) -> int:
    return T0_NS + round(seconds * NS)


def imu(
    stamps_ns: Ints, rate: ArrayLike, force: ArrayLike = (0.0, 0.0, 9.80665)
) -> Imu:
    shape = (len(stamps_ns), 3)
    return Imu(
        stamps_ns,
        np.broadcast_to(rate, shape).copy(),
        np.broadcast_to(force, shape).copy(),
    )


def dvl(stamps_ns: Ints, velocity: ArrayLike, cov: ArrayLike = np.nan) -> Dvl:
    n = len(stamps_ns)
    return Dvl(
        stamps_ns,
        np.broadcast_to(velocity, (n, 3)).copy(),
        np.broadcast_to(cov, (n, 3, 3)).copy(),
    )


def odometry_at_rest(*blocks: Dvl, calibration: Calibration | None = None) -> Odometry:
    """Given inertial rows of 90 s at rest, then blocks of the Doppler log."""
    odometry = Odometry(calibration or Calibration())
    odometry.add(imu(stamps(50, 90.0), 0.0), None)
    for block in blocks:
        odometry.add(None, block)
    return odometry


def waves(stamps_ns: Ints, seed: int, amplitude: float) -> Floats:
    """Three smooth components, periods of 1 s to 5 s, shape (n, 3)."""
    rng = np.random.default_rng(seed)
    t = (stamps_ns - T0_NS)[:, None] * 1e-9
    phase = rng.uniform(0, 2 * np.pi, (2, 3))
    period = rng.uniform(1, 5, (2, 3))
    return (
        amplitude
        * np.sin(2 * np.pi * t / period[0] + phase[0])
        * np.cos(2 * np.pi * t / period[1] + phase[1])
    )


class Steps(NamedTuple):
    """Constant rate and velocity over each of n steps, and the density of the velocity's noise."""

    duration_s: Floats
    rate: Floats
    velocity: Floats
    velocity_psd: Floats
    force: Floats


def steps_of(
    imu: Imu, dvl: Dvl, start_ns: int, end_ns: int, known_ns: int, hold_past: bool
) -> Steps:
    """Cut at every known stamp of either sensor, by numpy's interpolation at the middles.

    Doppler noise: half of either end's covariance over the interval about a step; past the rows that of the last one.
    """
    inertial, log = (rows.between(0, known_ns) for rows in (imu, dvl))
    cuts = np.concatenate([inertial.stamps_ns, log.stamps_ns])
    cuts = np.unique(np.r_[start_ns, end_ns, cuts[(cuts > start_ns) & (cuts < end_ns)]])
    middles = cuts[:-1] + np.diff(cuts) // 2

    def sampled(stamps: Ints, values: Floats) -> Floats:
        if hold_past:
            return values[np.minimum(np.searchsorted(stamps, middles), len(stamps) - 1)]
        t = (middles - start_ns).astype(float)
        knots = (stamps - start_ns).astype(float)
        return np.column_stack([np.interp(t, knots, column) for column in values.T])

    psd = np.zeros((len(middles), 3, 3))
    for n, k in enumerate(np.searchsorted(log.stamps_ns, middles).tolist()):
        last = min(k, len(log) - 1)
        ends = (last, last) if hold_past or k >= len(log) else (last, last - 1)
        if last > 0:
            psd[n] = (
                np.diff(log.stamps_ns)[last - 1]
                * 1e-9
                * log.velocity_cov[list(ends)].mean(axis=0)
            )
    rate, force = (
        sampled(inertial.stamps_ns, c)
        for c in (inertial.angular_velocity, inertial.specific_force)
    )
    return Steps(
        np.diff(cuts) * 1e-9, rate, sampled(log.stamps_ns, log.velocity), psd, force
    )


def carried(dt: float, w: Floats, v: Floats, lever: Floats) -> gtsam.Pose3:
    """Motion of a constant twist, by GTSAM's exponential; w and v at a lever arm."""
    return gtsam.Pose3.Expmap(dt * np.concatenate([w, v - np.cross(w, lever)]))


def dead_reckoned(steps: Steps, bias: Floats, lever: Floats) -> list[gtsam.Pose3]:
    """Poses after every step."""
    poses = [gtsam.Pose3()]
    for dt, w, v in zip(
        steps.duration_s, steps.rate - bias, steps.velocity, strict=True
    ):
        poses.append(poses[-1].compose(carried(dt, w, v, lever)))
    return poses


def missed(dt: float, w: Floats, v: Floats, lever: Floats, error: Floats) -> Floats:
    """Difference in a step by errors of rate and velocity."""
    right = carried(dt, w, v, lever)
    wrong = carried(dt, w + error[:3], v + error[3:], lever)
    return gtsam.Pose3.Logmap(right.between(wrong))


def dense_covariance(
    steps: Steps, bias: Floats, lever: Floats, gyro_density: float
) -> tuple[Floats, Floats]:
    """Covariance (6, 6) and bias derivative (6, 3) at the end, step by step with differentiated exponentials."""
    P = np.zeros((6, 6))
    D = np.zeros((6, 3))
    for dt, w, v, psd in zip(
        steps.duration_s,
        steps.rate - bias,
        steps.velocity,
        steps.velocity_psd,
        strict=True,
    ):
        G = central_differences(partial(missed, dt, w, v, lever), np.zeros(6))
        Q = block_diag(np.eye(3) * gyro_density**2 / dt, psd / dt)
        F = carried(dt, w, v, lever).inverse().AdjointMap()
        P = F @ P @ F.T + G @ Q @ G.T
        D = F @ D - G[:, :3]
    return P, D
