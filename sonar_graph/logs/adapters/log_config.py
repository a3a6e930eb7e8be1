"""Log configuration: what a user states about the topics of a log, one TOML table a role.

A table of a shipped type changes only what it names; for any other type it names the fields. ``false`` takes away what
the shipped adapter has (docs/tutorials/04_your_own_log.md)::

    [dvl]
    topic = "/dvl/data"
    rotation = "frd"
    covariance = {meaning = "standard deviation"}
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sonar_graph.calibration import Calibration
from sonar_graph.errors import LogError
from sonar_graph.files import as_path, read_toml
from sonar_graph.logs.adapters.adapter import UNITS, Adapter, did_you_mean, leaf_fields
from sonar_graph.logs.adapters.drivers import ADAPTERS, SHIPPED
from sonar_graph.logs.adapters.message_table import LOG_TIME, field_of
from sonar_graph.logs.cdr import Struct, short_name
from sonar_graph.settings import faults_in, meanings_of, toml_key, toml_value

Table = Mapping[str, Any]


@dataclass(frozen=True)
class LogConfig:
    """Validated tables by role; keys that a table leaves out are those of the shipped adapter.

    Examples
    --------
    >>> from sonar_graph import LogConfig
    >>> LogConfig.parse({"dvl": {"rotation": "frd"}}, "by hand").table("dvl")
    {'rotation': 'frd'}
    """

    tables: Mapping[str, Table] = field(default_factory=dict)
    source: str = "log configuration"
    """Name of the file in errors."""

    @classmethod
    def parse(cls, values: Mapping[str, Any], source: str) -> LogConfig:
        """Check values as TOML gives them, as far as that is possible before a log is read.

        A LogError names the source, the table and the key, and what was expected.
        """
        for role, table in values.items():
            if isinstance(table, Mapping) and "file" in table:
                raise LogError(
                    f"{source}: says which text tables are what ([{role}] file), not what the topics of a log are: "
                    f"give it to `sonar-graph convert csv TABLES --config {source} -o OUT.mcap`; a log made by it "
                    f"needs a log configuration only for what is still to be changed"
                )
        config = cls(values, source)
        # what a table means depends on the type, which only the log may have
        for role, table in values.items():
            if role not in ADAPTERS:
                fault = f"there is no role [{role}]"
                known = [one for one in ADAPTERS if one == role.lower()]
                if known:
                    fault += f"; did you mean [{known[0]}]?"
                elif not isinstance(table, Mapping):
                    fault = f"`{role} = …` belongs below a table, such as [dvl]"
                elif role in Calibration.model_fields:
                    fault += ", which is a section of a calibration: give it with --calibration"
                raise LogError(
                    f"{source}: {fault}; tables are for {', '.join(ADAPTERS)}"
                )
            if not isinstance(table, Mapping):
                fault = f"expected a table, [{role}], not {table!r}"
                raise LogError(f"{source}: {role}: {fault}")
            for key in table.keys() & ADAPTERS.keys():
                raise LogError(
                    f"{source}: [{role}] {key}: a line `{key}. … = …` belongs above the first table, or into [{key}] "
                    f"without `{key}.`"
                )
            shipped = [one.adapter.type for one in SHIPPED[role]]
            if "type" in table:
                if not isinstance(table["type"], str):
                    fault = f"expected a text such as {shipped[0]!r}"
                    raise LogError(f"{source}: [{role}] type: {fault}")
                shipped = [table["type"]]
            # without a type, the table must fit one of the shipped types
            faults = []
            for type_name in shipped:
                try:
                    config.adapters(role, type_name)
                except LogError as error:
                    faults.append(error)
            if len(faults) == len(shipped):
                raise faults[0]
        return config

    def table(self, role: str) -> Table:
        """Table of a role; empty without one."""
        return self.tables.get(role, {})

    def number(self, role: str, key: str, default: float) -> float:
        """A number in a role's table, also where it is written as a unit."""
        value = self.table(role).get(key, default)
        return UNITS[value] if isinstance(value, str) else float(value)

    def types(self) -> frozenset[str]:
        """Message types that tables name, without the ``msg``."""
        return frozenset(
            short_name(table["type"])
            for table in self.tables.values()
            if "type" in table
        )

    def adapters(self, role: str, type_name: str) -> list[Adapter]:
        """Adapters for one type: the shipped ones, changed by the table, or the table's own."""
        table = self.table(role)
        bases = shipped_for(role, type_name)
        if not bases and "type" in table:
            bases = [ADAPTERS[role].model_construct(type=type_name)]
        try:
            return [base.changed({**table, "type": type_name}) for base in bases]
        except ValidationError as error:
            # a type that is not shipped needs all of its fields
            is_incomplete = any(one["type"] == "missing" for one in error.errors())
            why = ""
            if is_incomplete:
                why = f"; no adapter is shipped for {type_name}, so its fields must be named"
            fault = faults_in(error, type(bases[0]))
            raise LogError(f"{self.source}: [{role}] {fault}{why}") from error

    def require_fields(self, role: str, type_name: str, definition: Struct) -> None:
        """Refuse a table that names fields which the messages do not have; naming those that they have."""
        known = dict(leaf_fields(definition))
        faults: list[str] = []
        for adapter in self.adapters(role, type_name):
            missing = adapter.missing_in(definition)
            faults = []
            for key, path in _field_names(self.table(role)):
                is_absent = path in missing
                if key == "stamp":
                    names = {field_of(path)[0], f"{path}.sec"}
                    is_absent = path != LOG_TIME and not names & known.keys()
                elif key == "frame_id_field":
                    is_absent = path not in known
                if is_absent:
                    # a misspelt field is the usual fault
                    meant = did_you_mean(path, known)
                    has = ", ".join(name + size for name, size in known.items())
                    faults.append(
                        f"{key}: {definition.name} has no field {path}; {meant}it has: {has}"
                    )
            if not faults:
                return
        if faults:
            raise LogError(f"{self.source}: [{role}] {'; '.join(faults)}")


