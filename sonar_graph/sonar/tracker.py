"""Elimination of noisy data: candidates that persist where the motion predicts them are tracks of something real.

A track is a point at rest (`track_filter`) with a probability p that something persistent is behind it. The
motion between two frames is handed in. After it, candidates z_m meet tracks j, whose innovations have the density
``N_mj = N(z_m; h(q_j), S_j)`` in (range, azimuth)::

    p <- p exp(-dt / lifetime)
    A_mj ~ p_j D_j N_mj,  new track ~ (new + clutter) / area,  rows normalised        p(m, j) of the 2014 paper's (1)
    p <- p L / (1 - p + p L),  L = 1 - D + D N / (clutter / area),  or 1 - D where it took no candidate

D is the probability of detection times that of lying inside the image, and the area is the image's in m rad. The
existence is that of integrated probabilistic data association (Musicki, Evans, Stankovic, IEEE TAC 39(6), 1994) for the
one candidate that the most probable assignment gives a track. An elevation enters once, when a track starts: what is
known of it is the same in every frame and must not be averaged.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import Field
from scipy.optimize import linear_sum_assignment
from scipy.special import ndtr
from scipy.stats import chi2

from sonar_graph.calibration import Section
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Floats, Ints
from sonar_graph.sonar.geometry import point_covariances, points
from sonar_graph.sonar.regions import Candidates
from sonar_graph.sonar.track_filter import Association, Expected, SonarStep, TrackStates, corrected

__all__ = ["SonarStep", "Tracker", "TrackingParams"]
NEVER = 1e9
"""Cost of what cannot be assigned."""


class TrackingParams(Section):
    """Settings of the tracker."""

    detection_probability: float = Field(0.9, gt=0, lt=1)
    """That an object inside the image becomes a candidate."""
    clutter_per_frame: float = Field(0.5, gt=0)
    """Accepted candidates a frame that are nothing persistent."""
    new_per_frame: float = Field(0.1, gt=0)
    """Objects a frame that come into view."""
    lifetime_s: float = Field(100.0, gt=0)
    """Mean time for which an object stays one."""
    range_sigma_m: float = Field(0.03, gt=0)
    """How far a centroid wanders in range: regions are cut differently in every frame."""
    azimuth_sigma_rad: float = Field(0.015, gt=0)
    """The same in azimuth."""
    drift_m: float = Field(0.005, ge=0)
    """What is added to each coordinate's deviation a frame, for what motion and a point at rest do not explain."""
    gate_probability: float = Field(0.999, gt=0, lt=1)
    """A candidate outside this quantile of a track's innovation (2 dof) cannot belong to it."""
    least_existence: float = Field(0.01, ge=0, lt=1)
    """A track is given up below it."""
    leaving_sigmas: float = Field(3.0, gt=0)
    """A track is given up when it is so many deviations outside the image."""


