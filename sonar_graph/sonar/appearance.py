"""Appearance of candidates: best place and heading of every design in the image around them, and what speaks for it.

The image is sampled on a square grid of the floor, where foreshortening and the shape of the fan drop out; its x axis
points away from the sonar, along the line of sight. Designs are templates on the same grid
(`sonar_graph.sonar.templates`), and the correlation with them finds place and heading. What speaks for a design there,
against anything else, is `sonar_graph.sonar.evidence`. Derivation: docs/theory/recognition.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

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
from sonar_graph.sonar.place import LONGEST_SHADOW, SHADE_FINE, Relief
from sonar_graph.sonar.regions import Candidates
from sonar_graph.sonar.templates import (
    ASSUMED_SLOPE,
    BLUR_RATIO,
    FINE,
    HEADINGS,
    Blur,
    Floats32,
    Patch,
    PolarGrid,
    Templates,
    middle_m,
)

HEADING_SIGMA_RAD = 2 * math.pi / HEADINGS / math.sqrt(3)
"""Standard deviation of a heading, which is known to one step of the templates' headings to either side."""
COARSE = 2
"""Cells between the places from which the search climbs to the best one."""
MOST_MULTIPLICATIONS = 250_000
"""OpenBLAS uses several cores from 262,144 on; threads that wait cost more than so small a product."""


class AppearanceParams(Section):
    """Settings of the comparison with designs."""

    cell_m: float = Field(0.015, gt=0)
    """Distance of the samples on the floor."""
    margin_m: float = Field(0.03, ge=0)
    """Width of the compared ring of floor around the largest design."""
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
    """What speaks for each design, in the columns of `sonar_graph.sonar.evidence.EVIDENCE`, shape (designs, 11)."""
    visible: float
    """Share of the cells in view at the best fit of all."""
    heading_rad: Floats
    """Heading of each design's x axis against the floor's, shape (designs,)."""
    centre_m: Floats
    """(x, y) of each design's centre on the floor where it correlates best, shape (designs, 2)."""
    template: Ints
    """Row of each design's template in `Templates`, shape (designs,)."""
    edge: Ints
    """Edge beyond which each design seems covered (`Figures.evidence`), -1: none, shape (designs,)."""


class Search(NamedTuple):
    """Templates whose best place in a patch is searched for."""

    cells: Ints
    """Cells that are compared, in a patch row by row, with the templates at their first place, shape (cells,)."""
    pictures: Floats32
    """The templates there, shape (templates, cells)."""
    squares: Floats32
    """Their squares, shape (templates, cells)."""
    sums: Floats32
    """Sums of both, shape (2, templates)."""
    first: Ints
    """First template of each design, and their number, shape (designs + 1,)."""
    row: Ints
    """Number of each place, one a cell along x and y; first those from which the search climbs. Shape (n, n)."""


