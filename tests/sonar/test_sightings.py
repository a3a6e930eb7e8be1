"""Laws of sightings: where candidates are, how certain that is, and their evidence of the designs."""

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.devices import DEFAULT_DESIGNS
from sonar_graph.measurements import Floats
from sonar_graph.sonar import Confusion, FloorView, ObjectSighting, confusion_for
from sonar_graph.sonar.appearance import (
    CENTROID_SIGMA_M,
    AppearanceParams,
    CandidateFit,
)

from .polar_images import (
    AZIMUTHS_RAD,
    HEIGHT_M,
    RANGES_M,
    ROTATION,
    VIEW,
    candidates_at,
    frame,
    image_db,
    odds,
    polar,
)

APERTURE_RAD = 0.244
USUAL = {"range_bound_m": 1e-3, "across_bound_m": 1.2e-3, "bound_power": 1.5}
SETTINGS = {
    "height_bias_m": 0.0,
    "range_sigma_m": 0.01,
    "across_sigma_m": 0.008,
} | USUAL
MODEL = confusion_for(DEFAULT_DESIGNS).model_copy(update=SETTINGS)
TRIANGLE = 2
FLUSH = [replace(design, relief_m=0.0) for design in DEFAULT_DESIGNS]
"""As these images show them: what stands up has a bright side and a shadow."""


def look_at(
    image: Floats,
    near_m: tuple[float, float],
    model: Confusion = MODEL,
    view: FloorView | None = VIEW,
    aperture_rad: float = APERTURE_RAD,
) -> ObjectSighting:
    """A look at a candidate near a point of the floor."""
    r, a = polar(near_m)
    look = CandidateFit(FLUSH, AppearanceParams(), model, aperture_rad)
    return look.at(image, frame(image), view, candidates_at([r], [a]), np.array([0]))[0]


@pytest.fixture(scope="module")
def triangle() -> np.ndarray:
    return image_db(
        DEFAULT_DESIGNS[TRIANGLE], (1.7, 0.05), 0.5, ROTATION, np.random.default_rng(0)
    )


def test_range_and_azimuth_are_those_of_the_fitted_centre(triangle):
    found = look_at(triangle, (1.725, 0.03))
    r, a = polar((1.7, 0.05))
    assert odds(found.fit).argmax() == TRIANGLE
    assert found.range_m == pytest.approx(r, abs=0.006)
    assert found.azimuth_rad == pytest.approx(a, abs=0.004)
    usual_m = np.array([0.01, 0.008]) * (found.bound_m / [1e-3, 1.2e-3]) ** 1.5
    sigmas = np.hypot(usual_m, found.moved_m) / [1, found.range_m]
    np.testing.assert_allclose(found.covariance, np.diag(sigmas**2))


def test_a_fit_tells_no_less_than_the_centroid_of_its_candidate(triangle):
    blind = MODEL.model_copy(update={"range_sigma_m": 9.0, "across_sigma_m": 19.0})
    found = look_at(triangle, (1.725, 0.03), blind)
    sigmas = CENTROID_SIGMA_M, CENTROID_SIGMA_M / polar((1.725, 0.03))[0]
    np.testing.assert_allclose(found.covariance, np.diag(np.square(sigmas)))


def test_the_height_of_a_face_is_added_to_the_range(triangle):
    high = MODEL.model_copy(update={"height_bias_m": 0.02})
    plain, found = (look_at(triangle, (1.7, 0.05), model) for model in (MODEL, high))
    longer_m = 0.02 * HEIGHT_M / plain.range_m
    assert found.range_m - plain.range_m == pytest.approx(longer_m, rel=1e-6)
    assert look_at(triangle, (1.7, 0.05), high, view=None).range_per_height == 0.0


@pytest.mark.parametrize(
    ("near_m", "changes"),
    [
        ((1.7, 0.75), {}),  # hardly in the image
        ((0.9, 0.0), {"view": FloorView(ROTATION, 2.0)}),  # no ray meets the floor
        # a fan of a fifth of the opening shows a strip of it
        ((1.95, 0.05), {"aperture_rad": 0.05}),
    ],
)
def test_what_is_not_in_view_is_compared_with_nothing(triangle, near_m, changes):
    found = look_at(triangle, near_m, **changes)
    assert found.fit is None
    r, a = polar(near_m)
    assert (found.range_m, found.azimuth_rad) == (r, a)
    sigmas = CENTROID_SIGMA_M, CENTROID_SIGMA_M / r
    np.testing.assert_allclose(found.covariance, np.diag(np.square(sigmas)))


def test_without_a_floor_the_patch_lies_in_the_plane_of_the_image():
    """A design drawn in that plane is found; on the floor's grid it would be foreshortened."""
    r, a = np.meshgrid(RANGES_M, AZIMUTHS_RAD)
    figure = DEFAULT_DESIGNS[1].level_db(r * np.cos(a) - 1.9, r * np.sin(a) - 0.1)
    power = np.random.default_rng(3).exponential(size=r.shape)
    level = 35.0 + np.nan_to_num(figure) + 10 * np.log10(power)
    image = level.astype(np.float32)
    place = np.hypot(1.9, 0.1), np.arctan2(0.1, 1.9)
    candidate = candidates_at(*np.transpose([place]))
    look = CandidateFit(FLUSH, AppearanceParams(), MODEL, APERTURE_RAD)
    flat, tilted = (
        look.at(image, frame(image), view, candidate, np.array([0]))[0]
        for view in (None, VIEW)
    )
    assert odds(flat.fit).argmax() == 1
    off = np.subtract((flat.range_m, flat.azimuth_rad), place)
    assert (np.abs(off) < [0.006, 0.003]).all()
    assert tilted.fit is None or odds(tilted.fit)[1] < odds(flat.fit)[1] - 1
