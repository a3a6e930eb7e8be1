"""Whole history under other choices of landmarks, solved beside the run for smoothed results.

A question for results must not change the run: this module reads its factors and changes nothing. Besides choosing
again, graduated non-convexity finds the right sightings without a good start (Yang, Antonante, Tzoumas, Carlone,
"Graduated non-convexity for robust spatial perception", IEEE RA-L 5(2), 2020). Every tracked object g is the landmark
that it names, with its squared error r_g^2, or none, at a constant c_g^2::

    min_x  sum_g min(r_g^2, c_g^2) / 2 + |odometry and all else|^2 / 2                                           (1)

which is the max-mixture of these two components: ``c_g^2 / 2`` is how much more probable a perfect fit is than none.
The minimum in (1) is graduated by mu, from nearly convex to (1) itself; each mu weighs objects by the paper's (14)::

    w = 0  where r^2 >= (mu + 1) / mu c^2,   1  where r^2 <= mu / (mu + 1) c^2,   else  c / r sqrt(mu (mu + 1)) - mu

`gtsam.GncLMOptimizer` weighs each factor alone; here an object is kept or dropped whole (doubtful_identities.md).
"""

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.measurements import Floats
from sonar_graph.slam.landmarks.mixture import Choices, Mixture, TrackedObject, supporters_elsewhere
from sonar_graph.slam.landmarks.sighting import Sighting, SightingFactors
from sonar_graph.slam.smoother import marginals_of, solve, solve_in_sight

LEAST_WEIGHT = 1e-6
"""Least weight of an object: variables that only its sightings hold stay determinate."""


class WeighedHistory:
    """Graph of the whole history in which each tracked object, of one landmark, has a weight.

    The factors that come once for a landmark, with its earliest sighting, are not weighed. The maker has no kernel.
    """

    def __init__(
        self, rest: gtsam.NonlinearFactorGraph, watches: list[TrackedObject], ids: list[int], maker: SightingFactors
    ) -> None:
        self._unweighed = gtsam.NonlinearFactorGraph(rest)
        for landmark_id, first in earliest(watches, ids).items():
            for factor in maker.beginning(first, L(landmark_id)).values():
                self._unweighed.push_back(factor)
        self._maker = maker
        self._watches = [
            [
                (sighting, L(landmark_id), list(maker.measured(sighting, L(landmark_id)).values()))
                for sighting in watch.sightings
            ]
            for watch, landmark_id in zip(watches, ids, strict=True)
        ]

    def graph(self, weights: Floats) -> gtsam.NonlinearFactorGraph:
        """The history with these weights, shape (n,), from 0 to 1: they divide the covariances of what was measured."""
        graph = gtsam.NonlinearFactorGraph(self._unweighed)
        for watch, weight in zip(self._watches, weights.tolist(), strict=True):
            for sighting, key, factors in watch:
                for factor in factors if weight == 1.0 else self._weighed(sighting, key, factors, weight):
                    graph.push_back(factor)
        return graph

    def _weighed(
        self, sighting: Sighting, key: int, factors: list[gtsam.NoiseModelFactor], weight: float
    ) -> list[gtsam.NoiseModelFactor]:
        weight = max(weight, LEAST_WEIGHT)
        if any(isinstance(factor, gtsam.CustomFactor) for factor in factors):  # of those GTSAM makes no copies
            return list(self._maker.measured(replace(sighting, noise=sighting.noise / weight), key).values())
        divisor, diagonal = math.sqrt(weight), gtsam.noiseModel.Diagonal.Sigmas
        return [f.cloneWithNewNoiseModel(diagonal(f.noiseModel().sigmas() / divisor)) for f in factors]


