"""Templates of the landmark designs at all headings, and patches of the image, on the same grid of the floor.

Axes are the level ones of `sonar_graph.sonar.geometry.FloorView`. A floor point p is the sonar point
``q = level_R_sonar^T p``, looked up at range |q| and azimuth atan2(q_y, q_x).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sonar_graph.devices import LandmarkDesign
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled, inlined
from sonar_graph.sonar.geometry import FloorView

Floats32 = NDArray[np.float32]
HEADINGS = 48
FINE = 4
"""Points of a cell, along each axis, over which a mask is averaged."""
SEARCHED_DARK = 0.5
"""Share of the dark parts' level in the templates of the search: a plate may be as its design or not be seen."""
SAME_SHARE = 0.05
"""Largest squared difference of headings that share a template, as a share of their variance."""


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
    """Decibels over the floor, of dark parts `SEARCHED_DARK` of them, shape (templates, cells)."""
    design: Ints
    """Which of the designs each is of, shape (templates,)."""
    heading_rad: Floats
    """Of the design's x axis against the grid's, shape (templates,)."""

    @classmethod
    def of(cls, designs: Sequence[LandmarkDesign], cell_m: float, margin_m: float, blur_m: float) -> Templates:
        """Templates of all designs at all headings, blurred by the resolution of the sonar.

        Around the largest design lies a ring of floor, without the part behind it, which the design may shade: the x
        axis of the grid points away from the sonar.
        """
        material_m = max(map(material_radius_m, designs))
        half = math.ceil((material_m + margin_m) / cell_m)
        side = 2 * half + 1
        places_m = cell_m * np.arange(-half, half + 1)
        x_m, y_m = np.meshgrid(places_m, places_m, indexing="ij")
        # a plate of 13 mm throws a shadow of 2 cm, which would pull the best fit away from the sonar
        away_m = np.hypot(x_m, y_m)
        is_behind = (away_m > material_m) & (x_m > 0.5 * away_m)
        cells = np.flatnonzero((away_m <= material_m + margin_m) & ~is_behind)
        pictures: list[Floats32] = []
        of: list[int] = []
        headings: list[float] = []
        for index, design in enumerate(designs):
            for heading in 2 * np.pi * np.arange(HEADINGS) / HEADINGS:
                bright, dark = drawn(design, heading, side, cell_m, blur_m)
                picture = (bright + SEARCHED_DARK * dark).ravel()[cells]
                same = (
                    np.mean((picture - known) ** 2) < SAME_SHARE * known.var()
                    for known, i in zip(pictures, of, strict=True)
                    if i == index
                )
                if not any(same):
                    pictures.append(picture)
                    of.append(index)
                    headings.append(heading)
        return cls(cell_m, side, cells, np.array(pictures, np.float32), np.array(of), np.array(headings))


def drawn(
    design: LandmarkDesign, heading_rad: float, side: int, cell_m: float, blur_m: float,
    stretch: tuple[float, float] = (1.0, 1.0),
) -> tuple[Floats32, Floats32]:  # fmt: skip
    """Bright and dark parts of a design over the floor, dB, as the sonar sees them, shapes (side, side).

    Stretched along its axes x and y, and blurred by the resolution of the sonar.
    """
    fine_m = cell_m / FINE * (np.arange(side * FINE) - side * FINE / 2 + 0.5)
    x_m, y_m = np.meshgrid(fine_m, fine_m, indexing="ij")
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    level = design.level_db((cos * x_m + sin * y_m) / stretch[0], (-sin * x_m + cos * y_m) / stretch[1])
    level = np.nan_to_num(level).astype(np.float32)
    bright, dark = (
        cv2.GaussianBlur(part, (0, 0), blur_m / cell_m * FINE).reshape(side, FINE, side, FINE).mean(axis=(1, 3))
        for part in (np.maximum(level, 0), np.minimum(level, 0))
    )
    return bright, dark


def material_radius_m(design: LandmarkDesign) -> float:
    """Distance from the centre to the farthest point with material."""
    pixels = len(design.mask)
    middles_m = ((np.arange(pixels) + 0.5) / pixels - 0.5) * design.size_m
    y_m, x_m = np.meshgrid(-middles_m, middles_m, indexing="ij")
    there = np.isfinite(design.mask)
    return float(np.hypot(x_m, y_m)[there].max(initial=design.size_m / 4))


_STEPS_A_BEAM = 4


class Patch(NamedTuple):
    """The image around a point of the floor."""

    level_db: Floats32
    """Mean level on the grid, shape (side, side), first axis x, second y; 0 where not seen."""
    seen: Floats32
    """1 where the image holds the point, else 0, shape (side, side)."""
    smooth_db: Floats32
    """Means of the levels seen in 3 by 3 cells, shape (side, side)."""
    held: Floats32
    """Share of these cells that is seen, shape (side, side)."""
    centre_m: Floats
    """(x, y) of its middle on the floor, shape (2,)."""

    @classmethod
    def of(cls, level_db: Floats32, seen: Floats32, centre_m: Floats) -> Patch:
        """Patch with these levels."""
        held, smooth = np.empty((2, *seen.shape), np.float32)
        smooth_levels(level_db, seen, smooth, held)
        return cls(level_db, seen, smooth, held, centre_m)


