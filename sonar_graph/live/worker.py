"""Estimator in a process of its own, so that its updates delay no prediction.

Steps wait in order, and all that wait are sent at once. Where they are more than a bound, those that wait longest lose
their detections (never IMU or Doppler rows, without which the pose would be wrong): the record names them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from sonar_graph.calibration import Calibration
from sonar_graph.estimator import (
    Estimator,
    load_estimator,
    make_params,
    newest_landmarks_of,
    refused_rows_of,
    withheld_of,
)
from sonar_graph.files import READY, OwnProcess, Tell, serve
from sonar_graph.measurements import Measurements
from sonar_graph.sequence import Sequence
from sonar_graph.states import Estimate, LandmarkMap, RefusedRow, Trajectory

if TYPE_CHECKING:
    from sonar_graph.live.engine import LiveOptions

MAP_SHARE = 20.0
"""Time between two maps over the time that one takes."""
LEAST_MAP_S = 1.0
MOST_WAITING_S = 2.0
"""Time of steps that may wait for the estimator before the oldest lose their detections."""
MOST_AT_ONCE = 100
"""Number of steps in one request, so that estimates come while many wait."""


@dataclass(frozen=True)
class Begin:
    """Request to make a new estimator."""

    name: str
    overrides: dict[str, Any]
    calibration: Calibration


@dataclass(frozen=True)
class Answer:
    """Estimates of some steps."""

    estimates: list[Estimate]
    landmarks: LandmarkMap | None
    """The map, now and then."""
    withheld: list[str]
    update_s: float
    """Duration of the longest update."""


@dataclass(frozen=True)
class LiveOutcome:
    """What an estimator knows at the end."""

    causal: Trajectory
    smoothed: Trajectory
    landmarks: LandmarkMap
    refused: list[RefusedRow]
    withheld: list[str]
    update_s: list[float]
    """Duration of each update."""
    finish_s: float
    """Duration of asking for all of this."""


FINISH = "finish"


class _Served:
    """State of the process that serves."""

    estimator: Estimator
    estimates: list[Estimate]
    update_s: list[float]
    next_map_s = 0.0


def serve_estimator() -> None:
    """Answer requests until stdin ends."""
    serve(_answer)


def _answer(request: Any, _: Tell) -> object:
    if isinstance(request, Begin):
        # loads numba, which the process that serves a robot has loaded already
        from sonar_graph.navigation import make_estimator

        kind = load_estimator(request.name)
        params = make_params(kind, request.overrides, request.name)
        make = partial(kind, params=params)
        _Served.estimator = make_estimator(make, request.calibration)
        _Served.estimates = []
        _Served.update_s = []
        _Served.next_map_s = 0.0
        return READY
    estimator = _Served.estimator
    before_s = time.perf_counter()
    if request == FINISH:
        smoothed = estimator.trajectory()
        landmarks = estimator.landmarks()
        finish_s = time.perf_counter() - before_s
        return LiveOutcome(
            Trajectory.from_estimates(_Served.estimates),
            smoothed,
            landmarks,
            refused_rows_of(estimator),
            withheld_of(estimator),
            _Served.update_s,
            finish_s,
        )
    found = []
    update_s = []
    # each update is timed by itself, although steps come together
    for step in request:
        if (estimate := estimator.process(step)) is not None:
            found.append(estimate)
        after_s = time.perf_counter()
        update_s.append(after_s - before_s)
        before_s = after_s
    _Served.update_s += update_s
    _Served.estimates += found
    landmarks_now = None
    # a map of thousands takes long: now and then is enough for viewers
    if found and before_s >= _Served.next_map_s:
        landmarks_now = newest_landmarks_of(estimator)
        map_s = time.perf_counter() - before_s
        _Served.next_map_s = before_s + map_s + max(LEAST_MAP_S, MAP_SHARE * map_s)
    return Answer(found, landmarks_now, withheld_of(estimator), max(update_s))


class Worker:
    """Estimator in its process, and the steps that wait for it.

    Parameters
    ----------
    options
        Estimator with its settings, and its rate.
    warm_up
        Simulated run on which what is slow the first time is compiled, before anything is received.
    answered
        Called with each `Answer`, by a thread of the worker.
    without_detections
        Gives a step without them.
    """

    def __init__(
        self,
        options: LiveOptions,
        warm_up: Sequence,
        answered: Callable[[Answer], None],
        without_detections: Callable[[Measurements], Measurements],
    ) -> None:
        program = (
            "from sonar_graph.live.worker import serve_estimator; serve_estimator()"
        )
        self._process = OwnProcess(("-c", program))
        self._begin = partial(Begin, options.estimator, dict(options.overrides))
        self._answered = answered
        self._without_detections = without_detections
        self._most_waiting = max(1, round(MOST_WAITING_S * options.rate_hz))
        self._waiting: list[Measurements] = []
        self._begins: Begin | None = None
        self._is_catching_up = False
        self._changed = threading.Condition()
        self._is_done = False
        self.error: Exception | None = None
        """Why the estimator failed, if it did."""
        self._process.answer()  # that it is ready
        steps = list(warm_up.replay(warm_up.instants(options.rate_hz)))
        # what is compiled or loaded at the first use must not delay the first pose
        for request in (self._begin(warm_up.calibration), steps, FINISH):
            self._process.ask(request)
        self._thread = threading.Thread(target=self._work, daemon=True)

    def begin(self, calibration: Calibration) -> None:
        """Begin the run, or begin it again: steps that wait are forgotten, and those that follow may be many for a while."""
        with self._changed:
            self._begins = self._begin(calibration)
            self._is_catching_up = True
            self._waiting.clear()
            self._changed.notify()
        if not self._thread.ident:
            self._thread.start()

    @property
    def waiting(self) -> int:
        """Number of steps that wait."""
        return len(self._waiting)

    def add(self, step: Measurements) -> None:
        """Queue a step; too many that wait lose their detections, the oldest first."""
        if self.error is not None:
            return
        with self._changed:
            self._waiting.append(step)
            # of the oldest, since the newest decide the pose
            late = len(self._waiting) - self._most_waiting - 1
            if late >= 0 and not self._is_catching_up:
                oldest = self._waiting[late]
                if oldest.detections is not None:
                    self._waiting[late] = self._without_detections(oldest)
            self._changed.notify()

    def finish(self) -> LiveOutcome:
        """LiveOutcome after all steps that wait; raises what the estimator raised."""
        with self._changed:
            self._is_done = True
            self._changed.notify()
        self._thread.join()
        if self.error is not None:
            raise self.error
        outcome: LiveOutcome = self._process.ask(FINISH)
        return outcome

    def end(self) -> None:
        """End the process."""
        self._process.end()

    def _work(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(
                        lambda: self._waiting or self._begins or self._is_done
                    )
                    begin = self._begins
                    self._begins = None
                    steps = self._waiting[:MOST_AT_ONCE]
                    del self._waiting[:MOST_AT_ONCE]
                # a run that begins again forgets the steps of the one before
                if begin is not None:
                    self._process.ask(begin)
                if steps:
                    # outside the lock: steps may be added while the estimator works
                    answer = self._process.ask(steps)
                    self._is_catching_up &= bool(self._waiting)
                    if self._begins is None:  # else it is of a run that is over
                        self._answered(answer)
                elif begin is None:
                    return
        except Exception as error:  # an estimator may fail in any way
            self.error = error
