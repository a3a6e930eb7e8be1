"""Landmark detections in a filter: predicted view, gate, elevation, and the update that both filters share.

Everything is in the axes of the state's body, a motion (dR, dp) before the frame, where neither filter's choice of
error matters. A landmark p lies at ``p_n = R^T (p - X)``; in the body at the frame at ``p_b = dR^T (p_n - dp)``. Range
and azimuth change along ``n = dR body_R_sonar D_q^T``, with one row of D_q (`sonar_graph.slam.models.project`) each.
A detection shows the point ``s = dp + dR (body_p_sonar + body_R_sonar q)``.

Far landmarks. Let Sigma be the covariance of the landmark's place relative to the vehicle, A and L its variances along
the beam and across it in the sonar's plane. The linearisation at the predicted place leaves out ::

    range:  L / (2 r)          azimuth:  sqrt(L A) / r^2                                                      (1)

Where that exceeds the noise of the detection, the landmark is compared with the point seen instead ::

    0 = p - g(x_v, z, elevation),    noise  G_z V G_z^T                                                       (2)

which is linear in both positions. V holds the noise of the detection, an elevation variance of ``aperture^2 / 12``, and
``r^2 aperture^4 / 320`` for the length of a beam that is not level. Derivation: docs/theory/gaps.md.
"""

import math
from typing import NamedTuple

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.preintegration import Integral
from sonar_graph.numerics import (
    Matrix,
    Vector,
    compiled,
    inlined,
    matrix,
    minus,
    product,
    times,
    transformed,
    transposed,
    vector,
)
from sonar_graph.slam.landmarks import gate_threshold
from sonar_graph.slam.models import floor_elevation, project, sonar_point

USED, NEW, GATED, PASSED_OVER = 0, 1, 2, 3
"""Outcome of a detection in compiled code."""
NO_SLOT = -1
"""Slot of a detection that is not used."""
DetectionColumns = tuple[Ints, Floats, Floats, Floats]
"""Slot of each row's landmark in the state, the next free one for a new landmark, or NO_SLOT (m,); range in m and
azimuth in rad (m,); their covariance (m, 2, 2), NaN where the log has none."""
DetectionOutcomes = tuple[Ints, Floats, Floats]
"""USED, NEW, GATED or PASSED_OVER (m,); innovations (m, 2) and their covariances (m, 2, 2), NaN without prediction."""
Noise = tuple[float, float, float]
"""Variance of the range, covariance, variance of the azimuth."""


class SonarModel(NamedTuple):
    """Sonar mounting and noise, gate, and floor."""

    body_R_sonar: Matrix
    body_p_sonar: Vector
    gate: float
    """Squared Mahalanobis distance beyond which an innovation is refused."""
    aperture_rad: float
    range_variance_m2: float
    """Used where the log has none."""
    azimuth_variance: float
    """Used where the log has none, rad²."""
    has_floor: bool
    floor_z_m: float
    floor_variance_m2: float


SonarValues = tuple[Matrix, Vector, float, float, float, float, bool, float, float]
"""Fields of a `SonarModel`."""


def sonar_model(calibration: Calibration, gate_probability: float) -> SonarModel:
    """The model of a calibration."""
    body_T_sonar = calibration.sonar.mounting.pose()
    floor = calibration.floor
    return SonarModel(
        body_R_sonar=matrix(body_T_sonar.rotation().matrix()),
        body_p_sonar=calibration.sonar.mounting.translation_m,
        gate=gate_threshold(gate_probability, 2),
        aperture_rad=calibration.sonar.elevation_aperture_rad,
        range_variance_m2=calibration.sonar.range_sigma_m**2,
        azimuth_variance=calibration.sonar.azimuth_sigma_rad**2,
        has_floor=floor is not None,
        floor_z_m=floor.z_m if floor else 0.0,
        floor_variance_m2=floor.sigma_m**2 if floor else 1.0,
    )


class Frame(NamedTuple):
    """The detections of one instant, among those of a window."""

    detections: DetectionColumns
    first: int
    last: int
    """Rows from the first up to, without, the last."""
    outcomes: DetectionOutcomes
    """Written at these rows."""
    was_lost: bool
    """True once the Doppler log has lost the bottom: landmarks may then be far from where they are predicted, (1)."""


class DetectionRow(NamedTuple):
    """One detection, and where to write its innovation."""

    slot: int
    z: tuple[float, float]
    """Range in m and azimuth in rad."""
    R_z: Noise
    innovation: Floats
    """Shape (2,)."""
    S: Floats
    """Covariance of the innovation, shape (2, 2)."""


