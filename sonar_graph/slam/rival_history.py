"""The history as it would be if watches were of other landmarks, solved beside the one that stands."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.measurements import Floats
from sonar_graph.slam.batch import solve
from sonar_graph.slam.graduated import graduate
from sonar_graph.slam.mixture import Choices, Mixture, Watch
from sonar_graph.slam.sighting import Sighting, SightingFactors

MOST_ROUNDS = 10
"""Times that choices are made anew."""
LEAST_WEIGHT = 1e-6
"""A watch of less is left out."""


class RivalHistory:
    """All watches, and all factors that are not of their sightings.

    Parameters
    ----------
    rest
        Those factors.
    watches, mixture
        What is chosen, and by what.
    maker
        Makes factors of sightings.
    """

    def __init__(
        self, rest: gtsam.NonlinearFactorGraph, watches: list[Watch], mixture: Mixture, maker: SightingFactors
    ) -> None:
        self._rest = rest
        self._watches = watches
        self._mixture = mixture
        self._maker = maker

    def cost(self, values: gtsam.Values, choices: Choices) -> float:
        """Of the max-mixture, with these components."""
        scores = self._mixture.scores(self._watches, values, choices, self._sizes(choices))
        return float(self._rest.error(values)) - sum(s[choice] for s, choice in zip(scores, choices, strict=True))

    def graduated(self, values: gtsam.Values) -> tuple[gtsam.Values, Choices]:
        """From graduated non-convexity on what the recogniser said, the nearest fixed point of the max-mixture."""
        favourites = [(watch, watch.statement.favourite) for watch in self._watches]
        known = [(watch, i) for watch, i in favourites if i is not None and values.exists(L(i))]
        named, ids = [watch for watch, _ in known], [i for _, i in known]
        plain = self._maker.without_kernel()
        values, weights = graduate(
            lambda weights: self._graph(named, [*ids], weights, plain),
            lambda values: self._mixture.squared_errors(named, ids, values),
            self._mixture.truncations(named),
            values,
        )
        kept = {w: i for w, i, weight in zip(named, ids, weights.tolist(), strict=True) if weight > 0.5}
        return self._fixed_point(values, [kept.get(watch) for watch in self._watches])

    def _sizes(self, choices: Choices) -> dict[int, int]:
        sizes: dict[int, int] = defaultdict(int)
        for watch, choice in zip(self._watches, choices, strict=True):
            if choice is not None:
                sizes[choice] += len(watch.sightings)
        return sizes

    def _fixed_point(self, values: gtsam.Values, choices: Choices) -> tuple[gtsam.Values, Choices]:
        for _ in range(MOST_ROUNDS):
            values = solve(self._graph(self._watches, choices, np.ones(len(choices)), self._maker), values)
            better = self._mixture.best(self._watches, values, choices, self._sizes(choices))
            if better == choices:
                break
            choices = better
        return values, choices

    def _graph(
        self, watches: list[Watch], choices: Choices, weights: Floats, maker: SightingFactors
    ) -> gtsam.NonlinearFactorGraph:
        """The history with these watches of these landmarks; weights divide their covariances."""
        graph = gtsam.NonlinearFactorGraph(self._rest)
        of: dict[int, list[tuple[Sighting, float]]] = defaultdict(list)
        for watch, landmark_id, weight in zip(watches, choices, weights.tolist(), strict=True):
            if landmark_id is not None:
                of[landmark_id] += [(sighting, max(weight, LEAST_WEIGHT)) for sighting in watch.sightings]
        for landmark_id, sightings in of.items():
            sightings.sort(key=lambda pair: (pair[0].stamp_ns, pair[0].row))
            for k, (sighting, weight) in enumerate(sightings):
                weighed = sighting if weight == 1.0 else replace(sighting, noise=sighting.noise / weight)
                for factor in maker.make(weighed, L(landmark_id), is_first=k == 0):
                    graph.push_back(factor)
        return graph
