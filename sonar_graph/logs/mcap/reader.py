"""Reading of an MCAP file in its own order: messages gathered by topic, and an account of what is damaged.

Each chunk from which anything is taken is decompressed whole and its CRC checked. A chunk is skipped, unread and
unchecked, only when a summary under a CRC states that it holds no wanted topic, or nothing of the wanted time. See
``docs/design/0004-logs.md``.
"""

import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Metadata, Schema

from sonar_graph.errors import LogError
from sonar_graph.logs.mcap.chunks import (
    Content,
    Found,
    find_messages,
    unpack_beginning,
    unpack_whole,
)
from sonar_graph.logs.mcap.log_file import LogFile, open_seal, parse, read_record
from sonar_graph.logs.mcap.record_walk import (
    HOLE,
    PRIVATE,
    Record,
    RecordWalk,
    content_of,
)
from sonar_graph.logs.mcap.time_window import WindowLimits
from sonar_graph.logs.mcap.topic import Damage, Descriptions, Keep, Keeping, Loss, Topic

_BLOCK = 1 << 22
_NS_PER_S = 1_000_000_000
Progress = Callable[[int, int], None]
"""Function called with the bytes done and the bytes in all."""


class ChunkPart(NamedTuple):
    """Messages of one topic in one chunk."""

    topic: Topic
    data: bytes | memoryview
    found: Found


def first_time_ns(file: LogFile) -> int:
    """Earliest log time by the statistics, or else that of the first messages that can be read; 0 without messages."""
    statistics = file.summary.statistics if file.summary else None
    if statistics is not None and statistics.message_count:
        return int(statistics.message_start_time)
    for record in RecordWalk(file):
        if record.opcode in (Opcode.CHUNK, Opcode.MESSAGE):
            with suppress(LogError):
                content = _content(file, record)
                if content.span_ns is not None:
                    return content.span_ns[0]
    return 0


def _content(file: LogFile, record: Record) -> Content:
    """Messages of a chunk or of a run of loose records; a LogError where the chunk is damaged."""
    if record.opcode == Opcode.MESSAGE:
        return find_messages(file.read(record.at, record.end - record.at))
    chunk = read_record(Chunk.read, content_of(file, record))
    data = unpack_whole(chunk)
    return find_messages(data, is_covered=chunk.uncompressed_crc != 0)


