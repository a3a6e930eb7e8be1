"""What speaks for a design at its best place, against anything else that may lie on the floor.

A patch is explained by figures with unknown levels. With B the bright parts of a design at its heading (its figure), D
its dark parts, B_q the figure stretched by `STRETCHES`, S and S_q the floor behind a figure, which something tall would
shade, and e the residual::

    design      z = floor + beta B + delta D + gamma S + e        delta <= 0, gamma <= 0
    otherwise   z = floor + beta B_q + gamma S_q + e              gamma <= 0, the best q
    covered     z = floor + beta B H + delta D + e                the best H, or 1

H is 1 on one side of a straight edge and 0 beyond it, where sediment or weed lies: `EDGES` directions, `OFFSETS` from
the middle. No level is given, so that neither gain nor contrast nor a plate that cannot be seen makes a fit bad. R is
the sum of squares that a model leaves, and sigma^2 the mean square of `design` without S. `EVIDENCE` names what comes
of it, the columns of `Figures.evidence`. Of Gaussian e a likelihood ratio is ``n / 2 ln R' / R`` with n independent
cells: logarithms of ratios count by the share of cells that are independent. How much each column counts is measured
(`Confusion.weights`). Derivation: docs/theory/recognition.md.
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
    material_radius_m,
)

Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
EVIDENCE = (
    "prior",
    "outline",
    "figure",
    "contrast",
    "beyond",
    "floor",
    "behind",
    "plate",
    "bare",
    "rival",
    "covered",
)
"""prior: 1; outline: ln R(otherwise) / R(design); figure: the same without S and D; contrast: ln beta / sigma; beyond:
ln mean square of what is brighter than the design says, next to the figure; floor: ln mean square of what is darker,
farther out; behind: level next to the figure on its far side, dB; plate: root of ln R(without D) / R(design), or of ln
R(without B) / R(design) where that is less, since a plate alone is none; bare: 1 for a design without dark parts, which
no plate can speak for; rival: ln of the least R(covered) of all designs over that of this one, as shares of what one
level leaves; covered: ln R(design without S) / R(covered)."""
POWER_OF_CELLS = np.array(
    [
        1.0 if name in ("outline", "figure", "rival", "covered") else 0.0
        for name in EVIDENCE
    ]
)
POWER_OF_CELLS[EVIDENCE.index("plate")] = 0.5
"""Power of the share of independent cells by which columns count: logarithms of ratios of two R, and a root of one."""
COVERED = EVIDENCE.index("covered")
HALF_POWER = 2 * math.sqrt(2 * math.log(2))
"""Width at half of the power over the standard deviation."""
STRETCHES = (
    *(
        (1.0, 1.0),
        (0.78, 0.78),
        (0.87, 0.87),
        (0.94, 0.94),
        (1.07, 1.07),
        (1.15, 1.15),
        (1.27, 1.27),
    ),
    *((1.2, 0.83), (0.83, 1.2)),
)
"""Of the figures of what is no landmark, along the design's axes x and y; the first is the design's own."""
EDGES, OFFSETS = 12, (0.15, 0.4, 0.65)
"""Edges of what covers a part of a figure: directions, and distances from its middle, in radii of the disc that has the
figure's second moment."""
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
STEP = np.float32(1 / 64)
"""In which models are kept, as bytes: a fit reads thousands of cells, and memory is what it waits for."""
OUT, PART = 0.12, 0.5
"""Shares of a cell in a figure: up to the first it lies outside, from the second on inside."""
NEAR, BEHIND, FAR = 1, 2, 4
"""Zones of the floor; a cell may lie in more than one."""


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
    """By how much each column of `EVIDENCE` counts, shape (11,)."""

    @classmethod
    def of(
        cls,
        designs: Sequence[LandmarkDesign],
        templates: Templates,
        blur_m: Blur,
        last: int,
    ) -> Figures:
        """Models of designs at the headings of their templates, for places 0 to ``last`` along each axis."""
        cell_m, material_m = templates.cell_m, max(map(material_radius_m, designs))
        half = math.ceil((material_m + SHADOW_M) / cell_m)
        side = 2 * half + 1
        x_m, y_m = np.meshgrid(
            *2 * [cell_m * np.arange(-half, half + 1)], indexing="ij"
        )
        away_m = np.hypot(x_m, y_m)
        area = (away_m <= material_m + REACH_M) | (
            (away_m <= material_m + SHADOW_M) & (x_m > 0.5 * away_m)
        )
        kernel = np.ones((2 * NEAR_CELLS + 1, 2 * NEAR_CELLS + 1), np.uint8)
        beyond_m = np.stack(
            [along_edge(x_m, y_m, edge) for edge in range(EDGES)], axis=-1
        )
        columns = []
        for index, heading in zip(
            templates.design.tolist(), templates.heading_rad.tolist(), strict=True
        ):
            design = designs[index]
            parts = [
                drawn(design, heading, side, cell_m, blur_m, stretch)
                for stretch in STRETCHES
            ]
            figures = [bright / float(np.nanmax(design.mask)) for bright, _ in parts]
            figure, dark = (
                figures[0],
                parts[0][1] / min(float(np.nanmin(design.mask)), -1.0),
            )
            has_dark = bool((dark > PART).any())
            own_shadow = behind(figure + dark, OWN_SHADOW_CELLS) > PART
            compared = area & ~(own_shadow & ((away_m > material_m) | (not has_dark)))
            is_out = (figure < OUT) & compared
            is_near = cv2.dilate((figure > PART).astype(np.uint8), kernel) > 0
            zones = NEAR * (is_out & is_near) + BEHIND * (
                is_out & (behind(figure, BEHIND_CELLS) > PART)
            )
            zones += FAR * (is_out & ~is_near & (dark < OUT))
            shades = [behind(one, SHADOW_CELLS) for one in figures]
            exact = np.stack([np.ones_like(figure), dark, *figures, *shades])[
                :, compared
            ].T
            values = np.clip(np.rint(exact / STEP), 0, 255).astype(np.uint8)
            smooth = np.stack([cv2.blur(dark, (3, 3)), cv2.blur(figure, (3, 3))])[
                :, compared
            ].T.astype(np.float32)
            kept, in_steps = np.empty((EDGES * len(OFFSETS), 3)), values.astype(float)
            gram = float(STEP) ** 2 * (in_steps.T @ in_steps)
            x, y = np.nonzero(compared)
            radius_m = math.sqrt(
                2 * float(np.average(away_m**2, weights=np.maximum(figure, 0.0)))
            )
            uncovered = beyond_m[compared][:, :, None] <= radius_m * np.array(OFFSETS)
            at = (x * (side + last) + y).astype(np.int32)
            own = (
                at,
                values,
                smooth,
                zones[compared].astype(np.uint8),
                uncovered.reshape(len(at), -1).astype(np.uint8),
            )
            kept_sums(values, np.ones(len(values), np.float32), own[-1], kept)
            columns.append((*own, gram, has_dark, kept, radius_m))
        *rows, grams, darks, sums, radii_m = zip(*columns, strict=True)
        first = np.cumsum([0, *map(len, rows[0])])
        cells, values, smooth, zones, uncovered = (
            np.ascontiguousarray(np.concatenate(of)) for of in rows
        )
        independent = math.prod(
            min(cell_m / (HALF_POWER * blur), 1.0) for blur in blur_m
        )
        of_templates = (
            np.array(grams),
            np.array(darks),
            uncovered,
            np.array(sums),
            np.array(radii_m),
        )
        counts = independent**POWER_OF_CELLS
        return cls(
            side + last,
            first,
            cells,
            values,
            smooth,
            zones,
            *of_templates,
            independent,
            counts,
        )

    def evidence(
        self, patch: Patch, template: Ints, cell: Ints
    ) -> tuple[Floats, Ints] | None:
        """`EVIDENCE` of templates on the parts of a patch that begin at some cells, and the edges that cover them.

        Shapes (n,), (n, 2), (n, 11) and (n,). None where too little of one is in view, or where it has one level. An
        edge is numbered by direction and offset; -1: the whole figure is at least as probable as that with the best
        edge, with prior probabilities of 1/2 for the whole and 1/72 for each of 36 edges.
        """
        found, edge = (
            np.empty((len(template), len(EVIDENCE))),
            np.full(len(template), -1),
        )
        is_measured = fill_evidence(
            patch.level_db.ravel(), patch.seen.ravel(), patch.smooth_db.ravel(), patch.held.ravel(), self.patch_side,
            self.first, self.cells, self.values, self.smooth, self.zones, self.gram, self.has_dark, self.uncovered,
            self.kept, self.counts, template, cell, found, edge,
        )  # fmt: skip
        return (found, edge) if is_measured else None

    def is_kept(self, template: int, edge: int, x_m: Floats, y_m: Floats) -> Bools:
        """Whether places about the middle of a template lie on the uncovered side of an edge."""
        direction, offset = divmod(edge, len(OFFSETS))
        return np.asarray(
            along_edge(x_m, y_m, direction) <= OFFSETS[offset] * self.radius_m[template]
        )


