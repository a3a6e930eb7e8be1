"""Identities that are believed track by track, known late, or changed (docs/theory/identities.md).

Sightings of a track wait, each on the keyframe at which it was made, until the track is known to be of a landmark; then
all become factors there. When the track turns out to be of another landmark, or of none, its factors are taken out of
the graph; those of the other landmark are put in once the estimate no longer rests on the wrong ones.
"""

import math
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from gtsam.symbol_shorthand import L
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.measurements import NO_TRACK, LandmarkDetections
from sonar_graph.models import ACCEPTED, MINIMUM_PROBABILITY, gate_threshold, identify
from sonar_graph.slam.estimates import Solution
from sonar_graph.slam.landmarks.landmark_graph import Assignment, LandmarkGraph
from sonar_graph.slam.landmarks.sighting import Screened, SeenFrame, Sighting, beam_point, late_view
from sonar_graph.slam.landmarks.unknown import IgnoredUnknown, NamelessLandmarks, UnknownParams, unnamed
from sonar_graph.states import OUTCOMES, Outcome

UNDECIDED, NO_LANDMARK = -2, -1
"""Decisions of a row besides a landmark's identity."""


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


def second_rows_of_tracks(frame: LandmarkDetections, identities: Mapping[int, int]) -> list[Outcome | None]:
    """Refusals of the rows of a frame that show an object a second time; None: the row stays.

    A track is one object in one place, so each frame keeps one row of it: that with the highest posterior for the
    landmark that the track counts as, by its number; of others, the one with the highest posterior for any landmark; of
    equals the first.
    """
    tracks = frame.track.tolist()
    best: dict[int, tuple[float, float, int]] = {}
    for row, track in enumerate(tracks):
        if track != NO_TRACK:
            is_landmark = frame.candidate_ids[row] >= 0
            ids, posterior = frame.candidate_ids[row, is_landmark], frame.id_probability[row, is_landmark]
            of_it = float(posterior[ids == identities.get(track, UNDECIDED)].sum())
            score = of_it, float(posterior.max(initial=0.0)), -row
            best[track] = max(best.get(track, score), score)
    return [
        None if track == NO_TRACK or -best[track][2] == row else Outcome.TRACK_REPEATED
        for row, track in enumerate(tracks)
    ]


