"""Laws of templates, of patches of the floor, of the fit of designs to them, and of the sightings that follow."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.special import erf

from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import Floats
from sonar_graph.sonar.appearance import CENTROID_SIGMA_M, Appearance, CandidateFit, DesignFit, ObjectSighting
from sonar_graph.sonar.confusion import Confusion, confusion_for
from sonar_graph.sonar.evidence import BEHIND, EVIDENCE, FAR, NEAR, Figures
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.templates import Patch, PolarGrid, Templates, azimuth, material_radius_m

from .polar_images import (
    AZIMUTHS_RAD,
    HEIGHT_M,
    RANGES_M,
    ROTATION,
    VIEW,
    candidates_at,
    floor_points,
    image_db,
    level_R_sonar,
    polar,
)

GRID = PolarGrid.of(RANGES_M, AZIMUTHS_RAD)


@pytest.fixture(scope="module")
def appearance() -> Appearance:
    return Appearance(DEFAULT_DESIGNS)


def _fit(
    appearance: Appearance, image: Floats, near_m: tuple[float, float], view: FloorView = VIEW
) -> DesignFit | None:
    return appearance.fit(GRID.patch(image, view, np.array(near_m), appearance.patch_side, appearance.params.cell_m))


def half_plane() -> LandmarkDesign:
    """10 dB of material on the side of positive x."""
    mask = np.full((200, 200), np.nan)
    mask[:, 100:] = 10.0
    return LandmarkDesign(1, "half", 1.0, mask)


def places_m(templates: Templates) -> Floats:
    """(x, y) of the cells, shape (2, cells)."""
    return templates.cell_m * (np.stack(np.divmod(templates.cells, templates.side)) - templates.side // 2)


def test_an_edge_is_as_blurred_as_the_sonar_sees_it():
    templates = Templates.of([half_plane()], 0.01, 0.0, 0.03)
    first = templates.pictures[templates.heading_rad == 0][0]
    x, y = places_m(templates)
    near = (np.abs(x) < 0.1) & (np.abs(y) < 0.2)
    np.testing.assert_allclose(first[near], 5 * (1 + erf(x[near] / (0.03 * np.sqrt(2)))), atol=0.2)


def test_a_heading_turns_from_x_to_y():
    templates = Templates.of([half_plane()], 0.02, 0.0, 0.01)
    x, y = places_m(templates)
    for heading_rad in (0.0, np.pi / 2, np.pi, 5 * np.pi / 4):
        (picture,) = templates.pictures[np.isclose(templates.heading_rad, heading_rad)]
        ahead = x * np.cos(heading_rad) + y * np.sin(heading_rad)
        inside = np.hypot(x, y) < 0.4
        assert (picture[inside & (ahead > 0.05)] > 9.9).all()
        assert (picture[inside & (ahead < -0.05)] < 0.1).all()


@pytest.mark.parametrize("margin_m", [0.0, 0.05])
def test_cells_are_those_of_a_disc_with_a_margin_around_the_largest_design_but_for_its_shadow(margin_m: float):
    templates = Templates.of(DEFAULT_DESIGNS, 0.01, margin_m, 0.01)
    material_m = max(map(material_radius_m, DEFAULT_DESIGNS))
    radius_m = material_m + margin_m
    x, y = places_m(templates)
    away_m = np.hypot(x, y)
    assert radius_m - 0.01 < away_m.max() <= radius_m
    area_m2 = np.pi * (material_m**2 + 2 / 3 * (radius_m**2 - material_m**2))  # a third of the ring is behind
    assert len(away_m) == pytest.approx(area_m2 / 0.01**2, rel=0.03)
    assert away_m[x > 0.51 * away_m].max() <= material_m
    assert margin_m == 0 or away_m[x < 0.49 * away_m].max() > material_m + 0.03


def test_material_ends_where_the_mask_ends_and_headings_that_look_alike_are_one_template_of_each_design():
    mask = np.full((100, 100), np.nan)
    mask[50, 80] = 3.0
    assert material_radius_m(LandmarkDesign(1, "dot", 1.0, mask)) == pytest.approx(np.hypot(0.305, 0.005), abs=1e-9)
    disc, square = DEFAULT_DESIGNS[:2]
    twin = LandmarkDesign(9, "twin", disc.size_m, disc.mask)
    assert np.bincount(Templates.of([disc, twin, square], 0.015, 0.03, 0.01).design).tolist() == [1, 1, 12]


def test_a_patch_shows_what_a_search_along_rays_finds_whatever_the_order_of_beams():
    rotation, centre = level_R_sonar(np.radians(29), np.radians(3)), np.array([1.75, 0.02])
    xy, lit = floor_points(rotation)
    view, cells_m = FloorView(rotation, HEIGHT_M), 0.015 * (np.arange(21) - 10)
    for axis, expected in enumerate(np.meshgrid(centre[0] + cells_m, centre[1] + cells_m, indexing="ij")):
        image = np.where(lit, 100 * xy[..., axis], 0).astype(np.float32)
        turned = PolarGrid.of(RANGES_M, AZIMUTHS_RAD[::-1])
        for patch in (GRID.patch(image, view, centre, 21, 0.015), turned.patch(image[::-1], view, centre, 21, 0.015)):
            assert (patch.seen == 1).all()
            np.testing.assert_allclose(patch.level_db / 100, expected, atol=2e-3)


def test_a_point_is_seen_when_all_bins_of_its_cell_are_in_the_image():
    """A fine grid over the far end, and one over the near end."""
    cell_m, bin_m, image = 0.004, RANGES_M[1] - RANGES_M[0], np.ones((96, 512), np.float32)
    for end_m in (RANGES_M[0], RANGES_M[-1]):
        centre, cells_m = np.array([np.sqrt(end_m**2 - HEIGHT_M**2), 0.0]), cell_m * (np.arange(41) - 20)
        patch = GRID.patch(image, VIEW, centre, 41, cell_m)
        r = np.sqrt((centre[0] + cells_m[:, None]) ** 2 + cells_m**2 + HEIGHT_M**2)
        covered = np.abs(RANGES_M[0] + bin_m * np.arange(-60, 572) - r[..., None]) < cell_m / 2
        outside = covered[..., [*range(60), *range(572, 632)]].any(axis=2)
        np.testing.assert_array_equal(patch.seen, ~outside)
        np.testing.assert_allclose(patch.level_db, patch.seen, atol=1e-6)


@given(st.floats(2.0, 15.0), st.integers(128, 1024))
@example(10.0, 512)
@example(15.0, 128)
@example(0.015 * 512, 512)
def test_a_patch_has_a_value_wherever_the_image_has_data_whatever_the_window(window_m: float, bins: int):
    """A constant image gives a constant patch, and an image of its ranges the range of each cell."""
    cell_m, bin_m = 0.015, window_m / bins
    ranges_m = 0.7 + bin_m * (np.arange(bins) + 0.5)
    grid, (x, y) = PolarGrid.of(ranges_m, AZIMUTHS_RAD), 1.75 + cell_m * (np.mgrid[:41, :41] - 20.0)
    r = np.sqrt(x**2 + (y - 1.75) ** 2 + HEIGHT_M**2)
    flat, sloped = (
        grid.patch(np.tile(level, (96, 1)).astype(np.float32), VIEW, np.array([1.75, 0.0]), 41, cell_m)
        for level in (np.full(bins, 37.0), 100 * ranges_m)
    )
    np.testing.assert_array_equal(flat.seen, 1)
    np.testing.assert_allclose(flat.level_db, 37.0, rtol=1e-6)
    np.testing.assert_allclose(sloped.level_db / 100, r, atol=1e-5 if bin_m > cell_m else bin_m / 2 + 1e-5)


@pytest.mark.parametrize("bin_m", [0.0024, 0.0149, 0.0151, 0.03])
def test_what_lies_beyond_the_first_or_last_bin_is_not_seen(bin_m: float):
    """Patches across the ends of a window: a cell reaches half of itself beyond a bin's middle, a finer one not."""
    cell_m, end_m = 0.015, np.hypot(1.75, HEIGHT_M)
    x, y = cell_m * (np.mgrid[:41, :41] - 20.0)
    r, reach_m = np.sqrt((1.75 + x) ** 2 + y**2 + HEIGHT_M**2), 0.0 if bin_m > cell_m else cell_m / 2
    for ranges_m in (end_m + bin_m * np.arange(-50, 1), end_m + bin_m * np.arange(51)):
        image = np.ones((96, 51), np.float32)
        patch = PolarGrid.of(ranges_m, AZIMUTHS_RAD).patch(image, VIEW, np.array([1.75, 0.0]), 41, cell_m)
        inside = (r > ranges_m[0] + reach_m) & (r < ranges_m[-1] - reach_m)
        outside = (r < ranges_m[0] - reach_m) | (r > ranges_m[-1] + reach_m)
        assert inside.any()
        assert outside.any()
        np.testing.assert_array_equal(patch.seen[inside], 1)
        np.testing.assert_array_equal(patch.seen[outside], 0)
        np.testing.assert_array_equal(patch.level_db, patch.seen)


