"""Writing of MCAP files of profile ``ros2``: encoded messages of several topics, merged by time.

Chunks carry CRCs, and the file has all indexes. A CRC over all data covers what lies outside chunks, and metadata
have a checksum of their own, which holds also in a file that was cut off. Each chunk is written to the disk as soon as
it is full, so that a writer that is killed loses only its open chunk.

Topics for viewers that join late carry the quality of service "transient local" in the form of rosbag2, so that
``ros2 bag play`` offers it: without it RViz would never receive ``/tf_static``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.reader import make_reader
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
ROSBAG2_METADATA = {"serialized_metadata": ""}
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

    Messages appear in the order of their log times; those of one instant in the order of the list. A file that cannot
    be written is a LogError.
    """
    with recording(path, metadata) as out:
        if any(entry.is_latched for entry in messages):
            out.offer_latched()
        end_ns = max(
            (int(m.log_times_ns.max()) for m in messages if len(m.log_times_ns)),
            default=0,
        )
        for file in attachments:
            out.attach(file, max(end_ns, 0))
        out.write(messages)


@contextmanager
def recording(
    path: Path, metadata: Mapping[str, Mapping[str, str]]
) -> Iterator[RecordingWriter]:
    """Recording that is written piece by piece, for messages that do not fit into memory; metadata come first.

    An existing file is replaced when the context ends without an error; until then, the pieces go to a file beside it.
    A file that cannot be written is a LogError.
    """
    with written_whole(path) as stream:
        out = RecordingWriter(stream)
        for name, record in metadata.items():
            out.add_metadata(name, record)
        yield out
        out.finish()


def is_own_log(path: Path) -> bool:
    """True for a log that this package wrote, of whatever profile, by the header of the file."""
    with regular(path).open("rb") as stream, suppress(Exception):
        # the package raises whatever its parts raise
        return bool(make_reader(stream).get_header().library == LIBRARY)
    return False


class RecordingWriter:
    """Writer to an open file; memory holds one chunk and the index."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._writer = Writer(stream, chunk_size=_CHUNK_BYTES, enable_data_crcs=True)
        self._writer.start(profile="ros2", library=LIBRARY)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._offers_latched = False

    def add_metadata(self, name: str, record: Mapping[str, str]) -> None:
        """Add a metadata record with its checksum."""
        self._writer.add_metadata(name, seal(record))

    def attach(self, file: Attachment, time_ns: int) -> None:
        """Add a file within the recording."""
        self._writer.add_attachment(
            0, time_ns, file.name, file.media_type, file.content
        )

    def offer_latched(self) -> None:
        """State once in the form of rosbag2 that there are latched topics."""
        if not self._offers_latched:
            # without it newer rosbag2 cannot read the offers
            self._writer.add_metadata("rosbag2", ROSBAG2_METADATA)
            self._offers_latched = True

    def write(self, messages: Sequence[Outgoing]) -> None:
        """Write messages in the order of their log times; those of one instant in the order of the list."""
        for entry in messages:
            self._offer(entry)
        rows = sorted(
            (max(time_ns, 0), of, row)
            for of, entry in enumerate(messages)
            for row, time_ns in enumerate(entry.log_times_ns.tolist())
        )
        written = self._stream.tell()
        for time_ns, of, row in rows:
            channel = self._channels[messages[of].topic]
            payload = messages[of].payloads[row].tobytes()
            self._writer.add_message(channel, time_ns, payload, time_ns)
            # a chunk was full: on the disk it survives the end of this process
            if self._stream.tell() != written:
                self._stream.flush()
                written = self._stream.tell()

    def _offer(self, entry: Outgoing) -> None:
        """Make a topic known to the file, once."""
        kind = entry.type_name
        if kind not in self._schemas:
            text = definition(kind).encode()
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text)
        if entry.topic in self._channels:
            return
        offers = {}
        if entry.is_latched:
            self.offer_latched()
            offers["offered_qos_profiles"] = TRANSIENT_LOCAL
        self._channels[entry.topic] = self._writer.register_channel(
            entry.topic, "cdr", self._schemas[kind], offers
        )

    def finish(self) -> None:
        """Write the summary."""
        self._writer.finish()  # type: ignore[no-untyped-call]  # of the mcap package
