"""Record of the recognition in a log, with pictures of its frames, for reports and viewers.

Pictures show the fan of a frame with the recognised identities, as Fig. 6 of the 2014 paper. Their pixels are those of
the nearest beam and bin, for display only.
"""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import SonarImage
from sonar_graph.files import (
    COMPARISON,
    read_json,
    regular,
    replacing,
    result_written,
    write_json,
)
from sonar_graph.images import SonarFrames, decibels
from sonar_graph.measurements import NS_PER_S, LandmarkDetections
from sonar_graph.sonar import Fan, MadeOfWindow
from sonar_graph.states import LandmarkMap

RECOGNITION = "recognition.json"
PICTURE_FOLDER = "recognised"
MOST_SHOWN = 6
MOST_PICTURES = 400
NONE = -1
LEAST_NAMED = 0.5
"""Posterior above which a detection counts as naming a landmark."""

NO_FLOOR = (
    "frame without a known floor: compared with the designs in the plane of the image"
)
CANDIDATE_OFF_FLOOR = "candidate rejected: off floor"
OFF_FLOOR = (
    "frame in which no floor can be: by mounting and tilt the sonar looks past it"
)
LACKS = "detections.floor"
"""Note of what is lacking for a known floor."""
FEWEST_TRACKS = 10
MOSTLY = 0.9
"""Number of reported tracks, and share of them without a landmark, from which images are doubted."""
SEE_TRACKS = "`sonar-graph recognise --report PAGE.html` shows the tracks"
"""Line after that doubt; not for that page itself."""


@dataclass(frozen=True, eq=False)
class DrawnFrame:
    """Picture of a frame with its detections."""

    stamp_ns: int
    jpeg: bytes
    landmark_ids: tuple[int, ...]
    """Most probable identity of each detection in it."""
    probabilities: tuple[float, ...]
    """Posterior of each of them."""


