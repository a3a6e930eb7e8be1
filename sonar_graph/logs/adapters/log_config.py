"""What a user says about a log: a table a role, in TOML, with anything that an adapter has.

A table of a type that comes along changes only what it names::

    [dvl]
    topic = "/dvl/data"
    rotation = "frd"
    covariance = {meaning = "standard deviation"}

for any other type it names the fields. ``false`` takes away what the adapter that comes along has.

Mistakes in a log configuration that only a log can show: fields that its messages do not have.

A log configuration as text: what was chosen for each role, with what may be changed and why nothing fits.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters.adapter import Adapter, leaf_fields
from sonar_graph.logs.adapters.drivers import SHIPPED
from sonar_graph.logs.adapters.dvl_messages import DvlAdapter
from sonar_graph.logs.adapters.landmark_messages import DetectionArrayAdapter, LandmarkMapAdapter
from sonar_graph.logs.adapters.sonar_messages import SonarAdapter
from sonar_graph.logs.adapters.vehicle_messages import DepthAdapter, ImuAdapter, TruthAdapter
from sonar_graph.logs.cdr import Struct, short_name
from sonar_graph.logs.message_table import LOG_TIME, field_of
from sonar_graph.settings import faults_in


def absent_fields(table: Mapping[str, Any], paths: list[str], definition: Struct) -> list[str]:
    """Which keys of a table name a field that messages do not have, with those that they have.

    Parameters
    ----------
    table
        Of one role.
    paths
        Fields that its adapter needs and the definition lacks.
    definition
        Of the messages.
    """
    known = dict(leaf_fields(definition))
    named = [(key, path) for key, path in _named(table) if path in paths or _is_absent_time(key, path, known)]
    return [f"{key}: {_fault(path, definition, known)}" for key, path in named]


def _fault(path: str, definition: Struct, known: Mapping[str, str]) -> str:
    similar = get_close_matches(path, known, 1)
    suggestion = f"did you mean {similar[0]}? " if similar else ""
    names = ", ".join(name + size for name, size in known.items())
    return f"{definition.name} has no field {path}; {suggestion}it has: {names}"


def _is_absent_time(key: str, path: str, known: Mapping[str, str]) -> bool:
    if key == "stamp":
        return path != LOG_TIME and not {field_of(path)[0], f"{path}.sec"} & known.keys()
    return key == "frame_id_field" and path not in known


def _named(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Keys of a table with the texts in them that may be names of fields."""
    for key, value in table.items():
        if isinstance(value, str):
            yield prefix + key, value
        elif isinstance(value, Mapping):
            yield from ((f"{prefix}{key}", path) for path in value if key == "valid_where")
            yield from _named(value, f"{prefix}{key}.")
        elif isinstance(value, list):
            yield from ((f"{prefix}{key}", item) for item in value if isinstance(item, str))


ADAPTERS: dict[str, type[Adapter]] = {
    "imu": ImuAdapter,
    "dvl": DvlAdapter,
    "depth": DepthAdapter,
    "detections": DetectionArrayAdapter,
    "truth": TruthAdapter,
    "true_landmarks": LandmarkMapAdapter,
    "sonar": SonarAdapter,
}
"""By role, for types that do not come along."""
Table = Mapping[str, Any]


@dataclass(frozen=True)
class LogConfig:
    """Validated tables by role; what is not in a table is left to the adapter that comes along."""

    tables: Mapping[str, Table] = field(default_factory=dict)
    source: str = "log configuration"
    """Names the file in errors."""

    @classmethod
    def parse(cls, values: Mapping[str, Any], source: str) -> LogConfig:
        """Check plain values as TOML gives them.

        Raises
        ------
        LogError
            Naming the source, the table and the key, and what was expected.
        """
        for role, table in values.items():
            if role not in ADAPTERS:
                raise LogError(f"{source}: there is no role [{role}]; tables are for {', '.join(ADAPTERS)}")
            if not isinstance(table, Mapping):
                raise LogError(f"{source}: {role}: expected a table, [{role}], not {table!r}")
        config = cls(values, source)
        for role, table in values.items():
            config._check(role, table)
        return config

    def table(self, role: str) -> Table:
        """What is said about a role; empty where nothing is."""
        return self.tables.get(role, {})

    def types(self) -> frozenset[str]:
        """Message types that are asked for, without the ``msg``."""
        return frozenset(short_name(table["type"]) for table in self.tables.values() if "type" in table)

    def adapters(self, role: str, type_name: str) -> list[Adapter]:
        """Adapters for one type: those that come along, changed as the table says, or the table's own.

        Raises
        ------
        LogError
            As `parse`.
        """
        table = {**self.table(role), "type": type_name}
        bases = shipped_for(role, type_name)
        if not bases and "type" not in self.table(role):
            return []
        if not bases:
            return [self._build(role, ADAPTERS[role], _changes(ADAPTERS[role].model_construct(type=type_name), table))]
        return [self._build(role, type(base), {**base.model_dump(), **_changes(base, table)}) for base in bases]

    def require_fields(self, role: str, type_name: str, definition: Struct) -> None:
        """Refuse a table that names fields which messages do not have.

        Raises
        ------
        LogError
            Naming source, table, key and field, and the fields that there are.
        """
        lacking = [
            absent_fields(self.table(role), adapter.missing_in(definition), definition)
            for adapter in self.adapters(role, type_name)
        ]
        if lacking and all(lacking):
            raise LogError(f"{self.source}: [{role}] {'; '.join(lacking[-1])}")

    def _check(self, role: str, table: Table) -> None:
        """Find mistakes before any log is read; where the type is not known yet, one that comes along must fit."""
        if "type" in table and not isinstance(table["type"], str):
            raise LogError(f"{self.source}: [{role}] type: expected a text such as {SHIPPED[role][0].adapter.type!r}")
        if "type" in table:
            self.adapters(role, table["type"])
            return
        faults = []
        for type_name in dict.fromkeys(shipped.adapter.type for shipped in SHIPPED[role]):
            try:
                self.adapters(role, type_name)
            except LogError as error:
                faults.append(error)
            else:
                return
        raise faults[0]

    def _build(self, role: str, kind: type[Adapter], values: Mapping[str, Any]) -> Adapter:
        try:
            return kind.model_validate(values)
        except ValidationError as error:
            is_incomplete = any(fault["type"] == "missing" for fault in error.errors())
            why = f"; no adapter comes along for {values['type']}, so its fields are named" if is_incomplete else ""
            raise LogError(f"{self.source}: [{role}] {faults_in(error, kind)}{why}") from error


