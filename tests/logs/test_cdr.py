"""ROS 2 messages as columns: against two other libraries, by hand, and where payloads or definitions are broken."""

import struct
import time
from itertools import combinations, islice, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic

from sonar_graph.errors import LogError
from sonar_graph.logs.cdr import Struct, decode, encode, parse_definition

from .random_schemas import check, stacked

NAME = "test_msgs/msg/Root"
RULE = "=" * 80
START = bytes([0, 1, 0, 0])


def parsed(text: str, **used: str) -> Struct:
    """A type by the text of its fields, and those of the types that it uses."""
    others = (
        f"{RULE}\nMSG: test_msgs/{name}\n{fields}\n" for name, fields in used.items()
    )
    return parse_definition(NAME, "\n".join([text, *others]))


# ---- definitions


@pytest.mark.parametrize("own", ["Part", "test_msgs/Part", "test_msgs/msg/Part"])
def test_types_of_the_own_package_need_no_prefix_and_a_time_no_definition(own):
    text = f"{own} part\nbuiltin_interfaces/Time stamp"
    part, stamp = parsed(text, Part="float64 x").fields
    assert part.kind.name == "test_msgs/Part"
    assert [f.name for f in stamp.kind.fields] == ["sec", "nanosec"]


def doubling(levels: int) -> str:
    """Types, each with two fields of the next: a few lines with as many fields as 2 to the power of their number."""
    names = [f"test_msgs/T{i}" for i in range(levels)] + ["float64"]
    parts = [
        f"MSG: {name}\n{names[i + 1]} a\n{names[i + 1]} b\n"
        for i, name in enumerate(names[:-1])
    ]
    return f"T0 root\n{RULE}\n" + f"{RULE}\n".join(parts)


CHAIN = "T0 first\n" + "".join(
    f"{RULE}\nMSG: test_msgs/T{i}\nT{i + 1} next\n" for i in range(3000)
)


REFUSED = {
    "other_msgs/Part part\n": "other_msgs/Part",
    "wstring text\n": "wstring",
    "float64\n": "no ros2msg field",
    "float64[0] x\n": "no ros2msg field",
    "{}": "no ros2msg field",
    f"Part p\n{RULE}\nMSG: test_msgs/Part\nPart[] p\n": "within itself",
    "Root[] things\n": "within itself",
    "float64 x\nint8 x\n": "two fields called x",
    doubling(45): "more than 10000 fields",
    CHAIN: "more than 50 deep",
}


def test_a_definition_that_cannot_be_understood_is_refused_and_named():
    assert len(parse_definition(NAME, doubling(8)).fields) == 1
    for text, message in REFUSED.items():
        with pytest.raises(LogError, match=message):
            parse_definition(NAME, text)


# ---- columns


@pytest.mark.parametrize(
    ("schemas", "messages", "seed"),
    [(40, 5, 1000), pytest.param(300, 10, 0, marks=pytest.mark.slow)],
)
def test_random_messages_decode_and_encode_as_with_two_other_libraries(
    schemas, messages, seed
):
    check(schemas, messages, seed)


def test_what_does_not_fit_or_exist_is_neither_written_nor_read():
    definition = parsed("uint8 a\nint32[] b\nP[] points", P="int16 x\nstring s")
    assert encode(definition, 2, {"a": np.array([0, 255])})[:, 4].tolist() == [0, 255]
    for name, value in (
        ("a", 256),
        ("a", -1),
        ("b", [[1 << 31]]),
        ("a", 1.5),
        ("a", np.nan),
    ):
        with pytest.raises(ValueError, match="does not fit"):
            encode(definition, 1, {name: np.array(value)})
    with pytest.raises(ValueError, match="nonsense"):
        encode(definition, 1, {"nonsense": 1.0})
    (group,) = decode(definition, [(np.arange(2), encode(definition, 2, {}))]).groups
    # a field within an empty sequence is there, without values
    assert (group["points.x"].shape, group["points.x"].dtype) == ((2, 0), np.int16)
    assert (group.strings("points.s"), group.first_string("points.s")) == ([[], []], "")


# ---- payloads that do not fit their definition

FIELDS = "string s\nbool[] flags\nfloat64[] values\nuint16 last\n"
DEFINITION = parsed(FIELDS)


def whole(last: int = 7) -> bytes:
    values = {
        "s": "abc",
        "flags": np.array([[True, False]]),
        "values": np.array([[1.5, 2.5]]),
        "last": last,
    }
    return encode(DEFINITION, 1, values)[0].tobytes()


def poked(at: int, *octets: int) -> bytes:
    payload = bytearray(whole())
    payload[at : at + len(octets)] = octets
    return bytes(payload)


