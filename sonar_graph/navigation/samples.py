"""Rows of a sensor by their stamps: storage, and checks of what a caller gives."""

from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sonar_graph.calibration import Calibration
from sonar_graph.devices import UNMEASURED_M_S
from sonar_graph.errors import CalibrationError, MeasurementError, SonarGraphError
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled

EARLIEST_NS, LATEST_NS = np.iinfo(np.int64).min, np.iinfo(np.int64).max
WINDOW_NS = 5_000_000_000
"""Window before an epoch in which gravity is measured should bottom lock be lost there: long enough for 1 mm/s² with
samples of 5 mm/s at 7 Hz, short enough for an accelerometer's bias not to have turned."""


class StampedRows:
    """Rows of one sensor in the order of their stamps, each stamp once, with columns of values, given empty."""

    stamps_ns: Ints
    values: tuple[NDArray[Any], ...]

    def __init__(self, *values: NDArray[Any]) -> None:
        self._columns: list[NDArray[Any]] = []
        self._show(0, np.empty(0, np.int64), *values)

    def insert(self, stamps_ns: Ints, *values: NDArray[Any]) -> bool:
        """Place rows by their increasing stamps; of equal stamps the first counts.

        Returns True where the first row comes before a row that was there already, or repeats its stamp.
        """
        n, end = len(self.stamps_ns), len(self.stamps_ns) + len(stamps_ns)
        comes_after = not n or bool(stamps_ns[0] > self.stamps_ns[-1])
        columns = self._columns
        if end > len(columns[0]):
            columns = [np.empty((4 * end, *old.shape[1:]), old.dtype) for old in columns]
            for column, old in zip(columns, self._columns, strict=True):
                column[:n] = old[:n]
        shown: list[NDArray[Any]] = []
        for column, new in zip(columns, (stamps_ns, *values), strict=True):
            column[n:end] = new
            shown.append(column[:end])
        self._columns, self.stamps_ns, self.values = columns, shown[0], tuple(shown[1:])
        if not comes_after:
            kept = np.unique(self.stamps_ns, return_index=True)[1]
            self._show(len(kept), *(column[kept] for column in columns))
        return not comes_after

    def forget_before(self, stamp_ns: int, more: int = 0) -> None:
        """Drop rows that no value from a stamp on needs, but keep ``more`` of them."""
        first = max(int(np.searchsorted(self.stamps_ns, stamp_ns)) - 1 - more, 0)
        self._show(len(self.stamps_ns) - first, *(column[first:] for column in self._columns))

    def _show(self, n: int, *columns: NDArray[Any]) -> None:
        """Take columns, of which the first n rows are filled."""
        self._columns = list(columns)
        self.stamps_ns = columns[0][:n]
        self.values = tuple([column[:n] for column in columns[1:]])


UNITS_NS = {"seconds": 1_000_000_000, "milliseconds": 1_000_000, "microseconds": 1_000}
_CLOSEST_ROWS_NS = 50_000
"""No IMU is as quick as 20 kHz; one of 20 Hz or more with stamps in microseconds looks quicker."""
_CLOSEST_SAMPLES_NS = 1_000_000
"""No Doppler log is as quick as 1 kHz; one with stamps in microseconds looks quicker."""


def finite_vector(name: str, values: ArrayLike, size: int, kind: type[SonarGraphError] = MeasurementError) -> Floats:
    """The values as an array of shape (size,); raises ``kind`` where they are not finite numbers of that shape."""
    found = np.asarray(values, np.float64)
    if found.shape != (size,):
        raise kind(f"{name}: expected shape ({size},), not {found.shape}")
    if not all(map(isfinite, found.tolist())):
        raise kind(f"{name}: expected finite numbers, not {found.tolist()}")
    return found


def require_noise(name: str, numbers: ArrayLike, size: int) -> None:
    """Raise CalibrationError where the numbers are not ``size`` finite standard deviations."""
    found = np.asarray(numbers)
    if found.dtype.kind not in "iuf" or found.shape != ((size,) if size > 1 else ()):
        raise CalibrationError(f"{name}: expected {size} number{'s' * (size > 1)}, not {numbers!r}")
    if not (np.isfinite(found) & (found >= 0)).all():
        raise CalibrationError(f"{name}: expected finite numbers of zero or more, not {numbers!r}")


def require_order(start_ns: int, end_ns: int) -> None:
    """Raise MeasurementError where the ends of an interval are not integers, the earlier first."""
    for name, instant in (("start_ns", start_ns), ("end_ns", end_ns)):
        if not isinstance(instant, int | np.integer):
            raise MeasurementError(f"{name}: expected integer nanoseconds, not {instant!r}; take the stamp of a row")
    if end_ns <= start_ns:
        raise MeasurementError(f"end_ns: {end_ns} is not after start_ns {start_ns}; the earlier first")


