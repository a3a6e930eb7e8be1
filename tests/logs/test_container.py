from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer

from sonar_graph.errors import LogError, MissingTopicError
from sonar_graph.logs.mcap.file_summary import Instant, TimeWindow
from sonar_graph.logs.mcap.reader import scan, stream
from sonar_graph.logs.mcap.topic import Keep
from sonar_graph.logs.reading import read_log

from .containers import chunk_indexes, entries, flip, read, scan_all, write, write_apart


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
    assert recording.damage.remarks == []


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
    assert recording.ending.startswith("the file is cut off: ")
    assert " 0 " not in recording.ending
    recording.require_sound()


def test_a_file_cut_off_says_how_much_time_is_there(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start("ros2", "test")
        channel = writer.register_channel("/a", "cdr", writer.register_schema("a/msg/A", "ros2msg", b"uint8[] data"))
        for second in range(100):
            writer.add_message(channel, second * 10**9, bytes(1000), second * 10**9)
        writer.finish()  # type: ignore[no-untyped-call]
    path.write_bytes(path.read_bytes()[:60_000])
    recording = scan_all(path)
    (topic,) = recording.topics.values()
    assert 50 < len(topic) < 60
    assert (recording.ending or "").endswith(f"; what is there spans {len(topic) - 1}.000 s")


def test_a_file_cut_off_before_its_first_message_says_so(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write(path)
    path.write_bytes(path.read_bytes()[: chunk_indexes(path)[0].chunk_start_offset + 3])
    ending = scan(path, lambda _: Keep.ALL).ending
    assert ending is not None
    assert ending.startswith("the file is cut off: ")
    assert ending.endswith("; no message is there")
    with pytest.raises(MissingTopicError, match=r"log\.mcap: has no messages: the file is cut off: "):
        read_log(path)


def test_a_writer_killed_between_records_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write(path)
    last = chunk_indexes(path)[-1]
    path.write_bytes(path.read_bytes()[: last.chunk_start_offset + last.chunk_length])
    assert scan(path, lambda _: Keep.ALL).ending is not None


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.NONE])
def test_a_flipped_bit_loses_its_chunk_and_is_never_read_as_data(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "log.mcap"
    written = write(path, compression=compression)
    chunk = chunk_indexes(path)[1]
    flip(path, chunk.chunk_start_offset + chunk.chunk_length // 2)
    found = read(path)
    assert set(found) < set(written)
    recording = scan(path, lambda _: Keep.ALL)
    with pytest.raises(
        LogError, match=r"damaged: bytes \d+ to \d+: chunk 2 is lost.*lost: 35 of /bytes, 35 of /json.*--salvage"
    ):
        recording.require_sound()


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"#ROSBAG V2.0\n", r"a ROS 1 bag; `sonar-graph convert rosbag .*log\.bag -o log\.mcap`"),
        (b"SQLite format 3\0", "a ROS 2 bag of the sqlite3 kind; `sonar-graph convert rosbag"),
        (b"", "empty: copy it again"),
        (bytes(1000), "zeros: copy it again"),
        (b'{"a": 1}\nb', r"""a text that begins with '\{"a": 1\}'"""),
        ("Überschrift\n".encode() * 9, "a text that begins with 'Überschrift'"),
        (b" \n ", "a text that begins with ''"),
        (b"\x7fELF\x02\x01\x01", "something else"),
    ],
)
def test_other_files_are_named_for_what_they_are(tmp_path: Path, content: bytes, kind: str) -> None:
    path = tmp_path / "log.bag"
    path.write_bytes(content)
    with pytest.raises(LogError, match=rf"not an MCAP file but {kind}"):
        scan(path, lambda _: Keep.ALL)


def test_folders_and_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="is a folder"):
        scan(tmp_path, lambda _: Keep.ALL)
    with pytest.raises(LogError, match="No such file"):
        scan(tmp_path / "none.mcap", lambda _: Keep.ALL)


