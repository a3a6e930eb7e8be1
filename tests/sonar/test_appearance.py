from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.sonar.appearance import Appearance, AppearanceParams, DesignFit
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.templates import Patch, PolarGrid

from .polar_images import AZIMUTHS_RAD, HEIGHT_M, RANGES_M, image_db, level_R_sonar

GRID = PolarGrid(RANGES_M, AZIMUTHS_RAD)


@pytest.fixture(scope="module")
def appearance() -> Appearance:
    return Appearance(DEFAULT_DESIGNS)


def _fit(appearance: Appearance, image: np.ndarray, rotation: np.ndarray, near_m: tuple[float, float]) -> DesignFit:
    view = FloorView(rotation, HEIGHT_M)
    patch = GRID.patch(image, view, np.array(near_m), appearance.patch_side, appearance.params.cell_m)
    return appearance.fit(patch)


@pytest.mark.parametrize("index", range(len(DEFAULT_DESIGNS)))
@pytest.mark.parametrize("heading_rad", [0.3, 2.0, -2.6])
def test_every_design_is_known_at_every_heading_in_speckle(appearance, index, heading_rad):
    rng = np.random.default_rng(index)
    rotation = level_R_sonar(np.radians(31), np.radians(-2))
    image = image_db(DEFAULT_DESIGNS[index], (1.7, 0.05), heading_rad, rotation, rng)
    fit = _fit(appearance, image, rotation, (1.72, 0.03))
    assert fit.best == index
    assert fit.correlation[index] > 0.75
    assert fit.correlation[index] - np.delete(fit.correlation, index).max() > 0.02
    np.testing.assert_allclose(fit.centre_m, [1.7, 0.05], atol=0.008)


def test_heading_of_a_triangle_is_found_up_to_its_symmetry(appearance):
    rotation = level_R_sonar()
    fit = _fit(appearance, image_db(DEFAULT_DESIGNS[2], (1.7, 0.0), 0.4, rotation, None), rotation, (1.7, 0.0))
    off = (fit.heading_rad - 0.4) % (2 * np.pi / 3)
    assert min(off, 2 * np.pi / 3 - off) < np.radians(5)


def test_neither_gain_nor_floor_level_matter(appearance):
    rotation = level_R_sonar()
    image = image_db(DEFAULT_DESIGNS[3], (1.7, 0.0), 1.0, rotation, np.random.default_rng(0))
    plain = _fit(appearance, image, rotation, (1.7, 0.0))
    other = _fit(appearance, 0.5 * image + 20, rotation, (1.7, 0.0))
    np.testing.assert_allclose(other.correlation, plain.correlation, atol=1e-3)


@pytest.mark.parametrize("rim", [39, 36, 27, 22])
def test_the_best_fit_is_that_of_numpy_over_the_cells_in_view(appearance, rim: int):
    """All shifts and headings by `np.corrcoef`, on noise of which the image holds the first columns."""
    templates, side = appearance.templates, appearance.patch_side
    seen = np.broadcast_to(np.arange(side) < rim, (side, side)).astype(np.float32)
    level = np.random.default_rng(rim).normal(40, 5, (side, side)).astype(np.float32) * seen
    x, y = np.divmod(templates.cells, templates.side)
    steps = range(side - templates.side + 1)
    best: dict[int, tuple[float, float, int]] = {}
    for i, j in ((i, j) for i in steps for j in steps):
        held = seen[x + i, y + j] > 0
        if held.mean() >= appearance.params.least_searched:
            window = level[x + i, y + j][held]
            for picture, design in zip(templates.pictures, templates.design.tolist(), strict=True):
                found = float(np.corrcoef(window, picture[held])[0, 1]), float(held.mean()), design
                best[design] = max(best.get(design, found), found)
    highest = max(best.values())
    fit = appearance.fit(Patch(level, seen, np.zeros(2)))
    assert fit.best == highest[2]
    assert fit.visible == pytest.approx(highest[1], abs=1e-6)
    wanted = [best[design][0] for design in range(appearance.designs)] if highest[1] >= 0.8 else [-1.0] * 4
    assert fit.correlation == pytest.approx(wanted, abs=1e-5)


def test_bare_floor_and_a_bar_fit_no_design_well(appearance):
    rotation, rng = level_R_sonar(), np.random.default_rng(3)
    bar = np.full((60, 60), np.nan)
    bar[24:36] = 12.0
    for design in (None, LandmarkDesign(9, "bar", 0.42, bar)):
        fit = _fit(appearance, image_db(design, (1.7, 0.0), 0.2, rotation, rng), rotation, (1.7, 0.0))
        assert fit.correlation.max() < 0.7


def test_a_wrong_height_costs_correlation(appearance):
    rotation = level_R_sonar()
    image = image_db(DEFAULT_DESIGNS[1], (1.7, 0.0), 0.4, rotation, None)
    right = _fit(appearance, image, rotation, (1.7, 0.0))
    patch = GRID.patch(image, FloorView(rotation, 0.5), np.array([1.9, 0.0]), appearance.patch_side, 0.015)
    assert appearance.fit(patch).correlation[1] < right.correlation[1] - 0.05


def test_a_landmark_at_the_edge_counts_by_what_is_in_view(appearance):
    rotation = level_R_sonar()
    image = image_db(DEFAULT_DESIGNS[0], (1.7, 0.37), 0.0, rotation, None)
    partly = _fit(appearance, image, rotation, (1.7, 0.37))
    assert partly.best == 0
    assert appearance.params.least_visible <= partly.visible < 0.95
    gone = _fit(appearance, image, rotation, (1.7, 0.75))
    assert (gone.correlation == -1).all()


@pytest.mark.parametrize("design", DEFAULT_DESIGNS, ids=lambda design: design.name)
@pytest.mark.parametrize("y_m", np.linspace(0.34, 0.46, 7))
def test_the_rim_of_the_image_does_not_push_a_landmark_aside(appearance, design, y_m: float):
    rotation = level_R_sonar()
    image = image_db(design, (1.7, y_m), 0.6, rotation, None)
    fit = _fit(appearance, image, rotation, (1.7, y_m - 0.02))
    if fit.correlation.max() > 0:
        np.testing.assert_allclose(fit.centre_m, (1.7, y_m), atol=0.003)


def test_a_disc_needs_one_template_and_a_square_a_quarter_of_the_headings(appearance):
    counts = np.bincount(appearance.templates.design)
    assert counts[0] == 1
    assert counts[1] == 12


def test_correlation_is_that_of_the_cells_in_view_at_the_best_shift_and_heading():
    """By brute force with another library's correlation, on a patch of noise with holes."""
    params = AppearanceParams(cell_m=0.03, search_m=0.03)
    appearance = Appearance(DEFAULT_DESIGNS, params)
    rng, side, templates = np.random.default_rng(5), appearance.patch_side, appearance.templates
    level = rng.normal(30, 5, (side, side)).astype(np.float32)
    seen = (rng.random((side, side)) < 0.97).astype(np.float32)
    fit = appearance.fit(Patch(level * seen, seen, np.zeros(2)))
    x, y = np.divmod(templates.cells, templates.side)
    best = np.full(len(DEFAULT_DESIGNS), -1.0)
    for shift_x, shift_y in np.ndindex(3, 3):
        cells = (x + shift_x, y + shift_y)
        there = seen[cells] > 0
        for picture, design in zip(templates.pictures, templates.design, strict=True):
            found = np.corrcoef(level[cells][there], picture[there])[0, 1]
            best[design] = max(best[design], found)
    np.testing.assert_allclose(fit.correlation, best, atol=1e-4)
