"""Direction of gravity from accelerometers.

Over an interval of duration T from epoch i to epoch j the specific force f, turned into frame i and averaged, is the
change of velocity plus gravity's reaction. With the velocity v of the IMU's point, dR = i_R_j and
``up = body_R_world e_z``::

    mean(i_R(t) f(t)) = (dR v_j - v_i) / T + g up_i,    up_j = dR^T up_i
    sigma^2 = (accel_noise^2 / T + 2 sigma_v^2 / T^2) / g^2 + N^2 T / 3 + sigma_b^2 T^2 / 4 + beta^2 max(1, tau / T)

The bias of the accelerometers, ``beta = accel_bias / g``, does not average out over successive directions. Where it is
no state, ``tau = (beta / N)^2`` keeps a filtered tilt from claiming less. docs/theory/alignment.md, gravity.md.
"""

import math

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.numerics import compiled

LEAST_GYRO_NOISE_DENSITY = 1e-7
"""rad/s/√Hz, ten times below the best fibre gyros: keeps tau finite for a gyro without noise."""


def gravity_direction(
    motion: PreintegratedMotion,
    velocity_i: Floats,
    velocity_j: Floats,
    sigma_m_s: float,
    calibration: Calibration,
    *,
    has_bias: bool = True,
) -> tuple[Floats, float] | None:
    """The unit vector up_j, shape (3,), and the standard deviation of a small tilt of it, rad.

    ``motion`` leads from epoch i to epoch j; the velocities are of the IMU's point in body axes at both, shape (3,),
    m/s, each component with ``sigma_m_s``. ``has_bias``: the accelerometers' bias is in the standard deviation. None
    where the specific force was not measured.
    """
    i_R_j = np.ascontiguousarray(motion.i_T_j.rotation().matrix())
    up_j = up_direction(motion.mean_specific_force, i_R_j, velocity_i, velocity_j, motion.duration_s)
    if not np.isfinite(up_j).all():
        return None
    return up_j, tilt_sigma(motion.duration_s, sigma_m_s, calibration, has_bias=has_bias)


@compiled
def up_direction(force: Floats, i_R_j: Floats, velocity_i: Floats, velocity_j: Floats, duration_s: float) -> Floats:
    """up_j of the mean specific force in frame i, shape (3,); NaN where the force is not measured."""
    g_i = force - (i_R_j @ velocity_j - velocity_i) / duration_s
    return i_R_j.T @ g_i / math.sqrt(g_i @ g_i)


def tilt_sigma(
    duration_s: float, velocity_sigma_m_s: float, calibration: Calibration, *, has_bias: bool = True
) -> float:
    """Standard deviation of the direction's tilt, rad; with the bias of the accelerometers, or without it."""
    imu, g = calibration.imu, calibration.gravity_m_s2
    noise = (imu.accel_noise_density**2 / duration_s + 2.0 * (velocity_sigma_m_s / duration_s) ** 2) / g**2
    noise += imu.gyro_noise_density**2 * duration_s / 3.0 + (imu.gyro_bias_sigma * duration_s) ** 2 / 4.0
    beta = imu.accel_bias_sigma / g if has_bias else 0.0
    tau_s = (beta / max(imu.gyro_noise_density, LEAST_GYRO_NOISE_DENSITY)) ** 2
    return math.sqrt(noise + beta**2 * max(1.0, tau_s / duration_s))
