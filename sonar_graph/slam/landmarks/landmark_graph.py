"""Landmarks of the graph, the states of detections, and the decisions that change them.

A policy decides what becomes of sightings (`Decision`). `LandmarkGraph.apply` alone changes their states, their factors
and the journal::

    not judged ──► used, new, reassigned                in the graph at the next update
               ──► waiting ──► used later, placed later, new; forgotten, no identity
               ──► gated, repeated, unfit, waiting      not in the graph
    in the graph ──► retracted (TAKEN_BACK), moved, reassigned, used later, unfit, withheld
    retracted ──► moved, gated, repeated
    gated, repeated, withheld ──► waiting               their track is of another landmark now
    unfit, withheld ──► used later, reassigned          their place fits now

The earliest sighting of a landmark has the factors that a landmark has once (`SightingFactors`). Hence the graph
depends only on the present landmark of each sighting, and not on the order of changes (docs/theory/identities.md).
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterable, Sequence, Set
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.calibration import KnownMap
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.models import KnownLandmarks
from sonar_graph.slam.factors import map_prior
from sonar_graph.slam.landmarks.sighting import (
    Frame,
    SeenFrame,
    Sighting,
    SightingFactors,
)
from sonar_graph.slam.smoother import (
    Changed,
    FactorGroup,
    Known,
    Marginals,
    Sightline,
    Smoother,
)
from sonar_graph.states import (
    OUTCOME_NUMBERS,
    UNKNOWN,
    DetectionJournal,
    DetectionLog,
    Outcome,
)

IN_GRAPH = frozenset(
    {
        Outcome.USED,
        Outcome.NEW,
        Outcome.USED_LATER,
        Outcome.PLACED_LATER,
        Outcome.MOVED,
        Outcome.REASSIGNED,
    }
)
"""States of a sighting whose factors are in the graph."""
FITTING = frozenset({Outcome.USED_LATER, Outcome.REASSIGNED, Outcome.UNFIT})
GIVEN_UP = frozenset({Outcome.FORGOTTEN, Outcome.NO_IDENTITY})
LATER: dict[Outcome | None, frozenset[Outcome]] = {
    None: frozenset(
        {Outcome.USED, Outcome.NEW, Outcome.REASSIGNED, Outcome.GATED, Outcome.REPEATED}
    )
    | {Outcome.UNFIT, Outcome.WAITING},
    Outcome.WAITING: GIVEN_UP
    | {
        Outcome.USED_LATER,
        Outcome.PLACED_LATER,
        Outcome.NEW,
        Outcome.GATED,
        Outcome.REPEATED,
    },
    **dict.fromkeys(
        IN_GRAPH, FITTING | {Outcome.TAKEN_BACK, Outcome.MOVED, Outcome.WITHHELD}
    ),
    Outcome.TAKEN_BACK: frozenset({Outcome.MOVED, Outcome.GATED, Outcome.REPEATED}),
    Outcome.GATED: frozenset({Outcome.WAITING}),
    Outcome.REPEATED: frozenset({Outcome.WAITING}),
    Outcome.WITHHELD: FITTING | {Outcome.WAITING, Outcome.TAKEN_BACK},
    Outcome.UNFIT: FITTING,
}
"""States that may follow a state; None: not judged yet. A state that is not a key is final."""


class Assignment(NamedTuple):
    """Next state of a sighting."""

    sighting: Sighting
    outcome: Outcome
    landmark_id: int | None = None
    """Landmark that it becomes a sighting of, or for which it was refused; None: as before in the journal."""
    innovation: Floats | None = None
    """Shape (2,); None without a prediction."""
    S: Floats | None = None
    """Its covariance, shape (2, 2)."""
    gain: float = 0.0
    """Ratio of expected variance to noise variance: the information that the sighting adds."""
    start: Floats | None = None
    """First estimate of a landmark that begins with it, shape (3,); None: where the sighting places it."""


@dataclass(frozen=True)
class Decision:
    """What becomes of sightings: rounds of assignments, each applied before the next, with an update between them."""

    rounds: tuple[tuple[Assignment, ...], ...] = ()
    released: tuple[int, ...] = ()
    """Landmarks of the map that have moved: they leave the graph afterwards."""
    settles: bool = False
    """True: before all rounds, add what waits to the estimate and iterate it to convergence."""

    @classmethod
    def of(
        cls, assignments: Iterable[Assignment], released: Iterable[int] = ()
    ) -> Decision:
        """Decision of one round, or of none without assignments."""
        one_round = tuple(assignments)
        return cls((one_round,), tuple(released)) if one_round else UNCHANGED

    @property
    def assignments(self) -> list[Assignment]:
        """All rounds together."""
        return [each for one_round in self.rounds for each in one_round]

    @property
    def is_empty(self) -> bool:
        """True when nothing changes."""
        return not self.rounds and not self.settles


UNCHANGED = Decision()


class Solution(NamedTuple):
    """Solution of the whole graph."""

    values: Known
    marginals: Marginals
    ids: list[int]
    """Landmarks in it, ascending."""


class IdentityPolicy:
    """Decides which landmark each sighting shows.

    For each frame `Frontend` calls `retract`, `associate`, `rivals` and `judge` in this order, then `reconsider` until
    its decision is empty. It applies each decision, and updates the estimate if that is due, before the next call.
    Without detections for the policy (None) only `retract` and `associate` are called. A method that a policy does not
    define decides nothing.
    """

    def __init__(self, landmarks: LandmarkGraph) -> None:
        self.landmarks = landmarks
        self.smoother = landmarks.smoother

    def screen(self, frame: LandmarkDetections) -> list[Outcome | None]:
        """Refuse rows by their identities and tracks alone; None: the row stays."""
        raise NotImplementedError

    def retract(self, frame: Frame | None) -> Decision:  # noqa: ARG002
        """Retract earlier sightings whose identity this frame changes."""
        return UNCHANGED

    def associate(self, frame: Frame | None) -> Decision:  # noqa: ARG002
        """Associate earlier sightings whose identity this frame reveals."""
        return UNCHANGED

    def rivals(self, frame: Frame, world_T_sonar: gtsam.Pose3) -> list[int]:
        """Keys of the variables with which the frame's detections are compared."""
        raise NotImplementedError

    def judge(self, seen: SeenFrame) -> Decision:
        """Decide on the frame's detections."""
        raise NotImplementedError

    def held(self) -> dict[int, float]:
        """Keyframes to keep in the window because sightings wait on them, with the time until which (s)."""
        return {}

    def reconsider(self) -> Decision:
        """Decide on earlier sightings again, after the frame has changed the estimate."""
        return UNCHANGED

    def forget(self, now_ns: int, left: Set[int] = frozenset()) -> list[Assignment]:  # noqa: ARG002
        """Give up sightings that have waited too long, or whose keyframes leave a bounded window."""
        return []

    def smoothed(self) -> Solution:
        """Solution of the whole graph."""
        values, marginals = self.smoother.solve_history()
        return Solution(values, marginals, self.landmarks.ids)

    def rechosen(self) -> list[Assignment]:
        """Assignments of that solution that differ from those of the run."""
        return []