class Tracker:
    """Tracks of what persists, from the candidates of one frame after another.

    Parameters
    ----------
    params
        Settings; None for the defaults.
    """

    def __init__(self, params: TrackingParams | None = None) -> None:
        self.params = params or TrackingParams()
        self._noise = np.diag([self.params.range_sigma_m**2, self.params.azimuth_sigma_rad**2])
        self._gate = float(chi2.ppf(self.params.gate_probability, 2))
        self._tracks = TrackStates.none()
        self._skipped: SonarStep | None = None
        self._stamp_ns: int | None = None
        self._next_id = 0

    def skip(self, motion: SonarStep) -> None:
        """Let the sonar move without a frame, because there was none that could be used."""
        self._skipped = self._since_last_frame(motion)

    def _since_last_frame(self, motion: SonarStep) -> SonarStep:
        return motion if self._skipped is None else self._skipped.then(motion)

    def step(self, candidates: Candidates, motion: SonarStep | None, stamp_ns: int) -> Association:
        """Take in the accepted candidates of one frame.

        Parameters
        ----------
        candidates
            Of the frame, rejected ones included.
        motion
            Of the sonar since the frame before or the last `skip`; None: it stood still.
        stamp_ns
            Of the frame, later than that of the frame before.

        Raises
        ------
        MeasurementError
            When the stamp is not later.
        """
        before = self._before(motion or SonarStep.none(), stamp_ns)
        rows = candidates.accepted
        z = np.stack([candidates.range_m[rows], candidates.azimuth_rad[rows]], axis=1)
        expected = Expected.of(before, self._noise)
        inside = _sigmas_inside(expected, candidates.window)
        detection = self.params.detection_probability * _probability_inside(inside)
        densities = expected.densities(z, self._gate)
        area = float(np.prod(candidates.window[:, 1] - candidates.window[:, 0]))
        matrix = self._association(densities * (before.existence * detection), area)
        took = _assigned(matrix)
        after = corrected(before, expected, z, took, self._noise)
        after = replace(
            after,
            existence=self._existence(before.existence, detection, densities, took, area),
            frames_seen=before.frames_seen + (took >= 0),
        )
        reasons = [
            self._reason_to_end(*row) for row in zip(after.existence, inside.min(axis=(1, 2), initial=0.0), strict=True)
        ]
        new = np.array([row for row in range(len(rows)) if row not in took], dtype=np.int64)
        return self._association_of(stamp_ns, candidates, before.ids, after, matrix, took, new, reasons)

    def _before(self, motion: SonarStep, stamp_ns: int) -> TrackStates:
        """The tracks as they are expected at a frame."""
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            raise MeasurementError(
                f"sonar frame at {stamp_ns} ns is not later than the one before, {self._stamp_ns} ns; leave it out"
            )
        elapsed_s = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        moved = self._tracks.moved(self._since_last_frame(motion), self.params.drift_m)
        self._stamp_ns, self._skipped = stamp_ns, None
        return replace(moved, existence=moved.existence * np.exp(-elapsed_s / self.params.lifetime_s))

    def _association(self, weights: Floats, area: float) -> Floats:
        """Probabilities that candidates come from tracks, or (last column) from none, shape (candidates, M' + 1)."""
        unexplained = (self.params.new_per_frame + self.params.clutter_per_frame) / area
        weights = np.hstack([weights, np.full((len(weights), 1), unexplained)])
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def _existence(self, existence: Floats, detection: Floats, densities: Floats, took: Ints, area: float) -> Floats:
        """Existence after the candidates that tracks took."""
        likelihood = 1.0 - detection
        seen = np.flatnonzero(took >= 0)
        likelihood[seen] += detection[seen] * densities[took[seen], seen] * area / self.params.clutter_per_frame
        return np.asarray(existence * likelihood / (1.0 - existence + existence * likelihood))

    def _reason_to_end(self, existence: float, inside: float) -> str:
        """Why a track is given up; empty where it is not."""
        if existence < self.params.least_existence:
            return f"exists with less than {self.params.least_existence:g}"
        return "left the image" if inside < -self.params.leaving_sigmas else ""

    def _born(self, candidates: Candidates, rows: Ints) -> TrackStates:
        """New tracks of candidates."""
        n, params = len(rows), self.params
        ids = self._next_id + np.arange(n)
        self._next_id += n
        position = points(candidates.range_m[rows], candidates.azimuth_rad[rows], candidates.elevation_rad[rows])
        covariance = point_covariances(position, self._noise, candidates.elevation_sigma_rad[rows])
        existence = np.full(n, params.new_per_frame / (params.new_per_frame + params.clutter_per_frame))
        return TrackStates(ids, position, covariance, existence, np.ones(n, dtype=np.int64))

    def _association_of(
        self,
        stamp_ns: int,
        candidates: Candidates,
        previous_ids: Ints,
        after: TrackStates,
        matrix: Floats,
        took: Ints,
        new: Ints,
        reasons: list[str],
    ) -> Association:
        """Keep the tracks that go on, add those that start, and say how they belong to the ones before."""
        stay = np.flatnonzero([not reason for reason in reasons])
        ended = np.flatnonzero([bool(reason) for reason in reasons])
        rows = np.append(took[stay], new)
        itself = np.eye(len(previous_ids), len(previous_ids) + 1)[stay]
        own = np.vstack([itself, np.zeros((len(new), len(previous_ids) + 1))])
        own[rows >= 0] = matrix[rows[rows >= 0]]
        old = np.arange(len(stay))
        own[old, stay] += own[old, -1]  # where its candidate is of something new, a track was not seen and is itself
        own[old, -1] = 0.0
        tracks = after.rows(stay)
        if len(new):
            tracks = tracks.and_(self._born(candidates, candidates.accepted[new]))
        self._tracks = tracks
        return Association(
            stamp_ns=stamp_ns,
            previous_ids=previous_ids,
            track_ids=tracks.ids,
            matrix=own,
            candidate=np.where(rows >= 0, np.append(candidates.accepted, -1)[rows], -1),
            existence=tracks.existence,
            position_m=tracks.position_m,
            position_cov=tracks.position_cov,
            frames_seen=tracks.frames_seen,
            ended_ids=previous_ids[ended],
            ended_reasons=tuple(reasons[row] for row in ended),
        )


def _assigned(matrix: Floats) -> Ints:
    """The candidate of each track in the most probable assignment, -1: none, shape (M',)."""
    candidates, tracks = matrix.shape[0], matrix.shape[1] - 1
    if not candidates or not tracks:
        return np.full(tracks, -1)
    cost = np.full((candidates, tracks + candidates), NEVER)
    np.log(matrix[:, :tracks], out=cost[:, :tracks], where=matrix[:, :tracks] > 0)
    cost[:, :tracks] = np.where(matrix[:, :tracks] > 0, -cost[:, :tracks], NEVER)
    cost[np.arange(candidates), tracks + np.arange(candidates)] = -np.log(matrix[:, tracks])
    chosen = linear_sum_assignment(cost)[1]
    took = np.full(tracks, -1)
    taken = np.flatnonzero(chosen < tracks)
    took[chosen[taken]] = taken
    return took


def _sigmas_inside(expected: Expected, window: Floats) -> Floats:
    """Deviations from the lower and upper limits of range and azimuth, positive inside, shape (M', 2, 2)."""
    sigma = np.sqrt(np.diagonal(expected.S, axis1=1, axis2=2))
    return np.stack([(expected.z - window[:, 0]) / sigma, (window[:, 1] - expected.z) / sigma], axis=1)


def _probability_inside(sigmas: Floats) -> Floats:
    """That the range and the azimuth lie within their limits, shape (M',)."""
    return np.asarray(np.prod(ndtr(sigmas[:, 0]) - ndtr(-sigmas[:, 1]), axis=1))
