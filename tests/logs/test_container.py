from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from sonar_graph.errors import LogError
from sonar_graph.logs.container import Keep, scan

TEXT = b"uint8[] data\n"


def write(path: Path, count: int = 400, **settings: object) -> list[tuple[int, bytes]]:
    """A log of messages of three lengths on one topic, between others in JSON; returns times and payloads."""
    rng = np.random.default_rng(0)
    written = []
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=4096, **settings)  # type: ignore[arg-type]
        writer.start("ros2", "test")
        schema = writer.register_schema("test_msgs/msg/Bytes", "ros2msg", TEXT)
        other = writer.register_schema("Some", "jsonschema", b"{}")
        channel = writer.register_channel("/bytes", "cdr", schema)
        silent = writer.register_channel("/json", "json", other)
        writer.register_channel("/never", "cdr", schema)
        writer.add_metadata("sonar_graph", {"name": "x"})
        for i in range(count):
            payload = rng.bytes([20, 50, 80][i % 3])
            written.append((1000 + i, payload))
            writer.add_message(channel, 1000 + i, payload, 1000 + i)
            writer.add_message(silent, 1000 + i, b'{"a": 1}', 1000 + i)
        writer.finish()
    return written


def read(path: Path) -> list[tuple[int, bytes]]:
    topic = scan(path, lambda _: Keep.ALL).topics["/bytes"]
    stacks = [part for stack in topic.stacks.values() for part in stack]
    payloads = {row: p.tobytes() for rows, ps in stacks for row, p in zip(rows, ps, strict=True)}
    return [(int(time), payloads[row]) for row, time in enumerate(topic.log_times_ns)]


@pytest.mark.parametrize(
    "settings",
    [
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False},
    ],
    ids=["zstd", "lz4", "none", "unchunked", "no-index", "no-summary"],
)
def test_every_message_is_found_whatever_the_container(tmp_path: Path, settings: dict[str, object]) -> None:
    path = tmp_path / "log.mcap"
    written = write(path, **settings)
    assert read(path) == written
    recording = scan(path, lambda _: Keep.STAMP)
    assert list(recording.topics) == ["/bytes", "/json"]
    assert recording.metadata == {"sonar_graph": {"name": "x"}}
    assert recording.ending is None
    assert recording.corrupt == []


def test_only_the_beginning_is_kept_where_only_the_stamp_is_wanted(tmp_path: Path) -> None:
    written = write(tmp_path / "log.mcap")
    topic = scan(tmp_path / "log.mcap", lambda _: Keep.STAMP).topics["/bytes"]
    assert len(topic) == len(written)
    assert list(topic.stacks) == [12]


@pytest.mark.parametrize("kept", [0.3, 0.6, 0.8])
def test_a_file_cut_off_gives_what_is_whole_and_says_so(tmp_path: Path, kept: float) -> None:
    path = tmp_path / "log.mcap"
    written = write(path)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * kept)])
    found = read(path)
    assert 0 < len(found) < len(written)
    assert found == written[: len(found)]
    recording = scan(path, lambda _: Keep.ALL)
    assert recording.ending is not None
    assert "cut off" in recording.ending
    recording.require_sound()


def test_a_writer_killed_between_records_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write(path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    last = summary.chunk_indexes[-1]
    path.write_bytes(path.read_bytes()[: last.chunk_start_offset + last.chunk_length])
    assert scan(path, lambda _: Keep.ALL).ending is not None


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.NONE])
def test_a_flipped_bit_loses_its_chunk_and_is_never_read_as_data(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "log.mcap"
    written = write(path, compression=compression)
    content = bytearray(path.read_bytes())
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[1]
    content[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 4
    path.write_bytes(content)
    found = read(path)
    assert set(found) < set(written)
    recording = scan(path, lambda _: Keep.ALL)
    with pytest.raises(LogError, match=r"damaged: bytes \d+ to \d+: chunk 2 is lost.*lost: 35 of /bytes, 35 of /json.*--salvage"):
        recording.require_sound()


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"#ROSBAG V2.0\n", "a ROS 1 bag"),
        (b"SQLite format 3\0", "sqlite3"),
        (b"", "something else"),
        (b"{}", "something else"),
    ],
)
def test_other_files_are_named_for_what_they_are(tmp_path: Path, content: bytes, kind: str) -> None:
    path = tmp_path / "log.bag"
    path.write_bytes(content)
    with pytest.raises(LogError, match=rf"not an MCAP file but .*{kind}.*rosbags-convert"):
        scan(path, lambda _: Keep.ALL)


def test_folders_and_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="is a folder"):
        scan(tmp_path, lambda _: Keep.ALL)
    with pytest.raises(LogError, match="No such file"):
        scan(tmp_path / "none.mcap", lambda _: Keep.ALL)
