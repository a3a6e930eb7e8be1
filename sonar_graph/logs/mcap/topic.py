"""Topics of a log: payloads gathered from chunks and decoded on request, and the account of what is damaged or lost.

A topic is described by a channel and a schema, which a file states in several places; `Descriptions` compares them.
A `Loss` states the bytes, the times and the number of messages that are lost; `settle` counts them by the statistics of
the file.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from sonar_graph.errors import LogError
from sonar_graph.logs.cdr import (
    Bytes,
    Decoder,
    Messages,
    Struct,
    parse_definition,
    short_name,
)
from sonar_graph.logs.mcap.chunks import unpack_messages
from sonar_graph.measurements import Ints

STAMP_BYTES = 12
"""Bytes up to the end of a header's stamp: encapsulation header, seconds and nanoseconds."""


class Keep(Enum):
    """Part of each message to keep while a file is read."""

    NONE = 0
    """Only their number; chunks without another topic are not even decompressed."""
    STAMP = STAMP_BYTES
    """The beginning of each payload, up to the stamp in its header."""
    ALL = -1


Keeping = Callable[[str], Keep]
"""Part of a message to keep, by the name of its type."""


def keeping(types: Iterable[str], others: Keep = Keep.NONE) -> Keeping:
    """Choice of the whole messages of some types, and of a part of those of others, by the name of the type."""
    wanted = set(map(short_name, types))
    return lambda kind: Keep.ALL if short_name(kind) in wanted else others


