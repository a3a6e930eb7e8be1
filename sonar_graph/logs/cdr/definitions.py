"""Definitions of ROS 2 messages: those that this package writes, and the parsing of those in a log.

A definition is ``ros2msg`` text (https://mcap.dev/spec/registry#ros2msg): the message's own fields, then those of the
types that it uses, each after a line of ``=`` and a line ``MSG: package/Type``. It travels with the messages, so that
any reader understands them without ROS. Field names and order are those of ROS 2 Jazzy's ``common_interfaces`` and of
``marine_acoustic_msgs`` 2.1; ``sonar_graph_msgs`` is this package's own (``docs/design/0004-logs.md``). They are in
``definitions.ros2msg``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files

from sonar_graph.errors import LogError

_SEPARATOR = "=" * 80
_SECTION = re.compile(r"^=+\n[ \t]*MSG:[ \t]*(\S+)\n", re.MULTILINE)
_FIELD_TYPE = re.compile(r"^(\w+/\w+)(?:\[.*?\])?\s", re.MULTILINE)


def short_name(type_name: str) -> str:
    """Type name as interface texts use it: ``sensor_msgs/Imu`` for ``sensor_msgs/msg/Imu``."""
    return type_name.replace("/msg/", "/")


def _sections(text: str) -> dict[str, str]:
    """Fields of each type by its name, from the sections of a text; "" is the name of what is before the first."""
    lines = (line.rstrip() for line in text.splitlines())
    own, *rest = _SECTION.split("\n".join(filter(None, lines)) + "\n")
    names = map(short_name, rest[::2])
    return {"": own, **dict(zip(names, rest[1::2], strict=True))}


DEFINITIONS = {
    name: fields.rstrip()
    for name, fields in _sections(
        files("sonar_graph.logs.cdr").joinpath("definitions.ros2msg").read_text("utf-8")
    ).items()
    if name
}
"""Fields of each type that this package writes or knows, by its name."""


@cache
def definition(type_name: str) -> str:
    """Interface text of a type such as ``sensor_msgs/msg/Imu``, with all types that it uses, as in an MCAP schema."""
    wanted = [short_name(type_name)]
    for name in wanted:
        wanted += [
            used
            for used in dict.fromkeys(_FIELD_TYPE.findall(DEFINITIONS[name]))
            if used not in wanted
        ]
    first, *others = wanted
    sections = (f"{_SEPARATOR}\nMSG: {name}\n{DEFINITIONS[name]}" for name in others)
    return "\n".join([DEFINITIONS[first], *sections]) + "\n"


# fmt: off
PRIMITIVES = {
    "bool": "?", "byte": "u1", "char": "u1", "float32": "f4", "float64": "f8",
    "uint8": "u1", "uint16": "u2", "uint32": "u4", "uint64": "u8",
    "int8":  "i1", "int16":  "i2", "int32":  "i4", "int64":  "i8",
}
# fmt: on
"""Type in numpy of each primitive, without the byte order."""
STRING = "string"
_MOST_FIELDS = 10_000
_DEEPEST = 50
_SHOWN = 80
"""Characters of a faulty line in an error."""
_LONGEST_TEXT = 1 << 20
_FIELD = re.compile(
    r"^(?P<type>[\w/]+)(?:<=\d+)?(?P<array>\[(?P<length>(?:<=)?\d{0,12})\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)$"
)


@dataclass(frozen=True, eq=False)
class Struct:
    """A message type with its fields in order."""

    name: str
    fields: tuple[Field, ...]


@dataclass(frozen=True)
class Field:
    """One field of a message type."""

    name: str
    kind: str | Struct
    """Key of `PRIMITIVES`, `STRING`, or a nested type."""
    length: int | None
    """Number of values: 1 for a single value, None for a sequence."""
    is_array: bool
    """True for an array or sequence."""


def parse_definition(type_name: str, text: str | None = None) -> Struct:
    """Tree of a message type, such as ``sensor_msgs/msg/Imu``, from its ``ros2msg`` text with all dependencies.

    Without a text the type is one of `DEFINITIONS`. Relative type names in the text belong to the package of the type.
    A LogError names the line that is not a field, or the type whose definition is not in the text.
    """
    found = _parsed(type_name, definition(type_name) if text is None else text)
    if isinstance(found, str):
        raise LogError(found)
    return found


@lru_cache(maxsize=256)
def _parsed(type_name: str, text: str) -> Struct | str:
    """Tree of a message type, or the fault of its text; both are remembered, since every role needs them."""
    if len(text) > _LONGEST_TEXT:
        return f"the definition of {type_name} has {len(text)} characters, and at most {_LONGEST_TEXT} are read"
    texts = _sections(text)
    root = short_name(type_name)
    texts[root] = texts[""]
    try:
        return _Parser(texts).struct(root, ())
    except LogError as error:
        return str(error)


class _Parser:
    """Tree of types from their texts; each type is parsed once."""

    def __init__(self, texts: dict[str, str]) -> None:
        self._texts = texts
        self._done: dict[str, Struct] = {}
        self._sizes: dict[str, int] = {}

    def struct(self, name: str, users: tuple[str, ...]) -> Struct:
        """Type of some name; ``users`` are the types around it, from the outermost on."""
        if name in users:
            raise LogError(
                f"the definition of {users[0]} uses {name} within itself, which no ROS 2 message can"
            )
        if len(users) > _DEEPEST:
            raise LogError(
                f"the definition of {users[0]} nests types more than {_DEEPEST} deep; no real one does"
            )
        if name in self._done:
            return self._done[name]
        fields: dict[str, Field] = {}
        for line in self._texts[name].splitlines():
            stated = line.split("#", 1)[0].strip()
            match = _FIELD.match(stated)
            if stated and (match is None or match["length"] == "0"):
                raise LogError(
                    f"the definition of {name} has the line {stated[:_SHOWN]!r}, which is no ros2msg field"
                )
            # an empty line, or a constant
            if match is None or match["rest"].startswith("="):
                continue
            field_name = match["name"]
            if field_name in fields:
                raise LogError(
                    f"the definition of {name} has two fields called {field_name}"
                )
            kind = self._kind(match["type"], name, users)
            is_array = match["array"] is not None
            length: int | None = 1
            if is_array:
                # "<=3" bounds a sequence, and has no number of its own
                length = int(match["length"]) if match["length"].isdigit() else None
            fields[field_name] = Field(field_name, kind, length, is_array=is_array)
        struct = self._done[name] = Struct(name, tuple(fields.values()))
        self._sizes[name] = sum(
            self._sizes[entry.kind.name] if isinstance(entry.kind, Struct) else 1
            for entry in struct.fields
        )
        # nested definitions grow exponentially
        if self._sizes[name] > _MOST_FIELDS:
            raise LogError(
                f"the definition of {name} has more than {_MOST_FIELDS} fields; no real one has"
            )
        return struct

    def _kind(self, type_name: str, owner: str, users: tuple[str, ...]) -> str | Struct:
        """Primitive, string or nested type of a field of ``owner``."""
        if type_name in PRIMITIVES or type_name == STRING:
            return type_name
        wanted = short_name(type_name)
        if "/" not in wanted:
            # old definitions write Header without its package
            package = "std_msgs" if wanted == "Header" else owner.split("/", 1)[0]
            wanted = f"{package}/{wanted}"
        if (
            wanted not in self._texts
            and wanted.startswith("builtin_interfaces/")
            and wanted in DEFINITIONS
        ):
            # some recorders leave these two out
            self._texts[wanted] = DEFINITIONS[wanted]
        if wanted not in self._texts:
            raise LogError(
                f"the definition of {owner} uses {type_name}, whose own definition is not in the log"
            )
        return self.struct(wanted, (*users, owner))
