"""Detections to factors: identity, prediction, gate, and the first sighting of a landmark.

A frame hangs on the newest keyframe by the odometry between them: the sonar's pose at the frame, in the keyframe's
body frame. Detections are predicted from there (docs/theory/models.md) and compared with the joint covariance of
keyframe, gyro bias and landmarks. The identity policy decides which become factors (docs/theory/identities.md,
doubtful_identities.md, unknown_landmarks.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.calibration import Calibration, FloorPrior
from sonar_graph.measurements import NO_TRACK, Floats, LandmarkDetections
from sonar_graph.navigation import PreintegratedMotion
from sonar_graph.slam.estimates import Solution
from sonar_graph.slam.keyframes import Keyframes, without_unsound
from sonar_graph.slam.landmarks import (
    AnonymousLandmarks,
    AssociatedUnknown,
    DeferredIdentities,
    DoubtfulIdentities,
    Identities,
    IdentityParams,
    IdentityPosterior,
    LandmarkSightings,
    Mixture,
    MixtureIdentity,
    Sighting,
    SightingFactors,
    decide,
    identify,
    of_no_landmark,
    once_a_track,
    refuse_taken_ids,
    unnamed,
)
from sonar_graph.slam.models import FLOOR_GATE, KernelParams, PredictedView, locate
from sonar_graph.slam.smoother import Sightline, Smoother
from sonar_graph.states import DetectionJournal, DetectionLog, Outcome


class SightingVerdict(NamedTuple):
    """Outcome of a detection when it came."""

    outcome: Outcome
    innovation: Floats | None = None
    """Shape (2,); None: nothing was expected."""
    S: Floats | None = None
    """Its covariance, shape (2, 2)."""
    landmark_id: int | None = None
    """Landmark that geometry paired it with."""
    sighting: Sighting | None = None
    """None where it was not tied to a keyframe."""


@dataclass
class Sightings:
    """Adds the factors of detected landmarks to a smoother and records what became of each detection."""

    calibration: Calibration
    identity: IdentityParams
    kernel: KernelParams
    smoother: Smoother
    keyframes: Keyframes
    journal: DetectionJournal = field(default_factory=DetectionJournal)

    def __post_init__(self) -> None:
        sonar, identity = self.calibration.sonar, self.identity
        self._body_T_sonar = sonar.mounting.pose()
        self._default_cov = np.diag([sonar.range_sigma_m**2, sonar.azimuth_sigma_rad**2])
        self._factors = SightingFactors(sonar, self.kernel.robust)
        landmarks = self._landmarks = LandmarkSightings(self.smoother, self._factors, self.journal)
        self._doubtful: DoubtfulIdentities | None = None
        self._anonymous: AnonymousLandmarks | None = None
        self._minimum_probability, self._gate, self._is_deferred = 0.0, np.inf, True
        if isinstance(identity, MixtureIdentity):
            self._doubtful = DoubtfulIdentities(landmarks, self.journal, identity, Mixture(identity, self.kernel))
        else:
            self._minimum_probability, self._gate = identity.minimum_probability, identity.gate
            self._is_deferred = identity.longest_wait_s > 0
            if isinstance(identity.unknown, AssociatedUnknown):
                self._anonymous = AnonymousLandmarks(landmarks, self.journal, identity.unknown)
        self._deferred = DeferredIdentities(landmarks, self.journal, self._gate, identity.longest_wait_s)

    @property
    def ids(self) -> set[int]:
        """Identities of the landmarks in the graph."""
        return self._landmarks.ids

    def update_if_due(self) -> None:
        """Bring the smoother up to date, and the sightings in line with what it withheld and gave up."""
        if (changed := self.keyframes.update_if_due()) is not None:
            self._landmarks.follow(changed)
            self._deferred.leave(changed.left)

    def add(self, frame: LandmarkDetections) -> None:
        """Take in the detections of one frame."""
        if self._anonymous is not None:
            refuse_taken_ids(frame)
        sound = without_unsound(frame, self.journal)
        if sound is None:
            return
        frame, stamp_ns = sound, int(sound.stamps_ns[0])
        unlocated = self.keyframes.newest_ns is None
        if unlocated or stamp_ns < self.keyframes.advanced_ns:
            late = Outcome.UNLOCATED if unlocated else Outcome.LATE
            for landmark_id in frame.most_probable()[0].tolist():
                self.journal.record(stamp_ns, landmark_id, late)
            return
        if self._is_deferred:
            known = of_no_landmark if self._doubtful is not None else self._deferred.identity_of
            frame = once_a_track(frame, known, self.journal)
        if self._doubtful is not None:
            self._doubt(self._doubtful, stamp_ns, frame)
            return
        identities = identify(frame, self._minimum_probability)
        is_unnamed = unnamed(frame) & (self._anonymous is not None)
        is_tracked = (frame.track != NO_TRACK) & self._is_deferred & ~is_unnamed
        if is_tracked.any():
            self.update_if_due()
            tracked = frame.rows(is_tracked)
            self._deferred.hear(tracked, decide(tracked, self._minimum_probability), self.keyframes.newest_s)
        verdicts = self._judge(stamp_ns, frame, identities, is_tracked.tolist())
        if self._anonymous is not None and is_unnamed.any():
            seen = self._seen(frame, identities, is_unnamed.tolist(), np.flatnonzero(is_unnamed).tolist())
            verdicts |= self._associate(self._anonymous, stamp_ns, seen, verdicts)
        elif self._anonymous is not None and self._anonymous.has_landmarks:
            self._merge(self._anonymous)
        for row, (landmark_id, track) in enumerate(zip(identities.ids.tolist(), frame.track.tolist(), strict=True)):
            verdict = verdicts[row]
            paired_id = landmark_id if verdict.landmark_id is None else verdict.landmark_id
            outcome = verdict.sighting.outcome if verdict.sighting else verdict.outcome
            number = self.journal.record(stamp_ns, paired_id, outcome, verdict.innovation, verdict.S)
            if verdict.sighting is not None:
                verdict.sighting.row = number
                if is_tracked[row]:
                    self._deferred.remember(track, verdict.sighting)

    def history(self) -> Solution:
        """Solution of the whole graph, with the doubtful identities that fit it best."""
        if self._doubtful is None:
            return Solution(*self.smoother.solve_history(), sorted(self.ids))
        chosen = self._doubtful.history()
        return Solution(chosen.values, chosen.marginals, sorted(chosen.ids))

    def log(self) -> DetectionLog:
        """Outcome of each detection in the same history."""
        self.forget()
        return self.journal.log() if self._doubtful is None else self._doubtful.log()

    def _doubt(self, doubtful: DoubtfulIdentities, stamp_ns: int, frame: LandmarkDetections) -> None:
        """Take in a frame whose identities are weighed against the places of its detections."""
        self.update_if_due()
        rows = range(len(frame))
        statements, tracks = [IdentityPosterior.of(frame, row) for row in rows], frame.track.tolist()
        seen = self._seen(frame, identify(frame, 0.0), [True] * len(frame), list(rows))
        motion = self.keyframes.motion_since_newest(stamp_ns)
        view = self._view(motion, doubtful.keys)
        chosen = doubtful.chosen_at_first(view, statements, tracks, seen.z, seen.cov)
        sightings = self._sightings(view, self._tie(stamp_ns, motion), seen)
        doubtful.enter(statements, tracks, sightings, chosen, self.keyframes.newest_s)
        for row, sighting in enumerate(sightings):
            of = statements[row].favourite if chosen[row] is None else chosen[row]
            sighting.row = self.journal.record(stamp_ns, -1 if of is None else of, sighting.outcome)
        self.update_if_due()
        doubtful.reconsider(self.keyframes.newest_s)

    def forget(self) -> None:
        """Forget sightings that have waited too long for their identity."""
        self._deferred.forget(self.keyframes.advanced_ns)
        if self._anonymous is not None:
            self._anonymous.forget(self.keyframes.oldest_key(self._anonymous.longest_wait_s))

    def _judge(
        self, stamp_ns: int, frame: LandmarkDetections, identities: Identities, is_tracked: list[bool]
    ) -> dict[int, SightingVerdict]:
        """Use what has an identity, keep what belongs to a track, refuse the rest; the verdict on each row."""
        refusals = identities.refusals
        verdicts = {row: SightingVerdict(why) for row, why in enumerate(refusals) if why}
        rows = [row for row, why in enumerate(refusals) if is_tracked[row] or not why]
        if not rows:
            return verdicts
        seen = self._seen(frame, identities, is_tracked, rows)
        self.update_if_due()
        motion = self.keyframes.motion_since_newest(stamp_ns)
        named = seen.where([refusals[row] is None for row in rows])
        is_known = [i in self._landmarks for i in named.ids]
        known, new = named.where(is_known), named.where([not known for known in is_known])
        view = self._view(motion, known.keys)
        tie = self._tie(stamp_ns, motion)
        verdicts |= self._sight_again(view, tie, known) | self._sight_first(view, tie, new)
        if len(named.rows) < len(rows):
            kept = seen.where([refusals[row] is not None for row in rows])
            for row, sighting in zip(kept.rows, self._sightings(view, tie, kept), strict=True):
                if refusals[row] is Outcome.REPEATED:  # a more probable row of the frame has the landmark
                    sighting.outcome = Outcome.REPEATED
                verdicts[row] = SightingVerdict(sighting.outcome, sighting=sighting)
        self.update_if_due()
        return verdicts

    def _seen(self, frame: LandmarkDetections, identities: Identities, is_tracked: list[bool], rows: list[int]) -> Seen:
        z = np.column_stack((frame.range_m[rows], frame.azimuth_rad[rows]))
        cov = frame.range_azimuth_cov[rows]
        is_unknown = np.isnan(cov).any(axis=(1, 2))
        if is_unknown.any():
            cov[is_unknown] = self._default_cov
        ids: list[int] = identities.ids[rows].tolist()
        return Seen(rows, ids, [L(max(i, 0)) for i in ids], [is_tracked[row] for row in rows], z, cov)

    def _view(self, motion: PreintegratedMotion, landmark_keys: list[int]) -> PredictedView:
        key, bias_key = self.keyframes.newest_key, self.keyframes.bias_key(-1)
        keys = [key, *landmark_keys] if bias_key is None else [key, bias_key, *landmark_keys]
        return PredictedView(
            pose_key=key,
            bias_key=bias_key,
            world_T_keyframe=self.smoother.values.atPose3(key),
            motion=motion,
            body_T_sonar=self._body_T_sonar,
            covariance=self.smoother.joint_covariance(keys),
        )

    def _tie(self, stamp_ns: int, motion: PreintegratedMotion) -> Tie:
        """Tie a frame to the newest keyframe, which is set now if the motion since the last one blurs the frame."""
        motion = self.keyframes.set_for_frame(stamp_ns, motion)
        return Tie(stamp_ns, self.keyframes.newest_key, motion, motion.i_T_j.compose(self._body_T_sonar))

    def _sight_again(self, view: PredictedView, tie: Tie, seen: Seen) -> dict[int, SightingVerdict]:
        """Add sightings of landmarks in the graph that are inside the gate."""
        if not seen.ids:
            return {}
        points = np.array([self.smoother.values.atPoint3(key) for key in seen.keys])
        found = view.compare(seen.keys, points, seen.z, seen.cov)
        inside: list[bool] = (found.distance <= self._gate).tolist()
        verdicts = {}
        for k, sighting in enumerate(self._sightings(view, tie, seen, points)):
            sighting.outcome = Outcome.USED if inside[k] else Outcome.GATED
            if inside[k]:
                self._landmarks.add(sighting, seen.ids[k], is_first=False, gain=float(found.gain[k]))
            verdicts[seen.rows[k]] = SightingVerdict(
                sighting.outcome, found.innovation[k], found.S[k], sighting=sighting
            )
        return verdicts

    def _sight_first(self, view: PredictedView, tie: Tie, seen: Seen) -> dict[int, SightingVerdict]:
        """Add new landmarks: on the known floor where they can stand on it, else on the centre beam."""
        verdicts = {}
        for k, landmark_id in enumerate(seen.ids):
            alone = seen.where([row == k for row in range(len(seen.ids))])
            range_m, azimuth_rad = alone.z[0].tolist()
            floor = self._floor_under(view, range_m, azimuth_rad)
            elevation = self._factors.elevation_on(floor, view.world_T_sonar, range_m, azimuth_rad)
            point = locate(view.world_T_sonar, range_m, azimuth_rad, elevation)
            self.smoother.add_landmark(seen.keys[k], point)
            (sighting,) = self._sightings(view, tie, alone, point[None])
            sighting.floor, sighting.outcome = floor, Outcome.NEW
            sighting.elevation_rad = 0.0 if seen.is_tracked[k] else elevation
            self._landmarks.add(sighting, landmark_id, is_first=True)
            verdicts[seen.rows[k]] = SightingVerdict(Outcome.NEW, sighting=sighting)
        return verdicts

    def _merge(self, anonymous: AnonymousLandmarks) -> None:
        """Make one landmark of two that are one."""
        self.update_if_due()
        if anonymous.has_landmarks and len(self.ids) > 1:
            joint = self.smoother.joint_covariance([self.keyframes.newest_key, *anonymous.keys()])
            anonymous.merge(joint, self.keyframes.newest_s)

    def _associate(
        self, anonymous: AnonymousLandmarks, stamp_ns: int, seen: Seen, named: dict[int, SightingVerdict]
    ) -> dict[int, SightingVerdict]:
        """Pair what has no identity with landmarks by geometry; the verdict on each row."""
        self.update_if_due()
        anonymous.forget(self.keyframes.oldest_key(anonymous.longest_wait_s))
        motion = self.keyframes.motion_since_newest(stamp_ns)
        self._merge(anonymous)
        view = self._view(motion, anonymous.keys())
        taken = {v.sighting.landmark_id for v in named.values() if v.sighting and v.sighting.landmark_id is not None}
        paired = anonymous.pair(view, seen.z, seen.cov, taken)
        sightings = self._sightings(view, self._tie(stamp_ns, motion), seen)
        anonymous.use(sightings, paired, self.keyframes.newest_s)
        self.update_if_due()
        return {
            row: SightingVerdict(s.outcome, found.innovation, found.S, s.landmark_id, s)
            for row, s, found in zip(seen.rows, sightings, paired, strict=True)
        }

    def _floor_under(self, view: PredictedView, range_m: float, azimuth_rad: float) -> FloorPrior | None:
        """Known floor, or None where it is too far from the point on the centre beam (`FLOOR_GATE`)."""
        floor = self.calibration.floor
        if floor is None:
            return None
        point = locate(view.world_T_sonar, range_m, azimuth_rad, 0.0)
        by_elevation = range_m * view.world_T_sonar.rotation().matrix()[2, 2] * self._factors.elevation_sigma_rad
        variance = by_elevation**2 + view.height_variance(point) + floor.sigma_m**2
        return floor if (point[2] - floor.z_m) ** 2 <= FLOOR_GATE * variance else None

    def _sightings(self, view: PredictedView, tie: Tie, seen: Seen, at: Floats | None = None) -> list[Sighting]:
        """Sightings of landmarks at points of the world, shape (m, 3); those of tracks as if at elevation 0."""
        if not seen.rows:
            return []
        points = np.zeros((len(seen.rows), 3)) if at is None else at.copy()
        floors = [self.calibration.floor] * len(seen.rows)
        for k, (range_m, azimuth_rad) in enumerate(seen.z.tolist()):
            if seen.is_tracked[k]:
                points[k] = locate(view.world_T_sonar, range_m, azimuth_rad, 0.0)
                floors[k] = self._floor_under(view, range_m, azimuth_rad)
        noise = view.blurred(seen.cov, tie.motion, points)
        return [
            Sighting(tie.stamp_ns, -1, Sightline(tie.pose_key, tie.keyframe_T_sonar, z), R, floor)
            for z, R, floor in zip(seen.z, noise, floors, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class Seen:
    """Some detections of one frame."""

    rows: list[int]
    """Numbers of the rows in the frame, length m."""
    ids: list[int]
    keys: list[int]
    """Graph keys of the landmarks."""
    is_tracked: list[bool]
    z: Floats
    """Range (m) and azimuth (rad), shape (m, 2)."""
    cov: Floats
    """Noise covariance, shape (m, 2, 2)."""

    def where(self, chosen: list[bool]) -> Seen:
        """Subset of the detections."""
        if all(chosen):
            return self
        at = [k for k, is_chosen in enumerate(chosen) if is_chosen]
        rows, ids, keys = ([column[k] for k in at] for column in (self.rows, self.ids, self.keys))
        return Seen(rows, ids, keys, [self.is_tracked[k] for k in at], self.z[at], self.cov[at])


@dataclass(frozen=True, eq=False)
class Tie:
    """Motion from the keyframe that gets the factors of a frame to that frame."""

    stamp_ns: int
    """Stamp of the frame."""
    pose_key: int
    motion: PreintegratedMotion
    """Motion whose noise is added to that of the sightings."""
    keyframe_T_sonar: gtsam.Pose3
