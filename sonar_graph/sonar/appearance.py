"""What a candidate looks like: soft scores against the landmark designs, whatever its heading.

The image around a candidate is sampled on a square grid of the floor, so that foreshortening and the fan's shape drop
out; each sample is a mean of decibels over a stretch of range as long as a cell. Every design is a template on the same
grid (`sonar_graph.sonar.templates`). Patch and template are compared by their correlation c over the cells in view,
which neither gain nor the floor's level changes, at all small shifts.

A closer look at the candidates that tracks took: which design fits, and where its centre is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.devices import LandmarkDesign
from sonar_graph.measurements import Floats, Ints, SonarFrames
from sonar_graph.numerics import compiled
from sonar_graph.sonar.confusion import Confusion, soft_scores
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.regions import Candidates
from sonar_graph.sonar.templates import Floats32, Patch, PolarGrid, Templates

MOST_MULTIPLICATIONS = 250_000
"""OpenBLAS uses several cores from 262,144 on."""


class AppearanceParams(Section):
    """How candidates are compared with designs."""

    cell_m: float = Field(0.015, gt=0)
    """Distance of the samples on the floor."""
    margin_m: float = Field(0.03, ge=0)
    """Width of the ring of floor around the largest design that is compared too."""
    blur_m: float = Field(0.01, gt=0)
    """Standard deviation of the sonar's resolution on the floor."""
    search_m: float = Field(0.045, ge=0)
    """How far a landmark's centre is sought from the candidate's, along each axis."""
    least_visible: float = Field(0.65, gt=0, le=1)
    """Share of the cells that must lie in the image where the best of all fits."""
    least_searched: float = Field(0.5, gt=0, le=1)
    """The same while the best is sought: less, or the rim of the image would push the best fit aside."""


@dataclass(frozen=True, eq=False)
class DesignFit:
    """How well each design fits a patch."""

    correlation: Floats
    """Best over headings and shifts, shape (designs,); -1 where too little is visible."""
    visible: float
    """Share of the cells in view at the best fit of all."""
    best: int
    """Design with the highest correlation."""
    heading_rad: float
    """Of that design's x axis against the floor's."""
    centre_m: Floats
    """(x, y) of that design's centre on the floor, between the grid's points, shape (2,)."""


