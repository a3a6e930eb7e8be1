"""Policies "robust" (default) and "gate": identities are accepted track by track, late or revised.

A row *decides* its track: for a landmark whose posterior reaches `minimum_probability`, or for none. On a decision::

    sightings that wait                  become factors of the landmark, each on the keyframe of its frame
    sightings of another landmark        are retracted first; with none, all wait

Retraction comes first, in an update of its own: the landmark then begins in the right place. With a gate, a sighting
has to pass the chi-square test of its innovation, ``e' S^-1 e <= chi2(2)`` (docs/theory/identities.md).
"""

import math
from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from typing import Literal

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.measurements import NO_TRACK, NS_PER_S, LandmarkDetections
from sonar_graph.models import ACCEPTED, MINIMUM_PROBABILITY, Verdict, identify, locate
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.slam.landmarks.landmark_graph import (
    UNCHANGED,
    Assignment,
    Decision,
    IdentityPolicy,
    LandmarkGraph,
)
from sonar_graph.slam.landmarks.sighting import Frame, SeenFrame, Sighting, late_view
from sonar_graph.slam.landmarks.unknown import IgnoredUnknown, UnknownParams
from sonar_graph.states import OUTCOMES, Outcome

UNDECIDED = -2
NO_LANDMARK = -1
"""Decisions of a row besides the identity of a landmark."""


class TrackedIdentity(Section):
    """Settings of identities that are accepted track by track."""

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
        """Largest squared Mahalanobis distance of range and azimuth; infinite: no gate."""
        return math.inf


class RobustIdentity(TrackedIdentity):
    """Use every detection whose identity is probable enough; the kernel limits the pull of wrong ones.

    Assumes that most sightings of every landmark are right, and that wrong ones disagree with each other. The kernel
    then lets the majority win, unless the first sighting of a landmark is so far off that the others hardly pull.

    Examples
    --------
    >>> from sonar_graph.slam import Isam2Params, RobustIdentity
    >>> Isam2Params().identity == RobustIdentity(minimum_probability=0.7)
    True
    """

    policy: Literal["robust"] = "robust"


class GatedIdentity(TrackedIdentity):
    """Use a detection whose identity is probable enough if it lies inside the gate of that landmark.

    Assumes that the estimate and its covariance are right when a detection comes. A detection outside the gate is
    refused, and not tried again unless its track changes its identity. Tracks change theirs as with "robust".

    Examples
    --------
    >>> from sonar_graph.slam import GatedIdentity, Isam2Params
    >>> Isam2Params(identity=GatedIdentity(gate_probability=0.99)).identity.policy
    'gate'
    """

    policy: Literal["gate"] = "gate"
    gate_probability: float = Field(0.999, gt=0, le=1)
    """Probability with which a right detection passes the gate. A detection is refused when its squared Mahalanobis
    distance exceeds this chi-square quantile (2 dof). 1: no gate."""

    @property
    def gate(self) -> float:
        """Largest squared Mahalanobis distance of range and azimuth; infinite: no gate."""
        return (
            chi_square_quantile(self.gate_probability, 2)
            if self.gate_probability < 1
            else math.inf
        )


@dataclass(eq=False)
class Track:
    """Object that the recogniser follows over several frames, with its present identity."""

    identity: int = UNDECIDED
    """Last decision: a landmark, `NO_LANDMARK`, or `UNDECIDED`."""
    newest_ns: int = 0
    """Stamp at which it was last seen."""
    waiting: list[Sighting] = field(default_factory=list)
    """Sightings to be used once their landmark is known, in the order of time."""
    settled: list[Sighting] = field(default_factory=list)
    """Sightings used, or refused, as sightings of that landmark."""

    def reopen(self, sightings: list[Sighting]) -> None:
        """Let settled sightings wait again."""
        reopened = set(sightings)
        self.settled = [
            sighting for sighting in self.settled if sighting not in reopened
        ]
        self.waiting = sorted(
            self.waiting + sightings, key=lambda sighting: sighting.stamp_ns
        )


