"""Outlier gate for Doppler velocities, and confirmation of the first velocities and those after a long gap.

Gate. A velocity v, t seconds after the last one u that was accepted, both in body axes, is expected to differ by::

    S = Q_u + Q_v + (q^2 t + (w t |u|)^2) I,    q velocity walk of the calibration, w `TURNING_RAD_S` (w t at most 2)

since the velocity may change and the vehicle may turn. The squared Mahalanobis distance is gated at `GATE`; what passes
is weighted by its noise.

Confirmation. At the start there is no velocity to compare with, and long after the last accepted one (`LONG_NS`, and
`LONG_INTERVALS` of the log's own) the gate is wide. Such a row waits. Of the waiting rows, chains are formed in which
each row is within the gate of the one before. A chain is accepted when it has more than half of the rows of its own
stretch and, for a speed v of its last row, at least::

    2 + floor((v / s)^2) rows, at most `MOST`,     s = `USUAL_SPEED_M_S`

The other rows up to its end are outliers. This assumes that more of the waiting rows are right than agree in being
wrong. The first row stays the first epoch even where its velocity was wrong: it then has that of the first accepted
row, with the variance of what may have changed since. Of a chain that ends a gap only the last row is used. Rows
more than a day apart confirm nothing. Waiting rows are no epochs. Stamps decide, not how a log is cut.
docs/theory/gaps.md.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.preintegration import covariance, rows_until
from sonar_graph.navigation.samples import (
    LATEST_NS,
    VelocityRow,
    VelocityRows,
)
from sonar_graph.numerics import (
    O3,
    ZERO,
    Mat3,
    Vec3,
    compiled,
    inlined,
    mat,
    row_of,
    vec,
)
from sonar_graph.sequence import PAUSE_NS
from sonar_graph.states import Refusal, RefusedRow

Flags = NDArray[np.bool_]
TURNING_RAD_S = 0.3
GATE = 44.8
"""Chi-square quantile of 1 - 1e-9, 3 degrees of freedom."""


class GateResult(NamedTuple):
    """Result of the gate on n rows."""

    distance: Floats
    """Squared Mahalanobis distance of each row from the last one accepted, shape (n,)."""
    is_outlier: Flags
    """Shape (n,)."""
    has_outliers: bool


def gate_velocities(
    rows: VelocityRows, known: VelocityRows, walk: float, gate: float
) -> GateResult:
    """Compare each row with the last one accepted, beginning with the known row before the first.

    ``walk`` is the root spectral density of the velocity's random walk, m/s/√s; ``gate`` the squared distance beyond
    which a row is an outlier.
    """
    n = len(rows.stamps_ns)
    distance = np.zeros(n)
    is_outlier = np.zeros(n, np.bool_)
    has_outliers = _write_gated(rows, known, walk, gate, distance, is_outlier)
    return GateResult(distance, is_outlier, has_outliers)


@compiled
def _write_gated(
    rows: VelocityRows,
    known: VelocityRows,
    walk: float,
    gate: float,
    distance: Floats,
    is_outlier: Flags,
) -> bool:
    """Fill the columns of `GateResult`; returns ``has_outliers``."""
    has_outliers = False
    last_ns = LATEST_NS
    u = ZERO
    Q_u = O3
    before = rows_until(known.stamps_ns, rows.stamps_ns[0] - 1) - 1
    if before >= 0:
        last_ns = known.stamps_ns[before]
        u = row_of(known.velocity, before)
        Q_u = covariance(known.cov, before)
    for k in range(len(rows.stamps_ns)):
        stamp_ns = rows.stamps_ns[k]
        v = row_of(rows.velocity, k)
        Q_v = covariance(rows.cov, k)
        if stamp_ns > last_ns:
            distance[k] = squared_distance(
                u, Q_u, v, Q_v, (stamp_ns - last_ns) * 1e-9, walk
            )
        is_outlier[k] = distance[k] > gate
        if is_outlier[k]:
            has_outliers = True
        else:
            last_ns = stamp_ns
            u = v
            Q_u = Q_v
    return has_outliers


@inlined
def squared_distance(
    u: Vec3, Q_u: Mat3, v: Vec3, Q_v: Mat3, t: float, walk: float
) -> float:
    """``e^T S^-1 e``, ``e = v - u``, of two velocities t seconds apart; S^-1 is the adjugate over the determinant."""
    x, y, z = v - u
    may_change = change_variance(u, t, walk)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = Q_u + Q_v
    xx += may_change
    yy += may_change
    zz += may_change
    # the adjugate [[a, b, c], [b, d, e], [c, e, f]]
    a = yy * zz - yz * yz
    b = xz * yz - xy * zz
    c = xy * yz - xz * yy
    d = xx * zz - xz * xz
    e = xy * xz - xx * yz
    f = xx * yy - xy * xy
    determinant = xx * a + xy * b + xz * c
    squares = a * x * x + d * y * y + f * z * z
    products = b * x * y + c * x * z + e * y * z
    return (squares + 2.0 * products) / determinant


@inlined
def change_variance(u: Vec3, t: float, walk: float) -> float:
    """Variance of one component of what a velocity may change in a time, ``q^2 t + (w t |u|)^2``."""
    return walk**2 * t + min(TURNING_RAD_S * t, 2.0) ** 2 * (u @ u)


LONG_NS = 3_000_000_000
"""A row after a longer time without an accepted one needs confirmation: the gate of a vehicle at rest is then 1.2 m/s
wide."""
LONG_INTERVALS = 3
"""The same for a slow log, in its own intervals."""
RECENT = 6
"""Number of rows whose intervals show how slow a log is."""
USUAL_SPEED_M_S = 2.0
MOST = 10
"""Number of rows that are enough for any speed."""
MOST_WAITING = 5 * MOST
"""Most rows that wait; beyond, the oldest is refused."""


def refusals(rows: list[VelocityRow], reason: Refusal) -> list[RefusedRow]:
    """Rows that are refused for one reason."""
    return [RefusedRow("dvl", row.stamp_ns, reason) for row in rows]


class Confirmed(NamedTuple):
    """Rows that may go on to the gate, and those that are refused."""

    rows: VelocityRows
    refused: list[RefusedRow]
    """Outliers have the squared distance from the nearest accepted row."""


class VelocityConfirmation:
    """Lets rows through one by one, or makes them wait for others that confirm them.

    ``walk``: root spectral density of the velocity's random walk, m/s/√s.
    """

    def __init__(self, walk: float) -> None:
        self._walk = walk
        self._recent_ns: list[int] = []
        self._waiting: list[VelocityRow] = []

    @property
    def unconfirmed(self) -> list[RefusedRow]:
        """The rows that wait."""
        return refusals(self._waiting, Refusal.UNCONFIRMED)

    def lets_all_pass(self, stamps_ns: Ints, accepted_ns: Ints) -> bool:
        """True where no row of a block would have to wait, given the rows of it that the gate accepts."""
        if self._waiting or not self._recent_ns or stamps_ns[0] <= self._recent_ns[-1]:
            return False
        if stamps_ns[-1] - self._recent_ns[-1] <= LONG_NS:
            return True
        known_ns = np.r_[self._recent_ns[-1], accepted_ns]
        since_ns = stamps_ns - known_ns[np.searchsorted(known_ns, stamps_ns) - 1]
        return bool((since_ns <= LONG_NS).all())

    def accept(self, accepted_ns: Ints) -> None:
        """Remember rows that the gate accepted."""
        if not len(accepted_ns):
            return
        recent = accepted_ns[-RECENT:].tolist()
        if self._recent_ns and recent[0] <= self._recent_ns[-1]:
            recent = sorted({*self._recent_ns, *recent})
        else:
            recent = self._recent_ns + recent
        self._recent_ns = recent[-RECENT:]

    def confirm(self, row: VelocityRow) -> Confirmed:
        """Add one row; return those, of it and the waiting ones, that may go on."""
        if not self._must_wait(row):
            return Confirmed(VelocityRows.of([row]), [])
        by_stamp = {old.stamp_ns: old for old in [row, *self._waiting]}
        waiting = [by_stamp[stamp_ns] for stamp_ns in sorted(by_stamp)]
        refused = refusals(waiting[:-MOST_WAITING], Refusal.UNCONFIRMED)
        waiting = waiting[-MOST_WAITING:]
        # a clock that was set meanwhile: rows before the step confirm nothing after it
        newest_ns = waiting[-1].stamp_ns
        apart = [old for old in waiting if newest_ns - old.stamp_ns > PAUSE_NS]
        refused += refusals(apart, Refusal.CLOCK)
        self._waiting = waiting[len(apart) :]
        chain = self.first_accepted_chain()
        released = self.release(chain, refused) if chain else []
        return Confirmed(VelocityRows.of(released), refused)

    def _must_wait(self, row: VelocityRow) -> bool:
        if not self._recent_ns:
            return True
        intervals = np.diff(self._recent_ns)
        long_ns = LONG_NS
        if len(intervals):
            # the gate of a slow log is wide anyway
            long_ns = max(LONG_NS, LONG_INTERVALS * int(intervals.min()))
        since_ns = row.stamp_ns - self._recent_ns[-1]
        return since_ns > 0 and (bool(self._waiting) or since_ns > long_ns)

    def first_accepted_chain(self) -> list[VelocityRow]:
        """The first chain of waiting rows that is long enough and a majority of its stretch; empty without one."""
        chains: list[list[VelocityRow]] = []
        for row in self._waiting:
            before = [
                chain for chain in chains if self._distance(chain[-1], row) <= GATE
            ]
            longest = max(
                before, key=lambda one: (len(one), one[-1].stamp_ns), default=[]
            )
            chain = [*longest, row]
            for begin in range(len(chain) - needed(row.velocity) + 1):
                part = chain[begin:]
                in_stretch = sum(
                    part[0].stamp_ns <= one.stamp_ns <= part[-1].stamp_ns
                    for one in self._waiting
                )
                if 2 * len(part) > in_stretch:
                    return part
            chains.append(chain)
        return []

    def release(
        self, chain: list[VelocityRow], refused: list[RefusedRow]
    ) -> list[VelocityRow]:
        """Stop waiting up to the end of an accepted chain; rows outside it are refused, of a gap all but the last."""
        # at the start all rows of the chain become epochs, after a gap its last one ends the gap
        stamps = {row.stamp_ns for row in chain}
        end_ns = chain[-1].stamp_ns
        is_start = not self._recent_ns
        found: list[VelocityRow] = []
        for row in self._waiting:
            if row.stamp_ns > end_ns:
                break
            if row.stamp_ns in stamps:
                found.append(row)
                continue
            distance = min(self._distance(row, other) for other in chain)
            refused.append(RefusedRow("dvl", row.stamp_ns, Refusal.OUTLIER, distance))
            if is_start and row.stamp_ns < chain[0].stamp_ns:
                found.append(self._instead(row, chain[0]))
        self._waiting = [row for row in self._waiting if row.stamp_ns > end_ns]
        if is_start:
            return found
        refused += refusals(found[:-1], Refusal.WAITED)
        return found[-1:]

    def _instead(self, wrong: VelocityRow, first: VelocityRow) -> VelocityRow:
        """The velocity of a later row at the stamp of a wrong one, with the variance of what may have changed."""
        t = (first.stamp_ns - wrong.stamp_ns) * 1e-9
        changed = change_variance(vec(first.velocity), t, self._walk)
        return VelocityRow(
            wrong.stamp_ns, first.velocity, first.cov + changed * np.eye(3)
        )

    def _distance(self, one: VelocityRow, other: VelocityRow) -> float:
        """Squared distance; the slower of the two decides how much turning can change."""
        # S depends on the speed of the earlier row: the smaller of both gives the narrower gate
        fast, slow = sorted(
            (one, other), key=lambda row: -(row.velocity @ row.velocity)
        )
        t = abs(other.stamp_ns - one.stamp_ns) * 1e-9
        u = vec(slow.velocity)
        v = vec(fast.velocity)
        distance = squared_distance(u, mat(slow.cov), v, mat(fast.cov), t, self._walk)
        return float(distance)


def needed(velocity: Floats) -> int:
    """Number of rows of a chain that are enough for a velocity."""
    return min(2 + int((velocity @ velocity) / USUAL_SPEED_M_S**2), MOST)
