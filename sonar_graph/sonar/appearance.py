"""What a candidate looks like: soft scores against the landmark designs, whatever its heading.

The image around a candidate is sampled on a square grid of the floor, so that foreshortening and the fan's shape drop
out; each sample is a mean of decibels over a stretch of range as long as a cell. Every design is a template on the same
grid (`sonar_graph.sonar.templates`). Patch and template are compared by their correlation c over the cells in view,
which neither gain nor the floor's level changes, at all small shifts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.kernels import compiled
from sonar_graph.landmark_designs import LandmarkDesign
from sonar_graph.measurements import Floats, Ints
from sonar_graph.sonar.floor_patch import Patch
from sonar_graph.sonar.templates import Floats32, Templates

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
class Fit:
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

    def fit(self, patch: Patch) -> Fit:
        """The designs at their best headings and shifts."""
        visible = _visible(patch.seen.ravel(), self._cells, self._offsets)
        at = self._correlations(patch, visible)
        best_shift, best_template = divmod(int(np.argmax(at)), at.shape[1])
        offset = self._between_points(at[:, best_template], best_shift)
        by_design = np.maximum.reduceat(at.max(axis=0), self._first_of_design)
        share = float(visible[best_shift])
        return Fit(
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
