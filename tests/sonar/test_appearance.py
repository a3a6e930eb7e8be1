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
    ROTATION,
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
    return appearance.fit(
        GRID.patch(
            image,
            view,
            np.array(near_m),
            appearance.patch_side,
            appearance.params.cell_m,
        )
    )


def half_plane() -> LandmarkDesign:
    """10 dB of material on the side of positive x, drawn about the middle of its edge, not about that of its figure."""
    mask = np.full((200, 200), np.nan)
    mask[:, 100:] = 10.0
    return edge_in_the_middle(LandmarkDesign(1, "half", 1.0, mask, relief_m=0.0))


def edge_in_the_middle(design: LandmarkDesign) -> LandmarkDesign:
    vars(design)["figure_m"] = (0.0, 0.0)
    return design


def test_foam_that_stands_up_shows_its_near_side():
    """2 cm of foam at a slope of tan 30 degrees: 12 mm of its near edge and their blur are brighter, no other edge."""
    flush = half_plane()
    raised = edge_in_the_middle(replace(flush, height_m=0.02, relief_m=0.02))
    for heading_rad in (0.0, np.pi, np.pi / 2):
        before, after = (
            picture_of(one, heading_rad, 151, 0.004, (1e-3, 1e-3))[0]
            for one in (flush, raised)
        )
        brighter_mm = (
            4 * (after - before).sum(axis=0) / (10 * np.log10(1 + np.sqrt(3) ** 3))
        )
        np.testing.assert_allclose(
            brighter_mm[10:65], 0.0 if heading_rad else 13.5, atol=1.5
        )


def test_a_point_is_seen_when_all_bins_of_its_cell_are_in_the_image():
    """A fine grid over the far end, and one over the near end."""
    cell_m = 0.004
    bin_m = RANGES_M[1] - RANGES_M[0]
    image = np.ones((96, 512), np.float32)
    for end_m in (RANGES_M[0], RANGES_M[-1]):
        centre = np.array([np.sqrt(end_m**2 - HEIGHT_M**2), 0.0])
        cells_m = cell_m * (np.arange(41) - 20)
        patch = GRID.patch(image, VIEW, centre, 41, cell_m)
        r = np.sqrt((centre[0] + cells_m[:, None]) ** 2 + cells_m**2 + HEIGHT_M**2)
        covered = (
            np.abs(RANGES_M[0] + bin_m * np.arange(-60, 572) - r[..., None])
            < cell_m / 2
        )
        outside = covered[..., [*range(60), *range(572, 632)]].any(axis=2)
        np.testing.assert_array_equal(patch.seen, ~outside)
        np.testing.assert_allclose(patch.level_db, patch.seen, atol=1e-6)


@pytest.mark.parametrize("index", range(len(DEFAULT_DESIGNS)))
@pytest.mark.parametrize("heading_rad", [0.3, 2.0, -2.6])
def test_every_design_is_known_at_every_heading_in_speckle(
    appearance, index, heading_rad
):
    rotation = level_R_sonar(np.radians(31), np.radians(-2))
    image = image_db(
        DEFAULT_DESIGNS[index],
        (1.7, 0.05),
        heading_rad,
        rotation,
        np.random.default_rng(index),
    )
    fit = _fit(appearance, image, (1.72, 0.03), FloorView(rotation, HEIGHT_M))
    found = odds(fit)
    assert found[index] > 5
    assert np.delete(found, index).max() < found[index] - 10
    np.testing.assert_allclose(fit.centre_m[index], [1.7, 0.05], atol=0.008)


