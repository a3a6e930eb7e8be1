"""Sensors of the vehicle: gravity, headings and position fixes as measurements, and errors that last through a run.

**Direction of gravity** from accelerometers. Over an interval of duration T from epoch i to epoch j the specific force
f, turned into frame i and averaged, is the change of velocity plus gravity's reaction. With the velocity v of the IMU's
point, dR = i_R_j and ``up = body_R_world e_z``::

    mean(i_R(t) f(t)) = (dR v_j - v_i) / T + g up_i,    up_j = dR^T up_i
    sigma^2 = (accel_noise^2 / T + 2 sigma_v^2 / T^2) / g^2 + N^2 T / 3 + sigma_b^2 T^2 / 4 + beta^2 max(1, tau / T)

The bias of the accelerometers, ``beta = accel_bias / g``, does not average out over successive directions. Where it is
no state, ``tau = (beta / N)^2`` keeps a filtered tilt from claiming less. docs/theory/alignment.md, gravity.md.

**Yaw** of a body as a compass measures it. For the turn ``R Exp(theta)`` of a body, with the rows (x, a, c) and
(y, b, d) of R::

    yaw = atan2(y, x),    d yaw / d theta = [0,  y c - x d,  x b - y a] / (x^2 + y^2)

Huber's kernel of headings and fixes: an error of d > k standard deviations has the noise ``R d / k``.
docs/theory/aiding.md.

**Lasting errors** are one vector b of an estimator's state::

    b = [b_tilt, b_heading, b_accel, compass, scale],    gyro bias = (I - u u^T) b_tilt + u u^T b_heading

with u the world's up in the body: the bias of the gyros is there twice, as it tilts the body and as it turns its
heading. Gravity observes the first. Its information on the second, through tilts of a few degrees, is smaller than the
error that gyro axes off by a tenth of a degree cause. Without gravity b_tilt is the whole bias. docs/theory/gravity.md.
"""

import math
from collections import Counter

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats
from sonar_graph.motion import PreintegratedMotion
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
    up_j = up_direction(
        motion.mean_specific_force, i_R_j, velocity_i, velocity_j, motion.duration_s
    )
    if not np.isfinite(up_j).all():
        return None
    return up_j, tilt_sigma(
        motion.duration_s, sigma_m_s, calibration, has_bias=has_bias
    )


def up_direction(
    force: Floats,
    i_R_j: Floats,
    velocity_i: Floats,
    velocity_j: Floats,
    duration_s: float,
) -> Floats:
    """up_j of the mean specific force in frame i, shape (3,); NaN where the force is not measured."""
    # the force that holds the vehicle against gravity: what is left without its acceleration
    g_i = force - (i_R_j @ velocity_j - velocity_i) / duration_s  # (3,)
    return i_R_j.T @ g_i / math.sqrt(g_i @ g_i)


def tilt_sigma(
    duration_s: float,
    velocity_sigma_m_s: float,
    calibration: Calibration,
    *,
    has_bias: bool = True,
) -> float:
    """Standard deviation of the direction's tilt, rad; with the bias of the accelerometers, or without it."""
    imu = calibration.imu
    g = calibration.gravity_m_s2
    noise = (
        imu.accel_noise_density**2 / duration_s
        + 2.0 * (velocity_sigma_m_s / duration_s) ** 2
    ) / g**2
    # the frame in which the force is averaged turns with the gyros' own error
    noise += (
        imu.gyro_noise_density**2 * duration_s / 3.0
        + (imu.gyro_bias_sigma * duration_s) ** 2 / 4.0
    )
    # where the bias is a state of the estimator, it must not count as noise too
    beta = imu.accel_bias_sigma / g if has_bias else 0.0
    tau_s = (beta / max(imu.gyro_noise_density, LEAST_GYRO_NOISE_DENSITY)) ** 2
    return math.sqrt(noise + beta**2 * max(1.0, tau_s / duration_s))


HEADING_WIDTH = 1.345
FIX_WIDTH = 1.628
HUBER_WIDTHS = {1: HEADING_WIDTH, 3: FIX_WIDTH}
"""k of a heading and of a fix: 95 % efficient for Gaussian noise of so many dimensions. The kernel is convex: a start
that is far off finds its way, which a kernel that lets go of large errors does not promise."""


def yaw_and_derivative(R: Floats) -> tuple[float, Floats]:
    """Yaw of a rotation, rad, and its derivative by a turn of the body, shape (3,)."""
    x, a, c = R[0]
    y, b, d = R[1]
    level2 = x * x + y * y
    return math.atan2(y, x), np.array(
        [0.0, (y * c - x * d) / level2, (x * b - y * a) / level2]
    )


def up_and_derivative(R: Floats) -> tuple[Floats, Floats]:
    """The world's up in the body, ``R^T e_z``, shape (3,), and its derivative by a turn of the body, shape (3, 3)."""
    up = R[2]
    return up, gtsam.SO3.Hat(up)


def huber_scale(e: Floats, S: Floats) -> float:
    """Factor ``max(1, d / k)`` by which Huber's kernel widens the noise of an innovation e of covariance S."""
    k = HEADING_WIDTH if len(e) == 1 else FIX_WIDTH
    return max(1.0, math.sqrt(e @ np.linalg.inv(S) @ e) / k)


