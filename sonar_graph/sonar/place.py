"""Place of a landmark in a patch, to a fraction of a cell: least squares of its figure, with the relief that it has.

Foam stands over the plate, or over the floor, by t. A sonar at a height h and a distance d meets the top of its near
side first: the side is laid over the first ``t h / d`` of the face, in the plane of the face, and makes it brighter.
Behind the far edge ``t (d / h + h / d)`` are dark. Without both a fit comes out too near by some 5 mm. With B the
figure, W what its side adds for each metre, D its dark parts, S its shadow and p its place::

    z = floor + beta (B + t h / d W) + delta D (1 - S) + gamma S + e

all but the floor shifted by p. Gauss-Newton: beta, delta, gamma and p are solved for together, with the slopes of the
figures at the levels before. Derivation: docs/theory/recognition.md.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sonar_graph.devices import LandmarkDesign
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled
from sonar_graph.sonar.templates import (
    FINE,
    Blur,
    Floats32,
    Patch,
    echo_power,
    seen_db,
    seen_share,
    with_side,
)

SIDE_M = 0.006
"""Width of the side for which it is drawn, to a fine point."""
SHADE_FINE = FINE // 2
"""Step of the lengths of shadows that are drawn, in points of the fine grid."""
LONGEST_SHADOW = 12
"""In such steps."""
MOST_RELIEFS = 2048
"""Drawings that are kept, some 25 kB each."""
STEPS = 2
"""Gauss-Newton steps from the best cell on."""
LEAST_BETA_DB = 0.05
LEAST_CELLS = 20


class Grid(NamedTuple):
    """Grid on which a design is drawn, and the resolution of the sonar on the floor."""

    side: int
    """Cells along its side."""
    cell_m: float
    blur_m: Blur


class Lit(NamedTuple):
    """What the height of a design adds as the sonar lights it from the side."""

    side_m: float
    """Width of the face that the near side covers."""
    longer: float
    """Share of a step by which the shadow is longer than `Relief.shorter`."""


class Relief(NamedTuple):
    """A design at one heading, and what its height adds, on the grid of the templates, shapes (side, side)."""

    figure: Floats32
    """B, dB."""
    side: Floats32
    """W, dB for each metre of the face that the side covers."""
    dark: Floats32
    """D, dB."""
    shorter: Floats32
    """Shares of the cells in a shadow of so many steps."""
    longer: Floats32
    """The same of one step more."""

    @classmethod
    @lru_cache(maxsize=MOST_RELIEFS)
    def of(
        cls, design: LandmarkDesign, heading_rad: float, grid: Grid, shade_steps: int
    ) -> Relief:
        """A design at this heading against the direction away from the sonar, which is the grid's x axis."""
        of_bright, power = echo_power(design, heading_rad, grid.side, grid.cell_m)
        is_bright = power > 1
        # W is a difference quotient: a side of this width, over its width
        width = max(1, round(SIDE_M / grid.cell_m * FINE))
        bright_db, whole_db, raised_db = (
            seen_db(one, grid.cell_m, grid.blur_m)
            for one in (of_bright, power, with_side(power, width))
        )
        is_shaded = is_bright.copy()
        # a shadow grows away from the sonar, along the first axis
        for _ in range(shade_steps * SHADE_FINE):
            is_shaded[1:] |= is_shaded[:-1]
        shorter = seen_share(is_shaded & ~is_bright, grid.cell_m, grid.blur_m)
        # one step longer, between which lengths are interpolated
        for _ in range(SHADE_FINE):
            is_shaded[1:] |= is_shaded[:-1]
        return cls(
            figure=bright_db,
            side=(raised_db - whole_db) / (width * grid.cell_m / FINE),
            dark=whole_db - bright_db,
            shorter=shorter,
            longer=seen_share(is_shaded & ~is_bright, grid.cell_m, grid.blur_m),
        )