@dataclass(eq=False)
class Recognition:
    """Detections in the images of a log, and what became of every candidate, track and frame."""

    frames: int = 0
    detections: LandmarkDetections | None = None
    outcomes: Counter[str] = field(default_factory=Counter)
    """Count of each outcome of candidates, tracks and frames."""
    warnings: list[tuple[int, str]] = field(default_factory=list)
    """Stamp and reason of unused frames and of changes of the window: the first of each reason, and the earliest."""
    pictures: list[DrawnFrame] = field(default_factory=list)
    """Spread evenly over the run."""
    notes: dict[str, str] = field(default_factory=dict)
    """Model and settings."""
    unlike: tuple[int, int] = 0, 0
    """Number of tracks whose surroundings are rougher or smoother than `Confusion.roughness`, and of all."""

    def warned(self) -> dict[str, int]:
        """Count of warnings by reason, most frequent first."""
        reasons = {reason for _, reason in self.warnings}
        return {
            outcome: count
            for outcome, count in self.outcomes.most_common()
            if outcome in reasons
        }

    def naming(self, true_landmarks: LandmarkMap | None = None) -> list[str]:
        """Lines on how often each landmark was the most probable class, with warnings.

        Parameters
        ----------
        true_landmarks
            Of the log, if it has any: landmarks without a design are named.
        """
        named: Counter[int] = Counter()
        looked_for: set[int] = set()
        if self.detections is not None:
            looked_for = set(np.unique(self.detections.candidate_ids).tolist())
            ids, probability = self.detections.most_probable()
            # below it "none of them" is the most probable class
            named.update(np.where(probability > LEAST_NAMED, ids, NONE).tolist())
        counts = [f"landmark {i}: {n}" for i, n in sorted(named.items()) if i != NONE]
        never = ", ".join(map(str, sorted(looked_for - named.keys())))
        shares = [*counts, f"none of them: {named[NONE]}"]
        lines = (
            [
                f"Most probable: {', '.join(shares)}{f'; never: landmark {never}' if never else ''}"
            ]
            if named
            else []
        )
        if not counts:
            designs = self.notes.get("detections.designs", "those given")
            lines.append(
                f"Warning: no landmark was recognised; looked for {designs}; --designs gives others"
            )
        if LACKS in self.notes:
            lines.append(f"Warning: {self.notes[LACKS]}")
        # in more than half of the frames: a mounting or floor that is wrong
        if 2 * self.outcomes[OFF_FLOOR] > self.frames:
            lines.append(
                f"Warning: in {self.outcomes[OFF_FLOOR]} of {self.frames} frames the sonar looks past the floor: check "
                "[sonar.mounting] (a positive pitch turns it down), [floor] and sonar.elevation_aperture_rad"
            )
        judged = sum(
            count
            for outcome, count in self.outcomes.items()
            if outcome.startswith("candidate rejected")
        )
        if (
            not counts
            and judged >= FEWEST_TRACKS
            and 2 * self.outcomes[CANDIDATE_OFF_FLOOR] > judged
        ):
            lines.append(
                f"Warning: {self.outcomes[CANDIDATE_OFF_FLOOR]} of {judged} rejected candidates lie where no floor can "
                "be: check [floor], the depth, and [sonar.mounting]"
            )
        unknown = (
            sorted(set(true_landmarks.ids.tolist()) - looked_for)
            if true_landmarks and looked_for
            else []
        )
        if unknown:
            listed = ", ".join(map(str, unknown))
            lines.append(
                f"Warning: the log has landmarks {listed}, of which there is no design; give --designs"
            )
        outside, tracks = self.unlike
        if tracks >= FEWEST_TRACKS and 2 * outside > tracks:
            lines.append(
                f"Warning: {outside} of {tracks} tracks lie on a floor rougher or smoother than where the model was "
                "measured (1 in 20 is usual): check sonar.image (scale, decibel_span, full_scale), or use `calibrate`"
            )
        if not unknown and (line := self.unlike_the_model()) is not None:
            lines += [line, SEE_TRACKS]
        return lines

    def unlike_the_model(self) -> str | None:
        """Warning where nearly all tracks are of no landmark; None else, and for few tracks."""
        if self.detections is None:
            return None
        # the last row of a track has all of its evidence
        last = {track: row for row, track in enumerate(self.detections.track.tolist())}
        none = 1 - self.detections.id_probability[list(last.values())].sum(axis=1)
        count = int(np.count_nonzero(none > LEAST_NAMED))
        if len(last) < FEWEST_TRACKS or count < MOSTLY * len(last):
            return None
        return (
            f"Warning: {count} of {len(last)} tracks are of no landmark: the images may be unlike those that the model "
            "was measured on; `sonar-graph label` and `calibrate --labels` measure it on these"
        )

    def entry(self) -> dict[str, Any]:
        """Content for JSON, without detections and pictures."""
        return {
            "frames": self.frames,
            "outcomes": dict(self.outcomes.most_common()),
            "warnings": self.warnings,
            "notes": self.notes,
        }

    def shown(self) -> list[DrawnFrame]:
        """Picture with the highest posterior of each landmark, at most six, in order of identity."""
        surest: dict[int, tuple[float, DrawnFrame]] = {}
        for picture in self.pictures:
            for landmark, probability in zip(
                picture.landmark_ids, picture.probabilities, strict=True
            ):
                if probability > surest.get(landmark, (0.5, None))[0]:
                    surest[landmark] = probability, picture
        return [picture for _, (_, picture) in sorted(surest.items())][:MOST_SHOWN]


def write_recognition(recognition: Recognition | None, folder: Path) -> None:
    """Write ``recognition.json`` and the pictures that the report shows; remove those of an earlier comparison."""
    with result_written(folder, COMPARISON) as written:
        written.remove(
            [
                RECOGNITION,
                *(
                    name
                    for name in written.names
                    if name.startswith(f"{PICTURE_FOLDER}/")
                ),
            ]
        )
        if recognition is None:
            return
        shown = recognition.shown()
        for picture in shown:
            with replacing(
                folder / PICTURE_FOLDER / f"{picture.stamp_ns}.jpg"
            ) as partial:
                partial.write_bytes(picture.jpeg)
        pictures = [[p.stamp_ns, p.landmark_ids, p.probabilities] for p in shown]
        write_json(folder / RECOGNITION, recognition.entry() | {"pictures": pictures})


def read_recognition(folder: Path) -> Recognition | None:
    """Read the files of `write_recognition`, without detections; None for a folder without them."""
    if not (folder / RECOGNITION).is_file():
        return None
    entry: dict[str, Any] = read_json(folder / RECOGNITION)
    pictures = [
        DrawnFrame(
            stamp,
            regular(folder / PICTURE_FOLDER / f"{stamp}.jpg").read_bytes(),
            tuple(ids),
            tuple(probabilities),
        )
        for stamp, ids, probabilities in entry["pictures"]
    ]
    warnings = [(stamp, reason) for stamp, reason in entry["warnings"]]
    return Recognition(
        entry["frames"],
        None,
        Counter(entry["outcomes"]),
        warnings,
        pictures,
        entry["notes"],
    )


