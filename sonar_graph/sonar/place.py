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
from typing import NamedTuple

import numpy as np

from sonar_graph.devices import LandmarkDesign
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled
from sonar_graph.sonar.templates import (
    FINE,
    Blur,
    Floats32,
    echo_power,
    seen_db,
    seen_share,
    with_side,
)

SIDE_M = 0.006
"""Width of the side for which it is drawn, to a fine point."""
SHADE_FINE, LONGEST_SHADOW = FINE // 2, 12
"""Step of the lengths of shadows that are drawn, in points of the fine grid, and the longest one in such steps."""
STEPS = 2
"""Gauss-Newton steps from the best cell on."""
LEAST_BETA_DB, LEAST_CELLS = 0.05, 20


class Relief(NamedTuple):
    """A design at one heading, and what its height adds, on the grid of the templates, shapes (side, side)."""

    figure: Floats32
    """B, dB."""
    side: Floats32
    """W, dB for each metre of the face that the side covers."""
    dark: Floats32
    """D, dB."""
    shades: tuple[Floats32, Floats32]
    """Shares of the cells in a shadow of so many steps, and of one more."""

    @classmethod
    def of(
        cls,
        design: LandmarkDesign,
        heading_rad: float,
        side: int,
        cell_m: float,
        blur_m: Blur,
        shade_steps: int,
    ) -> Relief:
        """A design at this heading against the direction away from the sonar, which is the grid's x axis."""
        of_bright, power = echo_power(design, heading_rad, side, cell_m)
        is_bright = power > 1
        width = max(1, round(SIDE_M / cell_m * FINE))
        shaded, raised_power = is_bright.copy(), with_side(power, width)
        bright, whole, raised = (
            seen_db(one, cell_m, blur_m) for one in (of_bright, power, raised_power)
        )
        for _ in range(shade_steps * SHADE_FINE):
            shaded[1:] |= shaded[:-1]
        shorter = seen_share(shaded & ~is_bright, cell_m, blur_m)
        for _ in range(SHADE_FINE):
            shaded[1:] |= shaded[:-1]
        shades = shorter, seen_share(shaded & ~is_bright, cell_m, blur_m)
        return cls(
            bright, (raised - whole) / (width * cell_m / FINE), whole - bright, shades
        )

    def place(
        self,
        level_db: Floats32,
        seen: Floats32,
        cells: tuple[Ints, Ints],
        start: Floats,
        side_m: float,
        longer: float,
    ) -> tuple[Floats, Floats]:
        """Place of the first cell of the figure's square in a patch, and the bound of its standard deviation, in cells.

        Parameters
        ----------
        level_db, seen
            Of the patch, shapes (n, n).
        cells
            Rows and columns of the square that are compared.
        start
            Place at which to begin, shape (2,).
        side_m
            Width of the face that the side covers.
        longer
            Share of a step by which the shadow is longer than the first of `shades`.
        """
        place, bound = start.astype(float), np.full(2, np.inf)
        fit_place(
            level_db, seen, *cells, self.figure, self.side, self.dark, *self.shades, side_m, longer, place, bound
        )  # fmt: skip
        return place, bound


@compiled
def fit_place(
    level_db: Floats32, seen: Floats32, rows: Ints, columns: Ints, face: Floats32, side_of: Floats32, plate: Floats32,
    shorter: Floats32, longest: Floats32, side_m: float, longer: float, place: Floats, bound: Floats,
) -> None:  # fmt: skip
    """Move a place to the least squares, and fill in the Cramer-Rao bound of its standard deviations, in cells.

    Parts of the landmark, and their shadows, are those of `Relief`.

    ``M = [1, B, D, S, dz/dx, dz/dy]`` with ``dz/dp = -(beta grad B + delta grad D + gamma grad S)``; the bound is the
    root of the last two on the diagonal of ``s^2 (M^T M)^-1``, s^2 the mean square of what is left.
    """
    shade = shorter + np.float32(longer) * (longest - shorter)
    figure, dark = face + np.float32(side_m) * side_of, plate * (1 - shade)
    beta, delta, gamma = np.float32(0), np.float32(0), np.float32(0)
    last, count = len(level_db) - 1, np.float32(0)
    mean = np.float32(np.sum(level_db * seen) / max(np.sum(seen), 1.0))
    along, across, M = (
        np.zeros_like(figure),
        np.zeros_like(figure),
        np.empty((7, len(rows)), np.float32),
    )
    for step in range(STEPS + 1):
        size, x0, y0 = 4 if step == 0 else 6, round(place[0]), round(place[1])
        if step > 0:
            slopes(beta * figure + delta * dark + gamma * shade, along, across)
        for n in range(len(rows)):
            i, j = rows[n], columns[n]
            x, y = x0 + i, y0 + j
            if 0 <= x <= last and 0 <= y <= last and seen[x, y] > 0:
                M[0, n], M[1, n], M[2, n], M[3, n] = (
                    1,
                    figure[i, j],
                    dark[i, j],
                    shade[i, j],
                )
                M[4, n], M[5, n], M[6, n] = (
                    along[i, j],
                    across[i, j],
                    level_db[x, y] - mean,
                )
            else:
                M[:, n] = 0
        products = np.dot(M, M.T).astype(np.float64)
        count = products[0, 0]
        if count < LEAST_CELLS:
            return
        c, inverse = solved(products, size)
        beta, delta, gamma = (
            np.float32(max(c[1], LEAST_BETA_DB)),
            np.float32(max(c[2], 0)),
            np.float32(min(c[3], 0)),
        )
        if size == 6:
            variance = max(products[6, 6] - np.dot(c, products[6, :6]), 0.0) / count
            for a in range(2):
                place[a] = (x0, y0)[a] + min(max(c[4 + a], -1.0), 1.0)
                bound[a] = math.sqrt(variance * inverse[a])


@compiled
def slopes(picture: Floats32, along: Floats32, across: Floats32) -> None:
    """Fill in by how much a picture falls from cell to cell, along its rows and along its columns."""
    last = len(picture) - 1
    for i in range(last + 1):
        before, after = max(i - 1, 0), min(i + 1, last)
        for j in range(last + 1):
            along[i, j] = (picture[before, j] - picture[after, j]) / np.float32(
                after - before
            )
        for j in range(1, last):
            across[i, j] = (picture[i, j - 1] - picture[i, j + 1]) / np.float32(2)
        across[i, 0], across[i, last] = (
            picture[i, 0] - picture[i, 1],
            picture[i, last - 1] - picture[i, last],
        )


@compiled
def solved(products: Floats, size: int) -> tuple[Floats, tuple[float, float]]:
    """Solution of ``G c = g`` by elimination, and the last two on the diagonal of the inverse of G.

    G and g are the first ``size`` rows of the products, g their last column.
    """
    a, c, second = products.copy(), np.zeros(size), 0.0
    for i in range(size):
        a[i, i] += 1e-6
    for i in range(size - 1):
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
    return c, (
        second / (a[size - 2, size - 2] * a[size - 1, size - 1]),
        1 / a[size - 1, size - 1],
    )
