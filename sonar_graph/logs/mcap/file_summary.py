"""Summary section at the end of an MCAP file, trusted only where its CRC fits, and the time window of a reading.

The summary repeats schemas and channels, and has an index of the chunks and the number of messages of each channel.
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
from sonar_graph.logs.mcap.records import (
    HEAD,
    LARGEST_BYTES,
    MAGIC,
    ByteRange,
    ChunkRecord,
    LogFile,
    RecordWalk,
)

_FOOTER = struct.Struct("<BQQQI")
_DATA_END = struct.Struct("<BQI")
_DATA_END_HEAD = HEAD.pack(Opcode.DATA_END, 4)
_LARGEST_MOVED = 1 << 26
_MOST_ENDS = 8
"""Ends of the data that are tried: the right one is the last, unless the summary has its nine bytes by chance."""
T = TypeVar("T", bound=Any)


@dataclass
class FileSummary:
    """Summary of a file, after its data section."""

    data_end_at: int
    """End of the data section, before its end record."""
    data_crc: int
    """CRC of the data section; 0: none."""
    has_crc: bool
    """True when a CRC covers the summary."""
    schemas: list[Schema] = field(default_factory=list)
    channels: list[Channel] = field(default_factory=list)
    chunks: dict[int, ChunkIndex] = field(default_factory=dict)
    """Chunk indexes by the offset of the chunk."""
    statistics: Statistics | None = None


def parse(kind: Callable[[ReadDataStream], T], content: bytes) -> T:
    """Record as parsed by the mcap package; a LogError where the content is not exactly one such record."""
    try:
        record = kind(ReadDataStream(BytesIO(content)))
        builder = RecordBuilder()
        record.write(builder)
        again = builder.end()[HEAD.size :]  # type: ignore[no-untyped-call]  # of the mcap package
    except Exception as error:  # the package's reader raises whatever its parts raise
        raise LogError(
            f"it cannot be read ({error or type(error).__name__})"
        ) from error
    if (
        again != content
    ):  # the package's reader accepts content that is too short or too long
        raise LogError(f"its {len(content)} bytes do not make sense")
    return record


def read_summary(file: LogFile) -> tuple[FileSummary | None, str | None]:
    """Summary, if it can be trusted, and the fault at the end of the file, if there is one.

    Where the CRC does not fit, bytes may be missing or doubled in the data before: the summary is then searched for by
    the record that ends the data, and used without its offsets of chunks.
    """
    tail = file.read(
        max(file.size - _FOOTER.size - len(MAGIC), 0), _FOOTER.size + len(MAGIC)
    )
    if len(tail) < _FOOTER.size + len(MAGIC) or not tail.endswith(MAGIC):
        return None, "it does not end as an MCAP file does"
    opcode, length, start, _, crc = _FOOTER.unpack_from(tail)
    footer_at = file.size - len(tail)
    start = start or footer_at
    least = len(MAGIC) + _DATA_END.size
    if (
        opcode != Opcode.FOOTER
        or length != _FOOTER.size - HEAD.size
        or not least <= start <= footer_at
    ):
        return None, "its footer is damaged"
    if footer_at - start > LARGEST_BYTES:
        return (
            None,
            f"its summary is said to have {footer_at - start} bytes, and at most {LARGEST_BYTES} are read",
        )
    if not crc or _crc(file, start, footer_at) == crc:
        return _read(file, start, footer_at, has_crc=crc != 0)
    first = max(footer_at - _LARGEST_MOVED, 0)
    content = file.read(first, footer_at - first)
    at = len(content)
    for _ in range(_MOST_ENDS):
        at = content.rfind(_DATA_END_HEAD, 0, at)
        if at < 0:
            break
        moved = first + at + _DATA_END.size
        if _crc(file, moved, footer_at) == crc:
            summary, _ = _read(file, moved, footer_at, has_crc=True)
            if summary:
                summary.chunks.clear()
            return (
                summary,
                "bytes are missing or doubled in it, so that its index does not fit",
            )
    return None, "its summary is damaged: the CRC does not fit"


def _crc(file: LogFile, start: int, footer_at: int) -> int:
    return zlib.crc32(file.read(start, footer_at + _FOOTER.size - 4 - start))


def _read(
    file: LogFile, start: int, footer_at: int, *, has_crc: bool
) -> tuple[FileSummary | None, str | None]:
    data_end_at = start - _DATA_END.size
    opcode, length, data_crc = _DATA_END.unpack(file.read(data_end_at, _DATA_END.size))
    is_sound = (opcode, length) == (Opcode.DATA_END, 4)
    summary = FileSummary(data_end_at, data_crc if is_sound else 0, has_crc)
    content, at = file.read(start, footer_at - start), 0
    try:
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
    except LogError as error:
        return None, f"its summary is damaged: {error}"
    return summary, None if is_sound else "the record that ends its data is damaged"


_NS_PER_S = 1_000_000_000
_FIRST_NS, _LAST_NS = -(1 << 63), (1 << 63) - 1


@dataclass(frozen=True)
class Instant:
    """Time in a log: seconds from its beginning, or absolute."""

    seconds: float | None = None
    """Seconds from the earliest recorded message."""
    absolute_ns: int | None = None
    """Nanoseconds since 1970, UTC."""

    @classmethod
    def parse(cls, text: str) -> Instant:
        """Instant from a number of seconds from the log's beginning, or from a date and time, in UTC without a zone.

        Any other text is a LogError.
        """
        try:
            seconds = float(text)
        except ValueError:
            try:
                when = datetime.fromisoformat(text)
            except ValueError:
                expected = "seconds from its beginning such as 90.5, or a date and time such as 2026-05-01T12:30:00Z"
                raise LogError(
                    f"{text!r} is no time in a log: give {expected}"
                ) from None
            since = (when if when.tzinfo else when.replace(tzinfo=UTC)) - datetime(
                1970, 1, 1, tzinfo=UTC
            )
            return cls(
                absolute_ns=(since.days * 86_400 + since.seconds) * _NS_PER_S
                + since.microseconds * 1000
            )
        if not 0 <= seconds < _LAST_NS / _NS_PER_S:
            raise LogError(
                f"{text!r} is no time in a log: give seconds from its beginning, 0 or more"
            )
        return cls(seconds=seconds)

    def resolve(self, beginning_ns: int) -> int:
        """Nanoseconds since 1970, given those of the log's beginning."""
        if self.absolute_ns is not None:
            return self.absolute_ns
        return beginning_ns + round((self.seconds or 0.0) * _NS_PER_S)


