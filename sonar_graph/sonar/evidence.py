"""Evidence for a design at its best place, against anything else that may lie on the floor.

A patch is explained by figures with unknown levels. With B the bright parts of a design at its heading (its figure), D
its dark parts, B_q the figure stretched by `STRETCHES`, S and S_q the floor behind a figure, which something tall would
shade, and e the residual::

    design      z = floor + beta B + delta D + gamma S + e        delta <= 0, gamma <= 0
    otherwise   z = floor + beta B_q + gamma S_q + e              gamma <= 0, the best q
    covered     z = floor + beta B H + delta D + e                the best H, or 1

H is 1 on one side of a straight edge and 0 beyond it, where sediment or weed lies: `EDGES` directions, `OFFSETS` from
the middle. No level is given, so that neither gain nor contrast nor a plate that cannot be seen makes a fit bad. R is
the sum of squares that a model leaves, and sigma^2 the mean square of `design` without S. `Evidence` names what comes
of it. Of Gaussian e a likelihood ratio is ``n / 2 ln R' / R`` with n independent cells: logarithms of ratios count by
the share of cells that are independent. How much each piece counts is measured (`Confusion.weights`). Derivation:
docs/theory/recognition.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sonar_graph.devices import LandmarkDesign
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled
from sonar_graph.sonar.templates import (
    Blur,
    Floats32,
    Patch,
    Templates,
    drawn,
    places_around,
)

Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]


class Evidence(NamedTuple):
    """Evidence for a design, one number a feature."""

    prior: float
    """1."""
    outline: float
    """``ln R(otherwise) / R(design)``."""
    figure: float
    """The same without S and D."""
    contrast: float
    """``ln beta / sigma``."""
    beyond: float
    """Logarithm of the mean square of what is brighter than the design, next to the figure."""
    floor: float
    """Logarithm of the mean square of what is darker than the design, farther out."""
    behind: float
    """Level next to the figure on its far side, dB."""
    plate: float
    """Root of ``ln R(without D) / R(design)``, or of ``ln R(without B) / R(design)`` where that is less: a plate alone
    is no landmark."""
    bare: float
    """1 for a design without dark parts, for which no plate is evidence."""
    rival: float
    """Logarithm of the least R(covered) of all designs over that of this one, as shares of what one level leaves."""
    covered: float
    """``ln R(design without S) / R(covered)``."""


EVIDENCE = Evidence._fields
"""Names of the pieces, the columns of `Figures.evidence`."""
RATIOS_OF_SQUARES = ("outline", "figure", "rival", "covered")
"""Pieces that count by the share of independent cells; `plate`, a root, counts by its root."""
RIVAL = EVIDENCE.index("rival")
COVERED = EVIDENCE.index("covered")
HALF_POWER = 2 * math.sqrt(2 * math.log(2))
"""Width at half of the power over the standard deviation."""
STRETCHES = (
    (1.0, 1.0),
    (0.78, 0.78),
    (0.87, 0.87),
    (0.94, 0.94),
    (1.07, 1.07),
    (1.15, 1.15),
    (1.27, 1.27),
    (1.2, 0.83),
    (0.83, 1.2),
)
"""Of the figures of what is no landmark, along the design's axes x and y; the first is the design's own."""
FLOOR = 0
DARK = 1
FIGURE = 2
"""Columns of the models: 1, D, and the first of the figures; the shadows S_q follow the figures."""
SHADOW = FIGURE + len(STRETCHES)
EDGES = 12
"""Directions of the edges of what covers a part of a figure."""
OFFSETS = (0.15, 0.4, 0.65)
"""Their distances from its middle, in radii of the disc that has the figure's second moment."""
REACH_M = 0.06
"""Width of the ring around the largest design that is explained."""
SHADOW_M = 0.09
"""The same behind it; longest shadow that is looked for is a little more."""
SHADOW_CELLS = 7
"""Length of S."""
OWN_SHADOW_CELLS = 2
"""Length of the shadow of a design's own height."""
NEAR_CELLS = 4
"""Width of the surroundings of a figure."""
BEHIND_CELLS = 3
"""Depth of its far side."""
LEAST_CELLS = 60
LEAST_BETA_DB = 0.5
LEAST_DB2 = 0.3
"""Floors of logarithms."""
LEAST_LEFT_DB2 = 1e-3
"""Floor of a sum of squares."""
LEAST_VARIANCE_DB2 = 0.1
"""Variance of a patch up to which it shows no speckle and nothing else: 5.57 dB squared over 300 looks."""
STEP = np.float32(1 / 64)
"""In which models are kept, as bytes: a fit reads thousands of cells, and memory is what it waits for."""
OUT = 0.12
"""Share of a cell in a figure up to which it lies outside."""
PART = 0.5
"""Share of a cell in a figure from which on it lies inside."""
NEAR = 1
BEHIND = 2
FAR = 4
"""Zones of the floor; a cell may lie in more than one."""


