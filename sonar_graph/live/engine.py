"""From messages in the order of arrival to steps of an estimator, with a record of everything that came.

The first seconds serve to choose topics and to gather the calibration, by the code that reads a log. From then on each
message is written to the record, read, and waits for its step (`sonar_graph.live.arrivals`). A message that is not used
is named in the record: what `read_log` gives of the record are the steps that the engine gave. There is no clock here;
a log that is played and a robot are the same.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.errors import LogError, MissingTopicError, SonarGraphError
from sonar_graph.live.arrivals import MOTION, Arrivals
from sonar_graph.live.live_messages import Message, dropped_messages, recorded_messages
from sonar_graph.live.message_reader import MessageReader, Part
from sonar_graph.logs import (
    LATENESS,
    LIVE_RATE,
    ROLES,
    Assembly,
    Choice,
    LiveRecord,
    PartialCalibration,
    choose_each,
    choose_topics,
    pinned,
    sonar_frame,
)
from sonar_graph.logs.adapters import LogConfig, Setup
from sonar_graph.logs.mcap import Keep, Recording, Topic
from sonar_graph.measurements import BLOCKS, NS_PER_S, Measurements
from sonar_graph.sequence import Sequence

OVERLOADED = "overload: the estimator was behind"
SETUP_NS = 2 * NS_PER_S
Held = list[tuple[Message, int]]
"""Messages with their log times."""


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
    """Choices of a live run.

    Examples
    --------
    >>> from sonar_graph.live import LiveOptions
    >>> options = LiveOptions(overrides={"history.policy": "bounded"}, lateness_s=0.5)
    >>> options.estimator, options.rate_hz
    ('isam2', 10.0)
    """

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

    Examples
    --------
    The messages of a log, as they would come:

    >>> from pathlib import Path
    >>> from sonar_graph import write_log
    >>> from sonar_graph.live import Engine, definition_of, recorded_messages
    >>> from sonar_graph.logs import LiveRecord
    >>> from sonar_graph.testing import small_world
    >>> write_log("dive.mcap", small_world())
    >>> steps = []
    >>> with LiveRecord(Path("record.mcap")) as record:
    ...     engine = Engine(record, definition_of, rate_hz=1.0)
    ...     for message in recorded_messages(Path("dive.mcap")):
    ...         parts = engine.take(message)
    ...         steps += engine.steps()
    ...     steps += engine.finish()
    >>> len(steps)
    20
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
        self.notes: dict[str, str] = {}
        """Notes of these, as `read_log` gives them."""
        self.record_path = record.path
        self._record = record
        self._definition_of = definition_of
        self._arrivals = Arrivals(rate_hz, lateness_s)
        self.generation = 0
        """Number of times that all steps began anew, since a topic of a further sensor came late."""
        self._rate_hz, self._lateness_s = rate_hz, lateness_s
        self._said = {
            LIVE_RATE: repr(float(rate_hz)),
            LATENESS: repr(float(lateness_s)),
        }
        self._wanted, self._config, self._given = (
            dict(wanted or {}),
            config or LogConfig(),
            calibration,
        )
        self.topics: dict[str, Topic] = {}
        """Topics that have sent."""
        self.remarks: list[str] = []
        """Lines for the user, who takes them away."""
        self.waits_for = ""
        """What the first messages lack."""
        self._sonar: str | None = None
        """Frame of the sonar, once an image has come."""
        self._first: Held = []
        self._first_motion_ns: int | None = None
        self._set_up_ns = 0
        """Arrival of the message with which the set-up was tried last."""
        self.in_use: dict[str, str] = {}
        """Topics by role."""
        self._places: dict[str, Choice] = {}
        """Topics whose first rows make all begin anew."""
        self._unfit: set[str] = set()
        """Topics with which that failed."""
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
                self.counts.lost[name] += max(
                    message.sequence - self._sequence[place] - 1, 0
                )
            self._sequence[place] = max(message.sequence, self._sequence.get(place, 0))
        log_time_ns = self.log_time_ns = self._record.write(
            name, message.payload, message.arrival_ns, message.sequence, message.sent_ns
        )
        if is_new and self._reader is not None:
            self._find_places()
        if dropped == OVERLOADED:  # all other reasons are found again
            self.drop(name, log_time_ns, OVERLOADED, message.arrival_ns)
            return []
        if self._reader is None:
            self._first.append((message, log_time_ns))
            return (
                self._all_parts(self._first)
                if self._is_time(message) and self._set_up(self._first)
                else []
            )
        if (
            name in self._places
            and self._brings_rows(message, log_time_ns)
            and (held := self._begin_anew(name))
        ):
            return self._all_parts(held)
        return self._parts(
            message, log_time_ns, self._reader.read(name, message.payload, log_time_ns)
        )

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
        topic = Topic(
            self.record_path,
            message.topic,
            kind,
            "cdr",
            "ros2msg",
            text,
            Keep.ALL,
            is_latched=is_latched,
        )
        self.topics[message.topic] = topic
        self._record.add_topic(topic)

    def _find_places(self) -> None:
        """Find topics that are not in use and may be of a sensor that has none, such as detections that begin late."""
        choices = choose_each(
            Recording(self.record_path, self.topics), self._wanted, self._config
        )
        self._places = {
            choice.topic: choice
            for role, choice in choices.items()
            if role in BLOCKS.keys() - self.in_use.keys()
            and choice.topic is not None
            and choice.topic not in {*self.in_use.values(), *self._unfit}
        }

    def _brings_rows(self, message: Message, log_time_ns: int) -> bool:
        """Tell whether a message has the first rows of its sensor; one that cannot be read is dropped."""
        assert self.calibration is not None
        choice = self._places[message.topic]
        try:
            block = _rows_in(
                choice,
                self.topics[message.topic],
                [(message, log_time_ns)],
                self.calibration,
            )
        except Exception as error:  # whatever a sender sends
            self.drop(
                message.topic, log_time_ns, _unreadable(error), message.arrival_ns
            )
            return False
        return block is not None

    def _begin_anew(self, name: str) -> Held:
        """Give all steps again from the record, with a sensor whose first rows came late; nothing where that fails.

        Its mounting is part of the calibration, which an estimator has from its beginning.
        """
        self._record.flush()
        dropped, needed = (
            dropped_messages(self.record_path),
            {*self.in_use.values(), *self._places},
        )
        held = [  # without images, which would not fit into memory
            (message, message.arrival_ns)
            for message in recorded_messages(self.record_path)
            if (message.topic, message.arrival_ns) not in dropped
            and (message.topic in needed or message.topic.endswith("tf_static"))
        ]
        if not self._set_up(held):
            self._unfit.add(name)
            self.remarks.append(f"{name} is not used: {self.waits_for}")
            del self._places[name]
            return []
        self._detections.clear()
        self.generation += 1
        return held

    def _is_time(self, message: Message) -> bool:
        """Tell whether it is time to choose topics and calibration: some seconds of both sensors of the motion."""
        if self._first_motion_ns is None:
            choices = choose_each(
                Recording(self.record_path, self.topics), self._wanted, self._config
            )
            if not all(
                choices[role].topic or choices[role].candidates for role in MOTION
            ):
                return False
            self._first_motion_ns = self._set_up_ns = message.arrival_ns
        since_ns = message.arrival_ns - self._set_up_ns
        if since_ns < 0:  # this computer's clock was set
            self._set_up_ns = message.arrival_ns
        waited_ns = self._set_up_ns - self._first_motion_ns
        if since_ns < max(SETUP_NS, waited_ns // 8):
            return False
        self._set_up_ns = message.arrival_ns
        return True

    def _set_up(self, held: Held) -> bool:
        """Choose topics and gather the calibration from messages; False where they are not enough yet."""
        wanted = self._wanted | self.in_use
        recording = self._recording(held)
        try:
            choices = choose_topics(recording, wanted, self._config)
        except MissingTopicError as error:  # it may still come
            self.waits_for = str(error)
            return False
        except LogError as error:  # several topics fit
            if self._wanted.keys() - ROLES.keys():
                raise
            again = f"everything is recorded: end with Ctrl-C, and go on with --resume {self.record_path} and a choice"
            self.waits_for = f"{error}; {again}"
            return False
        if unreadable := self._unreadable_detections(choices["detections"], held):
            held[:] = [one for one in held if one not in unreadable]
            recording = self._recording(held)
        try:
            self._sonar = (
                sonar_frame(recording, wanted.get("sonar"), self._config) or self._sonar
            )
            dvl: Any = choices["dvl"].adapter
            choices["dvl"] = replace(choices["dvl"], adapter=dvl.at_first())
            assembly = Assembly(recording, choices, self._given, self._sonar)
            choices = {
                role: choice
                if _is_of_use(assembly, role)
                else replace(choice, topic=None, adapter=None)
                for role, choice in choices.items()
            }
            assembly = Assembly(recording, choices, self._given, self._sonar)
            tables = pinned(self._config, choices, assembly)
            config = LogConfig.parse(
                json.loads(json.dumps(tables)), self._config.source
            )
            assembly = Assembly(
                recording,
                choose_topics(recording, {}, config),
                self._given,
                self._sonar,
            )
            sequence = assembly.sequence("live")
            reader = MessageReader(assembly)
        except SonarGraphError as error:
            if str(error) != self.waits_for and self._reader is None:
                self.remarks.append(f"waiting: {error}")
            self.waits_for = str(error)
            return False
        self.waits_for = ""
        frames_ns = max(
            (at_ns for message, at_ns in held if message.topic.endswith("tf_static")),
            default=0,
        )
        self.sequence, self.calibration, self.notes = (
            sequence,
            sequence.calibration,
            sequence.notes,
        )
        self._reader = reader
        self._record.describe(
            self.record_path.stem, self.calibration, tables, self._said, frames_ns
        )
        self._arrivals = Arrivals(self._rate_hz, self._lateness_s)
        self.in_use = {
            role: choice.topic
            for role, choice in choices.items()
            if choice.topic is not None
        }
        self._find_places()
        return True

    def _recording(self, held: Held) -> Recording:
        topics = {name: topic.empty() for name, topic in self.topics.items()}
        for message, log_time_ns in held:
            _gather(topics[message.topic], message, log_time_ns)
        return Recording(self.record_path, topics)

    def _unreadable_detections(self, choice: Choice, held: Held) -> Held:
        """Messages of detections that break their own rules, which would make the topic useless; they are dropped."""
        found: Held = []
        for message, log_time_ns in held:
            if message.topic == choice.topic:
                try:
                    _rows_in(
                        choice,
                        self.topics[message.topic],
                        [(message, log_time_ns)],
                        Calibration(),
                    )
                except Exception as error:  # whatever a sender sends
                    found.append((message, log_time_ns))
                    self.drop(
                        message.topic,
                        log_time_ns,
                        _unreadable(error),
                        message.arrival_ns,
                    )
        return found

    def _all_parts(self, held: Held) -> list[Part]:
        """Parts of all messages until now, after the usual difference of their stamps from their arrival is known."""
        assert self._reader is not None
        found = [
            (m, at_ns, self._reader.read(m.topic, m.payload, at_ns))
            for m, at_ns in held
        ]
        first_ns = found[0][0].arrival_ns if found else 0
        offsets_ns = sorted(
            part.stamp_ns - message.arrival_ns
            for message, _, parts in found
            for part in parts
            if not part.fault and message.arrival_ns < first_ns + SETUP_NS
        )
        if offsets_ns:
            self._arrivals.expect(first_ns + offsets_ns[len(offsets_ns) // 2], first_ns)
        self._first = []
        return [
            part for m, at_ns, parts in found for part in self._parts(m, at_ns, parts)
        ]

    def _parts(
        self, message: Message, log_time_ns: int, found: list[Part]
    ) -> list[Part]:
        parts, reasons = [], []
        for part in found:
            # of some rows only: these are left out of a log too
            fault = part.fault if part.block is None else ""
            reason = fault or self._arrivals.add(
                part.role, part.stamp_ns, part.block, message.arrival_ns
            )
            if reason:
                reasons.append(reason)
                continue
            parts.append(part)
            if part.role == "detections" and part.block is not None:
                self._detections.setdefault(part.stamp_ns, []).append(
                    (message.topic, log_time_ns)
                )
        if reasons and not parts:
            self.drop(message.topic, log_time_ns, reasons[0], message.arrival_ns)
        return parts

    def _counted(self, step: Measurements) -> Measurements:
        """A step, after which its messages are no longer waited for."""
        for stamp_ns in [
            stamp_ns
            for stamp_ns in self._detections
            if stamp_ns <= step.end_ns - 60 * NS_PER_S
        ]:
            del self._detections[stamp_ns]
        return step

    def drop(self, topic: str, log_time_ns: int, reason: str, arrival_ns: int) -> None:
        """Name a message in the record as not used."""
        self.counts.dropped[topic, reason] += 1
        self._record.drop(topic, log_time_ns, reason, arrival_ns)


def _gather(topic: Topic, message: Message, log_time_ns: int) -> None:
    topic.gather(
        message.payload,
        np.zeros(1, np.int64),
        np.array([len(message.payload)]),
        np.array([log_time_ns]),
    )


def _rows_in(choice: Choice, topic: Topic, held: Held, calibration: Calibration) -> Any:
    """Rows of some messages by themselves; None where they have none."""
    topic = topic.empty()
    for message, log_time_ns in held:
        _gather(topic, message, log_time_ns)
    adapter: Any = choice.adapter
    block, _ = adapter.read(adapter.table(topic), Setup(calibration))
    return block


def _is_of_use(assembly: Assembly, role: str) -> bool:
    """Tell whether an optional sensor has sent what its calibration needs: a sound message, and a fix on the Earth."""
    topic = assembly.topics.get(role)
    if topic is None or role in MOTION or role not in BLOCKS:
        return True
    if not topic.messages():
        return False
    adapter = assembly.adapters[role]
    return (
        getattr(adapter, "geodetic", None) is None
        or assembly.setup(role).origin is not None
    )


def _unreadable(error: Exception) -> str:
    return f"cannot be read: {str(error).rpartition(': topic ')[2] or type(error).__name__}"
