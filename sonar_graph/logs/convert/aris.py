"""ARIS recordings (``.aris``, DDF version 5) of Sound Metrics' lens sonars.

A file is a header of 1024 bytes and frames: a header of 1024 bytes, then one byte a sample, all beams of the first
range first and the right-most beam first. All that is needed is in the headers of the frames.

Source: SoundMetrics/aris-file-sdk (MIT): ``type-definitions``, ``docs/understanding-aris-data.md``.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration, SonarCalibration, SonarImage
from sonar_graph.devices import aris_azimuths, even_azimuths
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

SIGNATURE = b"DDF\x05"
HEADER_BYTES = 1024
BEAMS_OF_PING_MODE = {1: 48, 2: 48, 3: 96, 4: 96, 5: 96, 6: 64, 7: 64, 8: 64, 9: 128, 10: 128, 11: 128, 12: 128}
HALF_ANGLE_DEG, TELEPHOTO_HALF_ANGLE_DEG = 14.0, 7.0
"""For combinations of beams and lens without a table."""
FREQUENCIES_HZ = {0: (1.1e6, 1.8e6), 1: (1.8e6, 3.0e6), 2: (0.7e6, 1.2e6)}
"""Low and high, by system type: ARIS 1800, 3000, 1200."""
SOUND_SPEEDS_M_S = (1350.0, 1650.0)
"""Outside, a header is damaged."""
DECIBEL_SPAN = 80.0
_US = 1e-6
LAST_US = 2**31 * 10**6 - 1
"""Stamps of ROS 2 have 31 bits for seconds since 1970."""
_READINGS = {
    "depth": 128,
    "altitude": 132,
    "pitch": 136,
    "roll": 144,
    "heading": 152,
    "compass heading": 160,
    "compass pitch": 164,
    "compass roll": 168,
    "water temperature": 224,
    "pan": 244,
    "tilt": 248,
}


def convert_aris(path: Path, output: Path, progress: Progress | None = None) -> SonarConversion:
    """Write an MCAP log with all whole frames of an ``.aris`` file.

    Raises
    ------
    DatasetError
        When it is no such file, or has no whole frame.
    LogError
        When the log cannot be written.
    """
    with ByteSource(Path(path)) as source:
        return convert_sonar_file(source, ArisFormat(source), Path(output), progress)


class ArisFormat:
    """Headers, samples and geometry of an ``.aris`` file."""

    first_at = head_bytes = HEADER_BYTES
    signature, signature_at = SIGNATURE, 12
    clock_period_ns = None

    def __init__(self, source: ByteSource) -> None:
        start = source.read(0, len(SIGNATURE))
        in_first_frame = source.read(HEADER_BYTES + self.signature_at, len(SIGNATURE))
        if SIGNATURE not in (start, in_first_frame):
            raise DatasetError(f"{source.path}: begins with {start!r}; an ARIS recording begins with {SIGNATURE!r}")
        (self.frames_promised,) = struct.unpack("<I", source.read(4, 4).ljust(4, b"\0"))
        image = SonarImage(scale="decibel", decibel_span=DECIBEL_SPAN)
        self.calibration = Calibration(sonar=SonarCalibration(image=image))
        self.notes = {
            "source": f"ARIS recording {source.path.name}",
            "sonar.time": "the sonar's own clock, microseconds since 1970",
            "sonar.beams": "the manufacturer's table for lens and number of beams, evenly spaced where there is none",
            "sonar.scale": f"counts 0 to 255 are 0 to {DECIBEL_SPAN:g} dB",
        }

    def head(self, content: bytes, at: int) -> FrameHead:
        """The header of a frame."""
        if len(content) < HEADER_BYTES:
            raise DamagedFrameError(f"a frame cut off, {len(content)} bytes of its header are there")
        if content[self.signature_at : self.signature_at + 4] != SIGNATURE:
            raise DamagedFrameError("no frame begins here")
        (number,) = struct.unpack_from("<I", content, 0)
        (clock_us,) = struct.unpack_from("<Q", content, 20)
        settings = _settings(content)
        beams, samples = BEAMS_OF_PING_MODE[int(settings[0])], int(settings[4])
        if clock_us > LAST_US:
            raise DamagedFrameError(f"frame {number} with a time of {clock_us} us")
        readings = {name: float(struct.unpack_from("<f", content, where)[0]) for name, where in _READINGS.items()}
        return FrameHead(at, HEADER_BYTES + beams * samples, number, clock_us * 1000, settings, readings)

    def may_follow(self, content: bytes, earlier: FrameHead) -> bool:
        """Whether some bytes can begin the frame after."""
        return may_be_numbered_header(content, self.signature, self.signature_at, earlier.number + 1)

    def geometry(self, settings: Settings) -> FrameGeometry:
        """Bins begin ``delay c / 2`` away and are ``period c / 2`` long."""
        mode, high, period_us, sound_speed, samples, delay_us, lens, system = map(float, settings)
        beams, telephoto = BEAMS_OF_PING_MODE[int(mode)], bool(lens)
        azimuths = aris_azimuths(beams, telephoto=telephoto)
        if azimuths is None:
            azimuths = even_azimuths(beams, TELEPHOTO_HALF_ANGLE_DEG if telephoto else HALF_ANGLE_DEG)
        middles_us = delay_us + (np.arange(int(samples), dtype=float) + 0.5) * period_us
        frequency_hz = FREQUENCIES_HZ[int(system)][int(high)]
        return FrameGeometry(middles_us * _US * sound_speed / 2, azimuths, frequency_hz, sound_speed)

    def samples(self, frame: bytes, settings: Settings) -> NDArray[np.generic]:
        """Shape (beams, bins)."""
        beams = BEAMS_OF_PING_MODE[int(settings[0])]
        return np.frombuffer(frame, np.uint8, offset=HEADER_BYTES).reshape(-1, beams).T


def _settings(content: bytes) -> Settings:
    """Ping mode, high frequency, sample period (µs), sound speed, samples, start delay (µs), lens, system type."""
    mode, high, _, _, period_us, _, _, sound_speed, samples = struct.unpack_from("<7IfI", content, 436)
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
        f"a sound speed of {sound_speed:g} m/s": not SOUND_SPEEDS_M_S[0] <= sound_speed <= SOUND_SPEEDS_M_S[1],
        "samples that are not in order": in_order == 0,
    }
    if any(faults.values()):
        raise DamagedFrameError(f"a header with {', '.join(text for text, wrong in faults.items() if wrong)}")
    return mode, high, period_us, float(sound_speed), samples, delay_us, lens, system
