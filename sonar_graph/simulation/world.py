"""Where the simulated vehicle drives: a flat floor with landmarks on it.

World z points up with z = 0 at the water's surface, so depths are negative heights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.states import LandmarkMap


@dataclass(frozen=True, eq=False)
class World:
    """A flat floor and what lies on it."""

    landmark_ids: Ints
    """Shape (m,), each once, ascending."""
    landmark_positions: Floats
    """Shape (m, 3), metres."""
    floor_z_m: float
    """Height of the floor."""

    def landmark_map(self) -> LandmarkMap:
        """The true landmarks; their covariances are unknown (NaN), because truth has none."""
        return LandmarkMap(self.landmark_ids, self.landmark_positions, np.full((len(self.landmark_ids), 3, 3), np.nan))


def world_on_floor(xy_m: Floats, floor_z_m: float, height_sigma_m: float, rng: np.random.Generator) -> World:
    """Landmarks with IDs 1, 2, ... whose heights are drawn around that of the floor.

    The heights are drawn so that the floor prior N(floor_z_m, height_sigma_m²) which estimators are given is true:
    landmarks exactly on the floor would make every estimator look too cautious.

    Parameters
    ----------
    xy_m
        Horizontal positions, shape (m, 2).
    floor_z_m
        Height of the floor.
    height_sigma_m
        Standard deviation of a landmark's height about the floor.
    rng
        Source of the heights.
    """
    heights = floor_z_m + height_sigma_m * rng.standard_normal(len(xy_m))
    return World(np.arange(1, len(xy_m) + 1), np.column_stack([xy_m, heights]), floor_z_m)
