"""Records of an MCAP file: where each begins and ends, also in a file that is damaged.

The walk goes from record to record in file order and believes a length only where something speaks for it: a chunk
says its length twice, an index says how long it is, the next record must begin like one. Where nothing fits, the walk
searches for the next place that does, and what lies between becomes a `Hole`.

Format: https://mcap.dev/spec

Files that are given as a log and are none: what they seem to be, and what to do.

Metadata records that carry their own checksum, because the container gives them none.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from sonar_graph.errors import LogError

BAG_MAGIC = (b"#ROSBAG", b"SQLite format 3")
"""How ROS 1 bags and the files of ROS 2 bags begin."""
START_BYTES = 64
"""How much of a file's beginning tells."""


def kind_and_advice(path: Path, start: bytes) -> str:
    """What completes "is not an MCAP file but ...".

    Parameters
    ----------
    path
        Of the file.
    start
        Its first bytes; fewer than `START_BYTES` only where the file ends.
    """
    convert = f"`sonar-graph convert rosbag {path} -o {path.with_suffix('.mcap').name}` makes one"
    if start.startswith(b"#ROSBAG"):
        return f"a ROS 1 bag; {convert}"
    if start.startswith(b"SQLite format 3"):
        return f"a ROS 2 bag of the sqlite3 kind; {convert}"
    return _neither(start, "logs are .mcap files, and ROS bags become one by `sonar-graph convert rosbag`")


def why_no_bag(path: Path, start: bytes) -> str | None:
    """What completes "`path` is ..." where a file is no bag by its first bytes; None where it may be one."""
    if start.startswith(BAG_MAGIC):
        return None
    if start.startswith(MCAP0_MAGIC):
        return f"already an MCAP file: read it directly, `sonar-graph inspect {path}`"
    return f"no bag but {_neither(start, 'give a ROS 1 .bag, or the folder of a ROS 2 bag')}"


def _neither(start: bytes, advice: str) -> str:
    if not start.strip(b"\0"):
        kind = "zeros" if start else "empty"
        return f"{kind}: copy it again, or see whether the recorder wrote anything"
    if _is_text(start):
        first_line = start.decode("utf-8", "replace").strip().partition("\n")[0]
        return f"a text that begins with {first_line[:40]!r}; {advice}"
    return f"something else; {advice}"


def _is_text(start: bytes) -> bool:
    """Whether these are printable characters, the last of which may be cut."""
    text = start.decode("utf-8", "replace").rstrip("\ufffd")
    return bool(text) and all(character.isprintable() or character.isspace() for character in text)


MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
LOOSE = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
"""Kinds that lie in chunks, or outside where a writer makes none."""
_TIMES_SIZE_CRC = struct.Struct("<QQQII")
_LONGEST_COMPRESSION = 16
_CHUNK_HEAD = HEAD.size + _TIMES_SIZE_CRC.size + _LONGEST_COMPRESSION + 8
_CHUNK_FIXED = _TIMES_SIZE_CRC.size + 8
_NEVER = 1 << 64
_SMALLEST: dict[int, int] = {
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: 22,
    Opcode.ATTACHMENT: 36,
    Opcode.METADATA: 8,
}
PRIVATE = 0x80
"""Kinds from here on are a writer's own and mean nothing to others."""
_BLOCK = 1 << 22
_STRETCH = 1 << 20
_CHAIN = 3


@dataclass(frozen=True)
class Record:
    """Where a record lies."""

    opcode: int
    at: int
    """Offset of its first byte."""
    size: int
    """Of its content, after opcode and length."""

    @property
    def content_at(self) -> int:
        """Offset of its content."""
        return self.at + HEAD.size

    @property
    def end(self) -> int:
        """Offset after its last byte."""
        return self.content_at + self.size


@dataclass(frozen=True)
class ChunkRecord(Record):
    """A chunk and what its head says."""

    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    """Of the uncompressed records; 0: none."""
    compression: str
    data_at: int
    data_size: int


@dataclass(frozen=True)
class ByteRange:
    """Bytes that are whole records without a chunk around them: schemas, channels and messages."""

    at: int
    end: int


@dataclass(frozen=True)
class Hole:
    """Bytes that are no records."""

    at: int
    end: int


