"""Velocity and covariance from the beams of a Doppler log, with all beams valid or some.

A beam of unit direction b measures ``z = b . v + n``, n ~ N(0, sigma²). Valid beams together have the information::

    Lambda = sum b b^T / sigma^2,      Lambda v = sum b z / sigma^2

With fewer than three beams, or three in one plane, some directions are not measured. The velocity is 0 along them, with
a sigma of `UNMEASURED_M_S`; odometry refuses such rows. docs/theory/beams.md.
"""

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats

UNMEASURED_M_S = 100.0
"""Standard deviation along a direction that no beam measured."""
PARTIAL_M2_S2 = 0.5 * UNMEASURED_M_S**2
"""Sum of variances beyond which a direction is unmeasured."""
_LEAST_SHARE = 1e-6
"""Share of the largest information below which a direction counts as not measured."""


def velocity_of_beams(
    directions: Floats, along_m_s: Floats, valid: NDArray[np.bool_], sigma_m_s: float
) -> tuple[Floats, Floats]:
    """Velocity and covariance of each ping.

    Parameters
    ----------
    directions
        Unit vectors, shape (beams, 3).
    along_m_s
        Velocity along each beam, shape (n, beams); what is not valid may be anything.
    valid
        Shape (n, beams).
    sigma_m_s
        White noise of a beam.

    Returns
    -------
    Velocity, shape (n, 3), m/s, and covariance, shape (n, 3, 3), m²/s², along the axes of the directions.

    Examples
    --------
    Four beams at 30° from the vertical, of a vehicle that moves ahead; the last beam is lost:

    >>> import numpy as np
    >>> from sonar_graph.devices import velocity_of_beams
    >>> tilt, turns = np.radians(30.0), np.radians([0, 90, 180, 270])
    >>> level = np.sin(tilt) * np.column_stack([np.cos(turns), np.sin(turns)])
    >>> directions = np.column_stack([level, np.full(4, -np.cos(tilt))])
    >>> along = (directions @ [0.5, 0.0, 0.0])[None]
    >>> velocity, covariance = velocity_of_beams(directions, along, np.array([[True, True, True, False]]), 0.01)
    >>> velocity.round(6) + 0.0
    array([[0.5, 0. , 0. ]])
    """
    velocity = np.zeros((len(valid), 3))
    covariance = np.empty((len(valid), 3, 3))
    # pings that lost the same beams share their geometry
    for pattern in np.unique(valid, axis=0):
        rows = (valid == pattern).all(axis=1)
        beams = directions[pattern]
        # along an axis with a small eigenvalue the beams measure nothing
        geometry, axes = np.linalg.eigh(beams.T @ beams)
        is_measured = geometry > max(_LEAST_SHARE * geometry[-1], np.finfo(float).tiny)
        per_geometry = 1.0 / np.where(is_measured, geometry, 1.0)
        inverse = (axes * (per_geometry * is_measured)) @ axes.T @ beams.T
        variances = np.where(
            is_measured, sigma_m_s**2 * per_geometry, UNMEASURED_M_S**2
        )
        # each ping by itself: its bits do not depend on the others
        along = along_m_s[rows][:, pattern, None]
        velocity[rows] = (inverse @ along)[:, :, 0]
        covariance[rows] = (axes * variances) @ axes.T
    return velocity, covariance


def is_partial(velocity_cov: Floats) -> NDArray[np.bool_]:
    """True for covariances of shape (n, 3, 3) with an unmeasured direction, shape (n,)."""
    return np.asarray(
        velocity_cov.diagonal(axis1=1, axis2=2).sum(axis=1) > PARTIAL_M2_S2
    )