class FigureOfTemplate(NamedTuple):
    """The models of a patch for one template, over the n cells that are compared; fields as in `Figures`."""

    cells: NDArray[np.int32]
    values: Bytes
    smooth: Floats32
    zones: Bytes
    uncovered: Bytes
    has_dark: bool
    radius_m: float
    gram: Floats
    kept: Floats


class Figures(NamedTuple):
    """The models of a patch for each template, over the cells that are compared.

    Rows are cells, those of one template after those of another, n in all.
    """

    patch_side: int
    """Cells along the side of the patches, in which the models may be shifted."""
    first: Ints
    """First row of each template, and n, shape (templates + 1,)."""
    cells: NDArray[np.int32]
    """Cells of a patch, row by row, with the template at its first place, shape (n,)."""
    values: Bytes
    """1, D, the figures B_q, and S_q behind them, in `STEP`, shape (n, 2 + 2 figures)."""
    smooth: Floats32
    """D and B over 3 by 3 cells, shape (n, 2)."""
    zones: Bytes
    """Sums of `FAR`, `NEAR` and `BEHIND`, shape (n,)."""
    gram: Floats
    """``values^T values`` of each template, shape (templates, 2 + 2 figures, 2 + 2 figures)."""
    has_dark: Bools
    """Whether it has dark parts, shape (templates,)."""
    uncovered: Bytes
    """1 in cells on the uncovered side of each edge, shape (n, edges)."""
    kept: Floats
    """`kept_sums` of each template, shape (templates, edges, 3)."""
    radius_m: Floats
    """Of the disc that has the figure's second moment, shape (templates,)."""
    independent: float
    """Share of the cells that are independent: cells are not where the sonar resolves less."""
    counts: Floats
    """By how much each piece of `Evidence` counts, shape (11,)."""

    @classmethod
    def of(
        cls,
        designs: Sequence[LandmarkDesign],
        templates: Templates,
        blur_m: Blur,
        last: int,
    ) -> Figures:
        """Models of designs at the headings of their templates, for places 0 to ``last`` along each axis."""
        grid = _Grid.of(designs, templates.cell_m)
        side = len(grid.x_m)
        patch_side = side + last
        pairs = zip(templates.design, templates.heading_rad, strict=True)
        figures = [
            _figure(designs[index], float(heading_rad), grid, blur_m, patch_side)
            for index, heading_rad in pairs
        ]
        cells, values, smooth, zones, uncovered, has_dark, radius_m, gram, kept = zip(
            *figures, strict=True
        )
        # a cell narrower than the width of the blur at half power repeats its neighbour
        independent = math.prod(
            min(templates.cell_m / (HALF_POWER * blur), 1.0) for blur in blur_m
        )
        return cls(
            patch_side=patch_side,
            first=np.cumsum([0, *map(len, cells)]),
            cells=np.concatenate(cells),
            values=np.concatenate(values),
            smooth=np.concatenate(smooth),
            zones=np.concatenate(zones),
            gram=np.array(gram),
            has_dark=np.array(has_dark),
            uncovered=np.concatenate(uncovered),
            kept=np.array(kept),
            radius_m=np.array(radius_m),
            independent=independent,
            counts=_counts(independent),
        )

    def evidence(
        self, patch: Patch, template: Ints, cell: Ints
    ) -> tuple[Floats, Ints] | None:
        """`Evidence` of templates on the parts of a patch that begin at some cells, and the edges that cover them.

        Shapes (n,), (n, 2), (n, 11) and (n,). None where too little of one is in view, or where it has one level. An
        edge is numbered by direction and offset; -1: the whole figure is at least as probable as that with the best
        edge, with prior probabilities of 1/2 for the whole and 1/72 for each of 36 edges.
        """
        found = np.empty((len(template), len(EVIDENCE)))
        edge = np.full(len(template), -1)
        if not fill_evidence(self, patch, template, cell, found, edge):
            return None
        # so far `rival` is the logarithm for each design alone: compare with the best of all designs
        found[:, RIVAL] = found[:, RIVAL].min() - found[:, RIVAL]
        return found * self.counts, edge

    def is_kept(self, template: int, edge: int, x_m: Floats, y_m: Floats) -> Bools:
        """Whether places about the middle of a template lie on the uncovered side of an edge."""
        direction, offset = divmod(edge, len(OFFSETS))
        reach_m = OFFSETS[offset] * self.radius_m[template]
        return along_edge(x_m, y_m, direction) <= reach_m