class LogFile:
    """An MCAP file open for reading.

    Raises
    ------
    LogError
        When there is no such file or it is not MCAP.
    """

    def __init__(self, path: Path) -> None:
        if path.is_dir():
            raise LogError(f"{path} is a folder; give the .mcap file in it")
        try:
            self._stream = path.open("rb", buffering=1 << 16)
        except OSError as error:
            raise LogError(f"{path} cannot be read: {error.strerror}") from error
        self.path = path
        self.size = self._stream.seek(0, 2)
        start = self.read(0, START_BYTES)
        if not start.startswith(MAGIC):
            self._stream.close()
            raise LogError(f"{path} is not an MCAP file but {kind_and_advice(path, start)}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._stream.close()

    def read(self, at: int, count: int) -> bytes:
        """Bytes from an offset on; fewer than asked for at the end of the file."""
        if at >= self.size:  # a damaged length may point anywhere
            return b""
        self._stream.seek(at)
        return self._stream.read(min(count, self.size - at))

    def content(self, record: Record) -> bytes:
        """What a record holds."""
        return self.read(record.content_at, record.size)

    def record(self, at: int) -> Record | None:
        """What would be the record at an offset; a chunk also where its opcode or its outer length is damaged."""
        start = self.read(at, _CHUNK_HEAD)
        if len(start) < HEAD.size:
            return None
        opcode, size = HEAD.unpack_from(start)
        chunk = None if opcode == Opcode.MESSAGE else _chunk(start, at)
        if chunk is not None and (chunk.size == size or (opcode == Opcode.CHUNK and self._begins(chunk.end))):
            return chunk
        return Record(opcode, at, size)

    def is_like_chunk(self, at: int) -> bool:
        """Whether a chunk begins at an offset, be its lengths as they may."""
        start = self.read(at, _CHUNK_HEAD)
        chunk = _chunk(start, at)
        return chunk is not None and start[0] == Opcode.CHUNK and chunk.compression in ("", "lz4", "zstd")

    def _begins(self, at: int) -> bool:
        """Whether something that begins like a record, or nothing, is at an offset."""
        head = self.read(at, HEAD.size)
        if len(head) < HEAD.size:
            return at == self.size
        opcode, size = HEAD.unpack(head)
        return 0 < opcode <= Opcode.DATA_END and size <= self.size - at - HEAD.size


def _chunk(start: bytes, at: int) -> ChunkRecord | None:
    """The chunk whose head these bytes are, by the lengths within it."""
    if len(start) < HEAD.size + _CHUNK_FIXED:
        return None
    start_ns, end_ns, uncompressed, crc, letters = _TIMES_SIZE_CRC.unpack_from(start, HEAD.size)
    name_at = HEAD.size + _TIMES_SIZE_CRC.size
    if letters > _LONGEST_COMPRESSION or name_at + letters + 8 > len(start):
        return None
    compression = start[name_at : name_at + letters].decode("latin-1")
    (data_size,) = struct.unpack_from("<Q", start, name_at + letters)
    data_at = at + name_at + letters + 8
    size = _CHUNK_FIXED + letters + data_size
    return ChunkRecord(Opcode.CHUNK, at, size, start_ns, end_ns, uncompressed, crc, compression, data_at, data_size)


class RecordWalk:
    """Goes through the data section of a file.

    Parameters
    ----------
    file
        The file.
    data_end_at
        Where the data section ends, if something trustworthy says so.
    """

    def __init__(self, file: LogFile, data_end_at: int | None) -> None:
        self._file = file
        self._at = len(MAGIC)
        self._stop_at = file.size if data_end_at is None else data_end_at
        self._data_end_at = data_end_at
        self._has_chunks = False
        self._is_loose = False
        self.reached_end = data_end_at is not None
        """Whether the data section's end is known or was found."""

    def __iter__(self) -> Iterator[Record | ByteRange | Hole]:
        while self._at < self._stop_at:
            record = self._file.record(self._at)
            if record is not None and self._is_data_end(record):
                self.reached_end = True
                return
            if record is None or not self._is_whole(record):
                yield self.search(self._at)
            elif record.opcode in LOOSE:
                self._is_loose = True
                stretch = ByteRange(self._at, max(record.end, self._last_loose(self._at)))
                self._at = stretch.end
                yield stretch
            else:
                self._has_chunks |= isinstance(record, ChunkRecord)
                self._at = record.end
                yield record

    def search(self, at: int) -> Hole:
        """Give up what begins at an offset and go on with the next trustworthy record after it."""
        self._has_chunks |= self._file.is_like_chunk(at)
        found = self._next_record(at + 1)
        self._at = self._stop_at if found is None else found
        return Hole(at, self._at)

    def jump(self, at: int) -> None:
        """Go on at an offset, where something trustworthy says that a record begins."""
        self._at = at

    def _is_data_end(self, record: Record) -> bool:
        known = self._data_end_at is not None
        return record.opcode == Opcode.DATA_END and record.size == 4 and not known

    def _is_whole(self, record: Record) -> bool:
        if record.end > self._stop_at or not self._is_likely(record):
            return False
        if record.opcode not in LOOSE or record.end == self._stop_at:
            return True
        following = self._file.record(record.end)  # the only witness to the length of a record without chunk
        return following is None or self._is_likely(following)

    def _is_likely(self, record: Record) -> bool:
        """Whether a record of this kind can have this length, in the data section."""
        if record.opcode in (Opcode.CHUNK, Opcode.HEADER):
            return isinstance(record, ChunkRecord) or record.at == len(MAGIC)
        if record.opcode == Opcode.MESSAGE_INDEX:
            count = self._file.read(record.content_at + 2, 4)
            return record.size >= 6 and len(count) == 4 and int.from_bytes(count, "little") == record.size - 6
        if record.opcode == Opcode.DATA_END:
            return record.size == 4
        return record.opcode >= PRIVATE or record.size >= _SMALLEST.get(record.opcode, _NEVER)

    def _last_loose(self, at: int) -> int:
        """Where the last of the records without chunk begins that lie in a block; those before it are whole."""
        block = self._file.read(at, min(_STRETCH, self._stop_at - at))
        place = 0
        while place + HEAD.size <= len(block):
            opcode, size = HEAD.unpack_from(block, place)
            if opcode not in LOOSE or size < _SMALLEST[opcode] or place + HEAD.size + size > len(block):
                break
            last, place = place, place + HEAD.size + size
        return at + (place if at + place == self._stop_at else last)

    def _next_record(self, start: int) -> int | None:
        """Where the next trustworthy record begins: a chunk or metadata; in a file without chunks three in a row.

        What looks like a message is not taken for one in a file with chunks: it may lie within a damaged chunk.
        """
        found = None
        if not self._is_loose or self._has_chunks:
            found = self._next_of(start, (Opcode.CHUNK, Opcode.METADATA))
        if found is None and not self._has_chunks:
            found = self._next_of(start, (Opcode.METADATA, *LOOSE))
        return found

    def _next_of(self, start: int, kinds: Sequence[Opcode]) -> int | None:
        for block_at in range(start, self._stop_at, _BLOCK):
            block = self._file.read(block_at, _BLOCK + HEAD.size)
            for offset in _places_of(block, kinds, self._stop_at):
                if offset < _BLOCK and self._is_trustworthy(block_at + offset):
                    return block_at + offset
        return None

    def _is_trustworthy(self, at: int) -> bool:
        record = self._file.record(at)
        if isinstance(record, ChunkRecord):
            return record.size == HEAD.unpack(self._file.read(at, HEAD.size))[1]
        for _ in range(_CHAIN):
            if record is None or record.end > self._stop_at or not self._is_likely(record):
                return False
            if record.end == self._stop_at:
                return True
            record = self._file.record(record.end)
        return True


def _places_of(block: bytes, kinds: Sequence[Opcode], limit: int) -> list[int]:
    """Offsets at which a byte is one of the kinds and the eight after it are a length below the limit."""
    octets = np.frombuffer(block, np.uint8)
    if len(octets) < HEAD.size:
        return []
    wanted = np.zeros(256, bool)
    wanted[[int(kind) for kind in kinds]] = True
    places = np.flatnonzero(wanted[octets[: len(octets) - HEAD.size + 1]])
    lengths = np.ndarray((len(octets) - 7,), "<u8", block, strides=(1,))[places + 1]
    return [int(place) for place in places[lengths <= limit]]


_SEAL = "crc32"


def seal(metadata: Mapping[str, str]) -> dict[str, str]:
    """The metadata with a CRC-32 over its keys and values, under the key ``crc32``."""
    return {**metadata, _SEAL: _checksum(metadata)}


def open_seal(metadata: Mapping[str, str]) -> tuple[dict[str, str], bool]:
    """The metadata without the checksum, and whether it had one.

    Raises
    ------
    LogError
        When the checksum does not fit.
    """
    content = {key: value for key, value in metadata.items() if key != _SEAL}
    if _SEAL not in metadata:
        return content, False
    if metadata[_SEAL] != _checksum(content):
        raise LogError("its CRC does not fit its content")
    return content, True


def _checksum(metadata: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(metadata.items())).encode()):08x}"
