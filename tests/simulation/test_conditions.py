"""Each condition of a scene obeys its own law, and the basin without any is as it was."""

from itertools import islice

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.spatial.transform import Rotation

from sonar_graph.devices import DEFAULT_DESIGNS
from sonar_graph.errors import SettingError
from sonar_graph.measurements import Floats
from sonar_graph.simulation import (
    LANDMARKS_XY_M,
    BasinOptions,
    simulate_basin,
    simulate_basin_frames,
)
from sonar_graph.simulation.basin import FLOOR_Z_M, UNKNOWN_OBJECTS, YSHARK
from sonar_graph.simulation.sonar_image import (
    SCENES,
    ImagedFrames,
    ImageOptions,
    SeabedObject,
    place_landmark,
    true_mounting,
    weathered,
)
from sonar_graph.simulation.sonar_image.frames import FrameTruth
from sonar_graph.simulation.sonar_image.scene import CELL_M, CELLS, scatterers
from sonar_graph.simulation.sonar_image.strangers import GROUPS

GOLDEN = [
    [68, 98, 140, 138, 139, 103, 109, 98, 66],
    [109, 131, 148, 129, 127, 136, 99, 113, 105],
    [65, 123, 101, 147, 163, 137, 77, 111, 96],
    [94, 116, 134, 122, 148, 114, 100, 115, 114],
    [102, 83, 91, 92, 108, 119, 120, 90, 67],
]
"""Samples of frame 9, of every twentieth beam and every fiftieth bin; a landmark is in view."""
OTHERS_XY_M = [[0.385, -6.786], [0.117, -0.316]]


SHORT = {"duration_s": 130, "laps": 1, "frame_rate_hz": 1.0}


def imaged(number: int = 0, **image: object) -> ImagedFrames:
    """A frame of the basin."""
    options = BasinOptions.model_validate(SHORT | {"image": image})
    return next(islice(simulate_basin_frames(options, 1), number, None))


def places_of(truth: FrameTruth) -> Floats:
    """Of all objects in the basin."""
    world_R_sonar = Rotation.from_quat(truth.quaternions_xyzw[0])
    return world_R_sonar.apply(truth.points_m[0]) + truth.positions[0]


TRIANGLE = DEFAULT_DESIGNS[2]


def landmark(seed: int = 0, **conditions: object) -> SeabedObject:
    options = ImageOptions.model_validate(conditions)
    placed = place_landmark(
        TRIANGLE, np.array([1.75, 0.0, 0.013]), 0.3, 0.0, options.foam_height_m
    )
    return weathered(placed, options, np.random.default_rng(seed))


FRESH = landmark()


IS_MATERIAL = ~np.isnan(FRESH.amplitude)


def test_flush_landmarks_without_conditions_make_the_golden_image():
    ninth = imaged(9, foam_height_m=0.0)
    image = ninth.frames.intensity[0].astype(int)
    # one: another processor's rounding
    np.testing.assert_allclose(image[4::20, 100::50], GOLDEN, atol=1)
    last_m = places_of(ninth.truth)[-2:, :2]
    np.testing.assert_allclose(last_m, OTHERS_XY_M, atol=6e-4)


def test_a_preset_gives_what_is_not_given():
    usual = ImageOptions()
    assert ImageOptions(scene="easy") == usual
    for name, values in SCENES.items():
        made = ImageOptions(scene=name)
        assert made == usual.model_copy(update={**values, "scene": name})
        assert ImageOptions.model_validate(made.model_dump()) == made
    mixed = ImageOptions(scene="hard", contrast_db=-6.0, strangers=())
    assert (mixed.contrast_db, mixed.strangers) == (-6.0, ())
    assert mixed.sediment == SCENES["hard"]["sediment"]
    with pytest.raises(SettingError, match=r"scene: .*easy.*hard"):
        ImageOptions(scene="calm")


def test_contrast_changes_bright_parts_and_not_the_plate():
    worn = landmark(contrast_db=-4.5, plate_db=0.0)
    level_db = np.where(FRESH.amplitude > 1, 12 - 4.5, 0.0)
    level_db[~IS_MATERIAL] = np.nan
    np.testing.assert_allclose(20 * np.log10(worn.amplitude), level_db, atol=1e-4)
    np.testing.assert_array_equal(worn.relief_m, FRESH.relief_m)


