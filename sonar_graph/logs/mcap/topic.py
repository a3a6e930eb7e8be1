"""The messages of one topic: payload bytes gathered from chunks, decoded on request.

What is lost of a log: where, when, of which topics, and why.

What a file says about its channels, in several places that should agree.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from sonar_graph.errors import LogError
from sonar_graph.logs.cdr import Bytes, Decoded, Decoder, Messages, Struct, parse_definition
from sonar_graph.logs.mcap.file_summary import FileSummary, parse
from sonar_graph.measurements import Ints

STAMP_BYTES = 12
"""Encapsulation header, seconds and nanoseconds: where a message with a header has its stamp."""


class Keep(Enum):
    """How much of a topic's messages to keep while going through a file."""

    NONE = 0
    """Nothing but their number; chunks in which no other topic lies are not even unpacked."""
    STAMP = STAMP_BYTES
    """The beginning of each payload, enough for its header's stamp."""
    ALL = -1


@dataclass
class Topic:
    """The messages of one topic."""

    file: Path
    name: str
    type_name: str
    """Such as ``sensor_msgs/msg/Imu``."""
    encoding: str
    """Of the messages: ``cdr``, ``protobuf``, ``json``, ..."""
    schema_encoding: str
    """``ros2msg``, ``ros2idl``, ``protobuf``, ..."""
    schema_text: str
    keep: Keep
    is_latched: bool = False
    """Its messages hold until they are replaced, as those of ``/tf_static`` do."""
    times: list[Ints] = field(default_factory=list)
    """Log times by chunk."""
    stacks: dict[int, list[tuple[Ints, Bytes]]] = field(default_factory=lambda: defaultdict(list))
    """Row numbers and payload bytes by number of bytes."""
    unsound: dict[str, int] = field(default_factory=dict)
    """Number of messages that are not what their definition says, by fault; known once they were decoded."""
    held_bytes: int = 0
    """Memory that the payloads take."""
    _count: int = 0
    _decoders: list[Decoder] = field(default_factory=list, repr=False)
    """At most one, made when it is needed, and shared by all pieces of a topic: it remembers layouts."""

    def __len__(self) -> int:
        return self._count

    @property
    def is_ros2(self) -> bool:
        """Whether its messages are CDR with a ``ros2msg`` definition."""
        return self.encoding == "cdr" and self.schema_encoding == "ros2msg"

    @property
    def log_times_ns(self) -> Ints:
        """When each message was recorded, shape (n,)."""
        self.times = [np.concatenate(self.times)] if self.times else [np.empty(0, np.int64)]
        return self.times[0]

    def definition(self) -> Struct:
        """The type of its messages.

        Raises
        ------
        LogError
            Naming file, topic and what is wrong in the definition.
        """
        with self._blaming():
            return parse_definition(self.type_name, self.schema_text)

    def messages(self) -> list[Messages]:
        """All sound messages, grouped by layout; the others are counted in `unsound` and no longer among the topic's.

        Raises
        ------
        LogError
            Naming file, topic and what is wrong in the definition.
        """
        if not self._decoders:
            self._decoders.append(Decoder(self.definition()))
        for parts in self.stacks.values():
            if len(parts) > 1:  # in place: the parts would take the same memory again
                parts[:] = [(np.concatenate([r for r, _ in parts]), np.concatenate([b for _, b in parts]))]
        decoded = self._decoders[0].decode(part for parts in self.stacks.values() for part in parts)
        return self._without(decoded) if decoded.unsound else decoded.groups

    def _without(self, decoded: Decoded) -> list[Messages]:
        """Forget unsound messages, so that rows count sound ones only."""
        is_sound = np.ones(len(self), bool)
        for fault, rows in decoded.unsound.items():
            is_sound[rows] = False
            self.unsound[fault] = self.unsound.get(fault, 0) + len(rows)
        number = np.cumsum(is_sound) - 1
        groups = [Messages(number[group.rows], group.payloads, group.layout) for group in decoded.groups]
        self.times, self._count = [self.log_times_ns[is_sound]], int(np.count_nonzero(is_sound))
        self.stacks.clear()
        for group in groups:
            self.stacks[group.payloads.shape[1]].append((group.rows, group.payloads))
        return groups

    @contextmanager
    def _blaming(self) -> Iterator[None]:
        try:
            yield
        except LogError as error:
            raise LogError(f"{self.file}: topic {self.name} ({self.type_name}): {error}") from error

    def gather(self, data: bytes | memoryview, offsets: Ints, sizes: Ints, log_times_ns: Ints) -> None:
        """Take in the messages that lie at the offsets of a chunk's bytes."""
        first = self._count
        self._count += len(sizes)
        if self.keep is Keep.NONE:
            return
        kept = sizes if self.keep is Keep.ALL else np.minimum(sizes, self.keep.value)
        self.times.append(log_times_ns)
        self.held_bytes += int(kept.sum())
        smallest, largest = int(kept.min(initial=1 << 62)), int(kept.max(initial=0))
        for size in [largest] if smallest == largest else np.unique(kept).tolist():
            rows = np.flatnonzero(kept == size)
            if not size:
                self.stacks[size].append((first + rows, np.empty((len(rows), 0), np.uint8)))
                continue
            windows = np.ndarray((len(data) - size + 1,), f"V{size}", data, strides=(1,))
            self.stacks[size].append((first + rows, windows[offsets[rows]].view(np.uint8).reshape(-1, size)))

    def empty(self) -> Topic:
        """The same topic without messages."""
        return replace(self, times=[], stacks=defaultdict(list), unsound={}, held_bytes=0, _count=0)


