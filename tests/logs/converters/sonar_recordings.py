"""Recordings of sonars, byte for byte from the documented layouts without use of the readers, and their logs."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sonar_graph.images import SonarFrames
from sonar_graph.logs import read_sonar_frames
from sonar_graph.logs.convert import (
    SonarConversion,
    convert_aris,
    convert_didson,
    convert_oculus,
)
from sonar_graph.logs.mcap import Keep, Recording, scan
from sonar_graph.logs.vehicle_setup import read_calibration, read_notes

START = datetime(2014, 5, 6, 7, 8, 9, 250_000, tzinfo=UTC)
STEP = timedelta(milliseconds=120)
START_NS = 1_399_360_089_250_000_000
STEP_NS = 120_000_000


def images(count: int, beams: int, samples: int, seed: int = 0) -> NDArray[np.uint8]:
    """Random frames (count, beams, samples) without equal neighbours."""
    return np.random.default_rng(seed).integers(
        0, 256, (count, beams, samples), dtype=np.uint8
    )


def put(header: bytearray, at: int, layout: str, *values: Any) -> None:
    struct.pack_into("<" + layout, header, at, *values)


@dataclass
class Recorded:
    """Frames as a file of a sonar, shape (count, beams, samples)."""

    frames: NDArray[Any]
    ending: ClassVar[str]

    def file_header(self) -> bytes:
        return b""

    def frame(self, i: int) -> bytes:
        raise NotImplementedError

    def pieces(self) -> list[bytes]:
        return [self.file_header(), *(self.frame(i) for i in range(len(self.frames)))]

    def content(self) -> bytes:
        return b"".join(self.pieces())


@dataclass
class Ddf(Recorded):
    """A DIDSON recording; the offsets are those of the DDF_03 and DDF_04 descriptions."""

    ending = "ddf"
    version: int = 3
    high: int = 1
    reverse: int = 0
    serial: int = 42
    start_code: int = 3
    length_code: int = 0
    flags: int = 0
    frame_version: bytes | None = None

    def file_header(self) -> bytes:
        count, beams, samples = self.frames.shape
        header = bytearray(512 if self.version == 3 else 1024)
        put(header, 0, "3sB4i", b"DDF", self.version, count, 8, self.high, beams)
        put(header, 20, "fi", 400_000.0, samples)
        window = self.start_code, self.length_code
        put(header, 28, "5i32s", 20, *window, self.reverse, self.serial, b"2014-05-06")
        return bytes(header)

    def frame(self, i: int) -> bytes:
        header = bytearray(256 if self.version == 3 else 1024)
        moment = START + i * STEP
        # the computer's clock is 7 s ahead
        put(header, 0, "3i", i, int(moment.timestamp()) + 7, 0)
        put(header, 12, "4s", self.frame_version or b"DDF" + bytes([self.version]))
        hundredths = moment.microsecond // 10_000
        put(header, 20, "7i", *moment.timetuple()[:6], hundredths)
        put(header, 48, "3i", 3, self.start_code, self.length_code)
        put(header, 192, "i", self.flags)
        return bytes(header) + self.frames[i].T.tobytes()  # beams fastest


@dataclass
class Aris(Recorded):
    """An ARIS recording; the offsets are those of aris-file-sdk's ArisFrameHeader."""

    ending = "aris"
    mode: int = 9
    telephoto: int = 0
    system: int = 1
    sound_speed: float = 1482.5
    in_order: int = 1
    sound_speeds: Sequence[float] = ()

    def file_header(self) -> bytes:
        return struct.pack("<4sI", b"DDF\x05", len(self.frames)).ljust(1024, b"\0")

    def frame(self, i: int) -> bytes:
        header = bytearray(1024)
        clock_us = (START_NS + i * STEP_NS) // 1000
        put(header, 0, "IQ4sIQ", i, clock_us + 7_000_000, b"DDF\x05", 0, clock_us)
        put(header, 128, "f", 1.5 + i)
        put(header, 160, "f", 90.0 - i)
        speed = self.sound_speeds[i] if self.sound_speeds else self.sound_speed
        # high frequency, 12, 30 kHz, a sample each 5 us
        ping = self.mode, 1, 12, 30_000, 5, 1
        put(header, 436, "6I2fI", *ping, 8.3, speed, self.frames.shape[2])
        put(header, 476, "3I", 1700, self.telephoto, self.system)
        put(header, 516, "I", self.in_order)
        return bytes(header) + self.frames[i].T.tobytes()


