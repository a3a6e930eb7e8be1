"""Identities that are believed track by track, known late, or changed (docs/theory/identities.md).

Sightings of a track wait, each on the keyframe at which it was made, until the track is known to be of a landmark; then
all become factors there. When the track turns out to be of another landmark, or of none, its factors are taken out of
the graph; those of the other landmark are put in once the estimate no longer rests on the wrong ones.

A track is one object in one place, so each frame keeps one row of it. If the track counts as a landmark, that is the
row with the highest posterior for this landmark; otherwise the row with the highest posterior for any landmark. If
several rows are equal, the first is kept.
"""

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.measurements import NO_TRACK, LandmarkDetections
from sonar_graph.navigation import PreintegratedMotion
from sonar_graph.slam.landmarks.association import gate_threshold
from sonar_graph.slam.landmarks.sighting import LandmarkSightings, Sighting
from sonar_graph.slam.landmarks.unknown import IgnoredUnknown, UnknownParams
from sonar_graph.slam.models import PredictedView
from sonar_graph.slam.smoother import Smoother
from sonar_graph.states import DetectionJournal, Outcome


class TrackedIdentity(Section):
    """Settings of identities that are believed track by track."""

    minimum_probability: float = Field(0.7, ge=0, le=1)
    """Least posterior of the most probable identity with which a detection is used."""
    longest_wait_s: float = Field(60.0, ge=0)
    """Longest time for which a detection waits for the identity of its track. When the identity changes, all detections
    of the track move to the new landmark. A track that is not seen for this time keeps its identity. 0: no detection
    waits, each is judged alone."""
    unknown: UnknownParams = IgnoredUnknown()
    """Detections that name no landmark."""

    @property
    def gate(self) -> float:
        """Largest squared Mahalanobis innovation of range and azimuth; infinite: none is refused."""
        return math.inf


class RobustIdentity(TrackedIdentity):
    """Use every detection whose identity is probable enough; the kernel limits the pull of wrong ones.

    Assumes that most sightings of every landmark are right, and that wrong ones disagree with each other: the kernel
    then lets the majority win, unless a landmark's first sighting is so far off that the others hardly pull.
    """

    policy: Literal["robust"] = "robust"


class GatedIdentity(TrackedIdentity):
    """Use a detection whose identity is probable enough if it lies inside the gate of that landmark.

    Assumes that the estimate and its covariance are right when a detection comes: a detection outside the gate is
    refused, and not tried again unless its track changes its identity. Tracks change theirs as with "robust".
    """

    policy: Literal["gate"] = "gate"
    gate_probability: float = Field(0.999, gt=0, le=1)
    """Probability with which a right detection passes the gate: detections are refused whose squared Mahalanobis
    innovation exceeds this chi-square quantile (2 dof). 1: no gate."""

    @property
    def gate(self) -> float:
        """Largest squared Mahalanobis innovation of range and azimuth; infinite: none is refused."""
        return gate_threshold(self.gate_probability, 2) if self.gate_probability < 1 else math.inf


UNDECIDED, NO_LANDMARK = -2, -1
"""Decisions of a row besides a landmark's identity."""
NS_PER_S = 1_000_000_000


def decide(frame: LandmarkDetections, least_probability: float) -> list[int]:
    """Decision of each row: a landmark's identity, `NO_LANDMARK` or `UNDECIDED`."""
    ids, probability = frame.most_probable()
    none = 1.0 - frame.id_probability.sum(axis=1)
    return [
        landmark_id
        if p >= least_probability and landmark_id >= 0
        else (NO_LANDMARK if missing >= least_probability else UNDECIDED)
        for landmark_id, p, missing in zip(ids.tolist(), probability.tolist(), none.tolist(), strict=True)
    ]


@dataclass(eq=False)
class Track:
    """Object that the recogniser follows over several frames, with its present identity."""

    identity: int = UNDECIDED
    """Last decision: a landmark, `NO_LANDMARK`, or `UNDECIDED`."""
    newest_ns: int = 0
    """Stamp at which it was last seen."""
    waiting: list[Sighting] = field(default_factory=list)
    """Sightings to be used once their landmark is known."""
    settled: list[Sighting] = field(default_factory=list)
    """Sightings used, or refused, as sightings of that landmark."""


STILL = PreintegratedMotion(
    gtsam.Pose3(), np.zeros((6, 6)), np.zeros((6, 3)), np.zeros(3), 0.0, mean_specific_force=np.full(3, np.nan)
)
"""No motion: a sighting contains that between keyframe and sonar already."""


