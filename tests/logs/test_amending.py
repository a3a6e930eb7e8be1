"""A log written again: everything that was in it, and what was added; also where it is not whole."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from sonar_graph.errors import LogError
from sonar_graph.logs import landmark_map_message, write_amended
from sonar_graph.logs.mcap import Keep, Outgoing, is_own_log, scan
from sonar_graph.states import LandmarkMap

from .conftest import cut, flip, recorded, writing

MAP = "sonar_graph_msgs/msg/LandmarkMap"


def foreign_log(
    path: Path, count: int = 400, profile: str = "ros2", tick_ns: int = 10
) -> Path:
    """A log of another program: two encodings, publish times that differ, metadata and an attachment."""
    with writing(path, profile, chunk_size=2000, enable_data_crcs=True) as writer:
        text = writer.register_schema("a/msg/B", "ros2msg", b"float64 x")
        binary = writer.register_schema("c.D", "protobuf", bytes(range(256)))
        offer = {"offered_qos_profiles": "- {durability: 1}"}
        one = writer.register_channel("/one", "cdr", text, offer)
        other = writer.register_channel("/other", "protobuf", binary)
        bare = writer.register_channel("/bare", "json", 0)
        writer.add_metadata("about", {"ship": "Vessel"})
        writer.add_attachment(1, 2, "notes.txt", "text/plain", b"of the dive")
        for k in range(count):
            at_ns = tick_ns * k
            sent_ns = at_ns - (3 if k else 0)
            writer.add_message(one, at_ns, struct.pack("<Id", 256, k), sent_ns, k)
            payload = bytes([k % 256]) * (k % 50)
            at_ns += 1
            writer.add_message((other, bare)[k % 2], at_ns, payload, at_ns, 7)
    return path


def content(path: Path) -> dict[str, list]:
    """All that a reader by another hand finds: each topic's description and messages, metadata and attachments."""
    found: dict[str, list] = {}
    for schema, channel, m in recorded(path):
        described = (schema.name, schema.encoding, schema.data) if schema else None
        head = described, channel.message_encoding, channel.metadata
        entry = m.log_time, m.publish_time, m.sequence, m.data
        found.setdefault(channel.topic, [head]).append(entry)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        found["metadata"] = [(m.name, m.metadata) for m in reader.iter_metadata()]
        found["attachments"] = [
            (a.name, a.media_type, a.log_time, a.data)
            for a in reader.iter_attachments()
        ]
    return found


def landmarks(time_ns: int, topic: str = "/map") -> Outgoing:
    known = LandmarkMap(np.array([3]), np.array([[1.0, 2.0, 3.0]]), np.eye(3)[None])
    return landmark_map_message(topic, known, time_ns)


@pytest.mark.parametrize(
    ("profile", "is_streamed"), [("ros2", False), ("", True), ("x" * 40, False)]
)
def test_an_amended_log_has_the_old_bytes_and_the_new_messages(
    tmp_path, profile, is_streamed
):
    source = foreign_log(tmp_path / "a.mcap", profile=profile)
    target = tmp_path / "b.mcap"
    times_ns = [5, 1005, 2005]
    new = map(landmarks, times_ns)
    added, more = ([], new) if is_streamed else (list(new), [])
    record = {"more": {"key": "value"}}
    amended = write_amended(source, target, added, more=more, metadata=record)
    before = content(source)
    after = content(target)
    assert [entry[:2] for entry in after.pop("/map")[1:]] == [(t, t) for t in times_ns]
    (name, found) = after["metadata"].pop()
    assert (name, found["key"]) == ("more", "value")
    assert after == before
    assert (amended.replaced, amended.notes) == ({}, {})
    with target.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == profile
        messages = reader.iter_messages(log_time_order=False)
        times_ns = [m.log_time for _, _, m in messages]
    assert times_ns == sorted(times_ns)
    assert is_own_log(target)
    assert not is_own_log(source)


@pytest.mark.parametrize("share", [0.3, 0.77])
def test_intact_messages_of_a_truncated_log_are_copied(tmp_path, share):
    """The length of what is there is counted from its first message."""
    source = foreign_log(tmp_path / "a.mcap", tick_ns=100_000_000)
    before = content(source)
    cut(source, int(share * source.stat().st_size))
    target = tmp_path / "b.mcap"
    amended = write_amended(source, target, [landmarks(15)])
    after = content(target)
    assert len(after.pop("/map")) == 2
    for name, found in after.items():
        assert found == before[name][: len(found)]
    topics = scan(source, lambda _: Keep.NONE).topics
    for name, topic in topics.items():
        assert len(after[name]) == 1 + len(topic)
    assert scan(target, lambda _: Keep.NONE).ending is None
    last_ns = max(after[name][-1][0] for name in topics)
    said = f"cut off.*what is there spans {last_ns * 1e-9:.3f} s"
    assert re.search(said, amended.notes["log.ending"])


def test_existing_topics_are_refused_unless_they_are_replaced(tmp_path):
    source = foreign_log(tmp_path / "a.mcap")
    once = tmp_path / "once.mcap"
    twice = tmp_path / "twice.mcap"
    write_amended(source, once, [landmarks(5)])
    of_another_type = {"added": [landmarks(5, "/one")], "anew": {"/one": MAP}}
    for log, target, given, message in (
        (once, twice, {"added": [landmarks(6)]}, r"/map .* is in the log already"),
        (source, twice, of_another_type, r"/one \(a/msg/B\) is in the log already"),
        (
            source,
            twice,
            {"added": [], "more": [landmarks(5, "/one")]},
            "in the log alr",
        ),
        (source, source, {"added": []}, "is the log itself"),
    ):
        with pytest.raises(LogError, match=message):
            write_amended(log, target, **given)
    amended = write_amended(once, twice, [landmarks(6)], anew={"/map": MAP})
    assert amended.replaced == {"/map": 1}
    assert [message[0] for message in content(twice)["/map"][1:]] == [6]
    write_amended(once, twice, [], anew={"/map": MAP})  # nothing comes in its place
    assert content(twice) == content(source)


def test_a_damaged_attachment_is_left_out_and_named(tmp_path):
    path = foreign_log(tmp_path / "a.mcap")
    flip(path, path.read_bytes().index(b"of the dive"))
    amended = write_amended(path, tmp_path / "b.mcap", [], salvage=True)
    assert "damaged and left out" in amended.notes["log.attachments"]
    assert content(tmp_path / "b.mcap")["attachments"] == []
