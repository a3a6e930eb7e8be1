"""What is wrong with instants, vectors and noise that a caller hands to preintegration, in one line."""

from __future__ import annotations

from math import isfinite

import numpy as np
from numpy.typing import ArrayLike

from sonar_graph.errors import CalibrationError, MeasurementError, SonarGraphError
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import compiled

UNITS_NS = {"seconds": 1_000_000_000, "milliseconds": 1_000_000, "microseconds": 1_000}
_CLOSEST_ROWS_NS = 50_000
"""No IMU is as quick as 20 kHz; one of 20 Hz or more with stamps in microseconds looks quicker."""

_CLOSEST_SAMPLES_NS = 1_000_000
"""No Doppler log is as quick as 1 kHz; one with stamps in microseconds looks quicker."""


def vector(name: str, values: ArrayLike, size: int, kind: type[SonarGraphError] = MeasurementError) -> Floats:
    """The values as an array; an error of this kind where they are not so many finite numbers."""
    found = np.asarray(values, np.float64)
    if found.shape != (size,):
        raise kind(f"{name}: expected shape ({size},), not {found.shape}")
    if not all(map(isfinite, found.tolist())):
        raise kind(f"{name}: expected finite numbers, not {found.tolist()}")
    return found


def noise(name: str, numbers: ArrayLike, size: int) -> None:
    """Refuse what is no standard deviation.

    Raises
    ------
    CalibrationError
        When the numbers are not so many, or one is negative or not finite.
    """
    found = np.asarray(numbers)
    if found.dtype.kind not in "iuf" or found.shape != ((size,) if size > 1 else ()):
        raise CalibrationError(f"{name}: expected {size} number{'s' * (size > 1)}, not {numbers!r}")
    if not (np.isfinite(found) & (found >= 0)).all():
        raise CalibrationError(f"{name}: expected finite numbers of zero or more, not {numbers!r}")


def order(start_ns: int, end_ns: int) -> None:
    """Refuse an interval whose ends are not integers, the earlier first."""
    for name, instant in (("start_ns", start_ns), ("end_ns", end_ns)):
        if not isinstance(instant, int | np.integer):
            raise MeasurementError(f"{name}: expected integer nanoseconds, not {instant!r}; take the stamp of a row")
    if end_ns <= start_ns:
        raise MeasurementError(f"end_ns: {end_ns} is not after start_ns {start_ns}; the earlier first")


def no_stamp(name: str, instant_ns: int, stamps_ns: Ints) -> MeasurementError:
    """That an end of an interval is not the stamp of a Doppler row, which there are, and which unit may be meant."""
    if not len(stamps_ns):
        return MeasurementError(f"{name}: {instant_ns} is no Doppler stamp: there are no Doppler rows; add them first")
    first, last = int(stamps_ns[0]), int(stamps_ns[-1])
    nearest = int(stamps_ns[np.argmin(np.abs(stamps_ns - instant_ns))])
    return MeasurementError(
        f"{name}: {instant_ns} is none of the {len(stamps_ns)} Doppler stamps from {first} to {last} ns; take one of"
        f" them, the nearest is {nearest}{_other_unit(int(instant_ns), stamps_ns)}"
    )


def _other_unit(instant: int, stamps_ns: Ints) -> str:
    first, last = int(stamps_ns[0]), int(stamps_ns[-1])
    if len(stamps_ns) > 1 and last - first < _CLOSEST_SAMPLES_NS * (len(stamps_ns) - 1):
        return "; the stamps are so close that they seem to be in a larger unit than nanoseconds"
    for unit, factor in UNITS_NS.items():
        if instant and first <= instant * factor <= last:
            return f"; it seems to be in {unit}: times {factor} it lies among them"
    return ""


def rows(name: str, stamps_ns: Ints, first: int, last: int) -> None:
    """Refuse repeated stamps from one row to another and next to these."""
    repeated = _repeated_row(stamps_ns, max(first - 1, 0), min(last + 2, len(stamps_ns)))
    if repeated >= 0:
        raise MeasurementError(
            f"{name}.stamps_ns: rows {repeated} and {repeated + 1} are both stamped {stamps_ns[repeated]} ns; leave one"
            " out: rows(numpy.unique(stamps_ns, return_index=True)[1]) keeps the first of each"
        )


def unit(name: str, stamps_ns: Ints) -> None:
    """Refuse rows so close that their stamps must be in another unit."""
    mean_ns = float(stamps_ns[-1] - stamps_ns[0]) / max(len(stamps_ns) - 1, 1)
    if len(stamps_ns) > 2 and mean_ns < _CLOSEST_ROWS_NS:
        raise MeasurementError(
            f"{name}.stamps_ns: {len(stamps_ns)} rows are {mean_ns:.3g} ns apart in the mean; stamps are nanoseconds,"
            " these seem to be in a larger unit: multiply them"
        )


def covariances(name: str, cov: Floats, stamps_ns: Ints) -> None:
    """Refuse what no errors can have: not symmetric, or negative in a direction; shape (n, 3, 3)."""
    row = _impossible_row(cov)
    if row >= 0:
        raise MeasurementError(
            f"{name}: the row at {stamps_ns[row]} ns is no covariance: expected a symmetric matrix without negative"
            f" eigenvalues, not {cov[row].round(9).tolist()}; NaN means not said"
        )


@compiled
def _repeated_row(stamps_ns: Ints, first: int, end: int) -> int:
    for row in range(first, end - 1):
        if stamps_ns[row + 1] == stamps_ns[row]:
            return row
    return -1


@compiled
def _impossible_row(cov: Floats) -> int:
    """By all principal minors, each relative to the size that its variances give it."""
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
