"""Reading of single messages as they arrive, by the adapters with which a log of them is read.

An adapter reads columns of many messages at once; for one message at 200 Hz that is mostly overhead. IMU messages that
are like one before, but for their numbers, are read by `PlainImu`. It has no rule of its own: where anything is unusual
(another length or string, a stamp of zero, a status, a number that is not finite, a force of zero) the adapter reads
the message. What is left is the same arithmetic, so rows are those of the log to the bit.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.live.live_messages import gather
from sonar_graph.logs import Assembly
from sonar_graph.logs.adapters import (
    LARGEST,
    Adapter,
    ImuAdapter,
    Mask,
    field_of,
    turn,
)
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.mcap import Topic
from sonar_graph.measurements import BLOCKS, NS_PER_S, Imu, Ints


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
            gather(topic, payload, log_time_ns)
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
        # a log of such messages is refused, so that its record must not have them
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
    """IMU messages with the form of one that was read without faults; made by `like`."""

    def __init__(
        self, adapter: ImuAdapter, messages: Messages, paths: list[str]
    ) -> None:
        first = messages.payloads[0]
        self._adapter = adapter
        self._stays = np.flatnonzero(_stays(messages))
        self._size = len(first)
        self._same = first[self._stays].tobytes()
        self._numbers = np.concatenate([_bytes_of(messages, path) for path in paths])
        stamps = (f"{adapter.stamp}.sec", f"{adapter.stamp}.nanosec")
        self._stamp = [_bytes_of(messages, path) for path in stamps]
        self._order = messages.layout.byte_order
        scales = [adapter.angular_velocity_scale, adapter.linear_acceleration_scale]
        self._scales = np.repeat(scales, 3)
        self._offset_ns = round(adapter.stamp_offset_s * NS_PER_S)

    @classmethod
    def like(cls, adapter: ImuAdapter, messages: Messages) -> PlainImu | None:
        """Form of a message; None where it takes more than double precision numbers to read it."""
        if adapter.linear_acceleration is None:
            return None
        status = (adapter.angular_velocity_status, adapter.linear_acceleration_status)
        axes = (*adapter.angular_velocity, *adapter.linear_acceleration)
        paths = [*axes, *filter(None, status)]
        columns = messages.layout.columns
        names = {field_of(path)[0] for path in paths}
        if not {*names, f"{adapter.stamp}.sec"} <= columns.keys():
            return None
        # of single precision, scaling would round otherwise
        kinds = {messages.layout.column(name).dtype.str[1:] for name in names}
        return cls(adapter, messages, paths) if kinds == {"f8"} else None

    def row(self, payload: bytes) -> Imu | None:
        """The row of a message; None for one that the adapter must read."""
        data = np.frombuffer(payload, np.uint8)
        if len(data) != self._size or data[self._stays].tobytes() != self._same:
            return None
        seconds, nanoseconds = (
            int(data[place].view(f"{self._order}{kind}")[0])
            for place, kind in zip(self._stamp, ("i4", "u4"), strict=True)
        )
        stamp_ns = seconds * NS_PER_S + nanoseconds
        numbers = data[self._numbers].view(f"{self._order}f8")
        values = numbers[:6] * self._scales
        is_sound = np.abs(values).max() < LARGEST and values[3:].any()
        if stamp_ns == 0 or not is_sound or (numbers[6:] == -1).any():
            return None
        rate, force = values.reshape(2, 1, 3)
        rotation = self._adapter.rotation
        rate = turn(rotation, rate)
        if self._adapter.angular_velocity_axes is not None:
            rate = turn(self._adapter.angular_velocity_axes, rate)
        stamps_ns = np.array([stamp_ns + self._offset_ns])
        return Imu.of_valid(stamps_ns, rate, turn(rotation, force))


def _bytes_of(messages: Messages, path: str) -> Ints:
    """Places of the bytes of a number in a message."""
    name, index = field_of(path)
    column = messages.layout.column(name)
    size = column.dtype.itemsize
    return column.starts[0] + (index or 0) * size + np.arange(size)


def _stays(messages: Messages) -> Mask:
    """Mask of the bytes that decide where the numbers are, and whether the message is sound."""
    layout = messages.layout
    stays = np.zeros(messages.payloads.shape[1], bool)
    stays[:2] = True  # the byte order
    for at, _ in layout.words:
        stays[at : at + 4] = True
    for path in (*layout.plan.texts, *layout.plan.booleans):
        column = layout.column(path)
        for start, count in zip(column.starts, column.counts, strict=True):
            stays[start : start + count] = True
    return stays
