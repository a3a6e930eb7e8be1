"""MCAP files of every kind, whole and damaged: every message that is whole is read, and what is lost is reported."""

import re
import struct
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.data_stream import ReadDataStream
from mcap.records import Chunk, ChunkIndex, Message
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, IndexType

from sonar_graph.errors import LogError, MissingTopicError
from sonar_graph.logs import read_log
from sonar_graph.logs.mcap import Damage, Instant, Keep, TimeWindow, scan, stream
from sonar_graph.logs.mcap.log_file import seal

from .conftest import (
    Stored,
    chunk_indexes,
    cut,
    entries,
    flip,
    read,
    scan_all,
    write,
    write_apart,
    writing,
)

NONE = CompressionType.NONE
LZ4 = CompressionType.LZ4
ZSTD = CompressionType.ZSTD


def chunk_end(chunk: ChunkIndex) -> int:
    return chunk.chunk_start_offset + chunk.chunk_length


def chunk_of(path: Path, number: int, channel: int = 1) -> list[Stored]:
    """Messages of a chunk as mcap's own reader finds them."""
    index = chunk_indexes(path)[number]
    content = path.read_bytes()[index.chunk_start_offset + 9 :][
        : index.chunk_length - 9
    ]
    records = breakup_chunk(Chunk.read(ReadDataStream(BytesIO(content))))
    return [
        (r.log_time, r.data)
        for r in records
        if isinstance(r, Message) and r.channel_id == channel
    ]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.mcap"


CONTAINERS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": ZSTD},
    "lz4": {"compression": LZ4},
    "none": {"compression": NONE},
    "unchunked": {"use_chunking": False},
    "no index": {
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
    "no summary": {"repeat_channels": False, "repeat_schemas": False},
}


@pytest.mark.parametrize("options", CONTAINERS.values(), ids=CONTAINERS)
def test_every_message_is_found_whatever_the_container(path, options):
    written = write(path, **options)
    assert read(path) == written
    calls: list[tuple[int, int]] = []
    recording = scan(
        path, lambda _: Keep.STAMP, progress=lambda *call: calls.append(call)
    )
    assert list(recording.topics) == ["/bytes", "/json"]
    assert recording.metadata == {"sonar_graph": {"name": "x"}}
    assert recording.ending is None
    assert recording.corrupt == recording.damage.remarks == []
    found = recording.topics["/bytes"]
    assert len(found) == len(written)
    assert list(found.stacks) == [12]  # only the stamps were wanted
    assert calls == sorted(calls) != []
    assert {total for _, total in calls} <= {path.stat().st_size}
    pieces: dict[str, list[Stored]] = {}
    for piece in stream(path, lambda _: Keep.ALL):
        pieces.setdefault(piece.name, []).extend(entries(piece))
    topics = scan_all(path).topics
    assert pieces == {name: entries(topic) for name, topic in topics.items()}


# ---- damage


def in_chunk(number: int, offset: int, bit: int = 4) -> Callable[[Path], None]:
    """A bit at an offset from the beginning of a chunk."""
    return lambda path: flip(
        path, chunk_indexes(path)[number].chunk_start_offset + offset, bit
    )


def at_text(text: bytes, offset: int = 0, bit: int = 1) -> Callable[[Path], None]:
    """A bit at an offset from some bytes."""
    return lambda path: flip(path, path.read_bytes().index(text) + offset, bit)


def both_lengths(path: Path, number: int = 1) -> None:
    """Both lengths of a chunk, so that its end is unknown."""
    in_chunk(number, 1)(path)
    in_chunk(number, 9 + 32, 1)(path)


def missing_in_chunk(number: int, count: int) -> Callable[[Path], object]:
    def cut_out(path: Path) -> None:
        at = chunk_indexes(path)[number].chunk_start_offset + 200
        content = path.read_bytes()
        path.write_bytes(content[:at] + content[at + count :])

    return cut_out


def huge_size(path: Path) -> None:
    at = chunk_indexes(path)[1].chunk_start_offset + 9 + 16
    content = path.read_bytes()
    path.write_bytes(content[:at] + struct.pack("<Q", 1 << 62) + content[at + 8 :])


def in_index(offset: int) -> Callable[[Path], None]:
    """A bit of the message index of the third chunk."""
    return lambda path: flip(
        path, min(chunk_indexes(path)[2].message_index_offsets.values()) + offset, 1
    )


def message_200(offset: int, bit: int) -> Callable[[Path], None]:
    """A bit at an offset from the head of a message outside chunks."""
    rng = np.random.default_rng(0)
    payloads = [rng.bytes([20, 50, 80][i % 3]) for i in range(201)]
    return at_text(payloads[200], offset - 31, bit)


