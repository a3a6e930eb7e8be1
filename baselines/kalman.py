"""Kalman update of both filters, and the treatment of doubtful detections: gate, robust kernel, far landmarks.

Derivation: docs/theory/fair_comparison.md (gate, kernel), docs/theory/gaps.md (far landmarks).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.linalg import LinAlgError

from baselines.events import Motion, Sonar, Views
from sonar_graph.measurements import Floats
from sonar_graph.models import FLOOR_GATE, Sight, wrap_angle
from sonar_graph.numerics import compilable, compiled, inlined, innovation_of, mat6
from sonar_graph.states import OUTCOME_NUMBERS, Outcome

USED = OUTCOME_NUMBERS[Outcome.USED]
GATED = OUTCOME_NUMBERS[Outcome.GATED]
NEW = OUTCOME_NUMBERS[Outcome.NEW]


class Judged(NamedTuple):
    """Range and azimuth of a known landmark, after the update."""

    outcome: int
    """`USED` or `GATED`."""
    e: Floats
    """Innovation, shape (2,)."""
    S: Floats
    """Covariance of the innovation, shape (2, 2)."""


@compilable
def cholesky(S: Floats) -> Floats:
    """Lower triangle L with ``S = L L^T``; NaN on its diagonal where S is not positive definite.

    For matrices of one to three rows LAPACK takes several times as long to call, and to compile.
    """
    L = np.zeros(S.shape)
    for i in range(len(S)):
        for j in range(i + 1):
            rest = S[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = rest / L[j, j]
            else:
                L[i, i] = math.sqrt(rest) if rest > 0.0 else math.nan
    return L


@compilable
def solve_lower(L: Floats, w: Floats) -> None:
    """``w <- L^-1 w``, with a lower triangle L."""
    for r in range(len(w)):
        for k in range(r):
            w[r] -= L[r, k] * w[k]
        w[r] /= L[r, r]


@compilable
def correction(P: Floats, HP: Floats, S: Floats, e: Floats) -> Floats:
    """``K e``, shape (n,), with ``K = P H^T S^-1``; P becomes ``P - K S K^T``.

    Raises LinAlgError where S is not positive definite.
    """
    # with S = L L^T and V = L^-1 H P: K e = V^T L^-1 e, K S K^T = V^T V
    L = cholesky(S)
    V = HP.copy()  # (m, n)
    w = e.copy()
    solve_lower(L, w)
    Ke = np.zeros(len(P))
    for r in range(len(S)):
        # a variance of zero or below, or no number
        if math.isnan(L[r, r]):
            raise LinAlgError("S is not positive definite")
        for i in range(len(P)):
            # loops over numbers: numba takes long to compile sums of rows
            for k in range(r):
                V[r, i] -= L[r, k] * V[k, i]
            V[r, i] /= L[r, r]
        # each row of V is a scalar update
        for i in range(len(P)):
            v = V[r, i]
            Ke[i] += v * w[r]
            for j in range(len(P)):
                # the factors commute: P stays symmetric to the last bit
                P[i, j] -= v * V[r, j]
    return Ke


def symmetric(A: Floats) -> Floats:
    """``(A + A^T) / 2``."""
    return 0.5 * (A + A.T)


@compiled
def covariance_after(P: Floats, J: Floats, C: Floats) -> Floats:
    """``J P J^T + C``, with the block of P that J is by; symmetric to the last bit."""
    k = J.shape[1]
    _, S = innovation_of(P[:k, :k], J, C)
    return S


@inlined
def view_noise(sight: Sight, motion: Motion, R_z: Floats) -> Floats:
    """``R_z + H_b C H_b^T``, shape (2, 2): noise of a view, with that of the motion to it."""
    C = mat6(motion.C)
    # C is the covariance in body axes, as H_b takes them
    by_azimuth = C @ sight.azimuth_by_body
    R = R_z.copy()
    R[0, 0] += sight.range_by_body @ (C @ sight.range_by_body)
    R[0, 1] += sight.range_by_body @ by_azimuth
    R[1, 0] = R[0, 1]
    R[1, 1] += sight.azimuth_by_body @ by_azimuth
    return R


@compiled
def distance(e: Floats, S: Floats) -> float:
    """``sqrt(e^T S^-1 e)``, the Mahalanobis distance of an innovation; NaN where S is not positive definite."""
    w = e.copy()
    solve_lower(cholesky(S), w)
    squared = 0.0
    for r in range(len(w)):
        squared += w[r] * w[r]
    return math.sqrt(squared)


@compiled
def judged(
    e: Floats, S: Floats, R_z: Floats, gate: float, kernel_width: float
) -> tuple[int, Floats]:
    """Outcome of an innovation of range and azimuth, and what a Cauchy kernel adds to R_z, shape (2, 2).

    `GATED` where the `distance` exceeds the gate. The kernel has the weight ``w_i = 1 / (1 + e_i^2 / (S_ii k^2))`` and
    makes ``R_ij / sqrt(w_i w_j)`` of the noise; an infinite width k adds nothing.
    """
    if not distance(e, S) <= gate:  # NaN is refused too
        return GATED, np.zeros((2, 2))
    spread = np.empty(2)  # 1 / sqrt(w)
    for i in range(2):
        spread[i] = math.sqrt(1.0 + e[i] ** 2 / (S[i, i] * kernel_width**2))
    widened = np.empty((2, 2))
    for i in range(2):
        for j in range(2):
            widened[i, j] = (spread[i] * spread[j] - 1.0) * R_z[i, j]
    return USED, widened


@inlined
def correction_by_view(
    P: Floats,
    H: Floats,
    sight: Sight,
    noise: Floats,
    views: Views,
    row: int,
    kernel_width: float,
) -> Floats:
    """`correction` by range and azimuth of a landmark, zero beyond the gate; writes outcome, e of (7) and S of the view.

    ``noise``: `view_noise`.
    """
    z = views.z[row]
    turned_rad = wrap_angle(z[1] - sight.azimuth_rad)
    e = np.array([z[0] - sight.range_m, turned_rad])  # (7)
    HP, S = innovation_of(P, H, noise)
    outcome, widened = judged(e, S, views.R_z[row], views.gate[row], kernel_width)
    views.outcome[row] = outcome
    # numbers: for arrays numba compiles the text of an error, which takes a tenth of all
    for i in range(2):
        views.e[row, i] = e[i]
        for j in range(2):
            views.S[row, i, j] = S[i, j]
    if outcome == GATED:
        return np.zeros(len(P))
    # the kernel widens the noise of the detection, not that of the motion
    return correction(P, HP, S + widened, e)


def is_far(cov: Floats, G_z: Floats, range_m: float, R_z: Floats) -> bool:
    """Check that a view linearised at the predicted place errs by more than its noise.

    With the variances A along the beam and L across it, in the sonar's plane, of a landmark's place relative to the
    vehicle, the linearisation leaves out ``L / (2 r)`` of the range and ``sqrt(L A) / r^2`` of the azimuth.

    Parameters
    ----------
    cov
        Covariance of that relative place, shape (3, 3).
    G_z
        Derivative of the point seen by (range, azimuth, elevation), shape (3, 3).
    """
    along = G_z[:, 0].copy()
    across = G_z[:, 1].copy()  # of length r
    A = along @ cov @ along
    L = across @ cov @ across / range_m**2
    is_bent = 2.0 * range_m * math.sqrt(R_z[0, 0]) < L
    is_turned = range_m**4 * R_z[1, 1] < L * A
    return bool(is_bent or is_turned)


def polar_covariance(R_z: Floats, aperture_rad: float) -> Floats:
    """Covariance of range, azimuth and elevation (3, 3); the latter is uniform in the aperture: ``aperture^2 / 12``."""
    V = np.zeros((3, 3))
    V[:2, :2] = R_z
    V[2, 2] = aperture_rad**2 / 12.0
    return V


def far_covariance(R_z: Floats, range_m: float, aperture_rad: float) -> Floats:
    """`polar_covariance` of a point at elevation 0: a beam that is not level reaches ``r e^2 / 2`` less far."""
    V = polar_covariance(R_z, aperture_rad)
    V[0, 0] += range_m**2 * aperture_rad**4 / 320.0
    return V


def judged_far(
    e: Floats,
    cov: Floats,
    noise: Floats,
    G_z: Floats,
    sonar: Sonar,
    z: Floats,
    R_z: Floats,
) -> tuple[Judged | None, Floats]:
    """`judged` for an innovation of a point at elevation 0, by its share along the beam and across it.

    Parameters
    ----------
    e, cov, noise
        Point seen less the landmark, shape (3,); its covariance by the state, and by the motion, shape (3, 3).
    G_z
        Derivative of the point seen by (range, azimuth, elevation), shape (3, 3).

    Returns
    -------
    Outcome, innovation of range and azimuth and its covariance; None where `is_far` is false. Covariance of the noise
    of the point with the kernel, shape (3, 3).
    """
    if not is_far(cov + noise, G_z, z[0], R_z):
        return None, noise
    noise = noise + G_z @ far_covariance(R_z, z[0], sonar.aperture_rad) @ G_z.T
    beam = G_z[:, :2]  # derivatives by range and azimuth, orthogonal
    # range and azimuth by the point
    B = np.ascontiguousarray((beam / np.sum(beam * beam, axis=0)).T)
    e_z = B @ e
    S_z = symmetric(B @ symmetric(cov + noise) @ B.T)
    outcome, widened = judged(e_z, S_z, R_z, sonar.gate, sonar.kernel_width)
    return Judged(outcome, e_z, S_z), symmetric(noise + beam @ widened @ beam.T)


def stands_on_floor(z_m: float, variance_m2: float, sonar: Sonar) -> bool:
    """Check that a new landmark's height is within the gate of a floor of known height."""
    return bool(
        (sonar.floor_z_m - z_m) ** 2
        <= FLOOR_GATE * (variance_m2 + sonar.floor_variance_m2)
    )
