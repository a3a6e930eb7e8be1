"""Elimination of noisy data: tracks of the candidates that persist where the motion predicts them.

A track is a point at rest with a probability p of existence, seen from a moving sonar by range and azimuth. Kalman
filter, with previous_T_sonar = (R, t), its covariance Sigma (tangent, rotation first), a point q of the frame before::

    q <- R^T (q - t),    P <- R^T P R + J Sigma J^T + drift^2 I,    J = [[q]x | -I]

With the densities ``N_mj = N(z_m; h(q_j), S_j)`` of candidates z_m in (range, azimuth) and D the probability of
detection times that of lying inside the image, whose area is in m rad::

    p <- p exp(-dt / lifetime)
    A_mj ~ p_j D_j N_mj,  new track ~ (new + clutter) / area,  rows normalised        p(m, j) of the 2014 paper's (1)
    p <- p L / (1 - p + p L),  L = 1 - D + D N / (clutter / area),  or 1 - D where it took no candidate

Existence is that of integrated probabilistic data association (Musicki, Evans, Stankovic, IEEE TAC 39(6), 1994) for the
candidate of the most probable assignment. The elevation enters once, when a track starts: it is the same error in every
frame and must not be averaged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np
from pydantic import Field
from scipy.optimize import linear_sum_assignment
from scipy.special import ndtr

from sonar_graph.calibration import Section
from sonar_graph.measurements import Columns, Floats, Ints
from sonar_graph.models import project_points, wrap_angle
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.sonar.geometry import point_covariances, points
from sonar_graph.sonar.regions import Candidates

NEVER = 1e9
"""Cost of what cannot be assigned."""
SKEW = np.array(
    [
        [0, 0, 0, 0, 0, -1, 0, 1, 0],
        [0, 0, 1, 0, 0, 0, -1, 0, 0],
        [0, -1, 0, 1, 0, 0, 0, 0, 0],
    ]
)
"""Nine elements of [q]x as ``q @ SKEW``."""


@dataclass(frozen=True, eq=False)
class SonarStep:
    """Motion of the sonar between two frames.

    Examples
    --------
    Ahead by 2 cm, known to 2 mm and a milliradian:

    >>> import gtsam
    >>> import numpy as np
    >>> from sonar_graph.sonar import SonarStep
    >>> sigmas = np.array([1e-3, 1e-3, 1e-3, 2e-3, 2e-3, 2e-3])
    >>> step = SonarStep(gtsam.Pose3(gtsam.Rot3(), np.array([0.02, 0.0, 0.0])), np.diag(sigmas**2))
    """

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
        return SonarStep(
            self.previous_T_sonar.compose(later.previous_T_sonar), covariance
        )


@dataclass(frozen=True, eq=False)
class TrackStates(Columns):
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

    def moved(self, step: SonarStep, drift_m: float) -> TrackStates:
        """Prediction: the tracks in the sonar frame after a step."""
        R = step.previous_T_sonar.rotation().matrix()
        t = step.previous_T_sonar.translation()
        q = (self.position_m - t) @ R
        # derivative of q by the tangent of the step, rotation first
        J = np.empty((len(self), 3, 6))
        J[:, :, :3] = (q @ SKEW).reshape(-1, 3, 3)
        J[:, :, 3:] = -np.eye(3)
        P = (
            R.T @ self.position_cov @ R
            + J @ step.covariance @ J.mT
            + drift_m**2 * np.eye(3)
        )
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
        z, H = project_points(np.ascontiguousarray(tracks.position_m))
        S = H @ tracks.position_cov @ H.mT + noise
        return cls(z, H, S, np.asarray(np.linalg.inv(S), np.float64))

    def innovations(self, z: Floats) -> Floats:
        """Measured minus expected, the azimuth wrapped: of one measurement a track, or of shape (n, 1, 2) of each."""
        e = z - self.z
        e[..., 1] = wrap_angle(e[..., 1])
        return e

    def densities(self, z: Floats, gate: float) -> Floats:
        """N(z; h(q), S) of n measurements; 0 where the squared Mahalanobis distance exceeds the gate. Shape (n, M)."""
        e = self.innovations(z[:, None])
        distance2 = (e[:, :, None] @ self.information @ e[:, :, :, None])[:, :, 0, 0]
        # density of a normal with information S^-1 in two dimensions
        peak = np.sqrt(np.linalg.det(self.information)) / (2 * math.pi)
        return np.where(distance2 <= gate, peak * np.exp(-0.5 * distance2), 0.0)


def corrected(
    tracks: TrackStates, expected: Expected, z: Floats, took: Ints, noise: Floats
) -> TrackStates:
    """Update by the measurement that each track took (-1: none), with the covariance in Joseph's form."""
    if not (took >= 0).any():
        return tracks
    P = tracks.position_cov
    H = expected.H
    K = P @ H.mT @ expected.information * (took >= 0)[:, None, None]
    q = tracks.position_m + (K @ expected.innovations(z[took])[:, :, None])[:, :, 0]
    # Joseph's form stays positive definite for any gain
    rest = np.eye(3) - K @ H
    return replace(
        tracks, position_m=q, position_cov=rest @ P @ rest.mT + K @ noise @ K.mT
    )


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


