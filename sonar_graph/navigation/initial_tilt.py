"""Roll, pitch and gyro bias at an instant, with how they depend on each other.

Which way is up in the body, ``u = body_R_world e_z``, has roll r and pitch p and no yaw::

    u = (-sin p, sin r cos p, cos r cos p),    r = atan2(u_y, u_z),    p = atan2(-u_x, hypot(u_y, u_z))

A gyro also feels the Earth. In a world with x east and y north, at latitude phi, with n the north in body axes::

    body_R_world Omega = Omega sin(phi) u + Omega cos(phi) n

The first part is known as soon as u is. n is horizontal and of no known direction without a heading: taken as uniform
in direction, the second part has mean zero and covariance ``(Omega cos(phi))^2 / 2 (I - u u^T)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import Floats, Imu
from sonar_graph.navigation.earth import earth_rate_in_world

LEAST_COSINE = 1e-3
"""Of pitch; roll has no meaning with the nose straight up or down."""


@dataclass(frozen=True, eq=False)
class InitialTilt:
    """Attitude but for yaw, and gyro bias."""

    stamp_ns: int
    """When it holds."""
    roll_rad: float
    pitch_rad: float
    gyro_bias: Floats
    """Body axes, shape (3,), rad/s."""
    covariance: Floats
    """Of [roll, pitch, gyro bias], shape (5, 5)."""
    bias_is_observed: NDArray[np.bool_]
    """Axes of whose bias the stretch told more than was known before, shape (3,)."""


def roll_and_pitch(up: Floats) -> tuple[float, float]:
    """Of the world's up in body axes, any length, shape (3,); rad."""
    return float(np.arctan2(up[1], up[2])), float(np.arctan2(-up[0], np.hypot(up[1], up[2])))


def angles_by_up(up: Floats) -> Floats:
    """Derivative of roll and pitch by a unit vector, shape (2, 3).

    Raises
    ------
    AlignmentError
        Where the nose points straight up or down.
    """
    x, y, z = up.tolist()
    cosine = np.hypot(y, z)
    if cosine < LEAST_COSINE:
        raise AlignmentError("alignment: the nose points straight up or down, where roll has no meaning")
    by_roll = np.array([0.0, z, -y]) / cosine**2
    by_pitch = np.array([-cosine, x * y / cosine, x * z / cosine])
    return np.stack([by_roll, by_pitch])


def earth_up_and_level(calibration: Calibration) -> tuple[float, float]:
    """Earth's rate along up and along north, rad/s; zero where it is not removed."""
    earth = earth_rate_in_world(calibration)
    return (0.0, 0.0) if earth is None else (float(earth[2]), float(earth[1]))


def in_body_axes(imu: Imu, calibration: Calibration) -> Imu:
    """The same readings along the body's axes.

    Raises
    ------
    AlignmentError
        Where a specific force was not measured.
    """
    if not np.isfinite(imu.specific_force).all():
        raise AlignmentError(
            "Imu.specific_force: is not finite in every row; alignment needs accelerometers throughout"
        )
    body_R_imu = calibration.imu.mounting.pose().rotation().matrix()
    return Imu(imu.stamps_ns, imu.angular_velocity @ body_R_imu.T, imu.specific_force @ body_R_imu.T)
