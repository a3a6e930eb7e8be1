"""What speaks for a design at its best place, against anything else that may lie on the floor.

A patch is explained by figures with unknown levels. With B the bright parts of a design at its heading (its figure), D
its dark parts, B_q the figure stretched by `STRETCHES`, S and S_q the floor behind a figure, which something tall would
shade, and e the residual::

    design      z = floor + beta B + delta D + gamma S + e        delta <= 0, gamma <= 0
    otherwise   z = floor + beta B_q + gamma S_q + e              gamma <= 0, the best q

No level is given, so that neither gain nor contrast nor a plate that cannot be seen makes a fit bad. R is the sum of
squares that a model leaves, and sigma^2 the mean square of `design` without S. `EVIDENCE` names what comes of it, the
columns of `Figures.evidence`. How much each counts is measured (`Confusion.weights`). Derivation:
docs/theory/recognition.md.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from sonar_graph.devices import LandmarkDesign
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled
from sonar_graph.sonar.templates import Floats32, Patch, Templates, drawn, material_radius_m

EVIDENCE = ("prior", "outline", "figure", "contrast", "beyond", "floor", "behind", "plate", "bare")
"""prior: 1; outline: ln R(otherwise) / R(design); figure: the same without S and D; contrast: ln beta / sigma; beyond:
ln mean square of what is brighter than the design says, next to the figure; floor: ln mean square of what is darker,
farther out; behind: level next to the figure on its far side, dB; plate: root of ln R(without D) / R(design); bare: 1
for a design without dark parts, which no plate can speak for."""
STRETCHES = (
    *((1.0, 1.0), (0.78, 0.78), (0.87, 0.87), (0.94, 0.94), (1.07, 1.07), (1.15, 1.15), (1.27, 1.27)),
    *((1.2, 0.83), (0.83, 1.2)),
)
"""Of the figures of what is no landmark, along the design's axes x and y; the first is the design's own."""
REACH_M = 0.06
"""Width of the ring around the largest design that is explained."""
SHADOW_M = 0.09
"""The same behind it; longest shadow that is looked for is a little more."""
SHADOW_CELLS, OWN_SHADOW_CELLS, NEAR_CELLS, BEHIND_CELLS = 7, 2, 4, 3
"""Lengths of S, of the shadow of a design's own height, of the surroundings of a figure, and of its far side."""
LEAST_CELLS = 60
LEAST_BETA_DB, LEAST_DB2 = 0.5, 0.3
"""Floors of logarithms."""
LEAST_VARIANCE_DB2 = 0.1
"""Variance of a patch up to which it shows no speckle and nothing else: 5.57 dB squared over 300 looks."""
OUT, PART = 0.12, 0.5
"""Shares of a cell in a figure: up to the first it lies outside, from the second on inside."""
NEAR, BEHIND, FAR = 1, 2, 4
"""Zones of the floor; a cell may lie in more than one."""


class Figures:
    """The models of a patch for each template."""

    def __init__(self, designs: Sequence[LandmarkDesign], templates: Templates, blur_m: float) -> None:
        self.cell_m, material_m = templates.cell_m, max(map(material_radius_m, designs))
        self.half = math.ceil((material_m + SHADOW_M) / self.cell_m)
        side = 2 * self.half + 1
        places_m = self.cell_m * np.arange(-self.half, self.half + 1)
        x_m, y_m = np.meshgrid(places_m, places_m, indexing="ij")
        away_m = np.hypot(x_m, y_m)
        area = (away_m <= material_m + REACH_M) | ((away_m <= material_m + SHADOW_M) & (x_m > 0.5 * away_m))
        self._designs: list[_Design] = []
        kernel = np.ones((2 * NEAR_CELLS + 1, 2 * NEAR_CELLS + 1), np.uint8)
        for index, heading in zip(templates.design.tolist(), templates.heading_rad.tolist(), strict=True):
            design = designs[index]
            parts = [drawn(design, heading, side, self.cell_m, blur_m, stretch) for stretch in STRETCHES]
            figures = [bright / float(np.nanmax(design.mask)) for bright, _ in parts]
            figure, dark = figures[0], parts[0][1] / min(float(np.nanmin(design.mask)), -1.0)
            is_plate = dark > PART
            own_shadow = behind(np.minimum(figure + dark, 1.0), OWN_SHADOW_CELLS) > PART
            compared = area & ~(own_shadow & ((away_m > material_m) | (not is_plate.any())))
            is_out = (figure < OUT) & compared
            is_near = cv2.dilate((figure > PART).astype(np.uint8), kernel) > 0
            zones = NEAR * (is_out & is_near) + BEHIND * (is_out & (behind(figure, BEHIND_CELLS) > PART))
            zones += FAR * (is_out & ~is_near & (dark < OUT))
            shades = [behind(one, SHADOW_CELLS) for one in figures]
            cells = np.flatnonzero(compared)
            columns = np.stack([np.ones_like(figure), dark, *figures, *shades]).reshape(-1, side * side)[:, cells]
            columns = np.ascontiguousarray(columns, np.float32)
            smooth = np.stack([cv2.blur(dark, (3, 3)), cv2.blur(figure, (3, 3))]).reshape(2, -1)[:, cells]
            rows, beside = np.divmod(cells, side)
            self._designs.append(
                _Design(
                    rows,
                    beside,
                    columns,
                    np.asarray(smooth, np.float32),
                    zones.ravel()[cells],
                    columns @ columns.T,
                    bool(is_plate.any()),
                )
            )

    def evidence(self, patch: Patch, template: int, first: tuple[int, int]) -> Floats | None:
        """`EVIDENCE` of a template on the part of a patch that begins at this cell, shape (9,).

        None where too little of it is in view, or where it has one level.
        """
        one, side = self._designs[template], len(patch.level_db)
        at = (one.rows + first[0]) * side + one.aside + first[1]
        seen, smooth = patch.seen.ravel()[at], patch.smooth_db.ravel()[at]
        count = float(seen.sum())
        if count < LEAST_CELLS:
            return None
        level = patch.level_db.ravel()[at]
        mean = float(level @ seen) / count
        level = (level - mean) * seen
        values, gram = one.values, one.gram
        if count < len(at):
            values = values * seen
            gram = values @ values.T
        products, total = (values @ level).astype(float), float(level @ level)
        if total < LEAST_VARIANCE_DB2 * count:
            return None
        return _evidence(
            gram.astype(float), products, total, count, one.has_dark, smooth - np.float32(mean), patch.held.ravel()[at],
            one.smooth, one.zones, level, seen,
        )  # fmt: skip


