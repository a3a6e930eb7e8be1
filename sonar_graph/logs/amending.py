"""Amending of logs: a copy of an MCAP log, byte by byte, with more messages in it.

The log is read as every log is (`sonar_graph.logs.mcap.reader`): of one that is cut off, what is whole is copied.
"""

import heapq
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata

from sonar_graph.errors import LogError
from sonar_graph.files import written_whole
from sonar_graph.logs.cdr import short_name
from sonar_graph.logs.mcap import (
    ChunkPart,
    Damage,
    Keep,
    LogFile,
    LogWriter,
    Outgoing,
    Passage,
    Recording,
    SchemaText,
    by_time,
    content_of,
    header_of,
    log_parts,
    own_schema,
    parse,
)

_Message = tuple[int, int, int, bytes, int]
"""Log time, channel, publish time, payload, sequence number."""


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
        copy = _AmendedCopy(
            source, logs, out, anew or {}, {entry.topic for entry in added}
        )
        return copy.run(added, more, metadata or {}, salvage)


class _AmendedCopy:
    """A log on its way into another file."""

    def __init__(
        self,
        source: Path,
        logs: list[LogFile],
        out: BinaryIO,
        anew: Mapping[str, str],
        added: Set[str],
    ) -> None:
        self._source = source
        self._anew = anew
        self._taken = set(added - anew.keys())
        self._passages = [
            (log, Passage(log, lambda _: Keep.ALL, may_skip=False)) for log in logs
        ]
        header = header_of(logs[0].path)
        # the profile states to viewers of ROS what they read
        profile = header.profile if header else ""
        self._writer = LogWriter(out, profile, is_copy=True)
        self._amended = Amended()
        self._beginning_ns: int | None = None

    def run(
        self,
        added: Sequence[Outgoing],
        more: Iterable[Outgoing],
        metadata: Mapping[str, Mapping[str, str]],
        salvage: bool,
    ) -> Amended:
        writer = self._writer.mcap
        amended = self._amended
        damage = Damage()
        # those of ``more`` go first: their topic is taken before the log's are copied
        merged = heapq.merge(
            self._streamed(more),
            self._recorded(),
            self._added(added),
            key=lambda message: message[0],
        )
        for log_time_ns, channel, sent_ns, payload, number in merged:
            writer.add_message(channel, log_time_ns, payload, sent_ns, number)
        for log, passage in self._passages:
            # known only when all messages have been read
            damage.extend(
                passage.damage, log.path.name if len(self._passages) > 1 else ""
            )
        recording = Recording(
            self._source, damage=damage, beginning_ns=self._beginning_ns
        )
        if not salvage:
            recording.require_sound()
        for log, record in (
            (log, record)
            for log, passage in self._passages
            for record in passage.others
        ):
            content = content_of(log, record)
            if record.opcode == Opcode.METADATA:
                found = parse(Metadata.read, content)
                writer.add_metadata(found.name, found.metadata)
            # a CRC of zero means none
            elif content[-4:] in (
                bytes(4),
                zlib.crc32(content[:-4]).to_bytes(4, "little"),
            ):
                file = parse(Attachment.read, content)
                writer.add_attachment(
                    file.create_time,
                    file.log_time,
                    file.name,
                    file.media_type,
                    file.data,
                )
            else:
                amended.notes["log.attachments"] = (
                    f"one at byte {record.at} is damaged and left out"
                )
        for name, values in metadata.items():
            self._writer.add_metadata(name, values)
        self._writer.finish()
        notes = recording.notes()
        amended.notes |= {
            name: notes[name] for name in ("log.ending", "log.damage") if name in notes
        }
        return amended

    def _recorded(self) -> Iterator[_Message]:
        """Messages of the log that are copied; those of one chunk in the order of their times."""
        for _, passage in self._passages:
            yield from self._recorded_in(passage)

    def _recorded_in(self, passage: Passage) -> Iterator[_Message]:
        # a chunk comes topic by topic, and its messages have to be merged by time
        for _, chunk in groupby(passage, key=lambda piece: id(piece.data)):
            copied = [
                (piece, channel)
                for piece in chunk
                if (channel := self._channel(piece, passage)) is not None
            ]
            if not copied:
                continue
            pieces = [piece for piece, _ in copied]
            data = pieces[0].data
            columns = zip(*(piece.found for piece in pieces), strict=True)
            at, size, time_ns = (np.concatenate(column) for column in columns)
            # messages of all topics of a chunk, to be sorted by time
            of = np.repeat(
                np.arange(len(pieces)), [len(piece.found.sizes) for piece in pieces]
            )
            for row in np.lexsort((at, time_ns)).tolist():
                begin = int(at[row])
                channel = copied[of[row]][1]
                payload = bytes(data[begin : begin + int(size[row])])
                # before each payload is the head of its record
                number, published_ns = (
                    int.from_bytes(data[begin - first : begin - end], "little")
                    for first, end in ((20, 16), (8, 0))
                )
                yield int(time_ns[row]), channel, published_ns, payload, number

    def _channel(self, piece: ChunkPart, passage: Passage) -> int | None:
        """Channel of messages in the copy; None where their topic is rewritten."""
        first_ns = int(piece.found.log_times_ns.min())
        self._beginning_ns = (
            first_ns
            if self._beginning_ns is None
            else min(first_ns, self._beginning_ns)
        )
        topic = piece.topic
        wanted = self._anew.get(topic.name)
        # two types on one topic confuse every reader
        if topic.name in self._taken or (
            wanted is not None and short_name(topic.type_name) != short_name(wanted)
        ):
            raise LogError(
                f"{self._source}: {topic.name} ({topic.type_name}) is in the log already; "
                "leave it out where the log is made"
            )
        if wanted is not None:
            self._amended.replaced[topic.name] += len(piece.found.sizes)
            return None
        channel, schema = passage.as_written[topic.name]
        return self._writer.channel(
            topic.name,
            SchemaText(schema.name, schema.encoding, schema.data),
            topic.encoding,
            channel.metadata,
        )

    def _added(self, added: Sequence[Outgoing]) -> Iterator[_Message]:
        for time_ns, entry, payload in by_time(added):
            schema = own_schema(entry.type_name)
            channel = self._writer.channel(entry.topic, schema)
            yield time_ns, channel, time_ns, payload, 0

    def _streamed(self, more: Iterable[Outgoing]) -> Iterator[_Message]:
        for entry in more:
            self._taken.add(entry.topic)
            yield from self._added([entry])
