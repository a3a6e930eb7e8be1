"""Sonar images of a live run: from messages to the recogniser, and its detections back.

Detections are a topic of their own, recorded like those of a robot that detects by itself: estimates of the record are
those of the live run, whatever was dropped before the recogniser.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np

from sonar_graph.images import NO_DEPTH, NO_HEIGHT
from sonar_graph.live.arrivals import joined
from sonar_graph.live.engine import Engine, LiveOptions
from sonar_graph.live.live_messages import Message
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

SONAR = "sonar"
ROLES = ("imu", "dvl", "depth")
UNREADABLE = "no sonar image"
ENDED, FAILED = "not recognised: the run ended", "not recognised: recognition failed"
TOO_EARLY = (
    "not recognised: of the first seconds, which give the calibration and the templates"
)


class LiveImages:
    """Images of the one sonar topic, where no detections come from elsewhere.

    The recogniser begins with the first image after the first seconds, whose ranges and beams decide which templates it
    draws, for some seconds. From then on an image goes to it as soon as an IMU row at or after it has come.
    """

    def __init__(self, engine: Engine, options: LiveOptions) -> None:
        self._engine = engine
        self._wanted = {SONAR: options.topics[SONAR]} if SONAR in options.topics else {}
        self._config = options.config or LogConfig()
        self._topic = ""
        self._adapter: SonarAdapter | None = None
        self._seen: deque[SonarAnswer] = deque()
        self._is_off = "detections" in options.topics
        self._worker = None if self._is_off else SonarWorker(self._seen.append)
        self.waiting = 0
        """Number of images that the recogniser has and has not answered, with the one that it begins with."""
        self._has_first = self._begins = False
        self._rows: dict[str, list[Any]] = {role: [] for role in ROLES}
        self._images: deque[tuple[int, Any, str, int]] = deque()
        self._newest_ns: dict[str, int] = {}
        self._known: set[str] = set()

    def wait(self) -> None:
        """Wait until the recogniser has compiled what it needs."""
        if self._worker is not None:
            self._worker.is_warm.wait()

    def take(self, message: Message, parts: list[Part]) -> None:
        """Take in a message and what counts of it."""
        if self._is_off or self._engine.sequence is None:
            return
        if (
            not self._newest_ns
        ):  # the recogniser begins with the rows of the first seconds
            of = self._engine.sequence.blocks()
            self._newest_ns = {
                role: int(of[role].stamps_ns[-1]) if role in of else 0 for role in ROLES
            }
        for part in parts:
            if (
                part.role in ROLES
                and part.block is not None
                and part.stamp_ns > self._newest_ns[part.role]
            ):
                self._rows[part.role].append(part.block)
                self._newest_ns[part.role] = part.stamp_ns
        for role, blocks in self._rows.items():
            if len(blocks) > 256:
                self._rows[role] = [joined(blocks)]
        if not self._topic:
            self._find(message)
        if message.topic == self._topic:
            self._read(message)
        while (
            self._topic
            and self._images
            and self._images[0][0] <= self._newest_ns["imu"]
        ):
            _, frame, topic, log_time_ns = self._images.popleft()
            rows = {
                role: joined(blocks) if blocks else None
                for role, blocks in self._rows.items()
            }
            self._rows = {role: [] for role in ROLES}
            assert self._worker is not None
            dropped = self._worker.add(
                Waiting(topic, log_time_ns, SonarRows(**rows, frame=frame))
            )
            self.waiting += 1 - len(dropped)
            for one in dropped:
                self._engine.drop(
                    one.topic, one.log_time_ns, OVERTAKEN, message.arrival_ns
                )

    def recognised(self) -> Iterator[SonarAnswer]:
        """Detections of images since the last call."""
        if (
            self._begins
            and self._worker is not None
            and self._worker.has_begun.is_set()
        ):
            self._begins = False
            self.waiting -= 1
            self._engine.counts.dropped[self._topic, TOO_EARLY] += 1
        while self._seen:
            self.waiting -= 1
            yield self._seen.popleft()

    def failure(self) -> str | None:
        """Why recognition has ended, said once; None: it has not."""
        if (
            self._is_off
            or not self._topic
            or self._worker is None
            or self._worker.error is None
        ):
            return None
        self._count_left(FAILED)
        return f"recognition of landmarks failed: {self._worker.error}; images are still recorded"

    def finish(self) -> None:
        """Count the images that were not recognised when the run ended."""
        if not self._is_off:
            self._count_left(ENDED)

    def _count_left(self, reason: str) -> None:
        left = self.waiting + len(self._images)
        if left:
            self._engine.counts.dropped[self._topic, reason] += left
        self._is_off, self.waiting = True, 0
        self._images.clear()

    def end(self) -> None:
        """End the recogniser's process."""
        if self._worker is not None:
            self._worker.end()

    def _find(self, message: Message) -> None:
        """Begin to recognise where a sonar sends and nothing else detects."""
        engine = self._engine
        if "detections" in engine.in_use or engine.topics.keys() == self._known:
            if "detections" in engine.in_use:
                self._is_off = True
                threading.Thread(
                    target=self.end, daemon=True
                ).start()  # poses do not wait for its end
            return
        self._known = set(engine.topics)
        choice = choose_topics(
            Recording(engine.record_path, engine.topics),
            self._wanted,
            self._config,
            (SONAR,),
        )[SONAR]
        if choice.topic is not None and isinstance(choice.adapter, SonarAdapter):
            self._topic, self._adapter = choice.topic, choice.adapter
            if missed := engine.counts.received[self._topic] - (
                message.topic == self._topic
            ):
                engine.counts.dropped[self._topic, TOO_EARLY] += missed
            assert engine.calibration is not None
            if engine.calibration.floor is None:
                engine.remarks.append(f"warning: {self._topic}: {NO_HEIGHT}")
            elif "depth" not in engine.in_use:
                engine.remarks.append(
                    f"warning: {self._topic}: {NO_DEPTH}, until it comes"
                )

    def _read(self, message: Message) -> None:
        topic = self._engine.topics[self._topic].empty()
        log_time_ns = self._engine.log_time_ns
        size = np.array([len(message.payload)])
        topic.gather(
            message.payload, np.zeros(1, np.int64), size, np.array([log_time_ns])
        )
        assert self._adapter is not None
        faults: list[str] = []
        assert self._worker is not None
        for frame in self._adapter.read(topic, lambda _, reason: faults.append(reason)):
            if not self._has_first:
                assert self._engine.sequence is not None
                self._worker.begin(SonarBegin(self._engine.sequence, frame))
                self._has_first = self._begins = True
                self.waiting = 1
            elif self._begins:
                self._engine.counts.dropped[self._topic, TOO_EARLY] += 1
            else:
                self._images.append(
                    (int(frame.stamps_ns[0]), frame, self._topic, log_time_ns)
                )
        for fault in faults:
            self._engine.drop(
                self._topic, log_time_ns, f"{UNREADABLE}: {fault}", message.arrival_ns
            )
