"""Recordings of sonars and ways of damaging them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonar_graph.logs.convert import SonarConversion

Convert = Callable[[Path, Path], SonarConversion]
Frame = tuple[bytes, int, bytes]
"""Image, stamp, and ranges with azimuths."""


@dataclass(frozen=True)
class Source:
    """A sound recording and what is read from it."""

    name: str
    convert: Convert
    pieces: list[bytes]
    """The file's header and its frames."""
    frames: list[Frame]
    is_relative: bool
    """Its times say only how long after the first frame."""

    @property
    def content(self) -> bytes:
        """The file."""
        return b"".join(self.pieces)


def cut(_: Source, content: bytes, rng: np.random.Generator) -> bytes:
    return content[: int(rng.integers(len(content)))]


def loss(source: Source, content: bytes, rng: np.random.Generator) -> bytes:
    return without(content, place(source, content, rng), stretch(source, rng))


def gain(source: Source, content: bytes, rng: np.random.Generator) -> bytes:
    return with_noise(content, place(source, content, rng), stretch(source, rng), rng)


def doubling(source: Source, content: bytes, rng: np.random.Generator) -> bytes:
    at = place(source, content, rng)
    return content[: at + stretch(source, rng)] + content[at:]


def loss_by_a_frame(source: Source, content: bytes, rng: np.random.Generator) -> bytes:
    return without(content, place(source, content, rng), len(source.pieces[1]))


def gain_by_a_frame(source: Source, content: bytes, rng: np.random.Generator) -> bytes:
    return with_noise(content, place(source, content, rng), len(source.pieces[1]), rng)


def without(content: bytes, at: int, count: int) -> bytes:
    return content[:at] + content[at + count :]


def with_noise(content: bytes, at: int, count: int, rng: np.random.Generator) -> bytes:
    return (
        content[:at]
        + rng.integers(0, 256, count, dtype=np.uint8).tobytes()
        + content[at:]
    )


def flips(_: Source, content: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(content)
    for at in rng.integers(0, len(content), int(rng.integers(1, 30))):
        changed[at] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def header_flip(source: Source, content: bytes, rng: np.random.Generator) -> bytes:
    """One bit in the header of one frame, where most of what counts is."""
    at = frame_starts(source)[int(rng.integers(len(source.frames)))] + int(
        rng.integers(900)
    )
    changed = bytearray(content)
    if at < len(changed):
        changed[at] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def zeros(source: Source, content: bytes, rng: np.random.Generator) -> bytes:
    at, count = place(source, content, rng), stretch(source, rng)
    return content[:at] + bytes(min(count, len(content) - at)) + content[at + count :]


_ALL = (
    cut,
    loss,
    gain,
    doubling,
    loss_by_a_frame,
    gain_by_a_frame,
    flips,
    header_flip,
    zeros,
)
DAMAGES = {damage.__name__.replace("_", " "): damage for damage in _ALL}
BY_A_FRAME = {"loss by a frame", "gain by a frame"}
"""They move what follows to where a frame should be, so that nothing can be noticed."""


def place(source: Source, content: bytes, rng: np.random.Generator) -> int:
    """Anywhere, or exactly where a frame begins."""
    starts = frame_starts(source)
    at = (
        starts[int(rng.integers(len(starts)))]
        if rng.random() < 0.2
        else int(rng.integers(len(content)))
    )
    return min(at, len(content))


def stretch(source: Source, rng: np.random.Generator) -> int:
    """A number of bytes up to two frames, but no frame exactly."""
    frame = len(source.pieces[1])
    count = int(np.exp(rng.uniform(0, np.log(2 * frame))))
    return count + (count % frame == 0)


def frame_starts(source: Source) -> list[int]:
    return np.cumsum([len(piece) for piece in source.pieces])[:-1].tolist()
