"""Recordings of Blueprint Subsea's Oculus sonars: the network messages of the sonar, one after another.

A message is a header of 16 bytes with the size of what follows. Ping results, in two layouts by the header's version,
hold the settings, the bearing of each beam in hundredths of a degree, and the image: all beams of the first range
first. See ``docs/theory/sonar_files.md``.

Source: liboculus and oculus_driver (both BSD-3), which quote the manufacturer's description.
"""

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import SonarImage
from sonar_graph.errors import DatasetError
from sonar_graph.logs.adapters import samples_of_rows
from sonar_graph.logs.convert.sonar_file import (
    ByteSource,
    DamagedFrameError,
    FrameGeometry,
    FrameHead,
    Settings,
    SonarConversion,
    SonarFormat,
    convert_sonar_file,
    plausible_headers,
    refuse_header,
)
from sonar_graph.logs.mcap import Progress
from sonar_graph.measurements import Floats

SIGNATURE = struct.pack("<H", 0x4F53)
HEADER = struct.Struct("<HHHHHIH")
"""Signature, source, destination, kind, version, bytes that follow, spare."""
PING = 0x23
OTHERS = {0x15, 0x55, 0xFF}
"""Kinds of messages without an image: fire, user configuration, dummy."""
MOST_OTHER_BYTES = 1 << 16
MOST_BEAMS = 1024
MOST_BEARING = 9000
CLOCK_PERIOD_NS = 1 << 32
"""Period of the older pings' 32-bit clock. Its unit is not documented: in nanoseconds, the sample has 16 pings a
second; in microseconds it would have one a minute."""
FIRE = struct.Struct("<5B4d")
"""Mode, rate, network speed, gamma, flags; range, gain, speed of sound, salinity."""
RESULTS = {
    **dict.fromkeys((0, 1), struct.Struct("<2I4dIBd2H3I")),
    2: struct.Struct("<2I8dBd2H4I3I"),
}
RESULT_AT = {0: 53, 1: 53, 2: 89}
"""Offset and fields of the result by version: number, status, frequency, temperature, pressure, (heading, pitch, roll),
speed of sound, time, bytes a sample - 1, bin, ranges, beams, (spare), offset and size of the image, size of all."""
NO_GAMMA = (0, 255)
"""Codes for no gamma; others are 255ths."""
HAS_GAINS = 0b100
GAIN_BYTES = 4


def convert_oculus(
    path: Path, output: Path, progress: Progress | None = None
) -> SonarConversion:
    """Write an MCAP log with all whole pings of a recording.

    Raises
    ------
    DatasetError
        When it is no such recording, or has no whole ping.
    LogError
        When the log cannot be written.
    """
    return convert_sonar_file(path, OculusFormat, output, progress)


