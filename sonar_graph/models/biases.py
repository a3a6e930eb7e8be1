"""Errors of sensors that last through a run, one vector b of an estimator's state, and what they do to a motion.

::

    b = [b_tilt, b_heading, b_accel, compass, scale],    gyro bias = (I - u u^T) b_tilt + u u^T b_heading

with u the world's up in the body: the bias of the gyros is there twice, as it tilts the body and as it turns its
heading. Gravity observes the first; what it would tell of the second, through tilts of a few degrees, is less than what
gyro axes off by a tenth of a degree pretend. Without gravity b_tilt is the whole bias. docs/theory/gravity.md.
"""

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats
from sonar_graph.numerics import (
    LOWER_LEFT,
    LOWER_RIGHT,
    UPPER_RIGHT,
    Mat3,
    Vec3,
    compiled,
    inlined,
    mat,
    outer,
    store,
    vec,
)

TILT, HEADING, ACCEL, COMPASS, SCALE, BIASES = slice(0, 3), slice(3, 6), slice(6, 9), 9, 10, 11
"""Places in b of the gyros' bias (rad/s), twice, that of the accelerometers (m/s²) and of the compass (rad), and the
relative scale error of the Doppler log; length of b."""


def bias_sigmas(calibration: Calibration) -> tuple[Floats, Floats]:
    """Standard deviations of b at the start, and densities of its walk, shape (11,) each."""
    imu, sigmas, walks = calibration.imu, np.zeros(BIASES), np.zeros(BIASES)
    sigmas[TILT], walks[TILT] = imu.gyro_bias_sigma, imu.gyro_bias_walk_density
    if calibration.use_gravity:
        sigmas[HEADING], walks[HEADING] = sigmas[TILT], walks[TILT]
    sigmas[ACCEL], walks[ACCEL] = imu.accel_bias_sigma, imu.accel_bias_walk_density
    sigmas[COMPASS], sigmas[SCALE] = calibration.heading.bias_sigma_rad, calibration.dvl.scale_sigma
    return sigmas, np.where(sigmas > 0, walks, 0.0)


def gyro_bias_of(b: Floats, up: Floats) -> Floats:
    """Gyro bias in body axes, shape (3,), where the world's up lies along ``up`` in the body; zero without gravity."""
    return b[TILT] + up * (up @ (b[HEADING] - b[TILT]))


@compiled
def by_biases(D: Floats, dR: Floats, dp: Floats, up: Floats, vertical: Floats, body_p_dvl: Floats) -> Floats:
    """`bias_jacobian` of arrays."""
    return bias_jacobian(D, mat(dR), vec(dp), vec(up), vec(vertical), vec(body_p_dvl))


@inlined
def bias_jacobian(D: Floats, dR: Mat3, dp: Vec3, up: Vec3, vertical: Vec3, body_p_dvl: Vec3) -> Floats:
    """Derivative of a motion's [theta, rho] by b, shape (6, 11), from that by the gyro bias, ``D``, shape (6, 3).

    By b_heading the body turns about the world's vertical alone, whatever its tilt meanwhile: ``u_j u_j^T D_theta``,
    with u at the end of the motion. A scale error lengthens the way of the Doppler log, ``dp + dR l - l``, as far as it
    is level: the vertical way is mostly noise, by which depth would measure the scale as too large.

    Parameters
    ----------
    dR, dp
        Mean of the motion.
    up
        The world's up in the body at its start; zero without gravity.
    vertical
        The same, with or without gravity.
    """
    up_j = dR.T @ up
    vertical_j = dR.T @ vertical
    D_theta = mat(D)
    D_rho = mat(D, LOWER_LEFT)
    theta_by_heading = outer(up_j, D_theta.T @ up_j)
    rho_by_heading = outer(D_rho @ up, up)
    way = dR.T @ (body_p_dvl - dp) - body_p_dvl
    level_way = way - (vertical_j @ way) * vertical_j
    D_b = np.zeros((6, BIASES))
    # b_tilt in the columns 0 to 2, b_heading in 3 to 5
    store(D_theta - theta_by_heading, D_b)
    store(D_rho - rho_by_heading, D_b, LOWER_LEFT)
    store(theta_by_heading, D_b, UPPER_RIGHT)
    store(rho_by_heading, D_b, LOWER_RIGHT)
    D_b[3, SCALE] = level_way.x
    D_b[4, SCALE] = level_way.y
    D_b[5, SCALE] = level_way.z
    return D_b
