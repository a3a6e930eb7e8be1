"""What a sonar sees, and where it is, from a body that is a motion (dR, dp) after the state: the same for both filters.

All vectors are in the axes of the state's body, where neither filter's choice of error matters. A landmark p lies at
``p_n = R^T (p - X)``, ``p_b = dR^T (p_n - dp)`` in the body then, and what is seen of it changes along ::

    n = dR body_R_sonar D_q^T        for range and azimuth each, D_q of `sonar_graph.slam.models.sonar_model.project`

A detection shows the point ``s = dp + dR (body_p_sonar + body_R_sonar q)``.

Landmarks seen again when the vehicle may be far from where it is predicted: linear at the place that was seen.

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

Correction of a covariance by m numbers at once, symmetric to the last bit.

With the Cholesky factor ``S = L L^T``, ``W = L^-1 H P`` and ``y = L^-1 e``: ``P <- P - W^T W`` and ``K e = W^T y``,
row by row. It is the textbook's ``(I - K H) P`` in a form whose products commute.
"""

from __future__ import annotations

import math

import numpy as np

from baselines.filter_inputs import Noise, SonarModel
from sonar_graph.measurements import Floats
from sonar_graph.navigation.preintegration import Integral
from sonar_graph.numerics import (
    Matrix,
    Vector,
    compiled,
    inlined,
    minus,
    product,
    times,
    transformed,
    transposed,
    vector,
)
from sonar_graph.slam.models import floor_elevation, project, sonar_point


@inlined
def predicted_view(
    X: Vector, R: Matrix, motion: Integral, sonar: SonarModel, p: Vector
) -> tuple[Floats, Vector, Vector, Vector]:
    """Range and azimuth of a landmark (2,), p_n, and n of each."""
    p_n = times(transposed(R), minus(p, X))
    p_b = times(transposed(motion.dR), minus(p_n, motion.dp))
    q = times(transposed(sonar.body_R_sonar), minus(p_b, sonar.body_p_sonar))
    z, D_q = project(np.array(q))
    node_R_sonar = product(motion.dR, sonar.body_R_sonar)
    return z, p_n, times(node_R_sonar, vector(D_q[0])), times(node_R_sonar, vector(D_q[1]))


@inlined
def point_seen(motion: Integral, sonar: SonarModel, z: tuple[float, float], elevation_rad: float) -> Vector:
    """The point s that a detection shows."""
    p_b = transformed(sonar.body_p_sonar, sonar.body_R_sonar, vector(sonar_point(z[0], z[1], elevation_rad)))
    return transformed(motion.dp, motion.dR, p_b)


@inlined
def elevation_of_new(X: Vector, R: Matrix, motion: Integral, sonar: SonarModel, z: tuple[float, float]) -> float:
    """Elevation of a new landmark: that on the floor; 0 without one, or where it is outside the aperture."""
    if not sonar.has_floor:
        return 0.0
    node_p_sonar = transformed(motion.dp, motion.dR, sonar.body_p_sonar)
    world_R_sonar = product(product(R, motion.dR), sonar.body_R_sonar)
    height_m = sonar.floor_z_m - transformed(X, R, node_p_sonar)[2]
    elevation = floor_elevation(np.array(world_R_sonar[2]), height_m, z[0], z[1], sonar.aperture_rad)
    return 0.0 if math.isnan(elevation) else elevation


@inlined
def noise_of_view(R_z: Noise, aperture_rad: float) -> Matrix:
    """Covariance of range, azimuth and an elevation anywhere in the aperture: variance ``aperture^2 / 12``."""
    return (R_z[0], R_z[1], 0.0), (R_z[1], R_z[2], 0.0), (0.0, 0.0, aperture_rad**2 / 12.0)


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
