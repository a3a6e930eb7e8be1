"""Time offset, mounting, lever arm and scale of a Doppler log, from the accelerations that it shares with the IMU.

Between two Doppler samples the change of velocity is also what the accelerometers felt, less gravity. In the frame g of
`sonar_graph.navigation.alignment.dvl_imu`, with the samples k at their stamps plus the offset tau::

    x_k     = C_k (R v_k - w_k x l) - F_k
    x_{k+1} - x_k = -d(C R v) (s - 1) + d(C [R v]x) psi + d(C [w]x) dl - d(S) b + d(P - [C R v]x S) b_g
                    + gamma T + gamma' T t

s is the factor on the log's velocities, psi a small turn of its mounting (``Exp(psi) R``), dl a correction to the
lever arm l from the IMU to the log, b and b_g the biases of accelerometers and gyros. Gravity and its slow turning,
which stands for tilt and the Earth's rotation, are fitted anew every half minute. A gyro bias turns gravity along a
straight line only while the body keeps its heading: left to gamma', what it does in turns, the same in every stretch,
would go into psi and s, whose intervals know nothing of it. The offset acts through the change of the velocity as the
body sees it: ``d/dtau x = -C dv/dt`` and a constant. Straight and steady driving says nothing of it. The lever arm
acts in turns alone, and along their axis not at all; the gyro bias shows where gravity is seen from changing headings.

The velocities that multiply s and psi are those that the accelerometers carry on from a fit over the stretch. The log's
own would bring their noise into the regression twice, which shrinks s towards nothing (errors in variables). The
accelerometers' noise, which is then in both sides, makes s too large by an amount that is known, and taken off again.
Rows that leave a direction unmeasured (`sonar_graph.devices.dvl_beams`) are left out; what remains may have gaps.
So are rows about holes of the IMU's, as far as an offset could carry them into one, and no stretch goes over a hole.

Attitude and velocity change by gyros and accelerometers alone, from the first sample on, at any instant.

The frame g is the IMU's own at its first sample. With C = g_R_imu, piecewise linear rates and the trapezoid rule::

    C <- C Exp((w_i + w_{i+1}) / 2 dt),    F(t) = int C f dt,    S(t) = int C dt,    P(t) = int [C f]x S dt

F is the change of velocity plus gravity's reaction, S what a constant accelerometer bias adds to it. A constant gyro
bias b turns C by ``Exp(S b)`` and adds ``-P b`` to F. Nothing here knows the world: which way is up is left to whoever
fits it.

In a hole of the samples (`sonar_graph.navigation.imu_gaps`) nobody knows how the body turned and what it felt.
The integrals go on over it, so that each part between two holes has a frame and beginnings of its own: only what lies
within one part can be compared.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from sonar_graph.calibration import Calibration
from sonar_graph.devices import is_partial
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.navigation.alignment.time_offset import (
    RANGE_S,
    Estimate1D,
    OffsetFit,
    SampleSeries,
    rate_noise_power,
    search_offset,
)
from sonar_graph.navigation.imu_gaps import UNFELT_NS, row_after_hole
from sonar_graph.numerics import compiled, rotation_exp


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


STRETCH_S = 30.0
"""Gravity and its turning are fitted anew after so long."""
MEAN_OVER_S = 1.0
"""Samples are averaged over so long: in shorter differences noise is larger than what the motion changes."""
LEAST_ROWS = 12
LARGEST_INTERVAL = 3.0
"""Times the usual one: a longer time between two samples ends a stretch."""
LEAST_STRETCHES = 2
PRIOR_SIGMAS = np.array([1.0, 0.05, 0.05, 1.0, *[3.0] * 3, *[0.5] * 3, *[0.02] * 3])
"""Scale; turn, rad, about x and y near what the calibration says; lever arm, m; biases, m/s² and rad/s."""
SCALE, YAW, LEVER, GYRO_BIAS = 1, 4, slice(5, 8), slice(11, 14)
"""Places among the parameters, after the offset."""
LARGEST_STEP_LEFT = 0.01
"""Of turn (rad), scale, gyro bias over a stretch (rad) and lever arm times a usual rate (m/s): linearising again then
changes nothing that matters."""
USUAL_RATE_RAD_S = 0.1
ROUNDS, HOPELESS_AFTER = 8, 3
"""At most, and after how many a log is given up that tells neither offset nor turn nor scale."""
OFFSET_LIMIT_S, YAW_LIMIT_RAD, SCALE_LIMIT = 0.1, np.radians(2.0), 0.02
LEVER_LIMIT_M, GYRO_BIAS_LIMIT_RAD_S = 0.25, 5e-3
"""What is less certain than this is said not to be told."""
NO_MANOEUVRES = "too little acceleration"
NO_TURNS = "too little turning"
Estimates3D = tuple[Estimate1D, Estimate1D, Estimate1D]
"""Along x, y and z of the body."""


@dataclass(frozen=True)
class DvlMatch:
    """What a Doppler log's readings say about its stamps, its mounting, its scale, and the gyros."""

    offset: Estimate1D
    """To be added to its stamps, s."""
    yaw: Estimate1D
    """To be added to the mounting's yaw, about the body's z axis, rad."""
    scale: Estimate1D
    """Factor by which its velocities must be multiplied."""
    lever: Estimates3D
    """From the IMU to the log, body axes, m: the whole arm, not a correction."""
    gyro_bias: Estimates3D
    """Body axes, rad/s; the Earth's rotation along an axis that keeps its direction is in it."""


