"""Any sonar's file, whole and damaged: no frame but those recorded, and what is lost is reported."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from sonar_graph.cli.main import app
from sonar_graph.logs import read_sonar_frames

from .sonar_recordings import (
    STEP_NS,
    Aris,
    Converted,
    Ddf,
    Oculus,
    converted,
    images,
)

COUNT = 7
EVERY = list(range(COUNT))
PICTURES = images(COUNT, 48, 50)
RECORDINGS = {
    "ddf": Ddf(PICTURES, high=0),
    "aris": Aris(PICTURES, mode=1),
    "raw": Oculus(PICTURES),
}
PIECES = {ending: recording.pieces() for ending, recording in RECORDINGS.items()}
SETTING_AT = {"ddf": 52, "aris": 476, "raw": 53 + 40 + 4 + 1 + 6}
"""A byte of something that ranges depend on: window start, delay, size of a bin."""
CLOCK_AT = {"ddf": 40, "aris": 24, "raw": 53 + 40 + 3}
"""A byte of a frame's time, worth seconds for a DIDSON, hours for an ARIS, and tenths of one for an Oculus."""
Frames = list[bytes]


def which(result: Converted) -> list[int]:
    """Numbers of the frames that were read: each was recorded, to the last byte, and at this time after the first."""
    known = {picture.tobytes(): i for i, picture in enumerate(PICTURES)}
    frames = sorted(
        (stamp_ns, known[image.tobytes()])
        for stamp_ns, image in result.by_stamp().items()
    )
    assert (
        sum(len(block) for block in result.blocks) == len(frames) == result.done.frames
    )
    return [number for _, number in frames]


def read(folder: Path, pieces: Frames, ending: str) -> tuple[list[int], str]:
    """Numbers of the frames that were read, and the messages about the others; together they are all bytes."""
    content = b"".join(pieces)
    result = converted(folder, content, ending)
    lost = sum(loss.end - loss.at for loss in result.done.lost)
    assert len(PIECES[ending][0]) + len(
        PIECES[ending][1]
    ) * result.done.frames + lost == len(content)
    numbers = which(result)
    origins_ns = np.array(sorted(result.by_stamp())) - np.array(numbers) * STEP_NS
    assert np.unique(origins_ns).size == 1  # an Oculus counts from anywhere
    return numbers, "; ".join(result.done.shortcomings())


# ---- damage


def patched(frames: Frames, number: int, at: int, value: bytes) -> Frames:
    frame = frames[number]
    frame = frame[:at] + value + frame[at + len(value) :]
    return [*frames[:number], frame, *frames[number + 1 :]]


def flipped(frames: Frames, which_one: int, at: int, bit: int) -> Frames:
    return patched(frames, which_one, at, bytes([frames[which_one][at] ^ bit]))


def other_settings(bits: dict[int, int]) -> Callable[[Frames, str], Frames]:
    """Damage that flips a bit of the settings of each of these frames."""

    def damage(frames: Frames, ending: str) -> Frames:
        for i, bit in bits.items():
            frames = flipped(frames, i, SETTING_AT[ending], bit)
        return frames

    return damage


def without(*lost: int) -> list[int]:
    return [n for n in EVERY if n not in lost]


# fmt: off
FAULTS: dict[str, tuple[Callable[[Frames, str], Frames], list[int], str]] = {
    "a frame twice": (lambda f, _: [*f[:3], *f[2:]], EVERY, "a repetition of the frame at byte"),
    "two settings that alternate": (other_settings({1: 4, 3: 4, 5: 4}), EVERY, "^$"),  # as some sonars have
    "damaged settings side by side": (
        other_settings({0: 1, 1: 2, 4: 4, 5: 8}), [2, 3, 6], "^([^;]*settings[^;]*(; )?){4}"),
    **{f"header {i}": (lambda f, _, i=i: patched(f, i, 0, b"\xa5" * 200), without(i), "bytes") for i in (0, 3, 6)},
    **{f"setting {i}": (other_settings({i: 4}), without(i), "settings are those of no frame") for i in (0, 1, 4, 6)},
    **{f"time {i}": (lambda f, e, i=i: flipped(f, i, CLOCK_AT[e], 16), without(i), "its time does not fit")
       for i in (2, 4)},
    # the same number of bytes remains as of a cut header, but they are not how a header begins
    **{f"{n} bytes in the last": (
        lambda f, _, n=n: [*f[:-1], f[-1][:-30] + b"\x5a" * n + f[-1][-30:]], EVERY[:-1],
        "bytes are missing or too many") for n in (1, 5, 40)},
}
ARIS_FAULTS: dict[str, tuple[Callable[[Frames, str], Frames], list[int], str]] = {
    **{f"time {i} far off": (lambda f, _, i=i: flipped(f, i, 24, 1), without(i), "its time does not fit")
       for i in (0, 6)},
    "next number, other signature": (
        lambda f, _: [*f[:-1], f[-1][:12] + b"DDX"], EVERY[:-2], "bytes are missing or too many"),
    # 65,000 samples a beam are possible, but then other frames would lie within this one
    **{f"length {i}": (
        lambda f, _, i=i: patched(f, i, 468, (65_000).to_bytes(4, "little")), without(i), "longer than the")
       for i in (0, 2)},
}
# fmt: on
CASES = [(ending, name) for ending in PIECES for name in FAULTS] + [
    ("aris", name) for name in ARIS_FAULTS
]


