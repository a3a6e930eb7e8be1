"""Time offset, mounting, lever arm and scale of a Doppler log, from the accelerations that it shares with the IMU.

The frame g is the IMU's own at its first sample. With C = g_R_imu, piecewise linear rates and the trapezoid rule::

    C <- C Exp((w_i + w_{i+1}) / 2 dt),    F(t) = int C f dt,    S(t) = int C dt,    P(t) = int [C f]x S dt,
    L(t) = int C [w]x f dt

Between two Doppler samples k, at their stamps plus the offset, velocity changes as the accelerometers measured::

    x_k = C_k (R v_k - w_k x l) - F_k
    x_{k+1} - x_k = -d(C R v) (s - 1) + d(C [R v]x) psi + d(C [w]x) dl - d(S) b + d(P - [C R v]x S) b_g
                    + d(L) tau + gamma T + gamma' T t

s scales the log's velocities, psi turns its mounting, dl corrects the lever arm l from IMU to log; b and b_g are the
biases of accelerometers and gyros; tau is how much later the filters of the gyros are than those of the accelerometers:
of a vehicle that rolls and circles, some milliseconds of it look like a pitch of the log by degrees. Gravity gamma and
its slow turning are fitted again every half minute. Rows of one or two beams and rows near holes of the IMU are left
out. Derivation and accuracy: docs/theory/sensor_check.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from sonar_graph.calibration import Calibration
from sonar_graph.devices import is_partial
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.navigation.alignment.at_rest import in_body_axes
from sonar_graph.navigation.alignment.time_offset import (
    RANGE_S,
    Estimate1D,
    SampleSeries,
    are_enough,
    search_offset,
)
from sonar_graph.navigation.imu_gaps import UNFELT_NS, row_after_hole
from sonar_graph.numerics import running_rotations


@dataclass(frozen=True, eq=False)
class InertialPath:
    """Attitude and velocity change by gyros and accelerometers alone, since the first sample.

    The integrals go on over a hole of the IMU, where they mean nothing: only what lies within one part, between two
    holes, can be compared.
    """

    seconds: Floats
    """Times of the samples since ``origin_ns``, shape (n,)."""
    origin_ns: int
    turns: Floats
    """Rotation vector from each sample to the next, shape (n - 1, 3), rad."""
    rotations: Floats
    """C, shape (n, 3, 3)."""
    impulse: Floats
    """F, shape (n, 3), m/s; NaN from the first sample on whose force was not measured."""
    turned_time: Floats
    """S, shape (n, 3, 3), s: derivative of F by the accelerometers' bias."""
    tilted_impulse: Floats
    """P, shape (n, 3, 3), m: minus the derivative of F by the gyros' bias."""
    delayed_impulse: Floats
    """L, shape (n, 3), m/s²: derivative of F by a delay of the gyros; by how much C v turns is left out."""
    rate: Floats
    """Angular rate as measured, shape (n, 3), rad/s."""
    parts: Ints
    """Number of holes before each sample, shape (n,)."""

    @classmethod
    def of(cls, imu: Imu) -> InertialPath:
        """Integrate; of samples with one stamp the first counts."""
        stamps, first = np.unique(imu.stamps_ns, return_index=True)
        seconds = (stamps - stamps[0]) * 1e-9
        rate = imu.angular_velocity[first]
        integrals = strapdown_integrals(seconds, rate, imu.specific_force[first])
        return cls(seconds, int(stamps[0]), *integrals, rate, holes_before(stamps))

    def since_origin(self, stamps_ns: Ints) -> Floats:
        """Seconds of other stamps on this path's axis, shape (k,)."""
        return np.asarray((stamps_ns - self.origin_ns) * 1e-9)

    def covers(self, seconds: Floats, margin_s: float = 0.0) -> NDArray[np.bool_]:
        """True where samples without a hole reach from a margin before an instant to a margin after it."""
        earliest = seconds - margin_s
        latest = seconds + margin_s
        inside = (earliest >= 0) & (latest <= self.seconds[-1])
        last_before = np.searchsorted(self.seconds, earliest, side="right") - 1
        first_after = np.searchsorted(self.seconds, latest)
        before = np.maximum(last_before, 0)
        after = np.minimum(first_after, len(self.seconds) - 1)
        return inside & (self.parts[before] == self.parts[after])

    def parts_at(self, seconds: Floats) -> Ints:
        """Number of holes that have ended before each instant, shape (k,)."""
        last_before = np.searchsorted(self.seconds, seconds, side="right") - 1
        return self.parts[np.maximum(last_before, 0)]

    def rotations_at(self, seconds: Floats) -> Floats:
        """C at instants within the samples, along the shortest arc between two, shape (k, 3, 3)."""
        row, share = self._between(seconds)
        since = Rotation.from_rotvec(share[:, None] * self.turns[row]).as_matrix()
        return self.rotations[row] @ since

    def linear_at(self, seconds: Floats, values: Floats) -> Floats:
        """One of the integrals, or any values at the samples, linear in between, shape (k, ...)."""
        row, share = self._between(seconds)
        before = values[row]
        share = share.reshape(-1, *[1] * (values.ndim - 1))
        return before + share * (values[row + 1] - before)

    def _between(self, seconds: Floats) -> tuple[Ints, Floats]:
        """Last sample before each instant, and the share of the way to the next one, shape (k,) both."""
        row = np.searchsorted(self.seconds, seconds) - 1
        row = np.minimum(np.maximum(row, 0), len(self.turns) - 1)
        begin_s = self.seconds[row]
        share = (seconds - begin_s) / (self.seconds[row + 1] - begin_s)
        return row, np.minimum(np.maximum(share, 0.0), 1.0)


