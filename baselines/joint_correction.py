"""Correction of a covariance by m numbers at once, symmetric to the last bit.

With the Cholesky factor ``S = L L^T``, ``W = L^-1 H P`` and ``y = L^-1 e``: ``P <- P - W^T W`` and ``K e = W^T y``,
row by row. It is the textbook's ``(I - K H) P`` in a form whose products commute.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import inlined


@inlined
def correct_jointly(P: Floats, n: int, cross_cov: Floats, S: Floats, innovation: Floats, shifted: Floats) -> None:
    """Take from P what was measured, and add ``K e`` to a vector.

    Parameters
    ----------
    P
        Covariance; its first n rows and columns are in use.
    cross_cov
        ``H P``, shape (m, n or more); overwritten.
    S
        Innovation covariance, shape (m, m).
    innovation
        Measured minus predicted, shape (m,).
    shifted
        Shape (n,) or longer.
    """
    L, W, y = np.linalg.cholesky(S), cross_cov, innovation.copy()
    for r in range(len(L)):
        for c in range(r):
            W[r] -= L[r, c] * W[c]
            y[r] -= L[r, c] * y[c]
        W[r] /= L[r, r]
        y[r] /= L[r, r]
        for i in range(n):
            for j in range(n):
                P[i, j] -= W[r, i] * W[r, j]
            shifted[i] += W[r, i] * y[r]