CONTRADICTING_SIGMAS = 5.0
DOUBTLESS_SIGMAS = {"heading": 10.0, "positions": CONTRADICTING_SIGMAS}
"""Distances that leave no doubt where most rows have them. A filter without gyro bias is soon off by 5 sigmas in heading,
but fixes hold every estimator's position."""
CONTRADICTING_SHARE = 0.2
"""Of headings or fixes: less are outliers, which the kernel is for."""
FEWEST_JUDGED = 10
CAUSES = {
    "heading": "headings contradict its yaw by more than {:g} sigma: gyro noise, gyro bias or start larger than the "
    "calibration says, or headings worse than heading.sigma_rad?",
    "positions": "position fixes contradict its position by more than {:g} sigma: noise of gyros or Doppler log, or "
    "the start, larger than the calibration says, or fixes worse than positions.sigma_m, or than their own "
    "covariances?",
}
"""Rest of the message about a sensor that an estimator contradicts, after the number of rows."""


class Contradictions:
    """Counts the headings and fixes of a run that its estimate contradicts, which the kernel would hide.

    A filter that is too sure takes right headings for outliers, then their error for one of the compass, and goes on
    being wrong. So headings are compared with the yaw alone, beside which the calibration's ``heading.bias_sigma_rad``
    is noise.
    """

    def __init__(self) -> None:
        self._far = Counter[str]()
        self._judged = Counter[str]()
        self._beyond_doubt = Counter[str]()

    def judge(self, sensor: str, distances: Floats | float) -> None:
        """Count distances in sigmas, of one row or several."""
        self._far[sensor] += int(np.count_nonzero(distances > CONTRADICTING_SIGMAS))
        self._judged[sensor] += np.size(distances)
        self._beyond_doubt[sensor] += int(
            np.count_nonzero(distances > DOUBTLESS_SIGMAS[sensor])
        )

    def messages(self) -> list[str]:
        """A line for each sensor that contradicts the estimate in more than `CONTRADICTING_SHARE` of its rows."""
        return [
            f"{self._far[sensor]} of {judged} {CAUSES[sensor].format(CONTRADICTING_SIGMAS)}"
            + (
                " Most are beyond doubt."
                if self._beyond_doubt[sensor] > judged / 2
                else ""
            )
            for sensor, judged in self._judged.items()
            # a share of a few rows may be chance
            if judged >= FEWEST_JUDGED
            and self._far[sensor] > CONTRADICTING_SHARE * judged
        ]


TILT = slice(0, 3)
HEADING = slice(3, 6)
"""Places in b of the gyros' bias, rad/s, as it tilts the body and as it turns its heading."""
ACCEL = slice(6, 9)
"""Place of the accelerometers' bias, m/s²."""
COMPASS = 9
"""Place of the compass's bias, rad."""
SCALE = 10
"""Place of the relative scale error of the Doppler log."""
BIASES = 11
"""Length of b."""


def bias_sigmas(calibration: Calibration) -> tuple[Floats, Floats]:
    """Standard deviations of b at the start, and densities of its walk, shape (11,) each."""
    imu = calibration.imu
    sigmas = np.zeros(BIASES)
    sigmas[TILT] = imu.gyro_bias_sigma
    sigmas[ACCEL] = imu.accel_bias_sigma
    sigmas[COMPASS] = calibration.heading.bias_sigma_rad
    sigmas[SCALE] = calibration.dvl.scale_sigma
    walks = np.zeros(BIASES)
    walks[TILT] = imu.gyro_bias_walk_density
    walks[ACCEL] = imu.accel_bias_walk_density
    if calibration.use_gravity:  # without it b_tilt is the whole bias
        sigmas[HEADING] = sigmas[TILT]
        walks[HEADING] = walks[TILT]
    # a sigma of 0 means that a bias is not estimated: then it must not walk either
    return sigmas, np.where(sigmas > 0, walks, 0.0)


@inlined
def gyro_bias_of(b: Floats, up: Vec3) -> Vec3:
    """Gyro bias in body axes, where the world's up lies along ``up`` in the body; zero without gravity."""
    tilt = vec(b)
    heading = vec(b[HEADING])
    return tilt + (up @ (heading - tilt)) * up


@compiled
def by_biases(
    D: Floats, dR: Floats, dp: Floats, up: Floats, vertical: Floats, body_p_dvl: Floats
) -> Floats:
    """`bias_jacobian` of arrays."""
    return bias_jacobian(D, mat(dR), vec(dp), vec(up), vec(vertical), vec(body_p_dvl))


@inlined
def bias_jacobian(
    D: Floats, dR: Mat3, dp: Vec3, up: Vec3, vertical: Vec3, body_p_dvl: Vec3
) -> Floats:
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
    # the compass does not change a motion
    D_b = np.zeros((6, BIASES))
    # b_tilt in the columns 0 to 2, b_heading in 3 to 5; when both change alike, the gyro bias does: the sum is D
    store(D_theta - theta_by_heading, D_b)
    store(D_rho - rho_by_heading, D_b, LOWER_LEFT)
    store(theta_by_heading, D_b, UPPER_RIGHT)
    store(rho_by_heading, D_b, LOWER_RIGHT)
    D_b[3, SCALE] = level_way.x
    D_b[4, SCALE] = level_way.y
    D_b[5, SCALE] = level_way.z
    return D_b
