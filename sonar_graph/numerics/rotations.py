"""Rotations as arrays; in compiled loops over samples: `sonar_graph.numerics.matrices`.

Forster et al., "On-Manifold Preintegration", IEEE TRO 33(1), 2017, (3), (8), (9).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.measurements import Floats
from sonar_graph.numerics.jit import compiled

SMALL_ANGLE_RAD = 1e-4
"""Angle below which the series are exact to 1e-18 relative."""


@compiled
def cross_matrix(v: Floats) -> Floats:
    """[v]x with ``[v]x w = v x w``, shape (3, 3)."""
    m = np.zeros((3, 3))
    m[0, 1] = -v[2]
    m[0, 2] = v[1]
    m[1, 0] = v[2]
    m[1, 2] = -v[0]
    m[2, 0] = -v[1]
    m[2, 1] = v[0]
    return m


@compiled
def rotation_exp(phi: Floats) -> Floats:
    """Rotation matrix of a rotation vector (rad): ``I + a [phi]x + b [phi]x^2`` (Rodrigues), shape (3, 3)."""
    angle2 = phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2
    if angle2 < SMALL_ANGLE_RAD**2:
        a = 1.0 - angle2 / 6.0
        b = 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / angle2
    K = cross_matrix(phi)
    return np.eye(3) + a * K + b * (K @ K)


@compiled
def left_jacobian(phi: Floats) -> Floats:
    """Mean of ``Exp(s phi)`` over s in [0, 1]: turns a constant body velocity into a chord, shape (3, 3)."""
    angle2 = phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2
    if angle2 < SMALL_ANGLE_RAD**2:
        b = 0.5 - angle2 / 24.0
        c = 1.0 / 6.0 - angle2 / 120.0
    else:
        angle = np.sqrt(angle2)
        b = (1.0 - np.cos(angle)) / angle2
        c = (angle - np.sin(angle)) / (angle2 * angle)
    K = cross_matrix(phi)
    return np.eye(3) + b * K + c * (K @ K)


def running_rotations(turns: Floats) -> Floats:
    """``I, Exp(turns[0]), Exp(turns[0]) Exp(turns[1]), ...`` of n rotation vectors, (n + 1, 3, 3), by doubling."""
    products = Rotation.from_rotvec(np.concatenate([np.zeros((1, 3)), turns])).as_matrix()
    span = 1
    while span <= len(turns):  # each product spans so many turns, or all before it
        products[span:] = products[:-span] @ products[span:]
        span *= 2
    return products
