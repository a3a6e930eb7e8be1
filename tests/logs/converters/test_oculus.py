from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonar_graph.logs.convert.oculus import convert_oculus
from sonar_graph.logs.reading import read_sonar_frames

from .sonar_logs import converted, degrees
from .sonar_recordings import STEP_NS, Oculus, images, oculus_note, put


@pytest.mark.parametrize("version", [0, 2])
@pytest.mark.parametrize("kind", ["u1", "u2", "u4"])
@pytest.mark.parametrize("beams", [256, 512])
def test_frames_are_read_as_they_were_recorded(tmp_path: Path, version: int, kind: str, beams: int) -> None:
    pictures = images(4, beams, 40).astype(kind) * (257 if kind == "u2" else 1)
    result = converted(tmp_path, Oculus(pictures, version=version).content(), "raw")
    np.testing.assert_array_equal(result.frames.intensity, pictures)
    assert result.frames.intensity.dtype == np.dtype(f"<{kind}")
    assert result.done.shortcomings() == []


@pytest.mark.parametrize("version", [0, 2])
def test_time_goes_on_where_the_clock_wraps_around(tmp_path: Path, version: int) -> None:
    """The older clock has 32 bits: it begins anew after 4.3 s, here between the first and the second ping."""
    stamps_ns = converted(tmp_path, Oculus(images(60, 16, 8), version=version).content(), "raw").frames.stamps_ns
    np.testing.assert_allclose(np.diff(stamps_ns), STEP_NS, atol=1)
    assert stamps_ns[0] == pytest.approx(2**32 - 100_000_000, abs=1)


def test_bearings_are_those_of_the_ping_and_turned_to_the_left(tmp_path: Path) -> None:
    frames = converted(tmp_path, Oculus(images(2, 26, 8)).content(), "raw").frames
    assert degrees(frames)[[0, 1, -1]] == pytest.approx([65.0, 60.0, -60.0])
    np.testing.assert_allclose(frames.ranges_m, 0.003 * (np.arange(8) + 0.5), rtol=1e-6)


@pytest.mark.parametrize("kind", ["u1", "u2"])
def test_gains_of_the_rows_are_taken_out(tmp_path: Path, kind: str) -> None:
    pictures = images(3, 16, 4).astype(kind)
    gains = np.array([1, 4, 9, 16], np.uint32)
    frames = converted(tmp_path, Oculus(pictures, gains=gains).content(), "raw").frames
    np.testing.assert_allclose(frames.intensity, pictures / [1, 2, 3, 4], rtol=1e-6)


def test_messages_without_images_are_passed_over(tmp_path: Path) -> None:
    pictures = images(4, 16, 8)
    _, *pings = Oculus(pictures).pieces()
    note = oculus_note(b"SO" * 30)
    content = b"".join([note, pings[0], note, note, *pings[1:], note])
    result = converted(tmp_path, content, "raw")
    np.testing.assert_array_equal(result.frames.intensity, pictures)
    assert result.done.shortcomings() == []


def test_damage_after_a_message_without_image_costs_only_itself(tmp_path: Path) -> None:
    pictures = images(4, 16, 8)
    _, *pings = Oculus(pictures).pieces()
    note = oculus_note()
    result = converted(tmp_path, b"".join([pings[0], note, bytes(len(note)), *pings[1:]]), "raw")
    np.testing.assert_array_equal(result.frames.intensity, pictures)
    begin = len(pings[0]) + len(note)
    assert [(loss.at, loss.end) for loss in result.done.lost] == [(begin, begin + len(note))]


def test_pings_that_were_not_recorded_are_counted(tmp_path: Path) -> None:
    _, *pings = Oculus(images(6, 16, 8)).pieces()
    done = converted(tmp_path, b"".join(pings[:2] + pings[4:]), "raw").done
    assert (done.frames, done.lost) == (4, [])
    assert done.shortcomings() == ["missing: the numbers of 2 frames between the first and the last"]


def test_attitude_is_in_the_notes_of_the_newer_pings(tmp_path: Path) -> None:
    notes = converted(tmp_path, Oculus(images(3, 16, 8), version=2).content(), "raw").notes
    assert (notes["sonar.heading"], notes["sonar.pitch"]) == ("45 to 47", "3 to 3")
    assert "switched on" in notes["sonar.time"]


@pytest.mark.parametrize(("kind", "full_scale"), [("u1", 255), ("u2", 65_535)])
def test_the_log_says_that_counts_are_linear(tmp_path: Path, kind: str, full_scale: float) -> None:
    image = converted(tmp_path, Oculus(images(1, 16, 8).astype(kind)).content(), "raw").calibration.sonar.image
    assert (image.scale, image.full_scale) == ("linear", full_scale)


