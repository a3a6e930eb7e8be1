"""ROS 2 messages as columns: CDR payloads read and written many at a time.

The `Layout` of a payload is found once, by a walk through the type's `Plan`; all payloads with the same length words
share it, and a field of all of them is one strided view of their bytes. For writing, the same walk with given lengths
finds the place of each column.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from sonar_graph.logs.cdr.definitions import Struct
from sonar_graph.logs.cdr.layout import (
    ENCAPSULATIONS,
    LENGTH_BYTES,
    Bytes,
    DecodingStep,
    Layout,
    PayloadColumn,
    UnsoundMessageError,
    layout_of,
    plan_of,
    unsound_contents,
)
from sonar_graph.measurements import Ints

Value = NDArray[Any] | float | str | Sequence[str]
Lengths = Mapping[str, int | Sequence[int]]
_ROWS_COMPARED_PER_WALK = 32
"""Cost of a walk through a payload over that of comparing it with a layout, about."""
_LAYOUTS_REMEMBERED = 8
"""Layouts remembered of each payload length, from one part of a topic to the next."""


@dataclass(frozen=True)
class Messages:
    """Decoded messages of one type with the same layout; ``messages["angular_velocity.x"]`` is a column."""

    rows: Ints
    """Numbers of these messages in the topic, from 0 in the order of the log, shape (n,)."""
    payloads: Bytes
    """Shape (n, size)."""
    layout: Layout

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, path: str) -> NDArray[Any]:
        """Values of a numeric field: shape (n,) for a single one, (n, m) within arrays; a KeyError without one."""
        column = self.layout.column(path)
        # a copy only where the values do not lie evenly
        values = _view(self.payloads, column)
        if values is None:
            values = np.ascontiguousarray(self.payloads[:, _places(column)]).view(
                column.dtype
            )
        return values[:, 0] if column.is_single else values

    def lengths(self, path: str) -> list[int]:
        """Numbers of elements of an array or sequence: one each time it occurs in a message, the same in all."""
        return self.layout.lengths(path)

    def strings(self, path: str) -> list[list[str]]:
        """Values of a string field: for each message one of each occurrence."""
        column = self.layout.column(path)
        runs = [
            (start, start + count - 1)
            for start, count in zip(column.starts, column.counts, strict=True)
        ]
        # an empty string may lack its NUL
        return [
            [str(content[a:b], "utf-8") if b > a else "" for a, b in runs]
            for content in (payload.tobytes() for payload in self.payloads)
        ]

    def first_string(self, path: str) -> str:
        """A string field's value in the first message; empty without one."""
        if path not in self.layout.columns:
            return ""
        first = Messages(self.rows[:1], self.payloads[:1], self.layout)
        return next(iter(first.strings(path)[0]), "")


class Decoded(NamedTuple):
    """Result of decoding payloads."""

    groups: list[Messages]
    """Sound messages by layout."""
    unsound: dict[str, Ints]
    """Rows of the others by their fault, which completes "3 messages ..."."""


def decode(definition: Struct, payloads: Iterable[tuple[Ints, Bytes]]) -> Decoded:
    """Messages grouped by layout; those that do not follow their definition are left out and named.

    Payloads are, for each length, the rows of the messages, shape (n,), and their bytes, shape (n, length).
    """
    return Decoder(definition).decode(payloads)


class Decoder:
    """Decoder of messages of one type part by part; known layouts are tried first."""

    def __init__(self, definition: Struct) -> None:
        self._plan = plan_of(definition)
        self._known: dict[int, list[Layout]] = defaultdict(list)
        self._unsound: dict[str, list[Ints]] = defaultdict(list)

    def decode(self, payloads: Iterable[tuple[Ints, Bytes]]) -> Decoded:
        """Messages grouped by layout, as by the function `decode`."""
        # the decoder is shared by all pieces of a topic
        self._unsound.clear()
        groups = []
        for rows, stack in payloads:
            for layout, members in self._by_layout(rows, stack):
                first = int(members[0])
                last = int(members[-1])
                # a view where they lie side by side
                is_run = last - first + 1 == len(members)
                found = stack[first : last + 1] if is_run else stack[members]
                is_sound = np.ones(len(members), bool)
                for fault, has_it in unsound_contents(layout, found):
                    if (has_it & is_sound).any():
                        self._unsound[fault].append(rows[members[has_it & is_sound]])
                    is_sound &= ~has_it
                if not is_sound.all():
                    members = members[is_sound]
                    found = found[is_sound]
                if len(members):
                    groups.append(Messages(rows[members], found, layout))
        return Decoded(
            groups,
            {fault: np.concatenate(parts) for fault, parts in self._unsound.items()},
        )

    def _by_layout(self, rows: Ints, stack: Bytes) -> Iterator[tuple[Layout, Ints]]:
        """Layouts of payloads of one length, each with the places of its payloads in the stack."""
        known = self._known[stack.shape[1]]
        # most messages of a topic share one layout: compare before walking
        left = np.arange(len(stack))
        for layout in known:
            same = layout.same(stack, left)
            if same.any():
                yield layout, left[same]
                left = left[~same]
        while left.size:
            found = self._layout(rows[left[0]], stack[left[0]])
            if found is None:
                left = left[1:]
                continue
            same = found.same(stack, left) if left.size > 1 else np.ones(1, bool)
            yield found, left[same]
            # texts that change in length give nearly every message a layout of its own
            if np.count_nonzero(same) * _ROWS_COMPARED_PER_WALK < left.size:
                yield from self._one_by_one(rows, stack, left[~same])
                return
            left = left[~same]
            known[_LAYOUTS_REMEMBERED - 1 :] = [found]

    def _one_by_one(
        self, rows: Ints, stack: Bytes, left: Ints
    ) -> Iterator[tuple[Layout, Ints]]:
        """Walk every payload, where hardly two have the same layout."""
        found: dict[tuple[object, ...], tuple[Layout, list[int]]] = {}
        for member in left.tolist():
            layout = self._layout(rows[member], stack[member])
            if layout is not None:
                found.setdefault((layout.byte_order, *layout.words), (layout, []))[
                    1
                ].append(member)
        for layout, members in found.values():
            yield layout, np.array(members)

    def _layout(self, row: int, payload: Bytes) -> Layout | None:
        try:
            return layout_of(self._plan, payload.data)
        except UnsoundMessageError as fault:
            self._unsound[str(fault)].append(np.array([row]))
            return None


