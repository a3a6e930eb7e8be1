"""Logs with images as they come from real dives: damaged, cut off, with a window that changes, with two sonars."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.errors import LogError
from sonar_graph.images import SonarFrames
from sonar_graph.logs import read_log, sonar_image_messages, write_log
from sonar_graph.recognition import NO_FLOOR, Recognition, recognise_images
from sonar_graph.recognition.session import LEAPT
from tests.recognition.imaged_lane import TOPIC, Lane

COUNT = 70
SECONDS = 10**9


def frames_of(lane: Lane) -> list[SonarFrames]:
    return [lane.one(k) for k in range(COUNT)]


def recognised(
    lane: Lane, log: Path, frames: list[SonarFrames] | None = None, **changes: object
) -> Recognition:
    """What is recognised in a log with frames; changes are of message 30."""
    blocks = frames or frames_of(lane)
    messages = [sonar_image_messages(TOPIC, frame) for frame in blocks]
    if changes:
        messages[30] = replace(messages[30], **changes)
    write_log(log, lane.sequence, messages)
    return recognise_images(log, read_log(log))


@pytest.fixture
def log(tmp_path) -> Path:
    return tmp_path / "log.mcap"


def sure(found: Recognition) -> set[int]:
    ids, probability = found.detections.most_probable()
    return set(ids[probability > 0.9].tolist())


@pytest.fixture(scope="module")
def plain(lane, tmp_path_factory) -> Recognition:
    return recognised(lane, tmp_path_factory.mktemp("plain") / "log.mcap")


def test_two_windows_in_turn_are_both_used(lane, log, plain):
    frames = frames_of(lane)
    for k in range(1, COUNT, 2):
        image = frames[k].intensity
        ranges_m = frames[k].ranges_m
        cropped = {"intensity": image[:, :, :450], "ranges_m": ranges_m[:450]}
        frames[k] = replace(frames[k], **cropped)
    found = recognised(lane, log, frames)
    assert sum("not used" in reason for _, reason in found.warnings) == 1
    assert sure(found) == sure(plain)
    stamps = [int(frame.stamps_ns[0]) for frame in frames]
    used = found.detections.stamps_ns.tolist()
    assert {stamps.index(stamp) % 2 for stamp in used} == {0, 1}


def test_a_leap_of_the_clock_costs_one_frame(lane, log, plain):
    frames = frames_of(lane)
    recorded_ns = frames[30].stamps_ns
    stamps_ns = recorded_ns + 10 * SECONDS
    frames[30] = replace(frames[30], stamps_ns=stamps_ns)
    found = recognised(lane, log, frames, log_times_ns=recorded_ns)
    assert found.warnings == [(int(stamps_ns[0]), f"frame not used: {LEAPT}")]
    assert len(found.detections) >= len(plain.detections) - 3


def test_bad_frames_are_never_drawn(lane, log):
    frames = [
        replace(f, intensity=np.full(f.intensity.shape, np.nan, np.float32))
        for f in frames_of(lane)[:12]
    ]
    found = recognised(lane, log, frames)
    assert found.pictures == []
    assert found.outcomes == {"frame not used: samples that are not finite": 12}


def test_a_hole_is_refused_and_with_salvage_named_and_the_rest_is_used(lane, log):
    messages = [sonar_image_messages(TOPIC, frame) for frame in frames_of(lane)]
    write_log(log, lane.sequence, messages)
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 0xFF
    log.write_bytes(data)
    with pytest.raises(LogError, match="--salvage"):
        read_log(log)
    sequence = read_log(log, salvage=True)
    assert "lost" in sequence.notes["log.damage"]
    found = recognise_images(log, sequence, salvage=True)
    assert COUNT / 2 < found.frames < COUNT


def test_a_log_without_depth_and_floor_is_recognised_in_the_image_plane(lane, log):
    calibration = lane.sequence.calibration.model_copy(update={"floor": None})
    bare = replace(lane.sequence, depth=None, calibration=calibration)
    found = recognised(replace(lane, sequence=bare), log)
    assert found.frames == COUNT
    assert found.warnings == []
    assert found.outcomes[NO_FLOOR] == COUNT
    assert found.detections is not None
