"""Path of a detection into the graph.

For each frame (`Frontend.add`)::

    screen      rows that cannot be used, or have no identity          journal: one row a detection
    revise      earlier sightings whose identity the frame changes     policy decides, `LandmarkGraph` applies
    tie         set a keyframe if the frame needs a newer one          the frame hangs on it by odometry
    predict     range and azimuth of rivals, with covariances          from the newest keyframe of the window
    decide      landmark of each detection, or a refusal               policy decides, `LandmarkGraph` applies
    reconsider  earlier sightings at the new estimate                  policy decides, `LandmarkGraph` applies

Every decision is a value. It is applied, and the estimate updated if that is due, before the policy decides again
(docs/theory/identities.md, doubtful_identities.md, unknown_landmarks.md). Predictions: docs/theory/models.md.
"""

from collections.abc import Set
from dataclasses import replace

import numpy as np

from sonar_graph.measurements import NO_TRACK, Floats, LandmarkDetections
from sonar_graph.models import KernelParams, polar_measurements
from sonar_graph.slam.keyframes import Keyframes
from sonar_graph.slam.landmarks import (
    AmendableJournal,
    AssociatedUnknown,
    Decision,
    Frame,
    IdentityParams,
    IdentityPolicy,
    LandmarkGraph,
    MixtureIdentities,
    MixtureIdentity,
    NamelessLandmarks,
    SeenFrame,
    SightingFactors,
    Solution,
    TrackedIdentities,
    unnamed,
)
from sonar_graph.slam.prediction import PredictedView, Tie
from sonar_graph.slam.smoother import Changed
from sonar_graph.states import DetectionLog, Outcome

UNIDENTIFIED = {Outcome.NO_IDENTITY, Outcome.REPEATED}
"""Refusals of an identity alone."""


