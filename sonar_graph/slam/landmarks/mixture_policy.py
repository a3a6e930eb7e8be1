"""Max-mixture of identities: choices made again as the estimate moves (docs/theory/doubtful_identities.md).

A tracked object is all sightings of one track, or one sighting of no track. Its components are the landmarks that it
may be, and none. The chosen component has its factors in the graph, the others have none; a Gauss-Newton step of that
graph is one of the max-mixture. After every update the choices of the window are made anew until none changes. For
smoothed results the choices of the whole history are made anew too, beside the run, which they leave as it is.

When a detection comes, the state is not yet conditioned on it. It is then weighed by its predictive density, with the
innovation covariance ``S = H P H' + R``: a vehicle that has drifted must not mistake its landmarks for none.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Set
from typing import Annotated, Literal, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from pydantic import Field

from sonar_graph.measurements import NO_TRACK, LandmarkDetections
from sonar_graph.models import Kernel
from sonar_graph.slam.estimates import Solution
from sonar_graph.slam.landmarks.landmark_graph import Assignment, LandmarkGraph
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
from sonar_graph.slam.landmarks.sighting import Screened, SeenFrame, Sighting, beam_point, late_view
from sonar_graph.slam.landmarks.tracked import NS_PER_S, GatedIdentity, RobustIdentity, second_rows_of_tracks
from sonar_graph.slam.smoother import Marginals, solve_in_sight
from sonar_graph.states import Outcome
from sonar_graph.tagged_sections import tagged

MOST_WINDOW_ROUNDS, MOST_HISTORY_ROUNDS = 3, 10
"""Times that choices are made anew, after one update and for one smoothed result."""
MOST_OPEN = 200
"""Number of newest tracked objects that are chosen anew in the window."""
MOST_RIVALS = 50
"""Number of landmarks nearest to a detection among which it is weighed, beside those that it names. The cost of their
joint covariance grows with the third power of their number."""


class MixtureIdentity(RecogniserErrors):
    """Choose for each track, or single detection, the landmark, or none, that posterior and place make most probable.

    The choice is made anew in the window as the estimate moves, and in the whole history for smoothed results. Assumes
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


IdentityParams = Annotated[RobustIdentity | GatedIdentity | MixtureIdentity, *tagged("policy", "robust")]
Changes = list[tuple[TrackedObject, int | None]]
"""Tracked objects with the landmark that each is to count as; None: no landmark."""


class ChosenHistory(NamedTuple):
    """Solution of the whole history with the choices that suit it best."""

    values: gtsam.Values
    marginals: Marginals
    watches: list[TrackedObject]
    choices: Choices
    """Choice for each tracked object."""


