"""What became of every track and candidate in a log's images, with a picture of each, to be looked at."""

from collections import Counter
from dataclasses import dataclass, field

import cv2
import numpy as np

from sonar_graph.calibration import SonarImage
from sonar_graph.images import SonarFrames, decibels
from sonar_graph.measurements import NS_PER_S, Floats
from sonar_graph.recognition.recognition_record import as_jpeg, draw_fan
from sonar_graph.sonar import Fan, MadeOfWindow, RecognisedFrame

HALF_M = 0.35
"""Half of the side of a picture."""
SIDE_PIXELS = 160
MOST_EXAMPLES = 6
"""Pictures of candidates rejected for one reason."""
EXAMPLE_PERIOD_NS = 5 * NS_PER_S
"""Least time between these."""
BETTER = 0.05
"""Rise of the visible share from which on a track is drawn again."""


@dataclass
class TrackStory:
    """A track from its first frame to its last."""

    number: int
    first_ns: int
    last_ns: int = 0
    frames: int = 0
    """Frames in which it took a candidate."""
    visible: float = -1.0
    """Share in view at its picture."""
    jpeg: bytes = b""
    beliefs: Floats = field(default_factory=lambda: np.empty(0))
    """Last probability of each landmark and of none of them, shape (ids + 1,)."""
    outcomes: Counter[str] = field(default_factory=Counter)
    """Number of frames by what became of it in them; the reason of its end."""


@dataclass
class Rejected:
    """Candidates that were rejected for one reason."""

    count: int = 0
    examples: list[tuple[int, bytes]] = field(default_factory=list)
    """Stamps and pictures of some."""


class TrackStories:
    """Collector of stories: call `see` with every frame that was used."""

    def __init__(self, image: SonarImage) -> None:
        self.tracks: dict[int, TrackStory] = {}
        self.rejected: dict[str, Rejected] = {}
        self._image = image
        self._fans = MadeOfWindow(fan_of_stories)

    def see(self, frame: SonarFrames, result: RecognisedFrame) -> None:
        """Take in the result for a block of one frame."""
        stamp_ns = result.stamp_ns
        views = _Views(frame, self._image, self._fans.of(frame))
        for number, sighting, _, beliefs in result.tracks:
            story = self.tracks.setdefault(number, TrackStory(number, stamp_ns))
            story.beliefs = beliefs
            if sighting is None:
                continue
            story.last_ns = stamp_ns
            story.frames = story.frames + 1
            visible = 0.0 if sighting.fit is None else sighting.fit.visible
            # the picture in which most of the object is in view
            if visible > story.visible + BETTER:
                story.visible = visible
                story.jpeg = views.around(sighting.range_m, sighting.azimuth_rad)
        for fate in result.fates:
            if fate.track in self.tracks:
                self.tracks[fate.track].outcomes[fate.outcome] += 1
            elif fate.track < 0 and np.isfinite(fate.range_m):
                found = self.rejected.setdefault(fate.outcome, Rejected())
                found.count += 1
                # examples from different times, not five of one object
                is_due = (
                    not found.examples
                    or stamp_ns - found.examples[-1][0] >= EXAMPLE_PERIOD_NS
                )
                if is_due and len(found.examples) < MOST_EXAMPLES:
                    found.examples.append(
                        (stamp_ns, views.around(fate.range_m, fate.azimuth_rad))
                    )


def fan_of_stories(ranges_m: Floats, azimuths_rad: Floats) -> Fan:
    """Fan in which the square of a picture has its pixels."""
    high = float(np.ptp(ranges_m)) / HALF_M * SIDE_PIXELS / 2
    return Fan.of(ranges_m, azimuths_rad, round(high))


class _Views:
    """Pictures of places in one frame, drawn with the first of them."""

    def __init__(self, frame: SonarFrames, image: SonarImage, fan: Fan) -> None:
        self._frame = frame
        self._image = image
        self._fan = fan
        self._whole: np.ndarray | None = None

    def around(self, range_m: float, azimuth_rad: float) -> bytes:
        """JPEG of a square about a place."""
        if self._whole is None:
            self._whole = draw_fan(
                decibels(self._frame.intensity[0], self._image), self._fan, None
            )
        column, row = self._fan.pixel(range_m, azimuth_rad)
        half = round(HALF_M * self._fan.pixels_per_m)
        padded = cv2.copyMakeBorder(
            self._whole, half, half, half, half, cv2.BORDER_CONSTANT
        )
        height, width = self._whole.shape[:2]
        column = int(np.clip(column, 0, width - 1))
        row = int(np.clip(row, 0, height - 1))
        square = padded[row : row + 2 * half, column : column + 2 * half]
        return as_jpeg(
            np.asarray(cv2.resize(square, (SIDE_PIXELS, SIDE_PIXELS)), np.uint8)
        )
