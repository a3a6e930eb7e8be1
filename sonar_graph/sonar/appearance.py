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
    least_visible: float = Field(0.8, gt=0, le=1)
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
        self._rows, self._shifts = self._shifted_cells()
        pictures = self.templates.pictures
        self._pictures, self._squares = np.ascontiguousarray(pictures.T), np.ascontiguousarray(pictures.T**2)

    def _shifted_cells(self) -> tuple[Ints, Ints]:
        """Places of the templates' cells in a patch at every shift, shape (shifts, cells), and the shifts, (n, 2)."""
        x, y = np.divmod(self.templates.cells, self.templates.side)
        steps = np.arange(2 * self._steps + 1)
        shifts = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        rows = (x + shifts[:, :1]) * self.patch_side + y + shifts[:, 1:]
        return rows, shifts - self._steps

    def fit(self, patch: Patch) -> Fit:
        """The designs at their best headings and shifts."""
        seen = patch.seen.ravel()[self._rows]
        level = patch.level_db.ravel()[self._rows]
        correlation, visible = self._correlations(level, seen)
        at = correlation.reshape(len(self._shifts), -1)
        best_shift, best_template = np.unravel_index(np.argmax(at), at.shape)
        by_design = np.array([at[:, self.templates.design == d].max() for d in range(self.designs)])
        offset = self._between_points(at[:, best_template], int(best_shift))
        share = float(visible[best_shift])
        return Fit(
            by_design if share >= self.params.least_visible else np.full_like(by_design, -1.0),
            share,
            int(self.templates.design[best_template]),
            float(self.templates.heading_rad[best_template]),
            patch.centre_m + self.params.cell_m * (self._shifts[best_shift] + offset),
        )

    def _correlations(self, level: Floats32, seen: Floats32) -> tuple[Floats32, Floats32]:
        """Correlation of each shift with each template, shape (shifts, templates), and the visible share (shifts,)."""
        count = seen.sum(axis=1)
        mean = (level * seen).sum(axis=1) / np.maximum(count, 1)
        level = (level - mean[:, None]) * seen
        template_sum, template_square = _product(seen, self._pictures), _product(seen, self._squares)
        n = np.maximum(count, 1)[:, None]
        template_variance = template_square - template_sum**2 / n
        level_variance = np.einsum("sc,sc->s", level, level)[:, None]
        product = _product(level, self._pictures)
        visible = count / level.shape[1]
        known = (visible[:, None] >= self.params.least_searched) & (template_variance > 0) & (level_variance > 0)
        scale = np.sqrt(np.where(known, template_variance * level_variance, 1.0))
        return np.where(known, product / scale, -1.0), visible

    def _between_points(self, correlation: Floats32, best: int) -> Floats:
        """Where a parabola through the neighbours of the best shift has its top, in points, shape (2,)."""
        side = 2 * self._steps + 1
        surface = correlation.reshape(side, side)
        x, y = divmod(best, side)
        return np.array([_top(surface[:, y], x), _top(surface[x, :], y)])


def _product(rows: Floats32, columns: Floats32) -> Floats32:
    """The matrix product, in pieces that BLAS takes on one core: for so little, threads that wait cost far more."""
    step = max(1, MOST_MULTIPLICATIONS // columns.size)
    return np.concatenate([rows[first : first + step] @ columns for first in range(0, len(rows), step)])


def _top(values: Floats32, at: int) -> float:
    """Offset of the top of the parabola through three values around the highest; 0 at an end."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, here, after = (float(v) for v in values[at - 1 : at + 2])
    bend = before - 2 * here + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0
