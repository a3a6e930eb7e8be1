"""Simulated images obey the laws that real ones obey, each with its switch."""

from copy import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import SonarImage
from sonar_graph.images import decibels
from sonar_graph.measurements import Floats
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.simulation.sonar_image import (
    SONARS,
    FrameSimulator,
    ImageOptions,
    scene,
)
from sonar_graph.simulation.sonar_image.imaging_sonar import ImagingSonar

HEIGHT_M = 0.95
TILT = Rotation.from_euler("ZYX", [0, 30, 0], degrees=True)
ABOVE = np.array([0.0, 0.0, HEIGHT_M])
PLAIN = ImageOptions(
    cross_talk_db=None, tvg_error_db=0.0, texture_shape=None, joints=False, multipath=False, noise_db=None,
    drop_probability=0.0,
)  # fmt: skip
EVEN = replace(SONARS["didson"], lens_cubic=None)
"""The same sonar with equally spaced beams."""


@cache
def floor_of(
    changes: tuple[tuple[str, object], ...], seed: int, sonar: ImagingSonar | None
) -> FrameSimulator:
    options = ImageOptions.model_validate(PLAIN.model_dump() | dict(changes))
    return FrameSimulator(options, (), 0.0, seed, sonar)


def simulator(
    objects: list[scene.SeabedObject] | None = None,
    seed: int = 0,
    sonar: ImagingSonar | None = None,
    **changes: object,
) -> FrameSimulator:
    """One floor for each set of options, with other objects on it at each call."""
    made = copy(floor_of(tuple(sorted(changes.items())), seed, sonar))
    made.objects = objects or []
    return made


def box_at(x_m: float, *size_and_level: float, y_m: float = 0.0) -> scene.SeabedObject:
    """A box on the floor; length, width, height and decibels over the floor."""
    radius_m = max(size_and_level[:2]) / 2 + 0.06
    return scene.place(
        -1,
        "box",
        scene.block(*size_and_level),
        radius_m,
        np.array([x_m, y_m, 0.0]),
        0.0,
    )


def level_db(
    made: FrameSimulator, x_m: float = 0.0, y_m: float = 0.0, number: int = 0
) -> Floats:
    place_m = np.array([x_m, y_m, HEIGHT_M])
    return made.level_db(place_m, TILT, number).astype(float)


def power(values_db: Floats) -> Floats:
    return 10 ** (values_db / 10)


def decibel(values: Floats) -> Floats:
    return 10 * np.log10(values)