class AmendableJournal(DetectionJournal):
    """Journal of detections whose outcomes may change later, and whose old rows may be dropped."""

    def forget_before(self, stamp_ns: int) -> None:
        """Drop rows until the first that is not older than ``stamp_ns``; the others keep their numbers."""
        count = 0
        while count < len(self) and self._stamps_ns[count] < stamp_ns:
            count += 1
        del self._stamps_ns[:count]
        del self._ids[:count]
        del self._outcomes[:count]
        del self._innovations[: 2 * count]
        del self._innovation_covs[: 4 * count]
        self._forgotten += count

    def amend(self, changed: Assignment) -> None:
        """Change the outcome of a row, and its landmark unless None.

        The innovation is replaced too, by NaN if it is missing: the earlier one was against another landmark.
        """
        row = changed.sighting.row - self._forgotten
        if row < 0:
            return
        self._outcomes[row] = OUTCOME_NUMBERS[changed.outcome]
        if changed.landmark_id is not None:
            self._ids[row] = changed.landmark_id
        e = UNKNOWN[:2] if changed.innovation is None else changed.innovation.tolist()
        S = UNKNOWN if changed.S is None else changed.S.ravel().tolist()
        self._innovations[2 * row : 2 * row + 2] = array("d", e)
        self._innovation_covs[4 * row : 4 * row + 4] = array("d", S)


