"""From detections to factors: identity, prediction, gate, and the landmark's first appearance."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.calibration import Calibration, FloorPrior
from sonar_graph.measurements import NO_TRACK, Floats, LandmarkDetections
from sonar_graph.navigation.preintegration import PreintegratedMotion
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
    LateGate,
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
    """What became of a detection when it came."""

    outcome: Outcome
    innovation: Floats | None = None
    """Shape (2,); None: nothing was expected."""
    S: Floats | None = None
    """Its covariance, shape (2, 2)."""
    landmark_id: int | None = None
    """Of which it is, where geometry said so."""
    sighting: Sighting | None = None
    """None where it did not come so far as to be tied to a keyframe."""


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
        landmarks = self._landmarks = LandmarkSightings(self.smoother, self._factors)
        self.smoother.when_withheld = lambda withheld: self._landmarks.withhold(withheld, self.journal)
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
        gate = LateGate(self.smoother, self._gate)
        self._deferred = DeferredIdentities(landmarks, self.journal, gate, identity.longest_wait_s)

    @property
    def ids(self) -> set[int]:
        """Landmarks in the graph."""
        return self._landmarks.ids

    def leave(self, pose_keys: set[int]) -> None:
        """Poses leave a bounded window."""
        self._landmarks.leave(pose_keys)
        self._deferred.leave(pose_keys)

    def add(self, frame: LandmarkDetections) -> None:
        """Take in the detections of one frame."""
        if self._anonymous is not None:
            refuse_taken_ids(frame)
        sound = without_unsound(frame, self.journal)
        if sound is not None:
            self._add(sound)

    def _add(self, frame: LandmarkDetections) -> None:
        stamp_ns = int(frame.stamps_ns[0])
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
            self.keyframes.update_if_due()
            tracked = frame.rows(is_tracked)
            self._deferred.hear(tracked, decide(tracked, self._minimum_probability), self.keyframes.newest_s)
        verdicts = self._judge(stamp_ns, frame, identities, is_tracked.tolist())
        if is_unnamed.any():
            seen = self._seen(frame, identities, is_unnamed.tolist(), np.flatnonzero(is_unnamed).tolist())
            verdicts |= self._associate(stamp_ns, seen, verdicts)
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
        """The whole graph solved; of doubtful identities with those that fit it best."""
        if self._doubtful is None:
            return Solution(*self.smoother.solve_history(), sorted(self.ids))
        chosen = self._doubtful.history()
        return Solution(chosen.values, chosen.marginals, sorted(chosen.ids))

    def log(self) -> DetectionLog:
        """What became of each detection, in the same history."""
        self.forget()
        return self.journal.log() if self._doubtful is None else self._doubtful.log()

    def _doubt(self, doubtful: DoubtfulIdentities, stamp_ns: int, frame: LandmarkDetections) -> None:
        """Take in a frame whose identities are weighed against where its detections are."""
        self.keyframes.update_if_due()
        rows = range(len(frame))
        statements, tracks = [IdentityPosterior.of(frame, row) for row in rows], frame.track.tolist()
        seen = self._seen(frame, identify(frame, 0.0), [True] * len(frame), list(rows))
        motion = self.keyframes.motion_since_newest(stamp_ns)
        view = self._view(motion, doubtful.keys)
        chosen = doubtful.chosen_at_first(view, statements, tracks, seen.z, seen.cov)
        motion = self.keyframes.set_for_frame(stamp_ns, motion)
        tie = Tie.between(motion, self.keyframes.newest_key, self._body_T_sonar, stamp_ns)
        sightings = self._sightings(view, tie, seen, np.zeros((len(frame), 3)))
        doubtful.enter(statements, tracks, sightings, chosen, self.keyframes.newest_s)
        for row, sighting in enumerate(sightings):
            of = statements[row].favourite if chosen[row] is None else chosen[row]
            sighting.row = self.journal.record(stamp_ns, -1 if of is None else of, sighting.outcome)
        self.keyframes.update_if_due()
        doubtful.reconsider(self.keyframes.newest_s)

    def forget(self) -> None:
        """Let go of sightings that have waited too long for their identity."""
        self._deferred.forget(self.keyframes.advanced_ns)
        if self._anonymous is not None:
            self._anonymous.forget(self.keyframes.oldest_key(self._anonymous.longest_wait_s))

    def _judge(
        self, stamp_ns: int, frame: LandmarkDetections, identities: Identities, is_tracked: list[bool]
    ) -> dict[int, SightingVerdict]:
        """Use what has an identity, keep what belongs to a track, refuse the rest; what became of each row."""
        refusals = identities.refusals
        verdicts = {row: SightingVerdict(why) for row, why in enumerate(refusals) if why}
        rows = [row for row, why in enumerate(refusals) if is_tracked[row] or not why]
        if rows:
            verdicts |= self._use(stamp_ns, self._seen(frame, identities, is_tracked, rows), refusals)
        return verdicts

    def _seen(self, frame: LandmarkDetections, identities: Identities, is_tracked: list[bool], rows: list[int]) -> Seen:
        z = np.column_stack((frame.range_m[rows], frame.azimuth_rad[rows]))
        cov = frame.range_azimuth_cov[rows]
        is_unknown = np.isnan(cov).any(axis=(1, 2))
        if is_unknown.any():
            cov[is_unknown] = self._default_cov
        ids: list[int] = identities.ids[rows].tolist()
        return Seen(rows, ids, [L(max(i, 0)) for i in ids], [is_tracked[row] for row in rows], z, cov)

    def _use(self, stamp_ns: int, seen: Seen, refusals: list[Outcome | None]) -> dict[int, SightingVerdict]:
        """Add the factors of a frame's landmarks, keep what is refused but tracked; what became of each, by row."""
        self.keyframes.update_if_due()
        motion = self.keyframes.motion_since_newest(stamp_ns)
        named = seen.where([refusals[row] is None for row in seen.rows])
        is_known = [i in self._landmarks for i in named.ids]
        known, new = named.where(is_known), named.where([not known for known in is_known])
        view = self._view(motion, known.keys)
        motion = self.keyframes.set_for_frame(stamp_ns, motion)
        tie = Tie.between(motion, self.keyframes.newest_key, self._body_T_sonar, stamp_ns)
        verdicts = self._sight_again(view, tie, known) | self._sight_first(view, tie, new)
        if len(named.rows) < len(seen.rows):
            kept = seen.where([refusals[row] is not None for row in seen.rows])
            verdicts |= self._keep(view, tie, kept, refusals)
        self.keyframes.update_if_due()
        return verdicts

    def _view(self, motion: PreintegratedMotion, landmark_keys: list[int]) -> PredictedView:
        key, bias_key = self.keyframes.newest_key, self.keyframes.newest_bias_key
        keys = [key, *landmark_keys] if bias_key is None else [key, bias_key, *landmark_keys]
        return PredictedView(
            pose_key=key,
            bias_key=bias_key,
            world_T_keyframe=self.smoother.values.atPose3(key),
            motion=motion,
            body_T_sonar=self._body_T_sonar,
            covariance=self.smoother.joint_covariance(keys),
        )

    def _sight_again(self, view: PredictedView, tie: Tie, seen: Seen) -> dict[int, SightingVerdict]:
        """Compare landmarks of the graph with what is expected of them; add what is inside the gate."""
        if not seen.ids:
            return {}
        points = np.array([self.smoother.values.atPoint3(key) for key in seen.keys])
        found = view.compare(seen.keys, points, seen.z, seen.cov)
        inside: list[bool] = (found.distance <= self._gate).tolist()
        self.smoother.waiting_gain += float(found.gain[inside].sum())
        verdicts = {}
        for k, sighting in enumerate(self._sightings(view, tie, seen, points)):
            sighting.outcome = Outcome.USED if inside[k] else Outcome.GATED
            if inside[k]:
                self._enter(sighting, seen.ids[k], is_first=False)
            verdicts[seen.rows[k]] = SightingVerdict(
                sighting.outcome, found.innovation[k], found.S[k], sighting=sighting
            )
        return verdicts

    def _sight_first(self, view: PredictedView, tie: Tie, seen: Seen) -> dict[int, SightingVerdict]:
        """Add landmarks to the graph: on the floor, where they can stand there, else on the centre beam."""
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
            self._enter(sighting, landmark_id, is_first=True)
            verdicts[seen.rows[k]] = SightingVerdict(Outcome.NEW, sighting=sighting)
        return verdicts

    def _keep(
        self, view: PredictedView, tie: Tie, seen: Seen, refusals: list[Outcome | None]
    ) -> dict[int, SightingVerdict]:
        """Tie to the keyframe what has no identity yet, or is displaced by a more probable row of the frame."""
        verdicts = {}
        sightings = self._sightings(view, tie, seen, np.zeros((len(seen.rows), 3)))
        for row, sighting in zip(seen.rows, sightings, strict=True):
            if refusals[row] is Outcome.REPEATED:
                sighting.outcome = Outcome.REPEATED
            verdicts[row] = SightingVerdict(sighting.outcome, sighting=sighting)
        return verdicts

    def _merge(self, anonymous: AnonymousLandmarks) -> None:
        """Make one landmark of two that are one."""
        self.keyframes.update_if_due()
        if anonymous.has_landmarks and len(self.ids) > 1:
            joint = self.smoother.joint_covariance([self.keyframes.newest_key, *anonymous.keys()])
            anonymous.merge(joint, self.keyframes.newest_s)

    def _associate(self, stamp_ns: int, seen: Seen, named: dict[int, SightingVerdict]) -> dict[int, SightingVerdict]:
        """Pair what has no identity with landmarks by geometry; what became of each, by row."""
        anonymous = self._anonymous
        if anonymous is None:
            return {}
        self.keyframes.update_if_due()
        anonymous.forget(self.keyframes.oldest_key(anonymous.longest_wait_s))
        motion = self.keyframes.motion_since_newest(stamp_ns)
        self._merge(anonymous)
        view = self._view(motion, anonymous.keys())
        taken = {v.sighting.landmark_id for v in named.values() if v.sighting and v.sighting.landmark_id is not None}
        paired = anonymous.pair(view, seen.z, seen.cov, taken)
        motion = self.keyframes.set_for_frame(stamp_ns, motion)
        tie = Tie.between(motion, self.keyframes.newest_key, self._body_T_sonar, stamp_ns)
        sightings = self._sightings(view, tie, seen, np.zeros((len(seen.rows), 3)))
        anonymous.use(sightings, paired, self.keyframes.newest_s)
        self.keyframes.update_if_due()
        return {
            row: SightingVerdict(s.outcome, found.innovation, found.S, s.landmark_id, s)
            for row, s, found in zip(seen.rows, sightings, paired, strict=True)
        }

    def _floor_under(self, view: PredictedView, range_m: float, azimuth_rad: float) -> FloorPrior | None:
        """The known floor, unless it is implausibly far from the point on the centre beam (`FLOOR_GATE`)."""
        floor = self.calibration.floor
        if floor is None:
            return None
        point = locate(view.world_T_sonar, range_m, azimuth_rad, 0.0)
        by_elevation = range_m * view.world_T_sonar.rotation().matrix()[2, 2] * self._factors.elevation_sigma_rad
        variance = by_elevation**2 + view.height_variance(point) + floor.sigma_m**2
        return floor if (point[2] - floor.z_m) ** 2 <= FLOOR_GATE * variance else None

    def _sightings(self, view: PredictedView, tie: Tie, seen: Seen, points: Floats) -> list[Sighting]:
        """Sightings of landmarks at points of the world, shape (m, 3); those of tracks as if at elevation 0."""
        if not seen.rows:
            return []
        points, floors = points.copy(), [self.calibration.floor] * len(seen.rows)
        for k, (range_m, azimuth_rad) in enumerate(seen.z.tolist()):
            if seen.is_tracked[k]:
                points[k] = locate(view.world_T_sonar, range_m, azimuth_rad, 0.0)
                floors[k] = self._floor_under(view, range_m, azimuth_rad)
        noise = view.blurred(seen.cov, tie.motion, points)
        return [
            Sighting(tie.stamp_ns, -1, Sightline(tie.pose_key, tie.keyframe_T_sonar, z), R, floor)
            for z, R, floor in zip(seen.z, noise, floors, strict=True)
        ]

    def _enter(self, sighting: Sighting, landmark_id: int, *, is_first: bool) -> None:
        made = self._factors.make(sighting, L(landmark_id), is_first=is_first)
        self._landmarks.enter(sighting, landmark_id, self.smoother.add(made))