class _Design(NamedTuple):
    """One template over the cells that are compared, n of them."""

    rows: Ints
    """Cells ahead from the first, shape (n,)."""
    aside: Ints
    """Cells to the side, shape (n,)."""
    values: Floats32
    """1, D, the figures B_q, and S_q behind them, shape (2 + 2 figures, n)."""
    smooth: Floats32
    """D and B over 3 by 3 cells, shape (2, n)."""
    zones: Ints
    """Sums of `FAR`, `NEAR` and `BEHIND`, shape (n,)."""
    gram: Floats32
    """``values values^T``."""
    has_dark: bool


@compiled
def residual(gram: Floats, products: Floats, total: float, at: Ints, solution: Floats) -> float:
    """Sum of squares left by least squares on the columns ``at``; fills in their coefficients, by elimination."""
    n = len(at)
    a = np.empty((n, n + 1))
    for i in range(n):
        for j in range(n):
            a[i, j] = gram[at[i], at[j]]
        a[i, i] += 1e-3
        a[i, n] = products[at[i]]
    for i in range(n):
        for k in range(i + 1, n):
            factor = a[k, i] / a[i, i]
            for j in range(i, n + 1):
                a[k, j] -= factor * a[i, j]
    left = total
    for i in range(n - 1, -1, -1):
        value = a[i, n]
        for j in range(i + 1, n):
            value -= a[i, j] * solution[j]
        solution[i] = value / a[i, i]
    for i in range(n):
        left -= solution[i] * products[at[i]]
    return max(left, 1e-3)


@compiled
def _evidence(
    gram: Floats, products: Floats, total: float, count: float, has_dark: bool, smooth: Floats32, held: Floats32,
    model: Floats32, zones: Ints, level: Floats32, seen: Floats32,
) -> Floats:  # fmt: skip
    """`EVIDENCE` from products of columns with each other and with levels, which have the mean 0."""
    dark, first, figures = 1, 2, (len(products) - 2) // 2
    found, solution = np.empty(9), np.zeros(4)
    # the design: with its dark parts where they are dark, with and without a shadow
    plain = residual(gram, products, total, np.array([0, first]), solution)
    floor, beta, delta = solution[0], solution[1], 0.0
    design = plain
    if has_dark:
        with_dark = residual(gram, products, total, np.array([0, first, dark]), solution)
        if solution[2] < 0:
            design, floor, beta, delta = with_dark, solution[0], solution[1], solution[2]
    shaded = residual(gram, products, total, np.array([0, first, first + figures]), solution)
    shaded = shaded if solution[2] < 0 else plain
    both = min(design, shaded)
    if delta < 0 and shaded < plain:
        with_both = residual(gram, products, total, np.array([0, first, dark, first + figures]), solution)
        both = with_both if solution[2] < 0 and solution[3] < 0 else both
    # otherwise: the best of all figures
    other, other_plain = shaded, plain
    for q in range(1, figures):
        other_plain_q = residual(gram, products, total, np.array([0, first + q]), solution)
        other_q = residual(gram, products, total, np.array([0, first + q, first + figures + q]), solution)
        other_plain = min(other_plain, other_plain_q)
        other = min(other, other_q if solution[2] < 0 else other_plain_q)
    # what is left next to the figure, farther out, and behind
    mean_square = design / count
    near, near_cells, far, far_cells, back, back_cells = 0.0, 0, 0.0, 0, 0.0, 0
    for c in range(len(zones)):
        if held[c] <= 0.5:
            continue
        off = smooth[c] - floor - beta * model[1, c] - delta * model[0, c]
        if zones[c] & NEAR:
            near, near_cells = near + max(off, 0.0) ** 2, near_cells + 1
        if zones[c] & FAR:
            far, far_cells = far + min(off, 0.0) ** 2, far_cells + 1
        if zones[c] & BEHIND and seen[c] > 0:
            back, back_cells = back + level[c] - floor, back_cells + 1
    found[0] = 1.0
    found[1] = math.log(other / both)
    found[2] = math.log(other_plain / plain)
    found[3] = math.log(max(beta, LEAST_BETA_DB) / math.sqrt(mean_square))
    found[4] = math.log((near / near_cells if near_cells > 8 else mean_square / 3) + LEAST_DB2)
    found[5] = math.log((far / far_cells if far_cells > 8 else mean_square / 3) + LEAST_DB2)
    found[6] = back / back_cells if back_cells > 5 else 0.0
    found[7] = math.sqrt(max(math.log(shaded / both), 0.0))
    found[8] = 0.0 if has_dark else 1.0
    return found


def behind(figure: Floats32, cells: int) -> Floats32:
    """Share of each cell that lies within so many cells behind a figure, and not in it, shape as given."""
    shaded = np.zeros_like(figure)
    for step in range(1, cells + 1):
        shaded[step:] = np.maximum(shaded[step:], figure[:-step])
    return np.clip(shaded - figure, 0.0, 1.0)
