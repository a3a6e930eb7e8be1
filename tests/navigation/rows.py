"""Rows of sensors along made-up motions, derivatives by differences, and dead reckoning step by step."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.navigation.odometry import Odometry

NS = 1_000_000_000
T0_NS = 1_700_000_000 * NS


def stamps(rate_hz: float, seconds: float, offset_s: float = 0.0) -> Ints:
    n = round(seconds * rate_hz) + 1
    return T0_NS + np.round((np.arange(n) / rate_hz + offset_s) * NS).astype(np.int64)


def at(seconds: float) -> int:
    return T0_NS + round(seconds * NS)


def imu(stamps_ns: Ints, rate: ArrayLike, force: ArrayLike = (0.0, 0.0, 9.80665)) -> Imu:
    shape = (len(stamps_ns), 3)
    return Imu(stamps_ns, np.broadcast_to(rate, shape).copy(), np.broadcast_to(force, shape).copy())


def dvl(stamps_ns: Ints, velocity: ArrayLike, cov: ArrayLike = np.nan) -> Dvl:
    n = len(stamps_ns)
    return Dvl(stamps_ns, np.broadcast_to(velocity, (n, 3)).copy(), np.broadcast_to(cov, (n, 3, 3)).copy())


def odometry_at_rest(*blocks: Dvl, calibration: Calibration | None = None) -> Odometry:
    """Told inertial rows of 90 s at rest, then blocks of the Doppler log."""
    odometry = Odometry(calibration or Calibration())
    odometry.add(imu(stamps(50, 90.0), 0.0), None)
    for block in blocks:
        odometry.add(None, block)
    return odometry


def waves(stamps_ns: Ints, seed: int, amplitude: float) -> Floats:
    """Three smooth components, periods of 1 s to 5 s, shape (n, 3)."""
    rng = np.random.default_rng(seed)
    t = (stamps_ns - T0_NS)[:, None] * 1e-9
    phase, period = rng.uniform(0, 2 * np.pi, (2, 3)), rng.uniform(1, 5, (2, 3))
    return amplitude * np.sin(2 * np.pi * t / period[0] + phase[0]) * np.cos(2 * np.pi * t / period[1] + phase[1])


class Steps(NamedTuple):
    """Constant rate and velocity over each of n steps, and the density of the velocity's noise."""

    duration_s: Floats
    rate: Floats
    velocity: Floats
    velocity_psd: Floats
    force: Floats


def steps_of(imu: Imu, dvl: Dvl, start_ns: int, end_ns: int, known_ns: int, hold_past: bool) -> Steps:
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
        t, knots = (middles - start_ns).astype(float), (stamps - start_ns).astype(float)
        return np.column_stack([np.interp(t, knots, column) for column in values.T])

    psd = np.zeros((len(middles), 3, 3))
    for n, k in enumerate(np.searchsorted(log.stamps_ns, middles).tolist()):
        last = min(k, len(log) - 1)
        ends = (last, last) if hold_past or k >= len(log) else (last, last - 1)
        if last > 0:
            psd[n] = np.diff(log.stamps_ns)[last - 1] * 1e-9 * log.velocity_cov[list(ends)].mean(axis=0)
    rate, force = (sampled(inertial.stamps_ns, c) for c in (inertial.angular_velocity, inertial.specific_force))
    return Steps(np.diff(cuts) * 1e-9, rate, sampled(log.stamps_ns, log.velocity), psd, force)


def dead_reckoned(steps: Steps, bias: Floats, lever: Floats) -> list[gtsam.Pose3]:
    """Poses after every step: a constant twist for each, by GTSAM's exponential."""
    poses = [gtsam.Pose3()]
    for dt, w, v in zip(steps.duration_s, steps.rate - bias, steps.velocity, strict=True):
        poses.append(poses[-1].compose(gtsam.Pose3.Expmap(dt * np.concatenate([w, v - np.cross(w, lever)]))))
    return poses


def derivative(function: Callable[[Floats], ArrayLike], size: int, step: float = 1e-6) -> Floats:
    """Central differences of a function at zero, one column an argument."""
    columns = [
        (np.asarray(function(step * axis)) - np.asarray(function(-step * axis))) / (2 * step) for axis in np.eye(size)
    ]
    return np.column_stack(columns)


def nees(errors: ArrayLike, covariance: Floats) -> Floats:
    """``e^T P^-1 e`` of errors (n, d) of one covariance."""
    return np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors)


