"""An MCAP file open for reading (https://mcap.dev/spec): its bytes, its summary, and records parsed by the mcap package.

The summary repeats schemas and channels, places the chunks and counts the messages. It is used only where its own CRC
fits. MCAP has no CRC over a metadata record; `seal` adds one to the record's entries.
"""

import json
import struct
import zlib
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, Self, TypeVar

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.stream_reader import StreamReader
from mcap.summary import Summary

from sonar_graph.errors import LogError
from sonar_graph.files import regular
from sonar_graph.logs.mcap.foreign_files import MCAP_MAGIC, START_BYTES, kind_and_advice

HEAD = struct.Struct("<BQ")
"""Opcode of a record, and number of bytes of its content."""
LARGEST_BYTES = 1 << 28
"""Most bytes of one record, and of a chunk without compression; a stated size could claim all memory."""
LARGEST_RATIO = 64
"""Bytes of messages for each byte of a log; samples of an IMU at rest, each with its stamp, compress by some thirty."""
SMALLER_CHUNKS = (
    "`mcap compress LOG -o OUT.mcap --chunk-size 4194304` writes smaller chunks"
)
_END_BYTES = HEAD.size + 20 + len(MCAP_MAGIC)
_CRC_AND_MAGIC_BYTES = 4 + len(MCAP_MAGIC)
_LARGEST_MOVED = 1 << 26
DATA_END_BYTES = HEAD.size + 4
_SEAL = "crc32"
T = TypeVar("T", bound=Any)


def read_record(kind: Callable[[ReadDataStream], T], content: bytes) -> T:
    """Record as the mcap package parses its content, which may be cut off; a LogError where it cannot be parsed."""
    try:
        return kind(ReadDataStream(BytesIO(content)))
    except Exception as error:  # the package raises whatever its parts raise
        raise LogError(
            f"it cannot be read ({error or type(error).__name__})"
        ) from error


def parse(kind: Callable[[ReadDataStream], T], content: bytes) -> T:
    """Record as the mcap package parses its content; a LogError where that is not exactly one such record."""
    record = read_record(kind, content)
    builder = RecordBuilder()
    record.write(builder)
    # the package accepts content that is too short or too long: only what it writes again unchanged is whole
    if builder.end()[HEAD.size :] != content:  # type: ignore[no-untyped-call]  # of the mcap package
        raise LogError(f"its {len(content)} bytes do not make sense")
    return record


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
        if not start.startswith(MCAP_MAGIC):
            self._stream.close()
            raise LogError(
                f"{path} is not an MCAP file but {kind_and_advice(path, start)}"
            )
        self.summary: Summary | None = None
        """Summary under a CRC that fits; None where the file has no such summary."""
        self.described: list[Schema | Channel] = []
        """Schemas and channels under that CRC, also where the rest of the summary does not fit the file."""
        self.data_end_at = self.size
        """End of the data by the summary; without a summary that of the file."""
        try:
            self.fault = self._read_summary()
            """Damage of the end of the file; None without one."""
        except Exception as error:  # the package raises whatever its parts raise
            self.fault = f"its summary is damaged: {error or type(error).__name__}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def read(self, at: int, count: int) -> bytes:
        """Bytes from an offset on; fewer at the end of the file.

        A LogError where they are more than `LARGEST_BYTES`.
        """
        if at >= self.size:  # a damaged length may point anywhere
            return b""
        count = min(count, self.size - at)
        # a damaged length could claim all memory
        if count > LARGEST_BYTES:
            raise LogError(
                f"{self.path}: bytes {at} to {at + count} are one record, and at most {LARGEST_BYTES} are read at "
                f"once; {SMALLER_CHUNKS}"
            )
        self._stream.seek(at)
        return self._stream.read(count)

    def _read_summary(self) -> str | None:
        ending = self.read(max(self.size - _END_BYTES, 0), _END_BYTES)
        try:
            # the package also compares the magic bytes after the footer
            footer: Any
            (footer,) = StreamReader(BytesIO(ending), skip_magic=True).records
        except Exception:  # the package raises whatever its parts raise
            return "it does not end as an MCAP file"
        # without a CRC a damaged summary could hide chunks
        if not footer.summary_start or not footer.summary_crc:
            return None
        content = self.read(footer.summary_start, self.size)
        if _fits(content, footer.summary_crc):
            self.described = _described(content)
            self._stream.seek(0)
            self.summary = make_reader(self._stream).get_summary()
            self.data_end_at = footer.summary_start - DATA_END_BYTES
            return None
        # bytes that are missing or doubled before it have moved the summary: the end of the data is before it
        content = self.read(max(self.size - _LARGEST_MOVED, 0), _LARGEST_MOVED)
        content = content.rpartition(HEAD.pack(Opcode.DATA_END, 4))[2][4:]
        if not _fits(content, footer.summary_crc):
            return "its summary is damaged: the CRC does not fit"
        self.described = _described(content)
        return "bytes are missing or doubled in it, so that its index does not fit"


def _fits(summary: bytes, crc: int) -> bool:
    return zlib.crc32(summary[:-_CRC_AND_MAGIC_BYTES]) == crc


def _described(summary: bytes) -> list[Schema | Channel]:
    records = StreamReader(BytesIO(summary), skip_magic=True).records
    return [one for one in records if isinstance(one, Schema | Channel)]


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
