"""Doppler velocities that no vehicle could have reached since the sample before, and rows that came too late.

A velocity v, t seconds after the last one u that was believed, both in body axes, is expected to differ by::

    S = Q_u + Q_v + (q^2 t + (w t |u|)^2) I,    q velocity walk of the calibration, w `TURNING_RAD_S` (w t at most 2)

since the velocity may change and the vehicle may turn. The squared Mahalanobis distance is gated far out, for what is
refused is lost; what passes is weighed by its noise. The gate widens while nothing is believed; with what it starts, at
first and after a long gap, `sonar_graph.navigation.dvl_screening.dvl_gate` decides. A row that leaves a direction
unmeasured is
compared, but nothing with it. The gate knows stamps and velocities alone: what it refuses does not depend on how a log
is cut.

The first velocities, and the first after a long gap: not believed until others confirm them.

The gate (`sonar_graph.navigation.dvl_screening.dvl_gate`) compares a velocity with the last that was believed. At the
start
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
from numpy.typing import NDArray

from sonar_graph.devices import is_partial
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.dvl_screening.partial_beams import Rows
from sonar_graph.navigation.samples import EARLIEST_NS, LATEST_NS, rows_until
from sonar_graph.numerics import (
    IDENTITY,
    ZERO,
    ZEROS,
    Matrix,
    Vector,
    compiled,
    cross,
    dot,
    inlined,
    matrix,
    minus,
    multiple_of,
    sum_of,
    times,
    transposed,
    vector,
)
from sonar_graph.states import Refusal, RefusedRow

Flags = NDArray[np.bool_]
TURNING_RAD_S = 0.3
GATE = 44.8
"""Chi-square quantile of 1 - 1e-9, 3 degrees of freedom."""


class VelocityVerdict(NamedTuple):
    """On n rows."""

    distance: Floats
    """Squared, of each row from the last whole one believed, shape (n,)."""
    is_partial: Flags
    """Rows that leave a direction unmeasured, shape (n,)."""
    is_outlier: Flags
    """Shape (n,)."""
    is_plain: bool
    """Whether no row is either."""


@compiled
def judge(
    stamps: Ints,
    velocity: Floats,
    cov: Floats,
    known_ns: Ints,
    known_velocity: Floats,
    known_cov: Floats,
    walk: float,
    gate: float,
) -> VelocityVerdict:
    """Compare each row with the last whole one believed.

    Parameters
    ----------
    known_ns, known_velocity, known_cov
        Rows that are believed already; the one before the first row is the first that is compared with.
    walk
        Root spectral density of the velocity's random walk, m/s/√s.
    gate
        Squared distance beyond which a row is not believed.
    """
    n = len(stamps)
    distance, partial, outlier, is_plain = np.zeros(n), is_partial(cov), np.zeros(n, np.bool_), True
    before = rows_until(known_ns, stamps[0] - 1) - 1
    last_ns, u, Q = LATEST_NS, ZERO, ZEROS
    if before >= 0:
        last_ns, u, Q = known_ns[before], vector(known_velocity[before]), matrix(known_cov[before])
    for k in range(n):
        v, Q_v = vector(velocity[k]), matrix(cov[k])
        if stamps[k] > last_ns:
            distance[k] = _squared_distance(u, Q, v, Q_v, (stamps[k] - last_ns) * 1e-9, walk)
        outlier[k] = distance[k] > gate
        if not (outlier[k] or partial[k]):
            last_ns, u, Q = stamps[k], v, Q_v
        else:
            is_plain = False
    return VelocityVerdict(distance, partial, outlier, is_plain)


@compiled
def distance_between(u: Floats, Q_u: Floats, v: Floats, Q_v: Floats, t: float, walk: float) -> float:
    """Squared distance of a velocity v from one u, t seconds apart."""
    return _squared_distance(vector(u), matrix(Q_u), vector(v), matrix(Q_v), t, walk)


def changed(velocity: Floats, t: float, walk: float) -> float:
    """Variance about each axis of what a velocity may change in t seconds, m²/s²."""
    return walk**2 * t + min(TURNING_RAD_S * t, 2.0) ** 2 * float(velocity @ velocity)


@inlined
def _squared_distance(u: Vector, Q_u: Matrix, v: Vector, Q_v: Matrix, t: float, walk: float) -> float:
    """``e^T S^-1 e``, ``e = v - u``. Columns of S^-1 are cross products of rows of S, over its determinant."""
    e = minus(v, u)
    may_change = walk**2 * t + min(TURNING_RAD_S * t, 2.0) ** 2 * dot(u, u)
    x, y, z = sum_of(sum_of(Q_u, Q_v), multiple_of(may_change, IDENTITY))
    solved = times(transposed((cross(y, z), cross(z, x), cross(x, y))), e)
    return dot(e, solved) / dot(x, cross(y, z))


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
