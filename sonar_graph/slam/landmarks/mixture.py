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

Weights: a recogniser states a posterior p over landmarks; what is missing to 1 is no landmark. With the probability q
that the statement has nothing to do with what was seen, K landmarks in the graph, and half of the errors being no
landmark, no weight is zero::

    w_i = (1 - q) p_i + q / (2 K),      w_none = (1 - q) (1 - sum p) + q / 2

A detection of no landmark may be anywhere in view, with the density u over range and azimuth, 1/(m rad).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.models import Kernel, project_points, wrap_angle
from sonar_graph.slam.landmarks.sighting import Sighting

REPEATED_LOSS = 3.0
"""Mean loss, twice or thrice what noise alone gives, to which sightings of one thing that stands still agree."""


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


@dataclass(eq=False)
class TrackedObject:
    """One object (`watch` in code): the last statement of the recogniser on it, and its sightings, at least one."""

    statement: IdentityPosterior
    sightings: list[Sighting] = field(default_factory=list)

    @property
    def landmark_id(self) -> int | None:
        """Landmark that it counts as; None: no landmark."""
        return next((s.landmark_id for s in self.sightings if s.landmark_id is not None), None)

    @property
    def stamps_ns(self) -> set[int]:
        """Stamps of the frames that show it."""
        return {sighting.stamp_ns for sighting in self.sightings}


Choices = list[int | None]
"""Landmark that each tracked object counts as; None: no landmark."""
Scores = dict[int | None, float]
"""Log density l of each component of a tracked object; None: no landmark."""


class Errors:
    """Whitened errors of n sightings against landmarks, for poses as they are estimated."""

    def __init__(self, sightings: Sequence[Sighting], values: gtsam.Values) -> None:
        n = len(sightings)
        self._origin, self._axes = np.empty((n, 3)), np.empty((n, 3, 3))
        poses: dict[int, gtsam.Pose3] = {}
        for j, sighting in enumerate(sightings):
            line = sighting.line
            if line.pose_key not in poses:
                poses[line.pose_key] = values.atPose3(line.pose_key)
            world_T_sonar = poses[line.pose_key].compose(line.body_T_sonar)
            self._origin[j], self._axes[j] = world_T_sonar.translation(), world_T_sonar.rotation().matrix()
        self._z = np.array([sighting.line.z for sighting in sightings]).reshape(n, 2)
        noise = np.array([sighting.noise for sighting in sightings]).reshape(n, 2, 2)
        self._whitener = np.linalg.inv(np.linalg.cholesky(noise))
        self.half_log_det = 0.5 * np.linalg.slogdet(noise)[1]
        """Of each sighting's noise, shape (n,)."""

    def of(self, points: Floats) -> Floats:
        """Against landmarks at points of the world, shape (K, 3): range and azimuth, shape (n, K, 2)."""
        q = np.einsum("nji,nkj->nki", self._axes, points[None] - self._origin[:, None])
        expected, _ = project_points(q.reshape(-1, 3))
        e = expected.reshape(*q.shape[:2], 2) - self._z[:, None]
        e[..., 1] = wrap_angle(e[..., 1])
        return np.einsum("nij,nkj->nki", self._whitener, e)

    def located(self) -> Floats:
        """Points of the world where each was seen if at elevation 0, shape (n, 3), m."""
        r, a = self._z.T
        on_beam = np.column_stack((r * np.cos(a), r * np.sin(a), np.zeros_like(r)))
        return self._origin + np.einsum("nij,nj->ni", self._axes, on_beam)