@compiled
def fit_place(
    relief: Relief,
    patch: Patch,
    cells: tuple[Ints, Ints],
    start: Floats,
    lit: Lit,
) -> tuple[Floats, Floats]:
    """Place of the first cell of the figure's square in a patch, and the Cramer-Rao bound of its sigmas, in cells.

    By least squares over the cells of the square (rows, columns), from a place (2,) on. ``M = [1, B, D, S, dz/dx,
    dz/dy]`` with ``dz/dp = -(beta grad B + delta grad D + gamma grad S)``; the bound is the root of the last two on the
    diagonal of ``s^2 (M^T M)^-1``, s^2 the mean square of what is left.
    """
    place = start.copy()
    bound = np.full(2, np.inf)
    # the near side and the shadow as the sonar lights them from here
    S = relief.shorter + np.float32(lit.longer) * (relief.longer - relief.shorter)
    B = relief.figure + np.float32(lit.side_m) * relief.side
    D = relief.dark * (1 - S)
    beta = np.float32(0)
    delta = np.float32(0)
    gamma = np.float32(0)
    along = np.zeros_like(B)
    across = np.zeros_like(B)
    seen_cells = max(np.sum(patch.seen), 1.0)
    # single precision loses less without the mean
    mean_db = np.float32(np.sum(patch.level_db * patch.seen) / seen_cells)
    level_db = patch.level_db
    seen = patch.seen
    rows, columns = cells
    last = len(level_db) - 1
    M = np.empty((7, len(rows)), np.float32)
    for step in range(STEPS + 1):
        size = 4 if step == 0 else 6  # the levels alone at first: slopes need them
        # figures are shifted by whole cells; their slopes carry the rest
        x0 = round(place[0])
        y0 = round(place[1])
        if step > 0:
            slopes(beta * B + delta * D + gamma * S, along, across)
        for n in range(len(rows)):
            i = rows[n]
            j = columns[n]
            x = x0 + i
            y = y0 + j
            if 0 <= x <= last and 0 <= y <= last and seen[x, y] > 0:
                M[0, n] = 1
                M[1, n] = B[i, j]
                M[2, n] = D[i, j]
                M[3, n] = S[i, j]
                M[4, n] = along[i, j]
                M[5, n] = across[i, j]
                M[6, n] = level_db[x, y] - mean_db
            else:
                # a cell out of view has no weight
                M[:, n] = 0
        # rows of M are the columns of the model and z: one product gives G and g
        products = np.dot(M, M.T).astype(np.float64)
        count = products[0, 0]
        if count < LEAST_CELLS:
            break
        c, inverse = solved(products, size)
        # with no contrast the slopes vanish, and the place is free
        beta = np.float32(max(c[1], LEAST_BETA_DB))
        delta = np.float32(max(c[2], 0))
        gamma = np.float32(min(c[3], 0))
        if size == 6:
            # R = z^T z - c^T g
            left = products[6, 6] - np.dot(c, products[6, :6])
            variance = max(left, 0.0) / count
            # slopes are of neighbouring cells: beyond one cell they mislead
            place[0] = x0 + min(max(c[4], -1.0), 1.0)
            place[1] = y0 + min(max(c[5], -1.0), 1.0)
            bound[0] = math.sqrt(variance * inverse[0])
            bound[1] = math.sqrt(variance * inverse[1])
    return place, bound


@compiled
def slopes(picture: Floats32, along: Floats32, across: Floats32) -> None:
    """Fill in by how much a picture falls from cell to cell, along its rows and along its columns."""
    last = len(picture) - 1
    for i in range(last + 1):
        before = max(i - 1, 0)
        after = min(i + 1, last)
        cells = np.float32(after - before)
        for j in range(last + 1):
            along[i, j] = (picture[before, j] - picture[after, j]) / cells
        for j in range(1, last):
            across[i, j] = (picture[i, j - 1] - picture[i, j + 1]) / np.float32(2)
        across[i, 0] = picture[i, 0] - picture[i, 1]
        across[i, last] = picture[i, last - 1] - picture[i, last]


@compiled
def solved(products: Floats, size: int) -> tuple[Floats, tuple[float, float]]:
    """Solution of ``G c = g`` by elimination, and the last two on the diagonal of the inverse of G.

    G and g are the first ``size`` rows of the products, g their last column.
    """
    a = products.copy()
    c = np.zeros(size)
    second = 0.0
    for i in range(size):
        # keeps pivots positive without a shadow or dark parts, whose columns are 0
        a[i, i] += 1e-6
    for i in range(size - 1):
        # for a 2 by 2 block with pivots d1, d2 the inverse has the diagonal s / (d1 d2) and 1 / d2, s the
        # element before its elimination
        if i == size - 2:
            second = a[i + 1, i + 1]
        for k in range(i + 1, size):
            factor = a[k, i] / a[i, i]
            for j in range(i, 7):
                a[k, j] -= factor * a[i, j]
    for i in range(size - 1, -1, -1):
        c[i] = a[i, 6]
        for j in range(i + 1, size):
            c[i] -= a[i, j] * c[j]
        c[i] /= a[i, i]
    d_before_last = a[size - 2, size - 2]
    d_last = a[size - 1, size - 1]
    return c, (second / (d_before_last * d_last), 1 / d_last)