def _field_names(values: object, key: str = "") -> Iterator[tuple[str, str]]:
    """Keys of a table with the texts in them that may be names of fields."""
    if isinstance(values, str):
        yield key, values
    elif isinstance(values, Mapping):
        for name, value in values.items():
            path = f"{key}.{name}" if key else name
            yield from _field_names(
                list(value) if name == "valid_where" else value, path
            )
    elif isinstance(values, list):
        for value in values:
            yield from _field_names(value, key)


def shipped_for(role: str, type_name: str) -> list[Adapter]:
    """Shipped adapters for a type."""
    wanted = short_name(type_name)
    return [s.adapter for s in SHIPPED[role] if short_name(s.adapter.type) == wanted]


def shipped_like(role: str, type_name: str, definition: Struct) -> Adapter | None:
    """Shipped adapter for a type whose fields are all in the definition; None without one."""
    return next(
        (
            base
            for base in shipped_for(role, type_name)
            if not base.missing_in(definition)
        ),
        None,
    )


def read_log_config(path: Path) -> LogConfig:
    """Read a TOML file that states what the topics of a log are.

    A LogError where it cannot be read, is not TOML, or states something impossible; it names table and key.
    """
    return LogConfig.parse(read_toml(path, LogError), str(path))


def as_log_config(value: LogConfig | str | Path | None, call: str) -> LogConfig | None:
    """A log configuration, or that in a TOML file; an `ArgumentError` that names the ``call`` where it is neither."""
    if isinstance(value, LogConfig | None):
        return value
    return read_log_config(as_path(value, f"{call}(path, config=FILE or LogConfig)"))


_WIDTH = 120


def table_text(role: str, topic: str, adapter: Adapter, shipped: Adapter | None) -> str:
    """TOML table that gives an adapter again when it is read, each key with its meaning.

    A setting that is None is written only where the shipped adapter for the type has one.
    """
    lines = [
        f"[{role}]",
        _line("topic", topic, None),
        _line("type", adapter.type, None),
    ]
    meanings = meanings_of(type(adapter))
    for name in type(adapter).model_fields:
        value = getattr(adapter, name)
        if name in ("topic", "type", "use"):
            continue
        if value is not None:
            lines.append(_line(name, value, meanings.get(name)))
        elif shipped is not None and getattr(shipped, name, None) is not None:
            lines.append(f"{name} = false")
    return "\n".join(lines)


def changes_text(adapter: Adapter, shipped: Adapter | None) -> str:
    """Differences from the shipped adapter, or all settings where none is shipped; empty: nothing differs."""
    base = shipped or type(adapter).model_construct(type="")
    # the topic is in a note of its own
    changed = {}
    for name in type(adapter).model_fields:
        value = getattr(adapter, name)
        if name not in ("topic", "use") and value != getattr(base, name, None):
            changed[name] = False if value is None else value
    return ", ".join(plain_lines(changed))


def plain_lines(table: Mapping[str, Any]) -> list[str]:
    """Lines of a table, one for each key."""
    return [f"{toml_key(name)} = {toml_value(value)}" for name, value in table.items()]


def _line(name: str, value: Any, description: str | None) -> str:
    line = f"{name} = {toml_value(value)}"
    meaning = " ".join((description or "").split()).partition(". ")[0].rstrip(".")
    with_meaning = f"{line}  # {meaning}"
    return with_meaning if meaning and len(with_meaning) <= _WIDTH else line