def dense_covariance(steps: Steps, bias: Floats, lever: Floats, gyro_density: float) -> tuple[Floats, Floats]:
    """Covariance (6, 6) and bias derivative (6, 3) at the end, step by step with differentiated exponentials."""
    P, D = np.zeros((6, 6)), np.zeros((6, 3))
    poses = dead_reckoned(steps, bias, lever)
    for k, (before, after) in enumerate(pairwise(poses)):
        dt, w, v, motion = steps.duration_s[k], steps.rate[k] - bias, steps.velocity[k], before.between(after)

        def off(error: Floats, dt=dt, w=w, v=v, motion=motion) -> Floats:
            wrong = w + error[:3]
            twist = np.concatenate([wrong, v + error[3:] - np.cross(wrong, lever)])
            return gtsam.Pose3.Logmap(motion.inverse().compose(gtsam.Pose3.Expmap(dt * twist)))

        G = derivative(off, 6)
        Q = np.zeros((6, 6))
        Q[:3, :3], Q[3:, 3:] = np.eye(3) * gyro_density**2 / dt, steps.velocity_psd[k] / dt
        F = motion.inverse().AdjointMap()
        P, D = F @ P @ F.T + G @ Q @ G.T, F @ D - G[:, :3]
    return P, D


GYRO, ACCEL, SIGMA = 2e-3, 3e-3, 0.01
NO_RATE = np.zeros(3)

HELD: dict[str, tuple[float, float]] = {"zoh-previous": (0.0, 0.5), "zoh-current": (1.0, 1.0), "trapezoid": (0.5, 0.5)}
"""Rules that turn one velocity by one rotation: the later sample's share, and when the rotation is, in intervals."""


def random_rows(seed: int, seconds: float = 2.0, turn_rad_s: float = 0.8) -> tuple[Imu, Dvl]:
    """Brisk motion; stamps in no relation, uneven Doppler intervals, each sample with its own covariance."""
    rng = np.random.default_rng(seed)
    quick = stamps(50, seconds + 1.0, -0.5 + rng.uniform(0, 0.02))
    slow = T0_NS + np.sort(np.round(rng.uniform(0.05, seconds - 0.05, 7) * NS)).astype(np.int64)
    slow = np.concatenate([[T0_NS], slow, [T0_NS + round(seconds * NS)]])
    root = SIGMA * (np.eye(3) + 0.3 * rng.standard_normal((len(slow), 3, 3)))
    force = np.array([0.3, -0.2, 9.8]) + waves(quick, seed + 1, 1.0)
    velocity = np.array([0.5, 0.1, 0.0]) + waves(slow, seed + 2, 0.3)
    return imu(quick, waves(quick, seed, turn_rad_s), force), dvl(slow, velocity, root @ np.swapaxes(root, 1, 2))


@dataclass
class StepByStep:
    """Dead reckoning of R, v, p, s with their errors [theta (frame j), dv, dp, ds], one small step after the other."""

    R: Floats
    v: Floats
    p: Floats
    s: Floats
    P: Floats
    """Covariance of [theta_i, dv, dp, ds] and the errors of all Doppler samples."""

    def covariance(self) -> Floats:
        J = np.eye(len(self.P))[:12]
        J[:3, :3] = self.R.T
        return J @ self.P @ J.T


def step_by_step(
    imu: Imu, dvl: Dvl, rule: str, bias: Floats, earth: Floats = NO_RATE, accel_density: float = ACCEL
) -> StepByStep:
    """Each sample's error is a state of its own, so that none can be counted twice."""
    n, at = len(dvl), dvl.stamps_ns
    P = np.zeros((12 + 3 * n, 12 + 3 * n))
    for k in range(n):
        P[12 + 3 * k : 15 + 3 * k, 12 + 3 * k : 15 + 3 * k] = dvl.velocity_cov[k]
    state = StepByStep(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), P)
    inertial, (later, when) = rule == "inertial", HELD.get(rule, (0.0, 0.0))
    turns = at[:-1] + np.floor(when * np.diff(at)).astype(np.int64)
    within = imu.stamps_ns[(imu.stamps_ns > at[0]) & (imu.stamps_ns < at[-1])]
    cuts = np.unique(np.concatenate([at, within, turns]))
    half = np.gradient((at - T0_NS) * 1e-9) * np.where(np.isin(np.arange(n), [0, n - 1]), 0.5, 1.0)
    half[1:-1] = (at[2:] - at[:-2]) * 0.5e-9
    for t, until in pairwise(cuts):
        if inertial and t in at:
            add_sample(state, int(np.searchsorted(at, t)), dvl, half)
        step(state, imu, dvl, int(t), int(until), rule, bias, earth)
        state.P = state.P + white_force(len(state.P), (until - t) * 1e-9, accel_density)
        if rule in HELD and until in turns:
            add_interval(state, int(np.searchsorted(turns, until)), dvl, later)
    if inertial:
        add_sample(state, n - 1, dvl, half)
        state.s = state.s + state.p
        F = np.eye(len(state.P))
        F[9:12, 6:9] = np.eye(3)
        state.P = F @ state.P @ F.T
    return state


