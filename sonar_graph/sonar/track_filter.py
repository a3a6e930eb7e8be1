"""Kalman filter of points at rest, seen from a moving sonar by range and azimuth.

With previous_T_sonar = (R, t), its covariance Sigma (tangent, rotation first) and a point q of the frame before::

    q <- R^T (q - t),    P <- R^T P R + J Sigma J^T + drift^2 I,    J = [[q]x | -I]

Loops over the few tracks of a frame are compiled: a seventh of the time of array operations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled


@dataclass(frozen=True, eq=False)
class SonarStep:
    """Motion of the sonar between two frames."""

    previous_T_sonar: gtsam.Pose3
    """Pose of the sonar now in the sonar frame of the frame before."""
    covariance: Floats
    """Of its tangent (rotation first, in the sonar frame now), shape (6, 6)."""

    @classmethod
    def none(cls) -> SonarStep:
        """No motion, with certainty."""
        return cls(gtsam.Pose3(), np.zeros((6, 6)))

    def then(self, later: SonarStep) -> SonarStep:
        """Both steps, one after the other, with independent errors."""
        adjoint = later.previous_T_sonar.inverse().AdjointMap()
        covariance = adjoint @ self.covariance @ adjoint.T + later.covariance
        return SonarStep(self.previous_T_sonar.compose(later.previous_T_sonar), covariance)


@dataclass(frozen=True, eq=False)
class TrackStates:
    """States of M tracks, one row each."""

    ids: Ints
    """Track numbers, never used twice."""
    position_m: Floats
    """In the sonar frame, shape (M, 3)."""
    position_cov: Floats
    """Shape (M, 3, 3)."""
    existence: Floats
    """Probability that the track is of something persistent, shape (M,)."""
    frames_seen: Ints
    """Frames in which the track took a candidate, shape (M,)."""

    @classmethod
    def none(cls) -> TrackStates:
        """No track."""
        whole = np.empty(0, dtype=np.int64)
        return cls(whole, np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), whole)

    def __len__(self) -> int:
        return len(self.ids)

    def rows(self, selection: Ints) -> TrackStates:
        """The selected rows, in this order."""
        return TrackStates(*(column[selection] for column in vars(self).values()))

    def and_(self, other: TrackStates) -> TrackStates:
        """These tracks, then the others."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return TrackStates(*(np.concatenate(pair) for pair in pairs))

    def moved(self, step: SonarStep, drift_m: float) -> TrackStates:
        """Prediction: the tracks in the sonar frame after a step."""
        previous_R_sonar = np.ascontiguousarray(step.previous_T_sonar.rotation().matrix())
        translation, step_cov = step.previous_T_sonar.translation(), np.ascontiguousarray(step.covariance)
        q, P = predicted_points(self.position_m, self.position_cov, previous_R_sonar, translation, step_cov, drift_m**2)
        return replace(self, position_m=q, position_cov=P)


class Expected(NamedTuple):
    """Expected measurements of range and azimuth, one row a track."""

    z: Floats
    """Shape (M, 2)."""
    H: Floats
    """Derivative by the position, shape (M, 2, 3)."""
    S: Floats
    """Innovation covariance, shape (M, 2, 2)."""

    @classmethod
    def of(cls, tracks: TrackStates, noise: Floats) -> Expected:
        """Expectation under measurement noise of shape (2, 2)."""
        return cls(*expected_ranges_azimuths(tracks.position_m, tracks.position_cov, noise))

    def densities(self, z: Floats, gate: float) -> Floats:
        """N(z; h(q), S) of n measurements; 0 where the squared Mahalanobis distance exceeds the gate. Shape (n, M)."""
        return innovation_densities(self.z, self.S, z, gate)


def corrected(tracks: TrackStates, expected: Expected, z: Floats, took: Ints, noise: Floats) -> TrackStates:
    """Update by the measurement that each track took (-1: none), with the covariance in Joseph's form."""
    q, P = corrected_points(tracks.position_m, tracks.position_cov, expected, z, took, noise)
    return replace(tracks, position_m=q, position_cov=P)