@pytest.mark.parametrize(("code", "gamma"), [(0, 1.0), (255, 1.0), (127, 0.498), (51, 0.2)])
def test_the_log_says_the_gamma_that_was_set(tmp_path: Path, code: int, gamma: float) -> None:
    result = converted(tmp_path, Oculus(images(1, 16, 8), gamma_code=code).content(), "raw")
    assert result.calibration.sonar.image.gamma == pytest.approx(gamma, abs=1e-3)
    assert f"{gamma:g}" in result.notes["sonar.scale"]


def test_the_newer_clock_does_not_wrap_around(tmp_path: Path) -> None:
    _, first, *_ = Oculus(images(1, 16, 8), version=2, first_clock=10**12).pieces()
    _, second, *_ = Oculus(images(1, 16, 8, seed=1), version=2, first_clock=10**12 + 10**10, first_number=501).pieces()
    stamps_ns = converted(tmp_path, first + second, "raw").frames.stamps_ns
    assert stamps_ns.tolist() == [10**12, 10**12 + 10**10]


def test_numbers_that_begin_anew_are_not_missing(tmp_path: Path) -> None:
    pieces = Oculus(images(3, 16, 8)).pieces() + Oculus(images(3, 16, 8, seed=1), first_number=7).pieces()
    assert converted(tmp_path, b"".join(pieces), "raw").done.missing == 0


def test_a_huge_message_without_image_is_damage(tmp_path: Path) -> None:
    _, *pings = Oculus(images(3, 16, 8)).pieces()
    note = bytearray(oculus_note())
    put(note, 10, "I", 1 << 20)
    result = converted(tmp_path, b"".join([bytes(note), *pings]), "raw")
    assert result.done.shortcomings() == [f"lost: bytes 0 to {len(note) - 1}: a message of kind 0x55, version 0"]
    assert result.done.frames == 3


@pytest.mark.parametrize(
    ("at", "layout", "value", "words"),
    [
        (122 - 8, "I", 100, "an image of 100 bytes"),
        (122 - 4, "I", 2177, "a message of 2177 bytes"),
        (122 - 12, "I", 150, "an image from byte 150"),
        (122 - 12, "I", 2049, "a message of"),
        (122 + 4, "h", -8000, "bearings that do not increase"),
        (122, "h", -9100, "bearings that do not increase"),
        (97, "B", 2, "3 bytes a sample"),
        (98, "d", 5.0, "bins of 5 m"),
        (98, "d", float("nan"), "bins of nan m"),
        (106, "H", 0, "0 ranges"),
        (108, "H", 2000, "2000 beams"),
        (85, "d", 15.0, "sound speed of 15"),
    ],
)
def test_a_ping_whose_header_makes_no_sense_is_lost(
    tmp_path: Path, at: int, layout: str, value: Any, words: str
) -> None:
    _, *pings = Oculus(images(4, 16, 8)).pieces()
    broken = bytearray(pings[1])
    put(broken, at, layout, value)
    done = converted(tmp_path, b"".join([pings[0], bytes(broken), *pings[2:]]), "raw").done
    assert done.frames == 3
    assert words in str(done.lost[0])


@pytest.mark.parametrize("length", [3, 16, 60, 130, 150])
def test_a_ping_cut_within_its_header_is_named(tmp_path: Path, length: int) -> None:
    _, *pings = Oculus(images(3, 16, 8)).pieces()
    done = converted(tmp_path, b"".join([*pings[:2], pings[2][:length]]), "raw").done
    assert done.frames == 2
    assert "cut off" in str(done.lost[0])


def test_another_file_is_named(tmp_path: Path, refusal: Any) -> None:
    path = tmp_path / "dive.raw"
    path.write_bytes(b"DDF\x05" + bytes(4000))
    refusal(lambda: convert_oculus(path, tmp_path / "dive.mcap"), path, "no Oculus ping")


@pytest.mark.recording
@pytest.mark.parametrize(("name", "count"), [("one_ping_8bit.raw", 1), ("three_pings_8bit.raw", 3)])
def test_real_recordings_are_read_to_the_byte(recordings: Path, tmp_path: Path, name: str, count: int) -> None:
    source = recordings / "sonar" / name
    done = convert_oculus(source, tmp_path / "dive.mcap")
    (frames,) = read_sonar_frames(tmp_path / "dive.mcap")
    content = np.fromfile(source, np.uint8).reshape(count, -1)[:, 2048:]
    np.testing.assert_array_equal(frames.intensity, content.reshape(count, 703, 256).transpose(0, 2, 1))
    assert done.shortcomings() == []
    assert degrees(frames)[[0, -1]] == pytest.approx([30.0, -30.0])
    assert frames.ranges_m[-1] == pytest.approx(2.0, abs=0.005)
    assert np.diff(frames.stamps_ns) == pytest.approx([62_502_130, 62_502_097][: count - 1])