@compiled
def no_outcomes(rows: int) -> DetectionOutcomes:
    """Arrays for the outcomes of some detections."""
    return np.empty(rows, np.int64), np.full((rows, 2), np.nan), np.full((rows, 2, 2), np.nan)


@inlined
def detection_row(frame: Frame, row: int, sonar: SonarModel) -> DetectionRow:
    """One row of a frame, with the noise of the log or else of the calibration."""
    slots, range_m, azimuth_rad, noise = frame.detections
    logged = noise[row]
    if math.isnan(logged[0, 0] + logged[0, 1] + logged[1, 0] + logged[1, 1]):
        R_z = sonar.range_variance_m2, 0.0, sonar.azimuth_variance
    else:
        R_z = logged[0, 0], 0.5 * (logged[0, 1] + logged[1, 0]), logged[1, 1]
    z = range_m[row], azimuth_rad[row]
    return DetectionRow(slots[row], z, R_z, frame.outcomes[1][row], frame.outcomes[2][row])


@inlined
def is_inside_gate(seen: DetectionRow, sonar: SonarModel) -> bool:
    """True where ``e^T S^-1 e`` of the innovation is within the gate."""
    e, S = seen.innovation, seen.S
    determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    squared = (S[1, 1] * e[0] * e[0] - (S[0, 1] + S[1, 0]) * e[0] * e[1] + S[0, 0] * e[1] * e[1]) / determinant
    return bool(squared <= sonar.gate)


@inlined
def predicted_view(
    X: Vector, R: Matrix, motion: Integral, sonar: SonarModel, p: Vector
) -> tuple[Floats, Vector, Vector, Vector]:
    """Predicted range and azimuth (2,) of a landmark, p_n, and n of range and of azimuth."""
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
    """Elevation of a new landmark: on the floor, or 0 without a floor within the aperture."""
    if not sonar.has_floor:
        return 0.0
    node_p_sonar = transformed(motion.dp, motion.dR, sonar.body_p_sonar)
    world_R_sonar = product(product(R, motion.dR), sonar.body_R_sonar)
    height_m = sonar.floor_z_m - transformed(X, R, node_p_sonar)[2]
    elevation = floor_elevation(np.array(world_R_sonar[2]), height_m, z[0], z[1], sonar.aperture_rad)
    return 0.0 if math.isnan(elevation) else elevation


@inlined
def polar_covariance(R_z: Noise, aperture_rad: float) -> Matrix:
    """Covariance of range, azimuth and elevation; the latter is uniform in the aperture: ``aperture^2 / 12``."""
    return (R_z[0], R_z[1], 0.0), (R_z[1], R_z[2], 0.0), (0.0, 0.0, aperture_rad**2 / 12.0)


@compiled
def is_beyond_linear(cov: Floats, G_z: Floats, range_m: float, R_z: Noise) -> bool:
    """True where the linearisation error (1) exceeds the sigma of the detection.

    ``cov`` is Sigma (3, 3), m²; G_z the derivative of the point by (range, azimuth, elevation) at elevation 0 (3, 3).
    """
    along, across = G_z[:, 0].copy(), G_z[:, 1].copy()
    A, L_r2 = along @ cov @ along, across @ cov @ across
    is_far_in_range = L_r2 > 2.0 * range_m**3 * np.sqrt(R_z[0])
    return bool(is_far_in_range or A * L_r2 > range_m**6 * R_z[2])


@compiled
def far_polar_covariance(range_m: float, R_z: Noise, aperture_rad: float) -> Floats:
    """V of (2): covariance of range, azimuth and elevation, shape (3, 3)."""
    V = np.array(polar_covariance(R_z, aperture_rad))
    V[0, 0] += range_m**2 * aperture_rad**4 / 320.0
    return V


@compiled
def range_azimuth_jacobian(G_z: Floats, range_m: float) -> Floats:
    """Derivative of range and azimuth by the point, shape (2, 3): for the gate and the recorded innovation."""
    B = np.empty((2, 3))
    B[0], B[1] = G_z[:, 0], G_z[:, 1] / range_m**2
    return B


@inlined
def correct_jointly(P: Floats, n: int, cross_cov: Floats, S: Floats, innovation: Floats, shifted: Floats) -> None:
    """Update the covariance by m numbers at once and add ``K e`` to a vector.

    With ``S = L L^T``, ``W = L^-1 H P`` and ``y = L^-1 e``: ``P <- P - W^T W`` and ``K e = W^T y``, row by row. The
    products commute, so that P stays symmetric to the last bit.

    ``cross_cov`` is ``H P`` (m, n or more), overwritten; S (m, m); the innovation (m,); ``shifted`` (n,) or longer.
    Only the first n rows and columns of P are used.
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
