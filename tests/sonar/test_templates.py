"""Laws of templates, and of patches of the floor."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.templates import PolarGrid, Templates, material_radius_m

from .polar_images import AZIMUTHS_RAD, HEIGHT_M, RANGES_M, floor_points, level_R_sonar


def half_plane(level_db: float = 10.0) -> LandmarkDesign:
    """Material on the side of positive x."""
    mask = np.full((200, 200), np.nan)
    mask[:, 100:] = level_db
    return LandmarkDesign(1, "half", 1.0, mask)


def places_m(templates: Templates) -> np.ndarray:
    """(x, y) of the cells, shape (cells, 2)."""
    middle = templates.side // 2
    return templates.cell_m * (np.stack(np.divmod(templates.cells, templates.side), axis=1) - middle)


def test_an_edge_is_as_blurred_as_the_sonar_sees_it():
    templates = Templates.of([half_plane()], 0.01, 0.0, 0.03)
    first = templates.pictures[templates.heading_rad == 0][0]
    x, y = places_m(templates).T
    near = (np.abs(x) < 0.1) & (np.abs(y) < 0.2)
    np.testing.assert_allclose(first[near], 5 * (1 + erf(x[near] / (0.03 * np.sqrt(2)))), atol=0.2)


def test_a_heading_turns_from_x_to_y():
    templates = Templates.of([half_plane()], 0.02, 0.0, 0.01)
    x, y = places_m(templates).T
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
    away_m = np.hypot(*places_m(templates).T)
    assert radius_m - 0.01 < away_m.max() <= radius_m
    area_m2 = np.pi * (material_m**2 + 2 / 3 * (radius_m**2 - material_m**2))  # a third of the ring is behind
    assert len(away_m) == pytest.approx(area_m2 / 0.01**2, rel=0.03)
    x, _ = places_m(templates).T
    assert away_m[x > 0.51 * away_m].max() <= material_m
    assert margin_m == 0 or away_m[x < 0.49 * away_m].max() > material_m + 0.03


def test_material_ends_where_the_mask_ends():
    mask = np.full((100, 100), np.nan)
    mask[50, 80] = 3.0
    assert material_radius_m(LandmarkDesign(1, "dot", 1.0, mask)) == pytest.approx(np.hypot(0.305, 0.005), abs=1e-9)


def test_headings_that_look_alike_are_one_template_and_designs_that_do_are_not():
    disc, square = DEFAULT_DESIGNS[:2]
    twin = LandmarkDesign(9, "twin", disc.size_m, disc.mask)
    assert np.bincount(Templates.of([disc, twin, square], 0.015, 0.03, 0.01).design).tolist() == [1, 1, 12]


def test_patch_shows_what_a_search_along_rays_finds():
    rotation = level_R_sonar(np.radians(29), np.radians(3))
    xy, lit = floor_points(rotation)
    grid, view = PolarGrid(RANGES_M, AZIMUTHS_RAD), FloorView(rotation, HEIGHT_M)
    for axis in range(2):
        image = np.where(lit, 100 * xy[..., axis], 0).astype(np.float32)
        patch = grid.patch(image, view, np.array([1.75, 0.02]), 21, 0.015)
        assert (patch.seen == 1).all()
        expected = np.array([1.75, 0.02])[axis] + 0.015 * (np.arange(21) - 10)
        shown = patch.level_db / 100
        np.testing.assert_allclose(
            shown, np.broadcast_to(expected[:, None] if axis == 0 else expected, shown.shape), atol=2e-3
        )


def test_order_of_beams_does_not_matter():
    rotation, rng = level_R_sonar(), np.random.default_rng(0)
    image = rng.normal(size=(96, 512)).astype(np.float32)
    view, centre = FloorView(rotation, HEIGHT_M), np.array([1.7, 0.0])
    left = PolarGrid(RANGES_M, AZIMUTHS_RAD).patch(image, view, centre, 21, 0.015)
    right = PolarGrid(RANGES_M, AZIMUTHS_RAD[::-1]).patch(image[::-1].copy(), view, centre, 21, 0.015)
    np.testing.assert_allclose(left.level_db, right.level_db, atol=1e-4)


def test_a_point_is_seen_when_all_bins_of_its_cell_are_in_the_image():
    """A fine grid over the far end, and one over the near end."""
    view, cell_m = FloorView(level_R_sonar(), HEIGHT_M), 0.004
    bin_m = RANGES_M[1] - RANGES_M[0]
    grid, image = PolarGrid(RANGES_M, AZIMUTHS_RAD), np.ones((96, 512), np.float32)
    for end_m in (RANGES_M[0], RANGES_M[-1]):
        centre = np.array([np.sqrt(end_m**2 - HEIGHT_M**2), 0.0])
        patch = grid.patch(image, view, centre, 41, cell_m)
        x = centre[0] + cell_m * (np.arange(41) - 20)
        y = cell_m * (np.arange(41) - 20)
        r = np.sqrt(x[:, None] ** 2 + y**2 + HEIGHT_M**2)
        bins = RANGES_M[0] + bin_m * np.arange(-60, 572)
        covered = np.abs(bins - r[..., None]) < cell_m / 2
        outside = covered[..., [*range(60), *range(572, 632)]].any(axis=2)
        np.testing.assert_array_equal(patch.seen, ~outside)
        np.testing.assert_allclose(patch.level_db, patch.seen, atol=1e-6)
