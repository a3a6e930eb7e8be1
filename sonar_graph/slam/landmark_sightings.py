"""Which sighting is of which landmark, and what of that is in the graph.

The earliest sighting of a landmark carries what is said of it once (`SightingFactors`). Whatever is
put in and taken out, and in whatever order, the factors depend only on which sightings are of which landmark: they are
those of a graph that had known from the start.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from gtsam.symbol_shorthand import L

from sonar_graph.slam.association import DetectionJournal
from sonar_graph.slam.exchange import Exchange
from sonar_graph.slam.sighting import Sighting, SightingFactors
from sonar_graph.slam.smoother import Smoother
from sonar_graph.slam.withholding import Withheld
from sonar_graph.states import Outcome


class LandmarkSightings:
    """The sightings that are in the graph, by landmark.

    Parameters
    ----------
    smoother
        Gets their factors.
    maker
        Makes them.
    """

    def __init__(self, smoother: Smoother, maker: SightingFactors) -> None:
        self.smoother = smoother
        """Whose graph has their factors."""
        self.maker = maker
        """Of their factors."""
        self._of: dict[int, dict[Sighting, None]] = defaultdict(dict)
        self._rooted: dict[int, Sighting] = {}

    @property
    def ids(self) -> set[int]:
        """Landmarks in the graph."""
        return set(self._of)

    def __contains__(self, landmark_id: object) -> bool:
        return landmark_id in self._of

    def sightings(self, landmark_id: int) -> list[Sighting]:
        """Those of a landmark."""
        return list(self._of.get(landmark_id, {}))

    def any_sighting(self, landmark_id: int) -> Sighting:
        """One of a landmark of the graph."""
        return next(iter(self._of[landmark_id]), None) or self._rooted[landmark_id]

    def is_rooted(self, landmark_id: int) -> bool:
        """Whether sightings of it have left a bounded window, so that it stays."""
        return landmark_id in self._rooted

    def sizes(self) -> dict[int, int]:
        """Number of sightings of each landmark; those that are in the graph for good count as one."""
        return {i: len(sightings) + (i in self._rooted) for i, sightings in self._of.items()}

    def stamps_ns(self, landmark_id: int) -> set[int]:
        """Frames that show a landmark."""
        return {sighting.stamp_ns for sighting in self._of.get(landmark_id, {})}

    def enter(self, sighting: Sighting, landmark_id: int, handles: Iterable[int]) -> None:
        """A sighting whose factors were given to the smoother already."""
        sighting.landmark_id, sighting.handles = landmark_id, tuple(handles)
        self._of[landmark_id][sighting] = None
        self.smoother.sightlines.add(L(landmark_id), sighting.line)

    def leave(self, pose_keys: set[int]) -> None:
        """Poses leave a bounded window: what was seen from them is part of the graph for good.

        A landmark that was seen from one of them stays, whatever becomes of its other sightings, and none of those
        becomes its first.
        """
        for landmark, sightings in self._of.items():
            gone = [sighting for sighting in sightings if sighting.line.pose_key in pose_keys]
            for sighting in gone:
                self._rooted.setdefault(landmark, sighting)
                del sightings[sighting]

    def withhold(self, withheld: Withheld, journal: DetectionJournal) -> set[int]:
        """The smoother cannot use some factors: their sightings leave the graph; handles of all factors of those."""
        gone = [
            sighting
            for landmark, sightings in self._of.items()
            for sighting in sightings
            if L(landmark) in withheld.keys or not withheld.handles.isdisjoint(sighting.handles)
        ]
        handles = {handle for sighting in gone for handle in sighting.handles}
        for sighting in gone:
            self._take(sighting)
            sighting.outcome = Outcome.WITHHELD
            if sighting.row >= 0:
                journal.amend(sighting.row, Outcome.WITHHELD)
        return handles

    def exchange(self, leaving: Iterable[Sighting], coming: Iterable[tuple[Sighting, int]], time_s: float) -> None:
        """Take sightings out of the graph, and put others in, each for a landmark, in one update of the smoother.

        Where the earliest sighting of a landmark changes, the factors of the old and of the new one are made anew. A
        landmark that loses its last sighting leaves the graph.
        """
        self.smoother.flush(time_s)  # it may solve the history, and has to know every landmark of a sightline then
        out, new = [s for s in leaving if s.landmark_id is not None], list(coming)
        touched = {s.landmark_id for s in out if s.landmark_id is not None} | {landmark for _, landmark in new}
        before = {landmark: self._first(landmark) for landmark in touched}
        removed = [handle for sighting in out for handle in sighting.handles]
        for sighting in out:
            self._take(sighting)
        for sighting, landmark in new:
            self.enter(sighting, landmark, ())
        again = self._roles_changed(before, {sighting for sighting, _ in new})
        removed += [handle for sighting in again for handle in sighting.handles]
        self._make([sighting for sighting, _ in new] + again, removed, before, time_s)

    def _first(self, landmark_id: int) -> Sighting | None:
        if landmark_id in self._rooted:
            return self._rooted[landmark_id]
        return min(self._of.get(landmark_id, {}), key=lambda s: (s.stamp_ns, s.row), default=None)

    def _take(self, sighting: Sighting) -> None:
        landmark = sighting.landmark_id
        if landmark is None:
            return
        del self._of[landmark][sighting]
        if not self._of[landmark] and landmark not in self._rooted:
            del self._of[landmark]
        self.smoother.sightlines.remove(L(landmark), sighting.line)
        sighting.landmark_id, sighting.handles = None, ()

    def _roles_changed(self, before: dict[int, Sighting | None], new: set[Sighting]) -> list[Sighting]:
        """Sightings that stay in, but no longer are, or now are, the first of their landmark."""
        changed = []
        for landmark, old in before.items():
            first = self._first(landmark)
            if first is not old:
                changed += [s for s in (old, first) if s is not None and s.landmark_id == landmark and s not in new]
        return changed

    def _make(
        self, sightings: list[Sighting], removed: list[int], before: dict[int, Sighting | None], time_s: float
    ) -> None:
        """Exchange factors for those of the sightings; landmarks begin and end with their sightings."""
        firsts = {landmark: self._first(landmark) for landmark in before}
        begun = {
            L(landmark): self.maker.place(first, self.smoother.values)
            for landmark, first in firsts.items()
            if first is not None and before[landmark] is None
        }
        lost = [L(landmark) for landmark, first in firsts.items() if first is None and before[landmark] is not None]
        made = [
            self.maker.make(s, L(s.landmark_id), is_first=s is firsts[s.landmark_id])
            for s in sightings
            if s.landmark_id is not None
        ]

        def entered(groups: list[list[int]]) -> None:
            for sighting, handles in zip(sightings, groups, strict=True):
                sighting.handles = tuple(handles)

        self.smoother.exchange(Exchange(removed, made, begun, lost), time_s, entered)
