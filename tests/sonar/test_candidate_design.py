from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.errors import CalibrationError
from sonar_graph.landmark_designs import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.sonar.candidate_design import _bright_parts, check_candidates
from sonar_graph.sonar.detection import DetectionParams, select_candidates
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.recogniser import Recogniser, RecogniserParams

from .polar_images import AZIMUTHS_RAD, HEIGHT_M, RANGES_M, image_db, level_R_sonar
from .test_recogniser import DECIBELS

PARAMS = DetectionParams()
SEARCH_M = RecogniserParams().appearance.search_m
VIEW = FloorView(level_R_sonar(), HEIGHT_M)
PIXELS = 200


def design_of(*boxes_m: tuple[float, float, float, float], level_db: float = 12.0, size_m: float = 0.5):
    """Bright boxes of x and y from the middle, half width and half height."""
    middles = ((np.arange(PIXELS) + 0.5) / PIXELS - 0.5) * size_m
    y, x = np.meshgrid(-middles, middles, indexing="ij")
    mask = np.full((PIXELS, PIXELS), np.nan)
    for x0, y0, half_x, half_y in boxes_m:
        mask[(np.abs(x - x0) <= half_x) & (np.abs(y - y0) <= half_y)] = level_db
    return LandmarkDesign(1, "boxes", size_m, mask)


def accepted_near_middle(design: LandmarkDesign) -> int:
    """Candidates of the selection itself, in an image without speckle but for a little, close enough to be compared."""
    image = image_db(design, (1.7, 0.0), 0.0, level_R_sonar(), None)
    image = image + np.random.default_rng(0).normal(0, 0.5, image.shape).astype(np.float32)
    found = select_candidates(image, RANGES_M, AZIMUTHS_RAD, VIEW, PARAMS)
    at = found.accepted
    away = np.hypot(
        found.range_m[at] * np.sin(found.azimuth_rad[at]),
        np.sqrt(found.range_m[at] ** 2 - HEIGHT_M**2) * np.cos(found.azimuth_rad[at]) - 1.7,
    )
    return int((away <= SEARCH_M + PARAMS.smoothing_m).sum())


ONE = design_of((0.0, 0.0, 0.1, 0.1))
WITH_A_NOSE = design_of((0.0, 0.0, 0.1, 0.1), (0.2, 0.0, 0.02, 0.02))
TWO_APART = design_of((-0.17, 0.0, 0.07, 0.07), (0.17, 0.0, 0.07, 0.07))
AT_A_CORNER = design_of((0.15, 0.15, 0.08, 0.08))
TINY = design_of((0.0, 0.0, 0.02, 0.02))
HUGE = design_of((0.0, 0.0, 0.24, 0.24))


def test_the_designs_that_ship_are_candidates():
    check_candidates(DEFAULT_DESIGNS, PARAMS, SEARCH_M)


@pytest.mark.parametrize("design", [ONE, WITH_A_NOSE], ids=["one part", "with a nose"])
def test_what_the_selection_finds_in_the_middle_is_let_through(design: LandmarkDesign):
    assert accepted_near_middle(design) == 1
    check_candidates([design], PARAMS, SEARCH_M)


@pytest.mark.parametrize(
    "design", [TWO_APART, AT_A_CORNER, TINY, HUGE], ids=["two apart", "at a corner", "too small", "too large"]
)
def test_what_the_selection_never_finds_in_the_middle_is_refused_by_name(design: LandmarkDesign):
    assert accepted_near_middle(design) == 0
    with pytest.raises(CalibrationError, match=r"boxes \(id 1\) would never be found: .* bright part"):
        Recogniser(DECIBELS, [replace(design, id=1)])


def test_parts_that_the_selection_joins_are_one():
    joined = design_of((-0.06, 0.0, 0.05, 0.08), (0.06, 0.0, 0.05, 0.08))
    assert len(_bright_parts(joined, PARAMS)[0]) == 1
    check_candidates([joined], PARAMS, SEARCH_M)
    with pytest.raises(CalibrationError, match="closing_m"):
        check_candidates([TWO_APART], PARAMS, SEARCH_M)
    check_candidates([TWO_APART], PARAMS.model_copy(update={"closing_m": 0.25}), SEARCH_M)


def test_parts_have_the_area_length_and_place_of_their_drawing():
    areas_m2, extents_m, offsets_m = _bright_parts(design_of((0.1, 0.05, 0.1, 0.05)), PARAMS)
    assert areas_m2 == pytest.approx([0.02], rel=0.25)
    assert extents_m == pytest.approx([0.2], rel=0.1)
    assert offsets_m == pytest.approx([np.hypot(0.1, 0.05)], abs=0.003)


def test_a_dark_part_may_lie_apart():
    dark = replace(ONE, mask=np.where(np.isnan(ONE.mask) & (np.indices(ONE.mask.shape)[0] < 20), -8.0, ONE.mask))
    check_candidates([dark], PARAMS, SEARCH_M)
