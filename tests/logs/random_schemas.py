"""Random message types and values, and the comparison of this package's CDR with two other libraries.

Each case is encoded by rosbags, decoded by mcap-ros2-support and by us, compared leaf for leaf, and encoded again by us
byte for byte.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mcap_ros2._dynamic import generate_dynamic
from rosbags.interfaces import Typestore
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sonar_graph.logs.cdr import Messages, Struct, decode, encode, parse_definition
from sonar_graph.logs.cdr.definitions import PRIMITIVES, STRING

ROOT = "fuzz_msgs/msg/Root"
TEXTS = ["", "a", "base_link", "ψ → 深い", "with \0 inside", "\U0001f420", "x" * 40]
CONSTANTS = [
    "uint8 A=1",
    "float64 B = -1.5",
    'string C="a # b"',
    "  # a comment: float64 no",
    "",
    "bool D=true",
]
DEFAULTS = {"bool": "true", "string": '"a b"', "float32": "-1.5", "float64": "1e-3"}
BUILTIN = dict.fromkeys(
    ["builtin_interfaces/Time", "builtin_interfaces/Duration"],
    "int32 sec\nuint32 nanosec",
)


class RandomTypes:
    """Draws message types, some of them nested in others."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.texts: dict[str, str] = {}

    def draw(self, name: str = "fuzz_msgs/Root", depth: int = 3) -> str:
        """Adds a type with all that it uses."""
        lines = []
        for i in range(self._rng.integers(0 if depth < 3 else 1, 7)):
            lines += [CONSTANTS[i]] if self._rng.random() < 0.2 else []
            lines.append(self._field(f"f{i}", depth))
        self.texts[name] = "\n".join(lines)
        return name

    def _field(self, name: str, depth: int) -> str:
        kind = self._kind(depth)
        array = str(self._rng.choice(["", "", "[]", "[3]", "[<=4]", "[1]"]))
        if kind == STRING and self._rng.random() < 0.2:
            kind = "string<=64"
        default = ""
        if not array and kind in {*PRIMITIVES, STRING} and self._rng.random() < 0.2:
            default = " " + DEFAULTS.get(kind, "7")
        comment = (
            "  # [m] float64 x" if self._rng.random() < 0.2 and kind != STRING else ""
        )
        return f"{kind}{array} {name}{default}{comment}"

    def _kind(self, depth: int) -> str:
        draw = self._rng.random()
        if draw < 0.3 and depth:
            return self.draw(f"fuzz_msgs/T{len(self.texts)}x{depth}", depth - 1)
        kind = str(
            self._rng.choice(
                list(BUILTIN) if draw < 0.4 else [*PRIMITIVES, STRING, STRING]
            )
        )
        self.texts |= {kind: BUILTIN[kind]} if kind in BUILTIN else {}
        return kind

    def schema(self) -> str:
        """The text of the root with all others."""
        others = [
            f"{'=' * 80}\nMSG: {name}\n{text}\n"
            for name, text in self.texts.items()
            if name != "fuzz_msgs/Root"
        ]
        return self.texts["fuzz_msgs/Root"] + "\n" + "".join(others)


def typestore(texts: dict[str, str]) -> Typestore:
    """The types as rosbags knows them."""
    store = get_typestore(Stores.EMPTY)
    types: dict[str, Any] = {}
    for name, text in texts.items():
        types |= get_types_from_msg(text, name.replace("/", "/msg/"))
    store.register(types)
    return store


def random_message(
    definition: Struct,
    store: Typestore,
    shape: np.random.Generator,
    rng: np.random.Generator,
) -> Any:
    """A message as rosbags has it: lengths and strings by the first generator, numbers by the second."""
    values = []
    for entry in definition.fields:
        count = (
            entry.length
            if entry.length is not None
            else int(shape.choice([0, 1, 2, 4]))
        )
        if isinstance(entry.kind, Struct):
            value: Any = [
                random_message(entry.kind, store, shape, rng) for _ in range(count)
            ]
        elif entry.kind == STRING:
            value = [str(shape.choice(TEXTS)) for _ in range(count)]
        else:
            value = random_numbers(PRIMITIVES[entry.kind], count, rng)
            if entry.kind == "byte" and not entry.is_array:
                value &= (
                    0x7F  # rosbags packs a single byte as signed, unlike a list of them
                )
        values.append(value if entry.is_array else value[0])
    if not definition.fields:
        values = [0]
    return store.types[definition.name.replace("/", "/msg/")](*values)


