"""Landmark designs as pictures on a grid of the floor, at all headings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sonar_graph.landmark_designs import LandmarkDesign
from sonar_graph.measurements import Floats, Ints

Floats32 = NDArray[np.float32]
HEADINGS = 48
FINE = 5
"""Points a cell, along each axis, over which a mask is averaged."""
SAME_SHARE = 0.05
"""Headings are one template when their squared difference is below this share of their variance."""


@dataclass(frozen=True, eq=False)
class Templates:
    """Templates over the cells of a disc, all on one square grid of the floor."""

    cell_m: float
    """Distance of the grid's points."""
    side: int
    """Points along the side of the square that holds the disc; odd."""
    cells: Ints
    """Which points of the square, row by row, are compared, shape (cells,)."""
    pictures: Floats32
    """Decibels over the floor, shape (templates, cells)."""
    design: Ints
    """Which of the designs each is of, shape (templates,)."""
    heading_rad: Floats
    """Of the design's x axis against the grid's, shape (templates,)."""

    @classmethod
    def of(cls, designs: Sequence[LandmarkDesign], cell_m: float, margin_m: float, blur_m: float) -> Templates:
        """Pictures of all designs.

        Parameters
        ----------
        cell_m
            Distance of the grid's points.
        margin_m
            Width of the ring of floor around the largest design, but for what lies behind it as the sonar sees it: the
            grid's x axis points away from the sonar.
        blur_m
            Standard deviation of the resolution with which the sonar sees it.
        """
        material_m = max(map(material_radius_m, designs))
        half = math.ceil((material_m + margin_m) / cell_m)
        places_m = cell_m * np.arange(-half, half + 1)
        x_m, y_m = np.meshgrid(places_m, places_m, indexing="ij")
        cells = np.flatnonzero(_compared(x_m, y_m, material_m, margin_m))
        pictures: list[Floats32] = []
        of: list[int] = []
        headings: list[float] = []
        for index, design in enumerate(designs):
            for heading in 2 * np.pi * np.arange(HEADINGS) / HEADINGS:
                picture = _picture(design, heading, half, cell_m, blur_m).ravel()[cells]
                same = (
                    np.mean((picture - known) ** 2) < SAME_SHARE * known.var()
                    for known, i in zip(pictures, of, strict=True)
                    if i == index
                )
                if not any(same):
                    pictures.append(picture)
                    of.append(index)
                    headings.append(heading)
        return cls(cell_m, 2 * half + 1, cells, np.array(pictures, np.float32), np.array(of), np.array(headings))


def _compared(x_m: Floats, y_m: Floats, material_m: float, margin_m: float) -> NDArray[np.bool_]:
    """Which points are compared: a disc, but for the floor behind, which the landmark may hide from the sonar.

    A plate of 13 mm throws a shadow of 2 cm. Taken for a part of it, it pulls the best fit away from the sonar.
    """
    away_m = np.hypot(x_m, y_m)
    is_behind = (away_m > material_m) & (x_m > 0.5 * away_m)
    return np.asarray((away_m <= material_m + margin_m) & ~is_behind)


def material_radius_m(design: LandmarkDesign) -> float:
    """Distance from the centre to the farthest point with material."""
    pixels = len(design.mask)
    middles_m = ((np.arange(pixels) + 0.5) / pixels - 0.5) * design.size_m
    y_m, x_m = np.meshgrid(-middles_m, middles_m, indexing="ij")
    there = np.isfinite(design.mask)
    return float(np.hypot(x_m, y_m)[there].max(initial=design.size_m / 4))


def _picture(design: LandmarkDesign, heading: float, half: int, cell_m: float, blur_m: float) -> Floats32:
    """The mask at a heading, averaged over cells and blurred, shape (side, side), first axis x, second y."""
    fine = cell_m / FINE * (np.arange((2 * half + 1) * FINE) - (2 * half + 1) * FINE / 2 + 0.5)
    x_m, y_m = np.meshgrid(fine, fine, indexing="ij")
    cos, sin = math.cos(heading), math.sin(heading)
    level = np.nan_to_num(design.level_db(cos * x_m + sin * y_m, -sin * x_m + cos * y_m)).astype(np.float32)
    blurred = cv2.GaussianBlur(level, (0, 0), blur_m / cell_m * FINE)
    side = 2 * half + 1
    return blurred.reshape(side, FINE, side, FINE).mean(axis=(1, 3))
