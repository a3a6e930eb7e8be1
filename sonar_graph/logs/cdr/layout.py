"""A ROS 2 message type made ready for going through payloads.

Where a field lies in a payload depends on the type's definition and on the lengths of the strings and sequences before
it, on nothing else. A `Plan` is the definition as steps: neighbouring values of fixed number are one step, whatever
types they are nested in; every string, sequence, and array of strings or types is another. A `Walk` takes the steps
once, with the lengths read from a payload or given, and notes where each begins.

Encoding is plain CDR (XCDR1, OMG DDS-XTypes 1.3, 7.4.1): a four-byte encapsulation header, then primitives aligned to
their own size counted from after that header; a string is its length with the closing NUL as uint32 and its bytes; a
type without fields is one byte.

Where everything lies in payloads of one type whose strings and sequences have the same lengths.

Whether payloads are what their definition says.

A message that is not is left out and counted by what is wrong with it; those around it are read. Checked are the
encapsulation, that everything lies within the payload, that the payload ends where its definition ends (but for the
padding to four bytes that DDS adds), that booleans are 0 or 1, and that strings are UTF-8 and closed by a NUL.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from struct import Struct as Packing
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.logs.cdr.definitions import PRIMITIVES, STRING, Field, Struct
from sonar_graph.measurements import Ints

HEADER_BYTES = 4
LENGTH_BYTES = 4
BYTE_ORDERS = "<>"
_PHASES = 8


def padding(at: int, size: int) -> int:
    """Bytes left free before a primitive of ``size`` bytes that follows byte ``at``."""
    return -(at - HEADER_BYTES) % size


class PayloadWalk:
    """Notes where things lie while the steps of a plan are taken."""

    def __init__(self, steps: int, length_of: Callable[[DecodingStep, int], int], most_elements: int | None) -> None:
        self.found: list[list[int]] = [[] for _ in range(steps)]
        """By step: the start of each block; start and count in turn of all else."""
        self.words: list[tuple[int, int]] = []
        """Byte offset and value of each length word."""
        self.end = HEADER_BYTES
        self.most_elements = most_elements
        self._length_of = length_of

    def length(self, step: DecodingStep, at: int) -> tuple[int, int]:
        """The byte after a step's length word, and the word's value."""
        at += -at % LENGTH_BYTES  # as much as after the header, which is as long
        count = self._length_of(step, at)
        self.words.append((at, count))
        return at + LENGTH_BYTES, count


class DecodingStep(ABC):
    """A part of a message type."""

    def __init__(self, index: int, path: str) -> None:
        self.index = index
        self.path = path

    @abstractmethod
    def take(self, at: int, walk: PayloadWalk) -> int:
        """Note where the part after byte ``at`` lies; the byte after it."""


@dataclass(frozen=True)
class Value:
    """One field of fixed number within a block."""

    path: str
    kind: str
    """numpy's type, without its byte order."""
    count: int
    is_single: bool
    """No array or sequence on the path: one value a message."""


class FieldBlock(DecodingStep):
    """Values of fixed number side by side."""

    def __init__(self, index: int, values: list[Value]) -> None:
        super().__init__(index, values[0].path)
        self.offsets = {value.path: [0] * _PHASES for value in values}
        """From the block's start, by the remainder of that start after division by 8."""
        self.counts = {value.path: value.count for value in values}
        self._sizes = [0] * _PHASES
        for phase in range(_PHASES):
            start = at = _PHASES + phase
            for value in values:
                size = np.dtype(value.kind).itemsize
                at += padding(at, size)
                self.offsets[value.path][phase] = at - start
                at += size * value.count
            self._sizes[phase] = at - start

    def take(self, at: int, walk: PayloadWalk) -> int:
        """Note where the block begins, before any padding."""
        walk.found[self.index].append(at)
        return at + self._sizes[at % _PHASES]


class Numbers(DecodingStep):
    """A sequence of numbers."""

    def __init__(self, index: int, path: str, kind: str) -> None:
        super().__init__(index, path)
        self._size = np.dtype(kind).itemsize

    def take(self, at: int, walk: PayloadWalk) -> int:
        """Note where the first number lies, and how many there are."""
        at, count = walk.length(self, at)
        if count:
            at += padding(at, self._size)
        walk.found[self.index] += (at, count)
        return at + count * self._size


class Text(DecodingStep):
    """A string."""

    def take(self, at: int, walk: PayloadWalk) -> int:
        """Note where the characters lie, and how many there are with the closing NUL."""
        at, count = walk.length(self, at)
        walk.found[self.index] += (at, count)
        return at + count