Picture = NDArray[np.uint8]
MARGIN = 6
SURE = 0.9
"""Posterior from which on an identity is drawn as certain."""
RECOGNISED = (60, 220, 255)
DOUBTFUL = (190, 190, 190)
"""Blue, green, red."""
JPEG_QUALITY = 85
TEXT_SIZE = 0.85
"""Legible where a page shows four pictures in a row."""


def draw_fan(
    image_db: NDArray[np.floating], fan: Fan, detections: LandmarkDetections | None
) -> Picture:
    """The frame in grey, the detections as rings with identity and posterior; shape (height, width, 3)."""
    # a few bright samples must not darken the rest
    low, high = np.percentile(image_db, [5, 99.7])
    grey = np.clip((image_db - low) / max(high - low, 1e-6) * 255, 0, 255).astype(
        np.uint8
    )
    shown = np.where(fan.beam >= 0, grey[np.maximum(fan.beam, 0), fan.bin], 0).astype(
        np.uint8
    )
    picture = np.asarray(
        cv2.cvtColor(cv2.medianBlur(shown, 3), cv2.COLOR_GRAY2BGR), np.uint8
    )
    if detections is not None:
        ids, probabilities = detections.most_probable()
        for i, (landmark, probability) in enumerate(
            zip(ids.tolist(), probabilities.tolist(), strict=True)
        ):
            place = fan.pixel(
                float(detections.range_m[i]), float(detections.azimuth_rad[i])
            )
            radius = round(0.23 * fan.pixels_per_m)
            is_sure = probability >= SURE
            # certain ones stand out; the others show their posterior
            colour = RECOGNISED if is_sure else DOUBTFUL
            text = f"ID {landmark}" if is_sure else f"ID {landmark}?  {probability:.2f}"
            cv2.circle(picture, place, radius, colour, 2 if is_sure else 1, cv2.LINE_AA)
            cv2.drawMarker(picture, place, colour, cv2.MARKER_CROSS, 9, 1)
            (width, height), descent = cv2.getTextSize(
                text, cv2.FONT_HERSHEY_SIMPLEX, TEXT_SIZE, 2
            )
            left = int(
                np.clip(
                    place[0] - width // 2, MARGIN, picture.shape[1] - width - MARGIN
                )
            )
            foot = max(place[1] - radius - 2 * MARGIN, height + MARGIN)
            corners = (
                (left - MARGIN, foot - height - MARGIN),
                (left + width + MARGIN, foot + descent),
            )
            cv2.rectangle(picture, *corners, (0, 0, 0), -1)
            cv2.putText(
                picture,
                text,
                (left, foot),
                cv2.FONT_HERSHEY_SIMPLEX,
                TEXT_SIZE,
                colour,
                2,
                cv2.LINE_AA,
            )
    return picture


def as_jpeg(picture: Picture) -> bytes:
    """The picture as the bytes of a JPEG file."""
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return encoded.tobytes()


class DrawnFrames:
    """Pictures spread evenly over a run whose length is not known: one a period, rather one with detections."""

    def __init__(self, image: SonarImage) -> None:
        self.pictures: list[DrawnFrame] = []
        self._image = image
        self._fans = MadeOfWindow(Fan.of)
        self._period_ns = NS_PER_S

    def add(self, frame: SonarFrames, found: LandmarkDetections | None) -> None:
        """Draw a block of one frame, if its time has come."""
        stamp_ns = int(frame.stamps_ns[0])
        is_early = (
            bool(self.pictures)
            and stamp_ns - self.pictures[-1].stamp_ns < self._period_ns
        )
        if is_early:
            # within the period only a first picture with detections replaces one without
            if found is None or self.pictures[-1].landmark_ids:
                return
            self.pictures.pop()
        ids: list[int] = []
        probabilities: list[float] = []
        if found is not None:
            ids, probabilities = (part.tolist() for part in found.most_probable())
        image_db = decibels(frame.intensity[0], self._image)
        jpeg = as_jpeg(draw_fan(image_db, self._fans.of(frame), found))
        self.pictures.append(
            DrawnFrame(stamp_ns, jpeg, tuple(ids), tuple(probabilities))
        )
        if len(self.pictures) > MOST_PICTURES:
            del self.pictures[1::2]
            self._period_ns *= 2
