"""Laws of templates, of patches of the floor, of the fit of designs to them, and of the sightings that follow."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from sonar_graph.devices import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.measurements import Floats
from sonar_graph.sonar import EVIDENCE, FloorView
from sonar_graph.sonar.appearance import (
    Appearance,
    DesignFit,
)
from sonar_graph.sonar.evidence import BEHIND, FAR, NEAR, STEP, Figures
from sonar_graph.sonar.templates import (
    Patch,
    PolarGrid,
)
from sonar_graph.sonar.templates import drawn as picture_of

from .polar_images import (
    AZIMUTHS_RAD,
    HEIGHT_M,
    RANGES_M,
    VIEW,
    design_of,
    image_db,
    level_R_sonar,
    odds,
)

GRID = PolarGrid.of(RANGES_M, AZIMUTHS_RAD)


BLUR_M = (0.002, 0.002)


@pytest.fixture(scope="module")
def appearance() -> Appearance:
    """For images that are as sharp as these, of landmarks as flat: neither beams nor pulse blur them."""
    return Appearance(
        [replace(design, relief_m=0.0) for design in DEFAULT_DESIGNS], BLUR_M
    )


def _fit(
    appearance: Appearance,
    image: Floats,
    near_m: tuple[float, float],
    view: FloorView = VIEW,
) -> DesignFit | None:
    centre = np.array(near_m)
    size = appearance.patch_side, appearance.params.cell_m
    return appearance.fit(GRID.patch(image, view, centre, *size))


def half_plane(height_m: float) -> LandmarkDesign:
    """10 dB of material on the side of positive x, drawn about the middle of its edge, not about that of its figure."""
    mask = np.full((200, 200), np.nan)
    mask[:, 100:] = 10.0
    design = LandmarkDesign(1, "half", 1.0, mask, height_m, relief_m=height_m)
    vars(design)["figure_m"] = (0.0, 0.0)
    return design


def test_foam_that_stands_up_shows_its_near_side():
    """2 cm of foam at a slope of tan 30 degrees: 12 mm of its near edge and their blur are brighter, no other edge."""
    for heading_rad, width_mm in ((0.0, 13.5), (np.pi, 0.0), (np.pi / 2, 0.0)):
        before, after = (
            picture_of(half_plane(height_m), heading_rad, 151, 0.004, (1e-3, 1e-3))[0]
            for height_m in (0.0, 0.02)
        )
        brighter_db = 4 * (after - before).sum(axis=0)[10:65]
        brighter_mm = brighter_db / (10 * np.log10(1 + np.sqrt(3) ** 3))
        np.testing.assert_allclose(brighter_mm, width_mm, atol=1.5)


def test_a_point_is_seen_when_all_bins_of_its_cell_are_in_the_image():
    """A fine grid over the far end, and one over the near end."""
    cell_m = 0.004
    bins_m = RANGES_M[0] + np.diff(RANGES_M)[0] * np.r_[-60:0, 512:572]
    cells_m = cell_m * (np.arange(41) - 20)
    for end_m in RANGES_M[[0, -1]]:
        ahead_m = np.sqrt(end_m**2 - HEIGHT_M**2)
        image = np.ones((96, 512), np.float32)
        patch = GRID.patch(image, VIEW, np.array([ahead_m, 0.0]), 41, cell_m)
        r = np.sqrt((ahead_m + cells_m[:, None]) ** 2 + cells_m**2 + HEIGHT_M**2)
        outside = (np.abs(bins_m - r[..., None]) < cell_m / 2).any(axis=2)
        np.testing.assert_array_equal(patch.seen, ~outside)
        np.testing.assert_allclose(patch.level_db, patch.seen, atol=1e-6)


@pytest.mark.parametrize("index", range(len(DEFAULT_DESIGNS)))
@pytest.mark.parametrize("heading_rad", [0.3, 2.0, -2.6])
def test_every_design_is_known_at_every_heading_in_speckle(
    appearance, index, heading_rad
):
    rotation = level_R_sonar(np.radians(31), np.radians(-2))
    place_m = (1.7, 0.05)
    rng = np.random.default_rng(index)
    image = image_db(DEFAULT_DESIGNS[index], place_m, heading_rad, rotation, rng)
    fit = _fit(appearance, image, (1.72, 0.03), FloorView(rotation, HEIGHT_M))
    found = odds(fit)
    assert found[index] > 5
    assert np.delete(found, index).max() < found[index] - 10
    np.testing.assert_allclose(fit.centre_m[index], place_m, atol=0.008)


def plain_evidence(
    figures: Figures, template: int, x: int, y: int, patch: Patch
) -> tuple[list[float], int]:
    """The equations of the module in NumPy: least squares on the cells in view, over and over; and the edge."""
    rows = slice(*figures.first[template : template + 2])
    side = len(patch.seen)
    i, j = np.divmod(figures.cells[rows], side) + np.array([[x], [y]])
    seen = patch.seen[i, j] > 0
    held = patch.held[i, j] > 0.5
    mean = patch.level_db[i, j][seen].mean()
    level = patch.level_db[i, j] - mean
    z = level[seen].astype(float)
    values = figures.values[rows] * float(STEP)
    has_dark = figures.has_dark[template]
    one, dark, figure = range(3)
    shades = len(values[0]) // 2 + 1

    def fitted(*columns: int) -> tuple[float, Floats]:
        A = values[seen][:, columns]
        c = np.linalg.solve(A.T @ A + 1e-3 * np.eye(len(columns)), A.T @ z)
        return z @ z - c @ (A.T @ z), c

    def with_shade(q: int) -> float:
        left, c = fitted(one, figure + q, shades + q)
        return left if c[2] < 0 else fitted(one, figure + q)[0]

    best, (floor, beta) = fitted(one, figure)
    plain = best
    delta = 0.0
    darker, c = fitted(one, figure, dark)
    if has_dark and c[2] < 0:
        best = darker
        floor, beta, delta = c
    is_dark = delta < 0
    shaded, *others = map(with_shade, range(shades - figure))
    both = min(best, shaded)
    all_columns, c = fitted(one, figure, dark, shades)
    if is_dark and shaded < plain and max(c[2:]) < 0:
        both = all_columns
    # from the middle; three places on each side
    away = 0.015 * (np.stack([i - x, j - y]) - (side - 7) // 2)
    B = values[:, figure]
    kept = np.where(B > 0.12, B, 0.0)
    weight = np.maximum(B, 0)
    radius = np.sqrt(2 * (away**2).sum(axis=0) @ weight / weight.sum())
    without = (one, dark) if is_dark else (one,)
    without_figure = fitted(*without)[0]
    covered = without_figure
    edge = -1
    edges = product(2 * np.pi * np.arange(12) / 12, (0.15, 0.4, 0.65))
    for number, (towards, offset) in enumerate(edges):
        along = away[0] * np.cos(towards) + away[1] * np.sin(towards)
        part = kept * (along <= offset * radius)
        A = np.column_stack([values[:, without], part])[seen]
        c = np.linalg.lstsq(A, z)[0]
        left = float(((z - A @ c) ** 2).sum())
        if c[-1] > 0 and left < covered:
            covered = left
            edge = number
    whole = best if beta > 0 else without_figure
    gain = figures.independent * seen.sum() / 2 * np.log(whole / covered)
    covered = min(covered, whole)
    mean_square = best / seen.sum()
    zones = figures.zones[rows]
    smooth = patch.smooth_db[i, j] - mean
    off = smooth - floor - figures.smooth[rows] @ [delta, beta]

    def beside(zone: int, off_db: Floats) -> float:
        at = (zones & zone > 0) & held
        return np.log(
            (np.mean(off_db[at] ** 2) if at.sum() > 8 else mean_square / 3) + 0.3
        )

    back = (zones & BEHIND > 0) & held & seen
    darkness = min(np.log(shaded / both), np.log(fitted(one, dark)[0] / best))
    ratios = [fitted(one, figure + q)[0] for q in range(shades - figure)]
    columns = [
        1.0,
        np.log(min(shaded, *others) / both),
        np.log(min(ratios) / plain),
        np.log(max(beta, 0.5) / np.sqrt(mean_square)),
        beside(NEAR, np.maximum(off, 0)),
        beside(FAR, np.minimum(off, 0)),
        np.mean(level[back] - floor) if back.sum() > 5 else 0.0,
        np.sqrt(max(darkness, 0.0)) if is_dark else 0.0,
        float(not has_dark),
        np.log(covered / (z @ z)),
        max(np.log(best / covered), 0.0),
    ]
    return columns, edge if gain > np.log(36) else -1


@pytest.mark.parametrize(
    ("rim", "blur_m"), [(99, BLUR_M), (26, BLUR_M), (99, (0.008, 0.02))]
)
def test_evidence_is_that_of_least_squares_over_the_cells_in_view(rim, blur_m):
    """Every design in rough noise: weak, whole, dark where it should be bright, or its plate alone; with holes.

    Ratios count by the share of cells that are independent where the sonar resolves less than a cell.
    """
    appearance = Appearance(DEFAULT_DESIGNS, blur_m)
    share = np.prod([min(0.015 / (2.3548 * one), 1.0) for one in blur_m])
    templates = appearance.templates
    figures = appearance.figures
    rng = np.random.default_rng(rim)
    side = appearance.patch_side
    has = set()
    is_edge = set()
    corner = np.array([[3 + appearance._rim], [2 + appearance._rim]])
    i, j = np.divmod(templates.cells, templates.side) + corner
    holes = 0.0 if rim > side else 0.05
    seen = (np.arange(side) < rim) & (rng.random((side, side)) > holes)
    seen = seen.astype(np.float32)
    at = np.array([[3, 2], [3, 3]])
    for template, picture in enumerate(templates.pictures):
        level = rng.normal(40, 4, (side, side)).astype(np.float32)
        drawn_db = (0.3 * picture, picture, -picture, 3 * np.minimum(picture, 0))
        level[i, j] += drawn_db[template % 4]
        level[side // 2 + (5, 12)[template % 2] :] -= (0, 8)[template // 2 % 2]
        patch = Patch.of(level * seen, seen, np.zeros(2))
        pair = np.array([template, (template + 1) % len(templates.design)])
        (found, rival), edges = figures.evidence(patch, pair, at)
        (expected, edge), (of_rival, edge_of_rival) = (
            plain_evidence(figures, one, *place, patch)
            for one, place in zip(pair, at, strict=True)
        )
        assert edges.tolist() == [edge, edge_of_rival]
        is_edge |= {*(edges >= 0)}
        rest = np.array([expected[9], of_rival[9]])
        expected[9], of_rival[9] = rest.min() - rest
        expected = np.array(expected)
        expected[[1, 2, 9, 10]] *= share
        expected[7] *= np.sqrt(share)
        np.testing.assert_allclose(found, expected, atol=5e-5)
        assert rival[9] == pytest.approx(share * of_rival[9], abs=5e-5)
        either = (found != 0) | (rival != 0)
        has |= {*np.array(EVIDENCE)[either].tolist()}
    assert has == {*EVIDENCE} - ({"bare"} if figures.has_dark.all() else set())
    assert is_edge == {True, False}


def drawn(figure: Floats) -> LandmarkDesign:
    """A figure of 12 dB on the floor."""
    return LandmarkDesign(9, "figure", 0.6, np.where(figure, 12.0, np.nan))


def strangers() -> dict[str, LandmarkDesign | None]:
    places_m = 0.002 * (np.arange(300) - 149.5)
    x, y = np.meshgrid(places_m, -places_m)
    r = np.hypot(x, y)
    a = np.arctan2(y, x)
    ragged = r < 0.13 + 0.05 * np.cos(3 * a) + 0.03 * np.cos(5 * a + 1)
    return {
        "floor": None,
        "bar": design_of((0.0, 0.0, 0.25, 0.04), size_m=0.6),
        "a lid of another size": drawn(r < 0.09),
        "ragged": drawn(ragged),
    }


@pytest.mark.parametrize("name", strangers())
def test_a_stranger_is_none(appearance, name):
    rng = np.random.default_rng(3)
    image = image_db(strangers()[name], (1.7, 0.0), 0.2, rng=rng)
    assert odds(_fit(appearance, image, (1.7, 0.0))).max() < -2


@pytest.mark.parametrize("design", DEFAULT_DESIGNS, ids=lambda design: design.name)
def test_the_rim_of_the_image_does_not_push_a_landmark_aside(appearance, design):
    for y_m in np.linspace(0.34, 0.46, 7):
        fit = _fit(appearance, image_db(design, (1.7, y_m), 0.6), (1.7, y_m - 0.02))
        if fit is not None:
            found_m = fit.centre_m[design.id - 1]
            np.testing.assert_allclose(found_m, (1.7, y_m), atol=0.004)