@dataclass(frozen=True, eq=False)
class Seen:
    """Some detections of one frame."""

    rows: list[int]
    """In the frame, length m."""
    ids: list[int]
    keys: list[int]
    """Of the landmarks in the graph."""
    is_tracked: list[bool]
    """Whether each belongs to a track."""
    z: Floats
    """Range (m) and azimuth (rad), shape (m, 2)."""
    cov: Floats
    """Their noise, shape (m, 2, 2)."""

    def where(self, chosen: list[bool]) -> Seen:
        """Those that are chosen."""
        if all(chosen):
            return self
        at = [k for k, is_chosen in enumerate(chosen) if is_chosen]
        rows, ids, keys = ([column[k] for k in at] for column in (self.rows, self.ids, self.keys))
        return Seen(rows, ids, keys, [self.is_tracked[k] for k in at], self.z[at], self.cov[at])


@dataclass(frozen=True, eq=False)
class Tie:
    """How a frame hangs on the keyframe that gets its factors."""

    stamp_ns: int
    """Of the frame."""
    pose_key: int
    motion: PreintegratedMotion
    """From that keyframe to the frame; its noise blurs the sightings."""
    keyframe_T_sonar: gtsam.Pose3
    """The sonar at the frame, in the keyframe's body frame."""

    @classmethod
    def between(cls, motion: PreintegratedMotion, pose_key: int, body_T_sonar: gtsam.Pose3, stamp_ns: int) -> Tie:
        """Tie by a motion and the sonar's mounting."""
        return cls(stamp_ns, pose_key, motion, motion.i_T_j.compose(body_T_sonar))
