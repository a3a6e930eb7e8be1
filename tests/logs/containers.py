"""Small MCAP files to be read and damaged, written by mcap's own writer."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.writer import Writer

from sonar_graph.logs.mcap.file_summary import TimeWindow
from sonar_graph.logs.mcap.reader import Recording, scan
from sonar_graph.logs.mcap.topic import Keep, Topic

TEXT = b"uint8[] data\n"
Entry = tuple[int, bytes]


@contextmanager
def writing(path: Path, **settings: Any) -> Iterator[Writer]:
    """A started file of mcap's own writer, finished at the end."""
    with path.open("wb") as stream:
        writer = Writer(stream, **settings)
        writer.start("ros2", "test")
        yield writer
        writer.finish()


def channel_for(writer: Writer, topic: str, kind: str = "test_msgs/msg/Bytes", text: bytes = TEXT) -> int:
    return writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text))


def write(path: Path, count: int = 400, *, chunk_size: int = 4096, **settings: Any) -> list[Entry]:
    """Messages of three lengths on /bytes, 1 ns apart, between others in JSON; what was written on /bytes."""
    rng = np.random.default_rng(0)
    written = [(1000 + i, rng.bytes([20, 50, 80][i % 3])) for i in range(count)]
    with writing(path, chunk_size=chunk_size, **settings) as writer:
        schema = writer.register_schema("test_msgs/msg/Bytes", "ros2msg", TEXT)
        other = writer.register_schema("Some", "jsonschema", b"{}")
        channel = writer.register_channel("/bytes", "cdr", schema)
        silent = writer.register_channel("/json", "json", other)
        writer.register_channel("/never", "cdr", schema)
        writer.add_metadata("sonar_graph", {"name": "x"})
        for time_ns, payload in written:
            writer.add_message(channel, time_ns, payload, time_ns)
            writer.add_message(silent, time_ns, b'{"a": 1}', time_ns)
    return written


def write_apart(path: Path, count: int = 100) -> None:
    """/a and /b in chunks of their own, by turns, a second apart from second 1 on; /tf_static is in the first chunk."""
    with writing(path) as writer:
        kinds = {"/a": "A", "/b": "B", "/tf_static": "Static"}
        channels = [channel_for(writer, name, f"test_msgs/msg/{kind}") for name, kind in kinds.items()]
        writer.add_message(channels[2], 10**9, b"static", 10**9)
        for i in range(count):
            writer.add_message(channels[i % 2], (1 + i) * 10**9, bytes([i]), 10**9)
            writer.flush()


def entries(topic: Topic) -> list[Entry]:
    """Log times and payloads, in order."""
    stacks = [part for stack in topic.stacks.values() for part in stack]
    payloads = {row: p.tobytes() for rows, ps in stacks for row, p in zip(rows, ps, strict=True)}
    return [(int(time), payloads[row]) for row, time in enumerate(topic.log_times_ns)]


def scan_all(path: Path, window: TimeWindow | None = None) -> Recording:
    return scan(path, lambda _: Keep.ALL, window)


def read(path: Path) -> list[Entry]:
    """Messages on /bytes."""
    topics = scan_all(path).topics
    return entries(topics["/bytes"]) if "/bytes" in topics else []


def chunk_indexes(path: Path) -> list[ChunkIndex]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def flip(path: Path, at: int, bit: int = 4) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= bit
    path.write_bytes(content)
