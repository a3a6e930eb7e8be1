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
from sonar_graph.live.live_messages import (
    Message,
    dropped_messages,
    gather,
    recorded_messages,
)
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
FORGOTTEN_NS = 60 * NS_PER_S
"""Time after which no detection of a step is dropped any more."""
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
    options
        Rate and lateness as of `Arrivals`; topics, their description and fields of a calibration as for `read_log`.

    Examples
    --------
    The messages of a log, as they would come:

    >>> from pathlib import Path
    >>> from sonar_graph import write_log
    >>> from sonar_graph.live import Engine, LiveOptions, definition_of, recorded_messages
    >>> from sonar_graph.logs import LiveRecord
    >>> from sonar_graph.testing import small_world
    >>> write_log("dive.mcap", small_world())
    >>> steps = []
    >>> with LiveRecord(Path("record.mcap")) as record:
    ...     engine = Engine(record, definition_of, LiveOptions(rate_hz=1.0))
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
        options: LiveOptions | None = None,
    ) -> None:
        self.options = options or LiveOptions()
        self.counts = Counts()
        self.calibration: Calibration | None = None
        """Known once the first seconds are over."""
        self.sequence: Sequence | None = None
        """What the messages of these were, with notes as `read_log` gives them."""
        self.log_time_ns = 0
        """Name of the newest message in the record."""
        self.record_path = record.path
        self.generation = 0
        """Number of times that all steps began anew, since a topic of a further sensor came late."""
        self.topics: dict[str, Topic] = {}
        """Topics that have sent."""
        self.remarks: list[str] = []
        """Lines for the user, who takes them away."""
        self.waits_for = ""
        """What the first messages lack."""
        self.in_use: dict[str, str] = {}
        """Topics by role."""
        self._record = record
        self._definition_of = definition_of
        self._config = self.options.config or LogConfig()
        self._arrivals = Arrivals(self.options.rate_hz, self.options.lateness_s)
        self._sonar: str | None = None
        """Frame of the sonar, once an image has come."""
        self._first: Held = []
        self._first_motion_ns: int | None = None
        self._set_up_ns = 0
        """Arrival of the message with which the set-up was tried last."""
        self._places: dict[str, Choice] = {}
        """Topics whose first rows make all begin anew."""
        self._unfit: set[str] = set()
        """Topics with which that failed."""
        self._reader: MessageReader | None = None
        self._sequence: dict[tuple[str, bytes], int] = {}
        self._detections: dict[int, list[tuple[str, int]]] = {}

    def take(self, message: Message) -> list[Part]:
        """Take in a message; the parts of it that count, at the end of the first seconds those of all until then."""
        name = message.topic
        number = message.sequence
        is_new = name not in self.topics
        if is_new:
            self._add_topic(message)
        self.counts.received[name] += 1
        if number:
            sender = (name, message.sender)
            last = self._sequence.get(sender, number - 1)
            self.counts.lost[name] += max(number - last - 1, 0)
            self._sequence[sender] = max(number, last)
        at_ns = self.log_time_ns = self._record.write(
            name, message.payload, message.arrival_ns, number, message.sent_ns
        )
        # of a sensor that began late
        if is_new and self._reader is not None:
            self._find_places()
        if self._reader is None:
            self._first.append((message, at_ns))
            is_set_up = self._is_time(message) and self._set_up(self._first)
            return self._all_parts(self._first) if is_set_up else []
        if name in self._places:
            rows, _ = self._rows_alone(self._places[name], message, at_ns)
            if rows is not None and (held := self._begin_anew(name)):
                return self._all_parts(held)
        found = self._reader.read(name, message.payload, at_ns)
        return self._parts(message, at_ns, found)

    def steps(self) -> Iterator[Measurements]:
        """Steps that are complete by now."""
        for step in self._arrivals.steps() if self._reader else ():
            # messages of steps long ago are not waited for
            for stamp_ns in list(self._detections):
                if stamp_ns <= step.end_ns - FORGOTTEN_NS:
                    del self._detections[stamp_ns]
            yield step

    def finish(self) -> Iterator[Measurements]:
        """Steps that are left when nothing more will come."""
        if self._reader is not None:
            yield from self._arrivals.rest()

    def without_detections(self, step: Measurements, arrival_ns: int) -> Measurements:
        """A step without its detections, for an estimator that is behind; the record names them."""
        if step.detections is not None:
            for stamp_ns in np.unique(step.detections.stamps_ns).tolist():
                for topic, at_ns in self._detections.pop(stamp_ns, ()):
                    self.drop(topic, at_ns, OVERLOADED, arrival_ns)
        return replace(step, detections=None)

    def drop(self, topic: str, log_time_ns: int, reason: str, arrival_ns: int) -> None:
        """Name a message in the record as not used."""
        self.counts.dropped[topic, reason] += 1
        self._record.drop(topic, log_time_ns, reason, arrival_ns)

    def _add_topic(self, message: Message) -> None:
        kind = message.type_name
        text = self._definition_of(kind)
        topic = Topic(
            self.record_path, message.topic, kind, "cdr", "ros2msg", text, Keep.ALL
        )
        topic.is_latched = message.topic.endswith("_static")
        self.topics[message.topic] = topic
        # the record must have the definition before the first message
        self._record.add_topic(topic)

    def _choices(self) -> dict[str, Choice]:
        """Choices by the topics alone, of whose messages nothing is kept."""
        recording = Recording(self.record_path, self.topics)
        return choose_each(recording, self.options.topics, self._config)

    def _find_places(self) -> None:
        """Find topics that are not in use and may be of a sensor that has none, such as detections that begin late."""
        taken = {None, *self.in_use.values(), *self._unfit}
        self._places = {
            str(choice.topic): choice
            for role, choice in self._choices().items()
            if role in BLOCKS.keys() - self.in_use.keys() and choice.topic not in taken
        }

    def _rows_alone(
        self, choice: Choice, message: Message, at_ns: int
    ) -> tuple[Any, bool]:
        """Rows of a message by itself, and whether it can be read; one that cannot is dropped."""
        topic = self.topics[message.topic].empty()
        gather(topic, message.payload, at_ns)
        adapter: Any = choice.adapter
        try:
            setup = Setup(self.calibration or Calibration())
            rows, _ = adapter.read(adapter.table(topic), setup)
        except Exception as error:  # whatever a sender sends
            fault = str(error).rpartition(": topic ")[2] or type(error).__name__
            reason = f"cannot be read: {fault}"
            self.drop(message.topic, at_ns, reason, message.arrival_ns)
            return None, False
        return rows, True

    def _begin_anew(self, name: str) -> Held:
        """Give all steps again from the record, with a sensor whose first rows came late; nothing where that fails.

        Its mounting is part of the calibration, which an estimator has from its beginning.
        """
        # the record is what is left of the messages until now
        self._record.flush()
        dropped = dropped_messages(self.record_path)
        needed = {*self.in_use.values(), *self._places}
        held = [  # without images, which would not fit into memory
            (message, message.arrival_ns)
            for message in recorded_messages(self.record_path)
            if (message.topic, message.arrival_ns) not in dropped
            and (message.topic in needed or message.topic.endswith("tf_static"))
        ]
        # without it everything goes on as before
        if not self._set_up(held):
            self._unfit.add(name)
            self.remarks.append(f"{name} is not used: {self.waits_for}")
            del self._places[name]
            return []
        self._detections.clear()
        self.generation += 1
        return held

    def _is_time(self, message: Message) -> bool:
        """True when it is time to choose topics and calibration: some seconds of both sensors of the motion."""
        now_ns = message.arrival_ns
        if self._first_motion_ns is None:
            motion = [self._choices()[role] for role in MOTION]
            if not all(choice.topic or choice.candidates for choice in motion):
                return False
            self._first_motion_ns = now_ns
            self._set_up_ns = now_ns
        # this computer's clock may be set back
        self._set_up_ns = min(self._set_up_ns, now_ns)
        # the longer it was in vain, the less often it is tried
        waited_ns = self._set_up_ns - self._first_motion_ns
        is_time = now_ns - self._set_up_ns >= max(SETUP_NS, waited_ns // 8)
        if is_time:
            self._set_up_ns = now_ns
        return is_time

    def _set_up(self, held: Held) -> bool:
        """Choose topics and gather the calibration from messages; False where they are not enough yet."""
        wanted = dict(self.options.topics) | self.in_use
        try:
            choices = choose_topics(self._recording(held), wanted, self._config)
        except MissingTopicError as error:  # it may still come
            self.waits_for = str(error)
            return False
        except LogError as error:  # several topics fit
            if self.options.topics.keys() - ROLES.keys():
                raise
            self.waits_for = f"{error}; everything is recorded: end with Ctrl-C, and begin again with a choice"
            return False
        # detections that break their own rules would make the topic useless
        detections = choices["detections"]
        held[:] = [
            one
            for one in held
            if one[0].topic != detections.topic or self._rows_alone(detections, *one)[1]
        ]
        recording = self._recording(held)
        try:
            sonar = sonar_frame(recording, wanted.get("sonar"), self._config)
            self._sonar = sonar or self._sonar
            dvl: Any = choices["dvl"].adapter
            choices["dvl"] = replace(choices["dvl"], adapter=dvl.at_first())
            given = self.options.calibration
            assembly = Assembly(recording, choices, given, self._sonar)
            # a sensor of no use may become one later
            for role, choice in choices.items():
                if not _is_of_use(assembly, role):
                    choices[role] = replace(choice, topic=None, adapter=None)
            tables = pinned(self._config, choices, assembly)
            # as a later reading of the record has it
            plain = json.loads(json.dumps(tables))
            config = LogConfig.parse(plain, self._config.source)
            # by the pinned configuration, as single messages are read from now on
            as_read = choose_topics(recording, {}, config)
            assembly = Assembly(recording, as_read, given, self._sonar)
            sequence = assembly.sequence("live")
            reader = MessageReader(assembly)
        except SonarGraphError as error:
            if str(error) != self.waits_for and self._reader is None:
                self.remarks.append(f"waiting: {error}")
            self.waits_for = str(error)
            return False
        self.waits_for = ""
        self._reader = reader
        self.sequence = sequence
        self.calibration = sequence.calibration
        trees = (at for message, at in held if message.topic.endswith("tf_static"))
        said = {
            LIVE_RATE: repr(float(self.options.rate_hz)),
            LATENESS: repr(float(self.options.lateness_s)),
        }
        about = (self.record_path.stem, self.calibration, tables, said)
        self._record.describe(*about, max(trees, default=0))
        self._arrivals = Arrivals(self.options.rate_hz, self.options.lateness_s)
        self.in_use = {role: c.topic for role, c in choices.items() if c.topic}
        self._find_places()
        return True

    def _recording(self, held: Held) -> Recording:
        topics = {name: topic.empty() for name, topic in self.topics.items()}
        for message, at_ns in held:
            gather(topics[message.topic], message.payload, at_ns)
        return Recording(self.record_path, topics)

    def _all_parts(self, held: Held) -> list[Part]:
        """Parts of all messages until now, after the usual difference of their stamps from their arrival is known."""
        assert self._reader is not None
        read = self._reader.read
        found = [
            (message, at_ns, read(message.topic, message.payload, at_ns))
            for message, at_ns in held
        ]
        first_ns = held[0][0].arrival_ns if held else 0
        offsets_ns = sorted(
            part.stamp_ns - message.arrival_ns
            for message, _, parts in found
            for part in parts
            if not part.fault and message.arrival_ns < first_ns + SETUP_NS
        )
        # the median, since the first message may be the wrong one
        if offsets_ns:
            usual_ns = offsets_ns[len(offsets_ns) // 2]
            self._arrivals.expect(first_ns + usual_ns, first_ns)
        self._first = []
        return [part for one in found for part in self._parts(*one)]

    def _parts(self, message: Message, at_ns: int, found: list[Part]) -> list[Part]:
        """Parts that are in time and can be read; a message without such a part is dropped."""
        parts = []
        reasons = []
        for part in found:
            # of some rows only: these are left out of a log too
            reason: str | None = part.fault if part.block is None else ""
            reason = reason or self._arrivals.add(
                part.role, part.stamp_ns, part.block, message.arrival_ns
            )
            if reason:
                reasons.append(reason)
                continue
            parts.append(part)
            if part.role == "detections" and part.block is not None:
                names = self._detections.setdefault(part.stamp_ns, [])
                names.append((message.topic, at_ns))
        if reasons and not parts:
            self.drop(message.topic, at_ns, reasons[0], message.arrival_ns)
        return parts


def _is_of_use(assembly: Assembly, role: str) -> bool:
    """True if an optional sensor has sent what its calibration needs: a valid message, and a fix on the Earth."""
    topic = assembly.topics.get(role)
    if topic is None or role in MOTION or role not in BLOCKS:
        return True
    is_geodetic = getattr(assembly.adapters[role], "geodetic", None) is not None
    has_origin = not is_geodetic or assembly.setup(role).origin is not None
    return bool(topic.messages()) and has_origin
