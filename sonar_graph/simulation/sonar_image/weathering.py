"""Landmarks as years under water leave them: weaker foam, growth and sediment, in patches.

A patch is where a smooth Gaussian random field exceeds its own quantile, so that it covers the wanted share of the area.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from sonar_graph.measurements import Floats
from sonar_graph.simulation.sonar_image.conditions import SceneConditions
from sonar_graph.simulation.sonar_image.scene import CELL_M, SeabedObject

PATCH_M = 0.06
"""Distance over which the correlation of the field falls to 1/e."""
FOULING_DB = 3.0
GROWTH_M = 0.008
"""Level over the floor of what grows, and its greatest height."""
DRAPE_M = 0.015
"""Sigma with which sediment rounds edges off."""


def patches(
    is_material: NDArray[np.bool_], share: float, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], Floats]:
    """Mask of patches that cover a share of the material, and how far within they are: 0 at the edge, 1 at most."""
    # the field's autocorrelation is exp(-(d / PATCH_M)^2)
    sigma = PATCH_M / (2 * CELL_M)
    field = gaussian_filter(rng.standard_normal(is_material.shape), sigma, mode="wrap")
    # the quantile over the material, so that the share is exact
    ranked = np.sort(field[is_material])
    count = round(share * len(ranked))
    if count == 0:
        return np.zeros(is_material.shape, bool), np.zeros(is_material.shape)
    edge = ranked[-count]
    return field >= edge, np.clip((field - edge) / max(field.max() - edge, 1e-9), 0, 1)


def weathered(
    landmark: SeabedObject, conditions: SceneConditions, rng: np.random.Generator
) -> SeabedObject:
    """The landmark after wear: levels of its bright and dark parts changed, then overgrown, then drowned."""
    fouling_rng, sediment_rng = rng.spawn(2)
    amplitude = landmark.amplitude.astype(float)
    relief_m = landmark.relief_m.astype(float)
    is_material = ~np.isnan(amplitude)
    # brighter than the floor: foam; the rest is plate
    is_bright = amplitude > 1
    amplitude[is_bright] *= 10 ** (conditions.contrast_db / 20)
    if conditions.plate_db is not None:
        amplitude[is_material & ~is_bright] = 10 ** (conditions.plate_db / 20)
    if conditions.fouling > 0:
        grows, depth = patches(is_material, conditions.fouling, fouling_rng)
        amplitude[grows & is_material] = 10 ** (FOULING_DB / 20)
        # growth is highest in the middle of its patch
        relief_m += np.where(is_material, GROWTH_M * depth, 0.0)
    if conditions.sediment > 0:
        drowned, _ = patches(is_material, conditions.sediment, sediment_rng)
        amplitude[drowned] = np.nan
        # sediment lies in a drape: it rounds the edges below it
        relief_m = np.where(
            drowned,
            gaussian_filter(relief_m, DRAPE_M / CELL_M, mode="nearest"),
            relief_m,
        )
    return replace(
        landmark,
        amplitude=amplitude.astype(np.float32),
        relief_m=relief_m.astype(np.float32),
    )