class TrackedIdentities(IdentityPolicy):
    """Policies "robust" and "gate".

    A sighting waits at most ``longest_wait_s``. A track that was not seen for so long is over, and keeps its identity.
    """

    def __init__(self, landmarks: LandmarkGraph, params: TrackedIdentity) -> None:
        super().__init__(landmarks)
        self._gate = params.gate
        self._minimum_probability = params.minimum_probability
        self._longest_wait_ns = round(params.longest_wait_s * NS_PER_S)
        self._tracks: dict[int, Track] = {}
        self._claims: list[Track] = []
        """Tracks that this frame decides or gives back their landmark, the most probable first."""

    def screen(self, frame: LandmarkDetections) -> list[Outcome | None]:
        """Refuse second rows of tracks, improbable identities, and those that the frame has in a more probable row."""
        oldest_ns = int(frame.stamps_ns[0]) - self._longest_wait_ns
        known = {
            number: track.identity
            for number, track in self._tracks.items()
            if track.newest_ns >= oldest_ns
        }
        refusals = second_rows_of_tracks(frame, known)
        # the second rows are left out before a landmark is given to the most probable row of the frame
        kept = [row for row, why in enumerate(refusals) if why is None]
        _, outcomes = identify(
            frame if len(kept) == len(refusals) else frame.rows(np.array(kept)),
            self._minimum_probability,
            are_sound=True,
        )
        for row, number in zip(kept, outcomes.tolist(), strict=True):
            refusals[row] = None if number == ACCEPTED else OUTCOMES[number]
        return refusals

    def retract(self, frame: Frame | None) -> Decision:
        """Give tracks their new identities, and let their sightings of another landmark wait again.

        Sightings that these had displaced wait again too. A sighting is displaced when another track had its landmark
        in its frame.
        """
        self._claims = []
        if frame is None:
            return UNCHANGED
        tracked = frame.select([track != NO_TRACK for track in frame.tracks])
        if tracked is None:
            return UNCHANGED
        given_up = self.forget(tracked.stamp_ns)
        reopened: list[Sighting] = []
        freed: set[tuple[int, int]] = set()
        for track, identity in self._decided(tracked):
            self._claims.append(track)
            if identity == track.identity:
                continue
            for sighting in track.settled:
                landmark_id = self.landmarks.state(sighting).landmark_id
                if landmark_id is not None:
                    freed.add((landmark_id, sighting.stamp_ns))
            reopened += track.settled
            track.reopen(track.settled)
            track.identity = identity
        # sightings that lost their frame's landmark to one that is retracted now
        for track in self._tracks.values() if freed else ():
            displaced = [
                s for s in track.settled if self._is_displaced_from(s, track, freed)
            ]
            if displaced:
                reopened += displaced
                track.reopen(displaced)
                self._claims.append(track)
        return Decision.of([*given_up, *map(self._waiting, reopened)])

    def associate(self, frame: Frame | None) -> Decision:  # noqa: ARG002
        """Associate what waits in the tracks that this frame decides.

        Where two tracks claim one landmark in one earlier frame, a sighting that is used already stays. Else that of
        the track with the more probable row gets it.
        """
        associated: list[Assignment] = []
        taken_ns: dict[int, set[int]] = {}
        for track in self._claims:
            if track.waiting and track.identity >= 0:
                if track.identity not in taken_ns:
                    taken_ns[track.identity] = self.landmarks.stamps_ns(track.identity)
                associated += self._associate(track, taken_ns[track.identity])
        return Decision.of(associated)

    def rivals(self, frame: Frame, world_T_sonar: gtsam.Pose3) -> list[int]:  # noqa: ARG002
        """Landmarks of the graph that the detections name."""
        return [
            L(frame.ids[row])
            for row in self._named(frame)
            if frame.ids[row] in self.landmarks
        ]

    def judge(self, seen: SeenFrame) -> Decision:
        """Use what has an identity, inside the gate if its landmark is in the graph. The rest waits in its track."""
        frame = seen.frame
        named = self._named(frame)
        known = [row for row in named if frame.ids[row] in self.landmarks]
        released: list[int] = []
        judged = self._compared(seen, known, released) if known else []
        judged += [self._begun(seen, row) for row in named if row not in known]
        others = [row for row in range(len(frame)) if frame.refusals[row] is not None]
        waiting = seen.sightings(others, seen.beam_points(others)) if others else []
        for row, sighting in zip(others, waiting, strict=True):
            # repeated: a more probable row of the frame has the landmark
            is_repeated = frame.refusals[row] is Outcome.REPEATED
            judged.append(
                Assignment(
                    sighting, Outcome.REPEATED if is_repeated else Outcome.WAITING
                )
            )
        track_of = dict(zip(frame.rows, frame.tracks, strict=True))
        for each in judged:
            track = self._tracks.get(track_of[each.sighting.row])
            if track is None:  # a single detection: final
                continue
            if each.outcome is Outcome.WAITING:
                track.waiting.append(each.sighting)
            else:
                track.settled.append(each.sighting)
        return Decision.of(judged, released)

    def held(self) -> dict[int, float]:
        """Keyframes of sightings that wait, of tracks that may still be of a landmark."""
        return {
            sighting.line.pose_key: (sighting.stamp_ns + self._longest_wait_ns)
            / NS_PER_S
            for track in self._tracks.values()
            if track.identity != NO_LANDMARK
            for sighting in track.waiting
        }

    def forget(self, now_ns: int, left: Set[int] = frozenset()) -> list[Assignment]:
        """Give up sightings that have waited too long or leave the window, and drop tracks that are over."""
        oldest_ns = now_ns - self._longest_wait_ns
        given_up: list[Assignment] = []
        for track in self._tracks.values():
            old = {
                s
                for s in track.waiting
                if s.stamp_ns < oldest_ns or s.line.pose_key in left
            }
            if old:
                why = (
                    Outcome.NO_IDENTITY
                    if track.identity == NO_LANDMARK
                    else Outcome.FORGOTTEN
                )
                # a retracted sighting stays one
                given_up += [
                    Assignment(s, why)
                    for s in track.waiting
                    if s in old and self.landmarks.state(s).outcome is Outcome.WAITING
                ]
                track.waiting = [
                    sighting for sighting in track.waiting if sighting not in old
                ]
            if left:
                track.settled = [
                    sighting
                    for sighting in track.settled
                    if sighting.line.pose_key not in left
                ]
        self._tracks = {
            number: track
            for number, track in self._tracks.items()
            if track.newest_ns >= oldest_ns
        }
        return given_up

    def _decided(self, frame: Frame) -> list[tuple[Track, int]]:
        """Tracks that rows of a frame decide, with the decisions, the most probable row first."""
        decisions = decide(frame.detections, self._minimum_probability)
        probability = frame.detections.most_probable()[1]
        decided = []
        # the order in which tracks may claim a landmark
        for row in np.argsort(-probability, kind="stable").tolist():
            track = self._tracks.setdefault(int(frame.detections.track[row]), Track())
            track.newest_ns = frame.stamp_ns
            if decisions[row] != UNDECIDED:
                decided.append((track, decisions[row]))
        return decided

    def _waiting(self, sighting: Sighting) -> Assignment:
        """Let a sighting wait; one in the graph is retracted."""
        is_in_graph = self.landmarks.state(sighting).landmark_id is not None
        return Assignment(
            sighting, Outcome.TAKEN_BACK if is_in_graph else Outcome.WAITING
        )

    def _is_displaced_from(
        self, sighting: Sighting, track: Track, freed: set[tuple[int, int]]
    ) -> bool:
        """True when its frame showed the landmark of its track elsewhere, and no longer does."""
        is_free = (track.identity, sighting.stamp_ns) in freed
        return is_free and self.landmarks.state(sighting).outcome is Outcome.REPEATED

    def _associate(self, track: Track, taken_ns: set[int]) -> list[Assignment]:
        """Judge the waiting sightings of a track; frames that show its landmark already are taken.

        They pass the gate one by one, from keyframes as estimated now. All pass where the landmark is not in the graph.
        """
        free: list[Sighting] = []
        for sighting in track.waiting:
            if sighting.stamp_ns not in taken_ns:
                taken_ns.add(sighting.stamp_ns)
                free.append(sighting)
        outcomes = dict.fromkeys(track.waiting, Outcome.REPEATED)
        for sighting, is_inside in zip(
            free, self._pass_gate(free, L(track.identity)), strict=True
        ):
            is_retracted = self.landmarks.state(sighting).outcome is Outcome.TAKEN_BACK
            used = Outcome.MOVED if is_retracted else Outcome.USED_LATER
            outcomes[sighting] = used if is_inside else Outcome.GATED
        track.settled += track.waiting
        track.waiting = []
        return [
            Assignment(sighting, outcome, track.identity)
            for sighting, outcome in outcomes.items()
        ]

    def _pass_gate(self, sightings: list[Sighting], key: int) -> list[bool]:
        """Flags of earlier sightings that lie inside the gate of a landmark."""
        values = self.smoother.estimates
        if not sightings or math.isinf(self._gate) or not values.exists(key):
            return [True] * len(sightings)
        # one joint covariance for all: its cost is that of the keyframes, not of the sightings
        joint = self.smoother.joint_covariance_of_any(
            [key, *{s.line.pose_key for s in sightings}]
        )
        point = values.atPoint3(key)[None]
        flags = []
        for sighting in sightings:
            view = late_view(sighting, values, joint)
            compared = view.compare(
                [key], point, sighting.line.z[None], sighting.noise[None]
            )
            flags.append(bool(compared.distance[0] <= self._gate))
        return flags

    def _named(self, frame: Frame) -> list[int]:
        """Detections whose identity is accepted."""
        return [row for row, why in enumerate(frame.refusals) if why is None]

    def _compared(
        self, seen: SeenFrame, rows: list[int], released: list[int]
    ) -> list[Assignment]:
        """Use detections of landmarks of the graph that lie inside the gate and do not contradict the map.

        Landmarks of the map that have moved are added to ``released``.
        """
        frame = seen.frame
        keys = [L(frame.ids[row]) for row in rows]
        # (m, 3)
        landmarks = np.array([self.smoother.estimates.atPoint3(key) for key in keys])
        compared = seen.view.compare(keys, landmarks, frame.z[rows], frame.noise[rows])
        # a sighting of a track may change its landmark, so that its noise must not depend on one
        points = landmarks
        is_tracked = [frame.tracks[row] != NO_TRACK for row in rows]
        if any(is_tracked):
            mask = np.array(is_tracked)[:, None]
            points = np.where(mask, seen.beam_points(rows), landmarks)
        judged = []
        for k, sighting in enumerate(seen.sightings(rows, points)):
            squared = compared.distance[k]
            landmark_id = frame.ids[rows[k]]
            verdict = self.landmarks.known.judge(
                landmark_id, frame.stamp_ns, compared.innovation[k], compared.S[k]
            )
            if verdict is Verdict.RELEASE:
                released.append(landmark_id)
            is_inside = squared <= self._gate and verdict is Verdict.USE
            judged.append(
                Assignment(
                    sighting,
                    Outcome.USED if is_inside else Outcome.GATED,
                    landmark_id,
                    compared.innovation[k],
                    compared.S[k],
                    gain=compared.gain[k] if is_inside else 0.0,
                )
            )
        return judged

    def _begun(self, seen: SeenFrame, row: int) -> Assignment:
        """Begin a landmark, on the known floor where it can stand on it, else on the centre beam."""
        frame = seen.frame
        z = frame.z[row]
        elevation_rad = seen.factors.elevation_on(
            seen.floors[row], seen.view.world_T_sonar, z
        )
        start = locate(seen.view.world_T_sonar, z[0], z[1], elevation_rad)
        # as in `_compared`: of a track, the sighting must not depend on where this landmark begins
        if frame.tracks[row] == NO_TRACK:
            (sighting,) = seen.sightings([row], start[None], elevation_rad)
        else:
            (sighting,) = seen.sightings([row], seen.beam_points([row]))
        return Assignment(sighting, Outcome.NEW, frame.ids[row], start=start)


