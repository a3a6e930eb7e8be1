"""Update of a filter, and what it does about doubtful detections: gate, kernel, landmarks far from where predicted.

Derivation: docs/theory/fair_comparison.md (gate, kernel), docs/theory/gaps.md (far landmarks).
"""

import math
from typing import NamedTuple

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats, Ints
from sonar_graph.models import elevation_on_floor, gate_threshold
from sonar_graph.numerics import compiled
from sonar_graph.states import OUTCOME_NUMBERS, Outcome

USED, GATED, NEW, LET_IN = (OUTCOME_NUMBERS[o] for o in (Outcome.USED, Outcome.GATED, Outcome.NEW, Outcome.LET_IN))
OUTLYING, JUDGED_TOGETHER = -2.0 * math.log(0.001), 10
"""Squared Mahalanobis distance that one right detection in a thousand exceeds, and number of detections of which most
tell: with a tenth of outliers six of ten are so once in 7,000 times, ``P(Bin(10, 0.1) > 5) = 1.5e-4``."""
MEDIAN = 2.0 * math.log(2.0)
"""Of a squared Mahalanobis distance of two numbers."""
MOST_LANDMARKS = 1 << 16


@compiled
def correction(P: Floats, U: Floats, S: Floats, e: Floats) -> Floats:
    """``K e`` (n,) of an update by m numbers, ``K = P H^T S^-1``, from ``U = H P`` (m, n); P becomes ``P - K S K^T``.

    With ``S = L L^T`` and ``V = L^-1 U`` that is ``P - V^T V``, row by row. Both factors of every product commute, so
    that P stays symmetric to the last bit. Raises LinAlgError where S is not positive definite.
    """
    n, L, V, y, Ke = len(P), S.copy(), U.copy(), e.copy(), np.zeros(len(P))
    for r in range(len(e)):
        if not L[r, r] > 0.0:
            raise np.linalg.LinAlgError("the covariance of an innovation is not positive definite")
        root = math.sqrt(L[r, r])
        y[r] /= root
        for i in range(n):
            V[r, i] /= root
        for k in range(r + 1, len(e)):
            L[k, r] /= root
            y[k] -= L[k, r] * y[r]
            for i in range(n):
                V[k, i] -= L[k, r] * V[r, i]
            for c in range(r + 1, k + 1):
                L[k, c] -= L[k, r] * L[c, r]
        for i in range(n):
            Ke[i] += V[r, i] * y[r]
            for j in range(n):
                P[i, j] -= V[r, i] * V[r, j]
    return Ke


class Gate(NamedTuple):
    """Doubt about detections: a gate that refuses, and a kernel that widens the noise of outliers."""

    threshold: float
    """Squared Mahalanobis distance beyond which an innovation is refused."""
    width: float
    """Of the kernel, in standard deviations; infinite: none."""
    squared: Floats
    """Squared Mahalanobis distances of the last detections of trusted landmarks, as a ring."""
    judged: Ints
    """Number of these detections so far, shape (1,)."""
    agreed: Ints
    """Number of detections that were no outliers, by the landmark's place in the state, modulo its length."""

    @classmethod
    def of(cls, gate_probability: float, kernel_width: float) -> "Gate":
        """The gate and kernel of a filter's settings (`FilterParams`), with nothing judged yet."""
        threshold, width = gate_threshold(gate_probability, 2), kernel_width or math.inf
        squared, agreed = np.zeros(JUDGED_TOGETHER), np.zeros(MOST_LANDMARKS, np.int64)
        return cls(threshold, width, squared, np.zeros(1, np.int64), agreed)


@compiled
def admit(e: Floats, S: Floats, R_z: Floats, gate: Gate, landmark: int) -> tuple[int, Floats]:
    """Judge an innovation of range and azimuth: `USED`, `GATED` or `LET_IN`, and what the kernel adds to R_z (2, 2).

    The kernel's weights w_i at ``e_i / sqrt(S_ii)`` make ``R_ij / sqrt(w_i w_j)`` of the noise. While most of the last
    detections of trusted landmarks are outliers, S is too small: the gate takes it times what makes the median of these
    fit, and there is no kernel. A landmark is trusted after as many agreements as it takes outliers for that; one that
    began by a wrong name has hardly any. docs/theory/fair_comparison.md.
    """
    squared = S[1, 1] * e[0] ** 2 - 2.0 * S[0, 1] * e[0] * e[1] + S[0, 0] * e[1] ** 2
    squared /= S[0, 0] * S[1, 1] - S[0, 1] ** 2
    widened, landmark = np.zeros((2, 2)), landmark % MOST_LANDMARKS
    if 2 * gate.agreed[landmark] > JUDGED_TOGETHER:
        gate.squared[gate.judged[0] % JUDGED_TOGETHER] = squared
        gate.judged[0] += 1
    gate.agreed[landmark] += squared <= OUTLYING
    is_too_small = 2 * np.sum(gate.squared > OUTLYING) > JUDGED_TOGETHER
    excess = np.median(gate.squared) / MEDIAN if is_too_small else 1.0
    if not squared <= excess * gate.threshold:
        return GATED, widened
    if is_too_small:
        return USED if squared <= gate.threshold else LET_IN, widened
    spread = np.empty(2)
    for i in range(2):
        spread[i] = math.sqrt(1.0 + e[i] ** 2 / (S[i, i] * gate.width**2))
    for i in range(2):
        for j in range(2):
            widened[i, j] = (spread[i] * spread[j] - 1.0) * R_z[i, j]
    return USED, widened


