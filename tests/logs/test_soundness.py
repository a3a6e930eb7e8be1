from __future__ import annotations

import struct
import time
from collections.abc import Callable
from itertools import combinations, islice, pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic

from sonar_graph.logs.cdr.definitions import parse_definition
from sonar_graph.logs.cdr.messages import decode, encode

from .random_schemas import stacked

NAME = "test_msgs/msg/Thing"
TEXT = "string s\nbool[] flags\nfloat64[] values\nuint16 last\n"
DEFINITION = parse_definition(NAME, TEXT)
START = bytes([0, 1, 0, 0])


def whole(**values: Any) -> bytes:
    given = {"s": "abc", "flags": np.array([[True, False]]), "values": np.array([[1.5, 2.5]]), "last": 7}
    return encode(DEFINITION, 1, given | values)[0].tobytes()


def poked(at: int, *octets: int) -> bytes:
    payload = bytearray(whole())
    payload[at : at + len(octets)] = octets
    return bytes(payload)


# 0 header, 4 length of s, 8 "abc\0", 12 length of flags, 16 flags, 20 length of values, 28 values, 44 last, 46 end
BROKEN: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "without an encapsulation header"),
    "only part of a header": (START[:3], "without an encapsulation header"),
    "cut within a number": (whole()[:45], "that end before their definition does"),
    "cut before a length": (whole()[:20], "that end before values"),
    "with bytes left over": (whole() + bytes(4), "that are longer than their definition says"),
    "with a string beyond the end": (poked(4, 0xF0, 0xFF, 0xFF, 0xFF), "with a length of s beyond their end"),
    "with a sequence beyond the end": (poked(20, 0xF0, 0xFF, 0xFF, 0x7F), "with a length of values beyond their end"),
    "with a boolean of 2": (poked(17, 2), "with a boolean flags that is neither 0 nor 1"),
    "with a boolean of 255": (poked(16, 255), "with a boolean flags that is neither 0 nor 1"),
    "with bytes that are no UTF-8": (poked(9, 0xFF), "with a string s that is not UTF-8 closed by a NUL"),
    "with a string that goes on": (poked(11, 0x41), "with a string s that is not UTF-8 closed by a NUL"),
    "in XCDR2": (poked(1, 7), "encoded as XCDR2 instead of plain CDR"),
    "in a parameter list": (poked(1, 3), "encoded as PL_CDR instead of plain CDR"),
    "in something else": (poked(0, 9), "encoded as 09010000 instead of plain CDR"),
}


@pytest.mark.parametrize("kind", BROKEN)
@pytest.mark.parametrize("place", [0, 1, 3], ids=["first", "among", "last"])
def test_a_broken_message_is_named_and_those_around_it_are_read(kind: str, place: int) -> None:
    payload, fault = BROKEN[kind]
    payloads = [whole(last=i) for i in range(3)]
    payloads.insert(place, payload)
    decoded = decode(DEFINITION, stacked(payloads))
    assert {name: rows.tolist() for name, rows in decoded.unsound.items()} == {fault: [place]}
    rows = {
        int(row): int(last) for group in decoded.groups for row, last in zip(group.rows, group["last"], strict=True)
    }
    assert rows == {row: i for i, row in enumerate(row for row in range(4) if row != place)}


@pytest.mark.parametrize("padding", [1, 2, 3])
def test_the_padding_that_middleware_adds_is_no_fault(padding: int) -> None:
    decoded = decode(DEFINITION, stacked([whole() + bytes(padding)]))
    assert decoded.unsound == {}
    assert decoded.groups[0]["last"].tolist() == [7]


@pytest.mark.parametrize("text", ["ψ → 深い", "\U0001f420", "with \0 inside", "ends in \0"])
def test_text_that_is_not_ascii_is_no_fault(text: str) -> None:
    (group,) = decode(DEFINITION, stacked([whole(s=text), whole(s=text)])).groups
    assert group.strings("s") == [[text], [text]]


def test_a_string_of_no_bytes_at_all_is_an_empty_one() -> None:
    payload = START + struct.pack("<IIIH", 0, 0, 0, 7)
    (group,) = decode(DEFINITION, stacked([payload])).groups
    assert group.strings("s") == [[""]]
    assert group["last"].tolist() == [7]


@given(st.binary(max_size=80), st.integers(0, 46), st.integers(0, 46))
def test_no_bytes_crash_and_what_is_sound_is_what_another_library_reads(noise: bytes, start: int, end: int) -> None:
    payload = whole()[:start] + noise + whole()[end:]
    decoded = decode(DEFINITION, stacked([payload]))
    assert len(decoded.groups) + len(decoded.unsound) == 1
    for group in decoded.groups:
        theirs = generate_dynamic(NAME, TEXT)[NAME](payload)
        assert group.strings("s") == [[theirs.s]]
        assert group["flags"][0].tolist() == theirs.flags
        np.testing.assert_array_equal(group["values"][0], theirs.values)
        assert group["last"].tolist() == [theirs.last]


@pytest.mark.parametrize(
    "make",
    [
        lambda _: whole()[:45],
        lambda _: poked(17, 2),
        lambda i: START + struct.pack("<I", 16 + i % 3) + bytes(40),
        lambda i: whole(s="a" * (4 * i), flags=np.zeros((1, 4 * (300 - i)))),
    ],
    ids=["cut", "boolean", "length", "many layouts"],
)
def test_21_000_messages_that_are_broken_or_hardly_share_a_layout_take_no_longer_than_seconds(
    make: Callable[[int], bytes],
) -> None:
    payloads = [make(i) for i in range(300)] * 70
    stacks = stacked(payloads)
    start = time.perf_counter()
    decode(DEFINITION, stacks)
    assert time.perf_counter() - start < 3.0


def test_12_000_messages_of_one_length_with_a_layout_each_take_no_longer_than_seconds() -> None:
    ends = [(0, *cuts, 64) for cuts in islice(combinations(range(1, 64), 3), 12_000)]
    texts = [[4 * (b - a) for a, b in pairwise(cuts)] for cuts in ends]  # four strings of together 256 bytes
    payloads = [START + b"".join(struct.pack(f"<I{n}s", n, b"x" * (n - 1)) for n in lengths) for lengths in texts]
    stacks = stacked(payloads)
    assert len(stacks) == 1
    definition = parse_definition(NAME, "string[4] names\n")
    start = time.perf_counter()
    decoded = decode(definition, stacks)
    assert time.perf_counter() - start < 3.0
    assert len(decoded.groups) == 12_000


def test_a_fixed_array_without_end_is_found_out_before_it_is_walked() -> None:
    text = f"P[4000000000] points\n{'=' * 80}\nMSG: test_msgs/P\nstring s\n"
    decoded = decode(parse_definition(NAME, text), stacked([START + bytes(80)]))
    assert list(decoded.unsound) == ["that end before their definition does"]
