"""Sonar images of a live run: from messages to the recogniser, and its detections back.

Detections are a topic of their own, recorded like those of a robot that detects by itself: estimates of the record are
those of the live run, whatever was dropped before the recogniser.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from typing import Any

from sonar_graph.images import NO_DEPTH, NO_HEIGHT, SonarFrames
from sonar_graph.live.arrivals import append, joined
from sonar_graph.live.engine import Engine
from sonar_graph.live.live_messages import Message, gather
from sonar_graph.live.message_reader import Part
from sonar_graph.live.sonar_worker import (
    OVERTAKEN,
    SonarAnswer,
    SonarBegin,
    SonarRows,
    SonarWorker,
    Waiting,
)
from sonar_graph.logs import choose_topics
from sonar_graph.logs.adapters import LogConfig, SonarAdapter
from sonar_graph.logs.mcap import Recording
from sonar_graph.sequence import Sequence

SONAR = "sonar"
ROLES = ("imu", "dvl", "depth")
UNREADABLE = "no sonar image"
ENDED = "not recognised: the run ended"
FAILED = "not recognised: recognition failed"
TOO_EARLY = (
    "not recognised: of the first seconds, which give the calibration and the templates"
)


class LiveImages:
    """Images of the one sonar topic, where no detections come from elsewhere.

    The recogniser begins with the first image after the first seconds, whose ranges and beams decide which templates it
    draws, for some seconds. From then on an image goes to it as soon as an IMU row at or after it has come.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._topic = ""
        self._adapter: SonarAdapter | None = None
        self._seen: deque[SonarAnswer] = deque()
        self._is_off = "detections" in engine.options.topics
        self._worker = None if self._is_off else SonarWorker(self._seen.append)
        self.waiting = 0
        """Number of images that the recogniser has and has not answered, with the one that it begins with."""
        self._has_first = False
        self._begins = False
        self._rows: dict[str, list[Any]] = {role: [] for role in ROLES}
        self._images: deque[tuple[str, int, SonarFrames]] = deque()
        """By topic and log time."""
        self._newest_ns: dict[str, int] = {}
        self._known: set[str] = set()

    def wait(self) -> None:
        """Wait until the recogniser has compiled what it needs."""
        if self._worker is not None:
            self._worker.is_warm.wait()

    def take(self, message: Message, parts: list[Part]) -> None:
        """Take in a message and what counts of it."""
        sequence = self._engine.sequence
        if self._is_off or self._worker is None or sequence is None:
            return
        if not self._newest_ns:
            # the recogniser begins with the rows of the first seconds
            self._newest_ns = dict.fromkeys(ROLES, 0)
            for role, block in sequence.blocks().items():
                self._newest_ns[role] = int(block.stamps_ns[-1])
        for part in parts:
            is_of_use = part.role in ROLES and part.block is not None
            if is_of_use and part.stamp_ns > self._newest_ns[part.role]:
                append(self._rows[part.role], part.block)
                self._newest_ns[part.role] = part.stamp_ns
        # images may come long before or after the other sensors
        if not self._topic:
            self._find(message)
        if message.topic == self._topic and self._adapter is not None:
            self._read(message, self._adapter, sequence)
        while self._images:
            topic, at_ns, frame = self._images[0]
            # a track needs the motion up to its image
            if frame.stamps_ns[0] > self._newest_ns["imu"]:
                break
            self._images.popleft()
            rows = {
                role: joined(blocks) for role, blocks in self._rows.items() if blocks
            }
            self._rows = {role: [] for role in ROLES}
            waiting = Waiting(topic, at_ns, SonarRows(**rows, frame=frame))
            self.waiting += 1
            for one in self._worker.add(waiting):
                self.waiting -= 1
                at = (one.topic, one.log_time_ns)
                self._engine.drop(*at, OVERTAKEN, message.arrival_ns)

    def recognised(self) -> Iterator[SonarAnswer]:
        """Detections of images since the last call."""
        if self._begins and self._worker and self._worker.has_begun.is_set():
            self._begins = False
            self.waiting -= 1
            self._too_early()
        while self._seen:
            self.waiting -= 1
            yield self._seen.popleft()

    def failure(self) -> str | None:
        """Why recognition has ended, given once; None: it has not."""
        error = self._worker.error if self._worker and self._topic else None
        if self._is_off or error is None:
            return None
        self._count_left(FAILED)
        return f"recognition of landmarks failed: {error}; images are still recorded"

    def finish(self) -> None:
        """Count the images that were not recognised when the run ended."""
        if not self._is_off:
            self._count_left(ENDED)

    def _count_left(self, reason: str) -> None:
        left = self.waiting + len(self._images)
        if left:
            self._engine.counts.dropped[self._topic, reason] += left
        self._is_off = True
        self.waiting = 0
        self._images.clear()

    def end(self) -> None:
        """End the recogniser's process."""
        if self._worker is not None:
            self._worker.end()

    def _find(self, message: Message) -> None:
        """Begin to recognise where a sonar sends and nothing else detects."""
        engine = self._engine
        if "detections" in engine.in_use:
            self._is_off = True
            # poses do not wait for its end
            threading.Thread(target=self.end, daemon=True).start()
            return
        if engine.topics.keys() == self._known:
            return
        self._known = set(engine.topics)
        recording = Recording(engine.record_path, engine.topics)
        config = engine.options.config or LogConfig()
        chosen = engine.options.topics.items()
        wanted = {role: topic for role, topic in chosen if role == SONAR}
        choice = choose_topics(recording, wanted, config, (SONAR,))[SONAR]
        if choice.topic is None or not isinstance(choice.adapter, SonarAdapter):
            return
        self._topic = choice.topic
        self._adapter = choice.adapter
        self._too_early(
            engine.counts.received[self._topic] - (message.topic == self._topic)
        )
        assert engine.calibration is not None
        if engine.calibration.floor is None:
            engine.remarks.append(f"warning: {self._topic}: {NO_HEIGHT}")
        elif "depth" not in engine.in_use:
            engine.remarks.append(f"warning: {self._topic}: {NO_DEPTH}, until it comes")

    def _too_early(self, count: int = 1) -> None:
        if count:
            self._engine.counts.dropped[self._topic, TOO_EARLY] += count

    def _read(
        self, message: Message, adapter: SonarAdapter, sequence: Sequence
    ) -> None:
        """Images of a message: the recogniser begins with the first, and misses those that come until it has."""
        topic = self._engine.topics[self._topic].empty()
        at_ns = self._engine.log_time_ns
        gather(topic, message.payload, at_ns)
        faults: list[str] = []
        for frame in adapter.read(topic, lambda _, reason: faults.append(reason)):
            if not self._has_first and self._worker is not None:
                self._worker.begin(SonarBegin(sequence, frame))
                self._has_first = True
                self._begins = True
                self.waiting = 1
            elif self._begins:
                self._too_early()
            else:
                self._images.append((self._topic, at_ns, frame))
        for fault in faults:
            reason = f"{UNREADABLE}: {fault}"
            self._engine.drop(self._topic, at_ns, reason, message.arrival_ns)
