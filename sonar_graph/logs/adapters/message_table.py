"""Messages of a topic as one table: columns over all rows, stamps, and the rows that are fit for use."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from sonar_graph.logs.mcap import Topic
from sonar_graph.measurements import NS_PER_S, Block, Ints

Rows = TypeVar("Rows", bound=Block)
Measured = TypeVar("Measured")
Mask = NDArray[np.bool_]
Dropped = dict[str, int]
"""Number of rows left out, by reason."""
Fit = tuple[Measured | None, Dropped]
"""Measurements of the rows fit for use, None without any, and the others."""
NOT_FINITE = "with values that are not finite or beyond 1e15"
SAME_STAMP = "with the stamp of another"
LARGEST = 1e15
"""No sensor gives more, in whatever unit; products of a few such numbers overflow."""
LAST_S = 1e10
"""Seconds since 1970 of the year 2286: no time is later."""
SMALLER = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of stamps that are no seconds."""
LOG_TIME = "log"
"""Value of `Adapter.stamp` that stands for the time of recording."""


class FieldTable(ABC):
    """Rows with a stamp each, whose fields are columns: messages of a topic, or lines of a text file."""

    stamps_ns: Ints
    """Shape (n,)."""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @abstractmethod
    def column(self, path: str) -> NDArray[Any]:
        """A field over all rows, shape (n,) or (n, m); ``a.b[2]`` is one element of an array, shape (n,)."""

    @abstractmethod
    def refuse(self, path: str, fault: str) -> NoReturn:
        """Raise a `LogError` about a field."""

    def beside(self, paths: Sequence[str]) -> NDArray[Any]:
        """Fields with one number a row side by side, shape (n, m)."""
        found = [self.column(path) for path in paths]
        for path, column in zip(paths, found, strict=True):
            if column.ndim > 1:
                self.refuse(
                    path,
                    f"is an array of {column.shape[1]}; name one element, such as {path}[0]",
                )
        return np.column_stack(found)


class MessageTable(FieldTable):
    """All messages of a topic whose fields of interest have the same size in each, stamped as an `Adapter` states.

    A LogError names file, topic and field where the messages are not as their definition has them.
    """

    def __init__(
        self,
        topic: Topic,
        stamp: str = "header.stamp",
        stamp_unit_s: float = 1.0,
        stamp_offset_s: float = 0.0,
    ) -> None:
        self.topic = topic
        self.groups = topic.messages()
        if not self.groups:
            faults = ", ".join(
                f"{count} {fault}" for fault, count in topic.unsound.items()
            )
            raise topic.error(f"no message is what its definition says: {faults}")
        log_times_ns = topic.log_times_ns
        if stamp == LOG_TIME:
            self.stamps_ns = log_times_ns
        elif self.has(stamp):
            numbers = self.column(stamp)
            self._require_dates(stamp, numbers * stamp_unit_s)
            self.stamps_ns = nanoseconds(numbers, stamp_unit_s)
        else:
            self._require(f"{stamp}.sec")
            self.stamps_ns = np.empty(len(topic), np.int64)
            for group in self.groups:
                seconds = group[f"{stamp}.sec"].astype(np.int64)
                stamps_ns = seconds * NS_PER_S + group[f"{stamp}.nanosec"]
                of_log_ns = log_times_ns[group.rows]
                # without a stamp the time of recording counts
                is_unset = stamps_ns == 0
                self.stamps_ns[group.rows] = np.where(is_unset, of_log_ns, stamps_ns)
        if stamp_offset_s:
            self.stamps_ns = self.stamps_ns + round(stamp_offset_s * NS_PER_S)

    def _require_dates(self, stamp: str, seconds: NDArray[Any]) -> None:
        """Refuse stamps that are typically of no date, since their unit is another one."""
        # single wrong stamps are left to the checks of the stamps
        typical_s = float(np.median(np.abs(seconds)))
        if typical_s > LAST_S:
            fits = next((u for u in SMALLER if typical_s * SMALLER[u] < LAST_S), "...")
            self.refuse(
                stamp,
                f"is typically {typical_s:.4g} s, beyond any date: another unit? "
                f'`stamp_unit_s = "{fits}"` in the log configuration',
            )

    def has(self, path: str) -> bool:
        """True where every message has a field with values."""
        return all(field_of(path)[0] in group.layout.columns for group in self.groups)

    def column(self, path: str) -> NDArray[Any]:
        """A field over all rows, shape (n,) or (n, m); ``a.b[2]`` is one element of an array, shape (n,)."""
        self._require(path)
        name, index = field_of(path)
        parts = [group[name] for group in self.groups]
        if len({part.shape[1:] for part in parts}) > 1:
            self.refuse(name, "has more elements in some messages than in others")
        values = np.empty(
            (len(self.topic), *parts[0].shape[1:]), parts[0].dtype.newbyteorder("=")
        )
        for group, part in zip(self.groups, parts, strict=True):
            values[group.rows] = part
        if index is None:
            return values
        if values.ndim == 1 or index >= values.shape[1]:
            self.refuse(
                path, f"has {values.shape[1] if values.ndim > 1 else 'no'} elements"
            )
        return values[:, index]

    def refuse(self, path: str, fault: str) -> NoReturn:
        """Raise a `LogError` about a field."""
        raise self.topic.error(f"field {path} of {self.topic.type_name} {fault}")

    def _require(self, path: str) -> None:
        if not self.has(path):
            stamp = (
                '; stamp = "log", or the name of a field, says what the time is'
                if path.endswith(".sec")
                else ""
            )
            raise self.topic.error(
                f"its {self.topic.type_name} has no field {path}{stamp}"
            )


