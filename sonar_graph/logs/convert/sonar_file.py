"""Recordings of imaging sonars, of whatever maker, as MCAP logs of sonar images.

The files are frames one after another, without checksums. A frame is whole when its header is plausible and another
plausible header, or the end of the file, follows at its end. A frame is damaged when its settings are those of none of
its neighbours (some sonars alternate between two), or when its time is not between theirs. Not detectable are samples
that were overwritten in place, and missing or additional bytes of exactly the length of frames. See
``docs/theory/sonar_files.md``.
"""

import json
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import chain, combinations, repeat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration, SonarCalibration, SonarImage
from sonar_graph.errors import DatasetError
from sonar_graph.files import regular, spelt
from sonar_graph.images import SonarFrames
from sonar_graph.logs.mcap import Progress, recording
from sonar_graph.logs.vehicle_setup import METADATA, recorded_calibration
from sonar_graph.logs.writing import sonar_image_messages
from sonar_graph.measurements import Floats

TOPIC = "/sonar/image"
_SEARCH_BYTES = 1 << 20
_IMAGE_BYTES = 1 << 22
_MOST_MISSING = 100_000
"""A larger jump of the frame number means that counting began at 0 again."""
_NEIGHBOURS = 4
"""Number of frames on either side with which a frame's settings are compared."""
_DRIFT = 1e-3
"""Relative change below which settings given as floats (speed of sound) agree."""
_ODD_GAP = 10
_ODD_GAP_NS = 1_000_000_000
"""The first and last interval may be this many times the one beside it, and this much more."""
Settings = tuple[int | float | bytes, ...]


class DamagedFrameError(Exception):
    """Bytes that cannot be the header of a frame, with the reason."""


def refuse_header(kind: str, faults: Mapping[str, bool]) -> None:
    """Refuse a header where some faults, by their texts, are true."""
    if any(faults.values()):
        texts = ", ".join(text for text, is_true in faults.items() if is_true)
        raise DamagedFrameError(f"{kind} with {texts}")


@dataclass(frozen=True)
class FrameHead:
    """Header of a frame."""

    at: int
    """Offset of the header in the file."""
    size: int
    """Bytes of header and samples."""
    number: int
    """Number of the frame, as counted by the sonar."""
    clock_ns: int
    """Time of the frame by the sonar's own clock."""
    settings: Settings
    """All on which samples and geometry depend; settings that may drift are floats."""
    has_image: bool = True
    """False for messages of other kinds between the frames."""

    @property
    def end(self) -> int:
        """Offset after the last byte."""
        return self.at + self.size


@dataclass(frozen=True)
class Lost:
    """Bytes of the file that are not used."""

    at: int
    end: int
    reason: str

    def __str__(self) -> str:
        return f"bytes {self.at} to {self.end - 1}: {self.reason}"


@dataclass(frozen=True, eq=False)
class FrameGeometry:
    """Ranges and azimuths of the samples of a frame."""

    ranges_m: Floats
    """Middle of each bin, shape (bins,)."""
    azimuths_rad: Floats
    """Azimuth of each beam in the order of the samples, positive to the left, shape (beams,)."""
    frequency_hz: float = 0.0
    sound_speed_m_s: float = 0.0


class SonarFormat(ABC):
    """Format of a sonar's file, opened."""

    image: SonarImage
    """Calibration of the samples."""
    notes: Mapping[str, str]
    """Interpretation of the file, for users of the log."""
    first_at: int
    """Offset of the first frame."""
    head_bytes: int
    """Bytes enough to read any frame's header."""
    signature: bytes
    """Bytes in every frame's header."""
    signature_at: int
    """Offset of the signature in the header."""
    clock_period_ns: int | None = None
    """Period after which the sonar's clock wraps around; None: never."""
    frames_promised: int = 0
    """Number of frames by the file's header; 0: not stated."""

    @abstractmethod
    def head(self, content: bytes, at: int) -> FrameHead:
        """Header at the beginning of some bytes, which lie at ``at`` in the file.

        Raises `DamagedFrameError` when the bytes cannot be a header.
        """

    @abstractmethod
    def may_follow(self, content: bytes, earlier: FrameHead) -> bool:
        """True where bytes at the end of the file, fewer than a header, can be the beginning of the next frame."""

    @abstractmethod
    def geometry(self, settings: Settings) -> FrameGeometry:
        """Ranges and azimuths of frames with some settings."""

    @abstractmethod
    def samples(self, frame: bytes, settings: Settings) -> NDArray[np.generic]:
        """Image in a frame's bytes, shape (beams, bins)."""


