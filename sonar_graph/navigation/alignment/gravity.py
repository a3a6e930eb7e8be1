"""Direction of gravity from accelerometers, the Earth's rotation, and roll and pitch of an up vector.

Over an interval of duration T from epoch i to epoch j the specific force f, turned into frame i and averaged, is the
change of velocity plus gravity's reaction. With the velocity v of the IMU's point, dR = i_R_j and
``up = body_R_world e_z``::

    mean(i_R(t) f(t)) = (dR v_j - v_i) / T + g up_i,    up_j = dR^T up_i
    sigma^2 = (accel_noise^2 / T + 2 sigma_v^2 / T^2) / g^2 + N^2 T / 3 + sigma_b^2 T^2 / 4 + beta^2 max(1, tau / T)

The bias of the accelerometers, ``beta = accel_bias / g``, does not average out over successive directions:
``tau = (beta / N)^2`` keeps a filtered tilt from claiming less. It does not make it consistent (its true variance is
1.5 times the claimed one, that of a smoothed tilt 2.5 times, by the scalar model): only the bias as a state would. Roll
r and pitch p follow from ``up = (-sin p, sin r cos p, cos r cos p)``. A gyro also measures the Earth's rotation; in a
world with x east and y north, at latitude phi, with n the north in body axes::

    body_R_world Omega = Omega sin(phi) up + Omega cos(phi) n

Derivation: docs/theory/alignment.md.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration, ImuCalibration
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import Floats, Imu
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.numerics import compiled

LEAST_GYRO_NOISE_DENSITY = 1e-7
"""rad/s/√Hz, ten times below the best fibre gyros: keeps tau finite for a gyro without noise."""


def velocity_at_imu(velocity: Floats, rate: Floats, body_p_dvl: Floats, body_p_imu: Floats) -> Floats:
    """Velocity of the IMU's point from that of the DVL's: ``v + w x (p_imu - p_dvl)``, body axes, shape (3,), m/s."""
    return np.asarray(velocity + np.cross(rate, body_p_imu - body_p_dvl))


def gravity_direction(
    motion: PreintegratedMotion,
    velocity_i: Floats,
    velocity_j: Floats,
    velocity_sigma_m_s: float,
    imu: ImuCalibration,
    gravity_m_s2: float,
) -> tuple[Floats, float] | None:
    """Measure the world's up in frame j.

    Parameters
    ----------
    motion
        From epoch i to epoch j, with the mean specific force.
    velocity_i, velocity_j
        Velocity of the IMU's point in body axes at the two epochs (see `velocity_at_imu`), shape (3,), m/s.
    velocity_sigma_m_s
        Standard deviation of one component of either velocity.

    Returns
    -------
    The unit vector ``body_R_world e_z`` at epoch j, shape (3,), and the standard deviation of a small tilt of it, rad.
    None where the specific force was not measured.
    """
    i_R_j = np.ascontiguousarray(motion.i_T_j.rotation().matrix())
    up_j = up_direction(motion.mean_specific_force, i_R_j, velocity_i, velocity_j, motion.duration_s)
    if not np.isfinite(up_j).all():
        return None
    return up_j, tilt_sigma(
        motion.duration_s,
        velocity_sigma_m_s,
        imu.accel_noise_density,
        imu.accel_bias_sigma,
        imu.gyro_noise_density,
        imu.gyro_bias_sigma,
        gravity_m_s2,
    )


@compiled
def up_direction(
    mean_force: Floats, i_R_j: Floats, velocity_i: Floats, velocity_j: Floats, duration_s: float
) -> Floats:
    """up_j of the module's equation, shape (3,); NaN where the force is not measured."""
    up_i = np.empty(3)
    for r in range(3):
        turned = i_R_j[r, 0] * velocity_j[0] + i_R_j[r, 1] * velocity_j[1] + i_R_j[r, 2] * velocity_j[2]
        up_i[r] = mean_force[r] - (turned - velocity_i[r]) / duration_s
    length = math.sqrt(up_i[0] ** 2 + up_i[1] ** 2 + up_i[2] ** 2)
    up_j = np.empty(3)
    for c in range(3):
        up_j[c] = (i_R_j[0, c] * up_i[0] + i_R_j[1, c] * up_i[1] + i_R_j[2, c] * up_i[2]) / length
    return up_j


