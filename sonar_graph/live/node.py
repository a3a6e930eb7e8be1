"""A live run: messages of a robot in; poses, landmarks and state out; a record and the outcome in a folder.

    transport -> inbox -> Engine -> record
                            |-> rows  -> Predictor -> odometry and frames, at the rate of the IMU
                            |-> steps -> Worker (a process) -> estimates -> Predictor, pose, landmarks

One thread takes messages from the inbox, so that everything happens in the order of arrival; the transport's own thread
only appends to it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from itertools import islice
from textwrap import shorten
from typing import Self

import gtsam
import numpy as np

from sonar_graph.errors import EstimatorError, LogError
from sonar_graph.live.arrivals import MOTION
from sonar_graph.live.engine import Engine, LiveOptions
from sonar_graph.live.inbox import Inbox, Silence
from sonar_graph.live.live_images import LiveImages
from sonar_graph.live.live_messages import Message
from sonar_graph.live.message_reader import Part
from sonar_graph.live.outlets import (
    DETECTED,
    OWN,
    TOPICS,
    Outlet,
    PoseForms,
    Status,
    payload_of_detections,
    payload_of_state,
    payloads_of_map,
)
from sonar_graph.live.predictor import Predictor
from sonar_graph.live.worker import Answer, LiveOutcome, Worker
from sonar_graph.logs import ROLES, LiveRecord, wanted_types
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.logs.cdr import short_name
from sonar_graph.models import LOCATED_AGAIN, MOVED, NOT_LOCATED
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.states import Estimate

FLUSH_S = 0.25
FRAME_PERIOD_NS = 18_000_000
"""Least time between two transforms of the body, some 50 a second: tf interpolates between them."""
STATE_S = 1.0
MOST_DURATIONS = 20_000
LINE_WIDTH = 200
WAITING_S = 5.0
"""Time after which the user is told what is missing for an estimate."""
MOST_STEPS_AT_ONCE = 50
WARM_UP = MissionOptions(
    duration_s=30.0, frame_rate_hz=10.0, dvl_dropouts_per_hour=500.0, dvl_dropout_s=3.0
)
"""Run on which all is compiled, with frames in gaps of the Doppler log."""


class LiveRun:
    """A live run from its first message to its outcome.

    Parameters
    ----------
    record
        Record, to which every message goes.
    definition_of
        Function that gives the definition of a message type.
    outlets
        Where messages are sent.
    show_line
        Called with lines for the user.
    status
        Called with the line of each second, which replaces the one before, unless it is the same; None: it is not made.
    """

    def __init__(
        self,
        record: LiveRecord,
        definition_of: Callable[[str], str],
        options: LiveOptions,
        outlets: list[Outlet],
        show_line: Callable[[str], None],
        status: Callable[[str], None] | None = None,
    ) -> None:
        self.inbox = Inbox()
        self.engine = Engine(record, definition_of, options)
        self._predict_cpu_s: deque[float] = deque(maxlen=MOST_DURATIONS)
        self._record = record
        self._options = options
        self._outlets = outlets
        self._said = show_line
        self._status = status
        self._now = Status()
        self._types = wanted_types(options.config or LogConfig(), ROLES)
        self._unused: set[str] = set()
        self._told: set[str] = set()
        """What is told once."""
        self._forms = PoseForms()
        self._answers: deque[Answer] = deque()
        # compiles in its process meanwhile
        self._images = LiveImages(self.engine)
        warm_up = simulate_mission(WARM_UP)
        self._worker = Worker(
            options,
            warm_up,
            self._answers.append,
            lambda step: self.engine.without_detections(step, time.time_ns()),
        )
        # in this process, whose predictions must not wait for a compiler
        warm_predictor(warm_up)
        self._predictor: Predictor | None = None
        self._silence = Silence()
        self._generation = -1
        self._done_s: dict[str, float] = {}
        """When each thing that is done now and then was done last."""
        self._estimates = 0
        self._next_frame_ns = 0
        self._latency_ns = 0
        self._longest_update_s = 0.0

    def wait_for_recogniser(self) -> None:
        """Wait until landmarks can be recognised in images as soon as they come."""
        self._images.wait()

    @property
    def images_waiting(self) -> int:
        """Number of sonar images that are being recognised."""
        return self._images.waiting

    def wants(self, topic: str, type_name: str) -> bool:
        """True if the messages of a topic may be of use."""
        return not topic.startswith(OWN) and short_name(type_name) in self._types

    def accept(self, message: Message) -> None:
        """Put a message into the inbox, if it may be of use; called by the transport's thread."""
        if self.wants(message.topic, message.type_name):
            self.inbox.put(message)

    def _lost(self) -> dict[str, int]:
        """Numbers of messages that were lost on the way, by topic."""
        return dict(sorted((+(self.engine.counts.lost + self.inbox.dropped)).items()))

    def counts(self) -> dict[str, dict[str, int]]:
        """Numbers of messages received, lost and dropped, by topic, and by topic and reason."""
        counts = self.engine.counts
        dropped = sorted(counts.dropped.items())
        return {
            "received": dict(sorted(counts.received.items())),
            "lost": self._lost(),
            "dropped": {f"{name}: {why}": number for (name, why), number in dropped},
        }

    def lacking(self) -> str:
        """What was missing for an estimate."""
        if self.engine.waits_for:
            return self.engine.waits_for
        if not self.engine.topics:
            return "no message came; is the domain right, and does anything send?"
        came = ", ".join(
            f"{name} ({topic.type_name})" for name, topic in self.engine.topics.items()
        )
        return f"an estimate needs two seconds of an IMU and a Doppler log; there came {came}"

    def turn(self, timeout_s: float = 0.05) -> None:
        """Take what has come, and send what follows from it."""
        messages = self.inbox.take(timeout_s)
        for message in messages:
            self._silence.note(message.topic, time.monotonic())
            self._take(message)
        # each message gives the steps that it completes; the rest of many comes now
        if not messages:
            self._give_steps()
        while self._answers:
            self._use(self._answers.popleft())
        if failure := self._images.failure():
            self._said(failure)
        for stamp_ns, detections in self._images.recognised():
            # recorded like detections of a robot, so that the record gives the same estimates
            payload = payload_of_detections(detections, stamp_ns)
            self._put(DETECTED, payload)
            self._take(Message(DETECTED, TOPICS[DETECTED], payload, time.time_ns()))
        if self._predictor is None and self._elapsed_s("waiting", WAITING_S):
            self._said(f"waiting: {self.lacking()}")
        if self._elapsed_s("flush", FLUSH_S):
            self._record.flush()
        has_pose = self._predictor is not None
        if has_pose and (period_s := self._elapsed_s("state", STATE_S)):
            self._state(period_s)
        # messages that wait in the inbox were not silent
        if self.inbox.is_empty and self._elapsed_s("silence", STATE_S):
            motion = {self.engine.in_use[role] for role in MOTION if self.engine.in_use}
            for line in self._silence.lines(motion, time.monotonic()):
                self._said(line)
        if self._worker.error is not None:
            self._say_once("failed", f"{self._failure()}; everything is still recorded")

    def _elapsed_s(self, what: str, period_s: float) -> float:
        """Seconds since something was done last, where it is to be done again after a period; else 0."""
        now_s = time.monotonic()
        elapsed_s = now_s - self._done_s.setdefault(what, now_s)
        if elapsed_s <= period_s:
            return 0.0
        self._done_s[what] = now_s
        return elapsed_s

    def finish(self) -> LiveOutcome | None:
        """LiveOutcome when no more messages will come; None where nothing could be estimated."""
        for message in self.inbox.take(0.0):
            self._take(message)
        self._images.finish()
        for step in (*self.engine.steps(), *self.engine.finish()):
            self._worker.add(step)
        if self._predictor is None:
            return None
        try:
            return self._worker.finish()
        except Exception as error:  # an estimator may fail in any way
            raise EstimatorError(self._failure()) from error

    def _failure(self) -> str:
        return f"{self._options.estimator} failed: {self._worker.error}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.end()
        self._images.end()

    def _take(self, message: Message) -> None:
        if message.topic in self._unused:
            return
        try:
            parts = self.engine.take(message)
        except LogError as error:
            if self.engine.calibration is None and message.topic in self.engine.topics:
                raise
            self._unused.add(message.topic)
            self._said(f"not used: {error}")
            return
        except OSError:
            raise  # the record cannot be written
        except Exception as error:  # whatever a sender sends: it is in the record
            self._fault(message.topic, error)
            return
        for remark in self.engine.remarks:
            self._said(remark)
        self.engine.remarks.clear()
        is_ready = self.engine.calibration is not None
        if is_ready and self._generation != self.engine.generation:
            self._begin()
        self._images.take(message, parts)
        try:
            self._move_on(parts, message.arrival_ns)
        except Exception as error:  # only the pose at the rate of the IMU suffers
            self._fault("the prediction", error)
        self._give_steps()

    def _give_steps(self) -> None:
        """Give steps to the estimator, so few at once that no pose waits; a clock that was set may complete many."""
        for step in islice(self.engine.steps(), MOST_STEPS_AT_ONCE):
            self._worker.add(step)

    def _move_on(self, parts: list[Part], arrival_ns: int) -> None:
        for part in parts:
            if part.block is None:
                continue
            if part.role == "detections" and len(part.block):
                self._now.detected_ns = max(self._now.detected_ns, part.stamp_ns)
            if self._predictor is None or part.role not in MOTION:
                continue
            # the predictor does not wait for steps
            rows = [part.block if part.role == role else None for role in MOTION]
            self._predictor.add(*rows)
            # of many rows at once only the newest pose is of use
            if part.role == "imu" and part is parts[-1]:
                self._predict(self._predictor, arrival_ns)

    def _fault(self, what: str, error: Exception) -> None:
        """Report once what went wrong with a topic, and go on."""
        fault = f"{type(error).__name__}: {error}"
        self._say_once(what, f"{what}: {fault}; everything is still recorded")

    def _say_once(self, what: str, line: str) -> None:
        if what not in self._told:
            self._told.add(what)
            self._said(line)

    def _begin(self) -> None:
        assert self.engine.calibration is not None
        self._generation = self.engine.generation
        if self._generation:
            self._said(
                "a further sensor has come: estimating anew from the beginning of the record"
            )
        assert self.engine.sequence is not None
        notes = self.engine.sequence.notes
        for subject in ("topics", "calibration", "start"):
            if text := notes.get(f"log.{subject}"):
                self._said(shorten(f"{subject}: {text}", LINE_WIDTH))
        for subject in ("log.doubtful", "log.warnings"):
            for warning in notes.get(subject, "").split("; "):
                # the odometry after the newest has not come yet
                if warning and not warning.startswith("detections:"):
                    self._said(f"warning: {warning}")
        # an estimator has its calibration from its beginning
        self._worker.begin(self.engine.calibration)
        self._predictor = Predictor(self.engine.calibration)
        self._now.newest_ns = 0
        self._next_frame_ns = 0
        self._said(f"estimating by {self._options.estimator}; Ctrl-C ends")

    def _predict(self, predictor: Predictor, arrival_ns: int) -> None:
        # of this thread alone: other threads take the processor meanwhile
        before_s = time.thread_time()
        at = predictor.predict()
        if at is None or at.stamp_ns <= self._now.newest_ns:
            return
        self._predict_cpu_s.append(time.thread_time() - before_s)
        self._now.predicted(at)
        self._put("/sonar_graph/odometry", self._forms.odometry(at))
        if at.stamp_ns >= self._next_frame_ns:
            self._next_frame_ns = at.stamp_ns + FRAME_PERIOD_NS
            self._put("/tf", self._forms.body(at))
        self._latency_ns = max(self._latency_ns, time.time_ns() - arrival_ns)

    def _use(self, answer: Answer) -> None:
        assert self._predictor is not None
        self._now.withheld = answer.withheld
        self._tell_of_map(answer)
        self._longest_update_s = max(self._longest_update_s, answer.update_s)
        self._estimates += len(answer.estimates)
        self._now.estimates += len(answer.estimates)
        mapped = answer.landmarks
        if mapped is not None:
            self._now.landmarks = len(mapped)
        lacking = [each for each in answer.withheld if each.startswith(NOT_LOCATED)]
        if lacking and "located" in self._told:
            self._told.discard("located")
            self._said(f"its place in the map was wrong; {lacking[0]}")
            # a pose that landmarks refute is none
            self._predictor.lose()
            self._now.at = None
        if lacking or not answer.estimates:
            return
        for estimate in answer.estimates:
            self._put("/sonar_graph/pose", self._forms.estimate(estimate))
        newest = answer.estimates[-1]
        self._predictor.correct(newest)
        map_T_odom = self._predictor.map_T_odom
        self._put("/tf", self._forms.correction(newest.stamp_ns, map_T_odom))
        if mapped is not None and len(mapped):
            landmarks, markers = payloads_of_map(mapped, newest.stamp_ns)
            self._put("/sonar_graph/landmarks", landmarks)
            self._put("/sonar_graph/markers", markers)

    def _tell_of_map(self, answer: Answer) -> None:
        """Say where the vehicle was located in its map, and what moved in it."""
        assert self.engine.calibration is not None
        for message in answer.withheld:
            if message.startswith((LOCATED_AGAIN, MOVED)):
                self._say_once(message, message)
        if self.engine.calibration.start.source == "map" and answer.estimates:
            x, y, _ = answer.estimates[0].world_T_body.translation()
            self._say_once("located", f"located in the map at ({x:.2f}, {y:.2f}) m")

    def _state(self, period_s: float) -> None:
        """Publish the state of the seconds since the last one, and give its line to the user."""
        dropped = self.engine.counts.dropped
        lost = self._lost()
        lists = {
            "lost": ", ".join(f"{name} {n}" for name, n in lost.items()),
            "dropped": ", ".join(
                f"{name} {n} {why}" for (name, why), n in sorted(dropped.items())
            ),
            "withheld": "; ".join(self._now.withheld),
        }
        values = {
            "latency_ms": f"{self._latency_ns * 1e-6:.1f}",
            "longest_update_ms": f"{self._longest_update_s * 1e3:.1f}",
            "predictor_cpu_p99_us": f"{1e6 * np.percentile(self._predict_cpu_s or [np.nan], 99):.0f}",
            "steps_waiting": str(self._worker.waiting),
            "images_waiting": str(self.images_waiting),
            "estimates": str(self._estimates),
            **{name: text or "none" for name, text in lists.items()},
        }
        is_well = not any(lists.values())
        summary = "running" if is_well else "messages are lost, dropped or withheld"
        state = payload_of_state(self._now.newest_ns, is_well, summary, values)
        self._put("/sonar_graph/state", state)
        gone = dropped.total() + sum(lost.values())
        latency_ms = self._latency_ns * 1e-6
        line = self._now.line(dropped=gone, latency_ms=latency_ms, period_s=period_s)
        # after the end of a log there is none
        if line and self._status is not None:
            self._status(line)
        self._latency_ns = 0
        self._longest_update_s = 0.0

    def _put(self, topic: str, payload: bytes) -> None:
        for put in self._outlets:
            put(topic, payload)


def warm_predictor(world: Sequence) -> None:
    """Compile what predictions and their messages need, over a gap of the Doppler log too."""
    predictor = Predictor(world.calibration)
    forms = PoseForms()
    for k, step in enumerate(world.replay(world.instants(1.0))):
        predictor.add(step.imu, None if 10 < k < 15 else step.dvl)
        if k < 10:
            predictor.correct(Estimate(step.end_ns, gtsam.Pose3(), np.eye(6)))
        if (at := predictor.predict()) is not None:
            forms.odometry(at)
            forms.body(at)
