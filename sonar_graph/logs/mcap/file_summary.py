"""The summary at a file's end: what the file says about itself, believed only where its CRC fits.

A part of a log, by the time of recording.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from io import BytesIO
from typing import Any, TypeVar

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema, Statistics

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.chunks import find_by_walk
from sonar_graph.logs.mcap.records import HEAD, MAGIC, ByteRange, ChunkRecord, LogFile, RecordWalk

_FOOTER = struct.Struct("<BQQQI")
_DATA_END = struct.Struct("<BQI")
_DATA_END_HEAD = HEAD.pack(Opcode.DATA_END, 4)
_LARGEST_MOVED = 1 << 26
T = TypeVar("T", bound=Any)


@dataclass
class FileSummary:
    """What stands after the data section."""

    data_end_at: int
    """Where the data section ends, before its own end record."""
    data_crc: int
    """Of the data section; 0: none."""
    has_crc: bool
    """Whether a CRC covers what follows."""
    schemas: list[Schema] = field(default_factory=list)
    channels: list[Channel] = field(default_factory=list)
    chunks: dict[int, ChunkIndex] = field(default_factory=dict)
    """By offset of the chunk."""
    statistics: Statistics | None = None


def parse(kind: Callable[[ReadDataStream], T], content: bytes) -> T:
    """A record read by the mcap package.

    Raises
    ------
    LogError
        When the content is not exactly one such record.
    """
    try:
        record = kind(ReadDataStream(BytesIO(content)))
        builder = RecordBuilder()
        record.write(builder)
        again = builder.end()[HEAD.size :]  # type: ignore[no-untyped-call]  # of the mcap package
    except Exception as error:  # the package's reader raises whatever its parts raise
        raise LogError(f"it cannot be read ({error or type(error).__name__})") from error
    if again != content:  # the package's reader takes what is too short or too long without a word
        raise LogError(f"its {len(content)} bytes do not make sense")
    return record


def read_summary(file: LogFile) -> tuple[FileSummary | None, str | None]:
    """The summary if it can be believed, and what is wrong with the end of the file."""
    tail = file.read(max(file.size - _FOOTER.size - len(MAGIC), 0), _FOOTER.size + len(MAGIC))
    if len(tail) < _FOOTER.size + len(MAGIC) or not tail.endswith(MAGIC):
        return None, "it does not end as an MCAP file does"
    opcode, length, start, _, crc = _FOOTER.unpack_from(tail)
    footer_at = file.size - len(tail)
    end = start or footer_at
    least = len(MAGIC) + _DATA_END.size
    if opcode != Opcode.FOOTER or length != _FOOTER.size - HEAD.size or not least <= end <= footer_at:
        return None, "its footer is damaged"
    if crc and _crc(file, end, footer_at) != crc:
        moved = _moved_start(file, footer_at, crc)
        if moved is None:
            return None, "its summary is damaged: the CRC does not fit"
        summary, _ = _read(file, moved, footer_at, has_crc=True)
        if summary:
            summary.chunks.clear()
        return summary, "bytes are missing or doubled in it, so that its index does not fit"
    return _read(file, end, footer_at, has_crc=crc != 0)


def _crc(file: LogFile, start: int, footer_at: int) -> int:
    return zlib.crc32(file.read(start, footer_at + _FOOTER.size - 4 - start))


def _moved_start(file: LogFile, footer_at: int, crc: int) -> int | None:
    """Where the summary begins, if not where the footer says."""
    first = max(footer_at - _LARGEST_MOVED, 0)
    content = file.read(first, footer_at - first)
    at = content.rfind(_DATA_END_HEAD)
    while at >= 0:
        if _crc(file, first + at + _DATA_END.size, footer_at) == crc:
            return first + at + _DATA_END.size
        at = content.rfind(_DATA_END_HEAD, 0, at)
    return None


def _read(file: LogFile, start: int, footer_at: int, *, has_crc: bool) -> tuple[FileSummary | None, str | None]:
    data_end_at = start - _DATA_END.size
    opcode, length, data_crc = _DATA_END.unpack(file.read(data_end_at, _DATA_END.size))
    is_sound = (opcode, length) == (Opcode.DATA_END, 4)
    summary = FileSummary(data_end_at, data_crc if is_sound else 0, has_crc)
    try:
        _fill(summary, file.read(start, footer_at - start))
    except LogError as error:
        return None, f"its summary is damaged: {error}"
    return summary, None if is_sound else "the record that ends its data is damaged"


def _fill(summary: FileSummary, content: bytes) -> None:
    at = 0
    while at + HEAD.size <= len(content):
        opcode, length = HEAD.unpack_from(content, at)
        at += HEAD.size
        if length > len(content) - at:
            raise LogError("a record in it is longer than the summary")
        record = content[at : at + length]
        if opcode == Opcode.SCHEMA:
            summary.schemas.append(parse(Schema.read, record))
        elif opcode == Opcode.CHANNEL:
            summary.channels.append(parse(Channel.read, record))
        elif opcode == Opcode.CHUNK_INDEX:
            index = parse(ChunkIndex.read, record)
            summary.chunks[index.chunk_start_offset] = index
        elif opcode == Opcode.STATISTICS:
            summary.statistics = parse(Statistics.read, record)
        at += length


_NS_PER_S = 1_000_000_000
_FIRST_NS, _LAST_NS = -(1 << 63), (1 << 63) - 1


@dataclass(frozen=True)
class Instant:
    """A time in a log: seconds from its beginning, or absolute."""

    seconds: float | None = None
    """From the earliest recorded message."""
    absolute_ns: int | None = None
    """Since 1970, UTC."""

    @classmethod
    def parse(cls, text: str) -> Instant:
        """A number is seconds from the log's beginning; a date with a time is absolute, in UTC unless it says else.

        Raises
        ------
        LogError
            When the text is neither.
        """
        try:
            seconds = float(text)
        except ValueError:
            return cls(absolute_ns=_nanoseconds(text))
        if not 0 <= seconds < _LAST_NS / _NS_PER_S:
            raise LogError(f"{text!r} is no time in a log: give seconds from its beginning, 0 or more")
        return cls(seconds=seconds)

    def resolve(self, beginning_ns: int) -> int:
        """Nanoseconds since 1970, given those of the log's beginning."""
        if self.absolute_ns is not None:
            return self.absolute_ns
        return beginning_ns + round((self.seconds or 0.0) * _NS_PER_S)