def inside_gate(smoother: Smoother, threshold: float, sightings: list[Sighting], landmark_id: int) -> list[bool]:
    """Flags of late sightings within a squared Mahalanobis distance of a landmark, from keyframes as estimated now.

    One by one, as those that come at once; all pass where the landmark is not in the graph.
    """
    key, values = L(landmark_id), smoother.values
    if not np.isfinite(threshold) or not sightings or not values.exists(key):
        return [True] * len(sightings)
    joint = smoother.joint_covariance_of_any([key, *{sighting.line.pose_key for sighting in sightings}])
    points = values.atPoint3(key)[None]
    distances = []
    for sighting in sightings:
        line = sighting.line
        view = PredictedView(line.pose_key, None, values.atPose3(line.pose_key), STILL, line.body_T_sonar, joint)
        found = view.compare([key], points, line.z[None], sighting.noise[None])
        distances.append(float(found.distance[0]))
    return [distance <= threshold for distance in distances]


class DeferredIdentities:
    """Keeps the graph in line with the identities of tracks.

    Late sightings pass a gate, the largest squared Mahalanobis distance. A sighting waits at most ``longest_wait_s``; a
    track that was not seen for so long is over, and keeps its identity.
    """

    def __init__(
        self, landmarks: LandmarkSightings, journal: DetectionJournal, gate: float, longest_wait_s: float
    ) -> None:
        self._landmarks = landmarks
        self._smoother = landmarks.smoother
        self._journal = journal
        self._gate = gate
        self._longest_wait_ns = round(longest_wait_s * NS_PER_S)
        self._tracks: dict[int, Track] = {}

    def _seen(self, number: int, stamp_ns: int) -> Track:
        track = self._tracks.setdefault(number, Track())
        track.newest_ns = stamp_ns
        return track

    def hear(self, frame: LandmarkDetections, decisions: list[int], time_s: float) -> None:
        """Bring earlier sightings in line with what a frame's rows decide (`decide`), before its own are made.

        Where tracks come to claim one landmark in one earlier frame, that of the more probable row gets it, but what is
        used already stays. The frame has one row of each track (`once_a_track`); time is that of the newest keyframe.
        """
        stamp_ns = int(frame.stamps_ns[0])
        self.forget(stamp_ns)
        rows = zip(frame.track.tolist(), decisions, frame.most_probable()[1].tolist(), strict=True)
        seen = [
            (self._seen(number, stamp_ns), decision)
            for number, decision, _ in sorted(rows, key=lambda row: -row[2])
            if number != NO_TRACK
        ]
        decided = [(track, decision) for track, decision in seen if decision != UNDECIDED]
        displaced = self._change([(track, new) for track, new in decided if new != track.identity], time_s)
        coming: list[tuple[Sighting, int]] = []
        taken: dict[int, set[int]] = {}
        for track in [track for track, _ in decided] + displaced:
            if track.waiting and track.identity >= 0:
                stamps_ns = taken.setdefault(track.identity, self._landmarks.stamps_ns(track.identity))
                coming += [(sighting, track.identity) for sighting in self._settle(track, stamps_ns)]
        if coming:
            self._landmarks.exchange([], coming, time_s)

    def identity_of(self, number: int) -> int:
        """Identity that a track counts as, `NO_LANDMARK` or `UNDECIDED`."""
        track = self._tracks.get(number)
        return UNDECIDED if track is None else track.identity

    def remember(self, number: int, sighting: Sighting) -> None:
        """Add a sighting of a track's newest frame; hold keyframes whose sightings may soon be used in the window."""
        track = self._seen(number, sighting.stamp_ns)
        (track.waiting if sighting.outcome is Outcome.WAITING else track.settled).append(sighting)
        self._smoother.hold(
            {
                waiting.line.pose_key: (waiting.stamp_ns + self._longest_wait_ns) / NS_PER_S
                for track in self._tracks.values()
                if track.identity != NO_LANDMARK
                for waiting in track.waiting
            }
        )

    def forget(self, now_ns: int) -> None:
        """Forget sightings that have waited too long, and tracks that are over."""
        oldest_ns = now_ns - self._longest_wait_ns
        for track in self._tracks.values():
            if track.waiting and track.waiting[0].stamp_ns < oldest_ns:
                self._give_up(track, lambda sighting: sighting.stamp_ns < oldest_ns)
        self._tracks = {number: track for number, track in self._tracks.items() if track.newest_ns >= oldest_ns}

    def leave(self, pose_keys: set[int]) -> None:
        """Forget what was seen from poses that leave a bounded window: it cannot be used or taken back any more."""
        for track in self._tracks.values():
            self._give_up(track, lambda sighting: sighting.line.pose_key in pose_keys)
            track.settled = [sighting for sighting in track.settled if sighting.line.pose_key not in pose_keys]

    def _give_up(self, track: Track, is_gone: Callable[[Sighting], bool]) -> None:
        """Forget sightings that wait in a track."""
        outcome = Outcome.NO_IDENTITY if track.identity == NO_LANDMARK else Outcome.FORGOTTEN
        for sighting in track.waiting:
            if is_gone(sighting) and sighting.outcome is Outcome.WAITING:
                self._journal.amend(sighting.row, outcome)
        track.waiting = [sighting for sighting in track.waiting if not is_gone(sighting)]

    def _change(self, changed: list[tuple[Track, int]], time_s: float) -> list[Track]:
        """Take back what tracks no longer count as; return other tracks that get what these had displaced."""
        leaving = [s for track, _ in changed for s in track.settled if s.landmark_id is not None]
        freed: dict[int, set[int]] = defaultdict(set)
        for sighting in leaving:
            if sighting.landmark_id is not None:
                freed[sighting.landmark_id].add(sighting.stamp_ns)
                sighting.outcome = Outcome.TAKEN_BACK
        if leaving:
            self._landmarks.exchange(leaving, [], time_s)
        for track, identity in changed:
            self._reopen(track, track.settled)
            track.identity = identity
        found = []
        for landmark_id, stamps_ns in freed.items():
            for track in [track for track in self._tracks.values() if track.identity == landmark_id]:
                displaced = [s for s in track.settled if s.outcome is Outcome.REPEATED and s.stamp_ns in stamps_ns]
                if displaced:
                    self._reopen(track, displaced)
                    found.append(track)
        return found

    def _reopen(self, track: Track, sightings: list[Sighting]) -> None:
        """Let settled sightings wait again."""
        for sighting in sightings:
            if sighting.outcome is not Outcome.TAKEN_BACK:
                sighting.outcome = Outcome.WAITING
            self._journal.amend(sighting.row, sighting.outcome)
        reopened = set(sightings)
        track.settled = [sighting for sighting in track.settled if sighting not in reopened]
        track.waiting = sorted(track.waiting + sightings, key=lambda sighting: sighting.stamp_ns)

    def _settle(self, track: Track, taken_ns: set[int]) -> list[Sighting]:
        """Judge a track's waiting sightings and return those to be used; frames that show the landmark are taken."""
        free = []
        for sighting in track.waiting:
            if sighting.stamp_ns in taken_ns:
                sighting.outcome = Outcome.REPEATED
            else:
                taken_ns.add(sighting.stamp_ns)
                free.append(sighting)
        inside = inside_gate(self._smoother, self._gate, free, track.identity)
        for sighting, is_inside in zip(free, inside, strict=True):
            used = Outcome.MOVED if sighting.outcome is Outcome.TAKEN_BACK else Outcome.USED_LATER
            sighting.outcome = used if is_inside else Outcome.GATED
        for sighting in track.waiting:
            self._journal.amend(sighting.row, sighting.outcome, track.identity)
        track.settled, track.waiting = track.settled + track.waiting, []
        return [sighting for sighting in free if sighting.outcome is not Outcome.GATED]


def of_no_landmark(_: int) -> int:
    """Identity of every track while none is known."""
    return UNDECIDED


def once_a_track(
    frame: LandmarkDetections, identity_of: Callable[[int], int], journal: DetectionJournal
) -> LandmarkDetections:
    """Frame with one row of each track; the others go to the journal.

    Parameters
    ----------
    identity_of
        Landmark that a track counts as, by its number; negative: none.
    """
    best: dict[int, tuple[float, float, int]] = {}
    for row, track in enumerate(frame.track.tolist()):
        if track != NO_TRACK:
            is_landmark = frame.candidate_ids[row] >= 0
            ids, posterior = frame.candidate_ids[row, is_landmark], frame.id_probability[row, is_landmark]
            score = float(posterior[ids == identity_of(track)].sum()), float(posterior.max(initial=0.0)), -row
            best[track] = max(best.get(track, score), score)
    is_kept = frame.track == NO_TRACK
    is_kept[[-score[2] for score in best.values()]] = True
    if is_kept.all():
        return frame
    for landmark_id in frame.most_probable()[0][~is_kept].tolist():
        journal.record(int(frame.stamps_ns[0]), landmark_id, Outcome.TRACK_REPEATED)
    return frame.rows(is_kept)
