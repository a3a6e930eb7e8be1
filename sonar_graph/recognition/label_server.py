"""Server of the page on which landmarks are labelled, for the browser of the same computer.

It listens on the loopback only. A random word in every address keeps other pages and other users of the computer out,
and requests that name another host are refused (DNS rebinding). Labels are written after every click.
"""

import json
import secrets
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from sonar_graph.calibration import SonarCalibration
from sonar_graph.images import SonarFrames, decibels
from sonar_graph.recognition.labels import Label, Labels, is_of_one_object
from sonar_graph.recognition.recognition_record import as_jpeg, draw_fan
from sonar_graph.recognition.session import one_by_one
from sonar_graph.sonar import Fan, MadeOfWindow, with_lens

HOST = "127.0.0.1"
PIXELS_HIGH = 640
MOST_BYTES = 10_000
"""Largest body of a request."""
MOST_FRAMES = 1500
"""Pictures held in memory; of more every second is left out."""


@dataclass(frozen=True, eq=False)
class ShownFrame:
    """Picture of a frame, and where its pixels are."""

    stamp_ns: int
    jpeg: bytes
    fan: Fan

    def range_azimuth(self, column: float, row: float) -> tuple[float, float] | None:
        """Range and azimuth of a pixel; None outside of the fan."""
        height, width = self.fan.beam.shape
        if (
            not (0 <= column < width and 0 <= row < height)
            or self.fan.beam[int(row), int(column)] < 0
        ):
            return None
        # the inverse of `Fan.pixel`
        ahead = self.fan.lowest_m + (height - row) / self.fan.pixels_per_m
        across = self.fan.half_width_m - column / self.fan.pixels_per_m
        return float(np.hypot(ahead, across)), float(np.arctan2(across, ahead))


def shown_frames(
    blocks: Iterable[SonarFrames],
    sonar: SonarCalibration,
    period_ns: int,
    progress: Callable[[int], None],
) -> list[ShownFrame]:
    """Pictures of frames, at least a period apart and at most `MOST_FRAMES`, evenly over the log."""
    shown: list[ShownFrame] = []
    fans = MadeOfWindow(partial(Fan.of, pixels_high=PIXELS_HIGH))
    for frame in (
        frame for block in blocks for frame in one_by_one(with_lens(block, sonar.lens))
    ):
        stamp_ns = int(frame.stamps_ns[0])
        if shown and stamp_ns - shown[-1].stamp_ns < period_ns:
            continue
        fan = fans.of(frame)
        picture = draw_fan(decibels(frame.intensity[0], sonar.image), fan, None)
        shown.append(ShownFrame(stamp_ns, as_jpeg(picture), fan))
        # too many: leave out every second, and look half as often from here on
        if len(shown) > MOST_FRAMES:
            del shown[1::2]
            period_ns = max(2 * period_ns, shown[1].stamp_ns - shown[0].stamp_ns)
        progress(len(shown))
    return shown


class LabelDesk:
    """Frames, and the labels given so far, which are written to their file after every change."""

    def __init__(
        self, frames: Sequence[ShownFrame], labels: Labels, path: Path
    ) -> None:
        self.frames = frames
        self._labels = labels
        self._path = path
        self._lock = Lock()

    @property
    def labels(self) -> tuple[Label, ...]:
        """Labels given so far."""
        return self._labels.labels

    def state(self) -> dict[str, Any]:
        """Labels of every frame in pixels, and the number of labels by identity, for the page."""
        rows: list[list[dict[str, Any]]] = [[] for _ in self.frames]
        by_stamp = {frame.stamp_ns: number for number, frame in enumerate(self.frames)}
        for label in self.labels:
            if (number := by_stamp.get(label.stamp_ns)) is not None:
                column, row = self.frames[number].fan.pixel(
                    label.range_m, label.azimuth_rad
                )
                rows[number].append({"column": column, "row": row, "id": label.id})
        # None stands for what is no landmark
        ids = [label.id for label in self.labels]
        return {
            "frames": rows,
            "counts": {str(key): ids.count(key) for key in set(ids)},
            "total": len(ids),
        }

    def add(
        self, frame: int, column: float, row: float, landmark: int | None
    ) -> str | None:
        """Give a label to a pixel, instead of one that is of the same object; the reason where that cannot be."""
        place = self.frames[frame].range_azimuth(column, row)
        if place is None:
            return "outside of the image"
        label = Label(
            stamp_ns=self.frames[frame].stamp_ns,
            range_m=place[0],
            azimuth_rad=place[1],
            id=landmark,
        )
        with self._lock:
            self._write(
                (
                    *(one for one in self.labels if not is_of_one_object(one, label)),
                    label,
                )
            )
        return None

    def take_back(self, frame: int) -> str | None:
        """Remove the last label of a frame; the reason if it has no label."""
        with self._lock:
            stamp_ns = self.frames[frame].stamp_ns
            rows = [
                row
                for row, label in enumerate(self.labels)
                if label.stamp_ns == stamp_ns
            ]
            if not rows:
                return "no label in this frame"
            self._write((*self.labels[: rows[-1]], *self.labels[rows[-1] + 1 :]))
        return None

    def _write(self, labels: tuple[Label, ...]) -> None:
        # written before it is shown: what the page has is in the file
        changed = Labels(log=self._labels.log, labels=labels)
        changed.write(self._path)
        self._labels = changed


