"""Recogniser of landmarks in sonar frames.

    frame -> decibels -> candidates (cfar) -> tracks (tracker) -> fits of designs (appearance) -> beliefs (bayes)

The steps are those of the 2014 paper: candidate selection, elimination of noisy data, Bayesian feature estimation.
Every candidate, track and unused frame has a row with its reason in `RecognisedFrame.fates`.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from pydantic import Field
from scipy.optimize import linear_sum_assignment

from sonar_graph.calibration import Calibration, Section
from sonar_graph.devices import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.images import SonarFrames, decibels
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.sonar.appearance import AppearanceParams, CandidateFit, ObjectSighting
from sonar_graph.sonar.bayes import Beliefs, IdentityParams
from sonar_graph.sonar.cfar import DetectionParams, check_candidates, select_candidates
from sonar_graph.sonar.confusion import Confusion, confusion_for
from sonar_graph.sonar.frame_check import FrameCheck, check_block
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.regions import Candidates, CandidateVerdict
from sonar_graph.sonar.templates import check_headings
from sonar_graph.sonar.tracker import Association, SonarStep, Tracker, TrackingParams


class RecogniserParams(Section):
    """Settings of the recogniser.

    Examples
    --------
    >>> from sonar_graph import Calibration
    >>> from sonar_graph.sonar import Recogniser, RecogniserParams
    >>> recogniser = Recogniser(Calibration(), params=RecogniserParams(detection={"false_alarm": 1e-4}))
    >>> recogniser.params.detection.false_alarm
    0.0001
    """

    detection: DetectionParams = DetectionParams()
    tracking: TrackingParams = TrackingParams()
    appearance: AppearanceParams = AppearanceParams()
    identity: IdentityParams = IdentityParams()
    confusion: Confusion | None = None
    """Measured model; None: the one that ships for the designs that ship, and an assumed one for others."""
    least_existence: float = Field(0.5, ge=0, le=1)
    """Tracks that exist less probably are not reported."""
    least_frames: int = Field(3, ge=1)
    """Frames in which a track must have been seen before it is reported."""
    independent: bool = True
    """Report a track as often as its errors are independent, and when its most probable identity changes or reaches one
    of `ACCEPTED_FROM`. False: in every frame, as if errors of successive frames were independent."""


class Fate(NamedTuple):
    """Outcome of one candidate, one track, or a whole frame.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph import Calibration, SonarFrames
    >>> from sonar_graph.sonar import Recogniser
    >>> recogniser = Recogniser(Calibration())
    >>> black = np.zeros((1, 96, 512), np.uint8)
    >>> ranges_m, azimuths_rad = np.linspace(1.26, 2.51, 512), np.linspace(0.25, -0.25, 96)
    >>> result = recogniser.process(SonarFrames(np.array([0]), black, ranges_m, azimuths_rad))
    >>> [fate.outcome for fate in result.fates]
    ['frame not used: all samples are zero']
    """

    stamp_ns: int
    track: int
    """-1: no track."""
    range_m: float
    azimuth_rad: float
    """NaN for a frame."""
    outcome: str
    """Words; `REPORTED` for a detection."""

    @classmethod
    def of_frame(cls, stamp_ns: int, outcome: str) -> Fate:
        """Outcome of a whole frame."""
        return cls(stamp_ns, -1, np.nan, np.nan, outcome)

    @property
    def is_of_frame(self) -> bool:
        """True for the outcome of a whole frame."""
        return self.track < 0 and math.isnan(self.range_m)


class TrackInFrame(NamedTuple):
    """A track in one frame."""

    id: int
    """Number of the track."""
    sighting: ObjectSighting | None
    """Fit of the designs; None where the track took no candidate."""
    independent_share: float
    """Independent share of the frame for this track, 0 to 1."""
    beliefs: Floats
    """Probability of each landmark and of none of them, shape (ids + 1,)."""


class RecognisedFrame(NamedTuple):
    """Result of a recogniser for one frame.

    Examples
    --------
    >>> from sonar_graph.sonar import RecognisedFrame
    >>> RecognisedFrame.not_used(0, "frame not used: saturated").is_used
    False
    """

    stamp_ns: int
    detections: LandmarkDetections | None
    """One row for each track that is seen now and trusted, with the posterior over all landmarks; None without one."""
    fates: list[Fate]
    """Outcome of every candidate, every track and every fault."""
    tracks: tuple[TrackInFrame, ...] = ()
    """Empty of a recogniser without tracks."""
    is_used: bool = True
    """False for a frame with a fault."""

    @classmethod
    def not_used(cls, stamp_ns: int, reason: str) -> RecognisedFrame:
        """Result for a frame that must not be used."""
        return cls(stamp_ns, None, [Fate.of_frame(stamp_ns, reason)], is_used=False)


PITCH_RAD = 0.15
STEEPEST_RAD = 1.3
"""Tilt of a vehicle, and steepest view, for which templates are drawn in advance."""
ACCEPTED_FROM = (0.5, 0.7)
"""Posteriors from which an identity is likelier than not, and from which estimators accept it by default."""
REPORTED = "reported"
NOT_INDEPENDENT = (
    "not reported: too soon after the track's last detection to be independent of it"
)
REJECTED = {
    int(v): f"candidate rejected: {v.name.lower().replace('_', ' ')}"
    for v in CandidateVerdict
}


class LastReport(NamedTuple):
    """Last detection of a track."""

    stamp_ns: int
    best: int
    """Most probable class."""
    level: int
    """Number of `ACCEPTED_FROM` that its probability had reached."""


class Recogniser:
    """Recogniser of landmarks in the frames of one sonar, in order.

    Parameters
    ----------
    calibration
        Aperture and scale of samples of the sonar.
    designs
        The landmarks that may be there; None: those that ship.
    params
        None: the defaults.

    Raises
    ------
    CalibrationError
        When the model was measured on other designs, or a design can never be found.

    Examples
    --------
    An empty frame:

    >>> import numpy as np
    >>> from sonar_graph import Calibration, SonarFrames
    >>> from sonar_graph.sonar import Recogniser
    >>> noise = np.random.default_rng(1).normal(100.0, 10.0, (1, 96, 512)).astype(np.uint8)
    >>> ranges_m, azimuths_rad = np.linspace(1.26, 2.51, 512), np.linspace(0.25, -0.25, 96)
    >>> recogniser = Recogniser(Calibration())
    >>> recogniser.process(SonarFrames(np.array([0]), noise, ranges_m, azimuths_rad)).detections is None
    True
    """

    def __init__(
        self,
        calibration: Calibration,
        designs: Sequence[LandmarkDesign] | None = None,
        params: RecogniserParams | None = None,
    ) -> None:
        self.params = params or RecogniserParams()
        self.designs = tuple(designs or DEFAULT_DESIGNS)
        self.confusion = self.params.confusion or confusion_for(self.designs)
        self.ids = np.array([design.id for design in self.designs])
        self.confusion.check_designs(self.designs)
        check_candidates(
            self.designs, self.params.detection, self.params.appearance.search_m
        )
        check_headings(self.designs)
        self._calibration = calibration
        opening_rad = calibration.sonar.elevation_aperture_rad
        self._appearance = CandidateFit(
            self.designs, self.params.appearance, self.confusion, opening_rad
        )
        self._tracker = Tracker(self.params.tracking)
        self._beliefs = Beliefs(self.confusion, self.params.identity)
        self._check = FrameCheck(calibration.sonar.image)
        self._start_T_sonar = gtsam.Pose3()
        self._interval_ns = (
            round(1e9 * self.confusion.report_interval_s)
            if self.params.independent
            else 0
        )
        self._reported: dict[int, LastReport] = {}
        """Last report of each track."""

    def prepare(self, frame: SonarFrames) -> None:
        """Draw the templates that frames with these ranges and beams may need, before the first of them arrives."""
        sonar = self._calibration.sonar
        # the vehicle pitches about the mounting
        tilt_rad = abs(sonar.mounting.rpy_rad[1])
        half_rad = sonar.elevation_aperture_rad / 2 + PITCH_RAD
        depressions_rad = (
            max(tilt_rad - half_rad, 0.0),
            min(tilt_rad + half_rad, STEEPEST_RAD),
        )
        self._appearance.prepare(frame.ranges_m, frame.azimuths_rad, depressions_rad)

    def process(
        self,
        frame: SonarFrames,
        motion: SonarStep | None = None,
        view: FloorView | None = None,
    ) -> RecognisedFrame:
        """Recognise landmarks in one frame: cfar, tracker, appearance, bayes.

        Parameters
        ----------
        frame
            A block of one frame.
        motion
            Motion of the sonar since the frame before; None for the first.
        view
            Tilt and height over the floor; None: not known, and patches are compared in the image's plane.

        Raises
        ------
        MeasurementError
            When the block is not one frame.
        """
        check_block(frame)
        stamp_ns = int(frame.stamps_ns[0])
        if motion is not None:
            self._start_T_sonar = self._start_T_sonar.compose(motion.previous_T_sonar)
        verdict = self._check.judge(frame)
        if verdict.fault is not None:
            # the tracker predicts over this frame with the next good one
            self._tracker.skip(motion or SonarStep.none())
            return RecognisedFrame.not_used(
                stamp_ns, f"frame not used: {verdict.fault}"
            )
        image_db = decibels(
            np.ascontiguousarray(frame.intensity[0]), self._calibration.sonar.image
        )
        candidates = select_candidates(
            image_db, frame.ranges_m, frame.azimuths_rad, view, self.params.detection
        )
        association = self._tracker.step(candidates, motion, stamp_ns)
        sightings = self._appearance.at(
            image_db, frame, view, candidates, association.candidate
        )
        log_odds = self._appearance.log_odds(sightings)
        is_fitted = np.isfinite(log_odds[:, -1])
        # horizontal unit vectors across each line of sight, in the axes of the first frame: motion along them changes
        # the speckle most
        azimuth = np.arctan2(association.position_m[:, 1], association.position_m[:, 0])
        across = np.column_stack(
            [-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)]
        )
        sideways = across @ self._start_T_sonar.rotation().matrix().T
        place = self._start_T_sonar.translation()
        beliefs, shares = self._beliefs.step(
            association, log_odds, is_fitted, place, sideways
        )
        detections, fates = self._report(candidates, association, sightings, beliefs)
        if verdict.change is not None:
            fates.append(Fate.of_frame(stamp_ns, verdict.change))
        columns = (
            association.ids.tolist(),
            sightings,
            shares.tolist(),
            each_once(beliefs),
        )
        tracks = tuple(TrackInFrame(*row) for row in zip(*columns, strict=True))
        return RecognisedFrame(stamp_ns, detections, fates, tracks)

    def _report(
        self,
        candidates: Candidates,
        association: Association,
        sightings: Sequence[ObjectSighting | None],
        beliefs: Floats,
    ) -> tuple[LandmarkDetections | None, list[Fate]]:
        """Rows for the tracks that are seen and trusted; fates of all candidates and tracks."""
        stamp_ns = association.stamp_ns
        columns = (
            candidates.verdicts.tolist(),
            candidates.range_m.tolist(),
            candidates.azimuth_rad.tolist(),
        )
        fates = [
            Fate(stamp_ns, -1, range_m, azimuth_rad, REJECTED[verdict])
            for verdict, range_m, azimuth_rad in zip(*columns, strict=True)
            if verdict != CandidateVerdict.ACCEPTED
        ]
        reported: dict[int, ObjectSighting] = {}
        for row, sighting in enumerate(sightings):
            if sighting is None:
                continue
            track = int(association.ids[row])
            outcome = self._outcome(row, association, sighting, beliefs[row])
            if outcome == REPORTED:
                reported[row] = sighting
                self._reported[track] = LastReport(stamp_ns, *self._named(beliefs[row]))
            fates.append(
                Fate(stamp_ns, track, sighting.range_m, sighting.azimuth_rad, outcome)
            )
        ended = association.ended_ids.tolist()
        for track, reason in zip(ended, association.ended_reasons, strict=True):
            fates.append(
                Fate(stamp_ns, track, np.nan, np.nan, f"track ended: {reason}")
            )
            # it is never reported again
            self._reported.pop(track, None)
        if not reported:
            return None, fates
        rows = list(reported)
        found = reported.values()
        detections = LandmarkDetections(
            stamps_ns=np.full(len(rows), stamp_ns),
            range_m=np.array([sighting.range_m for sighting in found]),
            azimuth_rad=np.array([sighting.azimuth_rad for sighting in found]),
            range_azimuth_cov=np.array([sighting.covariance for sighting in found]),
            candidate_ids=np.tile(self.ids, (len(rows), 1)),
            id_probability=each_once(beliefs[rows])[:, :-1],
            track=association.ids[rows],
        )
        return detections, fates

    def _named(self, beliefs: Floats) -> tuple[int, int]:
        """Most probable class, and the number of `ACCEPTED_FROM` that its probability reaches; 0 of no landmark."""
        best = int(np.argmax(beliefs))
        is_landmark = best < len(self.ids)
        return best, bisect_right(ACCEPTED_FROM, beliefs[best]) if is_landmark else 0

    def _outcome(
        self,
        row: int,
        association: Association,
        sighting: ObjectSighting,
        beliefs: Floats,
    ) -> str:
        """Outcome of the track in this row, which took a candidate."""
        params = self.params
        if sighting.fit is None:
            return "not reported: too little of it is in view"
        if association.frames_seen[row] < params.least_frames:
            return f"not reported: seen in fewer than {params.least_frames} frames"
        if association.existence[row] < params.least_existence:
            return f"not reported: exists with less than {params.least_existence:g}"
        last = self._reported.get(int(association.ids[row]))
        if last is None:
            return REPORTED
        best, level = self._named(beliefs)
        # a changed or surer identity is reported although range and azimuth repeat their errors
        is_changed = best != last.best or level > last.level
        is_due = association.stamp_ns - last.stamp_ns >= self._interval_ns
        return REPORTED if is_changed or is_due else NOT_INDEPENDENT

    def notes(self) -> dict[str, str]:
        """Rule, designs and model, for the notes of a log."""
        return {
            "detections.rule": self.params.identity.rule,
            "detections.designs": ", ".join(
                f"{design.id}: {design.name}" for design in self.designs
            ),
            "detections.model": "; ".join(
                f"{k}: {v}" for k, v in self.confusion.provenance.items()
            )
            or "unknown",
        }


def each_once(beliefs: Floats) -> Floats:
    """Beliefs in which no landmark is the most probable identity of two tracks, shape (M, classes).

    The most probable assignment of tracks to landmarks (or to none) decides; a track that loses its most probable
    landmark to another one believes in "none of them" instead.
    """
    tracks = beliefs.shape[0]
    known = beliefs.shape[1] - 1
    best = np.argmax(beliefs, axis=1)
    named = best[best < known]
    if len(np.unique(named)) == len(named):
        return beliefs
    # a track may be "none of them" as often as there are tracks: one such column each
    cost = -np.log(
        np.maximum(
            np.hstack([beliefs[:, :known], np.tile(beliefs[:, known:], (1, tracks))]),
            1e-12,
        )
    )
    _, assigned = linear_sum_assignment(cost)
    result = beliefs.copy()
    for track, landmark in enumerate(best.tolist()):
        # the landmark goes to the track where it is likelier
        if landmark < known and assigned[track] != landmark and landmark in assigned:
            result[track, known] += result[track, landmark]
            result[track, landmark] = 0.0
    return result
