"""Damage that can happen to any file of a sonar: no frame but those recorded, and what is lost is named."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sonar_graph.errors import DatasetError

from .sonar_logs import CONVERTERS, Converted, converted
from .sonar_recordings import STEP_NS, Aris, Ddf, Oculus, images, put

COUNT = 7
PICTURES = {"ddf": images(COUNT, 48, 50), "aris": images(COUNT, 48, 50), "raw": images(COUNT, 48, 50)}
PIECES = {
    "ddf": Ddf(PICTURES["ddf"], high=0).pieces(),
    "aris": Aris(PICTURES["aris"], mode=1).pieces(),
    "raw": Oculus(PICTURES["raw"]).pieces(),
}
SETTING_AT = {"ddf": 52, "aris": 476, "raw": 53 + 40 + 4 + 1}
"""Of something that ranges depend on: window start, delay, size of a bin."""
CLOCK_AT = {"ddf": 40, "aris": 24, "raw": 53 + 40 + 3}
"""A byte of a frame's time, worth seconds for a DIDSON, hours for an ARIS, and tenths of one for an Oculus."""
ENDINGS = list(PIECES)
each_kind = pytest.mark.parametrize("ending", ENDINGS)
in_one_folder = settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])


def which(result: Converted, ending: str) -> list[int]:
    """Numbers of the frames that were read: each was recorded, to the last byte, and at this time after the first."""
    known = {picture.tobytes(): i for i, picture in enumerate(PICTURES[ending])}
    frames = sorted((stamp_ns, known[image.tobytes()]) for stamp_ns, image in result.by_stamp().items())
    assert sum(len(block) for block in result.blocks) == len(frames) == result.done.frames
    return [number for _, number in frames]


def at_their_times(result: Converted, ending: str) -> bool:
    """Whether every frame is as long after the first as it was recorded; an Oculus counts from anywhere."""
    known = {picture.tobytes(): i for i, picture in enumerate(PICTURES[ending])}
    origins_ns = {stamp_ns - known[image.tobytes()] * STEP_NS for stamp_ns, image in result.by_stamp().items()}
    return len(origins_ns) == 1


def read(folder: Path, pieces: list[bytes], ending: str) -> tuple[list[int], str]:
    content = b"".join(pieces)
    result = converted(folder, content, ending)
    size = len(PIECES[ending][1])
    lost = sum(loss.end - loss.at for loss in result.done.lost)
    assert len(PIECES[ending][0]) + size * result.done.frames + lost == len(content)
    assert at_their_times(result, ending)
    return which(result, ending), "; ".join(result.done.shortcomings())


def patched(piece: bytes, at: int, value: bytes) -> bytes:
    return piece[:at] + value + piece[at + len(value) :]


@each_kind
def test_a_whole_file_has_no_shortcomings(tmp_path: Path, ending: str) -> None:
    assert read(tmp_path, PIECES[ending], ending) == (list(range(COUNT)), "")


@each_kind
@in_one_folder
@given(part=st.floats(0, 1, exclude_max=True))
def test_of_a_cut_file_every_complete_frame_is_read(tmp_path: Path, ending: str, part: float) -> None:
    head, *frames = PIECES[ending]
    length = len(head) + len(frames[0]) + int(part * (COUNT - 1) * len(frames[0]))
    whole, rest = divmod(length - len(head), len(frames[0]))
    numbers, said = read(tmp_path, [b"".join(PIECES[ending])[:length]], ending)
    assert numbers == list(range(whole))
    assert bool(rest) == ("cut off" in said)
    if rest:
        assert f"bytes {length - rest} to {length - 1}: " in said


@each_kind
def test_a_cut_frame_is_named_with_its_bytes(tmp_path: Path, ending: str) -> None:
    head, *frames = PIECES[ending]
    size = len(frames[0])
    _, said = read(tmp_path, [head, *frames[:3], frames[3][:-10]], ending)
    number = 503 if ending == "raw" else 3
    assert f"frame {number}: cut off, {size - 10} of {size} bytes are there" in said
    assert f"bytes {len(head) + 3 * size} to {len(head) + 4 * size - 11}" in said


@each_kind
@pytest.mark.parametrize("count", [1, 5, 40])
def test_a_last_frame_with_foreign_bytes_is_not_believed(tmp_path: Path, ending: str, count: int) -> None:
    """The same number of bytes remains as of a cut header, but they are not how a header begins."""
    head, *frames = PIECES[ending]
    frames[-1] = frames[-1][:-30] + b"\x5a" * count + frames[-1][-30:]
    numbers, said = read(tmp_path, [head, *frames], ending)
    assert numbers == list(range(COUNT - 1))
    assert "bytes are missing or too many" in said


