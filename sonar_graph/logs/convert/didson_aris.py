"""DIDSON (``.ddf``) and ARIS (``.aris``) recordings of Sound Metrics' lens sonars: DDF versions 3, 4 and 5.

A file is a header and frames: a header each, then one byte a sample, all beams of the first range first. An ARIS states
delay and sample period of a frame; its bins begin ``delay c / 2`` away and are ``period c / 2`` long. A DIDSON states
codes of the window of ranges: it begins at a multiple of 0.42 m ("extended") or 0.375 m ("classic"), twice that at low
frequency, and its length is in a table. These metres hold for the nominal speed of sound, see
``docs/theory/sonar_files.md``.

Sources: SoundMetrics/aris-file-sdk (MIT) for ARIS; for facts on DIDSON oncvideo (MIT), ARISreader, pyDIDSON and
Echoview's description of the format. No file of a real DIDSON was at hand.
"""

import struct
from abc import abstractmethod
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import SonarImage
from sonar_graph.devices import aris_azimuths, didson_azimuths, even_azimuths
from sonar_graph.errors import DatasetError
from sonar_graph.logs.convert.sonar_file import (
    ByteSource,
    DamagedFrameError,
    FrameGeometry,
    FrameHead,
    Settings,
    SonarConversion,
    SonarFormat,
    convert_sonar_file,
    refuse_header,
)
from sonar_graph.logs.mcap import Progress

MAGIC = b"DDF"


def convert_didson(
    path: Path,
    output: Path,
    progress: Progress | None = None,
    *,
    sound_speed_m_s: float | None = None,
) -> SonarConversion:
    """Write an MCAP log with all whole frames of a ``.ddf`` file.

    Parameters
    ----------
    path, output
        The recording and the log.
    progress
        Called with the bytes done and the bytes in all.
    sound_speed_m_s
        Speed of sound in the water, by which ranges are scaled; None: the nominal 1465 m/s of the window codes.

    Raises
    ------
    DatasetError
        When it is no such file, its header is damaged, or it has no whole frame.
    LogError
        When the log cannot be written.
    """
    open_format = partial(DidsonFormat, sound_speed_m_s=sound_speed_m_s)
    return convert_sonar_file(path, open_format, output, progress)


def convert_aris(
    path: Path, output: Path, progress: Progress | None = None
) -> SonarConversion:
    """Write an MCAP log with all whole frames of an ``.aris`` file.

    Raises
    ------
    DatasetError
        When it is no such file, or has no whole frame.
    LogError
        When the log cannot be written.
    """
    return convert_sonar_file(path, ArisFormat, output, progress)


class LensSonarFormat(SonarFormat):
    """Frames with a number in the first four bytes of their header, and a signature at byte 12."""

    signature_at = 12

    def head(self, content: bytes, at: int) -> FrameHead:
        """Header of a frame."""
        if len(content) < self.head_bytes:
            raise DamagedFrameError(
                f"a frame cut off, {len(content)} bytes of its header are there"
            )
        if content[self.signature_at : self.signature_at + 4] != self.signature:
            raise DamagedFrameError("no frame begins here")
        (number,) = struct.unpack_from("<I", content, 0)
        clock_ns, settings = self.fields(content, number)
        size = self.head_bytes + int(settings[0]) * int(settings[1])
        return FrameHead(at, size, number, clock_ns, settings)

    @abstractmethod
    def fields(self, content: bytes, number: int) -> tuple[int, Settings]:
        """Time by the sonar's clock in nanoseconds, and settings of a frame: beams, samples a beam, and others."""

    def may_follow(self, content: bytes, earlier: FrameHead) -> bool:
        """True where some bytes can begin the frame after, by its number and signature."""
        # the bytes may end before the signature, or within it
        signed = content[self.signature_at :]
        is_next = (earlier.number + 1).to_bytes(4, "little").startswith(content[:4])
        return is_next and self.signature.startswith(signed[: len(self.signature)])

    def samples(self, frame: bytes, settings: Settings) -> NDArray[np.generic]:
        """Image of a frame, shape (beams, bins)."""
        rows = np.frombuffer(frame, np.uint8, offset=self.head_bytes)
        return rows.reshape(-1, int(settings[0])).T


