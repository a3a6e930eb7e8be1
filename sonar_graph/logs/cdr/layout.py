"""Layout of CDR payloads: the place of every field of a ROS 2 message type, and whether payloads follow their type.

The place of a field depends only on the type and on the lengths of the strings and sequences before it. A `Plan` is the
type as steps: neighbouring values of fixed number are one step, whatever types they are nested in; each string, each
sequence, and each array of strings or types is another. A `Layout` takes the steps once, with lengths read from a
payload or given, and notes where each begins. It holds for all payloads with the same lengths.

Encoding is plain CDR (XCDR1, OMG DDS-XTypes 1.3, 7.4.1): a four-byte encapsulation header, then primitives aligned to
their own size counted from after that header; a string is its length with the closing NUL as uint32 and its bytes; a
type without fields is one byte.

A payload is sound when its encapsulation is plain CDR, everything lies within it, it ends where its definition ends
(but for the padding to four bytes that DDS adds), booleans are 0 or 1, and strings are UTF-8 and closed by a NUL.
Other messages are left out and counted by their fault.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import cached_property, lru_cache
from itertools import groupby
from struct import Struct as Packing
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.logs.cdr.definitions import PRIMITIVES, STRING, Field, Struct
from sonar_graph.measurements import Ints

HEADER_BYTES = 4
LENGTH_BYTES = 4
_PHASES = 8


def padding(at: int, size: int) -> int:
    """Bytes of padding before a primitive of ``size`` bytes at byte ``at``."""
    return -(at - HEADER_BYTES) % size


LengthOf = Callable[["DecodingStep", int], int]
"""Value of the length word of a step at a byte offset."""


class DecodingStep(ABC):
    """Part of a message type."""

    is_text = False

    def __init__(self, path: str) -> None:
        self.path = path

    @abstractmethod
    def take(self, at: int, layout: Layout) -> int:
        """Note the place of the part at byte ``at``; returns the byte after it."""


class Value(NamedTuple):
    """Field with a fixed number of values within a block."""

    path: str
    kind: str
    """Type in numpy, without the byte order."""
    number: int
    is_single: bool
    """True without an array or sequence on the path: one value a message."""


class FieldBlock(DecodingStep):
    """Neighbouring values of fixed number."""

    def __init__(self, values: list[Value]) -> None:
        super().__init__(values[0].path)
        self.offsets = {value.path: [0] * _PHASES for value in values}
        """Offsets from the start of the block, by that start modulo 8."""
        self.counts = {value.path: value.number for value in values}
        self._sizes = [0] * _PHASES
        # alignment depends on where the block begins, so that there are eight sets of offsets
        for phase in range(_PHASES):
            start = at = _PHASES + phase
            for value in values:
                size = np.dtype(value.kind).itemsize
                at += padding(at, size)
                self.offsets[value.path][phase] = at - start
                at += size * value.number
            self._sizes[phase] = at - start

    def take(self, at: int, layout: Layout) -> int:
        """Note the start of the block, before any padding."""
        layout.found[self].append(at)
        return at + self._sizes[at % _PHASES]


class Counted(DecodingStep):
    """Values whose count is in the payload: a string, or a sequence of numbers."""

    def __init__(self, path: str, kind: str, *, is_text: bool) -> None:
        super().__init__(path)
        self.is_text = is_text
        self._size = np.dtype(kind).itemsize

    def take(self, at: int, layout: Layout) -> int:
        """Note the place of the first value and their count; the NUL that closes a string is one."""
        at, count = layout.counted(self, at)
        # numbers are aligned where there is one, and texts need no step for it
        if count and self._size > 1:
            at += padding(at, self._size)
        layout.found[self] += (at, count)
        return at + count * self._size


class Repeated(DecodingStep):
    """Array or sequence of strings or of another type."""

    def __init__(self, path: str, count: int | None, steps: list[DecodingStep]) -> None:
        super().__init__(path)
        self._count = count
        self._steps = steps

    def take(self, at: int, layout: Layout) -> int:
        """Note the start and count of the elements, and walk through them."""
        # a fixed array has no length word
        at, count = (
            layout.counted(self, at) if self._count is None else (at, self._count)
        )
        layout.found[self] += (at, count)
        if count > layout.most_elements:
            # every element has a byte at least, so this is beyond the end
            return at + count
        for _ in range(count):
            for step in self._steps:
                at = step.take(at, layout)
        return at


class Leaf(NamedTuple):
    """Field that holds values."""

    step: DecodingStep
    kind: str
    """Type of one value in numpy, without the byte order; of a string, one byte."""
    is_single: bool
    """True without an array or sequence on the path: one value a message."""


class Plan:
    """Message type as steps."""

    def __init__(self, definition: Struct) -> None:
        self.name = definition.name
        self.leaves: dict[str, Leaf] = {}
        """Leaves by path, such as ``header.stamp.sec``; all elements of a sequence share one path."""
        self.sequences: dict[str, DecodingStep] = {}
        """Arrays and sequences by path, without arrays of numbers."""
        self.steps = self._compile(definition, "", is_single=True)
        self.texts = [path for path, leaf in self.leaves.items() if leaf.step.is_text]
        self.booleans = [path for path, leaf in self.leaves.items() if leaf.kind == "?"]

    def _compile(
        self, definition: Struct, prefix: str, *, is_single: bool
    ) -> list[DecodingStep]:
        """Steps of a type, of which neighbouring values of fixed number are one."""
        steps: list[DecodingStep] = []
        parts = self._parts(definition, prefix, is_single)
        for kind, run in groupby(parts, type):
            found = list(run)
            steps += [self._block(found)] if kind is Value else found
        return steps

    def _parts(self, definition: Struct, prefix: str, is_single: bool) -> Iterator[Any]:
        """Values of fixed number, and steps for all else."""
        if not definition.fields:
            yield Value(prefix, "u1", 1, is_single)
        for entry in definition.fields:
            path = prefix + entry.name
            single = is_single and not entry.is_array
            # a nested type is part of the block: CDR has no mark where it begins
            if isinstance(entry.kind, Struct) and not entry.is_array:
                yield from self._parts(entry.kind, path + ".", single)
            elif (
                isinstance(entry.kind, str)
                and entry.kind != STRING
                and entry.length is not None
            ):
                yield Value(path, PRIMITIVES[entry.kind], entry.length, single)
            else:
                yield self._step(entry, path, single)

    def _block(self, values: list[Value]) -> FieldBlock:
        """A step for some values, each of which is then known by its path."""
        block = FieldBlock(values)
        for path, kind, _, is_single in values:
            # a type without fields has a byte that is no field
            if path and not path.endswith("."):
                self.leaves[path] = Leaf(block, kind, is_single)
        return block

    def _step(self, entry: Field, path: str, is_single: bool) -> DecodingStep:
        if isinstance(entry.kind, Struct):
            inner = self._compile(entry.kind, path + ".", is_single=False)
        else:
            is_text = entry.kind == STRING
            kind = PRIMITIVES.get(entry.kind, "u1")
            counted = Counted(path, kind, is_text=is_text)
            self.leaves[path] = Leaf(counted, kind, is_single)
            # strings in an array or sequence have a length word each
            if not is_text or not entry.is_array:
                return counted
            inner = [counted]
        repeated = Repeated(path, entry.length, inner)
        self.sequences[path] = repeated
        return repeated


@lru_cache(maxsize=256)
def plan_of(definition: Struct) -> Plan:
    """Plan of a message type."""
    return Plan(definition)


Bytes = NDArray[np.uint8]
ENCAPSULATIONS = {">": bytes([0, 0]), "<": bytes([0, 1])}
"""First bytes of a payload by byte order."""


class PayloadColumn(NamedTuple):
    """Places of the values of one field."""

    dtype: np.dtype[Any]
    """Type of one value; for a string, one byte."""
    is_single: bool
    """True without an array or sequence on the path: one value a message."""
    starts: list[int]
    """Byte offset of each stretch."""
    counts: list[int]
    """Number of values of each stretch."""


class Layout:
    """Places of all fields in payloads with the same lengths of strings and sequences."""

    def __init__(
        self,
        plan: Plan,
        byte_order: str,
        length_of: LengthOf,
        most_elements: float = math.inf,
    ) -> None:
        self.columns = plan.leaves
        """Fields that hold values by path, such as ``header.stamp.sec``."""
        self.byte_order = byte_order
        self.plan = plan
        self.found: dict[DecodingStep, list[int]] = defaultdict(list)
        """By step: the start of each block; for other steps start and count in turn."""
        self.words: list[tuple[int, int]] = []
        """Byte offset and value of each length word."""
        self.most_elements = most_elements
        """An array of more would reach beyond the end of the payload."""
        self._places: dict[str, PayloadColumn] = {}
        self._length_of = length_of
        self.size = HEADER_BYTES
        for step in plan.steps:
            self.size = step.take(self.size, self)
        # it refers to the payload, which a layout that is remembered must not keep in memory
        del self._length_of

    def counted(self, step: DecodingStep, at: int) -> tuple[int, int]:
        """Byte after a step's length word, and the value of the word."""
        at += -at % LENGTH_BYTES  # as much as after the header, which is as long
        count = self._length_of(step, at)
        self.words.append((at, count))
        return at + LENGTH_BYTES, count

    def column(self, path: str) -> PayloadColumn:
        """Places of the values of a field; a KeyError where the type has no such field with values of its own."""
        place = self._places.get(path)
        if place is None:
            place = self._places[path] = self._place(path)
        return place

    def _place(self, path: str) -> PayloadColumn:
        step, kind, is_single = self.columns[path]
        dtype = np.dtype(self.byte_order + kind)
        found = self.found[step]
        if not isinstance(step, FieldBlock):
            return PayloadColumn(dtype, is_single, found[::2], found[1::2])
        offsets = step.offsets[path]
        starts = [start + offsets[start % _PHASES] for start in found]
        counts = [step.counts[path]] * len(found)
        return PayloadColumn(dtype, is_single, starts, counts)

    def lengths(self, path: str) -> list[int]:
        """Number of elements of an array or sequence, one each time it occurs."""
        if path not in self.plan.sequences:
            return self.column(path).counts
        return self.found[self.plan.sequences[path]][1::2]

    def same(self, payloads: Bytes, rows: Ints) -> NDArray[np.bool_]:
        """True for each of some rows of payloads, shape (n, size), that has this layout."""
        places, expected = self._distinction
        every = len(rows) == len(payloads)
        some = payloads[:, places] if every else payloads[np.ix_(rows, places)]
        return (some == expected).all(axis=1)

    @cached_property
    def _distinction(self) -> tuple[Ints, Bytes]:
        """Places and values of the bytes of the encapsulation and of all length words."""
        words = np.array(self.words, np.int64).reshape(-1, 2)
        at = words[:, :1] + np.arange(LENGTH_BYTES)
        lengths = words[:, 1].astype(f"{self.byte_order}u{LENGTH_BYTES}").view(np.uint8)
        start = np.frombuffer(ENCAPSULATIONS[self.byte_order], np.uint8)
        return np.append([0, 1], at), np.append(start, lengths)


