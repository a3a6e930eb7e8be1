"""From sonar frames to recognised landmarks: candidates, tracks, appearance, beliefs, one frame after another.

    frame -> decibels -> candidates -> tracks -> how well each design fits -> beliefs -> detections

The steps are those of the 2014 paper: candidate selection (`sonar_graph.sonar.cfar`), elimination of noisy data
(`sonar_graph.sonar.tracker`), Bayesian feature estimation (`sonar_graph.sonar.bayes`). Nothing that is seen
disappears without a row that says why.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from pydantic import Field
from scipy.optimize import linear_sum_assignment

from sonar_graph.calibration import Calibration, Section
from sonar_graph.devices import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.measurements import Floats, Ints, LandmarkDetections, SonarFrames
from sonar_graph.sonar.appearance import Appearance, AppearanceParams, CandidateFit, ObjectSighting
from sonar_graph.sonar.beliefs import Beliefs, IdentityParams
from sonar_graph.sonar.cfar import DetectionParams, check_candidates, select_candidates
from sonar_graph.sonar.confusion import Confusion, confusion_for
from sonar_graph.sonar.frame_check import FrameCheck, check_block
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.regions import Candidates, CandidateVerdict
from sonar_graph.sonar.track_filter import Association, SonarStep
from sonar_graph.sonar.tracker import Tracker, TrackingParams


class RecogniserParams(Section):
    """All settings of the recogniser."""

    detection: DetectionParams = DetectionParams()
    tracking: TrackingParams = TrackingParams()
    appearance: AppearanceParams = AppearanceParams()
    identity: IdentityParams = IdentityParams()
    confusion: Confusion | None = None
    """The measured model; None: the one that ships, for the designs that ship, and an assumed one for others."""
    least_existence: float = Field(0.5, ge=0, le=1)
    """Tracks that exist less probably are not reported."""
    least_frames: int = Field(3, ge=1)
    """Frames in which a track must have been seen before it is reported."""


class Fate(NamedTuple):
    """What became of one candidate, one track, or a whole frame."""

    stamp_ns: int
    track: int
    """-1: of no track."""
    range_m: float
    azimuth_rad: float
    """NaN for a frame."""
    outcome: str
    """In words; `REPORTED` for a detection."""


REPORTED = "reported"
REJECTED = {int(v): f"candidate rejected: {v.name.lower().replace('_', ' ')}" for v in CandidateVerdict}


class Recogniser:
    """Recognises landmarks in the frames of one sonar, taken one after another.

    Parameters
    ----------
    calibration
        Of the sonar: its mounting, aperture and scale of samples.
    designs
        The landmarks that may be there; None: those that ship.
    params
        None: the defaults.

    Raises
    ------
    CalibrationError
        When the measured model is of other landmarks, or a design can never be found.
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
        check_candidates(self.designs, self.params.detection, self.params.appearance.search_m)
        self._calibration = calibration
        self._look = CandidateFit(
            Appearance(self.designs, self.params.appearance),
            self.confusion,
            calibration.sonar.elevation_aperture_rad,
        )
        self._tracker = Tracker(self.params.tracking)
        self._beliefs = Beliefs(self.confusion, self.params.identity)
        self._check = FrameCheck(calibration.sonar.image)
        self._start_T_sonar = gtsam.Pose3()
        self.fates: list[Fate] = []
        """What became of everything in the frame last processed."""
        self.stamp_ns: int | None = None
        """Of the frame last processed."""
        self.sightings: list[ObjectSighting | None] = []
        """How the designs fitted each track of that frame; None where it had no candidate."""
        self.track_ids: Ints = np.empty(0, dtype=np.int64)
        """Numbers of those tracks."""

    def process(
        self, frame: SonarFrames, motion: SonarStep | None = None, view: FloorView | None = None
    ) -> LandmarkDetections | None:
        """Take in one frame; what is recognised in it.

        Parameters
        ----------
        frame
            A block of one frame.
        motion
            Of the sonar since the frame before; None for the first.
        view
            Where the sonar is over the floor; None: not known, and patches are compared in the image's plane.

        Returns
        -------
        LandmarkDetections | None
            One row a track that is seen now and trusted, with the posterior over all landmarks. None where there is
            none, and for a frame that must not be used; `fates` says why.

        Raises
        ------
        MeasurementError
            When the block is not one frame.
        """
        check_block(frame)
        self.stamp_ns = stamp_ns = int(frame.stamps_ns[0])
        self.sightings, self.track_ids = [], np.empty(0, dtype=np.int64)
        if motion is not None:
            self._start_T_sonar = self._start_T_sonar.compose(motion.previous_T_sonar)
        if (fault := self._check.fault(frame)) is not None:
            self._tracker.skip(motion or SonarStep.none())
            self.fates = [Fate(stamp_ns, -1, np.nan, np.nan, f"frame not used: {fault}")]
            return None
        image_db = self._calibration.sonar.image.decibels(np.ascontiguousarray(frame.intensity[0]))
        candidates = select_candidates(image_db, frame.ranges_m, frame.azimuths_rad, view, self.params.detection)
        association = self._tracker.step(candidates, motion, stamp_ns)
        self.track_ids = association.track_ids
        self.sightings = self._look.at(image_db, frame, view, candidates, association.candidate)
        scores = self._look.scores(self.sightings)
        beliefs = self._beliefs.step(association, scores, self._places(), self._sideways(association))
        found = self._report(stamp_ns, candidates, association, beliefs)
        if self._check.change is not None:
            self.fates.append(Fate(stamp_ns, -1, np.nan, np.nan, self._check.change))
        return found

    def notes(self) -> dict[str, str]:
        """How detections come about, for a log's notes."""
        return {
            "detections.rule": self.params.identity.rule,
            "detections.designs": ", ".join(f"{design.id}: {design.name}" for design in self.designs),
            "detections.model": "; ".join(f"{k}: {v}" for k, v in self.confusion.provenance.items()) or "not said",
        }

    def _places(self) -> list[Floats | None]:
        """Where the sonar is, for each track that could be compared with the designs."""
        place = self._start_T_sonar.translation()
        return [None if sighting is None or sighting.fit is None else place for sighting in self.sightings]

    def _sideways(self, association: Association) -> Floats:
        """Horizontal axis across each track's line of sight, in the frame of the places, shape (M, 3)."""
        azimuth = np.arctan2(association.position_m[:, 1], association.position_m[:, 0])
        across = np.column_stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)])
        return np.asarray(across @ self._start_T_sonar.rotation().matrix().T)

    def _report(
        self, stamp_ns: int, candidates: Candidates, association: Association, beliefs: Floats
    ) -> LandmarkDetections | None:
        """The rows of the frame, and what became of all the rest."""
        self.fates = _fates_of_candidates(stamp_ns, candidates)
        reported = []
        for row, sighting in enumerate(self.sightings):
            if sighting is not None:
                outcome = self._outcome(association, row, sighting)
                track = int(association.track_ids[row])
                self.fates.append(Fate(stamp_ns, track, sighting.range_m, sighting.azimuth_rad, outcome))
                if outcome == REPORTED:
                    reported.append((row, sighting))
        self.fates += [
            Fate(stamp_ns, track, np.nan, np.nan, f"track ended: {reason}")
            for track, reason in zip(association.ended_ids.tolist(), association.ended_reasons, strict=True)
        ]
        if not reported:
            return None
        rows = [row for row, _ in reported]
        return LandmarkDetections(
            stamps_ns=np.full(len(rows), stamp_ns),
            range_m=np.array([sighting.range_m for _, sighting in reported]),
            azimuth_rad=np.array([sighting.azimuth_rad for _, sighting in reported]),
            range_azimuth_cov=np.array([sighting.covariance for _, sighting in reported]),
            candidate_ids=np.tile(self.ids, (len(rows), 1)),
            id_probability=each_once(beliefs[rows])[:, :-1],
            track=association.track_ids[rows],
        )

    def _outcome(self, association: Association, row: int, sighting: ObjectSighting) -> str:
        if sighting.fit is None:
            return "not reported: too little of it is in view"
        if association.frames_seen[row] < self.params.least_frames:
            return f"not reported: seen in fewer than {self.params.least_frames} frames"
        if association.existence[row] < self.params.least_existence:
            return f"not reported: exists with less than {self.params.least_existence:g}"
        return REPORTED