def no_doppler_stamp(name: str, instant_ns: int, stamps_ns: Ints) -> MeasurementError:
    """Error for an end of an interval that is not the stamp of a Doppler row; names the nearest and a likely unit."""
    if not len(stamps_ns):
        return MeasurementError(f"{name}: {instant_ns} is no Doppler stamp: there are no Doppler rows; add them first")
    first, last = int(stamps_ns[0]), int(stamps_ns[-1])
    nearest = int(stamps_ns[np.argmin(np.abs(stamps_ns - instant_ns))])
    units = [unit for unit, factor in UNITS_NS.items() if instant_ns and first <= int(instant_ns) * factor <= last]
    hint = f"; it seems to be in {units[0]}: times {UNITS_NS[units[0]]} it lies among them" if units else ""
    if len(stamps_ns) > 1 and last - first < _CLOSEST_SAMPLES_NS * (len(stamps_ns) - 1):
        hint = "; the stamps are so close that they seem to be in a larger unit than nanoseconds"
    return MeasurementError(
        f"{name}: {instant_ns} is none of the {len(stamps_ns)} Doppler stamps from {first} to {last} ns; take one of"
        f" them, the nearest is {nearest}{hint}"
    )


def require_distinct_stamps(name: str, stamps_ns: Ints, first: int, last: int) -> None:
    """Raise MeasurementError where stamps repeat between two rows or next to them."""
    begin = max(first - 1, 0)
    repeated = np.flatnonzero(np.diff(stamps_ns[begin : last + 2]) == 0)
    if len(repeated):
        row = begin + int(repeated[0])
        raise MeasurementError(
            f"{name}.stamps_ns: rows {row} and {row + 1} are both stamped {stamps_ns[row]} ns; leave one"
            " out: rows(numpy.unique(stamps_ns, return_index=True)[1]) keeps the first of each"
        )


def require_nanoseconds(name: str, stamps_ns: Ints) -> None:
    """Raise MeasurementError where rows are so close that their stamps must be in another unit."""
    mean_ns = float(stamps_ns[-1] - stamps_ns[0]) / max(len(stamps_ns) - 1, 1)
    if len(stamps_ns) > 2 and mean_ns < _CLOSEST_ROWS_NS:
        raise MeasurementError(
            f"{name}.stamps_ns: {len(stamps_ns)} rows are {mean_ns:.3g} ns apart in the mean; stamps are nanoseconds,"
            " these seem to be in a larger unit: multiply them"
        )


def require_covariances(name: str, cov: Floats, stamps_ns: Ints) -> None:
    """Raise MeasurementError where one of (n, 3, 3) matrices is not symmetric, or negative in a direction."""
    row = first_impossible_covariance(cov)
    if row >= 0:
        raise MeasurementError(
            f"{name}: the row at {stamps_ns[row]} ns is no covariance: expected a symmetric matrix without negative"
            f" eigenvalues, not {cov[row].round(9).tolist()}; NaN means not said"
        )


@compiled
def first_impossible_covariance(cov: Floats) -> int:
    """First row that is no covariance, by all principal minors relative to its variances; -1 where there is none."""
    for k in range(len(cov)):
        P = cov[k]
        determinant, scale = 0.0, P[0, 0] * P[1, 1] * P[2, 2]
        for i in range(3):
            j, other = (i + 1) % 3, (i + 2) % 3
            product = P[i, i] * P[j, j]
            if not (P[i, i] >= 0 and np.abs(P[i, j] - P[j, i]) <= 1e-6 * np.sqrt(np.abs(product)) + 1e-15):
                return k
            if not product - P[i, j] ** 2 >= -1e-6 * product - 1e-24:
                return k
            determinant += P[0, i] * (P[1, j] * P[2, other] - P[1, other] * P[2, j])
        if not determinant >= -1e-6 * scale - 1e-36:
            return k
    return -1


def longest_interval_ns(calibration: Calibration) -> int:
    """Longest interval between velocity samples that is no gap; held samples leave no gap."""
    return LATEST_NS if calibration.odometry_interpolation == "hold-past" else round(calibration.dvl.gap_s * 1e9)


PARTIAL_M2_S2 = 0.5 * UNMEASURED_M_S**2
"""Sum of variances beyond which a direction is unmeasured."""


def in_numbers(velocity_cov: Floats, unsaid: Floats) -> Floats:
    """Covariances of shape (n, 3, 3) without NaN and infinity.

    Parameters
    ----------
    unsaid
        Value in place of NaN, shape (3, 3).

    Returns
    -------
    The same, with `UNMEASURED_M_S` and no correlation along axes whose variance is infinite.
    """
    if np.isfinite(velocity_cov).all():
        return velocity_cov
    infinite = np.isinf(velocity_cov.diagonal(axis1=1, axis2=2))
    unmeasured = infinite[:, :, None] | infinite[:, None, :]
    numbers = np.where(np.isnan(velocity_cov), unsaid, velocity_cov)
    return np.where(unmeasured, UNMEASURED_M_S**2 * np.eye(3), numbers)


def is_partial(velocity_cov: Floats) -> NDArray[np.bool_]:
    """True for covariances of shape (n, 3, 3) with an unmeasured direction, shape (n,)."""
    return np.asarray(velocity_cov.diagonal(axis1=1, axis2=2).sum(axis=1) > PARTIAL_M2_S2)
