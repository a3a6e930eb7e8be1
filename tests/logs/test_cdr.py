from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.logs.cdr import layout as plan
from sonar_graph.logs.cdr.definitions import parse_definition
from sonar_graph.logs.cdr.layout import Layout
from sonar_graph.logs.cdr.messages import Decoded, Decoder, decode, encode

from .random_schemas import check, stacked

NAME = "fuzz_msgs/msg/Root"
RULE = "=" * 80
START = bytes([0, 1, 0, 0])
TEXTS = st.text(st.characters(codec="utf-8"), max_size=9)


@pytest.fixture
def fresh_plans() -> Any:
    """Plans are remembered; those made with a deliberate fault must not be."""
    plan.plan_of.cache_clear()
    yield
    plan.plan_of.cache_clear()


def test_random_messages_decode_and_encode_as_with_two_other_libraries() -> None:
    tally = check(schemas=40, messages=5, seed=1000)
    assert tally.is_clean, tally.examples
    assert tally.messages == 40 * 5 * 2  # in both byte orders


@pytest.mark.slow
def test_many_random_messages_decode_and_encode_as_with_two_other_libraries() -> None:
    tally = check(schemas=300, messages=10)
    assert tally.is_clean, tally.examples
    assert (tally.schemas, tally.messages) == (300, 6000)


@pytest.mark.usefixtures("fresh_plans")
@pytest.mark.parametrize(
    "wrong",
    [
        lambda at, size: -(at - plan.HEADER_BYTES) % min(size, 4),  # the rule of XCDR2
        lambda at, size: -at % size,  # counted from before the header
        lambda *_: 0,
    ],
    ids=["of-XCDR2", "with-header", "none"],
)
def test_the_comparison_catches_a_wrong_alignment(monkeypatch: pytest.MonkeyPatch, wrong: Any) -> None:
    monkeypatch.setattr(plan, "padding", wrong)
    tally = check(schemas=20, messages=2, seed=1000)
    assert tally.unsound + tally.decoded_differently > 0


@pytest.mark.usefixtures("fresh_plans")
def test_the_comparison_catches_a_swapped_column(monkeypatch: pytest.MonkeyPatch) -> None:
    column = Layout.column

    def shifted(self: Layout, path: str) -> Any:
        found = column(self, path)
        return found._replace(starts=found.starts[::-1])

    monkeypatch.setattr(Layout, "column", shifted)
    assert check(schemas=20, messages=2, seed=1000).decoded_differently > 0


@given(st.data())
def test_writing_then_reading_is_the_identity_to_the_bit(data: st.DataObject) -> None:
    inner = "string name\nfloat32[] d\nuint8 e\n"
    text = (
        f"int8 a\nstring s\nfloat64[] v\nstring[] names\nPart[] parts\nbool[2] z\n{RULE}\nMSG: fuzz_msgs/Part\n{inner}"
    )
    definition = parse_definition(NAME, text)
    n, count = data.draw(st.integers(1, 4)), data.draw(st.integers(0, 3))
    each = data.draw(st.lists(st.integers(0, 3), min_size=count, max_size=count))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    bits = rng.integers(0, 1 << 63, (n, count), dtype=np.uint64)
    values = {
        "a": rng.integers(-128, 128, n),
        "s": data.draw(TEXTS),
        "v": bits.view(np.float64),  # any bits, NaN with a payload among them
        "names": data.draw(st.lists(TEXTS, max_size=3)),
        "parts.name": data.draw(st.lists(TEXTS, min_size=count, max_size=count)),
        "parts.d": rng.normal(size=(n, sum(each))).astype(np.float32),
        "z": rng.integers(0, 2, (n, 2)).astype(bool),
    }
    payloads = encode(definition, n, values, {"parts": count, "parts.d": each})
    (group,) = decode(definition, [(np.arange(n), payloads)]).groups
    np.testing.assert_array_equal(group["v"].view(np.uint64), bits)
    for path in ("a", "parts.d", "z"):
        np.testing.assert_array_equal(group[path], values[path])
    assert group["z"].dtype == bool
    assert group.strings("s") == [[values["s"]]] * n
    assert group.strings("names") == [values["names"]] * n
    assert group.strings("parts.name") == [values["parts.name"]] * n
    assert group.lengths("parts.d") == each
    assert not group["parts.e"].any()