def apart(k: int) -> tuple[float, float]:
    """Places so far apart that their speckle is independent."""
    return 0.31 * (k % 12), 0.33 * (k // 12)


def looks(count: int, **changes: object) -> Floats:
    """Intensities from places that are apart, shape (count, beams, bins)."""
    made = simulator(**changes)
    return power(np.array([level_db(made, *apart(k), k) for k in range(count)]))


def bins_at(made: FrameSimulator, *ranges_m: float) -> np.ndarray:
    return np.searchsorted(made.ranges_m(), ranges_m)


def test_speckle_is_exponential_in_intensity_and_spreads_by_5_57_decibels():
    first, near, far, last = bins_at(simulator(), 1.7, 1.9, 2.1, 2.3)
    values = looks(24)[:, 30:66]
    level = decibel(values[..., first:last])
    level -= level.mean(axis=(0, 1))
    # 1 % more: a cell holds a finite number of scatterers
    assert level.std() == pytest.approx(5.57, rel=0.015)
    distant = values[:, ::4, near:far:8]
    relative = (distant / distant.mean(axis=(0, 1))).reshape(-1)
    assert stats.kstest(relative, "expon").pvalue > 1e-3
    assert stats.kstest(np.sqrt(relative), "expon").pvalue < 1e-6


def test_texture_makes_the_floor_k_distributed():
    first, last = bins_at(simulator(), 1.9, 2.1)
    for shape, moment, rel in ((1.0, 2 * (1 + 1 / 1.0), 0.12), (None, 2, 0.03)):
        x = looks(30, texture_shape=shape)[:, 20:76, first:last]
        assert np.mean((x / x.mean(axis=(0, 1))) ** 2) == pytest.approx(moment, rel=rel)


@pytest.mark.parametrize(
    ("moved_m", "speckle", "atol"),
    [(0.036, "world", 0.07), (0.07, "world", 0.07), (0.0, "frame", 0.1)],
)
def test_speckle_decorrelates_with_motion_across_as_the_aperture_says(
    moved_m, speckle, atol
):
    """Of the same floor, seen from a sonar that moved across and turned back to it; "frame": drawn for each frame.

    Square of the autocorrelation of a two-way aperture (a triangle): the cubic B-spline, half of it after 3.6 cm.
    """
    # one looks straight ahead
    sonar = replace(EVEN, beams=9, azimuth_span_rad=np.radians(0.3 * 9))
    made = simulator(sonar=sonar, speckle=speckle)
    across_m = np.sqrt(2.0**2 - HEIGHT_M**2)
    turned = Rotation.from_euler("Z", -np.arctan2(moved_m, across_m)) * TILT
    shift_m = (np.hypot(across_m, moved_m) - across_m) * across_m / 2.0
    ranges_m = made.ranges_m()
    near = (ranges_m > 1.96) & (ranges_m < 2.04)
    pairs = []
    for k in range(100):
        x_m, y_m = apart(k)
        moved = np.array([x_m, y_m + moved_m, HEIGHT_M])
        here = power(level_db(made, x_m, y_m, 2 * k)[4])
        there = power(made.level_db(moved, turned, 2 * k + 1)[4].astype(float))
        again = np.interp(ranges_m[near] + shift_m, ranges_m, there)
        pairs.append((here[near], again))
    found = np.corrcoef(*np.hstack(pairs))[0, 1]
    u = 2 * moved_m / (0.886 * 1480 / 1.8e6 / np.radians(0.3))
    spline = max(1 - 1.5 * u**2 + 0.75 * u**3 if u < 1 else (2 - u) ** 3 / 4, 0) ** 2
    expected = spline if speckle == "world" else 0.0
    assert found == pytest.approx(expected, abs=atol)
    assert moved_m != 0.036 or spline == pytest.approx(0.5, abs=0.02)


def elevation_pattern(lift_rad: Floats) -> Floats:
    return np.sinc(0.886 * np.sin(lift_rad) / np.sin(np.radians(14))) ** 4


def test_level_over_range_is_that_of_spreading_absorption_and_gain():
    made = simulator(absorption_db_m=0.8)
    at = bins_at(made, 1.65, 1.8, 2.0, 2.2, 2.35)
    mean = looks(60)[:, 20:76].mean(axis=(0, 1))
    smooth = decibel(np.array([mean[k - 12 : k + 12].mean() for k in at]))
    r = made.ranges_m()[at]
    sine = HEIGHT_M / r
    pattern = elevation_pattern(np.arcsin(sine) - np.radians(30))
    cell = r / np.sqrt(1 - sine**2)  # metres of floor in a beam, times those in a bin
    # Lambert, spreading, and gain of 30 log r
    echo = decibel(sine**2 * pattern * cell / r**4 * r**3)
    np.testing.assert_allclose(smooth - smooth[2], echo - echo[2], atol=0.35)
    assert smooth[2] == pytest.approx(40 + decibel(pattern[2]), abs=0.3)


def test_shadow_is_as_long_as_height_and_grazing_angle_make_it():
    height_m = 0.06
    far_m = 1.55
    box = box_at(1.5, 0.1, 0.3, height_m, 0.0)
    profile, lit = (
        level_db(simulator([box], shadows=is_on))[40:56].mean(axis=0)
        for is_on in (True, False)
    )
    # over the far upper edge
    end_m = np.hypot(far_m * HEIGHT_M / (HEIGHT_M - height_m), HEIGHT_M)
    ranges_m = simulator().ranges_m()
    dark = ranges_m[(profile < 0) & (ranges_m > 1.6)]
    assert dark[0] == pytest.approx(np.hypot(far_m, HEIGHT_M - height_m), abs=0.012)
    assert dark[-1] == pytest.approx(end_m, abs=0.012)
    behind = (ranges_m > np.hypot(far_m + 0.01, HEIGHT_M)) & (ranges_m < end_m)
    assert lit[behind].min() > 20


def test_landmark_is_as_much_brighter_than_the_floor_as_its_mask_says():
    plate = box_at(1.7, 0.3, 0.3, 0.0, 12.0)
    first, last = bins_at(simulator(), 1.9, 2.0)
    on, off = (
        np.mean(
            [
                power(level_db(simulator(objects, speckle="frame"), number=n))
                for n in range(8)
            ],
            axis=0,
        )[42:54, first:last].mean()
        for objects in ([plate], [])
    )
    assert decibel(on / off) == pytest.approx(12, abs=0.2)


def point_response(**changes: object) -> np.ndarray:
    """Level of every beam around a small strong object straight ahead, in dB below its own."""
    dot = box_at(1.75, 0.005, 0.005, 0.0, 140.0, y_m=0.002)
    image = level_db(simulator([dot], **changes))
    column = int(np.argmax(image.max(axis=0)))
    return image[:, column] - image[:, column].max()


def test_first_side_lobe_lies_26_decibels_down_and_can_be_switched_off():
    unit_rad = np.radians(0.3) / 0.8859
    offset = np.linspace(1.001, 2.0, 1700) * unit_rad
    amplitude = replace(EVEN, beams=960).two_way_pattern(offset, True)
    pattern_db = 20 * np.log10(amplitude)
    assert pattern_db.max() == pytest.approx(-26.5, abs=0.2)
    assert offset[np.argmax(pattern_db)] == pytest.approx(1.43 * unit_rad, rel=0.01)
    with_lobes, without = (
        np.sort(point_response(side_lobes=is_on))[::-1] for is_on in (True, False)
    )
    assert with_lobes[20] > without[20] + 20


def test_cross_talk_shows_every_eighth_beam_at_its_level():
    quiet = point_response(side_lobes=False)
    loud = point_response(side_lobes=False, cross_talk_db=-25.0)
    off = np.arange(96) - np.argmax(loud)
    is_ghost = (np.abs(off) > 6) & (off % 8 == 0)
    assert (loud > quiet + 10)[is_ghost].all()
    assert decibel(np.sum(power(loud[is_ghost]))) == pytest.approx(-25, abs=1.5)


def test_an_echo_by_the_surface_has_delay_and_level_of_its_way():
    """The samples of a bright plate come again at the later bin: spreading (r / late)^4, gain (late / r)^3."""
    depth_m = 0.75
    plate = box_at(1.35, 0.3, 0.4, 0.0, 60.0)
    surface = {"surface_path_db": -9.0, "absorption_db_m": 0.0}
    made = simulator([plate], multipath=True, **surface)
    image = made.level_db(ABOVE, TILT, 0, HEIGHT_M + depth_m)[42:54].astype(float)
    r = made.ranges_m()
    level_m2 = np.maximum(r**2 - HEIGHT_M**2, 0)
    late_m = 0.5 * (r + np.sqrt(level_m2 + (HEIGHT_M + 2 * depth_m) ** 2))
    on = (r > np.hypot(1.25, HEIGHT_M)) & (r < np.hypot(1.45, HEIGHT_M))
    echo = image[:, np.abs(r - late_m[on, None]).argmin(axis=1)]
    longer_db = decibel(late_m[on] / r[on])
    assert np.mean(echo - image[:, on] + 9.0 + longer_db) == pytest.approx(0, abs=0.3)
    # by which it would be off without one of the spreadings
    assert np.mean(2 * longer_db) > 2


def test_a_log_may_state_beams_that_are_equally_spaced():
    """The true ones are compared with the lens of the recogniser in tests/sonar/test_geometry.py."""
    linear = simulator(measured_lens=False)
    np.testing.assert_allclose(np.degrees(np.diff(linear.azimuths_rad())), 0.3)
    np.testing.assert_array_equal(level_db(simulator()), level_db(linear))


@pytest.mark.parametrize("name", sorted(SONARS))
def test_every_sonar_makes_images_of_its_size_and_logs_their_span(name, monkeypatch):
    """Its samples are decibels over the span."""
    sonar = replace(SONARS[name], decibel_span=100.0)
    monkeypatch.setitem(SONARS, name, sonar)
    made = simulator(sonar=sonar, noise_db=15.0)
    image = made.frame(ABOVE, TILT, 0)
    assert image.shape == (sonar.beams, sonar.bins)
    options = BasinOptions(duration_s=120.0, laps=1, image=ImageOptions(sonar=name))
    said = simulate_basin(options).calibration.sonar.image
    assert said == SonarImage(scale="decibel", decibel_span=100.0, full_scale=255)
    found = decibels(image, said)
    # the mean of decibels: 2.5 below
    middle = found[sonar.beams // 2 - 5 : sonar.beams // 2 + 5, 250:350]
    assert middle.mean() == pytest.approx(40 - 2.5, abs=1.5)
    inside = (image > 0) & (image < 255)
    assert inside.mean() > 0.9
    off_db = np.abs(found - level_db(made))[inside]
    assert off_db.max() < 0.5 * 100.0 / 255 + 1e-4


MIDDLE_M = 1.6
FRAMES = 16
LENGTH_M = 0.06
WIDTH_M = 0.2


def ramp(rise: float) -> scene.SeabedObject:
    """Rises away from the sonar; only its middle scatters much, 60 dB over the floor."""

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        is_bright = (np.abs(x_m) < LENGTH_M / 2) & (np.abs(y_m) < WIDTH_M / 2)
        rises = (np.abs(x_m) < 0.08) & (np.abs(y_m) < 0.15)
        height_m = np.where(rises, rise * (x_m + 0.08), 0.0)
        return np.where(is_bright, 60.0, np.nan), height_m

    return scene.place(-1, "ramp", shape, 0.2, np.array([MIDDLE_M, 0.0, 0.0]), 0.0)


def energy_of_ramp(rise: float, **changes: object) -> float:
    """Mean sum over all samples; scatterers are drawn again for each frame."""
    changes = {"shadows": False, "absorption_db_m": 0.0, "speckle": "frame"} | changes
    made = simulator([ramp(rise)], **changes)
    return np.mean([np.sum(power(level_db(made, number=n))) for n in range(FRAMES)])


def by_hand(rise: float, *, is_ghost: bool = False) -> float:
    """Lambert's cos^2 i times the facet's area, elevation pattern, and range: spreading r^-4 and gain r^3."""
    x = MIDDLE_M + np.linspace(-LENGTH_M / 2, LENGTH_M / 2, 41)
    y = np.linspace(-WIDTH_M / 2, WIDTH_M / 2, 41)[:, None]
    top = rise * (x - MIDDLE_M + 0.08)
    to_face = np.stack(np.broadcast_arrays(x, y, top - HEIGHT_M), axis=-1)
    r = np.linalg.norm(to_face, axis=-1)
    area = np.hypot(1, rise)
    cos = to_face @ [rise, 0.0, -1.0] / area / r
    up = to_face @ TILT.as_matrix()[:, 2]
    pattern = elevation_pattern(np.arcsin(up / r))
    if is_ghost:
        r = 0.5 * (r + np.sqrt(x**2 + y**2 + (HEIGHT_M + top) ** 2))
    return np.mean(cos**2 * area * pattern / r)


@pytest.mark.parametrize("rise", [1.0, 1.5])
def test_a_sloping_face_echoes_by_lamberts_rule_times_its_area(rise):
    ratio_db = decibel(energy_of_ramp(rise) / energy_of_ramp(0.0))
    expected_db = decibel(by_hand(rise) / by_hand(0.0))
    assert ratio_db == pytest.approx(expected_db, abs=0.4)


def test_a_steep_face_echoes_by_way_of_the_floor_there_and_back():
    """Out by the floor and back straight, and the other way round, are equally long: twice the amplitude."""
    rise = 1.5
    amplitude = 2 * 0.8 * (1 - 1 / np.hypot(1, rise))
    with_floor = energy_of_ramp(rise, multipath=True, floor_reflection=0.8)
    expected = amplitude**2 * by_hand(rise, is_ghost=True) / by_hand(rise)
    share = with_floor / energy_of_ramp(rise) - 1
    assert share == pytest.approx(expected, rel=0.2)


def test_noise_adds_its_power_to_the_echo():
    """At 2 m, where the gain over range is 0 dB."""
    first, last = bins_at(simulator(), 1.95, 2.05)
    added = (looks(8, noise_db=40.0) - looks(8))[:, 20:76, first:last].mean()
    assert decibel(added) == pytest.approx(40, abs=0.3)
