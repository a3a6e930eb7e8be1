"""Laws of the candidate selection, of its background, and of the designs that can be candidates."""

from contextlib import nullcontext

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from scipy import stats

from sonar_graph.devices import LandmarkDesign
from sonar_graph.errors import CalibrationError
from sonar_graph.measurements import Floats
from sonar_graph.sonar import FloorView, cfar
from sonar_graph.sonar.appearance import AppearanceParams
from sonar_graph.sonar.regions import (
    MEDIAN_TO_SIGMA,
    CandidateVerdict,
    background_of,
)

from . import polar_images
from .polar_images import HEIGHT_M, RANGES_M, design_of, image_db, polar

AZIMUTHS_RAD = polar_images.AZIMUTHS_RAD[::-1].copy()
VIEW = FloorView.from_angles(HEIGHT_M, 0.0, np.radians(30))
PLATE_DB = 12.0


def speckle_db(seed: int, level_db: float | Floats = 30.0) -> Floats:
    """One-look speckle: 10 log10 of an exponential variable, shape (96, 512)."""
    power = np.random.default_rng(seed).exponential(size=(96, 512))
    return (level_db + 10 * np.log10(power)).astype(np.float32)


def floor_xy():
    """Level (x, y) of every pixel, shape (2, beams, bins)."""
    pixels = np.tile(RANGES_M, 96), np.repeat(AZIMUTHS_RAD, 512)
    return (VIEW.floor_points(*pixels) @ VIEW.level_R_sonar.T).T[:2].reshape(2, -1, 512)


def frame_with_plate(x=1.65, y=0.05, side=0.3, plate_db=PLATE_DB):
    at_x, at_y = floor_xy()
    inside = (np.abs(at_x - x) < side / 2) & (np.abs(at_y - y) < side / 2)
    return speckle_db(1, 30.0 + plate_db * inside)


def select(image, view=VIEW, **settings):
    return cfar.select_candidates(
        image, RANGES_M, AZIMUTHS_RAD, view, cfar.DetectionParams(**settings)
    )


def test_thresholds_are_those_of_speckle_of_one_look_and_of_many():
    for looks in (1, 4, 20):
        levels = 10 * np.log10(stats.gamma(looks).rvs(1_000_000, random_state=4))
        offset = cfar.false_alarm_offset_db(float(np.std(levels)), 1e-2)
        share = np.mean(levels > np.mean(levels) + offset)
        assert share == pytest.approx(1e-2, rel=0.06)
    spreads = np.array([0.3, 1.23, 5.57, 8.0], dtype=np.float32)
    exact = [cfar.false_alarm_offset_db(float(spread), 1e-3) for spread in spreads]
    assert cfar.false_alarm_offsets_db(spreads, 1e-3) == pytest.approx(exact, abs=0.02)


ACROSS = np.linspace(-1.0, 1.0, 96)[:, None]


@pytest.mark.parametrize(
    "level", [20.0, 50.0, 30.0 - 12.0 * (RANGES_M - 1.26) / 1.25, 30.0 + 3.0 * ACROSS]
)
def test_false_alarms_keep_their_rate_whatever_the_level_and_at_the_rim(level):
    frames = [speckle_db(seed, level) for seed in range(30)]
    found = [select(frame, closing_m=0, false_alarm=1e-2) for frame in frames]
    masks = np.array([one.labels > 0 for one in found])
    assert 0.7e-2 < masks.mean() < 1.7e-2
    if np.ndim(level) == 0:
        for rim in (masks[:, 0], masks[:, -1], masks[..., 0], masks[..., -1]):
            assert rim.mean() > 0.2 * masks.mean()


@pytest.mark.parametrize(("x", "y"), [(1.65, 0.05), (1.5, -0.15), (1.9, 0.2)])
def test_a_plate_is_one_candidate_where_geometry_says(x, y):
    """On the floor; without one its area is smaller by the foreshortening, and its elevation unknown."""
    found, blind = (select(frame_with_plate(x, y), view=view) for view in (VIEW, None))
    (row,) = found.accepted
    (flat,) = blind.accepted
    r = found.range_m[row]
    a = found.azimuth_rad[row]
    assert (r, a) == pytest.approx(polar((x, y)), abs=0.01)
    assert found.area_m2[row] == pytest.approx(0.09, abs=0.02)
    assert found.extent_m[row] == pytest.approx(0.3, abs=0.03)
    assert found.level_db[row] == pytest.approx(PLATE_DB, abs=2.5)
    up_m = VIEW.floor_points(np.array([r]), np.array([a]))[0, 2]
    assert np.sin(found.elevation_rad[row]) == pytest.approx(up_m / r, abs=1e-9)
    longer = r / np.sqrt(r**2 - HEIGHT_M**2)
    assert found.area_m2[row] / blind.area_m2[flat] == pytest.approx(longer, rel=0.03)
    assert (blind.elevation_rad == 0).all()
    assert blind.elevation_sigma_rad[flat] == pytest.approx(0.244 / np.sqrt(12))