class _Grid(NamedTuple):
    """Places about the middle of a template, shapes (side, side)."""

    x_m: Floats
    """Away from the sonar."""
    y_m: Floats
    away_m: Floats
    """From the middle."""
    material_m: float
    """Reach of the largest design."""
    cell_m: float
    is_explained: Bools
    """Within `REACH_M` of the largest design, or `SHADOW_M` behind it."""

    @classmethod
    def of(cls, designs: Sequence[LandmarkDesign], cell_m: float) -> _Grid:
        x_m, y_m, away_m, material_m = places_around(designs, SHADOW_M, cell_m)
        is_around = away_m <= material_m + REACH_M
        # within 60 degrees of the direction away from the sonar, where a shadow falls
        is_behind = (away_m <= material_m + SHADOW_M) & (x_m > 0.5 * away_m)
        return cls(x_m, y_m, away_m, material_m, cell_m, is_around | is_behind)


def _figure(
    design: LandmarkDesign,
    heading_rad: float,
    grid: _Grid,
    blur_m: Blur,
    patch_side: int,
) -> FigureOfTemplate:
    """Models for one design at one heading."""
    side = len(grid.x_m)
    parts = [
        drawn(design, heading_rad, side, grid.cell_m, blur_m, stretch)
        for stretch in STRETCHES
    ]
    # levels of figures are relative to the brightest part: beta takes the contrast
    brightest_db = float(np.nanmax(design.mask))
    darkest_db = min(float(np.nanmin(design.mask)), -1.0)
    figures = [bright / brightest_db for bright, _ in parts]
    figure = figures[0]
    dark = parts[0][1] / darkest_db
    has_dark = bool((dark > PART).any())
    # the design's own shadow is explained by nothing; a plate hides the part that falls on it
    own_shadow = behind(figure + dark, OWN_SHADOW_CELLS) > PART
    is_off_plate = (grid.away_m > grid.material_m) | (not has_dark)
    is_compared = grid.is_explained & ~(own_shadow & is_off_plate)
    shades = [behind(one, SHADOW_CELLS) for one in figures]
    exact = np.stack([np.ones_like(figure), dark, *figures, *shades])
    # the models are read in every fit; bytes fit into the cache of the processor
    steps = np.clip(np.rint(exact[:, is_compared].T / STEP), 0, 255)
    smooth = np.stack([cv2.blur(dark, (3, 3)), cv2.blur(figure, (3, 3))])
    # for a disc of radius r the second moment about its middle is r^2 / 2
    weights = np.maximum(figure, 0.0)
    second_moment_m2 = float(np.average(grid.away_m**2, weights=weights))
    radius_m = math.sqrt(2 * second_moment_m2)
    beyond_m = np.stack(
        [along_edge(grid.x_m, grid.y_m, one)[is_compared] for one in range(EDGES)], -1
    )
    uncovered = beyond_m[:, :, None] <= radius_m * np.array(OFFSETS)
    row, column = np.nonzero(is_compared)
    zones = _zones(figure, dark, is_compared)
    values = np.ascontiguousarray(steps.astype(np.uint8))
    is_uncovered = uncovered.reshape(len(row), -1).astype(np.uint8)
    # over all cells: a patch that is seen whole needs no sum over cells again
    in_steps = values.astype(float)
    return FigureOfTemplate(
        cells=(row * patch_side + column).astype(np.int32),
        values=values,
        smooth=np.ascontiguousarray(smooth[:, is_compared].T.astype(np.float32)),
        zones=zones[is_compared].astype(np.uint8),
        uncovered=is_uncovered,
        has_dark=has_dark,
        radius_m=radius_m,
        gram=float(STEP) ** 2 * (in_steps.T @ in_steps),
        kept=kept_sums(values, np.ones(len(row), np.float32), is_uncovered),
    )