class Appearance:
    """Compares patches with designs.

    Parameters
    ----------
    designs
        What is known.
    params
        None: the defaults.
    """

    def __init__(self, designs: Sequence[LandmarkDesign], params: AppearanceParams | None = None) -> None:
        self.params = params or AppearanceParams()
        self.templates = Templates.of(designs, self.params.cell_m, self.params.margin_m, self.params.blur_m)
        self.designs = len(designs)
        self._steps = math.ceil(self.params.search_m / self.params.cell_m)
        self.patch_side = self.templates.side + 2 * self._steps
        x, y = np.divmod(self.templates.cells, self.templates.side)
        steps = np.arange(2 * self._steps + 1)
        self._shifts = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        self._cells, self._offsets = x * self.patch_side + y, self._shifts @ np.array([self.patch_side, 1])
        pictures = self.templates.pictures
        self._pictures, self._squares = np.ascontiguousarray(pictures.T), np.ascontiguousarray(pictures.T**2)
        self._sums = self._pictures.sum(axis=0), self._squares.sum(axis=0)
        self._first_of_design = np.searchsorted(self.templates.design, np.arange(self.designs))

    def fit(self, patch: Patch) -> DesignFit:
        """The designs at their best headings and shifts."""
        visible = _visible(patch.seen.ravel(), self._cells, self._offsets)
        at = self._correlations(patch, visible)
        best_shift, best_template = divmod(int(np.argmax(at)), at.shape[1])
        offset = self._between_points(at[:, best_template], best_shift)
        by_design = np.maximum.reduceat(at.max(axis=0), self._first_of_design)
        share = float(visible[best_shift])
        return DesignFit(
            by_design if share >= self.params.least_visible else np.full_like(by_design, -1.0),
            share,
            int(self.templates.design[best_template]),
            float(self.templates.heading_rad[best_template]),
            patch.centre_m + self.params.cell_m * (self._shifts[best_shift] - self._steps + offset),
        )

    def _correlations(self, patch: Patch, visible: Floats32) -> Floats32:
        """Correlation of each shift with each template, shape (shifts, templates); -1 where too little is visible."""
        correlation = np.full((len(visible), self._pictures.shape[1]), -1.0, np.float32)
        shifts = np.flatnonzero(visible >= self.params.least_searched)
        if not len(shifts):
            return correlation
        n = (visible[shifts] * len(self._cells))[:, None]
        level = _windows(_centred(patch).ravel(), self._cells, self._offsets[shifts])
        total, square = self._template_sums(patch, visible, shifts)
        level_sum, level_square = level.sum(axis=1)[:, None], np.einsum("sc,sc->s", level, level)[:, None]
        covariance = _product(level, self._pictures) - level_sum * total / n
        scale2 = np.maximum(square - total**2 / n, 0.0) * np.maximum(level_square - level_sum**2 / n, 0.0)
        known = scale2 > 0
        correlation[shifts] = np.where(known, covariance / np.sqrt(np.where(known, scale2, 1.0)), -1.0)
        return correlation

    def _template_sums(self, patch: Patch, visible: Floats32, shifts: Ints) -> tuple[Floats32, Floats32]:
        """Of the templates and of their squares over the cells that are seen, shape (shifts, templates)."""
        total, square = (np.tile(whole, (len(shifts), 1)) for whole in self._sums)
        cut = np.flatnonzero(visible[shifts] < 1)
        if len(cut):
            seen = _windows(patch.seen.ravel(), self._cells, self._offsets[shifts[cut]])
            total[cut], square[cut] = _product(seen, self._pictures), _product(seen, self._squares)
        return total, square

    def _between_points(self, correlation: Floats32, best: int) -> Floats:
        """Where a parabola through the neighbours of the best shift has its top, in points, shape (2,)."""
        side = 2 * self._steps + 1
        surface = correlation.reshape(side, side)
        x, y = divmod(best, side)
        return np.array([_top(surface[:, y], x), _top(surface[x, :], y)])


def _centred(patch: Patch) -> Floats32:
    """Levels over their mean, 0 where nothing is seen: sums of small numbers are exact enough."""
    return (patch.level_db - patch.level_db.sum() / max(patch.seen.sum(), 1.0)) * patch.seen


@compiled
def _visible(seen: Floats32, cells: Ints, offsets: Ints) -> Floats32:
    """Share of the cells that a patch holds at each offset, shape (offsets,)."""
    share = np.empty(len(offsets), np.float32)
    for n in range(len(offsets)):
        count = 0
        for c in range(len(cells)):
            count += int(seen[cells[c] + offsets[n]])
        share[n] = count / len(cells)
    return share


@compiled
def _windows(values: Floats32, cells: Ints, offsets: Ints) -> Floats32:
    """Values of a patch in the cells at each offset, shape (offsets, cells)."""
    windows = np.empty((len(offsets), len(cells)), np.float32)
    for n in range(len(offsets)):
        for c in range(len(cells)):
            windows[n, c] = values[cells[c] + offsets[n]]
    return windows


