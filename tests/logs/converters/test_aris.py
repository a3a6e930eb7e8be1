from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from sonar_graph.logs.convert.didson_aris import convert_aris
from sonar_graph.logs.reading import read_sonar_frames

from .sonar_logs import converted, degrees
from .sonar_recordings import START_NS, STEP_NS, Aris, images, put

BEAMS = {1: 48, 2: 48, 3: 96, 5: 96, 6: 64, 8: 64, 9: 128, 12: 128}


@pytest.mark.parametrize(("mode", "beams"), BEAMS.items())
def test_frames_are_read_as_they_were_recorded(tmp_path: Path, mode: int, beams: int) -> None:
    pictures = images(4, beams, 700)
    result = converted(tmp_path, Aris(pictures, mode=mode).content(), "aris")
    np.testing.assert_array_equal(result.frames.intensity, pictures)
    assert result.frames.stamps_ns.tolist() == [START_NS + i * STEP_NS for i in range(4)]
    assert result.done.shortcomings() == []


def test_ranges_are_half_the_way_of_sound(tmp_path: Path) -> None:
    """Bin i is sampled from delay + i period to the next, and sound goes there and back."""
    content = Aris(images(2, 128, 600), delay_us=1700, period_us=5, sound_speed=1480.0).content()
    ranges_m = converted(tmp_path, content, "aris").frames.ranges_m
    np.testing.assert_allclose(ranges_m[[0, 599]], [(1700 + 2.5) * 740e-6, (1700 + 599 * 5 + 2.5) * 740e-6], rtol=1e-6)


@pytest.mark.parametrize(
    ("file", "edge_deg"),
    [
        ({"mode": 9, "system": 1}, 14.705),
        ({"mode": 1, "system": 2, "telephoto": 1}, 6.742),
        ({"mode": 9, "system": 1, "telephoto": 1}, 7.0 * 127 / 128),  # no table
    ],
)
def test_the_first_beam_is_the_right_most(tmp_path: Path, file: dict[str, Any], edge_deg: float) -> None:
    frames = converted(tmp_path, Aris(images(2, BEAMS[file["mode"]], 64), **file).content(), "aris").frames
    assert degrees(frames)[[0, -1]] == pytest.approx([-edge_deg, edge_deg], abs=1e-3)


def test_a_drifting_speed_of_sound_loses_nothing(tmp_path: Path) -> None:
    pictures = images(5, 48, 64)
    speeds = [1480.0, 1480.1, 1480.0, 1480.2, 1480.0]
    result = converted(tmp_path, Aris(pictures, mode=1, sound_speeds=speeds).content(), "aris")
    assert result.done.frames == 5
    by_stamp = result.by_stamp()
    for i, picture in enumerate(pictures):
        np.testing.assert_array_equal(by_stamp[START_NS + i * STEP_NS], picture)


def test_what_other_sensors_said_is_in_the_notes(tmp_path: Path) -> None:
    notes = converted(tmp_path, Aris(images(3, 48, 64), mode=1).content(), "aris").notes
    assert (notes["sonar.depth"], notes["sonar.compass heading"]) == ("1.5 to 3.5", "88 to 90")
    assert "since 1970" in notes["sonar.time"]


def test_the_log_says_that_counts_are_decibels(tmp_path: Path) -> None:
    image = converted(tmp_path, Aris(images(1, 128, 64)).content(), "aris").calibration.sonar.image
    np.testing.assert_allclose(image.decibels(np.array([0, 51, 255], np.uint8)), [0, 16, 80], rtol=1e-6)


def test_readings_that_are_no_numbers_are_left_out(tmp_path: Path) -> None:
    content = bytearray(Aris(images(3, 48, 64), mode=1).content())
    put(content, 1024 + 128, "f", float("nan"))
    assert converted(tmp_path, bytes(content), "aris").notes["sonar.depth"] == "2.5 to 3.5"


def test_a_time_beyond_what_a_log_can_hold_loses_the_frame(tmp_path: Path, refusal: Any) -> None:
    content = bytearray(Aris(images(1, 48, 64), mode=1).content())
    put(content, 1024 + 20, "Q", 2**31 * 10**6)
    path = tmp_path / "dive.aris"
    path.write_bytes(content)
    refusal(lambda: convert_aris(path, tmp_path / "dive.mcap"), path, "frame 0 with a time of 2147483648000000 us")


@pytest.mark.parametrize("system", [(1, 1, 3.0e6), (1, 0, 1.8e6), (0, 1, 1.8e6), (2, 0, 0.7e6)])
def test_frequency_and_speed_of_sound_are_in_the_messages(tmp_path: Path, system: tuple[int, int, float]) -> None:
    kind, high, frequency_hz = system
    converted(tmp_path, Aris(images(1, 128, 64), system=kind, high=high).content(), "aris")
    with (tmp_path / "dive.mcap").open("rb") as stream:
        ((*_, message),) = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
    assert message.ping_info.frequency == pytest.approx(frequency_hz)
    assert message.ping_info.sound_speed == pytest.approx(1482.5)


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ({"mode": 0}, "ping mode 0"),
        ({"system": 7}, "system type 7"),
        ({"in_order": 0}, "not in order"),
        ({"sound_speed": 15.0}, "sound speed of 15"),
        ({"sound_speed": float("nan")}, "sound speed of nan"),
    ],
)
def test_frames_that_cannot_be_placed_are_refused(
    tmp_path: Path, refusal: Any, file: dict[str, Any], words: str
) -> None:
    path = tmp_path / "dive.aris"
    path.write_bytes(Aris(images(3, 128, 64), **file).content())
    refusal(lambda: convert_aris(path, tmp_path / "dive.mcap"), path, "no whole frame", words)


def test_another_file_is_named(tmp_path: Path, refusal: Any) -> None:
    path = tmp_path / "dive.aris"
    path.write_bytes(b"SO" * 4000)
    refusal(lambda: convert_aris(path, tmp_path / "dive.mcap"), path, "DDF")


def test_a_damaged_file_header_costs_no_frame(tmp_path: Path) -> None:
    pictures = images(3, 128, 64)
    content = b"\xff" * 1024 + Aris(pictures).content()[1024:]
    np.testing.assert_array_equal(converted(tmp_path, content, "aris").frames.intensity, pictures)


@pytest.mark.recording
def test_a_real_recording_is_read_to_the_byte(recordings: Path, tmp_path: Path) -> None:
    source = recordings / "sonar" / "sample.aris"
    done = convert_aris(source, tmp_path / "dive.mcap")
    (frames,) = read_sonar_frames(tmp_path / "dive.mcap")
    content = np.fromfile(source, np.uint8)[1024:].reshape(6, 1024 + 48 * 2000)[:, 1024:]
    np.testing.assert_array_equal(frames.intensity, content.reshape(6, 2000, 48).transpose(0, 2, 1))
    assert done.shortcomings() == []
    assert frames.stamps_ns[0] == 1_371_198_080_759_456_000  # 2013-06-14, by the sonar
    assert degrees(frames)[[0, -1]] == pytest.approx([-6.742, 6.742])  # an ARIS 1200 with telephoto lens
    # the header also states 3.33 m and 20.3 m, for 1450 m/s; the water had 1435.93 m/s
    assert frames.ranges_m[0] == pytest.approx(3.3299 * 1435.93 / 1450, abs=0.006)
    assert frames.ranges_m[-1] - frames.ranges_m[0] == pytest.approx(20.3 * 1435.93 / 1450, abs=0.02)
