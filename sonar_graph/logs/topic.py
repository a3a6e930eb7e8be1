"""The messages of one topic: payload bytes gathered from chunks, decoded on request."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.logs.cdr import Decoded, Decoder, Messages
from sonar_graph.logs.layout import Bytes
from sonar_graph.logs.schema import Struct, parse_definition
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