@pytest.mark.parametrize(("ending", "name"), CASES)
def test_intact_frames_of_a_damaged_file_are_read(tmp_path, ending, name):
    damage, expected, told = (FAULTS | ARIS_FAULTS)[name]
    head, *frames = PIECES[ending]
    numbers, said = read(tmp_path, [head, *damage(frames, ending)], ending)
    assert numbers == expected
    assert re.search(told, said)
    lost = without(*expected)
    if len(lost) == 1 and "in the last" not in name:
        begin = len(head) + lost[0] * len(frames[0])
        assert f"bytes {begin} to {begin + len(frames[0]) - 1}: " in said


@pytest.mark.parametrize("ending", PIECES)
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(part=0)
@given(part=st.floats(0, 1, exclude_max=True))
def test_of_a_cut_file_every_complete_frame_is_read(tmp_path, ending, part):
    head, *frames = PIECES[ending]
    length = len(head) + len(frames[0]) + int(part * (COUNT - 1) * len(frames[0]))
    whole, rest = divmod(length - len(head), len(frames[0]))
    numbers, said = read(tmp_path, [b"".join(PIECES[ending])[:length]], ending)
    assert numbers == list(range(whole))
    assert bool(rest) == ("cut off" in said)
    if rest:
        assert f"bytes {length - rest} to {length - 1}: " in said


@pytest.mark.parametrize("ending", ["ddf", "aris"])
def test_a_file_header_that_is_damaged_or_lost_bytes_costs_no_frame(tmp_path, ending):
    head, *frames = map(bytes, PIECES[ending])
    if ending == "aris":
        damaged = converted(tmp_path, b"".join([b"\xff" * 1024, *frames]), ending)
        assert which(damaged) == EVERY
    result = converted(tmp_path, b"".join([head[:300], *frames]), ending)
    assert which(result) == EVERY
    assert [loss.end for loss in result.done.lost] == [300]
    assert f"{len(head) - 300} bytes too short" in result.done.shortcomings()[0]


# ---- conversion to a log


@pytest.mark.parametrize(
    ("kind", "ending"), [("didson", "ddf"), ("aris", "aris"), ("oculus", "raw")]
)
def test_the_commands_say_what_was_read_and_lost(tmp_path, kind, ending):
    source = tmp_path / "dive.bin"
    source.write_bytes(b"".join(PIECES[ending][:5])[:-7])
    said = run("convert", kind, source, "-o", tmp_path / "dive.mcap")
    for words in ("dive.bin: 3 frames, 0.2 s", "lost: bytes", "cut off"):
        assert words in said
    said = run("inspect", tmp_path / "dive.mcap", code=3)  # images alone are no run
    for words in ("48 beams x 50 bins of uint8", "cut off"):
        assert words in said


def run(*arguments: object, code: int = 0) -> str:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == code, done.output
    return done.output


def test_the_command_takes_the_speed_of_sound_and_shows_losses(tmp_path):
    header, *frames = Ddf(images(50, 96, 512)).pieces()
    source = tmp_path / "dive.ddf"
    log = tmp_path / "dive.mcap"
    frames[1::2] = [bytes(len(frame)) for frame in frames[1::2]]
    source.write_bytes(b"".join([header, *frames]))
    said = run("convert", "didson", source, "-o", log, "--sound-speed", 1500)
    assert said.count("lost: bytes") == 10
    assert "and 15 stretches more" in said
    (last_m,) = {frames.ranges_m[-1] for frames in read_sonar_frames(log)}
    assert last_m == pytest.approx((1.26 + 1.25) * 1500 / 1465, abs=0.002)
