"""Points at rest, seen from a moving sonar: their prediction, and their correction by range and azimuth.

With previous_T_sonar = (R, t) and its covariance Sigma (tangent, rotation first), a point q of the frame before is

    q <- R^T (q - t),    P <- R^T P R + J Sigma J^T + drift^2 I,    J = [[q]x | -I].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.sonar.geometry import ranges_azimuths_elevations


@dataclass(frozen=True, eq=False)
class SonarStep:
    """How the sonar moved between two frames."""

    previous_T_sonar: gtsam.Pose3
    """The sonar now, in the sonar frame of the frame before."""
    covariance: Floats
    """Of its tangent (rotation first, in the frame of now), shape (6, 6)."""

    @classmethod
    def none(cls) -> SonarStep:
        """It stood still, with certainty."""
        return cls(gtsam.Pose3(), np.zeros((6, 6)))

    def then(self, later: SonarStep) -> SonarStep:
        """Both steps, one after the other; their errors are independent."""
        adjoint = later.previous_T_sonar.inverse().AdjointMap()
        covariance = adjoint @ self.covariance @ adjoint.T + later.covariance
        return SonarStep(self.previous_T_sonar.compose(later.previous_T_sonar), covariance)


@dataclass(frozen=True, eq=False)
class Tracks:
    """One row a track, M of them."""

    ids: Ints
    """Numbers, never used twice."""
    position_m: Floats
    """In the sonar frame, shape (M, 3)."""
    position_cov: Floats
    """Shape (M, 3, 3)."""
    existence: Floats
    """Probability that something persistent is behind it, shape (M,)."""
    frames_seen: Ints
    """Frames in which it took a candidate, shape (M,)."""

    @classmethod
    def none(cls) -> Tracks:
        """No track."""
        whole = np.empty(0, dtype=np.int64)
        return cls(whole, np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), whole)

    def __len__(self) -> int:
        return len(self.ids)

    def rows(self, selection: Ints) -> Tracks:
        """Some of them, in this order."""
        return Tracks(*(column[selection] for column in vars(self).values()))

    def and_(self, other: Tracks) -> Tracks:
        """These, then the others."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Tracks(*(np.concatenate(pair) for pair in pairs))

    def moved(self, step: SonarStep, drift_m: float) -> Tracks:
        """In the sonar frame after a step."""
        R, t = step.previous_T_sonar.rotation().matrix(), step.previous_T_sonar.translation()
        q = (self.position_m - t) @ R
        jacobian = np.concatenate([_skews(q), np.broadcast_to(-np.eye(3), (len(q), 3, 3))], axis=2)
        noise = jacobian @ step.covariance @ jacobian.transpose(0, 2, 1)
        covariance = R.T @ self.position_cov @ R + noise + drift_m**2 * np.eye(3)
        return replace(self, position_m=q, position_cov=covariance)


@dataclass(frozen=True, eq=False)
class Expected:
    """Range and azimuth of tracks, before they are measured."""

    z: Floats
    """Shape (M, 2)."""
    H: Floats
    """Derivative by the position, shape (M, 2, 3)."""
    S: Floats
    """Innovation covariance, shape (M, 2, 2)."""

    @classmethod
    def of(cls, tracks: Tracks, noise: Floats) -> Expected:
        """With the measurement's noise, shape (2, 2)."""
        q = tracks.position_m
        r, a, _ = ranges_azimuths_elevations(q)
        level2 = np.maximum(q[:, 0] ** 2 + q[:, 1] ** 2, 1e-12)
        by_azimuth = np.stack([-q[:, 1] / level2, q[:, 0] / level2, np.zeros(len(q))], axis=1)
        H = np.stack([q / r[:, None], by_azimuth], axis=1)
        return cls(np.stack([r, a], axis=1), H, H @ tracks.position_cov @ H.transpose(0, 2, 1) + noise)

    def innovations(self, z: Floats) -> Floats:
        """Of each of n measurements from each track, azimuths wrapped, shape (n, M, 2)."""
        difference = z[:, None, :] - self.z
        difference[..., 1] -= 2 * np.pi * np.round(difference[..., 1] / (2 * np.pi))
        return np.asarray(difference)

    def densities(self, z: Floats, gate: float) -> Floats:
        """N(z; h(q), S); 0 where the squared Mahalanobis distance exceeds the gate. Shape (n, M)."""
        innovation = self.innovations(z)
        distance2 = np.einsum("nmi,mij,nmj->nm", innovation, np.linalg.inv(self.S), innovation)
        peak = 1.0 / (2 * np.pi * np.sqrt(np.linalg.det(self.S)))
        return np.where(distance2 <= gate, peak * np.exp(-0.5 * distance2), 0.0)


def corrected(tracks: Tracks, expected: Expected, z: Floats, took: Ints, noise: Floats) -> Tracks:
    """Positions after the measurement that each track took (-1: none), by the Kalman filter in Joseph's form."""
    rows = np.flatnonzero(took >= 0)
    if not len(rows):
        return tracks
    P, H, S = tracks.position_cov[rows], expected.H[rows], expected.S[rows]
    gain = np.linalg.solve(S, H @ P).transpose(0, 2, 1)
    innovation = expected.innovations(z)[took[rows], rows]
    rest = np.eye(3) - gain @ H
    position, covariance = tracks.position_m.copy(), tracks.position_cov.copy()
    position[rows] += np.einsum("nij,nj->ni", gain, innovation)
    covariance[rows] = rest @ P @ rest.transpose(0, 2, 1) + gain @ noise @ gain.transpose(0, 2, 1)
    return replace(tracks, position_m=position, position_cov=covariance)


def _skews(q: Floats) -> Floats:
    """[q]x of each, shape (n, 3, 3)."""
    skews = np.zeros((len(q), 3, 3))
    skews[:, 0, 1], skews[:, 0, 2], skews[:, 1, 2] = -q[:, 2], q[:, 1], -q[:, 0]
    return skews - skews.transpose(0, 2, 1)
