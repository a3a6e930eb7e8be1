"""Points at rest, seen from a moving sonar: their prediction, and their correction by range and azimuth.

With previous_T_sonar = (R, t) and its covariance Sigma (tangent, rotation first), a point q of the frame before is

    q <- R^T (q - t),    P <- R^T P R + J Sigma J^T + drift^2 I,    J = [[q]x | -I].

A frame has few tracks: compiled loops over them take a seventh of the time of an array operation each.

How the tracks of two frames belong together: the process model p(m, j) of equation (1) of the 2014 paper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled


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
class TrackStates:
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
    def none(cls) -> TrackStates:
        """No track."""
        whole = np.empty(0, dtype=np.int64)
        return cls(whole, np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), whole)

    def __len__(self) -> int:
        return len(self.ids)

    def rows(self, selection: Ints) -> TrackStates:
        """Some of them, in this order."""
        return TrackStates(*(column[selection] for column in vars(self).values()))

    def and_(self, other: TrackStates) -> TrackStates:
        """These, then the others."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return TrackStates(*(np.concatenate(pair) for pair in pairs))

    def moved(self, step: SonarStep, drift_m: float) -> TrackStates:
        """In the sonar frame after a step."""
        previous_R_sonar = np.ascontiguousarray(step.previous_T_sonar.rotation().matrix())
        translation, step_cov = step.previous_T_sonar.translation(), np.ascontiguousarray(step.covariance)
        q, P = _moved(self.position_m, self.position_cov, previous_R_sonar, translation, step_cov, drift_m**2)
        return replace(self, position_m=q, position_cov=P)


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
    def of(cls, tracks: TrackStates, noise: Floats) -> Expected:
        """With the measurement's noise, shape (2, 2)."""
        return cls(*_expected(tracks.position_m, tracks.position_cov, noise))

    def densities(self, z: Floats, gate: float) -> Floats:
        """N(z; h(q), S) of n measurements; 0 where the squared Mahalanobis distance exceeds the gate. Shape (n, M)."""
        return _densities(self.z, self.S, z, gate)


def corrected(tracks: TrackStates, expected: Expected, z: Floats, took: Ints, noise: Floats) -> TrackStates:
    """Positions after the measurement that each track took (-1: none), by the Kalman filter in Joseph's form."""
    q, P = _corrected(tracks.position_m, tracks.position_cov, expected.z, expected.H, expected.S, z, took, noise)
    return replace(tracks, position_m=q, position_cov=P)


@compiled
def _moved(
    position_m: Floats, position_cov: Floats, R: Floats, t: Floats, step_cov: Floats, drift2: float
) -> tuple[Floats, Floats]:
    """Positions and covariances after a step."""
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
def _expected(position_m: Floats, position_cov: Floats, noise: Floats) -> tuple[Floats, Floats, Floats]:
    """What `Expected` has."""
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
    """Of one measurement from one track, the azimuth wrapped, shape (2,)."""
    difference = z - expected
    difference[1] -= 2 * math.pi * round(difference[1] / (2 * math.pi))
    return difference


@compiled
def _densities(expected: Floats, S: Floats, z: Floats, gate: float) -> Floats:
    """Shape (n, M)."""
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
def _corrected(
    position_m: Floats,
    position_cov: Floats,
    expected: Floats,
    H: Floats,
    S: Floats,
    z: Floats,
    took: Ints,
    noise: Floats,
) -> tuple[Floats, Floats]:
    """Positions and covariances after the measurements."""
    q, P = position_m.copy(), position_cov.copy()
    for m in range(len(q)):
        if took[m] >= 0:
            gain = P[m] @ H[m].T @ np.linalg.inv(S[m])
            rest = np.eye(3) - gain @ H[m]
            q[m] += gain @ _innovation(z[took[m]], expected[m])
            P[m] = rest @ P[m] @ rest.T + gain @ noise @ gain.T
    return q, P


@dataclass(frozen=True, eq=False)
class Association:
    """The tracks after a frame, M of them, and where each came from among the M' tracks before it."""

    stamp_ns: int
    """Of the frame."""
    previous_ids: Ints
    """Track numbers before the frame, shape (M',)."""
    track_ids: Ints
    """Track numbers after the frame, shape (M,). Numbers are never used twice."""
    matrix: Floats
    """Probability that track m now was track j before, shape (M, M' + 1); the last column is "new track". Rows sum
    to 1. A track without a candidate in this frame is itself, with certainty; only a track that starts can be new."""
    candidate: Ints
    """Row in `Candidates` that each track took, shape (M,); -1: it was not seen in this frame."""
    existence: Floats
    """Probability that something persistent is behind the track, shape (M,)."""
    position_m: Floats
    """In the sonar frame at ``stamp_ns``, shape (M, 3)."""
    position_cov: Floats
    """Shape (M, 3, 3), m²."""
    frames_seen: Ints
    """Frames in which the track had a candidate, shape (M,)."""
    ended_ids: Ints
    """Tracks that were given up in this frame, shape (k,)."""
    ended_reasons: tuple[str, ...]
    """Why, one for each of ``ended_ids``."""
