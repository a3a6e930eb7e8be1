"""Which sightings belong, found without a good start: graduated non-convexity on the truncated cost.

Yang, Antonante, Tzoumas, Carlone, "Graduated non-convexity for robust spatial perception", IEEE RA-L 5(2), 2020. Every
watch g is of the landmark that it names (r_g^2 its squared error) or of none (a constant c_g^2)::

    min_x  sum_g min(r_g^2, c_g^2) / 2 + |odometry and all else|^2 / 2                                           (1)

which is the max-mixture of these two components: ``c_g^2 / 2`` is how much more probable a perfect fit is than none.
The minimum in (1) is graduated by mu, from nearly convex to (1) itself; each mu weighs watches by the paper's (14)::

    w = 0  where r^2 >= (mu + 1) / mu c^2,   1  where r^2 <= mu / (mu + 1) c^2,   else  c / r sqrt(mu (mu + 1)) - mu

Odometry and all other factors are known inliers. GTSAM has this too (`gtsam.GncLMOptimizer`), but weighs each factor
alone where a watch is to be kept or dropped as a whole, and calls each factor in Python with a copy of all values.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.slam.batch import solve

MU_FACTOR = 1.4
"""By which mu grows, as in the paper."""
STEPS_EACH = 2
"""Levenberg-Marquardt steps at each mu."""
MOST_GRADES = 60
DECIDED = 1e-3
"""Weights so near to 0 and 1 end it."""


def truncated_weights(r2: Floats, c2: Floats, mu: float) -> Floats:
    """Weights of squared errors r2 truncated at c2, shape (n,) each."""
    with np.errstate(divide="ignore"):
        between = np.sqrt(c2 * mu * (mu + 1.0) / r2) - mu
    return np.where(r2 <= mu / (mu + 1.0) * c2, 1.0, np.where(r2 >= (mu + 1.0) / mu * c2, 0.0, between))


def first_mu(r2: Floats, c2: Floats) -> float:
    """At which (1) is nearly convex: the largest error is still weighed."""
    worst = float((r2 / c2).max(initial=0.0))
    return 1.0 / (2.0 * worst - 1.0) if worst > 1.0 else np.inf


def graduate(
    weighted: Callable[[Floats], gtsam.NonlinearFactorGraph],
    squared_errors: Callable[[gtsam.Values], Floats],
    c2: Floats,
    values: gtsam.Values,
) -> tuple[gtsam.Values, Floats]:
    """The solution of (1), and which watches it keeps, shape (n,): weights of 0 or 1, or nearly.

    Parameters
    ----------
    weighted
        The graph in which the watches have these weights.
    squared_errors
        r2 of the watches.
    """
    mu = first_mu(squared_errors(values), c2)
    weights = np.ones(len(c2))
    for _ in range(MOST_GRADES if np.isfinite(mu) else 0):
        weights = truncated_weights(squared_errors(values), c2, mu)
        values = solve(weighted(weights), values, STEPS_EACH)
        if ((weights < DECIDED) | (weights > 1.0 - DECIDED)).all():
            break
        mu *= MU_FACTOR
    return values, weights
