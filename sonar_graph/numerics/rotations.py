"""Rotations as arrays; in compiled loops over samples: `sonar_graph.numerics.matrices`."""

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.measurements import Floats


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


def running_rotations(turns: Floats) -> Floats:
    """``I, Exp(turns[0]), Exp(turns[0]) Exp(turns[1]), ...`` of n rotation vectors, (n + 1, 3, 3), by doubling."""
    products = Rotation.from_rotvec(np.concatenate([np.zeros((1, 3)), turns])).as_matrix()
    span = 1
    while span <= len(turns):  # each product spans so many turns, or all before it
        products[span:] = products[:-span] @ products[span:]
        span *= 2
    return products
