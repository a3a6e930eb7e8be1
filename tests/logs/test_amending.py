"""A log written again: everything that was in it, and what was added; also where it is not whole."""

import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from sonar_graph.errors import LogError
from sonar_graph.logs import landmark_map_message, write_amended
from sonar_graph.logs.mcap import Keep, Outgoing, is_own_log, scan
from sonar_graph.states import LandmarkMap

from .conftest import writing

MAP = "sonar_graph_msgs/msg/LandmarkMap"
IMU_TEXT = b"float64 x"
BINARY_SCHEMA = bytes(range(256))


def foreign_log(
    path: Path, count: int = 400, profile: str = "ros2", tick_ns: int = 10
) -> Path:
    """A log of another program: two encodings, publish times that differ, metadata and an attachment."""
    with writing(path, profile, chunk_size=2000, enable_data_crcs=True) as writer:
        text = writer.register_schema("a/msg/B", "ros2msg", IMU_TEXT)
        binary = writer.register_schema("c.D", "protobuf", BINARY_SCHEMA)
        one = writer.register_channel(
            "/one", "cdr", text, {"offered_qos_profiles": "- {durability: 1}"}
        )
        other = writer.register_channel("/other", "protobuf", binary)
        bare = writer.register_channel("/bare", "json", 0)
        writer.add_metadata("about", {"ship": "Vessel"})
        writer.add_attachment(1, 2, "notes.txt", "text/plain", b"of the dive")
        for k in range(count):
            at_ns = tick_ns * k
            writer.add_message(
                one, at_ns, struct.pack("<Id", 256, k), at_ns - (3 if k else 0), k
            )
            writer.add_message(
                (other, bare)[k % 2],
                at_ns + 1,
                bytes([k % 256]) * (k % 50),
                at_ns + 1,
                7,
            )
    return path


def content(path: Path) -> dict[str, list]:
    """All that a reader by another hand finds."""
    found: dict[str, list] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream)
        for schema, channel, message in reader.iter_messages():
            described = (schema.name, schema.encoding, schema.data) if schema else None
            entry = (
                message.log_time,
                message.publish_time,
                message.sequence,
                message.data,
            )
            found.setdefault(
                channel.topic, [(described, channel.message_encoding, channel.metadata)]
            ).append(entry)
        found["metadata"] = [
            (record.name, record.metadata) for record in reader.iter_metadata()
        ]
        found["attachments"] = [
            (a.name, a.media_type, a.log_time, a.data)
            for a in reader.iter_attachments()
        ]
    return found


def landmarks(time_ns: int, topic: str = "/map") -> Outgoing:
    known = LandmarkMap(np.array([3]), np.array([[1.0, 2.0, 3.0]]), np.eye(3)[None])
    return landmark_map_message(topic, known, time_ns)


@pytest.mark.parametrize("profile", ["ros2", "", "x" * 40])
def test_an_amended_log_has_the_old_bytes_and_the_new_messages(tmp_path, profile):
    source = foreign_log(tmp_path / "a.mcap", profile=profile)
    amended = write_amended(
        source,
        tmp_path / "b.mcap",
        [landmarks(2005)],
        metadata={"more": {"key": "value"}},
    )
    before = content(source)
    after = content(tmp_path / "b.mcap")
    assert after.pop("/map")[1][:2] == (2005, 2005)
    (name, record) = after["metadata"].pop()
    assert (name, record["key"]) == ("more", "value")
    assert after == before
    assert (amended.replaced, amended.notes) == ({}, {})
    with (tmp_path / "b.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == profile
        times_ns = [
            m.log_time for _, _, m in reader.iter_messages(log_time_order=False)
        ]
    assert times_ns == sorted(times_ns)
    assert is_own_log(tmp_path / "b.mcap")
    assert not is_own_log(source)


@pytest.mark.parametrize("share", [0.3, 0.77])
def test_intact_messages_of_a_truncated_log_are_copied(tmp_path, share):
    """The length of what is there is counted from its first message."""
    whole = foreign_log(tmp_path / "a.mcap", tick_ns=100_000_000).read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(share * len(whole))])
    amended = write_amended(cut, tmp_path / "b.mcap", [landmarks(15)])
    before = content(tmp_path / "a.mcap")
    after = content(tmp_path / "b.mcap")
    assert len(after.pop("/map")) == 2
    for name, found in after.items():
        assert found == before[name][: len(found)]
    assert after["attachments"] == before["attachments"]
    topics = scan(cut, lambda _: Keep.NONE).topics
    assert {name: len(after[name]) - 1 for name in topics} == {
        name: len(topic) for name, topic in topics.items()
    }
    assert 0.5 * share < (len(after["/one"]) - 1) / 400 < 1.5 * share
    assert scan(tmp_path / "b.mcap", lambda _: Keep.NONE).ending is None
    last_ns = max(after[name][-1][0] for name in topics)
    said = f"cut off.*what is there spans {last_ns * 1e-9:.3f} s"
    assert re.search(said, amended.notes["log.ending"])


def test_existing_topics_are_refused_unless_they_are_replaced(
    tmp_path,
):
    source = foreign_log(tmp_path / "a.mcap")
    once = tmp_path / "once.mcap"
    twice = tmp_path / "twice.mcap"
    write_amended(source, once, [landmarks(5)])
    with pytest.raises(LogError, match=r"/map .* is in the log already"):
        write_amended(once, twice, [landmarks(6)])
    with pytest.raises(
        LogError, match=r"/one \(a/msg/B\) is in the log already"
    ):  # of another type
        write_amended(
            source, twice, [replace(landmarks(5), topic="/one")], anew={"/one": MAP}
        )
    amended = write_amended(once, twice, [landmarks(6)], anew={"/map": MAP})
    assert amended.replaced == {"/map": 1}
    assert [message[0] for message in content(twice)["/map"][1:]] == [6]
    write_amended(once, twice, [], anew={"/map": MAP})  # nothing comes in its place
    assert content(twice) == content(source)
    with pytest.raises(LogError, match="is the log itself"):
        write_amended(source, source, [])


def test_a_damaged_attachment_is_left_out_and_named(tmp_path):
    source = foreign_log(tmp_path / "a.mcap")
    (tmp_path / "bad.mcap").write_bytes(
        source.read_bytes().replace(b"of the dive", b"of the dove")
    )
    amended = write_amended(
        tmp_path / "bad.mcap", tmp_path / "b.mcap", [], salvage=True
    )
    assert "damaged and left out" in amended.notes["log.attachments"]
    assert content(tmp_path / "b.mcap")["attachments"] == []


def test_messages_in_pieces_are_merged_under_a_new_topic(
    tmp_path,
):
    source = foreign_log(tmp_path / "source.mcap")
    plain = tmp_path / "plain.mcap"
    streamed = tmp_path / "streamed.mcap"
    entries = [landmarks(time_ns) for time_ns in (5, 1005, 2005)]
    write_amended(source, plain, entries)
    write_amended(source, streamed, [], more=iter(entries))
    assert content(streamed) == content(plain)
    taken = next(iter(content(source)))
    with pytest.raises(LogError, match="is in the log already"):
        write_amended(source, streamed, [], more=iter([landmarks(5, taken)]))
