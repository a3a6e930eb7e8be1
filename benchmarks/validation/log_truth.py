"""Content of an undamaged log, by mcap's own reader."""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mcap.reader import NonSeekingReader
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

Payload = tuple[int, int]
"""Log time, and CRC of the payload."""
Named = tuple[str, Payload]


@dataclass
class Truth:
    """A log's messages, and where they lie."""

    name: str
    content: bytes
    messages: dict[str, Counter[Payload]] = field(default_factory=dict)
    types: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Type and definition of each topic."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    records: list[tuple[int, int, int]] = field(default_factory=list)
    """Opcode, start and end of each record outside of chunks."""
    chunks: dict[int, list[Named]] = field(default_factory=dict)
    """Messages of each chunk, by where it starts."""
    loose: dict[int, Named] = field(default_factory=dict)
    """Messages outside of chunks, by where they start."""
    has_summary: bool = False
    """With the channels repeated in it."""

    @property
    def count(self) -> int:
        return sum(messages.total() for messages in self.messages.values())

    @property
    def data_end(self) -> int:
        return next(
            (start for opcode, start, _ in self.records if opcode == 0x0F),
            len(self.content),
        )

    def _is_in(self, damaged: bytes, start: int, end: int) -> bool:
        return (
            damaged[start:end] == self.content[start:end]
            or self.content[start:end] in damaged
        )

    def _is_described(self, damaged: bytes) -> bool:
        """Check that the first chunk, or the summary, with all channels is there."""
        first = next(
            (record for record in self.records if record[1] in self.chunks), None
        )
        if first is not None and self._is_in(damaged, *first[1:]):
            return True
        return self.has_summary and damaged.endswith(self.content[self.data_end :])

    def sound_chunks(self, damaged: bytes) -> Iterator[list[Named]]:
        """Messages of each chunk whose bytes are all there."""
        if self.chunks and self._is_described(damaged):
            for _, start, end in self.records:
                if start in self.chunks and self._is_in(damaged, start, end):
                    yield self.chunks[start]

    def sound_loose(self, damaged: bytes) -> Iterator[Named]:
        """Messages without chunk whose bytes are all there, and the descriptions before them too."""
        ends = {start: end for _, start, end in self.records}
        described = [
            (start, end)
            for opcode, start, end in self.records
            if opcode in (3, 4) and start < self.data_end
        ]
        if self.loose and all(self._is_in(damaged, *place) for place in described):
            for start, named in self.loose.items():
                if self._is_in(damaged, start, ends[start]):
                    yield named


def read_truth(path: Path) -> Truth:
    """The truth about a sound file."""
    truth = Truth(path.stem, path.read_bytes())
    with path.open("rb") as stream:
        for schema, channel, message in NonSeekingReader(stream).iter_messages():
            counter = truth.messages.setdefault(channel.topic, Counter())
            counter[_payload(message)] += 1
            truth.types[channel.topic] = (
                (schema.name, schema.data.decode()) if schema else ("", "")
            )
    _locate(truth, path)
    return truth


def _payload(message: Message) -> Payload:
    return message.log_time, zlib.crc32(message.data)


def _locate(truth: Truth, path: Path) -> None:
    at, topics = 8, {}
    while at < len(truth.content) - 8:
        opcode, length = struct.unpack_from("<BQ", truth.content, at)
        truth.records.append((opcode, at, at + 9 + length))
        at += 9 + length
    starts = iter(start for _, start, _ in truth.records)
    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            start = next(starts)
            inner = breakup_chunk(record) if isinstance(record, Chunk) else [record]
            if isinstance(record, Chunk):
                truth.chunks[start] = []
            for item in inner:
                if isinstance(item, Channel):
                    topics[item.id] = item.topic
                    truth.has_summary |= start > truth.data_end
                elif isinstance(item, Message) and isinstance(record, Chunk):
                    truth.chunks[start].append(
                        (topics[item.channel_id], _payload(item))
                    )
                elif isinstance(item, Message):
                    truth.loose[start] = topics[item.channel_id], _payload(item)
                elif isinstance(item, Metadata):
                    truth.metadata[item.name] = {
                        k: v for k, v in item.metadata.items() if k != "crc32"
                    }
                elif isinstance(item, Schema):
                    continue
