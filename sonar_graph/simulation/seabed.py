"""What lies on the floor: landmarks, stones, and flat patches that are no landmarks.

Each is turned once into a patch of the scatterers' grid, which says how strongly each cell scatters and how high it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sonar_graph.landmark_designs import LandmarkDesign
from sonar_graph.measurements import Floats
from sonar_graph.simulation.scatterers import CELL_M, Floats32

Shape = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Level over the floor in dB (NaN: floor) and height over it in metres, at points of the object's own frame."""
SLOPE_M = 0.4
"""Over which the floor rises or falls to the bottom of a landmark."""


@dataclass(frozen=True, eq=False)
class SeabedObject:
    """Something on the floor."""

    id: int
    """Of a landmark its identity, otherwise negative."""
    kind: str
    position_m: Floats
    """World position of the centre of its face, or of its foot, shape (3,)."""
    yaw_rad: float
    extent_m: float
    """Radius of the disc that its material covers."""
    radius_m: float
    """Of a circle around its patch, in which the floor may slope."""
    first_row: int
    """Where its patch begins on the grid of scatterers."""
    first_column: int
    amplitude: Floats32
    """Over the even floor, shape (rows, columns); NaN: floor."""
    relief_m: Floats32
    """Height over the even floor, same shape."""


def place(
    id_: int, kind: str, shape: Shape, extent_m: float, position_m: Floats, yaw_rad: float, margin_m: float = 0.0
) -> SeabedObject:
    """Put a shape on the grid.

    Parameters
    ----------
    id_, kind
        What it is.
    shape
        Its level and height.
    extent_m
        Radius that holds its material.
    position_m
        World position of its origin.
    yaw_rad
        Turns it, positive to the left.
    margin_m
        How far the floor around it slopes.
    """
    radius_m = extent_m + margin_m
    first = np.floor((position_m[:2] - radius_m) / CELL_M).astype(int) - 1
    cells = int(np.ceil(2 * radius_m / CELL_M)) + 3
    x = (first[0] + np.arange(cells) + 0.5) * CELL_M - position_m[0]
    y = (first[1] + np.arange(cells) + 0.5) * CELL_M - position_m[1]
    world_x, world_y = np.meshgrid(x, y)
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    level_db, height_m = shape(cos * world_x + sin * world_y, cos * world_y - sin * world_x)
    amplitude = (10 ** (level_db / 20)).astype(np.float32)
    position_m = np.asarray(position_m, float)
    relief = height_m.astype(np.float32)
    row, column = int(first[1]), int(first[0])
    return SeabedObject(id_, kind, position_m, yaw_rad, extent_m, radius_m, row, column, amplitude, relief)


def place_landmark(design: LandmarkDesign, position_m: Floats, yaw_rad: float, floor_z_m: float) -> SeabedObject:
    """A landmark whose face lies at its true position.

    It stands on the floor, which rises or falls around it by a smooth cosine as far as that needs.
    """
    bottom_m = float(position_m[2]) - design.height_m - floor_z_m
    plate_m = _material_radius_m(design)

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        level_db = design.level_db(x_m, y_m)
        away = np.clip((np.hypot(x_m, y_m) - plate_m) / SLOPE_M, 0, 1)
        ground_m = bottom_m * 0.5 * (1 + np.cos(np.pi * away))
        return level_db, ground_m + np.where(np.isnan(level_db), 0.0, design.height_m)

    return place(design.id, design.name, shape, plate_m, position_m, yaw_rad, SLOPE_M)


def _material_radius_m(design: LandmarkDesign) -> float:
    """Of the circle about its centre that holds all of its material."""
    pixels = len(design.mask)
    middle_m = ((np.arange(pixels) + 0.5) / pixels - 0.5) * design.size_m
    away_m = np.hypot(middle_m[:, None], middle_m[None, :]) + design.size_m / pixels
    return float(away_m[~np.isnan(design.mask)].max(initial=0.0))


def stone(radius_m: float, height_m: float, level_db: float) -> Shape:
    """Half an ellipsoid."""

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        from_top = (x_m**2 + y_m**2) / radius_m**2
        height = height_m * np.sqrt(np.clip(1 - from_top, 0, None))
        return np.where(from_top < 1, level_db, np.nan), height

    return shape


def block(length_m: float, width_m: float, height_m: float, level_db: float) -> Shape:
    """A box; its upright sides scatter as steeply as the grid can show."""

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        inside = (np.abs(x_m) < length_m / 2) & (np.abs(y_m) < width_m / 2)
        return np.where(inside, level_db, np.nan), np.where(inside, height_m, 0.0)

    return shape


def ragged_patch(radius_m: float, level_db: float, rng: np.random.Generator) -> Shape:
    """A flat rough patch whose radius varies irregularly with direction, from about half to one and a half."""
    order = np.arange(1, 6)
    waves = rng.normal(0, 0.28 / np.sqrt(order), (2, len(order)))

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        angle = np.arctan2(y_m, x_m)[..., None] * order
        outline = radius_m * np.clip(1 + np.cos(angle) @ waves[0] + np.sin(angle) @ waves[1], 0.3, 1.7)
        inside = np.hypot(x_m, y_m) < outline
        return np.where(inside, level_db, np.nan), np.where(inside, 0.005, 0.0)

    return shape


def scattered_objects(spots_m: Floats, stones: int, rng: np.random.Generator) -> list[SeabedObject]:
    """Stones at the first spots, ragged patches at the others, with identities -1, -2, ...

    Parameters
    ----------
    spots_m
        World positions on the floor, shape (n, 3).
    stones
        How many of them.
    rng
        Source of sizes, levels and outlines.
    """
    objects = []
    for number, spot in enumerate(spots_m):
        if number < stones:
            radius_m = rng.uniform(0.08, 0.16)
            kind, shape = "stone", stone(radius_m, rng.uniform(0.02, 0.06), rng.uniform(4, 10))
        else:
            mean_radius_m = rng.uniform(0.10, 0.16)
            kind, shape = "patch", ragged_patch(mean_radius_m, rng.uniform(9, 13), rng)
            radius_m = 1.7 * mean_radius_m
        objects.append(place(-1 - number, kind, shape, radius_m, spot, rng.uniform(-np.pi, np.pi)))
    return objects


def within(objects: Sequence[SeabedObject], centre_m: Floats, reach_m: float) -> list[SeabedObject]:
    """Those that a circle on the floor touches."""
    return [o for o in objects if np.hypot(*(o.position_m[:2] - centre_m[:2])) < reach_m + o.radius_m]
