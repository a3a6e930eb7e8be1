"""Doppler velocities that no vehicle could have reached since the sample before, and rows that came too late.

A velocity v, t seconds after the last one u that was believed, both in body axes, is expected to differ by::

    S = Q_u + Q_v + (q t + (w t |u|)^2) I,    q velocity walk of the calibration, w `TURNING_RAD_S` (w t at most 2)

since the velocity may change and the vehicle may turn. The squared Mahalanobis distance is gated far out, for what is
refused is lost; what passes is weighed by its noise. The gate widens while nothing is believed, so that a wrong first
sample costs seconds, not the run. A row that leaves a direction unmeasured is compared, but nothing with it. The gate
knows stamps and velocities alone: what it refuses does not depend on how a log is cut.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import compiled

TURNING_RAD_S = 0.3
GATE = 44.8
"""Chi-square quantile of 1 - 1e-9, 3 degrees of freedom."""


@compiled
def distances(
    stamps: Ints,
    velocity: Floats,
    cov: Floats,
    partial: NDArray[np.bool_],
    last_ns: int,
    last_velocity: Floats,
    last_cov: Floats,
    walk: float,
) -> Floats:
    """Squared distance of each row from the last whole one believed, shape (n,); rows above `GATE` are not believed.

    Parameters
    ----------
    partial
        Rows that leave a direction unmeasured, shape (n,).
    last_ns, last_velocity, last_cov
        The row believed before the first; a stamp not before the first row's: there is none.
    walk
        Root spectral density of the velocity's random walk, m/s/√s.
    """
    found = np.zeros(len(stamps))
    for k in range(len(stamps)):
        t = (stamps[k] - last_ns) * 1e-9
        if t > 0.0:
            speed2 = last_velocity[0] ** 2 + last_velocity[1] ** 2 + last_velocity[2] ** 2
            S = last_cov + cov[k]
            S += np.eye(3) * (walk**2 * t + min(TURNING_RAD_S * t, 2.0) ** 2 * speed2)
            change = velocity[k] - last_velocity
            found[k] = change @ np.linalg.solve(S, change)
        if found[k] <= GATE and not partial[k]:
            last_ns, last_velocity, last_cov = stamps[k], velocity[k], cov[k]
    return found