def test_alignment_counts_from_after_the_encapsulation_header() -> None:
    definition = parse_definition(NAME, "uint8 a\nfloat64 b\nstring s\nuint16 c\n")
    by_hand = START + struct.pack("<B7xdI3sxH", 7, 1.5, 3, b"ab\0", 9)
    assert encode(definition, 1, {"a": 7, "b": 1.5, "s": "ab", "c": 9})[0].tobytes() == by_hand


def test_a_type_without_fields_takes_one_byte() -> None:
    definition = parse_definition(NAME, f"Nothing[] n\nuint16 a\n{RULE}\nMSG: fuzz_msgs/Nothing\n# no fields\n")
    by_hand = START + struct.pack("<I3sxH", 3, b"\0\0\0", 9)
    assert encode(definition, 1, {"a": 9}, {"n": 3})[0].tobytes() == by_hand
    assert decode(definition, stacked([by_hand])).groups[0]["a"].tolist() == [9]


def test_big_endian_messages_are_read() -> None:
    definition = parse_definition(NAME, "uint8 a\nfloat64 b\nint32[] c\n")
    by_hand = bytes([0, 0, 0, 0]) + struct.pack(">B7xdI2i", 7, 1.5, 2, -3, 4)
    (group,) = decode(definition, stacked([by_hand, by_hand])).groups
    assert group["a"].tolist() == [7, 7]
    assert group["b"].tolist() == [1.5, 1.5]
    assert group["c"].tolist() == [[-3, 4], [-3, 4]]


def test_byte_orders_are_told_apart_where_lengths_are_the_same() -> None:
    definition = parse_definition(NAME, "float64 a\n")
    payloads = [START + struct.pack("<d", 1.5), bytes(4) + struct.pack(">d", 2.5), START + struct.pack("<d", 3.5)]
    groups = decode(definition, stacked(payloads)).groups
    assert sorted((group.rows.tolist(), group["a"].tolist()) for group in groups) == [
        ([0, 2], [1.5, 3.5]),
        ([1], [2.5]),
    ]


def test_messages_of_one_length_but_different_layout_are_kept_apart() -> None:
    definition = parse_definition(NAME, "uint8[] a\nuint8[] b\n")
    # 1 + 5 and 5 + 1 bytes make payloads of the same length with the second length word elsewhere
    first = START + struct.pack("<IB3xI5s", 1, 9, 5, b"abcde")
    second = START + struct.pack("<I5s3xIB", 5, b"abcde", 1, 9)
    groups = decode(definition, stacked([first, second, first])).groups
    assert sorted((group.rows.tolist(), group["a"].shape[1]) for group in groups) == [([0, 2], 1), ([1], 5)]


def test_messages_with_a_layout_each_are_read_like_those_that_share_one() -> None:
    definition = parse_definition(NAME, "string[] names\nfloat64 a\n")
    splits = [(i, j) for i in range(1, 40) for j in range(1, 41 - i)] * 2
    lists = [["x" * i, "y" * j, "z" * (41 - i - j)] for i, j in splits]
    payloads = [
        encode(definition, 1, {"names": names, "a": float(row)})[0].tobytes() for row, names in enumerate(lists)
    ]
    seen: dict[int, tuple[list[str], float]] = {}
    for group in decode(definition, stacked(payloads)).groups:
        for row, names, value in zip(group.rows.tolist(), group.strings("names"), group["a"].tolist(), strict=True):
            seen[row] = names, value
    assert seen == {row: (names, float(row)) for row, names in enumerate(lists)}


