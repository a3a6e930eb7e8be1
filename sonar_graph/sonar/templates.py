"""Templates of the landmark designs at all headings, and patches of the image, on the same grid of the floor.

Axes are the level ones of `sonar_graph.sonar.geometry.FloorView`. A floor point p is the sonar point
``q = level_R_sonar^T p``, looked up at range |q| and azimuth atan2(q_y, q_x).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sonar_graph.devices import LandmarkDesign
from sonar_graph.errors import CalibrationError
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled, inlined
from sonar_graph.sonar.geometry import FloorView

Floats32 = NDArray[np.float32]
Blur = tuple[float, float]
"""Standard deviations of the sonar's resolution on the floor, away from it and across, m."""
BLUR_RATIO = math.sqrt(2)
"""Of one blur to the next for which there are templates."""
NEAREST = 30
"""Last range of a sonar over the nearest one at which candidates are expected."""
HEADINGS = 48
FINE = 4
"""Points of a cell, along each axis, over which a mask is averaged."""
LEAST_BLUR_M = 1e-3
ASSUMED_SLOPE = math.tan(math.radians(30.0))
"""Of the ray to a landmark against the floor, where it is not known or templates are drawn once for all."""
SIDE_DB = 7.9
"""Level of a face with its side laid over it, over that of the face alone.

``1 + (d / h)^3`` by Lambert's law, at a grazing angle of 30 degrees: the side is met more steeply, ``(d / h)^2``, and
has d / h times the area on the same width.
"""
MOST_POWERS = 1024
"""Number of drawings before the blur that are kept, some 80 kB each: those of four designs are 561."""
SEARCHED_DARK = 0.5
"""Share of the dark parts' level in the templates of the search: a plate may be as its design or not be seen."""
SAME_SHARE = 0.05
"""Largest squared difference of headings that share a template, as a share of their variance."""
TURNED_RAD = math.radians(30.0)
CHECKED_CELL_M = 0.01
"""Least turn after which designs must look otherwise (`check_headings`), and the cells in which that is seen."""


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
    def of(
        cls,
        designs: Sequence[LandmarkDesign],
        cell_m: float,
        margin_m: float,
        blur_m: Blur,
    ) -> Templates:
        """Templates of all designs at all headings, blurred by the resolution of the sonar (`drawn`).

        Around the largest design lies a ring of floor, without the part behind it, which the design may shade: the x
        axis of the grid points away from the sonar.
        """
        x_m, _, away_m, material_m = places_around(designs, margin_m, cell_m)
        side = len(x_m)
        # a plate of 13 mm throws a shadow of 2 cm, which would pull the best fit away from the sonar
        is_behind = (away_m > material_m) & (x_m > 0.5 * away_m)
        cells = np.flatnonzero((away_m <= material_m + margin_m) & ~is_behind)
        rows: list[tuple[Floats32, int, float]] = []
        for index, design in enumerate(designs):
            # symmetric designs repeat: of equal pictures the first heading stands for all
            for heading in 2 * np.pi * np.arange(HEADINGS) / HEADINGS:
                bright, dark = drawn(design, heading, side, cell_m, blur_m)
                picture = (bright + SEARCHED_DARK * dark).ravel()[cells]
                same = (
                    np.mean((picture - known) ** 2) < SAME_SHARE * known.var()
                    for known, i, _ in rows
                    if i == index
                )
                if not any(same):
                    rows.append((picture, index, heading))
        pictures, of, headings = zip(*rows, strict=True)
        return cls(
            cell_m,
            side,
            cells,
            np.array(pictures, np.float32),
            np.array(of),
            np.array(headings),
        )