class LabelServer(ThreadingHTTPServer):
    """Server of a page and a desk, on a free port of the loopback."""

    daemon_threads = True

    def __init__(
        self,
        desk: LabelDesk,
        page: Callable[[str], str],
        ids: Sequence[int],
        port: int = 0,
    ) -> None:
        self.desk = desk
        self.ids = frozenset(ids)
        self.page = page
        # other users of the computer do not know it
        self.word = secrets.token_urlsafe(16)
        super().__init__((HOST, port), _LabelRequest)

    @property
    def host(self) -> str:
        """Host and port."""
        return f"{HOST}:{self.server_port}"

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{self.host}/{self.word}/"

    def handle_error(self, *_: Any) -> None:
        """A browser that goes away in the middle of a request is no error."""


class _LabelRequest(BaseHTTPRequestHandler):
    server: LabelServer
    protocol_version = "HTTP/1.1"
    timeout = 30

    def log_message(self, *_: Any) -> None:
        """Keep requests out of the terminal, which shows the messages of the command."""

    def do_GET(self) -> None:
        requested = self._requested()
        if requested == "":
            nonce = secrets.token_urlsafe(16)
            policy = (
                "default-src 'none'; img-src 'self' data:; connect-src 'self'; style-src 'unsafe-inline'; "
                f"script-src 'nonce-{nonce}'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
            )
            self._send(
                self.server.page(nonce).encode(), "text/html; charset=utf-8", policy
            )
        elif requested == "state":
            self._send_json(self.server.desk.state())
        elif (
            requested is not None
            and (number := self._frame_of(requested.removeprefix("frame/"))) is not None
        ):
            self._send(self.server.desk.frames[number].jpeg, "image/jpeg")
        else:
            self._refuse(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        desk = self.server.desk
        requested = self._requested()
        content = self._content()
        number = None if content is None else self._frame_of(str(content.get("frame")))
        if requested not in ("label", "take-back"):
            self._refuse(HTTPStatus.NOT_FOUND)
        elif content is None or number is None:
            self._refuse(HTTPStatus.BAD_REQUEST)
        elif requested == "take-back":
            self._answer(partial(desk.take_back, number))
        else:
            column, row, landmark = (
                content.get(name) for name in ("column", "row", "id")
            )
            # the page offers these identities only
            is_known = landmark is None or (
                isinstance(landmark, int) and landmark in self.server.ids
            )
            if not (
                isinstance(column, int | float)
                and isinstance(row, int | float)
                and is_known
            ):
                self._refuse(HTTPStatus.BAD_REQUEST)
                return
            self._answer(partial(desk.add, number, float(column), float(row), landmark))

    def _answer(self, change: Callable[[], str | None]) -> None:
        try:
            fault = change()
        except (
            Exception
        ) as error:  # such as a full disk: the page shows it, and nothing is lost
            fault = f"not saved: {error}"
        self._send_json(self.server.desk.state() | {"fault": fault})

    def _requested(self) -> str | None:
        """Path after the word; None where the word or the host is another."""
        # a page of another host, whose name was made to lead here, has another host
        if self.headers.get("Host") not in (
            self.server.host,
            f"localhost:{self.server.server_port}",
        ):
            return None
        word, slash, rest = self.path.removeprefix("/").partition("/")
        return (
            rest
            if slash
            and secrets.compare_digest(word.encode(), self.server.word.encode())
            else None
        )

    def _content(self) -> dict[str, Any] | None:
        """JSON object of a request; None if it is something else, is too long, or comes from another page."""
        length = self.headers.get("Content-Length", "")
        is_json = self.headers.get("Content-Type") == "application/json"
        # without a length the body never ends
        if not (length.isdecimal() and int(length) <= MOST_BYTES):
            self.close_connection = True
            return None
        body = self.rfile.read(int(length))
        origin = self.headers.get("Origin")
        if not is_json or origin not in (None, f"http://{self.headers.get('Host')}"):
            return None
        try:
            content = json.loads(body)
        except (ValueError, RecursionError):
            return None
        return content if isinstance(content, dict) else None

    def _frame_of(self, text: str) -> int | None:
        # nine digits are more frames than any log has
        number = int(text) if text.isdecimal() and len(text) < 9 else -1
        return number if 0 <= number < len(self.server.desk.frames) else None

    def _refuse(self, status: HTTPStatus) -> None:
        self._send(status.phrase.encode(), "text/plain; charset=utf-8", status=status)

    def _send_json(self, content: dict[str, Any]) -> None:
        self._send(json.dumps(content).encode(), "application/json")

    def _send(
        self,
        body: bytes,
        kind: str,
        policy: str = "default-src 'none'",
        status: HTTPStatus = HTTPStatus.OK,
    ) -> None:
        self.send_response(status)
        headers = {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": policy,
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)