class SonarModel(NamedTuple):
    """Sonar mounting and noise, gate, and floor."""

    body_R_sonar: Floats
    body_p_sonar: Floats
    gate: Gate
    aperture_rad: float
    R_z: Floats
    """Covariance of range and azimuth where the log has none, shape (2, 2)."""
    floor_z_m: float
    """NaN where it is not known."""
    floor_variance_m2: float
    body_T_sonar: gtsam.Pose3

    @classmethod
    def of(cls, calibration: Calibration, gate: Gate) -> "SonarModel":
        """The model of a calibration, with the gate of a filter."""
        sonar, floor = calibration.sonar, calibration.floor
        return cls(
            body_R_sonar=np.ascontiguousarray(sonar.mounting.pose().rotation().matrix()),
            body_p_sonar=np.array(sonar.mounting.translation_m),
            gate=gate,
            aperture_rad=sonar.elevation_aperture_rad,
            R_z=np.diag([sonar.range_sigma_m**2, sonar.azimuth_sigma_rad**2]),
            floor_z_m=floor.z_m if floor else math.nan,
            floor_variance_m2=floor.sigma_m**2 if floor else math.nan,
            body_T_sonar=sonar.mounting.pose(),
        )

    def elevation_of_new(self, R: Floats, X: Floats, z: Floats) -> float:
        """Elevation of a new landmark seen from a body: on the floor, or 0 without a floor within the aperture."""
        world_T_sonar = gtsam.Pose3(gtsam.Rot3(R), X).compose(self.body_T_sonar)
        return elevation_on_floor(world_T_sonar, z[0], z[1], self.floor_z_m, self.aperture_rad) or 0.0


@compiled
def read(range_m: Floats, azimuth_rad: Floats, logged: Floats, R_z: Floats) -> tuple[Floats, Floats]:
    """Detections z (m, 2) and their covariances (m, 2, 2): symmetric, and R_z where the log has none."""
    z, noise = np.empty((len(range_m), 2)), np.empty(logged.shape)
    for k in range(len(z)):
        z[k, 0], z[k, 1] = range_m[k], azimuth_rad[k]
        cross = 0.5 * (logged[k, 0, 1] + logged[k, 1, 0])
        is_known = not math.isnan(logged[k, 0, 0] + cross + logged[k, 1, 1])
        noise[k, 0, 0], noise[k, 1, 1] = (logged[k, 0, 0], logged[k, 1, 1]) if is_known else (R_z[0, 0], R_z[1, 1])
        noise[k, 0, 1] = noise[k, 1, 0] = cross if is_known else R_z[0, 1]
    return z, noise


def polar_covariance(R_z: Floats, aperture_rad: float) -> Floats:
    """Covariance of range, azimuth and elevation (3, 3); the latter is uniform in the aperture: ``aperture^2 / 12``."""
    V = np.diag([0.0, 0.0, aperture_rad**2 / 12.0])
    V[:2, :2] = R_z
    return V


def far_view(
    missed: Floats, cov: Floats, G_z: Floats, sonar: SonarModel, z: Floats, R_z: Floats, landmark: int
) -> tuple[int, Floats, Floats, Floats] | None:
    """Compare a landmark with the point seen, which is linear in both positions; None where `observe` is linear enough.

    With the variances A along the beam and L across it, in the sonar's plane, the linearisation at the predicted place
    leaves out ``L / (2 r)`` of the range and ``sqrt(L A) / r^2`` of the azimuth. Where that exceeds the noise of the
    detection, its place ``0 = g(x_v, z, elevation) - p`` counts instead, with an elevation variance ``aperture^2 / 12``
    and ``r^2 aperture^4 / 320`` for the length of a beam that is not level. docs/theory/gaps.md.

    Parameters
    ----------
    missed, cov
        The point seen at elevation 0 less the landmark, (3,), and its covariance by state and motion, (3, 3).
    G_z
        Derivative of the point seen by (range, azimuth, elevation), (3, 3).

    Returns
    -------
    Outcome by `admit`; the covariance with the noise of the detection (3, 3); the innovation of range and azimuth (2,)
    and its covariance.
    """
    r, along, across = z[0], G_z[:, 0], G_z[:, 1]
    A, L_r2 = along @ cov @ along, across @ cov @ across
    if L_r2 <= 2.0 * r**3 * math.sqrt(R_z[0, 0]) and A * L_r2 <= r**6 * R_z[1, 1]:
        return None
    V = polar_covariance(R_z, sonar.aperture_rad)
    V[0, 0] += r**2 * sonar.aperture_rad**4 / 320.0
    cov = cov + G_z @ V @ G_z.T
    cov = 0.5 * (cov + cov.T)
    B = np.array([along, across / r**2])  # range and azimuth by the point
    e, S = B @ missed, B @ cov @ B.T
    outcome, widened = admit(e, S, R_z, sonar.gate, landmark)
    return outcome, cov + G_z[:, :2] @ widened @ G_z[:, :2].T, e, S
