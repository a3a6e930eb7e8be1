from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2._dynamic import serialize_dynamic
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sonar_graph.errors import LogError
from sonar_graph.logs.cdr import decode, encode
from sonar_graph.logs.schema import parse_definition

INTEGERS = {"int8": 8, "uint8": 8, "int16": 16, "uint16": 16, "int32": 32, "uint32": 32, "int64": 64, "uint64": 64}
NAME = "fuzz_msgs/msg/Root"
TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)


def payload_stack(payloads: list[bytes]) -> list[tuple[np.ndarray, np.ndarray]]:
    """What the container hands over: payloads stacked by length."""
    sizes = np.array([len(p) for p in payloads])
    return [
        (np.flatnonzero(sizes == size), np.array([np.frombuffer(p, np.uint8) for p in payloads if len(p) == size]))
        for size in np.unique(sizes)
    ]


def leaf_values(kind: str) -> st.SearchStrategy[Any]:
    if kind == "string":
        return TEXTS
    if kind == "bool":
        return st.booleans()
    if kind in INTEGERS:
        bits = INTEGERS[kind]
        low = -(1 << (bits - 1)) if kind.startswith("i") else 0
        return st.integers(low, low + (1 << bits) - 1)
    return st.floats(width=32 if kind == "float32" else 64)


@st.composite
def definitions(draw: st.DrawFn, depth: int = 2) -> tuple[str, dict[str, str], Any]:
    """Lines of a type, the texts of the types that it uses, and a function that draws a value of it."""
    lines, others, makers = [], {}, {}
    for i in range(draw(st.integers(1, 5))):
        kind = draw(st.sampled_from(["bool", "float32", "float64", "string", *INTEGERS] + ["nested"] * (depth > 0)))
        maker = leaf_values(kind) if kind != "nested" else None
        if kind == "nested":
            kind = f"fuzz_msgs/T{depth}x{i}"
            text, more, maker = draw(definitions(depth - 1))
            renamed = {name: f"{name}of{depth}x{i}" for name in more}
            for old, new in renamed.items():
                text = text.replace(old + " ", new + " ").replace(old + "[", new + "[")
                more = {k: v.replace(old + " ", new + " ").replace(old + "[", new + "[") for k, v in more.items()}
            others |= {kind: text} | {renamed[k]: v for k, v in more.items()}
        array = draw(st.sampled_from(["", "[]", "[3]", "[<=4]"]))
        size = {"": None, "[]": (0, 4), "[3]": (3, 3), "[<=4]": (0, 4)}[array]
        makers[f"f{i}"] = maker if size is None else st.lists(maker, min_size=size[0], max_size=size[1])
        lines.append(f"{kind}{array} f{i}")
    return "\n".join(lines) + "\n", others, st.fixed_dictionaries(makers)


def leaves(value: Any, path: str = "") -> list[tuple[str, Any]]:
    """All values in a nested message with their paths, in order."""
    if isinstance(value, dict):
        return [leaf for name, v in value.items() for leaf in leaves(v, f"{path}.{name}" if path else name)]
    if isinstance(value, list):
        return [leaf for v in value for leaf in leaves(v, path)]
    return [(path, value)]


@given(st.data())
def test_columns_hold_what_another_library_encoded(data: st.DataObject) -> None:
    root, others, maker = data.draw(definitions())
    text = root + "".join(f"{'=' * 80}\nMSG: {name}\n{body}" for name, body in others.items())
    values = data.draw(st.lists(maker, min_size=1, max_size=4))
    encoder = serialize_dynamic(NAME, text)[NAME]
    groups = decode(parse_definition(NAME, text), payload_stack([encoder(v) for v in values]))
    assert sorted(row for group in groups for row in group.rows) == list(range(len(values)))
    for group in groups:
        for at, row in enumerate(group.rows):
            found: dict[str, list[Any]] = {}
            for path, value in leaves(values[row]):
                found.setdefault(path, []).append(value)
            for path, expected in found.items():
                if isinstance(expected[0], str):
                    assert group.strings(path)[at] == expected
                else:
                    actual = group[path]
                    np.testing.assert_array_equal(np.atleast_1d(actual[at]), np.array(expected, actual.dtype))