class MixtureIdentities:
    """Policy "max-mixture": keeps the graph in line with the best component of every tracked object."""

    def __init__(self, landmarks: LandmarkGraph, params: MixtureIdentity, kernel: Kernel) -> None:
        self._landmarks, self._smoother = landmarks, landmarks.smoother
        self.mixture = Mixture(params, kernel)
        self._longest_wait_ns = round(params.longest_wait_s * NS_PER_S)
        self._tracks: dict[int, TrackedObject] = {}
        self._disputed: set[int] = set()
        self._chosen: tuple[gtsam.Values, int, ChosenHistory] | None = None
        self.watches: list[TrackedObject] = []
        """All tracked objects in the order in which they began."""

    def screen(self, frame: LandmarkDetections) -> Screened:
        """Refuse second rows of tracks."""
        return Screened(second_rows_of_tracks(frame, {}), [False] * len(frame))

    def assign(self, frame: SeenFrame) -> Iterator[list[Assignment]]:
        """The frame's sightings, with what waited in their tracks; then others as the estimate moves.

        The detection of a known track is of its landmark. Tracks that are over are forgotten; keyframes on which
        sightings of others wait are held in the window.
        """
        rows, tracks = list(range(len(frame.rows))), frame.detections.track.tolist()
        statements = [IdentityPosterior.of(frame.detections, row) for row in rows]
        ids = self._rivals(frame, statements)
        keys = [L(i) for i in ids]
        view = frame.predict(keys)
        points = np.array([self._smoother.values.atPoint3(key) for key in keys]).reshape(-1, 3)
        expected, cov = view.expect(keys, points)
        scores: list[Scores] = []
        for row, said in enumerate(statements):
            known = self._tracks.get(tracks[row])
            if known is not None and known.landmark_id is not None:
                scores.append({known.landmark_id: np.inf})
            else:
                scores.append(self.mixture.at_first(said, ids, frame.z[row], expected, cov + frame.noise[row]))
        chosen = each_once(scores, [{0}] * len(scores))
        assigned: list[Assignment] = []
        for row, sighting in enumerate(frame.sightings(view, rows)):
            assigned += self._enter(statements[row], tracks[row], sighting, chosen[row])
        yield assigned
        oldest_ns = frame.stamp_ns - self._longest_wait_ns
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
        yield from self.reconsider(frame.keyframes.newest_s)

    def _enter(
        self, said: IdentityPosterior, track: int, sighting: Sighting, chosen: int | None
    ) -> Iterator[Assignment]:
        """One sighting as chosen, and what waited in its track."""
        watch = self._tracks.get(track)
        if watch is None:
            watch = TrackedObject(said)
            self.watches.append(watch)
            if track != NO_TRACK:
                self._tracks[track] = watch
        waiting = [s for s in watch.sightings if s.outcome is Outcome.UNFIT]
        watch.statement = said
        watch.sightings.append(sighting)
        if said.favourite not in (None, chosen):
            self._disputed.add(said.favourite)
        if chosen is None:
            yield Assignment(sighting, Outcome.UNFIT, -1 if said.favourite is None else said.favourite)
            return
        at_once = Outcome.USED if chosen in self._landmarks else Outcome.NEW
        is_as_said = at_once is Outcome.NEW or chosen == said.favourite
        yield Assignment(sighting, at_once if is_as_said else Outcome.REASSIGNED, chosen)
        taken_ns = self._landmarks.stamps_ns(chosen) | {sighting.stamp_ns}
        yield from (Assignment(s, *late_outcome(said, chosen)) for s in waiting if s.stamp_ns not in taken_ns)

    def reconsider(self, now_s: float) -> Iterator[list[Assignment]]:
        """Choose anew in the window until nothing changes; move landmarks to where their sightings agree."""
        watches = self._open()
        if self._changes(watches):
            self._landmarks.follow(self._smoother.flush(now_s))
            self._smoother.settle(now_s)  # a step of a robust kernel may end far from where the choices are to be made
        for _ in range(MOST_WINDOW_ROUNDS):
            changes = [
                (watch, new)
                for watch, new in self._changes(watches)
                if watch.landmark_id is None or self._is_alone(watch) or self._is_preferred(new, watch)
            ]
            if not changes:
                break
            yield self._change(changes)
        for landmark_id in sorted(self._disputed.intersection(self._landmarks.ids)):
            naming = [watch for watch in self.watches if watch.statement.favourite == landmark_id]
            present = [watch.landmark_id for watch in naming]
            found = supporters_elsewhere(landmark_id, naming, present, self._smoother.values, self.mixture)
            if found is not None:
                yield self._change([(w, None) for w in self.watches if w.landmark_id == landmark_id])
                yield self._change([(w, landmark_id) for w in found])
        self._disputed.clear()

    def forget(self, now_ns: int, left: Set[int] = frozenset()) -> list[Assignment]:  # noqa: ARG002
        """Nothing is forgotten: it may be chosen anew in the whole history."""
        return []

    def smoothed(self) -> Solution:
        """Solution of the whole graph with the choices that suit it best."""
        chosen = self._history()
        return Solution(chosen.values, chosen.marginals, sorted({i for i in chosen.choices if i is not None}))

    def rechosen(self) -> list[Assignment]:
        """Assignments of the whole history that are not those of the window."""
        chosen = self._history()
        return _assigned(_differing(chosen.watches, chosen.choices))

    def _changes(self, watches: list[TrackedObject]) -> Changes:
        values, sizes = self._smoother.values, self._landmarks.sizes()
        return _differing(watches, self.mixture.best(watches, values, [w.landmark_id for w in watches], sizes))

    def _change(self, changes: Changes) -> list[Assignment]:
        self._disputed |= {w.statement.favourite for w, new in changes if w.statement.favourite not in (None, new)}
        return _assigned(changes)

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

    def _rivals(self, frame: SeenFrame, statements: list[IdentityPosterior]) -> list[int]:
        """Landmarks among which the detections of a frame are weighed, ascending; see `MOST_RIVALS`."""
        ids = self._landmarks.ids
        if len(ids) <= MOST_RIVALS:
            return ids
        world_T_sonar = frame.predict([]).world_T_sonar
        seen = np.array([beam_point(world_T_sonar, z)[:2] for z in frame.z])
        points = np.array([self._smoother.values.atPoint3(L(i))[:2] for i in ids])
        away_m = np.linalg.norm(points - seen[:, None], axis=2)
        near = np.argpartition(away_m, MOST_RIVALS - 1, axis=1)[:, :MOST_RIVALS]
        kept = {ids[k] for k in np.unique(near).tolist()}
        kept.update(i for statement in statements for i in statement.probability)
        kept.update(w.landmark_id for w in self._tracks.values() if w.landmark_id is not None)
        return [i for i in ids if i in kept]

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
        keys = [L(i) for i in ids]
        view = late_view(sighting, values, self._smoother.joint_covariance_of_any([sighting.line.pose_key, *keys]))
        expected, cov = view.expect(keys, np.array([values.atPoint3(key) for key in keys]))
        scores = self.mixture.at_first(watch.statement, ids, sighting.line.z, expected, cov + sighting.noise)
        return scores[new] > scores[watch.landmark_id]

    def _history(self) -> ChosenHistory:
        """Choose anew in the whole history until nothing changes."""
        solved, marginals = self._smoother.solve_history()
        heard = sum(len(watch.sightings) for watch in self.watches)
        if self._chosen is None or self._chosen[0] is not solved or self._chosen[1] != heard:
            watches = [
                watch
                for watch in self.watches
                if watch.landmark_id is not None or all(s.outcome is not Outcome.WITHHELD for s in watch.sightings)
            ]
            handles = {s.handle for watch in watches for s in watch.sightings if s.handle is not None}
            rest, values = self._smoother.graph_without(handles), solved
            choices = [watch.landmark_id for watch in watches]
            for _ in range(MOST_HISTORY_ROUNDS):
                start, better = values, self.mixture.best(watches, values, choices, _sizes(watches, choices))
                if better == choices:
                    start, better = self._relocated(watches, values, choices)
                if better == choices:
                    break
                values, choices = self._solve(rest, watches, start, better), better
            if values is not solved:
                marginals = Marginals(self._graph(rest, watches, choices), values)
            self._chosen = solved, heard, ChosenHistory(values, marginals, watches, choices)
        return self._chosen[2]

    def _relocated(
        self, watches: list[TrackedObject], values: gtsam.Values, choices: Choices
    ) -> tuple[gtsam.Values, Choices]:
        """Landmarks that began with something else begin where those that name them agree that they are."""
        moved = gtsam.Values(values)
        for landmark_id in sorted(_sizes(watches, choices)):
            rows = [row for row, watch in enumerate(watches) if watch.statement.favourite == landmark_id]
            naming, now = [watches[row] for row in rows], [choices[row] for row in rows]
            found = supporters_elsewhere(landmark_id, naming, now, values, self.mixture)
            if found is not None:
                without = [None if choice == landmark_id else choice for choice in choices]
                choices = [landmark_id if w in found else c for w, c in zip(watches, without, strict=True)]
                first = min((s for watch in found for s in watch.sightings), key=lambda s: (s.stamp_ns, s.row))
                moved.update(L(landmark_id), self._landmarks.factors.place(first, values))
        return moved, choices

    def _solve(
        self, rest: gtsam.NonlinearFactorGraph, watches: list[TrackedObject], values: gtsam.Values, choices: Choices
    ) -> gtsam.Values:
        """Solution of the history in which each tracked object is the landmark chosen for it."""
        lines, start = defaultdict(list), gtsam.Values(values)
        for watch, choice in zip(watches, choices, strict=True):
            if choice is not None:
                for sighting in watch.sightings:
                    lines[L(choice)].append(sighting.line)
                if not start.exists(L(choice)):
                    start.insert(L(choice), self._landmarks.factors.place(watch.sightings[0], values))
        return solve_in_sight(self._graph(rest, watches, choices), start, lines)

    def _graph(
        self, rest: gtsam.NonlinearFactorGraph, watches: list[TrackedObject], choices: Choices
    ) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph(rest)
        of: dict[int, list[Sighting]] = defaultdict(list)
        for watch, landmark_id in zip(watches, choices, strict=True):
            if landmark_id is not None:
                of[landmark_id] += watch.sightings
        for landmark_id, sightings in of.items():
            for k, sighting in enumerate(sorted(sightings, key=lambda sighting: (sighting.stamp_ns, sighting.row))):
                for factor in self._landmarks.factors.make(sighting, L(landmark_id), is_first=k == 0).values():
                    graph.add(factor)
        return graph


def late_outcome(statement: IdentityPosterior, new: int | None) -> tuple[Outcome, int | None]:
    """Outcome of detections whose landmark is chosen late, and the landmark for the journal."""
    if new is None:
        return Outcome.UNFIT, statement.favourite
    return Outcome.USED_LATER if new == statement.favourite else Outcome.REASSIGNED, new


def _assigned(changes: Changes) -> list[Assignment]:
    return [Assignment(s, *late_outcome(watch.statement, new)) for watch, new in changes for s in watch.sightings]


def _differing(watches: list[TrackedObject], choices: Choices) -> Changes:
    return [(watch, new) for watch, new in zip(watches, choices, strict=True) if new != watch.landmark_id]


def _sizes(watches: list[TrackedObject], choices: Choices) -> dict[int, int]:
    """Number of sightings of each chosen landmark."""
    sizes: dict[int, int] = defaultdict(int)
    for watch, choice in zip(watches, choices, strict=True):
        if choice is not None:
            sizes[choice] += len(watch.sightings)
    return sizes