HEADER_BYTES = {3: (512, 256), 4: (1024, 1024)}
"""Bytes of the file's and of a frame's header, by version."""
BEAMS = (48, 96)
MOST_SAMPLES = 4096
DIDSON_DECIBEL_SPAN = 90.0
"""By Echoview's description of the format."""
LAST_YEAR = 2037
"""Last year whose stamps ROS 2 can hold."""
NOMINAL_SOUND_SPEED_M_S = 1465.0
HIGH_FREQUENCY_HZ = 1.8e6
LOW_FREQUENCY_HZ = 1.1e6
CLASSIC = 1
LONG_RANGE = 2
"""Bits of a frame's configuration flags."""
START_STEP_M = {0: 0.42, CLASSIC: 0.375}
SHORTEST_M = {0: 1.25, CLASSIC: 1.125}
LENGTH_CODES = 6
"""The length of the window doubles with each code, and with the bit of the long range."""
LOW_FREQUENCY_SHIFT = 2
"""Low frequency begins with the third length."""
FIRST_EXTENDED_SERIAL = 19
LONG_RANGE_SERIAL = 15
"""Sonars of earlier serial numbers are classic whatever their flags, and one of them has a long range."""


class DidsonFormat(LensSonarFormat):
    """Headers, samples and geometry of a ``.ddf`` file."""

    def __init__(
        self, source: ByteSource, sound_speed_m_s: float | None = None
    ) -> None:
        start = source.read(0, len(MAGIC) + 1)
        if start[: len(MAGIC)] != MAGIC:
            raise DatasetError(
                f"{source.path}: begins with {start!r}; a DIDSON recording begins with {MAGIC!r}"
            )
        self._version = start[-1] if len(start) > len(MAGIC) else 0
        if self._version not in HEADER_BYTES:
            advice = "versions 3 and 4 are read"
            if self._version == 5:
                advice = "use `convert aris`"
            raise DatasetError(
                f"{source.path}: is of DDF version {self._version}; {advice}"
            )
        self.first_at, self.head_bytes = HEADER_BYTES[self._version]
        header = source.read(0, self.first_at)
        if len(header) < self.first_at:
            raise DatasetError(
                f"{source.path}: ends within its header of {self.first_at} bytes"
            )
        self.frames_promised, _, resolution, self._beams, _, self._samples = (
            struct.unpack_from("<4ifi", header, 4)
        )
        self._reverse, self._serial = struct.unpack_from("<2i", header, 40)
        is_plausible = self._beams in BEAMS and resolution in (0, 1)
        if not is_plausible or not 0 < self._samples <= MOST_SAMPLES:
            raise DatasetError(
                f"{source.path}: its header is damaged: it says {self._beams} beams, {self._samples} samples, "
                f"resolution {resolution}; expected 48 or 96 beams, at most {MOST_SAMPLES} samples, resolution 0 or 1"
            )
        self._is_high = resolution == 1
        self._sound_speed_m_s = sound_speed_m_s or NOMINAL_SOUND_SPEED_M_S
        # frames usually repeat the file's version in their headers, and otherwise all have the same bytes there
        usual = MAGIC + bytes([self._version])
        frame_bytes = self.head_bytes + self._beams * self._samples
        self.signature = usual
        if usual not in source.read(len(usual), self.first_at + 2 * frame_bytes):
            in_first_frame = self.first_at + self.signature_at
            self.signature = source.read(in_first_frame, len(usual))
        self.image = SonarImage(scale="decibel", decibel_span=DIDSON_DECIBEL_SPAN)
        self.notes = {
            "source": f"DIDSON recording {source.path.name}, DDF version {self._version}",
            "sonar.time": "the sonar's own calendar time, to hundredths of a second, taken as UTC",
            "sonar.beams": "the manufacturer's polynomial for the lens",
            "sonar.ranges": f"from window codes, for a sound speed of {self._sound_speed_m_s:g} m/s",
            "sonar.scale": f"counts 0 to 255 are 0 to {DIDSON_DECIBEL_SPAN:g} dB "
            "(Echoview's description of the format)",
        }

    def fields(self, content: bytes, number: int) -> tuple[int, Settings]:
        """Time and settings: beams, samples, window codes, flags."""
        start, length = struct.unpack_from("<2i", content, 52)
        (flags,) = struct.unpack_from("<I", content, 192)
        if self._serial < FIRST_EXTENDED_SERIAL:
            flags = CLASSIC
            if self._serial == LONG_RANGE_SERIAL:
                flags |= LONG_RANGE
        elif self._version == 3:
            # the other bits are of the sonar's state
            flags &= CLASSIC | LONG_RANGE
        else:
            flags = 0
        shift = 0 if self._is_high else LOW_FREQUENCY_SHIFT
        if not 0 <= start <= 31 or not 0 <= length < LENGTH_CODES - shift:
            raise DamagedFrameError(
                f"frame {number} with window codes {start} and {length}"
            )
        year, month, day, hour, minute, second, hundredths = struct.unpack_from(
            "<7i", content, 20
        )
        if not 1990 <= year <= LAST_YEAR or not 0 <= hundredths < 100:
            raise DamagedFrameError(
                f"frame {number} of the year {year}, with {hundredths} hundredths of a second"
            )
        try:
            moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        except (ValueError, OverflowError) as error:
            raise DamagedFrameError(
                f"frame {number} with a time that does not exist: {error}"
            ) from error
        clock_ns = round(moment.timestamp()) * 10**9 + hundredths * 10**7
        return clock_ns, (self._beams, self._samples, start, length, flags)

    def geometry(self, settings: Settings) -> FrameGeometry:
        """Bins that divide the window evenly."""
        beams, samples, start, length, flags = map(int, settings)
        step_m = START_STEP_M[flags & CLASSIC]
        frequency_hz = HIGH_FREQUENCY_HZ
        if not self._is_high:
            # at low frequency windows begin in double steps, and the two shortest lengths are missing
            step_m *= 2
            length += LOW_FREQUENCY_SHIFT
            frequency_hz = LOW_FREQUENCY_HZ
        # the sonar measures times: its metres hold for the nominal speed of sound
        scale = self._sound_speed_m_s / NOMINAL_SOUND_SPEED_M_S
        doublings = length + bool(flags & LONG_RANGE)
        bin_m = SHORTEST_M[flags & CLASSIC] * 2**doublings * scale / samples
        middles = np.arange(samples, dtype=float) + 0.5
        ranges_m = start * step_m * scale + middles * bin_m
        azimuths_rad = didson_azimuths(beams)[:: -1 if self._reverse else 1]
        return FrameGeometry(
            ranges_m, azimuths_rad, frequency_hz, self._sound_speed_m_s
        )