@compiled
def tilt_sigma(
    duration_s: float,
    velocity_sigma_m_s: float,
    accel_noise_density: float,
    accel_bias_sigma: float,
    gyro_noise_density: float,
    gyro_bias_sigma: float,
    gravity: float,
) -> float:
    """Standard deviation of the direction's tilt, rad."""
    noise = (accel_noise_density**2 / duration_s + 2.0 * (velocity_sigma_m_s / duration_s) ** 2) / gravity**2
    noise += gyro_noise_density**2 * duration_s / 3.0 + (gyro_bias_sigma * duration_s) ** 2 / 4.0
    beta = accel_bias_sigma / gravity
    tau_s = (beta / max(gyro_noise_density, LEAST_GYRO_NOISE_DENSITY)) ** 2
    return math.sqrt(noise + beta**2 * max(1.0, tau_s / duration_s))


EARTH_RATE_RAD_S = 7.292115e-5
"""WGS 84."""


def earth_rate_in_world(calibration: Calibration) -> Floats | None:
    """Earth's angular rate in a world with x east, y north, z up, shape (3,), rad/s; None without a latitude."""
    latitude = calibration.earth_rate_latitude_rad
    if latitude is None:
        return None
    return EARTH_RATE_RAD_S * np.array([0.0, np.cos(latitude), np.sin(latitude)])


LEAST_COSINE = 1e-3
"""Least cosine of pitch; roll has no meaning with the nose straight up or down."""


@dataclass(frozen=True, eq=False)
class InitialTilt:
    """Roll, pitch and gyro bias at one instant, with their joint covariance."""

    stamp_ns: int
    """When it holds."""
    roll_rad: float
    pitch_rad: float
    gyro_bias: Floats
    """Body axes, shape (3,), rad/s."""
    covariance: Floats
    """Of [roll, pitch, gyro bias], shape (5, 5)."""
    bias_is_observed: NDArray[np.bool_]
    """True for the axes whose bias the data tell better than the prior, shape (3,)."""


def roll_and_pitch(up: Floats) -> tuple[float, float]:
    """Roll and pitch (rad) from the world's up in body axes, of any length, shape (3,)."""
    return float(np.arctan2(up[1], up[2])), float(np.arctan2(-up[0], np.hypot(up[1], up[2])))


def angles_by_up(up: Floats) -> Floats:
    """Derivative of roll and pitch by up, shape (2, 3); raises AlignmentError for a nose straight up or down."""
    x, y, z = up.tolist()
    cosine = np.hypot(y, z)
    if cosine < LEAST_COSINE:
        raise AlignmentError("alignment: the nose points straight up or down, where roll has no meaning")
    by_roll = np.array([0.0, z, -y]) / cosine**2
    by_pitch = np.array([-cosine, x * y / cosine, x * z / cosine])
    return np.stack([by_roll, by_pitch])


def earth_up_and_level(calibration: Calibration) -> tuple[float, float]:
    """Earth's rate along up and along north, rad/s; zero without a latitude."""
    earth = earth_rate_in_world(calibration)
    return (0.0, 0.0) if earth is None else (float(earth[2]), float(earth[1]))


def in_body_axes(imu: Imu, calibration: Calibration) -> Imu:
    """Turn readings into body axes; raises AlignmentError where a specific force was not measured."""
    if not np.isfinite(imu.specific_force).all():
        raise AlignmentError(
            "Imu.specific_force: is not finite in every row; alignment needs accelerometers throughout"
        )
    body_R_imu = calibration.imu.mounting.pose().rotation().matrix()
    return Imu(imu.stamps_ns, imu.angular_velocity @ body_R_imu.T, imu.specific_force @ body_R_imu.T)
