"""Chunks of an MCAP file: records decompressed and checked against the CRC, and the messages among them.

The messages are found by the chunk's message index where it agrees with every record, or else by a walk through the
records.
"""

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
from sonar_graph.logs.mcap.records import (
    HEAD,
    LARGEST_BYTES,
    LARGEST_RATIO,
    LOOSE,
    SMALLER_CHUNKS,
    ChunkRecord,
)
from sonar_graph.measurements import Ints

_PIECE = 1 << 10
_ZSTD, _LZ4 = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"
_MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log", "<u8"),
        ("publish", "<u8"),
    ]
)
_MESSAGE_FIELDS = _MESSAGE.itemsize - HEAD.size
Index = Mapping[int, NDArray[np.uint64]]
"""Log time and offset of each message in a chunk, shape (n, 2), by channel."""


class ChunkError(LogError):
    """A chunk that cannot be read whole."""


class Found(NamedTuple):
    """Places of the messages of one channel in some bytes, in their order."""

    offsets: Ints
    """Offsets of the payloads, shape (n,)."""
    sizes: Ints
    """Bytes of each payload."""
    log_times_ns: Ints

    def of(self, rows: slice | Ints | NDArray[np.bool_]) -> Found:
        """Some of the messages."""
        return Found(self.offsets[rows], self.sizes[rows], self.log_times_ns[rows])


@dataclass
class Content:
    """Records in some uncompressed bytes."""

    data: bytes | memoryview
    channels: dict[int, Found]
    """Messages by channel."""
    described: list[tuple[int, bytes]]
    """Opcode and content of schemas and channels, in their order."""
    end: int
    """End of the last whole record."""

    def __len__(self) -> int:
        return sum(len(found.sizes) for found in self.channels.values())

    def times_ns(self) -> tuple[int, int]:
        """Earliest and latest log time; there must be a message."""
        times_ns = [found.log_times_ns for found in self.channels.values()]
        return min(int(t.min()) for t in times_ns), max(int(t.max()) for t in times_ns)

    def trusted(self) -> Content:
        """Content without its last message where no record follows it: that message may reach into damaged bytes."""
        rest = self.data[self.end : self.end + 1]
        if not len(rest) or rest[0] in LOOSE or not self.channels:
            return self
        last = max(
            self.channels, key=lambda channel: int(self.channels[channel].offsets[-1])
        )
        channels = {**self.channels, last: self.channels[last].of(slice(0, -1))}
        return Content(
            self.data,
            {c: f for c, f in channels.items() if len(f.sizes)},
            self.described,
            self.end,
        )


_DECOMPRESSOR = zstandard.ZstdDecompressor()


def unpack(chunk: ChunkRecord, packed: bytes) -> bytes:
    """Records of a chunk; a ChunkError where they cannot be decompressed, or the CRC does not fit."""
    data = packed
    try:
        if chunk.compression == "zstd" or (
            chunk.compression not in ("", "lz4") and packed.startswith(_ZSTD)
        ):
            size = zstandard.get_frame_parameters(packed).content_size
            unknown = size in (
                zstandard.CONTENTSIZE_UNKNOWN,
                zstandard.CONTENTSIZE_ERROR,
            )
            data = _DECOMPRESSOR.decompress(
                packed,
                max_output_size=_limited(chunk.uncompressed_size if unknown else size),
            )
        elif chunk.compression == "lz4" or (
            chunk.compression and packed.startswith(_LZ4)
        ):
            size = _limited(chunk.uncompressed_size)
            data = lz4.frame.LZ4FrameDecompressor().decompress(
                packed, max_length=size + 1
            )
        elif chunk.compression:
            raise ChunkError(f"its compression {chunk.compression!r} is not known")
    except (zstandard.ZstdError, RuntimeError, MemoryError, ValueError) as error:
        raise ChunkError(f"it cannot be decompressed: {error}") from error
    if chunk.crc and zlib.crc32(data) != chunk.crc:
        raise ChunkError("its CRC does not fit its content")
    if not chunk.crc and len(data) != chunk.uncompressed_size:
        raise ChunkError(
            f"it has {len(data)} bytes instead of {chunk.uncompressed_size}"
        )
    return data


def is_packed(data: bytes | memoryview, offset: int) -> bool:
    """Tell whether a payload is compressed by itself, as ``ros2 bag record --compression-mode message`` does."""
    return bytes(data[offset : offset + len(_ZSTD)]) == _ZSTD


def unpack_messages(
    data: bytes | memoryview, offsets: Ints, sizes: Ints
) -> tuple[bytes, Ints, Ints]:
    """Payloads that are compressed one by one, one after another, with their offsets and sizes, shape (n,).

    One that cannot be decompressed stays as it is, and is then no message of its type.
    """
    payloads = []
    for offset, length in zip(offsets.tolist(), sizes.tolist(), strict=True):
        packed = bytes(data[offset : offset + length])
        try:
            size = zstandard.get_frame_parameters(packed).content_size
            is_known = size not in (
                zstandard.CONTENTSIZE_UNKNOWN,
                zstandard.CONTENTSIZE_ERROR,
            )
            most = _limited(size) if is_known else len(packed) * LARGEST_RATIO
            payloads.append(_DECOMPRESSOR.decompress(packed, max_output_size=most))
        except (zstandard.ZstdError, ChunkError, MemoryError):
            payloads.append(packed)
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    return b"".join(payloads), np.cumsum(lengths) - lengths, lengths