class TrackedIdentity(Section):
    """Settings of identities that are believed track by track."""

    minimum_probability: float = Field(MINIMUM_PROBABILITY, ge=0, le=1)
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

    Examples
    --------
    >>> from sonar_graph.slam import Isam2Params, RobustIdentity
    >>> Isam2Params().identity == RobustIdentity(minimum_probability=0.7)
    True
    """

    policy: Literal["robust"] = "robust"


class GatedIdentity(TrackedIdentity):
    """Use a detection whose identity is probable enough if it lies inside the gate of that landmark.

    Assumes that the estimate and its covariance are right when a detection comes: a detection outside the gate is
    refused, and not tried again unless its track changes its identity. Tracks change theirs as with "robust".

    Examples
    --------
    >>> from sonar_graph.slam import GatedIdentity, Isam2Params
    >>> Isam2Params(identity=GatedIdentity(gate_probability=0.99)).identity.policy
    'gate'
    """

    policy: Literal["gate"] = "gate"
    gate_probability: float = Field(0.999, gt=0, le=1)
    """Probability with which a right detection passes the gate: detections are refused whose squared Mahalanobis
    innovation exceeds this chi-square quantile (2 dof). 1: no gate."""

    @property
    def gate(self) -> float:
        """Largest squared Mahalanobis innovation of range and azimuth; infinite: none is refused."""
        return gate_threshold(self.gate_probability, 2) if self.gate_probability < 1 else math.inf


NS_PER_S = 1_000_000_000


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

    def reopen(self, sightings: list[Sighting]) -> list[Assignment]:
        """Let settled sightings wait again; those in the graph are taken back."""
        self.settled = [sighting for sighting in self.settled if sighting not in set(sightings)]
        self.waiting = sorted(self.waiting + sightings, key=lambda sighting: sighting.stamp_ns)
        return [Assignment(s, Outcome.WAITING if s.landmark_id is None else Outcome.TAKEN_BACK) for s in sightings]


class TrackedIdentities:
    """Policies "robust" and "gate": keeps the graph in line with what is said of detections and of their tracks.

    A sighting waits at most ``longest_wait_s``; a track that was not seen for so long is over, and keeps its identity.
    """

    def __init__(
        self, landmarks: LandmarkGraph, params: TrackedIdentity, nameless: NamelessLandmarks | None = None
    ) -> None:
        self._landmarks, self._nameless = landmarks, nameless
        self._gate, self._minimum_probability = params.gate, params.minimum_probability
        self._longest_wait_ns = round(params.longest_wait_s * NS_PER_S)
        self._tracks: dict[int, Track] = {}

    def screen(self, frame: LandmarkDetections) -> Screened:
        """Refuse second rows of tracks, and rows of no track whose identity is not probable enough or taken."""
        oldest_ns = int(frame.stamps_ns[0]) - self._longest_wait_ns
        known = {number: track.identity for number, track in self._tracks.items() if track.newest_ns >= oldest_ns}
        refusals, waits = second_rows_of_tracks(frame, known), frame.track != NO_TRACK
        if self._nameless is not None:
            self._nameless.refuse_taken_ids(frame)
            waits |= unnamed(frame)
        kept = [row for row, why in enumerate(refusals) if why is None]
        seen = frame if len(kept) == len(frame) else frame.rows(np.array(kept))
        for row, number in zip(kept, identify(seen, self._minimum_probability)[1].tolist(), strict=True):
            refusals[row] = None if number == ACCEPTED else OUTCOMES[number]
        return Screened(refusals, [wait and row in kept for row, wait in enumerate(waits.tolist())])

    def assign(self, frame: SeenFrame) -> Iterator[list[Assignment]]:
        """Earlier sightings of tracks whose identity changes, then the frame's, those without a name last."""
        seen = frame.detections
        nameless = np.flatnonzero(unnamed(seen)).tolist() if self._nameless is not None else []
        rows, tracks = [row for row in range(len(seen)) if row not in nameless], seen.track.tolist()
        tracked = [row for row in rows if tracks[row] != NO_TRACK]
        if tracked:
            yield from self._hear(seen.rows(np.array(tracked)))
        sightings: dict[int, Sighting] = {}
        if rows:
            assigned = self._judge(frame, rows)
            sightings = {each.sighting.row: each.sighting for each in assigned}
            yield assigned
        if self._nameless is not None:
            taken = {s.landmark_id for s in sightings.values() if s.landmark_id is not None}
            yield from self._nameless.assign(frame, nameless, taken)
        for row in tracked:
            sighting, track = sightings[frame.rows[row]], self._tracks[tracks[row]]
            (track.waiting if sighting.outcome is Outcome.WAITING else track.settled).append(sighting)
        if tracked:  # what may soon be used stays in the window
            self._landmarks.smoother.hold(
                {
                    waiting.line.pose_key: (waiting.stamp_ns + self._longest_wait_ns) / NS_PER_S
                    for track in self._tracks.values()
                    if track.identity != NO_LANDMARK
                    for waiting in track.waiting
                }
            )

    def forget(self, now_ns: int, left: Set[int] = frozenset()) -> list[Assignment]:
        """Forget sightings that have waited too long or leave the window, and tracks that are over."""
        oldest_ns, given_up = now_ns - self._longest_wait_ns, []
        for track in self._tracks.values():
            gone = {s for s in track.waiting if s.stamp_ns < oldest_ns or s.line.pose_key in left}
            if gone:
                why = Outcome.NO_IDENTITY if track.identity == NO_LANDMARK else Outcome.FORGOTTEN
                given_up += [Assignment(s, why) for s in track.waiting if s in gone and s.outcome is Outcome.WAITING]
                track.waiting = [sighting for sighting in track.waiting if sighting not in gone]
            if left:
                track.settled = [sighting for sighting in track.settled if sighting.line.pose_key not in left]
        self._tracks = {number: track for number, track in self._tracks.items() if track.newest_ns >= oldest_ns}
        return given_up + ([] if self._nameless is None else self._nameless.forget(left))

    def smoothed(self) -> Solution:
        """Solution of the whole graph."""
        return Solution(*self._landmarks.smoother.solve_history(), self._landmarks.ids)

    def rechosen(self) -> list[Assignment]:
        """Nothing is chosen anew."""
        return []

    def _hear(self, frame: LandmarkDetections) -> Iterator[list[Assignment]]:
        """Bring earlier sightings in line with what a frame's rows decide (`decide`), before its own are judged.

        Where tracks come to claim one landmark in one earlier frame, that of the more probable row gets it, but what is
        used already stays; where it is taken back, the one that it had displaced is used.
        """
        stamp_ns = int(frame.stamps_ns[0])
        yield self.forget(stamp_ns)
        decisions, decided = decide(frame, self._minimum_probability), []
        for row in np.argsort(-frame.most_probable()[1], kind="stable").tolist():
            track = self._tracks.setdefault(int(frame.track[row]), Track())
            track.newest_ns = stamp_ns
            if decisions[row] != UNDECIDED:
                decided.append((track, decisions[row]))
        changed = [(track, new) for track, new in decided if new != track.identity]
        leaving = [s for track, _ in changed for s in track.settled]
        freed = {(s.landmark_id, s.stamp_ns) for s in leaving if s.landmark_id is not None}
        back, displaced = [], []
        for track, new in changed:
            back += track.reopen(track.settled)
            track.identity = new
        for track in self._tracks.values() if freed else ():
            may_return = [s for s in track.settled if s.outcome is Outcome.REPEATED]
            if again := [s for s in may_return if (track.identity, s.stamp_ns) in freed]:
                back += track.reopen(again)
                displaced.append(track)
        yield back
        coming: list[Assignment] = []
        taken: dict[int, set[int]] = {}
        for track in [track for track, _ in decided] + displaced:
            if track.waiting and track.identity >= 0:
                stamps_ns = taken.setdefault(track.identity, self._landmarks.stamps_ns(track.identity))
                coming += self._settle(track, stamps_ns)
        yield coming

    def _settle(self, track: Track, taken_ns: set[int]) -> list[Assignment]:
        """Judge a track's waiting sightings; frames that show its landmark already are taken.

        They pass the gate one by one, as those that come at once, from keyframes as estimated now; all pass where the
        landmark is not in the graph.
        """
        smoother, key = self._landmarks.smoother, L(track.identity)
        free = []
        for sighting in track.waiting:
            if sighting.stamp_ns not in taken_ns:
                taken_ns.add(sighting.stamp_ns)
                free.append(sighting)
        inside = set(free)
        if np.isfinite(self._gate) and free and smoother.values.exists(key):
            joint = smoother.joint_covariance_of_any([key, *{sighting.line.pose_key for sighting in free}])
            point = smoother.values.atPoint3(key)[None]
            for sighting in free:
                view = late_view(sighting, smoother.values, joint)
                if view.compare([key], point, sighting.line.z[None], sighting.noise[None]).distance[0] > self._gate:
                    inside.remove(sighting)
        judged = []
        for sighting in track.waiting:
            used = Outcome.MOVED if sighting.outcome is Outcome.TAKEN_BACK else Outcome.USED_LATER
            refused = Outcome.GATED if sighting in set(free) else Outcome.REPEATED
            judged.append(Assignment(sighting, used if sighting in inside else refused, track.identity))
        track.settled, track.waiting = track.settled + track.waiting, []
        return judged

    def _judge(self, frame: SeenFrame, rows: list[int]) -> list[Assignment]:
        """Use what has an identity, inside the gate if its landmark is in the graph; the rest waits in its track."""
        values, make = self._landmarks.smoother.values, self._landmarks.factors
        ids, refusals, is_tracked = frame.ids, frame.refusals, frame.detections.track != NO_TRACK
        named = [row for row in rows if refusals[row] is None]
        known = [row for row in named if ids[row] in self._landmarks]
        keys = [L(ids[row]) for row in known]
        view, judged = frame.predict(keys), []
        if known:
            points = np.array([values.atPoint3(key) for key in keys])
            found = view.compare(keys, points, frame.z[known], frame.noise[known])
            at = np.where(is_tracked[known, None], np.nan, points)
            for k, sighting in enumerate(frame.sightings(view, known, at)):
                is_inside = bool(found.distance[k] <= self._gate)
                outcome, gain = (Outcome.USED, float(found.gain[k])) if is_inside else (Outcome.GATED, 0.0)
                judged.append(Assignment(sighting, outcome, ids[known[k]], found.innovation[k], found.S[k], gain))
        for row in named:
            if row not in known:  # a landmark begins on the known floor where it can stand on it, else on the beam
                floor = frame.floor_under(view, row)
                elevation = make.elevation_on(floor, view.world_T_sonar, frame.z[row])
                start = beam_point(view.world_T_sonar, frame.z[row], elevation)
                (sighting,) = frame.sightings(view, [row], None if is_tracked[row] else start[None])
                sighting.floor, sighting.elevation_rad = floor, 0.0 if is_tracked[row] else elevation
                judged.append(Assignment(sighting, Outcome.NEW, ids[row], start=start))
        kept = [row for row in rows if refusals[row] is not None]
        for row, sighting in zip(kept, frame.sightings(view, kept), strict=True):
            is_taken = refusals[row] is Outcome.REPEATED  # a more probable row of the frame has the landmark
            judged.append(Assignment(sighting, Outcome.REPEATED if is_taken else Outcome.WAITING))
        return judged
