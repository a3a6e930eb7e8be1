"""ROS 2 messages as columns: CDR payloads read and written many at a time.

Where a field lies in a payload depends on the type's definition and on the lengths of the strings and sequences
before it, on nothing else. So the `Layout` is worked out once, by walking the definition; all payloads whose length
words are the same share it, and a field of all of them is one strided view of their bytes. The same walk, given the
lengths instead of reading them, tells where to put each column when writing.

Encoding is plain CDR (XCDR1, OMG DDS-XTypes 1.3, 7.4.1): a four-byte encapsulation header, then primitives aligned to
their own size counted from after that header; a string is its length with the closing NUL as uint32 and its bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.errors import LogError
from sonar_graph.logs.schema import PRIMITIVES, STRING, Struct
from sonar_graph.measurements import Ints

HEADER_BYTES = 4
_LITTLE_ENDIAN = bytes([0, 1, 0, 0])
_BYTE_ORDERS = {(0, 0): ">", (0, 1): "<"}
_LENGTH = "u4"

Bytes = NDArray[np.uint8]
Value = NDArray[Any] | float | str | Sequence[str]


@dataclass(frozen=True)
class Column:
    """Where the values of one field lie."""

    dtype: np.dtype[Any]
    """Of one value; for a string, one byte."""
    is_single: bool
    """No array or sequence on the path: one value a message."""
    runs: list[tuple[int, int]] = field(default_factory=list)
    """Byte offset and number of values of each stretch."""


@dataclass
class Layout:
    """Where everything lies in payloads of one type whose strings and sequences have the same lengths."""

    byte_order: str
    columns: dict[str, Column] = field(default_factory=dict)
    """By path, such as ``header.stamp.sec``; what lies in a sequence of structs has one path for all elements."""
    length_words: list[tuple[int, int]] = field(default_factory=list)
    """Byte offset and value of each length word."""
    size: int = HEADER_BYTES

    def same(self, payloads: Bytes) -> NDArray[np.bool_]:
        """Which payloads, shape (n, size), have this layout."""
        places = [1, *(offset + i for offset, _ in self.length_words for i in range(4))]
        words = np.array([value for _, value in self.length_words], dtype=self.byte_order + _LENGTH)
        expected = np.concatenate([[self.byte_order == "<"], words.view(np.uint8)])
        return np.asarray((payloads[:, places] == expected).all(axis=1))


class LengthWord(NamedTuple):
    """A length word whose value is wanted."""

    path: str
    offset: int
    is_string: bool
    """Of a string, with its closing NUL; otherwise of a sequence."""


LengthOf = Callable[[LengthWord], int]


class _Walk:
    """Works out a layout by going through a definition field by field."""

    def __init__(self, byte_order: str, length_of: LengthOf) -> None:
        self.layout = Layout(byte_order)
        self._length_of = length_of

    def struct(self, definition: Struct, prefix: str = "", *, is_single: bool = True) -> Layout:
        for entry in definition.fields:
            path, single = prefix + entry.name, is_single and not entry.is_array
            count = self._length_word(path, is_string=False) if entry.length is None else entry.length
            if isinstance(entry.kind, Struct):
                for _ in range(count):
                    self.struct(entry.kind, path + ".", is_single=single)
            elif entry.kind == STRING:
                for _ in range(count):
                    self._values(path, "u1", self._length_word(path, is_string=True), single)
            else:
                self._values(path, PRIMITIVES[entry.kind], count, single)
        return self.layout

    def _length_word(self, path: str, *, is_string: bool) -> int:
        self._align(4)
        offset = self.layout.size
        length = self._length_of(LengthWord(path, offset, is_string))
        self.layout.length_words.append((offset, length))
        self.layout.size += 4
        return length

    def _values(self, path: str, kind: str, count: int, is_single: bool) -> None:
        dtype = np.dtype(self.layout.byte_order + kind)
        column = self.layout.columns.setdefault(path, Column(dtype, is_single))
        if count:
            self._align(dtype.itemsize)
        column.runs.append((self.layout.size, count))
        self.layout.size += count * dtype.itemsize

    def _align(self, size: int) -> None:
        self.layout.size += -(self.layout.size - HEADER_BYTES) % size


@dataclass(frozen=True)
class Messages:
    """Decoded messages of one type that share a layout; ``messages["angular_velocity.x"]`` is a column."""

    rows: Ints
    """Which messages of the topic these are, counted from 0 in the order of the log; shape (n,)."""
    payloads: Bytes
    """Shape (n, size)."""
    layout: Layout

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, path: str) -> NDArray[Any]:
        """Values of a numeric field: shape (n,) for a single one, (n, m) within arrays; empty where m is 0."""
        column = self.layout.columns.get(path)
        if column is None:
            return np.empty((len(self), 0))
        size = column.dtype.itemsize
        if len(column.runs) != 1:
            return np.ascontiguousarray(self.payloads[:, _places(column)]).view(column.dtype)
        at, count = column.runs[0]
        values = self.payloads[:, at : at + count * size].view(column.dtype)
        return values[:, 0] if column.is_single else values

    def strings(self, path: str) -> list[list[str]]:
        """Values of a string field, for each message one of each occurrence."""
        runs = self.layout.columns[path].runs if path in self.layout.columns else []
        return [[_text(row[at : at + count]) for at, count in runs] for row in self.payloads]

    def first_string(self, path: str) -> str:
        """A string field's value in the first message."""
        return next(iter(Messages(self.rows[:1], self.payloads[:1], self.layout).strings(path)[0]), "")


