"""Images belong to the run whose other sensors `simulate_basin` gives, and their truth lists what is in them."""

from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.devices import OWN_DESIGNS
from sonar_graph.errors import CalibrationError, SimulationError
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


def test_truth_of_frames_is_that_of_the_run(run):
    sequence, made = run
    body_T_sonar = sequence.calibration.sonar.mounting.pose()
    truth = sequence.truth
    for imaged in made[::3]:
        row = np.argmin(np.abs(truth.stamps_ns - imaged.frames.stamps_ns[0]))
        world_R_body = gtsam.Rot3(truth.rotations()[row].as_matrix())
        pose = gtsam.Pose3(world_R_body, truth.positions[row]) * body_T_sonar
        told = gtsam.Rot3(*imaged.truth.quaternions_xyzw[0][[3, 0, 1, 2]])
        off = pose.between(gtsam.Pose3(told, imaged.truth.positions[0]))
        assert np.abs(off.translation()).max() < 0.01
        assert np.linalg.norm(gtsam.Rot3.Logmap(off.rotation())) < 0.02


def around(
    imaged: ImagedFrames, frame: int, target: int, beams: int, bins: int
) -> float:
    """Mean sample around the true place of an object."""
    frames = imaged.frames
    truth = imaged.truth
    beam = np.abs(frames.azimuths_rad - truth.azimuth_rad()[frame, target]).argmin()
    bin_ = np.abs(frames.ranges_m - truth.range_m()[frame, target]).argmin()
    rows = slice(beam - beams, beam + beams + 1)
    return frames.intensity[frame, rows, bin_ - bins : bin_ + bins + 1].mean()


def whole(imaged: ImagedFrames) -> list[list[int]]:
    """Frames and landmarks that are seen whole."""
    return np.argwhere(imaged.truth.share_in_view[:, :4] == 1).tolist()


def test_every_landmark_is_seen_whole_and_brightest_where_truth_says(run):
    seen = Counter()
    for imaged in run[1]:
        assert imaged.truth.ids[:4].tolist() == [1, 2, 3, 4]
        for frame, target in whole(imaged):
            usual = np.median(imaged.frames.intensity[frame])
            assert around(imaged, frame, target, 3, 10) > usual + 20
            seen[target] += 1
    assert min(seen[target] for target in range(4)) >= 2


def test_frames_stream_and_do_not_depend_on_the_size_of_blocks(run):
    _, made = run
    smaller = simulate_basin_frames(options(), frames_per_block=5)
    first = np.concatenate([b.frames.intensity for b in islice(smaller, 3)])
    np.testing.assert_array_equal(first, made[0].frames.intensity[:15])
    assert max(len(b.frames) for b in made) <= 16


def test_dropped_frames_are_missing_and_change_no_other(run):
    stamps_ns = np.concatenate([imaged.frames.stamps_ns for imaged in run[1][:2]])
    some = next(blocks(drop_probability=0.3)).frames
    among = np.searchsorted(stamps_ns, some.stamps_ns)
    np.testing.assert_array_equal(stamps_ns[among], some.stamps_ns)
    assert 0.5 < len(among) / (among[-1] + 1) < 0.9
    expected = run[1][0].frames.intensity[among[5]]
    np.testing.assert_array_equal(some.intensity[5], expected)


def test_time_offset_moves_stamps_and_sound_speed_scales_ranges(run):
    plain = run[1][0].frames
    for fault, late_ns, longer in (
        ({"time_offset_s": 0.05}, 50_000_000, 1.0),
        ({"sound_speed_error": 0.01}, 0, 1.01),
    ):
        frames = next(blocks(**fault)).frames
        np.testing.assert_array_equal(frames.stamps_ns - plain.stamps_ns, late_ns)
        np.testing.assert_allclose(frames.ranges_m / plain.ranges_m, longer)
        np.testing.assert_array_equal(frames.intensity, plain.intensity)


def test_share_in_view_falls_from_one_to_zero_across_the_edge_of_the_fan():
    place_m = np.array([1.7, 0.0, 0.0])
    disc = place(-1, "disc", block(0.2, 0.2, 0.0, 6.0), 0.1, place_m, 0.0)
    simulator = FrameSimulator(ImageOptions(texture_shape=None), [disc], 0.0)
    # roughly, for a tilted fan
    edge_m = 1.7 * np.tan(np.radians(14.25)) / np.cos(np.radians(30)) * 0.95
    positions = np.array([[0.0, y, 0.95] for y in (0.0, edge_m, 1.0)])
    tilts = Rotation.from_euler("Y", np.full((3, 1), 30.0), degrees=True)
    truth = frame_truth(positions, tilts, simulator)
    first, middle, last = truth.share_in_view[:, 0]
    assert (first, last) == (1, 0)
    assert 0.2 < middle < 0.9
    ranges_m = np.linalg.norm(positions - place_m, axis=1)
    np.testing.assert_allclose(truth.range_m()[:, 0], ranges_m)
    assert truth.azimuth_rad()[2, 0] < 0  # the sonar is to the left of the disc


def squares(path: Path, ids: list[int]) -> str:
    """File of bright squares with these identities, on plates of unequal sizes."""
    corners = "[[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]"
    shape = f'shapes = [{{ level_db = 25.0, polygon_m = {corners} }}]\nname = "square"'
    plates = [f"[[landmark]]\nid = {i}\nsize_m = {0.3 + i / 500}\n{shape}" for i in ids]
    path.write_text("\n".join(plates), encoding="utf-8")
    return str(path)


def test_own_landmarks_lie_in_the_basin_under_their_own_identities(run, tmp_path):
    file = squares(tmp_path / "own.toml", [40, 10, 30, 20, 50])
    sequence = simulate_basin(options(designs=file))
    usual, made = run
    ids = [10, 20, 30, 40]
    names = ", ".join(f"{number}: square" for number in ids)
    assert sequence.notes[OWN_DESIGNS] == f"{names}, of own.toml"
    assert OWN_DESIGNS not in usual.notes
    assert sequence.true_landmarks.ids.tolist() == ids
    places_m = usual.true_landmarks.positions
    np.testing.assert_array_equal(sequence.true_landmarks.positions, places_m)
    number, other = next(each for each in enumerate(made) if whole(each[1]))
    own = next(islice(blocks(designs=file), number, None))
    assert own.truth.ids[:4].tolist() == ids
    assert (own.truth.ids[4:] < 0).all()
    mine, theirs = (around(each, *whole(other)[0], 2, 10) for each in (own, other))
    assert (mine - theirs) * 80 / 255 == pytest.approx(25 - 12, abs=4)


def test_too_few_landmarks_for_the_basin_are_refused(tmp_path):
    few = squares(tmp_path / "own.toml", [1, 2, 3])
    words = r"image.designs: .*own.toml has 3 landmark .* basin needs 4; add 1"
    with pytest.raises(SimulationError, match=words):
        simulate_basin(options(designs=few))
    with pytest.raises(CalibrationError, match=r"none\.toml"):
        next(blocks(designs=str(tmp_path / "none.toml")))
