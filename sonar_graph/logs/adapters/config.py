"""What a user says about a log: a table a role, in TOML, with anything that an adapter has.

A table of a type that comes along changes only what it names::

    [dvl]
    topic = "/dvl/data"
    rotation = "frd"
    covariance = {meaning = "standard deviation"}

for any other type it names the fields. ``false`` takes away what the adapter that comes along has.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters.adapter import Adapter
from sonar_graph.logs.adapters.config_faults import absent_fields
from sonar_graph.logs.adapters.detection_array import DetectionArrayAdapter
from sonar_graph.logs.adapters.doppler import DvlAdapter
from sonar_graph.logs.adapters.inertial import ImuAdapter
from sonar_graph.logs.adapters.landmarks import LandmarkMapAdapter
from sonar_graph.logs.adapters.reference import TruthAdapter
from sonar_graph.logs.adapters.shipped import SHIPPED
from sonar_graph.logs.adapters.sonar_images import SonarAdapter
from sonar_graph.logs.adapters.vertical import DepthAdapter
from sonar_graph.logs.message_definitions import short_name
from sonar_graph.logs.schema import Struct
from sonar_graph.validation import faults_in

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