def field_of(path: str) -> tuple[str, int | None]:
    """Field and index of a path: ``("a.b", 2)`` for ``a.b[2]``."""
    name, bracket, rest = path.partition("[")
    return name, int(rest.rstrip("]")) if bracket else None


def nanoseconds(values: NDArray[Any], unit_s: float) -> Ints:
    """Stamps of any unit in nanoseconds; exact for units of whole nanoseconds, 0 for values that are not finite."""
    unit_ns = unit_s * NS_PER_S
    finite = np.where(np.isfinite(values), values, 0)
    if unit_ns < 1 or abs(unit_ns - round(unit_ns)) > 1e-9 * unit_ns:
        return np.rint(finite * unit_ns).astype(np.int64)
    # seconds since 1970 as a double lose nanoseconds when they are multiplied
    whole = np.floor(finite)
    return whole.astype(np.int64) * round(unit_ns) + np.rint(
        (finite - whole) * unit_ns
    ).astype(np.int64)


def share(has_it: Mask) -> str:
    """How many of some rows have a fault, such as "3 of 20"."""
    return f"{np.count_nonzero(has_it)} of {len(has_it)}"


def not_finite(*columns: NDArray[Any]) -> Mask:
    """Mask of rows in which some column has a value that is not finite or larger than `LARGEST`, shape (n,)."""
    return ~np.all(
        [(np.abs(c) < LARGEST).reshape(len(c), -1).all(axis=1) for c in columns], axis=0
    )


def fit_rows(
    stamps_ns: Ints, faults: Mapping[str, Mask], *, unique: bool
) -> tuple[Ints, Dropped]:
    """Rows fit for use in the order of their stamps, shape (n,), and the number of the others by fault.

    Faults are masks, shape (n,), by name; a row counts for its first fault only. With ``unique``, all but the first of
    rows with the same stamp are left out.
    """
    # one fault a row, so that the counts add up to the rows left out
    fit = np.ones(len(stamps_ns), bool)
    counts = {}
    for fault, has_it in faults.items():
        counts[fault] = int(np.count_nonzero(fit & has_it))
        fit &= ~has_it
    rows: Ints = np.flatnonzero(fit).astype(np.int64)
    rows = rows[np.argsort(stamps_ns[rows], kind="stable")]
    if unique and rows.size:
        # estimators need increasing stamps
        again = np.diff(stamps_ns[rows], prepend=stamps_ns[rows[0]] - 1) == 0
        counts[SAME_STAMP] = int(np.count_nonzero(again))
        rows = rows[~again]
    return rows, {fault: count for fault, count in counts.items() if count}


def fit_block(
    kind: type[Rows],
    stamps_ns: Ints,
    faults: Mapping[str, Mask],
    *columns: NDArray[Any],
    unique: bool = True,
) -> Fit[Rows]:
    """Block of the rows that `fit_rows` chooses, None without any, and the number of the others by fault."""
    rows, dropped = fit_rows(stamps_ns, faults, unique=unique)
    if not rows.size:
        return None, dropped
    return kind(stamps_ns[rows], *(column[rows] for column in columns)), dropped