class ByteSource:
    """File open for reading at any offset."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._stream = regular(path).open("rb")
            self.size = path.stat().st_size
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror}") from error

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def read(self, at: int, count: int) -> bytes:
        """Bytes from ``at``; fewer at the end of the file."""
        try:
            self._stream.seek(at)
            return self._stream.read(count)
        except OSError as error:
            raise DatasetError(
                f"{self.path}: cannot be read at byte {at}: {error.strerror}"
            ) from error

    def places(self, pattern: bytes, start: int) -> Iterator[int]:
        """Offsets of a pattern, from ``start`` on."""
        for at in range(start, self.size, _SEARCH_BYTES):
            # blocks overlap: the pattern may lie across the end of one
            block = self.read(at, _SEARCH_BYTES + len(pattern) - 1)
            found = block.find(pattern)
            while found >= 0:
                yield at + found
                found = block.find(pattern, found + 1)


def plausible_headers(
    source: ByteSource, kind: SonarFormat, start: int
) -> Iterator[FrameHead]:
    """Plausible headers from an offset on, wherever the signature is found."""
    for at in source.places(kind.signature, start + kind.signature_at):
        begin = at - kind.signature_at
        try:
            head = kind.head(source.read(begin, kind.head_bytes), begin)
        except DamagedFrameError:
            continue  # the signature's bytes by chance
        yield head


def frames_and_losses(
    source: ByteSource, kind: SonarFormat
) -> Iterator[FrameHead | Lost]:
    """Headers of all trustworthy frames in the order of the file, and the losses between them."""
    # a frame is judged by those before it that are trusted and by as many after it
    accepted: deque[FrameHead] = deque(maxlen=_NEIGHBOURS)
    waiting: deque[FrameHead] = deque()
    # "None" at the end: the last frames have fewer after them
    for found in chain(_whole_frames(source, kind), repeat(None, _NEIGHBOURS)):
        if isinstance(found, Lost):
            yield found
            continue
        if found is not None:
            waiting.append(found)
        if len(waiting) > _NEIGHBOURS or (found is None and waiting):
            head = waiting.popleft()
            fault = _fault(accepted, head, waiting, kind.clock_period_ns)
            if fault:
                yield Lost(head.at, head.end, f"frame {head.number}: {fault}")
            else:
                accepted.append(head)
                yield head


def _whole_frames(source: ByteSource, kind: SonarFormat) -> Iterator[FrameHead | Lost]:
    """Frames followed by another header or the end of the file; not yet compared with their neighbours."""
    at = kind.first_at
    # the newest header, whose frame is whole only when another one follows at its end
    pending = None
    while at < source.size:
        try:
            head = kind.head(source.read(at, kind.head_bytes), at)
            if head.end > source.size and next(
                plausible_headers(source, kind, at + 1), None
            ):
                raise DamagedFrameError(
                    f"frame {head.number} claims to be longer than the file, in which others follow"
                )
        except DamagedFrameError as error:
            # bytes may be missing from the frame before, or from the file's header
            start = 0 if at == kind.first_at else at + 1
            if pending:
                start = pending.at + 1
            headers = plausible_headers(source, kind, start)
            found = next((other for other in headers if other.at != at), None)
            end = found.at if found else source.size
            if pending and _is_shifted(source, kind, pending, found):
                reason = f"frame {pending.number} and what follows: bytes are missing or too many"
                yield Lost(pending.at, end, reason)
            else:
                # the damage begins after the frame before, which is whole
                if pending and pending.has_image:
                    yield pending
                if end > at:
                    yield Lost(at, end, str(error))
                else:
                    reason = f"the file's header is {at - end} bytes too short"
                    yield Lost(0, end, reason)
            pending = None
            at = end
            continue
        if pending and pending.has_image:
            yield pending
        pending = head
        at = head.end
    if pending and pending.end > source.size:
        have = f"{source.size - pending.at} of {pending.size} bytes are there"
        yield Lost(pending.at, source.size, f"frame {pending.number}: cut off, {have}")
    elif pending and pending.has_image:
        yield pending


def _is_shifted(
    source: ByteSource, kind: SonarFormat, pending: FrameHead, found: FrameHead | None
) -> bool:
    """True where the frame before a bad header may lack bytes, or have too many."""
    # whole frames between two headers may be lost; a part of one shifts all that follows
    if found is not None:
        return (found.at - pending.end) % pending.size != 0
    rest = source.size - pending.end
    if rest < kind.head_bytes and kind.may_follow(
        source.read(pending.end, rest), pending
    ):
        return False
    return rest % pending.size != 0


def _fault(
    accepted: Sequence[FrameHead],
    judged: FrameHead,
    waiting: Sequence[FrameHead],
    period_ns: int | None,
) -> str | None:
    """Reason not to trust a frame's header, from the frames before and after it; None: trusted."""
    if accepted and (accepted[-1].number, accepted[-1].clock_ns) == (
        judged.number,
        judged.clock_ns,
    ):
        return f"a repetition of the frame at byte {accepted[-1].at}"
    others = [*accepted, *waiting]
    is_like_another = any(_agree(judged, other) for other in others)
    # two others that agree are needed: each frame may have settings of its own
    are_alike = any(_agree(one, other) for one, other in combinations(others, 2))
    if are_alike and not is_like_another:
        return "its settings are those of no frame beside it"
    if len(others) < 2:
        return None
    row = [*accepted, judged, *waiting]
    # the first or the last frame is judged by the two beside it
    middle = min(max(len(accepted), 1), len(row) - 2)
    before_ns = _elapsed(row[middle - 1], row[middle], period_ns)
    after_ns = _elapsed(row[middle], row[middle + 1], period_ns)
    if accepted and waiting:
        total_ns = _elapsed(row[middle - 1], row[middle + 1], period_ns)
        is_between = min(before_ns, after_ns) >= 0 and before_ns + after_ns == total_ns
        # where time runs back over both steps, the clock was set, and no frame is at fault
        fits = total_ns < 0 or is_between
    else:
        gap_ns = before_ns
        usual_ns = after_ns
        if accepted:
            gap_ns = after_ns
            usual_ns = before_ns
        fits = usual_ns < 0 or 0 <= gap_ns <= _ODD_GAP * usual_ns + _ODD_GAP_NS
    return None if fits else "its time does not fit those of the frames beside it"


