"""What recordings of imaging sonars have in common, whoever made them: frames one after another, without checksums.

From frame to frame through a sonar's file, believing none that its neighbours contradict.

The formats have no checksums. What can be checked is checked: a frame is whole when its header makes sense and another
sensible header, or the end of the file, follows where it should; a frame has a damaged header whose settings are those
of none of its neighbours (some sonars alternate between two), or whose time is not between theirs. What cannot be told:
samples that were overwritten in place, and bytes that are missing or too many by exactly the length of frames.

A sonar's recording as an MCAP log of sonar images, a few frames at a time.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration
from sonar_graph.errors import DatasetError
from sonar_graph.logs.mcap import RecordingWriter, recording
from sonar_graph.logs.vehicle_setup import METADATA
from sonar_graph.logs.writing import sonar_image_messages
from sonar_graph.measurements import Floats, SonarFrames

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


_NEIGHBOURS = 4
"""On either side, with which a frame's settings are compared."""
_DRIFT = 1e-3
"""Relative change of a setting given as a float (speed of sound) between neighbours that is none."""
_ODD_GAP = 10
"""How many times longer the first and last interval may be than the one beside it, before its time counts as damaged,
with ..."""
_ODD_GAP_NS = 1_000_000_000
"""... this much to spare."""


def frames_and_losses(source: ByteSource, kind: SonarFormat) -> Iterator[FrameHead | Lost]:
    """Headers of all frames that can be believed, in the order of the file, and what is lost between."""
    accepted: deque[FrameHead] = deque(maxlen=_NEIGHBOURS)
    waiting: deque[FrameHead] = deque()
    for found in _whole(source, kind):
        if isinstance(found, Lost):
            yield found
            continue
        waiting.append(found)
        if len(waiting) > _NEIGHBOURS:
            yield _judged(accepted, waiting, kind.clock_period_ns)
    while waiting:
        yield _judged(accepted, waiting, kind.clock_period_ns)


def _judged(accepted: deque[FrameHead], waiting: deque[FrameHead], period_ns: int | None) -> FrameHead | Lost:
    """The first that waits: believed, or lost."""
    head = waiting.popleft()
    fault = _fault(accepted, head, waiting, period_ns)
    if fault:
        return Lost(head.at, head.end, f"frame {head.number}: {fault}")
    accepted.append(head)
    return head


def first_sound(source: ByteSource, kind: SonarFormat) -> FrameHead | None:
    """The first header with an image that makes sense, wherever it is; None: there is none."""
    head = _next_sound(source, kind, 0)
    while head is not None and not head.has_image:
        head = _next_sound(source, kind, head.at + 1)
    return head


def _whole(source: ByteSource, kind: SonarFormat) -> Iterator[FrameHead | Lost]:
    """Frames after which the file goes on as it should, with their neighbours not yet compared."""
    at, pending = kind.first_at, None
    while at < source.size:
        try:
            head = _head(source, kind, at)
        except DamagedFrameError as error:
            found = _next_sound(source, kind, _search_start(kind, pending, at), but_not=at)
            is_shifted = pending is not None and _is_shifted(source, kind, pending, found)
            yield from _around_damage(pending, at, found.at if found else source.size, str(error), is_shifted)
            pending, at = None, found.at if found else source.size
            continue
        if pending and pending.has_image:
            yield pending
        pending, at = head, head.end
    if pending and pending.end > source.size:
        have = source.size - pending.at
        yield Lost(
            pending.at, source.size, f"frame {pending.number}: cut off, {have} of {pending.size} bytes are there"
        )
    elif pending and pending.has_image:
        yield pending


def _search_start(kind: SonarFormat, pending: FrameHead | None, at: int) -> int:
    """Within the frame before, from which bytes may be missing, or within the file's header, from which too."""
    if pending:
        return pending.at + 1
    return 0 if at == kind.first_at else at + 1


def _head(source: ByteSource, kind: SonarFormat, at: int) -> FrameHead:
    head = kind.head(source.read(at, kind.head_bytes), at)
    if head.end > source.size and _next_sound(source, kind, at + 1):
        raise DamagedFrameError(f"frame {head.number} claims to be longer than the file, in which others follow")
    return head