@compiled
def predicted_points(
    position_m: Floats, position_cov: Floats, R: Floats, t: Floats, step_cov: Floats, drift2: float
) -> tuple[Floats, Floats]:
    """Positions and covariances in the sonar frame after a step."""
    q, P = np.empty_like(position_m), np.empty_like(position_cov)
    J = np.zeros((3, 6))
    J[:, 3:] = -np.eye(3)
    for m in range(len(q)):
        q[m] = (position_m[m] - t) @ R
        x, y, z = q[m]
        J[0, 1], J[0, 2], J[1, 2] = -z, y, -x
        J[1, 0], J[2, 0], J[2, 1] = z, -y, x
        P[m] = R.T @ position_cov[m] @ R + J @ step_cov @ J.T + drift2 * np.eye(3)
    return q, P


@compiled
def expected_ranges_azimuths(position_m: Floats, position_cov: Floats, noise: Floats) -> tuple[Floats, Floats, Floats]:
    """Expected measurements, their derivatives and innovation covariances: the columns of `Expected`."""
    n = len(position_m)
    z, H, S = np.empty((n, 2)), np.zeros((n, 2, 3)), np.empty((n, 2, 2))
    for m in range(n):
        q = position_m[m]
        level2 = q[0] ** 2 + q[1] ** 2
        z[m, 0], z[m, 1] = math.sqrt(level2 + q[2] ** 2), math.atan2(q[1], q[0])
        H[m, 0] = q / z[m, 0]
        H[m, 1, 0], H[m, 1, 1] = -q[1] / max(level2, 1e-12), q[0] / max(level2, 1e-12)
        S[m] = H[m] @ position_cov[m] @ H[m].T + noise
    return z, H, S


@compiled
def _innovation(z: Floats, expected: Floats) -> Floats:
    """Innovation of one measurement, the azimuth wrapped, shape (2,)."""
    difference = z - expected
    difference[1] -= 2 * math.pi * round(difference[1] / (2 * math.pi))
    return difference


@compiled
def innovation_densities(expected: Floats, S: Floats, z: Floats, gate: float) -> Floats:
    """Gaussian density of each measurement for each track, 0 outside the gate, shape (n, M)."""
    densities = np.zeros((len(z), len(expected)))
    for m in range(len(expected)):
        information = np.linalg.inv(S[m])
        peak = math.sqrt(np.linalg.det(information)) / (2 * math.pi)
        for n in range(len(z)):
            innovation = _innovation(z[n], expected[m])
            distance2 = innovation @ information @ innovation
            if distance2 <= gate:
                densities[n, m] = peak * math.exp(-0.5 * distance2)
    return densities


@compiled
def corrected_points(
    position_m: Floats, position_cov: Floats, expected: Expected, z: Floats, took: Ints, noise: Floats
) -> tuple[Floats, Floats]:
    """Positions and covariances after the measurements."""
    q, P = position_m.copy(), position_cov.copy()
    for m in range(len(q)):
        if took[m] >= 0:
            gain = P[m] @ expected.H[m].T @ np.linalg.inv(expected.S[m])
            rest = np.eye(3) - gain @ expected.H[m]
            q[m] += gain @ _innovation(z[took[m]], expected.z[m])
            P[m] = rest @ P[m] @ rest.T + gain @ noise @ gain.T
    return q, P


@dataclass(frozen=True, eq=False)
class Association(TrackStates):
    """The M tracks after a frame and their association with the M' tracks before it, p(m, j) of equation (1)."""

    stamp_ns: int
    """Of the frame."""
    previous_ids: Ints
    """Track numbers before the frame, shape (M',)."""
    matrix: Floats
    """Probability that track m now was track j before, shape (M, M' + 1); the last column is "new track". Rows sum
    to 1. A track without a candidate in this frame is itself, with certainty; only a track that starts can be new."""
    candidate: Ints
    """Row in `Candidates` that each track took, shape (M,); -1: none."""
    ended_ids: Ints
    """Tracks ended in this frame, shape (k,)."""
    ended_reasons: tuple[str, ...]
    """Reason for each of ``ended_ids``."""
