"""``join``: images of one file, navigation of another."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.calibration import (
    Calibration,
    FloorPrior,
    Mounting,
    SonarCalibration,
    SonarImage,
)
from sonar_graph.logs import (
    METADATA,
    read_log,
    read_sonar_frames,
    sonar_image_messages,
    write_log,
)
from sonar_graph.logs.mcap import recording
from tests.logs.converters import copies
from tests.recognition.imaged_lane import TOPIC, Lane

OFFSET_S = 2.4


def images_log(lane: Lane, path: Path, offset_s: float = OFFSET_S) -> Path:
    """The images by a clock that is behind, in a log that states what their samples mean."""
    sonar = SonarCalibration(image=SonarImage(decibel_span=75.0))
    stamps_ns = lane.frames.stamps_ns - round(offset_s * 1e9)
    own = Calibration(sonar=sonar).model_dump_json(exclude_unset=True)
    with recording(path, {METADATA: {"calibration": own}}) as writer:
        frames = replace(lane.frames, stamps_ns=stamps_ns)
        writer.write([sonar_image_messages(TOPIC, frames)])
    return path


def stamps_of(log: Path) -> np.ndarray:
    return np.concatenate([block.stamps_ns for block in read_sonar_frames(log)])


@pytest.fixture(scope="module")
def both(lane, tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("two")
    write_log(folder / "nav.mcap", lane.sequence)
    return images_log(lane, folder / "images.mcap"), folder / "nav.mcap"


def test_images_are_moved_to_the_clock_of_the_navigation(lane, both, tmp_path, reply):
    out = tmp_path / "joined.mcap"
    said = reply(0, "join", *both, "-o", out).out
    found = re.search(r"Clock offset, to be added .*: (\+\S+) s ± (\S+) s", said)
    offset_s, near_s = map(float, found.groups())
    assert abs(offset_s - OFFSET_S) < 3 * near_s + 0.01
    assert f"{len(lane.frames)} frames, " in said
    joined = read_log(out)
    np.testing.assert_array_equal(joined.imu.stamps_ns, lane.sequence.imu.stamps_ns)
    near_ns = 3e9 * near_s + 1e7
    np.testing.assert_allclose(stamps_of(out), lane.frames.stamps_ns, atol=near_ns)
    images = np.concatenate([block.intensity for block in read_sonar_frames(out)])
    np.testing.assert_array_equal(images, lane.frames.intensity)
    assert joined.notes["images.clock_offset"].startswith(f"{found[1]} s")
    expected = lane.sequence.calibration
    sonar = joined.calibration.sonar
    assert sonar.mounting == expected.sonar.mounting
    assert sonar.image.decibel_span == 75.0
    assert joined.calibration.model_copy(update={"sonar": expected.sonar}) == expected


@pytest.fixture(scope="module")
def few(lane, tmp_path_factory) -> Path:
    """Too few images to measure an offset by."""
    stamps_ns = lane.frames.stamps_ns[:12]
    images = lane.frames.intensity[:12]
    frames = replace(lane.frames, stamps_ns=stamps_ns, intensity=images)
    log = tmp_path_factory.mktemp("few") / "images.mcap"
    return images_log(replace(lane, frames=frames), log)


@pytest.fixture(scope="module")
def bare(lane, tmp_path_factory) -> Path:
    """Navigation as another program writes it: mountings in ``/tf_static``, and no record of this package."""
    folder = tmp_path_factory.mktemp("bare")
    write_log(folder / "whole.mcap", lane.sequence)
    return copies.bare(folder / "whole.mcap", folder / "nav.mcap")


def test_the_mounting_of_the_sonar_is_that_of_the_navigations_frames(
    lane, few, bare, run, tmp_path
):
    out = tmp_path / "joined.mcap"
    expected = lane.sequence.calibration.sonar.mounting
    assert expected != Mounting()
    assert run("join", few, bare, "-o", out, "--offset", OFFSET_S) == 0
    joined = read_log(out)
    sonar = joined.calibration.sonar
    for name in ("translation_m", "rpy_rad"):
        found = getattr(sonar.mounting, name)
        assert found == pytest.approx(getattr(expected, name), abs=1e-12)
    assert sonar.image.decibel_span == 75.0
    assert "not stated" in joined.notes["log.start"]


def test_mounting_floor_and_start_of_a_given_file_are_in_the_joined_log(
    both, few, bare, run, tmp_path
):
    given = tmp_path / "vehicle.toml"
    out = tmp_path / "joined.mcap"
    given.write_text(
        "[floor]\nz_m = -3.0\nsigma_m = 0.02\n[start]\nposition_m = [1.0, 2.0, -0.5]\n"
        "[sonar.mounting]\nrpy_rad = [0.0, 0.3, 0.0]\n"
    )
    words = "-o", out, "--offset", OFFSET_S, "--calibration", given
    for navigation in (bare, both[1]):
        assert run("join", few, navigation, *words) == 0
        found = read_log(out).calibration
        assert found.floor == FloorPrior(z_m=-3.0, sigma_m=0.02)
        assert found.start.position_m == (1.0, 2.0, -0.5)
        assert found.sonar.mounting.rpy_rad == (0.0, 0.3, 0.0)
        dvl = read_log(navigation).calibration.dvl
        assert found.dvl.mounting.rpy_rad == pytest.approx(dvl.mounting.rpy_rad)


def test_a_stated_offset_is_taken_and_doubted_where_the_images_say_else(
    lane, both, tmp_path, reply
):
    words = "join", *both, "-o", tmp_path / "joined.mcap", "--offset"
    said = reply(0, *words, OFFSET_S).out
    assert "+2.400 s, as stated; by the images +2.4" in said
    assert "Warning" not in said
    np.testing.assert_array_equal(stamps_of(words[4]), lane.frames.stamps_ns)
    assert "Warning: they do not agree" in reply(0, *words, 3.5).out


def test_files_without_common_time_are_refused_with_an_offset(
    lane, both, tmp_path, reply
):
    far = images_log(lane, tmp_path / "far.mcap", offset_s=1.2e9)
    out = tmp_path / "joined.mcap"
    words = "join", far, both[1], "-o", out
    (line,) = reply(2, *words).err.splitlines()
    told = r"far\.mcap: \d.* s; .*nav\.mcap: \d.* s: no common time; .* \(\+(\d+\.\d+) makes"
    found = re.search(told, line)
    assert found
    assert not out.exists()
    said = reply(0, *words, "--offset", found[1], "--search", 3).out
    refined = re.search(r": \+(\d+\.\d+) s ± (\d\.\d+) s", said)
    assert abs(float(refined[1]) - 1.2e9) < 3 * float(refined[2])


def test_an_offset_that_few_images_cannot_show_must_be_stated(
    both, few, tmp_path, reply
):
    out = tmp_path / "joined.mcap"
    words = "join", few, both[1], "-o", out, "--offset", OFFSET_S
    lack = "steps between them could be measured, and 50 are needed; state it"
    assert lack in reply(2, *words, "--search", 2).err
    assert "as stated; the images do not determine" in reply(0, *words).out
    assert len(stamps_of(out)) == 12