def _limited(size: int) -> int:
    """Bytes of a chunk as its head states them; a ChunkError where they are more than fit into memory."""
    if size > LARGEST_BYTES:
        raise ChunkError(
            f"it claims to have {size} bytes, and at most {LARGEST_BYTES} are read at once; {SMALLER_CHUNKS}"
        )
    return size


def unpack_beginning(chunk: ChunkRecord, packed: bytes) -> bytes:
    """Records at the beginning of a chunk that is cut off; no CRC covers them."""
    if not chunk.compression:
        return packed
    reader: Any = (
        lz4.frame.LZ4FrameDecompressor()
        if chunk.compression == "lz4"
        else zstandard.ZstdDecompressor().decompressobj()
    )
    found = bytearray()
    try:
        for at in range(0, len(packed), _PIECE):
            found += reader.decompress(packed[at : at + _PIECE])
            if len(found) > min(chunk.uncompressed_size, LARGEST_BYTES):
                break
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError):
        pass  # what came before is whole
    return bytes(found[: chunk.uncompressed_size])


def find_by_index(data: bytes | memoryview, index: Index) -> Content | None:
    """Messages of a chunk by its index; None where index and chunk disagree in anything.

    Every record that the index names must be a message of that channel and time, and only schemas and channels may lie
    between them. So an index that leaves out a message, or points into one, is detected.
    """
    counts = [len(rows) for rows in index.values()]
    rows = np.concatenate([*index.values(), np.empty((0, 2), np.uint64)])
    starts, times_ns = rows[:, 1].astype(np.int64), rows[:, 0]
    if len(starts) and (
        starts.min() < 0 or starts.max() > len(data) - _MESSAGE.itemsize
    ):
        return None
    heads = _heads(data)[starts]
    lengths = heads["length"].astype(np.int64)
    channels = np.repeat(np.array(list(index), np.uint16), counts)
    agree = (
        (heads["opcode"] == Opcode.MESSAGE)
        & (heads["channel"] == channels)
        & (heads["log"] == times_ns)
    )
    if not (agree & (lengths >= _MESSAGE_FIELDS) & (lengths <= len(data))).all():
        return None
    order = np.argsort(starts, kind="stable")
    ends = np.concatenate([[0], (starts + HEAD.size + lengths)[order]])
    following = np.concatenate([starts[order], [len(data)]])
    if (following < ends).any():  # messages overlap
        return None
    described = []
    for gap in np.flatnonzero(following > ends).tolist():
        at = last = int(ends[gap])
        for opcode, start, stop in _records(data[at : int(following[gap])]):
            if opcode == Opcode.MESSAGE:
                return None
            described.append((opcode, bytes(data[at + start : at + stop])))
            last = at + stop
        if last != following[gap]:
            return None
    every = Found(
        starts + _MESSAGE.itemsize, lengths - _MESSAGE_FIELDS, times_ns.astype(np.int64)
    )
    found: dict[int, Found] = {}
    for channel, count, end in zip(
        index, counts, np.cumsum(counts).tolist(), strict=True
    ):
        part = every.of(slice(end - count, end))
        is_sorted = (part.offsets[1:] > part.offsets[:-1]).all()
        found[channel] = part if is_sorted else part.of(np.argsort(part.offsets))
    return Content(data, found, described, len(data))


def _heads(data: bytes | memoryview) -> NDArray[Any]:
    """View of the bytes as the head of a message at every offset."""
    return np.ndarray(
        (max(len(data) - _MESSAGE.itemsize + 1, 0),), _MESSAGE, data, strides=(1,)
    )


def find_by_walk(data: bytes | memoryview) -> Content:
    """Messages in some bytes, record by record until the first that is not whole."""
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
    sizes, times_ns = (
        heads["length"].astype(np.int64) - _MESSAGE_FIELDS,
        heads["log"].astype(np.int64),
    )
    every = Found(starts + _MESSAGE.itemsize, sizes, times_ns)
    found = {
        channel: every.of(heads["channel"] == channel)
        for channel in np.unique(heads["channel"]).tolist()
    }
    return Content(data, found, described, end)


def _records(data: bytes | memoryview) -> Iterator[tuple[int, int, int]]:
    """Opcode, begin and end of the content of each whole record."""
    at, end = 0, len(data)
    while at + HEAD.size <= end:
        opcode, length = HEAD.unpack_from(data, at)
        start = at + HEAD.size
        if opcode == 0 or length > end - start:
            return
        at = start + length
        yield opcode, start, at