@pytest.mark.parametrize("index", range(len(DEFAULT_DESIGNS)))
@pytest.mark.parametrize("heading_rad", [0.3, 2.0, -2.6])
def test_every_design_is_known_at_every_heading_in_speckle(appearance, index, heading_rad):
    rotation = level_R_sonar(np.radians(31), np.radians(-2))
    image = image_db(DEFAULT_DESIGNS[index], (1.7, 0.05), heading_rad, rotation, np.random.default_rng(index))
    fit = _fit(appearance, image, (1.72, 0.03), FloorView(rotation, HEIGHT_M))
    found = odds(fit)
    assert found[index] > 5
    assert np.delete(found, index).max() < found[index] - 10
    np.testing.assert_allclose(fit.centre_m[index], [1.7, 0.05], atol=0.008)


@pytest.mark.parametrize("rim", [47, 44, 35, 30])
def test_places_and_headings_are_those_of_the_best_correlation_over_the_cells_in_view(appearance, rim: int):
    """A landmark in noise, of which the image holds the first columns; all shifts and headings by `np.corrcoef`."""
    templates, side, rng = appearance.templates, appearance.patch_side, np.random.default_rng(rim)
    x, y = np.divmod(templates.cells, templates.side)
    steps, row = range(2 * appearance._steps + 1), len(templates.design) // 2
    level = rng.normal(40, 4, (side, side)).astype(np.float32)
    level[x + appearance._rim + 3, y + appearance._rim + 1] += templates.pictures[row]
    seen = np.tile(np.arange(side) < rim, (side, 1)).astype(np.float32)
    fit = appearance.fit(Patch.of(level * seen, seen, np.zeros(2)))
    best = (-1.0, 0, 0, 0, 0.0)
    for i, j in ((i, j) for i in steps for j in steps):
        held = seen[x + appearance._rim + i, y + appearance._rim + j] > 0
        if held.mean() >= appearance.params.least_searched:
            window = level[x + appearance._rim + i, y + appearance._rim + j][held]
            for n, picture in enumerate(templates.pictures):
                best = max(best, (float(np.corrcoef(window, picture[held])[0, 1]), n, i, j, float(held.mean())))
    _, template, i, j, visible = best
    if visible < appearance.params.least_visible:
        assert fit is None
        return
    design = templates.design[template]
    assert template == row
    assert fit.heading_rad[design] == templates.heading_rad[template]
    np.testing.assert_allclose(fit.centre_m[design], 0.015 * (np.array([i, j]) - appearance._steps), atol=0.002)
    assert fit.visible == pytest.approx(visible, abs=0.12)


