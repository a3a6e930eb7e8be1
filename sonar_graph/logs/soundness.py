"""Whether payloads are what their definition says.

A message that is not is left out and counted by what is wrong with it; those around it are read. Checked are the
encapsulation, that everything lies within the payload, that the payload ends where its definition ends (but for the
padding to four bytes that DDS adds), that booleans are 0 or 1, and that strings are UTF-8 and closed by a NUL.
"""

from __future__ import annotations

from collections.abc import Iterator
from struct import Struct as Packing

import numpy as np
from numpy.typing import NDArray

from sonar_graph.logs.layout import ENCAPSULATIONS, Bytes, Layout
from sonar_graph.logs.plan import HEADER_BYTES, LENGTH_BYTES, Plan, Step

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

    def read_length(step: Step, at: int) -> int:
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
