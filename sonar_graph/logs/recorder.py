"""Writing MCAP: columns of payloads from several topics, merged by time.

A file has profile ``ros2``, chunks with CRCs, and all indexes. What lies outside chunks is covered too: by a CRC over
all data, and metadata by a checksum of their own, which also holds in a file that was cut off. Each chunk is on its way
to the disk as soon as it is full, so that a writer that is killed loses only the one that it was filling.

Topics that a viewer must also get when it joins late carry the quality of service "transient local" in the form of
rosbag2, so that ``ros2 bag play`` offers it: without it RViz would never receive ``/tf_static``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.writer import Writer

from sonar_graph.errors import LogError
from sonar_graph.logs.layout import Bytes
from sonar_graph.logs.message_definitions import definition
from sonar_graph.logs.metadata import seal
from sonar_graph.measurements import Ints

_CHUNK_BYTES = 1 << 20
_FOREVER = "{sec: 9223372036, nsec: 854775807}"
TRANSIENT_LOCAL = (
    f"- {{history: 1, depth: 10, reliability: 1, durability: 1, deadline: {_FOREVER}, lifespan: {_FOREVER}, "
    f"liveliness: 1, liveliness_lease_duration: {_FOREVER}, avoid_ros_namespace_conventions: false}}"
)
"""Keep last, reliable, transient local: the numbers of rmw's enumerations, as rosbag2 has them up to version 8."""
ROSBAG2_METADATA = {"serialized_metadata": ""}
"""Makes newer versions of rosbag2, which write words, read numbers in what a channel offers."""


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
    is_latched: bool = False
    """Viewers that join late get it too; the first entry of a topic decides."""


@dataclass(frozen=True)
class Attachment:
    """A file within the recording."""

    name: str
    media_type: str
    """Such as ``application/json``."""
    content: bytes


def write_recording(
    path: Path,
    messages: list[Outgoing],
    metadata: Mapping[str, Mapping[str, str]],
    attachments: Sequence[Attachment] = (),
) -> None:
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
            _write(partial, messages, metadata, attachments)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror}") from error


def _write(
    path: Path,
    messages: list[Outgoing],
    metadata: Mapping[str, Mapping[str, str]],
    attachments: Sequence[Attachment],
) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=_CHUNK_BYTES, enable_data_crcs=True)
        writer.start(profile="ros2", library="sonar-graph")
        for name, record in metadata.items():
            writer.add_metadata(name, seal(record))
        if any(entry.is_latched for entry in messages):
            writer.add_metadata("rosbag2", ROSBAG2_METADATA)
        end_ns = max((int(m.log_times_ns.max()) for m in messages if len(m.log_times_ns)), default=0)
        for file in attachments:
            writer.add_attachment(0, max(end_ns, 0), file.name, file.media_type, file.content)
        _add_messages(writer, messages, stream)
        writer.finish()  # type: ignore[no-untyped-call]  # of the mcap package


def _add_messages(writer: Writer, messages: list[Outgoing], stream: BinaryIO) -> None:
    channels = _register(writer, messages)
    times_ns = np.concatenate([np.maximum(m.log_times_ns, 0) for m in messages] or [np.empty(0, np.int64)])
    source = np.repeat(np.arange(len(messages)), [len(m.log_times_ns) for m in messages])
    row = np.concatenate([np.arange(len(m.log_times_ns)) for m in messages] or [np.empty(0, np.int64)])
    order = np.argsort(times_ns, kind="stable")
    written = stream.tell()
    for time_ns, of, at in zip(times_ns[order].tolist(), source[order].tolist(), row[order].tolist(), strict=True):
        writer.add_message(channels[of], time_ns, messages[of].payloads[at].tobytes(), time_ns)
        if stream.tell() != written:  # a chunk was full
            stream.flush()
            written = stream.tell()


def _register(writer: Writer, messages: list[Outgoing]) -> list[int]:
    """The channel of each entry; entries of one topic share it."""
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for entry in messages:
        if entry.type_name not in schemas:
            text = definition(entry.type_name).encode()
            schemas[entry.type_name] = writer.register_schema(entry.type_name, "ros2msg", text)
        if entry.topic not in channels:
            offers = {"offered_qos_profiles": TRANSIENT_LOCAL} if entry.is_latched else {}
            channels[entry.topic] = writer.register_channel(entry.topic, "cdr", schemas[entry.type_name], offers)
    return [channels[entry.topic] for entry in messages]
