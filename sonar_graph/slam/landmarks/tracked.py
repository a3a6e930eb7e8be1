"""Identities that become known late, or turn out to be others than was believed.

A track's sightings wait, each on the keyframe at which it was made, until the track is known to be of a landmark; then
all become factors there. When a track turns out to be of another landmark, or of none, its factors are taken out of the
graph. Those of the other landmark are put in once the estimate no longer rests on the wrong ones: a new landmark then
begins in the right place. What counts as known is in `sonar_graph.slam.landmarks.tracked`; which factors result, in
`sonar_graph.slam.landmarks.sighting`.

Watches of one object each, what has been seen in them, and which landmark each counts as.

A row of a track is the recogniser's belief after all of the track's evidence so far. It decides (`decide`):

* for a landmark, when that one's posterior reaches the least probability;
* for none of the known ones, when what is missing to 1 does;
* nothing, otherwise: the track goes on counting as what it did.

Whether a sighting that comes late to a landmark of the graph is where that landmark is expected.

One row of a track in a frame: what is watched is one object, and one object is in one place.

Of several the row is kept that says best what its track counts as: the one with the highest posterior of that landmark.
While a track counts as none it is the row with the highest posterior of any; of equals, the first.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from numpy.typing import NDArray
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.measurements import NO_TRACK, LandmarkDetections
from sonar_graph.navigation.preintegration import PreintegratedMotion
from sonar_graph.slam.landmarks.association import gate_threshold
from sonar_graph.slam.landmarks.sighting import LandmarkSightings, Sighting
from sonar_graph.slam.landmarks.unknown import IgnoredUnknown, UnknownParams
from sonar_graph.slam.models import PredictedView
from sonar_graph.slam.smoother import Smoother
from sonar_graph.states import DetectionJournal, Outcome


class TrackedIdentity(Section):
    """Settings of identities that are believed track by track."""

    minimum_probability: float = Field(0.7, ge=0, le=1)
    """A detection is used when its most probable identity has at least this posterior."""
    longest_wait_s: float = Field(60.0, ge=0)
    """Detections of one track wait at most so long until its identity is known, and are moved when it turns out to be
    another. A track not seen for so long keeps the one it has. 0: every detection is judged by itself."""
    unknown: UnknownParams = IgnoredUnknown()
    """Detections that name no landmark."""

    @property
    def gate(self) -> float:
        """Largest squared Mahalanobis innovation of range and azimuth; infinite: none is refused."""
        return math.inf


class RobustIdentity(TrackedIdentity):
    """Believe what is probable enough.

    Assumes that most sightings of every landmark are right, and that wrong ones disagree with each other: the kernel
    then lets the majority win, unless a landmark's first sighting is so far off that the others hardly pull.
    """

    policy: Literal["robust"] = "robust"


class GatedIdentity(TrackedIdentity):
    """Believe what is probable enough and lies where that landmark is expected.

    Assumes that the estimate and its covariance are right when a detection comes; nothing is taken back.
    """

    policy: Literal["gate"] = "gate"
    gate_probability: float = Field(0.999, gt=0, le=1)
    """A detection whose squared Mahalanobis innovation exceeds this chi-square quantile (2 dof) is refused; 1: none."""

    @property
    def gate(self) -> float:
        """Largest squared Mahalanobis innovation of range and azimuth; infinite: none is refused."""
        return gate_threshold(self.gate_probability, 2) if self.gate_probability < 1 else math.inf


UNDECIDED, NO_LANDMARK = -2, -1
"""What a row may decide besides a landmark's identity."""
NS_PER_S = 1_000_000_000


def decide(frame: LandmarkDetections, least_probability: float) -> list[int]:
    """What each row decides: a landmark's identity, `NO_LANDMARK` or `UNDECIDED`."""
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
    """One object, watched."""

    identity: int = UNDECIDED
    """What was decided last: that of a landmark, `NO_LANDMARK`, or nothing yet."""
    newest_ns: int = 0
    """When it was last seen."""
    waiting: list[Sighting] = field(default_factory=list)
    """Those to be used once it is known of which landmark they are."""
    settled: list[Sighting] = field(default_factory=list)
    """Those that are used, or were refused, as sightings of that landmark."""


