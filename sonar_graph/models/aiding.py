"""Yaw of a body as a compass measures it, the robust kernel of headings and position fixes, and whom it silences.

For the turn ``R Exp(theta)`` of a body, with the rows (x, a, c) and (y, b, d) of R::

    yaw = atan2(y, x),    d yaw / d theta = [0,  y c - x d,  x b - y a] / (x^2 + y^2)

Kernel of Huber: an error of d > k standard deviations has the noise ``R d / k``. docs/theory/aiding.md.
"""

import math
from collections import Counter

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.numerics import cross_matrix

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
    return up, cross_matrix(up)


def huber_scale(e: Floats, S: Floats) -> float:
    """Factor ``max(1, d / k)`` by which Huber's kernel widens the noise of an innovation e of covariance S."""
    k = HEADING_WIDTH if len(e) == 1 else FIX_WIDTH
    return max(1.0, math.sqrt(e @ np.linalg.inv(S) @ e) / k)


CONTRADICTING_SIGMAS = 5.0
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

    def judge(self, sensor: str, distances: Floats | float) -> None:
        """Take note of distances in sigmas, of one row or several."""
        self._far[sensor] += int(np.count_nonzero(np.asarray(distances) > CONTRADICTING_SIGMAS))
        self._judged[sensor] += np.size(distances)

    def messages(self) -> list[str]:
        """A line for each sensor of which more than `CONTRADICTING_SHARE` of the rows contradict the estimate."""
        return [
            f"{self._far[sensor]} of {judged} {CAUSES[sensor].format(CONTRADICTING_SIGMAS)}"
            for sensor, judged in self._judged.items()
            if judged >= FEWEST_JUDGED and self._far[sensor] > CONTRADICTING_SHARE * judged
        ]