def odds(fit: DesignFit, model: Confusion | None = None) -> np.ndarray:
    return (model or MODEL).log_odds(fit.evidence)


def plain_evidence(figures: Figures, template: int, x: int, y: int, patch: Patch) -> list[float]:
    """The equations of the module in NumPy: least squares on the cells in view, over and over."""
    rows, side = slice(*figures.first[template : template + 2]), len(patch.seen)
    i, j = np.divmod(figures.cells[rows], side) + np.array([[x], [y]])
    seen, held = patch.seen[i, j] > 0, patch.held[i, j] > 0.5
    level = patch.level_db[i, j] - patch.level_db[i, j][seen].mean()
    smooth = patch.smooth_db[i, j] - patch.level_db[i, j][seen].mean()
    values, zones, design = figures.values[rows].astype(float), figures.zones[rows], figures.smooth[rows]

    def fitted(*columns: int) -> tuple[float, Floats]:
        A, z = values[seen][:, columns], level[seen].astype(float)
        c = np.linalg.solve(A.T @ A + 1e-3 * np.eye(len(columns)), A.T @ z)
        return z @ z - c @ (A.T @ z), c

    one, dark, figure, shades = 0, 1, 2, len(values[0]) // 2 + 1
    plain, (floor, beta) = fitted(one, figure)
    delta, best, shaded = 0.0, plain, plain
    if figures.has_dark[template] and fitted(one, figure, dark)[1][2] < 0:
        best, (floor, beta, delta) = fitted(one, figure, dark)
    if fitted(one, figure, shades)[1][2] < 0:
        shaded = fitted(one, figure, shades)[0]
    both = min(best, shaded)
    if delta < 0 and shaded < plain and max(fitted(one, figure, dark, shades)[1][2:]) < 0:
        both = fitted(one, figure, dark, shades)[0]
    others = [shaded]
    for q in range(1, shades - figure):
        with_shade, c = fitted(one, figure + q, shades + q)
        others.append(with_shade if c[2] < 0 else fitted(one, figure + q)[0])
    off = smooth - floor - beta * design[:, 1] - delta * design[:, 0]
    near, far, back = ((zones & zone > 0) & held for zone in (NEAR, FAR, BEHIND))
    back &= seen
    mean_square = best / seen.sum()
    return [
        1.0,
        np.log(min(others) / both),
        np.log(min(fitted(one, figure + q)[0] for q in range(shades - figure)) / plain),
        np.log(max(beta, 0.5) / np.sqrt(mean_square)),
        np.log((np.mean(np.maximum(off[near], 0) ** 2) if near.sum() > 8 else mean_square / 3) + 0.3),
        np.log((np.mean(np.minimum(off[far], 0) ** 2) if far.sum() > 8 else mean_square / 3) + 0.3),
        np.mean(level[back] - floor) if back.sum() > 5 else 0.0,
        np.sqrt(max(np.log(shaded / both), 0.0)),
        float(not figures.has_dark[template]),
    ]