def _zones(figure: Floats32, dark: Floats32, is_compared: Bools) -> Ints:
    """Zone of each cell about a figure, shape as given."""
    # dilation by a square of this side marks the cells within `NEAR_CELLS` of the figure
    kernel = np.ones((2 * NEAR_CELLS + 1, 2 * NEAR_CELLS + 1), np.uint8)
    is_out = (figure < OUT) & is_compared
    is_near = cv2.dilate((figure > PART).astype(np.uint8), kernel) > 0
    is_behind = behind(figure, BEHIND_CELLS) > PART
    near = NEAR * (is_out & is_near)
    back = BEHIND * (is_out & is_behind)
    # a plate belongs to the design, so its cells are no floor
    far = FAR * (is_out & ~is_near & (dark < OUT))
    return near + back + far


def _counts(independent: float) -> Floats:
    """By how much each piece of `Evidence` counts, shape (11,)."""
    counts = np.ones(len(EVIDENCE))
    for name in RATIOS_OF_SQUARES:
        counts[EVIDENCE.index(name)] = independent
    counts[EVIDENCE.index("plate")] = math.sqrt(independent)
    return counts


class View(NamedTuple):
    """Levels of a patch in the cells of one template, n of them."""

    level_db: Floats32
    """z less their mean, 0 where not seen, shape (n,)."""
    is_seen: Floats32
    """1 or 0, shape (n,)."""
    mean_db: np.float32
    cells: float
    """Number of the cells in view."""
    total: float
    """``z^T z``: what one level leaves."""


class Products(NamedTuple):
    """What least squares needs of a view."""

    gram: Floats
    """``values^T values`` over the cells in view, shape (2 + 2 figures, 2 + 2 figures)."""
    levels: Floats32
    """``values^T z``, shape (2 + 2 figures,)."""
    total: float
    """``z^T z``."""


class Left(NamedTuple):
    """What a model leaves."""

    squares: float
    """Sum of squares, R."""
    without_last: float
    """R without the last column."""
    levels: Floats
    """Levels of the columns, shape (4,)."""


class DesignFitted(NamedTuple):
    """Sums of squares R that the models of a design leave, and its levels."""

    plain: float
    """R(floor, B)."""
    design: float
    """R(design without S)."""
    shaded: float
    """R(floor, B, S)."""
    both: float
    """R(design)."""
    without_figure: float
    """R(floor, D), or R(floor) where D is not dark."""
    dark_product: float
    """Product of D, without its mean, and z."""
    floor_db: float
    beta: float
    delta: float