@given(st.integers(0, 5), st.integers(1, 4), TEXTS)
def test_rosbags_re_encodes_what_is_written_to_the_same_bytes(count: int, n: int, text: str) -> None:
    message = "uint8 a\nstring s\nfloat64[] v\nint16[3] w\nfuzz_msgs/Inner[] inner\nbool z\n"
    inner = "string name\nfloat64 d\nuint8 e\n"
    definition = parse_definition(NAME, message + f"{'=' * 80}\nMSG: fuzz_msgs/Inner\n{inner}")
    rng = np.random.default_rng(count)
    inners = count + 1
    values = {
        "a": np.arange(n),
        "s": text,
        "v": rng.normal(size=(n, count)),
        "w": rng.integers(-9, 9, (n, 3)),
        "z": True,
    }
    values |= {"inner.name": [text * (i % 3) for i in range(inners)], "inner.d": rng.normal(size=(n, inners))}
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(inner, "fuzz_msgs/msg/Inner") | get_types_from_msg(message, NAME))
    for i, payload in enumerate(encode(definition, n, values, {"inner": inners})):
        decoded = store.deserialize_cdr(payload.tobytes(), NAME)
        assert bytes(store.serialize_cdr(decoded, NAME)) == payload.tobytes()
        assert decoded.s == text
        np.testing.assert_array_equal(decoded.v, values["v"][i])
        assert [x.name for x in decoded.inner] == values["inner.name"]


def test_alignment_counts_from_after_the_encapsulation_header() -> None:
    definition = parse_definition(NAME, "uint8 a\nfloat64 b\nstring s\nuint16 c\n")
    by_hand = bytes([0, 1, 0, 0]) + struct.pack("<B7xdI3sxH", 7, 1.5, 3, b"ab\0", 9)
    assert encode(definition, 1, {"a": 7, "b": 1.5, "s": "ab", "c": 9})[0].tobytes() == by_hand


def test_big_endian_messages_are_read() -> None:
    definition = parse_definition(NAME, "uint8 a\nfloat64 b\nint32[] c\n")
    by_hand = bytes([0, 0, 0, 0]) + struct.pack(">B7xdI2i", 7, 1.5, 2, -3, 4)
    (group,) = decode(definition, payload_stack([by_hand, by_hand]))
    assert group["a"].tolist() == [7, 7]
    assert group["b"].tolist() == [1.5, 1.5]
    assert group["c"].tolist() == [[-3, 4], [-3, 4]]


def test_messages_of_one_length_but_different_layout_are_kept_apart() -> None:
    definition = parse_definition(NAME, "uint8[] a\nuint8[] b\n")
    # 1 + 5 and 5 + 1 bytes make payloads of the same length with the second length word elsewhere
    first = bytes([0, 1, 0, 0]) + struct.pack("<IB3xI5s", 1, 9, 5, b"abcde")
    second = bytes([0, 1, 0, 0]) + struct.pack("<I5s3xIB", 5, b"abcde", 1, 9)
    groups = decode(definition, payload_stack([first, second, first]))
    assert sorted((group.rows.tolist(), group["a"].shape[1]) for group in groups) == [([0, 2], 1), ([1], 5)]


@pytest.mark.parametrize("cut", [3, 5, 12, 19])
def test_a_payload_shorter_than_its_definition_is_refused(cut: int) -> None:
    definition = parse_definition(NAME, "string s\nfloat64 a\n")
    whole = encode(definition, 1, {"s": "abc", "a": 1.0})
    assert decode(definition, [(np.array([0]), whole)])[0]["a"][0] == 1.0
    with pytest.raises(LogError, match="fuzz_msgs/Root"):
        decode(definition, [(np.array([0]), whole[:, :cut])])


def test_a_length_beyond_the_payload_is_refused_before_anything_is_reserved() -> None:
    definition = parse_definition(NAME, "float64[] a\n")
    with pytest.raises(LogError, match="at a"):
        decode(definition, payload_stack([bytes([0, 1, 0, 0]) + struct.pack("<I", 0xFFFFFFF0)]))


def test_other_encapsulations_are_refused() -> None:
    definition = parse_definition(NAME, "float64 a\n")
    with pytest.raises(LogError, match="not plain CDR"):
        decode(definition, payload_stack([bytes([0, 7, 0, 0]) + bytes(8)]))


def test_a_field_that_does_not_exist_is_not_written() -> None:
    with pytest.raises(ValueError, match="nonsense"):
        encode(parse_definition(NAME, "float64 a\n"), 1, {"nonsense": 1.0})
