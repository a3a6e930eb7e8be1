"""Live equals log, to the bit: messages in the order of arrival against the record of them, read as a log."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph import load_estimator, read_log, write_log
from sonar_graph.calibration import Calibration, KnownMap
from sonar_graph.errors import LogError
from sonar_graph.live import Engine, LiveOptions, definition_of, recorded_messages
from sonar_graph.logs import LiveRecord, PartialCalibration
from sonar_graph.navigation import make_estimator
from sonar_graph.testing import aided_world, small_world
from tests.live.traffic import (
    NS,
    assert_record_equals,
    assert_same_steps,
    live,
    messages_of,
)


def test_a_record_gives_the_steps_that_were_live(tmp_path):
    """With messages that come late by random times, also later than the budget, which are then dropped by name."""
    come = messages_from(tmp_path, aided_world(), 0.6)
    engine, steps = live(tmp_path / "record.mcap", come)
    assert engine.counts.dropped
    assert_record_equals(engine, steps)


def messages_from(tmp_path, world, delay_s=0.0):
    write_log(tmp_path / "log.mcap", world)
    return messages_of(tmp_path / "log.mcap", np.random.default_rng(5), delay_s)


def assert_same_estimates(name, steps, path):
    """An estimator's poses and covariances of live steps are those of the record, to the bit; the first and the last."""
    record = read_log(path)
    bits = []
    for given in (steps, record.replay(record.instants(10.0))):
        estimator = make_estimator(load_estimator(name), record.calibration)
        found = [estimator.process(step) for step in given]
        numbers = [e and (e.world_T_body.matrix(), e.covariance) for e in found]
        bits.append([each and [a.tobytes() for a in each] for each in numbers])
    assert bits[0] == bits[1]
    return found[0], found[-1]


@pytest.mark.parametrize(
    "name", ["isam2", "ekf-slam", "invariant-ekf", "dead-reckoning"]
)
def test_estimates_of_a_record_are_those_of_the_live_run_to_the_bit(tmp_path, name):
    record = tmp_path / "record.mcap"
    _, steps = live(record, messages_from(tmp_path, small_world(), 0.4))
    _, last = assert_same_estimates(name, steps, record)
    assert last is not None


@pytest.mark.parametrize("name", ["isam2", "ekf-slam"])
def test_a_start_is_found_in_a_map_live_as_from_the_record_to_the_bit(tmp_path, name):
    """No pose before; the record keeps the map."""
    world = small_world()
    truth = world.true_landmarks
    known = KnownMap.of(truth.ids, truth.positions, sigma_m=0.02)
    given = PartialCalibration({"map": known.model_dump(mode="json")}, "map.toml")
    nowhere = world.calibration.model_dump(mode="json", exclude={"start"})
    unplaced = replace(world, calibration=Calibration.model_validate(nowhere))
    come = messages_from(tmp_path, unplaced, 0.2)
    engine, steps = live(tmp_path / "record.mcap", come, calibration=given)
    assert engine.calibration.start.source == "map"
    assert_record_equals(engine, steps)
    first, last = assert_same_estimates(name, steps, tmp_path / "record.mcap")
    assert first is None
    assert last is not None


def test_a_record_whose_writer_was_killed_goes_on_as_if_nothing_had_been(tmp_path):
    """Half a record, cut within its last chunk, and the rest of the messages: the same steps as of one record."""
    messages = messages_from(tmp_path, small_world(), 0.4)
    _, steps = live(tmp_path / "whole.mcap", messages)
    with LiveRecord(tmp_path / "half.mcap") as half:
        engine = Engine(half, definition_of)
        for message in messages[: len(messages) // 2]:
            engine.take(message)
            list(engine.steps())
        half.flush()
        written = (tmp_path / "half.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(written[: 6 * len(written) // 10])
    kept = list(recorded_messages(tmp_path / "cut.mcap"))
    assert 0 < len(kept) < len(messages) // 2
    again = [*kept, *messages[len(kept) :]]
    _, resumed = live(tmp_path / "resumed.mcap", again)
    assert_same_steps(resumed, steps)


def test_gaps_of_sequence_numbers_are_losses_by_topic(tmp_path):
    numbers = Counter()
    messages = []
    for message in messages_from(tmp_path, small_world()):
        topic = message.topic
        numbers[topic] += 1
        if topic != "/dvl/data" or numbers[topic] % 10 != 5:
            messages.append(message._replace(sequence=numbers[topic]))
    engine, _ = live(tmp_path / "record.mcap", messages)
    assert +engine.counts.lost == {"/dvl/data": 10}


def test_a_topic_that_was_chosen_may_come_late(tmp_path):
    topic = "/sonar/landmarks"
    messages = messages_from(tmp_path, small_world())
    late_ns = messages[0].arrival_ns + 5 * NS
    options = LiveOptions(topics={"detections": topic})
    waited_for = set()
    with LiveRecord(tmp_path / "record.mcap") as record:
        engine = Engine(record, definition_of, options)
        for message in messages:
            if message.topic != topic or message.arrival_ns > late_ns:
                engine.take(message)
            if message.arrival_ns < late_ns - NS:
                assert engine.calibration is None
            waited_for.add(engine.waits_for)
        assert engine.calibration is not None
        assert topic in "".join(waited_for)
        assert len(list(engine.steps())) > 100


def test_several_topics_for_one_role_are_recorded_with_advice(tmp_path):
    messages = messages_from(tmp_path, small_world())
    other = [m._replace(topic="/imu/other") for m in messages if m.topic == "/imu/data"]
    both = sorted([*messages, *other], key=lambda message: message.arrival_ns)
    engine, steps = live(tmp_path / "first.mcap", both)
    assert not steps
    assert "/imu/other" in engine.waits_for
    assert "begin again with a choice" in engine.waits_for
    assert sum(engine.counts.received.values()) == len(both)
    kept = list(recorded_messages(tmp_path / "first.mcap"))
    engine, steps = live(tmp_path / "second.mcap", kept, topics={"imu": "/imu/data"})
    assert len(steps) > 100
    assert engine.in_use["imu"] == "/imu/data"


def test_a_record_that_was_begun_at_the_same_instant_is_named(tmp_path):
    path = tmp_path / "record.mcap"
    told = r"record\.mcap: a record is there already"
    with LiveRecord(path), pytest.raises(LogError, match=told):
        LiveRecord(path)
