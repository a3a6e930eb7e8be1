"""Kalman filter of points at rest, seen from a moving sonar by range and azimuth.

With previous_T_sonar = (R, t), its covariance Sigma (tangent, rotation first) and a point q of the frame before::

    q <- R^T (q - t),    P <- R^T P R + J Sigma J^T + drift^2 I,    J = [[q]x | -I]
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np

from sonar_graph.measurements import Floats, Ints

SKEW = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]])
"""Nine elements of [q]x as ``q @ SKEW``."""


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
        R, t = step.previous_T_sonar.rotation().matrix(), step.previous_T_sonar.translation()
        q, J = (self.position_m - t) @ R, np.empty((len(self), 3, 6))
        J[:, :, :3], J[:, :, 3:] = (q @ SKEW).reshape(-1, 3, 3), -np.eye(3)
        P = R.T @ self.position_cov @ R + J @ step.covariance @ J.mT + drift_m**2 * np.eye(3)
        return replace(self, position_m=q, position_cov=P)


class Expected(NamedTuple):
    """Expected measurements of range and azimuth, one row a track."""

    z: Floats
    """Shape (M, 2)."""
    H: Floats
    """Derivative by the position, shape (M, 2, 3)."""
    S: Floats
    """Innovation covariance, shape (M, 2, 2)."""
    information: Floats
    """Inverse of S, shape (M, 2, 2)."""

    @classmethod
    def of(cls, tracks: TrackStates, noise: Floats) -> Expected:
        """Expectation under measurement noise of shape (2, 2)."""
        q, (x, y, _) = tracks.position_m, tracks.position_m.T
        h2 = x**2 + y**2
        z, H = np.empty((len(q), 2)), np.zeros((len(q), 2, 3))
        z[:, 0], z[:, 1] = np.sqrt(h2 + q[:, 2] ** 2), np.arctan2(y, x)
        H[:, 0] = q / z[:, :1]
        H[:, 1, 0], H[:, 1, 1] = -y / np.maximum(h2, 1e-12), x / np.maximum(h2, 1e-12)
        S = H @ tracks.position_cov @ H.mT + noise
        return cls(z, H, S, np.asarray(np.linalg.inv(S), np.float64))

    def innovations(self, z: Floats) -> Floats:
        """Measured minus expected, the azimuth wrapped: of one measurement a track, or of shape (n, 1, 2) of each."""
        e = z - self.z
        e[..., 1] -= 2 * math.pi * np.rint(e[..., 1] / (2 * math.pi))
        return e

    def densities(self, z: Floats, gate: float) -> Floats:
        """N(z; h(q), S) of n measurements; 0 where the squared Mahalanobis distance exceeds the gate. Shape (n, M)."""
        e = self.innovations(z[:, None])
        distance2 = (e[:, :, None] @ self.information @ e[:, :, :, None])[:, :, 0, 0]
        peak = np.sqrt(np.linalg.det(self.information)) / (2 * math.pi)
        return np.where(distance2 <= gate, peak * np.exp(-0.5 * distance2), 0.0)


def corrected(tracks: TrackStates, expected: Expected, z: Floats, took: Ints, noise: Floats) -> TrackStates:
    """Update by the measurement that each track took (-1: none), with the covariance in Joseph's form."""
    if not (took >= 0).any():
        return tracks
    P, H = tracks.position_cov, expected.H
    K = P @ H.mT @ expected.information * (took >= 0)[:, None, None]
    q = tracks.position_m + (K @ expected.innovations(z[took])[:, :, None])[:, :, 0]
    rest = np.eye(3) - K @ H
    return replace(tracks, position_m=q, position_cov=rest @ P @ rest.mT + K @ noise @ K.mT)


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
