"""Roll, pitch and gyro bias at the first sample of a moving vehicle, from accelerations shared with its Doppler log.

In the body's frame at the first IMU sample, with C, F, S and P of `sonar_graph.navigation.alignment.dvl_imu`, y the
Doppler
velocity at the IMU's point and u the world's up, velocity less what the accelerometers felt is a straight line::

    x_k = C_k y_k - F_k = v - g t_k u - S_k b_a + B_k b_g + E_k Omega + e_k
    B_k = P_k - [C_k y_k]x S_k - C_k [l]x,    E_k = Q_k - [C_k y_k]x t_k,    Q = int [C f]x t dt

b_a, b_g are the biases, l the lever arm from Doppler log to IMU, and Omega the Earth's rate, ``Omega sin(phi) u`` and a
level part of unknown direction (`sonar_graph.navigation.alignment.gravity`). v and u are free; biases and the level
part
have priors. The noise e holds the Doppler log's own with that of one rate at the lever arm, R, and steps of the IMU's
white noise in the intervals m before k, with variance a^2 dt and N^2 dt::

    cov(e_j, e_k) = R_k [j = k] + sum_{m <= j, k} dt_m (a^2 I + N^2 [x_j + F_m]x [x_k + F_m]x^T)

Least squares, linearised and integrated again with the bias found until it stays. Fine alignment with a velocity as the
reference: Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., 2013, chapter
5.6; K. R. Britting, Inertial Navigation Systems Analysis, 1971, chapter 9.

Left out: Doppler scale and mounting, the walk of the gyro bias, Coriolis acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.stats import chi2

from sonar_graph.calibration import Calibration
from sonar_graph.devices import in_numbers, is_partial
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.navigation.alignment.dvl_imu import InertialPath, cross_matrices, interpolated
from sonar_graph.navigation.alignment.gravity import (
    InitialTilt,
    angles_by_up,
    earth_up_and_level,
    in_body_axes,
    roll_and_pitch,
)
from sonar_graph.navigation.imu_gaps import UNFELT_NS, row_after_hole

FEWEST, SHORTEST_S, LONGEST_S = 10, 2.0, 60.0
"""Samples of the Doppler log, the time that they must span, and how much of it is used."""
FREE = 10.0
"""Sigma of what nothing is known of: velocity in m/s, tilt in rad."""
OBSERVED = 0.5
"""A bias is observed where its sigma fell below this share of the prior's."""
ROUNDS, LARGEST_STEP_LEFT = 10, 1e-5
"""Of tilt and of gyro bias over the stretch, rad."""
LARGEST_MISFIT, FALSE_ALARM = 2.25, 1e-6
"""Of chi-square over its mean, beyond chance."""
VELOCITY, TILT, GYRO, ACCEL, NORTH = slice(0, 3), slice(3, 5), slice(5, 8), slice(8, 11), slice(11, 13)


@dataclass(frozen=True, eq=False)
class _Doppler:
    """Samples in the frame of the path."""

    seconds: Floats
    turned: Floats
    """C y, shape (k, 3)."""
    x: Floats
    """C y - F."""
    lever: Floats
    """C [l]x, shape (k, 3, 3)."""
    R: Floats
    """Covariance of x by what is fresh in each sample, shape (k, 3, 3)."""

    @classmethod
    def along(cls, path: InertialPath, seconds: Floats, velocity: Floats, R: Floats, known: Calibration) -> _Doppler:
        """Velocities in body axes, taken to the IMU's point."""
        lever = np.subtract(known.imu.mounting.translation_m, known.dvl.mounting.translation_m)
        C = path.rotations_at(seconds)
        at_imu = velocity + np.cross(path.rate_at(seconds), lever)
        turned = np.einsum("kij,kj->ki", C, at_imu)
        skewed = C @ cross_matrices(lever[None])
        rate_variance = known.imu.gyro_noise_density**2 / float(np.median(np.diff(path.seconds)))
        by_rate = rate_variance * skewed @ skewed.transpose(0, 2, 1)
        return cls(seconds, turned, turned - path.impulse_at(seconds), skewed, C @ R @ C.transpose(0, 2, 1) + by_rate)


@dataclass(frozen=True, eq=False)
class _Fit:
    velocity: Floats
    up: Floats
    gyro_bias: Floats
    accel_bias: Floats
    north: Floats
    """Level part of the Earth's rate, shape (3,), rad/s."""


