"""What a file says about its channels, in several places that should agree."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from sonar_graph.logs.summary import Summary, parse
from sonar_graph.logs.topic import Keep, Topic

_NO_SCHEMA = Schema(id=0, name="", encoding="", data=b"")
_TRANSIENT_LOCAL = re.compile(r"durability:\s*(1\b|transient_local)")


class Descriptions:
    """Schemas and channels by their numbers.

    The first description of a number holds, but one under a CRC goes before one without. Those of the summary come
    first, so that they stand in for any that are lost in the data.
    """

    def __init__(self, path: Path, keep: Callable[[str], Keep]) -> None:
        self._path = path
        self._keep = keep
        self._schemas: dict[int, tuple[Schema, bool]] = {}
        self._channels: dict[int, tuple[Channel, bool]] = {}
        self.by_channel: dict[int, Topic] = {}
        self.by_name: dict[str, Topic] = {}
        self.as_written: dict[str, tuple[Channel, Schema]] = {}
        """Each topic's channel and schema, byte by byte."""
        self.remarks: list[str] = []

    def add_summary(self, summary: Summary) -> None:
        """Take in the summary's copies."""
        for schema in summary.schemas:
            self._add_schema(schema, is_covered=summary.has_crc)
        for channel in summary.channels:
            self._add_channel(channel, is_covered=summary.has_crc)

    def add(self, opcode: int, content: bytes, *, is_covered: bool) -> None:
        """Take in a record; ``is_covered``: a CRC fits it.

        Raises
        ------
        LogError
            When it is not what its kind says.
        """
        if opcode == Opcode.SCHEMA:
            self._add_schema(parse(Schema.read, content), is_covered=is_covered)
        elif opcode == Opcode.CHANNEL:
            self._add_channel(parse(Channel.read, content), is_covered=is_covered)

    def _add_schema(self, schema: Schema, *, is_covered: bool) -> None:
        known, was_covered = self._schemas.get(schema.id, (None, False))
        if known is None or (known != schema and is_covered and not was_covered):
            self._schemas[schema.id] = schema, is_covered
        if known is not None and known != schema:
            self._disagree(f"schema {schema.id} ({known.name})", is_covered=is_covered or was_covered)

    def _add_channel(self, channel: Channel, *, is_covered: bool) -> None:
        known, was_covered = self._channels.get(channel.id, (None, False))
        if known is None or (known != channel and is_covered and not was_covered):
            self._channels[channel.id] = channel, is_covered
            self.by_channel[channel.id] = self._topic(channel)
        if known is not None and known != channel:
            self._disagree(f"channel {channel.id} ({known.topic})", is_covered=is_covered or was_covered)

    def _disagree(self, what: str, *, is_covered: bool) -> None:
        held = "the one under a CRC holds" if is_covered else "the first holds"
        remark = f"{what} is described in two ways; {held}"
        if remark not in self.remarks:
            self.remarks.append(remark)

    def _topic(self, channel: Channel) -> Topic:
        schema, _ = self._schemas.get(channel.schema_id, (_NO_SCHEMA, True))
        offered = channel.metadata.get("offered_qos_profiles", "")
        topic = Topic(
            file=self._path,
            name=channel.topic,
            type_name=schema.name,
            encoding=channel.message_encoding,
            schema_encoding=schema.encoding,
            schema_text=schema.data.decode("utf-8", "replace"),
            keep=self._keep(schema.name),
            is_latched=channel.topic.endswith("_static") or bool(_TRANSIENT_LOCAL.search(offered)),
        )
        self.as_written.setdefault(channel.topic, (channel, schema))
        return self.by_name.setdefault(channel.topic, topic)
