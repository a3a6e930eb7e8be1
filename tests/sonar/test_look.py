from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS
from sonar_graph.measurements import SonarFrames
from sonar_graph.sonar.appearance import CENTROID_SIGMA_M, Appearance, CandidateFit, DesignFit, ObjectSighting
from sonar_graph.sonar.confusion import Confusion, confusion_for, soft_scores
from sonar_graph.sonar.geometry import FloorView

from .candidate_rows import candidates_at
from .polar_images import AZIMUTHS_RAD, HEIGHT_M, RANGES_M, image_db, level_R_sonar

ROTATION = level_R_sonar()
VIEW = FloorView(ROTATION, HEIGHT_M)
APERTURE_RAD = 0.244
SHIPPED = confusion_for(DEFAULT_DESIGNS)
MODEL = SHIPPED.model_copy(update={"threshold": 0.7, "range_sigma_m": 0.01, "azimuth_sigma_rad": 0.004})
TRIANGLE = 2


@pytest.fixture(scope="module")
def appearance() -> Appearance:
    return Appearance(DEFAULT_DESIGNS)


def frame(image: np.ndarray, ranges_m: np.ndarray = RANGES_M, azimuths_rad: np.ndarray = AZIMUTHS_RAD) -> SonarFrames:
    return SonarFrames(np.array([1]), image[None], ranges_m, azimuths_rad)


def look_at(
    appearance: Appearance,
    image: np.ndarray,
    near_m: tuple[float, float],
    model: Confusion = MODEL,
    view: FloorView | None = VIEW,
) -> ObjectSighting:
    """A look at a candidate near a point of the floor."""
    r, a = VIEW.range_azimuth(np.array(near_m))
    look = CandidateFit(appearance, model, APERTURE_RAD)
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


def test_what_is_hardly_in_the_image_is_compared_with_nothing(appearance, triangle):
    r, a = VIEW.range_azimuth(np.array([1.7, 0.75]))
    found = look_at(appearance, triangle, (1.7, 0.75))
    assert found.fit is None
    assert (found.range_m, found.azimuth_rad, found.is_fitted) == (r, a, False)
    look = CandidateFit(appearance, MODEL, APERTURE_RAD)
    assert look.scores([found]).tolist() == [[0.0] * 5]


def test_what_no_ray_finds_on_the_floor_is_compared_with_nothing(appearance, triangle):
    look = CandidateFit(appearance, MODEL, APERTURE_RAD)
    (found,) = look.at(triangle, frame(triangle), FloorView(ROTATION, 2.0), candidates_at([1.3], [0.0]), np.array([0]))
    assert found is not None
    assert found.fit is None


def test_a_track_that_was_not_seen_has_no_sighting_and_rows_say_which_candidate(appearance, triangle):
    r, a = VIEW.range_azimuth(np.array([1.7, 0.05]))
    look = CandidateFit(appearance, MODEL, APERTURE_RAD)
    candidates = candidates_at([2.05, r], [-0.1, a])
    found = look.at(triangle, frame(triangle), VIEW, candidates, np.array([-1, 1, 0]))
    assert found[0] is None
    assert found[1] is not None
    assert found[1].is_fitted
    assert found[2] is not None
    assert found[2].azimuth_rad == pytest.approx(-0.1, abs=0.05)
    scores = look.scores(found)
    assert scores.shape == (3, 5)
    assert (scores[0] == 0).all()
    np.testing.assert_allclose(scores[1:].sum(axis=1), 1)
    assert scores[1].argmax() == TRIANGLE


def test_scores_are_those_of_the_model(appearance):
    fit = DesignFit(np.array([0.5, 0.8, 0.2, -1.0]), 0.9, 1, 0.0, np.zeros(2))
    look = CandidateFit(appearance, MODEL, APERTURE_RAD)
    found = look.scores([ObjectSighting(fit, 2.0, 0.0, np.eye(2)), None])
    expected = soft_scores(fit.correlation[None], np.array([0.9]), MODEL.sharpness, MODEL.threshold)[0]
    np.testing.assert_allclose(found, [expected, np.zeros(5)])


def test_other_beams_and_bins_are_looked_up_anew(appearance, triangle):
    """A log may change its window on the way."""
    look = CandidateFit(appearance, MODEL, APERTURE_RAD)
    r, a = VIEW.range_azimuth(np.array([1.7, 0.05]))
    first = look.at(triangle, frame(triangle), VIEW, candidates_at([r], [a]), np.array([0]))[0]
    turned = look.at(
        np.ascontiguousarray(triangle[::-1]),
        frame(triangle, azimuths_rad=AZIMUTHS_RAD[::-1].copy()),
        VIEW,
        candidates_at([r], [a]),
        np.array([0]),
    )[0]
    half = np.ascontiguousarray(triangle[:, :400])
    cut = look.at(half, frame(half, RANGES_M[:400]), VIEW, candidates_at([r], [a]), np.array([0]))[0]
    assert first is not None
    for other in (turned, cut):
        assert other is not None
        assert other.fit is not None
        np.testing.assert_allclose(other.fit.correlation, first.fit.correlation, atol=1e-3)
    shifted = look.at(triangle, frame(triangle, RANGES_M + 0.1), VIEW, candidates_at([r], [a]), np.array([0]))[0]
    assert shifted is not None
    assert shifted.fit is not None
    assert abs(shifted.fit.correlation - first.fit.correlation).max() > 0.05


def test_the_aperture_hides_what_lies_outside_of_it(appearance, triangle):
    """The same landmark in a fan of a third of the opening: only a strip of it counts as seen."""
    r, a = VIEW.range_azimuth(np.array([1.95, 0.05]))
    wide, narrow = (
        CandidateFit(appearance, MODEL, aperture).at(
            triangle, frame(triangle), VIEW, candidates_at([r], [a]), np.array([0])
        )[0]
        for aperture in (0.244, 0.05)
    )
    assert wide is not None
    assert wide.fit is not None
    assert narrow is not None
    assert narrow.fit is None


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
