"""Writing of MCAP files of profile ``ros2``: encoded messages of several topics, merged by time.

Chunks carry CRCs, and the file has all indexes. A CRC over all data covers what lies outside chunks, and metadata
have a checksum of their own, which holds also in a file that was cut off. Each chunk is written to the disk as soon as
it is full, so that a writer that is killed loses only its open chunk.

Topics for viewers that join late carry the quality of service "transient local" in the form of rosbag2, so that
``ros2 bag play`` offers it: without it RViz would never receive ``/tf_static``.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from itertools import chain
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.reader import make_reader
from mcap.records import Header
from mcap.writer import Writer

from sonar_graph.files import regular, written_whole
from sonar_graph.logs.cdr import Bytes, definition
from sonar_graph.logs.mcap.log_file import seal
from sonar_graph.measurements import Ints

_CHUNK_BYTES = 1 << 20
_FOREVER = "{sec: 9223372036, nsec: 854775807}"
TRANSIENT_LOCAL = (
    f"- {{history: 1, depth: 10, reliability: 1, durability: 1, deadline: {_FOREVER}, lifespan: {_FOREVER}, "
    f"liveliness: 1, liveliness_lease_duration: {_FOREVER}, avoid_ros_namespace_conventions: false}}"
)
"""Keep last, reliable, transient local, by the numbers of rmw's enumerations as rosbag2 has them up to version 8."""
LIBRARY = "sonar-graph"
"""Library in the header of a log that this package wrote."""
_ROSBAG2_METADATA = {"serialized_metadata": ""}
"""Record that makes newer versions of rosbag2, which write words, read numbers in the offer of a channel."""


@dataclass(frozen=True)
class Outgoing:
    """Encoded messages of equal size for one topic."""

    topic: str
    type_name: str
    """Such as ``sensor_msgs/msg/Imu``."""
    log_times_ns: Ints
    """Time of recording of each message, shape (n,)."""
    payloads: Bytes
    """Shape (n, size)."""
    is_latched: bool = False
    """True for viewers that join late; the first entry of a topic decides."""


class SchemaText(NamedTuple):
    """Definition of a message type, as a log holds it."""

    name: str
    encoding: str
    data: bytes


@cache
def own_schema(type_name: str) -> SchemaText:
    """Definition of one of the types that this package writes."""
    return SchemaText(type_name, "ros2msg", definition(type_name).encode())


def latched(is_latched: bool) -> dict[str, str]:
    """Metadata of a channel whose messages late subscribers get too, or of another channel."""
    return {"offered_qos_profiles": TRANSIENT_LOCAL} if is_latched else {}


def by_time(messages: Sequence[Outgoing]) -> Iterator[tuple[int, Outgoing, bytes]]:
    """Time, entry and payload of each message, by time; those of one instant in the order of the entries."""
    rows = sorted(
        (time_ns, of, row)
        for of, entry in enumerate(messages)
        for row, time_ns in enumerate(entry.log_times_ns.tolist())
    )
    for time_ns, of, row in rows:
        yield time_ns, messages[of], messages[of].payloads[row].tobytes()


def write_recording(
    path: Path,
    messages: list[Outgoing],
    metadata: Mapping[str, Mapping[str, str]],
) -> None:
    """Write an MCAP file of profile ``ros2``; an existing file is replaced only when the new one is complete.

    Messages appear in the order of their log times; those of one instant in the order of the list. A file that cannot
    be written is a LogError.
    """
    with recording(path, metadata) as out:
        out.write(messages)


@contextmanager
def recording(
    path: Path, metadata: Mapping[str, Mapping[str, str]]
) -> Iterator[LogWriter]:
    """Recording that is written piece by piece, for messages that do not fit into memory; metadata come first.

    An existing file is replaced when the context ends without an error; until then, the pieces go to a file beside it.
    A file that cannot be written is a LogError.
    """
    with written_whole(path) as stream:
        out = LogWriter(stream)
        for name, record in metadata.items():
            out.add_metadata(name, record)
        yield out
        out.finish()


def header_of(path: Path) -> Header | None:
    """Header of an MCAP file, which states the profile and the library that wrote it; None without one."""
    with regular(path).open("rb") as stream, suppress(Exception):
        # the package raises whatever its parts raise
        return make_reader(stream).get_header()
    return None


def is_own_log(path: Path) -> bool:
    """True for a log that this package wrote, of whatever profile."""
    header = header_of(path)
    return header is not None and header.library == LIBRARY


class LogWriter:
    """Writer to an open file; memory holds one chunk and the index.

    Schemas and channels are registered once. A log that is copied (``is_copy``) has its own record of rosbag2.
    """

    def __init__(
        self, stream: BinaryIO, profile: str = "ros2", *, is_copy: bool = False
    ) -> None:
        self._stream = stream
        self.mcap = Writer(stream, chunk_size=_CHUNK_BYTES, enable_data_crcs=True)
        self.mcap.start(profile=profile, library=LIBRARY)
        # without it newer rosbag2 cannot read the offers of latched topics
        if not is_copy:
            self.mcap.add_metadata("rosbag2", _ROSBAG2_METADATA)
        # number 0 means that there is no schema
        self._schemas = {SchemaText("", "", b""): 0}
        self._channels: dict[tuple[str, SchemaText], int] = {}

    def add_metadata(self, name: str, record: Mapping[str, str]) -> None:
        """Add a metadata record with its checksum."""
        self.mcap.add_metadata(name, seal(record))

    def channel(
        self,
        topic: str,
        schema: SchemaText,
        encoding: str = "cdr",
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Number of the channel of a topic; the first call makes it known to the file."""
        if schema not in self._schemas:
            self._schemas[schema] = self.mcap.register_schema(*schema)
        key = (topic, schema)
        if key not in self._channels:
            self._channels[key] = self.mcap.register_channel(
                topic, encoding, self._schemas[schema], dict(metadata or {})
            )
        return self._channels[key]

    def write(
        self, messages: Sequence[Outgoing], more: Iterable[Outgoing] = ()
    ) -> None:
        """Write messages in the order of their log times; those of one instant in the order of the list.

        Entries of ``more`` are in the order of time, and each is taken when the one before is written.
        """
        streamed = chain.from_iterable(by_time([entry]) for entry in more)
        # topics are listed in the order of the list, also those without a message
        channels = {entry.topic: self._offer(entry) for entry in messages}
        written = self._stream.tell()
        for time_ns, entry, payload in heapq.merge(
            by_time(messages), streamed, key=lambda message: message[0]
        ):
            if entry.topic not in channels:
                channels[entry.topic] = self._offer(entry)
            at_ns = max(time_ns, 0)
            self.mcap.add_message(channels[entry.topic], at_ns, payload, at_ns)
            # a chunk was full: on the disk it survives the end of this process
            if self._stream.tell() != written:
                self._stream.flush()
                written = self._stream.tell()

    def _offer(self, entry: Outgoing) -> int:
        """Channel of an entry's topic."""
        schema = own_schema(entry.type_name)
        return self.channel(entry.topic, schema, metadata=latched(entry.is_latched))

    def finish(self) -> None:
        """Write the summary."""
        self.mcap.finish()  # type: ignore[no-untyped-call]  # of the mcap package