class ObjectTracks:
    """The tracks that may still change their identity.

    Parameters
    ----------
    longest_wait_s
        A sighting waits at most so long, and a track that was not seen for so long is over.
    """

    def __init__(self, longest_wait_s: float) -> None:
        self._longest_wait_ns = round(longest_wait_s * NS_PER_S)
        self._by_number: dict[int, Track] = {}

    def __len__(self) -> int:
        return len(self._by_number)

    def seen(self, number: int, stamp_ns: int) -> Track:
        """The track of a number, which is seen now."""
        track = self._by_number.setdefault(number, Track())
        track.newest_ns = stamp_ns
        return track

    def identity_of(self, number: int) -> int:
        """What the track of a number counts as, if there is one."""
        track = self._by_number.get(number)
        return UNDECIDED if track is None else track.identity

    def counting_as(self, landmark_id: int) -> list[Track]:
        """Tracks that count as a landmark."""
        return [track for track in self._by_number.values() if track.identity == landmark_id]

    def held_until_s(self) -> dict[int, float]:
        """Keyframes on which sightings wait that may soon be used, by key, and until when (s)."""
        return {
            sighting.line.pose_key: (sighting.stamp_ns + self._longest_wait_ns) / NS_PER_S
            for track in self._by_number.values()
            if track.identity != NO_LANDMARK
            for sighting in track.waiting
        }

    def leave(self, pose_keys: set[int]) -> list[tuple[Sighting, int]]:
        """Let go of what was seen from some poses: the sightings that waited in vain, and what was decided of them."""
        forgotten: list[tuple[Sighting, int]] = []
        for track in self._by_number.values():
            forgotten += [(old, track.identity) for old in track.waiting if old.line.pose_key in pose_keys]
            track.waiting = [sighting for sighting in track.waiting if sighting.line.pose_key not in pose_keys]
            track.settled = [sighting for sighting in track.settled if sighting.line.pose_key not in pose_keys]
        return forgotten

    def forget(self, now_ns: int) -> list[tuple[Sighting, int]]:
        """Let go of what is too old: the sightings that waited in vain, and what their tracks had decided."""
        oldest_ns = now_ns - self._longest_wait_ns
        forgotten: list[tuple[Sighting, int]] = []
        for track in self._by_number.values():
            if track.waiting and track.waiting[0].stamp_ns < oldest_ns:
                forgotten += [(old, track.identity) for old in track.waiting if old.stamp_ns < oldest_ns]
                track.waiting = [sighting for sighting in track.waiting if sighting.stamp_ns >= oldest_ns]
        over = [number for number, track in self._by_number.items() if track.newest_ns < oldest_ns]
        for number in over:
            del self._by_number[number]
        return forgotten


STILL = PreintegratedMotion(
    gtsam.Pose3(), np.zeros((6, 6)), np.zeros((6, 3)), np.zeros(3), 0.0, mean_specific_force=np.full(3, np.nan)
)
"""No motion between keyframe and sonar but what a sighting has in it already."""


class LateGate:
    """Chi-square gate on range and azimuth, from keyframes as they are estimated now.

    Parameters
    ----------
    smoother
        The graph.
    threshold
        Largest squared Mahalanobis distance; infinite: no gate.
    """

    def __init__(self, smoother: Smoother, threshold: float) -> None:
        self._smoother = smoother
        self._threshold = threshold

    def inside(self, sightings: list[Sighting], landmark_id: int) -> list[bool]:
        """Which sightings pass, one by one, as those do that come at once; all of a landmark not in the graph."""
        key, values = L(landmark_id), self._smoother.values
        if not np.isfinite(self._threshold) or not sightings or not values.exists(key):
            return [True] * len(sightings)
        joint = self._smoother.joint_covariance_of_any([key, *{sighting.line.pose_key for sighting in sightings}])
        points = values.atPoint3(key)[None]
        distances = []
        for sighting in sightings:
            line = sighting.line
            view = PredictedView(line.pose_key, None, values.atPose3(line.pose_key), STILL, line.body_T_sonar, joint)
            found = view.compare([key], points, line.z[None], sighting.noise[None])
            distances.append(float(found.distance[0]))
        return [distance <= self._threshold for distance in distances]