@compiled
def fill_evidence(
    figures: Figures,
    patch: Patch,
    template: Ints,
    cell: Ints,
    found: Floats,
    edge: Ints,
) -> bool:
    """Fill in `Evidence` of templates, of `rival` the logarithm for this design alone, shape (n, 11), and edges.

    False where too little is in view, or where it has one level.
    """
    for k in range(len(template)):
        # rows of this template in the arrays that hold all templates
        begin = figures.first[template[k]]
        end = figures.first[template[k] + 1]
        shift = cell[k, 0] * figures.patch_side + cell[k, 1]
        cells = figures.cells[begin:end] + shift
        values = figures.values[begin:end]
        uncovered = figures.uncovered[begin:end]
        view = viewed(patch, cells)
        # a few cells fit any figure
        if view.cells < LEAST_CELLS:
            return False
        # one level everywhere: every model is perfect, and all ratios are 0 / 0
        if view.total < LEAST_VARIANCE_DB2 * view.cells:
            return False
        products = products_in_view(figures.gram[template[k]], values, view)
        has_dark = figures.has_dark[template[k]]
        fit = design_fitted(products, view.cells, has_dark)
        other, other_without_shadow = otherwise(products, fit)
        smooth = figures.smooth[begin:end]
        zones = figures.zones[begin:end]
        near_db2, far_db2, behind_db = surroundings(
            patch, cells, view, fit, smooth, zones
        )
        kept = figures.kept[template[k]]
        # cut by the rim of the image: sums over all cells are too large
        if view.cells < len(cells):
            kept = kept_sums(values, view.is_seen, uncovered)
        covered, best_edge = least_covered(view, values, uncovered, kept, products, fit)
        # a figure darker than the floor is no figure of foam
        whole = fit.design if fit.beta > 0 else fit.without_figure
        cells_count = 0.5 * view.cells * figures.counts[COVERED]
        # log likelihood ratio of the covered figure against the whole one
        gain = cells_count * math.log(max(whole / covered, 1.0))
        # prior odds: 1/2 for the whole figure, 1/72 for each edge
        if gain > math.log(EDGES * len(OFFSETS)):
            edge[k] = best_edge
        left = min(covered, whole)
        sigma = math.sqrt(fit.design / view.cells)
        # gain of D, then gain of B: a plate without foam is another thing that lies there
        plate = math.log(fit.shaded / fit.both)
        foam = math.log(max(fit.without_figure, LEAST_LEFT_DB2) / fit.design)
        plate_and_foam = max(min(plate, foam), 0.0)
        pieces = Evidence(
            1.0,
            math.log(other / fit.both),
            math.log(other_without_shadow / fit.plain),
            math.log(max(fit.beta, LEAST_BETA_DB) / sigma),
            math.log(near_db2 + LEAST_DB2),
            math.log(far_db2 + LEAST_DB2),
            behind_db,
            math.sqrt(plate_and_foam) if fit.delta < 0 else 0.0,
            0.0 if has_dark else 1.0,
            math.log(left / view.total),
            math.log(max(fit.design / left, 1.0)),
        )
        for column in range(len(pieces)):
            found[k, column] = pieces[column]
    return True


@compiled
def viewed(patch: Patch, cells: Ints) -> View:
    """The levels of a patch in some cells."""
    level_db = patch.level_db.ravel()[cells]
    is_seen = patch.seen.ravel()[cells]
    count = float(np.dot(is_seen, is_seen))
    # the floor is one of the columns; without the mean, sums of squares lose fewer digits
    mean_db = np.float32(np.dot(level_db, is_seen) / max(count, 1.0))
    for n in range(len(cells)):
        level_db[n] = (level_db[n] - mean_db) * is_seen[n]
    total = float(np.dot(level_db, level_db))
    return View(level_db, is_seen, mean_db, count, total)


@compiled
def products_in_view(gram: Floats, values: Bytes, view: View) -> Products:
    """Products of the columns with each other and with the levels, without the cells that are not in view."""
    levels = products_of(view.level_db, values)
    in_view = gram.copy()
    for n in range(len(values)):
        if view.is_seen[n] == 0:
            for i in range(len(gram)):
                for j in range(len(gram)):
                    in_view[i, j] -= (STEP * values[n, i]) * (STEP * values[n, j])
    return Products(in_view, levels, view.total)


