"""Appearance of candidates: best place and heading of every design in the image around them, and the evidence for it.

The image is sampled on a square grid of the floor, where foreshortening and the shape of the fan drop out; its x axis
points away from the sonar, along the line of sight. Designs are templates on the same grid
(`sonar_graph.sonar.templates`), and the correlation with them finds place and heading. The evidence for a design
there, against anything else, is in `sonar_graph.sonar.evidence`. Derivation: docs/theory/recognition.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
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
from sonar_graph.sonar.geometry import FloorView, MadeOfWindow
from sonar_graph.sonar.place import (
    LONGEST_SHADOW,
    SHADE_FINE,
    Grid,
    Lit,
    Relief,
    fit_place,
)
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
    """Evidence for each design, in the columns of `sonar_graph.sonar.evidence.EVIDENCE`, shape (designs, 11)."""
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

    patch_side: int
    """Cells along the side of the patch."""
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


class BestPlaces(NamedTuple):
    """Best template of each design in a patch, and its place."""

    visible: float
    """Share of the cells in view at the best place of all before the climb."""
    template: Ints
    """Shape (designs,)."""
    cell: Ints
    """Place of the best correlation, in cells, shape (designs, 2)."""
    top: Floats
    """Top of the parabolas through it and its neighbours, in cells, shape (designs, 2)."""


class Placed(NamedTuple):
    """Place of a design on the floor; all x and y."""

    centre_m: Floats
    """Shape (2,)."""
    bound_m: Floats
    """Cramer-Rao bound of its standard deviations, shape (2,)."""
    moved_m: Floats
    """By what else it may be off, shape (2, 2)."""


class Appearance:
    """Comparison of patches with the templates of designs, as a sonar of one resolution sees them."""

    def __init__(
        self,
        designs: Sequence[LandmarkDesign],
        blur_m: Blur,
        params: AppearanceParams | None = None,
    ) -> None:
        self.params = params or AppearanceParams()
        self._designs = designs
        # drawn once for a resolution: the search runs over them in every frame
        templates = Templates.of(
            designs, self.params.cell_m, self.params.margin_m, blur_m
        )
        self.templates = templates
        self._steps = math.ceil(self.params.search_m / self.params.cell_m)
        self.figures = Figures.of(designs, templates, blur_m, 2 * self._steps)
        self.patch_side = self.figures.patch_side
        self._rim = (self.patch_side - templates.side) // 2 - self._steps
        drawn = zip(
            templates.design.tolist(), templates.heading_rad.tolist(), strict=True
        )
        self._to_middle_m = np.array(
            [middle_m(designs[index], heading_rad) for index, heading_rad in drawn]
        )
        x, y = np.divmod(templates.cells, templates.side)
        self._compared = (x, y)
        self._grid = Grid(templates.side, self.params.cell_m, blur_m)
        pictures = templates.pictures
        squares = pictures**2
        self._search = Search(
            patch_side=self.patch_side,
            cells=(x + self._rim) * self.patch_side + y + self._rim,
            pictures=pictures,
            squares=squares,
            sums=np.stack([pictures.sum(axis=1), squares.sum(axis=1)]),
            first=np.searchsorted(templates.design, np.arange(len(designs) + 1)),
            row=numbered_places(2 * self._steps + 1),
        )

    def fit(self, patch: Patch) -> DesignFit | None:
        """Fit of the designs, each at its best heading and shift; None where too little is in view."""
        best = find_places(patch, self._search, self.params.least_searched)
        if best.visible < self.params.least_visible:
            return None
        # the search used half of the dark parts; evidence fits their level
        found = self.figures.evidence(patch, best.template, best.cell)
        if found is None:
            return None
        evidence, edge = found
        shift_m = self.params.cell_m * (best.top - self._steps)
        return DesignFit(
            evidence=evidence,
            visible=best.visible,
            heading_rad=self.templates.heading_rad[best.template],
            centre_m=patch.centre_m + shift_m + self._to_middle_m[best.template],
            template=best.template,
            edge=edge,
        )

    def place(
        self, patch: Patch, fit: DesignFit, design: int, grazing_slope: float
    ) -> Placed:
        """Place of a design that fits a patch, the bound of its standard deviations, and by what else it may be off.

        ``grazing_slope`` is the height of the sonar over the distance along the floor. Only so many cells count for the
        bound as are independent. Where a part seems covered, the place is that of the rest. What else: the way between
        the places with and without that part, and by how much an error of the heading moves the middle of a design
        whose figure lies beside it.
        """
        cell_m = self.params.cell_m
        of_design = self._designs[design]
        relief_m = of_design.standing_m
        row = int(fit.template[design])
        edge = int(fit.edge[design])
        to_middle_m = self._to_middle_m[row]
        origin = self._rim + self._steps
        # from the far edge at the top to where the ray meets the plane again, in that plane
        shadow_m = relief_m * (grazing_slope + 1 / grazing_slope)
        shade = min(shadow_m / cell_m * FINE / SHADE_FINE, LONGEST_SHADOW)
        heading_rad = float(self.templates.heading_rad[row])
        relief = Relief.of(of_design, heading_rad, self._grid, int(shade))
        # two lengths of the shadow are drawn; in between they are interpolated
        lit = Lit(relief_m * grazing_slope, shade - int(shade))
        start = (fit.centre_m[design] - to_middle_m - patch.centre_m) / cell_m + origin
        place, bound = fit_place(relief, patch, self._compared, start, lit)
        moved_m = np.zeros(2)
        # part of the figure seems covered: place the rest, and count the difference as an error
        if edge >= 0:
            half = self.templates.side // 2
            x_m, y_m = (cell_m * (one - half) for one in self._compared)
            is_kept = self.figures.is_kept(row, edge, x_m, y_m)
            kept = (self._compared[0][is_kept], self._compared[1][is_kept])
            of_kept, bound_of_kept = fit_place(relief, patch, kept, place, lit)
            # too few cells of the rest are in view: keep the place of the whole
            if np.isfinite(bound_of_kept).all():
                moved_m = cell_m * (of_kept - place)
                place = of_kept
                bound = bound_of_kept
        # an error of the heading turns the way from the figure to the middle
        turned_m = HEADING_SIGMA_RAD * np.array([-to_middle_m[1], to_middle_m[0]])
        return Placed(
            centre_m=patch.centre_m + cell_m * (place - origin) + to_middle_m,
            bound_m=cell_m / math.sqrt(self.figures.independent) * bound,
            moved_m=np.stack([moved_m, turned_m]),
        )


def numbered_places(side: int) -> Ints:
    """`Search.row` of so many places along each axis."""
    is_start = np.arange(side) % COARSE == 0
    # the starts first, so that their rows are one block of a matrix product
    order = np.argsort(~(is_start[:, None] & is_start), axis=None, kind="stable")
    return np.argsort(order).reshape(side, side)


class Laid(NamedTuple):
    """What lies in a patch under the templates, at the places where they were laid; rows as in `Search.row`."""

    patch_db: Floats32
    """Levels of the patch less their mean, 0 where not seen, shape (side * side,)."""
    seen: Floats32
    """Shape (side * side,)."""
    is_cut: bool
    """Whether a cell of the patch is not seen."""
    level_db: Floats32
    """Shape (places, cells)."""
    held: Floats32
    """1 where seen, shape (places, cells), or (1, cells) of a patch that is not cut."""
    sums: Floats32
    """Number of the cells seen, sum of their levels and of the squares, 0 where nothing was laid, shape (places, 3)."""


@compiled
def find_places(patch: Patch, search: Search, least_searched: float) -> BestPlaces:
    """Which template of each design correlates best with a patch, and where.

    All templates are laid at every `COARSE` place; each design's best one climbs from there.
    """
    places = len(search.row)
    designs = len(search.first) - 1
    cells = len(search.cells)
    laid = unlaid(patch, search)
    for x in range(0, places, COARSE):
        for y in range(0, places, COARSE):
            lay(laid, search, x, y)
    found = coarse_correlations(laid, search)
    # for designs that correlate nowhere
    template = search.first[:-1].copy()
    cell = np.zeros((designs, 2), np.int64)
    top = np.zeros((designs, 2))
    best = np.full(designs, -1.0)
    highest = -1.0
    visible = 0.0
    first = search.first
    for x in range(0, places, COARSE):
        for y in range(0, places, COARSE):
            row = search.row[x, y]
            # at the rim of the image few cells correlate with anything
            if laid.sums[row, 0] < least_searched * cells:
                continue
            for k in range(designs):
                for t in range(first[k], first[k + 1]):
                    if found[row, t] > best[k]:
                        best[k] = found[row, t]
                        template[k] = t
                        cell[k, 0] = x
                        cell[k, 1] = y
                if best[k] > highest:
                    highest = best[k]
                    visible = laid.sums[row, 0] / cells
    for k in range(designs):
        climb(laid, search, template[k], cell[k], top[k])
    return BestPlaces(visible, template, cell, top)


@compiled
def unlaid(patch: Patch, search: Search) -> Laid:
    """Levels of a patch, with room for what lies under the templates."""
    level_db = patch.level_db.ravel()
    seen = patch.seen.ravel()
    total = 0.0
    count = 0.0
    is_cut = False
    for at in range(len(seen)):
        total += level_db[at]
        count += seen[at]
        is_cut = is_cut or seen[at] < 1
    # correlations do not depend on the mean; single precision does
    mean = np.float32(total / max(count, 1.0))
    patch_db = np.empty(len(seen), np.float32)
    for at in range(len(seen)):
        patch_db[at] = (level_db[at] - mean) * seen[at]
    places = search.row.size
    cells = len(search.cells)
    return Laid(
        patch_db,
        seen,
        is_cut,
        np.empty((places, cells), np.float32),
        np.ones((places if is_cut else 1, cells), np.float32),
        np.zeros((places, 3), np.float32),
    )


@compiled
def lay(laid: Laid, search: Search, x: int, y: int) -> None:
    """Fill in the row of one place."""
    row = search.row[x, y]
    # one offset: cells are numbered row by row
    shift = x * search.patch_side + y
    cells = search.cells
    patch_db = laid.patch_db
    seen = laid.seen
    level_db = laid.level_db[row]
    held = laid.held[row if laid.is_cut else 0]
    for c in range(len(cells)):
        level_db[c] = patch_db[np.uint32(cells[c] + shift)]
    if laid.is_cut:
        for c in range(len(cells)):
            held[c] = seen[np.uint32(cells[c] + shift)]
    laid.sums[row, 0] = np.dot(held, held)
    laid.sums[row, 1] = np.dot(held, level_db)
    laid.sums[row, 2] = np.dot(level_db, level_db)


@compiled
def coarse_correlations(laid: Laid, search: Search) -> Floats32:
    """Correlations of all templates at the places from which the search climbs, shape (places, templates)."""
    rows = ((len(search.row) + COARSE - 1) // COARSE) ** 2
    templates = len(search.pictures)
    # in blocks small enough that OpenBLAS stays on one core
    most = max(1, MOST_MULTIPLICATIONS // search.pictures.size)
    found = np.empty((rows, templates), np.float32)
    sums = laid.sums
    for begin in range(0, rows, most):
        end = min(begin + most, rows)
        ab = np.dot(laid.level_db[begin:end], search.pictures.T)
        b = search.sums[:1]
        bb = search.sums[1:]
        # sums over a template depend on which of its cells are seen
        if laid.is_cut:
            b = np.dot(laid.held[begin:end], search.pictures.T)
            bb = np.dot(laid.held[begin:end], search.squares.T)
        for row in range(begin, end):
            w = row - begin
            held = w if laid.is_cut else 0
            for t in range(templates):
                found[row, t] = correlation(
                    sums[row], b[held, t], bb[held, t], ab[w, t]
                )
    return found


@compiled
def climb(laid: Laid, search: Search, template: int, cell: Ints, top: Floats) -> None:
    """Move a template's place uphill, cell by cell, and fill in the top beside it."""
    places = len(search.row)
    # each place is computed once
    known = np.full(search.row.shape, np.nan)
    x = cell[0]
    y = cell[1]
    has_moved = True
    while has_moved:
        has_moved = False
        for dx, dy in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
            i = x + dx
            j = y + dy
            if 0 <= i < places and 0 <= j < places and np.isnan(known[i, j]):
                known[i, j] = correlation_at(laid, search, template, i, j)
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            i = x + dx
            j = y + dy
            if 0 <= i < places and 0 <= j < places and known[i, j] > known[x, y]:
                x = i
                y = j
                has_moved = True
                break
    cell[0] = x
    cell[1] = y
    top[0] = x
    top[1] = y
    if 0 < x < places - 1:
        # the top between cells, where both neighbours are known
        top[0] += parabola_top(known[x - 1, y], known[x, y], known[x + 1, y])
    if 0 < y < places - 1:
        top[1] += parabola_top(known[x, y - 1], known[x, y], known[x, y + 1])