def shipped_for(role: str, type_name: str) -> list[Adapter]:
    """The adapters for a type that come along."""
    wanted = short_name(type_name)
    return [s.adapter for s in SHIPPED[role] if short_name(s.adapter.type) == wanted]


def shipped_like(role: str, type_name: str, definition: Struct) -> Adapter | None:
    """The adapter that comes along for a type and has all its fields in the definition; None where there is none."""
    return next((base for base in shipped_for(role, type_name) if not base.missing_in(definition)), None)


def read_log_config(path: Path) -> LogConfig:
    """Read a TOML file that says what the topics of a log are.

    Raises
    ------
    LogError
        When the file cannot be read, is not TOML, or says something that cannot be; naming table and key.
    """
    try:
        values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise LogError(f"{path}: not TOML: {error}") from error
    return LogConfig.parse(values, str(path))


def _changes(base: BaseModel, table: Table) -> dict[str, Any]:
    """A table over an adapter: sections are merged, ``false`` takes away what can be absent."""
    changes: dict[str, Any] = {}
    for key, value in table.items():
        old = getattr(base, key, None)
        if value is False and not isinstance(old, bool):
            changes[key] = None
        elif isinstance(old, BaseModel) and isinstance(value, Mapping):
            changes[key] = {**old.model_dump(), **value}
        else:
            changes[key] = value
    return changes


_WIDTH = 120
_TURNED_OFF = "false"


def table_text(role: str, topic: str, adapter: Adapter, shipped: Adapter | None) -> str:
    """A table that gives this adapter again when it is read, each key with what it means.

    Parameters
    ----------
    role, topic, adapter
        What was chosen.
    shipped
        The adapter that comes along for the type, whose settings hold where the table has none.
    """
    lines = [f"[{role}]", _line("topic", topic, None), _line("type", adapter.type, None)]
    for name, info in type(adapter).model_fields.items():
        value = getattr(adapter, name)
        if name in ("topic", "type", "use"):
            continue
        if value is not None:
            lines.append(_line(name, value, info.description))
        elif shipped is not None and getattr(shipped, name, None) is not None:
            lines.append(f"{name} = {_TURNED_OFF}")
    return "\n".join(lines)


def changes_text(adapter: Adapter, shipped: Adapter | None) -> str:
    """What differs from the adapter that comes along, or all that is said where none does; empty: nothing."""
    base = shipped or type(adapter).model_construct(type="")
    said = {name: getattr(adapter, name) for name in type(adapter).model_fields if name not in ("topic", "use")}
    changed = {name: value for name, value in said.items() if value != getattr(base, name, None)}
    return ", ".join(
        f"{name} = {_TURNED_OFF if value is None else toml_value(value)}" for name, value in changed.items()
    )


def plain_lines(table: Mapping[str, Any]) -> list[str]:
    """The keys of a table, one a line."""
    return [f"{_key(name)} = {toml_value(value)}" for name, value in table.items()]


def comment(text: str) -> str:
    """Text as comment lines."""
    return "\n".join(f"# {line}".rstrip() for line in text.splitlines())


def _line(name: str, value: Any, description: str | None) -> str:
    line = f"{name} = {toml_value(value)}"
    meaning = " ".join((description or "").split()).partition(". ")[0].rstrip(".")
    with_meaning = f"{line}  # {meaning}"
    return with_meaning if meaning and len(with_meaning) <= _WIDTH else line


def toml_value(value: Any) -> str:
    """A value as TOML, on one line.

    Raises
    ------
    TypeError
        For what TOML cannot express.
    """
    if isinstance(value, BaseModel):
        return toml_value(value.model_dump(exclude_none=True))
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)} = {toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    raise TypeError(f"{type(value).__name__} has no TOML form")


def _key(name: str) -> str:
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else _text(name)


def _text(value: str) -> str:
    """A basic string: that of JSON, but for one character that TOML does not allow."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