@dataclass
class Topic:
    """Messages of one topic."""

    file: Path
    name: str
    type_name: str
    """Such as ``sensor_msgs/msg/Imu``."""
    encoding: str
    """Encoding of the messages: ``cdr``, ``protobuf``, ``json``, ..."""
    schema_encoding: str
    """``ros2msg``, ``ros2idl``, ``protobuf``, ..."""
    schema_text: str
    keep: Keep
    is_latched: bool = False
    """True where messages hold until they are replaced, as those of ``/tf_static`` do."""
    times: list[Ints] = field(default_factory=list)
    """Log times by chunk."""
    stacks: dict[int, list[tuple[Ints, Bytes]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    """Row numbers and payload bytes by number of bytes."""
    unsound: dict[str, int] = field(default_factory=dict)
    """Number of messages that do not follow their definition, by fault; known after decoding."""
    held_bytes: int = 0
    """Memory of the payloads, bytes."""
    _count: int = 0
    _decoders: list[Decoder] = field(default_factory=list, repr=False)
    """At most one decoder, made when needed and shared by all pieces of a topic: it remembers layouts."""

    def __len__(self) -> int:
        return self._count

    def is_a(self, type_name: str) -> bool:
        """True for a topic of a type, with or without the ``msg``."""
        return short_name(self.type_name) == short_name(type_name)

    @property
    def is_ros2(self) -> bool:
        """True where messages are CDR with a ``ros2msg`` definition."""
        return self.encoding == "cdr" and self.schema_encoding == "ros2msg"

    @property
    def log_times_ns(self) -> Ints:
        """Time of recording of each message, shape (n,)."""
        self.times = (
            [np.concatenate(self.times)] if self.times else [np.empty(0, np.int64)]
        )
        return self.times[0]

    def definition(self) -> Struct:
        """Type of the messages; a LogError names file, topic and what is wrong in the definition."""
        try:
            return parse_definition(self.type_name, self.schema_text)
        except LogError as error:
            raise LogError(
                f"{self.file}: topic {self.name} ({self.type_name}): {error}"
            ) from error

    def error(self, fault: str) -> LogError:
        """Error about the messages, naming file and topic."""
        return LogError(f"{self.file}: topic {self.name}: {fault}")

    def messages(self) -> list[Messages]:
        """All sound messages, grouped by layout. The others are counted in `unsound` and removed from the topic."""
        if not self._decoders:
            self._decoders.append(Decoder(self.definition()))
        for parts in self.stacks.values():
            if len(parts) > 1:  # in place: the parts would take the same memory again
                parts[:] = [
                    (
                        np.concatenate([r for r, _ in parts]),
                        np.concatenate([b for _, b in parts]),
                    )
                ]
        decoded = self._decoders[0].decode(
            part for parts in self.stacks.values() for part in parts
        )
        if not decoded.unsound:
            return decoded.groups
        # a message that breaks its definition would shift the rows of all after it
        is_sound = np.ones(len(self), bool)
        for fault, rows in decoded.unsound.items():
            is_sound[rows] = False
            self.unsound[fault] = self.unsound.get(fault, 0) + len(rows)
        number = self._keep_rows(is_sound)
        return [
            Messages(number[group.rows], group.payloads, group.layout)
            for group in decoded.groups
        ]

    def gather(
        self, data: bytes | memoryview, offsets: Ints, sizes: Ints, log_times_ns: Ints
    ) -> None:
        """Add the messages at some offsets of a chunk's bytes."""
        if len(offsets) and self.encoding == "cdr":
            data, offsets, sizes = unpack_messages(data, offsets, sizes)
        first = self._count
        self._count += len(sizes)
        if self.keep is Keep.NONE:
            return
        # payloads of one size are one block, which decodes without a copy
        kept = sizes if self.keep is Keep.ALL else np.minimum(sizes, self.keep.value)
        self.times.append(log_times_ns)
        self.held_bytes += int(kept.sum())
        smallest = int(kept.min(initial=1 << 62))
        largest = int(kept.max(initial=0))
        for size in [largest] if smallest == largest else np.unique(kept).tolist():
            rows = np.flatnonzero(kept == size)
            if not size:
                self.stacks[size].append(
                    (first + rows, np.empty((len(rows), 0), np.uint8))
                )
                continue
            # one gather of whole payloads instead of a copy of each
            windows = np.ndarray(
                (len(data) - size + 1,), f"V{size}", data, strides=(1,)
            )
            self.stacks[size].append(
                (first + rows, windows[offsets[rows]].view(np.uint8).reshape(-1, size))
            )

    def leave_out(self, log_times_ns: Ints) -> None:
        """Remove the messages that were recorded at some times."""
        self._keep_rows(~np.isin(self.log_times_ns, log_times_ns))

    def _keep_rows(self, is_kept: NDArray[np.bool_]) -> Ints:
        """Remove the other messages; the new row of each message that stays, shape (n,)."""
        # rows count only the messages that stay
        number = np.cumsum(is_kept) - 1
        for size, parts in self.stacks.items():
            self.stacks[size] = [
                (number[rows[is_kept[rows]]], payloads[is_kept[rows]])
                for rows, payloads in parts
            ]
        self.times = [self.log_times_ns[is_kept]]
        self._count = int(np.count_nonzero(is_kept))
        return number

    def extend(self, later: Topic) -> None:
        """Add the messages of the same topic in the next file of a log; a LogError where it has another type."""
        # rows of two definitions cannot be decoded together
        if (self.type_name, self.encoding, self.schema_text) != (
            later.type_name,
            later.encoding,
            later.schema_text,
        ):
            raise later.error(
                f"is a {later.type_name} defined otherwise than in the files before"
            )
        for size, parts in later.stacks.items():
            self.stacks[size] += [
                (rows + self._count, payloads) for rows, payloads in parts
            ]
        self.times += later.times
        self._count += later._count
        self.held_bytes += later.held_bytes

    def empty(self) -> Topic:
        """The same topic without messages."""
        return replace(
            self, times=[], stacks=defaultdict(list), unsound={}, held_bytes=0, _count=0
        )


_NS_PER_S = 1_000_000_000
_TOPICS_NAMED = 6


@dataclass
class Loss:
    """Bytes of a file that could not be read."""

    at: int
    """Offset of its first byte."""
    end: int
    """Offset after its last byte."""
    reason: str
    start_ns: int | None = None
    """Log time after which messages may be missing; None: not known."""
    end_ns: int | None = None
    """Log time until which messages may be missing."""
    messages: dict[str, int] | None = None
    """Number of lost messages by topic; None: not known."""
    file: str = ""
    """Name of the file, where a log has several."""

    def describe(self, beginning_ns: int | None) -> str:
        """Text with times in seconds after the log's beginning."""
        text = (
            f"bytes {self.at} to {self.end}: {self.reason}" if self.end else self.reason
        )
        text = f"{self.file}: {text}" if self.file else text
        if (
            self.start_ns is not None
            and self.end_ns is not None
            and beginning_ns is not None
        ):
            start_s, end_s = (
                (ns - beginning_ns) / _NS_PER_S for ns in (self.start_ns, self.end_ns)
            )
            text += f"; {start_s:.3f} s to {end_s:.3f} s of the log"
        if self.messages:
            parts = [
                f"{count} of {name}" for name, count in sorted(self.messages.items())
            ]
            more = (
                f" and of {len(parts) - _TOPICS_NAMED} more topics"
                if len(parts) > _TOPICS_NAMED
                else ""
            )
            text += f"; lost: {', '.join(parts[:_TOPICS_NAMED])}{more}"
        elif self.messages is not None:
            text += "; no messages lost"
        return text


@dataclass
class Damage:
    """Account of the damage of a file."""

    losses: list[Loss] = field(default_factory=list)
    """Losses in the middle of the file."""
    ending: Loss | None = None
    """Loss at the end of a file that was cut off."""
    remarks: list[str] = field(default_factory=list)
    """Faults that cost no messages."""
    unprotected: list[str] = field(default_factory=list)
    """Parts that were read without a CRC over them."""

    def extend(self, later: Damage, file: str) -> None:
        """Add the damage of the next file of a log: the end of any but the last is a loss in the middle."""
        # another file follows, so this end is in the middle of the log
        if self.ending is not None:
            self.losses.append(self.ending)
        for loss in (*later.losses, later.ending):
            if loss is not None:
                loss.file = file
        self.losses += later.losses
        self.ending = later.ending
        place = f"{file}: " if file else ""
        self.remarks += [place + remark for remark in later.remarks]
        self.unprotected += [place + part for part in later.unprotected]


def settle(
    damage: Damage, topics: Mapping[str, Topic], counts: Mapping[str, int] | None
) -> None:
    """Find the number of lost messages by the file's statistics, where the losses themselves do not have it.

    These are the counted messages without those read and those in losses of known number. ``counts`` are the messages
    of each topic by the statistics; None: not known.
    """
    if counts is None:
        return
    missing = {}
    for name, count in counts.items():
        found = len(topics[name]) if name in topics else 0
        known = sum((loss.messages or {}).get(name, 0) for loss in damage.losses)
        if count > found + known:
            missing[name] = count - found - known
    unknown = [loss for loss in damage.losses if loss.messages is None]
    # the statistics do not state which of several losses had which messages
    if missing and len(unknown) != 1:
        reason = "fewer messages than the file's statistics count"
        damage.losses.append(Loss(0, 0, reason, messages=missing))
        return
    for loss in unknown:
        loss.messages = missing


_TRANSIENT_LOCAL = re.compile(r"durability:\s*(1\b|transient_local)")


class Descriptions:
    """Schemas and channels by their numbers; the first description of a number counts."""

    def __init__(self, path: Path, keep: Keeping) -> None:
        self._path = path
        self._keep = keep
        self._schemas: dict[int, Schema] = {0: Schema(0, b"", "", "")}
        self._channels: dict[int, Channel] = {}
        self.by_channel: dict[int, Topic] = {}
        self.by_name: dict[str, Topic] = {}
        self.as_written: dict[str, tuple[Channel, Schema]] = {}
        """Channel and schema of each topic, byte by byte."""
        self.remarks: dict[str, None] = {}
        """Texts in their order."""

    def add(self, record: Schema | Channel) -> None:
        """Add a description; one that differs from an earlier one of the same number is remarked upon."""
        if isinstance(record, Schema):
            first = self._schemas.setdefault(record.id, record)
            if first != record:
                self._remark(f"schema {record.id} ({first.name})")
            return
        known = self._channels.setdefault(record.id, record)
        if known is record:
            self._add_topic(record)
        elif known != record:
            self._remark(f"channel {record.id} ({known.topic})")

    def _remark(self, what: str) -> None:
        self.remarks[f"{what} is described in two ways; the first holds"] = None

    def _add_topic(self, channel: Channel) -> None:
        schema = self._schemas.get(channel.schema_id, self._schemas[0])
        offered = channel.metadata.get("offered_qos_profiles", "")
        topic = Topic(
            file=self._path,
            name=channel.topic,
            type_name=schema.name,
            encoding=channel.message_encoding,
            schema_encoding=schema.encoding,
            schema_text=schema.data.decode("utf-8", "replace"),
            keep=self._keep(schema.name),
            is_latched=channel.topic.endswith("_static")
            or bool(_TRANSIENT_LOCAL.search(offered)),
        )
        # two channels of one topic are the same topic, as two publishers make them
        self.as_written.setdefault(channel.topic, (channel, schema))
        self.by_channel[channel.id] = self.by_name.setdefault(channel.topic, topic)