def earliest(watches: list[TrackedObject], ids: list[int]) -> dict[int, Sighting]:
    """Earliest sighting of each landmark, from tracked objects and the landmark of each."""
    first: dict[int, Sighting] = {}
    for watch, landmark_id in zip(watches, ids, strict=True):
        for sighting in watch.sightings:
            known = first.get(landmark_id)
            if known is None or (sighting.stamp_ns, sighting.row) < (known.stamp_ns, known.row):
                first[landmark_id] = sighting
    return first


MU_FACTOR = 1.4
"""By which mu grows, as in the paper."""
STEPS_EACH = 2
"""Levenberg-Marquardt steps at each mu."""
MOST_GRADES = 60
DECIDED = 1e-3
"""Weights so near to 0 and 1 end it."""


def graduated_weights(
    weighted: Callable[[Floats], gtsam.NonlinearFactorGraph],
    squared_errors: Callable[[gtsam.Values], Floats],
    c2: Floats,
    values: gtsam.Values,
) -> tuple[gtsam.Values, Floats]:
    """Solution of (1), and the weight of each object, shape (n,): 0 or 1, or nearly.

    At the first mu (1) is nearly convex: the largest error is still weighed.
    """
    worst = float((squared_errors(values) / c2).max(initial=0.0))
    mu, weights = 1.0 / (2.0 * worst - 1.0) if worst > 1.0 else np.inf, np.ones(len(c2))
    for _ in range(MOST_GRADES if np.isfinite(mu) else 0):
        r2 = squared_errors(values)
        with np.errstate(divide="ignore"):
            between = np.sqrt(c2 * mu * (mu + 1.0) / r2) - mu
        weights = np.where(r2 <= mu / (mu + 1.0) * c2, 1.0, np.where(r2 >= (mu + 1.0) / mu * c2, 0.0, between))
        values = solve(weighted(weights), values, STEPS_EACH)
        if ((weights < DECIDED) | (weights > 1.0 - DECIDED)).all():
            break
        mu *= MU_FACTOR
    return values, weights


MOST_ROUNDS = 10
"""Times that choices are made anew."""
LEAST_GAIN = 1e-3
"""Of the cost, for another solution to be taken."""