def test_pieces_are_what_a_scan_finds_in_the_same_order(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write(path)
    pieces: dict[str, list[tuple[int, bytes]]] = {}
    for piece in stream(path, lambda _: Keep.ALL):
        pieces.setdefault(piece.name, []).extend(entries(piece))
    assert pieces == {name: entries(topic) for name, topic in scan_all(path).topics.items()}


def test_pieces_of_a_damaged_file_end_in_an_error(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    written = write(path)
    flip(path, chunk_indexes(path)[1].chunk_start_offset + 100)
    found = []
    with pytest.raises(LogError, match="damaged: bytes"):
        found += [
            entry for piece in stream(path, lambda _: Keep.ALL) if piece.name == "/bytes" for entry in entries(piece)
        ]
    assert set(found) <= set(written)


def test_chunks_without_a_wanted_topic_are_not_even_read(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_apart(path)
    for index in chunk_indexes(path)[1::2]:  # those of /b: damage there goes unnoticed, and the recording says so
        flip(path, index.chunk_start_offset + index.chunk_length - 1)
    whole = scan_all(path)
    assert len(whole.corrupt) == 50
    recording = scan(path, lambda kind: Keep.NONE if kind.endswith("/B") else Keep.ALL)
    assert len(recording.topics["/a"]) == 50
    assert recording.corrupt == []
    assert (recording.chunks, recording.skipped_chunks) == (100, 50)
    assert recording.notes()["log.skipped"].startswith("50 of 100 chunks")


def test_a_window_holds_what_was_recorded_in_it_and_latched_topics(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_apart(path)
    recording = scan(path, lambda _: Keep.ALL, TimeWindow(Instant.parse("10"), Instant.parse("20")))
    times_s = sorted(t for name in ("/a", "/b") for t in (recording.topics[name].log_times_ns // 10**9).tolist())
    assert times_s == list(range(11, 21))
    assert entries(recording.topics["/tf_static"]) == [(10**9, b"static")]
    assert recording.skipped_chunks == 89
    assert recording.notes()["log.part"] == "10.000 s to 20.000 s of the recording"
    absolute = TimeWindow(Instant.parse("1970-01-01T00:01:31Z"))
    assert sum(len(t) for t in scan(path, lambda _: Keep.ALL, absolute).topics.values()) == 11


@pytest.mark.parametrize("summary", [True, False])
def test_a_window_is_the_same_without_summary(tmp_path: Path, summary: bool) -> None:
    path = tmp_path / "log.mcap"
    written = write(path)
    if not summary:
        path.write_bytes(path.read_bytes()[: chunk_indexes(path)[-1].chunk_start_offset])
        written = read(path)
    window = TimeWindow(Instant.parse("100e-9"), Instant.parse("150e-9"))
    recording = scan(path, lambda _: Keep.ALL, window)
    assert entries(recording.topics["/bytes"]) == [entry for entry in written if 1100 <= entry[0] < 1150]
    assert (recording.skipped_chunks > 0) == summary


def test_an_empty_window_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_apart(path)
    with pytest.raises(LogError, match=r"nothing was recorded from 1000\.000 s to the end"):
        scan(path, lambda _: Keep.ALL, TimeWindow(Instant.parse("1000")))


@pytest.mark.parametrize("part", ["time", "offset", "channel", "missing"])
def test_an_index_that_does_not_fit_its_chunk_is_not_believed(tmp_path: Path, part: str) -> None:
    path = tmp_path / "log.mcap"
    written = write(path, compression=CompressionType.NONE)
    chunk = chunk_indexes(path)[2]
    index_at = min(chunk.message_index_offsets.values())
    if part == "missing":  # an index with one entry fewer, its lengths in order
        content = bytearray(path.read_bytes())
        (length,) = struct.unpack_from("<Q", content, index_at + 1)
        private = struct.pack("<BQ", 0x80, 16 - 9) + bytes(16 - 9)
        content[index_at + 1 : index_at + 9] = struct.pack("<Q", length - 16)
        content[index_at + 11 : index_at + 15] = struct.pack("<I", length - 16 - 6)
        content[index_at + 9 + length - 16 : index_at + 9 + length] = private
        path.write_bytes(content)
    else:
        flip(path, index_at + {"channel": 9, "time": 15, "offset": 23}[part], 1)
    recording = scan_all(path)
    assert entries(recording.topics["/bytes"]) == written
    assert recording.corrupt == []
    assert any("message index of chunk 3" in remark for remark in recording.damage.remarks)


def test_a_summary_that_lies_about_chunks_is_not_used_to_skip(tmp_path: Path) -> None:
    """The index of a chunk with /a says that it holds /b only, in a summary without CRC."""
    path = tmp_path / "log.mcap"
    write_apart(path)
    content = bytearray(path.read_bytes())
    footer_at = len(content) - 8 - 29
    content[footer_at + 25 : footer_at + 29] = bytes(4)
    index = chunk_indexes(path)[4]
    entry = struct.pack("<IHQ", 10, 1, index.message_index_offsets[1])
    assert content.count(entry) == 1
    at = content.index(entry)
    content[at : at + len(entry)] = struct.pack("<IHQ", 10, 2, index.message_index_offsets[1])
    path.write_bytes(content)
    recording = scan(path, lambda _: Keep.ALL, TimeWindow(Instant.parse("3"), Instant.parse("7")))
    assert (recording.topics["/a"].log_times_ns // 10**9).tolist() == [5, 7]
    assert any("the summary's index does not fit chunk 5" in remark for remark in recording.damage.remarks)
    assert recording.skipped_chunks == 0


def test_progress_ends_at_the_whole(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write(path)
    calls: list[tuple[int, int]] = []
    scan(path, lambda _: Keep.ALL, progress=lambda done, total: calls.append((done, total)))
    done = [d for d, _ in calls]
    assert done == sorted(done)
    assert {total for _, total in calls} == {path.stat().st_size}
    assert len(calls) == len(chunk_indexes(path))


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def test_half_a_chunk_gives_its_whole_messages(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "log.mcap"
    written = write(path, 60_000, chunk_size=1 << 20, compression=compression)
    second = chunk_indexes(path)[1]
    before = int(np.searchsorted([time for time, _ in written], second.message_start_time))
    path.write_bytes(path.read_bytes()[: second.chunk_start_offset + second.chunk_length // 2])
    found = read(path)
    assert found == written[: len(found)]
    assert len(found) > before + 0.2 * before
    assert "which no CRC covers" in (scan_all(path).ending or "")


def test_messages_outside_chunks_may_be_larger_than_what_is_read_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    payloads = [bytes([i]) * (3 << 20) for i in range(3)]
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start("ros2", "test")
        channel = writer.register_channel("/a", "cdr", writer.register_schema("a/msg/A", "ros2msg", b"uint8[] data"))
        for i, payload in enumerate(payloads):
            writer.add_message(channel, i, payload, i)
        writer.finish()  # type: ignore[no-untyped-call]
    assert entries(scan_all(path).topics["/a"]) == list(enumerate(payloads))