def match_dvl_to_imu(imu: Imu, dvl: Dvl, calibration: Calibration) -> DvlMatch:
    """Compare velocities with accelerations.

    Parameters
    ----------
    imu, dvl
        Of one run; the IMU with specific forces, else nothing can be told.
    calibration
        Mountings as far as they are known; the yaw found is on top of them.
    """
    if not np.isfinite(imu.specific_force).all():
        return _unknown("no accelerometers")
    imu = _in_body_axes(imu, calibration)
    path = InertialPath.of(imu)
    seconds = path.since_origin(dvl.stamps_ns)
    inside = path.covers(seconds, RANGE_S) & ~is_partial(dvl.velocity_cov)
    body_R_dvl = calibration.dvl.mounting.pose().rotation().matrix()
    seconds, velocity = seconds[inside], dvl.velocity[inside] @ body_R_dvl.T
    runs = list(stretches_of(seconds, path.parts_at(seconds)))
    if len(runs) < LEAST_STRETCHES:
        return _unknown(f"less than {LEAST_STRETCHES * STRETCH_S:g} s with both and no hole of the IMU")
    lever = np.subtract(calibration.dvl.mounting.translation_m, calibration.imu.mounting.translation_m)
    with threadpool_limits(1, user_api="blas"):
        return _matched(imu, seconds, velocity, runs, lever)


def _matched(imu: Imu, seconds: Floats, velocity: Floats, runs: list[slice], lever: Floats) -> DvlMatch:
    yaw, scale, gyro_bias = 0.0, 1.0, np.zeros(3)
    for done in range(1, ROUNDS + 1):
        path = InertialPath.of(Imu(imu.stamps_ns, imu.angular_velocity - gyro_bias, imu.specific_force))
        turned = scale * Rotation.from_rotvec([0.0, 0.0, yaw]).apply(velocity)
        line_up = partial(_line_up, path, seconds, turned, runs, lever)
        found = search_offset(line_up, PRIOR_SIGMAS)
        found = _without_shared_noise(found, line_up(found.offset_s))
        (more, turn), drift = found.fit.parameters[[SCALE, YAW]].tolist(), found.fit.parameters[GYRO_BIAS]
        sigma = np.sqrt(np.diag(found.fit.covariance))
        longer = np.where(sigma[LEVER] <= LEVER_LIMIT_M, found.fit.parameters[LEVER], 0.0)
        yaw, scale, gyro_bias, lever = yaw + turn, scale * (1.0 + more), gyro_bias + drift, lever + longer
        if np.linalg.norm([turn, more, *(drift * STRETCH_S), *(longer * USUAL_RATE_RAD_S)]) < LARGEST_STEP_LEFT:
            break
        is_told = not found.reason or sigma[YAW] <= YAW_LIMIT_RAD or sigma[SCALE] <= SCALE_LIMIT
        if done >= HOPELESS_AFTER and not is_told:
            return _unknown(NO_MANOEUVRES)
    else:
        return _unknown(NO_MANOEUVRES)
    return DvlMatch(
        found.offset().limited(OFFSET_LIMIT_S, NO_MANOEUVRES),
        Estimate1D(yaw, float(sigma[YAW])).limited(YAW_LIMIT_RAD, NO_MANOEUVRES),
        Estimate1D(scale, float(sigma[SCALE])).limited(SCALE_LIMIT, NO_MANOEUVRES),
        _along_axes(lever, sigma[LEVER], LEVER_LIMIT_M),
        _along_axes(gyro_bias, sigma[GYRO_BIAS], GYRO_BIAS_LIMIT_RAD_S),
    )


def _along_axes(values: Floats, sigmas: Floats, limit: float) -> Estimates3D:
    x, y, z = (Estimate1D(float(values[i]), float(sigmas[i])).limited(limit, NO_TURNS) for i in range(3))
    return x, y, z


