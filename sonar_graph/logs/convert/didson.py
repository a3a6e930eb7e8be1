"""DIDSON recordings (``.ddf``, versions 3 and 4) of Sound Metrics' lens sonar.

A file is a header of 512 bytes (1024 in version 4) and frames: a header of 256 (1024) bytes, then one byte a sample,
all beams of the first range first. The window of ranges is given by codes: it begins at a multiple of 0.42 m
("extended") or 0.375 m ("classic"), twice that at low frequency, and is as long as a table says. The sonar times its
echoes by a clock, so these metres hold for one speed of sound: the delays of 0.572 and 0.512 ms that Echoview states
for one step make 0.419 and 0.375 m at 1465 m/s.

Sources, for facts: oncvideo (MIT), ARISreader, pyDIDSON, Echoview's description of the format. No file of a real sonar
was at hand.
"""

from __future__ import annotations

import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration, SonarCalibration, SonarImage
from sonar_graph.devices import didson_azimuths
from sonar_graph.errors import DatasetError
from sonar_graph.logs.convert.sonar_file import (
    ByteSource,
    DamagedFrameError,
    FrameGeometry,
    FrameHead,
    Progress,
    Settings,
    SonarConversion,
    convert_sonar_file,
    may_be_numbered_header,
)

MAGIC = b"DDF"
HEADER_BYTES = {3: (512, 256), 4: (1024, 1024)}
"""Of the file and of a frame, by version."""
BEAMS = (48, 96)
MOST_SAMPLES = 4096
DECIBEL_SPAN = 90.0
"""Echoview's description of the format; 80 for ARIS."""
LAST_YEAR = 2037
"""Stamps of ROS 2 end early in 2038."""
NOMINAL_SOUND_SPEED_M_S = 1465.0
HIGH_FREQUENCY_HZ, LOW_FREQUENCY_HZ = 1.8e6, 1.1e6
CLASSIC, LONG_RANGE = 1, 2
"""Bits of a frame's configuration flags."""
START_STEP_M = {0: 0.42, CLASSIC: 0.375, LONG_RANGE: 0.42, CLASSIC | LONG_RANGE: 0.375}
LENGTHS_M = {
    0: (1.25, 2.5, 5.0, 10.0, 20.0, 40.0),
    CLASSIC: (1.125, 2.25, 4.5, 9.0, 18.0, 36.0),
    LONG_RANGE: (2.5, 5.0, 10.0, 20.0, 40.0, 80.0),
    CLASSIC | LONG_RANGE: (2.25, 4.5, 9.0, 18.0, 36.0, 72.0),
}
"""By flags; low frequency begins with the third."""
LOW_FREQUENCY_SHIFT = 2
FIRST_EXTENDED_SERIAL, LONG_RANGE_SERIAL = 19, 15
"""Earlier sonars are classic whatever the flags say, and one of them has a long range."""
_READINGS = {
    "depth": 128,
    "altitude": 132,
    "pitch": 136,
    "roll": 144,
    "heading": 152,
    "pan": 160,
    "tilt": 164,
    "sonar roll": 168,
}
_TIME_AT, _WINDOW_AT, _FLAGS_AT = 20, 52, 192


def convert_didson(
    path: Path, output: Path, progress: Progress | None = None, *, sound_speed_m_s: float | None = None
) -> SonarConversion:
    """Write an MCAP log with all whole frames of a ``.ddf`` file.

    Parameters
    ----------
    path, output
        The recording and the log.
    progress
        Called with the bytes done and the bytes in all.
    sound_speed_m_s
        Of the water, by which ranges are scaled; None: the sonar's nominal metres, which hold for 1465 m/s.

    Raises
    ------
    DatasetError
        When it is no such file, its header is damaged, or it has no whole frame.
    LogError
        When the log cannot be written.
    """
    with ByteSource(Path(path)) as source:
        return convert_sonar_file(source, DidsonFormat(source, sound_speed_m_s), Path(output), progress)