def align_in_motion(imu: Imu, dvl: Dvl, calibration: Calibration) -> InitialTilt:
    """Roll, pitch and gyro bias at the first IMU sample.

    Parameters
    ----------
    imu, dvl
        Of the same stretch; of more than a minute the first is used, and what is before the first hole of the IMU's
        rows. The vehicle may move or rest.
    calibration
        Densities, sigmas of both biases as priors, Doppler sigma where the log has none, mountings, gravity, latitude.

    Returns
    -------
    Where the stretch says nothing of a bias, its sigma is the prior's, and it is marked as not observed.

    Raises
    ------
    AlignmentError
        Where samples are too few, there is no accelerometer, or velocities and accelerations disagree.
    """
    imu = until_hole(in_body_axes(imu, calibration))
    seconds, velocity, R = _doppler_rows(imu, dvl, calibration)
    imu = imu.rows(imu.stamps_ns <= imu.stamps_ns[0] + round((LONGEST_S + 1.0) * 1e9))
    upward, _ = earth_up_and_level(calibration)
    path = InertialPath.of(imu)
    fit = _started(_Doppler.along(path, seconds, velocity, R, calibration))
    for _ in range(ROUNDS):
        path = _path_without(imu, fit.gyro_bias, upward * fit.up + fit.north, path.rotations)
        doppler = _Doppler.along(path, seconds, velocity, R, calibration)
        fit, covariance, step, misfit = _improved(fit, path, doppler, calibration)
        if step < LARGEST_STEP_LEFT:
            break
    _check_misfit(misfit, 3 * len(seconds))
    return _result(int(imu.stamps_ns[0]), fit, covariance, calibration)


def until_hole(imu: Imu) -> Imu:
    """The rows before the first hole, in which nobody knows how the vehicle turned."""
    row = row_after_hole(imu.stamps_ns, 0, len(imu) - 1, UNFELT_NS)
    return imu if row < 0 else imu.rows(slice(0, row))


def _doppler_rows(imu: Imu, dvl: Dvl, calibration: Calibration) -> tuple[Floats, Floats, Floats]:
    """Seconds since the first IMU row, velocity and its covariance in body axes, of whole rows within the IMU's."""
    seconds = (dvl.stamps_ns - imu.stamps_ns[0]) * 1e-9
    until = min(LONGEST_S, float(imu.stamps_ns[-1] - imu.stamps_ns[0]) * 1e-9)
    inside = (seconds >= 0.0) & (seconds <= until) & ~is_partial(dvl.velocity_cov)
    inside[1:] &= np.diff(dvl.stamps_ns) > 0
    seconds = seconds[inside]
    if len(seconds) < FEWEST or seconds[-1] - seconds[0] < SHORTEST_S:
        raise AlignmentError(
            f"alignment: {len(seconds)} Doppler samples beside the IMU; give {FEWEST} over {SHORTEST_S:g} s or more"
        )
    body_R_dvl = calibration.dvl.mounting.pose().rotation().matrix()
    default = np.diag(np.square(calibration.dvl.velocity_sigma_m_s))
    R = in_numbers(dvl.velocity_cov[inside], default)
    return seconds, dvl.velocity[inside] @ body_R_dvl.T, body_R_dvl @ R @ body_R_dvl.T


def _path_without(imu: Imu, bias: Floats, earth: Floats, rotations: Floats) -> InertialPath:
    """The path by rates less the bias and less the Earth's, turned into the body by the path before."""
    _, first = np.unique(imu.stamps_ns, return_index=True)
    imu = imu.rows(first)
    rate = imu.angular_velocity - bias - np.einsum("nji,j->ni", rotations, earth)
    return InertialPath.of(replace(imu, angular_velocity=rate))


def _started(doppler: _Doppler) -> _Fit:
    """A line through all, without any bias."""
    slope, velocity = np.polyfit(doppler.seconds, doppler.x, 1)
    nothing = np.zeros(3)
    return _Fit(velocity, -slope / np.linalg.norm(slope), nothing, nothing, nothing)


