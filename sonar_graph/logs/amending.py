"""A log written anew with more messages in it: everything that was there, byte by byte, and what was added."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import Writer

from sonar_graph.errors import LogError
from sonar_graph.logs.message_definitions import definition
from sonar_graph.logs.recorder import Outgoing

_CHUNK_BYTES = 1 << 20
_Message = tuple[int, int, str, bytes, int]
"""Log time, publish time, topic, payload, sequence number."""


def write_amended(source: Path, target: Path, added: Sequence[Outgoing]) -> None:
    """Copy an MCAP log and add messages, all in the order of their log times; only chunks are held in memory.

    Parameters
    ----------
    source
        The log; metadata and attachments are copied too.
    target
        Another file; one that exists is replaced when the new one is complete.
    added
        On topics that the log does not have.

    Raises
    ------
    LogError
        When the two are one file, a topic is there already, or a file cannot be read or written.
    """
    if target.exists() and target.samefile(source):
        raise LogError(f"{target}: is the log itself; give another name with -o")
    partial = target.with_name(target.name + ".part")
    try:
        with source.open("rb") as log, partial.open("wb") as out:
            _copy(source, log, out, added)
        partial.replace(target)
    except OSError as error:
        raise LogError(f"{target} cannot be written: {error.strerror}") from error
    except McapError as error:
        raise LogError(f"{source}: cannot be copied whole: {error}; record or copy it again") from error
    finally:
        partial.unlink(missing_ok=True)


def _copy(source: Path, log: BinaryIO, out: BinaryIO, added: Sequence[Outgoing]) -> None:
    reader = make_reader(log)
    writer = Writer(out, chunk_size=_CHUNK_BYTES, enable_data_crcs=True)
    writer.start(profile=reader.get_header().profile, library="sonar-graph")
    for record in reader.iter_metadata():
        writer.add_metadata(record.name, record.metadata)
    for file in reader.iter_attachments():
        writer.add_attachment(file.create_time, file.log_time, file.name, file.media_type, file.data)
    channels = _Channels(writer)
    for log_time, publish_time, topic, payload, number in heapq.merge(
        _of_log(source, reader, channels, {entry.topic for entry in added}),
        _of_entries(added, channels),
        key=lambda message: message[0],
    ):
        writer.add_message(channels.by_topic[topic], log_time, payload, publish_time, number)
    writer.finish()  # type: ignore[no-untyped-call]  # of the mcap package


class _Channels:
    """Schemas and channels of the file that is written."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[tuple[str, bytes], int] = {}
        self.by_topic: dict[str, int] = {}

    def offer(self, topic: str, schema: tuple[str, str, bytes], encoding: str, metadata: dict[str, str]) -> None:
        """Make a topic known, once."""
        if topic in self.by_topic:
            return
        name, kind, text = schema
        if (name, text) not in self._schemas:
            self._schemas[name, text] = self._writer.register_schema(name, kind, text)
        number = self._schemas[name, text]
        self.by_topic[topic] = self._writer.register_channel(topic, encoding, number, metadata)


def _of_log(source: Path, reader: Any, channels: _Channels, taken: set[str]) -> Iterator[_Message]:
    for schema, channel, message in reader.iter_messages():
        if channel.topic in taken:
            raise LogError(f"{source}: {channel.topic} is in the log already; leave it out where the log is made")
        described = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
        channels.offer(channel.topic, described, channel.message_encoding, channel.metadata)
        yield message.log_time, message.publish_time, channel.topic, message.data, message.sequence


def _of_entries(added: Sequence[Outgoing], channels: _Channels) -> Iterator[_Message]:
    rows = sorted(
        (time_ns, of, row) for of, entry in enumerate(added) for row, time_ns in enumerate(entry.log_times_ns.tolist())
    )
    for time_ns, of, row in rows:
        entry = added[of]
        text = definition(entry.type_name).encode()
        channels.offer(entry.topic, (entry.type_name, "ros2msg", text), "cdr", {})
        yield time_ns, time_ns, entry.topic, entry.payloads[row].tobytes(), 0