@compiled
def design_fitted(products: Products, count: float, has_dark: bool) -> DesignFitted:
    """The design: with its dark parts where they are dark, with and without a shadow."""
    gram = products.gram
    plain = least_squares(products, (FLOOR, FIGURE))
    design = plain.squares
    floor_db = plain.levels[0]
    beta = plain.levels[1]
    delta = 0.0
    if has_dark:
        # a plate that seems brighter than the floor is no plate: keep the fit without it
        with_dark = least_squares(products, (FLOOR, FIGURE, DARK))
        if with_dark.levels[2] < 0:
            design = with_dark.squares
            floor_db = with_dark.levels[0]
            beta = with_dark.levels[1]
            delta = with_dark.levels[2]
    # D without its mean, as the floor takes the mean
    dark_mean = gram[FLOOR, DARK] / count
    dark_product = products.levels[DARK] - dark_mean * products.levels[FLOOR]
    without_figure = products.total
    if delta < 0:
        dark_square = gram[DARK, DARK] - gram[FLOOR, DARK] ** 2 / count
        without_figure = products.total - dark_product**2 / dark_square
    # a shadow that is brighter than the floor is none
    with_shadow = least_squares(products, (FLOOR, FIGURE, SHADOW))
    shaded = with_shadow.squares if with_shadow.levels[2] < 0 else plain.squares
    both = min(design, shaded)
    # D and S overlap, and only together do they leave the least
    if delta < 0 and shaded < plain.squares:
        with_both = least_squares(products, (FLOOR, FIGURE, DARK, SHADOW))
        if with_both.levels[2] < 0 and with_both.levels[3] < 0:
            both = with_both.squares
    return DesignFitted(
        plain.squares, design, shaded, both, without_figure, dark_product, floor_db, beta, delta
    )  # fmt: skip


@compiled
def otherwise(products: Products, fit: DesignFitted) -> tuple[float, float]:
    """Least that any figure of `STRETCHES` leaves, with a shadow where it is dark, and without one."""
    squares = fit.shaded
    without_shadow = fit.plain
    for q in range(1, len(STRETCHES)):
        # one elimination gives both: S is the last column
        one = least_squares(products, (FLOOR, FIGURE + q, SHADOW + q))
        without_shadow = min(without_shadow, one.without_last)
        is_dark = one.levels[2] < 0
        squares = min(squares, one.squares if is_dark else one.without_last)
    return squares, without_shadow


@compiled
def surroundings(
    patch: Patch, cells: Ints, view: View, fit: DesignFitted, smooth: Floats32, zones: Bytes
) -> tuple[float, float, float]:  # fmt: skip
    """Mean squares of what is brighter than the design next to it and darker farther out, and the level behind it."""
    smooth_db = patch.smooth_db.ravel()
    held = patch.held.ravel()
    level_db = view.level_db
    is_seen = view.is_seen
    near = 0.0
    far = 0.0
    back = 0.0
    near_cells = 0
    far_cells = 0
    back_cells = 0
    for n in range(len(cells)):
        at = cells[n]
        # means over 3 by 3 cells that are mostly not seen are too noisy
        if zones[n] == 0 or held[at] <= 0.5:
            continue
        of_floor = smooth_db[at] - view.mean_db - fit.floor_db
        off_db = of_floor - fit.beta * smooth[n, 1] - fit.delta * smooth[n, 0]
        if zones[n] & NEAR:
            # only brighter: next to a landmark lies its shadow, and foam of other things
            near += max(off_db, 0.0) ** 2
            near_cells += 1
        if zones[n] & FAR:
            # only darker: farther out other objects may be bright
            far += min(off_db, 0.0) ** 2
            far_cells += 1
        if zones[n] & BEHIND and is_seen[n] > 0:
            back = back + level_db[n] - fit.floor_db
            back_cells += 1
    # of smooth speckle, where too few cells are in view
    speckle_db2 = fit.design / view.cells / 3
    return (
        near / near_cells if near_cells > 8 else speckle_db2,
        far / far_cells if far_cells > 8 else speckle_db2,
        back / back_cells if back_cells > 5 else 0.0,
    )


@compiled
def products_of(level: Floats32, values: Bytes) -> Floats32:
    """``values^T level``, values in `STEP`. Four cells at a time: a sum that waits for each takes twice as long."""
    found = np.zeros(values.shape[1], np.float32)
    last = len(level) // 4 * 4
    for n in range(0, last, 4):
        a = level[n]
        b = level[n + 1]
        c = level[n + 2]
        d = level[n + 3]
        for i in range(len(found)):
            found[i] += a * np.float32(values[n, i]) + b * np.float32(values[n + 1, i])
            found[i] += c * np.float32(values[n + 2, i]) + d * np.float32(
                values[n + 3, i]
            )
    for n in range(last, len(level)):
        for i in range(len(found)):
            found[i] += level[n] * np.float32(values[n, i])
    return found * STEP


