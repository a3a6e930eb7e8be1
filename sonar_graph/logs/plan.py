"""A ROS 2 message type made ready for going through payloads.

Where a field lies in a payload depends on the type's definition and on the lengths of the strings and sequences before
it, on nothing else. A `Plan` is the definition as steps: neighbouring values of fixed number are one step, whatever
types they are nested in; every string, sequence, and array of strings or types is another. A `Walk` takes the steps
once, with the lengths read from a payload or given, and notes where each begins.

Encoding is plain CDR (XCDR1, OMG DDS-XTypes 1.3, 7.4.1): a four-byte encapsulation header, then primitives aligned to
their own size counted from after that header; a string is its length with the closing NUL as uint32 and its bytes; a
type without fields is one byte.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from sonar_graph.logs.schema import PRIMITIVES, STRING, Field, Struct

HEADER_BYTES = 4
LENGTH_BYTES = 4
BYTE_ORDERS = "<>"
_PHASES = 8


def padding(at: int, size: int) -> int:
    """Bytes left free before a primitive of ``size`` bytes that follows byte ``at``."""
    return -(at - HEADER_BYTES) % size


class Walk:
    """Notes where things lie while the steps of a plan are taken."""

    def __init__(self, steps: int, length_of: Callable[[Step, int], int], most_elements: int | None) -> None:
        self.found: list[list[int]] = [[] for _ in range(steps)]
        """By step: the start of each block; start and count in turn of all else."""
        self.words: list[tuple[int, int]] = []
        """Byte offset and value of each length word."""
        self.end = HEADER_BYTES
        self.most_elements = most_elements
        self._length_of = length_of

    def length(self, step: Step, at: int) -> tuple[int, int]:
        """The byte after a step's length word, and the word's value."""
        at += -at % LENGTH_BYTES  # as much as after the header, which is as long
        count = self._length_of(step, at)
        self.words.append((at, count))
        return at + LENGTH_BYTES, count


class Step(ABC):
    """A part of a message type."""

    def __init__(self, index: int, path: str) -> None:
        self.index = index
        self.path = path

    @abstractmethod
    def take(self, at: int, walk: Walk) -> int:
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


class Block(Step):
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

    def take(self, at: int, walk: Walk) -> int:
        """Note where the block begins, before any padding."""
        walk.found[self.index].append(at)
        return at + self._sizes[at % _PHASES]


class Numbers(Step):
    """A sequence of numbers."""

    def __init__(self, index: int, path: str, kind: str) -> None:
        super().__init__(index, path)
        self._size = np.dtype(kind).itemsize

    def take(self, at: int, walk: Walk) -> int:
        """Note where the first number lies, and how many there are."""
        at, count = walk.length(self, at)
        if count:
            at += padding(at, self._size)
        walk.found[self.index] += (at, count)
        return at + count * self._size


class Text(Step):
    """A string."""

    def take(self, at: int, walk: Walk) -> int:
        """Note where the characters lie, and how many there are with the closing NUL."""
        at, count = walk.length(self, at)
        walk.found[self.index] += (at, count)
        return at + count


class Repeated(Step):
    """An array or sequence of strings or of another type."""

    def __init__(self, index: int, path: str, count: int | None, steps: list[Step]) -> None:
        super().__init__(index, path)
        self._count = count
        self._steps = steps

    def take(self, at: int, walk: Walk) -> int:
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

    step: Step
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
        self.sequences: dict[str, Step] = {}
        """By path, arrays and sequences but for arrays of numbers."""
        self._parts = 0
        self._steps = self._compile(definition, "", is_single=True)
        self.texts = [path for path, leaf in self.leaves.items() if isinstance(leaf.step, Text)]
        self.booleans = [path for path, leaf in self.leaves.items() if leaf.dtypes["<"] == np.bool_]

    def walk(self, length_of: Callable[[Step, int], int], most_elements: int | None = None) -> Walk:
        """Take all steps.

        Parameters
        ----------
        length_of
            The value of a step's length word, which lies at a byte.
        most_elements
            What no array can exceed, because the payload ends.
        """
        walk = Walk(self._parts, length_of, most_elements)
        for step in self._steps:
            walk.end = step.take(walk.end, walk)
        return walk

    def _compile(self, definition: Struct, prefix: str, *, is_single: bool) -> list[Step]:
        steps: list[Step] = []
        values: list[Value] = []
        self._add(definition, prefix, is_single, steps, values)
        self._close(steps, values)
        return steps

    def _add(self, definition: Struct, prefix: str, is_single: bool, steps: list[Step], values: list[Value]) -> None:
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

    def _step(self, entry: Field, path: str, is_single: bool) -> Step:
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

    def _close(self, steps: list[Step], values: list[Value]) -> None:
        """Make a block of the values gathered so far."""
        if values:
            block = Block(self._next(), values)
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