def each_once(beliefs: Floats) -> Floats:
    """Beliefs in which no landmark is the most probable identity of two tracks, shape (M, classes).

    The most probable assignment of tracks to landmarks (or to none) decides; a track that loses its most probable
    landmark to another one believes in "none of them" instead.
    """
    tracks, known = beliefs.shape[0], beliefs.shape[1] - 1
    best = np.argmax(beliefs, axis=1)
    named = best[best < known]
    if len(np.unique(named)) == len(named):
        return beliefs
    cost = -np.log(np.maximum(np.hstack([beliefs[:, :known], np.tile(beliefs[:, known:], (1, tracks))]), 1e-12))
    _, assigned = linear_sum_assignment(cost)
    result = beliefs.copy()
    for track, landmark in enumerate(best.tolist()):
        if landmark < known and assigned[track] != landmark and landmark in assigned:
            result[track, known] += result[track, landmark]
            result[track, landmark] = 0.0
    return result


def _fates_of_candidates(stamp_ns: int, candidates: Candidates) -> list[Fate]:
    """Those that were rejected before they came to a track."""
    columns = candidates.verdicts.tolist(), candidates.range_m.tolist(), candidates.azimuth_rad.tolist()
    return [
        Fate(stamp_ns, -1, range_m, azimuth_rad, REJECTED[verdict])
        for verdict, range_m, azimuth_rad in zip(*columns, strict=True)
        if verdict != CandidateVerdict.ACCEPTED
    ]
