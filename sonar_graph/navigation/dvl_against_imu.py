"""Time offset, mounting, lever arm and scale of a Doppler log, from the accelerations that it shares with the IMU.

Between two Doppler samples the change of velocity is also what the accelerometers felt, less gravity. In the frame g of
`sonar_graph.navigation.inertial_path`, with the samples k at their stamps plus the offset tau::

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
Rows that leave a direction unmeasured (`sonar_graph.doppler_beams`) are left out; what remains may have gaps.
So are rows about holes of the IMU's, as far as an offset could carry them into one, and no stretch goes over a hole.
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
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.navigation.differenced_fit import Stretch, rate_noise_power
from sonar_graph.navigation.inertial_path import InertialPath
from sonar_graph.navigation.offset_search import RANGE_S, Estimate1D, OffsetFit, search_offset
from sonar_graph.navigation.velocity_covariances import is_partial

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


def _without_shared_noise(found: OffsetFit, stretches: list[Stretch]) -> OffsetFit:
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
) -> list[Stretch]:
    seconds = stamped_s + offset_s
    C, impulse = path.rotations_at(seconds), path.impulse_at(seconds)
    turning = C @ cross_matrices(path.rate_at(seconds))
    x = np.einsum("nij,nj->ni", C, velocity) - turning @ lever - impulse
    S, P = path.turned_time_at(seconds), path.tilted_impulse_at(seconds)
    return [_stretch(seconds[r], x[r], impulse[r], C[r], turning[r], S[r], P[r], lever) for r in runs]


def _stretch(
    seconds: Floats, x: Floats, impulse: Floats, C: Floats, turning: Floats, S: Floats, P: Floats, lever: Floats
) -> Stretch:
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


def _difference(level_R_g: Floats, seconds: Floats, x: Floats, A: Floats) -> Stretch:
    duration = np.diff(seconds)
    middle = seconds[:-1] + 0.5 * duration
    gravity = duration[:, None, None] * np.eye(3)
    return Stretch(
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
