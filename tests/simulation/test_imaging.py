"""Images belong to the run whose other sensors `simulate_basin` gives, and their truth lists what is in them."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.devices import OWN_DESIGNS
from sonar_graph.errors import CalibrationError, SimulationError
from sonar_graph.measurements import Floats
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin, simulate_basin_frames
from sonar_graph.simulation.sonar_image import (
    FrameSimulator,
    ImagedFrames,
    ImageOptions,
)
from sonar_graph.simulation.sonar_image.frames import frame_truth
from sonar_graph.simulation.sonar_image.scene import block, place

SLOW = {"duration_s": 130, "laps": 1, "frame_rate_hz": 1.0}


def options(**image: object) -> BasinOptions:
    return BasinOptions.model_validate(SLOW | {"image": image})


def blocks(**image: object) -> Iterator[ImagedFrames]:
    return simulate_basin_frames(options(**image), frames_per_block=16)


@pytest.fixture(scope="module")
def run() -> tuple[Sequence, list[ImagedFrames]]:
    return simulate_basin(options()), list(blocks())


def test_asking_for_images_leaves_all_other_sensors_alone(run):
    sequence = run[0]
    plain = simulate_basin(BasinOptions.model_validate(SLOW))
    assert sequence.detections is None
    assert "image model" in sequence.notes["ours"]
    for one, other in (
        (sequence.imu.angular_velocity, plain.imu.angular_velocity),
        (sequence.dvl.velocity, plain.dvl.velocity),
        (sequence.true_landmarks.positions, plain.true_landmarks.positions),
    ):
        np.testing.assert_array_equal(one, other)


def test_truth_of_frames_is_that_of_the_run(run):
    sequence, made = run
    body_T_sonar = sequence.calibration.sonar.mounting.pose()
    body_R_sonar = Rotation.from_matrix(np.array(body_T_sonar.rotation().matrix()))
    for imaged in made[::3]:
        nearest = np.argmin(
            np.abs(sequence.truth.stamps_ns - imaged.frames.stamps_ns[0])
        )
        world_R_body = sequence.truth.rotations()[nearest]
        position = sequence.truth.positions[nearest] + world_R_body.apply(
            np.array(body_T_sonar.translation())
        )
        np.testing.assert_allclose(imaged.truth.positions[0], position, atol=0.01)
        told = Rotation.from_quat(imaged.truth.quaternions_xyzw[0])
        assert ((world_R_body * body_R_sonar).inv() * told).magnitude() < 0.02


def around(
    imaged: ImagedFrames, frame: int, target: int, beams: int, bins: int
) -> Floats:
    """Samples around the true place of an object."""
    frames = imaged.frames
    truth = imaged.truth
    beam = np.abs(frames.azimuths_rad - truth.azimuth_rad()[frame, target]).argmin()
    bin_ = np.abs(frames.ranges_m - truth.range_m()[frame, target]).argmin()
    return frames.intensity[
        frame, beam - beams : beam + beams + 1, bin_ - bins : bin_ + bins + 1
    ].astype(float)


def test_every_landmark_is_seen_whole_and_brightest_where_truth_says(run):
    seen = dict.fromkeys([1, 2, 3, 4], 0)
    for imaged in run[1]:
        assert imaged.truth.ids[:4].tolist() == [1, 2, 3, 4]
        for frame, target in np.argwhere(imaged.truth.share_in_view[:, :4] == 1):
            assert (
                around(imaged, frame, target, 3, 10).mean()
                > np.median(imaged.frames.intensity[frame]) + 20
            )
            seen[int(imaged.truth.ids[target])] += 1
    assert min(seen.values()) >= 2


def test_frames_stream_and_do_not_depend_on_the_size_of_blocks(run):
    _, made = run
    smaller = simulate_basin_frames(options(), frames_per_block=5)
    first = np.concatenate([b.frames.intensity for b in islice(smaller, 3)])
    np.testing.assert_array_equal(first, made[0].frames.intensity[:15])
    assert max(len(b.frames) for b in made) <= 16


def test_dropped_frames_are_missing_and_change_no_other():
    whole, more = (b.frames for b in islice(blocks(drop_probability=0.0), 2))
    some = next(blocks(drop_probability=0.3)).frames
    stamps_ns = np.append(whole.stamps_ns, more.stamps_ns)
    among = np.searchsorted(stamps_ns, some.stamps_ns)
    np.testing.assert_array_equal(stamps_ns[among], some.stamps_ns)
    assert 0.5 < len(among) / (among[-1] + 1) < 0.9
    np.testing.assert_array_equal(some.intensity[5], whole.intensity[among[5]])


def test_time_offset_moves_stamps_and_sound_speed_scales_ranges(
    run,
):
    late, wrong = (
        next(blocks(**fault)).frames
        for fault in ({"time_offset_s": 0.05}, {"sound_speed_error": 0.01})
    )
    plain = run[1][0].frames
    np.testing.assert_array_equal(late.stamps_ns - plain.stamps_ns, 50_000_000)
    np.testing.assert_array_equal(wrong.stamps_ns, plain.stamps_ns)
    np.testing.assert_allclose(wrong.ranges_m / plain.ranges_m, 1.01)
    np.testing.assert_array_equal(late.ranges_m, plain.ranges_m)
    for frames in (late, wrong):
        np.testing.assert_array_equal(frames.intensity, plain.intensity)


def test_share_in_view_falls_from_one_to_zero_across_the_edge_of_the_fan():
    disc = place(
        -1, "disc", block(0.2, 0.2, 0.0, 6.0), 0.1, np.array([1.7, 0.0, 0.0]), 0.0
    )
    simulator = FrameSimulator(ImageOptions(texture_shape=None), [disc], 0.0)
    tilt = Rotation.from_euler("ZYX", [0, 30, 0], degrees=True)
    # roughly, for a tilted fan
    edge_m = 1.7 * np.tan(np.radians(14.25)) / np.cos(np.radians(30)) * 0.95
    positions = np.array([[0.0, y, 0.95] for y in (0.0, edge_m, 1.0)])
    truth = frame_truth(positions, Rotation.concatenate([tilt] * 3), simulator)
    assert truth.share_in_view[0, 0] == 1
    assert 0.2 < truth.share_in_view[1, 0] < 0.9
    assert truth.share_in_view[2, 0] == 0
    np.testing.assert_allclose(
        truth.range_m()[:, 0], np.linalg.norm(positions - [1.7, 0, 0], axis=1)
    )
    assert truth.azimuth_rad()[2, 0] < 0  # the sonar is to the left of the disc


def squares(path: Path, ids: list[int]) -> Path:
    """Bright squares with these identities, on plates of unequal sizes."""
    corners = "[[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]"
    shape = (
        f'name = "square"\nshapes = [{{ level_db = 25.0, polygon_m = {corners} }}]\n'
    )
    path.write_text(
        "".join(
            f"[[landmark]]\nid = {id_}\nsize_m = {0.3 + id_ / 500}\n{shape}"
            for id_ in ids
        ),
        encoding="utf-8",
    )
    return path


def test_own_landmarks_lie_in_the_basin_under_their_own_identities(run, tmp_path):
    file = squares(tmp_path / "own.toml", [40, 10, 30, 20, 50])
    sequence = simulate_basin(options(designs=str(file)))
    usual, made = run
    assert (
        sequence.notes[OWN_DESIGNS]
        == "10: square, 20: square, 30: square, 40: square, of own.toml"
    )
    assert OWN_DESIGNS not in usual.notes
    assert sequence.true_landmarks.ids.tolist() == [10, 20, 30, 40]
    np.testing.assert_array_equal(
        sequence.true_landmarks.positions, usual.true_landmarks.positions
    )
    number = next(
        i
        for i, imaged in enumerate(made)
        if (imaged.truth.share_in_view[:, :4] == 1).any()
    )
    own = next(islice(blocks(designs=str(file)), number, None))
    other = made[number]
    assert own.truth.ids[:4].tolist() == [10, 20, 30, 40]
    assert (own.truth.ids[4:] < 0).all()
    place = np.argwhere(other.truth.share_in_view[:, :4] == 1)[0]
    brighter = around(own, *place, 2, 10).mean() - around(other, *place, 2, 10).mean()
    assert brighter * 80 / 255 == pytest.approx(25 - 12, abs=4)


def test_too_few_landmarks_for_the_basin_are_refused(tmp_path):
    few = str(squares(tmp_path / "own.toml", [1, 2, 3]))
    with pytest.raises(
        SimulationError,
        match=r"image.designs: .*own.toml has 3 landmark .* basin needs 4; add 1",
    ):
        simulate_basin(options(designs=few))
    with pytest.raises(CalibrationError, match=r"none\.toml"):
        next(blocks(designs=str(tmp_path / "none.toml")))