_NS_PER_S = 1_000_000_000
_TOPICS_NAMED = 6


@dataclass
class Loss:
    """A stretch of a file that could not be read."""

    at: int
    """Offset of its first byte."""
    end: int
    """Offset after its last byte."""
    reason: str
    start_ns: int | None = None
    """Log time from which on messages may be missing; None: not known."""
    end_ns: int | None = None
    """Log time until which messages may be missing."""
    messages: dict[str, int] | None = None
    """How many, by topic; None: not known."""
    is_estimate: bool = False
    """The numbers follow from the topics' rates."""

    def describe(self, beginning_ns: int | None) -> str:
        """In words, with times in seconds after the log's beginning."""
        text = f"bytes {self.at} to {self.end}: {self.reason}"
        if self.start_ns is not None and self.end_ns is not None and beginning_ns is not None:
            start_s, end_s = ((ns - beginning_ns) / _NS_PER_S for ns in (self.start_ns, self.end_ns))
            text += f"; {start_s:.3f} s to {end_s:.3f} s of the log"
        if self.messages:
            about = "about " if self.is_estimate else ""
            parts = [f"{about}{count} of {name}" for name, count in sorted(self.messages.items())]
            more = f" and of {len(parts) - _TOPICS_NAMED} more topics" if len(parts) > _TOPICS_NAMED else ""
            text += f"; lost: {', '.join(parts[:_TOPICS_NAMED])}{more}"
        elif self.messages is not None:
            text += "; no messages lost"
        return text


@dataclass
class Damage:
    """What is wrong with a file."""

    losses: list[Loss] = field(default_factory=list)
    """Stretches in its middle that are lost."""
    ending: Loss | None = None
    """What is missing at the end of a file that was cut off."""
    remarks: list[str] = field(default_factory=list)
    """What is wrong but cost no messages."""
    unprotected: list[str] = field(default_factory=list)
    """What was read without a CRC over it."""


def settle(damage: Damage, topics: Mapping[str, Topic], counts: Mapping[str, int] | None) -> None:
    """Find out how much is lost where nothing in the loss itself tells.

    Parameters
    ----------
    damage
        Of a file.
    topics
        What was read.
    counts
        How many messages each topic has by the file's own statistics; None: not known.
    """
    missing = _missing(damage.losses, topics, counts) if counts is not None else None
    unknown = [loss for loss in damage.losses if loss.messages is None]
    if missing and not unknown:
        whole = Loss(0, 0, "fewer messages than the file's statistics count", messages=missing)
        damage.losses.append(whole)
    for loss in unknown:
        loss.is_estimate = missing is None or len(unknown) > 1
        loss.messages = _by_rate(loss, topics) if missing is None or (missing and len(unknown) > 1) else missing


def _missing(losses: list[Loss], topics: Mapping[str, Topic], counts: Mapping[str, int]) -> dict[str, int]:
    known = {name: sum((loss.messages or {}).get(name, 0) for loss in losses) for name in counts}
    found = {name: len(topics[name]) if name in topics else 0 for name in counts}
    missing = {name: counts[name] - found[name] - known[name] for name in counts}
    return {name: count for name, count in missing.items() if count > 0}


