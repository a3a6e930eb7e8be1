"""What a chunk holds: its bytes, unpacked and checked, and the messages in them."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.records import HEAD, LOOSE, ChunkRecord
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


class Found(NamedTuple):
    """Messages of one channel in a stretch of bytes, in their order."""

    offsets: Ints
    """Of the payloads, shape (n,)."""
    sizes: Ints
    """Of the payloads."""
    log_times_ns: Ints

    def of(self, rows: slice | Ints | NDArray[np.bool_]) -> Found:
        """Some of them."""
        return Found(self.offsets[rows], self.sizes[rows], self.log_times_ns[rows])


@dataclass
class Content:
    """The records in a stretch of uncompressed bytes."""

    data: bytes | memoryview
    channels: dict[int, Found]
    """Its messages."""
    described: list[tuple[int, bytes]]
    """Opcode and content of its schemas and channels, in their order."""
    end: int
    """Where the last whole record ends."""

    def __len__(self) -> int:
        return sum(len(found.sizes) for found in self.channels.values())

    def times_ns(self) -> tuple[int, int]:
        """The earliest and the latest log time; there must be a message."""
        times_ns = [found.log_times_ns for found in self.channels.values()]
        return min(int(t.min()) for t in times_ns), max(int(t.max()) for t in times_ns)

    def trusted(self) -> Content:
        """Without the last message, where what follows it is no record: it may reach into what is damaged."""
        rest = self.data[self.end : self.end + 1]
        if not len(rest) or rest[0] in LOOSE or not self.channels:
            return self
        last = max(self.channels, key=lambda channel: int(self.channels[channel].offsets[-1]))
        rest_of_last = self.channels[last].of(slice(0, -1))
        channels = {**self.channels, last: rest_of_last}
        return Content(self.data, {c: f for c, f in channels.items() if len(f.sizes)}, self.described, self.end)


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
    counts = [len(rows) for rows in index.values()]
    rows = np.concatenate([*index.values(), np.empty((0, 2), np.uint64)])
    starts, times_ns = rows[:, 1].astype(np.int64), rows[:, 0]
    if len(starts) and (starts.min() < 0 or starts.max() > len(data) - _MESSAGE.itemsize):
        return None
    heads = _heads(data)[starts]
    lengths = heads["length"].astype(np.int64)
    channels = np.repeat(np.array(list(index), np.uint16), counts)
    agree = (heads["opcode"] == Opcode.MESSAGE) & (heads["channel"] == channels) & (heads["log"] == times_ns)
    if not (agree & (lengths >= _MESSAGE_FIELDS) & (lengths <= len(data))).all():
        return None
    described = _between(data, starts, starts + HEAD.size + lengths)
    if described is None:
        return None
    every = Found(starts + _MESSAGE.itemsize, lengths - _MESSAGE_FIELDS, times_ns.astype(np.int64))
    ends = np.cumsum(counts).tolist()
    found = {
        channel: every.of(slice(end - count, end)) for channel, count, end in zip(index, counts, ends, strict=True)
    }
    return Content(data, {channel: _in_order(part) for channel, part in found.items()}, described, len(data))


def _heads(data: bytes | memoryview) -> NDArray[Any]:
    """What a message's head would be at each offset."""
    return np.ndarray((max(len(data) - _MESSAGE.itemsize + 1, 0),), _MESSAGE, data, strides=(1,))


def _in_order(found: Found) -> Found:
    is_sorted = (found.offsets[1:] > found.offsets[:-1]).all()
    return found if is_sorted else found.of(np.argsort(found.offsets))


def _between(data: bytes | memoryview, starts: Ints, ends: Ints) -> list[tuple[int, bytes]] | None:
    """The schemas and channels between messages; None where there is anything else, or messages overlap."""
    order = np.argsort(starts, kind="stable")
    before = np.concatenate([[0], ends[order]])
    after = np.concatenate([starts[order], [len(data)]])
    if (after < before).any():
        return None
    described = []
    for gap in np.flatnonzero(after > before).tolist():
        at = last = int(before[gap])
        for opcode, start, stop in _records(data[at : int(after[gap])]):
            if opcode == Opcode.MESSAGE:
                return None
            described.append((opcode, bytes(data[at + start : at + stop])))
            last = at + stop
        if last != after[gap]:
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
    heads = _heads(data)[starts]
    sizes, times_ns = heads["length"].astype(np.int64) - _MESSAGE_FIELDS, heads["log"].astype(np.int64)
    every = Found(starts + _MESSAGE.itemsize, sizes, times_ns)
    found = {channel: every.of(heads["channel"] == channel) for channel in np.unique(heads["channel"]).tolist()}
    return Content(data, found, described, end)


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
