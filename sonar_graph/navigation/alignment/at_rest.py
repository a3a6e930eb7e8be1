"""Roll, pitch and gyro bias from a rest.

At rest accelerometers measure gravity's reaction and gyros the Earth's rotation. With means over the length T of the
rest, u the world's up in body axes, b_a and b_g the biases, a and N the noise densities, K the walk of the gyro bias::

    mean f = g u + b_a + e_a,               cov(e_a) = a^2 / T
    mean w = b_g + Omega sin(phi) u + Omega cos(phi) n + e_g,    cov(e_g) = N^2 / T + K^2 T / 3

Hence ``u = mean f / |mean f|`` with the variance ``(sigma_a^2 + a^2 / T) / g^2`` across u, and at the end of the rest
``b_g = mean w - Omega sin(phi) u``. Without a latitude the bias includes the Earth's rotation, which is not in the
covariance. docs/theory/alignment.md; coarse levelling: P. D. Groves, Principles of GNSS, Inertial, and Multisensor
Integrated Navigation Systems, 2nd ed., 2013, chapter 5.6. Roll r and pitch p follow from ``up = (-sin p, sin r cos p,
cos r cos p)``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.motion import earth_rate_in_world
from sonar_graph.numerics import chi_square_exceeded

LEAST_COSINE = 1e-3
"""Least cosine of pitch; roll has no meaning with the nose straight up or down."""


@dataclass(frozen=True, eq=False)
class InitialTilt:
    """Roll, pitch and gyro bias at one instant, with their joint covariance.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.navigation.alignment import (align_at_rest)
    >>> from sonar_graph.testing import still_world
    >>> world = still_world()
    >>> tilt = align_at_rest(world.imu, world.calibration)
    >>> print(f"roll {np.degrees(tilt.roll_rad):.2f}°, pitch {np.degrees(tilt.pitch_rad):.2f}°")
    roll 5.73°, pitch -2.86°
    >>> tilt.covariance.shape
    (5, 5)
    """

    stamp_ns: int
    """When it holds."""
    roll_rad: float
    pitch_rad: float
    gyro_bias: Floats
    """Body axes, shape (3,), rad/s."""
    covariance: Floats
    """Of [roll, pitch, gyro bias], shape (5, 5)."""
    bias_is_observed: NDArray[np.bool_]
    """True for the axes whose bias is known better from the data than from the prior, shape (3,)."""


def roll_and_pitch(up: Floats) -> tuple[float, float]:
    """Roll and pitch (rad) from the world's up in body axes, of any length, shape (3,)."""
    x, y, z = up.tolist()
    roll = np.arctan2(y, z)
    pitch = np.arctan2(-x, np.hypot(y, z))
    return float(roll), float(pitch)


def angles_by_up(up: Floats) -> Floats:
    """Derivative of roll and pitch by up, shape (2, 3); raises AlignmentError for a nose straight up or down."""
    x, y, z = up.tolist()
    cosine = np.hypot(y, z)  # of pitch
    if cosine < LEAST_COSINE:
        raise AlignmentError(
            "alignment: the nose points straight up or down, where roll has no meaning"
        )
    by_roll = np.array([0.0, z, -y]) / cosine**2
    by_pitch = np.array([-cosine, x * y / cosine, x * z / cosine])
    return np.stack([by_roll, by_pitch])


def earth_up_and_level(calibration: Calibration) -> tuple[float, float]:
    """Earth's rate along up and along north, rad/s; zero without a latitude."""
    earth = earth_rate_in_world(calibration)
    if earth is None:
        return 0.0, 0.0
    _, north, up = earth.tolist()
    return up, north


def in_body_axes(imu: Imu, calibration: Calibration) -> Imu:
    """Readings in body axes, forces without their known bias; AlignmentError where a specific force was not measured."""
    if not np.isfinite(imu.specific_force).all():
        raise AlignmentError(
            "Imu.specific_force: is not finite in every row; alignment needs accelerometers throughout"
        )
    body_R_imu = calibration.imu.mounting.pose().rotation().matrix()
    return Imu(
        imu.stamps_ns,
        imu.angular_velocity @ body_R_imu.T,
        (imu.specific_force - calibration.imu.accel_bias_m_s2) @ body_R_imu.T,
    )


BLOCK_S = 0.5
"""Means over this time are compared, so that vibration is not taken for motion."""
FEWEST_BLOCKS = 4
LARGEST_NOISE_RATIO = 1.5
"""Largest ratio of the means' standard deviation to that of the noise densities, beyond chance."""
FALSE_ALARM = 1e-6
LARGEST_RATE_RAD_S = 0.02
"""A larger mean rate is no bias: the vehicle turns steadily."""
LARGEST_SPEED_M_S = 0.02
LARGEST_GRAVITY_ERROR = 0.05
"""Share of gravity; beyond it the unit is another one, or gravity was removed."""


