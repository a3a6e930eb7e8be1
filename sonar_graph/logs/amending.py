"""Amending of logs: a copy of an MCAP log, byte by byte, with more messages in it.

The log is read as every log is (`sonar_graph.logs.mcap.reader`): of one that is cut off, what is whole is copied.
"""

import heapq
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import chain, groupby, repeat
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata

from sonar_graph.errors import LogError
from sonar_graph.files import written_whole
from sonar_graph.logs.mcap import (
    Damage,
    Found,
    Keep,
    LogFile,
    LogWriter,
    Outgoing,
    Passage,
    Record,
    Recording,
    SchemaText,
    Topic,
    by_time,
    content_of,
    header_of,
    log_parts,
    own_schema,
    parse,
)

_Message = tuple[int, int, int, bytes, int]
"""Log time, channel, publish time, payload, sequence number."""
_HEAD = struct.Struct("<IQQ")
"""Sequence number, log time and publish time before a payload."""


@dataclass
class Amended:
    """Account of a log that was rewritten."""

    replaced: Counter[str] = field(default_factory=Counter)
    """Number of messages left out because their topic was rewritten."""
    notes: dict[str, str] = field(default_factory=dict)
    """Parts that could not be copied, by subject as in `Recording.notes`."""


def write_amended(
    source: Path,
    target: Path,
    added: Sequence[Outgoing],
    *,
    more: Iterable[Outgoing] = (),
    anew: Mapping[str, str] | None = None,
    metadata: Mapping[str, Mapping[str, str]] | None = None,
    salvage: bool = False,
) -> Amended:
    """Copy an MCAP log and add messages, all in the order of their log times; only chunks are held in memory.

    Parameters
    ----------
    source
        The log, whose metadata and attachments are copied too.
    target
        Another file; one that exists is replaced when the new one is complete.
    added
        Messages on topics that the log does not have, or that are rewritten.
    more
        The same for messages that do not fit into memory at once, such as images: entries of one topic in the order of
        time, each taken when the one before is written.
    anew
        Types by topic; the messages of the log on these topics are left out.
    metadata
        Records by name, after those of the log; of two with one name the later counts.
    salvage
        Copy what is whole of a log that is damaged in its middle.

    Raises
    ------
    LogError
        When the two are one file, a topic is there already (under ``anew``: with another type), the log is damaged in
        its middle, or a file cannot be read or written.
    """
    if target.exists() and target.samefile(source):
        raise LogError(f"{target}: is the log itself; give another name with -o")
    with ExitStack() as opened:
        logs = [opened.enter_context(LogFile(part)) for part in log_parts(source)]
        out = opened.enter_context(written_whole(target))
        header = header_of(logs[0].path)
        # the profile states to viewers of ROS what they read
        writer = LogWriter(out, header.profile if header else "", is_copy=True)
        topics = {entry.topic for entry in added}
        copy = _AmendedCopy(source, writer, anew or {}, topics - (anew or {}).keys())
        copy.write(logs, added, more, salvage=salvage)
        for name, values in (metadata or {}).items():
            writer.add_metadata(name, values)
        writer.finish()
    return copy.amended


