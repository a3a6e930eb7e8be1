"""Reading of an MCAP file in its own order: messages gathered by topic, and an account of what is damaged.

Each chunk from which anything is taken is decompressed whole and its CRC checked. Its messages are found by the message
index where that agrees with the chunk in every record, or else by a walk through the records. A chunk is skipped,
unread and unchecked, only when a summary that agrees with the chunk's head states that it holds no wanted topic, or
nothing of the wanted time. See ``docs/design/0004-logs.md``.
"""

import zlib
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Metadata

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.chunks import (
    Content,
    Found,
    Index,
    find_by_index,
    find_by_walk,
    unpack,
    unpack_beginning,
)
from sonar_graph.logs.mcap.file_summary import (
    TimeWindow,
    first_time_ns,
    parse,
    read_summary,
)
from sonar_graph.logs.mcap.records import (
    PRIVATE,
    ByteRange,
    ChunkRecord,
    Hole,
    LogFile,
    Record,
    RecordWalk,
    open_seal,
)
from sonar_graph.logs.mcap.topic import Damage, Descriptions, Keep, Loss, Topic

_BLOCK = 1 << 22
_NS_PER_S = 1_000_000_000
_PIECE_BYTES = 1 << 20
Progress = Callable[[int, int], None]
"""Function called with the bytes done and the bytes in all."""


class IndexMismatchError(LogError):
    """An index that does not describe its chunks, so that chunks may have been skipped wrongly."""


class ChunkPart(NamedTuple):
    """Messages of one topic in one chunk."""

    topic: Topic
    data: bytes | memoryview
    found: Found