def places_around(
    designs: Sequence[LandmarkDesign], margin_m: float, cell_m: float
) -> tuple[Floats, Floats, Floats, float]:
    """Places x and y of a grid about the middle of the largest design, their distance from it, and its reach."""
    material_m = max(map(material_radius_m, designs))
    half = math.ceil((material_m + margin_m) / cell_m)
    places_m = cell_m * np.arange(-half, half + 1)
    x_m, y_m = np.meshgrid(places_m, places_m, indexing="ij")
    return x_m, y_m, np.hypot(x_m, y_m), material_m


def drawn(
    design: LandmarkDesign, heading_rad: float, side: int, cell_m: float, blur_m: Blur,
    stretch: tuple[float, float] = (1.0, 1.0),
) -> tuple[Floats32, Floats32]:  # fmt: skip
    """Bright and dark parts of a design over the floor, dB, as the sonar sees them, shapes (side, side).

    Stretched along its axes x and y. The side that its relief shows at `ASSUMED_SLOPE` is laid over the face. The beams
    and the pulse blur the *power* of the echo, so that what is bright grows and what is dark shrinks; a cell is then a
    mean of decibels. Both parts add up to the whole.
    """
    # the near side covers this part of the face, as seen along the ray
    width = round(design.standing_m * ASSUMED_SLOPE / cell_m * FINE)
    bright_db, whole_db = (
        seen_db(with_side(power, width), cell_m, blur_m)
        for power in echo_power(design, heading_rad, side, cell_m, stretch)
    )
    return bright_db, whole_db - bright_db


def with_side(power: Floats32, width: int) -> Floats32:
    """Power of an echo with the near side of what is bright laid over it, so many fine points wide."""
    is_bright = power > 1
    inner = is_bright.copy()
    for _ in range(width):
        # erosion away from the sonar leaves what is not near the front edge
        inner[1:] &= inner[:-1]
    return np.where(is_bright & ~inner, power * np.float32(10 ** (SIDE_DB / 10)), power)


@lru_cache(maxsize=MOST_POWERS)
def echo_power(
    design: LandmarkDesign,
    heading_rad: float,
    side: int,
    cell_m: float,
    stretch: tuple[float, float] = (1.0, 1.0),
) -> tuple[Floats32, Floats32]:
    """Power of the echo of a design's bright parts and of all of it, not blurred, over `FINE` points a cell.

    Its figure lies in the middle (`LandmarkDesign.figure_m`), and is stretched about it.
    """
    fine_m = cell_m / FINE * (np.arange(side * FINE) - side * FINE / 2 + 0.5)
    x_m, y_m = np.meshgrid(fine_m, fine_m, indexing="ij")
    cos = math.cos(heading_rad)
    sin = math.sin(heading_rad)
    (x0, y0) = design.figure_m
    (x_share, y_share) = stretch
    # from the grid into the axes of the design
    level = design.level_db(
        x0 + (cos * x_m + sin * y_m) / x_share, y0 + (-sin * x_m + cos * y_m) / y_share
    )
    level = np.nan_to_num(level).astype(np.float32)
    bright, whole = (
        np.asarray(10 ** (one / 10), np.float32)
        for one in (np.maximum(level, 0), level)
    )
    return bright, whole


def seen_db(power: Floats32, cell_m: float, blur_m: Blur) -> Floats32:
    """Levels of cells, as the sonar sees the power of fine ones."""
    return of_cells(
        np.asarray(10 * np.log10(blurred(power, cell_m, blur_m)), np.float32)
    )


def seen_share(is_in: NDArray[np.bool_], cell_m: float, blur_m: Blur) -> Floats32:
    """Shares of the echo of cells that come from fine ones."""
    return of_cells(blurred(is_in.astype(np.float32), cell_m, blur_m))


def blurred(fine: Floats32, cell_m: float, blur_m: Blur) -> Floats32:
    """Power on a fine grid, blurred away from the sonar (x) and across."""
    # opencv refuses a width of zero
    away, across = (max(one, LEAST_BLUR_M) / cell_m * FINE for one in blur_m)
    return np.asarray(
        cv2.GaussianBlur(fine, (0, 0), sigmaX=across, sigmaY=away), np.float32
    )


