"""The chi-square distribution, digit for digit that of scipy.stats, which takes a second to load."""

from functools import cache

import numpy as np
from scipy.special import chdtr, chdtri, gammaincinv

from sonar_graph.measurements import Floats


@cache  # gates use the same few at every frame
def chi_square_quantile(probability: float, dof: float) -> float:
    """Value that a chi-square variable of so many degrees of freedom stays below with this probability.

    As a gate: the squared Mahalanobis distance that a true innovation of ``dof`` components stays below.

    Examples
    --------
    >>> from sonar_graph.numerics import chi_square_quantile
    >>> round(chi_square_quantile(0.95, 2), 3)
    5.991
    """
    # half a chi-square variable has the gamma distribution of shape dof / 2
    return 2.0 * float(gammaincinv(0.5 * dof, probability))


def chi_square_exceeded(probability: float, dof: float) -> float:
    """Value that a chi-square variable exceeds with this probability; exact for tiny probabilities."""
    return float(chdtri(dof, probability))


def chi_square_share(values: Floats, dof: float) -> Floats:
    """Probability that a chi-square variable stays below each of the values, of the same shape."""
    return np.asarray(chdtr(dof, values), np.float64)
