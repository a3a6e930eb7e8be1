"""Which cells of the floor a sonar can see."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.measurements import Floats, Ints
from sonar_graph.simulation.scatterers import CELL_M


class Sector(NamedTuple):
    """Part of the floor as the sonar's foot sees it."""

    heading: Floats
    """Horizontal unit vector of the sonar's axis, shape (2,)."""
    half_bearing_rad: float
    nearest_m: float
    """Horizontal distances."""
    farthest_m: float


class Cells(NamedTuple):
    """Cells row by row."""

    first_row: int
    spans: Ints
    """First and last column (not included) of each row, shape (rows, 2)."""


def lit_sector(
    world_R_sonar: Rotation,
    height_m: float,
    ranges_m: tuple[float, float],
    half_azimuth_rad: float,
    half_lift_rad: float,
) -> Sector | None:
    """Floor within the ranges and within the angles either side of the axis; None where there is none."""
    axis = world_R_sonar.apply([1.0, 0.0, 0.0])
    azimuth, lift = np.meshgrid(
        np.linspace(-half_azimuth_rad, half_azimuth_rad, 5), np.linspace(-half_lift_rad, half_lift_rad, 5)
    )
    rays = world_R_sonar.apply(
        np.stack([np.cos(lift) * np.cos(azimuth), np.cos(lift) * np.sin(azimuth), np.sin(lift)], -1).reshape(-1, 3)
    )
    run = np.hypot(rays[:, 0], rays[:, 1])
    nearest, farthest = (np.sqrt(max(r**2 - height_m**2, 0.0)) for r in ranges_m)
    drop = -rays[:, 2] / run
    nearest = max(nearest, height_m / max(drop.max(), 1e-6))
    if drop.min() > 0:
        farthest = min(farthest, height_m / drop.min())
    if nearest >= farthest or height_m <= 0:
        return None
    heading = axis[:2] / np.hypot(*axis[:2])
    bearings = np.arctan2(heading[0] * rays[:, 1] - heading[1] * rays[:, 0], rays[:, :2] @ heading)
    return Sector(heading, float(np.abs(bearings).max()), float(nearest), float(farthest))


def cells_of(sector: Sector, foot_m: Floats) -> Cells:
    """Cells of a four-cornered part of the floor that holds the sector; ``foot_m`` is what lies below the sonar."""
    bearing = sector.half_bearing_rad * np.array([1, 1, 0, -1, -1])
    far_m = sector.farthest_m / np.cos(sector.half_bearing_rad / 2)
    reach_m = np.array([sector.nearest_m, far_m, far_m, far_m, sector.nearest_m])
    ahead, aside = reach_m * np.cos(bearing), reach_m * np.sin(bearing)
    x = (foot_m[0] + sector.heading[0] * ahead - sector.heading[1] * aside) / CELL_M
    y = (foot_m[1] + sector.heading[1] * ahead + sector.heading[0] * aside) / CELL_M
    first_row, end_row = int(np.floor(y.min())), int(np.ceil(y.max()))
    middle = np.arange(first_row, end_row) + 0.5
    left, right = np.full(len(middle), np.inf), np.full(len(middle), -np.inf)
    for x1, y1, x2, y2 in zip(x, y, np.roll(x, -1), np.roll(y, -1), strict=True):
        if abs(y2 - y1) < 1e-9:
            continue
        crosses = (middle >= min(y1, y2)) & (middle <= max(y1, y2))
        at = x1 + (middle[crosses] - y1) * (x2 - x1) / (y2 - y1)
        left[crosses], right[crosses] = np.minimum(left[crosses], at), np.maximum(right[crosses], at)
    empty = left > right
    left[empty], right[empty] = x[0], x[0]
    return Cells(first_row, np.column_stack([np.floor(left), np.ceil(right)]).astype(np.int64))
