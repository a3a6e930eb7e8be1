"""Reading of single messages as they arrive, by the adapters with which a log of them is read.

An adapter reads columns of many messages at once; for one message at 200 Hz that is mostly overhead. IMU messages that
are like one before, but for their numbers, are read by `PlainImu`. It has no rule of its own: where anything is unusual
(another length or string, a stamp of zero, a status, a number that is not finite, a force of zero) the adapter reads
the message. What is left is the same arithmetic, so rows are those of the log to the bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from operator import itemgetter
from struct import Struct, calcsize
from typing import Any, NamedTuple

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.logs import Assembly
from sonar_graph.logs.adapters import (
    LARGEST,
    Adapter,
    ImuAdapter,
    axes_matrix,
    field_of,
    turned,
)
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.mcap import Topic
from sonar_graph.measurements import BLOCKS, NS_PER_S, Imu, Ints

ONE: Ints = np.zeros(1, np.int64)
KINDS = {"f8": "d", "i4": "i", "u4": "I"}
"""Numbers that are read, by their type in numpy."""


class Part(NamedTuple):
    """What a message says in one role."""

    role: str
    stamp_ns: int
    block: Any
    """Rows of this stamp; None: there are none."""
    fault: str
    """Reason why there are none; empty where the message is sound, as one of a sonar frame without detections."""


class MessageReader:
    """Reader of messages one by one.

    Topics, adapters, calibration, origin of the world and axes of a compass are those that the messages of the first
    seconds gave (`Assembly`, whose configuration is `pinned`).
    """

    def __init__(self, assembly: Assembly) -> None:
        self.calibration = assembly.calibration
        self._adapters = assembly.adapters
        self._setups = {
            role: assembly.setup(role) for role in assembly.topics if role in BLOCKS
        }
        self._topics: dict[str, Topic] = {}
        self._roles: dict[str, list[str]] = {}
        self._sizes = {}
        for role in self._setups:
            topic = assembly.topics[role]
            self._topics[topic.name] = topic.empty()
            self._roles.setdefault(topic.name, []).append(role)
            self._sizes[role] = _sizes(self._adapters[role], topic.messages()[0])
        self._plain: dict[tuple[str, int], PlainImu | None] = {}
        """By topic and number of bytes."""

    def read(self, name: str, payload: bytes, log_time_ns: int) -> list[Part]:
        """What the message of a topic says, by role; nothing for a topic that is not used."""
        parts = []
        for role in self._roles.get(name, ()):
            plain = self._plain.get((name, len(payload))) if role == "imu" else None
            if plain is not None and (row := plain.row(payload)) is not None:
                parts.append(Part(role, int(row.stamps_ns[0]), row, ""))
                continue
            topic = self._topics[name].empty()
            topic.gather(
                payload, ONE, np.array([len(payload)]), np.array([log_time_ns])
            )
            try:
                parts.append(self._part(role, topic))
            except Exception as error:  # whatever a sender sends
                fault = str(error).removeprefix(f"{topic.file}: topic {name}: ")
                parts.append(
                    Part(
                        role,
                        log_time_ns,
                        None,
                        f"cannot be read: {fault or type(error).__name__}",
                    )
                )
        return parts

    def _part(self, role: str, topic: Topic) -> Part:
        adapter = self._adapters[role]
        table = adapter.table(topic)
        first = table.groups[0]
        if _sizes(adapter, first) != self._sizes[role]:
            raise LogError("has arrays of another length than the first messages")
        block, dropped = adapter.read(table, self._setups[role])
        faults = ", ".join(topic.unsound | dropped)
        place = topic.name, first.payloads.shape[1]
        if role == "imu" and not faults and place not in self._plain:
            self._plain[place] = PlainImu.like(adapter, first)
        return Part(role, int(table.stamps_ns[0]), block, faults)


def _sizes(adapter: Adapter, group: Messages) -> list[tuple[int, ...]]:
    """Number of elements of each field that an adapter reads."""
    return [group[field_of(path)[0]].shape[1:] for path in adapter.fields()]


class PlainImu:
    """IMU messages of one form; made by `like`.

    Parameters
    ----------
    adapter
        How they are read.
    size
        Number of bytes.
    same
        Bytes that each has, and where: encapsulation, lengths, strings and booleans.
    numbers
        Kinds and places of seconds, nanoseconds, rates, forces, and what is -1 where one of these was not measured.
    byte_order
        Of the numbers, as `struct` has it.
    """

    def __init__(
        self,
        adapter: ImuAdapter,
        size: int,
        same: list[tuple[int, int, bytes]],
        numbers: list[tuple[str, int]],
        byte_order: str,
    ) -> None:
        self._size = size
        self._unpack_same = _unpacking(size, [(f"{b - a}s", a) for a, b, _ in same])
        self._same = tuple(content for _, _, content in same)
        in_order = sorted(set(numbers), key=lambda number: number[1])
        self._unpack_numbers = _unpacking(size, in_order, byte_order)
        self._wanted = itemgetter(*(in_order.index(number) for number in numbers))
        scales = adapter.angular_velocity_scale, adapter.linear_acceleration_scale
        self._scales = np.repeat(scales, 3).tolist()
        self._offset_ns = round(adapter.stamp_offset_s * NS_PER_S)
        self._axes = (
            None if adapter.rotation == "flu" else axes_matrix(adapter.rotation)
        )

    @classmethod
    def like(cls, adapter: ImuAdapter, messages: Messages) -> PlainImu | None:
        """Form of a message that was read without faults; None where it takes more than numbers to read it."""
        if adapter.linear_acceleration is None:
            return None
        if adapter.angular_velocity_axes is not None:
            return None
        stamp = f"{adapter.stamp}.sec", f"{adapter.stamp}.nanosec"
        status = [
            path
            for path in (
                adapter.angular_velocity_status,
                adapter.linear_acceleration_status,
            )
            if path
        ]
        numbers = []
        for path in (
            *stamp,
            *adapter.angular_velocity,
            *adapter.linear_acceleration,
            *status,
        ):
            name, index = field_of(path)
            if name not in messages.layout.columns:
                return None
            column = messages.layout.column(name)
            kind = KINDS.get(f"{column.dtype.kind}{column.dtype.itemsize}")
            if kind is None or (kind == "d") == (path in stamp):
                return None  # of single precision, scaling would round otherwise
            numbers.append(
                (kind, column.starts[0] + (index or 0) * column.dtype.itemsize)
            )
        payload = messages.payloads[0].tobytes()
        same = [(a, b, payload[a:b]) for a, b in _runs_that_stay(messages)]
        return cls(adapter, len(payload), same, numbers, messages.layout.byte_order)

    def row(self, payload: bytes) -> Imu | None:
        """The row of a message; None for one that the adapter must read."""
        if len(payload) != self._size or self._unpack_same(payload) != self._same:
            return None
        seconds, nanoseconds, *numbers = self._wanted(self._unpack_numbers(payload))
        stamp_ns = seconds * NS_PER_S + nanoseconds
        values = [
            value * scale
            for value, scale in zip(numbers[:6], self._scales, strict=True)
        ]
        if not (
            stamp_ns
            and -1 not in numbers[6:]
            and any(values[3:])
            and sum(map(abs, values)) < LARGEST
        ):
            return None
        rate, force = np.array(values).reshape(2, 1, 3)
        if self._axes is not None:
            rate, force = turned(self._axes, rate), turned(self._axes, force)
        return Imu.of_valid(np.array([stamp_ns + self._offset_ns]), rate, force)


def _unpacking(
    size: int, fields: list[tuple[str, int]], byte_order: str = "<"
) -> Callable[[bytes], tuple[Any, ...]]:
    """Function that unpacks fields, their kinds and places in order, of so many bytes."""
    kinds, end = byte_order, 0
    for kind, at in fields:
        kinds += f"{at - end}x{kind}"
        end = at + calcsize(f"={kind}")
    return Struct(f"{kinds}{size - end}x").unpack


def _runs_that_stay(messages: Messages) -> Iterator[tuple[int, int]]:
    """Beginnings and ends of the bytes that decide where the numbers are, and whether the message is sound."""
    layout, stays = messages.layout, np.zeros(messages.payloads.shape[1] + 2, bool)
    stays[1:3] = True
    for at, _ in layout.words:
        stays[at + 1 : at + 5] = True
    for path in (*layout.plan.texts, *layout.plan.booleans):
        column = layout.column(path)
        for start, count in zip(column.starts, column.counts, strict=True):
            stays[start + 1 : start + 1 + count] = True
    ends = np.flatnonzero(stays[1:] != stays[:-1]).tolist()
    yield from list(pairwise(ends))[::2]
