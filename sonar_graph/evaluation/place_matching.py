"""Landmarks that an estimator has named itself, matched to the true ones by their place.

An estimator that is not told identities gives its landmarks some of its own, from `FIRST_ANONYMOUS_ID` on. Maps are
compared by identity, so that no landmark is ever mistaken for a known one; to score these, they are named first.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from sonar_graph.states import FIRST_ANONYMOUS_ID, LandmarkMap

FARTHEST_M = 1.0
"""Farther from a true landmark than this, horizontally, one without a name is not taken for it when it is scored."""


def anonymous_named(estimated: LandmarkMap, true: LandmarkMap | None) -> LandmarkMap:
    """The map as it is scored: landmarks without a name get that of the true one within `FARTHEST_M`."""
    return estimated if true is None else named_by_place(estimated, true, FARTHEST_M)


def named_by_place(estimated: LandmarkMap, true: LandmarkMap, farthest_m: float) -> LandmarkMap:
    """The estimated map, in which landmarks of unknown identity get that of the true landmark at their place.

    Of all matchings one to one between landmarks of unknown identity and true ones that no identity of the map names,
    the one with the most pairs within ``farthest_m``, horizontally, and of these the one with the least sum of squared
    distances (Kuhn, Naval Research Logistics 2, 1955). What is matched with none keeps its identity.

    Parameters
    ----------
    farthest_m
        Farther apart than this nothing is matched. Neither map is aligned.
    """
    unknown = np.flatnonzero((estimated.ids >= FIRST_ANONYMOUS_ID) & ~np.isin(estimated.ids, true.ids))
    free = np.flatnonzero(~np.isin(true.ids, estimated.ids))
    apart = estimated.positions[unknown, None, :2] - true.positions[None, free, :2]
    squared = np.sum(apart**2, axis=-1)
    is_near = squared <= farthest_m**2
    too_far = farthest_m**2 * (min(squared.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(is_near, squared, too_far))
    matched = is_near[rows, columns]
    ids = estimated.ids.copy()
    ids[unknown[rows[matched]]] = true.ids[free[columns[matched]]]
    order = np.argsort(ids)
    return LandmarkMap(ids[order], estimated.positions[order], estimated.covariances[order])
