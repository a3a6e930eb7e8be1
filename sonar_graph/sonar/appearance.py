"""Appearance of candidates: best place and heading of every design in the image around them, and what speaks for it.

The image is sampled on a square grid of the floor, where foreshortening and the shape of the fan drop out; its x axis
points away from the sonar, along the line of sight. Designs are templates on the same grid
(`sonar_graph.sonar.templates`), and the correlation with them finds place and heading. What speaks for a design there,
against anything else, is `sonar_graph.sonar.evidence`. Derivation: docs/theory/recognition.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.devices import LandmarkDesign
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled
from sonar_graph.sonar.confusion import Confusion
from sonar_graph.sonar.evidence import Figures
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.regions import Candidates
from sonar_graph.sonar.templates import Floats32, Patch, PolarGrid, Templates

COARSE = 2
"""Cells between the shifts from which the search climbs to the best one."""
MOST_MULTIPLICATIONS = 250_000
"""OpenBLAS uses several cores from 262,144 on."""


class AppearanceParams(Section):
    """Settings of the comparison with designs."""

    cell_m: float = Field(0.015, gt=0)
    """Distance of the samples on the floor."""
    margin_m: float = Field(0.03, ge=0)
    """Width of the compared ring of floor around the largest design."""
    blur_m: float = Field(0.01, gt=0)
    """Standard deviation of the sonar's resolution on the floor."""
    search_m: float = Field(0.045, ge=0)
    """Largest distance of a landmark's centre from the candidate's centroid, along each axis."""
    least_visible: float = Field(0.65, gt=0, le=1)
    """Share of the cells that must lie in the image at the best fit."""
    least_searched: float = Field(0.5, gt=0, le=1)
    """The same during the search: less, or the rim of the image would push the best fit aside."""


@dataclass(frozen=True, eq=False)
class DesignFit:
    """Fit of each design to a patch."""

    evidence: Floats
    """What speaks for each design, in the columns of `sonar_graph.sonar.evidence.EVIDENCE`, shape (designs, 9)."""
    visible: float
    """Share of the cells in view at the best fit of all."""
    heading_rad: Floats
    """Heading of each design's x axis against the floor's, shape (designs,)."""
    centre_m: Floats
    """(x, y) of each design's centre on the floor, between the grid's points, shape (designs, 2)."""


