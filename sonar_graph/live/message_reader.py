"""Reading of single messages as they arrive, by the adapters with which a log of them is read."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.logs import Assembly, rows_of
from sonar_graph.logs.adapters import Adapter, field_of, header_stamps_ns
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.mcap import Topic
from sonar_graph.measurements import BLOCKS, Ints

ONE: Ints = np.zeros(1, np.int64)


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
        self._axes_and_origin = {role: assembly.axes_and_origin(role) for role in assembly.topics if role in BLOCKS}
        self._topics: dict[str, Topic] = {}
        self._roles: dict[str, list[str]] = {}
        for role in self._axes_and_origin:
            topic = assembly.topics[role]
            self._topics[topic.name] = topic.empty()
            self._roles.setdefault(topic.name, []).append(role)
        self._sizes = {
            role: _sizes(self._adapters[role], assembly.topics[role].messages()[0])
            for role in self._axes_and_origin
            if self._adapters[role].reads_table
        }

    def read(self, name: str, payload: bytes, log_time_ns: int) -> list[Part]:
        """What the message of a topic says, by role; nothing for a topic that is not used."""
        parts = []
        for role in self._roles.get(name, ()):
            topic = self._topics[name].empty()
            topic.gather(payload, ONE, np.array([len(payload)]), np.array([log_time_ns]))
            try:
                parts.append(self._part(role, topic))
            except Exception as error:  # whatever a sender sends
                fault = str(error).removeprefix(f"{topic.file}: topic {name}: ")
                parts.append(Part(role, log_time_ns, None, f"cannot be read: {fault or type(error).__name__}"))
        return parts

    def _part(self, role: str, topic: Topic) -> Part:
        adapter = self._adapters[role]
        if not adapter.reads_table:
            groups = topic.messages()
            block, dropped = rows_of(adapter, topic, self.calibration, *self._axes_and_origin[role])
            faults = ", ".join(topic.unsound | dropped)
            if not groups:
                raise LogError(faults)
            return Part(role, int(header_stamps_ns(groups[0], topic.log_times_ns)[0]), block, faults)
        table = adapter.table(topic)
        if _sizes(adapter, table.groups[0]) != self._sizes[role]:
            raise LogError("has arrays of another length than the first messages")
        block, dropped = rows_of(adapter, table, self.calibration, *self._axes_and_origin[role])
        return Part(role, int(table.stamps_ns[0]), block, ", ".join(topic.unsound | dropped))


def _sizes(adapter: Adapter, group: Messages) -> list[tuple[int, ...]]:
    """Number of elements of each field that an adapter reads."""
    return [group[field_of(path)[0]].shape[1:] for path in adapter.fields()]
