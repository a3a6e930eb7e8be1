"""Covariances of Doppler velocities: what holds where they are not said, and which say that a part was measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonar_graph.doppler_beams import UNMEASURED_M_S
from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled


@compiled
def in_numbers(velocity_cov: Floats, unsaid: Floats) -> Floats:
    """Covariances of shape (n, 3, 3) to compute with.

    Parameters
    ----------
    unsaid
        What holds where a number is NaN, shape (3, 3).

    Returns
    -------
    The same, with `UNMEASURED_M_S` and no correlation along axes whose variance is infinite.
    """
    numbers = np.empty(velocity_cov.shape)
    for k in range(len(numbers)):
        said = velocity_cov[k]
        for i in range(3):
            for j in range(3):
                if np.isinf(said[i, i]) or np.isinf(said[j, j]):
                    numbers[k, i, j] = UNMEASURED_M_S**2 if i == j else 0.0
                else:
                    numbers[k, i, j] = unsaid[i, j] if np.isnan(said[i, j]) else said[i, j]
    return numbers


@compiled
def is_partial(velocity_cov: Floats) -> NDArray[np.bool_]:
    """Rows with a direction of which nothing was measured, shape (n,), from covariances of shape (n, 3, 3)."""
    partial = np.empty(len(velocity_cov), np.bool_)
    for k in range(len(partial)):
        cov = velocity_cov[k]
        partial[k] = cov[0, 0] + cov[1, 1] + cov[2, 2] > 0.5 * UNMEASURED_M_S**2
    return partial
