"""Random message types and values, and the comparison of this package's CDR with two other libraries.

Each case is encoded by rosbags, decoded by mcap-ros2-support and by us, compared leaf for leaf, and encoded again by us
byte for byte.
"""

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
        """The text of the root, which is drawn last, with all others."""
        *others, (_, root) = self.texts.items()
        parts = (f"{'=' * 80}\nMSG: {name}\n{text}\n" for name, text in others)
        return "".join([root, "\n", *parts])


def random_message(
    definition: Struct,
    store: Typestore,
    shape: np.random.Generator,
    rng: np.random.Generator,
) -> Any:
    """A message as rosbags has it: lengths and strings by the first generator, numbers by the second."""
    values = []
    for entry in definition.fields:
        count = entry.length
        if count is None:
            count = int(shape.choice([0, 1, 2, 4]))
        if isinstance(entry.kind, Struct):
            parts = range(count)
            value: Any = [random_message(entry.kind, store, shape, rng) for _ in parts]
        elif entry.kind == STRING:
            value = shape.choice(TEXTS, count).tolist()
        else:
            value = random_numbers(PRIMITIVES[entry.kind], count, rng)
            if entry.kind == "byte" and not entry.is_array:
                value &= 0x7F  # rosbags packs a single byte as signed, not a list
        values.append(value if entry.is_array else value[0])
    return store.types[definition.name.replace("/", "/msg/")](*values or [0])


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
    """All values by path, in order, of a message as mcap-ros2-support decodes it."""
    for entry in definition.fields:
        path = prefix + entry.name
        value = getattr(message, entry.name)
        for element in value if entry.is_array else [value]:
            if isinstance(entry.kind, Struct):
                leaves_of(element, entry.kind, path + ".", found)
            else:
                number = element % 256 if entry.kind == "char" else element
                found.setdefault(path, []).append(number)
    return found


def check_message(
    group: Messages, at: int, definition: Struct, theirs: Any, payload: bytes
) -> None:
    """Compare a message leaf for leaf, and written again from its columns and lengths byte for byte."""
    expected = leaves_of(theirs, definition, "", {})
    plan = group.layout.plan
    values: dict[str, Any] = {}
    for path, leaf in plan.leaves.items():
        is_text = leaf.step.is_text
        ours = group.strings(path)[at] if is_text else group[path][at : at + 1]
        np.testing.assert_array_equal(np.ravel(ours), expected.get(path, []), path)
        values[path] = ours
    lengths = {path: group.lengths(path) for path in (*plan.leaves, *plan.sequences)}
    assert encode(definition, 1, values, lengths)[0].tobytes() == payload


def stacked(payloads: list[bytes]) -> list[tuple[np.ndarray, np.ndarray]]:
    """What the container hands over: payloads stacked by length."""
    sizes = np.array([len(p) for p in payloads])
    rows = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
    return [
        (some, np.array([np.frombuffer(payloads[row], np.uint8) for row in some]))
        for some in rows
    ]


def check(schemas: int, messages: int, seed: int) -> None:
    """Compare random types with random values, in both byte orders."""
    for number in range(seed, seed + schemas):
        rng = np.random.default_rng(number)
        types = RandomTypes(rng)
        types.draw()
        schema = types.schema()
        definition = parse_definition(ROOT, schema)
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(schema, ROOT))
        oracle = generate_dynamic(ROOT, schema)[ROOT]
        # two each share a layout
        shapes = [np.random.default_rng([number, i // 2]) for i in range(messages)]
        drawn = [random_message(definition, store, shape, rng) for shape in shapes]
        payloads = [
            bytes(store.serialize_cdr(one, ROOT, little_endian=is_little))
            for is_little in (True, False)
            for one in drawn
        ]
        padded = [payload + bytes(-len(payload) % 4) for payload in payloads]
        decoded = decode(definition, stacked(padded))
        assert not decoded.unsound, f"seed {number}"
        rows = []
        for group in decoded.groups:
            for at, row in enumerate(group.rows.tolist()):
                payload = payloads[row % messages]
                check_message(group, at, definition, oracle(padded[row]), payload)
                rows.append(row)
        assert sorted(rows) == list(range(2 * messages))
