"""The MCAP container: messages gathered by topic, and what is damaged.

Every record is visited in file order, whether or not the file has a summary; every chunk's CRC is checked; messages
of one length are gathered from a chunk in one copy. Messages of topics that nobody asked for are never touched.

Format: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from sonar_graph.errors import LogError
from sonar_graph.logs.cdr import Bytes, Messages, decode
from sonar_graph.logs.schema import Struct, parse_definition
from sonar_graph.measurements import Ints

MAGIC = b"\x89MCAP0\r\n"
STAMP_BYTES = 12
"""Encapsulation header, seconds and nanoseconds: where a message with a header has its stamp."""
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNKABLE = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_LOOSE_BYTES = 1 << 20
_OTHER_FORMATS = {b"#ROSBAG": "a ROS 1 bag", b"SQLite format 3": "a ROS 2 bag of the sqlite3 kind"}


class Keep(Enum):
    """How much of a topic's messages to keep while going through a file."""

    STAMP = STAMP_BYTES
    """The beginning of each payload, enough for its header's stamp."""
    ALL = -1


@dataclass
class Topic:
    """The messages of one topic."""

    file: Path
    name: str
    type_name: str
    """Such as ``sensor_msgs/msg/Imu``."""
    encoding: str
    """Of the messages: ``cdr``, ``protobuf``, ``json``, ..."""
    schema_encoding: str
    """``ros2msg``, ``ros2idl``, ``protobuf``, ..."""
    schema_text: str
    keep: Keep
    times: list[Ints] = field(default_factory=list)
    """Log times by chunk."""
    stacks: dict[int, list[tuple[Ints, Bytes]]] = field(default_factory=lambda: defaultdict(list))
    """Row numbers and payload bytes by number of bytes."""

    def __len__(self) -> int:
        return sum(map(len, self.times))

    @property
    def is_ros2(self) -> bool:
        """Whether its messages are CDR with a ``ros2msg`` definition."""
        return self.encoding == "cdr" and self.schema_encoding == "ros2msg"

    @property
    def log_times_ns(self) -> Ints:
        """When each message was recorded, shape (n,)."""
        return np.concatenate(self.times) if self.times else np.empty(0, np.int64)

    def definition(self) -> Struct:
        """The type of its messages.

        Raises
        ------
        LogError
            Naming file, topic and what is wrong in the definition.
        """
        with self._blaming():
            return parse_definition(self.type_name, self.schema_text)

    def messages(self) -> list[Messages]:
        """All messages, grouped by layout.

        Raises
        ------
        LogError
            Naming file, topic and what is wrong in a message.
        """
        definition = self.definition()
        stacks = [
            (np.concatenate([r for r, _ in parts]), np.concatenate([b for _, b in parts]))
            for parts in self.stacks.values()
        ]
        with self._blaming():
            return decode(definition, stacks)

    @contextmanager
    def _blaming(self) -> Iterator[None]:
        try:
            yield
        except LogError as error:
            raise LogError(f"{self.file}: topic {self.name} ({self.type_name}): {error}") from error

    def gather(self, data: bytes, offsets: Ints, sizes: Ints, log_times_ns: Ints) -> None:
        """Take in the messages that lie at the offsets of a chunk's bytes."""
        first = len(self)
        self.times.append(log_times_ns)
        kept = sizes if self.keep is Keep.ALL else np.minimum(sizes, self.keep.value)
        for size in np.unique(kept).tolist():
            if size:
                rows = np.flatnonzero(kept == size)
                windows = np.ndarray((len(data) - size + 1,), f"V{size}", data, strides=(1,))
                self.stacks[size].append((first + rows, windows[offsets[rows]].view(np.uint8).reshape(-1, size)))


