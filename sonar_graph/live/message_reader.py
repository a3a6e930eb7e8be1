"""Reading of single messages as they arrive, by the adapters with which a log of them is read.

An adapter reads columns of many messages at once, here of one message: rows are those of the log to the bit. An IMU
message takes some 0.2 ms.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from sonar_graph.errors import LogError
from sonar_graph.live.live_messages import gather
from sonar_graph.logs import Assembly
from sonar_graph.logs.adapters import Adapter, field_of
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.mcap import Topic
from sonar_graph.measurements import BLOCKS


class Part(NamedTuple):
    """Content of a message in one role."""

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

    def read(self, name: str, payload: bytes, log_time_ns: int) -> list[Part]:
        """Content of a message of a topic, by role; nothing for a topic that is not used."""
        parts = []
        for role in self._roles.get(name, ()):
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
        return Part(role, int(table.stamps_ns[0]), block, faults)


def _sizes(adapter: Adapter, group: Messages) -> list[tuple[int, ...]]:
    """Number of elements of each field that an adapter reads."""
    return [group[field_of(path)[0]].shape[1:] for path in adapter.fields_used()]
