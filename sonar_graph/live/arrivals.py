"""Steps of an estimator from messages in the order in which they arrive, without a clock.

Sensors are late by different times, so that a message may arrive after messages of other sensors that are stamped after
it. Estimates are wanted at the instants of `Sequence.instants`,

    t_k = t_0 + k T,    t_0 = max(first IMU stamp, first Doppler stamp)

The step up to t_k is complete when every sensor in use has a message stamped at or after t_k, or any sensor one stamped
at or after t_k + L, with the lateness budget L. A message stamped at or before the last complete instant is
late. It is refused by name, so that a log without the refused messages gives the same steps, to the bit.

Time of arrival has one use: a stamp that runs ahead of its time of arrival is of a clock that was set, and would make
all other sensors late. A jump of half a day is never believed: it would be millions of steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import BLOCKS, NS_PER_S, PAUSE_NS, Block, Measurements

LATE = "late: its step was complete"
REPEATED = "with the stamp of another"
AHEAD = "stamped ahead of its arrival: a clock was set?"
BEHIND = "stamped long before the others: a clock was set?"
MOTION = ("imu", "dvl")
"""Sensors without which there is no estimate."""
AHEAD_NS = NS_PER_S
"""Time by which a stamp may run ahead of its arrival, compared with the newest message before."""
NEW_CLOCK_NS = 2 * NS_PER_S
"""Time of arrival after which stamps ahead are believed, where no other was."""
FARTHEST_NS = PAUSE_NS // 2
"""Jump that is not believed: a log that pauses for a day is two."""
PADDING = {"candidate_ids": -1, "id_probability": 0.0}
"""Columns of detections that are as wide as a message has candidates, and what stands for none."""
MOST_PARTS = 256
"""Number of waiting blocks of a sensor that are made one."""


class Arrivals:
    """Messages that wait for those that may still come.

    Parameters
    ----------
    rate_hz
        Number of estimates a second.
    lateness_s
        Lateness budget L: how long a step waits, by stamps, for a sensor that is silent or slow.

    Examples
    --------
    A Doppler row that comes after an IMU row with a later stamp is not late, since its step is not complete:

    >>> import numpy as np
    >>> from sonar_graph import Dvl, Imu
    >>> def imu(at_ms):
    ...     return Imu(np.array([at_ms * 1_000_000]), np.zeros((1, 3)), np.array([[0.0, 0.0, 9.81]]))
    >>> def dvl(at_ms):
    ...     return Dvl(np.array([at_ms * 1_000_000]), np.zeros((1, 3)), np.full((1, 3, 3), np.nan))
    >>> arrivals = Arrivals(rate_hz=10.0)
    >>> for role, block in [("imu", imu(0)), ("dvl", dvl(0)), ("imu", imu(110)), ("dvl", dvl(100))]:
    ...     arrivals.add(role, int(block.stamps_ns[0]), block)
    >>> [(step.end_ns, len(step.imu), len(step.dvl)) for step in arrivals.steps()]
    [(100000000, 1, 2)]
    >>> arrivals.add("dvl", 100_000_000, dvl(100))
    'late: its step was complete'
    """

    def __init__(self, rate_hz: float, lateness_s: float = 0.25) -> None:
        if not 0 < rate_hz <= NS_PER_S:
            raise MeasurementError(f"{rate_hz} Hz is no rate; expected more than 0")
        if not 0 <= lateness_s < float("inf"):
            raise MeasurementError(
                f"a lateness budget of {lateness_s} s is none; expected 0 or more"
            )
        self.step_ns = round(NS_PER_S / rate_hz)
        self.lateness_ns = round(lateness_s * NS_PER_S)
        self.newest_ns: dict[str, int] = {}
        """Newest stamp of each sensor."""
        self.done_ns: int | None = None
        """Last complete instant."""
        self._first_ns: dict[str, int] = {}
        self._waiting: dict[str, list[Block]] = {name: [] for name in BLOCKS}
        self._stamps_ns: dict[str, set[int]] = {name: set() for name in BLOCKS}
        self._clock_ns: tuple[int, int] | None = None
        """Newest stamp, and the arrival of the last message."""

    def expect(self, stamp_ns: int, arrival_ns: int) -> None:
        """Set the usual stamp at a time of arrival, before the first message, whose own may be wrong."""
        self._clock_ns = stamp_ns, arrival_ns

    def add(
        self,
        sensor: str,
        stamp_ns: int,
        block: Block | None,
        arrival_ns: int | None = None,
    ) -> str | None:
        """Take in a message of a sensor, by its name in `Measurements`; the reason why it is refused, or None.

        ``block``: its rows, all of this stamp; None of a sonar frame in which nothing was detected, after which
        no detection up to its stamp will come.
        """
        newest_ns = stamp_ns
        # stamps and arrivals go on by the same time, unless a clock was set
        if arrival_ns is not None and self._clock_ns is not None:
            newest_ns, last_arrival_ns = self._clock_ns
            ahead_ns = stamp_ns - newest_ns
            since_ns = max(arrival_ns - last_arrival_ns, 0)
            is_ahead = ahead_ns > since_ns + AHEAD_NS and since_ns < NEW_CLOCK_NS
            if is_ahead or ahead_ns > FARTHEST_NS:
                return AHEAD
            if self.done_ns is None and ahead_ns < -FARTHEST_NS:
                return BEHIND
        if self.done_ns is not None and stamp_ns <= self.done_ns:
            return LATE
        if block is not None:
            # a sonar frame has many rows of one stamp
            if sensor != "detections" and stamp_ns in self._stamps_ns[sensor]:
                return REPEATED
            self._stamps_ns[sensor].add(stamp_ns)
            append(self._waiting[sensor], block)
            self._first_ns[sensor] = min(stamp_ns, self._first_ns.get(sensor, stamp_ns))
        self.newest_ns[sensor] = max(stamp_ns, self.newest_ns.get(sensor, stamp_ns))
        if arrival_ns is not None:
            self._clock_ns = (max(stamp_ns, newest_ns), arrival_ns)
        return None

    @property
    def start_ns(self) -> int | None:
        """Instant at which the start pose holds, once both sensors of the motion have sent."""
        has_both = all(name in self._first_ns for name in MOTION)
        return max(self._first_ns[name] for name in MOTION) if has_both else None

    def steps(self) -> Iterator[Measurements]:
        """Steps that are complete by now, in order."""
        while (end_ns := self._next_ns()) is not None:
            newest_ns = self.newest_ns.values()
            is_awaited = max(newest_ns) < end_ns + self.lateness_ns
            if is_awaited and min(newest_ns) < end_ns:
                return
            yield self._step(end_ns)

    def rest(self) -> Iterator[Measurements]:
        """Steps that are left when nothing more will come: up to the last instant with IMU and Doppler log."""
        while (end_ns := self._next_ns()) is not None:
            if min(self.newest_ns[name] for name in MOTION) < end_ns:
                return
            yield self._step(end_ns)

    def _next_ns(self) -> int | None:
        """Instant at the end of the next step; None before the start."""
        begun_ns = self.start_ns if self.done_ns is None else self.done_ns
        return None if begun_ns is None else begun_ns + self.step_ns

    def _step(self, end_ns: int) -> Measurements:
        assert self.start_ns is not None
        # the first step has what came before the start too
        after_ns = self.start_ns - PAUSE_NS if self.done_ns is None else self.done_ns
        rows: dict[str, Any] = {}
        for name, parts in self._waiting.items():
            if parts:
                block = joined(parts)
                rows[name] = block.between(after_ns, end_ns)
                left = block.between(end_ns, int(block.stamps_ns[-1]))
                parts[:] = [] if left is None else [left]
                stamps_ns = [] if left is None else left.stamps_ns.tolist()
                self._stamps_ns[name] = set(stamps_ns)
        self.done_ns = end_ns
        return Measurements(end_ns, **rows)


def append(parts: list[Any], block: Any) -> None:
    """Append a block to those of a sensor; of many blocks one is made."""
    parts.append(block)
    # joining thousands of single rows at once would delay a step
    if len(parts) > MOST_PARTS:
        parts[:] = [joined(parts)]


def joined(parts: list[Any]) -> Any:
    """One block, sorted by stamp; rows with equal stamps stay in the order of arrival."""
    if len(parts) == 1:
        return parts[0]
    stamps_ns = np.concatenate([part.stamps_ns for part in parts])
    # late messages come after newer ones
    order = np.argsort(stamps_ns, kind="stable")
    columns = {
        name: _stacked(name, [getattr(part, name) for part in parts])[order]
        for name in vars(parts[0])
    }
    return type(parts[0])(**columns)


def _stacked(name: str, columns: list[Any]) -> Any:
    """Columns one below the other; candidates padded to the most with -1 and probability 0, as in a log."""
    if name in PADDING:
        most = max(column.shape[1] for column in columns)
        filled = [np.full((len(column), most), PADDING[name]) for column in columns]
        for column, wide in zip(columns, filled, strict=True):
            wide[:, : column.shape[1]] = column
        columns = filled
    return np.concatenate(columns)
