"""Roll, pitch and gyro bias at the first sample of a moving vehicle, from accelerations shared with its Doppler log.

In the body's frame at the first IMU sample, with C, F, S and P of `InertialPath`, y the Doppler velocity at the IMU's
point and u the world's up, velocity less what the accelerometers gained is a straight line::

    x_k = C_k y_k - F_k = v - g t_k u - S_k b_a + B_k b_g + E_k Omega + e_k
    B_k = P_k - [C_k y_k]x S_k - C_k [l]x,    E_k = Q_k - [C_k y_k]x t_k,    Q = int [C f]x t dt

b_a and b_g are the biases, l the lever arm from Doppler log to IMU, Omega the Earth's rate: ``Omega sin(phi) u`` and a
level part of unknown direction. v and u are free; biases and the level part have priors. Least squares, linearised and
integrated again with the bias found until it stays. The noise e holds that of each Doppler sample with that of one rate
at the lever arm, R, and the IMU's white noise in the intervals m before k::

    cov(e_j, e_k) = R_k [j = k] + sum_{m <= j, k} dt_m (a^2 I + N^2 [x_j + F_m]x [x_k + F_m]x^T)

Left out: Doppler scale and mounting, the walk of the gyro bias, Coriolis acceleration. docs/theory/alignment.md; fine
alignment with a velocity as reference: Groves, 2nd ed., 2013, chapter 5.6; Britting, Inertial Navigation Systems
Analysis, 1971, chapter 9.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from sonar_graph.calibration import Calibration
from sonar_graph.devices import is_partial
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.navigation.alignment.at_rest import (
    InitialTilt,
    angles_by_up,
    earth_up_and_level,
    in_body_axes,
    roll_and_pitch,
)
from sonar_graph.navigation.alignment.dvl_imu import InertialPath, cross_matrices
from sonar_graph.navigation.imu_gaps import UNFELT_NS, row_after_hole
from sonar_graph.navigation.samples import in_numbers
from sonar_graph.numerics import chi_square_exceeded

MOST_ROWS = 600
"""Doppler rows, at most: ten a second for a minute."""
FEWEST = 10
"""Fewest samples of the Doppler log."""
SHORTEST_S = 2.0
"""Least time that they span."""
LONGEST_S = 60.0
"""Longest time that is used."""
FREE = 10.0
"""Prior sigma of velocity (m/s) and tilt (rad), so wide that it does not matter."""
OBSERVED = 0.5
"""A bias is observed where its sigma fell below this share of the prior's."""
ROUNDS = 10
LARGEST_STEP_LEFT = 1e-5
"""Step of tilt and of gyro bias over the stretch (rad) after which the rounds end."""
LARGEST_MISFIT = 2.25
"""Largest chi-square over its mean, beyond chance."""
FALSE_ALARM = 1e-6
# places among the 13 parameters
VELOCITY = slice(0, 3)
TILT = slice(3, 5)
GYRO = slice(5, 8)
ACCEL = slice(8, 11)
NORTH = slice(11, 13)


@dataclass(frozen=True, eq=False)
class DopplerOnPath:
    """Doppler samples at the IMU's point, in the frame of the path."""

    seconds: Floats
    turned: Floats
    """C y, shape (k, 3)."""
    x: Floats
    """C y - F, shape (k, 3)."""
    lever: Floats
    """C [l]x, shape (k, 3, 3)."""
    R: Floats
    """Covariance of x by the noise that is fresh in each sample, shape (k, 3, 3)."""

    @classmethod
    def of(
        cls,
        path: InertialPath,
        seconds: Floats,
        velocity: Floats,
        R: Floats,
        known: Calibration,
    ) -> DopplerOnPath:
        """Take velocities in body axes and their covariances R to the IMU's point and into the path's frame."""
        lever = np.subtract(
            known.imu.mounting.translation_m, known.dvl.mounting.translation_m
        )
        C = path.rotations_at(seconds)  # (k, 3, 3)
        at_imu = velocity + np.cross(path.linear_at(seconds, path.rate), lever)
        turned = np.einsum("kij,kj->ki", C, at_imu)
        skewed = C @ cross_matrices(lever[None])
        rate_variance = known.imu.gyro_noise_density**2 / np.median(
            np.diff(path.seconds)
        )
        R = C @ R @ C.transpose(0, 2, 1)
        R += rate_variance * skewed @ skewed.transpose(0, 2, 1)
        return cls(
            seconds, turned, turned - path.linear_at(seconds, path.impulse), skewed, R
        )


@dataclass(frozen=True, eq=False)
class AlignmentState:
    """The 13 parameters, those of a direction as vectors of shape (3,)."""

    velocity: Floats
    up: Floats
    gyro_bias: Floats
    accel_bias: Floats
    north: Floats
    """Level part of the Earth's rate, rad/s."""