def _agree(one: FrameHead, other: FrameHead) -> bool:
    """True where two frames have the same settings."""
    return all(
        abs(a - b) <= _DRIFT * abs(b)
        if isinstance(a, float) and isinstance(b, float)
        else a == b
        for a, b in zip(one.settings, other.settings, strict=True)
    )


def _elapsed(one: FrameHead, other: FrameHead, period_ns: int | None) -> int:
    difference = other.clock_ns - one.clock_ns
    return difference if period_ns is None else difference % period_ns


@dataclass
class SonarConversion:
    """Result of the conversion of a sonar's recording."""

    frames: int = 0
    first_ns: int = 0
    last_ns: int = 0
    lost: list[Lost] = field(default_factory=list)
    """Bytes that could not be read."""
    missing: int = 0
    """Frame numbers without a frame, either lost or never recorded."""
    promised: int = 0
    """Number of frames by the file's header; 0: not stated."""

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last."""
        return (self.last_ns - self.first_ns) * 1e-9

    @property
    def content(self) -> str:
        """Number of frames and duration."""
        return f"{self.frames} frames, {self.duration_s:.1f} s"

    def shortcomings(self, most: int | None = None) -> list[str]:
        """Lines about lost and missing frames; at most ``most`` of the losses."""
        lines = [f"lost: {loss}" for loss in self.lost[:most]]
        if len(self.lost) > len(lines):
            lines.append(
                f"lost: and {len(self.lost) - len(lines)} stretches more; all are in the log's notes"
            )
        if self.missing:
            lines.append(
                f"missing: the numbers of {self.missing} frames between the first and the last"
            )
        if self.promised > self.frames:
            lines.append(
                f"missing: {self.promised - self.frames} of {self.promised} frames that the file's header names"
            )
        return lines


def convert_sonar_file(
    path: Path,
    open_format: Callable[[ByteSource], SonarFormat],
    output: Path,
    progress: Progress | None = None,
) -> SonarConversion:
    """Write all whole frames to an MCAP log; memory holds a few of them at a time."""
    with closing(ByteSource(Path(path))) as source:
        return _convert(source, open_format(source), Path(output), progress)


def _convert(
    source: ByteSource, kind: SonarFormat, output: Path, progress: Progress | None
) -> SonarConversion:
    conversion = SonarConversion(promised=kind.frames_promised)
    calibration = Calibration(sonar=SonarCalibration(image=kind.image))
    record = {
        "name": spelt(source.path.stem),
        "calibration": recorded_calibration(calibration),
    }
    # a conversion that is interrupted leaves a log with the notes that are known before
    first_record = record | {"notes": json.dumps(dict(kind.notes))}
    found = frames_and_losses(source, kind)
    with recording(output, {METADATA: first_record}) as out:
        for block in _blocks(found, kind.clock_period_ns, conversion):
            heads, stamps_ns = zip(*block, strict=True)
            geometry = kind.geometry(heads[0].settings)
            images = [
                kind.samples(source.read(head.at, head.size), head.settings)
                for head in heads
            ]
            frames = SonarFrames(
                np.array(stamps_ns),
                np.stack(images),
                geometry.ranges_m,
                geometry.azimuths_rad,
            )
            messages = sonar_image_messages(
                TOPIC,
                frames,
                frequency_hz=geometry.frequency_hz,
                sound_speed_m_s=geometry.sound_speed_m_s,
            )
            out.write([messages])
            if progress:
                progress(heads[-1].end, source.size)
        if not conversion.frames:
            first = f": {conversion.lost[0]}" if conversion.lost else ""
            raise DatasetError(
                f"{source.path}: holds no whole frame{first}; is it a recording of this sonar?"
            )
        notes = dict(kind.notes)
        shortcomings = conversion.shortcomings()
        if shortcomings:
            notes["sonar.shortcomings"] = "; ".join(shortcomings)
        # the later of two records counts
        out.add_metadata(METADATA, record | {"notes": json.dumps(notes)})
    return conversion


def _blocks(
    found: Iterable[FrameHead | Lost],
    period_ns: int | None,
    conversion: SonarConversion,
) -> Iterator[list[tuple[FrameHead, int]]]:
    """Frames and their stamps in blocks of the same settings, with time running on, and of a size that fits memory.

    A clock that wraps around is continued. The account of frames and losses goes to ``conversion``.
    """
    block: list[tuple[FrameHead, int]] = []
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
        if not conversion.frames:
            conversion.first_ns = stamp_ns
        conversion.last_ns = stamp_ns
        conversion.frames += 1
        earlier = head
        if block:
            last, last_ns = block[-1]
            is_full = (len(block) + 1) * head.size > _IMAGE_BYTES
            is_alike = (last.settings, last.size) == (head.settings, head.size)
            # a block's stamps ascend: where the clock was set back, another begins
            if is_full or not is_alike or stamp_ns < last_ns:
                yield block
                block = []
        block.append((head, stamp_ns))
    if block:
        yield block
