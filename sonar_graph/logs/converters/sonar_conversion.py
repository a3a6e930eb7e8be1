"""A sonar's recording as an MCAP log of sonar images, a few frames at a time."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sonar_graph.errors import DatasetError
from sonar_graph.logs.converters.frame_walk import frames_and_losses
from sonar_graph.logs.converters.sonar_file import ByteSource, FrameHead, Lost, SonarFormat
from sonar_graph.logs.log_record import METADATA
from sonar_graph.logs.recorder import RecordingWriter, recording
from sonar_graph.logs.sonar_encoding import sonar_image_messages
from sonar_graph.measurements import SonarFrames

TOPIC = "/sonar/image"
_BLOCK_BYTES = 1 << 22
_MOST_MISSING = 100_000
"""More numbers than this are not missing: counting began anew."""

Progress = Callable[[int, int], None]
"""Called with the bytes done and the bytes in all."""
Block = list[tuple[FrameHead, int]]
"""Frames with the same settings, and their stamps in nanoseconds."""


@dataclass
class SonarConversion:
    """What became of a sonar's recording."""

    frames: int = 0
    first_ns: int = 0
    last_ns: int = 0
    lost: list[Lost] = field(default_factory=list)
    """What could not be read."""
    missing: int = 0
    """Numbers that no frame has: those lost, and those that were never recorded."""
    promised: int = 0
    """Number of frames by the file's header; 0: it does not say."""
    readings: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Lowest and highest value of what other sensors said in the frames' headers."""

    @property
    def duration_s(self) -> float:
        """From the first frame to the last."""
        return (self.last_ns - self.first_ns) * 1e-9

    def shortcomings(self, most: int | None = None) -> list[str]:
        """What is lost or missing, in lines; of many losses only the first ``most``."""
        lines = [f"lost: {loss}" for loss in self.lost[:most]]
        if len(self.lost) > len(lines):
            lines.append(f"lost: and {len(self.lost) - len(lines)} stretches more; all are in the log's notes")
        if self.missing:
            lines.append(f"missing: the numbers of {self.missing} frames between the first and the last")
        if self.promised > self.frames:
            lines.append(
                f"missing: {self.promised - self.frames} of {self.promised} frames that the file's header names"
            )
        return lines


def convert_sonar_file(
    source: ByteSource, kind: SonarFormat, output: Path, progress: Progress | None = None
) -> SonarConversion:
    """Write all frames that are whole to an MCAP log; memory holds a few of them at a time.

    Raises
    ------
    DatasetError
        When no frame is whole.
    LogError
        When the log cannot be written.
    """
    conversion = SonarConversion(promised=kind.frames_promised)
    record = {"name": source.path.stem, "calibration": kind.calibration.model_dump_json()}
    with recording(output, {METADATA: record | {"notes": json.dumps(dict(kind.notes))}}) as out:
        for block in _blocks(_stamped(frames_and_losses(source, kind), kind.clock_period_ns, conversion)):
            _write(out, source, kind, block)
            if progress:
                progress(block[-1][0].end, source.size)
        if not conversion.frames:
            first = f": {conversion.lost[0]}" if conversion.lost else ""
            raise DatasetError(f"{source.path}: holds no whole frame{first}; is it a recording of this sonar?")
        notes = dict(kind.notes) | _notes(conversion)
        out.add_metadata(METADATA, record | {"notes": json.dumps(notes)})  # the later of two records counts
    return conversion


def _stamped(
    found: Iterator[FrameHead | Lost], period_ns: int | None, conversion: SonarConversion
) -> Iterator[tuple[FrameHead, int]]:
    """Frames with their stamps, a clock that wraps around being continued; the rest goes to the conversion."""
    earlier: FrameHead | None = None
    stamp_ns = 0
    for head in found:
        if isinstance(head, Lost):
            conversion.lost.append(head)
            continue
        jump = head.number - earlier.number - 1 if earlier else 0
        conversion.missing += jump if 0 < jump < _MOST_MISSING else 0
        step_ns = head.clock_ns - (earlier.clock_ns if earlier else 0)
        stamp_ns += step_ns if period_ns is None else step_ns % period_ns
        conversion.first_ns = conversion.first_ns if conversion.frames else stamp_ns
        conversion.last_ns = stamp_ns
        conversion.frames += 1
        _add_readings(conversion.readings, head.readings)
        earlier = head
        yield head, stamp_ns


def _add_readings(extremes: dict[str, tuple[float, float]], readings: Mapping[str, float]) -> None:
    for name, value in readings.items():
        if np.isfinite(value):
            low, high = extremes.get(name, (value, value))
            extremes[name] = min(low, value), max(high, value)


def _blocks(frames: Iterator[tuple[FrameHead, int]]) -> Iterator[Block]:
    """Runs of frames with the same settings and time running on, of a size that is handled at once."""
    block: Block = []
    for head, stamp_ns in frames:
        if block:
            last, last_ns = block[-1]
            full = (len(block) + 1) * head.size > _BLOCK_BYTES
            if full or last.settings != head.settings or last.size != head.size or stamp_ns < last_ns:
                yield block
                block = []
        block.append((head, stamp_ns))
    if block:
        yield block


def _write(out: RecordingWriter, source: ByteSource, kind: SonarFormat, block: Block) -> None:
    heads, stamps_ns = zip(*block, strict=True)
    geometry = kind.geometry(heads[0].settings)
    images = np.stack([kind.samples(source.read(head.at, head.size), head.settings) for head in heads])
    frames = SonarFrames(np.array(stamps_ns), images, geometry.ranges_m, geometry.azimuths_rad)
    message = sonar_image_messages(
        TOPIC, frames, frequency_hz=geometry.frequency_hz, sound_speed_m_s=geometry.sound_speed_m_s
    )
    out.write([message])


def _notes(conversion: SonarConversion) -> dict[str, str]:
    notes = {
        f"sonar.{name}": f"{low:g} to {high:g}" for name, (low, high) in conversion.readings.items() if low or high
    }
    shortcomings = conversion.shortcomings()
    return notes | ({"sonar.shortcomings": "; ".join(shortcomings)} if shortcomings else {})