@compiled
def fill_evidence(
    level_db: Floats32, seen: Floats32, smooth_db: Floats32, held: Floats32, side: int,
    first_of: Ints, all_cells: NDArray[np.int32], all_values: Bytes, all_smooth: Floats32, all_zones: Bytes,
    grams: Floats, has_dark: Bools, all_uncovered: Bytes, all_kept: Floats, counts: Floats, template: Ints, cell: Ints,
    found: Floats, edge: Ints,
) -> bool:  # fmt: skip
    """Fill in `EVIDENCE` of templates on the parts of a patch that begin at some cells, shape (n, 11), and edges.

    A patch comes row by row, each ``side`` cells; what is known of templates as in `Figures`. False where too little is
    in view, or where it has one level.
    """
    least = np.inf
    for k in range(len(template)):
        begin, end, shift = (
            first_of[template[k]],
            first_of[template[k] + 1],
            cell[k, 0] * side + cell[k, 1],
        )
        cells, values, rows = all_cells[begin:end], all_values[begin:end], end - begin
        smooth, zones = all_smooth[begin:end], all_zones[begin:end]
        level, is_seen = np.empty(rows, np.float32), np.empty(rows, np.float32)
        for n in range(rows):
            level[n], is_seen[n] = level_db[cells[n] + shift], seen[cells[n] + shift]
        count = float(np.dot(is_seen, is_seen))
        if count < LEAST_CELLS:
            return False
        mean = np.float32(np.dot(level, is_seen) / count)
        for n in range(rows):
            level[n] = (level[n] - mean) * is_seen[n]
        total = float(np.dot(level, level))
        if total < LEAST_VARIANCE_DB2 * count:
            return False
        # products of the columns with each other and with the levels
        gram, products = grams[template[k]].copy(), products_of(level, values)
        for n in range(rows if count < rows else 0):
            if is_seen[n] == 0:
                for i in range(len(gram)):
                    for j in range(len(gram)):
                        gram[i, j] -= (STEP * values[n, i]) * (STEP * values[n, j])
        c, work, dark, first, kinds = (
            np.zeros(4),
            np.empty((4, 5)),
            1,
            2,
            (len(products) - 2) // 2,
        )
        # the design: with its dark parts where they are dark, with and without a shadow
        plain, _ = least_squares(gram, products, total, (0, first), c, work)
        design, floor, beta, delta = plain, c[0], c[1], 0.0
        if has_dark[template[k]]:
            with_dark, _ = least_squares(
                gram, products, total, (0, first, dark), c, work
            )
            if c[2] < 0:
                design, floor, beta, delta = with_dark, c[0], c[1], c[2]
        dz = products[dark] - gram[0, dark] / count * products[0]
        only_dark = total - (
            dz**2 / (gram[dark, dark] - gram[0, dark] ** 2 / count)
            if delta < 0
            else 0.0
        )
        shaded, _ = least_squares(
            gram, products, total, (0, first, first + kinds), c, work
        )
        shaded = shaded if c[2] < 0 else plain
        both = min(design, shaded)
        if delta < 0 and shaded < plain:
            with_both, _ = least_squares(
                gram, products, total, (0, first, dark, first + kinds), c, work
            )
            both = with_both if c[2] < 0 and c[3] < 0 else both
        # otherwise: the best of all figures
        other, other_plain = shaded, plain
        for q in range(first + 1, first + kinds):
            shaded_q, plain_q = least_squares(
                gram, products, total, (0, q, q + kinds), c, work
            )
            other_plain = min(other_plain, plain_q)
            other = min(other, shaded_q if c[2] < 0 else plain_q)
        # what is left next to the figure, farther out, and behind
        mean_square = design / count
        near, near_cells, far, far_cells, back, back_cells = 0.0, 0, 0.0, 0, 0.0, 0
        for n in range(rows):
            at = cells[n] + shift
            if zones[n] == 0 or held[at] <= 0.5:
                continue
            off = (
                smooth_db[at]
                - mean
                - floor
                - beta * smooth[n, 1]
                - delta * smooth[n, 0]
            )
            if zones[n] & NEAR:
                near, near_cells = near + max(off, 0.0) ** 2, near_cells + 1
            if zones[n] & FAR:
                far, far_cells = far + min(off, 0.0) ** 2, far_cells + 1
            if zones[n] & BEHIND and is_seen[n] > 0:
                back, back_cells = back + level[n] - floor, back_cells + 1
        found[k, 0] = 1.0
        found[k, 1] = math.log(other / both)
        found[k, 2] = math.log(other_plain / plain)
        found[k, 3] = math.log(max(beta, LEAST_BETA_DB) / math.sqrt(mean_square))
        found[k, 4] = math.log(
            (near / near_cells if near_cells > 8 else mean_square / 3) + LEAST_DB2
        )
        found[k, 5] = math.log(
            (far / far_cells if far_cells > 8 else mean_square / 3) + LEAST_DB2
        )
        found[k, 6] = back / back_cells if back_cells > 5 else 0.0
        plate, foam = math.log(shaded / both), math.log(max(only_dark, 1e-3) / design)
        found[k, 7] = math.sqrt(max(min(plate, foam), 0.0)) if delta < 0 else 0.0
        found[k, 8] = 0.0 if has_dark[template[k]] else 1.0
        uncovered, kept = all_uncovered[begin:end], all_kept[template[k]]
        if count < rows:
            kept = np.empty(kept.shape)
            kept_sums(values, is_seen, uncovered, kept)
        whole = design if beta > 0 else only_dark
        covered, best = least_covered(
            level, values, uncovered, kept, count, gram, only_dark, dz, delta < 0
        )
        if 0.5 * count * counts[COVERED] * math.log(
            max(whole / covered, 1.0)
        ) > math.log(EDGES * len(OFFSETS)):
            edge[k] = best
        covered = min(covered, whole)
        found[k, 9], found[k, 10] = (
            math.log(covered / total),
            math.log(max(design / covered, 1.0)),
        )
        least = min(least, found[k, 9])
    for k in range(len(template)):
        found[k, 9] = least - found[k, 9]
        found[k] *= counts
    return True


