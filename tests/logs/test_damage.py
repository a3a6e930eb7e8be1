from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from mcap.data_stream import ReadDataStream
from mcap.records import Chunk, Message
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer

from sonar_graph.logs.mcap.reader import scan
from sonar_graph.logs.mcap.records import seal
from sonar_graph.logs.mcap.topic import Damage, Keep, Loss, Topic, settle

from .containers import chunk_indexes, entries, flip, read, scan_all, write


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.mcap"


def chunk_of(path: Path, number: int, channel: int = 1) -> list[tuple[int, bytes]]:
    """Messages of a chunk as mcap's own reader finds them."""
    index = chunk_indexes(path)[number]
    content = path.read_bytes()[index.chunk_start_offset + 9 :][: index.chunk_length - 9]
    records = breakup_chunk(Chunk.read(ReadDataStream(BytesIO(content))))
    return [(r.log_time, r.data) for r in records if isinstance(r, Message) and r.channel_id == channel]


def test_a_lost_chunk_is_told_with_bytes_times_and_counts(path: Path) -> None:
    written = write(path)
    chunk = chunk_indexes(path)[1]
    lost, others = chunk_of(path, 1), chunk_of(path, 1, channel=2)
    flip(path, chunk.chunk_start_offset + chunk.chunk_length - 3)
    (loss,) = scan_all(path).damage.losses
    assert (loss.at, loss.end) == (chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length)
    assert (loss.start_ns, loss.end_ns) == (chunk.message_start_time, chunk.message_end_time)
    assert loss.messages == {"/bytes": len(lost), "/json": len(others)}
    assert not loss.is_estimate
    assert read(path) == [entry for entry in written if entry not in lost]


@pytest.mark.parametrize("bit", [1, 8, 128])
@pytest.mark.parametrize("octet", [1, 2, 5, 8])
def test_a_chunk_whose_outer_length_lies_is_read(path: Path, octet: int, bit: int) -> None:
    written = write(path)
    flip(path, chunk_indexes(path)[1].chunk_start_offset + octet, bit)
    assert read(path) == written


def test_a_chunk_with_another_opcode_is_read(path: Path) -> None:
    written = write(path)
    flip(path, chunk_indexes(path)[1].chunk_start_offset, 0x80)
    assert read(path) == written


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.NONE])
def test_after_missing_bytes_reading_goes_on_with_the_next_chunk(path: Path, compression: CompressionType) -> None:
    written = write(path, compression=compression)
    first = chunk_indexes(path)[1]
    lost, others = chunk_of(path, 1), chunk_of(path, 1, channel=2)
    at = first.chunk_start_offset + 200
    assert first.message_index_length < 1500 < first.chunk_length - 200
    content = path.read_bytes()
    path.write_bytes(content[:at] + content[at + 1500 :])  # more than its index takes
    assert read(path) == [entry for entry in written if entry not in lost]
    (loss,) = scan_all(path).damage.losses
    assert loss.at == first.chunk_start_offset
    assert loss.messages == {"/bytes": len(lost), "/json": len(others)}  # by the statistics of a summary that has moved


def test_what_looks_like_messages_within_a_damaged_chunk_is_not_read(path: Path) -> None:
    """Uncompressed, with both of its lengths wrong: the messages in it have no CRC that could be checked."""
    written = write(path, compression=CompressionType.NONE)
    lost = chunk_of(path, 1)
    chunk = chunk_indexes(path)[1]
    flip(path, chunk.chunk_start_offset + 1)
    flip(path, chunk.chunk_start_offset + 9 + 32, 1)
    assert read(path) == [entry for entry in written if entry not in lost]


def test_also_the_first_chunk_is_not_read_as_messages_without_chunk(path: Path) -> None:
    write(path, chunk_size=1 << 20, compression=CompressionType.NONE)
    (chunk,) = chunk_indexes(path)
    path.write_bytes(path.read_bytes()[: chunk.chunk_start_offset + chunk.chunk_length])
    flip(path, chunk.chunk_start_offset + 1)
    flip(path, chunk.chunk_start_offset + 9 + 32, 1)
    assert scan_all(path).topics == {}


def test_a_length_that_lies_outside_chunks_costs_one_message(path: Path) -> None:
    written = write(path, use_chunking=False)
    content = path.read_bytes()
    at = content.index(written[200][1]) - 22 - 9
    for bit in (1, 64):
        flip(path, at + 1, bit)
        assert set(written) - set(read(path)) == {written[200]}
        flip(path, at + 1, bit)