@dataclass
class _AmendedCopy:
    """A log on its way into another file."""

    source: Path
    writer: LogWriter
    anew: Mapping[str, str]
    taken: set[str]
    """Topics that the log must not have."""
    amended: Amended = field(default_factory=Amended)
    beginning_ns: int | None = None

    def write(
        self,
        logs: list[LogFile],
        added: Sequence[Outgoing],
        more: Iterable[Outgoing],
        *,
        salvage: bool,
    ) -> None:
        """Write messages, metadata and attachments of the files of a log, and the added messages."""
        passages = [Passage(log, lambda _: Keep.ALL, may_skip=False) for log in logs]
        # those of ``more`` go first: their topic is taken before the log's are copied
        for log_time_ns, channel, sent_ns, payload, number in heapq.merge(
            self._streamed(more),
            chain.from_iterable(map(self._recorded, passages)),
            self._added(added),
            key=lambda message: message[0],
        ):
            self.writer.mcap.add_message(channel, log_time_ns, payload, sent_ns, number)
        damage = Damage()
        for log, passage in zip(logs, passages, strict=True):
            # known only when all messages have been read
            damage.extend(passage.damage, log.path.name if len(logs) > 1 else "")
        recording = Recording(
            self.source, damage=damage, beginning_ns=self.beginning_ns
        )
        if not salvage:
            recording.require_sound()
        for log, passage in zip(logs, passages, strict=True):
            for record in passage.others:
                self._copy_other(record, content_of(log, record))
        notes = recording.notes()
        self.amended.notes |= {
            name: notes[name] for name in ("log.ending", "log.damage") if name in notes
        }

    def _copy_other(self, record: Record, content: bytes) -> None:
        """Copy metadata, or an attachment whose CRC fits."""
        writer = self.writer.mcap
        if record.opcode == Opcode.METADATA:
            found = parse(Metadata.read, content)
            writer.add_metadata(found.name, found.metadata)
        # a CRC of zero means none
        elif int.from_bytes(content[-4:], "little") in (0, zlib.crc32(content[:-4])):
            file = parse(Attachment.read, content)
            writer.add_attachment(
                file.create_time, file.log_time, file.name, file.media_type, file.data
            )
        else:
            self.amended.notes["log.attachments"] = (
                f"one at byte {record.at} is damaged and left out"
            )

    def _recorded(self, passage: Passage) -> Iterator[_Message]:
        """Messages of the log that are copied; those of one chunk in the order of their times."""
        # a chunk comes topic by topic, and its messages have to be merged by time
        for _, chunk in groupby(passage, key=lambda piece: id(piece.data)):
            rows: list[Any] = []
            for topic, data, found in chunk:
                channel = self._channel(topic, found, passage)
                if channel is not None:
                    columns = (found.log_times_ns, found.offsets, found.sizes)
                    times = (column.tolist() for column in columns)
                    rows += zip(*times, repeat(channel), repeat(data))
            for time_ns, at, size, channel, data in sorted(
                rows, key=lambda row: row[:2]
            ):
                # before each payload is the head of its record
                number, _, published_ns = _HEAD.unpack_from(data, at - _HEAD.size)
                payload = bytes(data[at : at + size])
                yield time_ns, channel, published_ns, payload, number

    def _channel(self, topic: Topic, found: Found, passage: Passage) -> int | None:
        """Channel of messages in the copy; None where their topic is rewritten."""
        first_ns = int(found.log_times_ns.min())
        if self.beginning_ns is None or first_ns < self.beginning_ns:
            self.beginning_ns = first_ns
        wanted = self.anew.get(topic.name)
        # two types on one topic confuse every reader
        if topic.name in self.taken or (wanted is not None and not topic.is_a(wanted)):
            raise LogError(
                f"{self.source}: {topic.name} ({topic.type_name}) is in the log already; "
                "leave it out where the log is made"
            )
        if wanted is not None:
            self.amended.replaced[topic.name] += len(found.sizes)
            return None
        channel, schema = passage.described.as_written[topic.name]
        text = SchemaText(schema.name, schema.encoding, schema.data)
        return self.writer.channel(topic.name, text, topic.encoding, channel.metadata)

    def _added(self, added: Sequence[Outgoing]) -> Iterator[_Message]:
        for time_ns, entry, payload in by_time(added):
            channel = self.writer.channel(entry.topic, own_schema(entry.type_name))
            yield time_ns, channel, time_ns, payload, 0

    def _streamed(self, more: Iterable[Outgoing]) -> Iterator[_Message]:
        for entry in more:
            self.taken.add(entry.topic)
            yield from self._added([entry])