def random_numbers(kind: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """Any bits; of floats, NaN and infinities often."""
    if kind == "?":
        return rng.integers(0, 2, count).astype(bool)
    numbers = np.frombuffer(rng.bytes(count * np.dtype(kind).itemsize), kind).copy()
    if numbers.dtype.kind == "f":
        special = np.array([np.nan, np.inf, -np.inf, -0.0, 1.5], kind)
        numbers = np.where(rng.random(count) < 0.3, rng.choice(special, count), numbers)
    return numbers


def leaves_of(
    message: Any, definition: Struct, prefix: str, found: dict[str, list[Any]]
) -> dict[str, list[Any]]:
    """All values by path, in order, of a message as mcap-ros2-support decodes it; of arrays their lengths too."""
    for entry in definition.fields:
        path = prefix + entry.name
        value = getattr(message, entry.name)
        elements = list(value) if entry.is_array else [value]
        if entry.is_array:
            found.setdefault(f"len {path}", []).append(len(elements))
        if isinstance(entry.kind, Struct):
            for element in elements:
                leaves_of(element, entry.kind, path + ".", found)
        else:
            found.setdefault(path, []).extend(
                x % 256 if entry.kind == "char" else x for x in elements
            )
    return found


def paths_of(definition: Struct, prefix: str = "") -> tuple[dict[str, bool], list[str]]:
    """Fields that hold values, with whether those are strings; and arrays and sequences."""
    values = dict[str, bool]()
    arrays = list[str]()
    for entry in definition.fields:
        path = prefix + entry.name
        arrays += [path] if entry.is_array else []
        if isinstance(entry.kind, Struct):
            inner_values, inner_arrays = paths_of(entry.kind, path + ".")
            values, arrays = values | inner_values, arrays + inner_arrays
        else:
            values[path] = entry.kind == STRING
    return values, arrays


def differences(
    group: Messages, at: int, definition: Struct, expected: dict[str, list[Any]]
) -> list[str]:
    """Paths at which a message of ours differs from the one that mcap-ros2-support decoded."""
    values, arrays = paths_of(definition)
    found = [
        path
        for path in arrays
        if group.lengths(path) != expected.get(f"len {path}", [])
    ]
    for path, is_text in values.items():
        ours = (
            group.strings(path)[at]
            if is_text
            else np.atleast_1d(group[path][at]).tolist()
        )
        theirs = expected.get(path, [])
        same = (
            a == b or (a != a and b != b) for a, b in zip(ours, theirs, strict=False)
        )
        found += [] if len(ours) == len(theirs) and all(same) else [path]
    return found


def encoded_again(group: Messages, at: int, definition: Struct) -> bytes:
    """A decoded message written from its columns and lengths."""
    paths, arrays = paths_of(definition)
    values: dict[str, Any] = {
        p: group.strings(p)[at] if text else group[p][at : at + 1]
        for p, text in paths.items()
    }
    return encode(
        definition, 1, values, {path: group.lengths(path) for path in arrays}
    )[0].tobytes()


@dataclass
class Tally:
    """Number of messages that were decoded, and what did not agree."""

    messages: int = 0
    unsound: int = 0
    decoded_differently: list[str] = field(default_factory=list)
    encoded_differently: list[str] = field(default_factory=list)


def stacked(payloads: list[bytes]) -> list[tuple[np.ndarray, np.ndarray]]:
    """What the container hands over: payloads stacked by length."""
    sizes = np.array([len(p) for p in payloads])
    rows = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
    return [
        (some, np.array([np.frombuffer(payloads[row], np.uint8) for row in some]))
        for some in rows
    ]


def check(schemas: int, messages: int, seed: int = 0) -> Tally:
    """Compare random types with random values, in both byte orders."""
    tally = Tally()
    for number in range(seed, seed + schemas):
        rng = np.random.default_rng(number)
        types = RandomTypes(rng)
        types.draw()
        schema = types.schema()
        definition = parse_definition(ROOT, schema)
        store = typestore(types.texts)
        oracle = generate_dynamic(ROOT, schema)[ROOT]
        # two each share a layout
        shapes = [np.random.default_rng([number, i // 2]) for i in range(messages)]
        drawn = [random_message(definition, store, shape, rng) for shape in shapes]
        little = [bytes(store.serialize_cdr(message, ROOT)) for message in drawn]
        big = [
            bytes(store.serialize_cdr(message, ROOT, little_endian=False))
            for message in drawn
        ]
        padded = [payload + bytes(-len(payload) % 4) for payload in little + big]
        decoded = decode(definition, stacked(padded))
        tally.unsound += sum(map(len, decoded.unsound.values()))
        for group in decoded.groups:
            for at, row in enumerate(group.rows.tolist()):
                wrong = differences(
                    group,
                    at,
                    definition,
                    leaves_of(oracle(padded[row]), definition, "", {}),
                )
                example = f"seed {number}, message {row}: {wrong}\n{schema}"
                tally.messages += 1
                tally.decoded_differently += [example] if wrong else []
                same = encoded_again(group, at, definition) == little[row % messages]
                tally.encoded_differently += [] if same else [example]
    return tally