class Frontend:
    """Adds the factors of detected landmarks to a smoother and records the outcome of each detection."""

    def __init__(
        self, identity: IdentityParams, kernel: KernelParams, keyframes: Keyframes
    ) -> None:
        calibration = keyframes.calibration
        factors = SightingFactors(calibration.sonar, kernel.robust(), calibration.floor)
        self.journal = AmendableJournal()
        self.landmarks = LandmarkGraph(
            keyframes.smoother, factors, self.journal, calibration.map
        )
        self._keyframes = keyframes
        self._uses_tracks = identity.longest_wait_s > 0
        self.policy: IdentityPolicy
        self._nameless: NamelessLandmarks | None = None
        """Policy of rows that name no landmark; None: they are refused, or the policy decides on them too."""
        if isinstance(identity, MixtureIdentity):
            self.policy = MixtureIdentities(self.landmarks, identity, kernel)
        else:
            self.policy = TrackedIdentities(self.landmarks, identity)
            if isinstance(identity.unknown, AssociatedUnknown):
                self._nameless = NamelessLandmarks(
                    self.landmarks, keyframes, identity.unknown
                )

    def add(self, detections: LandmarkDetections) -> None:
        """Decide on the detections of one frame, and on earlier ones that it concerns."""
        frame = self._screened(detections)
        if frame is None:
            return
        tie: Tie | None = None
        taken: set[int] = set()
        for policy, part in self._shared(frame):
            # first, so that the frame is compared with an estimate without the wrong identities
            self._apply(policy.retract(part))
            self._apply(policy.associate(part))
            if part is None:
                continue
            newest = self._keyframes.tie(
                self._keyframes.motion_since_newest(part.stamp_ns)
            )
            if tie is None:  # once a frame: all its sightings hang on one keyframe
                tie = self._keyframes.tie(
                    self._keyframes.set_for_frame(part.stamp_ns, newest.motion)
                )
            seen = self._predicted(policy, part, newest, tie, frozenset(taken))
            decision = policy.judge(seen)
            self._apply(decision)
            # keyframes of sightings that wait stay in the window, so that late factors cost no restart
            self.landmarks.smoother.hold(self.policy.held())
            later = policy.reconsider()
            while not later.is_empty:
                self._apply(later)
                later = policy.reconsider()
            # only nameless detections, which come last, need to know
            for each in decision.assignments if self._nameless is not None else ():
                landmark_id = self.landmarks.state(each.sighting).landmark_id
                # None where the smoother withheld the sighting
                if landmark_id is not None:
                    taken.add(landmark_id)

    def add_fix(self, stamp_ns: int, position_m: Floats, cov_m2: Floats) -> None:
        """Add a position fix, which enters the estimate at once if it adds enough information."""
        self._keyframes.add_fix(stamp_ns, position_m, cov_m2)
        self.update_if_due()

    def update_if_due(self) -> None:
        """Update the smoother, and the states of sightings that it withheld or that left the window."""
        changed = self._keyframes.update_if_due()
        if changed is not None:
            self._follow(changed)

    def advance(self, until_ns: int) -> None:
        """Set the keyframes that are due at an instant."""
        changes = self._keyframes.advance(until_ns)
        for changed in changes:
            self._follow(changed)
        if changes:
            self.landmarks.begin(self._keyframes.newest_s)

    def smoothed(self) -> Solution:
        """Solution of the whole graph, with the doubtful identities that fit it best."""
        return self.policy.smoothed()

    def log(self) -> DetectionLog:
        """Outcome of each detection in the same history."""
        self._forget(set())
        return self.landmarks.log(self.policy.rechosen())

    def _screened(self, detections: LandmarkDetections) -> Frame | None:
        """Detections that may become sightings. Every row enters the journal, a refused one with its reason."""
        if not self._uses_tracks:  # without waiting, each detection is judged alone
            detections = replace(detections, track=np.full(len(detections), NO_TRACK))
        stamp_ns = int(detections.stamps_ns[0])
        ids = detections.most_probable()[0].tolist()
        refusals = self._refusals(detections)
        # the policy amends the rows that it decides on
        rows = [
            self.journal.record(stamp_ns, landmark_id, why or Outcome.WAITING)
            for landmark_id, why in zip(ids, refusals, strict=True)
        ]
        # a row without an identity may get one by its track or by its place
        tracks = detections.track.tolist()
        may_wait = [track != NO_TRACK for track in tracks]
        if self._nameless is not None:
            may_wait = [
                a or b for a, b in zip(may_wait, unnamed(detections), strict=True)
            ]
        is_open = [
            why is None or (why in UNIDENTIFIED and waits)
            for why, waits in zip(refusals, may_wait, strict=True)
        ]
        sonar = self._keyframes.calibration.sonar
        z, noise = polar_measurements(detections, sonar)
        frame = Frame(detections, stamp_ns, rows, ids, tracks, refusals, z, noise)
        return frame.select(is_open)

    def _refusals(self, detections: LandmarkDetections) -> list[Outcome | None]:
        """Reason why a row cannot be used, or has no identity; None: it has one, or the policy chooses it by place."""
        is_sound = detections.are_sound().tolist()
        if not any(is_sound):
            return [Outcome.UNSOUND] * len(is_sound)
        sound = detections if all(is_sound) else detections.rows(np.array(is_sound))
        if self._keyframes.newest_ns is None:
            screened: list[Outcome | None] = [Outcome.UNLOCATED] * len(sound)
        elif detections.stamps_ns[0] < self._keyframes.advanced_ns:
            # the motion to a frame before the newest instant is no longer kept
            screened = [Outcome.LATE] * len(sound)
        else:
            if self._nameless is not None:
                self._nameless.refuse_taken_ids(sound)
            screened = self.policy.screen(sound)
        rest = iter(screened)
        return [next(rest) if is_one else Outcome.UNSOUND for is_one in is_sound]

    def _shared(self, frame: Frame) -> list[tuple[IdentityPolicy, Frame | None]]:
        """Policies in the order in which they decide, with the detections of each."""
        if self._nameless is None:
            return [(self.policy, frame)]
        is_nameless = unnamed(frame.detections).tolist()
        return [
            (self.policy, frame.select([not each for each in is_nameless])),
            (self._nameless, frame.select(is_nameless)),
        ]

    def _predicted(
        self,
        policy: IdentityPolicy,
        frame: Frame,
        newest: Tie,
        tie: Tie,
        taken: frozenset[int],
    ) -> SeenFrame:
        """The frame with its prediction from the newest keyframe of the window.

        A keyframe that was set for this frame enters the window with the next update, together with its sightings.
        """
        smoother = self._keyframes.smoother
        body_T_sonar = self.landmarks.factors.body_T_sonar
        world_T_keyframe = smoother.estimates.atPose3(newest.pose_key)
        world_T_sonar = world_T_keyframe.compose(newest.motion.i_T_j).compose(
            body_T_sonar
        )
        keys = policy.rivals(frame, world_T_sonar)
        joint = smoother.joint_covariance([*newest.keys, *keys])
        view = PredictedView(newest, world_T_keyframe, body_T_sonar, joint)
        return SeenFrame(frame, view, keys, tie, taken, self.landmarks.factors)

    def _apply(self, decision: Decision) -> None:
        """Apply each round of a decision, and update the estimate before the next."""
        if decision.settles:
            self.landmarks.settle(self._keyframes.newest_s)
        for assignments in decision.rounds:
            self.landmarks.apply(assignments, self._keyframes.newest_s)
            self.update_if_due()
        if decision.released:
            self.landmarks.release(decision.released, self._keyframes.newest_s)

    def _follow(self, changed: Changed) -> None:
        self.landmarks.follow(changed)
        if changed.left:
            self._forget(changed.left)
            self.landmarks.forget(changed.left)

    def _forget(self, left: Set[int]) -> None:
        """Give up sightings that have waited too long, or whose keyframes have left the window."""
        for policy in (self.policy, self._nameless):
            if policy is not None and (
                given_up := policy.forget(self._keyframes.advanced_ns, left)
            ):
                self.landmarks.apply(given_up, self._keyframes.newest_s)