MOST_PADDING = 3
_UNPACK_LENGTH = {order: Packing(order + "I").unpack_from for order in ENCAPSULATIONS}
_BYTE_ORDERS = {start: order for order, start in ENCAPSULATIONS.items()}
_OTHER_ENCAPSULATIONS = {
    2: "PL_CDR",
    3: "PL_CDR",
    **dict.fromkeys(range(6, 12), "XCDR2"),
}


class UnsoundMessageError(Exception):
    """Payload that does not follow its definition; the text completes "3 messages ..."."""


def layout_of(plan: Plan, payload: memoryview) -> Layout:
    """Layout of a payload; an UnsoundMessageError where it is not plain CDR or not as long as its definition requires."""
    if len(payload) < HEADER_BYTES:
        raise UnsoundMessageError("without an encapsulation header")
    order = _BYTE_ORDERS.get(bytes(payload[:2]))
    if order is None:
        kind = _OTHER_ENCAPSULATIONS.get(payload[1]) if payload[0] == 0 else None
        raise UnsoundMessageError(
            f"encoded as {kind or payload[:HEADER_BYTES].hex()} instead of plain CDR"
        )
    unpack = _UNPACK_LENGTH[order]
    size = len(payload)

    def read_length(step: DecodingStep, at: int) -> int:
        if at + LENGTH_BYTES > size:
            raise UnsoundMessageError(f"that end before {step.path}")
        length: int = unpack(payload, at)[0]
        if length > size - at:
            raise UnsoundMessageError(f"with a length of {step.path} beyond their end")
        return length

    layout = Layout(plan, order, read_length, size)
    if layout.size > size:
        raise UnsoundMessageError("that end before their definition does")
    # a definition that is too short would read as sound
    if layout.size < size - MOST_PADDING:
        raise UnsoundMessageError("that are longer than their definition says")
    return layout


def unsound_contents(
    layout: Layout, payloads: Bytes
) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Faults of booleans and strings of payloads that share a layout, and the rows that have them, shape (n,)."""
    for path in layout.plan.booleans:
        column = layout.column(path)
        for start, count in zip(column.starts, column.counts, strict=True):
            has_it = np.asarray((payloads[:, start : start + count] > 1).any(axis=1))
            if has_it.any():
                yield f"with a boolean {path} that is neither 0 nor 1", has_it
    for path in layout.plan.texts:
        column = layout.column(path)
        for start, length in zip(column.starts, column.counts, strict=True):
            # bytes as one object: numpy would take longer for single messages
            text = payloads[:, start : start + length].tobytes()
            if length and (any(text[length - 1 :: length]) or not text.isascii()):
                texts = [text[i : i + length] for i in range(0, len(text), length)]
                has_it = np.array([not _is_text(one) for one in texts])
                if has_it.any():
                    fault = f"with a string {path} that is not UTF-8 closed by a NUL"
                    yield fault, has_it


def _is_text(characters: bytes) -> bool:
    try:
        characters.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return characters.endswith(b"\0")
