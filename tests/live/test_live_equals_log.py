"""Live equals log, to the bit: messages in the order of arrival against the record of them, read as a log."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonar_graph import Odometry, load_estimator, read_log, write_log
from sonar_graph.calibration import Calibration, KnownMap
from sonar_graph.errors import LogError
from sonar_graph.live import (
    Engine,
    LiveOptions,
    Message,
    definition_of,
    recorded_messages,
)
from sonar_graph.logs import LiveRecord, PartialCalibration
from sonar_graph.navigation import make_estimator
from sonar_graph.testing import aided_world, small_world
from tests.live.traffic import messages_of

NS = 1_000_000_000


def live(path: Path, messages: list[Message], **options):
    with LiveRecord(path) as record:
        engine = Engine(record, definition_of, LiveOptions(**options))
        generation = 0
        steps = []
        for message in messages:
            engine.take(message)
            if engine.generation != generation:
                generation = engine.generation
                steps = []
            for step in engine.steps():
                steps.append(step)
                assert len(steps) < 1000, "steps without end"
        steps += engine.finish()
    return engine, steps


def same_blocks(mine, theirs):
    assert (mine is None) == (theirs is None)
    if mine is not None:
        for name, column in vars(mine).items():
            assert np.array_equal(column, getattr(theirs, name), equal_nan=True), name


@pytest.mark.parametrize("delay_s", [0.0, 0.2, 0.6])
@pytest.mark.parametrize("world", [small_world, aided_world])
def test_a_record_gives_the_steps_that_were_live(tmp_path, world, delay_s):
    """With messages that come late by random times, also later than the budget, which are then dropped by name."""
    write_log(tmp_path / "log.mcap", world())
    messages = messages_of(tmp_path / "log.mcap", np.random.default_rng(3), delay_s)
    engine, steps = live(tmp_path / "record.mcap", messages)
    assert bool(engine.counts.dropped) == (delay_s > 0.25)
    record = read_log(tmp_path / "record.mcap")
    assert record.calibration == engine.calibration
    replayed = list(record.replay(record.instants(10.0)))
    assert [step.end_ns for step in steps] == [step.end_ns for step in replayed]
    for mine, theirs in zip(steps, replayed, strict=True):
        for name in record.blocks():
            same_blocks(getattr(mine, name), getattr(theirs, name))


@pytest.mark.parametrize(
    "name", ["isam2", "ekf-slam", "invariant-ekf", "dead-reckoning"]
)
def test_estimates_of_a_record_are_those_of_the_live_run_to_the_bit(tmp_path, name):
    write_log(tmp_path / "log.mcap", small_world())
    messages = messages_of(tmp_path / "log.mcap", np.random.default_rng(5), 0.4)
    _, steps = live(tmp_path / "record.mcap", messages)
    record = read_log(tmp_path / "record.mcap")
    bits = []
    for given in (steps, record.replay(record.instants(10.0))):
        estimator = load_estimator(name)(
            record.calibration, Odometry(record.calibration)
        )
        estimates = [estimator.process(step) for step in given]
        bits.append(
            b"".join(
                e.world_T_body.matrix().tobytes() + e.covariance.tobytes()
                for e in estimates
                if e
            )
        )
    assert bits[0] == bits[1]
    assert bits[0]


@pytest.mark.parametrize("name", ["isam2", "ekf-slam"])
def test_a_start_is_found_in_a_map_live_as_from_the_record_to_the_bit(tmp_path, name):
    """No pose before; the record keeps the map."""
    world = small_world()
    truth = world.true_landmarks
    known = KnownMap.of(truth.ids, truth.positions, sigma_m=0.02)
    given = PartialCalibration({"map": known.model_dump(mode="json")}, "map.toml")
    nowhere = world.calibration.model_dump(mode="json", exclude={"start"})
    unplaced = replace(world, calibration=Calibration.model_validate(nowhere))
    write_log(tmp_path / "log.mcap", unplaced)
    messages = messages_of(tmp_path / "log.mcap", np.random.default_rng(5), 0.2)
    engine, steps = live(tmp_path / "record.mcap", messages, calibration=given)
    assert engine.calibration.start.source == "map"
    record = read_log(tmp_path / "record.mcap")
    assert record.calibration == engine.calibration
    runs = []
    for run in (steps, record.replay(record.instants(10.0))):
        estimator = make_estimator(load_estimator(name), record.calibration)
        runs.append([estimator.process(step) for step in run])
    assert runs[0][0] is None
    assert runs[0][-1] is not None
    for mine, theirs in zip(*runs, strict=True):
        assert (mine is None) == (theirs is None)
        if mine is not None:
            np.testing.assert_array_equal(
                mine.world_T_body.matrix(), theirs.world_T_body.matrix()
            )
            np.testing.assert_array_equal(mine.covariance, theirs.covariance)


def test_a_record_whose_writer_was_killed_goes_on_as_if_nothing_had_been(tmp_path):
    """Half a record, cut within its last chunk, and the rest of the messages: the same steps as of one record."""
    write_log(tmp_path / "log.mcap", small_world())
    messages = messages_of(tmp_path / "log.mcap", np.random.default_rng(5), 0.4)
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
    assert [step.end_ns for step in resumed] == [step.end_ns for step in steps]
    for mine, theirs in zip(resumed, steps, strict=True):
        for name in ("imu", "dvl", "depth", "detections"):
            same_blocks(getattr(mine, name), getattr(theirs, name))


def test_rows_that_a_slow_estimator_missed_are_not_recorded(tmp_path):
    write_log(tmp_path / "log.mcap", small_world())
    messages = messages_of(tmp_path / "log.mcap", np.random.default_rng(5), 0.0)
    with LiveRecord(tmp_path / "record.mcap") as record:
        engine = Engine(record, definition_of)
        steps = []
        for message in messages:
            engine.take(message)
            steps += [
                engine.without_detections(s, message.arrival_ns) for s in engine.steps()
            ]
        steps += [
            engine.without_detections(s, messages[-1].arrival_ns)
            for s in engine.finish()
        ]
    assert all(step.detections is None for step in steps)
    assert sum(engine.counts.dropped.values()) >= 30
    assert read_log(tmp_path / "record.mcap").detections is None


def test_gaps_of_sequence_numbers_are_losses_by_topic(tmp_path):
    write_log(tmp_path / "log.mcap", small_world())
    numbers: dict[str, int] = {}
    messages = []
    for message in messages_of(tmp_path / "log.mcap", np.random.default_rng(5), 0.0):
        numbers[message.topic] = number = numbers.get(message.topic, 0) + 1
        if message.topic != "/dvl/data" or number % 10 != 5:
            messages.append(message._replace(sequence=number))
    engine, _ = live(tmp_path / "record.mcap", messages)
    assert +engine.counts.lost == {"/dvl/data": 10}


def test_a_topic_that_was_chosen_may_come_late(tmp_path):
    write_log(tmp_path / "log.mcap", small_world())
    messages = messages_of(tmp_path / "log.mcap", np.random.default_rng(5), 0.0)
    late_ns = messages[0].arrival_ns + 5 * NS
    with LiveRecord(tmp_path / "record.mcap") as record:
        engine = Engine(
            record,
            definition_of,
            LiveOptions(topics={"detections": "/sonar/landmarks"}),
        )
        waited_for = set()
        for message in messages:
            if message.topic != "/sonar/landmarks" or message.arrival_ns > late_ns:
                engine.take(message)
            if message.arrival_ns < late_ns - NS:
                assert engine.calibration is None
            waited_for.add(engine.waits_for)
        assert engine.calibration is not None
        assert any("/sonar/landmarks" in text for text in waited_for)
        assert sum(1 for _ in engine.steps()) > 100


def test_several_topics_for_one_role_are_recorded_with_advice(
    tmp_path,
):
    write_log(tmp_path / "log.mcap", small_world())
    messages = messages_of(tmp_path / "log.mcap", np.random.default_rng(5), 0.0)
    both = [
        again
        for m in messages
        for again in (
            [m, m._replace(topic="/imu/other")] if m.topic == "/imu/data" else [m]
        )
    ]
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
    with (
        LiveRecord(tmp_path / "record.mcap"),
        pytest.raises(LogError, match=r"record\.mcap: a record is there already"),
    ):
        LiveRecord(tmp_path / "record.mcap")
