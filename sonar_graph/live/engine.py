"""From messages in the order of arrival to steps of an estimator, with a record of everything that came.

The first seconds serve to choose topics and to gather the calibration, by the code that reads a log. From then on each
message is written to the record, read, and waits for its step (`sonar_graph.live.arrivals`). A message that is not used
is named in the record: what `read_log` gives of the record are the steps that the engine gave. There is no clock here;
a log that is played and a robot are the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.errors import MissingTopicError
from sonar_graph.live.arrivals import Arrivals
from sonar_graph.live.live_messages import Message, dropped_messages, recorded_messages
from sonar_graph.live.message_reader import MessageReader, Part
from sonar_graph.logs import (
    LATENESS,
    LIVE_RATE,
    Assembly,
    LiveRecord,
    PartialCalibration,
    choose_each,
    choose_topics,
    pinned,
)
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.logs.mcap import Keep, Recording, Topic
from sonar_graph.measurements import BLOCKS, NS_PER_S, Measurements
from sonar_graph.sequence import Sequence

OVERLOADED = "overload: the estimator was behind"
SETUP_NS = 2 * NS_PER_S


@dataclass
class Counts:
    """Numbers of messages by topic."""

    received: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)
    """Numbers that are missing between the sequence numbers of a sender."""
    dropped: Counter[tuple[str, str]] = field(default_factory=Counter)
    """By topic and reason."""


@dataclass
class LiveOptions:
    """Choices of a live run."""

    estimator: str = "isam2"
    overrides: Mapping[str, Any] = field(default_factory=dict)
    rate_hz: float = 10.0
    lateness_s: float = 0.25
    topics: Mapping[str, str] = field(default_factory=dict)
    config: LogConfig | None = None
    calibration: PartialCalibration | None = None


class Engine:
    """Steps of an estimator from messages.

    Parameters
    ----------
    record
        Record, to which everything goes.
    definition_of
        Function that gives the definition of a message type.
    rate_hz, lateness_s
        As of `Arrivals`.
    wanted, config, calibration
        Topics by role, description of topics, and fields of a calibration, as for `read_log`.
    """

    def __init__(
        self,
        record: LiveRecord,
        definition_of: Callable[[str], str],
        *,
        rate_hz: float = 10.0,
        lateness_s: float = 0.25,
        wanted: Mapping[str, str] | None = None,
        config: LogConfig | None = None,
        calibration: PartialCalibration | None = None,
    ) -> None:
        self.counts = Counts()
        self.calibration: Calibration | None = None
        """Known once the first seconds are over."""
        self.sequence: Sequence | None = None
        """What the messages of these were."""
        self.log_time_ns = 0
        """Name of the newest message in the record."""
        self.waits_for = ""
        """What the first messages lack."""
        self.notes: dict[str, str] = {}
        """Notes of these, as `read_log` gives them."""
        self.record_path = record.path
        self._record = record
        self._definition_of = definition_of
        self._arrivals = Arrivals(rate_hz, lateness_s)
        self.generation = 0
        """Number of times that all steps began anew, since a topic of a further sensor came late."""
        self._rate_hz, self._lateness_s = rate_hz, lateness_s
        self._said = {LIVE_RATE: f"{rate_hz:g}", LATENESS: f"{lateness_s:g}"}
        self._wanted, self._config, self._given = dict(wanted or {}), config or LogConfig(), calibration
        self.topics: dict[str, Topic] = {}
        """Topics that have sent."""
        self._first: list[tuple[Message, int]] = []
        self._dropped: dict[tuple[str, int], str] = {}
        """Messages that were dropped before all began anew."""
        self._first_motion_ns: int | None = None
        self.in_use: set[str] = set()
        """Roles that have a topic."""
        self._reader: MessageReader | None = None
        self._sequence: dict[tuple[str, bytes], int] = {}
        self._detections: dict[int, list[tuple[str, int]]] = {}

    def take(self, message: Message, dropped: str | None = None) -> list[Part]:
        """Take in a message; the parts of it that count, at the end of the first seconds those of all until then.

        ``dropped``: reason for which an earlier run, whose record this is, dropped it for being behind.
        """
        name = message.topic
        is_new = name not in self.topics
        if is_new:
            self._add_topic(message)
        self.counts.received[name] += 1
        if message.sequence:
            place = name, message.sender
            if place in self._sequence:
                self.counts.lost[name] += max(message.sequence - self._sequence[place] - 1, 0)
            self._sequence[place] = max(message.sequence, self._sequence.get(place, 0))
        log_time_ns = self.log_time_ns = self._record.write(
            name, message.payload, message.arrival_ns, message.sequence, message.sent_ns
        )
        if dropped == OVERLOADED:  # all other reasons are found again
            self.drop(name, log_time_ns, OVERLOADED, message.arrival_ns)
            return []
        if is_new and self._reader is not None and self._brings_a_sensor(message):
            self._begin_anew()
        elif self._reader is not None:
            return self._parts(message, log_time_ns)
        else:
            self._first.append((message, log_time_ns))
        if not self._is_set_up(message):
            return []
        held = [(m, ns) for m, ns in self._first if (m.topic, ns) not in self._dropped]
        self._first.clear()
        return [part for m, ns in held for part in self._parts(m, ns)]

    def steps(self) -> Iterator[Measurements]:
        """Steps that are complete by now."""
        if self._reader is not None:
            yield from map(self._counted, self._arrivals.steps())

    def finish(self) -> Iterator[Measurements]:
        """Steps that are left when nothing more will come."""
        if self._reader is not None:
            yield from map(self._counted, self._arrivals.rest())

    def without_detections(self, step: Measurements, arrival_ns: int) -> Measurements:
        """A step without its detections, for an estimator that is behind; the record says so."""
        if step.detections is not None:
            for stamp_ns in np.unique(step.detections.stamps_ns).tolist():
                for topic, log_time_ns in self._detections.pop(stamp_ns, ()):
                    self.drop(topic, log_time_ns, OVERLOADED, arrival_ns)
        return replace(step, detections=None)

    def _add_topic(self, message: Message) -> None:
        is_latched = message.topic.endswith("_static")
        text = self._definition_of(message.type_name)
        kind = message.type_name
        topic = Topic(self.record_path, message.topic, kind, "cdr", "ros2msg", text, Keep.ALL, is_latched=is_latched)
        self.topics[message.topic] = topic
        self._record.add_topic(topic)

    def _brings_a_sensor(self, message: Message) -> bool:
        """Tell whether the first message of a topic is of a sensor that had none, such as the first detections."""
        topics = {message.topic: self._gathered([(message, message.arrival_ns)])[message.topic]}
        choices = choose_each(Recording(self.record_path, topics), self._wanted, self._config)
        return any(c.topic is not None for role, c in choices.items() if role in BLOCKS.keys() - self.in_use)

    def _gathered(self, held: list[tuple[Message, int]]) -> dict[str, Topic]:
        """Topics with some messages and their log times."""
        topics = {name: topic.empty() for name, topic in self.topics.items()}
        for message, log_time_ns in held:
            size = np.array([len(message.payload)])
            topics[message.topic].gather(message.payload, np.zeros(1, np.int64), size, np.array([log_time_ns]))
        return topics

    def _begin_anew(self) -> None:
        """Give all steps again from the record, with a sensor whose topic came late.

        Its mounting is part of the calibration, which an estimator has from its beginning.
        """
        self._record.flush()
        self._first = [(message, message.arrival_ns) for message in recorded_messages(self.record_path)]
        self._dropped = dropped_messages(self.record_path)
        self._arrivals, self._reader = Arrivals(self._rate_hz, self._lateness_s), None
        self._detections.clear()
        self.generation += 1

    def _is_set_up(self, message: Message) -> bool:
        """Try to choose topics and calibration; True once that is done."""
        if self._first_motion_ns is None:
            choices = choose_each(Recording(self.record_path, self.topics), self._wanted, self._config)
            has_both = all(choices[role].topic or choices[role].candidates for role in ("imu", "dvl"))
            self._first_motion_ns = message.arrival_ns if has_both else None
        if self._first_motion_ns is None or message.arrival_ns < self._first_motion_ns + SETUP_NS:
            return False
        recording = Recording(self.record_path, self._gathered(self._first))
        try:
            choices = choose_topics(recording, self._wanted, self._config)
        except MissingTopicError as error:  # it may still come
            self._first_motion_ns, self.waits_for = message.arrival_ns, str(error)
            return False
        assembly = Assembly(recording, choices, self._given)
        sequence = assembly.sequence("live")
        self.sequence, self.calibration, self.notes = sequence, sequence.calibration, sequence.notes
        self._record.describe(self.record_path.stem, self.calibration, pinned(self._config, choices), self._said)
        self._reader = MessageReader(assembly)
        self._wanted = {role: choice.topic for role, choice in choices.items() if choice.topic is not None}
        self.in_use = set(self._wanted)
        return True

    def _parts(self, message: Message, log_time_ns: int) -> list[Part]:
        assert self._reader is not None
        parts, reasons = [], []
        found = self._reader.read(message.topic, message.payload, log_time_ns)
        for part in found:
            reason = part.fault or self._arrivals.add(part.role, part.stamp_ns, part.block, message.arrival_ns)
            if reason:
                reasons.append(reason)
                continue
            parts.append(part)
            if part.role == "detections" and part.block is not None:
                self._detections.setdefault(part.stamp_ns, []).append((message.topic, log_time_ns))
        if reasons and not parts:
            self.drop(message.topic, log_time_ns, reasons[0], message.arrival_ns)
        return parts

    def _counted(self, step: Measurements) -> Measurements:
        """A step, after which its messages are no longer waited for."""
        for stamp_ns in [stamp_ns for stamp_ns in self._detections if stamp_ns <= step.end_ns - 60 * NS_PER_S]:
            del self._detections[stamp_ns]
        return step

    def drop(self, topic: str, log_time_ns: int, reason: str, arrival_ns: int) -> None:
        """Name a message in the record as not used."""
        self.counts.dropped[topic, reason] += 1
        self._record.drop(topic, log_time_ns, reason, arrival_ns)