def test_byte_orders_are_told_apart_where_every_message_has_its_own_layout() -> None:
    definition = parse_definition(NAME, "uint8[] a\nuint8[] b\nint32 c\n")
    sizes = [(4 * i, 160 - 4 * i) for i in range(41) for _ in "<>"]
    payloads = [
        bytes([0, order == "<", 0, 0]) + struct.pack(f"{order}I{a}sI{b}si", a, b"a" * a, b, b"b" * b, row)
        for row, ((a, b), order) in enumerate(zip(sizes, "<>" * 41, strict=True))
    ]
    groups = decode(definition, stacked(payloads)).groups
    found = {
        row: value for group in groups for row, value in zip(group.rows.tolist(), group["c"].tolist(), strict=True)
    }
    assert found == {row: row for row in range(82)}


def test_layouts_met_in_an_earlier_part_give_the_same_columns() -> None:
    definition = parse_definition(NAME, "string s\nfloat64[] v\n")
    payloads = encode(definition, 6, {"s": "abc", "v": np.arange(12.0).reshape(6, 2)})
    decoder, rows = Decoder(definition), np.arange(6)
    parts = [decoder.decode([(rows[part], payloads[part])]).groups[0] for part in (slice(2), slice(2, 5), slice(5, 6))]
    np.testing.assert_array_equal(np.concatenate([part["v"] for part in parts]), np.arange(12.0).reshape(6, 2))
    assert parts[0].layout is parts[1].layout is parts[2].layout


def test_a_column_that_lies_evenly_is_a_view_and_any_other_a_copy() -> None:
    text = f"float32[] image\nP[] points\nQ[] ragged\n{RULE}\nMSG: fuzz_msgs/P\nfloat64 x\nfloat64 y\n"
    text += f"{RULE}\nMSG: fuzz_msgs/Q\nstring name\nfloat64 x\n"
    definition = parse_definition(NAME, text)
    values = {"image": np.ones((2, 5)), "points.y": np.ones((2, 3)), "ragged.name": ["a", "b" * 9, "c"]}
    payloads = encode(definition, 2, values, {"points": 3, "ragged": 3})
    (group,) = decode(definition, [(np.arange(2), payloads)]).groups
    assert np.shares_memory(group.payloads, payloads)
    assert np.shares_memory(group["image"], payloads)
    assert np.shares_memory(group["points.y"], payloads)
    assert not np.shares_memory(group["ragged.x"], payloads)
    assert group["ragged.x"].shape == (2, 3)


def test_a_number_that_does_not_fit_is_not_written() -> None:
    definition = parse_definition(NAME, "uint8 a\nint32[] b\n")
    assert encode(definition, 2, {"a": np.array([0, 255])})[:, 4].tolist() == [0, 255]
    for values in ({"a": np.array([256])}, {"a": -1}, {"b": np.array([[1 << 31]])}, {"a": 1.5}, {"a": np.nan}):
        with pytest.raises(ValueError, match="does not fit"):
            encode(definition, 1, values)


def test_a_field_that_does_not_exist_is_neither_written_nor_read() -> None:
    definition = parse_definition(NAME, "float64 a\n")
    with pytest.raises(ValueError, match="nonsense"):
        encode(definition, 1, {"nonsense": 1.0})
    (group,) = decode(definition, [(np.arange(1), encode(definition, 1, {"a": 1.0}))]).groups
    with pytest.raises(KeyError):
        group["nonsense"]


def test_a_field_within_an_empty_sequence_is_there_without_values() -> None:
    definition = parse_definition(NAME, f"P[] points\n{RULE}\nMSG: fuzz_msgs/P\nint16 x\nstring s\n")
    decoded: Decoded = decode(definition, [(np.arange(2), encode(definition, 2, {}))])
    (group,) = decoded.groups
    assert group["points.x"].shape == (2, 0)
    assert group["points.x"].dtype == np.int16
    assert group.strings("points.s") == [[], []]
    assert group.first_string("points.s") == ""