@compiled
def products_of(level: Floats32, values: Bytes) -> Floats32:
    """``values^T level``, values in `STEP`. Four cells at a time: a sum that waits for each takes twice as long."""
    found, last = np.zeros(values.shape[1], np.float32), len(level) // 4 * 4
    for n in range(0, last, 4):
        a, b, c, d = level[n], level[n + 1], level[n + 2], level[n + 3]
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
def kept_sums(values: Bytes, seen: Floats32, uncovered: Bytes, kept: Floats) -> None:
    """Fill in sums of b, b^2 and b D over the cells of a figure up to each edge, shape (edges, 3)."""
    kept[:] = 0.0
    for n in range(len(values)):
        b = STEP * values[n, 2] * seen[n]
        if b > OUT:
            for edge in range(len(kept)):
                is_kept = uncovered[n, edge]
                kept[edge, 0] += b * is_kept
                kept[edge, 1] += b * b * is_kept
                kept[edge, 2] += b * (STEP * values[n, 1]) * is_kept


@compiled
def least_covered(
    level: Floats32, values: Bytes, uncovered: Bytes, kept: Floats, count: float, gram: Floats,
    only_dark: float, dz: float, has_dark: bool,
) -> tuple[float, int]:  # fmt: skip
    """Least sum of squares that a figure leaves of which all beyond a straight edge is covered, and that edge.

    With D or without; edge -1: no part of the figure is brighter than the floor. The floor and D are taken out of the
    figure first: ``R = R(floor, D) - (b^T z)^2 / b^T b``. ``only_dark`` is R(floor, D), ``dz`` the product of D,
    without its mean, and z.
    """
    products = np.zeros(len(kept), np.float32)
    for n in range(len(level)):
        b_n = STEP * values[n, 2]
        if b_n > OUT:
            bz_n = b_n * level[n]
            for edge in range(len(products)):
                products[edge] += bz_n * np.float32(uncovered[n, edge])
    dark_mean, dd, least, best = (
        gram[0, 1] / count,
        gram[1, 1] - gram[0, 1] ** 2 / count,
        only_dark,
        -1,
    )
    for edge in range(len(kept)):
        b, bb, bz = (
            kept[edge, 0],
            kept[edge, 1] - kept[edge, 0] ** 2 / count,
            float(products[edge]),
        )
        if has_dark:
            bd = kept[edge, 2] - b * dark_mean
            bb, bz = bb - bd**2 / dd, bz - bd * dz / dd
        if bb > 0 and bz > 0 and only_dark - bz**2 / bb < least:
            least, best = only_dark - bz**2 / bb, edge
    return max(least, 1e-3), best


