"""Where everything lies in payloads of one type whose strings and sequences have the same lengths."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.logs.plan import LENGTH_BYTES, Block, Plan, Walk
from sonar_graph.measurements import Ints

Bytes = NDArray[np.uint8]
ENCAPSULATIONS = {">": bytes([0, 0]), "<": bytes([0, 1])}
"""How a payload begins, by byte order."""


class Column(NamedTuple):
    """Where the values of one field lie."""

    dtype: np.dtype[Any]
    """Of one value; for a string, one byte."""
    is_single: bool
    """No array or sequence on the path: one value a message."""
    starts: list[int]
    """Byte offset of each stretch."""
    counts: list[int]
    """Number of values of each stretch."""


class Layout:
    """What a walk found."""

    def __init__(self, plan: Plan, byte_order: str, walk: Walk) -> None:
        self.columns = plan.leaves
        """The fields that hold values, by path, such as ``header.stamp.sec``."""
        self.byte_order = byte_order
        self.size = walk.end
        self.words = walk.words
        self._plan = plan
        self._found = walk.found

    def column(self, path: str) -> Column:
        """Where a field's values lie.

        Raises
        ------
        KeyError
            When the type has no such field, or it holds no values itself.
        """
        step, dtypes, is_single = self.columns[path]
        found = self._found[step.index]
        if isinstance(step, Block):
            offsets = step.offsets[path]
            starts = [start + offsets[start % len(offsets)] for start in found]
            return Column(dtypes[self.byte_order], is_single, starts, [step.counts[path]] * len(found))
        return Column(dtypes[self.byte_order], is_single, found[::2], found[1::2])

    def lengths(self, path: str) -> list[int]:
        """Number of elements of an array or sequence, one each time it occurs.

        Raises
        ------
        KeyError
            When the type has no such field.
        """
        sequence = self._plan.sequences.get(path)
        return self.column(path).counts if sequence is None else self._found[sequence.index][1::2]

    def texts(self) -> Iterator[tuple[str, Column]]:
        """Every string field with its path; the closing NUL counts as one of its bytes."""
        return ((path, self.column(path)) for path in self._plan.texts)

    def booleans(self) -> Iterator[tuple[str, Column]]:
        """Every field of booleans with its path."""
        return ((path, self.column(path)) for path in self._plan.booleans)

    def same(self, payloads: Bytes, rows: Ints) -> NDArray[np.bool_]:
        """Which rows of payloads, shape (n, size), have this layout."""
        words = np.array(self.words, np.int64).reshape(-1, 2)
        places = np.concatenate([[0, 1], (words[:, :1] + np.arange(LENGTH_BYTES)).reshape(-1)])
        lengths = words[:, 1].astype(f"{self.byte_order}u{LENGTH_BYTES}").view(np.uint8)
        expected = np.concatenate([np.frombuffer(ENCAPSULATIONS[self.byte_order], np.uint8), lengths])
        some = payloads[:, places] if len(rows) == len(payloads) else payloads[np.ix_(rows, places)]
        return np.asarray((some == expected).all(axis=1))