def test_a_bit_outside_chunks_is_noticed_by_the_crc_over_all_data(path: Path) -> None:
    written = write(path, use_chunking=False, enable_data_crcs=True)
    assert scan_all(path).damage == Damage()
    flip(path, path.read_bytes().index(written[200][1]) + 3)
    (loss,) = scan_all(path).damage.losses
    assert "the CRC over all data does not fit" in loss.reason
    assert "messages lie outside chunks" in loss.reason


def test_what_no_crc_covers_is_named(path: Path) -> None:
    write(path, use_chunking=False)
    assert scan_all(path).notes()["log.unprotected"] == "messages lie outside chunks, metadata record 'sonar_graph'"
    write(path, enable_crcs=False)
    assert "chunks carry no CRC" in scan_all(path).notes()["log.unprotected"]
    write(path)
    assert scan_all(path).notes() == {"log.unprotected": "metadata record 'sonar_graph'"}


def test_a_description_outside_chunks_is_checked_against_the_summary(path: Path) -> None:
    written = write(path, use_chunking=False)
    flip(path, path.read_bytes().index(b"test_msgs/msg/Bytes"), 1)
    recording = scan_all(path)
    assert recording.topics["/bytes"].type_name == "test_msgs/msg/Bytes"
    assert entries(recording.topics["/bytes"]) == written
    assert any("schema 1 (test_msgs/msg/Bytes) is described in two ways" in r for r in recording.damage.remarks)


def test_descriptions_lost_with_the_first_chunk_come_from_the_summary(path: Path) -> None:
    written = write(path)
    lost = chunk_of(path, 0)
    flip(path, chunk_indexes(path)[0].chunk_start_offset + 100)
    assert read(path) == written[len(lost) :]


def test_descriptions_come_from_a_summary_that_has_moved(path: Path) -> None:
    written = write(path)
    lost = chunk_of(path, 0)
    at = chunk_indexes(path)[0].chunk_start_offset + 200
    content = path.read_bytes()
    path.write_bytes(content[:at] + content[at + 10 :])
    assert read(path) == written[len(lost) :]


def test_a_channel_outside_chunks_that_differs_from_the_summary_is_not_believed(path: Path) -> None:
    written = write(path, use_chunking=False)
    flip(path, path.read_bytes().index(b"/bytes"), 1)
    recording = scan_all(path)
    assert entries(recording.topics["/bytes"]) == written
    assert any("channel 1 (/bytes) is described in two ways" in remark for remark in recording.damage.remarks)


def test_a_description_with_a_wrong_length_within_is_lost_not_shortened(path: Path) -> None:
    write(path, use_chunking=False, use_statistics=False, repeat_channels=False, repeat_schemas=False)
    content = path.read_bytes()
    flip(path, content.index(b"uint8[] data") - 4, 16)  # of 13 bytes it now claims 29, of which 13 are there
    recording = scan_all(path)
    assert any("the description of a channel is lost" in loss for loss in recording.corrupt)


def test_a_wrong_length_of_metadata_costs_no_message(path: Path) -> None:
    written = write(path)
    flip(path, path.read_bytes().index(b"sonar_graph") - 4 - 8, 64)
    assert read(path) == written
    assert "a metadata record is lost" in scan_all(path).corrupt[0]


def test_without_any_description_messages_are_counted_as_lost(path: Path) -> None:
    written = write(path)
    first, second = chunk_indexes(path)[:2]
    content = path.read_bytes()[: second.chunk_start_offset + second.chunk_length]
    path.write_bytes(content)
    flip(path, first.chunk_start_offset + 100)
    recording = scan_all(path)
    assert recording.topics == {}
    assert sum(sum((loss.messages or {}).values()) for loss in recording.damage.losses) > len(written) / 10
    assert "whose description is lost" in recording.corrupt[1]


@pytest.mark.parametrize("tail", [bytes(5000), b"\x05" * 5000, bytes(range(256)) * 20])
def test_a_tail_that_is_no_mcap_costs_nothing(path: Path, tail: bytes) -> None:
    written = write(path)
    path.write_bytes(path.read_bytes() + tail)
    recording = scan_all(path)
    assert entries(recording.topics["/bytes"]) == written
    assert recording.damage.losses == []
    assert any("does not end as an MCAP file does" in remark for remark in recording.damage.remarks)


def test_zeros_after_a_cut_are_not_taken_for_a_message(path: Path) -> None:
    """As a file system leaves them after a crash: a message that reaches into them is not whole."""
    written = write(path, 2000, chunk_size=1 << 20, compression=CompressionType.NONE)
    content = path.read_bytes()
    for kept in range(20_000, 20_080):
        path.write_bytes(content[:kept] + bytes(300))
        found = read(path)
        assert found == written[: len(found)]
        assert len(found) > 100


