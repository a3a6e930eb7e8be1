"""Doppler velocities that no vehicle could have reached since the sample before, and rows that came too late.

A velocity v, t seconds after the last one u that was believed, both in body axes, is expected to differ by::

    S = Q_u + Q_v + (q^2 t + (w t |u|)^2) I,    q velocity walk of the calibration, w `TURNING_RAD_S` (w t at most 2)

since the velocity may change and the vehicle may turn. The squared Mahalanobis distance is gated far out, for what is
refused is lost; what passes is weighed by its noise. The gate widens while nothing is believed; with what it starts, at
first and after a long gap, `sonar_graph.navigation.velocity_doubt` decides. A row that leaves a direction unmeasured is
compared, but nothing with it. The gate knows stamps and velocities alone: what it refuses does not depend on how a log
is cut.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.interpolation import rows_until
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.stamped_rows import LATEST_NS
from sonar_graph.navigation.triples import (
    IDENTITY,
    ZERO,
    ZEROS,
    Matrix,
    Vector,
    cross,
    dot,
    matrix,
    minus,
    multiple_of,
    sum_of,
    times,
    transposed,
    vector,
)
from sonar_graph.navigation.velocity_covariances import is_partial

Flags = NDArray[np.bool_]

TURNING_RAD_S = 0.3
GATE = 44.8
"""Chi-square quantile of 1 - 1e-9, 3 degrees of freedom."""


class Verdict(NamedTuple):
    """On n rows."""

    distance: Floats
    """Squared, of each row from the last whole one believed, shape (n,)."""
    is_partial: Flags
    """Rows that leave a direction unmeasured, shape (n,)."""
    is_outlier: Flags
    """Shape (n,)."""
    is_plain: bool
    """Whether no row is either."""


@compiled
def judge(
    stamps: Ints,
    velocity: Floats,
    cov: Floats,
    known_ns: Ints,
    known_velocity: Floats,
    known_cov: Floats,
    walk: float,
    gate: float,
) -> Verdict:
    """Compare each row with the last whole one believed.

    Parameters
    ----------
    known_ns, known_velocity, known_cov
        Rows that are believed already; the one before the first row is the first that is compared with.
    walk
        Root spectral density of the velocity's random walk, m/s/√s.
    gate
        Squared distance beyond which a row is not believed.
    """
    n = len(stamps)
    distance, partial, outlier, is_plain = np.zeros(n), is_partial(cov), np.zeros(n, np.bool_), True
    before = rows_until(known_ns, stamps[0] - 1) - 1
    last_ns, u, Q = LATEST_NS, ZERO, ZEROS
    if before >= 0:
        last_ns, u, Q = known_ns[before], vector(known_velocity[before]), matrix(known_cov[before])
    for k in range(n):
        v, Q_v = vector(velocity[k]), matrix(cov[k])
        if stamps[k] > last_ns:
            distance[k] = _squared_distance(u, Q, v, Q_v, (stamps[k] - last_ns) * 1e-9, walk)
        outlier[k] = distance[k] > gate
        if not (outlier[k] or partial[k]):
            last_ns, u, Q = stamps[k], v, Q_v
        else:
            is_plain = False
    return Verdict(distance, partial, outlier, is_plain)


@compiled
def distance_between(u: Floats, Q_u: Floats, v: Floats, Q_v: Floats, t: float, walk: float) -> float:
    """Squared distance of a velocity v from one u, t seconds apart."""
    return _squared_distance(vector(u), matrix(Q_u), vector(v), matrix(Q_v), t, walk)


def changed(velocity: Floats, t: float, walk: float) -> float:
    """Variance about each axis of what a velocity may change in t seconds, m²/s²."""
    return walk**2 * t + min(TURNING_RAD_S * t, 2.0) ** 2 * float(velocity @ velocity)


@inlined
def _squared_distance(u: Vector, Q_u: Matrix, v: Vector, Q_v: Matrix, t: float, walk: float) -> float:
    """``e^T S^-1 e``, ``e = v - u``. Columns of S^-1 are cross products of rows of S, over its determinant."""
    e = minus(v, u)
    may_change = walk**2 * t + min(TURNING_RAD_S * t, 2.0) ** 2 * dot(u, u)
    x, y, z = sum_of(sum_of(Q_u, Q_v), multiple_of(may_change, IDENTITY))
    solved = times(transposed((cross(y, z), cross(z, x), cross(x, y))), e)
    return dot(e, solved) / dot(x, cross(y, z))