def of_cells(fine: Floats32) -> Floats32:
    """Means of the fine points of each cell."""
    side = len(fine) // FINE
    return np.asarray(
        cv2.resize(fine, (side, side), interpolation=cv2.INTER_AREA), np.float32
    )


def material_radius_m(design: LandmarkDesign) -> float:
    """Distance from the middle of its figure to the farthest point with material."""
    pixels = len(design.mask)
    middles_m = ((np.arange(pixels) + 0.5) / pixels - 0.5) * design.size_m
    y_m, x_m = np.meshgrid(-middles_m, middles_m, indexing="ij")
    there = np.isfinite(design.mask)
    x0, y0 = design.figure_m
    return float(np.hypot(x_m - x0, y_m - y0)[there].max(initial=design.size_m / 4))


def middle_m(design: LandmarkDesign, heading_rad: float) -> Floats:
    """Way on the grid from the middle of a design's figure to the middle of its square, shape (2,)."""
    (x, y) = design.figure_m
    cos = math.cos(heading_rad)
    sin = math.sin(heading_rad)
    return -np.array([cos * x - sin * y, sin * x + cos * y])


def check_headings(designs: Sequence[LandmarkDesign]) -> None:
    """Refuse designs whose image does not show where the middle of their square is.

    A figure beside it that looks the same turned by `TURNED_RAD` and more, with its dark parts, may belong to several
    middles. Raises `CalibrationError` naming the design.
    """
    for design in designs:
        # a figure in the middle has its middle there at any heading
        if design.figure_m == (0.0, 0.0):
            continue
        side = 2 * math.ceil(material_radius_m(design) / CHECKED_CELL_M) + 1
        first, *turned = (
            drawn(
                design,
                2 * math.pi * k / HEADINGS,
                side,
                CHECKED_CELL_M,
                (CHECKED_CELL_M, CHECKED_CELL_M),
            )
            for k in range(HEADINGS)
        )
        off = [float(np.mean((sum(one) - sum(first)) ** 2)) for one in turned]
        # small turns look alike by the blur, and move the middle little
        least = round(TURNED_RAD * HEADINGS / (2 * math.pi))
        if min(off[least - 1 : -least + 1 or None]) < SAME_SHARE * float(
            np.var(sum(first))
        ):
            away_cm = 100 * math.hypot(*design.figure_m)
            raise CalibrationError(
                f"landmark design {design.name} (id {design.id}): its figure lies {away_cm:.0f} cm from the middle of "
                "its square and looks the same when it is turned, so that nothing tells where the middle is; "
                "draw it in the middle"
            )


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
        return cls(level_db, seen, *smooth_levels(level_db, seen), centre_m)


WIDTH_TO_SIGMA = 1 / 2.355
"""Standard deviation of a normal curve over its width at half of its height."""


