"""Records of an MCAP file (https://mcap.dev/spec), also of one that is damaged.

`RecordWalk` goes from record to record in the order of the file. It trusts a length only where a second source agrees:
a chunk states its length twice, a message index states its number of entries, and the next record must begin like one.
Where nothing agrees, the walk searches for the next place that does and reports the bytes between as a `Hole`.

MCAP has no CRC over a metadata record; `seal` adds one to the record's entries.
"""

import json
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from mcap.opcode import Opcode

from sonar_graph.errors import LogError
from sonar_graph.files import regular

MAGIC = b"\x89MCAP0\r\n"
BAG_MAGIC = (b"#ROSBAG", b"SQLite format 3")
"""First bytes of ROS 1 bags and of the files of ROS 2 bags."""
ALREADY_MCAP = "already an MCAP file: read it directly, "
START_BYTES = 64
"""Leading bytes that identify the type of a file."""


TABLES = "write what it holds as text tables, for `sonar-graph convert csv`"
CONVERT = "`sonar-graph convert {} {{file}} -o {{stem}}.mcap` makes a log of it"
FOREIGN: tuple[tuple[bytes, str, str], ...] = (
    (b"#ROSBAG", "a ROS 1 bag", CONVERT.format("rosbag")),
    (b"SQLite format 3", "a ROS 2 bag of the sqlite3 kind", CONVERT.format("rosbag")),
    (b"DDF\x05", "an ARIS' recording", CONVERT.format("aris")),
    *((b"DDF" + bytes([version]), "a DIDSON's recording", CONVERT.format("didson")) for version in range(5)),
    (b"\x28\xb5\x2f\xfd", "compressed by zstd", "`zstd -d {file}` unpacks it"),
    (b"\x04\x22\x4d\x18", "compressed by lz4", "`lz4 -d {file}` unpacks it"),
    (b"\x1f\x8b", "compressed by gzip", "`gunzip {file}` unpacks it"),
    (b"BZh", "compressed by bzip2", "`bunzip2 {file}` unpacks it"),
    (b"\xfd7zXZ", "compressed by xz", "`unxz {file}` unpacks it"),
    (b"PK\x03\x04", "a zip archive", "`unzip {file}` unpacks it"),
    (b"\xa3\x95", "an ArduPilot log (.bin)", "`mavlogdump.py --format csv --types IMU {file} > imu.csv` of pymavlink, "
     "and so on, writes tables for `sonar-graph convert csv`"),
    (b"ULog", "a PX4 log (.ulg)", "`ulog2csv {file}` of pyulog writes tables for `sonar-graph convert csv`"),
    (b"\x7f\x7f", "a PD0 recording of a Doppler log", f"mhkit.dolfyn reads it in Python: {TABLES}"),
    (b"\xa5\x0a", "a Nortek recording (.ad2cp)", f"mhkit.dolfyn reads it in Python: {TABLES}"),
    (b"\x89HDF", "an HDF5 file", TABLES),
    (b"MATLAB", "a MATLAB file", TABLES),
    (b"\x93NUMPY", "a numpy array", TABLES),
)  # fmt: skip
"""First bytes of files of other kinds, what these are, and how their content becomes a log."""


def kind_and_advice(path: Path, start: bytes) -> str:
    """The end of "`path` is not an MCAP file but ...", from the first `START_BYTES` bytes of the file."""
    if path.suffix.lower() == ".oculus":
        return "a file of the Oculus viewer, which is not read; `sonar-graph convert oculus` reads network messages"
    if start.startswith(b"SO") and b"\0" in start:
        return f"an Oculus' recording; `sonar-graph convert oculus {path} -o {path.stem}.mcap` makes a log of it"
    if start[8:9] in (b"\xfd", b"\xfe") and path.suffix == ".tlog":
        return f"MAVLink telemetry (.tlog); `mavlogdump.py --format csv` of pymavlink reads it: {TABLES}"
    return foreign_kind(path, start) or _unknown_kind(
        start,
        "logs are .mcap files; ROS bags become one by `sonar-graph convert rosbag`, text tables by "
        "`sonar-graph convert csv`",
    )


