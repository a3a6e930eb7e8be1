"""Messages between the transport's thread and the one that takes them, and topics from which nothing comes any more."""

from __future__ import annotations

import threading
from collections import Counter, deque

from sonar_graph.live.live_messages import Message

MOST_BYTES = 1 << 28
"""Of the messages that wait."""
SILENT_S = 5.0
"""Time without a message after which the user is told."""


class Inbox:
    """Messages that wait to be taken, bounded: the oldest are dropped and counted."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self._messages: deque[Message] = deque()
        self._bytes = 0
        self._changed = threading.Condition()

    def put(self, message: Message) -> None:
        """Append a message."""
        with self._changed:
            self._messages.append(message)
            self._bytes += len(message.payload)
            # an estimator that hangs must not take all memory
            while self._bytes > MOST_BYTES:
                oldest = self._messages.popleft()
                self._bytes -= len(oldest.payload)
                self.dropped[oldest.topic] += 1
            self._changed.notify()

    @property
    def is_empty(self) -> bool:
        """Whether no message waits."""
        return not self._messages

    def take(self, timeout_s: float) -> list[Message]:
        """All messages that wait; an empty list if none comes in time."""
        with self._changed:
            if not self._messages:
                self._changed.wait(timeout_s)
            messages = list(self._messages)
            self._messages.clear()
            self._bytes = 0
            return messages


class Silence:
    """Topics that have sent, and for how long nothing came of them; each silence is reported once.

    Examples
    --------
    >>> silence = Silence()
    >>> silence.note("/dvl/data", 1.0)
    >>> silence.note("/imu/data", 5.0)
    >>> silence.lines({"/imu/data", "/dvl/data"}, at_s=7.0)
    ['/dvl/data: nothing since 6 s']
    >>> silence.lines({"/imu/data", "/dvl/data"}, at_s=8.0)
    []
    """

    def __init__(self) -> None:
        self._heard_s: dict[str, float] = {}
        self._said: set[str] = set()

    def note(self, topic: str, at_s: float) -> None:
        """Note that a message of a topic came."""
        self._heard_s[topic] = at_s
        self._said.discard(topic)

    def lines(self, topics: set[str], at_s: float) -> list[str]:
        """A line for each of these topics that has become silent."""
        silent = {
            topic: at_s - heard_s
            for topic, heard_s in self._heard_s.items()
            if topic in topics and at_s - heard_s > SILENT_S
        }
        new = sorted(silent.keys() - self._said)
        self._said |= silent.keys()
        return [f"{topic}: nothing since {silent[topic]:.0f} s" for topic in new]