@dataclass
class Recording:
    """What an MCAP file holds."""

    path: Path
    topics: dict[str, Topic] = field(default_factory=dict)
    """Those with messages, by name."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    """Metadata records by name; of two with one name the last."""
    ending: str | None = None
    """What is wrong with the end of a file that was cut off; everything before is whole."""
    corrupt: list[str] = field(default_factory=list)
    """Chunks that are lost, each with the reason."""

    def require_sound(self) -> None:
        """Refuse a file with lost chunks in its middle.

        Raises
        ------
        LogError
            Naming the first lost chunk.
        """
        if self.corrupt:
            more = f" (and {len(self.corrupt) - 1} more)" if len(self.corrupt) > 1 else ""
            advice = "copy it again or run `mcap recover` on it"
            raise LogError(f"{self.path} is damaged: {self.corrupt[0]}{more}; {advice}")


def scan(path: Path, keep: Callable[[str], Keep]) -> Recording:
    """Go through an MCAP file once.

    Parameters
    ----------
    path
        The file.
    keep
        From a type's name, how much of such messages to keep.

    Raises
    ------
    LogError
        When there is no such file or it is not MCAP.
    """
    recording = Recording(path)
    with _open(path) as stream:
        _Scan(recording, keep).run(stream)
    return recording


def _open(path: Path) -> BinaryIO:
    if path.is_dir():
        raise LogError(f"{path} is a folder; give the .mcap file in it")
    try:
        stream = path.open("rb")
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}") from error
    start = stream.read(16)
    if not start.startswith(MAGIC):
        stream.close()
        kind = next((name for magic, name in _OTHER_FORMATS.items() if start.startswith(magic)), "something else")
        advice = "of a ROS bag `rosbags-convert --src BAG --dst FOLDER --dst-storage mcap` makes one"
        raise LogError(f"{path} is not an MCAP file but {kind}; {advice}")
    stream.seek(len(MAGIC))
    return stream


class _Scan:
    """One pass over a file's records."""

    def __init__(self, recording: Recording, keep: Callable[[str], Keep]) -> None:
        self._recording = recording
        self._keep = keep
        self._schemas: dict[int, Schema] = {}
        self._topics: dict[int, Topic] = {}
        self._chunks = 0
        self._loose = bytearray()

    def run(self, stream: BinaryIO) -> None:
        size = stream.seek(0, 2)
        stream.seek(size - len(MAGIC))
        has_end = stream.read() == MAGIC and size > len(MAGIC)
        stream.seek(len(MAGIC))
        for opcode, body in self._records(stream, size, has_end):
            if opcode == Opcode.CHUNK:
                self._take_loose()
                self._take_chunk(body)
            elif opcode == Opcode.METADATA:
                record = Metadata.read(ReadDataStream(BytesIO(body)))
                self._recording.metadata[record.name] = record.metadata
            elif opcode in _CHUNKABLE:
                self._loose += _RECORD.pack(opcode, len(body)) + body
                if len(self._loose) > _LOOSE_BYTES:
                    self._take_loose()
        self._take_loose()
        topics = self._recording.topics
        self._recording.topics = {name: topics[name] for name in sorted(topics) if len(topics[name])}

    def _records(self, stream: BinaryIO, size: int, has_end: bool) -> Iterator[tuple[int, bytes]]:
        """Records of the data section; the summary after it only repeats."""
        while True:
            at = stream.tell()
            head = stream.read(_RECORD.size)
            opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
            if opcode == Opcode.DATA_END:
                return
            if opcode == 0 or length > size - stream.tell():
                self._broken(at, size, has_end)
                return
            yield opcode, stream.read(length)

    def _broken(self, at: int, size: int, has_end: bool) -> None:
        if has_end:
            self._recording.corrupt.append(f"no valid record at byte {at} of {size}")
        else:
            self._recording.ending = f"the file is cut off: its last whole record ends at byte {at} of {size}"

    def _take_loose(self) -> None:
        """Take in what lies outside chunks."""
        data = bytes(self._loose)
        self._loose.clear()
        self._take("a stretch without chunks", lambda: data)

    def _take_chunk(self, body: bytes) -> None:
        self._chunks += 1

        def unpack() -> bytes:
            chunk = Chunk.read(ReadDataStream(BytesIO(body)))
            data: bytes = get_chunk_data_stream(chunk, validate_crc=True)[0].read(chunk.uncompressed_size)
            return data

        self._take(f"chunk {self._chunks}", unpack)

    def _take(self, part: str, unpack: Callable[[], bytes]) -> None:
        try:
            data = unpack()
            found = self._messages_in(data)
        except Exception as error:  # the decompressors and the record reader each have errors of their own
            self._recording.corrupt.append(f"{part} is lost ({error})")
            return
        for channel in found.keys() - self._topics.keys():
            count = len(found.pop(channel))
            self._recording.corrupt.append(f"{part} has {count} messages of channel {channel}, which is not described")
        self._gather(data, found)

    def _messages_in(self, data: bytes) -> dict[int, list[tuple[int, int, int]]]:
        """Offset, size and log time of each message, by channel."""
        found: dict[int, list[tuple[int, int, int]]] = defaultdict(list)
        at, end = 0, len(data)
        while at < end:
            opcode, length = _RECORD.unpack_from(data, at)
            at += _RECORD.size
            if length > end - at:
                raise LogError("a record in it is longer than the chunk")
            if opcode == Opcode.MESSAGE:
                channel, _, log_time_ns, _ = _MESSAGE.unpack_from(data, at)
                found[channel].append((at + _MESSAGE.size, length - _MESSAGE.size, log_time_ns))
            elif opcode == Opcode.SCHEMA:
                self._add_schema(data[at : at + length])
            elif opcode == Opcode.CHANNEL:
                self._add_channel(data[at : at + length])
            at += length
        return found

    def _gather(self, data: bytes, found: dict[int, list[tuple[int, int, int]]]) -> None:
        for channel, entries in found.items():
            offsets, sizes, log_times_ns = np.array(entries, np.int64).T
            self._topics[channel].gather(data, offsets, sizes, log_times_ns)

    def _add_schema(self, body: bytes) -> None:
        schema = Schema.read(ReadDataStream(BytesIO(body)))
        self._schemas[schema.id] = schema

    def _add_channel(self, body: bytes) -> None:
        channel = Channel.read(ReadDataStream(BytesIO(body)))
        if channel.id in self._topics:
            return
        schema = self._schemas.get(channel.schema_id, Schema(id=0, name="", encoding="", data=b""))
        topic = Topic(
            file=self._recording.path,
            name=channel.topic,
            type_name=schema.name,
            encoding=channel.message_encoding,
            schema_encoding=schema.encoding,
            schema_text=schema.data.decode("utf-8", "replace"),
            keep=self._keep(schema.name),
        )
        self._topics[channel.id] = self._recording.topics.setdefault(channel.topic, topic)