@pytest.mark.parametrize("rim", [99, 30, 26])
def test_evidence_is_that_of_least_squares_over_the_cells_in_view(appearance, rim: int):
    """Every design in rough noise, with its plate or dark behind; or the first columns of it, with holes."""
    templates, figures, rng = appearance.templates, appearance.figures, np.random.default_rng(rim)
    side, has = appearance.patch_side, set()
    i, j = np.divmod(templates.cells, templates.side) + np.array([[3 + appearance._rim], [2 + appearance._rim]])
    seen = (np.arange(side) < rim) & (rng.random((side, side)) > (0.0 if rim > side else 0.05))
    seen = seen.astype(np.float32)
    for template in range(len(templates.design)):
        level = rng.normal(40, 4, (side, side)).astype(np.float32)
        level[i, j] += (0.3, 1.0)[template % 2] * templates.pictures[template]
        level[side // 2 + (5, 12)[template % 2] :] -= (0, 8)[template // 2 % 2]
        patch = Patch.of(level * seen, seen, np.zeros(2))
        (found,) = figures.evidence(patch, np.array([template]), np.array([[3, 2]]))
        np.testing.assert_allclose(found, plain_evidence(figures, template, 3, 2, patch), atol=5e-5)
        has |= {name for name, value in zip(EVIDENCE, found, strict=True) if value != 0}
    assert has == {*EVIDENCE} - ({"bare"} if figures.has_dark.all() else set())


@pytest.mark.parametrize("width", [11, 23])
def test_zones_of_which_only_a_few_cells_are_in_view_say_nothing(appearance, width: int):
    """Only the middle is in view: at its rim lie the first cells next to the figure, behind it, or farther out."""
    templates, figures, rng = appearance.templates, appearance.figures, np.random.default_rng(width)
    side = appearance.patch_side
    inside = np.abs(np.arange(side) - side // 2) <= width // 2
    seen = (inside[:, None] & inside).astype(np.float32)
    for template in range(len(templates.design)):
        patch = Patch.of(rng.normal(40, 4, (side, side)).astype(np.float32) * seen, seen, np.zeros(2))
        (found,) = figures.evidence(patch, np.array([template]), np.array([[3, 2]]))
        np.testing.assert_allclose(found[4:7], plain_evidence(figures, template, 3, 2, patch)[4:7], atol=2e-3)


def test_gain_and_floor_level_change_nothing(appearance):
    """Decibels are as the sonar's gain lifts them; the heading of a triangle is found up to its symmetry."""
    image = image_db(DEFAULT_DESIGNS[2], (1.7, 0.0), 0.4, ROTATION, np.random.default_rng(0))
    plain, other = (_fit(appearance, picture, (1.7, 0.0)) for picture in (image, image + 20))
    np.testing.assert_allclose(other.evidence, plain.evidence, atol=2e-3)
    off = (plain.heading_rad[2] - 0.4) % (2 * np.pi / 3)
    assert min(off, 2 * np.pi / 3 - off) < np.radians(5)


def test_a_patch_of_one_level_says_nothing(appearance):
    image = image_db(DEFAULT_DESIGNS[2], (1.7, 0.0), 0.4, ROTATION, np.random.default_rng(0))
    assert _fit(appearance, np.full_like(image, 30.0), (1.7, 0.0)) is None
    assert _fit(appearance, image, (1.7, 0.0)) is not None


@pytest.mark.parametrize("design", DEFAULT_DESIGNS, ids=lambda design: design.name)
def test_weaker_contrast_lowers_the_odds_and_not_the_ranking(appearance, design):
    strong, weak = (
        odds(_fit(appearance, image_db(weaker(design, by_db), (1.7, 0.0), 0.3, ROTATION, rng), (1.7, 0.0)))
        for by_db, rng in zip((3.0, 9.0), map(np.random.default_rng, (1, 1)), strict=True)
    )
    assert strong.argmax() == weak.argmax() == design.id - 1
    assert strong.max() > weak.max() > 0


def weaker(design: LandmarkDesign, by_db: float) -> LandmarkDesign:
    """Its foam that much less bright."""
    return replace(design, mask=np.where(design.mask > 0, design.mask - by_db, design.mask))


def on_floor(design: LandmarkDesign) -> LandmarkDesign:
    """Its bright figure without the plate."""
    return replace(design, mask=np.where(design.mask > 0, design.mask, np.nan))


@pytest.mark.parametrize("design", DEFAULT_DESIGNS, ids=lambda design: design.name)
def test_a_plate_that_is_not_seen_is_no_evidence_against_a_design(appearance, design):
    seen, unseen = (
        _fit(appearance, image_db(one, (1.7, 0.0), 0.3, ROTATION, np.random.default_rng(2)), (1.7, 0.0))
        for one in (design, on_floor(design))
    )
    plate = EVIDENCE.index("plate")
    assert unseen.evidence[design.id - 1, plate] < 0.5 * seen.evidence[design.id - 1, plate]
    assert odds(unseen).argmax() == design.id - 1
    assert odds(unseen).max() > 0


def drawn(figure: Floats, below_db: float | None = None) -> LandmarkDesign:
    """A figure of 12 dB, and where it is not a level or the floor."""
    return LandmarkDesign(9, "figure", 0.6, np.where(figure, 12.0, np.nan if below_db is None else below_db))


def strangers() -> dict[str, LandmarkDesign | None]:
    x, y = np.meshgrid(0.002 * (np.arange(300) - 149.5), 0.002 * (149.5 - np.arange(300)))
    bar, small = (np.abs(y) < 0.04) & (np.abs(x) < 0.25), np.hypot(x, y) < 0.09
    ragged = np.hypot(x, y) < 0.13 + 0.05 * np.cos(3 * np.arctan2(y, x)) + 0.03 * np.cos(5 * np.arctan2(y, x) + 1)
    return {
        "floor": None, "bar": drawn(bar), "a lid of another size": drawn(small), "ragged": drawn(ragged),
    }  # fmt: skip


@pytest.mark.parametrize("name", strangers())
def test_a_stranger_is_none(appearance, name):
    image = image_db(strangers()[name], (1.7, 0.0), 0.2, ROTATION, np.random.default_rng(3))
    assert odds(_fit(appearance, image, (1.7, 0.0))).max() < -2


def test_a_long_shadow_speaks_against_a_design(appearance):
    """A square with the floor dark behind it as far as something 5 cm high would shade it, or not."""
    square = on_floor(DEFAULT_DESIGNS[1])
    image = image_db(square, (1.7, 0.0), 0.0, ROTATION, np.random.default_rng(4))
    shaded = image.copy()
    r, a = np.meshgrid(RANGES_M, AZIMUTHS_RAD)
    x = np.sqrt(np.maximum((r * np.cos(a)) ** 2 + 0 * a, 0))
    first, last = (polar((1.7 + d, 0.0))[0] for d in (0.15, 0.24))
    dark = (r > first) & (r < last) & (np.abs(r * np.sin(a)) < 0.13) & (x > 0)
    shaded[dark] -= 15
    plain, behind = (odds(_fit(appearance, one, (1.7, 0.0)))[1] for one in (image, shaded))
    assert behind < plain - 1


@pytest.mark.parametrize("design", DEFAULT_DESIGNS, ids=lambda design: design.name)
def test_the_rim_of_the_image_does_not_push_a_landmark_aside(appearance, design):
    for y_m in np.linspace(0.34, 0.46, 7):
        fit = _fit(appearance, image_db(design, (1.7, y_m), 0.6), (1.7, y_m - 0.02))
        if fit is not None:
            np.testing.assert_allclose(fit.centre_m[design.id - 1], (1.7, y_m), atol=0.004)


APERTURE_RAD = 0.244
SETTINGS = {"bin_m": None, "height_bias_m": 0.0, "range_sigma_m": 0.01, "azimuth_sigma_rad": 0.004}
MODEL = confusion_for(DEFAULT_DESIGNS).model_copy(update=SETTINGS)
TRIANGLE = 2


def frame(image: Floats, ranges_m: Floats = RANGES_M, azimuths_rad: Floats = AZIMUTHS_RAD) -> SonarFrames:
    return SonarFrames(np.array([1]), image[None], ranges_m, azimuths_rad)


def look_at(
    appearance: Appearance,
    image: Floats,
    near_m: tuple[float, float],
    model: Confusion = MODEL,
    view: FloorView | None = VIEW,
    aperture_rad: float = APERTURE_RAD,
) -> ObjectSighting:
    """A look at a candidate near a point of the floor."""
    r, a = polar(near_m)
    look = CandidateFit(appearance, model, aperture_rad)
    return look.at(image, frame(image), view, candidates_at([r], [a]), np.array([0]))[0]


@pytest.fixture(scope="module")
def triangle() -> np.ndarray:
    return image_db(DEFAULT_DESIGNS[TRIANGLE], (1.7, 0.05), 0.5, ROTATION, np.random.default_rng(0))


def test_range_and_azimuth_are_those_of_the_centre_and_less_certain_where_partly_in_view(appearance, triangle):
    found = look_at(appearance, triangle, (1.725, 0.03))
    r, a = polar((1.7, 0.05))
    assert odds(found.fit).argmax() == TRIANGLE
    assert (found.range_m, found.azimuth_rad) == (pytest.approx(r, abs=0.006), pytest.approx(a, abs=0.004))
    np.testing.assert_allclose(found.covariance, np.diag([0.01**2, 0.004**2]) / found.fit.visible**4)
    found = look_at(appearance, image_db(DEFAULT_DESIGNS[0], (1.7, 0.34), 0.0), (1.7, 0.33))
    assert 0.8 <= found.fit.visible < 0.97
    np.testing.assert_allclose(found.covariance, np.diag([0.01**2, 0.004**2]) / found.fit.visible**4)


def test_what_is_seen_in_longer_bins_than_the_models_is_less_certain_by_the_looks_that_it_lacks(appearance, triangle):
    bin_m = RANGES_M[1] - RANGES_M[0]
    plain, finer = (
        look_at(appearance, triangle, (1.7, 0.05), MODEL.model_copy(update={"bin_m": of})) for of in (bin_m, bin_m / 5)
    )
    np.testing.assert_allclose(finer.covariance, 5 * plain.covariance)
    assert finer.bin_m == pytest.approx(bin_m)


def test_a_face_that_is_higher_than_the_landmarks_place_seems_nearer_by_what_is_added(appearance, triangle):
    high = MODEL.model_copy(update={"height_bias_m": 0.02})
    plain, found = (look_at(appearance, triangle, (1.7, 0.05), model) for model in (MODEL, high))
    assert found.range_m - plain.range_m == pytest.approx(0.02 * HEIGHT_M / plain.range_m, rel=1e-6)
    assert look_at(appearance, triangle, (1.7, 0.05), high, view=None).range_per_height == 0.0


@pytest.mark.parametrize(
    ("near_m", "view", "aperture_rad"),
    [
        ((1.7, 0.75), VIEW, APERTURE_RAD),  # hardly in the image
        ((0.9, 0.0), FloorView(ROTATION, 2.0), APERTURE_RAD),  # no ray meets the floor there
        ((1.95, 0.05), VIEW, 0.05),  # a fan of a fifth of the opening shows a strip of it
    ],
)
def test_what_is_not_in_view_is_compared_with_nothing(appearance, triangle, near_m, view, aperture_rad):
    found = look_at(appearance, triangle, near_m, view=view, aperture_rad=aperture_rad)
    assert found.fit is None
    r, a = polar(near_m)
    assert (found.range_m, found.azimuth_rad) == (r, a)
    np.testing.assert_allclose(found.covariance, np.diag([CENTROID_SIGMA_M**2, (CENTROID_SIGMA_M / r) ** 2]))


def test_rows_say_which_candidate_and_odds_are_those_of_the_model(appearance, triangle):
    r, a = polar((1.7, 0.05))
    look = CandidateFit(appearance, MODEL, APERTURE_RAD)
    candidates = candidates_at([2.05, r], [-0.1, a])
    none, seen, beside = look.at(triangle, frame(triangle), VIEW, candidates, np.array([-1, 1, 0]))
    assert none is None
    assert beside.azimuth_rad == pytest.approx(-0.1, abs=0.05)
    found = look.log_odds([none, seen, beside])
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1], [*MODEL.log_odds(seen.fit.evidence), 0.0])
    assert found[1].argmax() == TRIANGLE