def _improved(
    fit: _Fit, path: InertialPath, doppler: _Doppler, calibration: Calibration
) -> tuple[_Fit, Floats, float, float]:
    """One Gauss-Newton step: the new fit, covariance of all parameters, what the step changed, chi-square before it."""
    upward, level = earth_up_and_level(calibration)
    sensors, g = calibration.imu, calibration.gravity_m_s2
    basis = _across(fit.up)
    sigma = np.repeat(
        [FREE, FREE, sensors.gyro_bias_sigma, sensors.accel_bias_sigma, level / np.sqrt(2)], [3, 2, 3, 3, 2]
    )
    H = _derivatives(path, doppler, basis, g, upward)
    t, S = doppler.seconds[:, None], path.turned_time_at(doppler.seconds)
    residual = doppler.x - (fit.velocity - g * t * fit.up - S @ fit.accel_bias)
    factor = cho_factor(_noise(path, doppler, calibration), lower=True)
    root = np.tril(factor[0])
    A = solve_triangular(root, H * sigma, lower=True)
    b = solve_triangular(root, residual.ravel(), lower=True)
    told = np.concatenate([np.zeros(5), fit.gyro_bias, fit.accel_bias, basis.T @ fit.north])
    told = np.divide(told, sigma, out=np.zeros_like(told), where=sigma > 0)
    information = cho_factor(A.T @ A + np.eye(len(sigma)))
    scaled = cho_solve(information, A.T @ b - told)
    step = sigma * scaled
    up = fit.up + basis @ step[TILT]
    new = _Fit(
        fit.velocity + step[VELOCITY],
        up / np.linalg.norm(up),
        fit.gyro_bias + step[GYRO],
        fit.accel_bias + step[ACCEL],
        basis @ (basis.T @ fit.north + step[NORTH]),
    )
    covariance = sigma[:, None] * cho_solve(information, np.diag(sigma))
    change = float(np.abs(step[TILT]).max() + np.abs(step[GYRO]).max() * doppler.seconds[-1])
    return new, covariance, change, float(np.sum((b - A @ scaled) ** 2))


def _across(up: Floats) -> Floats:
    """Two unit vectors across another, shape (3, 2)."""
    return np.asarray(np.linalg.svd(up[None])[2][1:].T)


def _derivatives(path: InertialPath, doppler: _Doppler, basis: Floats, g: float, upward: float) -> Floats:
    """Of all x by all parameters, shape (3 k, 13)."""
    t = doppler.seconds[:, None, None]
    S, turned = path.turned_time_at(doppler.seconds), cross_matrices(doppler.turned)
    by_gyro = path.tilted_impulse_at(doppler.seconds) - turned @ S - doppler.lever
    by_earth = interpolated(doppler.seconds, path.seconds, _earth_tilted(path)) - turned * t
    by_up = (-g * t * np.eye(3) + upward * by_earth) @ basis
    still = np.broadcast_to(np.eye(3), S.shape)
    return np.concatenate([still, by_up, by_gyro, -S, by_earth @ basis], axis=2).reshape(-1, 13)


def _earth_tilted(path: InertialPath) -> Floats:
    """``Q = int [C f]x t dt``, shape (n, 3, 3)."""
    middle = 0.5 * (path.seconds[1:] + path.seconds[:-1])
    steps = cross_matrices(np.diff(path.impulse, axis=0)) * middle[:, None, None]
    return np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])


def _noise(path: InertialPath, doppler: _Doppler, calibration: Calibration) -> Floats:
    """Covariance of all x, shape (3 k, 3 k)."""
    sensors, t = calibration.imu, doppler.seconds
    edges = np.concatenate([[0.0], t])
    before = t[:, None] >= t[None]  # the interval m ends at sample m
    dt = np.where(before, np.diff(edges)[None], 0.0)
    F = path.impulse_at(0.5 * (edges[1:] + edges[:-1]))
    arms = cross_matrices((doppler.x[:, None] + F[None]).reshape(-1, 3)).reshape(len(t), len(t), 3, 3)
    by_turn = (sensors.gyro_noise_density * np.sqrt(dt)[:, :, None, None] * arms).transpose(0, 2, 1, 3)
    by_turn = by_turn.reshape(3 * len(t), -1)
    force = np.kron(sensors.accel_noise_density**2 * np.minimum(t[:, None], t[None]), np.eye(3))
    own = np.zeros((len(t), 3, len(t), 3))
    own[np.arange(len(t)), :, np.arange(len(t)), :] = doppler.R
    return np.asarray(by_turn @ by_turn.T + force + own.reshape(force.shape))


def _check_misfit(misfit: float, count: int) -> None:
    freedom = count - 5
    if misfit > LARGEST_MISFIT * chi2.isf(FALSE_ALARM, freedom):
        ratio = np.sqrt(misfit / freedom)
        raise AlignmentError(
            f"alignment: velocities and accelerations differ {ratio:.1f} times more than their noise says; "
            "check mountings and stamps with `sonar-graph inspect`, and the densities in the calibration"
        )


def _result(stamp_ns: int, fit: _Fit, covariance: Floats, calibration: Calibration) -> InitialTilt:
    by_step = np.zeros((5, 13))
    by_step[:2, TILT] = angles_by_up(fit.up) @ _across(fit.up)
    by_step[2:, GYRO] = np.eye(3)
    joint = by_step @ covariance @ by_step.T
    observed = np.sqrt(np.diag(joint)[2:]) < OBSERVED * calibration.imu.gyro_bias_sigma
    return InitialTilt(stamp_ns, *roll_and_pitch(fit.up), fit.gyro_bias, joint, observed)