class DidsonFormat:
    """Headers, samples and geometry of a ``.ddf`` file."""

    signature_at = 12
    clock_period_ns = None

    def __init__(self, source: ByteSource, sound_speed_m_s: float | None = None) -> None:
        self._version = _version(source)
        self.first_at, self.head_bytes = HEADER_BYTES[self._version]
        header = source.read(0, self.first_at)
        if len(header) < self.first_at:
            raise DatasetError(f"{source.path}: ends within its header of {self.first_at} bytes")
        self.frames_promised, _, resolution, self._beams, _, self._samples = struct.unpack_from("<4ifi", header, 4)
        self._reverse, self._serial = struct.unpack_from("<2i", header, 40)
        if self._beams not in BEAMS or resolution not in (0, 1) or not 0 < self._samples <= MOST_SAMPLES:
            said = f"{self._beams} beams, {self._samples} samples, resolution {resolution}"
            expected = f"48 or 96 beams, at most {MOST_SAMPLES} samples, resolution 0 or 1"
            raise DatasetError(f"{source.path}: its header is damaged: it says {said}; expected {expected}")
        self._is_high = resolution == 1
        self._sound_speed_m_s = sound_speed_m_s or NOMINAL_SOUND_SPEED_M_S
        self.signature = self._signature(source)
        image = SonarImage(scale="decibel", decibel_span=DECIBEL_SPAN)
        self.calibration = Calibration(sonar=SonarCalibration(image=image))
        self.notes = {
            "source": f"DIDSON recording {source.path.name}, DDF version {self._version}",
            "sonar.time": "the sonar's own calendar time, to hundredths of a second, taken as UTC",
            "sonar.beams": "the manufacturer's polynomial for the lens",
            "sonar.ranges": f"from window codes, for a sound speed of {self._sound_speed_m_s:g} m/s",
            "sonar.scale": f"counts 0 to 255 are 0 to {DECIBEL_SPAN:g} dB (Echoview's description of the format)",
        }

    def head(self, content: bytes, at: int) -> FrameHead:
        """The header of a frame."""
        if len(content) < self.head_bytes:
            raise DamagedFrameError(f"a frame cut off, {len(content)} bytes of its header are there")
        if content[self.signature_at : self.signature_at + 4] != self.signature:
            raise DamagedFrameError("no frame begins here")
        (number,) = struct.unpack_from("<I", content, 0)
        start, length = struct.unpack_from("<2i", content, _WINDOW_AT)
        flags = self._flags(struct.unpack_from("<I", content, _FLAGS_AT)[0])
        shift = 0 if self._is_high else LOW_FREQUENCY_SHIFT
        if not 0 <= start <= 31 or not 0 <= length < len(LENGTHS_M[flags]) - shift:
            raise DamagedFrameError(f"frame {number} with window codes {start} and {length}")
        readings = {name: float(struct.unpack_from("<f", content, where)[0]) for name, where in _READINGS.items()}
        size = self.head_bytes + self._beams * self._samples
        settings = start, length, flags, self._beams, self._samples
        return FrameHead(at, size, number, _clock_ns(content, number), settings, readings)

    def may_follow(self, content: bytes, earlier: FrameHead) -> bool:
        """Whether some bytes can begin the frame after."""
        return may_be_numbered_header(content, self.signature, self.signature_at, earlier.number + 1)

    def geometry(self, settings: Settings) -> FrameGeometry:
        """Bins divide the window evenly."""
        start, length, flags, beams, samples = map(int, settings)
        scale = self._sound_speed_m_s / NOMINAL_SOUND_SPEED_M_S
        begin_m = start * START_STEP_M[flags] * (1 if self._is_high else 2) * scale
        length_m = LENGTHS_M[flags][length + (0 if self._is_high else LOW_FREQUENCY_SHIFT)] * scale
        ranges_m = begin_m + (np.arange(samples, dtype=float) + 0.5) * (length_m / samples)
        azimuths_rad = didson_azimuths(beams)
        if self._reverse:
            azimuths_rad = azimuths_rad[::-1]
        frequency_hz = HIGH_FREQUENCY_HZ if self._is_high else LOW_FREQUENCY_HZ
        return FrameGeometry(ranges_m, azimuths_rad, frequency_hz, self._sound_speed_m_s)

    def samples(self, frame: bytes, settings: Settings) -> NDArray[np.generic]:
        """Shape (beams, bins)."""
        beams = int(settings[3])
        return np.frombuffer(frame, np.uint8, offset=self.head_bytes).reshape(-1, beams).T

    def _flags(self, stated: int) -> int:
        if self._serial < FIRST_EXTENDED_SERIAL:
            return CLASSIC | (LONG_RANGE if self._serial == LONG_RANGE_SERIAL else 0)
        return stated & (CLASSIC | LONG_RANGE) if self._version == 3 else 0

    def _signature(self, source: ByteSource) -> bytes:
        """What stands where a frame's header has its version: usually that of the file, in any case always the same."""
        usual = MAGIC + bytes([self._version])
        first_frames = source.read(len(usual), self.first_at + 2 * (self.head_bytes + self._beams * self._samples))
        return usual if usual in first_frames else source.read(self.first_at + self.signature_at, len(usual))


def _version(source: ByteSource) -> int:
    start = source.read(0, len(MAGIC) + 1)
    if start[: len(MAGIC)] != MAGIC:
        raise DatasetError(f"{source.path}: begins with {start!r}; a DIDSON recording begins with {MAGIC!r}")
    version = start[-1] if len(start) > len(MAGIC) else 0
    if version not in HEADER_BYTES:
        advice = "use `convert aris`" if version == 5 else "versions 3 and 4 are read"
        raise DatasetError(f"{source.path}: is of DDF version {version}; {advice}")
    return version


def _clock_ns(content: bytes, number: int) -> int:
    year, month, day, hour, minute, second, hundredths = struct.unpack_from("<7i", content, _TIME_AT)
    if not 1990 <= year <= LAST_YEAR or not 0 <= hundredths < 100:
        raise DamagedFrameError(f"frame {number} of the year {year}, with {hundredths} hundredths of a second")
    try:
        moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except (ValueError, OverflowError) as error:
        raise DamagedFrameError(f"frame {number} with a time that does not exist: {error}") from error
    return round(moment.timestamp()) * 10**9 + hundredths * 10**7
