from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.cli.main import main
from sonar_graph.errors import DatasetError, LogError
from sonar_graph.logs.convert.didson_aris import convert_didson
from sonar_graph.logs.reading import read_sonar_frames

from .sonar_logs import converted
from .sonar_recordings import START_NS, STEP_NS, Aris, Ddf, Oculus, images


def long_recording(path: Path, frames: int) -> Path:
    """Frames of 96 x 512 that differ in number and time only."""
    kind = Ddf(np.zeros((1, 96, 512), np.uint8))
    kind.frames = np.broadcast_to(kind.frames, (frames, 96, 512))
    with path.open("wb") as stream:
        stream.write(kind.file_header())
        for i in range(frames):
            stream.write(kind.frame(i))
    return path


def peak_bytes(source: Path, log: Path) -> int:
    tracemalloc.start()
    convert_didson(source, log)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    short, long = (long_recording(tmp_path / f"{n}.ddf", n) for n in (200, 800))
    peak_bytes(short, tmp_path / "warm.mcap")  # imports and caches
    few, many = peak_bytes(short, tmp_path / "a.mcap"), peak_bytes(long, tmp_path / "b.mcap")
    assert many < few + 0.05 * long.stat().st_size
    assert few < 32e6


def test_progress_runs_from_the_first_frames_to_the_end(tmp_path: Path) -> None:
    source = long_recording(tmp_path / "dive.ddf", 300)
    told: list[tuple[int, int]] = []
    convert_didson(source, tmp_path / "dive.mcap", lambda done, total: told.append((done, total)))
    size = source.stat().st_size
    assert len(told) > 2
    assert [total for _, total in told] == [size] * len(told)
    assert sorted(told) == told
    assert told[-1] == (size, size)


def test_more_frames_than_a_block_holds_are_all_written(tmp_path: Path) -> None:
    source = long_recording(tmp_path / "dive.ddf", 300)
    convert_didson(source, tmp_path / "dive.mcap")
    stamps_ns = np.concatenate([block.stamps_ns for block in read_sonar_frames(tmp_path / "dive.mcap")])
    assert np.sort(stamps_ns).tolist() == [START_NS + i * STEP_NS for i in range(300)]


def test_a_log_that_exists_survives_a_recording_without_frames(tmp_path: Path) -> None:
    log, source = tmp_path / "dive.mcap", tmp_path / "dive.ddf"
    log.write_bytes(b"precious")
    source.write_bytes(Ddf(images(1, 96, 64)).content()[:600])
    with pytest.raises(DatasetError, match="no whole frame: bytes 512 to 599: a frame cut off"):
        convert_didson(source, log)
    assert log.read_bytes() == b"precious"
    assert sorted(tmp_path.iterdir()) == [source, log]


def test_a_log_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    source = tmp_path / "dive.ddf"
    source.write_bytes(Ddf(images(1, 96, 64)).content())
    (tmp_path / "file").touch()
    with pytest.raises(LogError, match="cannot be written"):
        convert_didson(source, tmp_path / "file" / "dive.mcap")


def test_a_recording_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"dive\.ddf: cannot be read"):
        convert_didson(tmp_path / "dive.ddf", tmp_path / "dive.mcap")


def test_the_log_has_the_name_of_the_recording(tmp_path: Path) -> None:
    result = converted(tmp_path, Aris(images(2, 128, 64)).content(), "aris")
    assert result.recording.metadata["sonar_graph"]["name"] == "dive"
    assert result.notes["source"] == "ARIS recording dive.aris"


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    printed = capsys.readouterr()
    return int(stop.value.code or 0), printed.out + printed.err


@pytest.mark.parametrize("kind", ["didson", "aris", "oculus"])
def test_the_commands_say_what_was_read_and_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str) -> None:
    pictures = images(4, 48, 64)
    whole = {"didson": Ddf(pictures, high=0), "aris": Aris(pictures, mode=1), "oculus": Oculus(pictures)}[
        kind
    ].content()
    source, log = tmp_path / "dive.bin", tmp_path / "dive.mcap"
    source.write_bytes(whole[:-7])
    code, said = run(capsys, "convert", kind, source, "-o", log)
    assert code == 0
    assert "dive.bin: 3 frames, 0.2 s" in said
    assert "lost: bytes" in said
    assert "cut off" in said
    code, said = run(capsys, "inspect", log)
    assert "48 beams x 64 bins of uint8" in said
    assert "cut off" in said


def test_the_command_takes_the_speed_of_sound(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, log = tmp_path / "dive.ddf", tmp_path / "dive.mcap"
    source.write_bytes(Ddf(images(2, 96, 512)).content())
    assert run(capsys, "convert", "didson", source, "-o", log, "--sound-speed", 1500)[0] == 0
    (frames,) = read_sonar_frames(log)
    assert frames.ranges_m[-1] == pytest.approx((1.26 + 1.25) * 1500 / 1465, abs=0.002)


def test_of_many_losses_the_command_shows_some(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    header, *frames = Ddf(images(50, 48, 64), high=0).pieces()
    source, log = tmp_path / "dive.ddf", tmp_path / "dive.mcap"
    source.write_bytes(header + b"".join(bytes(len(f)) if i % 2 else f for i, f in enumerate(frames)))
    _, said = run(capsys, "convert", "didson", source, "-o", log)
    assert said.count("lost: bytes") == 10
    assert "and 15 stretches more" in said
