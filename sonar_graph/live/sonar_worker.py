"""Recogniser in a process of its own: sonar images in, detections out.

Rows of the other sensors go along with the images, since tracks need the sonar's motion and its height. Where images
come faster than they are recognised, the oldest that wait are dropped, and the record names them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from sonar_graph.files import READY, OwnProcess, Tell, serve
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import Depth, Dvl, Imu, LandmarkDetections
from sonar_graph.sequence import Sequence

MOST_FRAMES = 5
"""Number of images that may wait."""
OVERTAKEN = "overload: newer images came before it was recognised"


@dataclass(frozen=True)
class SonarRows:
    """Rows since the last request, and an image after them."""

    imu: Imu | None
    dvl: Dvl | None
    depth: Depth | None
    frame: SonarFrames | None


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


def serve_recogniser() -> None:
    """Answer requests until stdin ends."""
    serve(_answer)


def _answer(request: Any, tell: Tell) -> object:  # noqa: ARG001  # of `serve`
    if isinstance(request, Sequence):
        from sonar_graph.recognition import RecognitionSession  # loads numba

        _Recogniser.session = RecognitionSession(request, pictures=False)
        return READY
    session = _Recogniser.session
    session.extend(request.imu, request.dvl, request.depth)
    frame: SonarFrames | None = request.frame
    if frame is None:
        return READY
    found = session.take(frame)
    session.forget()
    return SonarAnswer(int(frame.stamps_ns[0]), found)


class SonarWorker:
    """Recogniser in its process, and the images that wait for it.

    Parameters
    ----------
    sequence
        Calibration, and the rows of the first seconds.
    seen
        Called with each `SonarAnswer`, by a thread of the worker.
    """

    def __init__(self, sequence: Sequence, seen: Callable[[SonarAnswer], None]) -> None:
        self._process = OwnProcess(
            ("-c", "from sonar_graph.live.sonar_worker import serve_recogniser; serve_recogniser()")
        )
        self._seen = seen
        self._waiting: list[Waiting] = []
        self._changed = threading.Condition()
        self.error: Exception | None = None
        """Why recognition failed, if it did."""
        threading.Thread(target=self._work, args=(sequence,), daemon=True).start()

    def add(self, waiting: Waiting) -> list[Waiting]:
        """Queue an image with the rows before it; those that are dropped, whose rows go with the next."""
        with self._changed:
            self._waiting.append(waiting)
            images = [i for i, one in enumerate(self._waiting) if one.rows.frame is not None]
            dropped = []
            for i in images[: max(len(images) - MOST_FRAMES, 0)]:
                dropped.append(self._waiting[i])
                rows = self._waiting[i].rows
                self._waiting[i] = self._waiting[i]._replace(rows=SonarRows(rows.imu, rows.dvl, rows.depth, None))
            self._changed.notify()
        return dropped

    def end(self) -> None:
        """End the process."""
        self._process.end()

    def _work(self, sequence: Sequence) -> None:
        try:
            self._process.answer()  # that it is ready
            self._process.send(sequence)
            self._process.answer()
            while True:
                with self._changed:
                    while not self._waiting:
                        self._changed.wait()
                    one = self._waiting.pop(0)
                self._process.send(one.rows)
                answer = self._process.answer()
                if isinstance(answer, SonarAnswer):
                    self._seen(answer)
        except Exception as error:  # of the process, or because it was ended
            self.error = error
