"""One passage through a log: what each chunk holds of each topic, and what is wrong with the file."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Generator, Iterator
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Metadata, Schema

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.chunks import (
    ChunkError,
    Content,
    Found,
    Index,
    find_by_index,
    find_by_walk,
    unpack,
    unpack_beginning,
)
from sonar_graph.logs.mcap.file_summary import TimeWindow, first_time_ns, parse, read_summary
from sonar_graph.logs.mcap.records import PRIVATE, ByteRange, ChunkRecord, Hole, LogFile, Record, RecordWalk, open_seal
from sonar_graph.logs.mcap.topic import Damage, Descriptions, Keep, Loss, Topic

_BLOCK = 1 << 22
Progress = Callable[[int, int], None]
"""Called with the bytes done and the bytes in all."""


class IndexLiesError(LogError):
    """A chunk is not what the index says, so that others may have been passed over wrongly."""


class ChunkPart(NamedTuple):
    """Messages of one topic in one chunk."""

    topic: Topic
    data: bytes | memoryview
    found: Found


class Passage:
    """Goes through a file once, in its order.

    Parameters
    ----------
    file
        The log.
    keep
        From a type's name, how much of such messages is wanted.
    window
        What was recorded then is wanted; of latched topics all.
    may_skip
        Whether chunks may be passed over for what the summary says about them.
    progress
        Told how far it is.
    """

    def __init__(
        self,
        file: LogFile,
        keep: Callable[[str], Keep],
        window: TimeWindow | None = None,
        *,
        may_skip: bool = True,
        progress: Progress | None = None,
    ) -> None:
        self.damage = Damage()
        self.metadata: dict[str, dict[str, str]] = {}
        self.others: list[Record] = []
        """Metadata that are whole, and attachments."""
        self.skipped = 0
        """Chunks passed over."""
        self.chunks = 0
        self._file = file
        self._may_skip = may_skip
        self._progress = progress
        self._summary, self._ending_fault = read_summary(file)
        self.part: str | None = None
        """Which part of the time is wanted, if not all."""
        self._limits_ns: tuple[int, int] | None = None
        if window is not None and not window.is_all:
            beginning_ns = first_time_ns(file, self._summary)
            self._limits_ns, self.part = window.resolve(beginning_ns), window.describe(beginning_ns)
        self._described = Descriptions(file.path, keep)
        self._walk = RecordWalk(file, self._summary.data_end_at if self._summary else None)
        self._last_ns: int | None = None
        self._open_losses: list[Loss] = []
        self._without_crc = 0
        self._unsealed: list[str] = []
        self._is_loose = False
        if self._summary:
            self._described.add_summary(self._summary)

    @property
    def topics(self) -> dict[str, Topic]:
        """All that are described, by name."""
        return self._described.by_name

    def as_written(self, topic: str) -> tuple[Channel, Schema]:
        """A topic's channel and schema."""
        return self._described.as_written[topic]

    @property
    def counts(self) -> dict[str, int] | None:
        """How many messages each topic has by the file's own statistics, where it has any."""
        statistics = self._summary.statistics if self._summary else None
        if statistics is None or not statistics.channel_message_counts:
            return None
        found: dict[str, int] = {}
        for channel, count in statistics.channel_message_counts.items():
            topic = self._described.by_channel.get(channel)
            name = f"channel {channel}" if topic is None else topic.name
            found[name] = found.get(name, 0) + count
        return found

    @property
    def is_complete(self) -> bool:
        """Whether every message that can be read was counted."""
        return not self.skipped and self._limits_ns is None

    def __iter__(self) -> Iterator[ChunkPart]:
        chunk: ChunkRecord | None = None
        index: dict[int, np.ndarray] = {}
        for item in self._walk:
            if chunk is not None and isinstance(item, Record) and item.opcode == Opcode.MESSAGE_INDEX:
                index.update(self._read_index(item))
                continue
            is_told = chunk is not None and (yield from self._take_chunk(chunk, index, item))
            chunk, index = None, {}
            if isinstance(item, ChunkRecord):
                chunk = item if self._is_due(item) else None
            elif isinstance(item, ByteRange):
                yield from self._take_loose(item)
            elif isinstance(item, Hole) and not is_told:
                yield from self._take_hole(item)
            elif isinstance(item, Record):
                self._take_other(item)
        if chunk is not None:
            yield from self._take_chunk(chunk, index, None)
        self._finish()

    # ---- chunks

    def _read_index(self, record: Record) -> dict[int, np.ndarray]:
        content = self._file.content(record)
        rows = np.frombuffer(content, "<u8", offset=6, count=(len(content) - 6) // 16 * 2).reshape(-1, 2)
        return {int.from_bytes(content[:2], "little"): rows}

    def _is_due(self, chunk: ChunkRecord) -> bool:
        """Whether a chunk must be unpacked; else the walk goes on after it and its message indexes."""
        self._report(chunk.end)
        self.chunks += 1
        index = self._indexed(chunk) if self._may_skip else None
        if index is None or self._is_wanted(chunk, index):
            return True
        self.skipped += 1
        self._walk.jump(chunk.end + index.message_index_length)
        return False

    def _take_chunk(self, chunk: ChunkRecord, index: Index, following: object) -> Generator[ChunkPart, None, bool]:
        """Whether a hole that follows is told already, as a part of a chunk that is not whole."""
        try:
            data = unpack(chunk, self._file.read(chunk.data_at, chunk.data_size))
        except ChunkError as error:
            self._lose_chunk(chunk, index, isinstance(following, Hole), f"chunk {self.chunks} is lost: {error}")
            return True
        content = find_by_index(data, index) if index else None
        if content is None:
            content = find_by_walk(data)
            if index:
                self._remark(f"the message index of chunk {self.chunks} (byte {chunk.at}) does not fit; read without")
            if content.end < len(data):
                self._lose(chunk.at, chunk.end, f"chunk {self.chunks} ends in {len(data) - content.end} bytes unread")
        self._check_against_summary(chunk, content)
        self._without_crc += not chunk.crc
        yield from self._take_content(content, chunk.at, chunk.end, is_covered=chunk.crc != 0)
        return False

    def _lose_chunk(self, chunk: ChunkRecord, index: Index, before_hole: bool, reason: str) -> None:
        """A chunk with a hole after it may have the wrong length: what follows is searched from its beginning."""
        end = self._walk.search(chunk.at).end if before_hole else chunk.end
        if end == self._file.size and not self._walk.reached_end:
            self.damage.ending = Loss(chunk.at, end, f"the file is cut off, or overwritten from there: {reason}")
        else:
            self._lose(chunk.at, end, reason, chunk, self._counted(index))

    def _counted(self, index: Index) -> dict[str, int] | None:
        """How many messages of each topic a chunk's index counts."""
        if not index:
            return None
        return {self._name(channel): len(rows) for channel, rows in index.items()}

    def _name(self, channel: int) -> str:
        topic = self._described.by_channel.get(channel)
        return f"channel {channel}" if topic is None else topic.name

    def _indexed(self, chunk: ChunkRecord) -> ChunkIndex | None:
        """What the summary says of a chunk, where it agrees with the chunk's own head."""
        index = self._summary.chunks.get(chunk.at) if self._summary else None
        if index is None or not index.message_index_offsets:
            return None
        said = (index.message_start_time, index.message_end_time, index.compressed_size, index.uncompressed_size)
        return index if said == (chunk.start_ns, chunk.end_ns, chunk.data_size, chunk.uncompressed_size) else None

    def _is_wanted(self, chunk: ChunkRecord, index: ChunkIndex) -> bool:
        topics = [self._described.by_channel.get(channel) for channel in index.message_index_offsets]
        first_ns, after_ns = self._limits_ns or (chunk.start_ns, chunk.end_ns + 1)
        is_inside = chunk.start_ns < after_ns and chunk.end_ns >= first_ns
        return any(
            topic is None or (topic.keep is not Keep.NONE and (is_inside or topic.is_latched)) for topic in topics
        )

    def _check_against_summary(self, chunk: ChunkRecord, content: Content) -> None:
        index = self._indexed(chunk)
        if index is None or not content.channels:
            return
        first_ns, last_ns = content.times_ns()
        is_inside = chunk.start_ns <= first_ns and last_ns <= chunk.end_ns
        if content.channels.keys() <= index.message_index_offsets.keys() and is_inside:
            return
        self._remark(f"the summary's index does not fit chunk {self.chunks} (byte {chunk.at}); read without")
        if self._may_skip:
            raise IndexLiesError(f"{self._file.path}: its index does not fit its chunks")

    # ---- what is not in chunks

    def _take_loose(self, stretch: ByteRange) -> Iterator[ChunkPart]:
        self._report(stretch.end)
        self._is_loose = True
        content = find_by_walk(self._file.read(stretch.at, stretch.end - stretch.at))
        yield from self._take_content(content, stretch.at, stretch.end, is_covered=False)

    def _take_hole(self, hole: Hole) -> Iterator[ChunkPart]:
        if hole.end < self._file.size or self._walk.reached_end:
            self._lose(hole.at, hole.end, "no valid record")
            return
        chunk = self._file.record(hole.at)
        reason = f"the file is cut off: its last whole record ends at byte {hole.at} of {hole.end}"
        if not isinstance(chunk, ChunkRecord) or chunk.end <= self._file.size:
            self.damage.ending = Loss(hole.at, hole.end, reason, self._last_ns)
            return
        self.chunks += 1
        content = find_by_walk(unpack_beginning(chunk, self._file.read(chunk.data_at, chunk.data_size))).trusted()
        if len(content):
            reason += f"; of the messages, {len(content)} are from the beginning of a chunk, which no CRC covers"
        self.damage.ending = Loss(hole.at, hole.end, reason, self._last_ns)
        yield from self._take_content(content, hole.at, hole.end, is_covered=False)

    def _take_other(self, record: Record) -> None:
        if record.opcode == Opcode.METADATA:
            try:
                found = parse(Metadata.read, self._file.content(record))
                content, is_sealed = open_seal(found.metadata)
            except LogError as error:
                end = self._walk.search(record.at).end  # its length may be what is wrong
                self._lose(record.at, end, f"a metadata record is lost: {error}", messages={})
                return
            self.metadata[found.name] = content
            self.others.append(record)
            if not is_sealed:
                self._unsealed.append(found.name)
        elif record.opcode == Opcode.ATTACHMENT:
            self.others.append(record)
        elif record.opcode >= PRIVATE:
            self._remark(f"bytes {record.at} to {record.end}: a record of private kind {record.opcode:#x}, not read")

    # ---- both

    def _take_content(self, content: Content, at: int, end: int, *, is_covered: bool) -> Iterator[ChunkPart]:
        for opcode, described in content.described:
            try:
                self._described.add(opcode, described, is_covered=is_covered)
            except LogError as error:
                self._lose(at, end, f"the description of a channel is lost: {error}", messages={})
        if content.channels:
            first_ns, last_ns = content.times_ns()
            self._close_losses(first_ns)
            self._last_ns = max(self._last_ns or 0, last_ns)
        for channel, found in content.channels.items():
            topic = self._described.by_channel.get(channel)
            if topic is None:
                reason = f"messages of channel {channel}, whose description is lost"
                self._lose(at, end, reason, messages={f"channel {channel}": len(found.sizes)})
                continue
            if self._limits_ns and not topic.is_latched:
                first_ns, after_ns = self._limits_ns
                found = found.of((found.log_times_ns >= first_ns) & (found.log_times_ns < after_ns))
            if len(found.sizes):
                yield ChunkPart(topic, content.data, found)

    def _lose(
        self,
        at: int,
        end: int,
        reason: str,
        chunk: ChunkRecord | None = None,
        messages: dict[str, int] | None = None,
    ) -> None:
        loss = Loss(at, end, reason, self._last_ns, None, messages)
        self.damage.losses.append(loss)
        if chunk is not None and self._indexed(chunk) is not None:
            loss.start_ns, loss.end_ns = chunk.start_ns, chunk.end_ns
        else:
            self._open_losses.append(loss)

    def _close_losses(self, first_ns: int) -> None:
        """What was lost was recorded before what comes now."""
        for loss in self._open_losses:
            loss.end_ns = first_ns
        self._open_losses.clear()

    def _remark(self, text: str) -> None:
        self.damage.remarks.append(text)

    def _report(self, done: int) -> None:
        if self._progress:
            self._progress(done, self._file.size)

    # ---- the end

    def _finish(self) -> None:
        damage = self.damage
        damage.remarks += self._described.remarks
        if self._ending_fault and damage.ending is None:
            if self._summary is None and not self._walk.reached_end:
                reason = (
                    f"the file is cut off: it ends after a whole record, at byte {self._file.size}, without a summary"
                )
                damage.ending = Loss(self._file.size, self._file.size, reason, self._last_ns)
            else:
                damage.remarks.append(f"{self._ending_fault}; the data before its end is whole")
        if damage.ending is not None:
            damage.ending.start_ns = self._last_ns
        unprotected = [f"{self._without_crc} chunks carry no CRC"] if self._without_crc else []
        unprotected += ["messages lie outside chunks"] if self._is_loose else []
        unprotected += [f"metadata record {name!r}" for name in self._unsealed]
        if unprotected and not self.skipped and not damage.losses and self._check_data_crc(unprotected):
            return
        damage.unprotected = unprotected

    def _check_data_crc(self, unprotected: list[str]) -> bool:
        """Whether the file has a CRC over all its data that fits; a loss where it has one that does not."""
        summary = self._summary
        if summary is None or not summary.data_crc:
            return False
        crc = 0
        for at in range(0, summary.data_end_at, _BLOCK):
            crc = zlib.crc32(self._file.read(at, min(_BLOCK, summary.data_end_at - at)), crc)
        if crc == summary.data_crc:
            return True
        reason = f"the CRC over all data does not fit, and {', '.join(unprotected)}: somewhere in these a bit is wrong"
        self.damage.losses.append(Loss(0, summary.data_end_at, reason, messages={}))
        return False