class Passage:
    """One pass through a file, in the order of the file: the wanted messages of each chunk, topic by topic.

    ``keep`` tells the wanted part of a message by the name of its type; ``window`` the wanted time of recording, but of
    latched topics everything is wanted. With ``may_skip`` chunks without wanted messages are skipped by the summary.
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
        """Whole metadata records, and attachments."""
        self.skipped = 0
        """Number of skipped chunks."""
        self.chunks = 0
        self._file = file
        self._may_skip = may_skip
        self._progress = progress
        self._summary, self._ending_fault = read_summary(file)
        self.part: str | None = None
        """Text of the wanted time, if not all is wanted."""
        self._limits_ns: tuple[int, int] | None = None
        if window is not None and (window.start or window.end):
            beginning_ns = first_time_ns(file, self._summary)
            self._limits_ns, self.part = (
                window.resolve(beginning_ns),
                window.describe(beginning_ns),
            )
        self._described = Descriptions(file.path, keep)
        self.topics = self._described.by_name
        """All described topics by name."""
        self.as_written = self._described.as_written
        """Channel and schema of each topic."""
        self._walk = RecordWalk(
            file, self._summary.data_end_at if self._summary else None
        )
        self._last_ns: int | None = None
        self._open_losses: list[Loss] = []
        self._without_crc = 0
        self._unsealed: list[str] = []
        self._is_loose = False
        if self._summary:
            self._described.add_summary(self._summary)

    @property
    def counts(self) -> dict[str, int] | None:
        """Number of messages of each topic by the file's own statistics; None without statistics."""
        statistics = self._summary.statistics if self._summary else None
        if statistics is None or not statistics.channel_message_counts:
            return None
        found: dict[str, int] = {}
        for channel, count in statistics.channel_message_counts.items():
            name = self._name(channel)
            found[name] = found.get(name, 0) + count
        return found

    def __iter__(self) -> Iterator[ChunkPart]:
        chunk: ChunkRecord | None = None
        index: dict[int, np.ndarray] = {}
        for item in self._walk:
            if (
                chunk is not None
                and isinstance(item, Record)
                and item.opcode == Opcode.MESSAGE_INDEX
            ):
                content = self._file.content(item)
                rows = np.frombuffer(
                    content, "<u8", offset=6, count=(len(content) - 6) // 16 * 2
                ).reshape(-1, 2)
                index[int.from_bytes(content[:2], "little")] = rows
                continue
            before_hole = isinstance(item, Hole)
            is_told = chunk is not None and (
                yield from self._take_chunk(chunk, index, before_hole=before_hole)
            )
            chunk, index = None, {}
            if isinstance(item, ChunkRecord):
                self._report(item.end)
                self.chunks += 1
                said = self._indexed(item) if self._may_skip else None
                if said is None or self._is_wanted(item, said):
                    chunk = item
                else:
                    self.skipped += 1
                    self._walk.jump(item.end + said.message_index_length)
            elif isinstance(item, ByteRange):
                self._report(item.end)
                self._is_loose = True
                loose = find_by_walk(self._file.read(item.at, item.end - item.at))
                yield from self._take_content(
                    loose, item.at, item.end, is_covered=False
                )
            elif isinstance(item, Hole) and not is_told:
                yield from self._take_hole(item)
            elif isinstance(item, Record):
                self._take_other(item)
        if chunk is not None:
            yield from self._take_chunk(chunk, index, before_hole=False)
        self._finish()

    def _is_wanted(self, chunk: ChunkRecord, index: ChunkIndex) -> bool:
        """True where a chunk may hold a wanted topic in the wanted time."""
        topics = [
            self._described.by_channel.get(channel)
            for channel in index.message_index_offsets
        ]
        first_ns, after_ns = self._limits_ns or (chunk.start_ns, chunk.end_ns + 1)
        is_inside = chunk.start_ns < after_ns and chunk.end_ns >= first_ns
        return any(
            topic is None
            or (topic.keep is not Keep.NONE and (is_inside or topic.is_latched))
            for topic in topics
        )

    def _take_chunk(
        self, chunk: ChunkRecord, index: Index, *, before_hole: bool
    ) -> Generator[ChunkPart, None, bool]:
        """Messages of a chunk; returns True where the chunk is lost, together with a hole after it."""
        try:
            data = unpack(chunk, self._file.read(chunk.data_at, chunk.data_size))
        except LogError as error:
            reason = f"chunk {self.chunks} is lost: {error}"
            # before a hole the chunk may have a wrong length: the next record is searched from its beginning
            end = self._walk.search(chunk.at).end if before_hole else chunk.end
            if end == self._file.size and not self._walk.reached_end:
                self.damage.ending = Loss(
                    chunk.at,
                    end,
                    f"the file is cut off, or overwritten from there: {reason}",
                )
            else:
                counted = {
                    self._name(channel): len(rows) for channel, rows in index.items()
                }
                self._lose(chunk.at, end, reason, chunk, counted or None)
            return True
        content = find_by_index(data, index) if index else None
        if content is None:
            content = find_by_walk(data)
            if index:
                self._remark(
                    f"the message index of chunk {self.chunks} (byte {chunk.at}) does not fit; read without"
                )
            if content.end < len(data):
                self._lose(
                    chunk.at,
                    chunk.end,
                    f"chunk {self.chunks} ends in {len(data) - content.end} bytes unread",
                )
        said = self._indexed(chunk)
        if said is not None and content.channels:
            first_ns, last_ns = content.times_ns()
            is_inside = chunk.start_ns <= first_ns and last_ns <= chunk.end_ns
            if not (
                is_inside
                and content.channels.keys() <= said.message_index_offsets.keys()
            ):
                self._remark(
                    f"the summary's index does not fit chunk {self.chunks} (byte {chunk.at}); read without"
                )
                if self._may_skip:
                    raise IndexMismatchError(
                        f"{self._file.path}: its index does not fit its chunks"
                    )
        self._without_crc += not chunk.crc
        yield from self._take_content(
            content, chunk.at, chunk.end, is_covered=chunk.crc != 0
        )
        return False

    def _indexed(self, chunk: ChunkRecord) -> ChunkIndex | None:
        """Index of a chunk in the summary, where it agrees with the chunk's own head."""
        index = self._summary.chunks.get(chunk.at) if self._summary else None
        if index is None or not index.message_index_offsets:
            return None
        said = (
            index.message_start_time,
            index.message_end_time,
            index.compressed_size,
            index.uncompressed_size,
        )
        return (
            index
            if said
            == (chunk.start_ns, chunk.end_ns, chunk.data_size, chunk.uncompressed_size)
            else None
        )

    def _take_hole(self, hole: Hole) -> Iterator[ChunkPart]:
        """Messages at the beginning of a chunk that is cut off; any other hole is a loss."""
        if hole.end < self._file.size or self._walk.reached_end:
            self._lose(hole.at, hole.end, "no valid record")
            return
        chunk = self._file.record(hole.at)
        reason = f"the file is cut off: its last whole record ends at byte {hole.at} of {hole.end}"
        if not isinstance(chunk, ChunkRecord) or chunk.end <= self._file.size:
            self.damage.ending = Loss(hole.at, hole.end, reason, self._last_ns)
            return
        self.chunks += 1
        content = find_by_walk(
            unpack_beginning(chunk, self._file.read(chunk.data_at, chunk.data_size))
        ).trusted()
        if len(content):
            reason += f"; of the messages, {len(content)} are from the beginning of a chunk, which no CRC covers"
        self.damage.ending = Loss(hole.at, hole.end, reason, self._last_ns)
        yield from self._take_content(content, hole.at, hole.end, is_covered=False)

    def _take_other(self, record: Record) -> None:
        """Metadata, an attachment, or a private record."""
        if record.opcode == Opcode.METADATA:
            try:
                found = parse(Metadata.read, self._file.content(record))
                content, is_sealed = open_seal(found.metadata)
            except LogError as error:
                end = self._walk.search(record.at).end  # the length may be damaged
                self._lose(
                    record.at, end, f"a metadata record is lost: {error}", messages={}
                )
                return
            self.metadata[found.name] = content
            self.others.append(record)
            if not is_sealed:
                self._unsealed.append(found.name)
        elif record.opcode == Opcode.ATTACHMENT:
            self.others.append(record)
        elif record.opcode >= PRIVATE:
            self._remark(
                f"bytes {record.at} to {record.end}: a record of private kind {record.opcode:#x}, not read"
            )

    def _take_content(
        self, content: Content, at: int, end: int, *, is_covered: bool
    ) -> Iterator[ChunkPart]:
        """Wanted messages of some bytes; their schemas and channels are added to the descriptions."""
        for opcode, described in content.described:
            try:
                self._described.add(opcode, described, is_covered=is_covered)
            except LogError as error:
                self._lose(
                    at,
                    end,
                    f"the description of a channel is lost: {error}",
                    messages={},
                )
        if content.channels:
            first_ns, last_ns = content.times_ns()
            for loss in self._open_losses:  # lost messages were recorded before these
                loss.end_ns = first_ns
            self._open_losses.clear()
            self._last_ns = max(self._last_ns or 0, last_ns)
        for channel, found in content.channels.items():
            topic = self._described.by_channel.get(channel)
            if topic is None:
                reason = f"messages of channel {channel}, whose description is lost"
                self._lose(
                    at, end, reason, messages={self._name(channel): len(found.sizes)}
                )
                continue
            if self._limits_ns and not topic.is_latched:
                first_ns, after_ns = self._limits_ns
                found = found.of(
                    (found.log_times_ns >= first_ns) & (found.log_times_ns < after_ns)
                )
            if len(found.sizes):
                yield ChunkPart(topic, content.data, found)

    def _name(self, channel: int) -> str:
        topic = self._described.by_channel.get(channel)
        return f"channel {channel}" if topic is None else topic.name

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

    def _remark(self, text: str) -> None:
        self.damage.remarks.append(text)

    def _report(self, done: int) -> None:
        if self._progress:
            self._progress(done, self._file.size)

    def _finish(self) -> None:
        """Complete the account of the damage at the end of the file."""
        damage, summary = self.damage, self._summary
        damage.remarks += self._described.remarks
        if self._ending_fault and damage.ending is None:
            if summary is None and not self._walk.reached_end:
                size = self._file.size
                reason = f"the file is cut off: it ends after a whole record, at byte {size}, without a summary"
                damage.ending = Loss(size, size, reason, self._last_ns)
            else:
                self._remark(f"{self._ending_fault}; the data before its end is whole")
        if damage.ending is not None:
            damage.ending.start_ns = self._last_ns
        unprotected = (
            [f"{self._without_crc} chunks carry no CRC"] if self._without_crc else []
        )
        unprotected += ["messages lie outside chunks"] if self._is_loose else []
        unprotected += [f"metadata record {name!r}" for name in self._unsealed]
        if (
            unprotected
            and not self.skipped
            and not damage.losses
            and summary is not None
            and summary.data_crc
        ):
            crc = 0
            for at in range(0, summary.data_end_at, _BLOCK):
                crc = zlib.crc32(
                    self._file.read(at, min(_BLOCK, summary.data_end_at - at)), crc
                )
            if crc == summary.data_crc:  # the CRC over all data protects them
                return
            reason = f"the CRC over all data does not fit, and {', '.join(unprotected)}: somewhere in these a bit is wrong"
            damage.losses.append(Loss(0, summary.data_end_at, reason, messages={}))
        damage.unprotected = unprotected