@pytest.mark.parametrize(
    ("settings", "verdict"),
    [
        ({"min_area_m2": 0.2, "max_area_m2": 1.0}, CandidateVerdict.TOO_SMALL),
        ({"max_area_m2": 0.05}, CandidateVerdict.TOO_LARGE),
        ({"max_extent_m": 0.2}, CandidateVerdict.TOO_LONG),
    ],
)
def test_each_gate_is_the_reason_that_it_gives(settings, verdict):
    kept = select(frame_with_plate())
    gated = select(frame_with_plate(), **settings)
    assert gated.verdicts[kept.accepted].tolist() == [verdict]
    assert len(gated.accepted) == 0


@pytest.mark.parametrize(
    ("x", "y"), [(1.65, 0.4), (1.65, -0.4), (2.25, 0.0), (0.85, 0.0)]
)
def test_a_plate_cut_by_the_edge_is_rejected_unless_wanted(x, y):
    cut = select(frame_with_plate(x, y))
    assert CandidateVerdict.AT_EDGE in cut.verdicts[cut.area_m2 > 0.01]
    assert len(cut.accepted) == 0
    assert len(select(frame_with_plate(x, y), keep_at_edge=True).accepted) == 1


def test_beyond_the_limit_the_strongest_are_kept():
    weak = frame_with_plate(y=0.25, side=0.22)
    strong = frame_with_plate(y=-0.2, side=0.15, plate_db=40.0)
    both, one = (
        select(np.maximum(weak, strong), **limit)
        for limit in ({}, {"max_candidates": 1})
    )
    right, left = both.accepted[np.argsort(both.azimuth_rad[both.accepted])]
    assert both.area_m2[left] > both.area_m2[right]  # the weaker one is larger
    assert one.accepted.tolist() == [right]
    assert one.verdicts[left] == CandidateVerdict.BEYOND_LIMIT


SPAN = 9
HALF_STEP_DB = 1 / 16
HALF_DEVIATION_STEP_DB = 1 / 80


def medians(values: Floats) -> Floats:
    """Over a square window, mirrored at the edges."""
    mirrored = np.pad(values, SPAN // 2, mode="reflect")
    return np.median(sliding_window_view(mirrored, (SPAN, SPAN)), axis=(2, 3))


@pytest.mark.parametrize("nodes", [20, 21])
@pytest.mark.parametrize("shaded", [0.0, 0.4])
def test_the_background_is_a_median_and_so_is_its_spread(nodes, shaded):
    """A shadow 40 dB deep over less than half of the beams is below what bytes reach, -16 dB."""
    level = np.random.default_rng(nodes).normal(40, 2, (nodes, 30))
    level += 0.3 * np.arange(30)
    level[: int(shaded * nodes)] -= 40
    level = level.astype(np.float32)
    pixels = np.kron(level, np.ones((3, 5), np.float32))
    level_db, spread_db = background_of(pixels, (3, 5), (3 * SPAN, 5 * SPAN))
    padded = np.pad(np.median(level, axis=0), 2, mode="reflect")
    trend = sliding_window_view(padded, 5).mean(axis=1)
    local = medians(np.clip(level - trend, -16, 127 / 8))
    assert level_db == pytest.approx(local + trend, abs=1.01 * HALF_STEP_DB)
    off = np.minimum(np.abs(level - level_db), 255 / 40)
    spread = np.maximum(MEDIAN_TO_SIGMA * medians(off), 0.2)
    tolerance = MEDIAN_TO_SIGMA * 1.01 * HALF_DEVIATION_STEP_DB
    assert spread_db == pytest.approx(spread, abs=tolerance)


SEARCH_M = AppearanceParams().search_m


def accepted_near_its_figure(design: LandmarkDesign) -> int:
    """Candidates of the selection itself, in an image without speckle but for a little, close enough to be compared."""
    image = image_db(design, (1.7, 0.0), 0.0)
    image += np.random.default_rng(0).normal(0, 0.5, image.shape).astype(np.float32)
    found = select(image[::-1], polar_images.VIEW)
    x, y = design.figure_m
    r = found.range_m[found.accepted]
    a = found.azimuth_rad[found.accepted]
    ahead = np.sqrt(r**2 - HEIGHT_M**2) * np.cos(a)
    off_m = np.hypot(r * np.sin(a) - y, ahead - 1.7 - x)
    return int((off_m <= SEARCH_M).sum())


MIDDLE = (0.0, 0.0, 0.1, 0.1)
TINY = design_of((0.0, 0.0, 0.02, 0.02))


@pytest.mark.parametrize(
    ("design", "count"),
    [
        (design_of(MIDDLE, (0.2, 0.0, 0.02, 0.02)), 1),  # with a nose
        (design_of((-0.17, 0.0, 0.07, 0.07), (0.17, 0.0, 0.07, 0.07)), 1),
        (design_of((0.15, 0.15, 0.08, 0.08)), 1),  # at a corner
        (TINY, 0),
        (design_of((0.0, 0.0, 0.24, 0.24)), 0),  # too large
    ],
)
def test_a_design_is_let_through_where_the_selection_finds_its_figure(design, count):
    assert accepted_near_its_figure(design) == count
    words = r"own \(id 7\) would never be found: its bright parts are"
    refused = pytest.raises(CalibrationError, match=words)
    with nullcontext() if count else refused:
        cfar.check_candidates([design], cfar.DetectionParams(), SEARCH_M)