class OculusFormat(SonarFormat):
    """Headers, samples and geometry of a recording of network messages."""

    first_at = 0
    head_bytes = RESULT_AT[2] + RESULTS[2].size + 2 * MOST_BEAMS
    signature = SIGNATURE
    signature_at = 0

    def __init__(self, source: ByteSource) -> None:
        first = next(
            (head for head in plausible_headers(source, self, 0) if head.has_image),
            None,
        )
        if first is None:
            raise DatasetError(
                f"{source.path}: holds no Oculus ping; give the sonar's network messages as recorded"
            )
        wraps = first.settings[0] != 2
        self.clock_period_ns = CLOCK_PERIOD_NS if wraps else None
        sample_bytes = int(first.settings[4])
        code = int(first.settings[2])
        gamma = 1.0 if code in NO_GAMMA else code / 255
        self.image = SonarImage(
            scale="linear", full_scale=2 ** (8 * sample_bytes) - 1, gamma=gamma
        )
        clock = ""
        if wraps:
            clock = ", a 32-bit number taken as nanoseconds and continued where it wraps around"
        self.notes = {
            "source": f"Oculus recording {source.path.name}",
            "sonar.time": f"since the sonar was switched on, not since 1970{clock}",
            "sonar.beams": "bearings of the pings",
            "sonar.scale": f"counts are the amplitude to the power of {gamma:.3g}, the gamma of the first ping",
        }

    def head(self, content: bytes, at: int) -> FrameHead:
        """Header of a message."""
        if len(content) < HEADER.size:
            raise DamagedFrameError(
                f"a message cut off, {len(content)} bytes of its header are there"
            )
        signature, _, _, kind, version, payload, _ = HEADER.unpack_from(content)
        if struct.pack("<H", signature) != SIGNATURE:
            raise DamagedFrameError("no message begins here")
        # between the pings, and without a time of their own
        if kind in OTHERS and payload <= MOST_OTHER_BYTES:
            return FrameHead(at, HEADER.size + payload, 0, 0, (), has_image=False)
        if kind != PING or version not in RESULTS:
            raise DamagedFrameError(f"a message of kind {kind:#x}, version {version}")
        total = HEADER.size + payload
        start = RESULT_AT[version]
        layout = RESULTS[version]
        if len(content) < start + layout.size:
            raise DamagedFrameError(
                f"a ping cut off, {len(content)} of {total} bytes are there"
            )
        mode, _, _, gamma, flags, *_ = FIRE.unpack_from(content, HEADER.size)
        number, _, frequency_hz, *others = layout.unpack_from(content, start)
        # the speed of sound follows temperature and pressure, in version 2 also an attitude
        at_sound_speed = 5 if version == 2 else 2
        sound_speed, clock, size_code, bin_m, ranges, beams, *_ = others[
            at_sound_speed:
        ]
        offset, image_bytes, message_bytes = others[-3:]
        size = size_code + 1
        bearings_at = start + layout.size
        bearings = content[bearings_at : bearings_at + 2 * beams]
        row_gain = GAIN_BYTES if flags & HAS_GAINS else 0
        if len(content) < min(total, bearings_at + 2 * beams):
            raise DamagedFrameError(
                f"ping {number} cut off, {len(content)} of {total} bytes are there"
            )
        whole = bearings[: len(bearings) // 2 * 2]
        # wider integers: differences of two of 16 bits overflow
        hundredths = np.frombuffer(whole, "<i2").astype(np.int64)
        are_wide = np.abs(hundredths).max(initial=0) > MOST_BEARING
        increase = bool(np.all(np.diff(hundredths) > 0)) and not are_wide
        faults = {
            f"{size} bytes a sample": size not in (1, 2, 4),
            f"{beams} beams": not 0 < beams <= MOST_BEAMS,
            f"{ranges} ranges": ranges == 0,
            f"an image of {image_bytes} bytes": image_bytes
            != ranges * (beams * size + row_gain),
            f"a message of {message_bytes} bytes": message_bytes != total
            or offset + image_bytes > total,
            f"an image from byte {offset}": offset < bearings_at + 2 * beams,
            "bearings that do not increase": len(bearings) < 2 * beams or not increase,
            f"bins of {bin_m:g} m": not 1e-5 <= bin_m <= 1.0,
            f"a sound speed of {sound_speed:g} m/s": not 1300 <= sound_speed <= 1700,
            f"a time of {clock:g}": not 0 <= clock < 1 << 32,
        }
        refuse_header("a ping", faults)
        layout_of_image = version, mode, gamma, flags, size, offset, ranges, beams
        # bearings as bytes: frames of one fan compare equal at once
        settings = (*layout_of_image, bin_m, sound_speed, frequency_hz, bearings)
        clock_ns = round(clock * 1e9) if version == 2 else clock
        return FrameHead(at, total, number, clock_ns, settings)

    def may_follow(self, content: bytes, earlier: FrameHead) -> bool:  # noqa: ARG002
        """True where some bytes can begin the message after."""
        return SIGNATURE.startswith(content[: len(SIGNATURE)])

    def geometry(self, settings: Settings) -> FrameGeometry:
        """Bins from the sonar on, and azimuths from the bearings, which are positive to the right."""
        *_, ranges, _, bin_m, sound_speed, frequency_hz, bearings = settings
        middles_m = (np.arange(int(ranges), dtype=float) + 0.5) * float(bin_m)
        right_rad: Floats = np.radians(np.frombuffer(bytes(bearings), "<i2") / 100)  # type: ignore[arg-type]
        return FrameGeometry(
            middles_m, -right_rad, float(frequency_hz), float(sound_speed)
        )

    def samples(self, frame: bytes, settings: Settings) -> NDArray[np.generic]:
        """Image, shape (beams, bins); rows with a gain are divided by its root, as in `read_sonar_frames`."""
        _, _, _, flags, size, offset, ranges, beams, *_ = map(int, settings[:8])
        row_gain = GAIN_BYTES if flags & HAS_GAINS else 0
        row_bytes = row_gain + beams * size
        rows = np.frombuffer(frame, np.uint8, ranges * row_bytes, offset)
        rows = rows.reshape(ranges, row_bytes)
        return samples_of_rows(rows, np.dtype(f"<u{size}"), has_gains=bool(row_gain)).T
