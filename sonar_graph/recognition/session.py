"""From a log's sonar images to landmark detections.

Images are streamed and never held together; motion, tilt and height come from the sequence's other sensors
(`sonar_graph.recognition.sonar_motion`). Detections are computed once for a log and are the same for all estimators.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from sonar_graph.devices import LandmarkDesign
from sonar_graph.logs import read_sonar_frames
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.logs.mcap import TimeWindow
from sonar_graph.measurements import LandmarkDetections, SonarFrames
from sonar_graph.recognition.recognition_record import DrawnFrame, Recognition, as_jpeg, draw_fan
from sonar_graph.recognition.sonar_motion import SonarMotion, SonarMotions
from sonar_graph.sequence import NS_PER_S
from sonar_graph.sequence import Sequence as Run
from sonar_graph.sonar import Fan, Fate, FloorView, Recogniser, RecogniserParams, SonarStep, with_lens

MOST_PICTURES = 400
MOST_WARNINGS = 200
PICTURE_PERIOD_NS = NS_PER_S
NOT_USED = "frame not used"
OUT_OF_ORDER = "out of order"
LEAPT = "out of order: its stamp is ahead of the frame after it"
NO_FLOOR = "frame without a known floor: compared with the designs in the plane of the image"
NO_ODOMETRY = "no IMU and Doppler log at its stamp"


class LandmarkRecogniser(Protocol):
    """What makes detections of frames: `Recogniser`, or another one in its place."""

    fates: list[Fate]
    """What became of everything in the frame last processed."""

    def process(
        self, frame: SonarFrames, motion: SonarStep | None = None, view: FloorView | None = None
    ) -> LandmarkDetections | None:
        """Take in one frame; what is recognised in it."""
        ...

    def notes(self) -> dict[str, str]:
        """How detections come about, for a log's notes."""
        ...


