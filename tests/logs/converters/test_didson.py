"""No file of a real DIDSON was at hand: these are written from the documented layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonar_graph.logs.convert.didson_aris import convert_didson

from .sonar_logs import converted, degrees
from .sonar_recordings import START_NS, STEP_NS, Ddf, images, put


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(("beams", "high"), [(96, 1), (48, 0)])
def test_frames_are_read_as_they_were_recorded(tmp_path: Path, version: int, beams: int, high: int) -> None:
    pictures = images(5, beams, 512)
    result = converted(tmp_path, Ddf(pictures, version=version, high=high).content(), "ddf")
    np.testing.assert_array_equal(result.frames.intensity, pictures)
    assert result.frames.intensity.dtype == np.uint8
    assert result.frames.stamps_ns.tolist() == [START_NS + i * STEP_NS for i in range(5)]
    assert (result.done.frames, result.done.lost, result.done.shortcomings()) == (5, [], [])
    assert result.done.duration_s == pytest.approx(4 * 0.12)


def test_a_mark_on_the_right_is_at_a_negative_azimuth(tmp_path: Path) -> None:
    """Of a sonar that is not upside down the first beam in the file is the right-most."""
    pictures = np.zeros((1, 96, 512), np.uint8)
    pictures[0, 0] = 255
    upright = converted(tmp_path, Ddf(pictures).content(), "ddf").frames
    assert degrees(upright)[upright.intensity[0, :, 0] == 255] == pytest.approx([-14.26], abs=0.01)
    inverted = converted(tmp_path, Ddf(pictures, reverse=1).content(), "ddf").frames
    assert degrees(inverted)[inverted.intensity[0, :, 0] == 255] == pytest.approx([14.25], abs=0.01)


@pytest.mark.parametrize(
    ("file", "begin_m", "length_m"),
    [
        ({"start_code": 3, "length_code": 0}, 1.26, 1.25),  # the window of the 2014 paper
        ({"start_code": 1, "length_code": 3}, 0.42, 10.0),
        ({"start_code": 3, "length_code": 0, "flags": 1}, 1.125, 1.125),
        ({"start_code": 2, "length_code": 1, "flags": 2}, 0.84, 5.0),
        ({"start_code": 2, "length_code": 1, "flags": 3}, 0.75, 4.5),
        ({"start_code": 2, "length_code": 0, "high": 0}, 1.68, 5.0),
        ({"start_code": 2, "length_code": 3, "high": 0, "flags": 1}, 1.5, 36.0),
        ({"start_code": 2, "length_code": 0, "serial": 18}, 0.75, 1.125),
        ({"start_code": 2, "length_code": 0, "serial": 15}, 0.75, 2.25),
        ({"start_code": 3, "length_code": 0, "flags": 0xF0}, 1.26, 1.25),
        ({"start_code": 3, "length_code": 0, "flags": 1, "version": 4}, 1.26, 1.25),
    ],
)
def test_window_codes_are_metres(tmp_path: Path, file: dict[str, Any], begin_m: float, length_m: float) -> None:
    beams = 96 if file.get("high", 1) else 48
    frames = converted(tmp_path, Ddf(images(2, beams, 500), **file).content(), "ddf").frames
    bin_m = length_m / 500
    np.testing.assert_allclose(frames.ranges_m, begin_m + bin_m / 2 + bin_m * np.arange(500), rtol=1e-6)


def test_ranges_scale_with_the_speed_of_sound(tmp_path: Path) -> None:
    """The sonar measures times; its metres hold for 1465 m/s."""
    content = Ddf(images(2, 96, 512)).content()
    nominal = converted(tmp_path, content, "ddf").frames.ranges_m
    warm = converted(tmp_path, content, "ddf", sound_speed_m_s=1500.0)
    np.testing.assert_allclose(warm.frames.ranges_m, nominal * 1500 / 1465, rtol=1e-6)
    assert "1500 m/s" in warm.notes["sonar.ranges"]


def test_what_other_sensors_said_is_in_the_notes(tmp_path: Path) -> None:
    content = Ddf(images(3, 96, 64), readings={128: 2.5, 152: 90.0}).content()
    notes = converted(tmp_path, content, "ddf").notes
    assert notes["sonar.depth"] == "2.5 to 4.5"
    assert notes["sonar.heading"] == "90 to 92"
    assert "sonar.pitch" not in notes  # always zero: not measured
    assert "UTC" in notes["sonar.time"]


def test_the_log_says_that_counts_are_decibels(tmp_path: Path) -> None:
    image = converted(tmp_path, Ddf(images(1, 96, 64)).content(), "ddf").calibration.sonar.image
    np.testing.assert_allclose(image.decibels(np.array([0, 51, 255], np.uint8)), [0, 18, 90], rtol=1e-6)


def test_frames_that_bear_another_version_are_read(tmp_path: Path) -> None:
    pictures = images(3, 48, 64)
    content = Ddf(pictures, high=0, frame_version=b"5.26").content()
    np.testing.assert_array_equal(converted(tmp_path, content, "ddf").frames.intensity, pictures)


def test_frames_that_the_header_promises_are_missed(tmp_path: Path) -> None:
    done = converted(tmp_path, Ddf(images(3, 48, 64), high=0, promised=5).content(), "ddf").done
    assert done.shortcomings() == ["missing: 2 of 5 frames that the file's header names"]


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (0, b"MOV", "begins with b'MOV"),
        (3, b"\x02", "version 2; versions 3 and 4"),
        (3, b"\x05", "convert aris"),
        (16, b"\x61", "97 beams"),
        (12, b"\x07", "resolution 7"),
        (24, b"\0\0", "0 samples"),
    ],
)
def test_a_header_that_makes_no_sense_is_named(tmp_path: Path, refusal: Any, at: int, value: bytes, words: str) -> None:
    content = bytearray(Ddf(images(2, 96, 512)).content())
    content[at : at + len(value)] = value
    path = tmp_path / "dive.ddf"
    path.write_bytes(content)
    refusal(lambda: convert_didson(path, tmp_path / "dive.mcap"), path, words)
    assert not list(tmp_path.glob("*.mcap*"))


@pytest.mark.parametrize(("at", "value"), [(16, 48), (25, 1)])
def test_a_header_of_another_size_gives_no_frames(tmp_path: Path, refusal: Any, at: int, value: int) -> None:
    """Possible numbers of beams and samples, but not those of the frames."""
    for count in (1, 2, 4):
        content = bytearray(Ddf(images(count, 96, 512)).content())
        content[at] = value
        path = tmp_path / "dive.ddf"
        path.write_bytes(content)
        refusal(lambda path=path: convert_didson(path, tmp_path / "dive.mcap"), path, "no whole frame")


@pytest.mark.parametrize("length", [0, 2, 3, 4, 300])
def test_files_without_a_whole_header_are_refused(tmp_path: Path, refusal: Any, length: int) -> None:
    path = tmp_path / "dive.ddf"
    path.write_bytes(Ddf(images(1, 96, 64)).content()[:length])
    refusal(lambda: convert_didson(path, tmp_path / "dive.mcap"), path)


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (52, 32, "window codes 32 and 0"),
        (52, -1, "window codes -1 and 0"),
        (56, 4, "window codes 3 and 4"),  # at low frequency there are four lengths
        (20, 1970, "year 1970"),
        (20, 2038, "year 2038"),
        (24, 13, "a time that does not exist"),
        (44, 100, "100 hundredths"),
    ],
)
def test_a_frame_whose_header_makes_no_sense_is_lost(
    tmp_path: Path, refusal: Any, at: int, value: int, words: str
) -> None:
    content = bytearray(Ddf(images(1, 48, 64), high=0).content())
    put(content, 512 + at, "i", value)
    path = tmp_path / "dive.ddf"
    path.write_bytes(content)
    refusal(lambda: convert_didson(path, tmp_path / "dive.mcap"), path, "no whole frame: bytes 512 to", words)
