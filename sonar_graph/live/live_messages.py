"""Messages as they come, and those of a log in the order in which they were recorded, at once or at their pace."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator
from itertools import groupby, repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sonar_graph.logs import DROPPED_TOPIC, dropped_in
from sonar_graph.logs.mcap import (
    ChunkPart,
    Keep,
    LogFile,
    Passage,
    Recording,
    Topic,
    log_parts,
    scan,
)

LONGEST_SLEEP_S = 0.05
HEAD = struct.Struct("<IQQ")
"""Sequence number, log time and time of publishing, which stand before a message's payload in MCAP."""


class Message(NamedTuple):
    """A message as it came.

    Examples
    --------
    >>> from sonar_graph.live import Message
    >>> Message("/imu", "sensor_msgs/msg/Imu", b"", arrival_ns=1_000_000_000).sequence
    0
    """

    topic: str
    type_name: str
    """Such as ``sensor_msgs/msg/Imu``."""
    payload: bytes
    arrival_ns: int
    sequence: int = 0
    """Number that the sender gave it; 0: none."""
    sent_ns: int = 0
    sender: bytes = b""


def gather(topic: Topic, payload: bytes, log_time_ns: int) -> None:
    """Add one message to a topic."""
    at = np.zeros(1, np.int64)
    topic.gather(payload, at, np.array([len(payload)]), np.array([log_time_ns]))


def recorded_messages(path: Path) -> Iterator[Message]:
    """Messages of a log in the order of the file, also of one that was cut off; the topic of dropped messages is left out.

    Raises `LogError` when the file cannot be read, or is damaged in its middle.
    """
    for file_path in log_parts(path):
        with LogFile(file_path) as file:
            # chunks without wanted topics are read too: every message is wanted
            passage = Passage(file, lambda _: Keep.ALL, may_skip=False)
            for _, parts in groupby(passage, key=lambda part: id(part.data)):
                yield from _in_order(list(parts))
            Recording(file_path, damage=passage.damage).require_sound()


def _in_order(parts: list[ChunkPart]) -> Iterator[Message]:
    """Messages of one chunk in the order in which they were written."""
    rows: list[Any] = []
    # a passage gives a chunk topic by topic
    for topic, _, found in parts:
        if topic.name != DROPPED_TOPIC and topic.encoding == "cdr":
            columns = (found.offsets, found.sizes, found.log_times_ns)
            rows += zip(*(column.tolist() for column in columns), repeat(topic))
    for at, size, log_time_ns, topic in sorted(rows, key=lambda row: row[0]):
        sequence, _, sent_ns = HEAD.unpack_from(parts[0].data, at - HEAD.size)
        payload = bytes(parts[0].data[at : at + size])
        yield Message(
            topic.name, topic.type_name, payload, log_time_ns, sequence, sent_ns
        )


def dropped_messages(path: Path) -> dict[tuple[str, int], str]:
    """Reasons of the messages that a record names as dropped, by topic and log time."""
    return dropped_in(scan(path, lambda _: Keep.ALL))


def play_messages(
    messages: Iterator[Message],
    rate: float,
    put: Callable[[Message], None],
    is_ended: Callable[[], bool],
) -> tuple[int, float]:
    """Give messages to ``put`` at ``rate`` times their pace; their number, and the longest delay in seconds."""
    begun_s = time.monotonic()
    first_ns = None
    count = 0
    latest_s = 0.0
    for message in messages:
        if first_ns is None:
            first_ns = message.arrival_ns
        due_s = begun_s + (message.arrival_ns - first_ns) * 1e-9 / rate
        # short sleeps, so that Ctrl-C ends it at once
        while (left_s := due_s - time.monotonic()) > 0:
            if is_ended():
                return count, latest_s
            time.sleep(min(left_s, LONGEST_SLEEP_S))
        latest_s = max(latest_s, -left_s)
        put(message)
        count += 1
    return count, latest_s