@compiled
def correlation_at(laid: Laid, search: Search, template: int, x: int, y: int) -> float:
    """Correlation of one template at one place."""
    row = search.row[x, y]
    # the search has laid the starts only
    if laid.sums[row, 0] == 0:
        lay(laid, search, x, y)
    picture = search.pictures[template]
    b = search.sums[0, template]
    bb = search.sums[1, template]
    if laid.is_cut:
        b = np.dot(laid.held[row], picture)
        bb = np.dot(laid.held[row], search.squares[template])
    return correlation(laid.sums[row], b, bb, np.dot(laid.level_db[row], picture))


@compiled
def correlation(sums: Floats32, b: float, bb: float, ab: float) -> float:
    """Correlation from `Laid.sums`, sums over a template and its squares, and over both; -1 where one is flat."""
    n = sums[0]
    a = sums[1]
    aa = sums[2]
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
    """Fit of all designs to a patch, and the place of the best one, x away from the sonar through the patch's middle."""

    of_designs: DesignFit
    place: Placed


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
        self._designs = tuple(designs)
        self._params = params
        self._confusion = confusion
        self._grid = partial(
            PolarGrid.of, elevation_aperture_rad=elevation_aperture_rad
        )
        self._grids = MadeOfWindow(self._grid)

    def at(
        self,
        image_db: Floats32,
        frame: SonarFrames,
        view: FloorView | None,
        candidates: Candidates,
        rows: Ints,
    ) -> list[ObjectSighting | None]:
        """Sightings of the candidates in these rows; None for a row of -1."""
        grid = self._grids.of(frame)
        # without a floor, patches lie in the plane of the image
        plane = view or SLANT_PLANE
        seen = rows[rows >= 0]
        range_m = candidates.range_m[seen]
        azimuth_rad = candidates.azimuth_rad[seen]
        points_m = plane.floor_points(range_m, azimuth_rad) @ plane.level_R_sonar.T
        # each patch is turned so that its x axis points away from the sonar
        bearing_rad = np.arctan2(points_m[:, 1], points_m[:, 0])
        away_m = np.hypot(points_m[:, 0], points_m[:, 1])
        fits = [
            self._fit(grid, image_db, plane, *row)
            for row in zip(away_m.tolist(), bearing_rad.tolist(), strict=True)
        ]
        of_seen = iter(self._sightings(view, range_m, azimuth_rad, bearing_rad, fits))
        return [None if row < 0 else next(of_seen) for row in rows.tolist()]

    def _fit(
        self,
        grid: PolarGrid,
        image_db: Floats32,
        plane: FloorView,
        away_m: float,
        bearing_rad: float,
    ) -> Fitted | None:
        """Fit of the designs to what lies at a distance and bearing on the floor; NaN: the ray does not reach it."""
        if math.isnan(away_m):
            return None
        # templates of the nearest resolution: drawn for each range they would take seconds
        steps = grid.blur_steps(away_m, math.hypot(away_m, plane.height_m))
        appearance = appearance_at(self._designs, self._params, *steps)
        patch = grid.patch(
            image_db,
            plane.turned(bearing_rad),
            np.array([away_m, 0.0]),
            appearance.patch_side,
            self._params.cell_m,
        )
        fit = appearance.fit(patch)
        if fit is None:
            return None
        # only the likeliest design is placed to a fraction of a cell
        best = int(self._confusion.log_odds(fit.evidence).argmax())
        slope = ASSUMED_SLOPE if plane is SLANT_PLANE else plane.height_m / away_m
        return Fitted(fit, appearance.place(patch, fit, best, slope))

    def prepare(
        self,
        ranges_m: Floats,
        azimuths_rad: Floats,
        depressions_rad: tuple[float, float],
    ) -> None:
        """Draw templates before the first candidate needs them, at most `MOST_PREPARED` sets, middle ranges first.

        Candidates are seen from so far to so far below the horizon.
        """
        in_view = self._grid(ranges_m, azimuths_rad).steps_in_view(
            float(ranges_m[0]), float(ranges_m[-1]), depressions_rad
        )
        for steps in in_view[:MOST_PREPARED]:
            appearance_at(self._designs, self._params, *steps)

    def _sightings(
        self, view: FloorView | None, range_m: Floats, azimuth_rad: Floats, bearing_rad: Floats,
        fits: list[Fitted | None],
    ) -> list[ObjectSighting]:  # fmt: skip
        """Sightings where the centre of the best design is; without a fit where the candidate's centroid is."""
        covariance = np.zeros((len(fits), 2, 2))
        covariance[:, 0, 0] = CENTROID_SIGMA_M**2
        covariance[:, 1, 1] = (CENTROID_SIGMA_M / range_m) ** 2
        sightings = [
            ObjectSighting(None, *row)
            for row in zip(
                range_m.tolist(), azimuth_rad.tolist(), covariance, strict=True
            )
        ]
        rows = [row for row, fit in enumerate(fits) if fit is not None]
        fitted = [fit for fit in fits if fit is not None]
        if not fitted:
            return sightings
        model = self._confusion
        xy_m = np.array([fit.place.centre_m for fit in fitted])
        moved_xy_m = np.array([fit.place.moved_m for fit in fitted])
        bound_xy_m = np.array([fit.place.bound_m for fit in fitted])
        # the place and those to which it may have moved, from the axes of each patch into level ones
        places_m = np.concatenate([xy_m[:, None], xy_m[:, None] + moved_xy_m], axis=1)
        cos = np.cos(bearing_rad[rows])
        sin = np.sin(bearing_rad[rows])
        # about the vertical, by the bearing of each patch
        level_R_patch = np.array([[cos, -sin], [sin, cos]])
        level_xy_m = np.einsum("ijn,nkj->nki", level_R_patch, places_m).reshape(-1, 2)
        all_range_m, all_azimuth_rad = (view or SLANT_PLANE).range_azimuth(level_xy_m)
        ranges_m = all_range_m.reshape(-1, 3)
        azimuths_rad = all_azimuth_rad.reshape(-1, 3)
        r = ranges_m[:, 0]
        # differences from the place, along the ray and across it
        along_m = ranges_m - r[:, None]
        across_m = r[:, None] * (azimuths_rad - azimuths_rad[:, :1])
        moved_m = np.sqrt((np.stack([along_m, across_m], axis=-1) ** 2).sum(axis=1))
        range_per_height = np.zeros(len(r)) if view is None else view.height_m / r
        away_m = np.hypot(xy_m[:, 0], xy_m[:, 1])
        # dr = (d / r) dx along the floor, and r da = (r / d) dy across
        bound_m = bound_xy_m * np.array([away_m / r, r / away_m]).T
        of_place = model.range_azimuth_cov(bound_m, r)
        to_range_azimuth = np.column_stack([np.ones_like(r), r])
        of_place[:, [0, 1], [0, 1]] += (moved_m / to_range_azimuth) ** 2
        for n, row in enumerate(rows):
            rise = float(range_per_height[n])
            sightings[row] = ObjectSighting(
                fit=fitted[n].of_designs,
                range_m=float(r[n] + model.height_bias_m * rise),
                azimuth_rad=float(azimuths_rad[n, 0]),
                # a fit is never less certain than the centroid of the candidate
                covariance=np.minimum(of_place[n], covariance[row]),
                range_per_height=rise,
                bound_m=bound_m[n],
                moved_m=moved_m[n],
            )
        return sightings

    def log_odds(self, sightings: Sequence[ObjectSighting | None]) -> Floats:
        """Log odds of each design against none of them, last 0 for these, shape (M, designs + 1).

        Of a track that ends looking like this; rows of NaN where nothing was compared.
        """
        odds = np.full((len(sightings), len(self._designs) + 1), np.nan)
        for row, one in enumerate(sightings):
            if one is not None and one.fit is not None:
                odds[row, :-1] = self._confusion.log_odds(one.fit.evidence)
                odds[row, -1] = 0.0
        return odds
