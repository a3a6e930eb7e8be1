"""Detections to factors: a frame is screened, tied to a keyframe, predicted, and assigned to landmarks.

A frame hangs on the newest keyframe by the odometry between them: the sonar's pose at the frame, in the keyframe's
body frame. Detections are predicted from there (docs/theory/models.md) and compared with the joint covariance of
keyframe, gyro bias and landmarks. The identity policy decides which become factors (docs/theory/identities.md,
doubtful_identities.md, unknown_landmarks.md), and may change its mind; the landmark graph does what it decides.
"""

from collections.abc import Set
from dataclasses import replace
from itertools import compress

import numpy as np

from sonar_graph.measurements import NO_TRACK, Floats, LandmarkDetections
from sonar_graph.models import KernelParams
from sonar_graph.slam.estimates import Solution
from sonar_graph.slam.keyframes import Keyframes
from sonar_graph.slam.landmarks import (
    AmendableJournal,
    AssociatedUnknown,
    IdentityParams,
    IdentityPolicy,
    LandmarkGraph,
    MixtureIdentities,
    MixtureIdentity,
    NamelessLandmarks,
    Screened,
    SeenFrame,
    SightingFactors,
    TrackedIdentities,
)
from sonar_graph.slam.smoother import Changed
from sonar_graph.states import DetectionLog, Outcome

NOTHING = Screened([], [])


class Frontend:
    """Adds the factors of detected landmarks to a smoother and records what became of each detection."""

    def __init__(self, identity: IdentityParams, kernel: KernelParams, keyframes: Keyframes) -> None:
        self.journal = AmendableJournal()
        self._keyframes = keyframes
        factors = SightingFactors(keyframes.calibration.sonar, kernel.robust())
        self.landmarks = LandmarkGraph(keyframes.smoother, factors, self.journal)
        self._uses_tracks = identity.longest_wait_s > 0
        self.policy: IdentityPolicy
        if isinstance(identity, MixtureIdentity):
            self.policy = MixtureIdentities(self.landmarks, identity, kernel)
        else:
            unknown, nameless = identity.unknown, None
            if isinstance(unknown, AssociatedUnknown):
                nameless = NamelessLandmarks(self.landmarks, keyframes, unknown)
            self.policy = TrackedIdentities(self.landmarks, identity, nameless)

    def add(self, frame: LandmarkDetections) -> None:
        """Take in the detections of one frame."""
        seen = self._screened(frame)
        if seen is None:
            return
        for assignments in self.policy.assign(seen):
            self.landmarks.apply(assignments, self._keyframes.newest_s)
            self.update_if_due()

    def add_fix(self, stamp_ns: int, position_m: Floats, cov_m2: Floats) -> None:
        """Take in a position fix, which enters the estimate at once unless it has next to nothing to tell."""
        self._keyframes.add_fix(stamp_ns, position_m, cov_m2)
        self.update_if_due()

    def update_if_due(self) -> None:
        """Bring the smoother up to date, and the sightings in line with what it withheld and gave up."""
        if (changed := self._keyframes.update_if_due()) is not None:
            self._follow(changed)

    def advance(self, until_ns: int) -> None:
        """Set the keyframes that are due at an instant."""
        for changed in self._keyframes.advance(until_ns):
            self._follow(changed)

    def _screened(self, frame: LandmarkDetections) -> SeenFrame | None:
        """Rows that may become sightings; all rows go to the journal."""
        if not self._uses_tracks:
            frame = replace(frame, track=np.full(len(frame), NO_TRACK))
        stamp_ns, is_sound = int(frame.stamps_ns[0]), frame.are_sound()
        refusals: list[Outcome | None] = [Outcome.UNSOUND] * len(frame)
        waits, kept = [False] * len(frame), np.flatnonzero(is_sound).tolist()
        if self._keyframes.newest_ns is None:
            said = Screened([Outcome.UNLOCATED] * len(kept), [False] * len(kept))
        elif stamp_ns < self._keyframes.advanced_ns:
            said = Screened([Outcome.LATE] * len(kept), [False] * len(kept))
        else:
            said = self.policy.screen(frame if len(kept) == len(frame) else frame.rows(is_sound)) if kept else NOTHING
        for row, why, wait in zip(kept, *said, strict=True):
            refusals[row], waits[row] = why, wait
        is_open = [why is None or wait for why, wait in zip(refusals, waits, strict=True)]
        ids = frame.most_probable()[0].tolist()
        rows = [
            self.journal.record(stamp_ns, landmark_id, why or Outcome.WAITING)
            for landmark_id, why in zip(ids, refusals, strict=True)
        ]
        if not any(is_open):
            return None
        seen = frame if all(is_open) else frame.rows(np.array(is_open))
        rows, ids, refusals = (list(compress(column, is_open)) for column in (rows, ids, refusals))
        return SeenFrame(seen, rows, ids, refusals, self._keyframes, self.landmarks.factors)

    def smoothed(self) -> Solution:
        """Solution of the whole graph, with the doubtful identities that fit it best."""
        return self.policy.smoothed()

    def log(self) -> DetectionLog:
        """Outcome of each detection in the same history."""
        self._forget(set())
        return self.landmarks.rechosen(self.policy.rechosen()).log()

    def _follow(self, changed: Changed) -> None:
        self.landmarks.follow(changed)
        if changed.left:
            self._forget(changed.left)

    def _forget(self, left: Set[int]) -> None:
        if given_up := self.policy.forget(self._keyframes.advanced_ns, left):
            self.landmarks.apply(given_up, self._keyframes.newest_s)
