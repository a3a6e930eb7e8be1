"""Identities as a recogniser states them: accepted by posterior, or weighed as hypotheses of a mixture.

A recogniser states a posterior p over landmarks; what is missing to 1 is no landmark. With the probability q that the
statement has nothing to do with what was seen, K landmarks in the graph, and half of the errors being no landmark::

    w_i    = (1 - q) p_i + q / (2 K)          landmark i
    w_none = (1 - q) (1 - sum p) + q / 2      no landmark

No weight is zero: the place of a detection can refute any identity. A detection of no landmark may be anywhere in view,
with the density u over range and azimuth, 1/(m rad) (docs/theory/doubtful_identities.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from pydantic import Field
from scipy.stats import chi2

from sonar_graph.calibration import Section
from sonar_graph.measurements import NO_TRACK, Floats, Ints, LandmarkDetections
from sonar_graph.states import Outcome


@dataclass(frozen=True, eq=False)
class Identities:
    """Identity of each detection of a block, or the reason why it has none."""

    ids: Ints
    """Most probable identity, shape (n,)."""
    refusals: list[Outcome | None]
    """None where the identity is accepted, length n."""


def identify(detections: LandmarkDetections, minimum_probability: float) -> Identities:
    """Accept the most probable identity of each row where its posterior is high enough.

    A landmark is in one place: of several rows of one frame with one identity the most probable is accepted, the first
    of equals.

    Parameters
    ----------
    minimum_probability
        Rows whose highest posterior is below it, or is not a number, or belongs to no identity (-1), are refused.
    """
    ids, probability = detections.most_probable()
    refusals = [
        None if p >= minimum_probability and landmark_id >= 0 else Outcome.NO_IDENTITY
        for p, landmark_id in zip(probability.tolist(), ids.tolist(), strict=True)
    ]
    places = list(zip(detections.stamps_ns.tolist(), ids.tolist(), strict=True))
    best: dict[tuple[int, int], int] = {}
    for row, place in enumerate(places):
        if refusals[row] is None and (place not in best or probability[row] > probability[best[place]]):
            best[place] = row
    once = [why if why or best[places[row]] == row else Outcome.REPEATED for row, why in enumerate(refusals)]
    return Identities(ids, once)


UNDECIDED, NO_LANDMARK = -2, -1
"""Decisions of a row besides a landmark's identity."""


def decide(frame: LandmarkDetections, least_probability: float) -> list[int]:
    """Decision of each row: a landmark's identity, `NO_LANDMARK` or `UNDECIDED`."""
    ids, probability = frame.most_probable()
    none = 1.0 - frame.id_probability.sum(axis=1)
    return [
        landmark_id
        if p >= least_probability and landmark_id >= 0
        else (NO_LANDMARK if missing >= least_probability else UNDECIDED)
        for landmark_id, p, missing in zip(ids.tolist(), probability.tolist(), none.tolist(), strict=True)
    ]


def second_rows_of_tracks(frame: LandmarkDetections, identities: Mapping[int, int]) -> list[Outcome | None]:
    """Refusals of the rows of a frame that show an object a second time; None: the row stays.

    A track is one object in one place, so each frame keeps one row of it: that with the highest posterior for the
    landmark that the track counts as, by its number; of others, the one with the highest posterior for any landmark; of
    equals the first.
    """
    tracks = frame.track.tolist()
    best: dict[int, tuple[float, float, int]] = {}
    for row, track in enumerate(tracks):
        if track != NO_TRACK:
            is_landmark = frame.candidate_ids[row] >= 0
            ids, posterior = frame.candidate_ids[row, is_landmark], frame.id_probability[row, is_landmark]
            of_it = float(posterior[ids == identities.get(track, UNDECIDED)].sum())
            score = of_it, float(posterior.max(initial=0.0)), -row
            best[track] = max(best.get(track, score), score)
    return [
        None if track == NO_TRACK or -best[track][2] == row else Outcome.TRACK_REPEATED
        for row, track in enumerate(tracks)
    ]


@cache
def gate_threshold(probability: float, dof: int) -> float:
    """Squared Mahalanobis distance that a true innovation of ``dof`` components stays below with this probability."""
    return float(chi2.ppf(probability, dof))


LEAST_LANDMARKS = 20
"""Least K: while the graph has few landmarks, a mistaken name is more probably of one that is not in it yet."""


class RecogniserErrors(Section):
    """Error rate of a recogniser, and the view over which detections of no landmark are spread."""

    wrong_id_probability: float = Field(0.05, gt=0, lt=1)
    """Probability q that the recogniser's statement has nothing to do with the object seen; errors that its posterior
    admits come on top. One half of q is shared by the landmarks of the graph, the other half means: no landmark."""
    view_range_m: float = Field(10.0, gt=0)
    """Width of the interval of range over which detections of no landmark are taken as evenly distributed."""
    view_azimuth_rad: float = Field(2.0, gt=0)
    """Width of the interval of azimuth over which detections of no landmark are taken as evenly distributed."""

    @property
    def log_density(self) -> float:
        """Logarithm of u."""
        return -math.log(self.view_range_m * self.view_azimuth_rad)


@dataclass(frozen=True)
class IdentityPosterior:
    """Posterior that a recogniser stated for one detection, or last for a track."""

    probability: dict[int, float]
    """Posterior of each landmark considered; 0 for all others."""

    @classmethod
    def of(cls, frame: LandmarkDetections, row: int) -> IdentityPosterior:
        """Posterior of a row; NaN counts as 0, and a sum above 1 is normalised to 1."""
        stated: dict[int, float] = {}
        for landmark_id, p in zip(frame.candidate_ids[row].tolist(), frame.id_probability[row].tolist(), strict=True):
            if landmark_id >= 0 and p > 0:
                stated[landmark_id] = stated.get(landmark_id, 0.0) + p
        return cls({landmark_id: p / max(sum(stated.values()), 1.0) for landmark_id, p in stated.items()})

    @property
    def favourite(self) -> int | None:
        """Landmark more probable than all else together, or None."""
        return next((landmark_id for landmark_id, p in self.probability.items() if p > 0.5), None)

    def log_weights(self, ids: list[int], errors: RecogniserErrors) -> Floats:
        """Logarithms of w for K landmarks and for none, shape (K + 1,)."""
        q, p = errors.wrong_id_probability, self.probability
        none = (1.0 - q) * (1.0 - min(sum(p.values()), 1.0)) + 0.5 * q
        share = 0.5 * q / max(len(ids), LEAST_LANDMARKS)
        weights = np.array([(1.0 - q) * p.get(landmark_id, 0.0) + share for landmark_id in ids] + [none])
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(weights))