ON_MAP = Sighting(
    stamp_ns=0,
    row=-1,
    line=Sightline(-1, gtsam.Pose3(), np.zeros(2)),
    noise=np.zeros((2, 2)),
)
"""Stands for the first sighting of a landmark of the map, whose prior takes the place of its first factors."""


class State(NamedTuple):
    """What has become of a sighting so far."""

    outcome: Outcome | None = None
    """None: not judged yet."""
    landmark_id: int | None = None
    """Landmark that it shows; None where it is not in the graph."""
    handle: int | None = None
    """Handle of its factors in the smoother; None where they wait for one, or it is not in the graph."""


UNJUDGED = State()


def age(sighting: Sighting) -> tuple[int, int]:
    """Sorts sightings by time, those of a frame by their rows."""
    return sighting.stamp_ns, sighting.row


def prior_of_map(known: KnownMap) -> FactorGroup:
    """Joint prior of the landmarks of a map."""
    keys = [L(landmark_id) for landmark_id in known.ids]
    prior = map_prior(keys, np.array(known.positions_m), known.joint())
    return FactorGroup({"map prior": prior})


class LandmarkGraph:
    """Sightings with their states and landmarks, and the journal of all detections."""

    def __init__(
        self,
        smoother: Smoother,
        factors: SightingFactors,
        journal: AmendableJournal,
        known_map: KnownMap | None = None,
    ) -> None:
        self.smoother = smoother
        self.factors = factors
        self.journal = journal
        self.known = KnownLandmarks(known_map, may_release=not smoother.is_bounded)
        """Landmarks of the map that was given."""
        self._map_prior: int | None = None
        """Handle of their joint prior."""
        self._states: dict[Sighting, State] = {}
        self._rooted: dict[int, Sighting] = {}
        """Of each landmark that keeps its first factors: a sighting that has left a bounded window, or `ON_MAP`."""
        self._of: dict[int, dict[Sighting, None]] = defaultdict(dict)
        """Sightings of each landmark, in the order in which they came; those of the map need none."""
        for landmark_id in self.known.ids:
            self._of[landmark_id] = {}
            self._rooted[landmark_id] = ON_MAP

    @property
    def ids(self) -> list[int]:
        """Identities of the landmarks in the graph, ascending."""
        return sorted(self._of)

    def __contains__(self, landmark_id: object) -> bool:
        return landmark_id in self._of

    def state(self, sighting: Sighting) -> State:
        """State of a sighting, as long as it may change."""
        return self._states.get(sighting, UNJUDGED)

    def sightings(self, landmark_id: int) -> list[Sighting]:
        """Sightings of a landmark that can be retracted."""
        return list(self._of.get(landmark_id, {}))

    def any_sighting(self, landmark_id: int) -> Sighting:
        """Any sighting of a landmark of the graph."""
        return next(iter(self._of[landmark_id]), None) or self._rooted[landmark_id]

    def is_rooted(self, landmark_id: int) -> bool:
        """True when sightings of it have left a bounded window, so that it stays."""
        return landmark_id in self._rooted

    def sizes(self) -> dict[int, int]:
        """Number of sightings of each landmark; all that have left a bounded window count as one."""
        return {
            i: len(sightings) + (i in self._rooted) for i, sightings in self._of.items()
        }

    def stamps_ns(self, landmark_id: int) -> set[int]:
        """Stamps of the frames that show a landmark."""
        return {sighting.stamp_ns for sighting in self._of.get(landmark_id, {})}

    def begin(self, time_s: float) -> None:
        """Add the landmarks of the map with their joint prior, once the graph has its first keyframe."""
        if not self.known.held or self._map_prior is not None:
            return
        assert self.known.map is not None
        for landmark_id, place in zip(self.known.ids, self.known.places(), strict=True):
            self.smoother.add_landmark(L(landmark_id), place)
        self._map_prior = self.smoother.add(prior_of_map(self.known.map))
        self.follow(self.smoother.flush(time_s))

    def release(self, landmark_ids: Sequence[int], time_s: float) -> None:
        """Take landmarks that have moved out of the graph, with their sightings; the others keep their prior."""
        fitted = [each for i in landmark_ids for each in self.sightings(i)]
        self.apply([Assignment(each, Outcome.UNFIT) for each in fitted], time_s)
        for landmark_id in landmark_ids:
            del self._of[landmark_id]
            del self._rooted[landmark_id]
        assert self._map_prior is not None
        assert self.known.map is not None
        groups = []
        if self.known.held:
            moved = set(self.known.ids) - self.known.held
            groups.append(prior_of_map(self.known.map.without(moved)))
        changed = self.smoother.exchange(
            time_s, [self._map_prior], groups, lost_landmarks=[*map(L, landmark_ids)]
        )
        if changed.added:
            self._map_prior = changed.added[0]
        self.follow(changed)

    def settle(self, time_s: float) -> None:
        """Add the factors that wait to the estimate, and iterate it to convergence."""
        self.follow(self.smoother.flush(time_s))
        self.smoother.settle(time_s)

    def apply(self, assignments: Iterable[Assignment], time_s: float) -> None:
        """Change the states of sightings, and with them journal and graph.

        Factors of sightings that are judged for the first time enter at the next update. All others are exchanged now.
        """
        added: list[Assignment] = []
        retracted: list[Sighting] = []
        associated: list[tuple[Sighting, int]] = []
        for each in assignments:
            state = self.state(each.sighting)
            # a policy that breaks the table would leave factors in the graph that no state names
            if each.outcome not in LATER.get(state.outcome, ()):
                raise AssertionError(
                    f"a sighting that is {state.outcome!r} cannot become {each.outcome!r}"
                )
            self.journal.amend(each)
            if state.landmark_id is not None:
                retracted.append(each.sighting)
            if each.outcome in IN_GRAPH and each.landmark_id is not None:
                if state.outcome is None:
                    added.append(each)
                else:
                    associated.append((each.sighting, each.landmark_id))
            if each.outcome in LATER:
                self._states[each.sighting] = State(
                    each.outcome, state.landmark_id, state.handle
                )
            else:
                self._states.pop(each.sighting, None)
        # before an exchange, which enters what waits
        for each in added:
            self._add(each)
        if retracted or associated:
            self._exchange(retracted, associated, time_s)

    def log(self, rechosen: list[Assignment]) -> DetectionLog:
        """Outcomes of all detections, with other assignments for some; nothing else changes."""
        if not rechosen:
            return self.journal.log()
        journal = deepcopy(self.journal)  # the run goes on with its own
        for each in rechosen:
            journal.amend(each)
        return journal.log()

    def follow(self, changed: Changed) -> None:
        """Update states after the smoother has withheld factors, or poses have left a bounded window.

        Sightings from poses that left are part of the graph for good. Their landmark stays, whatever becomes of its
        other sightings, and none of the others becomes its first.
        """
        if not (changed.withheld or changed.left):
            return  # the usual case; the loops below visit every sighting of the run
        withheld = [
            s for s, state in self._states.items() if state.handle in changed.withheld
        ]
        for sighting in withheld:
            self._remove(sighting)
            self._states[sighting] = State(Outcome.WITHHELD)
            self.journal.amend(Assignment(sighting, Outcome.WITHHELD))
        for landmark_id, sightings in self._of.items():
            # their factors are in a marginal now and cannot be taken out
            for sighting in [s for s in sightings if s.line.pose_key in changed.left]:
                self._rooted.setdefault(landmark_id, sighting)
                del sightings[sighting]

    def forget(self, left: Set[int]) -> None:
        """Drop the states of sightings whose keyframes have left a bounded window."""
        for sighting in [s for s in self._states if s.line.pose_key in left]:
            del self._states[sighting]

    def _add(self, new: Assignment) -> None:
        """Add a sighting, and its landmark where it is new, at the next update."""
        assert new.landmark_id is not None
        key = L(new.landmark_id)
        is_first = new.landmark_id not in self
        if is_first:
            start = (
                self.factors.start(new.sighting, self.smoother.estimates)
                if new.start is None
                else new.start
            )
            self.smoother.add_landmark(key, start)
        make = partial(self.factors.make, new.sighting, key, is_first=is_first)
        group = FactorGroup(make, (key, new.sighting.line))
        handle = self.smoother.add(group, gain=new.gain)
        self._insert(new.sighting, new.landmark_id, handle)

    def _exchange(
        self,
        retracted: list[Sighting],
        associated: list[tuple[Sighting, int]],
        time_s: float,
    ) -> None:
        """Take sightings out of the graph, and put others in, each for a landmark, in one update of the smoother.

        A landmark begins with its first sighting and leaves the graph with its last.
        """
        # only factors that have entered the smoother can be taken out
        self.follow(self.smoother.flush(time_s))
        entering = dict(associated)
        leaving: list[Sighting] = []
        affected = set(entering.values())
        for sighting in retracted:
            landmark_id = self.state(sighting).landmark_id
            if landmark_id is not None:  # the flush may have withheld it
                leaving.append(sighting)
                affected.add(landmark_id)
        before = self._roles(affected)
        existed = self._of.keys() & affected
        handle_of = {sighting: self.state(sighting).handle for sighting in before}
        for sighting in leaving:
            self._remove(sighting)
        for sighting, new_id in entering.items():
            self._insert(sighting, new_id, None)
        after = self._roles(affected)
        # a sighting that becomes the first of its landmark, or no longer is, gets other factors
        remade = [
            sighting
            for sighting, role in after.items()
            if sighting not in entering and role != before[sighting]
        ]
        made: dict[Sighting, FactorGroup] = {}
        for sighting in [*entering, *remade]:
            i, is_first = after[sighting]
            group = self.factors.make(sighting, L(i), is_first=is_first)
            made[sighting] = FactorGroup(group, (L(i), sighting.line))
        begun = {
            L(i): self.factors.start(sighting, self.smoother.estimates)
            for sighting, (i, is_first) in after.items()
            if is_first and i not in existed
        }
        # a landmark without sightings would be undetermined
        lost = [L(i) for i in sorted(existed) if i not in self]
        removed = [handle_of[sighting] for sighting in [*leaving, *remade]]
        handles = [handle for handle in removed if handle is not None]
        changed = self.smoother.exchange(
            time_s, handles, list(made.values()), begun, lost
        )
        for sighting, handle in zip(made, changed.added, strict=True):
            self._states[sighting] = self._states[sighting]._replace(handle=handle)
        self.follow(changed)

    def _roles(self, landmark_ids: Set[int]) -> dict[Sighting, tuple[int, bool]]:
        """Sightings of some landmarks: its landmark, and True for the one with the factors that this has once."""
        roles = {}
        for landmark_id in sorted(landmark_ids):
            sightings = self._of.get(landmark_id, {})
            # of a rooted landmark these factors are final
            is_rooted = landmark_id in self._rooted
            first = None if is_rooted else min(sightings, key=age, default=None)
            for sighting in sightings:
                roles[sighting] = (landmark_id, sighting is first)
        return roles

    def _insert(self, sighting: Sighting, landmark_id: int, handle: int | None) -> None:
        self._states[sighting] = State(
            self.state(sighting).outcome, landmark_id, handle
        )
        self._of[landmark_id][sighting] = None
        self.known.seen.add(landmark_id)

    def _remove(self, sighting: Sighting) -> None:
        outcome, landmark_id, _ = self._states[sighting]
        if landmark_id is None:
            return
        del self._of[landmark_id][sighting]
        if not self._of[landmark_id] and landmark_id not in self._rooted:
            del self._of[landmark_id]
        self._states[sighting] = State(outcome)