def test_a_size_beyond_all_memory_is_refused_not_reserved(path: Path) -> None:
    written = write(path)
    chunk = chunk_indexes(path)[1]
    content = bytearray(path.read_bytes())
    struct.pack_into("<Q", content, chunk.chunk_start_offset + 9 + 16, 1 << 62)
    path.write_bytes(content)
    assert read(path) == written  # the frame within tells its size, and the CRC fits
    assert scan_all(path).corrupt == []


def test_losses_are_estimated_from_rates_where_nothing_counts_them() -> None:
    topic = Topic(Path("x"), "/imu", "", "cdr", "ros2msg", "", Keep.ALL)
    times_ns = np.delete(np.arange(1000) * 10_000_000, slice(400, 450))
    topic.gather(bytes(10), np.zeros(950, np.int64), np.full(950, 10), times_ns)
    loss = Loss(0, 100, "no valid record", int(times_ns[399]), int(times_ns[400]))
    settle(Damage([loss]), {"/imu": topic}, None)
    assert loss.messages == {"/imu": 50}
    assert loss.is_estimate
    assert loss.describe(0) == "bytes 0 to 100: no valid record; 3.990 s to 4.500 s of the log; lost: about 50 of /imu"


def test_fewer_messages_than_the_statistics_count_are_a_loss() -> None:
    damage = Damage()
    settle(damage, {}, {"/imu": 3})
    assert damage.losses[0].messages == {"/imu": 3}
    settle(sound := Damage(), {}, {})
    assert sound.losses == []


def test_metadata_under_a_seal_is_whole_or_lost(path: Path) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("sonar_graph", seal({"calibration": "0.05", "name": "x"}))
        writer.finish()  # type: ignore[no-untyped-call]
    recording = scan(path, lambda _: Keep.ALL)
    assert recording.metadata == {"sonar_graph": {"calibration": "0.05", "name": "x"}}
    assert recording.damage == Damage()
    flip(path, path.read_bytes().index(b"0.05") + 3, 1)
    recording = scan(path, lambda _: Keep.ALL)
    assert recording.metadata == {}
    assert "a metadata record is lost: its CRC does not fit" in recording.corrupt[0]


WRITERS = {
    "mcap's own": """
writer = Writer(open(path, "wb"), chunk_size=65536)
writer.start("ros2", "test")
channel = writer.register_channel("/n", "json", 0)
for n in range(10**9):
    writer.add_message(channel, n, os.urandom(1000), n)
    os.write(1, b"%d\\n" % n)
""",
    "ours": """
import numpy as np
from sonar_graph.logs.mcap import writer
from sonar_graph.logs.mcap.writer import Outgoing, write_recording

class Telling(Writer):
    def add_message(self, channel, time_ns, data, publish_ns):
        super().add_message(channel, time_ns, data, publish_ns)
        os.write(1, b"%d\\n" % time_ns)

writer.Writer, writer._CHUNK_BYTES = Telling, 65536
payloads = np.zeros((50_000, 1000), np.uint8)  # small when compressed: a chunk fits into a buffer
write_recording(Path(path), [Outgoing("/n", "std_msgs/msg/Header", np.arange(50_000), payloads)], {})
""",
}


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="there is no SIGKILL here")
@pytest.mark.parametrize("by", WRITERS)
def test_a_killed_writer_loses_at_most_its_open_chunk(tmp_path: Path, by: str) -> None:
    path = tmp_path / "log.mcap"
    head = "import os, sys\nfrom pathlib import Path\nfrom mcap.writer import Writer\npath = sys.argv[1]\n"
    writer = subprocess.Popen([sys.executable, "-c", head + WRITERS[by], str(path)], stdout=subprocess.PIPE)
    assert writer.stdout is not None
    told = 0
    while told < 3000:
        told = int(writer.stdout.readline())
    os.kill(writer.pid, signal.SIGKILL)
    rest, _ = writer.communicate()
    last = int(rest.splitlines()[-1]) if rest.endswith(b"\n") and rest.strip() else told
    if by == "ours":
        assert not path.exists()  # never a file that looks complete
        path = path.with_name(path.name + ".part")
    found = scan_all(path).topics["/n"].log_times_ns
    np.testing.assert_array_equal(found, np.arange(len(found)))
    buffered = 8192 if by == "mcap's own" else 0  # by Python's file, in which a part of the chunk before waits
    assert len(found) >= last - (65536 + buffered) // 1000 - 1
    assert scan_all(path).ending is not None