def _without_shared_noise(found: OffsetFit, stretches: list[SampleSeries]) -> OffsetFit:
    """The noise of the IMU, in the differences and in what multiplies the scale alike, adds a known amount to all."""
    shift = found.fit.covariance[:, SCALE] * rate_noise_power(stretches, found.fit.ratios)
    fit = replace(found.fit, parameters=found.fit.parameters - shift)
    return replace(found, fit=fit, offset_s=found.offset_s - float(shift[0]))


def _unknown(reason: str) -> DvlMatch:
    nothing = Estimate1D(np.nan, np.inf, reason)
    return DvlMatch(nothing, nothing, nothing, (nothing,) * 3, (nothing,) * 3)


def _in_body_axes(imu: Imu, calibration: Calibration) -> Imu:
    body_R_imu = calibration.imu.mounting.pose().rotation().matrix()
    return Imu(imu.stamps_ns, imu.angular_velocity @ body_R_imu.T, imu.specific_force @ body_R_imu.T)


def stretches_of(seconds: Floats, parts: Ints) -> Iterator[slice]:
    """Runs of samples without a gap, of one part of the path, about half a minute each.

    Shorter ones with too few samples are left out.
    """
    intervals = np.diff(seconds)
    if not len(intervals):
        return
    usual = float(np.median(intervals))
    ends = np.flatnonzero((intervals > LARGEST_INTERVAL * usual) | (np.diff(parts) > 0)) + 1
    rows = max(LEAST_ROWS, round(STRETCH_S / max(usual, 1e-9)))
    for first, last in zip([0, *ends], [*ends, len(seconds)], strict=True):
        count = max(1, round((last - first - 1) / rows))
        edges = np.linspace(first, last - 1, count + 1).astype(int).tolist()
        for begin, end in pairwise(edges):
            if end - begin >= LEAST_ROWS:
                yield slice(begin, end + 1)


def _line_up(
    path: InertialPath, stamped_s: Floats, velocity: Floats, runs: list[slice], lever: Floats, offset_s: float
) -> list[SampleSeries]:
    seconds = stamped_s + offset_s
    C, impulse = path.rotations_at(seconds), path.impulse_at(seconds)
    turning = C @ cross_matrices(path.rate_at(seconds))
    x = np.einsum("nij,nj->ni", C, velocity) - turning @ lever - impulse
    S, P = path.turned_time_at(seconds), path.tilted_impulse_at(seconds)
    return [_stretch(seconds[r], x[r], impulse[r], C[r], turning[r], S[r], P[r], lever) for r in runs]


def _stretch(
    seconds: Floats, x: Floats, impulse: Floats, C: Floats, turning: Floats, S: Floats, P: Floats, lever: Floats
) -> SampleSeries:
    """Differences of x; their derivatives are taken at the velocity that the IMU carries on, which is free of noise."""
    since = seconds - seconds.mean()
    slow = np.vander(since, 3)
    carried = impulse + slow @ np.linalg.lstsq(slow, x, rcond=None)[0] + turning @ lever
    in_body = np.einsum("nji,nj->ni", C, carried)
    since_first = S - S[0]
    drifting = P - P[0] - cross_matrices(impulse - impulse[0]) @ S[0] - cross_matrices(carried) @ since_first
    A = np.concatenate([-carried[:, :, None], C @ cross_matrices(in_body), turning, -since_first, drifting], axis=2)
    together = max(1, round(MEAN_OVER_S / float(np.median(np.diff(since)))))
    return _difference(_levelling(impulse), *(mean_of_successive(values, together) for values in (since, x, A)))


def _difference(level_R_g: Floats, seconds: Floats, x: Floats, A: Floats) -> SampleSeries:
    duration = np.diff(seconds)
    middle = seconds[:-1] + 0.5 * duration
    gravity = duration[:, None, None] * np.eye(3)
    return SampleSeries(
        np.diff(x, axis=0) @ level_R_g.T,
        level_R_g @ np.diff(A, axis=0),
        np.concatenate([gravity, middle[:, None, None] * gravity], axis=2),
        duration,
        walks=(True, True, False),
    )


def _levelling(impulse: Floats) -> Floats:
    """Rotation from g to axes whose third is what the accelerometers felt over a stretch: the vertical, nearly."""
    vertical = impulse[-1] - impulse[0]
    return np.asarray(Rotation.align_vectors([[0.0, 0.0, 1.0]], vertical[None])[0].as_matrix())


def mean_of_successive(values: Floats, count: int) -> Floats:
    """Means of so many rows at a time; what is left over at the end is left out."""
    whole = len(values) // count
    return np.asarray(values[: whole * count].reshape(whole, count, *values.shape[1:]).mean(axis=1))


def cross_matrices(vectors: Floats) -> Floats:
    """[v]x with ``[v]x w = v x w`` of each row, shape (n, 3, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
