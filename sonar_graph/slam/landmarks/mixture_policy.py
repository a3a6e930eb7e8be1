"""Policy "max-mixture": identities chosen again as the estimate moves (docs/theory/doubtful_identities.md).

A tracked object is all sightings of one track, or one sighting of no track. Its components are the landmarks that it
may be, and none (`mixture`). The chosen component has its factors in the graph, the others have none; a Gauss-Newton
step of that graph is one of the max-mixture. After every update the choices of the window are revised until none
changes. For smoothed results the choices of the whole history are revised too, beside the run.

When a detection comes, the state is not yet conditioned on it. It is then weighed by its predictive density, with the
innovation covariance ``S = H P H' + R``: a vehicle that has drifted must not mistake its landmarks for none.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Annotated, Literal, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from pydantic import Field

from sonar_graph.calibration import tagged
from sonar_graph.measurements import NO_TRACK, NS_PER_S, LandmarkDetections
from sonar_graph.models import Kernel, locate
from sonar_graph.slam.landmarks.landmark_graph import (
    UNCHANGED,
    Assignment,
    Decision,
    IdentityPolicy,
    LandmarkGraph,
    Solution,
    age,
)
from sonar_graph.slam.landmarks.mixture import (
    Choices,
    IdentityPosterior,
    Mixture,
    RecogniserErrors,
    Scores,
    TrackedObject,
    each_once,
    supporters_elsewhere,
)
from sonar_graph.slam.landmarks.sighting import Frame, SeenFrame, Sighting, late_view
from sonar_graph.slam.landmarks.tracked import (
    GatedIdentity,
    RobustIdentity,
    second_rows_of_tracks,
)
from sonar_graph.slam.smoother import Marginals, Sightline, solve
from sonar_graph.states import Outcome

MOST_WINDOW_ROUNDS = 3
"""Times that the choices of the window are revised after one frame."""
MOST_HISTORY_ROUNDS = 10
"""Times that the choices of the history are revised for one smoothed result."""
MOST_OPEN = 200
"""Number of newest tracked objects whose choices are revised in the window."""
MOST_RIVALS = 50
"""Number of landmarks nearest to a detection among which it is weighed, beside those that it names. The cost of their
joint covariance grows with the third power of their number."""


class MixtureIdentity(RecogniserErrors):
    """Choose for each track, or single detection, the landmark, or none, that posterior and place make most probable.

    The choice is revised in the window as the estimate moves, and in the whole history for smoothed results. Assumes
    independent errors at the rate `wrong_id_probability`, and an estimate near the truth when it chooses.

    Examples
    --------
    A fifth of the names is wrong:

    >>> from sonar_graph import run_estimator
    >>> from sonar_graph.testing import misnamed_world
    >>> world = misnamed_world()
    >>> result = run_estimator(world, "isam2", {"identity.policy": "max-mixture", "identity.wrong_id_probability": 0.2})
    >>> result.landmarks.ids
    array([ 4,  9, 11])
    """

    policy: Literal["max-mixture"] = "max-mixture"
    longest_wait_s: float = Field(60.0, gt=0)
    """Longest time for which detections of a track wait in the window. A track that is not seen for this time ends."""


IdentityParams = Annotated[
    RobustIdentity | GatedIdentity | MixtureIdentity, *tagged("policy", "robust")
]
Changes = list[tuple[TrackedObject, int | None]]
"""Tracked objects with the landmark that each is to count as; None: no landmark."""


class ChosenHistory(NamedTuple):
    """Solution of the whole history with the choices that suit it best."""

    values: gtsam.Values
    marginals: Marginals
    objects: list[TrackedObject]
    choices: Choices
    """Choice for each tracked object."""


class MixtureIdentities(IdentityPolicy):
    """Keeps the graph in line with the best component of every tracked object."""

    def __init__(
        self, landmarks: LandmarkGraph, params: MixtureIdentity, kernel: Kernel
    ) -> None:
        super().__init__(landmarks)
        self.mixture = Mixture(params, kernel)
        self.objects: list[TrackedObject] = []
        """All tracked objects in the order in which they began."""
        self._longest_wait_ns = round(params.longest_wait_s * NS_PER_S)
        self._tracks: dict[int, TrackedObject] = {}
        self._disputed: set[int] = set()
        """Landmarks that an object names and is not taken for."""
        self._oldest_ns = 0
        """Stamp from which on sightings wait."""
        self._round = 0
        """Number of revisions of the window since the last frame, one of them to settle the estimate."""
        self._open: list[TrackedObject] = []
        """Objects whose choices `reconsider` revises."""
        self._chosen: tuple[gtsam.Values, int, ChosenHistory] | None = None
        """Solution from which the history was chosen, number of sightings then, and the history."""

    def screen(self, frame: LandmarkDetections) -> list[Outcome | None]:
        """Refuse second rows of tracks."""
        return second_rows_of_tracks(frame, {})

    def rivals(self, frame: Frame, world_T_sonar: gtsam.Pose3) -> list[int]:
        """Landmarks of the graph, of a large map those near a detection or named; see `MOST_RIVALS`."""
        ids = self.landmarks.ids
        if len(ids) > MOST_RIVALS:
            seen = np.array(
                [locate(world_T_sonar, r, a, 0.0)[:2] for r, a in frame.z.tolist()]
            )
            points = np.array([self.smoother.estimates.atPoint3(L(i))[:2] for i in ids])
            # horizontal: the elevation of a detection is not known
            distance_m = np.linalg.norm(points - seen[:, None], axis=2)  # (m, K)
            nearest = np.argpartition(distance_m, MOST_RIVALS - 1, axis=1)[
                :, :MOST_RIVALS
            ]
            kept: set[int | None] = {ids[k] for k in np.unique(nearest).tolist()}
            kept.update(
                *(
                    IdentityPosterior.of(frame.detections, row).probability
                    for row in range(len(frame))
                )
            )
            kept.update(map(self.landmark_of, self._tracks.values()))
            ids = [i for i in ids if i in kept]
        return [L(i) for i in ids]

    def judge(self, seen: SeenFrame) -> Decision:
        """Choose a landmark for each detection, and for what waited in its track.

        The detection of a known track is of its landmark. Tracks that are over are forgotten.
        """
        frame = seen.frame
        rows = list(range(len(frame)))
        tracks = frame.detections.track.tolist()
        posteriors = [IdentityPosterior.of(frame.detections, row) for row in rows]
        ids = [gtsam.Symbol(key).index() for key in seen.keys]
        points = np.array(
            [self.smoother.estimates.atPoint3(key) for key in seen.keys]
        ).reshape(-1, 3)
        expected, S_0 = seen.view.expect(seen.keys, points)
        # all components of each detection, before the state is conditioned on it
        scores: list[Scores] = []
        for row in rows:
            known = self._tracks.get(tracks[row])
            landmark_id = None if known is None else self.landmark_of(known)
            if landmark_id is not None:  # a track is of one landmark
                scores.append({landmark_id: np.inf})
            else:
                S = S_0 + frame.noise[row]
                scores.append(
                    self.mixture.at_first(
                        posteriors[row], ids, frame.z[row], expected, S
                    )
                )
        chosen = each_once(scores, [{frame.stamp_ns}] * len(frame))
        judged: list[Assignment] = []
        for row, sighting in enumerate(seen.sightings(rows, seen.beam_points(rows))):
            each = self._tracked(tracks[row], posteriors[row])
            judged += self._extended(each, sighting, chosen[row])
        # the recogniser may use the number of a track that is over for another object
        self._oldest_ns = frame.stamp_ns - self._longest_wait_ns
        self._tracks = {
            k: each
            for k, each in self._tracks.items()
            if each.sightings[-1].stamp_ns >= self._oldest_ns
        }
        self._round = 0
        return Decision.of(judged)

    def held(self) -> dict[int, float]:
        """Keyframes of sightings of tracks that are of no landmark yet."""
        return {
            sighting.line.pose_key: (sighting.stamp_ns + self._longest_wait_ns)
            / NS_PER_S
            for each in self._tracks.values()
            if self.landmark_of(each) is None
            for sighting in each.sightings
            if sighting.stamp_ns >= self._oldest_ns
        }

    def reconsider(self) -> Decision:
        """Revise the choices of the window until none changes; then move landmarks to where their sightings agree."""
        # places last: a landmark moves only when no choice changes any more
        revised = self._revise_window()
        return self._relocate() if revised.is_empty else revised

    def smoothed(self) -> Solution:
        """Solution of the whole graph with the choices that suit it best."""
        chosen = self.history()
        return Solution(
            chosen.values,
            chosen.marginals,
            sorted({i for i in chosen.choices if i is not None}),
        )

    def rechosen(self) -> list[Assignment]:
        """Assignments of the whole history that differ from those of the window."""
        chosen = self.history()
        return _assigned(self._differing(chosen.objects, chosen.choices))

    def landmark_of(self, each: TrackedObject) -> int | None:
        """Landmark that a tracked object counts as; None: no landmark."""
        for sighting in each.sightings:
            landmark_id = self.landmarks.state(sighting).landmark_id
            if landmark_id is not None:
                return landmark_id
        return None

    def _tracked(self, track: int, posterior: IdentityPosterior) -> TrackedObject:
        """Object of a track, or a new one, with its newest posterior."""
        each = self._tracks.get(track)
        if each is None:
            each = TrackedObject(posterior)
            self.objects.append(each)
            if track != NO_TRACK:
                self._tracks[track] = each
        each.posterior = posterior
        return each

    def _extended(
        self, each: TrackedObject, sighting: Sighting, chosen: int | None
    ) -> list[Assignment]:
        """Extend a tracked object by a sighting as chosen; what waited in its track follows."""
        waiting = [
            s
            for s in each.sightings
            if self.landmarks.state(s).outcome is Outcome.UNFIT
        ]
        each.sightings.append(sighting)
        favourite = each.posterior.favourite
        self._dispute([(each, chosen)])
        if chosen is None:
            return [
                Assignment(
                    sighting, Outcome.UNFIT, -1 if favourite is None else favourite
                )
            ]
        outcome = Outcome.USED if chosen == favourite else Outcome.REASSIGNED
        if chosen not in self.landmarks:
            outcome = Outcome.NEW
        # a landmark is once in a frame
        taken_ns = self.landmarks.stamps_ns(chosen) | {sighting.stamp_ns}
        free = [s for s in waiting if s.stamp_ns not in taken_ns]
        return [
            Assignment(sighting, outcome, chosen),
            *(_late(s, each, chosen) for s in free),
        ]

    def _dispute(self, changes: Changes) -> None:
        """Note the landmarks that objects name and are not taken for."""
        for each, new in changes:
            favourite = each.posterior.favourite
            if favourite is not None and favourite != new:
                self._disputed.add(favourite)

    def _changes(self, objects: list[TrackedObject]) -> Changes:
        """Best components that differ from the present choices."""
        choices = [self.landmark_of(each) for each in objects]
        best = self.mixture.best(
            objects, self.smoother.estimates, choices, self.landmarks.sizes()
        )
        return self._differing(objects, best)

    def _differing(self, objects: list[TrackedObject], choices: Choices) -> Changes:
        return [
            (each, new)
            for each, new in zip(objects, choices, strict=True)
            if new != self.landmark_of(each)
        ]

    def _revise_window(self) -> Decision:
        """Next choices in the window; empty when none changes, and after `MOST_WINDOW_ROUNDS`."""
        self._round += 1
        if (
            self._round == 1
        ):  # the window is read once a frame; later rounds revise the same objects
            self._open = self._revisable()
        if self._round > 1 + MOST_WINDOW_ROUNDS:
            self._open = []
        changes = self._changes(self._open)
        if changes and self._round == 1:
            # a step of a robust kernel may end far from the minimum at which the choices are to be revised
            return Decision(settles=True)
        preferred = [
            (each, new) for each, new in changes if self._is_preferred(new, each)
        ]
        if not preferred:
            self._open = []
        self._dispute(preferred)
        return Decision.of(_assigned(preferred))

    def _relocate(self) -> Decision:
        """Begin the next disputed landmark again where the objects that name it agree that it is."""
        while self._disputed:
            # the order must not depend on how the set was filled
            landmark_id = min(self._disputed)
            self._disputed.discard(landmark_id)
            if landmark_id not in self.landmarks:
                continue
            choices = [self.landmark_of(each) for each in self.objects]
            values = self.smoother.estimates
            supporters = supporters_elsewhere(
                landmark_id, self.objects, choices, values, self.mixture
            )
            if supporters is not None:
                leaving = _assigned(
                    [
                        (each, None)
                        for each, choice in zip(self.objects, choices, strict=True)
                        if choice == landmark_id
                    ]
                )
                coming = _assigned([(each, landmark_id) for each in supporters])
                # in two rounds: a landmark begins in a new place only after it has lost its last sighting
                return Decision((tuple(leaving), tuple(coming)))
        return UNCHANGED

    def _revisable(self) -> list[TrackedObject]:
        """Objects whose choices are revised: tracks whose posterior contradicts it, and objects in the window.

        An object is in the window when all its sightings are. One that alone holds a landmark keeps it.
        """
        contradicted = [
            each
            for each in self._tracks.values()
            if self.landmark_of(each) is not None
            and each.posterior.favourite is not None
            and each.posterior.favourite != self.landmark_of(each)
        ]
        recent = self.objects[-MOST_OPEN:]
        inside = set(
            self.smoother.in_window(
                sorted({s.line.pose_key for each in recent for s in each.sightings})
            )
        )
        return contradicted + [
            each
            for each in recent
            if each not in contradicted
            and not self._is_alone(each)
            and all(s.line.pose_key in inside for s in each.sightings)
        ]

    def _is_alone(self, each: TrackedObject) -> bool:
        """True when no other object has sightings of its landmark."""
        landmark_id = self.landmark_of(each)
        return landmark_id is not None and self.landmarks.sizes()[landmark_id] == len(
            each.sightings
        )

    def _is_preferred(self, new: int | None, each: TrackedObject) -> bool:
        """True when the predictive density of the newest sighting also prefers the new component to the present one.

        While the estimate is uncertain, as when a loop closes, a large residual does not yet mean a wrong identity.
        With a robust kernel it may stay large for some updates. An object of no landmark, or one that alone holds its
        landmark, may always change.
        """
        old = self.landmark_of(each)
        if old is None or self._is_alone(each):
            return True
        sighting = each.sightings[-1]
        values = self.smoother.estimates
        ids = [i for i in (old, new) if i is not None and i in self.landmarks]
        keys = [L(i) for i in ids]
        view = late_view(
            sighting,
            values,
            self.smoother.joint_covariance_of_any([sighting.line.pose_key, *keys]),
        )
        expected, S_0 = view.expect(
            keys, np.array([values.atPoint3(key) for key in keys])
        )
        scores = self.mixture.at_first(
            each.posterior, ids, sighting.line.z, expected, S_0 + sighting.noise
        )
        return scores[new] > scores[old]

    def history(self) -> ChosenHistory:
        """Revise the choices of the whole history until none changes. The run's own choices stay."""
        solved, marginals = self.smoother.solve_history()
        # the solution of an unchanged graph is the same object; sightings of no landmark do not change it
        count = sum(len(each.sightings) for each in self.objects)
        if (
            self._chosen is None
            or self._chosen[0] is not solved
            or self._chosen[1] != count
        ):
            self._chosen = (solved, count, self._choose_history(solved, marginals))
        return self._chosen[2]

    def _choose_history(
        self, solved: gtsam.Values, marginals: Marginals
    ) -> ChosenHistory:
        # what left a variable undetermined in the run would do so here
        objects = [each for each in self.objects if not self._is_withheld(each)]
        handles = {
            self.landmarks.state(sighting).handle
            for each in objects
            for sighting in each.sightings
        }
        rest = self.smoother.graph_without(
            {handle for handle in handles if handle is not None}
        )
        values = solved
        choices = [self.landmark_of(each) for each in objects]
        for _ in range(MOST_HISTORY_ROUNDS):
            # first the choices at the solution; when they are stable, the places of landmarks
            start = values
            better = self.mixture.best(
                objects, values, choices, _sizes(objects, choices)
            )
            if better == choices:
                start, better = self._relocated(objects, values, choices)
            if better == choices:
                break
            values = self.solution(rest, objects, start, better)
            choices = better
        if values is not solved:  # else those of the run's own graph hold
            marginals = Marginals(self.graph(rest, objects, choices), values)
        return ChosenHistory(values, marginals, objects, choices)

    def _is_withheld(self, each: TrackedObject) -> bool:
        """True when a sighting of an object of no landmark could not be used."""
        outcomes = [
            self.landmarks.state(sighting).outcome for sighting in each.sightings
        ]
        return self.landmark_of(each) is None and Outcome.WITHHELD in outcomes

    def _relocated(
        self, objects: list[TrackedObject], values: gtsam.Values, choices: Choices
    ) -> tuple[gtsam.Values, Choices]:
        """Begin landmarks that began with something else where those that name them agree that they are."""
        moved = gtsam.Values(values)
        for landmark_id in sorted(_sizes(objects, choices)):
            supporters = supporters_elsewhere(
                landmark_id, objects, choices, values, self.mixture
            )
            if supporters is None:
                continue
            without = [None if choice == landmark_id else choice for choice in choices]
            choices = [
                landmark_id if each in supporters else choice
                for each, choice in zip(objects, without, strict=True)
            ]
            first = min((s for each in supporters for s in each.sightings), key=age)
            moved.update(L(landmark_id), self.landmarks.factors.start(first, values))
        return moved, choices

    def solution(
        self,
        rest: gtsam.NonlinearFactorGraph,
        objects: list[TrackedObject],
        values: gtsam.Values,
        choices: Choices,
    ) -> gtsam.Values:
        """Solution of the history in which each tracked object is the landmark chosen for it."""
        start = gtsam.Values(values)
        lines: dict[int, list[Sightline]] = {}
        for landmark_id, sightings in _by_choice(objects, choices).items():
            key = L(landmark_id)
            lines[key] = [sighting.line for sighting in sightings]
            # a landmark that the run does not have begins where its first object has it
            if not start.exists(key):
                start.insert(key, self.landmarks.factors.start(sightings[0], values))
        return solve(self.graph(rest, objects, choices), start, lines)

    def graph(
        self,
        rest: gtsam.NonlinearFactorGraph,
        objects: list[TrackedObject],
        choices: Choices,
    ) -> gtsam.NonlinearFactorGraph:
        """All factors, those of sightings as chosen."""
        graph = gtsam.NonlinearFactorGraph(rest)
        for landmark_id, sightings in _by_choice(objects, choices).items():
            # as in `LandmarkGraph`, the earliest has the factors that a landmark has once
            for k, sighting in enumerate(sorted(sightings, key=age)):
                for factor in self.landmarks.factors.make(
                    sighting, L(landmark_id), is_first=k == 0
                ).values():
                    graph.add(factor)
        return graph


def _late(sighting: Sighting, each: TrackedObject, new: int | None) -> Assignment:
    """Assignment of a sighting of an object whose landmark is chosen late."""
    favourite = each.posterior.favourite
    if new is None:
        return Assignment(sighting, Outcome.UNFIT, favourite)
    return Assignment(
        sighting, Outcome.USED_LATER if new == favourite else Outcome.REASSIGNED, new
    )


def _assigned(changes: Changes) -> list[Assignment]:
    return [
        _late(sighting, each, new)
        for each, new in changes
        for sighting in each.sightings
    ]


def _sizes(objects: list[TrackedObject], choices: Choices) -> dict[int, int]:
    """Number of sightings of each chosen landmark."""
    return {i: len(shown) for i, shown in _by_choice(objects, choices).items()}


def _by_choice(
    objects: list[TrackedObject], choices: Choices
) -> dict[int, list[Sighting]]:
    """Sightings of each chosen landmark."""
    sightings: dict[int, list[Sighting]] = defaultdict(list)
    for each, choice in zip(objects, choices, strict=True):
        if choice is not None:
            sightings[choice] += each.sightings
    return sightings