def test_candidates_of_one_frame_are_seen_as_each_alone(appearance, triangle):
    """Of three the middle one is not in view, and its row of the others is not the frame's."""
    places = [polar(xy) for xy in ((1.7, 0.07), (1.7, 0.75), (1.69, 0.04))]
    look = CandidateFit(appearance, MODEL.model_copy(update={"height_bias_m": 0.02}), APERTURE_RAD)

    def seen(*of: tuple[float, float]) -> list[ObjectSighting]:
        return look.at(
            triangle, frame(triangle), VIEW, candidates_at(*map(list, zip(*of, strict=True))), np.arange(len(of))
        )

    for one, (other,) in zip(seen(*places), map(seen, places), strict=True):
        assert (one.fit is None) == (other.fit is None)
        assert (one.range_m, one.azimuth_rad, one.range_per_height) == pytest.approx(
            (other.range_m, other.azimuth_rad, other.range_per_height), rel=1e-12
        )
        np.testing.assert_array_equal(one.covariance, other.covariance)


def test_azimuths_are_those_of_the_arctangent_all_round():
    angles_rad = np.linspace(-3.14, 3.14, 1001)
    found = [azimuth(3 * np.cos(a), 3 * np.sin(a)) for a in angles_rad.tolist()]
    np.testing.assert_allclose(found, angles_rad, atol=1e-7)


