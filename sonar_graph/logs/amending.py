"""A log written anew with more messages in it: everything that was there, byte by byte, and what was added.

The log is read as every log is (`sonar_graph.logs.mcap.reader`), so that of one that is cut off what is whole is
copied.
"""

from __future__ import annotations

import heapq
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Header, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from sonar_graph.errors import LogError
from sonar_graph.files import written_whole
from sonar_graph.logs.cdr import definition, short_name
from sonar_graph.logs.mcap import LIBRARY, ChunkPart, Keep, LogFile, Outgoing, Passage, Recording, parse, seal

_CHUNK_BYTES = 1 << 20
_Message = tuple[int, int, str, bytes, int]
"""Log time, publish time, topic, payload, sequence number."""
_Described = tuple[str, str, bytes]
"""Name, encoding and text of a schema."""


@dataclass
class Amended:
    """What became of the log that was written anew."""

    replaced: Counter[str] = field(default_factory=Counter)
    """Number of messages left out because their topic was written anew."""
    notes: dict[str, str] = field(default_factory=dict)
    """What could not be copied, by subject, as `Recording.notes` has it."""


def write_amended(
    source: Path,
    target: Path,
    added: Sequence[Outgoing],
    *,
    anew: Mapping[str, str] | None = None,
    metadata: Mapping[str, Mapping[str, str]] | None = None,
    salvage: bool = False,
) -> Amended:
    """Copy an MCAP log and add messages, all in the order of their log times; only chunks are held in memory.

    Parameters
    ----------
    source
        The log; metadata and attachments are copied too. Of one that is cut off, what is whole is copied.
    target
        Another file; one that exists is replaced when the new one is complete.
    added
        On topics that the log does not have, or that are written anew.
    anew
        Types by topics: what the log has on these is left out.
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
    with LogFile(source) as log, written_whole(target) as out:
        return _AmendedCopy(log, out, anew or {}, {entry.topic for entry in added}).run(added, metadata or {}, salvage)


class _AmendedCopy:
    """One log on its way into another file."""

    def __init__(self, log: LogFile, out: BinaryIO, anew: Mapping[str, str], added: Set[str]) -> None:
        self._log, self._anew, self._taken = log, anew, added - anew.keys()
        self._passage = Passage(log, lambda _: Keep.ALL, may_skip=False)
        self._writer = Writer(out, chunk_size=_CHUNK_BYTES, enable_data_crcs=True)
        self._schemas: dict[_Described, int] = {("", "", b""): 0}
        self._channels: dict[str, int] = {}
        self._amended = Amended()
        self._beginning_ns: int | None = None

    def run(self, added: Sequence[Outgoing], metadata: Mapping[str, Mapping[str, str]], salvage: bool) -> Amended:
        writer, passage = self._writer, self._passage
        writer.start(profile=_profile(self._log.path), library=LIBRARY)
        both = heapq.merge(self._of_log(), self._of_entries(added), key=lambda message: message[0])
        for log_time, publish_time, topic, payload, number in both:
            writer.add_message(self._channels[topic], log_time, payload, publish_time, number)
        recording = Recording(self._log.path, damage=passage.damage, beginning_ns=self._beginning_ns)
        if not salvage:
            recording.require_sound()
        self._copy_others()
        for name, record in metadata.items():
            writer.add_metadata(name, seal(record))
        writer.finish()  # type: ignore[no-untyped-call]  # of the mcap package
        notes = recording.notes()
        self._amended.notes |= {name: notes[name] for name in ("log.ending", "log.damage") if name in notes}
        return self._amended

    def _of_log(self) -> Iterator[_Message]:
        """All messages; those of one chunk in the order of their times."""
        for _, pieces in groupby(self._passage, key=lambda piece: id(piece.data)):
            yield from _sorted([piece for piece in pieces if self._is_copied(piece)])

    def _note_time(self, piece: ChunkPart) -> None:
        first_ns = int(piece.found.log_times_ns.min())
        self._beginning_ns = first_ns if self._beginning_ns is None else min(first_ns, self._beginning_ns)

    def _is_copied(self, piece: ChunkPart) -> bool:
        self._note_time(piece)
        topic = piece.topic
        wanted = self._anew.get(topic.name)
        if topic.name in self._taken or (wanted is not None and short_name(topic.type_name) != short_name(wanted)):
            raise LogError(
                f"{self._log.path}: {topic.name} ({topic.type_name}) is in the log already; "
                "leave it out where the log is made"
            )
        if wanted is not None:
            self._amended.replaced[topic.name] += len(piece.found.sizes)
            return False
        channel, schema = self._passage.as_written(topic.name)
        self._offer(topic.name, (schema.name, schema.encoding, schema.data), topic.encoding, channel.metadata)
        return True

    def _of_entries(self, added: Sequence[Outgoing]) -> Iterator[_Message]:
        rows = sorted(
            (at_ns, of, row) for of, entry in enumerate(added) for row, at_ns in enumerate(entry.log_times_ns.tolist())
        )
        for time_ns, of, row in rows:
            entry = added[of]
            text = definition(entry.type_name).encode()
            self._offer(entry.topic, (entry.type_name, "ros2msg", text), "cdr", {})
            yield time_ns, time_ns, entry.topic, entry.payloads[row].tobytes(), 0

    def _offer(self, topic: str, schema: _Described, encoding: str, metadata: Mapping[str, str]) -> None:
        """Make a topic known, once."""
        if topic in self._channels:
            return
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(*schema)
        self._channels[topic] = self._writer.register_channel(topic, encoding, self._schemas[schema], dict(metadata))

    def _copy_others(self) -> None:
        """Metadata and attachments."""
        for record in self._passage.others:
            content = self._log.content(record)
            if record.opcode == Opcode.METADATA:
                found = parse(Metadata.read, content)
                self._writer.add_metadata(found.name, found.metadata)
                continue
            if content[-4:] not in (bytes(4), zlib.crc32(content[:-4]).to_bytes(4, "little")):
                self._amended.notes["log.attachments"] = f"one at byte {record.at} is damaged and left out"
                continue
            file = parse(Attachment.read, content)
            self._writer.add_attachment(file.create_time, file.log_time, file.name, file.media_type, file.data)


def _sorted(pieces: Sequence[ChunkPart]) -> Iterator[_Message]:
    """Messages of one stretch of bytes in the order of their times; before each payload is the head of its record."""
    if not pieces:
        return
    data = pieces[0].data
    at, size, time_ns = (np.concatenate(column) for column in zip(*(piece.found for piece in pieces), strict=True))
    of = np.repeat(np.arange(len(pieces)), [len(piece.found.sizes) for piece in pieces])
    for row in np.lexsort((at, time_ns)).tolist():
        begin = int(at[row])
        number, published_ns = (int.from_bytes(data[begin - a : begin - b], "little") for a, b in ((20, 16), (8, 0)))
        payload = bytes(data[begin : begin + int(size[row])])
        yield int(time_ns[row]), published_ns, pieces[of[row]].topic.name, payload, number


def _profile(path: Path) -> str:
    """What the head of a log says about its conventions; empty where it cannot be read."""
    with path.open("rb") as stream:
        try:
            head = next(iter(StreamReader(stream).records), None)
        except McapError:
            return ""
    return head.profile if isinstance(head, Header) else ""