BEAMS_OF_PING_MODE = dict(enumerate([48] * 2 + [96] * 3 + [64] * 3 + [128] * 4, 1))
HALF_ANGLES_DEG = (14.0, 7.0)
"""Half the field of view without and with the telephoto lens, for numbers of beams without a table."""
FREQUENCIES_HZ = {0: (1.1e6, 1.8e6), 1: (1.8e6, 3.0e6), 2: (0.7e6, 1.2e6)}
"""Low and high frequency by system type: ARIS 1800, 3000, 1200."""
SOUND_SPEEDS_M_S = (1350.0, 1650.0)
"""Limits of the speed of sound in an undamaged header."""
ARIS_DECIBEL_SPAN = 80.0
_US = 1e-6
LAST_US = 2**31 * 10**6 - 1
"""Last time that stamps of ROS 2 can hold, with 31 bits for seconds since 1970."""


class ArisFormat(LensSonarFormat):
    """Headers, samples and geometry of an ``.aris`` file; all of them are in the headers of the frames."""

    first_at = head_bytes = 1024
    signature = b"DDF\x05"

    def __init__(self, source: ByteSource) -> None:
        start = source.read(0, len(self.signature))
        # a damaged file header is no reason to refuse: all settings are in the frames
        in_first_frame = source.read(
            self.first_at + self.signature_at, len(self.signature)
        )
        if self.signature not in (start, in_first_frame):
            expected = f"an ARIS recording begins with {self.signature!r}"
            raise DatasetError(f"{source.path}: begins with {start!r}; {expected}")
        (self.frames_promised,) = struct.unpack("<I", source.read(4, 4).ljust(4, b"\0"))
        self.image = SonarImage(scale="decibel", decibel_span=ARIS_DECIBEL_SPAN)
        self.notes = {
            "source": f"ARIS recording {source.path.name}",
            "sonar.time": "the sonar's own clock, microseconds since 1970",
            "sonar.beams": "the manufacturer's table for lens and number of beams, evenly spaced where there is none",
            "sonar.scale": f"counts 0 to 255 are 0 to {ARIS_DECIBEL_SPAN:g} dB",
        }

    def fields(self, content: bytes, number: int) -> tuple[int, Settings]:
        """Time and settings.

        These are beams, samples, ping mode, high frequency, sample period (µs), sound speed, start delay (µs), lens, system.
        """
        (clock_us,) = struct.unpack_from("<Q", content, 20)
        mode, high, _, _, period_us, _, _, sound_speed, samples = struct.unpack_from(
            "<7IfI", content, 436
        )
        delay_us, lens, system = struct.unpack_from("<3I", content, 476)
        (in_order,) = struct.unpack_from("<I", content, 516)
        faults = {
            f"ping mode {mode}": mode not in BEAMS_OF_PING_MODE,
            f"frequency {high}": high not in (0, 1),
            f"system type {system}": system not in FREQUENCIES_HZ,
            f"lens {lens}": lens not in (0, 1),
            f"{samples} samples a beam": not 0 < samples <= 1 << 16,
            f"a sample period of {period_us} us": not 0 < period_us <= 1000,
            f"a start delay of {delay_us} us": delay_us > 1 << 20,
            f"a sound speed of {sound_speed:g} m/s": not SOUND_SPEEDS_M_S[0]
            <= sound_speed
            <= SOUND_SPEEDS_M_S[1],
            "samples that are not in order": in_order == 0,
        }
        refuse_header("a header", faults)
        if clock_us > LAST_US:
            raise DamagedFrameError(f"frame {number} with a time of {clock_us} us")
        beams = BEAMS_OF_PING_MODE[mode]
        way = period_us, float(sound_speed), delay_us
        return clock_us * 1000, (beams, samples, mode, high, *way, lens, system)

    def geometry(self, settings: Settings) -> FrameGeometry:
        """Bins by start delay, sample period and speed of sound."""
        _, _, _, _, period_us, sound_speed, delay_us, *_ = map(float, settings)
        beams, samples, _, high, *_, lens, system = map(int, settings)
        azimuths = aris_azimuths(beams, telephoto=bool(lens))
        if azimuths is None:
            # the manufacturer publishes no table for this lens and number of beams
            azimuths = even_azimuths(beams, HALF_ANGLES_DEG[lens])
        # half of the way of the sound, there and back
        middles_us = delay_us + (np.arange(samples, dtype=float) + 0.5) * period_us
        frequency_hz = FREQUENCIES_HZ[system][high]
        return FrameGeometry(
            middles_us * _US * sound_speed / 2, azimuths, frequency_hz, sound_speed
        )
