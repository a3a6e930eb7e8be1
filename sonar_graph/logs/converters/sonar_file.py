"""What recordings of imaging sonars have in common, whoever made them: frames one after another, without checksums."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration
from sonar_graph.errors import DatasetError
from sonar_graph.measurements import Floats

_BLOCK_BYTES = 1 << 20


Settings = tuple[int | float | bytes, ...]


class DamagedFrameError(Exception):
    """A frame's header cannot be one; the text says why."""


@dataclass(frozen=True)
class FrameHead:
    """What the header of a frame says."""

    at: int
    """Byte of the file where the header begins."""
    size: int
    """Bytes of header and samples."""
    number: int
    """As the sonar counts."""
    clock_ns: int
    """The sonar's own time of the frame."""
    settings: Settings
    """All that samples and geometry depend on; those that may drift are floats."""
    readings: Mapping[str, float] = field(default_factory=dict)
    """What other sensors said, such as depth."""
    has_image: bool = True
    """Messages of other kinds between the frames have none."""

    @property
    def end(self) -> int:
        """Byte after the last."""
        return self.at + self.size


@dataclass(frozen=True)
class Lost:
    """A stretch of the file of which nothing is used."""

    at: int
    end: int
    reason: str

    def __str__(self) -> str:
        return f"bytes {self.at} to {self.end - 1}: {self.reason}"


@dataclass(frozen=True, eq=False)
class FrameGeometry:
    """Where the samples of a frame lie."""

    ranges_m: Floats
    """Middle of each bin, shape (bins,)."""
    azimuths_rad: Floats
    """Of each beam in the order of the samples, positive to the left, shape (beams,)."""
    frequency_hz: float = 0.0
    sound_speed_m_s: float = 0.0


class SonarFormat(Protocol):
    """A kind of file, opened."""

    @property
    def calibration(self) -> Calibration:
        """What the kind of sonar says about its images."""
        ...

    @property
    def notes(self) -> Mapping[str, str]:
        """How the file is understood, for whoever reads the log."""
        ...

    @property
    def first_at(self) -> int:
        """Where the first frame is."""
        ...

    @property
    def head_bytes(self) -> int:
        """Enough to read any frame's header."""
        ...

    @property
    def signature(self) -> bytes:
        """Bytes that every frame's header has."""
        ...

    @property
    def signature_at(self) -> int:
        """Where in the header they are."""
        ...

    @property
    def clock_period_ns(self) -> int | None:
        """What the sonar's clock wraps around at; None: it does not."""
        ...

    @property
    def frames_promised(self) -> int:
        """Number of frames by the file's header; 0: it does not say."""
        ...

    def head(self, content: bytes, at: int) -> FrameHead:
        """The header at the beginning of some bytes, which lie at ``at`` in the file.

        Raises
        ------
        DamagedFrameError
            When it cannot be one.
        """
        ...

    def may_follow(self, content: bytes, earlier: FrameHead) -> bool:
        """Whether bytes at the end of the file, fewer than a header, can be the beginning of the next frame."""
        ...

    def geometry(self, settings: Settings) -> FrameGeometry:
        """Ranges and azimuths of frames with these settings."""
        ...

    def samples(self, frame: bytes, settings: Settings) -> NDArray[np.generic]:
        """The image in a frame's bytes, shape (beams, bins)."""
        ...


def may_be_numbered_header(content: bytes, signature: bytes, signature_at: int, number: int) -> bool:
    """Whether bytes begin like a header with a number in its first four bytes and a signature later on."""
    signed = content[signature_at:]
    return number.to_bytes(4, "little").startswith(content[:4]) and signature.startswith(signed[: len(signature)])


class ByteSource:
    """A file that is read where it is wanted."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._stream = path.open("rb")
            self.size = path.stat().st_size
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stream.close()

    def read(self, at: int, count: int) -> bytes:
        """Bytes from ``at``; fewer at the end of the file."""
        try:
            self._stream.seek(at)
            return self._stream.read(count)
        except OSError as error:
            raise DatasetError(f"{self.path}: cannot be read at byte {at}: {error.strerror}") from error

    def places(self, pattern: bytes, start: int) -> Iterator[int]:
        """Where a pattern begins, from ``start`` on."""
        for at in range(start, self.size, _BLOCK_BYTES):
            block = self.read(at, _BLOCK_BYTES + len(pattern) - 1)
            found = block.find(pattern)
            while found >= 0:
                yield at + found
                found = block.find(pattern, found + 1)
