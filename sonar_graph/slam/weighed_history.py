"""A history in which watches count more or less: factors are made once, and given other noise for other weights."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
from gtsam.symbol_shorthand import L

from sonar_graph.measurements import Floats
from sonar_graph.slam.mixture import Watch
from sonar_graph.slam.sighting import Sighting, SightingFactors

LEAST_WEIGHT = 1e-6
"""Of a watch in a graph: what nothing else holds stays determinate."""


class WeighedHistory:
    """Watches that are each of one landmark, and all other factors.

    What is said once of a landmark, by its earliest sighting, is not weighed: it is not of a watch.

    Parameters
    ----------
    rest
        Those other factors.
    watches, ids
        At least one, and of which landmark each is.
    maker
        Makes factors; without a kernel.
    """

    def __init__(
        self, rest: gtsam.NonlinearFactorGraph, watches: list[Watch], ids: list[int], maker: SightingFactors
    ) -> None:
        self._unweighed = gtsam.NonlinearFactorGraph(rest)
        for landmark_id, first in earliest(watches, ids).items():
            for factor in maker.beginning(first, L(landmark_id)):
                self._unweighed.push_back(factor)
        self._maker = maker
        self._watches = [
            [(sighting, L(landmark_id), maker.measured(sighting, L(landmark_id))) for sighting in watch.sightings]
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
            return self._maker.measured(replace(sighting, noise=sighting.noise / weight), key)
        return [_with_sigmas(factor, factor.noiseModel().sigmas() / math.sqrt(weight)) for factor in factors]


def earliest(watches: list[Watch], ids: list[int]) -> dict[int, Sighting]:
    """The first sighting of each landmark, for watches that are each of one."""
    first: dict[int, Sighting] = {}
    for watch, landmark_id in zip(watches, ids, strict=True):
        for sighting in watch.sightings:
            known = first.get(landmark_id)
            if known is None or (sighting.stamp_ns, sighting.row) < (known.stamp_ns, known.row):
                first[landmark_id] = sighting
    return first


def _with_sigmas(factor: gtsam.NoiseModelFactor, sigmas: Floats) -> gtsam.NoiseModelFactor:
    return factor.cloneWithNewNoiseModel(gtsam.noiseModel.Diagonal.Sigmas(sigmas))
