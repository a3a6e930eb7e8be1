"""Chunks of an MCAP file: records decompressed and checked against the CRC, and the places of the messages among them.

The places are columns, because `sonar_graph.logs.cdr` decodes the payloads of many messages at once.
"""

from __future__ import annotations

import zlib
from typing import NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk
from numpy.typing import NDArray

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.log_file import (
    HEAD,
    LARGEST_BYTES,
    LARGEST_RATIO,
    SMALLER_CHUNKS,
)
from sonar_graph.logs.mcap.record_walk import LOOSE, record_starts
from sonar_graph.measurements import Ints

_ZSTD = b"\x28\xb5\x2f\xfd"
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


class Found(NamedTuple):
    """Places of the messages of one channel in some bytes, in their order."""

    offsets: Ints
    """Offsets of the payloads, shape (n,)."""
    sizes: Ints
    """Bytes of each payload."""
    log_times_ns: Ints

    def of(self, rows: Ints | NDArray[np.bool_]) -> Found:
        """Some of the messages."""
        return Found(self.offsets[rows], self.sizes[rows], self.log_times_ns[rows])


class Content(NamedTuple):
    """Records in some uncompressed bytes."""

    data: bytes | memoryview
    channels: dict[int, Found]
    """Messages by channel."""
    described: list[tuple[int, bytes]]
    """Opcode and content of schemas and channels, in their order."""
    span_ns: tuple[int, int] | None
    """Earliest and latest log time; None without messages."""
    end: int
    """End of the last whole record."""
    is_covered: bool
    """True when a CRC fits these bytes."""


def unpack(chunk: Chunk) -> bytes:
    """Bytes of a chunk as far as they can be decompressed, and at most one more than the chunk states.

    The mcap package's own ``get_chunk_data_stream`` has no limit, so that a chunk of zeros could fill all memory, and gives
    nothing of a chunk that is cut off.
    """
    most = chunk.uncompressed_size
    if most > LARGEST_BYTES:
        raise LogError(
            f"it claims to have {most} bytes, and at most {LARGEST_BYTES} are read at once; {SMALLER_CHUNKS}"
        )
    try:
        if chunk.compression == "zstd":
            reader = zstandard.ZstdDecompressor().stream_reader(chunk.data)
            return reader.read(most + 1)
        if chunk.compression == "lz4":
            unpacker = lz4.frame.LZ4FrameDecompressor()
            return bytes(unpacker.decompress(chunk.data, max_length=most + 1))
    except (zstandard.ZstdError, RuntimeError) as error:
        raise LogError(f"it cannot be decompressed: {error}") from error
    if chunk.compression:
        raise LogError(f"its compression {chunk.compression!r} is not known")
    return chunk.data


def unpack_whole(chunk: Chunk) -> bytes:
    """Bytes of a whole chunk; a LogError where they do not fit its CRC, or without a CRC its size."""
    data = unpack(chunk)
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise LogError("its CRC does not fit its content")
    if len(data) != chunk.uncompressed_size and not chunk.uncompressed_crc:
        raise LogError(f"it has {len(data)} bytes instead of {chunk.uncompressed_size}")
    return data


def unpack_beginning(chunk: Chunk) -> bytes:
    """Whole records at the beginning of a chunk that is cut off; no CRC covers them."""
    data = unpack(chunk)
    starts = record_starts(data)
    following = data[starts[-1] :][:1]
    # zeros of the file system after a cut: a message that no record follows may reach into them
    if following.strip(bytes(LOOSE)) and len(starts) > 1:
        starts.pop()
    return data[: starts[-1]]


def find_messages(data: bytes | memoryview, *, is_covered: bool = False) -> Content:
    """Places of the whole messages in some bytes, up to the first record that is not whole."""
    bounds = np.array(record_starts(data), np.int64)  # (n + 1,)
    opcodes = np.frombuffer(data, np.uint8)[bounds[:-1]]  # (n,)
    is_message = opcodes == Opcode.MESSAGE
    # a message that is shorter than its own fields is invalid, and what follows it is not to be trusted
    is_short = is_message & (np.diff(bounds) < _MESSAGE.itemsize)
    if is_short.any():
        whole = int(np.argmax(is_short))
        bounds = bounds[: whole + 1]
        is_message = is_message[:whole]
    described = [
        (int(opcodes[row]), bytes(data[bounds[row] + HEAD.size : bounds[row + 1]]))
        for row in np.flatnonzero(~is_message)
    ]
    starts = bounds[:-1][is_message]  # (m,)
    offsets = starts + _MESSAGE.itemsize
    sizes = bounds[1:][is_message] - offsets
    # the bytes as the head of a message at every offset
    count = max(len(data) - _MESSAGE.itemsize + 1, 0)
    heads = np.ndarray((count,), _MESSAGE, data, strides=(1,))
    channels = heads["channel"][starts]
    times_ns = heads["log"][starts].astype(np.int64)
    every = Found(offsets, sizes, times_ns)
    found = {
        channel: every.of(np.flatnonzero(channels == channel))
        for channel in np.flatnonzero(np.bincount(channels)).tolist()
    }
    span_ns = (int(times_ns.min()), int(times_ns.max())) if len(times_ns) else None
    return Content(data, found, described, span_ns, int(bounds[-1]), is_covered)


def unpack_messages(
    data: bytes | memoryview, offsets: Ints, sizes: Ints
) -> tuple[bytes | memoryview, Ints, Ints]:
    """Payloads, one after another, with their offsets and sizes, shape (n,), where they are compressed one by one.

    ``ros2 bag record --compression-mode message`` does so; other payloads are given as they are. One that cannot be
    decompressed stays as it is, and is then no message of its type.
    """
    if bytes(data[offsets[0] : offsets[0] + len(_ZSTD)]) != _ZSTD:
        return data, offsets, sizes
    payloads = [
        _unpack_message(bytes(data[offset : offset + length]))
        for offset, length in zip(offsets.tolist(), sizes.tolist(), strict=True)
    ]
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    return b"".join(payloads), np.cumsum(lengths) - lengths, lengths


def _unpack_message(packed: bytes) -> bytes:
    try:
        # the limit below counts only where the frame does not state its size
        if zstandard.frame_content_size(packed) > LARGEST_BYTES:
            return packed
        return zstandard.decompress(packed, len(packed) * LARGEST_RATIO)
    except zstandard.ZstdError:
        return packed