class Appearance:
    """Comparison of patches with the templates of designs, as a sonar of one resolution sees them."""

    def __init__(
        self,
        designs: Sequence[LandmarkDesign],
        blur_m: Blur,
        params: AppearanceParams | None = None,
    ) -> None:
        self.params = params or AppearanceParams()
        self.templates = templates = Templates.of(
            designs, self.params.cell_m, self.params.margin_m, blur_m
        )
        self.designs = len(designs)
        self._steps = math.ceil(self.params.search_m / self.params.cell_m)
        self.figures = Figures.of(designs, templates, blur_m, 2 * self._steps)
        self.patch_side = self.figures.patch_side
        self._rim = (self.patch_side - templates.side) // 2 - self._steps
        self._designs, self._blur_m = tuple(designs), blur_m
        drawn = zip(
            templates.design.tolist(), templates.heading_rad.tolist(), strict=True
        )
        self._to_middle_m = np.array(
            [middle_m(designs[index], heading_rad) for index, heading_rad in drawn]
        )
        self._compared = x, y = np.divmod(templates.cells, templates.side)
        self._reliefs: dict[tuple[int, int], Relief] = {}
        pictures = templates.pictures
        self._search = Search(
            (x + self._rim) * self.patch_side + y + self._rim,
            pictures,
            pictures**2,
            np.stack([pictures.sum(axis=1), (pictures**2).sum(axis=1)]),
            np.searchsorted(templates.design, np.arange(self.designs + 1)),
            numbered_places(2 * self._steps + 1),
        )

    def fit(self, patch: Patch) -> DesignFit | None:
        """Fit of the designs, each at its best heading and shift; None where too little is in view."""
        params, search, template = (
            self.params,
            self._search,
            self._search.first[:-1].copy(),
        )
        cell, top = np.zeros((self.designs, 2), np.int64), np.zeros((self.designs, 2))
        visible = find_places(
            patch.level_db.ravel(), patch.seen.ravel(), self.patch_side,
            search.cells, search.pictures, search.squares, search.sums, search.first, search.row,
            params.least_searched, template, cell, top,
        )  # fmt: skip
        if (
            visible < params.least_visible
            or (found := self.figures.evidence(patch, template, cell)) is None
        ):
            return None
        evidence, edge = found
        centre_m = (
            patch.centre_m
            + params.cell_m * (top - self._steps)
            + self._to_middle_m[template]
        )
        return DesignFit(
            evidence,
            visible,
            self.templates.heading_rad[template],
            centre_m,
            template,
            edge,
        )

    def place(
        self, patch: Patch, fit: DesignFit, design: int, grazing_slope: float
    ) -> tuple[Floats, Floats, Floats]:
        """Place of a design that fits a patch, the bound of its standard deviations, and by what else it may be off.

        All are x and y on the floor, m, shapes (2,), (2,) and (2, 2). ``grazing_slope`` is the height of the sonar over
        the distance along the floor. Only so many cells count for the bound as are independent. Where a part seems
        covered, the place is that of the rest. What else: the way between the places with and without that part, and by
        how much an error of the heading moves the middle of a design whose figure lies beside it.
        """
        cell_m, relief_m, origin = (
            self.params.cell_m,
            self._designs[design].standing_m,
            self._rim + self._steps,
        )
        shadow_m = relief_m * (grazing_slope + 1 / grazing_slope)
        shade = min(shadow_m / cell_m * FINE / SHADE_FINE, LONGEST_SHADOW)
        drawn = row, steps = int(fit.template[design]), int(shade)
        side, to_middle_m = self.templates.side, self._to_middle_m[row]
        if drawn not in self._reliefs:
            heading_rad = float(self.templates.heading_rad[row])
            self._reliefs[drawn] = Relief.of(
                self._designs[design], heading_rad, side, cell_m, self._blur_m, steps
            )
        start = (fit.centre_m[design] - to_middle_m - patch.centre_m) / cell_m + origin
        cells, relief, side_m, moved = (
            self._compared,
            self._reliefs[drawn],
            relief_m * grazing_slope,
            np.zeros(2),
        )
        place, bound = relief.place(
            patch.level_db, patch.seen, cells, start, side_m, shade - steps
        )
        if (edge := int(fit.edge[design])) >= 0:
            is_kept = self.figures.is_kept(
                row, edge, *(cell_m * (one - side // 2) for one in cells)
            )
            kept = cells[0][is_kept], cells[1][is_kept]
            of_kept, bound_of_kept = relief.place(
                patch.level_db, patch.seen, kept, place, side_m, shade - steps
            )
            if np.isfinite(bound_of_kept).all():
                moved, place, bound = cell_m * (of_kept - place), of_kept, bound_of_kept
        bound_m = cell_m / math.sqrt(self.figures.independent) * bound
        turned_m = HEADING_SIGMA_RAD * np.array([-to_middle_m[1], to_middle_m[0]])
        return (
            patch.centre_m + cell_m * (place - origin) + to_middle_m,
            bound_m,
            np.stack([moved, turned_m]),
        )


def numbered_places(side: int) -> Ints:
    """`Search.row` of so many places along each axis."""
    is_start = np.arange(side) % COARSE == 0
    order = np.argsort(~(is_start[:, None] & is_start), axis=None, kind="stable")
    return np.argsort(order).reshape(side, side)


@compiled
def find_places(
    level_db: Floats32, seen: Floats32, side: int, cells: Ints, pictures: Floats32, squares: Floats32, sums: Floats32,
    first: Ints, row_of: Ints, least_searched: float, template: Ints, cell: Ints, top: Floats,
) -> float:  # fmt: skip
    """Fill in which template of each design correlates best with a patch, at which cell, and the top beside it.

    A patch comes row by row, each ``side`` cells; templates as in `Search`. At first templates are the first of their
    designs, and places 0. The share of the cells in view at the best place of all before the climb.
    """
    places, is_cut, total, count = len(row_of), False, 0.0, 0.0
    for at in range(len(seen)):
        total, count, is_cut = (
            total + level_db[at],
            count + seen[at],
            is_cut or seen[at] < 1,
        )
    levels, mean = np.empty(len(seen), np.float32), np.float32(total / max(count, 1.0))
    for at in range(len(seen)):
        levels[at] = (level_db[at] - mean) * seen[at]
    # what lies under the templates, at the places where they are laid
    level = np.empty((places * places, len(cells)), np.float32)
    held = np.ones((places * places if is_cut else 1, len(cells)), np.float32)
    of_level = np.zeros((places * places, 3), np.float32)
    for x in range(0, places, COARSE):
        for y in range(0, places, COARSE):
            row = row_of[x, y]
            lay(
                levels,
                seen,
                cells,
                x * side + y,
                is_cut,
                level[row],
                held[row if is_cut else 0],
                of_level[row],
            )
    rows, step = (
        ((places + COARSE - 1) // COARSE) ** 2,
        max(1, MOST_MULTIPLICATIONS // pictures.size),
    )
    found = np.empty((rows, len(pictures)), np.float32)
    for begin in range(0, rows, step):
        end = min(begin + step, rows)
        ab, b, bb = np.dot(level[begin:end], pictures.T), sums[:1], sums[1:]
        if is_cut:
            b, bb = (
                np.dot(held[begin:end], pictures.T),
                np.dot(held[begin:end], squares.T),
            )
        for row in range(begin, end):
            w = row - begin
            for t in range(len(pictures)):
                found[row, t] = correlation(
                    of_level[row], b[w % len(b), t], bb[w % len(b), t], ab[w, t]
                )
    best, highest, visible = np.full(len(template), -1.0), -1.0, 0.0
    for x in range(0, places, COARSE):
        for y in range(0, places, COARSE):
            row = row_of[x, y]
            if of_level[row, 0] < least_searched * len(cells):
                continue
            for k in range(len(template)):
                for t in range(first[k], first[k + 1]):
                    if found[row, t] > best[k]:
                        best[k], template[k], cell[k, 0], cell[k, 1] = (
                            found[row, t],
                            t,
                            x,
                            y,
                        )
                if best[k] > highest:
                    highest, visible = best[k], of_level[row, 0] / len(cells)
    # uphill from there
    for k in range(len(template)):
        x, y, moved, known = cell[k, 0], cell[k, 1], True, np.full(row_of.shape, np.nan)
        picture, square, b_k, bb_k = (
            pictures[template[k]],
            squares[template[k]],
            sums[0, template[k]],
            sums[1, template[k]],
        )
        while moved:
            moved = False
            for dx, dy in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
                i, j = x + dx, y + dy
                if not (0 <= i < places and 0 <= j < places and np.isnan(known[i, j])):
                    continue
                row = row_of[i, j]
                if of_level[row, 0] == 0:
                    lay(
                        levels,
                        seen,
                        cells,
                        i * side + j,
                        is_cut,
                        level[row],
                        held[row if is_cut else 0],
                        of_level[row],
                    )
                if is_cut:
                    b_k, bb_k = np.dot(held[row], picture), np.dot(held[row], square)
                known[i, j] = correlation(
                    of_level[row], b_k, bb_k, np.dot(level[row], picture)
                )
            for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                i, j = x + dx, y + dy
                if 0 <= i < places and 0 <= j < places and known[i, j] > known[x, y]:
                    x, y, moved = i, j, True
                    break
        cell[k, 0], cell[k, 1], top[k, 0], top[k, 1] = x, y, x, y
        if 0 < x < places - 1:
            top[k, 0] += parabola_top(known[x - 1, y], known[x, y], known[x + 1, y])
        if 0 < y < places - 1:
            top[k, 1] += parabola_top(known[x, y - 1], known[x, y], known[x, y + 1])
    return visible


@compiled
def lay(
    levels: Floats32, seen: Floats32, cells: Ints, shift: int, is_cut: bool,
    level: Floats32, held: Floats32, sums: Floats32,
) -> None:  # fmt: skip
    """Fill in levels, and whether they are seen, in cells so far on; their number, sum and sum of squares."""
    for c in range(len(cells)):
        level[c] = levels[np.uint32(cells[c] + shift)]
    if is_cut:
        for c in range(len(cells)):
            held[c] = seen[np.uint32(cells[c] + shift)]
    sums[0], sums[1], sums[2] = (
        np.dot(held, held),
        np.dot(held, level),
        np.dot(level, level),
    )


@compiled
def correlation(sums: Floats32, b: float, bb: float, ab: float) -> float:
    """Correlation from `lay`'s sums, sums over a template and its squares, and over both; -1 where one is flat."""
    n, a, aa = sums[0], sums[1], sums[2]
    scale2 = (n * aa - a * a) * (n * bb - b * b)
    return (n * ab - a * b) / math.sqrt(scale2) if scale2 > 0 else -1.0


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
    bound_m: Floats | None = None
    """Cramer-Rao bound of the standard deviations of the best design along the ray and across it, range times azimuth,
    shape (2,); None without a fit."""
    moved_m: Floats | None = None
    """Standard deviations along the ray and across it that are added to those of the bound: the way by which what seems
    to cover a part moves the place, and the error of the heading of a figure beside the middle. Shape (2,), 0 where
    there is neither; None without a fit."""


class Fitted(NamedTuple):
    """Fit of all designs to a patch, and the place of the best one on the floor."""

    of_designs: DesignFit
    centre_m: Floats
    """(x, y), x away from the sonar through the middle of the patch, shape (2,)."""
    bound_m: Floats
    """Cramer-Rao bound of its standard deviations, shape (2,)."""
    moved_m: Floats
    """By what else it may be off (`Appearance.place`), shape (2, 2)."""


@lru_cache(maxsize=64)
def appearance_at(
    designs: tuple[LandmarkDesign, ...],
    params: AppearanceParams,
    away: int,
    across: int,
) -> Appearance:
    """Appearance of designs to a sonar that blurs by so many steps of `BLUR_RATIO` from a millimetre on."""
    return Appearance(
        designs, (1e-3 * BLUR_RATIO**away, 1e-3 * BLUR_RATIO**across), params
    )


MOST_PREPARED = 12
"""Sets of templates that are drawn in advance, half a second of work each: enough for a view from 1 m to 4 m."""


class CandidateFit:
    """Comparison of candidates with designs, for a sonar of this full vertical opening."""

    def __init__(
        self,
        designs: Sequence[LandmarkDesign],
        params: AppearanceParams,
        confusion: Confusion,
        elevation_aperture_rad: float,
    ) -> None:
        self._designs, self._params, self._confusion = tuple(designs), params, confusion
        self._weights = np.array(confusion.weights)
        self._aperture_rad = elevation_aperture_rad
        self._grid: PolarGrid | None = None
        self._shape: tuple[Floats, Floats] = np.empty(0), np.empty(0)

    def at(
        self,
        image_db: Floats32,
        frame: SonarFrames,
        view: FloorView | None,
        candidates: Candidates,
        rows: Ints,
    ) -> list[ObjectSighting | None]:
        """Sightings of the candidates in these rows; None for a row of -1."""
        shape = (frame.ranges_m, frame.azimuths_rad)
        is_same = (
            one is other or np.array_equal(one, other)
            for one, other in zip(self._shape, shape, strict=True)
        )
        if self._grid is None or not all(is_same):
            self._grid, self._shape = PolarGrid.of(*shape, self._aperture_rad), shape
        plane, seen = view or SLANT_PLANE, rows[rows >= 0]
        range_m, azimuth_rad = candidates.range_m[seen], candidates.azimuth_rad[seen]
        points_m = plane.floor_points(range_m, azimuth_rad) @ plane.level_R_sonar.T
        bearing_rad, away_m = (
            np.arctan2(points_m[:, 1], points_m[:, 0]),
            np.hypot(points_m[:, 0], points_m[:, 1]),
        )
        fits = [
            self._fit(image_db, plane, *row)
            for row in zip(away_m.tolist(), bearing_rad.tolist(), strict=True)
        ]
        sightings = iter(self._sightings(view, range_m, azimuth_rad, bearing_rad, fits))
        return [None if row < 0 else next(sightings) for row in rows.tolist()]

    def _fit(
        self, image_db: Floats32, plane: FloorView, away_m: float, bearing_rad: float
    ) -> Fitted | None:
        """Fit of the designs to what lies at a distance and bearing on the floor; NaN: the ray does not reach it."""
        assert self._grid is not None
        if math.isnan(away_m):
            return None
        steps = self._grid.blur_steps(away_m, math.hypot(away_m, plane.height_m))
        appearance = appearance_at(self._designs, self._params, *steps)
        ahead, centre_m = plane.turned(bearing_rad), np.array([away_m, 0.0])
        patch = self._grid.patch(
            image_db, ahead, centre_m, appearance.patch_side, self._params.cell_m
        )
        if (fit := appearance.fit(patch)) is None:
            return None
        best = int((fit.evidence @ self._weights).argmax())
        slope = ASSUMED_SLOPE if plane is SLANT_PLANE else plane.height_m / away_m
        return Fitted(fit, *appearance.place(patch, fit, best, slope))

    def prepare(
        self,
        ranges_m: Floats,
        azimuths_rad: Floats,
        depressions_rad: tuple[float, float],
    ) -> None:
        """Draw templates before the first candidate needs them, at most `MOST_PREPARED` sets, middle ranges first.

        Candidates are seen from so far to so far below the horizon.
        """
        grid = PolarGrid.of(ranges_m, azimuths_rad, self._aperture_rad)
        for steps in grid.steps_in_view(
            float(ranges_m[0]), float(ranges_m[-1]), depressions_rad
        )[:MOST_PREPARED]:
            appearance_at(self._designs, self._params, *steps)

    def _sightings(
        self, view: FloorView | None, range_m: Floats, azimuth_rad: Floats, bearing_rad: Floats,
        fits: list[Fitted | None],
    ) -> list[ObjectSighting]:  # fmt: skip
        """Sightings where the centre of the best design is; without a fit where the candidate's centroid is."""
        model, fitted = self._confusion, [fit for fit in fits if fit is not None]
        covariance, rise = np.zeros((len(fits), 2, 2)), np.zeros(len(fits))
        covariance[:, 0, 0], covariance[:, 1, 1] = (
            CENTROID_SIGMA_M**2,
            (CENTROID_SIGMA_M / range_m) ** 2,
        )
        bounds: list[Floats | None] = [None] * len(fits)
        moves: list[Floats | None] = [None] * len(fits)
        if fitted:
            rows = np.flatnonzero([fit is not None for fit in fits])
            xy, bound, moves_m = (
                np.array([getattr(fit, name) for fit in fitted])
                for name in Fitted._fields[1:]
            )
            cos, sin = np.cos(bearing_rad[rows]), np.sin(bearing_rad[rows])
            places = np.concatenate([xy[:, None], xy[:, None] + moves_m], axis=1)
            level_xy = np.einsum(
                "ijn,nkj->nki", np.array([[cos, -sin], [sin, cos]]), places
            )
            r, azimuth = (
                one.reshape(-1, 3)
                for one in (view or SLANT_PLANE).range_azimuth(level_xy.reshape(-1, 2))
            )
            off = np.stack(
                [r - r[:, :1], r[:, :1] * (azimuth - azimuth[:, :1])], axis=-1
            )
            moved, r, azimuth_rad[rows] = (
                np.sqrt((off**2).sum(axis=1)),
                r[:, 0],
                azimuth[:, 0],
            )
            rise[rows] = 0.0 if view is None else view.height_m / r
            range_m[rows] = r + model.height_bias_m * rise[rows]
            away_m = np.hypot(*xy.T)
            bound = bound * np.array([away_m / r, r / away_m]).T
            of_place = model.range_azimuth_cov(bound, r)
            of_place[:, [0, 1], [0, 1]] += (
                moved / np.column_stack([np.ones_like(r), r])
            ) ** 2
            covariance[rows] = np.minimum(of_place, covariance[rows])
            for row, *one in zip(rows.tolist(), bound, moved, strict=True):
                bounds[row], moves[row] = one
        of = [None if fit is None else fit.of_designs for fit in fits]
        columns = (
            of,
            range_m.tolist(),
            azimuth_rad.tolist(),
            covariance,
            rise.tolist(),
            bounds,
            moves,
        )
        return [ObjectSighting(*row) for row in zip(*columns, strict=True)]

    def log_odds(self, sightings: Sequence[ObjectSighting | None]) -> Floats:
        """Log odds of each design against none of them, last 0 for these, shape (M, designs + 1).

        Of a track that ends looking like this; rows of NaN where nothing was compared.
        """
        odds = np.full((len(sightings), len(self._designs) + 1), np.nan)
        fits = {
            row: one.fit
            for row, one in enumerate(sightings)
            if one is not None and one.fit is not None
        }
        if fits:
            odds[[*fits], :-1] = self._confusion.log_odds(
                np.array([fit.evidence for fit in fits.values()])
            )
            odds[[*fits], -1] = 0.0
        return odds
