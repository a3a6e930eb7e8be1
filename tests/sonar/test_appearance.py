"""Laws of the fit of designs to patches, and of the sightings that follow from it."""

from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.measurements import SonarFrames
from sonar_graph.sonar.appearance import CENTROID_SIGMA_M, Appearance, CandidateFit, DesignFit, ObjectSighting
from sonar_graph.sonar.confusion import Confusion, confusion_for, soft_scores
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.templates import Patch, PolarGrid

from .candidate_rows import candidates_at
from .polar_images import AZIMUTHS_RAD, HEIGHT_M, RANGES_M, image_db, level_R_sonar

ROTATION = level_R_sonar()
VIEW = FloorView(ROTATION, HEIGHT_M)
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


@pytest.mark.parametrize("rim", [39, 36, 27, 22])
def test_the_best_fit_is_that_of_numpy_over_the_cells_in_view(appearance, rim: int):
    """All shifts and headings by `np.corrcoef`, on noise of which the image holds the first columns, with holes."""
    templates, side, rng = appearance.templates, appearance.patch_side, np.random.default_rng(rim)
    seen = ((np.arange(side) < rim) & (rng.random((side, side)) < (0.99 if rim == 39 else 1.0))).astype(np.float32)
    level = rng.normal(40, 5, (side, side)).astype(np.float32) * seen
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


def test_gain_and_floor_level_cost_nothing_and_a_wrong_height_does(appearance):
    """The heading of a triangle is found up to its symmetry."""
    image = image_db(DEFAULT_DESIGNS[2], (1.7, 0.0), 0.4, ROTATION, np.random.default_rng(0))
    plain, other = (_fit(appearance, picture, ROTATION, (1.7, 0.0)) for picture in (image, 0.5 * image + 20))
    np.testing.assert_allclose(other.correlation, plain.correlation, atol=1e-3)
    off = (plain.heading_rad - 0.4) % (2 * np.pi / 3)
    assert min(off, 2 * np.pi / 3 - off) < np.radians(5)
    patch = GRID.patch(image, FloorView(ROTATION, 0.5), np.array([1.9, 0.0]), appearance.patch_side, 0.015)
    assert appearance.fit(patch).correlation[2] < plain.correlation[2] - 0.05


def test_bare_floor_and_a_bar_fit_no_design_well(appearance):
    rotation, rng = level_R_sonar(), np.random.default_rng(3)
    bar = np.full((60, 60), np.nan)
    bar[24:36] = 12.0
    for design in (None, LandmarkDesign(9, "bar", 0.42, bar)):
        fit = _fit(appearance, image_db(design, (1.7, 0.0), 0.2, rotation, rng), rotation, (1.7, 0.0))
        assert fit.correlation.max() < 0.7


@pytest.mark.parametrize("design", DEFAULT_DESIGNS, ids=lambda design: design.name)
@pytest.mark.parametrize("y_m", np.linspace(0.34, 0.46, 7))
def test_the_rim_of_the_image_does_not_push_a_landmark_aside(appearance, design, y_m: float):
    rotation = ROTATION
    image = image_db(design, (1.7, y_m), 0.6, rotation, None)
    fit = _fit(appearance, image, rotation, (1.7, y_m - 0.02))
    if fit.correlation.max() > 0:
        np.testing.assert_allclose(fit.centre_m, (1.7, y_m), atol=0.003)


APERTURE_RAD = 0.244
SHIPPED = confusion_for(DEFAULT_DESIGNS)
MODEL = SHIPPED.model_copy(update={"threshold": 0.7, "range_sigma_m": 0.01, "azimuth_sigma_rad": 0.004})
TRIANGLE = 2


def frame(image: np.ndarray, ranges_m: np.ndarray = RANGES_M, azimuths_rad: np.ndarray = AZIMUTHS_RAD) -> SonarFrames:
    return SonarFrames(np.array([1]), image[None], ranges_m, azimuths_rad)


def look_at(
    appearance: Appearance,
    image: np.ndarray,
    near_m: tuple[float, float],
    model: Confusion = MODEL,
    view: FloorView | None = VIEW,
    aperture_rad: float = APERTURE_RAD,
) -> ObjectSighting:
    """A look at a candidate near a point of the floor."""
    r, a = VIEW.range_azimuth(np.array(near_m))
    look = CandidateFit(appearance, model, aperture_rad)
    (sighting,) = look.at(image, frame(image), view, candidates_at([r], [a]), np.array([0]))
    assert sighting is not None
    return sighting


@pytest.fixture(scope="module")
def triangle() -> np.ndarray:
    return image_db(DEFAULT_DESIGNS[TRIANGLE], (1.7, 0.05), 0.5, ROTATION, np.random.default_rng(0))