def plain_evidence(
    figures: Figures, template: int, x: int, y: int, patch: Patch
) -> tuple[list[float], int]:
    """The equations of the module in NumPy: least squares on the cells in view, over and over; and the edge."""
    rows = slice(*figures.first[template : template + 2])
    side = len(patch.seen)
    i, j = np.divmod(figures.cells[rows], side) + np.array([[x], [y]])
    seen = patch.seen[i, j] > 0
    held = patch.held[i, j] > 0.5
    level = patch.level_db[i, j] - patch.level_db[i, j][seen].mean()
    smooth = patch.smooth_db[i, j] - patch.level_db[i, j][seen].mean()
    values = figures.values[rows] * float(STEP)
    zones = figures.zones[rows]
    design = figures.smooth[rows]

    def fitted(*columns: int) -> tuple[float, Floats]:
        A = values[seen][:, columns]
        z = level[seen].astype(float)
        c = np.linalg.solve(A.T @ A + 1e-3 * np.eye(len(columns)), A.T @ z)
        return z @ z - c @ (A.T @ z), c

    one = 0
    dark = 1
    figure = 2
    shades = len(values[0]) // 2 + 1
    plain, (floor, beta) = fitted(one, figure)
    delta = 0.0
    best = plain
    shaded = plain
    if figures.has_dark[template] and fitted(one, figure, dark)[1][2] < 0:
        best, (floor, beta, delta) = fitted(one, figure, dark)
    if fitted(one, figure, shades)[1][2] < 0:
        shaded = fitted(one, figure, shades)[0]
    both = min(best, shaded)
    if (
        delta < 0
        and shaded < plain
        and max(fitted(one, figure, dark, shades)[1][2:]) < 0
    ):
        both = fitted(one, figure, dark, shades)[0]
    others = [shaded]
    for q in range(1, shades - figure):
        with_shade, c = fitted(one, figure + q, shades + q)
        others.append(with_shade if c[2] < 0 else fitted(one, figure + q)[0])
    # from the middle; three places on each side
    away = 0.015 * (np.stack([i - x, j - y]) - (side - 7) // 2)
    B = values[:, figure]
    kept = np.where(B > 0.12, B, 0.0)
    radius = np.sqrt(
        2 * (away**2).sum(axis=0) @ np.maximum(B, 0) / np.maximum(B, 0).sum()
    )
    without_figure = fitted(one, dark)[0] if delta < 0 else fitted(one)[0]
    covered = without_figure
    edge = -1
    edges = product(2 * np.pi * np.arange(12) / 12, (0.15, 0.4, 0.65))
    for number, (towards, offset) in enumerate(edges):
        part = kept * (
            away[0] * np.cos(towards) + away[1] * np.sin(towards) <= offset * radius
        )
        A = np.stack(
            [np.ones_like(part), *([values[:, dark]] if delta < 0 else []), part]
        )[:, seen].T
        c = np.linalg.lstsq(A, level[seen].astype(float), rcond=None)[0]
        if c[-1] > 0 and (left := float(((level[seen] - A @ c) ** 2).sum())) < covered:
            covered = left
            edge = number
    whole = best if beta > 0 else without_figure
    edge = (
        edge
        if figures.independent * seen.sum() / 2 * np.log(whole / covered) > np.log(36)
        else -1
    )
    covered = min(covered, whole)
    off = smooth - floor - beta * design[:, 1] - delta * design[:, 0]
    near, far, back = ((zones & zone > 0) & held for zone in (NEAR, FAR, BEHIND))
    back &= seen
    mean_square = best / seen.sum()
    columns = [
        1.0,
        np.log(min(others) / both),
        np.log(min(fitted(one, figure + q)[0] for q in range(shades - figure)) / plain),
        np.log(max(beta, 0.5) / np.sqrt(mean_square)),
        np.log(
            (
                np.mean(np.maximum(off[near], 0) ** 2)
                if near.sum() > 8
                else mean_square / 3
            )
            + 0.3
        ),
        np.log(
            (
                np.mean(np.minimum(off[far], 0) ** 2)
                if far.sum() > 8
                else mean_square / 3
            )
            + 0.3
        ),
        np.mean(level[back] - floor) if back.sum() > 5 else 0.0,
        np.sqrt(
            max(min(np.log(shaded / both), np.log(fitted(one, dark)[0] / best)), 0.0)
        )
        if delta < 0
        else 0.0,
        float(not figures.has_dark[template]),
        np.log(covered / (level[seen] @ level[seen])),
        max(np.log(best / covered), 0.0),
    ]
    return columns, edge


@pytest.mark.parametrize(
    ("rim", "blur_m"), [(99, BLUR_M), (26, BLUR_M), (99, (0.008, 0.02))]
)
def test_evidence_is_that_of_least_squares_over_the_cells_in_view(rim: int, blur_m):
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
    i, j = np.divmod(templates.cells, templates.side) + np.array(
        [[3 + appearance._rim], [2 + appearance._rim]]
    )
    seen = (np.arange(side) < rim) & (
        rng.random((side, side)) > (0.0 if rim > side else 0.05)
    )
    seen = seen.astype(np.float32)
    for template, picture in enumerate(templates.pictures):
        level = rng.normal(40, 4, (side, side)).astype(np.float32)
        level[i, j] += (0.3 * picture, picture, -picture, 3 * np.minimum(picture, 0))[
            template % 4
        ]
        level[side // 2 + (5, 12)[template % 2] :] -= (0, 8)[template // 2 % 2]
        patch = Patch.of(level * seen, seen, np.zeros(2))
        another = (template + 1) % len(templates.design)
        at = np.array([[3, 2], [3, 3]])
        (found, rival), edges = figures.evidence(
            patch, np.array([template, another]), at
        )
        (own, edge), (of_another, edge_of_another) = (
            plain_evidence(figures, one, *place, patch)
            for one, place in zip((template, another), at, strict=True)
        )
        assert edges.tolist() == [edge, edge_of_another]
        is_edge |= {*(edges >= 0)}
        expected = np.array(own)
        shares = (own[9], of_another[9])
        expected[9] = min(shares) - expected[9]
        expected[[1, 2, 9, 10]] *= share
        expected[7] *= np.sqrt(share)
        np.testing.assert_allclose(found, expected, atol=5e-5)
        assert rival[9] == pytest.approx(share * (min(shares) - shares[1]), abs=5e-5)
        has |= {
            name
            for name, *values in zip(EVIDENCE, found, rival, strict=True)
            if any(values)
        }
    assert has == {*EVIDENCE} - ({"bare"} if figures.has_dark.all() else set())
    assert is_edge == {True, False}


def drawn(figure: Floats) -> LandmarkDesign:
    """A figure of 12 dB on the floor."""
    return LandmarkDesign(9, "figure", 0.6, np.where(figure, 12.0, np.nan))


def strangers() -> dict[str, LandmarkDesign | None]:
    places_m = 0.002 * (np.arange(300) - 149.5)
    x, y = np.meshgrid(places_m, -places_m)
    small = np.hypot(x, y) < 0.09
    ragged = np.hypot(x, y) < 0.13 + 0.05 * np.cos(
        3 * np.arctan2(y, x)
    ) + 0.03 * np.cos(5 * np.arctan2(y, x) + 1)
    return {
        "floor": None,
        "bar": design_of((0.0, 0.0, 0.25, 0.04), size_m=0.6),
        "a lid of another size": drawn(small),
        "ragged": drawn(ragged),
    }


@pytest.mark.parametrize("name", strangers())
def test_a_stranger_is_none(appearance, name):
    image = image_db(
        strangers()[name], (1.7, 0.0), 0.2, ROTATION, np.random.default_rng(3)
    )
    assert odds(_fit(appearance, image, (1.7, 0.0))).max() < -2


@pytest.mark.parametrize("design", DEFAULT_DESIGNS, ids=lambda design: design.name)
def test_the_rim_of_the_image_does_not_push_a_landmark_aside(appearance, design):
    for y_m in np.linspace(0.34, 0.46, 7):
        fit = _fit(appearance, image_db(design, (1.7, y_m), 0.6), (1.7, y_m - 0.02))
        if fit is not None:
            np.testing.assert_allclose(
                fit.centre_m[design.id - 1], (1.7, y_m), atol=0.004
            )