class Mixture:
    """Log densities of tracked objects, from the recogniser's error rate and the kernel of a sighting's noise."""

    def __init__(self, errors: RecogniserErrors, kernel: Kernel) -> None:
        self._errors = errors
        self._kernel = kernel
        self._log_peak = 2.0 * kernel.log_normaliser

    def at_first(self, statement: IdentityPosterior, ids: list[int], z: Floats, expected: Floats, S: Floats) -> Scores:
        """Components of a detection that the state is not yet conditioned on, with its innovation covariances S."""
        e = z - expected
        e[:, 1] = wrap_angle(e[:, 1])
        whitener = np.linalg.inv(np.linalg.cholesky(S))
        log_densities = (
            self._log_peak
            - 0.5 * np.linalg.slogdet(S)[1]
            - self._kernel.loss(np.einsum("kij,kj->ki", whitener, e)).sum(axis=1)
        )
        new = [i for i in statement.probability if i not in set(ids)]
        totals = statement.log_weights(ids + new, self._errors)
        totals[: len(ids)] += log_densities
        totals[len(ids) :] += self._errors.log_density
        return dict(zip([*ids, *new, None], totals.tolist(), strict=True))

    def gains(self, landmark_id: int, watches: list[TrackedObject], points: Floats, values: gtsam.Values) -> Floats:
        """Log density l_i of a landmark at each of k points minus l_none, for n tracked objects, shape (n, k)."""
        fits = self._fits(watches, points, values)
        weights = np.array([watch.statement.log_weights([landmark_id], self._errors) for watch in watches])
        return np.asarray(fits - self._unplaced(watches)[:, None] + (weights[:, 0] - weights[:, 1])[:, None])

    def _peaks(self, watch: TrackedObject) -> Floats:
        """Log density of each sighting where it fits perfectly, shape (n,)."""
        noise = np.array([sighting.noise for sighting in watch.sightings])
        return np.asarray(self._log_peak - 0.5 * np.linalg.slogdet(noise)[1])

    def _unplaced(self, watches: list[TrackedObject]) -> Floats:
        """Log densities of the sightings of objects whose place is not known, shape (n,).

        The first sighting may be anywhere. The others are near it, with the mean loss `REPEATED_LOSS` of sightings of a
        thing that stands still. If each could be anywhere, many sightings of an unknown object would prove it to be the
        nearest landmark.
        """
        u = self._errors.log_density
        return np.array([u + np.maximum(self._peaks(w)[1:] - REPEATED_LOSS, u).sum() for w in watches])

    def _fits(self, watches: list[TrackedObject], points: Floats, values: gtsam.Values) -> Floats:
        """Log densities of tracked objects, for landmarks at points of the world, shape (n, k)."""
        errors = Errors([s for watch in watches for s in watch.sightings], values)
        single = self._log_peak - errors.half_log_det[:, None] - self._kernel.loss(errors.of(points)).sum(axis=2)
        return np.asarray(np.add.reduceat(single, _starts(watches), axis=0))

    def scores(
        self, watches: list[TrackedObject], values: gtsam.Values, choices: Choices, sizes: dict[int, int]
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
        ids, unplaced = sorted(sizes), self._unplaced(watches)
        points = np.array([values.atPoint3(L(i)) for i in ids]).reshape(-1, 3)
        fits, scores = self._fits(watches, points, values), []
        for watch, choice, own, anywhere in zip(watches, choices, fits, unplaced.tolist(), strict=True):
            if choice is not None and sizes[choice] == len(watch.sightings):
                own[ids.index(choice)] = anywhere
            new = [i for i in watch.statement.probability if i not in sizes]
            totals = np.append(own, np.full(len(new) + 1, anywhere))
            totals += watch.statement.log_weights([*ids, *new], self._errors)
            scores.append(dict(zip([*ids, *new, None], totals.tolist(), strict=True)))
        return scores

    def best(
        self, watches: list[TrackedObject], values: gtsam.Values, choices: Choices, sizes: dict[int, int]
    ) -> Choices:
        """Largest component of each tracked object at the estimate; no landmark twice in a frame.

        A landmark that is not in the graph begins with one object, the one with most sightings. Others that chose it
        keep their present choice for now: its place is known only once it is in the graph.
        """
        if not watches:
            return []
        found = each_once(self.scores(watches, values, choices, sizes), [watch.stamps_ns for watch in watches])
        beginning: dict[int, TrackedObject] = {}
        for watch, new in sorted(zip(watches, found, strict=True), key=lambda pair: -len(pair[0].sightings)):
            if new is not None and new not in sizes:
                beginning.setdefault(new, watch)
        return [
            old if new in beginning and beginning[new] is not watch else new
            for watch, old, new in zip(watches, choices, found, strict=True)
        ]


def _starts(watches: list[TrackedObject]) -> list[int]:
    """First index of each object's sightings when those of all objects are joined."""
    return list(accumulate((len(watch.sightings) for watch in watches[:-1]), initial=0))


def each_once(scores: list[Scores], stamps_ns: list[set[int]]) -> list[int | None]:
    """Best component of each object, those with the highest density first; a landmark is once in a frame."""
    chosen: list[int | None] = [None] * len(scores)
    taken: dict[int, set[int]] = {}
    for row in sorted(range(len(scores)), key=lambda row: -max(scores[row].values())):
        for landmark_id in sorted(scores[row], key=scores[row].__getitem__, reverse=True):
            if landmark_id is None:
                break
            if taken.setdefault(landmark_id, set()).isdisjoint(stamps_ns[row]):
                taken[landmark_id] |= stamps_ns[row]
                chosen[row] = landmark_id
                break
    return chosen


MOST_PROPOSALS = 20
"""Newest objects whose first sightings propose a place."""
MOST_VOTERS = 400
LEAST_MARGIN = 3.0
"""A new place has to be e to this power times as probable."""


def supporters_elsewhere(
    landmark_id: int, watches: list[TrackedObject], choices: Choices, values: gtsam.Values, mixture: Mixture
) -> list[TrackedObject] | None:
    """Tracked objects that agree on a better place for the landmark that they name; None: no better place."""
    voters = watches[-MOST_VOTERS:]
    proposals = [w for w, choice in zip(watches, choices, strict=True) if choice != landmark_id][-MOST_PROPOSALS:]
    if len(proposals) < 2:
        return None
    places = Errors([watch.sightings[0] for watch in proposals], values).located()
    points = np.vstack([values.atPoint3(L(landmark_id)), places])
    gains = mixture.gains(landmark_id, voters, points, values)
    votes = np.maximum(gains, 0.0).sum(axis=0)
    winner = int(np.argmax(votes))
    if votes[winner] < votes[0] + LEAST_MARGIN:
        return None
    return [watch for watch, gain in zip(voters, gains[:, winner].tolist(), strict=True) if gain > 0.0]
