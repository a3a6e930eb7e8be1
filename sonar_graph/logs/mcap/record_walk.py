"""Places of the records in the data of a file, in their order, also where some of the bytes are damaged.

The mcap package parses the records. It does not find them here, for two reasons: it cannot go on after a damaged record,
and it makes Python objects of all entries of the message indexes, one for each message, which are not needed.
"""

import re
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Metadata

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.foreign_files import MCAP_MAGIC
from sonar_graph.logs.mcap.log_file import (
    DATA_END_BYTES,
    HEAD,
    LARGEST_BYTES,
    LogFile,
    parse,
)

HOLE = 0
"""Opcode, which MCAP does not use, of bytes that are not records."""
PRIVATE = 0x80
"""Kinds of records from here on are private to a writer."""
LOOSE = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE)))
"""Kinds of the records within chunks; outside where the writer makes no chunks."""
_SMALLEST: dict[int, int] = {
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: 22,
    Opcode.HEADER: 8,
    Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6,
    Opcode.ATTACHMENT: 36,
    Opcode.METADATA: 8,
    Opcode.DATA_END: 4,
}
_STRETCH = 1 << 20
_BLOCK = 1 << 16
_LONGEST_PATTERN = 45
# a chunk: three high bytes of its length are zero, and the name of its compression follows its times, size and CRC
_CHUNK = rb"\x06(?=.{5}\0{3}.{28}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4}))"
# of at most 64 KiB: each that looks like one is parsed
_METADATA = rb"\x0c(?=.{2}\0{6})"
_LOOSE = rb"[\x03-\x05](?=.{4}\0{4})"
_AMONG_CHUNKS = re.compile(_CHUNK + b"|" + _METADATA, re.DOTALL)
_ANY = re.compile(_AMONG_CHUNKS.pattern + b"|" + _LOOSE, re.DOTALL)


class Record(NamedTuple):
    """Place of a record in the file, of a run of loose ones (opcode ``MESSAGE``), or of bytes that are no record."""

    opcode: int
    at: int
    """Offset of the first byte."""
    end: int
    """Offset after the last byte."""


def content_of(file: LogFile, record: Record) -> bytes:
    """Content of a record, after opcode and length."""
    start = record.at + HEAD.size
    return file.read(start, record.end - start)


def record_starts(data: bytes | memoryview) -> list[int]:
    """Offsets of the whole schemas, channels and messages that follow each other in some bytes, and the end of the last.

    This loop is the one step that is done for each message; the package would make an object of each.
    """
    starts = [0]
    at = 0
    last = len(data) - HEAD.size
    # looked up once: attributes cost as much as the step itself
    unpack = HEAD.unpack_from
    append = starts.append
    head_bytes = HEAD.size
    loose = LOOSE
    while at <= last:
        opcode, length = unpack(data, at)
        if opcode not in loose:
            break
        at += head_bytes + length
        append(at)
    if at > len(data):
        starts.pop()
    return starts


class RecordWalk:
    """Walk through the data of a file.

    A length counts only where a record begins after it, or where a summary under a CRC states it. Elsewhere the walk
    searches for the next such record, and gives the bytes between as a hole.
    """

    def __init__(self, file: LogFile) -> None:
        self._file = file
        self._stop_at = file.data_end_at
        indexes = file.summary.chunk_indexes if file.summary else []
        self.chunks = {index.chunk_start_offset: index for index in indexes}
        """Chunks by their offsets, as the summary places them."""
        self._has_chunks = bool(indexes)

    def __iter__(self) -> Iterator[Record]:
        at = len(MCAP_MAGIC)
        while at < self._stop_at:
            record = self._record(at)
            if record is not None and record.opcode in LOOSE:
                record = self._run(record)
            if record is None or not self._is_confirmed(record):
                record = Record(HOLE, at, self._next(at))
            self._has_chunks |= record.opcode == Opcode.CHUNK
            yield record
            if record.opcode == Opcode.DATA_END:
                return
            index = self.chunks.get(at)
            # the message indexes after a chunk are not used: what they state is in the chunk, under its CRC
            at = record.end + (index.message_index_length if index else 0)
        if self._file.summary:
            yield Record(Opcode.DATA_END, self._stop_at, self._stop_at + DATA_END_BYTES)

    def _record(self, at: int) -> Record | None:
        """Record at an offset by the summary, or else by its head; None where the data cannot have such a record."""
        # the summary is under a CRC, the head of a chunk is not
        index = self.chunks.get(at)
        if index is not None:
            return Record(Opcode.CHUNK, at, at + index.chunk_length)
        head = self._file.read(at, HEAD.size)
        if len(head) < HEAD.size:
            return None
        opcode, size = HEAD.unpack(head)
        end = at + HEAD.size + size
        is_known = opcode >= PRIVATE or size >= _SMALLEST.get(opcode, self._file.size)
        # the end of the file may cut a record off, but a length beyond any record is damaged
        is_likely = end <= self._stop_at or size <= LARGEST_BYTES
        return Record(opcode, at, end) if is_known and is_likely else None

    def _is_confirmed(self, record: Record) -> bool:
        return record.end <= self._stop_at and (
            record.at in self.chunks
            or record.opcode == Opcode.DATA_END
            or self._stop_at - record.end < HEAD.size
            or self._record(record.end) is not None
        )

    def _run(self, first: Record) -> Record | None:
        """Loose records from one on, each followed by another record."""
        count = max(_STRETCH, first.end - first.at)
        block = self._file.read(first.at, min(count, self._stop_at - first.at))
        # the last one may have a damaged length: then the run ends before it
        for size in record_starts(block)[:-3:-1]:
            run = Record(Opcode.MESSAGE, first.at, first.at + size)
            if size and self._is_confirmed(run):
                return run
        return None

    def _next(self, at: int) -> int:
        """Offset of the next record after a damaged one.

        In a file with chunks, bytes that look like a message are not trusted: they may lie within a damaged chunk.
        """
        self._has_chunks |= self._file.read(at, 1) == bytes([Opcode.CHUNK])
        # a loose record looks like one within a chunk
        pattern = _AMONG_CHUNKS if self._has_chunks else _ANY
        # small blocks: hostile files have many heads, and each search reads a block again
        for block_at in range(at + 1, self._stop_at, _BLOCK):
            block = self._file.read(block_at, _BLOCK + _LONGEST_PATTERN)
            for match in pattern.finditer(block):
                record = self._record(block_at + match.start())
                if record is not None and self._is_found(record):
                    return record.at
        return self._stop_at

    def _is_found(self, record: Record) -> bool:
        """True where a record is one, and not bytes within a damaged chunk that look like its head."""
        if record.opcode == Opcode.METADATA and record.end <= self._stop_at:
            with suppress(LogError):
                parse(Metadata.read, content_of(self._file, record))
                return True
            return False
        return self._is_confirmed(record)
