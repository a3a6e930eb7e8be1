"""Landmarks of a map that was given: which of them have moved since, and which are not seen.

Every sighting of a landmark of the map is compared with its prediction, by the squared Mahalanobis distance of range and
azimuth. One beyond `CONTRADICTS` contradicts the map. It is a wrong identity, or the landmark has moved. Wrong identities
contradict here and there; a landmark that has moved is contradicted each time, and one contradiction follows the last one
soon or is like it. So a landmark is contradicted from `FEWEST` such contradictions in a row on, where all contradictions
are more than half of its sightings. As long as fewer landmarks are contradicted
than agree, it has moved. The estimator maps it again once `FEWEST` contradictions are alike: those of wrong identities show
no place. Where as many are contradicted, the start may be wrong, or those
that agree have moved: then their sightings are refused, and a message names both.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterable
from enum import Enum

import numpy as np

from sonar_graph.calibration import KnownMap
from sonar_graph.measurements import Floats
from sonar_graph.numerics import diagonal_blocks
from sonar_graph.states import LandmarkMap

CONTRADICTS = 13.8
"""Chi-square quantile of 99.9 %, two degrees of freedom."""
FEWEST = 3
"""Number of contradictions in a row from which on a landmark may have moved."""
MOVED = "moved since the map was made"
LOCATED_AGAIN = "located again in the map"
NOT_LOCATED = "not yet located in the map"
SURE_TIMES = 3
"""Times as many landmarks contradict the map as agree with it, from which on it, or the start, is wrong beyond doubt."""
SOON_NS = 5_000_000_000
"""Time between two contradictions of a landmark that wrong identities, which are spread over all landmarks, seldom make."""


class Verdict(Enum):
    """Treatment of a sighting."""

    USE = "use"
    REFUSE = "refuse"
    RELEASE = "release: the landmark has moved"


class KnownLandmarks:
    """Landmarks of the map, with the sightings that agree with it and those that contradict it."""

    gate = math.sqrt(CONTRADICTS)
    """Mahalanobis distance from which on a sighting contradicts the map."""

    def __init__(self, known: KnownMap | None, *, may_release: bool = True) -> None:
        self.map = known
        self._may_release = may_release
        self.held: set[int] = set(known.ids) if known else set()
        """Identities that still stand where the map has them."""
        self.ids = known.ids if known else ()
        self.moved: list[int] = [*known.moved] if known else []
        """Identities that do not, in the order in which this was noticed; first those that the map leaves out."""
        self.seen: set[int] = set()
        """Identities with a sighting."""
        self._agreeing: Counter[int] = Counter()
        self._contradicting: Counter[int] = Counter()
        self._last: dict[int, tuple[int, Floats]] = {}
        """Stamp and innovation of the last contradiction, by landmark."""
        self._in_a_row: Counter[int] = Counter()
        """Contradictions that follow the one before soon, or are like it, until now."""
        self._alike: Counter[int] = Counter()
        """Contradictions that are like the one before: what they show stands in one place."""
        self._elsewhere: set[int] = set()
        """Landmarks with `FEWEST` of them."""

    def judge(self, landmark_id: int, stamp_ns: int, e: Floats, S: Floats) -> Verdict:
        """Treatment of a sighting with an innovation of range and azimuth, shape (2,), and its covariance, (2, 2)."""
        if landmark_id not in self.held:
            return Verdict.USE
        self.seen.add(landmark_id)
        if e @ np.linalg.solve(S, e) <= CONTRADICTS:
            self._agreeing[landmark_id] += 1
            return Verdict.USE
        self._contradict(landmark_id, stamp_ns, e, S)
        contradicted = self._contradicted()
        is_in_one_place = self._alike[landmark_id] >= FEWEST
        is_clear = landmark_id in contradicted and self._is_outvoted(contradicted)
        if not (is_clear and is_in_one_place):
            return Verdict.REFUSE
        self.moved.append(landmark_id)
        # what has left a bounded window cannot be taken out again
        if not self._may_release:
            return Verdict.REFUSE
        self.held.discard(landmark_id)
        return Verdict.RELEASE

    def _contradict(
        self, landmark_id: int, stamp_ns: int, e: Floats, S: Floats
    ) -> None:
        """Count a contradiction."""
        self._contradicting[landmark_id] += 1
        last_ns, last_e = self._last.get(landmark_id, (stamp_ns, e))
        self._last[landmark_id] = (stamp_ns, e)
        change = e - last_e
        is_alike = change @ np.linalg.solve(2.0 * S, change) <= CONTRADICTS
        if not is_alike and stamp_ns - last_ns > SOON_NS:
            self._in_a_row[landmark_id] = 0
        self._in_a_row[landmark_id] += 1
        if self._in_a_row[landmark_id] >= FEWEST:
            self._elsewhere.add(landmark_id)
        self._alike[landmark_id] += int(is_alike)

    def _contradicted(self) -> list[int]:
        """Landmarks that the map still holds against most of their sightings."""
        return [
            i
            for i in self.ids
            if i in self.held
            and i not in self.moved
            and i in self._elsewhere
            and self._contradicting[i] > self._agreeing[i]
        ]

    def _agree(self) -> list[int]:
        """Landmarks that the map holds by most of their sightings."""
        return [
            i
            for i in self.held.difference(self.moved)
            if self._agreeing[i] > self._contradicting[i]
        ]

    def _is_outvoted(self, contradicted: list[int]) -> bool:
        """Check that fewer landmarks have moved or are contradicted than agree with the map."""
        return len(self.moved) + len(contradicted) < len(self._agree())

    def places(self) -> Floats:
        """Places of all landmarks of the map, shape (m, 3), m."""
        given = self.map.positions_m if self.map else ()
        return np.array(given, dtype=np.float64).reshape(-1, 3)

    def joint(self) -> Floats:
        """Joint covariance of all their coordinates, shape (3 m, 3 m), m²."""
        return self.map.joint() if self.map else np.empty((0, 0))

    def as_given(self) -> dict[int, tuple[Floats, Floats]]:
        """Place (3,) and covariance (3, 3) of each landmark of a fixed map that has not moved."""
        if self.map is None or not self.map.is_fixed:
            return {}
        blocks = diagonal_blocks(self.map.joint(), 3)
        rows = zip(self.ids, self.places(), blocks, strict=True)
        return {i: (place, P) for i, place, P in rows if i in self.held}

    def with_given(self, found: LandmarkMap) -> LandmarkMap:
        """An estimated map, with the landmarks of a fixed map as they were given."""
        positions = found.positions.copy()
        covariances = found.covariances.copy()
        for landmark_id, given in self.as_given().items():
            row = int(np.searchsorted(found.ids, landmark_id))
            if row < len(found) and found.ids[row] == landmark_id:
                positions[row], covariances[row] = given
        return LandmarkMap(found.ids, positions, covariances)

    def messages(self) -> list[str]:
        """A line about what moved, and one about what was not seen."""
        if self.map is None:
            return []
        lines = []
        moved = self.moved
        contradicted = self._contradicted()
        # the landmarks that agree may have been seen after the last sighting of one that has moved
        if self._is_outvoted(contradicted):
            moved = [*moved, *contradicted]
            contradicted = []
        again = [i for i in moved if i not in self.held or i in self.map.moved]
        if again:
            lines.append(
                f"{MOVED}: {named(again)}: mapped again; correct the map, or its sigmas where they are too small"
            )
        refused = sorted({*moved}.difference(again))
        if refused:
            whole = ", or give history.policy = whole to map them again"
            way_out = f"correct the map{'' if self._may_release else whole}"
            lines.append(f"{MOVED}: {named(refused)}: sightings are refused; {way_out}")
        if contradicted:
            # a few may agree by chance
            is_sure = len(contradicted) > max(1, SURE_TIMES * len(self._agree()))
            surely = " beyond doubt" if is_sure else ""
            lines.append(
                f"{named(contradicted)}: sightings contradict the map{surely}, and too few others agree with it: "
                "landmarks have moved, or the start or the map is wrong; `sonar-graph inspect LOG --map FILE` checks both"
            )
        unseen = [i for i in self.ids if i not in self.seen]
        if unseen:
            lines.append(f"of the map not seen: {named(unseen)}")
        return lines


def named(ids: Collection[int]) -> str:
    """Landmarks in a message, such as ``landmark 4`` or ``landmarks 1..9``."""
    return f"landmark{'s' * (len(ids) != 1)} {listed(ids)}"


def listed(ids: Iterable[int]) -> str:
    """Identities in a message, ascending, those that follow each other as ``1..9``."""
    parts: list[list[int]] = []
    for landmark_id in sorted(ids):
        if parts and landmark_id == parts[-1][-1] + 1:
            parts[-1].append(landmark_id)
        else:
            parts.append([landmark_id])
    texts: list[str] = []
    for part in parts:
        is_long = len(part) > 2
        texts += [f"{part[0]}..{part[-1]}"] if is_long else map(str, part)
    return ", ".join(texts)
