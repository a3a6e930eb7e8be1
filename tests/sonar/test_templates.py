from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.sonar.templates import Templates, material_radius_m


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


def test_material_ends_where_the_mask_ends():
    mask = np.full((100, 100), np.nan)
    mask[50, 80] = 3.0
    assert material_radius_m(LandmarkDesign(1, "dot", 1.0, mask)) == pytest.approx(np.hypot(0.305, 0.005), abs=1e-9)


def test_designs_that_look_alike_have_templates_each():
    disc = DEFAULT_DESIGNS[0]
    twin = LandmarkDesign(9, "twin", disc.size_m, disc.mask)
    assert np.bincount(Templates.of([disc, twin], 0.02, 0.0, 0.01).design).tolist() == [1, 1]


def test_floor_behind_a_landmark_is_not_compared():
    templates = Templates.of(DEFAULT_DESIGNS, 0.01, 0.05, 0.01)
    x, y = places_m(templates).T
    away_m = np.hypot(x, y)
    material_m = max(map(material_radius_m, DEFAULT_DESIGNS))
    assert away_m[x > 0.51 * away_m].max() <= material_m
    assert away_m[x < 0.49 * away_m].max() > material_m + 0.03
