"""Writing MCAP: columns of payloads from several topics, merged by time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.writer import Writer

from sonar_graph.errors import LogError
from sonar_graph.logs.cdr import Bytes
from sonar_graph.logs.message_definitions import definition
from sonar_graph.measurements import Ints

_CHUNK_BYTES = 1 << 20


@dataclass(frozen=True)
class Outgoing:
    """Encoded messages of equal size for one topic."""

    topic: str
    type_name: str
    """Such as ``sensor_msgs/msg/Imu``."""
    log_times_ns: Ints
    """When each message counts as recorded, shape (n,)."""
    payloads: Bytes
    """Shape (n, size)."""


def write_recording(path: Path, messages: list[Outgoing], metadata: Mapping[str, Mapping[str, str]]) -> None:
    """Write an MCAP file of profile ``ros2``; an existing file is replaced only when the new one is complete.

    Messages appear in the order of their log times; those at one instant in the order of the list.

    Raises
    ------
    LogError
        When the file cannot be written.
    """
    partial = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            _write(partial, messages, metadata)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror}") from error


def _write(path: Path, messages: list[Outgoing], metadata: Mapping[str, Mapping[str, str]]) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=_CHUNK_BYTES)
        writer.start(profile="ros2", library="sonar-graph")
        for name, record in metadata.items():
            writer.add_metadata(name, dict(record))
        _add_messages(writer, messages)
        writer.finish()  # type: ignore[no-untyped-call]  # of the mcap package


def _add_messages(writer: Writer, messages: list[Outgoing]) -> None:
    channels = _register(writer, messages)
    times_ns = np.concatenate([np.maximum(m.log_times_ns, 0) for m in messages] or [np.empty(0, np.int64)])
    source = np.repeat(np.arange(len(messages)), [len(m.log_times_ns) for m in messages])
    row = np.concatenate([np.arange(len(m.log_times_ns)) for m in messages] or [np.empty(0, np.int64)])
    order = np.argsort(times_ns, kind="stable")
    for time_ns, of, at in zip(times_ns[order].tolist(), source[order].tolist(), row[order].tolist(), strict=True):
        writer.add_message(channels[of], time_ns, messages[of].payloads[at].tobytes(), time_ns)


def _register(writer: Writer, messages: list[Outgoing]) -> list[int]:
    """The channel of each entry; entries of one topic share it."""
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for entry in messages:
        if entry.type_name not in schemas:
            text = definition(entry.type_name).encode()
            schemas[entry.type_name] = writer.register_schema(entry.type_name, "ros2msg", text)
        if entry.topic not in channels:
            channels[entry.topic] = writer.register_channel(entry.topic, "cdr", schemas[entry.type_name])
    return [channels[entry.topic] for entry in messages]