class DeferredIdentities:
    """Keeps the graph in line with what tracks are known to show.

    Parameters
    ----------
    landmarks
        Of the graph.
    journal
        Its rows are amended when sightings are used, moved, taken back or forgotten.
    gate
        For sightings that come late to a landmark of the graph.
    longest_wait_s
        A sighting waits at most so long. A track that was not seen for so long is over: what it counts as stays.
    """

    def __init__(
        self, landmarks: LandmarkSightings, journal: DetectionJournal, gate: LateGate, longest_wait_s: float
    ) -> None:
        self._landmarks = landmarks
        self._smoother = landmarks.smoother
        self._journal = journal
        self._gate = gate
        self._tracks = ObjectTracks(longest_wait_s)

    def hear(self, frame: LandmarkDetections, decisions: list[int], time_s: float) -> None:
        """Bring earlier sightings in line with what a frame's rows decide, before its own are made.

        Where tracks come to claim one landmark in one earlier frame, that of the more probable row gets it, but what
        is used already stays.

        Parameters
        ----------
        frame
            No track has two rows in it (`sonar_graph.slam.landmarks.tracked`).
        decisions
            Of each row: an identity, `NO_LANDMARK` or `UNDECIDED`.
        time_s
            Of the newest keyframe.
        """
        stamp_ns = int(frame.stamps_ns[0])
        self.forget(stamp_ns)
        rows = zip(frame.track.tolist(), decisions, frame.most_probable()[1].tolist(), strict=True)
        seen = [
            (self._tracks.seen(number, stamp_ns), decision)
            for number, decision, _ in sorted(rows, key=lambda row: -row[2])
            if number != NO_TRACK
        ]
        decided = [(track, decision) for track, decision in seen if decision != UNDECIDED]
        displaced = self._change([(track, new) for track, new in decided if new != track.identity], time_s)
        self._use_late([track for track, _ in decided] + displaced, time_s)

    def identity_of(self, number: int) -> int:
        """What a track counts as: an identity, `NO_LANDMARK` or `UNDECIDED`."""
        return self._tracks.identity_of(number)

    def remember(self, number: int, sighting: Sighting) -> None:
        """A sighting of a track's newest frame."""
        track = self._tracks.seen(number, sighting.stamp_ns)
        (track.waiting if sighting.outcome is Outcome.WAITING else track.settled).append(sighting)
        self._smoother.hold(self._tracks.held_until_s())

    def forget(self, now_ns: int) -> None:
        """Let go of sightings that have waited too long."""
        self._give_up(self._tracks.forget(now_ns))

    def leave(self, pose_keys: set[int]) -> None:
        """Poses leave a bounded window: nothing that was seen from them can be used or taken back any more."""
        self._give_up(self._tracks.leave(pose_keys))

    def _give_up(self, forgotten: list[tuple[Sighting, int]]) -> None:
        for sighting, decision in forgotten:
            if sighting.outcome is Outcome.WAITING:
                outcome = Outcome.NO_IDENTITY if decision == NO_LANDMARK else Outcome.FORGOTTEN
                self._journal.amend(sighting.row, outcome)

    def _change(self, changed: list[tuple[Track, int]], time_s: float) -> list[Track]:
        """Take back what tracks no longer count as; other tracks that now get what these had displaced."""
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
        return self._displaced(freed)

    def _displaced(self, freed: dict[int, set[int]]) -> list[Track]:
        found = []
        for landmark_id, stamps_ns in freed.items():
            for track in self._tracks.counting_as(landmark_id):
                displaced = [s for s in track.settled if s.outcome is Outcome.REPEATED and s.stamp_ns in stamps_ns]
                if displaced:
                    self._reopen(track, displaced)
                    found.append(track)
        return found

    def _reopen(self, track: Track, sightings: list[Sighting]) -> None:
        """Sightings wait again."""
        for sighting in sightings:
            if sighting.outcome is not Outcome.TAKEN_BACK:
                sighting.outcome = Outcome.WAITING
            self._journal.amend(sighting.row, sighting.outcome)
        reopened = set(sightings)
        track.settled = [sighting for sighting in track.settled if sighting not in reopened]
        track.waiting = sorted(track.waiting + sightings, key=lambda sighting: sighting.stamp_ns)

    def _use_late(self, tracks: list[Track], time_s: float) -> None:
        """Put waiting sightings of tracks that count as a landmark into the graph."""
        coming: list[tuple[Sighting, int]] = []
        taken: dict[int, set[int]] = {}
        for track in tracks:
            if track.waiting and track.identity >= 0:
                stamps_ns = taken.setdefault(track.identity, self._landmarks.stamps_ns(track.identity))
                coming += [(sighting, track.identity) for sighting in self._settle(track, stamps_ns)]
        if coming:
            self._landmarks.exchange([], coming, time_s)

    def _settle(self, track: Track, taken_ns: set[int]) -> list[Sighting]:
        """Judge a track's waiting sightings; those to be used. Frames in which the landmark is seen count as taken."""
        free = []
        for sighting in track.waiting:
            if sighting.stamp_ns in taken_ns:
                sighting.outcome = Outcome.REPEATED
            else:
                taken_ns.add(sighting.stamp_ns)
                free.append(sighting)
        for sighting, is_inside in zip(free, self._gate.inside(free, track.identity), strict=True):
            used = Outcome.MOVED if sighting.outcome is Outcome.TAKEN_BACK else Outcome.USED_LATER
            sighting.outcome = used if is_inside else Outcome.GATED
        for sighting in track.waiting:
            self._journal.amend(sighting.row, sighting.outcome, track.identity)
        track.settled, track.waiting = track.settled + track.waiting, []
        return [sighting for sighting in free if sighting.outcome is not Outcome.GATED]


def of_no_landmark(_: int) -> int:
    """What a track counts as, where nobody knows."""
    return UNDECIDED


def best_of_tracks(frame: LandmarkDetections, identity_of: Callable[[int], int]) -> NDArray[np.bool_]:
    """Which rows of a frame are kept, shape (n,): all of no track, and one of each track.

    Parameters
    ----------
    identity_of
        The landmark that a track counts as, by its number; negative: none.
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
    return is_kept


def once_a_track(
    frame: LandmarkDetections, identity_of: Callable[[int], int], journal: DetectionJournal
) -> LandmarkDetections:
    """A frame with one row of each track; the others go to the journal."""
    is_kept = best_of_tracks(frame, identity_of)
    if is_kept.all():
        return frame
    for landmark_id in frame.most_probable()[0][~is_kept].tolist():
        journal.record(int(frame.stamps_ns[0]), landmark_id, Outcome.TRACK_REPEATED)
    return frame.rows(is_kept)
