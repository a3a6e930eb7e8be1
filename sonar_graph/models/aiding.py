"""Gravity, headings and position fixes as measurements, and the messages about sensors that contradict an estimate.

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
"""

import math
from collections import Counter

import gtsam
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


HEADING_WIDTH, FIX_WIDTH = 1.345, 1.628
HUBER_WIDTHS = {1: HEADING_WIDTH, 3: FIX_WIDTH}
"""k of a heading and of a fix: 95 % efficient for Gaussian noise of so many dimensions. The kernel is convex: a start
that is far off finds its way, which a kernel that lets go of large errors does not promise."""


def yaw_and_derivative(R: Floats) -> tuple[float, Floats]:
    """Yaw of a rotation, rad, and its derivative by a turn of the body, shape (3,)."""
    x, a, c = R[0, 0], R[0, 1], R[0, 2]
    y, b, d = R[1, 0], R[1, 1], R[1, 2]
    level2 = x * x + y * y
    return math.atan2(y, x), np.array([0.0, (y * c - x * d) / level2, (x * b - y * a) / level2])


def up_and_derivative(R: Floats) -> tuple[Floats, Floats]:
    """The world's up in the body, ``R^T e_z``, shape (3,), and its derivative by a turn of the body, shape (3, 3)."""
    up = R[2]
    return up, gtsam.SO3.Hat(up)


def huber_scale(e: Floats, S: Floats) -> float:
    """Factor ``max(1, d / k)`` by which Huber's kernel widens the noise of an innovation e of covariance S."""
    k = HEADING_WIDTH if len(e) == 1 else FIX_WIDTH
    return max(1.0, math.sqrt(e @ np.linalg.inv(S) @ e) / k)


CONTRADICTING_SIGMAS, DOUBTLESS_SIGMAS = 5.0, 10.0
CONTRADICTING_SHARE = 0.2
"""Of headings or fixes: less are outliers, which the kernel is for."""
FEWEST_JUDGED = 10
CAUSES = {
    "heading": "headings contradict its yaw by more than {:g} sigma: gyro noise, gyro bias or start larger than the "
    "calibration says, or headings worse than heading.sigma_rad?",
    "positions": "position fixes contradict its position by more than {:g} sigma: noise of gyros or Doppler log, or "
    "the start, larger than the calibration says, or fixes worse than positions.sigma_m?",
}
"""What is said of a sensor that an estimator contradicts, after the number of rows."""


class Contradictions:
    """Counts the headings and fixes of a run that its estimate contradicts, which the kernel would keep silent about.

    A filter that is too sure takes right headings for outliers, then their error for one of the compass, and goes on
    being wrong. So headings are compared with the yaw alone, beside which the calibration's ``heading.bias_sigma_rad``
    is noise.
    """

    def __init__(self) -> None:
        self._far, self._judged = Counter[str](), Counter[str]()
        self._beyond_doubt = Counter[str]()

    def judge(self, sensor: str, distances: Floats | float) -> None:
        """Take note of distances in sigmas, of one row or several."""
        self._far[sensor] += int(np.count_nonzero(np.asarray(distances) > CONTRADICTING_SIGMAS))
        self._judged[sensor] += np.size(distances)
        self._beyond_doubt[sensor] += int(np.count_nonzero(np.asarray(distances) > DOUBTLESS_SIGMAS))

    def messages(self) -> list[str]:
        """A line for each sensor of which more than `CONTRADICTING_SHARE` of the rows contradict the estimate."""
        return [
            f"{self._far[sensor]} of {judged} {CAUSES[sensor].format(CONTRADICTING_SIGMAS)}"
            + (" Most are beyond doubt." if self._beyond_doubt[sensor] > judged / 2 else "")
            for sensor, judged in self._judged.items()
            if judged >= FEWEST_JUDGED and self._far[sensor] > CONTRADICTING_SHARE * judged
        ]
