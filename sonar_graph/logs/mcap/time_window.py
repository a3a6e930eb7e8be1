"""Time window of a reading: the part of a log between two times of recording."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

from sonar_graph.errors import LogError

_NS_PER_S = 1_000_000_000
_FIRST_NS = -(1 << 63)
_LAST_NS = (1 << 63) - 1
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


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
            since = (when if when.tzinfo else when.replace(tzinfo=UTC)) - _EPOCH
            return cls(absolute_ns=since // timedelta(microseconds=1) * 1000)
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


class Limits(NamedTuple):
    """Times of recording of a part of a log, nanoseconds since 1970."""

    first_ns: int
    """First instant within the part."""
    after_ns: int
    """First instant after it."""
    text: str
    """The same in seconds after the log's beginning."""


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
        limits = [
            None if text is None else Instant.parse(text) for text in (start, end)
        ]
        return cls(*limits)

    def resolve(self, beginning_ns: int) -> Limits:
        """The window of a log whose earliest message was recorded at an instant."""
        first_ns = self.start.resolve(beginning_ns) if self.start else _FIRST_NS
        after_ns = self.end.resolve(beginning_ns) if self.end else _LAST_NS
        if first_ns >= after_ns:
            raise LogError(
                "the wanted part of the log ends before it starts: its start must be less than its end"
            )
        start = f"{(first_ns - beginning_ns) / _NS_PER_S:.3f} s"
        end = f"{(after_ns - beginning_ns) / _NS_PER_S:.3f} s"
        text = f"{start if self.start else 'the beginning'} to {end if self.end else 'the end'} of the recording"
        return Limits(first_ns, after_ns, text)
