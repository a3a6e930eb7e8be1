"""Max-mixture of identities, incrementally: choices made again as the estimate moves (doubtful_identities.md).

A tracked object is all sightings of one track, or one sighting of no track. Its components are the landmarks that it
may be, and none. The chosen component has its factors in the graph, the others have none; a Gauss-Newton step of that
graph is one of the max-mixture. After every update the choices of the window are made anew until none changes. For
smoothed results the choices of the whole history are made anew too, beside the run.

When a detection comes, the state is not yet conditioned on it. It is then weighed by its predictive density, with the
innovation covariance ``S = H P H' + R``: a vehicle that has drifted must not mistake its landmarks for none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from pydantic import Field

from sonar_graph.measurements import NO_TRACK, Floats
from sonar_graph.slam.landmarks.association import IdentityPosterior, RecogniserErrors
from sonar_graph.slam.landmarks.mixture import Choices, Mixture, TrackedObject, each_once, supporters_elsewhere
from sonar_graph.slam.landmarks.mixture_history import RivalHistory
from sonar_graph.slam.landmarks.sighting import LandmarkSightings, Sighting
from sonar_graph.slam.landmarks.tracked import NS_PER_S, STILL, GatedIdentity, RobustIdentity
from sonar_graph.slam.models import PredictedView
from sonar_graph.states import DetectionJournal, DetectionLog, Outcome
from sonar_graph.tagged_sections import tagged

MOST_ROUNDS = 3
"""Times that choices are made anew after one update."""
MOST_OPEN = 200
"""Number of newest tracked objects that are chosen anew."""


class MixtureIdentity(RecogniserErrors):
    """Choose for each track, or single detection, the landmark, or none, that posterior and place make most probable.

    "max-mixture": the choice is made anew in the window as the estimate moves, and in the whole history for smoothed
    results. Assumes independent errors at the rate `wrong_id_probability`, and an estimate near the truth when it
    chooses. "gnc": smoothed results also try the solution of graduated non-convexity over the whole history, which
    needs no good estimate to begin with; assumes that most identities stated by the recogniser are right.
    """

    policy: Literal["max-mixture", "gnc"] = "max-mixture"
    longest_wait_s: float = Field(60.0, gt=0)
    """Longest time for which detections of a track wait in the window. A track that is not seen for this time ends."""


IdentityParams = Annotated[RobustIdentity | GatedIdentity | MixtureIdentity, *tagged("policy", "robust")]


class DoubtfulIdentities:
    """Keeps the graph in line with the best component of every tracked object."""

    def __init__(
        self, landmarks: LandmarkSightings, journal: DetectionJournal, params: MixtureIdentity, mixture: Mixture
    ) -> None:
        self._landmarks = landmarks
        self._smoother, self._maker = landmarks.smoother, landmarks.maker
        self._journal = journal
        self._mixture = mixture
        self._longest_wait_ns = round(params.longest_wait_s * NS_PER_S)
        self._is_graduated = params.policy == "gnc"
        self._tracks: dict[int, TrackedObject] = {}
        self._disputed: set[int] = set()
        self._chosen: ChosenHistory | None = None
        self._chosen_from: gtsam.Values | None = None
        self.watches: list[TrackedObject] = []
        """All tracked objects in the order in which they began."""

    @property
    def keys(self) -> list[int]:
        """Keys of the landmarks in the graph."""
        return [L(i) for i in sorted(self._landmarks.ids)]

    def chosen_at_first(
        self, view: PredictedView, statements: list[IdentityPosterior], tracks: list[int], z: Floats, noise: Floats
    ) -> list[int | None]:
        """Choose the landmark of each detection of a frame; that of a known track is the track's.

        Parameters
        ----------
        z, noise
            Range (m) and azimuth (rad), shape (m, 2), and their covariance, shape (m, 2, 2).
        """
        ids = sorted(self._landmarks.ids)
        points = np.array([self._smoother.values.atPoint3(L(i)) for i in ids]).reshape(-1, 3)
        expected, cov = view.expect(self.keys, points)
        scores = [
            self._mixture.at_first(statement, ids, z[row], expected, cov + noise[row])
            for row, statement in enumerate(statements)
        ]
        for row, track in enumerate(tracks):
            watch = self._tracks.get(track) if track != NO_TRACK else None
            if watch is not None and watch.landmark_id is not None:
                scores[row] = {watch.landmark_id: np.inf}
        return each_once(scores, [{0}] * len(scores))

    def enter(
        self,
        statements: list[IdentityPosterior],
        tracks: list[int],
        sightings: list[Sighting],
        chosen: list[int | None],
        time_s: float,
    ) -> None:
        """Put a frame's sightings into the graph as chosen, with what waited in their tracks.

        Tracks that are over are forgotten; keyframes on which sightings of others wait are held in the window.
        """
        late: list[tuple[Sighting, int]] = []
        for statement, track, sighting, landmark_id in zip(statements, tracks, sightings, chosen, strict=True):
            known = self._tracks.get(track) if track != NO_TRACK else None
            watch = known or TrackedObject(statement)
            watch.statement = statement
            if known is None:
                self.watches.append(watch)
                if track != NO_TRACK:
                    self._tracks[track] = watch
            waiting = [s for s in watch.sightings if s.outcome is Outcome.UNFIT] if track != NO_TRACK else []
            watch.sightings.append(sighting)
            if landmark_id != statement.favourite and statement.favourite is not None:
                self._disputed.add(statement.favourite)
            if landmark_id is None:
                sighting.outcome = Outcome.UNFIT
                continue
            is_first = landmark_id not in self._landmarks
            sighting.outcome = Outcome.NEW if is_first else _used(statement, landmark_id, Outcome.USED)
            if is_first:
                self._smoother.add_landmark(L(landmark_id), self._maker.place(sighting, self._smoother.values))
            self._landmarks.add(sighting, landmark_id, is_first=is_first)
            taken_ns = self._landmarks.stamps_ns(landmark_id)
            fresh = [s for s in waiting if s.stamp_ns not in taken_ns]
            for waited in fresh:
                waited.outcome = _used(statement, landmark_id, Outcome.USED_LATER)
            late += [(waited, landmark_id) for waited in fresh]
        if late:
            self._landmarks.exchange([], late, time_s)
        for sighting, landmark_id in late:
            self._journal.amend(sighting.row, sighting.outcome, landmark_id)
        oldest_ns = sightings[0].stamp_ns - self._longest_wait_ns
        self._tracks = {k: watch for k, watch in self._tracks.items() if watch.sightings[-1].stamp_ns >= oldest_ns}
        self._smoother.hold(
            {
                sighting.line.pose_key: (sighting.stamp_ns + self._longest_wait_ns) / NS_PER_S
                for watch in self._tracks.values()
                if watch.landmark_id is None
                for sighting in watch.sightings
                if sighting.stamp_ns >= oldest_ns
            }
        )

    def reconsider(self, time_s: float) -> None:
        """Choose anew in the window until nothing changes; move landmarks to where their sightings agree."""
        watches = self._open()
        if self._changes(watches, self._smoother.values):
            self._landmarks.follow(self._smoother.flush(time_s))
            self._smoother.settle(time_s)  # a step of a robust kernel may end far from where the choices are to be made
        for _ in range(MOST_ROUNDS):
            changes = [
                (watch, new)
                for watch, new in self._changes(watches, self._smoother.values)
                if watch.landmark_id is None or self._is_alone(watch) or self._is_preferred(new, watch)
            ]
            if not changes:
                break
            self._change(changes, time_s)
        for landmark_id in sorted(self._disputed & self._landmarks.ids):
            naming = [watch for watch in self.watches if watch.statement.favourite == landmark_id]
            present = [watch.landmark_id for watch in naming]
            found = supporters_elsewhere(landmark_id, naming, present, self._smoother.values, self._mixture)
            if found is not None:
                self._change([(w, None) for w in self.watches if w.landmark_id == landmark_id], time_s)
                self._change([(w, landmark_id) for w in found], time_s)
        self._disputed.clear()

    def history(self) -> ChosenHistory:
        """Choose anew in the whole history until nothing changes; the window's choices stay as they are."""
        values, marginals = self._smoother.solve_history()
        heard = sum(len(watch.sightings) for watch in self.watches)
        if self._chosen is None or self._chosen_from is not values or self._chosen.heard != heard:
            watches = [
                watch
                for watch in self.watches
                if watch.landmark_id is not None or all(s.outcome is not Outcome.WITHHELD for s in watch.sightings)
            ]
            present = [watch.landmark_id for watch in watches]
            handles = {s.handle for watch in watches for s in watch.sightings if s.handle is not None}
            rival = RivalHistory(self._smoother.graph_without(handles), watches, self._mixture, self._maker)
            found, choices = rival.settled(values, present, is_graduated=self._is_graduated)
            if found is not values:
                marginals = rival.marginals(found, choices)
            self._chosen_from, self._chosen = values, ChosenHistory(found, marginals, watches, choices, heard)
        return self._chosen

    def log(self) -> DetectionLog:
        """Outcome of each detection in the whole history."""
        journal, chosen = self._journal.copy(), self.history()
        for watch, new in _differing(chosen.watches, chosen.choices):
            for sighting in watch.sightings:
                journal.amend(sighting.row, *late_outcome(watch.statement, new))
        return journal.log()

    def _changes(self, watches: list[TrackedObject], values: gtsam.Values) -> list[tuple[TrackedObject, int | None]]:
        best = self._mixture.best(watches, values, [watch.landmark_id for watch in watches], self._landmarks.sizes())
        return _differing(watches, best)

    def _open(self) -> list[TrackedObject]:
        """Objects to choose anew: tracks whose statement contradicts their present choice, and objects in the window.

        An object is in the window when all its sightings are. One that alone holds a landmark keeps it.
        """
        recent = self.watches[-MOST_OPEN:]
        contradicted = [
            watch
            for watch in self._tracks.values()
            if watch.landmark_id is not None and watch.statement.favourite not in (None, watch.landmark_id)
        ]
        inside = set(self._smoother.in_window(sorted({s.line.pose_key for w in recent for s in w.sightings})))
        return contradicted + [
            watch
            for watch in recent
            if not self._is_alone(watch)
            and all(s.line.pose_key in inside for s in watch.sightings)
            and watch not in contradicted
        ]

    def _is_alone(self, watch: TrackedObject) -> bool:
        """True when no other object has sightings of its landmark."""
        return watch.landmark_id is not None and self._landmarks.sizes()[watch.landmark_id] == len(watch.sightings)

    def _is_preferred(self, new: int | None, watch: TrackedObject) -> bool:
        """True when the predictive density of the newest sighting also prefers the new component to the present one.

        While the estimate is uncertain, as when a loop closes, a large residual does not yet mean a wrong identity.
        With a robust kernel it may stay large for some updates.
        """
        sighting, values = watch.sightings[-1], self._smoother.values
        ids = [i for i in (watch.landmark_id, new) if i is not None and i in self._landmarks]
        line, keys = sighting.line, [L(i) for i in ids]
        joint = self._smoother.joint_covariance_of_any([line.pose_key, *keys])
        view = PredictedView(line.pose_key, None, values.atPose3(line.pose_key), STILL, line.body_T_sonar, joint)
        expected, cov = view.expect(keys, np.array([values.atPoint3(key) for key in keys]))
        scores = self._mixture.at_first(watch.statement, ids, line.z, expected, cov + sighting.noise)
        return scores[new] > scores[watch.landmark_id]

    def _change(self, changes: list[tuple[TrackedObject, int | None]], time_s: float) -> None:
        leaving = [s for watch, _ in changes for s in watch.sightings if s.landmark_id is not None]
        coming = [(s, new) for watch, new in changes if new is not None for s in watch.sightings]
        for watch, new in changes:
            said = watch.statement.favourite
            if said is not None and new != said:
                self._disputed.add(said)
            for sighting in watch.sightings:
                sighting.outcome, landmark_id = late_outcome(watch.statement, new)
                self._journal.amend(sighting.row, sighting.outcome, landmark_id)
        self._landmarks.exchange(leaving, coming, time_s)


@dataclass(frozen=True, eq=False)
class ChosenHistory:
    """Solution of the whole history with the choices that suit it best."""

    values: gtsam.Values
    marginals: gtsam.Marginals | gtsam.ISAM2
    watches: list[TrackedObject]
    choices: Choices
    """Choice for each tracked object."""
    heard: int
    """Number of sightings from which it was chosen."""

    @property
    def ids(self) -> set[int]:
        """Landmarks that are seen in it, by identity."""
        return {choice for choice in self.choices if choice is not None}


def late_outcome(statement: IdentityPosterior, new: int | None) -> tuple[Outcome, int | None]:
    """Outcome of detections whose landmark is chosen late, and the landmark for the journal."""
    if new is None:
        return Outcome.UNFIT, statement.favourite
    return _used(statement, new, Outcome.USED_LATER), new


def _used(statement: IdentityPosterior, landmark_id: int, as_said: Outcome) -> Outcome:
    return as_said if landmark_id == statement.favourite else Outcome.REASSIGNED


def _differing(watches: list[TrackedObject], choices: Choices) -> list[tuple[TrackedObject, int | None]]:
    return [(watch, new) for watch, new in zip(watches, choices, strict=True) if new != watch.landmark_id]
