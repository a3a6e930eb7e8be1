from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from sonar_graph.logs.mcap.file_summary import read_summary
from sonar_graph.logs.mcap.records import LogFile, open_seal
from sonar_graph.logs.mcap.writer import Attachment, Outgoing, write_recording
from sonar_graph.logs.writing import pose_messages, static_message
from sonar_graph.states import Trajectory

T0_NS = 1_700_000_000_000_000_000


def poses(n: int = 20_000) -> Outgoing:
    stamps_ns = T0_NS + np.arange(n) * 10**7
    positions = np.random.default_rng(0).normal(size=(n, 3))
    return pose_messages("/pose", Trajectory.without_covariances(stamps_ns, positions, np.tile([0, 0, 0, 1.0], (n, 1))))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorder") / "a.mcap"
    still = poses(1)
    messages = [static_message("/start", still.type_name, T0_NS, still.payloads), poses()]
    file = Attachment("notes/a.json", "application/json", b'{"a": 1}')
    write_recording(path, messages, {"about": {"key": "value ψ"}}, [file])
    return path


def test_profile_index_and_counts_are_those_of_a_ros_2_recording(recording: Path) -> None:
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


def test_a_flipped_bit_in_a_chunk_does_not_pass_its_crc(recording: Path, tmp_path: Path) -> None:
    with recording.open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[1]  # type: ignore[union-attr]
    octets = bytearray(recording.read_bytes())
    octets[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(octets)
    with (tmp_path / "damaged.mcap").open("rb") as stream, pytest.raises((McapError, ValueError, RuntimeError)):
        list(make_reader(stream, validate_crcs=True).iter_messages())


def test_metadata_and_attachments_are_found_by_name(recording: Path) -> None:
    with recording.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        about = {m.name: m.metadata for m in reader.iter_metadata()}["about"]
        assert open_seal(about) == ({"key": "value ψ"}, True)
        (file,) = reader.iter_attachments()
    assert (file.name, file.media_type, file.data) == ("notes/a.json", "application/json", b'{"a": 1}')


def test_a_crc_covers_all_data(recording: Path) -> None:
    with LogFile(recording) as file:
        summary, fault = read_summary(file)
        assert (summary is not None, fault) == (True, None)
        assert summary.data_crc == zlib.crc32(file.read(0, summary.data_end_at)) != 0


def test_latched_topics_offer_transient_local_in_numbers_that_all_rosbag2_read(recording: Path) -> None:
    """Versions that would expect words read numbers when the record ``rosbag2`` has no metadata of theirs."""
    with AnyReader([recording]) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
        assert sum(1 for _ in reader.messages()) == 20_001
    (start,) = offered["/start"]
    assert (start.durability.name, start.reliability.name, start.history.name) == (
        "TRANSIENT_LOCAL",
        "RELIABLE",
        "KEEP_LAST",
    )
    assert offered["/pose"] == []
    with recording.open("rb") as stream:
        reader = make_reader(stream)
        (channel,) = [c for c in reader.get_summary().channels.values() if c.topic == "/start"]  # type: ignore[union-attr]
        assert "durability: 1," in channel.metadata["offered_qos_profiles"]
        assert {m.name: m.metadata for m in reader.iter_metadata()}["rosbag2"] == {"serialized_metadata": ""}
