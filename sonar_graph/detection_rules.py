"""What ranges, identities and their posteriors must be, wherever they come from.

A posterior is from 0 to 1, and so is its sum over the identities of a row. An identity becomes part of a variable's key
in a graph, which has 56 bits for it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ROUNDING = 1e-6
"""By which a sum of posteriors may exceed 1: single precision."""
FIRST_TOO_LARGE_ID = 2**56
FARTHEST_M = 100_000.0
"""No sonar sees farther, and the square of a range must remain a number."""
ID_ADVICE = "number the landmarks from 0 on, such as 1, 2, 3, where identities are made (a hash has no place)"


def no_posterior(probability: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Rows, shape (n, k), that are none: below 0, above 1 in sum, or no number, shape (n,)."""
    with np.errstate(invalid="ignore", over="ignore"):
        is_one = (probability >= 0).all(axis=1) & (probability.sum(axis=1) <= 1.0 + ROUNDING)
    return np.asarray(~is_one)


def too_large(ids: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Rows, shape (n, k), with an identity for which a key has no room, shape (n,)."""
    return np.asarray((ids >= FIRST_TOO_LARGE_ID).any(axis=1))


def possible_ranges(range_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which ranges a sonar can have measured, shape (n,)."""
    return np.asarray((range_m > 0) & (range_m <= FARTHEST_M))
