"""Logs that this package writes, read by itself and by others; and files that are whole or not there."""

import os
import signal
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader

from sonar_graph.errors import LogError
from sonar_graph.images import SonarFrames
from sonar_graph.logs import read_log, sonar_image_messages, write_log
from sonar_graph.logs.mcap import LogFile, write_recording
from sonar_graph.logs.mcap.log_file import open_seal
from sonar_graph.logs.writing import pose_messages, static_message
from sonar_graph.measurements import Imu
from sonar_graph.states import Trajectory

from .conftest import decode, scan_all

T0_NS = 1_700_000_000_000_000_000
BLOCKS = (
    "imu",
    "dvl",
    "depth",
    "heading",
    "positions",
    "detections",
    "truth",
    "true_landmarks",
)


@settings(max_examples=15)
@given(
    seed=st.integers(0, 2**31),
    samples=st.integers(1, 40),
    candidates=st.integers(1, 4),
    left_out=st.sets(st.sampled_from(BLOCKS[2:])),
)
def test_reading_what_was_written_is_the_identity(
    make_sequence, tmp_path_factory, seed, samples, candidates, left_out
):
    sequence = replace(
        make_sequence(seed, samples, candidates), **dict.fromkeys(left_out)
    )
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    write_log(path, sequence)
    found = read_log(path)
    for name in BLOCKS:
        expected = getattr(sequence, name)
        actual = getattr(found, name)
        assert (expected is None) == (actual is None), name
        for field, column in vars(expected).items() if expected is not None else ():
            np.testing.assert_array_equal(
                getattr(actual, field), column, f"{name}.{field}"
            )
    assert (found.name, found.calibration) == (sequence.name, sequence.calibration)
    assert found.notes.items() >= sequence.notes.items()


def test_stamps_and_samples_beyond_ros_are_refused(make_sequence, tmp_path):
    path = tmp_path / "a.mcap"
    for stamp_ns in (2**31 * 10**9, -(2**31) * 10**9 - 1):
        imu = Imu(np.array([stamp_ns]), np.zeros((1, 3)), np.zeros((1, 3)))
        with pytest.raises(LogError, match="32-bit seconds"):
            write_log(path, replace(make_sequence(), imu=imu))
    kinds = frames("u1"), frames("c16")
    images = (sonar_image_messages("/sonar/image", kind) for kind in kinds)
    with pytest.raises(LogError, match="/sonar/image: samples of type complex"):
        write_log(path, make_sequence(), images)
    assert list(tmp_path.iterdir()) == []
    path.write_text("not a folder")
    with pytest.raises(LogError, match=r"a\.mcap/b\.mcap cannot be written"):
        write_log(path / "b.mcap", make_sequence())


# --- sonar images ----------------------------------------------------------------------------------------------------


def frames(kind: str = "u1", count: int = 3) -> SonarFrames:
    intensity = np.arange(count * 20).reshape(count, 4, 5)
    stamps_ns = T0_NS + 123 + np.arange(count) * 10**8
    azimuths_rad = np.radians(np.linspace(14.0, -15.0, 4))
    ranges_m = np.linspace(1.26, 2.51, 5)
    return SonarFrames(stamps_ns, intensity.astype(kind), ranges_m, azimuths_rad)


def test_messages_made_one_by_one_lie_in_the_order_of_time(make_sequence, tmp_path):
    sequence = make_sequence()
    stamps_ns = sequence.imu.stamps_ns[[4, 12]]
    single = (
        replace(frames(count=1), stamps_ns=at_ns) for at_ns in np.split(stamps_ns, 2)
    )
    sonar = {"frequency_hz": 1.8e6, "sound_speed_m_s": 1480}
    images = [sonar_image_messages("/sonar/image", one, **sonar) for one in single]
    times = []
    for more in ([], images):
        write_log(tmp_path / "a.mcap", sequence, iter(more))
        with (tmp_path / "a.mcap").open("rb") as stream:
            records = StreamReader(stream).records
            times.append([r.log_time for r in records if isinstance(r, Message)])
    without, complete = times
    assert len(without) > 80
    assert without == sorted(without)
    assert complete == sorted([*without, *stamps_ns.tolist()])
    for message in decode(tmp_path / "a.mcap")["/sonar/image"]:
        said = message.ping_info.frequency, message.ping_info.sound_speed
        assert said == (np.float32(1.8e6), 1480)


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def long_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20,000 poses and a latched one, with metadata and an attached file."""
    path = tmp_path_factory.mktemp("recorder") / "a.mcap"
    positions = np.random.default_rng(0).normal(size=(20_000, 3))
    stamps_ns = T0_NS + np.arange(20_000) * 10**7
    truth = Trajectory.without_covariances(
        stamps_ns, positions, np.tile([0, 0, 0, 1.0], (20_000, 1))
    )
    poses = pose_messages("/pose", truth)
    still = static_message("/start", poses.type_name, T0_NS, poses.payloads[:1])
    write_recording(path, [still, poses], {"about": {"key": "value ψ"}})
    return path


def test_a_recording_has_the_records_of_rosbag2(long_log):
    with long_log.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        count = sum(1 for _ in reader.iter_messages())
        assert summary.statistics.message_count == count == 20_001
        indexes = summary.chunk_indexes
        assert len(indexes) > 3
        assert all(one.message_index_length and one.compression for one in indexes)
        records = {m.name: m.metadata for m in reader.iter_metadata()}
    assert open_seal(records["about"]) == ({"key": "value ψ"}, True)
    # versions that would expect words read numbers when the record has no metadata of theirs
    assert records["rosbag2"] == {"serialized_metadata": ""}
    offers = {c.topic: c.metadata for c in summary.channels.values()}
    assert "durability: 1," in offers["/start"]["offered_qos_profiles"]


def test_crcs_cover_each_chunk_and_all_data(long_log):
    assert scan_all(long_log).notes() == {}  # which names chunks without a CRC
    with LogFile(long_log) as file:
        assert (file.summary is not None, file.fault) == (True, None)
        stated = int.from_bytes(file.read(file.data_end_at + 9, 4), "little")
        assert stated == zlib.crc32(file.read(0, file.data_end_at)) != 0


def test_latched_topics_offer_transient_local_qos(long_log):
    with AnyReader([long_log]) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
        assert sum(1 for _ in reader.messages()) == 20_001
    (start,) = offered["/start"]
    names = (start.durability.name, start.reliability.name, start.history.name)
    assert names == ("TRANSIENT_LOCAL", "RELIABLE", "KEEP_LAST")
    assert offered["/pose"] == []


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
def test_a_killed_writer_loses_at_most_its_open_chunk(tmp_path):
    path = tmp_path / "log.mcap"
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE
    ) as writer:
        assert writer.stdout is not None
        told = 0
        while told < 3000:
            told = int(writer.stdout.readline())
        os.kill(writer.pid, signal.SIGKILL)
        rest, _ = writer.communicate()
    last = int(rest.splitlines()[-1]) if rest.endswith(b"\n") and rest.strip() else told
    assert not path.exists()  # never a file that looks complete
    (partial,) = tmp_path.glob(".log.mcap.*.partial.mcap")
    recording = scan_all(partial)
    found = recording.topics["/n"].log_times_ns
    np.testing.assert_array_equal(found, np.arange(len(found)))
    assert len(found) >= last - 65536 // 1000 - 1
    assert recording.ending is not None