def align_at_rest(
    imu: Imu, calibration: Calibration, dvl: Dvl | None = None
) -> InitialTilt:
    """Roll, pitch and gyro bias of a vehicle that does not move.

    Parameters
    ----------
    imu
        Rows of the rest alone, at least two seconds.
    calibration
        Noise densities, accelerometer bias, mountings, gravity, and the latitude if the Earth's rotation is to be
        removed from the bias. `gyro_bias_sigma` is not used: the bias is from the rest alone.
    dvl
        Velocities of the same time, as a further check that the vehicle rested.

    Returns
    -------
    InitialTilt
        At the last row's stamp.

    Raises
    ------
    AlignmentError
        Where the vehicle moved, the rest is too short or has a hole, or there is no accelerometer.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.calibration import Calibration
    >>> from sonar_graph.measurements import Imu
    >>> from sonar_graph.navigation.alignment import (align_at_rest)
    >>> force = np.tile([0.0, 9.80665 * np.sin(0.1), 9.80665 * np.cos(0.1)], (500, 1))
    >>> tilt = align_at_rest(Imu(np.arange(500) * 10_000_000, np.zeros((500, 3)), force), Calibration())
    >>> round(tilt.roll_rad, 6)
    0.1
    """
    imu = in_body_axes(imu, calibration)
    refuse_motion(imu, calibration, dvl)
    force = imu.specific_force.mean(axis=0)
    rate = imu.angular_velocity.mean(axis=0)
    # at rest the accelerometers measure gravity's reaction alone
    up = force / np.linalg.norm(force)
    upward, _ = earth_up_and_level(calibration)
    span_s = float(imu.stamps_ns[-1] - imu.stamps_ns[0]) * 1e-9
    length_s = span_s * len(imu) / (len(imu) - 1)  # n samples stand for n intervals
    roll, pitch = roll_and_pitch(up)
    # the Earth's rotation about the vertical is known; its level part has an unknown direction
    bias = rate - upward * up
    cov = covariance_at_rest(up, length_s, calibration)
    return InitialTilt(
        int(imu.stamps_ns[-1]), roll, pitch, bias, cov, np.ones(3, dtype=np.bool_)
    )


def covariance_at_rest(up: Floats, rest_s: float, calibration: Calibration) -> Floats:
    """Covariance of [roll, pitch, gyro bias] after a rest of ``rest_s`` seconds, shape (5, 5).

    ``up``: unit vector ``body_R_world e_z``, shape (3,).
    """
    upward, level = earth_up_and_level(calibration)
    sensors = calibration.imu
    # a tilt moves the direction across itself only
    across = np.eye(3) - np.outer(up, up)
    tilt = (
        sensors.accel_bias_sigma**2 + sensors.accel_noise_density**2 / rest_s
    ) / calibration.gravity_m_s2**2
    by_up = np.concatenate([angles_by_up(up), -upward * np.eye(3)])
    covariance = by_up @ (tilt * across) @ by_up.T
    noise = (
        sensors.gyro_noise_density**2 / rest_s
        + sensors.gyro_bias_walk_density**2 * rest_s / 3.0
    )
    # the level part of the Earth's rate counts as noise, half of its square along each axis
    covariance[2:, 2:] += noise * np.eye(3) + 0.5 * level**2 * across
    return covariance


def refuse_motion(imu: Imu, calibration: Calibration, dvl: Dvl | None) -> None:
    """Raise AlignmentError where the rows, in body axes, are no rest: too short, with a hole, moving or turning."""
    seconds = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
    if seconds[-1] < FEWEST_BLOCKS * BLOCK_S:
        raise AlignmentError(
            f"alignment: {seconds[-1]:.1f} s of IMU is too short; give {FEWEST_BLOCKS * BLOCK_S:g} s"
        )
    if np.diff(seconds).max() > 0.5 * BLOCK_S:
        raise AlignmentError(
            f"Imu: {np.diff(seconds).max():.2f} s without a row; give a stretch without holes"
        )
    block = (seconds / BLOCK_S).astype(np.int64)
    _, first, count = np.unique(block, return_index=True, return_counts=True)
    for name, values, field in (
        ("specific_force", imu.specific_force, "accel_noise_density"),
        ("angular_velocity", imu.angular_velocity, "gyro_noise_density"),
    ):
        density = getattr(calibration.imu, field)
        # the last block is not full
        means = (np.add.reduceat(values, first, axis=0) / count[:, None])[:-1]
        freedom = means.size - means.shape[1]
        squares = np.sum((means - means.mean(axis=0)) ** 2)
        # of white noise the means over blocks have the variance density^2 / BLOCK_S
        ratio = np.sqrt(squares * BLOCK_S / freedom)
        by_chance = np.sqrt(chi_square_exceeded(FALSE_ALARM, freedom) / freedom)
        if ratio > LARGEST_NOISE_RATIO * by_chance * density:
            raise AlignmentError(
                f"Imu.{name}: varies as a density of {ratio:.2g}, not imu.{field} = {density:.2g}; "
                "the vehicle moved (give another stretch, or align in motion), or the density is too small"
            )
    rate = np.linalg.norm(imu.angular_velocity.mean(axis=0))
    if rate > LARGEST_RATE_RAD_S:
        raise AlignmentError(
            f"Imu.angular_velocity: turns at {rate:.3f} rad/s on average; no rest, give another stretch"
        )
    force = np.linalg.norm(imu.specific_force.mean(axis=0))
    gravity = calibration.gravity_m_s2
    if abs(force / gravity - 1.0) > LARGEST_GRAVITY_ERROR:
        raise AlignmentError(
            f"Imu.specific_force: {force:.2f} m/s² on average, not {gravity:.2f}; "
            "check its unit, and that gravity is in it"
        )
    if dvl is None:
        return
    during = dvl.between(int(imu.stamps_ns[0]) - 1, int(imu.stamps_ns[-1]))
    if during is not None:
        speed = np.linalg.norm(during.velocity.mean(axis=0))
        sigma = np.linalg.norm(calibration.dvl.velocity_sigma_m_s) / np.sqrt(
            len(during)
        )
        if speed > LARGEST_SPEED_M_S + 5.0 * sigma:
            raise AlignmentError(
                f"Dvl.velocity: {speed:.3f} m/s on average; no rest, give another stretch or align in motion"
            )
