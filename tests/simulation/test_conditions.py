"""Each condition of a scene obeys its own law, and the basin without any is as it was."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.spatial.transform import Rotation

from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS
from sonar_graph.errors import SettingError
from sonar_graph.measurements import Floats
from sonar_graph.simulation.basin import (
    FLOOR_Z_M,
    LANDMARKS_XY_M,
    UNKNOWN_OBJECTS,
    YSHARK,
    BasinOptions,
    simulate_basin,
    simulate_basin_frames,
)
from sonar_graph.simulation.sonar_image import (
    SCENES,
    SONARS,
    FrameSimulator,
    ImageOptions,
    SeabedObject,
    place_landmark,
    strangers_at,
    true_mounting,
    weathered,
)
from sonar_graph.simulation.sonar_image.scene import CELL_M, CELLS, scatterers
from sonar_graph.simulation.sonar_image.strangers import GROUPS, KINDS

TILT = Rotation.from_euler("ZYX", [0, 30, 0], degrees=True)
BARE = {
    "cross_talk_db": None,
    "tvg_error_db": 0.0,
    "texture_shape": None,
    "joints": False,
    "multipath": False,
}
BARE |= {"noise_db": None, "drop_probability": 0.0, "speckle": "frame"}
EVEN = SONARS["didson"].model_copy(update={"lens_cubic": None})
GOLDEN = [
    [68, 98, 140, 138, 139, 103, 109, 98, 66],
    [90, 135, 115, 93, 140, 138, 80, 141, 66],
    [109, 131, 148, 129, 127, 136, 99, 113, 105],
    [0, 133, 118, 110, 105, 141, 64, 97, 37],
    [65, 123, 101, 147, 163, 137, 77, 111, 96],
    [100, 104, 91, 137, 96, 161, 95, 124, 107],
    [94, 116, 134, 122, 148, 114, 100, 115, 114],
    [71, 128, 120, 101, 130, 107, 98, 104, 73],
    [102, 83, 91, 92, 108, 119, 120, 90, 67],
    [98, 120, 155, 115, 123, 87, 53, 86, 118],
]
"""Samples of frame 9, of every tenth beam and every fiftieth bin; a landmark is in view."""
OTHERS_XY_M = [
    *([3.546, -0.272], [3.332, -6.855], [0.03, -4.814], [7.231, -6.614]),
    *([6.531, -0.047], [6.837, -2.192], [0.385, -6.786], [0.117, -0.316]),
]
TRIANGLE = DEFAULT_DESIGNS[2]


def mean_intensity(made: FrameSimulator, height_m: float, frames: int) -> Floats:
    """Of one place, over scatterers drawn anew for each frame."""
    place = np.array([0.0, 0.0, height_m])
    levels = [made.level_db(place, TILT, n).astype(float) for n in range(frames)]
    return np.mean([10 ** (one / 10) for one in levels], axis=0)


def landmark(seed: int = 0, **conditions: object) -> SeabedObject:
    options = ImageOptions.model_validate(conditions)
    placed = place_landmark(
        TRIANGLE, np.array([1.75, 0.0, 0.013]), 0.3, 0.0, options.foam_height_m
    )
    return weathered(placed, options, np.random.default_rng(seed))


FRESH = landmark()
MATERIAL = ~np.isnan(FRESH.amplitude)
FOAM, PLATE = FRESH.amplitude > 1, FRESH.amplitude < 1


def test_flush_landmarks_without_conditions_make_the_images_that_they_always_made():
    image = {"foam_height_m": 0.0}
    options = BasinOptions.model_validate(
        {"duration_s": 130, "laps": 1, "frame_rate_hz": 1.0, "image": image}
    )
    imaged = next(islice(simulate_basin_frames(options, 1), 9, None))
    image, truth = imaged.frames.intensity[0].astype(int), imaged.truth
    # one: another processor's rounding
    np.testing.assert_allclose(image[4::10, 100::50], GOLDEN, atol=1)
    places = (
        Rotation.from_quat(truth.quaternions_xyzw[0]).apply(truth.points_m[0])
        + truth.positions[0]
    )
    np.testing.assert_allclose(places[4:, :2], OTHERS_XY_M, atol=6e-4)


def test_a_preset_gives_what_is_not_given():
    assert ImageOptions(scene="easy") == ImageOptions()
    for name, values in SCENES.items():
        made = ImageOptions(scene=name)
        assert made.model_dump() == ImageOptions().model_dump() | values | {
            "scene": name
        }
        assert ImageOptions.model_validate(made.model_dump()) == made
    mixed = ImageOptions(scene="hard", contrast_db=-6.0, strangers=())
    assert (mixed.contrast_db, mixed.strangers) == (-6.0, ())
    assert mixed.sediment == SCENES["hard"]["sediment"]
    with pytest.raises(SettingError, match=r"scene: .*easy.*hard"):
        ImageOptions(scene="calm")


def test_contrast_changes_bright_parts_and_the_plate_has_a_level_of_its_own():
    worn = landmark(contrast_db=-4.5, plate_db=0.0)
    np.testing.assert_allclose(20 * np.log10(worn.amplitude[FOAM]), 12 - 4.5, atol=1e-4)
    np.testing.assert_allclose(20 * np.log10(worn.amplitude[PLATE]), 0.0, atol=1e-4)
    np.testing.assert_array_equal(np.isnan(worn.amplitude), ~MATERIAL)
    np.testing.assert_array_equal(worn.relief_m, FRESH.relief_m)


def test_foam_stands_on_its_plate_with_its_face_where_it_was():
    flush, deepest = landmark(foam_height_m=0.0), landmark(foam_height_m=0.1)
    for one in (FRESH, deepest):
        np.testing.assert_array_equal(one.relief_m[FOAM], flush.relief_m[FOAM])
    np.testing.assert_allclose(
        FRESH.relief_m[PLATE], flush.relief_m[PLATE] - TRIANGLE.relief_m, atol=1e-6
    )
    np.testing.assert_allclose(
        deepest.relief_m[PLATE], flush.relief_m[PLATE] - TRIANGLE.height_m, atol=1e-6
    )


@pytest.mark.parametrize(
    ("name", "share"), [("sediment", 0.25), ("sediment", 1.0), ("fouling", 0.4)]
)
def test_patches_not_pixels_cover_the_share_that_is_asked_for(name: str, share: float):
    worn = landmark(3, **{name: share})
    if name == "sediment":
        covered = np.isnan(worn.amplitude) & MATERIAL
    else:
        covered = MATERIAL & np.isclose(20 * np.log10(worn.amplitude), 3.0, atol=1e-4)
    assert covered[MATERIAL].mean() == pytest.approx(share, abs=1e-3)
    assert label(covered)[1] < 12  # a tenth of the cells at random would make hundreds
    other = landmark(4, **{name: share})
    assert np.array_equal(other.amplitude, worn.amplitude, equal_nan=True) == (
        share == 1.0
    )


def test_what_drowned_has_no_edges_and_what_grows_is_at_most_eight_millimetres_high():
    drowned, overgrown = landmark(3, sediment=1.0), landmark(3, fouling=0.5)
    steepest = [
        np.abs(np.diff(one.relief_m, axis=1)).max() / CELL_M for one in (FRESH, drowned)
    ]
    assert steepest[1] < 0.4 < 3 < steepest[0]  # 13 mm over 2 sqrt(2 pi) sigma
    growth_m = overgrown.relief_m - FRESH.relief_m
    assert 0.003 < growth_m.max() <= 0.008
    assert np.abs(growth_m[~MATERIAL]).max() == 0


def test_a_drowned_landmark_echoes_as_the_floor_does():
    flat = replace(landmark(sediment=1.0), relief_m=np.zeros_like(FRESH.relief_m))
    options = ImageOptions.model_validate(BARE)
    with_, without = (
        mean_intensity(FrameSimulator(options, o, 0.0, 0, EVEN), 0.95, 4)
        for o in ([flat], [])
    )
    np.testing.assert_allclose(with_, without, rtol=1e-5)


@pytest.mark.parametrize("length_m", [0.03, 0.06])
def test_strength_of_the_floor_is_smooth_over_the_length_that_is_asked_for(
    length_m: float,
):
    strength = (
        scatterers(50.0, False, np.random.default_rng(3), length_m).texture.astype(
            float
        )
        ** 2
    )
    power = np.mean(np.abs(np.fft.fft(strength - strength.mean(), axis=1)) ** 2, axis=0)
    correlation, distance_m = np.fft.ifft(power).real, np.arange(CELLS) * CELL_M
    near = distance_m < 2 * length_m
    np.testing.assert_allclose(
        (correlation / correlation[0])[near],
        np.exp(-((distance_m[near] / length_m) ** 2)),
        atol=0.08,
    )


def rippled(length_m: float, height_m: float, seed: int = 2) -> Floats:
    relief_m = scatterers(
        None, False, np.random.default_rng(seed), 0.03, length_m, height_m
    ).relief_m
    assert relief_m is not None
    return relief_m.astype(float)


def test_ripples_have_the_length_and_height_that_are_asked_for():
    relief_m = rippled(0.10, 0.02)
    assert (relief_m.min(), relief_m.max()) == pytest.approx((-0.02, 0.0), abs=1e-5)
    power = np.abs(np.fft.fft2(relief_m - relief_m.mean())) ** 2
    waves = np.fft.fftfreq(CELLS, CELL_M)
    total = np.hypot(*np.meshgrid(waves, waves))
    assert np.sum(total * power) / power.sum() == pytest.approx(1 / 0.10, rel=0.05)
    assert relief_m.std() == pytest.approx(0.02 / np.sqrt(8), rel=0.03)
    assert scatterers(None, False, np.random.default_rng(2)).relief_m is None


def floor_points(sonar_height_m: float, made: FrameSimulator) -> Floats:
    """World x and y at which each beam and bin meets the plane z = 0, shape (beams, bins, 2)."""
    azimuth, r = made.sonar.azimuths_rad()[:, None], made.sonar.ranges_m()
    lift = np.linspace(-0.26, 0.26, 1041)
    down = np.sin(np.radians(30)) * np.cos(azimuth) * np.cos(lift) - np.cos(
        np.radians(30)
    ) * np.sin(lift)  # beams, lift
    at = np.stack(
        [np.interp(sonar_height_m / r, row[::-1], lift[::-1]) for row in down]
    )
    ray = np.stack(
        [np.cos(at) * np.cos(azimuth), np.cos(at) * np.sin(azimuth), np.sin(at)],
        axis=-1,
    )
    return (TILT.apply(ray.reshape(-1, 3)).reshape(ray.shape) * r[:, None])[..., :2]


def test_faces_of_ripples_echo_by_lamberts_rule():
    """cos² of the angle from the facet's normal, times its area, against that of the plane.

    And a bin of slant range holds the more floor, the more it rises away from the sonar.
    """
    length_m, height_m, seed, high_m = 0.16, 0.012, 5, 0.95
    options = [
        ImageOptions.model_validate(
            BARE | {"ripple_length_m": length_m, "ripple_height_m": h}
        )
        for h in (height_m, 0)
    ]
    made, even = (FrameSimulator(o, [], 0.0, seed, EVEN) for o in options)
    seen = mean_intensity(made, high_m, 60) / mean_intensity(even, high_m, 60)
    relief_m = made._floor.relief_m.astype(float)
    at = floor_points(high_m, made)
    slope_y, slope_x = np.gradient(relief_m, CELL_M)
    cell = tuple(np.floor(at[..., k] / CELL_M).astype(int) % CELLS for k in (1, 0))
    to_sonar = np.concatenate([-at, np.full((*at.shape[:2], 1), high_m)], axis=-1)
    to_sonar /= np.linalg.norm(to_sonar, axis=-1, keepdims=True)
    facet = (
        to_sonar[..., 2]
        - to_sonar[..., 0] * slope_x[cell]
        - to_sonar[..., 1] * slope_y[cell]
    )
    area = np.sqrt(1 + slope_x[cell] ** 2 + slope_y[cell] ** 2)
    run = np.linalg.norm(to_sonar[..., :2], axis=-1)
    shortened = (
        run
        + (to_sonar[..., 0] * slope_x[cell] + to_sonar[..., 1] * slope_y[cell])
        * to_sonar[..., 2]
        / run
    )
    expected = facet**2 / area / to_sonar[..., 2] ** 2 * run / shortened
    expected_db, seen_db = (10 * np.log10(x[10:86, 150:450]) for x in (expected, seen))
    assert expected_db.std() > 1.5
    assert np.corrcoef(expected_db.ravel(), seen_db.ravel())[0, 1] > 0.85
    assert np.polyfit(expected_db.ravel(), seen_db.ravel(), 1)[0] == pytest.approx(
        1, abs=0.12
    )


@pytest.mark.parametrize("height_m", [0.004, 0.03])
def test_ripples_hide_their_lee_where_they_are_steeper_than_the_rays(height_m: float):
    """Dark bins are those in which no point of the profile under a beam is in sight."""
    high_m, tilt = 0.35, Rotation.from_euler("ZYX", [0, 12, 0], degrees=True)
    conditions = {"ripple_length_m": 0.15, "ripple_height_m": height_m}
    made = FrameSimulator(
        ImageOptions.model_validate(BARE | conditions), [], 0.0, 3, EVEN
    )
    relief_m = made._floor.relief_m.astype(float)
    run_m, expected = np.arange(0.8, 2.6, 0.001), []
    for azimuth in EVEN.azimuths_rad()[10:86]:
        column, row = (
            np.floor(run_m * f(azimuth) / CELL_M).astype(int) % CELLS
            for f in (np.cos, np.sin)
        )
        drop_m = high_m - relief_m[row, column]
        rises = -drop_m / run_m
        in_sight = rises >= np.maximum.accumulate(rises)
        seen = (
            np.histogram(np.hypot(run_m, drop_m)[in_sight], EVEN.bins, (1.26, 2.51))[0]
            > 0
        )
        expected.append(~seen[100:450])
    image = made.level_db(np.array([0.0, 0.0, high_m]), tilt, 0)[10:86, 100:450]
    assert np.mean(image < 10) == pytest.approx(np.mean(expected), abs=0.06)
    assert np.mean((image < 10) == np.array(expected)) > 0.85


def test_ripples_end_before_a_landmark():
    options = ImageOptions.model_validate(BARE | {"ripple_height_m": 0.03})
    hidden = [landmark(sediment=1.0)]
    made = [FrameSimulator(options, o, 0.0, 0, EVEN) for o in (hidden, [])]
    disc, rough = (mean_intensity(one, 0.95, 30)[44:52] for one in made)
    ranges_m = EVEN.ranges_m()
    on = (ranges_m > np.hypot(1.68, 0.95)) & (ranges_m < np.hypot(1.82, 0.95))
    assert (
        np.log(disc.mean(axis=0)[on]).std() < 0.6 * np.log(rough.mean(axis=0)[on]).std()
    )


def test_strangers_take_turns_and_keep_within_their_disc():
    spots_m = np.column_stack([np.arange(18.0), np.zeros(18), np.zeros(18)])
    objects = strangers_at(
        spots_m, ("natural", "look-alikes", "lid"), -9, np.random.default_rng(1)
    )
    assert [o.id for o in objects] == list(range(-9, -27, -1))
    assert sorted(o.kind for o in objects) == sorted(2 * list(KINDS))
    for item in objects:
        rows, columns = np.nonzero(~np.isnan(item.amplitude))
        x, y = (
            (columns + item.first_column + 0.5) * CELL_M,
            (rows + item.first_row + 0.5) * CELL_M,
        )
        away_m = np.hypot(x - item.position_m[0], y - item.position_m[1])
        assert 0.3 * item.extent_m < away_m.max() <= item.extent_m + CELL_M
        assert 0.002 < item.relief_m.max() < 0.12
    assert strangers_at(spots_m, (), -1, np.random.default_rng(1)) == []


@pytest.mark.parametrize("group", sorted(GROUPS))
def test_strangers_lie_beside_the_landmarks_and_truth_and_log_say_what_they_are(
    group: str,
):
    image = {"strangers": [group], "stones": 1, "decoys": 0}
    options = BasinOptions.model_validate(
        {"duration_s": 130, "laps": 1, "frame_rate_hz": 1.0, "image": image}
    )
    truth = next(simulate_basin_frames(options, 1)).truth
    assert truth.kinds[:5] == (*(design.name for design in DEFAULT_DESIGNS), "stone")
    assert truth.ids.tolist() == [1, 2, 3, 4, *range(-1, -10, -1)]
    assert set(truth.kinds[5:]) == set(GROUPS[group])
    world_R_sonar = Rotation.from_quat(truth.quaternions_xyzw[0])
    places = world_R_sonar.apply(truth.points_m[0]) + truth.positions[0]
    np.testing.assert_allclose(places[4:, 2], FLOOR_Z_M, atol=1e-9)
    nearest_m = np.linalg.norm(places[5:, None, :2] - LANDMARKS_XY_M, axis=2).min(
        axis=1
    )
    assert nearest_m.min() > 0.6
    assert nearest_m.max() < 0.75
    note = simulate_basin(options).notes[UNKNOWN_OBJECTS]
    said = [
        f"{kind} at ({x:.2f}, {y:.2f})"
        for kind, (x, y, _) in zip(truth.kinds[4:], places[4:], strict=True)
    ]
    assert note == ", ".join(said)


def test_strangers_and_wear_leave_the_rest_of_the_basin_alone():
    usual, hard = (
        next(
            simulate_basin_frames(
                BasinOptions(duration_s=130, laps=1, image=ImageOptions(**image)), 1
            )
        ).truth
        for image in ({}, {"strangers": ("lid",), "sediment": 0.3, "fouling": 0.2})
    )
    np.testing.assert_array_equal(hard.points_m[:, : len(usual.ids)], usual.points_m)
    assert hard.kinds[: len(usual.ids)] == usual.kinds


def test_the_sonar_sees_from_another_pose_than_the_log_says():
    options = ImageOptions(attitude_error_deg=0.5, altitude_error_m=0.02)
    made = [true_mounting(YSHARK.sonar, options, seed) for seed in range(400)]
    turned = np.degrees(np.array([m.rpy_rad for m in made]) - YSHARK.sonar.rpy_rad)
    moved_m = np.array([m.translation_m for m in made]) - YSHARK.sonar.translation_m
    np.testing.assert_allclose(turned.std(axis=0), 0.5, rtol=0.12)
    np.testing.assert_allclose(moved_m.std(axis=0), [0, 0, 0.02], rtol=0.12, atol=1e-12)
    np.testing.assert_allclose(
        np.corrcoef(np.column_stack([turned, moved_m[:, 2]]).T), np.eye(4), atol=0.15
    )
    assert true_mounting(YSHARK.sonar, ImageOptions(), 3) == YSHARK.sonar

    def of(image: ImageOptions) -> BasinOptions:
        return BasinOptions(duration_s=130, laps=1, seed=3, image=image)

    true, told = (
        next(simulate_basin_frames(of(image), 1)).truth
        for image in (options, ImageOptions())
    )
    seen = Rotation.from_quat(told.quaternions_xyzw[0]).inv() * Rotation.from_quat(
        true.quaternions_xyzw[0]
    )
    meant = Rotation.from_euler(
        "xyz", YSHARK.sonar.rpy_rad
    ).inv() * Rotation.from_euler("xyz", made[3].rpy_rad)
    assert seen.magnitude() == pytest.approx(meant.magnitude(), abs=1e-9)
    assert simulate_basin(of(options)).calibration.sonar.mounting == YSHARK.sonar