def along_edge(x_m: Floats, y_m: Floats, direction: int) -> Floats:
    """How far places lie in one of `EDGES` directions."""
    towards_rad = 2 * math.pi * direction / EDGES
    return np.asarray(x_m * math.cos(towards_rad) + y_m * math.sin(towards_rad))


@compiled
def least_squares(
    gram: Floats,
    products: Floats32,
    total: float,
    at: tuple[int, ...],
    c: Floats,
    a: Floats,
) -> tuple[float, float]:
    """Sums of squares that the columns ``at`` leave, all of them and all but the last; fills in coefficients of all.

    ``a`` is room to work in, shape (4, 5). By elimination: with ``G = L D L^T`` and ``L y = products`` column i takes
    ``y_i^2 / D_i``.
    """
    n, left, before = len(at), total, total
    for i in range(n):
        for j in range(n):
            a[i, j] = gram[at[i], at[j]]
        a[i, i] += 1e-3
        a[i, n] = products[at[i]]
    for i in range(n):
        before, left = left, left - a[i, n] ** 2 / a[i, i]
        for k in range(i + 1, n):
            factor = a[k, i] / a[i, i]
            for j in range(i, n + 1):
                a[k, j] -= factor * a[i, j]
    for i in range(n - 1, -1, -1):
        c[i] = a[i, n] / a[i, i]
        for k in range(i):
            a[k, n] -= a[k, i] * c[i]
    return max(left, 1e-3), max(before, 1e-3)


def behind(figure: Floats32, cells: int) -> Floats32:
    """Share of each cell that lies within so many cells behind a figure, and not in it, shape as given."""
    # the near side of foam is brighter than 1
    inside, shaded = (
        np.minimum(figure, 1.0),
        np.zeros_like(figure),
    )
    for step in range(1, cells + 1):
        shaded[step:] = np.maximum(shaded[step:], inside[:-step])
    return np.clip(shaded - inside, 0.0, 1.0)