def _product(rows: Floats32, columns: Floats32) -> Floats32:
    """The matrix product, in pieces that BLAS takes on one core: for so little, threads that wait cost far more."""
    step = max(1, MOST_MULTIPLICATIONS // columns.size)
    product = np.empty((len(rows), columns.shape[1]), np.float32)
    for first in range(0, len(rows), step):
        np.matmul(rows[first : first + step], columns, out=product[first : first + step])
    return product


def _top(values: Floats32, at: int) -> float:
    """Offset of the top of the parabola through three values around the highest; 0 at an end."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, here, after = (float(v) for v in values[at - 1 : at + 2])
    bend = before - 2 * here + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


CENTROID_SIGMA_M = 0.04
"""Of a candidate's own centroid, along and across, where no design fits: a landmark's middle may be elsewhere."""
SLANT_PLANE = FloorView(np.eye(3), 1e-3)
"""Where no floor is known, patches lie in the plane of the image."""


@dataclass(frozen=True, eq=False)
class ObjectSighting:
    """A track's candidate in one frame, and how the designs fit it."""

    fit: DesignFit | None
    """None where too little of it is in the image."""
    range_m: float
    azimuth_rad: float
    covariance: Floats
    """Of both, shape (2, 2)."""
    is_fitted: bool = False
    """Whether range and azimuth are those of a design's centre, not of the candidate's centroid."""


class CandidateFit:
    """Compares candidates with the designs.

    Parameters
    ----------
    appearance
        The designs.
    confusion
        The measured model.
    elevation_aperture_rad
        Full vertical opening of the sonar.
    """

    def __init__(self, appearance: Appearance, confusion: Confusion, elevation_aperture_rad: float) -> None:
        self._appearance, self._confusion = appearance, confusion
        self._aperture_rad = elevation_aperture_rad
        self._grid: PolarGrid | None = None
        self._shape: tuple[Floats, Floats] | None = None

    def at(
        self,
        image_db: Floats32,
        frame: SonarFrames,
        view: FloorView | None,
        candidates: Candidates,
        rows: Ints,
    ) -> list[ObjectSighting | None]:
        """What each track took; None for a row of -1."""
        grid, floor = self._grid_of(frame), view or SLANT_PLANE
        return [None if row < 0 else self._one(image_db, grid, floor, candidates, row) for row in rows.tolist()]

    def scores(self, sightings: Sequence[ObjectSighting | None]) -> Floats:
        """Soft scores of the features, shape (M, designs + 1); rows of 0 where nothing was compared."""
        scores = np.zeros((len(sightings), self._appearance.designs + 1))
        for row, sighting in enumerate(sightings):
            if sighting is not None and (fit := sighting.fit) is not None:
                model = self._confusion
                found = soft_scores(fit.correlation[None], np.array([fit.visible]), model.sharpness, model.threshold)
                scores[row] = found[0]
        return scores

    def _grid_of(self, frame: SonarFrames) -> PolarGrid:
        """The lookup of the frame's beams and bins, made once for all frames that share them."""
        shape = (frame.ranges_m, frame.azimuths_rad)
        if self._grid is None or self._shape is None or not all(map(_is_same, self._shape, shape)):
            self._grid, self._shape = PolarGrid(*shape, self._aperture_rad), shape
        return self._grid

    def _one(
        self, image_db: Floats32, grid: PolarGrid, view: FloorView, candidates: Candidates, row: int
    ) -> ObjectSighting:
        range_m, azimuth_rad = float(candidates.range_m[row]), float(candidates.azimuth_rad[row])
        loose = np.square([CENTROID_SIGMA_M, CENTROID_SIGMA_M / range_m])
        unfitted = ObjectSighting(None, range_m, azimuth_rad, np.diag(loose))
        centre = view.floor_point(range_m, azimuth_rad)
        if centre is None:
            return unfitted
        appearance = self._appearance
        fit = appearance.fit(grid.patch(image_db, view, centre, appearance.patch_side, appearance.params.cell_m))
        if fit.correlation.max() < 0:
            return unfitted
        if fit.correlation.max() < self._confusion.threshold:
            return ObjectSighting(fit, range_m, azimuth_rad, unfitted.covariance)
        covariance = self._confusion.range_azimuth_cov(fit.visible)
        return ObjectSighting(fit, *view.range_azimuth(fit.centre_m), covariance, is_fitted=True)


def _is_same(one: Floats, other: Floats) -> bool:
    return one is other or np.array_equal(one, other)
