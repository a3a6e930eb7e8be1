from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from sonar_graph.errors import MeasurementError
from sonar_graph.sonar.cfar import (
    DetectionParams,
    false_alarm_offset_db,
    false_alarm_offsets_db,
    odd_counts,
    select_candidates,
)
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.regions import CandidateVerdict, measure_regions

from .candidate_rows import AZIMUTHS_RAD, RANGES_M, speckle_db

VIEW = FloorView.from_angles(0.95, 0.0, np.radians(30))
PLATE_DB = 12.0


def floor_xy(view=VIEW):
    """Level (x, y) of every pixel, shape (2, beams, bins)."""
    q = view.floor_points(np.tile(RANGES_M, 96), np.repeat(AZIMUTHS_RAD, 512)) @ view.level_R_sonar.T
    return q.T[:2].reshape(2, 96, 512)


def frame_with_plate(x=1.65, y=0.05, side=0.3, seed=1, view=VIEW, level=30.0, plate_db=PLATE_DB):
    at = floor_xy(view)
    inside = (np.abs(at[0] - x) < side / 2) & (np.abs(at[1] - y) < side / 2)
    return (speckle_db(seed, level) + plate_db * inside).astype(np.float32)


def select(image, view=VIEW, **settings):
    return select_candidates(image, RANGES_M, AZIMUTHS_RAD, view, DetectionParams(**settings))


def share_that_stands_out(image, false_alarm):
    """Of the pixels, none closed or gated away."""
    return np.mean(select(image, false_alarm=false_alarm, closing_m=0).labels > 0)


def test_one_look_of_speckle_has_the_offset_of_an_exponential():
    """-ln(0.01) = 4.605 times the mean is 6.63 dB, and the mean of decibels lies 2.51 dB below that of the power."""
    assert false_alarm_offset_db(5.570, 0.01) == pytest.approx(6.632 + 2.507, abs=0.01)
    sample = speckle_db(3, 0.0, (1000, 1000))
    assert np.std(sample) == pytest.approx(5.570, abs=0.02)
    assert np.mean(sample > np.mean(sample) + false_alarm_offset_db(5.570, 0.01)) == pytest.approx(0.01, rel=0.05)


@pytest.mark.parametrize("looks", [1, 4, 20])
def test_offset_of_many_looks_is_that_of_their_mean_power(looks):
    levels = 10 * np.log10(stats.gamma(looks).rvs(1_000_000, random_state=4))
    offset = false_alarm_offset_db(float(np.std(levels)), 1e-2)
    assert np.mean(levels > np.mean(levels) + offset) == pytest.approx(1e-2, rel=0.06)


def test_interpolated_offsets_are_the_offsets():
    spreads = np.array([0.3, 1.23, 5.57, 8.0], dtype=np.float32)
    exact = [false_alarm_offset_db(float(spread), 1e-3) for spread in spreads]
    assert false_alarm_offsets_db(spreads, 1e-3) == pytest.approx(exact, abs=0.02)


def test_false_alarms_keep_their_rate_at_the_rim():
    masks = [
        select(speckle_db(seed).astype(np.float32), false_alarm=0.03, closing_m=0).labels > 0 for seed in range(30)
    ]
    inside = np.mean(masks)
    for rim in (np.s_[:, 0], np.s_[:, -1], np.s_[:, :, 0], np.s_[:, :, -1]):
        assert np.mean(np.array(masks)[rim]) > 0.3 * inside


def test_lengths_in_metres_become_beams_and_bins_at_mid_range():
    """Beams of 0.3 degrees at 1.885 m, bins of 1.25 m in 512."""
    across_m, along_m = 1.885 * np.radians(0.3), 1.25 / 512
    assert odd_counts(0.03, (across_m, along_m)) == (3, 13)
    assert odd_counts(0.0, (across_m, along_m)) == (1, 1)


@pytest.mark.parametrize(("closing_m", "count"), [(0.12, 1), (0.0, 2)])
def test_gaps_up_to_a_width_are_bridged(closing_m, count):
    """Two halves of a plate, 8 cm apart."""
    at = floor_xy()
    halves = (np.abs(at[0] - 1.65) < 0.15) & (np.abs(np.abs(at[1]) - 0.1) < 0.06)
    image = (speckle_db(1) + 15 * halves).astype(np.float32)
    assert len(select(image, closing_m=closing_m).accepted) == count


ACROSS = np.linspace(-1.0, 1.0, 96)[:, None]


