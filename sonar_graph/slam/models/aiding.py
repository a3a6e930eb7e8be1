"""Yaw of a body as a compass measures it, and the robust kernel of headings and position fixes.

For the turn ``R Exp(theta)`` of a body, with the rows (x, a, c) and (y, b, d) of R::

    yaw = atan2(y, x),    d yaw / d theta = [0,  y c - x d,  x b - y a] / (x^2 + y^2)

Kernel of Huber: an error of d > k standard deviations has the noise ``R d / k``. docs/theory/aiding.md.
"""

import math

import numpy as np

from sonar_graph.measurements import Floats

HUBER_WIDTHS = {1: 1.345, 3: 1.628}
"""k of a heading and of a fix: 95 % efficient for Gaussian noise of so many dimensions. The kernel is convex: a start
that is far off finds its way, which a kernel that lets go of large errors does not promise."""


def yaw_and_derivative(R: Floats) -> tuple[float, Floats]:
    """Yaw of a rotation, rad, and its derivative by a turn of the body, shape (3,)."""
    (x, a, c), (y, b, d) = R[0].tolist(), R[1].tolist()
    level2 = x * x + y * y
    return math.atan2(y, x), np.array([0.0, (y * c - x * d) / level2, (x * b - y * a) / level2])


def doubted(e: Floats, S: Floats, R: Floats) -> Floats:
    """Covariance of an innovation e with the kernel's noise, where it is S with Gaussian noise R, shapes (m, m)."""
    distance = math.sqrt(e @ np.linalg.solve(S, e))
    return np.asarray(S + (max(1.0, distance / HUBER_WIDTHS[len(e)]) - 1.0) * R)