@pytest.mark.parametrize(
    ("name", "share"), [("sediment", 0.25), ("sediment", 1.0), ("fouling", 0.4)]
)
def test_patches_not_pixels_cover_the_share_that_is_asked_for(name, share):
    worn, other = (landmark(seed, **{name: share}).amplitude for seed in (3, 4))
    if name == "sediment":
        covered = np.isnan(worn) & IS_MATERIAL
    else:
        covered = IS_MATERIAL & np.isclose(20 * np.log10(worn), 3.0, atol=1e-4)
    assert covered[IS_MATERIAL].mean() == pytest.approx(share, abs=1e-3)
    assert label(covered)[1] < 12  # a tenth of the cells at random would make hundreds
    assert np.array_equal(other, worn, equal_nan=True) == (share == 1.0)


def test_strength_of_the_floor_is_smooth_over_the_length_that_is_asked_for():
    length_m = 0.06
    floor = scatterers(50.0, False, np.random.default_rng(3), length_m)
    strength = floor.texture.astype(float) ** 2
    power = np.abs(np.fft.fft(strength - strength.mean(), axis=1)) ** 2
    correlation = np.fft.ifft(power.mean(axis=0)).real
    distance_m = np.arange(CELLS) * CELL_M
    near = distance_m < 2 * length_m
    expected = np.exp(-((distance_m[near] / length_m) ** 2))
    found = correlation[near] / correlation[0]
    np.testing.assert_allclose(found, expected, atol=0.08)


def test_ripples_have_the_length_and_height_that_are_asked_for():
    rng = np.random.default_rng(2)
    floor = scatterers(None, False, rng, 0.03, 0.10, 0.02)
    relief_m = floor.relief_m.astype(float)
    assert (relief_m.min(), relief_m.max()) == pytest.approx((-0.02, 0.0), abs=1e-5)
    power = np.abs(np.fft.fft2(relief_m - relief_m.mean())) ** 2
    waves = np.fft.fftfreq(CELLS, CELL_M)
    total = np.hypot(*np.meshgrid(waves, waves))
    assert np.sum(total * power) / power.sum() == pytest.approx(1 / 0.10, rel=0.05)
    assert relief_m.std() == pytest.approx(0.02 / np.sqrt(8), rel=0.03)
    assert scatterers(None, False, np.random.default_rng(2)).relief_m.size == 0


@pytest.mark.parametrize("group", sorted(GROUPS))
def test_strangers_lie_beside_the_landmarks_and_are_in_truth_and_log(group):
    image = {"strangers": [group], "stones": 1, "decoys": 0}
    truth = imaged(**image).truth
    assert truth.kinds[:5] == (*(design.name for design in DEFAULT_DESIGNS), "stone")
    assert truth.ids.tolist() == [1, 2, 3, 4, *range(-1, -10, -1)]
    assert set(truth.kinds[5:]) == set(GROUPS[group])
    places_m = places_of(truth)[4:]
    np.testing.assert_allclose(places_m[:, 2], FLOOR_Z_M, atol=1e-9)
    apart_m = np.linalg.norm(places_m[1:, None, :2] - LANDMARKS_XY_M, axis=2)
    nearest_m = apart_m.min(axis=1)
    assert 0.6 < nearest_m.min() < nearest_m.max() < 0.75
    note = simulate_basin(BasinOptions.model_validate(SHORT | {"image": image})).notes
    assert note[UNKNOWN_OBJECTS] == ", ".join(
        f"{kind} at ({x:.2f}, {y:.2f})"
        for kind, (x, y, _) in zip(truth.kinds[4:], places_m, strict=True)
    )


def test_the_sonar_sees_from_another_pose_than_the_log_says():
    options = ImageOptions(attitude_error_deg=0.5, altitude_error_m=0.02)
    made = [true_mounting(YSHARK.sonar, options, seed) for seed in range(400)]
    turned_deg = np.degrees(np.array([m.rpy_rad for m in made]) - YSHARK.sonar.rpy_rad)
    moved_m = np.array([m.translation_m for m in made]) - YSHARK.sonar.translation_m
    np.testing.assert_allclose(turned_deg.std(axis=0), 0.5, rtol=0.12)
    np.testing.assert_allclose(moved_m.std(axis=0), [0, 0, 0.02], rtol=0.12, atol=1e-12)
    basin = BasinOptions(duration_s=130, laps=1, seed=3, image=options)
    assert simulate_basin(basin).calibration.sonar.mounting == YSHARK.sonar
    exact = basin.model_copy(update={"image": ImageOptions()})
    true, told = (
        Rotation.from_quat(next(simulate_basin_frames(one, 1)).truth.quaternions_xyzw)
        for one in (basin, exact)
    )
    meant, stated = (
        Rotation.from_euler("xyz", mounting.rpy_rad)
        for mounting in (made[3], YSHARK.sonar)
    )
    off_rad = (told.inv() * true).magnitude()
    assert off_rad == pytest.approx((stated.inv() * meant).magnitude(), abs=1e-9)
