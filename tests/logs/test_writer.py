"""Recordings that this package writes, read by others; and files that are whole or not there."""

import os
import signal
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from sonar_graph.errors import LogError
from sonar_graph.files import written_whole
from sonar_graph.logs.mcap.file_summary import read_summary
from sonar_graph.logs.mcap.records import LogFile, open_seal
from sonar_graph.logs.mcap.writer import Attachment, Outgoing, write_recording
from sonar_graph.logs.writing import pose_messages, static_message
from sonar_graph.states import Trajectory

from .conftest import chunk_indexes, flip, scan_all

T0_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20,000 poses and a latched one, with metadata and an attached file."""
    path = tmp_path_factory.mktemp("recorder") / "a.mcap"
    positions = np.random.default_rng(0).normal(size=(20_000, 3))
    stamps_ns = T0_NS + np.arange(20_000) * 10**7
    truth = Trajectory.without_covariances(stamps_ns, positions, np.tile([0, 0, 0, 1.0], (20_000, 1)))
    poses = pose_messages("/pose", truth)
    still = static_message("/start", poses.type_name, T0_NS, poses.payloads[:1])
    file = Attachment("notes/a.json", "application/json", b'{"a": 1}')
    write_recording(path, [still, poses], {"about": {"key": "value ψ"}}, [file])
    return path


def test_profile_index_counts_metadata_and_attachments_are_those_of_a_ros_2_recording(recording: Path) -> None:
    with recording.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == sum(1 for _ in reader.iter_messages()) == 20_001
        assert len(summary.chunk_indexes) > 3
        assert all(index.message_index_length > 0 and index.compression for index in summary.chunk_indexes)
        assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
        assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
        about = {m.name: m.metadata for m in reader.iter_metadata()}["about"]
        assert open_seal(about) == ({"key": "value ψ"}, True)
        (file,) = reader.iter_attachments()
    assert (file.name, file.media_type, file.data) == ("notes/a.json", "application/json", b'{"a": 1}')


def test_messages_lie_in_the_order_of_their_times_and_those_of_one_instant_in_that_of_the_list(tmp_path: Path) -> None:
    times_ns = np.repeat([20, 10], 50)
    first, second = (Outgoing(n, "std_msgs/msg/Header", times_ns, np.zeros((100, 9), np.uint8)) for n in ("/a", "/b"))
    write_recording(tmp_path / "a.mcap", [first, second], {})
    with (tmp_path / "a.mcap").open("rb") as stream:
        found = [(m.log_time, c.topic) for _, c, m in make_reader(stream).iter_messages(log_time_order=False)]
    assert found == [(time, topic) for time in (10, 20) for topic in ("/a", "/b") for _ in range(50)]


def test_crcs_cover_each_chunk_and_all_data(recording: Path, tmp_path: Path) -> None:
    with LogFile(recording) as file:
        summary, fault = read_summary(file)
        assert (summary is not None, fault) == (True, None)
        assert summary.data_crc == zlib.crc32(file.read(0, summary.data_end_at)) != 0
    chunk, damaged = chunk_indexes(recording)[1], tmp_path / "damaged.mcap"
    damaged.write_bytes(recording.read_bytes())
    flip(damaged, chunk.chunk_start_offset + chunk.chunk_length // 2, 1)
    with damaged.open("rb") as stream, pytest.raises((McapError, ValueError, RuntimeError)):
        list(make_reader(stream, validate_crcs=True).iter_messages())


def test_latched_topics_offer_transient_local_in_numbers_that_all_rosbag2_read(recording: Path) -> None:
    """Versions that would expect words read numbers when the record ``rosbag2`` has no metadata of theirs."""
    with AnyReader([recording]) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
        assert sum(1 for _ in reader.messages()) == 20_001
    (start,) = offered["/start"]
    names = (start.durability.name, start.reliability.name, start.history.name)
    assert names == ("TRANSIENT_LOCAL", "RELIABLE", "KEEP_LAST")
    assert offered["/pose"] == []
    with recording.open("rb") as stream:
        reader = make_reader(stream)
        (channel,) = [c for c in reader.get_summary().channels.values() if c.topic == "/start"]  # type: ignore[union-attr]
        assert "durability: 1," in channel.metadata["offered_qos_profiles"]
        assert {m.name: m.metadata for m in reader.iter_metadata()}["rosbag2"] == {"serialized_metadata": ""}


def test_a_file_has_its_name_only_when_it_is_whole(tmp_path: Path) -> None:
    def break_off(path: Path) -> None:
        with written_whole(path) as stream:
            stream.write(b"half")
            raise ZeroDivisionError

    path = tmp_path / "new folder" / "log.mcap"
    with written_whole(path) as stream:
        stream.write(b"all of it")
        stream.flush()
        assert not path.exists()
    with pytest.raises(ZeroDivisionError):
        break_off(path)
    assert path.read_bytes() == b"all of it"
    assert list(path.parent.iterdir()) == [path]
    with pytest.raises(LogError, match=r"log\.mcap/a cannot be written: "):
        break_off(path / "a")


WRITER = """
import os, sys
from pathlib import Path
import numpy as np
from mcap.writer import Writer
from sonar_graph.logs.mcap import writer
from sonar_graph.logs.mcap.writer import Outgoing, write_recording

class Telling(Writer):
    def add_message(self, channel, time_ns, data, publish_ns):
        super().add_message(channel, time_ns, data, publish_ns)
        os.write(1, b"%d\\n" % time_ns)

writer.Writer, writer._CHUNK_BYTES = Telling, 65536
payloads = np.zeros((50_000, 1000), np.uint8)  # small when compressed: a chunk fits into a buffer
write_recording(Path(sys.argv[1]), [Outgoing("/n", "std_msgs/msg/Header", np.arange(50_000), payloads)], {})
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="there is no SIGKILL here")
def test_a_killed_writer_loses_at_most_its_open_chunk(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None
        told = 0
        while told < 3000:
            told = int(writer.stdout.readline())
        os.kill(writer.pid, signal.SIGKILL)
        rest, _ = writer.communicate()
    last = int(rest.splitlines()[-1]) if rest.endswith(b"\n") and rest.strip() else told
    assert not path.exists()  # never a file that looks complete
    recording = scan_all(path.with_name(f".partial-{path.name}"))
    found = recording.topics["/n"].log_times_ns
    np.testing.assert_array_equal(found, np.arange(len(found)))
    assert len(found) >= last - 65536 // 1000 - 1
    assert recording.ending is not None
