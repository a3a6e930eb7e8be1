"""What depth samples over an interval say about its end.

Each sample is carried to the end by the vehicle's own odometry. Its noise is white, r, but the error of carrying it
grows as a random walk of q m²/s, and is shared by all samples that are older. The best weights are those of a Kalman
filter for a random walk, started from nothing::

    P <- P + q dt,    K = P / (P + r_k),    w <- (1 - K) w,  w_k = K,    P <- (1 - K) P

so that samples count for as long as q lets them: about sqrt(r dt / q). For q = 0 the weights are the inverse variances.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled


@compiled
def weights_at_end(variance_m2: Floats, before_end_s: Floats, wander_m2_s: float) -> tuple[Floats, float]:
    """Weights of the samples in the height at the end, and that height's variance.

    Parameters
    ----------
    variance_m2
        r of each sample, in order of time, shape (n,), n >= 1.
    before_end_s
        Time from each sample to the end, not increasing, shape (n,).
    wander_m2_s
        q, the spectral density of the odometry's vertical velocity noise, m²/s.

    Returns
    -------
    Weights with sum 1, shape (n,), and the variance, m².
    """
    weights = np.zeros(len(variance_m2))
    weights[0], P = 1.0, variance_m2[0]
    for k in range(1, len(variance_m2)):
        P += wander_m2_s * (before_end_s[k - 1] - before_end_s[k])
        gain = P / (P + variance_m2[k])
        weights *= 1.0 - gain
        weights[k] = gain
        P *= 1.0 - gain
    return weights, P + wander_m2_s * max(before_end_s[-1], 0.0)
