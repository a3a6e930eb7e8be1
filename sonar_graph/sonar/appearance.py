"""Appearance of candidates: correlation of the image around them with every design, at all headings and small shifts.

The image is sampled on a square grid of the floor, where foreshortening and the shape of the fan drop out. Designs are
templates on the same grid (`sonar_graph.sonar.templates`). The correlation c over the cells in view does not depend on
gain or on the level of the floor. How far speckle lowers it depends on the design's contrast and on the bins, and is
corrected. Derivation: docs/theory/recognition.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.devices import LandmarkDesign
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled
from sonar_graph.sonar.confusion import STANDARD_ATTENUATION, Confusion, soft_scores
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.regions import Candidates
from sonar_graph.sonar.templates import Floats32, Patch, PolarGrid, Templates

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

    correlation: Floats
    """Best over headings and shifts, shape (designs,); negative where too little is visible. That of a sighting is
    corrected for attenuation by speckle, and may exceed 1."""
    visible: float
    """Share of the cells in view at the best fit of all."""
    best: int
    """Design with the highest correlation."""
    heading_rad: float
    """Heading of that design's x axis against the floor's."""
    centre_m: Floats
    """(x, y) of that design's centre on the floor, between the grid's points, shape (2,)."""


class Appearance:
    """Comparison of patches with the templates of designs."""

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
        self._variance_db2 = np.add.reduceat(pictures.var(axis=1), self._first_of_design)
        self._variance_db2 /= np.bincount(self.templates.design)

    def fit(self, patch: Patch) -> DesignFit:
        """Fit of the designs at their best headings and shifts."""
        seen = windows(patch.seen.ravel(), self._cells, self._offsets)
        visible = seen.sum(axis=1) / np.float32(len(self._cells))
        at = self._correlations(patch, seen, visible)
        best_shift, best_template = divmod(int(np.argmax(at)), at.shape[1])
        side = 2 * self._steps + 1
        surface = at[:, best_template].reshape(side, side)
        x, y = divmod(best_shift, side)
        offset = np.array([parabola_top(surface[:, y], x), parabola_top(surface[x, :], y)])
        by_design = np.maximum.reduceat(at.max(axis=0), self._first_of_design)
        share = float(visible[best_shift])
        return DesignFit(
            by_design if share >= self.params.least_visible else np.full_like(by_design, -1.0),
            share,
            int(self.templates.design[best_template]),
            float(self.templates.heading_rad[best_template]),
            patch.centre_m + self.params.cell_m * (self._shifts[best_shift] - self._steps + offset),
        )

    def attenuation(self, bin_m: float) -> Floats:
        """Correlation of a patch with its own design that speckle leaves, shape (designs,), in bins of a length.

        A template of variance V plus noise of variance N correlates with the template by ``sqrt(V / (V + N))``.
        """
        return np.asarray(np.sqrt(self._variance_db2 / (self._variance_db2 + noise_db2(self.params.cell_m, bin_m))))

    def _correlations(self, patch: Patch, seen: Floats32, visible: Floats32) -> Floats32:
        """Correlation of each shift with each template, shape (shifts, templates); -1 where too little is visible."""
        correlation = np.full((len(visible), self._pictures.shape[1]), -1.0, np.float32)
        shifts = np.flatnonzero(visible >= self.params.least_searched)
        if not len(shifts):
            return correlation
        n = (visible[shifts] * len(self._cells))[:, None]
        # levels over their mean, 0 where nothing is seen: sums of small numbers are exact enough in 32 bits
        centred = (patch.level_db - patch.level_db.sum() / max(patch.seen.sum(), 1.0)) * patch.seen
        level = windows(centred.ravel(), self._cells, self._offsets[shifts])
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


def parabola_top(values: Floats32, at: int) -> float:
    """Offset of the top of the parabola through the highest value and its neighbours; 0 at an end."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, here, after = (float(v) for v in values[at - 1 : at + 2])
    bend = before - 2 * here + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


ONE_LOOK_DB2 = (10 / math.log(10)) ** 2 * math.pi**2 / 6
"""Variance of the level of speckle of one look."""
BINS_A_LOOK = 1.64
"""Length of a pulse: 4 mm in bins of 2.44 mm."""
TEXTURE_DB2 = 6.7
"""Variance of a cell that looks do not average out. Measured on a simulated basin: what the shipped designs leave
unexplained in their own patches (15.0), without its speckle."""


def noise_db2(cell_m: float, bin_m: float) -> float:
    """Variance of the level of a cell that shows an even floor, dB squared."""
    return ONE_LOOK_DB2 / max(1.0, cell_m / (BINS_A_LOOK * bin_m)) + TEXTURE_DB2


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
    is_fitted: bool = False
    """Range and azimuth are those of a design's centre, not of the candidate's centroid."""


class CandidateFit:
    """Comparison of candidates with designs, for a sonar of this full vertical opening."""

    def __init__(self, appearance: Appearance, confusion: Confusion, elevation_aperture_rad: float) -> None:
        self._appearance, self._confusion = appearance, confusion
        self._aperture_rad = elevation_aperture_rad
        self._grid: PolarGrid | None = None
        self._correction = np.ones(appearance.designs)
        self._shape: tuple[Floats, Floats] = np.empty(0), np.empty(0)

    def at(
        self, image_db: Floats32, frame: SonarFrames, view: FloorView | None, candidates: Candidates, rows: Ints
    ) -> list[ObjectSighting | None]:
        """Sightings of the candidates in these rows; None for a row of -1."""
        shape = (frame.ranges_m, frame.azimuths_rad)
        is_same = (one is other or np.array_equal(one, other) for one, other in zip(self._shape, shape, strict=True))
        if self._grid is None or not all(is_same):
            self._grid, self._shape = PolarGrid.of(*shape, self._aperture_rad), shape
            self._correction = STANDARD_ATTENUATION / self._appearance.attenuation(self._grid.bin_m)
        view, appearance = view or SLANT_PLANE, self._appearance
        sightings: list[ObjectSighting | None] = []
        for row in rows.tolist():
            if row < 0:
                sightings.append(None)
                continue
            range_m, azimuth_rad = float(candidates.range_m[row]), float(candidates.azimuth_rad[row])
            centroid_cov = np.diag(np.square([CENTROID_SIGMA_M, CENTROID_SIGMA_M / range_m]))
            sighting = ObjectSighting(None, range_m, azimuth_rad, centroid_cov)
            centre = view.floor_point(range_m, azimuth_rad)
            if centre is not None:
                side, cell_m = appearance.patch_side, appearance.params.cell_m
                fit = appearance.fit(self._grid.patch(image_db, view, centre, side, cell_m))
                fit = replace(fit, correlation=fit.correlation * self._correction)
                best = fit.correlation.max()
                if best >= self._confusion.threshold:
                    covariance = self._confusion.range_azimuth_cov(fit.visible)
                    sighting = ObjectSighting(fit, *view.range_azimuth(fit.centre_m), covariance, is_fitted=True)
                elif best >= 0:
                    sighting = replace(sighting, fit=fit)
            sightings.append(sighting)
        return sightings

    def scores(self, sightings: Sequence[ObjectSighting | None]) -> Floats:
        """Soft scores of the features, shape (M, designs + 1); rows of 0 where nothing was compared."""
        scores, model = np.zeros((len(sightings), self._appearance.designs + 1)), self._confusion
        for row, sighting in enumerate(sightings):
            if sighting is not None and (fit := sighting.fit) is not None:
                found = soft_scores(fit.correlation[None], np.array([fit.visible]), model.sharpness, model.threshold)
                scores[row] = found[0]
        return scores