@dataclass
class Oculus(Recorded):
    """Oculus pings of either version, with samples of 8, 16 or 32 bits and without gains."""

    ending = "raw"
    version: int = 0
    gamma_code: int = 127

    def frame(self, i: int) -> bytes:
        image = np.ascontiguousarray(self.frames[i].T)
        ranges, beams = image.shape
        pixels = image.astype(f"<u{image.itemsize}").tobytes()
        bearings = np.linspace(-6500, 6000, beams).astype("<i2").tobytes()
        flags = 2, 0, 255, self.gamma_code, 0b11001
        fire = struct.pack("<5B4d", *flags, 2.0, 50.0, 0.0, 0.0)
        # a clock of 32 bits that wraps around
        clock_ns = 2**32 - 100_000_000 + i * STEP_NS
        head = 500 + i, 0, 2.1e6, 12.5, 1.9
        is_wide = self.version == 2
        if is_wide:
            fire += struct.pack("<9I", *range(9))
            attitude = 45.0 + i, 3.0, -2.0
            result = struct.pack("<2I8d", *head, *attitude, 1481.0, clock_ns * 1e-9)
        else:
            result = struct.pack("<2I4dI", *head, 1481.0, clock_ns % 2**32)
        result += struct.pack("<BdHH", image.itemsize - 1, 0.003, ranges, beams)
        result += bytes(16 * is_wide)
        offset = 2048
        total = offset + len(pixels)
        result += struct.pack("<3I", offset, len(pixels), total)
        kind = 0x4F53, 1, 2, 0x23, self.version
        header = struct.pack("<HHHHHIH", *kind, total - 16, 0)
        content = header + fire + result + bearings
        return content.ljust(offset, b"\0") + pixels


def no_ping(payload: bytes = b"\0" * 12) -> bytes:
    """A message without an image: the user's configuration."""
    return struct.pack("<HHHHHIH", 0x4F53, 1, 2, 0x55, 0, len(payload), 0) + payload


CONVERTERS = {"ddf": convert_didson, "aris": convert_aris, "raw": convert_oculus}


@dataclass
class Converted:
    done: SonarConversion
    blocks: list[SonarFrames]
    recording: Recording

    @property
    def frames(self) -> SonarFrames:
        """All of them, where there is one block."""
        (block,) = self.blocks
        return block

    @property
    def notes(self) -> dict[str, str]:
        return read_notes(self.recording)

    @property
    def image(self) -> Any:
        """Calibration of the samples."""
        return read_calibration(self.recording).sonar.image

    def by_stamp(self) -> dict[int, NDArray[Any]]:
        return {
            stamp_ns: image
            for block in self.blocks
            for stamp_ns, image in zip(
                block.stamps_ns.tolist(), block.intensity, strict=True
            )
        }


def converted(folder: Path, content: bytes, ending: str, **settings: Any) -> Converted:
    source = folder / f"dive.{ending}"
    log = folder / "dive.mcap"
    source.write_bytes(content)
    done = CONVERTERS[ending](source, log, **settings)
    return Converted(done, list(read_sonar_frames(log)), scan(log, lambda _: Keep.NONE))


def log_of(folder: Path, recording: Recorded, **settings: Any) -> Converted:
    return converted(folder, recording.content(), recording.ending, **settings)