class RivalHistory:
    """Other choices for all tracked objects: their mixture, and all factors that are not of their sightings."""

    def __init__(
        self, rest: gtsam.NonlinearFactorGraph, watches: list[TrackedObject], mixture: Mixture, maker: SightingFactors
    ) -> None:
        self._rest = rest
        self._watches = watches
        self._mixture = mixture
        self._maker = maker

    def settled(self, values: gtsam.Values, choices: Choices, *, is_graduated: bool) -> tuple[gtsam.Values, Choices]:
        """Nearest fixed point of the max-mixture from these choices, or what graduated non-convexity finds."""
        values, choices = self._fixed_point(values, choices)
        if is_graduated and self._known(values):
            found, others = self.graduated(values)
            if self.cost(found, others) < self.cost(values, choices) - LEAST_GAIN:
                return found, others
        return values, choices

    def marginals(self, values: gtsam.Values, choices: Choices) -> gtsam.Marginals | gtsam.ISAM2:
        """Marginals of a solution."""
        return marginals_of(self._chosen_graph(choices), values)

    def cost(self, values: gtsam.Values, choices: Choices) -> float:
        """Cost of the max-mixture with these components; what is said once of a landmark is among the other factors."""
        scores = self._mixture.scores(self._watches, values, choices, self._sizes(choices))
        chosen = [(watch, choice) for watch, choice in zip(self._watches, choices, strict=True) if choice is not None]
        said_once = sum(
            factor.error(values)
            for landmark_id, first in earliest([w for w, _ in chosen], [i for _, i in chosen]).items()
            for factor in self._maker.beginning(first, L(landmark_id)).values()
        )
        components = sum(score[choice] for score, choice in zip(scores, choices, strict=True))
        return float(self._rest.error(values)) + said_once - components

    def graduated(self, values: gtsam.Values) -> tuple[gtsam.Values, Choices]:
        """From graduated non-convexity on what the recogniser said, the nearest fixed point of the max-mixture."""
        known = self._known(values)
        named, ids = [watch for watch, _ in known], [i for _, i in known]
        weighed = WeighedHistory(self._rest, named, ids, self._maker.without_kernel())
        values, weights = graduated_weights(
            weighed.graph,
            lambda values: self._mixture.squared_errors(named, ids, values),
            self._mixture.truncations(named),
            values,
        )
        kept = {w: i for w, i, weight in zip(named, ids, weights.tolist(), strict=True) if weight > 0.5}
        choices: Choices = [kept.get(watch) for watch in self._watches]
        return self._fixed_point(self._solve(values, choices), choices)

    def _known(self, values: gtsam.Values) -> list[tuple[TrackedObject, int]]:
        """Tracked objects that name a landmark of the graph, each with that landmark."""
        favourites = [(watch, watch.statement.favourite) for watch in self._watches]
        return [(watch, i) for watch, i in favourites if i is not None and values.exists(L(i))]

    def _sizes(self, choices: Choices) -> dict[int, int]:
        sizes: dict[int, int] = defaultdict(int)
        for watch, choice in zip(self._watches, choices, strict=True):
            if choice is not None:
                sizes[choice] += len(watch.sightings)
        return sizes

    def _fixed_point(self, values: gtsam.Values, choices: Choices) -> tuple[gtsam.Values, Choices]:
        for _ in range(MOST_ROUNDS):
            start, better = values, self._mixture.best(self._watches, values, choices, self._sizes(choices))
            if better == choices:
                start, better = self._relocated(values, choices)
            if better == choices:
                break
            values, choices = self._solve(start, better), better
        return values, choices

    def _relocated(self, values: gtsam.Values, choices: Choices) -> tuple[gtsam.Values, Choices]:
        """Landmarks that began with something else begin where those that name them agree that they are."""
        moved = gtsam.Values(values)
        for landmark_id in sorted(self._sizes(choices)):
            rows = [row for row, watch in enumerate(self._watches) if watch.statement.favourite == landmark_id]
            naming, now = [self._watches[row] for row in rows], [choices[row] for row in rows]
            found = supporters_elsewhere(landmark_id, naming, now, values, self._mixture)
            if found is not None:
                without = [None if choice == landmark_id else choice for choice in choices]
                choices = [landmark_id if w in found else c for w, c in zip(self._watches, without, strict=True)]
                first = min((s for watch in found for s in watch.sightings), key=lambda s: (s.stamp_ns, s.row))
                moved.update(L(landmark_id), self._maker.place(first, values))
        return moved, choices

    def _solve(self, values: gtsam.Values, choices: Choices) -> gtsam.Values:
        lines, start = defaultdict(list), gtsam.Values(values)
        for watch, choice in zip(self._watches, choices, strict=True):
            if choice is not None:
                for sighting in watch.sightings:
                    lines[L(choice)].append(sighting.line)
                if not start.exists(L(choice)):
                    start.insert(L(choice), self._maker.place(watch.sightings[0], values))
        return solve_in_sight(self._chosen_graph(choices), start, lines)

    def _chosen_graph(self, choices: Choices) -> gtsam.NonlinearFactorGraph:
        """Graph of the history in which each tracked object is the landmark chosen for it."""
        graph = gtsam.NonlinearFactorGraph(self._rest)
        of: dict[int, list[Sighting]] = defaultdict(list)
        for watch, landmark_id in zip(self._watches, choices, strict=True):
            if landmark_id is not None:
                of[landmark_id] += watch.sightings
        for landmark_id, sightings in of.items():
            sightings.sort(key=lambda sighting: (sighting.stamp_ns, sighting.row))
            for k, sighting in enumerate(sightings):
                for factor in self._maker.make(sighting, L(landmark_id), is_first=k == 0).values():
                    graph.push_back(factor)
        return graph
