"""Recogniser in a process of its own: sonar images in, detections out.

Rows of the other sensors go along with the images, since tracks need the sonar's motion and its height. Where images
come faster than they are recognised, the oldest that wait are dropped, and the record names them.
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from sonar_graph.files import READY, OwnProcess, Tell, serve
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import Depth, Dvl, Imu, LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission

WARM_UP = "warm up"
BEAMS = 96
BINS = 512
MOST_FRAMES = 5
"""Number of images that may wait."""
OVERTAKEN = "overload: newer images came before it was recognised"


class SonarBegin(NamedTuple):
    """Request to begin: calibration and rows of the first seconds, and one image with the shape of all others."""

    sequence: Sequence
    frame: SonarFrames


@dataclass(frozen=True)
class SonarRows:
    """Rows since the last request, and an image after them."""

    frame: SonarFrames | None
    imu: Imu | None = None
    dvl: Dvl | None = None
    depth: Depth | None = None


class SonarAnswer(NamedTuple):
    """Detections in an image; None where nothing was recognised."""

    stamp_ns: int
    detections: LandmarkDetections | None


class Waiting(NamedTuple):
    """An image that waits, as it is named in the record."""

    topic: str
    log_time_ns: int
    rows: SonarRows


class _Recogniser:
    """State of the process that serves."""

    session: Any


def warm_recogniser() -> None:
    """Compile what a recogniser needs, on images of noise with a bright spot that moves."""
    from sonar_graph.devices import DEFAULT_DESIGNS
    from sonar_graph.recognition import RecognitionSession
    from sonar_graph.sonar import Recogniser

    world = simulate_mission(MissionOptions(duration_s=6.0))
    noise = np.random.default_rng(0)
    # templates of a single design: drawing them takes longer than all that is compiled
    recogniser = Recogniser(world.calibration, DEFAULT_DESIGNS[:1])
    session = RecognitionSession(world, recogniser)
    ranges_m = np.linspace(0.5, 10.0, BINS)
    azimuths_rad = np.linspace(1.0, -1.0, BEAMS)
    for k, stamp_ns in enumerate(world.instants(4.0)[2:]):
        intensity = noise.integers(0, 40, (1, BEAMS, BINS)).astype(np.uint8)
        intensity[0, 40 + k : 46 + k, 200:220] = 250
        session.take(
            SonarFrames(np.array([stamp_ns]), intensity, ranges_m, azimuths_rad)
        )


def serve_recogniser() -> None:
    """Answer requests until stdin ends."""
    serve(_answer)


def _answer(request: Any, _: Tell) -> object:
    if request == WARM_UP:
        warm_recogniser()
        return READY
    if isinstance(request, SonarBegin):
        from sonar_graph.recognition import RecognitionSession  # loads numba
        from sonar_graph.sonar import Recogniser

        recogniser = Recogniser(request.sequence.calibration)
        recogniser.prepare(request.frame)
        _Recogniser.session = RecognitionSession(request.sequence, recogniser)
        gc.freeze()  # templates are never looked at again, which would delay an image
        return READY
    session = _Recogniser.session
    # first the rows: the track needs the motion up to its image
    session.extend(request.imu, request.dvl, request.depth)
    frame: SonarFrames | None = request.frame
    if frame is None:
        return READY
    found = session.take(frame).detections
    session.forget()
    return SonarAnswer(int(frame.stamps_ns[0]), found)


class SonarWorker:
    """Recogniser in its process, and the images that wait for it.

    Parameters
    ----------
    seen
        Called with each `SonarAnswer`, by a thread of the worker.
    """

    def __init__(self, seen: Callable[[SonarAnswer], None]) -> None:
        program = "from sonar_graph.live.sonar_worker import serve_recogniser; serve_recogniser()"
        self._process = OwnProcess(("-c", program))
        self._seen = seen
        self._waiting: list[Waiting] = []
        self._changed = threading.Condition()
        self._begin: SonarBegin | None = None
        self._is_ended = False
        self.is_warm = threading.Event()
        """Set when it has compiled what it needs, or failed."""
        self.has_begun = threading.Event()
        """Set when it has drawn what it compares images with, or failed."""
        self.error: Exception | None = None
        """Why recognition failed, if it did."""
        threading.Thread(target=self._work, daemon=True).start()

    def begin(self, begin: SonarBegin) -> None:
        """Begin; images are given when it has begun."""
        with self._changed:
            self._begin = begin
            self._changed.notify()

    def add(self, waiting: Waiting) -> list[Waiting]:
        """Queue an image with the rows before it; those that are dropped, whose rows go with the next."""
        with self._changed:
            self._waiting.append(waiting)
            images = [
                i for i, one in enumerate(self._waiting) if one.rows.frame is not None
            ]
            dropped = []
            # rows stay: tracks need the motion between the images that are left
            for i in images[:-MOST_FRAMES]:
                one = self._waiting[i]
                dropped.append(one)
                self._waiting[i] = one._replace(rows=replace(one.rows, frame=None))
            self._changed.notify()
        return dropped

    def end(self) -> None:
        """End the process."""
        with self._changed:
            was_ended = self._is_ended
            self._is_ended = True
            self._changed.notify()
        # outside the lock, which the thread that waits for an answer needs
        if not was_ended:
            self._process.end()

    def _work(self) -> None:
        try:
            self._process.answer()  # that it is ready
            self._process.ask(WARM_UP)
            self.is_warm.set()
            with self._changed:
                self._changed.wait_for(lambda: self._begin or self._is_ended)
            self._process.ask(self._begin)
            self.has_begun.set()
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._waiting or self._is_ended)
                    if self._is_ended:
                        return
                    one = self._waiting.pop(0)
                answer = self._process.ask(one.rows)
                if isinstance(answer, SonarAnswer):
                    self._seen(answer)
        except Exception as error:  # of the process, or because it was ended
            self.error = error
        finally:
            self.is_warm.set()
            self.has_begun.set()
