"""Landmarks seen again when the vehicle may be far from where it is predicted: linear at the place that was seen.

Range and azimuth of a landmark are linear in its place relative to the vehicle only as long as that is known well. With
Sigma the covariance of the place, A and L its variances along the beam and across it in the sonar's plane, what the
linearisation at the predicted place leaves out has the sizes ::

    range:  L / (2 r)          azimuth:  sqrt(L A) / r^2                                                      (1)

Beyond the noise of the detection they make a filter sure of what is wrong: after 120 s without Doppler log the position
may err by tens of metres, and a landmark 10 m off lies in any direction. The place g(z, elevation) that a detection
shows has no such error, however far the vehicle is from where it was predicted, for it is taken at what was measured.
The landmark p must be there::

    0 = p - g(x_v, z, elevation),    noise  G_z V G_z^T                                                       (2)

linear in both positions. V holds the noise of the detection and, as for a new landmark, an elevation of
``aperture^2 / 12``, and for a beam that is not level ``E[(r e^2 / 2)^2] = r^2 aperture^4 / 320`` of its length.
Once the landmark is placed so, (1) holds again. Derivation and figures: docs/theory/gaps.md.
"""

from __future__ import annotations

import numpy as np

from baselines.filter_detections import Noise
from baselines.sonar_views import noise_of_view
from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled


@compiled
def is_beyond_linear(cov: Floats, G_z: Floats, range_m: float, R_z: Noise) -> bool:
    """Whether (1) is more than the sigma of a detection.

    Parameters
    ----------
    cov
        Sigma, shape (3, 3), m².
    G_z
        Of the point by (range, azimuth, elevation) at elevation 0, shape (3, 3): unit vector along the beam, and those
        across it times the range.
    R_z
        Variance of the range, covariance, variance of the azimuth.
    """
    along, across = G_z[:, 0].copy(), G_z[:, 1].copy()
    A, L_r2 = along @ cov @ along, across @ cov @ across
    is_far_in_range = L_r2 > 2.0 * range_m**3 * np.sqrt(R_z[0])
    return bool(is_far_in_range or A * L_r2 > range_m**6 * R_z[2])


@compiled
def view_noise(range_m: float, R_z: Noise, aperture_rad: float) -> Floats:
    """V of (2): covariance of range, azimuth and elevation, shape (3, 3)."""
    V = np.array(noise_of_view(R_z, aperture_rad))
    V[0, 0] += range_m**2 * aperture_rad**4 / 320.0
    return V


@compiled
def by_range_and_azimuth(G_z: Floats, range_m: float) -> Floats:
    """What a shift of the point is in range and azimuth, shape (2, 3): for the gate and the record."""
    B = np.empty((2, 3))
    B[0], B[1] = G_z[:, 0], G_z[:, 1] / range_m**2
    return B
