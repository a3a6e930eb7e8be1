"""Landmarks of the graph, their sightings, and the life of a detection: one owner, one writer.

A policy says what sightings are to become (`Assignment`); `LandmarkGraph.apply` alone changes their state, their
factors and the journal::

    not judged ──► used, new, reassigned                in the graph at the next update
               ──► waiting ──► used later, placed later, new; forgotten, no identity
               ──► gated, repeated, unfit, waiting      not in the graph
    in the graph ──► taken back, moved, reassigned, used later, unfit, withheld
    taken back ──► moved, gated, repeated
    gated, repeated, withheld ──► waiting               their track is of another landmark now
    unfit, withheld ──► used later, reassigned          their place fits now

The earliest sighting of a landmark carries what is said of it once (`SightingFactors`): whatever is put in and taken
out, in whatever order, the graph depends only on which sightings are of which landmark (docs/theory/identities.md).
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator, Set
from copy import deepcopy
from typing import NamedTuple, Protocol

from gtsam.symbol_shorthand import L

from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.slam.estimates import Solution
from sonar_graph.slam.landmarks.sighting import Screened, SeenFrame, Sighting, SightingFactors
from sonar_graph.slam.smoother import Changed, FactorGroup, Smoother
from sonar_graph.states import OUTCOME_NUMBERS, UNKNOWN, DetectionJournal, Outcome

IN_GRAPH = frozenset(
    {Outcome.USED, Outcome.NEW, Outcome.USED_LATER, Outcome.PLACED_LATER, Outcome.MOVED, Outcome.REASSIGNED}
)
"""States of a sighting whose factors are in the graph."""
FITTING = frozenset({Outcome.USED_LATER, Outcome.REASSIGNED, Outcome.UNFIT})
LATER: dict[Outcome | None, frozenset[Outcome]] = {
    None: frozenset({*IN_GRAPH, Outcome.GATED, Outcome.REPEATED, Outcome.UNFIT, Outcome.WAITING}),
    Outcome.WAITING: frozenset(
        {Outcome.USED_LATER, Outcome.PLACED_LATER, Outcome.NEW, Outcome.GATED, Outcome.REPEATED, Outcome.FORGOTTEN}
        | {Outcome.NO_IDENTITY}
    ),
    **dict.fromkeys(IN_GRAPH, FITTING | {Outcome.TAKEN_BACK, Outcome.MOVED, Outcome.WITHHELD}),
    Outcome.TAKEN_BACK: frozenset({Outcome.MOVED, Outcome.GATED, Outcome.REPEATED}),
    Outcome.GATED: frozenset({Outcome.WAITING}),
    Outcome.REPEATED: frozenset({Outcome.WAITING}),
    Outcome.WITHHELD: FITTING | {Outcome.WAITING, Outcome.TAKEN_BACK},
    Outcome.UNFIT: FITTING,
}
"""States that may follow a state; None: not judged yet. From those that are not named here nothing follows."""


class Assignment(NamedTuple):
    """Next state of a sighting."""

    sighting: Sighting
    outcome: Outcome
    landmark_id: int | None = None
    """Landmark that it becomes a sighting of, or for which it was refused; None: the journal keeps what it says."""
    innovation: Floats | None = None
    """Shape (2,); None: nothing was expected."""
    S: Floats | None = None
    """Its covariance, shape (2, 2)."""
    gain: float = 0.0
    """Expected variance over that of the noise."""
    start: Floats | None = None
    """First estimate of a landmark that begins with it, shape (3,); None: where the sighting places it."""


class IdentityPolicy(Protocol):
    """Decides of which landmarks sightings are."""

    def screen(self, frame: LandmarkDetections) -> Screened:
        """Judge rows by what is said of them alone."""

    def assign(self, frame: SeenFrame) -> Iterator[list[Assignment]]:
        """Rounds of assignments, of a frame's sightings and of earlier ones.

        Each round is applied, and the estimate brought up to date if that is due, before the next is asked for.
        """

    def forget(self, now_ns: int, left: Set[int] = frozenset()) -> list[Assignment]:
        """Give up what has waited too long, and what was seen from poses that leave a bounded window."""

    def smoothed(self) -> Solution:
        """Solution of the whole graph."""

    def rechosen(self) -> list[Assignment]:
        """Assignments of that solution that the run itself does not make."""


class AmendableJournal(DetectionJournal):
    """Journal of detections whose outcomes may change later, and whose old rows may be dropped."""

    def forget_before(self, stamp_ns: int) -> None:
        """Drop rows until the first that is not older than ``stamp_ns``; the others keep their numbers."""
        count = 0
        while count < len(self) and self._stamps_ns[count] < stamp_ns:
            count += 1
        del self._stamps_ns[:count], self._ids[:count], self._outcomes[:count]
        del self._innovations[: 2 * count], self._innovation_covs[: 4 * count]
        self._forgotten += count

    def copy(self) -> AmendableJournal:
        """Independent copy."""
        return deepcopy(self)

    def amend(
        self,
        row: int,
        outcome: Outcome,
        landmark_id: int | None = None,
        innovation: Floats | None = None,
        innovation_cov: Floats | None = None,
    ) -> None:
        """Change the outcome of a row, and its landmark unless None; innovation and covariance as in `record`.

        An earlier innovation is dropped: it was against the landmark that the detection was first taken for.
        """
        row -= self._forgotten
        if row < 0:
            return
        self._outcomes[row] = OUTCOME_NUMBERS[outcome]
        self._ids[row] = self._ids[row] if landmark_id is None else landmark_id
        e = UNKNOWN[:2] if innovation is None else innovation.tolist()
        S = UNKNOWN if innovation_cov is None else innovation_cov.ravel().tolist()
        self._innovations[2 * row : 2 * row + 2] = array("d", e)
        self._innovation_covs[4 * row : 4 * row + 4] = array("d", S)


class LandmarkGraph:
    """Sightings that are in the graph, by landmark, and the journal of all detections."""

    def __init__(self, smoother: Smoother, factors: SightingFactors, journal: AmendableJournal) -> None:
        self.smoother, self.factors, self.journal = smoother, factors, journal
        self._of: dict[int, dict[Sighting, None]] = defaultdict(dict)
        self._rooted: dict[int, Sighting] = {}

    @property
    def ids(self) -> list[int]:
        """Identities of the landmarks in the graph, ascending."""
        return sorted(self._of)

    def __contains__(self, landmark_id: object) -> bool:
        return landmark_id in self._of

    def sightings(self, landmark_id: int) -> list[Sighting]:
        """Sightings of a landmark that can be taken back."""
        return list(self._of.get(landmark_id, {}))

    def any_sighting(self, landmark_id: int) -> Sighting:
        """Any sighting of a landmark of the graph."""
        return next(iter(self._of[landmark_id]), None) or self._rooted[landmark_id]

    def is_rooted(self, landmark_id: int) -> bool:
        """True when sightings of it have left a bounded window, so that it stays."""
        return landmark_id in self._rooted

    def sizes(self) -> dict[int, int]:
        """Number of sightings of each landmark; those that are in the graph for good count as one."""
        return {i: len(sightings) + (i in self._rooted) for i, sightings in self._of.items()}

    def stamps_ns(self, landmark_id: int) -> set[int]:
        """Stamps of the frames that show a landmark."""
        return {sighting.stamp_ns for sighting in self._of.get(landmark_id, {})}

    def apply(self, assignments: Iterable[Assignment], time_s: float) -> None:
        """Change the states of sightings, and with them journal and graph.

        Factors of sightings that are judged for the first time are used at the next update, others in one update now.
        """
        prompt: list[Assignment] = []
        leaving: list[Sighting] = []
        coming: list[tuple[Sighting, int]] = []
        for each in assignments:
            sighting, outcome, landmark_id = each.sighting, each.outcome, each.landmark_id
            if outcome not in LATER.get(sighting.outcome, ()):
                raise AssertionError(f"a sighting that is {sighting.outcome!r} cannot become {outcome!r}")
            self.journal.amend(sighting.row, outcome, landmark_id, each.innovation, each.S)
            if sighting.landmark_id is not None:
                leaving.append(sighting)
            if outcome in IN_GRAPH and landmark_id is not None:
                if sighting.outcome is None:
                    prompt.append(each)
                else:
                    coming.append((sighting, landmark_id))
            sighting.outcome = outcome
        for each in prompt:
            self._add(each)
        if leaving or coming:
            self._exchange(leaving, coming, time_s)

    def rechosen(self, assignments: list[Assignment]) -> AmendableJournal:
        """Copy of the journal as other assignments would have it; nothing else changes."""
        journal = self.journal.copy() if assignments else self.journal
        for sighting, outcome, landmark_id, *_ in assignments:
            journal.amend(sighting.row, outcome, landmark_id)
        return journal

    def follow(self, changed: Changed) -> None:
        """Take out sightings that the smoother could not use, and let go of those from poses that left.

        What was seen from poses that left a bounded window is part of the graph for good: its landmark stays, whatever
        becomes of its other sightings, and none of those becomes its first.
        """
        if not (changed.withheld or changed.left):
            return  # as after most updates; what follows looks at every sighting of the run
        for sighting in [s for sightings in self._of.values() for s in sightings if s.handle in changed.withheld]:
            self._take(sighting)
            sighting.outcome = Outcome.WITHHELD
            self.journal.amend(sighting.row, Outcome.WITHHELD)
        for landmark, sightings in self._of.items():
            for sighting in [s for s in sightings if s.line.pose_key in changed.left]:
                self._rooted.setdefault(landmark, sighting)
                del sightings[sighting]

    def _add(self, new: Assignment) -> None:
        """Add a sighting, and its landmark where it is new, at the next update."""
        sighting, landmark_id = new.sighting, new.landmark_id
        assert landmark_id is not None
        is_first = landmark_id not in self
        if is_first:
            start = self.factors.place(sighting, self.smoother.estimates) if new.start is None else new.start
            self.smoother.add_landmark(L(landmark_id), start)
        made = self.factors.make(sighting, L(landmark_id), is_first=is_first)
        handle = self.smoother.add(made, (L(landmark_id), sighting.line), gain=new.gain)
        self._put(sighting, landmark_id, handle)

    def _exchange(self, leaving: list[Sighting], coming: list[tuple[Sighting, int]], time_s: float) -> None:
        """Take sightings out of the graph, and put others in, each for a landmark, in one update of the smoother.

        Where the earliest sighting of a landmark changes, the factors of the old and of the new one are made anew. A
        landmark that loses its last sighting leaves the graph.
        """
        self.follow(self.smoother.flush(time_s))
        out = [sighting for sighting in leaving if sighting.landmark_id is not None]
        touched = {s.landmark_id for s in out if s.landmark_id is not None} | {landmark for _, landmark in coming}
        before = {landmark: self._first(landmark) for landmark in touched}
        removed = [sighting.handle for sighting in out]
        for sighting in out:
            self._take(sighting)
        for sighting, landmark in coming:
            self._put(sighting, landmark, None)
        firsts = {landmark: self._first(landmark) for landmark in before}
        fresh = {sighting for sighting, _ in coming}
        again = [  # they stay in, but no longer are, or now are, the first of their landmark
            s
            for landmark, old in before.items()
            if firsts[landmark] is not old
            for s in (old, firsts[landmark])
            if s is not None and s.landmark_id == landmark and s not in fresh
        ]
        removed += [sighting.handle for sighting in again]
        begun = {
            L(landmark): self.factors.place(first, self.smoother.estimates)
            for landmark, first in firsts.items()
            if first is not None and before[landmark] is None
        }
        lost = [L(landmark) for landmark, first in firsts.items() if first is None and before[landmark] is not None]
        sightings = [sighting for sighting, _ in coming] + again
        made = [
            FactorGroup(
                self.factors.make(s, L(s.landmark_id), is_first=s is firsts[s.landmark_id]), (L(s.landmark_id), s.line)
            )
            for s in sightings
            if s.landmark_id is not None
        ]
        changed = self.smoother.exchange(
            time_s, [handle for handle in removed if handle is not None], made, begun, lost
        )
        for sighting, handle in zip(sightings, changed.added, strict=True):
            sighting.handle = handle
        self.follow(changed)

    def _first(self, landmark_id: int) -> Sighting | None:
        if landmark_id in self._rooted:
            return self._rooted[landmark_id]
        return min(self._of.get(landmark_id, {}), key=lambda s: (s.stamp_ns, s.row), default=None)

    def _put(self, sighting: Sighting, landmark_id: int, handle: int | None) -> None:
        sighting.landmark_id, sighting.handle = landmark_id, handle
        self._of[landmark_id][sighting] = None

    def _take(self, sighting: Sighting) -> None:
        landmark = sighting.landmark_id
        if landmark is None:
            return
        del self._of[landmark][sighting]
        if not self._of[landmark] and landmark not in self._rooted:
            del self._of[landmark]
        sighting.landmark_id = sighting.handle = None