@pytest.mark.parametrize("level", [20.0, 50.0, 30.0 - 12.0 * (RANGES_M - 1.26) / 1.25, 30.0 + 3.0 * ACROSS])
def test_false_alarms_keep_their_rate_whatever_the_level(level):
    shares = [share_that_stands_out(speckle_db(seed, level).astype(np.float32), 1e-2) for seed in range(12)]
    assert 0.7e-2 < np.mean(shares) < 1.7e-2


def test_texture_raises_the_threshold_by_itself():
    """Gamma texture of shape 1 in patches as large as the smoothing: a fixed threshold would stand out everywhere."""
    rng = np.random.default_rng(5)
    shares, fixed = [], []
    for seed in range(8):
        texture = np.kron(rng.gamma(1.0, size=(32, 32)), np.ones((3, 16)))
        image = (speckle_db(seed) + 10 * np.log10(texture)).astype(np.float32)
        shares.append(share_that_stands_out(image, 1e-2))
        smooth = np.mean(image.reshape(32, 3, 32, 16), axis=(1, 3))
        fixed.append(np.mean(smooth > np.median(smooth) + false_alarm_offset_db(5.57 / np.sqrt(48), 1e-2)))
    assert np.mean(shares) < 2e-2
    assert np.mean(fixed) > 0.2


@pytest.mark.parametrize(("x", "y"), [(1.65, 0.05), (1.5, -0.15), (1.9, 0.2)])
def test_a_plate_is_one_candidate_where_geometry_says(x, y):
    found = select(frame_with_plate(x, y))
    (row,) = found.accepted
    expected = VIEW.range_azimuth(np.array([x, y]))
    assert found.range_m[row] == pytest.approx(expected[0], abs=0.01)
    assert found.azimuth_rad[row] == pytest.approx(expected[1], abs=0.01)
    assert found.area_m2[row] == pytest.approx(0.09, abs=0.02)
    assert found.extent_m[row] == pytest.approx(0.3, abs=0.03)
    assert found.level_db[row] == pytest.approx(PLATE_DB, abs=2.5)


def test_the_extent_of_a_bar_does_not_depend_on_how_it_lies():
    """Labelled by hand, 0.4 m by 0.05 m, in the slant plane at 2 m."""
    r, a = np.meshgrid(RANGES_M, AZIMUTHS_RAD)
    x, y = r * np.cos(a) - 1.9, r * np.sin(a)
    for turned_rad in (0.0, np.pi / 4, np.pi / 2, -np.pi / 4):
        along = x * np.cos(turned_rad) + y * np.sin(turned_rad)
        aside = y * np.cos(turned_rad) - x * np.sin(turned_rad)
        labels = ((np.abs(along) < 0.2) & (np.abs(aside) < 0.025)).astype(np.int32)
        found = measure_regions(np.zeros((96, 512), np.float32), labels, 1, RANGES_M, AZIMUTHS_RAD, None)
        assert found.extent_m[0] == pytest.approx(0.4, abs=0.015)
        assert found.area_m2[0] == pytest.approx(0.02, rel=0.05)


def test_the_elevation_of_a_candidate_puts_it_on_the_floor():
    found = select(frame_with_plate())
    (row,) = found.accepted
    q = VIEW.floor_points(found.range_m[[row]], found.azimuth_rad[[row]])[0]
    assert np.sin(found.elevation_rad[row]) == pytest.approx(q[2] / found.range_m[row], abs=1e-9)
    blind = select(frame_with_plate(), view=None)
    assert (blind.elevation_rad == 0).all()
    assert blind.elevation_sigma_rad[blind.accepted[0]] == pytest.approx(0.244 / np.sqrt(12))


def test_areas_on_the_floor_are_larger_than_in_the_slant_plane():
    on_floor, in_slant_plane = (select(frame_with_plate(), view=view) for view in (VIEW, None))
    ratio = on_floor.area_m2[on_floor.accepted[0]] / in_slant_plane.area_m2[in_slant_plane.accepted[0]]
    r = on_floor.range_m[on_floor.accepted[0]]
    assert ratio == pytest.approx(r / np.sqrt(r**2 - 0.95**2), rel=0.03)


def test_the_area_of_all_of_the_image_is_that_of_a_sector():
    """Every pixel labelled: on the floor, angle times (g1^2 - g0^2) / 2 for an untilted sonar's sector of rings."""
    labels = np.ones((96, 512), dtype=np.int32)
    contrast = np.zeros((96, 512), dtype=np.float32)
    angle = (AZIMUTHS_RAD[0] - AZIMUTHS_RAD[-1]) * 96 / 95
    level = FloorView.from_angles(0.95, 0.0, 0.0)
    found = measure_regions(contrast, labels, 1, RANGES_M, AZIMUTHS_RAD, level)
    edges2 = np.array([1.26, 2.51]) ** 2 - 0.95**2
    assert found.area_m2[0] == pytest.approx(angle * np.diff(edges2)[0] / 2, rel=1e-3)


