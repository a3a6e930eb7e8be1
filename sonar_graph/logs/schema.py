"""Interface definitions of ROS 2 messages (``ros2msg`` text) as trees of fields.

The text in an MCAP schema is the message's own definition followed by those of the types that it uses, each after a
line of ``=`` and a line ``MSG: package/Type`` (https://mcap.dev/spec/registry#ros2msg).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

from sonar_graph.errors import LogError
from sonar_graph.logs.message_definitions import DEFINITIONS, short_name

PRIMITIVES = {
    "bool": "?",
    "byte": "u1",
    "char": "u1",
    "uint8": "u1",
    "int8": "i1",
    "uint16": "u2",
    "int16": "i2",
    "uint32": "u4",
    "int32": "i4",
    "uint64": "u8",
    "int64": "i8",
    "float32": "f4",
    "float64": "f8",
}
"""numpy's type of each primitive, without its byte order."""
STRING = "string"
_MOST_FIELDS = 10_000
_DEEPEST = 50

_SECTION = re.compile(r"^=+\s*\n\s*MSG:\s*(\S+)\s*\n", re.MULTILINE)
_FIELD = re.compile(
    r"^(?P<type>[\w/]+)(?:<=\d+)?(?P<array>\[(?P<length>(?:<=)?\d*)\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)$"
)


@dataclass(frozen=True, eq=False)
class Struct:
    """A message type: its fields in order."""

    name: str
    fields: tuple[Field, ...]


@dataclass(frozen=True)
class Field:
    """One field of a message type."""

    name: str
    kind: str | Struct
    """A key of `PRIMITIVES`, `STRING`, or a nested type."""
    length: int | None
    """1 for a single value, the number of values of a fixed array, None for a sequence."""
    is_array: bool
    """Whether it is an array or sequence."""


@lru_cache(maxsize=256)
def parse_definition(type_name: str, text: str) -> Struct:
    """The tree of a message type from its interface text.

    Parameters
    ----------
    type_name
        Such as ``sensor_msgs/msg/Imu``; relative type names in the text belong to its package.
    text
        The ``ros2msg`` text with all dependencies.

    Raises
    ------
    LogError
        Naming the line that is not a field, or the type whose definition is not in the text.
    """
    own, *rest = _SECTION.split(text.replace("\r\n", "\n"))
    texts = {short_name(name): body for name, body in zip(rest[::2], rest[1::2], strict=True)}
    root = short_name(type_name)
    texts[root] = own
    return _Parser(texts).struct(root, ())


class _Parser:
    """Puts the texts of types together; each type is parsed once."""

    def __init__(self, texts: dict[str, str]) -> None:
        self._texts = texts
        self._done: dict[str, Struct] = {}
        self._sizes: dict[str, int] = {}

    def struct(self, name: str, users: tuple[str, ...]) -> Struct:
        if name in users:
            raise LogError(f"the definition of {users[0]} uses {name} within itself, which no ROS 2 message can")
        if len(users) > _DEEPEST:
            raise LogError(f"the definition of {users[0]} nests types more than {_DEEPEST} deep; no real one does")
        if name not in self._done:
            lines = (line.split("#", 1)[0].strip() for line in self._texts[name].splitlines())
            found = (self._field(line, name, (*users, name)) for line in lines if line)
            struct = Struct(name, tuple(entry for entry in found if entry is not None))
            self._check(struct)
            self._done[name] = struct
        return self._done[name]

    def _check(self, struct: Struct) -> None:
        names = [entry.name for entry in struct.fields]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise LogError(f"the definition of {struct.name} has two fields called {twice}")
        size = sum(self._sizes[entry.kind.name] if isinstance(entry.kind, Struct) else 1 for entry in struct.fields)
        if size > _MOST_FIELDS:
            raise LogError(f"the definition of {struct.name} has more than {_MOST_FIELDS} fields; no real one has")
        self._sizes[struct.name] = size

    def _field(self, line: str, owner: str, users: tuple[str, ...]) -> Field | None:
        """The field of one line, or None for a constant."""
        match = _FIELD.match(line)
        if match is None or match["length"] == "0":
            raise LogError(f"the definition of {owner} has the line {line!r}, which is no ros2msg field")
        if match["rest"].startswith("="):
            return None
        kind = self._kind(match["type"], owner, users)
        if match["array"] is None:
            return Field(match["name"], kind, 1, is_array=False)
        length = match["length"]
        return Field(match["name"], kind, int(length) if length.isdigit() else None, is_array=True)

    def _kind(self, type_name: str, owner: str, users: tuple[str, ...]) -> str | Struct:
        if type_name in PRIMITIVES or type_name == STRING:
            return type_name
        package = owner.split("/", 1)[0]
        wanted = short_name(type_name)
        wanted = {"Header": "std_msgs/Header"}.get(wanted, wanted if "/" in wanted else f"{package}/{wanted}")
        if wanted not in self._texts and wanted.startswith("builtin_interfaces/") and wanted in DEFINITIONS:
            self._texts[wanted] = DEFINITIONS[wanted]  # some recorders leave these two out
        if wanted not in self._texts:
            raise LogError(f"the definition of {owner} uses {type_name}, whose own definition is not in the log")
        return self.struct(wanted, users)