def encode(
    definition: Struct,
    n: int,
    values: Mapping[str, Value],
    lengths: Lengths | None = None,
) -> Bytes:
    """Payloads of n messages with the same layout, shape (n, size); fields that are not given are zero or empty.

    Parameters
    ----------
    values
        By path. Numbers: anything that broadcasts to shape (n,), or (n, m) within arrays, where m also is the length
        of a sequence of numbers. Strings: one for all, or a list with one for each occurrence in a message.
    lengths
        Number of elements of sequences by path, for all occurrences in a message or for each; needed for sequences of
        structs, and of numbers within those.

    Raises
    ------
    ValueError
        For a field that the type does not have, and a number that does not fit into its field.
    """
    # a misspelt field would be written as zeros
    plan = plan_of(definition)
    unknown = values.keys() - plan.leaves.keys()
    if unknown:
        raise ValueError(f"{definition.name} has no field {', '.join(sorted(unknown))}")
    order = "<"
    layout = Layout(plan, order, _given_lengths(values, lengths or {}))
    payloads = np.zeros((n, layout.size), np.uint8)
    payloads[:, :2] = np.frombuffer(ENCAPSULATIONS[order], np.uint8)
    for at, length in layout.words:
        word = length.to_bytes(LENGTH_BYTES, "little")
        payloads[:, at : at + LENGTH_BYTES] = np.frombuffer(word, np.uint8)
    for path, value in values.items():
        column = layout.column(path)
        if isinstance(value, str | list):
            texts = [value] * len(column.starts) if isinstance(value, str) else value
            characters = b"".join(str(text).encode() + b"\0" for text in texts)
            payloads[:, _places(column)] = np.frombuffer(characters, np.uint8)
            continue
        given = np.asarray(value)
        with np.errstate(invalid="ignore"):  # checked in the next line
            # casting silently wraps integers
            numbers = given.astype(column.dtype)
        if column.dtype.kind in "iu" and not np.array_equal(numbers, given):
            raise ValueError(f"{path}: a number does not fit into {column.dtype}")
        if numbers.ndim == 1 and column.is_single:
            numbers = numbers.reshape(-1, 1)
        numbers = np.broadcast_to(numbers, (n, sum(column.counts)))
        view = _view(payloads, column)
        if view is None:
            payloads[:, _places(column)] = np.ascontiguousarray(numbers).view(np.uint8)
        else:
            view[...] = numbers
    return payloads


def _given_lengths(
    values: Mapping[str, Value], lengths: Lengths
) -> Callable[[DecodingStep, int], int]:
    """Length of each string and sequence in turn, from the values and lengths to be written."""
    texts: dict[str, Iterator[int]] = {}
    each: dict[str, Iterator[int]] = {}
    for path, value in values.items():
        if isinstance(value, str):
            texts[path] = repeat(len(value.encode()) + 1)
        elif isinstance(value, list):
            # the number of strings, where it is not given, and each with its closing NUL
            each[path] = repeat(len(value))
            texts[path] = (len(str(text).encode()) + 1 for text in value)
        elif isinstance(value, np.ndarray) and value.ndim > 1:
            each[path] = repeat(value.shape[1])
    for path, given in lengths.items():
        each[path] = repeat(given) if isinstance(given, int) else iter(given)

    def length_of(step: DecodingStep, _: int) -> int:
        found = (texts if step.is_text else each).get(step.path)
        return next(found) if found else int(step.is_text)

    return length_of


def _view(payloads: Bytes, column: PayloadColumn) -> NDArray[Any] | None:
    """Column without copying, shape (n, m); None where its parts are not evenly spaced single values."""
    starts = column.starts
    size = column.dtype.itemsize
    if not starts:
        return np.empty((len(payloads), 0), column.dtype)
    values = payloads[:, starts[0] : starts[0] + column.counts[0] * size].view(
        column.dtype
    )
    if len(starts) == 1:
        return values
    # one strided view replaces a copy
    spacing = starts[1] - starts[0]
    if any(count != 1 for count in column.counts) or starts != list(
        range(starts[0], starts[-1] + 1, spacing)
    ):
        return None
    return as_strided(
        values, (len(payloads), len(starts)), (values.strides[0], spacing)
    )


def _places(column: PayloadColumn) -> Ints:
    """Offsets of all bytes of a column, in order."""
    sizes = np.array(column.counts, np.int64) * column.dtype.itemsize
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.repeat(np.array(column.starts, np.int64), sizes) + within