def test_range_and_azimuth_are_those_of_the_designs_centre_and_not_of_the_candidate(appearance, triangle):
    found = look_at(appearance, triangle, (1.725, 0.03))
    assert found.is_fitted
    assert found.fit is not None
    assert found.fit.best == TRIANGLE
    r, a = VIEW.range_azimuth(np.array([1.7, 0.05]))
    assert (found.range_m, found.azimuth_rad) == (pytest.approx(r, abs=0.006), pytest.approx(a, abs=0.004))
    np.testing.assert_allclose(found.covariance, np.diag([0.01**2, 0.004**2]) / found.fit.visible**4)


def test_what_is_partly_in_view_is_less_certain(appearance):
    image = image_db(DEFAULT_DESIGNS[0], (1.7, 0.34), 0.0, ROTATION, None)
    found = look_at(appearance, image, (1.7, 0.33))
    assert found.is_fitted
    assert found.fit is not None
    assert 0.8 <= found.fit.visible < 0.97
    np.testing.assert_allclose(found.covariance, np.diag([0.01**2, 0.004**2]) / found.fit.visible**4)


def test_what_no_design_fits_stays_where_its_centroid_is(appearance, triangle):
    strict = MODEL.model_copy(update={"threshold": 0.999})
    found = look_at(appearance, triangle, (1.725, 0.03), strict)
    assert not found.is_fitted
    assert found.fit is not None
    r, a = VIEW.range_azimuth(np.array([1.725, 0.03]))
    assert (found.range_m, found.azimuth_rad) == (r, a)
    np.testing.assert_allclose(found.covariance, np.diag([CENTROID_SIGMA_M**2, (CENTROID_SIGMA_M / r) ** 2]))


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
    assert (found.range_m, found.azimuth_rad, found.is_fitted) == (*VIEW.range_azimuth(np.array(near_m)), False)


def test_rows_say_which_candidate_and_scores_are_those_of_the_model(appearance, triangle):
    r, a = VIEW.range_azimuth(np.array([1.7, 0.05]))
    look = CandidateFit(appearance, MODEL, APERTURE_RAD)
    candidates = candidates_at([2.05, r], [-0.1, a])
    none, seen, beside = look.at(triangle, frame(triangle), VIEW, candidates, np.array([-1, 1, 0]))
    assert none is None
    assert seen.is_fitted
    assert beside.azimuth_rad == pytest.approx(-0.1, abs=0.05)
    scores = look.scores([none, seen, beside])
    fit = seen.fit
    expected = soft_scores(fit.correlation[None], np.array([fit.visible]), MODEL.sharpness, MODEL.threshold)[0]
    np.testing.assert_allclose(scores[:2], [np.zeros(5), expected])
    assert scores[1].argmax() == TRIANGLE


def test_other_beams_and_bins_are_looked_up_anew(appearance, triangle):
    """A log may change its window on the way: beams the other way round, fewer bins, farther bins."""
    look, (r, a) = CandidateFit(appearance, MODEL, APERTURE_RAD), VIEW.range_azimuth(np.array([1.7, 0.05]))

    def correlation(image: np.ndarray, ranges_m: np.ndarray = RANGES_M, azimuths_rad: np.ndarray = AZIMUTHS_RAD):
        image = np.ascontiguousarray(image)
        taken = frame(image, ranges_m, azimuths_rad)
        return look.at(image, taken, VIEW, candidates_at([r], [a]), np.array([0]))[0].fit.correlation

    first = correlation(triangle)
    np.testing.assert_allclose(correlation(triangle[::-1], azimuths_rad=AZIMUTHS_RAD[::-1].copy()), first, atol=1e-3)
    np.testing.assert_allclose(correlation(triangle[:, :400], RANGES_M[:400]), first, atol=1e-3)
    assert abs(correlation(triangle, RANGES_M + 0.1) - first).max() > 0.05


def test_without_a_floor_the_patch_lies_in_the_plane_of_the_image(appearance):
    """A design drawn in that plane is found; on the floor's grid it would be foreshortened."""
    r, a = np.meshgrid(RANGES_M, AZIMUTHS_RAD)
    design = DEFAULT_DESIGNS[1]
    level = np.nan_to_num(design.level_db(r * np.cos(a) - 1.9, r * np.sin(a) - 0.1)) + 35.0
    image = (level + 10 * np.log10(np.random.default_rng(3).exponential(size=level.shape))).astype(np.float32)
    candidates = candidates_at([float(np.hypot(1.9, 0.1))], [float(np.arctan2(0.1, 1.9))])
    flat, tilted = (
        CandidateFit(appearance, MODEL, APERTURE_RAD).at(image, frame(image), view, candidates, np.array([0]))[0]
        for view in (None, VIEW)
    )
    assert flat is not None
    assert flat.fit is not None
    assert flat.fit.best == 1
    assert (flat.range_m, flat.azimuth_rad) == (
        pytest.approx(np.hypot(1.9, 0.1), abs=0.006),
        pytest.approx(np.arctan2(0.1, 1.9), abs=0.003),
    )
    assert tilted is not None
    assert tilted.fit is None or tilted.fit.correlation[1] < flat.fit.correlation[1] - 0.02
