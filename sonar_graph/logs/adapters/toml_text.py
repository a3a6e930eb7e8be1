"""A log configuration as text: what was chosen for each role, with what may be changed and why nothing fits."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from sonar_graph.logs.adapters.adapter import Adapter

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