class Repeated(DecodingStep):
    """An array or sequence of strings or of another type."""

    def __init__(self, index: int, path: str, count: int | None, steps: list[DecodingStep]) -> None:
        super().__init__(index, path)
        self._count = count
        self._steps = steps

    def take(self, at: int, walk: PayloadWalk) -> int:
        """Note where the elements begin and how many there are, and go through them."""
        at, count = walk.length(self, at) if self._count is None else (at, self._count)
        walk.found[self.index] += (at, count)
        if walk.most_elements is not None and count > walk.most_elements:
            return at + count  # every element has a byte at least, so this is beyond the end
        for _ in range(count):
            for step in self._steps:
                at = step.take(at, walk)
        return at


class Leaf(NamedTuple):
    """A field that holds values."""

    step: DecodingStep
    dtypes: Mapping[str, np.dtype[Any]]
    """Of one value, by byte order; for a string, one byte."""
    is_single: bool
    """No array or sequence on the path: one value a message."""


@cache
def _dtypes(kind: str) -> Mapping[str, np.dtype[Any]]:
    return {order: np.dtype(order + kind) for order in BYTE_ORDERS}


class Plan:
    """A message type as steps."""

    def __init__(self, definition: Struct) -> None:
        self.name = definition.name
        self.leaves: dict[str, Leaf] = {}
        """By path, such as ``header.stamp.sec``; a field within a sequence has one path for all elements."""
        self.sequences: dict[str, DecodingStep] = {}
        """By path, arrays and sequences but for arrays of numbers."""
        self._parts = 0
        self._steps = self._compile(definition, "", is_single=True)
        self.texts = [path for path, leaf in self.leaves.items() if isinstance(leaf.step, Text)]
        self.booleans = [path for path, leaf in self.leaves.items() if leaf.dtypes["<"] == np.bool_]

    def walk(self, length_of: Callable[[DecodingStep, int], int], most_elements: int | None = None) -> PayloadWalk:
        """Take all steps.

        Parameters
        ----------
        length_of
            The value of a step's length word, which lies at a byte.
        most_elements
            What no array can exceed, because the payload ends.
        """
        walk = PayloadWalk(self._parts, length_of, most_elements)
        for step in self._steps:
            walk.end = step.take(walk.end, walk)
        return walk

    def _compile(self, definition: Struct, prefix: str, *, is_single: bool) -> list[DecodingStep]:
        steps: list[DecodingStep] = []
        values: list[Value] = []
        self._add(definition, prefix, is_single, steps, values)
        self._close(steps, values)
        return steps

    def _add(
        self, definition: Struct, prefix: str, is_single: bool, steps: list[DecodingStep], values: list[Value]
    ) -> None:
        if not definition.fields:
            values.append(Value(prefix, "u1", 1, is_single))
        for entry in definition.fields:
            path, single = prefix + entry.name, is_single and not entry.is_array
            if isinstance(entry.kind, Struct) and not entry.is_array:
                self._add(entry.kind, path + ".", single, steps, values)
            elif isinstance(entry.kind, str) and entry.kind != STRING and entry.length is not None:
                values.append(Value(path, PRIMITIVES[entry.kind], entry.length, single))
            else:
                self._close(steps, values)
                steps.append(self._step(entry, path, single))

    def _step(self, entry: Field, path: str, is_single: bool) -> DecodingStep:
        if isinstance(entry.kind, Struct):
            inner = self._compile(entry.kind, path + ".", is_single=False)
        elif entry.kind == STRING:
            text = Text(self._next(), path)
            self.leaves[path] = Leaf(text, _dtypes("u1"), is_single)
            if not entry.is_array:
                return text
            inner = [text]
        else:
            kind = PRIMITIVES[entry.kind]
            self.sequences[path] = numbers = Numbers(self._next(), path, kind)
            self.leaves[path] = Leaf(numbers, _dtypes(kind), is_single)
            return numbers
        self.sequences[path] = repeated = Repeated(self._next(), path, entry.length, inner)
        return repeated

    def _close(self, steps: list[DecodingStep], values: list[Value]) -> None:
        """Make a block of the values gathered so far."""
        if values:
            block = FieldBlock(self._next(), values)
            steps.append(block)
            for value in values:
                if value.path and not value.path.endswith("."):  # that is the byte of a type without fields
                    self.leaves[value.path] = Leaf(block, _dtypes(value.kind), value.is_single)
            values.clear()

    def _next(self) -> int:
        self._parts += 1
        return self._parts - 1


@lru_cache(maxsize=256)
def plan_of(definition: Struct) -> Plan:
    """The plan of a message type."""
    return Plan(definition)


Bytes = NDArray[np.uint8]
ENCAPSULATIONS = {">": bytes([0, 0]), "<": bytes([0, 1])}
"""How a payload begins, by byte order."""


