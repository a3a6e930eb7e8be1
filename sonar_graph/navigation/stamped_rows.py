"""Rows of a sensor as they are kept: in the order of their stamps, whatever the order in which they came."""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import compiled

EARLIEST_NS, LATEST_NS = np.iinfo(np.int64).min, np.iinfo(np.int64).max
WINDOW_NS = 5_000_000_000
"""Rows kept before a node, where gravity is found should bottom lock be lost there: enough for 1 mm/s² with samples of
5 mm/s at 7 Hz, short enough for an accelerometer's bias not to have turned."""


class StampedRows:
    """Each stamp once, with two values.

    Parameters
    ----------
    shapes
        Of either value's rows.
    """

    def __init__(self, *shapes: tuple[int, ...]) -> None:
        self.stamps_ns: Ints = np.empty(0, np.int64)
        one, other = shapes
        self.values: tuple[Floats, Floats] = np.empty((0, *one)), np.empty((0, *other))

    def insert(self, stamps_ns: Ints, one: Floats, other: Floats) -> bool:
        """Place rows by their stamps; of equal stamps the first counts.

        Parameters
        ----------
        stamps_ns
            At least one, increasing.

        Returns
        -------
        Whether the first comes before a row that was there already, or is one.
        """
        comes_after = not len(self.stamps_ns) or bool(stamps_ns[0] > self.stamps_ns[-1])
        self.stamps_ns = np.concatenate([self.stamps_ns, stamps_ns])
        self.values = np.concatenate([self.values[0], one]), np.concatenate([self.values[1], other])
        if not comes_after:
            self._keep(np.unique(self.stamps_ns, return_index=True)[1])
        return not comes_after

    def forget_before(self, stamp_ns: int, more: int = 0) -> None:
        """Drop rows that are needed for no value from a stamp on, but for some more before it."""
        self._keep(slice(max(int(np.searchsorted(self.stamps_ns, stamp_ns)) - 1 - more, 0), None))

    def _keep(self, rows: slice | Ints) -> None:
        self.stamps_ns = self.stamps_ns[rows]
        self.values = self.values[0][rows], self.values[1][rows]


@compiled
def node_range(imu_ns: Ints, dvl_ns: Ints, after_ns: int, until_ns: int) -> tuple[int, int]:
    """Rows of the DVL that are nodes after one instant and reached at another: first, and one past the last."""
    seen = np.searchsorted(imu_ns, until_ns, side="right")
    if seen == 0:
        return 0, 0
    covered_ns = min(until_ns, imu_ns[seen - 1])
    first = np.searchsorted(dvl_ns, after_ns, side="right")
    return int(first), max(int(first), int(np.searchsorted(dvl_ns, covered_ns, side="right")))


@compiled
def rows_before_gaps(stamps: Ints, start_ns: int, end_ns: int, longest_ns: int) -> Ints:
    """Rows from one stamp to another whose next one comes more than so long after."""
    first, last = np.searchsorted(stamps, start_ns), np.searchsorted(stamps, end_ns)
    return np.flatnonzero(np.diff(stamps[first : last + 1]) > longest_ns) + first
