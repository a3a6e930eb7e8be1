from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.errors import CalibrationError
from sonar_graph.sonar.cfar import DetectionParams, bright_parts, check_candidates, select_candidates
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
    assert len(bright_parts(joined, PARAMS)[0]) == 1
    check_candidates([joined], PARAMS, SEARCH_M)
    with pytest.raises(CalibrationError, match="closing_m"):
        check_candidates([TWO_APART], PARAMS, SEARCH_M)
    check_candidates([TWO_APART], PARAMS.model_copy(update={"closing_m": 0.25}), SEARCH_M)


def test_parts_have_the_area_length_and_place_of_their_drawing():
    areas_m2, extents_m, offsets_m = bright_parts(design_of((0.1, 0.05, 0.1, 0.05)), PARAMS)
    assert areas_m2 == pytest.approx([0.02], rel=0.25)
    assert extents_m == pytest.approx([0.2], rel=0.1)
    assert offsets_m == pytest.approx([np.hypot(0.1, 0.05)], abs=0.003)


def test_a_dark_part_may_lie_apart():
    dark = replace(ONE, mask=np.where(np.isnan(ONE.mask) & (np.indices(ONE.mask.shape)[0] < 20), -8.0, ONE.mask))
    check_candidates([dark], PARAMS, SEARCH_M)


def set_to(**settings: float) -> DetectionParams:
    return PARAMS.model_copy(update=settings)


def is_refused(design: LandmarkDesign, params: DetectionParams = PARAMS, search_m: float = SEARCH_M) -> bool:
    try:
        check_candidates([design], params, search_m)
    except CalibrationError:
        return True
    return False


def test_a_part_may_be_as_far_from_the_middle_as_is_searched_and_smoothed():
    """6 cm off: within 4.5 and 3 cm together, not within either nor within less of both."""
    beside = design_of((0.06, 0.0, 0.1, 0.1))
    assert not is_refused(beside, set_to(smoothing_m=0.03), 0.045)
    assert is_refused(beside, set_to(smoothing_m=0.03), 0.02)
    assert is_refused(beside, set_to(smoothing_m=0.005), 0.045)


def test_a_part_may_be_as_long_as_a_candidate():
    bar = design_of((0.0, 0.0, 0.22, 0.04))
    assert not is_refused(bar, set_to(max_extent_m=0.55))
    assert is_refused(bar, set_to(max_extent_m=0.4))


def test_one_part_must_have_the_size_and_the_place():
    """A speck in the middle and a box at a corner do not make up for each other."""
    speck, box = (0.0, 0.0, 0.02, 0.02), (0.17, 0.17, 0.06, 0.06)
    assert is_refused(design_of(speck, box))
    assert not is_refused(design_of((0.0, 0.0, 0.06, 0.06), box))


def test_what_is_refused_is_named_in_square_metres_and_centimetres():
    with pytest.raises(CalibrationError) as refused:
        check_candidates([AT_A_CORNER], PARAMS, 0.045)
    assert "with its centre 21 cm from the middle" in str(refused.value)
    assert "lie within 8 cm of the middle" in str(refused.value)


def test_a_part_much_narrower_than_the_smoothing_is_dimmed_away():
    """A mean over 10 cm of 12 dB on 4 cm is 1.9 dB; closing does not average."""
    assert len(bright_parts(TINY, set_to(smoothing_m=0.1))[0]) == 0
    assert len(bright_parts(TINY, set_to(closing_m=0.1))[0]) == 1
    with pytest.raises(CalibrationError, match="its bright parts are all smoothed away; one must have"):
        check_candidates([TINY], set_to(smoothing_m=0.1), SEARCH_M)


def test_a_part_is_where_the_mean_over_the_smoothing_is_over_the_floor():
    """Against scipy, in cells of 2 mm; 3 dB of 12 are reached beyond the edge."""
    areas_m2, extents_m, _ = bright_parts(design_of((0.0, 0.0, 0.2, 0.1)), set_to(smoothing_m=0.1))
    at_m = 0.002 * np.arange(-200, 201)
    x_m, y_m = np.meshgrid(at_m, at_m)
    mean_db = uniform_filter(np.where((np.abs(x_m) <= 0.2) & (np.abs(y_m) <= 0.1), 12.0, 0.0), 50)
    is_part = mean_db >= 3.0
    assert areas_m2 == pytest.approx([is_part.sum() * 0.002**2], rel=0.05)
    assert extents_m == pytest.approx([np.sqrt(12 * x_m[is_part].var())], rel=0.02)
    assert extents_m[0] > 0.41


@pytest.mark.parametrize("settings", [{}, {"smoothing_m": 0.1}, {"closing_m": 0.1}])
def test_the_edge_of_the_square_is_none_of_a_part(settings):
    """The same box, in a square that it fills and in a larger one."""
    box = (0.0, 0.0, 0.1, 0.1)
    filled, larger = (bright_parts(design_of(box, size_m=size_m), set_to(**settings)) for size_m in (0.2, 0.5))
    for one, other in zip(filled, larger, strict=True):
        assert one == pytest.approx(other, rel=0.06, abs=0.003)


def test_dark_parts_are_none():
    dark = design_of((0.0, 0.0, 0.1, 0.1), level_db=-12.0)
    assert len(bright_parts(dark, PARAMS)[0]) == 0
    assert is_refused(dark)


def test_parts_that_touch_at_a_corner_are_one():
    touching = design_of((-0.0525, -0.0525, 0.05, 0.05), (0.05, 0.045, 0.05, 0.05))
    areas_m2, _, _ = bright_parts(touching, set_to(smoothing_m=0.005, closing_m=0.0))
    assert areas_m2 == pytest.approx([0.02], rel=0.1)


def test_parts_come_largest_first():
    areas_m2, _, offsets_m = bright_parts(design_of((-0.15, 0.0, 0.03, 0.03), (0.1, 0.0, 0.1, 0.1)), PARAMS)
    assert areas_m2[0] > 4 * areas_m2[1]
    assert offsets_m == pytest.approx([0.1, 0.15], abs=0.005)
