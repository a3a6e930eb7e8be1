"""Mistakes in a log configuration that only a log can show: fields that its messages do not have."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from typing import Any

from sonar_graph.logs.adapters.adapter import leaf_fields
from sonar_graph.logs.schema import Struct
from sonar_graph.logs.table import LOG_TIME, field_of


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