BOOLEAN = "with a boolean flags that is neither 0 nor 1"
TEXT = "with a string s that is not UTF-8 closed by a NUL"
# fmt: off
# 0 header, 4 length of s, 8 "abc\0", 12 length of flags, 16 flags, 20 length of values, 28 values, 44 last, 46 end
BROKEN: dict[str, tuple[bytes, str]] = {
    "empty":                        (b"",                               "without an encapsulation header"),
    "only part of a header":        (START[:3],                         "without an encapsulation header"),
    "cut within a number":          (whole()[:45],                      "that end before their definition does"),
    "cut before a length":          (whole()[:20],                      "that end before values"),
    "with bytes left over":         (whole() + bytes(4),                "that are longer than their definition says"),
    "with a string beyond the end": (poked(4, 0xF0, 0xFF, 0xFF, 0xFF),  "with a length of s beyond their end"),
    "with a list beyond the end":   (poked(20, 0xF0, 0xFF, 0xFF, 0x7F), "with a length of values beyond their end"),
    "with a boolean of 2":          (poked(17, 2),                      BOOLEAN),
    "with a boolean of 255":        (poked(16, 255),                    BOOLEAN),
    "with two faults":              (poked(9, 0xFF, *b"c\0\2\0\0\0\2"), BOOLEAN),
    "with bytes that are no UTF-8": (poked(9, 0xFF),                    TEXT),
    "with a string that goes on":   (poked(11, 0x41),                   TEXT),
    "in XCDR2":                     (poked(1, 7),                       "encoded as XCDR2 instead of plain CDR"),
    "in a parameter list":          (poked(1, 3),                       "encoded as PL_CDR instead of plain CDR"),
    "in something else":            (poked(0, 9),                       "encoded as 09010000 instead of plain CDR"),
}
# fmt: on


@pytest.mark.parametrize("kind", BROKEN)
@pytest.mark.parametrize("place", [0, 1, 3], ids=["first", "among", "last"])
def test_a_broken_message_is_named_and_those_around_it_are_read(kind, place):
    payload, fault = BROKEN[kind]
    payloads = [whole(i) for i in range(3)]
    payloads.insert(place, payload)
    decoded = decode(DEFINITION, stacked(payloads))
    ((found, rows),) = decoded.unsound.items()
    assert (found, rows.tolist()) == (fault, [place])
    (group,) = decoded.groups
    assert group.rows.tolist() == [row for row in range(4) if row != place]
    assert group["last"].tolist() == [0, 1, 2]


@given(st.binary(max_size=80), st.integers(0, 46), st.integers(0, 46))
def test_no_bytes_crash_and_what_is_sound_is_what_another_library_reads(
    noise, start, end
):
    payload = whole()[:start] + noise + whole()[end:]
    decoded = decode(DEFINITION, stacked([payload]))
    assert len(decoded.groups) + len(decoded.unsound) == 1
    for group in decoded.groups:
        theirs = generate_dynamic(NAME, FIELDS)[NAME](payload)
        assert group.strings("s") == [[theirs.s]]
        assert group["flags"][0].tolist() == theirs.flags
        np.testing.assert_array_equal(group["values"][0], theirs.values)
        assert group["last"].tolist() == [theirs.last]


# four strings of together 256 bytes
CUTS = [(0, *cuts, 64) for cuts in islice(combinations(range(1, 64), 3), 6_000)]
LENGTHS = [[4 * (b - a) for a, b in pairwise(cuts)] for cuts in CUTS]


NAMES = parsed("string[4] names")


ENDLESS = parsed("P[4000000000] points", P="string s")


MANY: dict[str, tuple[Struct, list[bytes]]] = {
    "cut": (DEFINITION, [whole()[:45]] * 21_000),
    "an array without end": (
        ENDLESS,
        [START + bytes(80)],
    ),  # found out before it is walked
    "one layout and byte order each": (
        NAMES,
        [
            bytes([0, order == "<", 0, 0])
            + b"".join(struct.pack(f"{order}I{n}s", n, b"x" * (n - 1)) for n in lengths)
            for lengths in LENGTHS
            for order in "<>"
        ],
    ),
}


@pytest.mark.parametrize(("definition", "payloads"), MANY.values(), ids=MANY)
def test_many_broken_messages_are_read_in_seconds(definition, payloads):
    stacks = stacked(payloads)
    start = time.process_time()
    decoded = decode(definition, stacks)
    assert time.process_time() - start < 3.0
    if definition is NAMES:
        assert (len(stacks), len(decoded.groups)) == (1, 12_000)
        for group in decoded.groups:
            (names,) = group.strings("names")
            assert [len(name) + 1 for name in names] == LENGTHS[group.rows[0] // 2]
    assert definition is not ENDLESS or list(decoded.unsound) == [
        "that end before their definition does"
    ]
