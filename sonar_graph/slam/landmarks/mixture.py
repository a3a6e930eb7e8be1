"""Max-mixture of the landmarks that sightings may be of, and the choice that maximises it.

A *tracked object* g is all sightings j of one track, or one sighting of no track. It is one of the landmarks i, or
none; each of these hypotheses is a *component* of its mixture, with the log density l. Olson and Agarwal, "Inference on
networks of mixtures for robust robot mapping", IJRR 32(7), 2013: at every point x only the largest component counts::

    l_i(x)    = log w_i + sum_j [ log n - 1/2 log det R_j - rho(e_range) - rho(e_azimuth) ]        e = e(x, j, L_i)
    l_none(x) = log w_none + log density of the sightings if the object is no landmark
    cost(x)   = sum_g min_k -l_k(x)  +  cost of all other factors

with the kernel's loss rho, and n normalising ``n^2 / sqrt(det R) exp(-rho)``. Choosing components is a descent: a
landmark that began in a wrong place fits none of its own sightings, and nothing moves it. So the objects that name it
vote on its place, ``vote(p) = sum of max(l_i(p), l_none)``, at the point where it is and where each sighting that does
not fit has it (docs/theory/doubtful_identities.md).

Weights: a recogniser gives a posterior p over landmarks; the rest to 1 is that of no landmark. With the probability q
that the posterior has nothing to do with the object, K landmarks in the graph, and half of the errors being no
landmark, no weight is zero::

    w_i = (1 - q) p_i + q / (2 K),      w_none = (1 - q) (1 - sum p) + q / 2

A detection of no landmark may be anywhere in view, with the density u over range and azimuth, 1/(m rad).
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import accumulate

import numpy as np
from gtsam.symbol_shorthand import L
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.models import Kernel, polar_difference, project_points
from sonar_graph.slam.landmarks.sighting import Sighting
from sonar_graph.slam.smoother import Known, sighted_from

REPEATED_LOSS = 3.0
"""Mean loss, twice or thrice what noise alone gives, to which sightings of one thing that stands still agree."""


LEAST_LANDMARKS = 20
"""Least K: while the graph has few landmarks, a mistaken identity is more probably that of one not in it yet."""


class RecogniserErrors(Section):
    """Error rate of a recogniser, and the view over which detections of no landmark are spread."""

    wrong_id_probability: float = Field(0.05, gt=0, lt=1)
    """Probability q that the recogniser's posterior has nothing to do with the object seen; errors that the posterior
    admits come on top. One half of q is shared by the landmarks of the graph, the other half is that of no landmark."""
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
    """Posterior of a recogniser for one detection, or its last one for a track."""

    probability: dict[int, float]
    """Posterior of each landmark considered; 0 for all others."""

    @classmethod
    def of(cls, frame: LandmarkDetections, row: int) -> IdentityPosterior:
        """Posterior of a row; NaN counts as 0, and a sum above 1 is normalised to 1."""
        posterior: dict[int, float] = defaultdict(float)
        candidates = frame.candidate_ids[row].tolist()
        probabilities = frame.id_probability[row].tolist()
        for landmark_id, p in zip(candidates, probabilities, strict=True):
            if landmark_id >= 0 and p > 0:  # False for NaN
                posterior[landmark_id] += p
        total = max(sum(posterior.values()), 1.0)
        return cls({landmark_id: p / total for landmark_id, p in posterior.items()})

    @property
    def favourite(self) -> int | None:
        """Landmark more probable than all else together, or None."""
        return next(
            (landmark_id for landmark_id, p in self.probability.items() if p > 0.5),
            None,
        )

    def log_weights(self, ids: list[int], errors: RecogniserErrors) -> Floats:
        """Logarithms of w for K landmarks and for none, shape (K + 1,)."""
        q = errors.wrong_id_probability
        p = np.array([self.probability.get(landmark_id, 0.0) for landmark_id in ids])
        missing = 1.0 - min(sum(self.probability.values()), 1.0)
        # half of the errors are of another landmark, each as probable as the next, half of none
        w = (1.0 - q) * p + 0.5 * q / max(len(ids), LEAST_LANDMARKS)
        w_none = (1.0 - q) * missing + 0.5 * q
        return np.log(np.append(w, w_none))


@dataclass(eq=False)
class TrackedObject:
    """One object: the last posterior of the recogniser for it, and its sightings, at least one."""

    posterior: IdentityPosterior
    sightings: list[Sighting] = field(default_factory=list)

    @property
    def stamps_ns(self) -> set[int]:
        """Stamps of the frames that show it."""
        return {sighting.stamp_ns for sighting in self.sightings}


Choices = list[int | None]
"""Landmark that each tracked object counts as; None: no landmark."""
Scores = dict[int | None, float]
"""Log density l of each component of a tracked object; None: no landmark."""


class Mixture:
    """Log densities of tracked objects, from the recogniser's error rate and the kernel of a sighting's noise."""

    def __init__(self, errors: RecogniserErrors, kernel: Kernel) -> None:
        self._errors = errors
        self._kernel = kernel
        self._log_peak = 2.0 * kernel.log_normaliser

    def at_first(
        self,
        posterior: IdentityPosterior,
        ids: list[int],
        z: Floats,
        expected: Floats,
        S: Floats,
    ) -> Scores:
        """Components of a detection that the state is not yet conditioned on, with its innovation covariances S."""
        e = polar_difference(z, expected)  # (K, 2)
        new = [i for i in posterior.probability if i not in set(ids)]
        totals = posterior.log_weights(ids + new, self._errors)
        totals[: len(ids)] += self._log_density(e[:, None], S)[:, 0]
        # a landmark that is not in the graph may be anywhere in view, as may what is no landmark
        totals[len(ids) :] += self._errors.log_density
        return dict(zip([*ids, *new, None], totals.tolist(), strict=True))

    def gains(
        self,
        landmark_id: int,
        objects: list[TrackedObject],
        points: Floats,
        values: Known,
    ) -> Floats:
        """Log density l_i of a landmark at each of k points minus l_none, for n tracked objects, shape (n, k)."""
        log_weights = np.array(
            [
                each.posterior.log_weights([landmark_id], self._errors)
                for each in objects
            ]
        )
        log_odds = log_weights[:, 0] - log_weights[:, 1]
        unplaced = self._unplaced(objects)
        return (
            self._fits(objects, points, values) - unplaced[:, None] + log_odds[:, None]
        )

    def scores(
        self,
        objects: list[TrackedObject],
        values: Known,
        choices: Choices,
        sizes: dict[int, int],
    ) -> list[Scores]:
        """Log density of each component of each tracked object, at the estimate.

        A landmark that is seen by one object alone lies where that object's sightings put it and would always fit them.
        For this object it counts as a landmark of unknown place, like a landmark that is not in the graph.

        Parameters
        ----------
        choices
            What each counts as now.
        sizes
            Number of sightings of each landmark of the graph.
        """
        ids = sorted(sizes)
        points = np.array([values.atPoint3(L(i)) for i in ids]).reshape(-1, 3)
        fits = self._fits(objects, points, values)  # (n, K)
        unplaced = self._unplaced(objects).tolist()
        scores = []
        for k, each in enumerate(objects):
            choice = choices[k]
            if choice is not None and sizes[choice] == len(each.sightings):
                fits[k, ids.index(choice)] = unplaced[k]
            new = [i for i in each.posterior.probability if i not in sizes]
            totals = np.append(fits[k], [unplaced[k]] * (len(new) + 1))
            totals += each.posterior.log_weights([*ids, *new], self._errors)
            scores.append(dict(zip([*ids, *new, None], totals.tolist(), strict=True)))
        return scores

    def best(
        self,
        objects: list[TrackedObject],
        values: Known,
        choices: Choices,
        sizes: dict[int, int],
    ) -> Choices:
        """Largest component of each tracked object at the estimate; no landmark twice in a frame.

        A landmark that is not in the graph begins with one object, the one with most sightings. Others that chose it
        keep their present choice for now: its place is known only once it is in the graph.
        """
        if not objects:
            return []
        scores = self.scores(objects, values, choices, sizes)
        best = each_once(scores, [each.stamps_ns for each in objects])
        beginning: dict[int | None, int] = {}
        """Object with which each new landmark begins."""
        for k in sorted(range(len(objects)), key=lambda k: -len(objects[k].sightings)):
            if best[k] is not None and best[k] not in sizes:
                beginning.setdefault(best[k], k)
        return [
            choices[k] if beginning.get(new, k) != k else new
            for k, new in enumerate(best)
        ]

    def _unplaced(self, objects: list[TrackedObject]) -> Floats:
        """Log densities of the sightings of objects whose place is not known, shape (n,).

        The first sighting may be anywhere. The others are near it, with the mean loss `REPEATED_LOSS` of sightings of a
        thing that stands still. If each could be anywhere, many sightings of an unknown object would prove it to be the
        nearest landmark.
        """
        log_u = self._errors.log_density
        totals = []
        for each in objects:
            R = np.array([sighting.noise for sighting in each.sightings])
            peaks = self._log_peak - 0.5 * np.linalg.slogdet(R)[1]
            repeated = np.maximum(peaks[1:] - REPEATED_LOSS, log_u)
            totals.append(log_u + repeated.sum())
        return np.array(totals)

    def _log_density(self, e: Floats, cov: Floats) -> Floats:
        """Log densities of errors, shape (n, k, 2), whose covariances are of shape (n, 2, 2): (n, k)."""
        whitener = np.linalg.inv(np.linalg.cholesky(cov))
        losses = self._kernel.loss(np.einsum("nij,nkj->nki", whitener, e)).sum(axis=2)
        half_log_det = 0.5 * np.linalg.slogdet(cov)[1]
        return self._log_peak - half_log_det[:, None] - losses

    def _fits(
        self, objects: list[TrackedObject], points: Floats, values: Known
    ) -> Floats:
        """Log densities of tracked objects, for landmarks at points of the world, shape (n, k)."""
        sightings = [sighting for each in objects for sighting in each.sightings]
        views = sighted_from(values, [sighting.line for sighting in sightings])
        q = views.in_sonar(points)  # (sightings, k, 3)
        expected, _ = project_points(q.reshape(-1, 3))
        e = polar_difference(expected.reshape(*q.shape[:2], 2), views.z[:, None])
        noise = np.array([sighting.noise for sighting in sightings])
        single = self._log_density(e, noise)  # (sightings, k)
        # sum over the sightings of each object, which follow each other
        starts = list(
            accumulate((len(each.sightings) for each in objects[:-1]), initial=0)
        )
        return np.add.reduceat(single, starts, axis=0)


def each_once(scores: list[Scores], stamps_ns: list[set[int]]) -> Choices:
    """Best component of each object, those with the highest density first; a landmark is once in a frame."""
    chosen: Choices = [None] * len(scores)
    taken_ns: dict[int, set[int]] = defaultdict(set)
    """Stamps of the frames that show each landmark."""
    for row in sorted(range(len(scores)), key=lambda row: -max(scores[row].values())):
        for landmark_id in sorted(
            scores[row], key=scores[row].__getitem__, reverse=True
        ):
            if landmark_id is None:
                break
            if taken_ns[landmark_id].isdisjoint(stamps_ns[row]):
                taken_ns[landmark_id] |= stamps_ns[row]
                chosen[row] = landmark_id
                break
    return chosen


MOST_PROPOSALS = 20
"""Newest objects whose first sightings propose a place."""
MOST_VOTERS = 400
"""Newest objects that vote."""
LEAST_MARGIN = 3.0
"""A new place has to be e to this power times as probable."""


def supporters_elsewhere(
    landmark_id: int,
    objects: list[TrackedObject],
    choices: Choices,
    values: Known,
    mixture: Mixture,
) -> list[TrackedObject] | None:
    """Tracked objects that agree on a better place for the landmark that they name; None: no better place."""
    naming = [
        (each, choice)
        for each, choice in zip(objects, choices, strict=True)
        if each.posterior.favourite == landmark_id
    ]
    voters = [each for each, _ in naming[-MOST_VOTERS:]]
    others = [each for each, choice in naming if choice != landmark_id]
    proposals = [
        each.sightings[0].line.point(values) for each in others[-MOST_PROPOSALS:]
    ]
    if len(proposals) < 2:
        return None
    # the first: where the landmark is now
    points = np.vstack([values.atPoint3(L(landmark_id)), *proposals])
    gains = mixture.gains(landmark_id, voters, points, values)  # (voters, points)
    votes = np.maximum(gains, 0.0).sum(axis=0)
    winner = int(np.argmax(votes))
    if votes[winner] < votes[0] + LEAST_MARGIN:
        return None
    return [
        each
        for each, gain in zip(voters, gains[:, winner].tolist(), strict=True)
        if gain > 0.0
    ]
