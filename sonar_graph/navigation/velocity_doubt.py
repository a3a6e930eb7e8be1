"""The first velocities, and the first after a long gap: not believed until others confirm them.

The gate (`sonar_graph.navigation.velocity_gate`) compares a velocity with the last that was believed. At the start
there is none, and after `LONG_NS` it lets nearly all pass. A row in doubt therefore waits. Of the rows that wait,
chains are formed in which each is within the gate of the one before it; the first chain that is long enough is believed
and the other rows are outliers. A chain needs, for a speed v of its last row::

    2 + floor((v / s)^2) rows, at most `MOST`,     s = `USUAL_SPEED_M_S`

so that one wrong row, or several that differ, never win, and a run of equal wrong ones has to be the longer the less it
looks like a vehicle: with a speed of N(0, s^2) a priori, each row more counts as one and (v / s)^2 as its surprise.
What this assumes: of the first rows, more are right than agree in being wrong. A vehicle that starts at 2 m/s is
believed at its third row, one at 10 m/s at its tenth.

The start's pose is that at the first row, which stays a node even where its velocity was wrong: it then has that of the
first row believed, with the variance of what may have changed since. Rows that wait are no nodes: until the first are
believed there is no estimate, and a gap lasts until then: of its chain the last row alone is used, since nothing that
happens before it may know of it. Stamps decide, not how a log is cut.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.navigation.partial_velocity import Rows
from sonar_graph.navigation.stamped_rows import EARLIEST_NS
from sonar_graph.navigation.velocity_gate import GATE, changed, distance_between

LONG_NS = 3_000_000_000
"""After that the gate is 1.2 m/s wide for a vehicle at rest, and six times its speed otherwise."""
USUAL_SPEED_M_S = 2.0
MOST = 10
"""Rows that are enough for any speed."""


class Waiting(NamedTuple):
    """A row in doubt, body axes."""

    stamp_ns: int
    velocity: Floats
    cov: Floats
    is_partial: bool


class Passed(NamedTuple):
    """What may go on to the gate, and what is refused."""

    rows: Rows
    outliers: list[tuple[int, float]]
    """Stamp, and squared distance from the nearest row believed."""


class VelocityDoubt:
    """Lets rows through, in their order, or makes them wait.

    Parameters
    ----------
    walk
        Root spectral density of the velocity's random walk, m/s/√s.
    """

    def __init__(self, walk: float) -> None:
        self._walk = walk
        self._last_ns: int | None = None
        self.start_known_ns = EARLIEST_NS
        """When the first velocity was confirmed."""
        self._waiting: list[Waiting] = []
        self._unused_ns: list[int] = []

    @property
    def waiting_ns(self) -> list[int]:
        """Stamps of the rows that wait, and of those that waited after a gap."""
        return [*self._unused_ns, *(row.stamp_ns for row in self._waiting)]

    def passed(self, rows: Rows, is_partial: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Passed:
        """Which rows, given and waiting, may go on."""
        if self._is_plain(rows, is_partial):
            self._last_ns = int(rows[0][-1])
            return Passed(rows, [])
        passed: list[Waiting] = []
        outliers: list[tuple[int, float]] = []
        for stamp_ns, velocity, cov, partial in zip(rows[0].tolist(), *rows[1:], is_partial.tolist(), strict=True):
            row = Waiting(stamp_ns, velocity, cov, partial)
            if not self._is_doubtful(row):
                passed.append(row)
                self._know(row)
                continue
            self._wait(row)
            chain = self._chain()
            if chain:
                passed += self._believed(chain, outliers)
        return Passed(_columns(passed), outliers)

    def _is_plain(self, rows: Rows, is_partial: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> bool:
        """Whether nothing waits and nothing will."""
        if self._waiting or self._last_ns is None or is_partial.any() or rows[0][0] <= self._last_ns:
            return False
        return rows[0][0] - self._last_ns <= LONG_NS and bool((np.diff(rows[0]) <= LONG_NS).all())

    def _is_doubtful(self, row: Waiting) -> bool:
        if self._last_ns is None:
            return bool(self._waiting) or not row.is_partial
        if row.stamp_ns <= self._last_ns:
            return False
        return bool(self._waiting) or (row.stamp_ns - self._last_ns > LONG_NS and not row.is_partial)

    def _know(self, row: Waiting) -> None:
        if not row.is_partial:
            self._last_ns = row.stamp_ns if self._last_ns is None else max(self._last_ns, row.stamp_ns)

    def _wait(self, row: Waiting) -> None:
        if all(row.stamp_ns != waiting.stamp_ns for waiting in self._waiting):
            self._waiting = sorted([*self._waiting, row], key=lambda waiting: waiting.stamp_ns)

    def _chain(self) -> list[Waiting]:
        """The first chain that is long enough; empty before there is one."""
        chains: list[list[Waiting]] = []
        for row in self._waiting:
            if row.is_partial:
                continue
            before = [chain for chain in chains if self._distance(chain[-1], row) <= GATE]
            chain = [*max(before, key=lambda one: (len(one), one[-1].stamp_ns), default=[]), row]
            if len(chain) >= needed(row.velocity):
                return chain
            chains.append(chain)
        return []

    def _believed(self, chain: list[Waiting], outliers: list[tuple[int, float]]) -> list[Waiting]:
        """All rows up to the end of the chain but those that are not of it; they become outliers."""
        stamps, end_ns = {row.stamp_ns for row in chain}, chain[-1].stamp_ns
        found: list[Waiting] = []
        for row in self._waiting:
            if row.stamp_ns > end_ns:
                break
            if row.is_partial or row.stamp_ns in stamps:
                found.append(row)
                continue
            outliers.append((row.stamp_ns, min(self._distance(row, other) for other in chain)))
            if self._last_ns is None and row.stamp_ns < chain[0].stamp_ns:
                found.append(self._replaced(row, chain[0]))
        if self._last_ns is None:
            self.start_known_ns = end_ns
        else:
            self._unused_ns += [row.stamp_ns for row in found[:-1]]
            found = found[-1:]
        self._waiting = [row for row in self._waiting if row.stamp_ns > end_ns]
        self._last_ns = end_ns
        return found

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


def _columns(rows: list[Waiting]) -> Rows:
    return (
        np.array([row.stamp_ns for row in rows], dtype=np.int64),
        np.array([row.velocity for row in rows]).reshape(-1, 3),
        np.array([row.cov for row in rows]).reshape(-1, 3, 3),
    )