def align_in_motion(imu: Imu, dvl: Dvl, calibration: Calibration) -> InitialTilt:
    """Roll, pitch and gyro bias at the first IMU sample of a vehicle that may move.

    Parameters
    ----------
    imu, dvl
        Rows of the same stretch; at most the first minute is used, and nothing after the first hole of the IMU.
    calibration
        Densities, sigmas of both biases as priors, Doppler sigma where the log has none, mountings, gravity, latitude.

    Returns
    -------
    InitialTilt
        A bias that the stretch does not determine has the prior's sigma and is marked as not observed.

    Raises
    ------
    AlignmentError
        Where samples are too few, there is no accelerometer, or velocities and accelerations disagree.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.calibration import Calibration
    >>> from sonar_graph.measurements import Dvl, Imu
    >>> from sonar_graph.navigation.alignment import (align_in_motion)
    >>> force = np.tile([0.0, 9.80665 * np.sin(0.1), 9.80665 * np.cos(0.1)], (500, 1))
    >>> imu = Imu(np.arange(500) * 10_000_000, np.zeros((500, 3)), force)
    >>> dvl = Dvl(np.arange(25) * 200_000_000, np.tile([1.0, 0.0, 0.0], (25, 1)), np.full((25, 3, 3), np.nan))
    >>> tilt = align_in_motion(imu, dvl, Calibration())
    >>> round(tilt.roll_rad, 6), tilt.bias_is_observed.shape
    (0.1, (3,))
    """
    imu = until_hole(in_body_axes(imu, calibration))
    seconds, velocity, R = whole_doppler_rows(imu, dvl, calibration)
    last_ns = imu.stamps_ns[0] + round((LONGEST_S + 1.0) * 1e9)
    imu = imu.rows(imu.stamps_ns <= last_ns)
    upward, _ = earth_up_and_level(calibration)
    path = InertialPath.of(imu)
    doppler = DopplerOnPath.of(path, seconds, velocity, R, calibration)
    slope, level = np.polyfit(doppler.seconds, doppler.x, 1)
    nothing = np.zeros(3)
    state = AlignmentState(
        level, -slope / np.linalg.norm(slope), nothing, nothing, nothing
    )
    once = imu.rows(np.unique(imu.stamps_ns, return_index=True)[1])
    for _ in range(ROUNDS):
        earth = np.einsum("nji,j->ni", path.rotations, upward * state.up + state.north)
        unbiased = once.angular_velocity - state.gyro_bias - earth
        path = InertialPath.of(replace(once, angular_velocity=unbiased))
        doppler = DopplerOnPath.of(path, seconds, velocity, R, calibration)
        state, covariance, step, misfit = gauss_newton_step(
            state, path, doppler, calibration
        )
        if step < LARGEST_STEP_LEFT:
            break
    freedom = 3 * len(seconds) - 5
    if misfit > LARGEST_MISFIT * chi_square_exceeded(FALSE_ALARM, freedom):
        times = float(np.sqrt(misfit / freedom))
        raise AlignmentError(
            f"alignment: velocities and accelerations differ {times:.1f} times more than their noise says; check "
            "mountings and stamps with `sonar-graph inspect`, and the densities in the calibration",
            times,
        )
    by_step = np.zeros((5, 13))
    by_step[:2, TILT] = angles_by_up(state.up) @ _across(state.up)
    by_step[2:, GYRO] = np.eye(3)
    joint = by_step @ covariance @ by_step.T
    observed = np.sqrt(np.diag(joint)[2:]) < OBSERVED * calibration.imu.gyro_bias_sigma
    roll, pitch = roll_and_pitch(state.up)
    return InitialTilt(
        int(imu.stamps_ns[0]), roll, pitch, state.gyro_bias, joint, observed
    )


def until_hole(imu: Imu) -> Imu:
    """The rows before the first hole, in which the turn of the vehicle is not known."""
    row = row_after_hole(imu.stamps_ns, 0, len(imu) - 1, UNFELT_NS)
    return imu if row < 0 else imu.rows(slice(0, row))