def _is_shifted(source: ByteSource, kind: SonarFormat, pending: FrameHead, found: FrameHead | None) -> bool:
    """Whether bytes may be missing from the frame before a bad header, or too many be in it."""
    if found is not None:
        return (found.at - pending.end) % pending.size != 0
    rest = source.size - pending.end
    if rest < kind.head_bytes and kind.may_follow(source.read(pending.end, rest), pending):
        return False
    return rest % pending.size != 0


def _around_damage(
    pending: FrameHead | None, at: int, end: int, reason: str, is_shifted: bool
) -> Iterator[FrameHead | Lost]:
    """What becomes of the frame before a bad header at ``at``, and of all up to the next good one or the end."""
    if pending and is_shifted:
        yield Lost(pending.at, end, f"frame {pending.number} and what follows: bytes are missing or too many")
        return
    if pending and pending.has_image:
        yield pending
    yield Lost(at, end, reason) if end > at else Lost(0, end, f"the file's header is {at - end} bytes too short")


def _next_sound(source: ByteSource, kind: SonarFormat, start: int, but_not: int = -1) -> FrameHead | None:
    """The first header from ``start`` on that makes sense, one place left out."""
    for at in source.places(kind.signature, start + kind.signature_at):
        begin = at - kind.signature_at
        try:
            if begin != but_not:
                return kind.head(source.read(begin, kind.head_bytes), begin)
        except DamagedFrameError:
            continue  # the signature's bytes by chance
    return None


def _fault(
    accepted: Sequence[FrameHead], judged: FrameHead, waiting: Sequence[FrameHead], period_ns: int | None
) -> str | None:
    """Why a frame's header is not believed; None: it is."""
    if accepted and (accepted[-1].number, accepted[-1].clock_ns) == (judged.number, judged.clock_ns):
        return f"a repetition of the frame at byte {accepted[-1].at}"
    if _is_odd(judged, [*accepted, *waiting]):
        return "its settings are those of no frame beside it"
    if accepted and waiting:
        is_right = _is_between(accepted[-1], judged, waiting[0], period_ns)
    elif len(waiting) > 1:
        is_right = _is_near(_elapsed(judged, waiting[0], period_ns), _elapsed(waiting[0], waiting[1], period_ns))
    elif len(accepted) > 1:
        is_right = _is_near(_elapsed(accepted[-1], judged, period_ns), _elapsed(accepted[-2], accepted[-1], period_ns))
    else:
        return None
    return None if is_right else "its time does not fit those of the frames beside it"


def _is_odd(judged: FrameHead, others: list[FrameHead]) -> bool:
    """Whether no other has its settings although some agree among themselves."""
    if any(_agree(judged, other) for other in others):
        return False
    return any(_agree(one, other) for one, other in combinations(others, 2))


def _is_near(gap_ns: int, usual_ns: int) -> bool:
    """Whether the first or last interval can be one, given the one beside it; where that runs back, nobody knows."""
    return usual_ns < 0 or 0 <= gap_ns <= _ODD_GAP * usual_ns + _ODD_GAP_NS


def _agree(one: FrameHead, other: FrameHead) -> bool:
    return all(
        abs(a - b) <= _DRIFT * abs(b) if isinstance(a, float) and isinstance(b, float) else a == b
        for a, b in zip(one.settings, other.settings, strict=True)
    )


def _is_between(earlier: FrameHead, judged: FrameHead, later: FrameHead, period_ns: int | None) -> bool:
    """Whether time runs on; where it runs back over both steps, the clock was set and nothing can be said."""
    before, after = _elapsed(earlier, judged, period_ns), _elapsed(judged, later, period_ns)
    total = _elapsed(earlier, later, period_ns)
    return total < 0 or (before >= 0 and after >= 0 and before + after == total)


def _elapsed(one: FrameHead, other: FrameHead, period_ns: int | None) -> int:
    difference = other.clock_ns - one.clock_ns
    return difference if period_ns is None else difference % period_ns


TOPIC = "/sonar/image"
_BLOCK_BYTES_sonar_conversion = 1 << 22
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
            full = (len(block) + 1) * head.size > _BLOCK_BYTES_sonar_conversion
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
