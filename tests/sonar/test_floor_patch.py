from __future__ import annotations

import numpy as np

from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.templates import PolarGrid

from .polar_images import AZIMUTHS_RAD, HEIGHT_M, RANGES_M, floor_points, level_R_sonar


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


def test_what_lies_outside_the_image_is_not_seen():
    patch = PolarGrid(RANGES_M, AZIMUTHS_RAD).patch(
        np.ones((96, 512), np.float32), FloorView(level_R_sonar(), HEIGHT_M), np.array([1.7, 0.45]), 21, 0.015
    )
    assert 0 < patch.seen.mean() < 1
    assert (patch.level_db[patch.seen == 0] == 0).all()


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