def test_other_beams_and_bins_are_looked_up_anew(appearance, triangle):
    """A log may change its window on the way: beams the other way round, fewer bins, farther bins."""
    look, (r, a) = CandidateFit(appearance, MODEL, APERTURE_RAD), polar((1.7, 0.05))
    first, turned, fewer, farther = (
        look.at(image, frame(image, *window), VIEW, candidates_at([r], [a]), np.array([0]))[0].fit.evidence
        for image, *window in (
            (triangle, RANGES_M, AZIMUTHS_RAD),
            (np.ascontiguousarray(triangle[::-1]), RANGES_M, AZIMUTHS_RAD[::-1].copy()),
            (np.ascontiguousarray(triangle[:, :400]), RANGES_M[:400], AZIMUTHS_RAD),
            (triangle, RANGES_M + 0.1, AZIMUTHS_RAD),
        )
    )
    np.testing.assert_allclose([turned, fewer], [first, first], atol=5e-3)
    assert abs(farther - first).max() > 0.05


def test_without_a_floor_the_patch_lies_in_the_plane_of_the_image(appearance):
    """A design drawn in that plane is found; on the floor's grid it would be foreshortened."""
    r, a = np.meshgrid(RANGES_M, AZIMUTHS_RAD)
    level = np.nan_to_num(DEFAULT_DESIGNS[1].level_db(r * np.cos(a) - 1.9, r * np.sin(a) - 0.1)) + 35.0
    image = (level + 10 * np.log10(np.random.default_rng(3).exponential(size=level.shape))).astype(np.float32)
    r, a = np.hypot(1.9, 0.1), np.arctan2(0.1, 1.9)
    candidate, look = candidates_at([r], [a]), CandidateFit(appearance, MODEL, APERTURE_RAD)
    flat, tilted = (look.at(image, frame(image), view, candidate, np.array([0]))[0] for view in (None, VIEW))
    assert odds(flat.fit).argmax() == 1
    assert (flat.range_m, flat.azimuth_rad) == (pytest.approx(r, abs=0.006), pytest.approx(a, abs=0.003))
    assert tilted.fit is None or odds(tilted.fit)[1] < odds(flat.fit)[1] - 1
