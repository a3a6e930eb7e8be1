from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.writer import recording
from sonar_graph.logs.reading import read_sonar_frames
from sonar_graph.logs.writing import sonar_image_messages
from sonar_graph.measurements import SonarFrames

KINDS = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"]


def frames(kind: str = "u1", count: int = 3, first: int = 0, beams: int = 4, bins: int = 5) -> SonarFrames:
    intensity = np.arange(count * beams * bins).reshape(count, beams, bins) % 97 + first
    stamps_ns = 1_700_000_000_000_000_123 + (first + np.arange(count)) * 10**8
    azimuths_rad = np.radians(np.linspace(14.0, -15.0, beams))
    return SonarFrames(stamps_ns, intensity.astype(kind), np.linspace(1.26, 2.51, bins), azimuths_rad)


def write(path: Path, *blocks: SonarFrames) -> Path:
    with recording(path, {}) as out:
        for block in blocks:
            out.write([sonar_image_messages("/sonar/image", block, frequency_hz=1.8e6, sound_speed_m_s=1480)])
    return path


@pytest.mark.parametrize("kind", [*KINDS, ">u2", ">f4"])
def test_frames_are_read_as_they_were_written(tmp_path: Path, kind: str) -> None:
    written = frames(kind)
    (read,) = read_sonar_frames(write(tmp_path / "log.mcap", written))
    np.testing.assert_array_equal(read.stamps_ns, written.stamps_ns)
    np.testing.assert_array_equal(read.intensity, written.intensity)
    assert read.intensity.dtype == written.intensity.dtype.newbyteorder("<")
    np.testing.assert_array_equal(read.ranges_m, written.ranges_m.astype(np.float32))
    np.testing.assert_allclose(read.azimuths_rad, written.azimuths_rad, atol=1e-15)


def test_another_library_sees_what_the_message_defines(tmp_path: Path) -> None:
    written = frames()
    with write(tmp_path / "log.mcap", written).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        messages = [message for *_, message in reader.iter_decoded_messages()]
    assert [m.header.stamp.nanosec for m in messages] == [123, 100_000_123, 200_000_123]
    first = messages[0]
    assert (first.ping_info.frequency, first.ping_info.sound_speed) == (np.float32(1.8e6), 1480)
    assert (first.image.dtype, first.image.beam_count, first.image.is_bigendian) == (0, 4, False)
    assert bytes(first.image.data) == written.intensity[0].T.tobytes()  # all beams of the first range first
    left, right = first.beam_directions[0], first.beam_directions[-1]
    assert (left.x, right.x) == (0, 0)
    assert left.y < 0 < right.y  # y is to the right
    np.testing.assert_allclose([left.z, right.z], np.cos(np.radians([14, 15])))


def test_pieces_of_different_size_are_one_recording(tmp_path: Path) -> None:
    blocks = [frames(first=0), frames(first=3, bins=7), frames(first=6, count=1)]
    read = list(read_sonar_frames(write(tmp_path / "log.mcap", *blocks)))
    assert [(len(block), block.intensity.shape[2]) for block in read] == [(3, 5), (3, 7), (1, 5)]
    assert (np.diff(np.concatenate([block.stamps_ns for block in read])) > 0).all()
    np.testing.assert_array_equal(read[2].intensity, blocks[2].intensity)


def test_an_existing_recording_survives_an_error(tmp_path: Path) -> None:
    path = write(tmp_path / "log.mcap", frames())
    before = path.read_bytes()
    with pytest.raises(LogError, match="complex"):
        write(path, frames(first=3), frames("c16"))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_samples_that_the_message_does_not_know_are_refused() -> None:
    with pytest.raises(LogError, match="/sonar/image: samples of type complex"):
        sonar_image_messages("/sonar/image", frames("c16"))