def tail(content: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(path.read_bytes() + content)


class Fault(NamedTuple):
    """Damage to a file, and the account that is expected of it."""

    damage: Callable[[Path], object]
    lost: int | None = (
        None  # the chunk whose messages are lost; without chunks, the message
    )
    corrupt: str = ""  # what the losses must contain; empty: there must be none
    remark: str = ""
    options: Mapping[str, Any] = MappingProxyType({})


PLAIN: dict[str, Any] = {"compression": NONE}
LOOSE: dict[str, Any] = {"use_chunking": False}
UNREPEATED = LOOSE | {
    "use_statistics": False,
    "repeat_channels": False,
    "repeat_schemas": False,
}
SECOND = "chunk 2 is lost: .*; lost: 35 of /bytes, 35 of /json$"
MOVED = "bytes are missing or doubled in it"
ENDING = "does not end as an MCAP file"
TWICE = r"schema 1 \(test_msgs/msg/Bytes\) is described in two ways; the first holds"
FAULTS = {
    "a bit in a chunk": Fault(in_chunk(1, 900), 1, SECOND),
    "a chunk's opcode": Fault(in_chunk(1, 0, 0x80)),
    "a chunk's size beyond all memory": Fault(huge_size, 1, SECOND),
    "both lengths of a chunk": Fault(both_lengths, options=PLAIN),
    "bytes missing": Fault(missing_in_chunk(1, 1500), 1, "no valid record", MOVED),
    "the first chunk, with the descriptions": Fault(
        in_chunk(0, 100), 0, "chunk 1 is lost"
    ),
    "a message index": Fault(in_index(15), options=PLAIN),
    "a longer message outside chunks": Fault(
        message_200(1, 1), 200, "1 of /bytes", options=LOOSE
    ),
    "a shorter message outside chunks": Fault(
        message_200(1, 64), 200, "no valid record", options=LOOSE
    ),
    "a type's name outside chunks": Fault(
        at_text(b"test_msgs/msg/Bytes"), remark=TWICE, options=LOOSE
    ),
    # it claims 29 bytes and has 13
    "a length in a description": Fault(
        at_text(b"uint8[] d", -4, 16), None, "description of a ch", options=UNREPEATED
    ),
    "the length of metadata": Fault(
        at_text(b"sonar_graph", -12, 64), None, "no valid record; no messages lost"
    ),
    "zeros after the end": Fault(tail(bytes(5000)), remark=ENDING),
} | {
    f"bit {bit} of byte {at} of a chunk": Fault(in_chunk(1, at, bit))
    for at in (1, 2, 5, 8)
    for bit in (1, 8, 128)
}


@pytest.mark.parametrize("name", FAULTS)
def test_of_a_damaged_file_all_that_is_whole_is_read_and_the_rest_is_told(path, name):
    fault = FAULTS[name]
    written = write(path, **fault.options)
    chunks = chunk_indexes(path)
    lost = []
    if fault.lost is not None:
        lost = chunk_of(path, fault.lost) if chunks else [written[fault.lost]]
    counted = {"/bytes": len(lost)}
    if lost and chunks:
        counted["/json"] = len(chunk_of(path, fault.lost or 0, channel=2))
    fault.damage(path)
    recording = scan_all(path)
    found = read(path)
    if not chunks:  # without a CRC a message that became shorter is read
        found = [entry for entry in found if entry in written]
    assert found == [entry for entry in written if entry not in lost]
    for told, expected in (
        (recording.corrupt, fault.corrupt),
        (recording.damage.remarks, fault.remark),
    ):
        assert bool(told) == bool(expected)
        assert any(re.search(expected, text) for text in told or [""])
    assert recording.ending is None
    is_described = fault.options != UNREPEATED
    kind = "test_msgs/msg/Bytes" if is_described else ""
    assert recording.topics["/bytes"].type_name == kind
    if not lost:
        return
    (loss,) = recording.damage.losses
    if not chunks:
        assert (loss.start_ns or 0) <= lost[0][0] <= (loss.end_ns or 0)
        return
    chunk = chunks[fault.lost or 0]
    assert loss.at == chunk.chunk_start_offset
    # only a summary that fits counts the messages
    assert loss.messages == (None if fault.remark == MOVED else counted)
    with pytest.raises(LogError, match=r"damaged: bytes \d+ to \d+: .*--salvage"):
        recording.require_sound()
    if name == "a bit in a chunk":
        assert loss.end == chunk_end(chunk)
        assert (loss.start_ns or 0) <= chunk.message_start_time
        assert chunk.message_end_time <= (loss.end_ns or 0)


RANDOM = settings(
    max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@RANDOM
@given(
    st.sampled_from(["flip", "remove", "insert", "zero", "cut"]),
    st.floats(0, 1),
    st.integers(1, 3000),
)
# up to a message within an uncompressed chunk
@example("remove", 0.0, 1449)
# from one message into another, so that the length of the first fits again
@example("remove", 0.859375, 1209)
@pytest.mark.parametrize("compression", [ZSTD, NONE])
def test_no_damage_makes_up_a_message_or_loses_one_silently(
    path, compression, how, part, count
):
    written = write(path, 200, compression=compression)
    content = path.read_bytes()
    at = 8 + int(part * (len(content) - 9))
    damaged = {
        "flip": content[:at]
        + bytes([content[at] ^ (1 << count % 8)])
        + content[at + 1 :],
        "remove": content[:at] + content[at + count :],
        "insert": content[:at] + bytes(count) + content[at:],
        "zero": (content[:at] + bytes(count))[: len(content)] + content[at + count :],
        "cut": content[:at],
    }[how]
    path.write_bytes(damaged)
    recording = scan_all(path)
    found = read(path)
    of_written = [entry for entry in found if entry in set(written)]
    assert of_written == [entry for entry in written if entry in set(found)]
    # where lengths fit again nothing shows that bytes are missing, but that no CRC covers them is said
    if of_written != found:
        assert len(found) == len(of_written) + 1
        assert "which no CRC covers" in str(recording.ending)
    if found != written:
        assert recording.corrupt or recording.ending


def test_messages_that_nothing_describes_are_not_read_but_counted_as_lost(path):
    """Without a CRC that could be checked, those of an uncompressed chunk are no messages outside chunks either."""
    write(path, chunk_size=1 << 20, compression=NONE)
    (chunk,) = chunk_indexes(path)
    both_lengths(path, 0)
    cut(path, chunk_end(chunk))
    assert scan_all(path).topics == {}
    written = write(path)
    first, second = chunk_indexes(path)[:2]
    cut(path, chunk_end(second))
    flip(path, first.chunk_start_offset + 100)
    recording = scan_all(path)
    assert recording.topics == {}
    counts = [sum((one.messages or {}).values()) for one in recording.damage.losses]
    assert sum(counts) > len(written) / 10
    assert "whose description is lost" in recording.corrupt[1]


def test_what_no_crc_covers_is_named_and_what_one_covers_is_whole_or_lost(path):
    record = "metadata record 'sonar_graph'"
    for options, named in (
        (LOOSE, f"messages lie outside chunks, {record}"),
        ({"enable_crcs": False}, f"12 chunks carry no CRC, {record}"),
        ({}, record),
    ):
        write(path, **options)
        assert scan_all(path).notes() == {"log.unprotected": named}
    written = write(path, use_chunking=False, enable_data_crcs=True)
    assert scan_all(path).damage == Damage()
    at_text(written[200][1], 3)(path)
    (loss,) = scan_all(path).damage.losses
    message = "the CRC over all data does not fit, and messages lie outside chunks"
    assert message in loss.reason
    sealed = {"calibration": "0.05", "name": "x"}
    with writing(path) as writer:
        writer.add_metadata("sonar_graph", seal(sealed))
    recording = scan_all(path)
    assert recording.metadata == {"sonar_graph": sealed}
    assert recording.damage == Damage()
    at_text(b"0.05", 3)(path)
    recording = scan_all(path)
    assert recording.metadata == {}
    assert "a metadata record is lost: its CRC does not fit" in recording.corrupt[0]


def test_a_truncated_file_is_read_up_to_the_cut(path):
    written = write(path)
    first, *_, last = chunk_indexes(path)
    cut(path, chunk_end(last))
    end = "the file is cut off: it ends after a whole record"
    assert (scan_all(path).ending or "").startswith(end)
    flip(path, last.chunk_start_offset + 1)  # the outer length of the last chunk
    assert read(path) == written
    cut(path, first.chunk_start_offset + 3)
    assert (scan_all(path).ending or "").endswith("; no message is there")
    message = r"log\.mcap: has no messages: the file is cut off: "
    with pytest.raises(MissingTopicError, match=message):
        read_log(path)


@pytest.mark.parametrize("compression", [ZSTD, LZ4, NONE])
def test_half_a_chunk_gives_its_whole_messages(path, compression):
    written = write(path, 12_000, chunk_size=1 << 18, compression=compression)
    second = chunk_indexes(path)[1]
    cut(path, second.chunk_start_offset + second.chunk_length // 2)
    found = read(path)
    assert found == written[: len(found)]
    # messages are a nanosecond apart, from 1000 on
    assert len(found) > 1.2 * (second.message_start_time - 1000)
    ending = scan_all(path).ending or ""
    assert "which no CRC covers" in ending
    assert ending.endswith(f"what is there spans {(found[-1][0] - 1000) * 1e-9:.3f} s")


# ---- files that are no logs


OTHER_FILES = {
    b"#ROSBAG V2.0\n": r"a ROS 1 bag; `sonar-graph convert rosbag .*log\.bag -o log\.mcap`",
    b"SQLite format 3\0": "a ROS 2 bag of the sqlite3 kind; `sonar-graph convert rosbag",
    b"DDF\x05"
    + bytes(
        60
    ): r"an ARIS' recording; `sonar-graph convert aris .*log\.bag -o log\.mcap` makes a log of it",
    b"DDF\x03" + bytes(60): "a DIDSON's recording; `sonar-graph convert didson ",
    b"SO\x01\0\0\0\x23\0": "an Oculus' recording; `sonar-graph convert oculus ",
    b"DDF SO": "a text that begins with 'DDF SO'",
    b"": "empty: copy it again",
    bytes(1000): "zeros: copy it again",
    b'{"a": 1}\nb': r"""a text that begins with '\{"a": 1\}'""",
    "Überschrift\n".encode() * 9: "a text that begins with 'Überschrift'",
    b" \n ": "a text that begins with ''",
    b"\x7fELF\x02\x01\x01": "something else",
    b"\xa3\x95\x80\x80"
    + bytes(
        60
    ): r"an ArduPilot log \(.bin\); `mavlogdump.py --format csv --types IMU .*convert csv`",
    b"ULog\x01\x12\x35\x01"
    + bytes(60): r"a PX4 log \(.ulg\); `ulog2csv .*`sonar-graph convert csv`",
    b"\x28\xb5\x2f\xfd" + bytes(60): "compressed by zstd; `zstd -d ",
    b"\x1f\x8b\x08" + b"aaaa": "compressed by gzip; `gunzip ",
    b"PK\x03\x04" + bytes(60): "a zip archive; `unzip ",
    b"\x7f\x7f\xf0\x02"
    + bytes(
        60
    ): "a PD0 recording of a Doppler log; mhkit.dolfyn .*`sonar-graph convert csv`",
    b"\xa5\x0a\x16" + bytes(60): "a Nortek recording",
    b"\x89HDF\r\n\x1a\n" + bytes(60): "an HDF5 file; .*`sonar-graph convert csv`",
}


def test_other_files_are_named_for_what_they_are(tmp_path):
    path = tmp_path / "log.bag"
    for content, kind in OTHER_FILES.items():
        path.write_bytes(content)
        with pytest.raises(LogError, match=rf"not an MCAP file but {kind}") as refusal:
            scan_all(path)
        assert len(str(refusal.value).replace(str(path), "log.bag")) <= 300
    viewer = tmp_path / "dive.oculus"
    viewer.write_bytes(b"\x44\x33\x22\x11")
    for path, kind in (
        (viewer, "a file of the Oculus viewer, which is not read"),
        (tmp_path, "is a folder"),
        (tmp_path / "none.mcap", "No such file"),
    ):
        with pytest.raises(LogError, match=kind):
            scan_all(path)


def test_a_window_holds_what_was_recorded_in_it_and_latched_topics(path):
    write_apart(path)
    recording = scan_all(path, TimeWindow.parse("10", "20"))
    times_ns = [recording.topics[name].log_times_ns for name in ("/a", "/b")]
    assert sorted(np.concatenate(times_ns) // 10**9) == list(range(11, 21))
    assert entries(recording.topics["/tf_static"]) == [(10**9, b"static")]
    assert recording.skipped_chunks == 89
    assert recording.notes()["log.part"] == "10.000 s to 20.000 s of the recording"
    absolute = TimeWindow.parse("1970-01-01T00:01:31Z", None)
    assert sum(len(t) for t in scan_all(path, absolute).topics.values()) == 11
    message = r"nothing was recorded from 1000\.000 s to the end"
    with pytest.raises(LogError, match=message):
        scan_all(path, TimeWindow.parse("1000", None))


def test_a_window_takes_seconds_and_dates_and_refuses_all_else():
    beginning_ns = 1_700_000_000_000_000_001
    for text, expected_ns in (
        ("1970-01-02T00:00:01", 86_401_000_000_000),
        ("1970-01-02T01:00:01.5+01:00", 86_401_500_000_000),
        ("1.5", beginning_ns + 1_500_000_000),
    ):
        assert Instant.parse(text).resolve(beginning_ns) == expected_ns
    assert Instant.parse("1700000000").resolve(0) == 1_700_000_000 * 10**9
    for text in ("-1", "nan", "inf", "x"):
        message = r"no time in a log: give seconds from its beginning"
        with pytest.raises(LogError, match=message):
            Instant.parse(text)
    with pytest.raises(LogError, match="ends before it starts"):
        TimeWindow.parse("2", "2").resolve(beginning_ns)