class PayloadColumn(NamedTuple):
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

    def __init__(self, plan: Plan, byte_order: str, walk: PayloadWalk) -> None:
        self.columns = plan.leaves
        """The fields that hold values, by path, such as ``header.stamp.sec``."""
        self.byte_order = byte_order
        self.size = walk.end
        self.words = walk.words
        self._plan = plan
        self._found = walk.found

    def column(self, path: str) -> PayloadColumn:
        """Where a field's values lie.

        Raises
        ------
        KeyError
            When the type has no such field, or it holds no values itself.
        """
        step, dtypes, is_single = self.columns[path]
        found = self._found[step.index]
        if isinstance(step, FieldBlock):
            offsets = step.offsets[path]
            starts = [start + offsets[start % len(offsets)] for start in found]
            return PayloadColumn(dtypes[self.byte_order], is_single, starts, [step.counts[path]] * len(found))
        return PayloadColumn(dtypes[self.byte_order], is_single, found[::2], found[1::2])

    def lengths(self, path: str) -> list[int]:
        """Number of elements of an array or sequence, one each time it occurs.

        Raises
        ------
        KeyError
            When the type has no such field.
        """
        sequence = self._plan.sequences.get(path)
        return self.column(path).counts if sequence is None else self._found[sequence.index][1::2]

    def texts(self) -> Iterator[tuple[str, PayloadColumn]]:
        """Every string field with its path; the closing NUL counts as one of its bytes."""
        return ((path, self.column(path)) for path in self._plan.texts)

    def booleans(self) -> Iterator[tuple[str, PayloadColumn]]:
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


MOST_PADDING = 3
_UNPACK_LENGTH = {order: Packing(order + "I").unpack_from for order in ENCAPSULATIONS}
_BYTE_ORDERS = {start: order for order, start in ENCAPSULATIONS.items()}
_OTHER_ENCAPSULATIONS = {2: "PL_CDR", 3: "PL_CDR", **dict.fromkeys(range(6, 12), "XCDR2")}


class UnsoundMessageError(Exception):
    """A payload is not what its definition says; the text completes "3 messages ..."."""


def layout_of(plan: Plan, payload: memoryview) -> Layout:
    """The layout of a payload.

    Raises
    ------
    UnsoundMessageError
        When it is not plain CDR, or shorter or longer than its definition says.
    """
    order = _byte_order(payload)
    unpack, size = _UNPACK_LENGTH[order], len(payload)

    def read_length(step: DecodingStep, at: int) -> int:
        if at + LENGTH_BYTES > size:
            raise UnsoundMessageError(f"that end before {step.path}")
        length: int = unpack(payload, at)[0]
        if length > size - at:
            raise UnsoundMessageError(f"with a length of {step.path} beyond their end")
        return length

    walk = plan.walk(read_length, most_elements=size)
    if walk.end > size:
        raise UnsoundMessageError("that end before their definition does")
    if walk.end < size - MOST_PADDING:
        raise UnsoundMessageError("that are longer than their definition says")
    return Layout(plan, order, walk)


def _byte_order(payload: memoryview) -> str:
    if len(payload) < HEADER_BYTES:
        raise UnsoundMessageError("without an encapsulation header")
    order = _BYTE_ORDERS.get(bytes(payload[:2]))
    if order is None:
        kind = _OTHER_ENCAPSULATIONS.get(payload[1]) if payload[0] == 0 else None
        raise UnsoundMessageError(f"encoded as {kind or payload[:HEADER_BYTES].hex()} instead of plain CDR")
    return order


def unsound_contents(layout: Layout, payloads: Bytes) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """What is wrong with booleans and strings of payloads that share a layout, and which have it, shape (n,)."""
    for path, column in layout.booleans():
        for start, count in zip(column.starts, column.counts, strict=True):
            has_it = np.asarray((payloads[:, start : start + count] > 1).any(axis=1))
            if has_it.any():
                yield f"with a boolean {path} that is neither 0 nor 1", has_it
    many, first = len(payloads) > 1, payloads[0].data
    for path, column in layout.texts():
        for start, length in zip(column.starts, column.counts, strict=True):
            end = start + length
            characters = payloads[:, start:end].tobytes() if many else bytes(first[start:end])
            if length and (any(characters[length - 1 :: length]) or not characters.isascii()):
                has_it = np.array([not _is_text(characters[i : i + length]) for i in range(0, len(characters), length)])
                if has_it.any():
                    yield f"with a string {path} that is not UTF-8 closed by a NUL", has_it


def _is_text(characters: bytes) -> bool:
    try:
        characters.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return characters.endswith(b"\0")