@dataclass(frozen=True)
class TimeWindow:
    """Part of a log from ``start`` up to but not including ``end``; None: from the beginning, to the end.

    The times of recording count, not the sensors' stamps, because only the former are in a file's index.

    Examples
    --------
    >>> from sonar_graph import TimeWindow
    >>> TimeWindow.parse("10", None).start
    Instant(seconds=10.0, absolute_ns=None)
    """

    start: Instant | None = None
    end: Instant | None = None

    @classmethod
    def parse(cls, start: str | None, end: str | None) -> TimeWindow:
        """Window between two times in text, as `Instant.parse` takes them; None: no limit."""
        first, last = (
            None if text is None else Instant.parse(text) for text in (start, end)
        )
        return cls(first, last)

    def describe(self, beginning_ns: int) -> str:
        """Text with the limits in seconds after the log's beginning."""
        start_ns, end_ns = self.resolve(beginning_ns)
        start = (
            "the beginning"
            if self.start is None
            else f"{(start_ns - beginning_ns) / _NS_PER_S:.3f} s"
        )
        end = (
            "the end"
            if self.end is None
            else f"{(end_ns - beginning_ns) / _NS_PER_S:.3f} s"
        )
        return f"{start} to {end} of the recording"

    def resolve(self, beginning_ns: int) -> tuple[int, int]:
        """First instant within and first instant after the window, nanoseconds since 1970."""
        start_ns = self.start.resolve(beginning_ns) if self.start else _FIRST_NS
        end_ns = self.end.resolve(beginning_ns) if self.end else _LAST_NS
        if start_ns >= end_ns:
            raise LogError(
                "the wanted part of the log ends before it starts: --start must be less than --end"
            )
        return start_ns, end_ns


def first_time_ns(file: LogFile, summary: FileSummary | None) -> int:
    """Earliest log time, by the statistics, or else the heads of the chunks, or else the messages themselves."""
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
