"""The first velocities, and the first after a long gap: not believed until others confirm them.

The gate (`sonar_graph.navigation.velocity_gate`) compares a velocity with the last that was believed. At the start
there is none, and long after it the gate lets nearly all pass. A row in doubt therefore waits. Of the rows that wait,
chains are formed in which each is within the gate of the one before it. A chain is believed when it has more than half
of the rows of its own stretch, and, for a speed v of its last row, at least::

    2 + floor((v / s)^2) rows, at most `MOST`,     s = `USUAL_SPEED_M_S`

The other rows up to its end are outliers. One wrong row never wins, and a run of equal wrong ones has to be the longer
the less it looks like a vehicle: with a speed of N(0, s^2) a priori, each row more counts as one and (v / s)^2 as its
surprise. Wrong rows that differ win where some that follow each other happen to be alike. What this assumes: of the
rows in doubt, more are right than agree in being wrong. A vehicle that starts at 2 m/s is believed at its third row,
one at 10 m/s at its tenth. Of more than `MOST_WAITING` rows the oldest is given up.

Long is more than `LONG_NS`, and than `LONG_INTERVALS` times the shortest of the last intervals, since the last row that
the gate believed. The start's pose is that at the first row, which stays a node even where its velocity was wrong: it
then has that of the first row believed, with the variance of what may have changed since. Rows that wait are no nodes:
until the first are believed there is no estimate, and a gap lasts until then: of its chain the last row alone is used,
since nothing that happens before it may know of it. Stamps decide, not how a log is cut.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.partial_velocity import Rows
from sonar_graph.navigation.stamped_rows import EARLIEST_NS
from sonar_graph.navigation.velocity_gate import GATE, changed, distance_between
from sonar_graph.states import Refusal, RefusedRow

LONG_NS = 3_000_000_000
"""After that the gate is 1.2 m/s wide for a vehicle at rest, and six times its speed otherwise."""
LONG_INTERVALS = 3
"""Of a slow log, the same in its own intervals."""
RECENT = 6
"""Rows whose intervals say how slow a log is."""
USUAL_SPEED_M_S = 2.0
MOST = 10
"""Rows that are enough for any speed."""
MOST_WAITING = 5 * MOST
"""Rows that wait at most."""


class Waiting(NamedTuple):
    """A row in doubt, body axes."""

    stamp_ns: int
    velocity: Floats
    cov: Floats
    is_partial: bool


class Passed(NamedTuple):
    """What may go on to the gate, and what is refused."""

    rows: Rows
    refused: list[RefusedRow]
    """Of outliers with the squared distance from the nearest row believed."""


class VelocityDoubt:
    """Lets rows through, one by one, or makes them wait.

    Parameters
    ----------
    walk
        Root spectral density of the velocity's random walk, m/s/√s.
    """

    def __init__(self, walk: float) -> None:
        self._walk = walk
        self._recent_ns: list[int] = []
        self.start_known_ns = EARLIEST_NS
        """When the first velocity was confirmed."""
        self._waiting: list[Waiting] = []

    @property
    def waiting_ns(self) -> list[int]:
        """Stamps of the rows that wait."""
        return [row.stamp_ns for row in self._waiting]

    @property
    def _last_ns(self) -> int | None:
        return self._recent_ns[-1] if self._recent_ns else None

    def is_none(self, stamps_ns: Ints, whole_ns: Ints) -> bool:
        """Whether no row of a block would be in doubt, if the gate believed some whole rows of it."""
        if self._waiting or not self._recent_ns or stamps_ns[0] <= self._recent_ns[-1]:
            return False
        if stamps_ns[-1] - self._recent_ns[-1] <= LONG_NS:
            return True
        known_ns = np.r_[self._recent_ns[-1], whole_ns]
        return bool((stamps_ns - known_ns[np.searchsorted(known_ns, stamps_ns) - 1] <= LONG_NS).all())

    def believe(self, whole_ns: Ints) -> None:
        """The gate believed whole rows."""
        if len(whole_ns):
            self._recent_ns = np.union1d(self._recent_ns, whole_ns[-RECENT:]).astype(np.int64).tolist()[-RECENT:]

    def passed(self, stamp_ns: int, velocity: Floats, cov: Floats, *, is_partial: bool) -> Passed:
        """Which rows, the one given and those that wait, may go on."""
        row = Waiting(stamp_ns, velocity, cov, is_partial)
        if not self._is_doubtful(row):
            return Passed(_columns([row]), [])
        self._wait(row)
        refused = [
            RefusedRow("dvl", old.stamp_ns, Refusal.UNCONFIRMED, np.nan) for old in self._waiting[:-MOST_WAITING]
        ]
        self._waiting = self._waiting[-MOST_WAITING:]
        chain = self._chain()
        passed = self._believed(chain, refused) if chain else []
        return Passed(_columns(passed), refused)

    def _is_doubtful(self, row: Waiting) -> bool:
        if self._last_ns is None:
            return bool(self._waiting) or not row.is_partial
        if row.stamp_ns <= self._last_ns:
            return False
        return bool(self._waiting) or (row.stamp_ns - self._last_ns > self._long_ns() and not row.is_partial)

    def _long_ns(self) -> int:
        intervals = np.diff(self._recent_ns)
        return max(LONG_NS, LONG_INTERVALS * int(intervals.min())) if len(intervals) else LONG_NS

    def _wait(self, row: Waiting) -> None:
        if all(row.stamp_ns != waiting.stamp_ns for waiting in self._waiting):
            self._waiting = sorted([*self._waiting, row], key=lambda waiting: waiting.stamp_ns)

    def _chain(self) -> list[Waiting]:
        """The first chain that is to be believed; empty before there is one."""
        whole = [row for row in self._waiting if not row.is_partial]
        chains: list[list[Waiting]] = []
        for row in whole:
            before = [chain for chain in chains if self._distance(chain[-1], row) <= GATE]
            chain = [*max(before, key=lambda one: (len(one), one[-1].stamp_ns), default=[]), row]
            for begin in range(len(chain) - needed(row.velocity) + 1):
                if _is_majority(chain[begin:], whole):
                    return chain[begin:]
            chains.append(chain)
        return []

    def _believed(self, chain: list[Waiting], refused: list[RefusedRow]) -> list[Waiting]:
        """All rows up to the end of the chain but those that are not of it, which are outliers; of a gap the last."""
        stamps, end_ns = {row.stamp_ns for row in chain}, chain[-1].stamp_ns
        found: list[Waiting] = []
        for row in self._waiting:
            if row.stamp_ns > end_ns:
                break
            if row.is_partial or row.stamp_ns in stamps:
                found.append(row)
                continue
            distance = min(self._distance(row, other) for other in chain)
            refused.append(RefusedRow("dvl", row.stamp_ns, Refusal.OUTLIER, distance))
            if self._last_ns is None and row.stamp_ns < chain[0].stamp_ns:
                found.append(self._replaced(row, chain[0]))
        self._waiting = [row for row in self._waiting if row.stamp_ns > end_ns]
        if self._last_ns is None:
            self.start_known_ns = end_ns
            return found
        refused += [RefusedRow("dvl", row.stamp_ns, Refusal.WAITED, np.nan) for row in found[:-1]]
        return found[-1:]

    def _replaced(self, row: Waiting, by: Waiting) -> Waiting:
        """The velocity of a later row at a row's stamp."""
        variance = changed(by.velocity, (by.stamp_ns - row.stamp_ns) * 1e-9, self._walk)
        return Waiting(row.stamp_ns, by.velocity, by.cov + variance * np.eye(3), False)

    def _distance(self, one: Waiting, other: Waiting) -> float:
        """Squared; turning changes no speed, so that the slower of the two says how much it can do."""
        fast, slow = sorted((one, other), key=lambda row: -float(row.velocity @ row.velocity))
        elapsed_s = abs(other.stamp_ns - one.stamp_ns) * 1e-9
        return distance_between(slow.velocity, slow.cov, fast.velocity, fast.cov, elapsed_s, self._walk)


def needed(velocity: Floats) -> int:
    """Rows of a chain that are enough for such a velocity."""
    return min(2 + int(float(velocity @ velocity) / USUAL_SPEED_M_S**2), MOST)


def _is_majority(chain: list[Waiting], whole: list[Waiting]) -> bool:
    """Whether a chain has more than half of the whole rows from its first to its last."""
    return 2 * len(chain) > sum(chain[0].stamp_ns <= row.stamp_ns <= chain[-1].stamp_ns for row in whole)


def _columns(rows: list[Waiting]) -> Rows:
    return (
        np.array([row.stamp_ns for row in rows], dtype=np.int64),
        np.array([row.velocity for row in rows]).reshape(-1, 3),
        np.array([row.cov for row in rows]).reshape(-1, 3, 3),
    )