def _nanoseconds(text: str) -> int:
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        expected = "seconds from its beginning such as 90.5, or a date and time such as 2026-05-01T12:30:00Z"
        raise LogError(f"{text!r} is no time in a log: give {expected}") from None
    when = when if when.tzinfo else when.replace(tzinfo=UTC)
    since = when - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * _NS_PER_S + since.microseconds * 1000


@dataclass(frozen=True)
class TimeWindow:
    """From ``start`` up to but not including ``end``; None: from the beginning, to the end.

    What was recorded counts, not the sensors' stamps, because only that is in a file's index.
    """

    start: Instant | None = None
    end: Instant | None = None

    @property
    def is_all(self) -> bool:
        """Whether it has no limits."""
        return self.start is None and self.end is None

    def describe(self, beginning_ns: int) -> str:
        """In seconds after the log's beginning."""
        start_ns, end_ns = self.resolve(beginning_ns)
        start = "the beginning" if self.start is None else f"{(start_ns - beginning_ns) / _NS_PER_S:.3f} s"
        end = "the end" if self.end is None else f"{(end_ns - beginning_ns) / _NS_PER_S:.3f} s"
        return f"{start} to {end} of the recording"

    def resolve(self, beginning_ns: int) -> tuple[int, int]:
        """First instant within, and first instant after, in nanoseconds since 1970."""
        start_ns = self.start.resolve(beginning_ns) if self.start else _FIRST_NS
        end_ns = self.end.resolve(beginning_ns) if self.end else _LAST_NS
        if start_ns >= end_ns:
            raise LogError("the wanted part of the log ends before it starts: --start must be less than --end")
        return start_ns, end_ns


def first_time_ns(file: LogFile, summary: FileSummary | None) -> int:
    """The earliest log time: by the statistics, or else the heads of the chunks, or else the messages themselves."""
    if summary and summary.statistics and summary.statistics.message_count:
        return int(summary.statistics.message_start_time)
    times_ns = []
    for item in RecordWalk(file, summary.data_end_at if summary else None):
        if isinstance(item, ChunkRecord) and 0 < item.start_ns <= item.end_ns:
            times_ns.append(item.start_ns)
        elif isinstance(item, ByteRange):
            content = find_by_walk(file.read(item.at, item.end - item.at))
            times_ns += [content.times_ns()[0]] if content.channels else []
    return min(times_ns, default=0)
