"""Reading of single messages as they arrive, by the adapters with which a log of them is read."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.logs import Assembly, rows_of
from sonar_graph.logs.adapters import header_stamps_ns
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
    seconds gave (`Assembly`). What a whole log decides is decided by these: accelerations of zero are "not measured"
    where they are in all of them.
    """

    def __init__(self, assembly: Assembly) -> None:
        self.calibration = assembly.calibration
        imu = assembly.block("imu")
        has_force = imu is not None and bool(np.isfinite(imu.specific_force).any())
        self._adapters = assembly.adapters | {
            "imu": assembly.adapters["imu"].model_copy(update={"are_zeros_measured": has_force})
        }
        self._axes_and_origin = {role: assembly.axes_and_origin(role) for role in assembly.topics if role in BLOCKS}
        self._topics: dict[str, Topic] = {}
        self._roles: dict[str, list[str]] = {}
        for role in self._axes_and_origin:
            topic = assembly.topics[role]
            self._topics[topic.name] = topic.empty()
            self._roles.setdefault(topic.name, []).append(role)

    def read(self, name: str, payload: bytes, log_time_ns: int) -> list[Part]:
        """What the message of a topic says, by role; nothing for a topic that is not used."""
        parts = []
        for role in self._roles.get(name, ()):
            topic = self._topics[name].empty()
            topic.gather(payload, ONE, np.array([len(payload)]), np.array([log_time_ns]))
            try:
                parts.append(self._part(role, topic, log_time_ns))
            except LogError as error:
                parts.append(Part(role, log_time_ns, None, ", ".join(topic.unsound) or str(error)))
        return parts

    def _part(self, role: str, topic: Topic, log_time_ns: int) -> Part:
        adapter = self._adapters[role]
        if not adapter.reads_table:
            groups = topic.messages()
            block, dropped = rows_of(adapter, topic, self.calibration, *self._axes_and_origin[role])
            stamp_ns = int(header_stamps_ns(groups[0], topic.log_times_ns)[0]) if groups else log_time_ns
            return Part(role, stamp_ns, block, ", ".join(topic.unsound | dropped))
        table = adapter.table(topic)
        block, dropped = rows_of(adapter, table, self.calibration, *self._axes_and_origin[role])
        return Part(role, int(table.stamps_ns[0]), block, ", ".join(topic.unsound | dropped))