def foreign_kind(path: Path, start: bytes) -> str | None:
    """Kind of a file by its first bytes, and what makes a log of it; None where these are of no such kind."""
    for magic, kind, advice in FOREIGN:
        if start.startswith(magic):
            return f"{kind}; {advice.format(file=path, stem=path.stem)}"
    return None


def why_no_bag(path: Path, start: bytes) -> str | None:
    """The end of "`path` is ..." where the first bytes are not those of a bag; None where they are."""
    if start.startswith(BAG_MAGIC):
        return None
    if start.startswith(MAGIC):
        return f"{ALREADY_MCAP}`sonar-graph inspect {path}`"
    kind = foreign_kind(path, start) or _unknown_kind(
        start, "give a ROS 1 .bag, or the folder of a ROS 2 bag"
    )
    return f"no bag but {kind}"


def _unknown_kind(start: bytes, advice: str) -> str:
    if not start.strip(b"\0"):
        kind = "zeros" if start else "empty"
        return f"{kind}: copy it again, or see whether the recorder wrote anything"
    # the last character may be cut
    text = start.decode("utf-8", "replace").rstrip("\ufffd")
    is_text = (
        all(character.isprintable() or character.isspace() for character in text)
        and "\ufffd" not in text
    )
    if text and is_text:
        first_line = text.strip().partition("\n")[0]
        return f"a text that begins with {first_line[:40]!r}; {advice}"
    return f"something else; {advice}"


HEAD = struct.Struct("<BQ")
LARGEST_BYTES = 1 << 28
"""Most bytes of one record, and of a chunk without compression; a stated size could ask for all memory."""
LARGEST_RATIO = 64
"""Bytes of messages for each byte of a log; samples of an IMU at rest, each with its stamp, compress by some thirty."""
SMALLER_CHUNKS = (
    "`mcap compress LOG -o OUT.mcap --chunk-size 4194304` writes smaller chunks"
)
LOOSE = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
"""Kinds of records within chunks; outside where the writer makes no chunks."""
_TIMES_SIZE_CRC = struct.Struct("<QQQII")
_LONGEST_COMPRESSION = 16
_CHUNK_HEAD = HEAD.size + _TIMES_SIZE_CRC.size + _LONGEST_COMPRESSION + 8
_CHUNK_FIXED = _TIMES_SIZE_CRC.size + 8
_SMALLEST: dict[int, int] = {
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: 22,
    Opcode.ATTACHMENT: 36,
    Opcode.METADATA: 8,
}
PRIVATE = 0x80
"""Kinds of records from here on are private to a writer."""
_BLOCK = 1 << 22
_STRETCH = 1 << 20
_CHAIN = 3


@dataclass(frozen=True)
class Record:
    """Place of a record in the file."""

    opcode: int
    at: int
    """Offset of the first byte."""
    size: int
    """Bytes of content, after opcode and length."""

    @property
    def content_at(self) -> int:
        """Offset of the content."""
        return self.at + HEAD.size

    @property
    def end(self) -> int:
        """Offset after the last byte."""
        return self.content_at + self.size


@dataclass(frozen=True)
class ChunkRecord(Record):
    """A chunk with the fields of its head."""

    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    """CRC of the uncompressed records; 0: none."""
    compression: str
    data_at: int
    data_size: int


@dataclass(frozen=True)
class ByteRange:
    """Bytes of whole schemas, channels and messages outside chunks."""

    at: int
    end: int


@dataclass(frozen=True)
class Hole:
    """Bytes that are not records."""

    at: int
    end: int


