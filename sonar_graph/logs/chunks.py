"""What a chunk holds: its bytes, unpacked and checked, and the messages in them."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from sonar_graph.errors import LogError
from sonar_graph.logs.records import HEAD, LOOSE, ChunkRecord
from sonar_graph.measurements import Ints

LARGEST_BYTES = 1 << 32
"""A chunk is not unpacked beyond this; a damaged size would ask for all memory."""
_PIECE = 1 << 13
_ZSTD, _LZ4 = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"
_MESSAGE = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
_MESSAGE_FIELDS = _MESSAGE.itemsize - HEAD.size

Index = Mapping[int, NDArray[np.uint64]]
"""Log time and offset of each message in a chunk, shape (n, 2), by channel."""


class ChunkError(LogError):
    """A chunk is not whole."""


@dataclass
class Content:
    """The records in a stretch of uncompressed bytes, in their order."""

    data: bytes | memoryview
    channels: Ints
    """Of each message, shape (n,)."""
    offsets: Ints
    """Of the payloads in the data."""
    sizes: Ints
    """Of the payloads."""
    log_times_ns: Ints
    described: list[tuple[int, bytes]] = field(default_factory=list)
    """Opcode and content of the schemas and channels among them."""
    end: int = 0
    """Where the last whole record ends."""

    def trusted(self) -> Content:
        """Without the last message, where what follows it is no record: it may reach into what is damaged."""
        rest = self.data[self.end :]
        if not len(rest) or rest[0] in LOOSE or not len(self.channels):
            return self
        channels, offsets, sizes, times_ns = (
            column[:-1] for column in (self.channels, self.offsets, self.sizes, self.log_times_ns)
        )
        return Content(self.data, channels, offsets, sizes, times_ns, self.described, self.end)


def unpack(chunk: ChunkRecord, packed: bytes) -> bytes:
    """The records of a chunk, checked against its CRC.

    Raises
    ------
    ChunkError
        When they cannot be had, or are not what was written.
    """
    try:
        data = _decompress(chunk, packed)
    except (zstandard.ZstdError, RuntimeError, MemoryError, ValueError) as error:
        raise ChunkError(f"it cannot be decompressed: {error}") from error
    if chunk.crc and zlib.crc32(data) != chunk.crc:
        raise ChunkError("its CRC does not fit its content")
    if not chunk.crc and len(data) != chunk.uncompressed_size:
        raise ChunkError(f"it has {len(data)} bytes instead of {chunk.uncompressed_size}")
    return data


_DECOMPRESSOR = zstandard.ZstdDecompressor()


def _decompress(chunk: ChunkRecord, packed: bytes) -> bytes:
    if chunk.compression == "zstd" or (chunk.compression not in ("", "lz4") and packed.startswith(_ZSTD)):
        size = zstandard.get_frame_parameters(packed).content_size
        unknown = size in (zstandard.CONTENTSIZE_UNKNOWN, zstandard.CONTENTSIZE_ERROR)
        size = chunk.uncompressed_size if unknown else size
        if size > LARGEST_BYTES:
            raise ChunkError(f"it claims to have {size} bytes")
        return _DECOMPRESSOR.decompress(packed, max_output_size=size)
    if chunk.compression == "lz4" or (chunk.compression and packed.startswith(_LZ4)):
        data: bytes = lz4.frame.decompress(packed)
        return data
    if chunk.compression:
        raise ChunkError(f"its compression {chunk.compression!r} is not known")
    return packed


def unpack_beginning(chunk: ChunkRecord, packed: bytes) -> bytes:
    """As much as can be had of a chunk of which only the beginning is there; no CRC covers it."""
    if not chunk.compression:
        return packed
    reader: Any = (
        lz4.frame.LZ4FrameDecompressor() if chunk.compression == "lz4" else zstandard.ZstdDecompressor().decompressobj()
    )
    found = bytearray()
    try:
        for at in range(0, len(packed), _PIECE):
            found += reader.decompress(packed[at : at + _PIECE])
            if len(found) > LARGEST_BYTES:
                break
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError):
        pass  # what came before is whole
    return bytes(found[: chunk.uncompressed_size])


def find_by_index(data: bytes | memoryview, index: Index) -> Content | None:
    """The messages of a chunk as its index says; None where index and chunk disagree in anything.

    Every record that the index names must be a message of that channel and time, and between them may lie only
    schemas and channels: an index that leaves out a message, or points into one, is found out.
    """
    channels = np.repeat(np.array(list(index), np.int64), [len(rows) for rows in index.values()])
    rows = np.concatenate([*index.values(), np.empty((0, 2), np.uint64)])
    order = np.argsort(rows[:, 1], kind="stable")
    starts, times_ns, channels = rows[order, 1].astype(np.int64), rows[order, 0], channels[order]
    if len(starts) and (starts[0] < 0 or starts[-1] > len(data) - _MESSAGE.itemsize):
        return None
    heads = np.ndarray((max(len(data) - _MESSAGE.itemsize + 1, 0),), _MESSAGE, data, strides=(1,))[starts]
    lengths = heads["length"].astype(np.int64)
    agree = (heads["opcode"] == Opcode.MESSAGE) & (heads["channel"] == channels) & (heads["log"] == times_ns)
    if not (agree & (lengths >= _MESSAGE_FIELDS) & (lengths <= len(data))).all():
        return None
    ends = starts + HEAD.size + lengths
    described = _between(data, np.concatenate([[0], ends]), np.concatenate([starts, [len(data)]]))
    if described is None:
        return None
    payloads = starts + _MESSAGE.itemsize
    return Content(data, channels, payloads, lengths - _MESSAGE_FIELDS, times_ns.astype(np.int64), described, len(data))


def _between(data: bytes | memoryview, ends: Ints, starts: Ints) -> list[tuple[int, bytes]] | None:
    """The schemas and channels between messages; None where there is anything else."""
    if (starts < ends).any():
        return None
    described = []
    for gap in np.flatnonzero(starts > ends).tolist():
        at = int(ends[gap])
        for opcode, start, stop in _records(data[at : int(starts[gap])]):
            if opcode == Opcode.MESSAGE:
                return None
            described.append((opcode, bytes(data[at + start : at + stop])))
            last = at + stop
        if not described or last != starts[gap]:
            return None
    return described


def find_by_walk(data: bytes | memoryview) -> Content:
    """The messages of a stretch, record by record until the first that is not whole."""
    messages, described, end = [], [], 0
    for opcode, start, stop in _records(data):
        if opcode == Opcode.MESSAGE:
            if stop - start < _MESSAGE_FIELDS:
                break
            messages.append(start - HEAD.size)
        else:
            described.append((opcode, bytes(data[start:stop])))
        end = stop
    starts = np.array(messages, np.int64)
    heads = np.ndarray((max(len(data) - _MESSAGE.itemsize + 1, 0),), _MESSAGE, data, strides=(1,))[starts]
    sizes = heads["length"].astype(np.int64) - _MESSAGE_FIELDS
    channels, times_ns = heads["channel"].astype(np.int64), heads["log"].astype(np.int64)
    return Content(data, channels, starts + _MESSAGE.itemsize, sizes, times_ns, described, end)


def _records(data: bytes | memoryview) -> Iterator[tuple[int, int, int]]:
    """Opcode, and where the content begins and ends, of each whole record."""
    at, end = 0, len(data)
    while at + HEAD.size <= end:
        opcode, length = HEAD.unpack_from(data, at)
        start = at + HEAD.size
        if opcode == 0 or length > end - start:
            return
        at = start + length
        yield opcode, start, at