def _by_rate(loss: Loss, topics: Mapping[str, Topic]) -> dict[str, int] | None:
    if loss.start_ns is None or loss.end_ns is None:
        return None
    lost = {}
    for name, topic in topics.items():
        times_ns = topic.log_times_ns
        before, after = times_ns[times_ns <= loss.start_ns], times_ns[times_ns >= loss.end_ns]
        if len(before) < 2 or not len(after):
            continue
        step_ns = float(np.median(np.diff(before[-100:])))
        count = round((after.min() - before.max()) / step_ns) - 1 if step_ns > 0 else 0
        if count > 0:
            lost[name] = count
    return lost or None


_NO_SCHEMA = Schema(id=0, name="", encoding="", data=b"")
_TRANSIENT_LOCAL = re.compile(r"durability:\s*(1\b|transient_local)")


class Descriptions:
    """Schemas and channels by their numbers.

    The first description of a number holds, but one under a CRC goes before one without. Those of the summary come
    first, so that they stand in for any that are lost in the data.
    """

    def __init__(self, path: Path, keep: Callable[[str], Keep]) -> None:
        self._path = path
        self._keep = keep
        self._schemas: dict[int, tuple[Schema, bool]] = {}
        self._channels: dict[int, tuple[Channel, bool]] = {}
        self.by_channel: dict[int, Topic] = {}
        self.by_name: dict[str, Topic] = {}
        self.as_written: dict[str, tuple[Channel, Schema]] = {}
        """Each topic's channel and schema, byte by byte."""
        self.remarks: list[str] = []

    def add_summary(self, summary: FileSummary) -> None:
        """Take in the summary's copies."""
        for schema in summary.schemas:
            self._add_schema(schema, is_covered=summary.has_crc)
        for channel in summary.channels:
            self._add_channel(channel, is_covered=summary.has_crc)

    def add(self, opcode: int, content: bytes, *, is_covered: bool) -> None:
        """Take in a record; ``is_covered``: a CRC fits it.

        Raises
        ------
        LogError
            When it is not what its kind says.
        """
        if opcode == Opcode.SCHEMA:
            self._add_schema(parse(Schema.read, content), is_covered=is_covered)
        elif opcode == Opcode.CHANNEL:
            self._add_channel(parse(Channel.read, content), is_covered=is_covered)

    def _add_schema(self, schema: Schema, *, is_covered: bool) -> None:
        known, was_covered = self._schemas.get(schema.id, (None, False))
        if known is None or (known != schema and is_covered and not was_covered):
            self._schemas[schema.id] = schema, is_covered
        if known is not None and known != schema:
            self._disagree(f"schema {schema.id} ({known.name})", is_covered=is_covered or was_covered)

    def _add_channel(self, channel: Channel, *, is_covered: bool) -> None:
        known, was_covered = self._channels.get(channel.id, (None, False))
        if known is None or (known != channel and is_covered and not was_covered):
            self._channels[channel.id] = channel, is_covered
            self.by_channel[channel.id] = self._topic(channel)
        if known is not None and known != channel:
            self._disagree(f"channel {channel.id} ({known.topic})", is_covered=is_covered or was_covered)

    def _disagree(self, what: str, *, is_covered: bool) -> None:
        held = "the one under a CRC holds" if is_covered else "the first holds"
        remark = f"{what} is described in two ways; {held}"
        if remark not in self.remarks:
            self.remarks.append(remark)

    def _topic(self, channel: Channel) -> Topic:
        schema, _ = self._schemas.get(channel.schema_id, (_NO_SCHEMA, True))
        offered = channel.metadata.get("offered_qos_profiles", "")
        topic = Topic(
            file=self._path,
            name=channel.topic,
            type_name=schema.name,
            encoding=channel.message_encoding,
            schema_encoding=schema.encoding,
            schema_text=schema.data.decode("utf-8", "replace"),
            keep=self._keep(schema.name),
            is_latched=channel.topic.endswith("_static") or bool(_TRANSIENT_LOCAL.search(offered)),
        )
        self.as_written.setdefault(channel.topic, (channel, schema))
        return self.by_name.setdefault(channel.topic, topic)