class TrackingParams(Section):
    """Settings of the tracker."""

    detection_probability: float = Field(0.9, gt=0, lt=1)
    """Probability that an object inside the image becomes a candidate."""
    clutter_per_frame: float = Field(0.5, gt=0)
    """Accepted candidates per frame that are of nothing persistent."""
    new_per_frame: float = Field(0.1, gt=0)
    """Objects per frame that come into view."""
    lifetime_s: float = Field(100.0, gt=0)
    """Mean time for which an object exists."""
    range_sigma_m: float = Field(0.03, gt=0)
    """Standard deviation of a centroid in range: regions are cut differently in every frame."""
    azimuth_sigma_rad: float = Field(0.015, gt=0)
    """The same in azimuth."""
    drift_m: float = Field(0.005, ge=0)
    """Standard deviation added to each coordinate per frame, for what motion and a point at rest do not explain."""
    gate_probability: float = Field(0.999, gt=0, lt=1)
    """Quantile of the innovation (2 dof) at the gate."""
    least_existence: float = Field(0.01, ge=0, lt=1)
    """A track ends below it."""
    leaving_sigmas: float = Field(3.0, gt=0)
    """Standard deviations outside the image at which a track ends."""


class Tracker:
    """Tracker of the candidates of one frame after another."""

    def __init__(self, params: TrackingParams | None = None) -> None:
        self.params = params or TrackingParams()
        self._noise = np.diag(
            [self.params.range_sigma_m**2, self.params.azimuth_sigma_rad**2]
        )
        self._gate = chi_square_quantile(self.params.gate_probability, 2)
        self._tracks = TrackStates.none()
        self._skipped = SonarStep.none()
        self._stamp_ns: int | None = None
        self._next_id = 0

    def skip(self, motion: SonarStep) -> None:
        """Move the sonar without a usable frame."""
        self._skipped = self._skipped.then(motion)

    def step(
        self, candidates: Candidates, motion: SonarStep | None, stamp_ns: int
    ) -> Association:
        """Predict the tracks by the motion since the frame before or the last `skip` (None: none), and update them.

        Stamps increase: `FrameCheck` refuses other frames.
        """
        params = self.params
        rows = candidates.accepted
        elapsed_s = (
            0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        )
        self.skip(motion or SonarStep.none())
        moved = self._tracks.moved(self._skipped, params.drift_m)
        before = replace(
            moved, existence=moved.existence * np.exp(-elapsed_s / params.lifetime_s)
        )
        self._stamp_ns = stamp_ns
        self._skipped = SonarStep.none()

        z = np.array([candidates.range_m[rows], candidates.azimuth_rad[rows]]).T
        expected = Expected.of(before, self._noise)
        window = candidates.window
        sigma = np.sqrt(np.diagonal(expected.S, axis1=1, axis2=2))
        # standard deviations from the lower and upper limits of range and azimuth, positive inside, shapes (M', 2)
        above = (expected.z - window[:, 0]) / sigma
        below = (window[:, 1] - expected.z) / sigma
        in_image = (ndtr(above) - ndtr(-below)).prod(axis=1)
        detection = params.detection_probability * in_image
        densities = expected.densities(z, self._gate)
        area = math.prod((window[:, 1] - window[:, 0]).tolist())

        # density of candidates that come from no known track
        unexplained = (params.new_per_frame + params.clutter_per_frame) / area
        weights = densities * (before.existence * detection)
        weights = np.hstack([weights, np.full((len(weights), 1), unexplained)])
        matrix = weights / weights.sum(axis=1, keepdims=True)
        took = most_probable_assignment(matrix)

        # existence by Bayes: p(frame | exists) over p(frame | does not), with clutter in the denominator
        likelihood = 1.0 - detection
        seen = np.flatnonzero(took >= 0)
        likelihood[seen] += (
            detection[seen]
            * densities[took[seen], seen]
            * area
            / params.clutter_per_frame
        )
        existence = (
            before.existence
            * likelihood
            / (1.0 - before.existence + before.existence * likelihood)
        )
        after = corrected(before, expected, z, took, self._noise)
        after = replace(
            after, existence=existence, frames_seen=before.frames_seen + (took >= 0)
        )
        # a track that left the image by several sigmas cannot be detected again
        least_inside = np.minimum(above, below).min(axis=1)
        reasons = [
            "left the image" if least < -params.leaving_sigmas else ""
            for least in least_inside
        ]
        for row in np.flatnonzero(existence < params.least_existence):
            reasons[row] = f"exists with less than {params.least_existence:g}"
        return self._keep(stamp_ns, candidates, after, matrix, took, reasons)

    def _keep(
        self,
        stamp_ns: int,
        candidates: Candidates,
        after: TrackStates,
        matrix: Floats,
        took: Ints,
        reasons: list[str],
    ) -> Association:
        """Keep the tracks without a reason to end, start new ones, and associate them with the tracks before."""
        is_ended = np.array(reasons, dtype=bool)
        stay = np.flatnonzero(~is_ended)
        ended = np.flatnonzero(is_ended)
        is_new = np.ones(len(matrix), dtype=bool)
        is_new[took[took >= 0]] = False
        new = np.flatnonzero(is_new)
        rows = np.append(took[stay], new)
        previous_ids = after.ids
        itself = np.eye(len(previous_ids), len(previous_ids) + 1)[stay]
        own = np.vstack([itself, np.zeros((len(new), len(previous_ids) + 1))])
        own[rows >= 0] = matrix[rows[rows >= 0]]
        old = np.arange(len(stay))
        # where its candidate is of something new, a track was not seen and is itself
        own[old, stay] += own[old, -1]
        own[old, -1] = 0.0
        tracks = after.rows(stay)
        if len(new):
            params = self.params
            start = candidates.accepted[new]
            n = len(new)
            position = points(
                candidates.range_m[start],
                candidates.azimuth_rad[start],
                candidates.elevation_rad[start],
            )
            covariance = point_covariances(
                position, self._noise, candidates.elevation_sigma_rad[start]
            )
            existence = np.full(
                n,
                params.new_per_frame
                / (params.new_per_frame + params.clutter_per_frame),
            )
            ids = self._next_id + np.arange(n)
            self._next_id += n
            seen = np.ones(n, dtype=np.int64)
            started = TrackStates(ids, position, covariance, existence, seen)
            tracks = TrackStates.concatenate([tracks, started])
        self._tracks = tracks
        return Association(
            **vars(tracks),
            stamp_ns=stamp_ns,
            previous_ids=previous_ids,
            matrix=own,
            candidate=np.where(rows >= 0, np.append(candidates.accepted, -1)[rows], -1),
            ended_ids=previous_ids[ended],
            ended_reasons=tuple(reasons[row] for row in ended),
        )


def most_probable_assignment(matrix: Floats) -> Ints:
    """Candidate of each track in the most probable assignment, -1: none, shape (M',)."""
    candidates = matrix.shape[0]
    tracks = matrix.shape[1] - 1
    if not candidates or not tracks:
        return np.full(tracks, -1)
    cost = np.full((candidates, tracks + candidates), NEVER)
    np.log(matrix[:, :tracks], out=cost[:, :tracks], where=matrix[:, :tracks] > 0)
    cost[:, :tracks] = np.where(matrix[:, :tracks] > 0, -cost[:, :tracks], NEVER)
    cost[np.arange(candidates), tracks + np.arange(candidates)] = -np.log(
        matrix[:, tracks]
    )
    chosen = linear_sum_assignment(cost)[1]
    took = np.full(tracks, -1)
    taken = np.flatnonzero(chosen < tracks)
    took[chosen[taken]] = taken
    return took