class PolarGrid(NamedTuple):
    """Beams and bins of an image, for looking up ranges and azimuths."""

    first_range_m: float
    bin_m: float
    first_azimuth_rad: float
    azimuth_step_rad: float
    beam_of_azimuth: Floats
    """Number of the beam, with fractions, at equally spaced azimuths."""
    spacing_rad: float
    """Mean angle between beams."""
    highest_sine: float
    """Sine of the elevation at the rim of the opening; what lies above is not in the image, whatever the range."""

    @classmethod
    def of(
        cls,
        ranges_m: Floats,
        azimuths_rad: Floats,
        elevation_aperture_rad: float = math.pi,
    ) -> PolarGrid:
        """Grid of equally spaced bins, shape (bins,), and of beams in one direction, shape (beams,)."""
        # beams may run from left to right or from right to left
        order = np.argsort(azimuths_rad)
        places = np.linspace(
            azimuths_rad.min(), azimuths_rad.max(), _STEPS_A_BEAM * len(azimuths_rad)
        )
        return cls(
            float(ranges_m[0]),
            float(ranges_m[-1] - ranges_m[0]) / (len(ranges_m) - 1),
            float(places[0]),
            float(places[1] - places[0]),
            np.interp(places, azimuths_rad[order], order.astype(float)),
            float(np.ptp(azimuths_rad)) / (len(azimuths_rad) - 1),
            math.sin(min(elevation_aperture_rad, math.pi) / 2),
        )

    def blur_m(self, away_m: float, range_m: float) -> Blur:
        """Resolution on the floor at a distance along it and a range.

        Sonars sample their images as finely as they resolve: a beam, both ways, is at half of its power as wide as
        beams are apart, and the pulse as long as a bin.
        """
        return (
            WIDTH_TO_SIGMA * self.bin_m * range_m / away_m,
            WIDTH_TO_SIGMA * self.spacing_rad * range_m,
        )

    def blur_steps(self, away_m: float, range_m: float) -> tuple[int, int]:
        """Nearest steps of `BLUR_RATIO`, from a millimetre on, to the resolution on the floor."""
        away, across = (
            max(0, round(math.log(one / 1e-3, BLUR_RATIO)))
            for one in self.blur_m(away_m, range_m)
        )
        return away, across

    def steps_in_view(
        self, first_m: float, last_m: float, depressions_rad: tuple[float, float]
    ) -> list[tuple[int, int]]:
        """All `blur_steps` between two ranges and depressions, those of middle ranges first."""
        # a window that begins at the sonar would need endless sets
        first_m = max(first_m, last_m / NEAREST)
        shares = np.linspace(
            -0.5, 0.5, math.ceil(4 * math.log(last_m / first_m, BLUR_RATIO)) + 2
        )
        found = dict[tuple[int, int], None]()
        # a dict keeps the order and drops repeats
        for share in sorted(shares.tolist(), key=abs):
            range_m = math.sqrt(first_m * last_m) * (last_m / first_m) ** share
            for depression_rad in np.linspace(*depressions_rad, 5).tolist():
                found[self.blur_steps(range_m * math.cos(depression_rad), range_m)] = (
                    None
                )
        return list(found)

    def patch(
        self,
        image_db: Floats32,
        view: FloorView,
        centre_m: Floats,
        side: int,
        cell_m: float,
    ) -> Patch:
        """The image on a grid of ``side`` by ``side`` floor points around a centre."""
        floor = view.level_R_sonar, view.height_m
        sampled = sample_floor(self, image_db, floor, centre_m, side, cell_m)
        return Patch.of(*sampled, centre_m)


@inlined
def azimuth(x: float, y: float) -> float:
    """``atan2(y, x)`` to 1e-7, NaN at pi. A loop of it takes several points at once, which one of ``atan2`` does not.

    From the tangent of the quarter of the angle, by the polynomial of Abramowitz and Stegun (1964), 4.4.49.
    """
    half = y / (x + math.sqrt(x * x + y * y))
    t = half / (1 + math.sqrt(1 + half * half))
    u = t * t
    tail = 0.1065626393 + u * (
        -0.07528964 + u * (0.0429096138 + u * (-0.0161657367 + u * 0.0028662257))
    )
    return (
        4
        * t
        * (
            1
            + u * (-0.3333314528 + u * (0.1999355085 + u * (-0.1420889944 + u * tail)))
        )
    )