@dataclass
class Recording:
    """Content of an MCAP file."""

    path: Path
    topics: dict[str, Topic] = field(default_factory=dict)
    """Topics with messages, by name."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    """Metadata records by name; the last of two with the same name."""
    damage: Damage = field(default_factory=Damage)
    """Damage of the file."""
    beginning_ns: int | None = None
    """Earliest known log time."""
    chunks: int = 0
    """Number of chunks in the file."""
    skipped_chunks: int = 0
    """Number of skipped chunks, which hold nothing that was asked for; their CRCs are not checked."""
    part: str | None = None
    """Text of the wanted time, if not all was asked for."""

    @property
    def ending(self) -> str | None:
        """Fault at the end of a file that was cut off, and the duration of what is there; None: not cut off."""
        ending = self.damage.ending
        if ending is None:
            return None
        if ending.start_ns is None or self.beginning_ns is None:
            return f"{ending.reason}; no message is there"
        return f"{ending.reason}; what is there spans {(ending.start_ns - self.beginning_ns) / _NS_PER_S:.3f} s"

    @property
    def corrupt(self) -> list[str]:
        """Text of each loss: bytes, reason, times and topics."""
        return [loss.describe(self.beginning_ns) for loss in self.damage.losses]

    def notes(self) -> dict[str, str]:
        """Notes about the reading for whoever uses the results, by subject."""
        skipped = f"{self.skipped_chunks} of {self.chunks} chunks hold nothing that was asked for; not read, not checked"
        texts = {
            "log.ending": self.ending or "",
            "log.damage": "; ".join(self.corrupt),
            "log.remarks": "; ".join(self.damage.remarks),
            "log.unprotected": ", ".join(self.damage.unprotected),
            "log.part": self.part or "",
            "log.skipped": skipped if self.skipped_chunks else "",
        }
        return {subject: text for subject, text in texts.items() if text}

    def require_sound(self) -> None:
        """Refuse a file that has holes by a LogError, which names the first hole and what reads the rest."""
        if self.corrupt:
            more = (
                f" (and {len(self.corrupt) - 1} more)" if len(self.corrupt) > 1 else ""
            )
            advice = "copy it again, or read what is whole with --salvage"
            raise LogError(f"{self.path} is damaged: {self.corrupt[0]}{more}; {advice}")