def hat(a: Floats) -> Floats:
    return gtsam.SO3.Hat(a)


def add_sample(state: StepByStep, k: int, dvl: Dvl, weight_s: Floats) -> None:
    turned, w = state.R @ dvl.velocity[k], weight_s[k]
    F = np.eye(len(state.P))
    F[9:12, :3], F[9:12, 3:6], F[9:12, 12 + 3 * k : 15 + 3 * k] = -w * hat(turned), -w * np.eye(3), w * state.R
    state.s, state.P = state.s + w * (turned - state.v), F @ state.P @ F.T


def add_interval(state: StepByStep, k: int, dvl: Dvl, later: float) -> None:
    """A whole interval's displacement by the rotation as it is now."""
    turned = (dvl.stamps_ns[k + 1] - dvl.stamps_ns[k]) * 1e-9 * state.R
    c = turned @ ((1 - later) * dvl.velocity[k] + later * dvl.velocity[k + 1])
    F = np.eye(len(state.P))
    F[9:12, :3] = -hat(c)
    F[9:12, 12 + 3 * k : 18 + 3 * k] = np.hstack([(1 - later) * turned, later * turned])
    state.s, state.P = state.s + c, F @ state.P @ F.T


def step(state: StepByStep, imu: Imu, dvl: Dvl, t: int, until: int, rule: str, bias: Floats, earth: Floats) -> None:
    dt, middle = (until - t) * 1e-9, t + (until - t) // 2 - T0_NS
    seconds = imu.stamps_ns - T0_NS
    rate = np.array([np.interp(middle, seconds, column) for column in imu.angular_velocity.T]) - bias[:3]
    rate = rate - state.R.T @ earth
    force = np.array([np.interp(middle, seconds, column) for column in imu.specific_force.T]) - bias[3:]
    A = np.zeros((8, 8))
    A[:3, :3], A[:3, 3], A[3, 4], A[:3, 5:] = hat(rate), force, 1.0, np.eye(3)
    E = expm(A * dt)
    a, b, G = state.R @ E[:3, 3], state.R @ E[:3, 4], state.R @ E[:3, 5:]
    F = np.eye(len(state.P))
    F[3:6, :3], F[6:9, :3], F[6:9, 3:6] = -hat(a), -hat(b), dt * np.eye(3)
    c = np.zeros(3)
    if rule in ("linear", "hold-previous"):
        k = int(np.searchsorted(dvl.stamps_ns, t, side="right")) - 1
        later = (middle + T0_NS - dvl.stamps_ns[k]) / (dvl.stamps_ns[k + 1] - dvl.stamps_ns[k])
        later = later if rule == "linear" else 0.0
        c = G @ ((1 - later) * dvl.velocity[k] + later * dvl.velocity[k + 1])
        F[9:12, :3] = -hat(c)
        F[9:12, 12 + 3 * k : 15 + 3 * k] = (1 - later) * G
        F[9:12, 15 + 3 * k : 18 + 3 * k] = later * G
    Q = np.zeros_like(state.P)
    Q[:3, :3] = np.eye(3) * GYRO**2 * dt / 2
    state.P = F @ (state.P + Q) @ F.T + Q
    state.p = state.p + dt * state.v + b
    state.v, state.s, state.R = state.v + a, state.s + c, state.R @ E[:3, :3]


def white_force(size: int, dt: float, density: float) -> Floats:
    """Covariance that a step's accelerometer noise adds to v and p."""
    W = np.zeros((size, size))
    W[3:6, 3:6], W[6:9, 6:9] = np.eye(3) * density**2 * dt, np.eye(3) * density**2 * dt**3 / 3
    W[3:6, 6:9] = W[6:9, 3:6] = np.eye(3) * density**2 * dt**2 / 2
    return W