@compiled
def smooth_levels(level: Floats32, seen: Floats32) -> tuple[Floats32, Floats32]:
    """Means of the levels seen in 3 by 3 cells, mirrored at the rim, and the shares that are seen."""
    side = len(level)
    smooth = np.empty((side, side), np.float32)
    held = np.empty((side, side), np.float32)
    total = np.empty(side + 2, np.float32)
    count = np.empty(side + 2, np.float32)
    for i in range(side):
        # mirrored at the rim: row -1 is row 1
        before = abs(i - 1)
        after = side - 1 - abs(side - 2 - i)
        for j in range(side):
            total[j + 1] = level[before, j] + level[i, j] + level[after, j]
            count[j + 1] = seen[before, j] + seen[i, j] + seen[after, j]
        total[0] = total[2]
        total[-1] = total[-3]
        count[0] = count[2]
        count[-1] = count[-3]
        for j in range(side):
            n = count[j] + count[j + 1] + count[j + 2]
            held[i, j] = n / np.float32(9)
            smooth[i, j] = (total[j] + total[j + 1] + total[j + 2]) / max(
                n, np.float32(0.9)
            )
    return smooth, held


@compiled
def sample_floor(
    grid: PolarGrid,
    image_db: Floats32,
    floor: tuple[Floats, float],
    centre: Floats,
    side: int,
    cell_m: float,
) -> tuple[Floats32, Floats32]:
    """Levels of the floor points around a centre, and 1 where a point is in the image; both 0 elsewhere.

    Each is the mean of decibels over the bins whose middles a cell covers, or where cells are finer than bins, linear
    between the two nearest; linear between beams. The floor is ``level_R_sonar`` and the sonar's height over it.
    """
    (beams, bins) = image_db.shape
    R, height_m = floor
    level = np.zeros((side, side), np.float32)
    seen = np.zeros((side, side), np.float32)
    nodes = grid.beam_of_azimuth
    per_bin = 1 / grid.bin_m
    per_step = 1 / grid.azimuth_step_rad
    # half of a cell, in bins
    half_bins = 0.5 * cell_m * per_bin
    half = 0.5 * (side - 1)
    z = -height_m
    # finer than bins: interpolate; coarser: average, or speckle aliases
    is_fine = half_bins < 0.5
    reach = 1.0 if is_fine else half_bins
    places = np.empty(side)
    middles = np.empty(side)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    for i in range(side):
        x = centre[0] + cell_m * (i - half)
        for j in range(side):
            y = centre[1] + cell_m * (j - half)
            # q = R^T p, written out: an array for each point costs more than the sum
            q0 = xx * x + yx * y + zx * z
            q1 = xy * x + yy * y + zy * z
            q2 = xz * x + yz * y + zz * z
            distance = math.sqrt(x * x + y * y + z * z)
            places[j] = (azimuth(q0, q1) - grid.first_azimuth_rad) * per_step
            # above the opening the sonar does not look, whatever the range
            is_lit = abs(q2) <= grid.highest_sine * distance
            middles[j] = (
                (distance - grid.first_range_m) * per_bin if is_lit else -2.0 * reach
            )
        for j in range(side):
            place = places[j]
            middle = middles[j]
            first = math.floor(middle - reach + 1)
            last = math.floor(middle + reach)
            # outside of the image: level and seen stay 0
            if first < 0 or last >= bins or not 0 <= place < len(nodes) - 1:
                continue
            # unsigned indices skip the check for negative ones
            k = np.uint32(place)
            first = np.uint32(first)
            last = np.uint32(last)
            beam = nodes[k] + (place - k) * (nodes[k + np.uint32(1)] - nodes[k])
            if beam < 0 or beam > beams - 1:
                continue
            # the last beam has no next one to interpolate with
            b = np.uint32(min(beam, beams - 2))
            share = beam - b
            one = image_db[b]
            other = image_db[b + np.uint32(1)]
            if is_fine:
                near = (1 - share) * one[first] + share * other[first]
                far = (1 - share) * one[last] + share * other[last]
                level[i, j] = near + (middle - first) * (far - near)
            else:
                of_one = 0.0
                of_other = 0.0
                for n in range(first, last + np.uint32(1)):
                    of_one = of_one + one[n]
                    of_other = of_other + other[n]
                level[i, j] = (of_one + share * (of_other - of_one)) / (
                    last - first + np.uint32(1)
                )
            seen[i, j] = 1.0
    return level, seen