class Appearance:
    """Comparison of patches with the templates of designs."""

    def __init__(self, designs: Sequence[LandmarkDesign], params: AppearanceParams | None = None) -> None:
        self.params = params or AppearanceParams()
        self.templates = Templates.of(designs, self.params.cell_m, self.params.margin_m, self.params.blur_m)
        self.designs = len(designs)
        self.figures = Figures(designs, self.templates, self.params.blur_m)
        self._steps = math.ceil(self.params.search_m / self.params.cell_m)
        self.patch_side = 2 * (self.figures.half + self._steps) + 1
        self._rim = self.figures.half - self.templates.side // 2
        x, y = np.divmod(self.templates.cells, self.templates.side)
        steps = np.arange(0, 2 * self._steps + 1, COARSE)
        self._shifts = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        self._cells = (x + self._rim) * self.patch_side + y + self._rim
        self._offsets = self._shifts @ np.array([self.patch_side, 1])
        pictures = self.templates.pictures
        self._pictures, self._squares = np.ascontiguousarray(pictures.T), np.ascontiguousarray(pictures.T**2)
        self._sums = self._pictures.sum(axis=0), self._squares.sum(axis=0)
        self._first_of_design = np.searchsorted(self.templates.design, np.arange(self.designs + 1)).tolist()

    def fit(self, patch: Patch) -> DesignFit | None:
        """Fit of the designs, each at its best heading and shift; None where too little is in view."""
        seen = windows(patch.seen.ravel(), self._cells, self._offsets)
        visible = seen.sum(axis=1) / np.float32(len(self._cells))
        at = self._correlations(patch, seen, visible)
        share = float(visible[int(np.argmax(at)) // at.shape[1]])
        if share < self.params.least_visible:
            return None
        level = centred(patch)
        evidence, headings, centres = [], [], []
        for first, last in pairwise(self._first_of_design):
            shift, template = divmod(int(np.argmax(at[:, first:last])), last - first)
            start, picture = self._shifts[shift], self.templates.pictures[first + template]
            x, y, offset = climbed(level, patch.seen, self._cells, picture, start, 2 * self._steps)
            found = self.figures.evidence(patch, first + template, (x, y))
            if found is None:
                return None
            evidence.append(found)
            headings.append(self.templates.heading_rad[first + template])
            centres.append(patch.centre_m + self.params.cell_m * (np.array([x, y]) - self._steps + offset))
        return DesignFit(np.array(evidence), share, np.array(headings), np.array(centres))

    def _correlations(self, patch: Patch, seen: Floats32, visible: Floats32) -> Floats32:
        """Correlation of each shift with each template, shape (shifts, templates); -1 where too little is visible."""
        correlation = np.full((len(visible), self._pictures.shape[1]), -1.0, np.float32)
        shifts = np.flatnonzero(visible >= self.params.least_searched)
        if not len(shifts):
            return correlation
        n = (visible[shifts] * len(self._cells))[:, None]
        level = windows(centred(patch).ravel(), self._cells, self._offsets[shifts])
        total, square = (np.tile(whole, (len(shifts), 1)) for whole in self._sums)
        cut = np.flatnonzero(visible[shifts] < 1)
        if len(cut):
            in_view = seen[shifts[cut]]
            total[cut], square[cut] = matmul(in_view, self._pictures), matmul(in_view, self._squares)
        level_sum, level_square = level.sum(axis=1)[:, None], np.einsum("sc,sc->s", level, level)[:, None]
        covariance = matmul(level, self._pictures) - level_sum * total / n
        scale2 = np.maximum(square - total**2 / n, 0.0) * np.maximum(level_square - level_sum**2 / n, 0.0)
        known = scale2 > 0
        correlation[shifts] = np.where(known, covariance / np.sqrt(np.where(known, scale2, 1.0)), -1.0)
        return correlation


@compiled
def windows(values: Floats32, cells: Ints, offsets: Ints) -> Floats32:
    """Values of a patch in the cells at each offset, shape (offsets, cells)."""
    found = np.empty((len(offsets), len(cells)), np.float32)
    for n in range(len(offsets)):
        for c in range(len(cells)):
            found[n, c] = values[cells[c] + offsets[n]]
    return found


def matmul(rows: Floats32, columns: Floats32) -> Floats32:
    """Matrix product in pieces that BLAS takes on one core: threads that wait cost more than so small a product."""
    step = max(1, MOST_MULTIPLICATIONS // columns.size)
    product = np.empty((len(rows), columns.shape[1]), np.float32)
    for first in range(0, len(rows), step):
        np.matmul(rows[first : first + step], columns, out=product[first : first + step])
    return product


def centred(patch: Patch) -> Floats32:
    """Levels over their mean, 0 where nothing is seen: sums of small numbers are exact enough in 32 bits."""
    return np.asarray((patch.level_db - patch.level_db.sum() / max(patch.seen.sum(), 1.0)) * patch.seen)


@compiled
def climbed(
    level: Floats32, seen: Floats32, cells: Ints, picture: Floats32, start: Ints, last: int
) -> tuple[int, int, Floats]:
    """Shift in x and y at which a template correlates best, uphill from a start, and the top of the parabola there.

    Shifts lie between 0 and ``last``; the top is an offset of at most one half along each axis, 0 at an end.
    """
    side, levels, seens = level.shape[1], level.ravel(), seen.ravel()
    known = np.full((last + 1, last + 1), np.nan)
    x, y, moved = start[0], start[1], True
    while moved:
        moved = False
        for dx, dy in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
            i, j = x + dx, y + dy
            if 0 <= i <= last and 0 <= j <= last and np.isnan(known[i, j]):
                known[i, j] = correlation(levels, seens, cells, i * side + j, picture)
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            i, j = x + dx, y + dy
            if 0 <= i <= last and 0 <= j <= last and known[i, j] > known[x, y]:
                x, y, moved = i, j, True
                break
    offset = np.zeros(2)
    if 0 < x < last:
        offset[0] = parabola_top(known[x - 1, y], known[x, y], known[x + 1, y])
    if 0 < y < last:
        offset[1] = parabola_top(known[x, y - 1], known[x, y], known[x, y + 1])
    return x, y, offset


@compiled
def correlation(level: Floats32, seen: Floats32, cells: Ints, offset: int, picture: Floats32) -> float:
    """Correlation of a template with the seen cells of a patch, whose levels are 0 elsewhere."""
    zero = np.float32(0.0)
    n, a, b, aa, bb, ab = zero, zero, zero, zero, zero, zero
    for c in range(len(cells)):
        at = np.uint32(cells[c] + offset)
        one, held, other = level[at], seen[at], picture[c]
        n, a, b = n + held, a + one, b + held * other
        aa, bb, ab = aa + one * one, bb + held * other * other, ab + one * other
    scale2 = (n * aa - a * a) * (n * bb - b * b)
    return float((n * ab - a * b) / math.sqrt(scale2)) if scale2 > 0 else -1.0


@compiled
def parabola_top(before: float, here: float, after: float) -> float:
    """Offset of the top of the parabola through a value and its neighbours, which are not higher."""
    bend = before - 2 * here + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


CENTROID_SIGMA_M = 0.04
"""Standard deviation of a candidate's centroid from the landmark's centre, along and across; used without a fit."""
SLANT_PLANE = FloorView(np.eye(3), 1e-3)
"""Plane of the image, which holds the patches where no floor is known."""


@dataclass(frozen=True, eq=False)
class ObjectSighting:
    """Candidate of a track in one frame, and how the designs fit it."""

    fit: DesignFit | None
    """None where too little of it is in the image."""
    range_m: float
    azimuth_rad: float
    covariance: Floats
    """Of range and azimuth, shape (2, 2)."""
    range_per_height: float = 0.0
    """Metres of range by which the landmark's face seems nearer for each metre that it is higher; 0: not known."""


class CandidateFit:
    """Comparison of candidates with designs, for a sonar of this full vertical opening."""

    def __init__(self, appearance: Appearance, confusion: Confusion, elevation_aperture_rad: float) -> None:
        self._appearance, self._confusion = appearance, confusion
        self._aperture_rad = elevation_aperture_rad
        self._grid: PolarGrid | None = None
        self._shape: tuple[Floats, Floats] = np.empty(0), np.empty(0)

    def at(
        self, image_db: Floats32, frame: SonarFrames, view: FloorView | None, candidates: Candidates, rows: Ints
    ) -> list[ObjectSighting | None]:
        """Sightings of the candidates in these rows; None for a row of -1."""
        shape = (frame.ranges_m, frame.azimuths_rad)
        is_same = (one is other or np.array_equal(one, other) for one, other in zip(self._shape, shape, strict=True))
        if self._grid is None or not all(is_same):
            self._grid, self._shape = PolarGrid.of(*shape, self._aperture_rad), shape
        return [
            None
            if row < 0
            else self._sighting(image_db, view, float(candidates.range_m[row]), float(candidates.azimuth_rad[row]))
            for row in rows.tolist()
        ]

    def _sighting(
        self, image_db: Floats32, view: FloorView | None, range_m: float, azimuth_rad: float
    ) -> ObjectSighting:
        """Sighting of a candidate with its centroid at a range and azimuth: where the best design's centre is."""
        assert self._grid is not None
        plane, model, appearance = view or SLANT_PLANE, self._confusion, self._appearance
        centroid = ObjectSighting(
            None, range_m, azimuth_rad, np.diag(np.square([CENTROID_SIGMA_M, CENTROID_SIGMA_M / range_m]))
        )
        centre = plane.floor_point(range_m, azimuth_rad)
        if centre is None:
            return centroid
        ahead = plane.turned(math.atan2(centre[1], centre[0]))
        at = np.array([np.hypot(*centre), 0.0])
        fit = appearance.fit(self._grid.patch(image_db, ahead, at, appearance.patch_side, appearance.params.cell_m))
        if fit is None:
            return centroid
        best = int(np.argmax(model.log_odds(fit.evidence)))
        range_m, azimuth_rad = ahead.range_azimuth(fit.centre_m[best])
        rise = 0.0 if view is None else view.height_m / range_m
        covariance = model.range_azimuth_cov(fit.visible)
        return ObjectSighting(fit, range_m + model.height_bias_m * rise, azimuth_rad, covariance, rise)

    def log_odds(self, sightings: Sequence[ObjectSighting | None]) -> Floats:
        """Log odds of each design against none of them, last 0 for these, shape (M, designs + 1).

        Of a track that ends looking like this; rows of NaN where nothing was compared.
        """
        odds = np.full((len(sightings), self._appearance.designs + 1), np.nan)
        for row, sighting in enumerate(sightings):
            if sighting is not None and sighting.fit is not None:
                odds[row] = np.append(self._confusion.log_odds(sighting.fit.evidence), 0.0)
        return odds