def recognise(
    log: Path,
    sequence: Run,
    *,
    topic: str | None = None,
    config: LogConfig | None = None,
    designs: Sequence[LandmarkDesign] | None = None,
    params: RecogniserParams | None = None,
    recogniser: LandmarkRecogniser | None = None,
    window: TimeWindow | None = None,
    salvage: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Recognition | None:
    """Recognise landmarks in the sonar images of a log.

    Parameters
    ----------
    log
        An MCAP file with sonar images.
    sequence
        The rest of the log.
    topic, config
        As of `read_sonar_frames`.
    designs, params
        As of `Recogniser`.
    recogniser
        In place of a `Recogniser` with those designs and params.
    window, salvage
        As of `read_log`, and as the sequence was read.
    progress
        Called with the number of frames done.

    Returns
    -------
    Recognition | None
        None where the log has no images.

    Raises
    ------
    LogError
        As `read_sonar_frames`.
    CalibrationError
        When designs and measured model do not belong together.
    """
    session = RecognitionSession(sequence, designs, params, recogniser=recogniser)
    blocks = read_sonar_frames(log, topic, config, window=window, salvage=salvage, refused=session.refuse)
    frames = (frame for block in blocks for frame in one_by_one(block))
    for frame in without_leaps(frames, session.refuse):
        session.take(frame)
        if progress is not None:
            progress(session.result.frames)
    return session.finish() if session.result.frames else None


def with_detections(sequence: Run, recognition: Recognition) -> Run:
    """The sequence with what was recognised; its notes say how."""
    return replace(sequence, detections=recognition.detections, notes=sequence.notes | recognition.notes)


def one_by_one(block: SonarFrames) -> Iterator[SonarFrames]:
    """Blocks of one frame each."""
    for row in range(len(block)):
        yield SonarFrames(
            block.stamps_ns[row : row + 1], block.intensity[row : row + 1], block.ranges_m, block.azimuths_rad
        )


def without_leaps(frames: Iterable[SonarFrames], refuse: Callable[[int, str], None]) -> Iterator[SonarFrames]:
    """Frames, blocks of one, without those whose stamp is wrong by so much that the frames after would be late.

    A frame that is ahead of the next one, while that one is ahead of all before, is refused: of the two stamps one is
    wrong, and this way only one frame is lost.
    """
    latest_ns, held = -1, None
    for frame in frames:
        if held is not None:
            stamp_ns, next_ns = int(held.stamps_ns[0]), int(frame.stamps_ns[0])
            if stamp_ns > next_ns > latest_ns:
                refuse(stamp_ns, LEAPT)
            else:
                latest_ns = max(latest_ns, stamp_ns)
                yield held
        held = frame
    if held is not None:
        yield held


class RecognitionSession:
    """Recognises frame by frame and gathers what came of it; what is kept does not grow with the images."""

    def __init__(
        self,
        sequence: Run,
        designs: Sequence[LandmarkDesign] | None = None,
        params: RecogniserParams | None = None,
        *,
        recogniser: LandmarkRecogniser | None = None,
        pictures: bool = True,
    ) -> None:
        self._draws = pictures
        self.result = Recognition()
        self.recogniser = recogniser or Recogniser(sequence.calibration, designs, params)
        self.motion: SonarMotion | None = None
        self._image_scale = sequence.calibration.sonar.image
        self._lens = sequence.calibration.sonar.lens
        self._motions = SonarMotions(sequence)
        self._blocks: list[LandmarkDetections] = []
        self._fan: Fan | None = None
        self._fan_of: tuple[object, object] = (None, None)
        self._picture_period_ns = PICTURE_PERIOD_NS

    def take(self, frame: SonarFrames) -> LandmarkDetections | None:
        """One frame, a block of one."""
        self.result.frames += 1
        stamp_ns = int(frame.stamps_ns[0])
        if not self._motions.covers(stamp_ns):
            reason = OUT_OF_ORDER if self._motions.passed(stamp_ns) else NO_ODOMETRY
            self._warn(stamp_ns, f"{NOT_USED}: {reason}")
            return None
        self.motion = motion = self._motions.at(stamp_ns)
        frame = with_lens(frame, self._lens)
        view = view_of(motion)
        self.result.outcomes[NO_FLOOR] += view is None
        found = self.recogniser.process(frame, step_of(motion), view)
        is_used = True
        for fate in self.recogniser.fates:
            if np.isnan(fate.range_m) and fate.track < 0:
                self._warn(stamp_ns, fate.outcome)
                is_used &= not fate.outcome.startswith(NOT_USED)
            else:
                self.result.outcomes[fate.outcome] += 1
        if found is not None:
            self._blocks.append(found)
        if self._draws and is_used:
            self._draw(frame, found)
        return found

    def refuse(self, stamp_ns: int, reason: str) -> None:
        """Count a message that is no frame."""
        self.result.frames += 1
        self._warn(stamp_ns, f"{NOT_USED}: {reason}")

    def finish(self) -> Recognition:
        """All that was gathered."""
        result = self.result
        result.detections = LandmarkDetections.concatenate(self._blocks) if self._blocks else None
        result.notes = {"detections": f"recognised in {result.frames} sonar images"} | self.recogniser.notes()
        result.outcomes = +result.outcomes  # without what never happened
        result.warnings.sort(key=lambda row: row[0])
        if result.warnings:
            result.notes["detections.warnings"] = "; ".join(f"{n} x {reason}" for reason, n in result.warned().items())
        return result

    def _warn(self, stamp_ns: int, reason: str) -> None:
        if len(self.result.warnings) < MOST_WARNINGS or reason not in self.result.outcomes:
            self.result.warnings.append((stamp_ns, reason))
        self.result.outcomes[reason] += 1

    def _draw(self, frame: SonarFrames, found: LandmarkDetections | None) -> None:
        """A picture now and then; of too many every second one is given up."""
        pictures, stamp_ns = self.result.pictures, int(frame.stamps_ns[0])
        if pictures and stamp_ns - pictures[-1].stamp_ns < self._picture_period_ns:
            return
        if self._fan is None or self._fan_of != (id(frame.ranges_m), id(frame.azimuths_rad)):
            self._fan = Fan.of(frame.ranges_m, frame.azimuths_rad)
            self._fan_of = (id(frame.ranges_m), id(frame.azimuths_rad))
        ids, probabilities = found.most_probable() if found is not None else (np.empty(0, int), np.empty(0))
        picture = draw_fan(self._image_scale.decibels(frame.intensity[0]), self._fan, found)
        pictures.append(DrawnFrame(stamp_ns, as_jpeg(picture), tuple(ids.tolist()), tuple(probabilities.tolist())))
        if len(pictures) > MOST_PICTURES:
            del pictures[1::2]
            self._picture_period_ns *= 2


def step_of(motion: SonarMotion) -> SonarStep | None:
    """The motion since the frame before, as the tracker wants it."""
    return None if motion.previous_T_sonar is None else SonarStep(motion.previous_T_sonar, motion.covariance)


def view_of(motion: SonarMotion) -> FloorView | None:
    """The floor, where the height over it is known."""
    if motion.height_m is None or motion.height_m <= 0:
        return None
    return FloorView(motion.level_R_sonar, motion.height_m, motion.height_sigma_m, motion.tilt_sigma_rad)
