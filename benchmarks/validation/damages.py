"""Ways in which a log gets damaged."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from log_truth import Truth

Generator = np.random.Generator


@dataclass(frozen=True)
class Damaged:
    """A damaged file."""

    path: Path
    kind: str
    content: bytes


def _flip(content: bytes, start: int, end: int, rng: Generator) -> bytes:
    """One bit other."""
    changed = bytearray(content)
    changed[int(rng.integers(start, end))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _record(truth: Truth, rng: Generator, opcodes: tuple[int, ...]) -> tuple[int, int]:
    """Start and end of one record of these kinds, or of any where there is none."""
    places = [(start, end) for opcode, start, end in truth.records if opcode in opcodes]
    places = places or [(start, end) for _, start, end in truth.records]
    return places[int(rng.integers(len(places)))]


def cut(content: bytes, _: Truth, rng: Generator) -> bytes:
    return content[: int(rng.integers(9, len(content)))]


def flip_anywhere(content: bytes, _: Truth, rng: Generator) -> bytes:
    return _flip(content, 8, len(content), rng)


def flip_in_chunk(content: bytes, truth: Truth, rng: Generator) -> bytes:
    start, end = _record(truth, rng, (6,))
    return _flip(content, min(start + 53, end - 1), end, rng)


def flip_in_chunk_head(content: bytes, truth: Truth, rng: Generator) -> bytes:
    start, end = _record(truth, rng, (6,))
    return _flip(content, start, min(start + 53, end), rng)


def flip_length(content: bytes, truth: Truth, rng: Generator) -> bytes:
    start, _ = _record(truth, rng, (1, 3, 4, 5, 6, 7, 12))
    return _flip(content, start + 1, start + 9, rng)


def flip_outside_chunks(content: bytes, truth: Truth, rng: Generator) -> bytes:
    start, end = _record(truth, rng, (1, 2, 3, 4, 7, 8, 11, 12, 13, 14, 15))
    return _flip(content, start, end, rng)


def flip_metadata(content: bytes, truth: Truth, rng: Generator) -> bytes:
    return _flip(content, *_record(truth, rng, (12,)), rng)


def without_summary(content: bytes, truth: Truth, rng: Generator) -> bytes:
    return content[: truth.data_end + (13 if rng.random() < 0.5 else 0)]


def zeroed_summary(content: bytes, truth: Truth, _: Generator) -> bytes:
    end = truth.data_end + 13
    return content[:end] + bytes(len(content) - end)


def garbage_tail(content: bytes, truth: Truth, rng: Generator) -> bytes:
    kept = content if rng.random() < 0.5 else cut(content, truth, rng)
    return kept + rng.bytes(int(rng.integers(1, 5000)))


def zero_tail(content: bytes, truth: Truth, rng: Generator) -> bytes:
    kept = content if rng.random() < 0.3 else cut(content, truth, rng)
    return kept + bytes(int(rng.integers(1, 100_000)))


def zeroed_block(content: bytes, _: Truth, rng: Generator) -> bytes:
    at = 512 * int(rng.integers(1, len(content) // 512))
    return content[:at] + bytes(512) + content[at + 512 :]


def foreign_block(content: bytes, _: Truth, rng: Generator) -> bytes:
    at, size = int(rng.integers(8, len(content))), int(rng.integers(1, 5000))
    return content[:at] + rng.bytes(min(size, len(content) - at)) + content[at + size :]


def missing_block(content: bytes, _: Truth, rng: Generator) -> bytes:
    at = int(rng.integers(8, len(content)))
    return content[:at] + content[at + int(rng.integers(1, 5000)) :]


def doubled_block(content: bytes, _: Truth, rng: Generator) -> bytes:
    at = int(rng.integers(8, len(content)))
    return (
        content[:at]
        + content[max(at - int(rng.integers(1, 5000)), 0) : at]
        + content[at:]
    )


DAMAGES: dict[str, Callable[[bytes, Truth, Generator], bytes]] = {
    function.__name__.replace("_", " "): function
    for function in (
        cut,
        flip_anywhere,
        flip_in_chunk,
        flip_in_chunk_head,
        flip_length,
        flip_outside_chunks,
        flip_metadata,
        without_summary,
        zeroed_summary,
        garbage_tail,
        zero_tail,
        zeroed_block,
        foreign_block,
        missing_block,
        doubled_block,
    )
}
