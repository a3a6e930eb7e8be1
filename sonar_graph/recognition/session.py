"""Landmark detections from the sonar images of a log, as `sonar-graph recognise` and `sonar-graph compare` make them.

    images -> one frame at a time -> motion, tilt and height at its stamp -> Recogniser.process -> LandmarkDetections

Images are streamed. Motion, tilt and height come from the other sensors (`sonar_graph.recognition.sonar_motion`), or
motion from the images themselves (`sonar_graph.recognition.image_motion`).
Detections are made once for a log, and are the same for all estimators. Design: docs/design/0009-recognition.md.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.devices import LandmarkDesign
from sonar_graph.errors import CalibrationError, LogError, MeasurementError
from sonar_graph.estimator import PlugIns
from sonar_graph.images import NO_DEPTH, NO_HEIGHT, NO_TILT, SonarFrames
from sonar_graph.logs import (
    ImagesAlone,
    PartialCalibration,
    Window,
    read_log,
    read_sonar_frames,
)
from sonar_graph.logs import no_images as no_images
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import Depth, Dvl, Imu, LandmarkDetections
from sonar_graph.recognition.image_motion import ImageMotions, MotionFrom
from sonar_graph.recognition.recognition_record import (
    LACKS,
    NO_FLOOR,
    OFF_FLOOR,
    DrawnFrames,
    Recognition,
)
from sonar_graph.recognition.sonar_motion import SonarMotions
from sonar_graph.sequence import Sequence as Run
from sonar_graph.sonar import (
    EVIDENCE,
    FloorView,
    RecognisedFrame,
    Recogniser,
    RecogniserParams,
    SonarStep,
    with_lens,
)

MOST_WARNINGS = 200
NOT_USED = "frame not used"
LEAPT = "out of order: its stamp is ahead of the frame after it"

RECOGNISERS = PlugIns(
    "sonar_graph.recognisers",
    "recogniser",
    CalibrationError,
    CalibrationError,
    built_in=("designs",),
)
"""Recognisers of other packages: functions or classes of a calibration and a dict of settings."""


class LandmarkRecogniser(Protocol):
    """Interface of `Recogniser` and of anything used in its place."""

    def process(
        self,
        frame: SonarFrames,
        motion: SonarStep | None = None,
        view: FloorView | None = None,
    ) -> RecognisedFrame:
        """Recognise landmarks in a block of one frame."""
        ...

    def notes(self) -> dict[str, str]:
        """Rule, designs and model, for the notes of a log."""
        ...


def recognise(
    images: Path | str | Iterable[SonarFrames],
    sequence: Run | None = None,
    *,
    designs: Sequence[LandmarkDesign] | None = None,
    params: RecogniserParams | None = None,
    recogniser: LandmarkRecogniser | None = None,
    calibration: Calibration | PartialCalibration | str | Path | None = None,
    topics: Mapping[str, str] | None = None,
    config: LogConfig | str | Path | None = None,
    window: Window | None = None,
    salvage: bool = False,
) -> Run:
    """Recognise landmarks in sonar images; give the sequence with the detections in it.

    Parameters
    ----------
    images
        An MCAP file with sonar images, or blocks of frames in the order of their stamps.
    sequence
        The other sensors, which give motion, tilt and height. None: read from the same log.
    designs
        Landmarks to look for; None: those that ship (`sonar_graph.devices.load_designs` reads others).
    params
        Settings of the `Recogniser`; None: the defaults.
    recogniser
        Another recogniser (`LandmarkRecogniser`); then `designs` and `params` are not used.
    calibration, config, window, salvage
        As of `sonar_graph.logs.read_log`.
    topics
        Topics by role, as of `read_log`; the role of the images is ``sonar``.

    Returns
    -------
    Sequence
        A copy of the sequence; earlier detections are replaced, and the notes describe how these were made.

    Raises
    ------
    LogError
        When the log has no sonar images, or cannot be read.
    MeasurementError
        When frames come without a sequence.
    CalibrationError
        When designs and measured model do not belong together.

    See Also
    --------
    recognise_images : the same with a record of what became of every candidate and frame.

    Examples
    --------
    The first minute in a simulated basin. From a log: ``recognise("dive.mcap").detections``.

    >>> from itertools import islice
    >>> from sonar_graph.recognition import recognise
    >>> from sonar_graph.simulation import BasinOptions, simulate_basin, simulate_basin_frames
    >>> options = BasinOptions(duration_s=240.0, laps=1)
    >>> blocks = islice(simulate_basin_frames(options), 10)  # 32 frames each
    >>> run = recognise((block.frames for block in blocks), simulate_basin(options))
    >>> ids, probability = run.detections.most_probable()
    """
    if sequence is None:
        if not isinstance(images, Path | str):
            raise MeasurementError(
                "recognise: frames need a sequence with IMU and DVL; give one, or the path of a log"
            )
        sequence = read_log(
            Path(images),
            calibration=calibration,
            topics=topics,
            config=config,
            window=window,
            salvage=salvage,
        )
    found = recognise_images(
        images,
        sequence,
        topic=(topics or {}).get("sonar"),
        config=config,
        designs=designs,
        params=params,
        recogniser=recogniser,
        window=window,
        salvage=salvage,
    )
    if found is None:
        raise LogError(
            no_images(images)
            if isinstance(images, Path | str)
            else "recognise: no sonar frame was given"
        )
    return with_detections(sequence, found)


def recognise_images(
    images: Path | str | Iterable[SonarFrames],
    sequence: Run | ImagesAlone,
    *,
    motion: MotionFrom = "navigation",
    topic: str | None = None,
    config: LogConfig | str | Path | None = None,
    designs: Sequence[LandmarkDesign] | None = None,
    params: RecogniserParams | None = None,
    recogniser: LandmarkRecogniser | None = None,
    window: Window | None = None,
    salvage: bool = False,
    progress: Callable[[int], None] | None = None,
    seen: Callable[[SonarFrames, RecognisedFrame], None] | None = None,
) -> Recognition | None:
    """Recognise landmarks in sonar images, with a record of what became of every candidate and frame.

    Parameters and errors are those of `recognise`, with the topic of the images and the window and salvage of the
    sequence; ``progress`` is called with the number of frames done, ``seen`` with each frame that was used and its result.
    None where there are no images.

    Without IMU and Doppler log (`ImagesAlone`) the motion is from the images; "fixed" is of a sonar at rest.
    """
    calibration = sequence.calibration
    session = RecognitionSession(
        sequence, recogniser or Recogniser(calibration, designs, params), motion
    )
    drawn = DrawnFrames(calibration.sonar.image)
    if isinstance(images, Path | str):
        images = read_sonar_frames(
            Path(images),
            topic,
            config,
            window=window,
            salvage=salvage,
            refused=session.refuse,
        )
    for frame, result in session.run(images):
        if result.is_used:
            frame = with_lens(frame, calibration.sonar.lens)
            drawn.add(frame, result.detections)
            if seen is not None:
                seen(frame, result)
        if progress is not None:
            progress(session.frames)
    if not session.frames:
        return None
    return replace(session.finish(), pictures=drawn.pictures)


def with_detections(sequence: Run, recognition: Recognition) -> Run:
    """The sequence with the detections of a recognition, and its notes."""
    return replace(
        sequence,
        detections=recognition.detections,
        notes=sequence.notes | recognition.notes,
    )


def one_by_one(block: SonarFrames) -> Iterator[SonarFrames]:
    """Blocks of one frame each."""
    for row in range(len(block)):
        yield SonarFrames(
            block.stamps_ns[row : row + 1],
            block.intensity[row : row + 1],
            block.ranges_m,
            block.azimuths_rad,
        )


def without_leaps(
    frames: Iterable[SonarFrames], refuse: Callable[[int, str], None]
) -> Iterator[SonarFrames]:
    """Frames (blocks of one) without those whose stamp leaps ahead.

    A frame ahead of the next one is refused if that one is ahead of all before. One of the two stamps is wrong, and
    this way only one frame is lost.
    """
    latest_ns = -1
    held = None
    for frame in frames:
        if held is not None:
            stamp_ns = int(held.stamps_ns[0])
            next_ns = int(frame.stamps_ns[0])
            # the next frame goes on from before: this one is ahead by mistake
            if stamp_ns > next_ns > latest_ns:
                refuse(stamp_ns, LEAPT)
            else:
                latest_ns = max(latest_ns, stamp_ns)
                yield held
        held = frame
    if held is not None:
        yield held


class RecognitionSession:
    """Recognition frame by frame; its memory does not grow with the number of images."""

    def __init__(
        self,
        sequence: Run | ImagesAlone,
        recogniser: LandmarkRecogniser,
        motion: MotionFrom = "navigation",
    ) -> None:
        self.frames = 0
        """Number of frames until now, refused ones included."""
        self._outcomes: Counter[str] = Counter()
        self._warnings: list[tuple[int, str]] = []
        self.recogniser = recogniser
        self.start_T_sonar = gtsam.Pose3()
        """Pose of the sonar at the last frame, in its axes at the first."""
        self.view: FloorView | None = None
        """View of the floor at the last frame, where it is known."""
        self._sonar = sequence.calibration.sonar
        # for the notes: why the floor was not known, where it was not
        self._lacks = ""
        if motion != "navigation":
            self._lacks = NO_TILT
        elif sequence.calibration.floor is None:
            self._lacks = NO_HEIGHT
        elif getattr(sequence, "depth", None) is None:
            self._lacks = NO_DEPTH
        self._motions: SonarMotions | ImageMotions
        if motion == "navigation" and isinstance(sequence, Run):
            self._motions = SonarMotions(sequence)
        else:
            self._motions = ImageMotions(
                sequence.calibration, is_fixed=motion == "fixed"
            )
        self._blocks: list[LandmarkDetections] = []
        self._beyond: dict[int, tuple[float, int]] = {}
        """Sum of the evidence `beyond` of each track, and number of its frames."""

    def run(
        self, blocks: Iterable[SonarFrames]
    ) -> Iterator[tuple[SonarFrames, RecognisedFrame]]:
        """Recognise blocks of frames; each frame with its result, as it is done."""
        frames = (frame for block in blocks for frame in one_by_one(block))
        for frame in without_leaps(frames, self.refuse):
            yield frame, self.take(frame)

    def extend(self, imu: Imu | None, dvl: Dvl | None, depth: Depth | None) -> None:
        """Take in rows of the other sensors that have come since, where the images come live."""
        if isinstance(self._motions, SonarMotions):
            self._motions.extend(imu, dvl, depth)

    def forget(self) -> None:
        """Forget what only the record of the whole run needs, where there is no end."""
        self._blocks.clear()

    def take(self, frame: SonarFrames) -> RecognisedFrame:
        """Recognise a block of one frame."""
        stamp_ns = int(frame.stamps_ns[0])
        if reason := self._motions.refusal(stamp_ns):
            self.refuse(stamp_ns, reason)
            return RecognisedFrame.not_used(stamp_ns, f"{NOT_USED}: {reason}")
        self.frames += 1
        if isinstance(self._motions, ImageMotions):
            self._motions.add(frame)
        step, view = self._motions.at(stamp_ns)
        self.view = view
        if step is not None:
            self.start_T_sonar = self.start_T_sonar.compose(step.previous_T_sonar)
        frame = with_lens(frame, self._sonar.lens)
        # counted for warnings: without a floor fewer landmarks are recognised
        self._outcomes[NO_FLOOR] += view is None
        self._outcomes[OFF_FLOOR] += view is not None and not self._may_show_floor(
            frame, view
        )
        result = self.recogniser.process(frame, step, view)
        for fate in result.fates:
            if fate.is_of_frame:
                self._warn(stamp_ns, fate.outcome)
            else:
                self._outcomes[fate.outcome] += 1
        if not result.is_used:
            return result
        if result.detections is not None:
            self._blocks.append(result.detections)
        for track in result.tracks:
            if track.sighting is not None and track.sighting.fit is not None:
                # how rough the surroundings are, against those of the measured model
                beyond = track.sighting.fit.evidence[:, EVIDENCE.index("beyond")]
                total, count = self._beyond.get(track.id, (0.0, 0))
                self._beyond[track.id] = total + float(beyond.mean()), count + 1
        return result

    def refuse(self, stamp_ns: int, reason: str) -> None:
        """Count a message that is not a usable frame."""
        self.frames += 1
        self._warn(stamp_ns, f"{NOT_USED}: {reason}")

    def finish(self) -> Recognition:
        """The record of all frames, without pictures."""
        notes = {"detections": f"recognised in {self.frames} sonar images"}
        notes |= self.recogniser.notes()
        if isinstance(self._motions, ImageMotions):
            notes |= self._motions.notes()
        if self._lacks and self._outcomes[NO_FLOOR]:
            notes[LACKS] = self._lacks
        unlike = (0, 0)
        usual = None
        if isinstance(self.recogniser, Recogniser):
            usual = self.recogniser.confusion.roughness
        if usual is not None:
            means = [total / count for total, count in self._beyond.values()]
            outside = [not usual[0] <= mean <= usual[1] for mean in means]
            unlike = (sum(outside), len(means))
        whole = Recognition(
            frames=self.frames,
            detections=LandmarkDetections.concatenate(self._blocks)
            if self._blocks
            else None,
            outcomes=+self._outcomes,  # drops zero counts
            warnings=sorted(self._warnings, key=lambda row: row[0]),
            notes=notes,
            unlike=unlike,
        )
        if whole.warnings:
            reasons = [f"{n} x {reason}" for reason, n in whole.warned().items()]
            notes["detections.warnings"] = "; ".join(reasons)
        return whole

    def _may_show_floor(self, frame: SonarFrames, view: FloorView) -> bool:
        """True if the floor lies within the vertical aperture at any range ahead."""
        ranges_m = frame.ranges_m
        q = view.floor_points(
            ranges_m, np.full(len(ranges_m), float(np.median(frame.azimuths_rad)))
        )
        # NaN where the ray does not reach the floor, which compares false
        elevation_rad = np.arcsin(q[:, 2] / ranges_m)
        return bool(
            (np.abs(elevation_rad) <= self._sonar.elevation_aperture_rad / 2).any()
        )

    def _warn(self, stamp_ns: int, reason: str) -> None:
        if len(self._warnings) < MOST_WARNINGS or reason not in self._outcomes:
            self._warnings.append((stamp_ns, reason))
        self._outcomes[reason] += 1