class Passage:
    """One pass through a file, in the order of the file: the wanted messages of each chunk, topic by topic.

    ``keep`` gives the wanted part of a message by the name of its type; ``limits`` the wanted time of recording, but of
    latched topics everything is wanted. With ``may_skip`` chunks without wanted messages are skipped by the summary.
    """

    def __init__(
        self,
        file: LogFile,
        keep: Keeping,
        limits: WindowLimits | None = None,
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
        self.limits = limits
        """The wanted time; None: all."""
        self._file = file
        self._may_skip = may_skip
        self._progress = progress
        self.described = Descriptions(file.path, keep)
        self._walk = RecordWalk(file)
        self._data_end: Record | None = None
        self._last_ns: int | None = None
        self._open_losses: list[Loss] = []
        self._without_crc = 0
        self._unsealed: list[str] = []
        self._is_loose = False
        # those of the summary come first: they replace any that are lost in the data
        for described in file.described:
            self.described.add(described)

    @property
    def counts(self) -> dict[str, int] | None:
        """Number of messages of each topic by the file's own statistics; None without statistics."""
        summary = self._file.summary
        if summary is None or summary.statistics is None:
            return None
        found = Counter[str]()
        for channel, count in summary.statistics.channel_message_counts.items():
            found[self._name(channel)] += count
        return found or None

    def __iter__(self) -> Iterator[ChunkPart]:
        for record in self._walk:
            if record.opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                yield from self._take_messages(record)
            elif record.opcode == HOLE:
                yield from self._take_hole(record)
            else:
                self._take_other(record)
        self._finish()

    def _is_wanted(self, index: ChunkIndex) -> bool:
        """True where a chunk may hold a wanted topic in the wanted time."""
        start_ns = index.message_start_time
        end_ns = index.message_end_time
        # without a window every chunk is inside
        first_ns, after_ns, _ = self.limits or (start_ns, end_ns + 1, "")
        is_inside = start_ns < after_ns and end_ns >= first_ns
        topics = [
            self.described.by_channel.get(channel)
            for channel in index.message_index_offsets
        ]
        # without message indexes the summary does not state which topics a chunk holds
        return not topics or any(
            topic is None
            or (topic.keep is not Keep.NONE and (is_inside or topic.is_latched))
            for topic in topics
        )

    def _take_hole(self, hole: Record) -> Iterator[ChunkPart]:
        """Loss of a hole, except for a chunk at its beginning that is whole, or cut off with the file."""
        content = None
        is_cut = hole.end == self._file.size
        if self._file.read(hole.at, 1) == bytes([Opcode.CHUNK]):
            self.chunks += 1
            with suppress(LogError):
                chunk = read_record(Chunk.read, content_of(self._file, hole))
                if is_cut:
                    content = find_messages(unpack_beginning(chunk))
                elif chunk.uncompressed_crc:  # its length is not confirmed
                    content = find_messages(unpack_whole(chunk), is_covered=True)
        # a cut end misleads no reader, so it is no hole that must be accepted by --salvage
        if is_cut:
            reason = f"the file is cut off: its last whole record ends at byte {hole.at} of {hole.end}"
            if content is not None and content.channels:
                count = sum(len(found.sizes) for found in content.channels.values())
                reason += f"; of the messages, {count} are from the beginning of a chunk, which no CRC covers"
            self.damage.ending = Loss(hole.at, hole.end, reason)
        else:
            after = "" if content is None else " after a whole chunk"
            self._lose(hole, f"no valid record{after}")
        if content is not None:
            yield from self._take(content, hole)

    def _take_other(self, record: Record) -> None:
        """Metadata, an attachment, a private record, or the end of the data."""
        if record.opcode == Opcode.DATA_END:
            self._data_end = record
        elif record.opcode == Opcode.METADATA:
            self._take_metadata(record)
        elif record.opcode == Opcode.ATTACHMENT:
            self.others.append(record)
        elif record.opcode >= PRIVATE:
            self.damage.remarks.append(
                f"bytes {record.at} to {record.end}: a record of private kind {record.opcode:#x}, not read"
            )

    def _take_metadata(self, record: Record) -> None:
        try:
            found = parse(Metadata.read, content_of(self._file, record))
            content, is_sealed = open_seal(found.metadata)
        except LogError as error:
            self._lose(record, f"a metadata record is lost: {error}", {})
            return
        self.metadata[found.name] = content
        self.others.append(record)
        if not is_sealed:
            self._unsealed.append(found.name)

    def _take_messages(self, record: Record) -> Iterator[ChunkPart]:
        """Wanted messages of a chunk or of a run of loose records."""
        is_chunk = record.opcode == Opcode.CHUNK
        self.chunks += is_chunk
        self._is_loose |= not is_chunk
        if self._progress:
            self._progress(record.end, self._file.size)
        index = self._walk.chunks.get(record.at)
        if self._may_skip and index is not None and not self._is_wanted(index):
            self.skipped += 1
            return
        try:
            content = _content(self._file, record)
        except LogError as error:
            self._lose(record, f"chunk {self.chunks} is lost: {error}")
            return
        unread = len(content.data) - content.end
        if unread:
            self._lose(record, f"chunk {self.chunks} ends in {unread} bytes unread")
        # what no CRC covers is named, because a wrong bit in it cannot be seen
        self._without_crc += is_chunk and not content.is_covered
        yield from self._take(content, record)

    def _take(self, content: Content, record: Record) -> Iterator[ChunkPart]:
        """Wanted messages of some bytes; their schemas and channels are added to the descriptions."""
        for opcode, described in content.described:
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            try:
                self.described.add(parse(kind.read, described))
            except LogError as error:
                self._lose(record, f"the description of a channel is lost: {error}", {})
        if content.span_ns is not None:
            first_ns, last_ns = content.span_ns
            # what was lost was recorded before these messages
            for loss in self._open_losses:
                loss.end_ns = first_ns
            self._open_losses.clear()
            self._last_ns = max(self._last_ns or 0, last_ns)
        for channel, found in content.channels.items():
            # a payload without a definition cannot be decoded
            topic = self.described.by_channel.get(channel)
            if topic is None:
                self._lose(
                    record,
                    f"messages of channel {channel}, whose description is lost",
                    {self._name(channel): len(found.sizes)},
                )
                continue
            if self.limits and not topic.is_latched:
                first_ns, after_ns, _ = self.limits
                times_ns = found.log_times_ns
                found = found.of((times_ns >= first_ns) & (times_ns < after_ns))
            if len(found.sizes):
                yield ChunkPart(topic, content.data, found)

    def _name(self, channel: int) -> str:
        topic = self.described.by_channel.get(channel)
        return f"channel {channel}" if topic is None else topic.name

    def _lose(
        self, record: Record, reason: str, messages: dict[str, int] | None = None
    ) -> None:
        loss = Loss(record.at, record.end, reason, self._last_ns, None, messages)
        self.damage.losses.append(loss)
        self._open_losses.append(loss)

    def _finish(self) -> None:
        """Complete the account of the damage at the end of the file."""
        damage = self.damage
        size = self._file.size
        damage.remarks += self.described.remarks
        # without the record that ends the data, records after the last one may be missing
        if self._data_end is None and damage.ending is None:
            reason = f"the file is cut off: it ends after a whole record, at byte {size}, without a summary"
            damage.ending = Loss(size, size, reason)
        elif self._file.fault and damage.ending is None:
            damage.remarks.append(
                f"{self._file.fault}; the data before its end is whole"
            )
            # no writer mixes the two: bytes are missing up to a message within a chunk
            if self._is_loose and self.chunks:
                reason = "messages lie outside chunks, so that the head of a chunk is missing"
                damage.losses.append(Loss(0, self._file.size, reason))
        if damage.ending is not None:
            damage.ending.start_ns = self._last_ns
        unprotected = []
        if self._without_crc:
            unprotected.append(f"{self._without_crc} chunks carry no CRC")
        if self._is_loose:
            unprotected.append("messages lie outside chunks")
        unprotected += [f"metadata record {name!r}" for name in self._unsealed]
        damage.unprotected = unprotected
        # where something is skipped or lost, the CRC over all data does not cover the rest
        if unprotected and not self.skipped and not damage.losses and self._data_end:
            self._check_data(self._data_end)

    def _check_data(self, data_end: Record) -> None:
        """Compare the CRC over all data, where the file has one, which protects what no other CRC covers."""
        expected = read_record(DataEnd.read, content_of(self._file, data_end))
        if not expected.data_section_crc:
            return
        crc = 0
        # in blocks: the file may be larger than the memory
        for at in range(0, data_end.at, _BLOCK):
            crc = zlib.crc32(self._file.read(at, min(_BLOCK, data_end.at - at)), crc)
        if crc == expected.data_section_crc:
            self.damage.unprotected = []
            return
        parts = ", ".join(self.damage.unprotected)
        reason = f"the CRC over all data does not fit, and {parts}: somewhere in these a bit is wrong"
        self.damage.losses.append(Loss(0, data_end.at, reason, messages={}))


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
    """Number of skipped chunks, which hold nothing that is wanted; their CRCs are not checked."""
    part: str | None = None
    """Text of the wanted time, if not all is wanted."""

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
