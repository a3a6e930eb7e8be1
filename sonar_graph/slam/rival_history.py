"""The history as it would be if watches were of other landmarks, solved beside the one that stands.

Nothing here is written to: it is what results are chosen from when they are asked for, and asking must not change the
run. Factors are shared with it; they are never changed.
"""

from __future__ import annotations

from collections import defaultdict

import gtsam
from gtsam.symbol_shorthand import L

from sonar_graph.slam.batch import marginals_of
from sonar_graph.slam.graduated import graduate
from sonar_graph.slam.misplaced_landmarks import supporters_elsewhere
from sonar_graph.slam.mixture import Choices, Mixture, Watch
from sonar_graph.slam.sighting import Sighting, SightingFactors
from sonar_graph.slam.sightlines import Sightlines, solve_in_sight
from sonar_graph.slam.weighed_history import WeighedHistory, earliest

MOST_ROUNDS = 10
"""Times that choices are made anew."""
LEAST_GAIN = 1e-3
"""Of the cost, for another solution to be taken."""


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

    def settled(self, values: gtsam.Values, choices: Choices, *, is_graduated: bool) -> tuple[gtsam.Values, Choices]:
        """The nearest fixed point of the max-mixture from a solution with these choices.

        Parameters
        ----------
        is_graduated
            Whether to take what graduated non-convexity finds, if that costs less.
        """
        values, choices = self._fixed_point(values, choices)
        if is_graduated and self._known(values):
            found, others = self.graduated(values)
            if self.cost(found, others) < self.cost(values, choices) - LEAST_GAIN:
                return found, others
        return values, choices

    def marginals(self, values: gtsam.Values, choices: Choices) -> gtsam.Marginals | gtsam.ISAM2:
        """What gives the covariances of a solution."""
        return marginals_of(self._chosen_graph(choices), values)

    def cost(self, values: gtsam.Values, choices: Choices) -> float:
        """Of the max-mixture, with these components; what is said once of a landmark is of all other factors there."""
        scores = self._mixture.scores(self._watches, values, choices, self._sizes(choices))
        chosen = [(watch, choice) for watch, choice in zip(self._watches, choices, strict=True) if choice is not None]
        said_once = sum(
            factor.error(values)
            for landmark_id, first in earliest([w for w, _ in chosen], [i for _, i in chosen]).items()
            for factor in self._maker.beginning(first, L(landmark_id))
        )
        components = sum(score[choice] for score, choice in zip(scores, choices, strict=True))
        return float(self._rest.error(values)) + said_once - components

    def graduated(self, values: gtsam.Values) -> tuple[gtsam.Values, Choices]:
        """From graduated non-convexity on what the recogniser said, the nearest fixed point of the max-mixture."""
        known = self._known(values)
        named, ids = [watch for watch, _ in known], [i for _, i in known]
        weighed = WeighedHistory(self._rest, named, ids, self._maker.without_kernel())
        values, weights = graduate(
            weighed.graph,
            lambda values: self._mixture.squared_errors(named, ids, values),
            self._mixture.truncations(named),
            values,
        )
        kept = {w: i for w, i, weight in zip(named, ids, weights.tolist(), strict=True) if weight > 0.5}
        choices: Choices = [kept.get(watch) for watch in self._watches]
        return self._fixed_point(self._solve(values, choices), choices)

    def _known(self, values: gtsam.Values) -> list[tuple[Watch, int]]:
        """Watches that name a landmark of the graph, and that."""
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
        lines, start = Sightlines(), gtsam.Values(values)
        for watch, choice in zip(self._watches, choices, strict=True):
            if choice is not None:
                for sighting in watch.sightings:
                    lines.add(L(choice), sighting.line)
                if not start.exists(L(choice)):
                    start.insert(L(choice), self._maker.place(watch.sightings[0], values))
        return solve_in_sight(self._chosen_graph(choices), start, lines)

    def _chosen_graph(self, choices: Choices) -> gtsam.NonlinearFactorGraph:
        """The history with the watches of these landmarks."""
        graph = gtsam.NonlinearFactorGraph(self._rest)
        of: dict[int, list[Sighting]] = defaultdict(list)
        for watch, landmark_id in zip(self._watches, choices, strict=True):
            if landmark_id is not None:
                of[landmark_id] += watch.sightings
        for landmark_id, sightings in of.items():
            sightings.sort(key=lambda sighting: (sighting.stamp_ns, sighting.row))
            for k, sighting in enumerate(sightings):
                for factor in self._maker.make(sighting, L(landmark_id), is_first=k == 0):
                    graph.push_back(factor)
        return graph