def _text(characters: Bytes) -> str:
    return characters.tobytes().rstrip(b"\0").decode("utf-8", "replace")


def decode(definition: Struct, payloads: Iterable[tuple[Ints, Bytes]]) -> list[Messages]:
    """Messages grouped by layout.

    Parameters
    ----------
    definition
        Of the messages' type.
    payloads
        For each length that occurs: which messages have it, shape (n,), and their bytes, shape (n, length).

    Raises
    ------
    LogError
        For a payload that is shorter than its definition, or not plain CDR.
    """
    groups = []
    for rows, stack in payloads:
        left = np.arange(len(rows))
        while left.size:
            part = stack if left.size == len(rows) else stack[left]
            layout = _layout_of(definition, part[0])
            same = layout.same(part)
            groups.append(Messages(rows[left[same]], part if same.all() else part[same], layout))
            left = left[~same]
    return groups


def _layout_of(definition: Struct, payload: Bytes) -> Layout:
    order = _BYTE_ORDERS.get((int(payload[0]), int(payload[1]))) if len(payload) >= HEADER_BYTES else None
    if order is None:
        start = payload[:HEADER_BYTES].tobytes().hex()
        raise LogError(f"a message of {definition.name} is not plain CDR (it begins with {start})")

    def read_length(word: LengthWord) -> int:
        value = payload[word.offset : word.offset + 4]
        length = int(value.view(order + _LENGTH)[0]) if len(value) == 4 else len(payload)
        if length > len(payload) - word.offset:
            raise LogError(f"a message of {definition.name} is shorter than its definition says, at {word.path}")
        return length

    layout = _Walk(order, read_length).struct(definition)
    if layout.size > len(payload):
        raise LogError(f"a message of {definition.name} has {len(payload)} bytes; its definition needs {layout.size}")
    return layout


def encode(definition: Struct, n: int, values: Mapping[str, Value], lengths: Mapping[str, int] | None = None) -> Bytes:
    """Payloads of n messages that share a layout; what is not given is zero or empty.

    Parameters
    ----------
    definition
        Of the messages' type.
    n
        Number of messages.
    values
        By path. Numbers: anything that broadcasts to shape (n,), or (n, m) within arrays, where m also is the length
        of a sequence of numbers. Strings: one for all, or a list with one for each occurrence in a message.
    lengths
        Number of elements of sequences of structs, by path.

    Returns
    -------
    NDArray[uint8]
        Shape (n, size).
    """
    layout = _Walk("<", _given_lengths(values, lengths or {})).struct(definition)
    unknown = values.keys() - layout.columns.keys()
    if unknown:
        raise ValueError(f"{definition.name} has no field {', '.join(sorted(unknown))}")
    payloads = np.zeros((n, layout.size), np.uint8)
    payloads[:, :HEADER_BYTES] = np.frombuffer(_LITTLE_ENDIAN, np.uint8)
    words = Column(np.dtype("<" + _LENGTH), is_single=False, runs=[(offset, 1) for offset, _ in layout.length_words])
    _fill(payloads, words, np.array([[length for _, length in layout.length_words]]))
    for path, value in values.items():
        _fill(payloads, layout.columns[path], value)
    return payloads


def _given_lengths(values: Mapping[str, Value], lengths: Mapping[str, int]) -> LengthOf:
    occurrences = {path: iter(value) for path, value in values.items() if isinstance(value, list)}

    def length_of(word: LengthWord) -> int:
        value = values.get(word.path)
        if word.is_string:
            text = next(occurrences[word.path]) if word.path in occurrences else value or ""
            return len(str(text).encode()) + 1
        return int(value.shape[1]) if isinstance(value, np.ndarray) else lengths.get(word.path, 0)

    return length_of


def _fill(payloads: Bytes, column: Column, value: Value) -> None:
    if isinstance(value, str | list):
        texts = [value] * len(column.runs) if isinstance(value, str) else value
        characters = b"".join(str(text).encode() + b"\0" for text in texts)
        payloads[:, _places(column)] = np.frombuffer(characters, np.uint8)
        return
    columns = np.asarray(value, column.dtype)
    columns = columns.reshape(-1, 1) if columns.ndim == 1 and column.is_single else columns
    columns = np.broadcast_to(columns, (len(payloads), sum(count for _, count in column.runs)))
    octets = np.ascontiguousarray(columns).view(np.uint8)
    if len(column.runs) == 1:
        at = column.runs[0][0]
        payloads[:, at : at + octets.shape[1]] = octets
    else:
        payloads[:, _places(column)] = octets


def _places(column: Column) -> Ints:
    """Offsets of all bytes of a column, in order."""
    runs = np.array(column.runs, np.int64).reshape(-1, 2)
    sizes = runs[:, 1] * column.dtype.itemsize
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.repeat(runs[:, 0], sizes) + within
