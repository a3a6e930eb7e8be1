from __future__ import annotations

import numpy as np

from sonar_graph.sonar.floor_patch import PolarGrid
from sonar_graph.sonar.geometry import FloorView

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