class LogFile:
    """An MCAP file open for reading; a LogError where the file does not exist or is not MCAP."""

    def __init__(self, path: Path) -> None:
        if path.is_dir():
            raise LogError(f"{path} is a folder; give the .mcap file in it")
        try:
            self._stream = regular(path).open("rb", buffering=1 << 16)
        except OSError as error:
            raise LogError(f"{path} cannot be read: {error.strerror}") from error
        self.path = path
        self.size = self._stream.seek(0, 2)
        start = self.read(0, START_BYTES)
        if not start.startswith(MAGIC):
            self._stream.close()
            raise LogError(
                f"{path} is not an MCAP file but {kind_and_advice(path, start)}"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def read(self, at: int, count: int) -> bytes:
        """Bytes from an offset on; fewer than asked for at the end of the file.

        A LogError where they are more than `LARGEST_BYTES`.
        """
        if at >= self.size:  # a damaged length may point anywhere
            return b""
        count = min(count, self.size - at)
        if count > LARGEST_BYTES:
            raise LogError(
                f"{self.path}: bytes {at} to {at + count} are one record, and at most {LARGEST_BYTES} are read at "
                f"once; {SMALLER_CHUNKS}"
            )
        self._stream.seek(at)
        return self._stream.read(count)

    def content(self, record: Record) -> bytes:
        """Content of a record."""
        return self.read(record.content_at, record.size)

    def record(self, at: int) -> Record | None:
        """Record at an offset, not checked. A chunk is found also where its opcode or its outer length is damaged."""
        start = self.read(at, _CHUNK_HEAD)
        if len(start) < HEAD.size:
            return None
        opcode, size = HEAD.unpack_from(start)
        chunk = None if opcode == Opcode.MESSAGE else _chunk(start, at)
        if chunk is not None and chunk.size != size:
            following = self.read(chunk.end, HEAD.size)
            next_opcode, next_size = (
                HEAD.unpack(following) if len(following) == HEAD.size else (0, 0)
            )
            is_followed = (
                0 < next_opcode <= Opcode.DATA_END
                and next_size <= self.size - chunk.end - HEAD.size
            )
            if opcode != Opcode.CHUNK or not (is_followed or chunk.end == self.size):
                chunk = None
        return chunk or Record(opcode, at, size)

    def is_like_chunk(self, at: int) -> bool:
        """True where the head of a chunk is at an offset, whatever its lengths."""
        start = self.read(at, _CHUNK_HEAD)
        chunk = _chunk(start, at)
        return (
            chunk is not None
            and start[0] == Opcode.CHUNK
            and chunk.compression in ("", "lz4", "zstd")
        )


def _chunk(start: bytes, at: int) -> ChunkRecord | None:
    """Chunk with these bytes as its head, by the lengths in the head."""
    if len(start) < HEAD.size + _CHUNK_FIXED:
        return None
    start_ns, end_ns, uncompressed, crc, letters = _TIMES_SIZE_CRC.unpack_from(
        start, HEAD.size
    )
    name_at = HEAD.size + _TIMES_SIZE_CRC.size
    if letters > _LONGEST_COMPRESSION or name_at + letters + 8 > len(start):
        return None
    compression = start[name_at : name_at + letters].decode("latin-1")
    (data_size,) = struct.unpack_from("<Q", start, name_at + letters)
    data_at = at + name_at + letters + 8
    size = _CHUNK_FIXED + letters + data_size
    return ChunkRecord(
        Opcode.CHUNK,
        at,
        size,
        start_ns,
        end_ns,
        uncompressed,
        crc,
        compression,
        data_at,
        data_size,
    )


class RecordWalk:
    """Walk through the data section of a file, up to ``data_end_at`` where a summary that can be trusted states it."""

    def __init__(self, file: LogFile, data_end_at: int | None) -> None:
        self._file = file
        self._at = len(MAGIC)
        self._stop_at = file.size if data_end_at is None else data_end_at
        self._has_chunks = False
        self._is_loose = False
        self.reached_end = data_end_at is not None
        """True when the end of the data section is known or was found."""

    def __iter__(self) -> Iterator[Record | ByteRange | Hole]:
        while self._at < self._stop_at:
            record = self._file.record(self._at)
            if (
                record is not None
                and record.opcode == Opcode.DATA_END
                and record.size == 4
                and not self.reached_end
            ):
                self.reached_end = True
                return
            if (
                record is None
                or record.end > self._stop_at
                or not self._is_likely(record)
            ):
                yield self.search(self._at)
            elif record.opcode not in LOOSE:
                self._has_chunks |= isinstance(record, ChunkRecord)
                self._at = record.end
                yield record
            else:
                # only the record after it confirms the length of a record outside chunks
                following = (
                    self._file.record(record.end)
                    if record.end < self._stop_at
                    else None
                )
                if following is not None and not self._is_likely(following):
                    yield self.search(self._at)
                    continue
                self._is_loose = True
                stretch = ByteRange(
                    self._at, max(record.end, self._confirmed_end(self._at))
                )
                self._at = stretch.end
                yield stretch

    def search(self, at: int) -> Hole:
        """Give up the record at an offset and go on with the next trustworthy one after it.

        That is a chunk or metadata, or in a file without chunks three records in a row. In a file with chunks, bytes
        that look like a message are not trusted: they may lie within a damaged chunk.
        """
        self._has_chunks |= self._file.is_like_chunk(at)
        found = None
        if not self._is_loose or self._has_chunks:
            found = self._next_of(at + 1, (Opcode.CHUNK, Opcode.METADATA))
        if found is None and not self._has_chunks:
            found = self._next_of(at + 1, (Opcode.METADATA, *LOOSE))
        self._at = self._stop_at if found is None else found
        return Hole(at, self._at)

    def jump(self, at: int) -> None:
        """Go on at an offset where a record begins according to a trusted index."""
        self._at = at

    def _is_likely(self, record: Record) -> bool:
        """True where the data section can have a record of this kind and length."""
        if record.opcode in (Opcode.CHUNK, Opcode.HEADER):
            return isinstance(record, ChunkRecord) or record.at == len(MAGIC)
        if record.opcode == Opcode.MESSAGE_INDEX:
            count = self._file.read(record.content_at + 2, 4)
            return (
                len(count) == 4 and int.from_bytes(count, "little") == record.size - 6
            )
        if record.opcode == Opcode.DATA_END:
            return record.size == 4
        if record.opcode in _SMALLEST:
            return record.size >= _SMALLEST[record.opcode]
        return record.opcode >= PRIVATE

    def _confirmed_end(self, at: int) -> int:
        """End of the records outside chunks that lie in the next block and are followed by another of them."""
        block = self._file.read(at, min(_STRETCH, self._stop_at - at))
        place = last = 0
        while place + HEAD.size <= len(block):
            opcode, size = HEAD.unpack_from(block, place)
            if (
                opcode not in LOOSE
                or size < _SMALLEST[opcode]
                or place + HEAD.size + size > len(block)
            ):
                break
            last, place = place, place + HEAD.size + size
        return at + (place if at + place == self._stop_at else last)

    def _next_of(self, start: int, kinds: Sequence[Opcode]) -> int | None:
        """Offset of the next trustworthy record of some kinds."""
        wanted = np.zeros(256, bool)
        wanted[[int(kind) for kind in kinds]] = True
        for block_at in range(start, self._stop_at, _BLOCK):
            block = self._file.read(block_at, _BLOCK + HEAD.size)
            if len(block) < HEAD.size:
                continue
            octets = np.frombuffer(block, np.uint8)
            places = np.flatnonzero(wanted[octets[: len(octets) - HEAD.size + 1]])
            lengths = np.ndarray((len(octets) - 7,), "<u8", block, strides=(1,))[
                places + 1
            ]
            for offset in places[lengths <= self._stop_at].tolist():
                if offset < _BLOCK and self._is_trustworthy(block_at + offset):
                    return block_at + offset
        return None

    def _is_trustworthy(self, at: int) -> bool:
        """True for a chunk whose two lengths agree, and for the first of three likely records in a row."""
        record = self._file.record(at)
        if isinstance(record, ChunkRecord):
            return record.size == HEAD.unpack(self._file.read(at, HEAD.size))[1]
        for _ in range(_CHAIN):
            if (
                record is None
                or record.end > self._stop_at
                or not self._is_likely(record)
            ):
                return False
            if record.end == self._stop_at:
                return True
            record = self._file.record(record.end)
        return True


_SEAL = "crc32"


def seal(metadata: Mapping[str, str]) -> dict[str, str]:
    """Metadata with a CRC-32 over its keys and values, under the key ``crc32``."""
    return {**metadata, _SEAL: _checksum(metadata)}


def open_seal(metadata: Mapping[str, str]) -> tuple[dict[str, str], bool]:
    """Metadata without the checksum, and True where it had one; a LogError where the checksum does not fit."""
    content = {key: value for key, value in metadata.items() if key != _SEAL}
    if _SEAL not in metadata:
        return content, False
    if metadata[_SEAL] != _checksum(content):
        raise LogError("its CRC does not fit its content")
    return content, True


def _checksum(metadata: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(metadata.items())).encode()):08x}"