class PolarGrid(NamedTuple):
    """Beams and bins of an image, for looking up ranges and azimuths."""

    first_range_m: float
    bin_m: float
    first_azimuth_rad: float
    azimuth_step_rad: float
    beam_of_azimuth: Floats
    """Number of the beam, with fractions, at equally spaced azimuths."""
    highest_sine: float
    """Sine of the elevation at the rim of the opening; what lies above is not in the image, whatever the range."""

    @classmethod
    def of(cls, ranges_m: Floats, azimuths_rad: Floats, elevation_aperture_rad: float = math.pi) -> PolarGrid:
        """Grid of equally spaced bins, shape (bins,), and of beams in one direction, shape (beams,)."""
        order = np.argsort(azimuths_rad)
        places = np.linspace(azimuths_rad.min(), azimuths_rad.max(), _STEPS_A_BEAM * len(azimuths_rad))
        return cls(
            float(ranges_m[0]),
            float(ranges_m[-1] - ranges_m[0]) / (len(ranges_m) - 1),
            float(places[0]),
            float(places[1] - places[0]),
            np.interp(places, azimuths_rad[order], order.astype(float)),
            math.sin(min(elevation_aperture_rad, math.pi) / 2),
        )

    def patch(self, image_db: Floats32, view: FloorView, centre_m: Floats, side: int, cell_m: float) -> Patch:
        """The image on a grid of ``side`` by ``side`` floor points around a centre."""
        level, seen = np.zeros((2, side, side), np.float32)
        sample_floor(self, image_db, view.level_R_sonar, view.height_m, centre_m, cell_m, level, seen)
        return Patch.of(level, seen, centre_m)


@inlined
def azimuth(x: float, y: float) -> float:
    """``atan2(y, x)`` to 1e-7, NaN at pi. A loop of it takes several points at once, which one of ``atan2`` does not.

    From the tangent of the quarter of the angle, by the polynomial of Abramowitz and Stegun (1964), 4.4.49.
    """
    half = y / (x + math.sqrt(x * x + y * y))
    t = half / (1 + math.sqrt(1 + half * half))
    u = t * t
    tail = 0.1065626393 + u * (-0.07528964 + u * (0.0429096138 + u * (-0.0161657367 + u * 0.0028662257)))
    return 4 * t * (1 + u * (-0.3333314528 + u * (0.1999355085 + u * (-0.1420889944 + u * tail))))


@compiled
def sample_floor(
    grid: PolarGrid, image_db: Floats32, R: Floats, height_m: float, centre: Floats, cell_m: float,
    level: Floats32, seen: Floats32,
) -> None:  # fmt: skip
    """Fill in levels on a square grid of the floor, and 1 where a point is in the image, shapes (side, side).

    Each is the mean of decibels over the bins whose middles a cell covers, or where cells are finer than bins, linear
    between the two nearest; linear between beams. R is ``level_R_sonar``.
    """
    (beams, bins), side, nodes = image_db.shape, len(level), grid.beam_of_azimuth
    per_bin, per_step = 1 / grid.bin_m, 1 / grid.azimuth_step_rad
    half_bins, half, z = 0.5 * cell_m * per_bin, 0.5 * (side - 1), -height_m
    is_fine = half_bins < 0.5
    reach, places, middles = 1.0 if is_fine else half_bins, np.empty(side), np.empty(side)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    for i in range(side):
        x = centre[0] + cell_m * (i - half)
        for j in range(side):
            y = centre[1] + cell_m * (j - half)
            q0, q1, q2 = xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z
            distance = math.sqrt(x * x + y * y + z * z)
            places[j] = (azimuth(q0, q1) - grid.first_azimuth_rad) * per_step
            is_lit = abs(q2) <= grid.highest_sine * distance
            middles[j] = (distance - grid.first_range_m) * per_bin if is_lit else -2.0 * reach
        for j in range(side):
            place, middle = places[j], middles[j]
            first, last = math.floor(middle - reach + 1), math.floor(middle + reach)
            if first < 0 or last >= bins or not 0 <= place < len(nodes) - 1:
                continue
            k, first, last = np.uint32(place), np.uint32(first), np.uint32(last)
            beam = nodes[k] + (place - k) * (nodes[k + np.uint32(1)] - nodes[k])
            if beam < 0 or beam > beams - 1:
                continue
            b = np.uint32(min(beam, beams - 2))
            share, one, other = beam - b, image_db[b], image_db[b + np.uint32(1)]
            if is_fine:
                near = (1 - share) * one[first] + share * other[first]
                far = (1 - share) * one[last] + share * other[last]
                level[i, j] = near + (middle - first) * (far - near)
            else:
                of_one, of_other = 0.0, 0.0
                for n in range(first, last + np.uint32(1)):
                    of_one, of_other = of_one + one[n], of_other + other[n]
                level[i, j] = (of_one + share * (of_other - of_one)) / (last - first + np.uint32(1))
            seen[i, j] = 1.0


@compiled
def smooth_levels(level: Floats32, seen: Floats32, smooth: Floats32, held: Floats32) -> None:
    """Fill in means of the levels seen in 3 by 3 cells, mirrored at the rim, and the shares that are seen."""
    side = len(level)
    total, count = np.empty(side + 2, np.float32), np.empty(side + 2, np.float32)
    for i in range(side):
        before, after = abs(i - 1), side - 1 - abs(side - 2 - i)
        for j in range(side):
            total[j + 1] = level[before, j] + level[i, j] + level[after, j]
            count[j + 1] = seen[before, j] + seen[i, j] + seen[after, j]
        total[0], total[-1], count[0], count[-1] = total[2], total[-3], count[2], count[-3]
        for j in range(side):
            n = count[j] + count[j + 1] + count[j + 2]
            held[i, j] = n / np.float32(9)
            smooth[i, j] = (total[j] + total[j + 1] + total[j + 2]) / max(n, np.float32(0.9))