def holes_before(stamps_ns: Ints) -> Ints:
    """Number of holes before each row, shape (n,)."""
    ends_hole = np.zeros(len(stamps_ns), dtype=np.int64)
    row = row_after_hole(stamps_ns, 0, len(stamps_ns) - 1, UNFELT_NS)
    while row >= 0:
        ends_hole[row] = 1
        row = row_after_hole(stamps_ns, row, len(stamps_ns) - 1, UNFELT_NS)
    return np.cumsum(ends_hole)


def strapdown_integrals(
    seconds: Floats, rate: Floats, force: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Turns between the samples, and C, F, S, P and L of the module's equations at every sample."""
    mean_rate = 0.5 * (rate[:-1] + rate[1:])
    turns = mean_rate * np.diff(seconds)[:, None]  # (n - 1, 3)
    from scipy.integrate import cumulative_trapezoid  # takes most of a second to load

    integral = partial(cumulative_trapezoid, x=seconds, axis=0, initial=0.0)
    C = running_rotations(turns)  # (n, 3, 3)
    felt = C @ force[:, :, None]
    F = integral(felt[:, :, 0])
    S = integral(C)
    P = integral(np.cross(felt, S, axis=1))
    turned = C @ np.cross(rate, force)[:, :, None]
    L = integral(turned[:, :, 0])
    return turns, C, F, S, P, L


STRETCH_S = 30.0
"""Gravity and its turning are fitted again after this time."""
MEAN_OVER_S = 1.0
"""Samples are averaged over this time: in shorter differences noise is larger than what the motion changes."""
LEAST_ROWS = 12
LARGEST_INTERVAL = 3.0
"""In usual intervals: a longer time between two samples ends a stretch."""
LEAST_STRETCHES = 2
PRIOR_SIGMAS = np.array(
    [1.0, 0.05, 0.05, 1.0, *[3.0] * 3, *[0.5] * 3, *[0.02] * 3, 0.005]
)
"""Scale; turn, rad, about x and y near the calibration's; lever arm, m; biases, m/s² and rad/s; delay of the gyros, s."""
# places among the parameters, after the offset
SCALE = 1
TURN = slice(2, 5)
LEVER = slice(5, 8)
ACCEL_BIAS = slice(8, 11)
GYRO_BIAS = slice(11, 14)
LARGEST_STEP_LEFT = 0.01
"""Of turn (rad), scale, gyro bias over a stretch (rad) and lever arm times a usual rate (m/s): below it, linearising
again changes nothing that matters."""
USUAL_RATE_RAD_S = 0.1
ROUNDS = 8
HOPELESS_AFTER = 3
"""Round after which the search ends where neither offset nor turn nor scale is known."""
# sigmas above which a number is reported as not known
OFFSET_LIMIT_S = 0.1
SURE = 4.5
"""Sigmas from which on a turn about x or y is none of the noise."""
TURN_LIMITS_RAD = np.radians([1.0, 1.0, 2.0])
"""About x and y the prior must not decide."""
SCALE_LIMIT = 0.02
LEVER_LIMIT_M = 0.25
ACCEL_BIAS_LIMIT_M_S2 = 0.05
GYRO_BIAS_LIMIT_RAD_S = 5e-3
NO_MANOEUVRES = "too little acceleration"
NO_TURNS = "too little turning"
Estimates3D = tuple[Estimate1D, ...]
"""Along x, y and z of the body."""


@dataclass(frozen=True)
class DvlMatch:
    """Corrections to a Doppler log's stamps, mounting and scale, and the biases of the IMU."""

    offset: Estimate1D
    """To be added to the log's stamps, s."""
    turn: Estimates3D
    """By which the mounting must be turned further: components of a rotation vector along the body's axes, rad."""
    scale: Estimate1D
    """Factor by which the log's velocities must be multiplied."""
    lever: Estimates3D
    """From the IMU to the log, body axes, m: the whole arm, not a correction."""
    accel_bias: Estimates3D
    """Body axes, m/s², beyond the calibration's; a vehicle that does not turn takes it for gravity."""
    gyro_bias: Estimates3D
    """Body axes, rad/s; includes the Earth's rotation along an axis that keeps its direction."""

    @classmethod
    def unknown(cls, reason: str) -> DvlMatch:
        """Nothing is known, for one reason."""
        nothing = Estimate1D.unknown(reason)
        along_axes = (nothing,) * 3
        return cls(nothing, along_axes, nothing, along_axes, along_axes, along_axes)


def match_dvl_to_imu(imu: Imu, dvl: Dvl, calibration: Calibration) -> DvlMatch:
    """Compare velocities with accelerations.

    Parameters
    ----------
    imu, dvl
        Rows of one run; without specific forces nothing is known.
    calibration
        Mountings as far as they are known; the turn found is on top of them.
    """
    if not np.isfinite(imu.specific_force).all():
        return DvlMatch.unknown("no accelerometers")
    imu = in_body_axes(imu, calibration)
    path = InertialPath.of(imu)
    seconds = path.since_origin(dvl.stamps_ns)
    inside = path.covers(seconds, RANGE_S) & ~is_partial(dvl.velocity_cov)
    body_R_dvl = calibration.dvl.mounting.pose().rotation().matrix()
    seconds = seconds[inside]
    velocity = dvl.velocity[inside] @ body_R_dvl.T  # (k, 3)
    stretches = stretches_of(seconds, path.parts_at(seconds))
    averaged = [Averaged.of(rows, seconds) for rows in stretches]
    runs = [run for run in averaged if run is not None]
    if len(averaged) < LEAST_STRETCHES:
        return DvlMatch.unknown(
            f"less than {LEAST_STRETCHES * STRETCH_S:g} s with both and no hole of the IMU"
        )
    lever = np.subtract(
        calibration.dvl.mounting.translation_m, calibration.imu.mounting.translation_m
    )
    turned_by = Rotation.identity()
    scale = 1.0
    gyro_bias = np.zeros(3)
    for done in range(1, ROUNDS + 1):
        # integrated again with the gyro bias found so far: the model is linearised about it
        path = InertialPath.of(
            Imu(imu.stamps_ns, imu.angular_velocity - gyro_bias, imu.specific_force)
        )
        turned = scale * turned_by.apply(velocity)
        line_up = partial(velocity_changes, path, seconds, turned, runs, lever)
        if not are_enough(line_up(0.0), PRIOR_SIGMAS):
            return DvlMatch.unknown("too few Doppler samples between gaps")
        # small matrices: threads of BLAS would only cost
        with threadpool_limits(1, user_api="blas"):
            found = search_offset(line_up, PRIOR_SIGMAS)
            found = found.without_shared_noise(line_up(found.offset_s), SCALE)
        parameters = found.fit.parameters
        sigma = np.sqrt(np.diag(found.covariance))
        turn = parameters[TURN]
        # a large turn leaves residuals that make its sigma large
        is_sure = (sigma[TURN] <= TURN_LIMITS_RAD) | (np.abs(turn) > SURE * sigma[TURN])
        # the yaw has no prior that matters
        turn = np.where(is_sure | [False, False, True], turn, 0.0)
        more = float(parameters[SCALE])
        drift = parameters[GYRO_BIAS]
        longer = np.where(sigma[LEVER] <= LEVER_LIMIT_M, parameters[LEVER], 0.0)
        turned_by = Rotation.from_rotvec(turn) * turned_by
        scale *= 1.0 + more
        gyro_bias = gyro_bias + drift
        lever = lever + longer
        # each in what it changes: rad or m/s
        step = [*turn, more, *(drift * STRETCH_S), *(longer * USUAL_RATE_RAD_S)]
        if np.linalg.norm(step) < LARGEST_STEP_LEFT:
            break
        is_known = (
            not found.reason
            or sigma[TURN][2] <= TURN_LIMITS_RAD[2]
            or sigma[SCALE] <= SCALE_LIMIT
        )
        if done >= HOPELESS_AFTER and not is_known:
            return DvlMatch.unknown(NO_MANOEUVRES)
    else:
        return DvlMatch.unknown(NO_MANOEUVRES)

    def along_axes(
        values: Floats, sigmas: Floats, limits: ArrayLike, reason: str
    ) -> Estimates3D:
        x, y, z = (
            Estimate1D(float(value), float(sigma)).limited(limit, reason)
            for value, sigma, limit in zip(
                values, sigmas, np.broadcast_to(limits, 3), strict=True
            )
        )
        return x, y, z

    return DvlMatch(
        found.offset().limited(OFFSET_LIMIT_S, NO_MANOEUVRES),
        along_axes(turned_by.as_rotvec(), sigma[TURN], TURN_LIMITS_RAD, NO_MANOEUVRES),
        Estimate1D(scale, float(sigma[SCALE])).limited(SCALE_LIMIT, NO_MANOEUVRES),
        along_axes(lever, sigma[LEVER], LEVER_LIMIT_M, NO_TURNS),
        along_axes(
            parameters[ACCEL_BIAS], sigma[ACCEL_BIAS], ACCEL_BIAS_LIMIT_M_S2, NO_TURNS
        ),
        along_axes(gyro_bias, sigma[GYRO_BIAS], GYRO_BIAS_LIMIT_RAD_S, NO_TURNS),
    )


def stretches_of(seconds: Floats, parts: Ints) -> Iterator[slice]:
    """Runs of samples of about half a minute, without a gap and within one part of the path, but for short ones."""
    intervals = np.diff(seconds)
    if not len(intervals):
        return
    usual = np.median(intervals)
    is_end = (intervals > LARGEST_INTERVAL * usual) | (np.diff(parts) > 0)
    ends = np.flatnonzero(is_end) + 1
    rows = max(LEAST_ROWS, round(STRETCH_S / max(usual, 1e-9)))
    for first, last in zip([0, *ends], [*ends, len(seconds)], strict=True):
        count = max(1, round((last - first - 1) / rows))
        edges = np.linspace(first, last - 1, count + 1).astype(int).tolist()
        for begin, end in pairwise(edges):
            if end - begin >= LEAST_ROWS:
                yield slice(begin, end + 1)


class Averaged(NamedTuple):
    """A run of samples, of which means are compared; the same at every offset."""

    rows: slice
    slow: Floats
    """Columns of gravity and its turning, shape (n, 3)."""
    by_slow: Floats
    """Their pseudoinverse, shape (3, n)."""
    together: int
    """Number of samples in a mean."""
    duration_s: Floats
    """Between two means, shape (m,)."""
    B: Floats
    """Derivatives by gravity and its turning, shape (m, 3, 6)."""

    @classmethod
    def of(cls, rows: slice, stamped_s: Floats) -> Self | None:
        """The run; None where it is too short for a difference of means."""
        since = stamped_s[rows] - stamped_s[rows].mean()
        # by the stamps as they are: moved stamps are rounded, and 2.5 rows a second would become 2 or 3
        interval_s = np.median(np.diff(stamped_s[rows]))
        together = max(1, round(MEAN_OVER_S / interval_s))
        t = means_over(since, together)
        if len(t) < 2:
            return None
        slow = np.vander(since, 3)
        duration = np.diff(t)
        gravity = duration[:, None, None] * np.eye(3)
        middle = t[:-1] + 0.5 * duration
        B = np.concatenate([gravity, middle[:, None, None] * gravity], axis=2)
        return cls(rows, slow, np.linalg.pinv(slow), together, duration, B)


def velocity_changes(
    path: InertialPath,
    stamped_s: Floats,
    velocity: Floats,
    runs: list[Averaged],
    lever: Floats,
    offset_s: float,
) -> list[SampleSeries]:
    """Differences of x over each run, with the stamps moved by an offset, and their derivatives.

    The velocities in the derivatives are those that the accelerometers carry on from a fit over the run. The log's own
    would bring their noise into the regression twice and shrink the scale (errors in variables). Axes are turned so
    that the third is the vertical, nearly: what the accelerometers felt over the run.
    """
    seconds = stamped_s + offset_s
    C = path.rotations_at(seconds)  # (n, 3, 3)
    F = path.linear_at(seconds, path.impulse)  # (n, 3)
    S = path.linear_at(seconds, path.turned_time)  # (n, 3, 3)
    P = path.linear_at(seconds, path.tilted_impulse)  # (n, 3, 3)
    L = path.linear_at(seconds, path.delayed_impulse)  # (n, 3)
    turning = C @ cross_matrices(path.linear_at(seconds, path.rate))  # C [w]x
    by_lever = turning @ lever
    x = (C @ velocity[:, :, None])[:, :, 0] - by_lever - F
    changes = []
    for run in runs:
        r = run.rows
        # gravity and its turning
        line = run.by_slow @ x[r]
        carried = F[r] + run.slow @ line + by_lever[r]  # C R v
        in_body = (carried[:, None, :] @ C[r])[:, 0]
        S_since = S[r] - S[r][0]
        F_since = F[r] - F[r][0]
        drifting = (
            P[r]
            - P[r][0]
            - cross_matrices(F_since) @ S[r][0]
            - cross_matrices(carried) @ S_since
        )
        # by scale, mounting, lever arm, both biases, delay: (n, 3, 14)
        columns = [
            -carried[:, :, None],
            C[r] @ cross_matrices(in_body),
            turning[r],
            -S_since,
            drifting,
            L[r][:, :, None],
        ]
        # the signs of the axes do not matter
        axes, _ = np.linalg.qr(F_since[-1:].T, "complete")
        level_R_g = axes.T[::-1]
        y = np.diff(means_over(x[r], run.together), axis=0) @ level_R_g.T
        means = means_over(np.concatenate(columns, axis=2), run.together)
        A = level_R_g @ np.diff(means, axis=0)
        walks = (True, True, False)
        changes.append(SampleSeries(y, A, run.B, run.duration_s, walks))
    return changes


def means_over(values: Floats, together: int) -> Floats:
    """Means of so many successive values, without an incomplete last mean, shape (n // together, ...)."""
    whole = len(values) // together
    parts = values[: whole * together].reshape(whole, together, *values.shape[1:])
    return parts.mean(axis=1)


def cross_matrices(vectors: Floats) -> Floats:
    """[v]x with ``[v]x w = v x w`` of each row, shape (n, 3, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