def test_the_area_of_all_of_a_tilted_and_rolled_image_is_that_of_its_outline():
    """The outline on the floor, by the shoelace formula."""
    view, azimuths = FloorView.from_angles(0.95, 0.3, 0.5), np.linspace(0.9, -0.9, 192)
    labels, contrast = np.ones((192, 512), dtype=np.int32), np.zeros((192, 512), dtype=np.float32)
    area = measure_regions(contrast, labels, 1, RANGES_M, azimuths, view).area_m2[0]
    q = view.floor_points(np.tile(RANGES_M, 192), np.repeat(azimuths, 512)) @ view.level_R_sonar.T
    xy = q.T[:2].reshape(2, 192, 512)
    x, y = np.concatenate([xy[:, 0], xy[:, :, -1], xy[:, -1, ::-1], xy[:, ::-1, 0]], axis=1)
    shoelace = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
    assert area == pytest.approx(shoelace * 192 / 191 * 512 / 511, rel=2e-3)


@pytest.mark.parametrize(
    ("settings", "verdict"),
    [
        ({"min_area_m2": 0.2, "max_area_m2": 1.0}, CandidateVerdict.TOO_SMALL),
        ({"max_area_m2": 0.05}, CandidateVerdict.TOO_LARGE),
        ({"max_extent_m": 0.2}, CandidateVerdict.TOO_LONG),
    ],
)
def test_each_gate_is_the_reason_that_it_gives(settings, verdict):
    kept, gated = select(frame_with_plate()), select(frame_with_plate(), **settings)
    (row,) = kept.accepted
    assert gated.verdicts[row] == verdict
    assert len(gated.accepted) == 0


@pytest.mark.parametrize(("x", "y"), [(1.65, 0.4), (1.65, -0.4), (2.25, 0.0), (0.85, 0.0)])
def test_a_plate_cut_by_the_edge_is_rejected_unless_wanted(x, y):
    image = frame_with_plate(x, y)
    cut = select(image)
    assert CandidateVerdict.AT_EDGE in cut.verdicts[cut.area_m2 > 0.01]
    assert len(cut.accepted) == 0
    assert len(select(image, keep_at_edge=True).accepted) == 1


def test_beyond_the_limit_the_strongest_are_kept():
    image = np.maximum(frame_with_plate(y=0.25, side=0.22), frame_with_plate(y=-0.2, side=0.15, plate_db=40.0))
    (row,) = select(image, max_candidates=1).accepted
    both = select(image)
    assert len(both.accepted) == 2
    by_azimuth = both.accepted[np.argsort(both.azimuth_rad[both.accepted])]
    assert np.diff(both.area_m2[by_azimuth])[0] > 0  # the weaker one is larger
    assert both.azimuth_rad[row] < 0
    assert np.sum(select(image, max_candidates=1).verdicts == CandidateVerdict.BEYOND_LIMIT) == 1


def test_what_lies_nearer_than_the_floor_is_off_it():
    view = FloorView.from_angles(1.6, 0.0, np.radians(45))
    image = speckle_db(6)
    image[40:56, 20:60] += 15
    found = select(image.astype(np.float32), view=view)
    near = np.flatnonzero(found.boxes[:, 3] * found.boxes[:, 2] > 200)
    assert found.verdicts[near].tolist() == [CandidateVerdict.OFF_FLOOR]


def test_frames_that_break_the_rules_are_refused():
    image = frame_with_plate()
    with pytest.raises(MeasurementError, match=r"\(95, 512\)"):
        select(image[:95])
    image[3, 4] = np.nan
    with pytest.raises(MeasurementError, match="finite"):
        select(image)


@pytest.mark.parametrize("value", [0.0, 80.0])
def test_a_constant_frame_has_no_candidates(value):
    assert len(select(np.full((96, 512), value, dtype=np.float32))) == 0


def test_quantisation_alone_makes_no_false_alarms():
    """A background that hardly varies is told from objects with the least spread there is."""
    steps = np.round(np.random.default_rng(2).uniform(0, 0.6, (96, 512)))
    image = (30.0 + 0.05 * steps).astype(np.float32)
    assert np.mean(select(image, closing_m=0).labels > 0) == 0