def decide(frame: LandmarkDetections, least_probability: float) -> list[int]:
    """Decision of each row: a landmark's identity, `NO_LANDMARK` or `UNDECIDED`."""
    ids, probability = frame.most_probable()
    none = 1.0 - frame.id_probability.sum(axis=1)  # the posterior of no known landmark
    decisions = np.where(none >= least_probability, NO_LANDMARK, UNDECIDED)
    is_named = (probability >= least_probability) & (ids >= 0)
    return np.where(is_named, ids, decisions).tolist()


def second_rows_of_tracks(
    frame: LandmarkDetections, identities: Mapping[int, int]
) -> list[Outcome | None]:
    """Refusals of the rows of a frame that show an object a second time; None: the row stays.

    A track is one object in one place, so each frame keeps one row of it: the row with the highest posterior for the
    landmark that the track counts as, by ``identities``; else the highest posterior for any landmark; of equals the
    first.
    """
    tracks = frame.track.tolist()
    best: dict[int, tuple[float, float, int]] = {}
    for row, track in enumerate(tracks):
        if track == NO_TRACK:
            continue
        is_landmark = frame.candidate_ids[row] >= 0
        ids = frame.candidate_ids[row, is_landmark]
        posterior = frame.id_probability[row, is_landmark]
        of_identity = posterior[ids == identities.get(track, UNDECIDED)].sum()
        score = (of_identity, posterior.max(initial=0.0), -row)
        best[track] = max(best.get(track, score), score)
    return [
        None if track == NO_TRACK or -best[track][2] == row else Outcome.TRACK_REPEATED
        for row, track in enumerate(tracks)
    ]