@each_kind
@in_one_folder
@given(part=st.floats(0, 1, exclude_max=True), count=st.integers(1, 3000))
def test_missing_bytes_cost_the_frames_that_they_touch(tmp_path: Path, ending: str, part: float, count: int) -> None:
    head, *frames = PIECES[ending]
    size, content = len(frames[0]), b"".join(frames)
    at = size + int(part * (COUNT - 3) * size)
    numbers, said = read(tmp_path, [head, content[:at], content[at + count :]], ending)
    # of the frame before nobody can say that it is whole, where the next header is not found in its place
    assert set(range(COUNT)) - set(numbers) <= set(range(at // size - 1, (at + count - 1) // size + 1))
    assert said


@each_kind
@in_one_folder
@given(part=st.floats(0, 1, exclude_max=True), count=st.integers(1, 3000), fill=st.integers(0, 255))
def test_foreign_bytes_cost_the_frame_that_they_are_in_and_perhaps_the_one_before(
    tmp_path: Path, ending: str, part: float, count: int, fill: int
) -> None:
    head, *frames = PIECES[ending]
    size, content = len(frames[0]), b"".join(frames)
    at = size + int(part * (COUNT - 3) * size)
    numbers, said = read(tmp_path, [head, content[:at], bytes([fill]) * count, content[at:]], ending)
    assert set(range(COUNT)) - set(numbers) <= {at // size - 1, at // size}
    assert "bytes" in said


@each_kind
@pytest.mark.parametrize("which_one", [0, 3, COUNT - 1])
def test_an_overwritten_header_costs_one_frame(tmp_path: Path, ending: str, which_one: int) -> None:
    head, *frames = PIECES[ending]
    frames[which_one] = patched(frames[which_one], 0, b"\xa5" * 200)
    numbers, said = read(tmp_path, [head, *frames], ending)
    assert numbers == [n for n in range(COUNT) if n != which_one]
    begin = len(head) + which_one * len(frames[0])
    assert f"bytes {begin} to {begin + len(frames[0]) - 1}: " in said


@each_kind
def test_a_frame_that_is_there_twice_is_read_once(tmp_path: Path, ending: str) -> None:
    head, *frames = PIECES[ending]
    numbers, said = read(tmp_path, [head, *frames[:3], *frames[2:]], ending)
    assert numbers == list(range(COUNT))
    assert "a repetition of the frame at byte" in said


@each_kind
@pytest.mark.parametrize("which_one", [0, 1, 4, COUNT - 1])
def test_a_setting_of_one_frame_alone_is_damage(tmp_path: Path, ending: str, which_one: int) -> None:
    head, *frames = PIECES[ending]
    old = frames[which_one][SETTING_AT[ending] + 6 * (ending == "raw")]
    frames[which_one] = patched(frames[which_one], SETTING_AT[ending] + 6 * (ending == "raw"), bytes([old ^ 4]))
    numbers, said = read(tmp_path, [head, *frames], ending)
    assert numbers == [n for n in range(COUNT) if n != which_one]
    assert "settings" in said


@each_kind
def test_a_setting_that_stays_changed_is_believed(tmp_path: Path, ending: str) -> None:
    head, *frames = PIECES[ending]
    at = SETTING_AT[ending] + 6 * (ending == "raw")
    changed = [patched(frame, at, bytes([frame[at] ^ 4])) for frame in frames]
    result = converted(tmp_path, b"".join([head, *frames[:3], *changed[3:]]), ending)
    assert which(result, ending) == list(range(COUNT))
    assert len(result.blocks) == 2
    assert result.blocks[0].ranges_m[-1] != result.blocks[1].ranges_m[-1]


@each_kind
@pytest.mark.parametrize("which_one", [2, 4])
def test_a_time_that_is_not_between_its_neighbours_is_damage(tmp_path: Path, ending: str, which_one: int) -> None:
    head, *frames = PIECES[ending]
    at = CLOCK_AT[ending]
    frames[which_one] = patched(frames[which_one], at, bytes([frames[which_one][at] ^ 16]))
    numbers, said = read(tmp_path, [head, *frames], ending)
    assert numbers == [n for n in range(COUNT) if n != which_one]
    assert "time" in said


@pytest.mark.parametrize("which_one", [0, COUNT - 1])
def test_a_first_or_last_time_that_is_far_from_the_others_is_damage(tmp_path: Path, which_one: int) -> None:
    head, *frames = PIECES["aris"]
    frames[which_one] = patched(frames[which_one], 24, bytes([frames[which_one][24] ^ 1]))
    numbers, said = read(tmp_path, [head, *frames], "aris")
    assert numbers == [n for n in range(COUNT) if n != which_one]
    assert "its time does not fit" in said


@each_kind
def test_two_settings_that_alternate_are_believed(tmp_path: Path, ending: str) -> None:
    """Some sonars switch between two frequencies or windows with every frame."""
    head, *frames = PIECES[ending]
    at = SETTING_AT[ending] + 6 * (ending == "raw")
    pieces = [patched(frame, at, bytes([frame[at] ^ 4])) if i % 2 else frame for i, frame in enumerate(frames)]
    assert read(tmp_path, [head, *pieces], ending) == (list(range(COUNT)), "")


@each_kind
def test_two_damaged_headers_side_by_side_are_both_told(tmp_path: Path, ending: str) -> None:
    head, *frames = PIECES[ending]
    at = SETTING_AT[ending] + 6 * (ending == "raw")
    for i, bit in ((0, 1), (1, 2), (4, 4), (5, 8)):
        frames[i] = patched(frames[i], at, bytes([frames[i][at] ^ bit]))
    numbers, said = read(tmp_path, [head, *frames], ending)
    assert numbers == [2, 3, 6]
    assert said.count("settings") == 4


def test_a_clock_that_is_set_back_loses_nothing(tmp_path: Path) -> None:
    head, *frames = PIECES["aris"]
    for i in range(4, COUNT):
        frame = bytearray(frames[i])
        put(frame, 20, "Q", int.from_bytes(frame[20:28], "little") - 3_600_000_000)
        frames[i] = bytes(frame)
    result = converted(tmp_path, b"".join([head, *frames]), "aris")
    assert sorted(which(result, "aris")) == list(range(COUNT))


@pytest.mark.parametrize("which_one", [0, 2])
def test_a_length_beyond_the_file_does_not_swallow_what_follows(tmp_path: Path, which_one: int) -> None:
    """65,000 samples a beam are possible, but then other frames would lie within this one."""
    head, *frames = PIECES["aris"]
    frame = bytearray(frames[which_one])
    put(frame, 468, "I", 65_000)
    frames[which_one] = bytes(frame)
    numbers, said = read(tmp_path, [head, *frames], "aris")
    assert numbers == [n for n in range(COUNT) if n != which_one]
    assert "longer than the file" in said


@pytest.mark.parametrize("ending", ["ddf", "aris"])
def test_a_file_header_that_lost_bytes_costs_no_frame(tmp_path: Path, ending: str) -> None:
    head, *frames = PIECES[ending]
    result = converted(tmp_path, b"".join([head[:300], *frames]), ending)
    assert which(result, ending) == list(range(COUNT))
    assert [loss.end for loss in result.done.lost] == [300]
    assert f"{len(head) - 300} bytes too short" in result.done.shortcomings()[0]


@each_kind
@pytest.mark.parametrize("count", [1, 2])
def test_few_frames_are_read_without_neighbours(tmp_path: Path, ending: str, count: int) -> None:
    assert read(tmp_path, PIECES[ending][: 1 + count], ending)[0] == list(range(count))


@each_kind
def test_a_file_of_nothing_but_noise_after_its_header_is_refused(tmp_path: Path, ending: str) -> None:
    noise = np.random.default_rng(1).integers(0, 256, 200_000, dtype=np.uint8).tobytes()
    path = tmp_path / f"dive.{ending}"
    path.write_bytes(PIECES[ending][0] + noise)
    with pytest.raises(DatasetError, match=rf"^{re.escape(str(path))}: "):
        CONVERTERS[ending](path, tmp_path / "dive.mcap")


@each_kind
def test_what_is_lost_is_in_the_notes_of_the_log(tmp_path: Path, ending: str) -> None:
    head, *frames = PIECES[ending]
    result: Any = converted(tmp_path, b"".join([head, *frames])[:-5], ending)
    assert "cut off" in result.notes["sonar.shortcomings"]
    whole: Any = converted(tmp_path, b"".join([head, *frames]), ending)
    assert "sonar.shortcomings" not in whole.notes