@compiled
def kept_sums(values: Bytes, seen: Floats32, uncovered: Bytes) -> Floats:
    """Sums of b, b^2 and b D over the cells of a figure up to each edge, shape (edges, 3)."""
    kept = np.zeros((uncovered.shape[1], 3))
    for n in range(len(values)):
        b = STEP * values[n, FIGURE] * seen[n]
        if b > OUT:
            for edge in range(len(kept)):
                is_kept = uncovered[n, edge]
                kept[edge, 0] += b * is_kept
                kept[edge, 1] += b * b * is_kept
                kept[edge, 2] += b * (STEP * values[n, DARK]) * is_kept
    return kept


@compiled
def least_covered(
    view: View, values: Bytes, uncovered: Bytes, kept: Floats, products: Products, fit: DesignFitted
) -> tuple[float, int]:  # fmt: skip
    """Least sum of squares that a figure leaves when all of it beyond a straight edge is covered, and that edge.

    Edge -1: no part of the figure is brighter than the floor. The floor and D are taken out of the figure first: ``R =
    R(floor, D) - (b^T z)^2 / b^T b``.
    """
    bright = np.zeros(len(kept), np.float32)  # b^T z
    level_db = view.level_db
    for n in range(len(level_db)):
        b_n = STEP * values[n, FIGURE]
        if b_n > OUT:
            # cells outside of the figure add nothing to b^T z
            bz_n = b_n * level_db[n]
            for edge in range(len(bright)):
                bright[edge] += bz_n * np.float32(uncovered[n, edge])
    gram = products.gram
    dark_mean = gram[FLOOR, DARK] / view.cells
    # D^T D without the floor
    dd = gram[DARK, DARK] - gram[FLOOR, DARK] ** 2 / view.cells
    least = fit.without_figure
    best = -1
    for edge in range(len(kept)):
        b = kept[edge, 0]
        # take the floor, and then D, out of b (Frisch, Waugh 1933)
        bb = kept[edge, 1] - b**2 / view.cells
        bz = float(bright[edge])
        if fit.delta < 0:
            bd = kept[edge, 2] - b * dark_mean
            bb -= bd**2 / dd
            bz -= bd * fit.dark_product / dd
        if bb > 0 and bz > 0:
            left = fit.without_figure - bz**2 / bb
            if left < least:
                least = left
                best = edge
    return max(least, LEAST_LEFT_DB2), best


def along_edge(x_m: Floats, y_m: Floats, direction: int) -> Floats:
    """How far places lie in one of `EDGES` directions."""
    towards_rad = 2 * math.pi * direction / EDGES
    return x_m * math.cos(towards_rad) + y_m * math.sin(towards_rad)


@compiled
def least_squares(products: Products, columns: tuple[int, ...]) -> Left:
    """What some columns leave, by elimination: with ``G = L D L^T``, ``L y = g`` column i takes ``y_i^2 / D_i``."""
    n = len(columns)
    a = np.empty((n, n + 1))
    for i in range(n):
        for j in range(n):
            a[i, j] = products.gram[columns[i], columns[j]]
        # keeps the pivot positive where two columns are nearly the same
        a[i, i] += 1e-3
        a[i, n] = products.levels[columns[i]]
    left = products.total
    without_last = products.total
    for i in range(n):
        # the columns before the last one leave this much
        without_last = left
        left -= a[i, n] ** 2 / a[i, i]
        for k in range(i + 1, n):
            factor = a[k, i] / a[i, i]
            for j in range(i, n + 1):
                a[k, j] -= factor * a[i, j]
    levels = np.zeros(4)
    for i in range(n - 1, -1, -1):
        levels[i] = a[i, n] / a[i, i]
        for k in range(i):
            a[k, n] -= a[k, i] * levels[i]
    return Left(max(left, LEAST_LEFT_DB2), max(without_last, LEAST_LEFT_DB2), levels)


def behind(figure: Floats32, cells: int) -> Floats32:
    """Share of each cell that lies within so many cells behind a figure, and not in it, shape as given."""
    inside = np.minimum(figure, 1.0)  # the near side of foam is brighter than 1
    shaded = np.zeros_like(figure)
    for step in range(1, cells + 1):
        shaded[step:] = np.maximum(shaded[step:], inside[:-step])
    return np.clip(shaded - inside, 0.0, 1.0)
