"""Rows of a sensor by their stamps: storage, covariances with unmeasured directions, and checks of arguments."""

from __future__ import annotations

from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sonar_graph.calibration import Calibration
from sonar_graph.devices import UNMEASURED_M_S
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Floats, Ints

EARLIEST_NS = np.iinfo(np.int64).min
LATEST_NS = np.iinfo(np.int64).max
WINDOW_NS = 5_000_000_000
"""Window before an epoch in which gravity is measured should bottom lock be lost there: long enough for 1 mm/s² with
samples of 5 mm/s at 7 Hz, short enough for an accelerometer's bias not to have turned."""


class VelocityRow(NamedTuple):
    """A velocity of the DVL's origin, body axes."""

    stamp_ns: int
    velocity: Floats
    """Shape (3,), m/s."""
    cov: Floats
    """Shape (3, 3), m²/s²."""


class VelocityRows(NamedTuple):
    """Velocities of the DVL's origin, body axes."""

    stamps_ns: Ints
    """Shape (n,)."""
    velocity: Floats
    """Shape (n, 3), m/s."""
    cov: Floats
    """Shape (n, 3, 3), m²/s²."""

    @classmethod
    def of(cls, rows: list[VelocityRow]) -> VelocityRows:
        """Columns of single rows."""
        stamps_ns = np.array([row.stamp_ns for row in rows], dtype=np.int64)
        velocity = np.array([row.velocity for row in rows]).reshape(-1, 3)
        cov = np.array([row.cov for row in rows]).reshape(-1, 3, 3)
        return cls(stamps_ns, velocity, cov)

    def where(self, is_kept: NDArray[np.bool_]) -> VelocityRows:
        """Some of the rows."""
        return VelocityRows._make(column[is_kept] for column in self)


class StampedRows:
    """Rows of one sensor in the order of their stamps, each stamp once, with columns of values, given empty."""

    stamps_ns: Ints
    values: tuple[NDArray[Any], ...]

    def __init__(self, *values: NDArray[Any]) -> None:
        self._columns: list[NDArray[Any]] = []
        """Stamps and values with room for more rows."""
        self._show(0, np.empty(0, np.int64), *values)

    def insert(self, stamps_ns: Ints, *values: NDArray[Any]) -> bool:
        """Place rows by their increasing stamps; of equal stamps the first counts.

        Returns True where the first row comes before a row that was there already, or repeats its stamp.
        """
        n = len(self.stamps_ns)
        end = n + len(stamps_ns)
        comes_after = not n or bool(stamps_ns[0] > self.stamps_ns[-1])
        columns = self._columns
        # four times the room, so that appending copies each row less than once
        if end > len(columns[0]):
            columns = [_with_room(old, n, 4 * end) for old in columns]
        shown: list[NDArray[Any]] = []
        for column, new in zip(columns, (stamps_ns, *values), strict=True):
            column[n:end] = new
            shown.append(column[:end])
        self._columns = columns
        self.stamps_ns = shown[0]
        self.values = tuple(shown[1:])
        if not comes_after:
            # a stable order: of equal stamps the row that came first is kept
            kept = np.unique(self.stamps_ns, return_index=True)[1]
            self._show(len(kept), *(column[kept] for column in columns))
        return not comes_after

    def forget_before(self, stamp_ns: int, more: int = 0) -> None:
        """Drop rows that no value from a stamp on needs, but keep ``more`` of them."""
        first = max(int(self.stamps_ns.searchsorted(stamp_ns)) - 1 - more, 0)
        self._show(
            len(self.stamps_ns) - first, *(column[first:] for column in self._columns)
        )

    def _show(self, n: int, *columns: NDArray[Any]) -> None:
        """Set the columns, whose first n rows are filled."""
        self._columns = list(columns)
        self.stamps_ns = columns[0][:n]
        self.values = tuple([column[:n] for column in columns[1:]])


def _with_room(old: NDArray[Any], n: int, size: int) -> NDArray[Any]:
    """An array of more rows that begins with the first n rows of an old one."""
    column = np.empty((size, *old.shape[1:]), old.dtype)
    column[:n] = old[:n]
    return column


def longest_interval_ns(calibration: Calibration) -> int:
    """Longest interval between velocity samples that is no gap; held samples leave no gap."""
    if calibration.odometry_interpolation == "hold-past":
        return LATEST_NS
    return round(calibration.dvl.gap_s * 1e9)


def in_numbers(velocity_cov: Floats, unknown: Floats) -> Floats:
    """Covariances of shape (n, 3, 3) without NaN and infinity.

    Parameters
    ----------
    unknown
        Value in place of NaN, shape (3, 3).

    Returns
    -------
    The same, with `UNMEASURED_M_S` and no correlation along axes whose variance is infinite.
    """
    if np.isfinite(velocity_cov).all():
        return velocity_cov
    infinite = np.isinf(velocity_cov.diagonal(axis1=1, axis2=2))
    unmeasured = infinite[:, :, None] | infinite[:, None, :]
    numbers = np.where(np.isnan(velocity_cov), unknown, velocity_cov)
    return np.where(unmeasured, UNMEASURED_M_S**2 * np.eye(3), numbers)


def finite_vector(name: str, values: ArrayLike, size: int) -> Floats:
    """The values as an array of shape (size,); raises MeasurementError unless they are finite numbers of that shape."""
    found = np.asarray(values, np.float64)
    if found.shape != (size,):
        raise MeasurementError(f"{name}: expected shape ({size},), not {found.shape}")
    if not all(map(isfinite, found.tolist())):
        raise MeasurementError(f"{name}: expected finite numbers, not {found.tolist()}")
    return found


def no_doppler_stamp(name: str, instant_ns: int, stamps_ns: Ints) -> MeasurementError:
    """Error for an epoch that is not the stamp of a Doppler row; names the nearest stamp."""
    if not len(stamps_ns):
        return MeasurementError(
            f"{name}: {instant_ns} is no Doppler stamp: there are no Doppler rows; add them first"
        )
    nearest = stamps_ns[np.argmin(np.abs(stamps_ns - instant_ns))]
    return MeasurementError(
        f"{name}: {instant_ns} is none of the {len(stamps_ns)} Doppler stamps from {stamps_ns[0]} to {stamps_ns[-1]}"
        f" ns; take one of them, the nearest is {nearest}"
    )
