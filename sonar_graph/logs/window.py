"""A part of a log, by the time of recording."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from sonar_graph.errors import LogError
from sonar_graph.logs.chunks import find_by_walk
from sonar_graph.logs.records import ChunkRecord, LogFile, Stretch, Walk
from sonar_graph.logs.summary import Summary

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
class Window:
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


def first_time_ns(file: LogFile, summary: Summary | None) -> int:
    """The earliest log time: by the statistics, or else the heads of the chunks, or else the messages themselves."""
    if summary and summary.statistics and summary.statistics.message_count:
        return int(summary.statistics.message_start_time)
    times_ns = []
    for item in Walk(file, summary.data_end_at if summary else None):
        if isinstance(item, ChunkRecord) and 0 < item.start_ns <= item.end_ns:
            times_ns.append(item.start_ns)
        elif isinstance(item, Stretch):
            content = find_by_walk(file.read(item.at, item.end - item.at))
            times_ns += [content.times_ns()[0]] if content.channels else []
    return min(times_ns, default=0)