def whole_doppler_rows(
    imu: Imu, dvl: Dvl, calibration: Calibration
) -> tuple[Floats, Floats, Floats]:
    """Seconds since the first IMU row, velocity and its covariance in body axes, of whole rows within the IMU's."""
    seconds = (dvl.stamps_ns - imu.stamps_ns[0]) * 1e-9
    until = min(LONGEST_S, float(imu.stamps_ns[-1] - imu.stamps_ns[0]) * 1e-9)
    inside = (seconds >= 0.0) & (seconds <= until) & ~is_partial(dvl.velocity_cov)
    inside[1:] &= np.diff(dvl.stamps_ns) > 0
    rows = np.flatnonzero(inside)
    # every second, third, ... one of a fast log: all errors of all rows have one covariance
    rows = rows[:: -(-max(len(rows), 1) // MOST_ROWS)]
    seconds = seconds[rows]
    if len(seconds) < FEWEST or seconds[-1] - seconds[0] < SHORTEST_S:
        raise AlignmentError(
            f"alignment: {len(seconds)} Doppler samples beside the IMU; give {FEWEST} over {SHORTEST_S:g} s or more"
        )
    body_R_dvl = calibration.dvl.mounting.pose().rotation().matrix()
    default = np.diag(np.square(calibration.dvl.velocity_sigma_m_s))
    R = in_numbers(dvl.velocity_cov[rows], default)
    velocity = dvl.velocity[rows] @ body_R_dvl.T
    return seconds, velocity, body_R_dvl @ R @ body_R_dvl.T


def gauss_newton_step(
    state: AlignmentState,
    path: InertialPath,
    doppler: DopplerOnPath,
    calibration: Calibration,
) -> tuple[AlignmentState, Floats, float, float]:
    """The next state, the covariance of all parameters, the size of the step, and chi-square before it."""
    upward, level = earth_up_and_level(calibration)
    sensors = calibration.imu
    g = calibration.gravity_m_s2
    basis = _across(state.up)  # (3, 2)
    prior_sigmas = [
        FREE,
        FREE,
        sensors.gyro_bias_sigma,
        sensors.accel_bias_sigma,
        level / np.sqrt(2),
    ]
    sigma = np.repeat(prior_sigmas, [3, 2, 3, 3, 2])  # (13,)
    t = doppler.seconds[:, None]  # (k, 1)
    S = path.linear_at(doppler.seconds, path.turned_time)
    middle = 0.5 * (path.seconds[1:] + path.seconds[:-1])
    Q_steps = cross_matrices(np.diff(path.impulse, axis=0)) * middle[:, None, None]
    Q = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(Q_steps, axis=0)])
    turned = cross_matrices(doppler.turned)
    by_gyro = (
        path.linear_at(doppler.seconds, path.tilted_impulse)
        - turned @ S
        - doppler.lever
    )
    by_earth = path.linear_at(doppler.seconds, Q) - turned * t[:, None]
    by_up = (-g * t[:, None] * np.eye(3) + upward * by_earth) @ basis
    still = np.broadcast_to(np.eye(3), S.shape)
    # (3 k, 13)
    H = np.concatenate([still, by_up, by_gyro, -S, by_earth @ basis], axis=2).reshape(
        -1, 13
    )
    residual = doppler.x - (state.velocity - g * t * state.up - S @ state.accel_bias)
    factor = cho_factor(noise_covariance(path, doppler, calibration), lower=True)
    root = np.tril(factor[0])
    # whitened, and by parameters in units of their prior sigmas: a sigma of zero holds one at zero
    A = solve_triangular(root, H * sigma, lower=True)
    b = solve_triangular(root, residual.ravel(), lower=True)
    north = basis.T @ state.north
    prior = np.concatenate([np.zeros(5), state.gyro_bias, state.accel_bias, north])
    prior = np.divide(prior, sigma, out=np.zeros_like(prior), where=sigma > 0)
    information = cho_factor(A.T @ A + np.eye(len(sigma)))
    scaled = cho_solve(information, A.T @ b - prior)
    step = sigma * scaled
    up = state.up + basis @ step[TILT]
    new = AlignmentState(
        state.velocity + step[VELOCITY],
        up / np.linalg.norm(up),
        state.gyro_bias + step[GYRO],
        state.accel_bias + step[ACCEL],
        basis @ (basis.T @ state.north + step[NORTH]),
    )
    covariance = sigma[:, None] * cho_solve(information, np.diag(sigma))
    tilted = np.abs(step[TILT]).max()
    turned_rad = np.abs(step[GYRO]).max() * doppler.seconds[-1]
    chi_square = np.sum((b - A @ scaled) ** 2)
    return new, covariance, tilted + turned_rad, chi_square


def _across(up: Floats) -> Floats:
    """Two unit vectors across another, shape (3, 2)."""
    return np.linalg.svd(up[None])[2][1:].T


def noise_covariance(
    path: InertialPath, doppler: DopplerOnPath, calibration: Calibration
) -> Floats:
    """Covariance of all e of the module's equations, shape (3 k, 3 k)."""
    sensors = calibration.imu
    t = doppler.seconds
    edges = np.concatenate([[0.0], t])
    before = t[:, None] >= t[None]  # the interval m ends at sample m
    dt = np.where(before, np.diff(edges)[None], 0.0)
    F = path.linear_at(0.5 * (edges[1:] + edges[:-1]), path.impulse)
    k = len(t)
    arms = cross_matrices((doppler.x[:, None] + F[None]).reshape(-1, 3))
    noise = sensors.gyro_noise_density * np.sqrt(dt)[:, :, None, None]
    by_turn = (noise * arms.reshape(k, k, 3, 3)).transpose(0, 2, 1, 3)
    by_turn = by_turn.reshape(3 * k, -1)
    shared_s = np.minimum(t[:, None], t[None])  # (k, k)
    force = np.kron(sensors.accel_noise_density**2 * shared_s, np.eye(3))
    # R_k [j = k] in its blocks
    own = np.zeros((k, 3, k, 3))
    own[np.arange(k), :, np.arange(k), :] = doppler.R
    return by_turn @ by_turn.T + force + own.reshape(force.shape)
