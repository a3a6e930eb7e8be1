"""Rows that estimators refuse, and what they withhold, are named to the user, from the log to the files."""

import json
import math
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from sonar_graph.estimator import installed_estimators, load_estimator, refused_rows_of
from sonar_graph.evaluation import (
    MOST_ROWS_NAMED,
    RunResult,
    gathered,
    read_comparison,
    run_estimator,
    write_comparison,
)
from sonar_graph.logs import read_log, write_log
from sonar_graph.measurements import Heading, Measurements, PositionFixes
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.states import Estimate, Outcome, Refusal, RefusedRow
from tests.synthetic import late, outlier, refusing, with_run

from .conftest import straight_sequence

HELD_NS = 3 * 10**9, 3 * 10**9 + 500_000_000
ESTIMATORS = list(installed_estimators())
NS = 10**9


def test_few_rows_are_named_each_and_many_are_counted_by_sensor_and_reason():
    few = [outlier(k, 50.0 + k) for k in range(MOST_ROWS_NAMED)]
    assert [
        (rows.count, rows.first_ns, rows.distances()) for rows in gathered(few[::-1])
    ] == [(1, k, f"{50 + k}") for k in range(MOST_ROWS_NAMED)]
    (many,) = gathered([*few, outlier(99, 7.5)])
    assert (many.count, many.first_ns, many.last_ns) == (MOST_ROWS_NAMED + 1, 0, 99)
    assert (many.times(-NS), many.distances()) == ("1.000 to 1.000", "7.50 to 54")
    # rows that differ in their time alone are one line
    (waited,) = gathered([late(0), late(7)])
    assert (waited.count, waited.first_ns, waited.last_ns) == (2, 0, 7)
    rows = (
        [outlier(k) for k in range(9)]
        + [late(k) for k in range(9)]
        + [RefusedRow("dvl", 3, Refusal.LATE, math.nan)]
    )
    found = Counter({(rows.sensor, rows.reason): rows.count for rows in gathered(rows)})
    assert found == {
        ("dvl", Refusal.OUTLIER): 9,
        ("imu", Refusal.LATE): 9,
        ("dvl", Refusal.LATE): 1,
    }


def test_files_have_counts_for_people_and_every_row_for_the_report(tmp_path):
    rows = [outlier(k * NS, 50.0 + k) for k in range(8)] + [late(3)]
    comparison = refusing(rows, "isam2", "ekf-slam")
    comparison = with_run(
        comparison, replace(comparison.runs[0], withheld=["landmark 3; open: z"])
    )
    write_comparison(comparison, tmp_path)
    content = json.loads((tmp_path / "comparison.json").read_text())
    told = content["runs"]["isam2"]["refused"]
    expected = {
        "sensor": "dvl",
        "reason": Refusal.OUTLIER.value,
        "count": 8,
        "first_ns": 0,
        "last_ns": 7 * NS,
    }
    assert told[0] == {**expected, "least_and_largest_distance": [50.0, 57.0]}
    assert told[1]["least_and_largest_distance"] is None
    restored = read_comparison(tmp_path)
    assert [run.withheld for run in restored.runs] == [["landmark 3; open: z"], [], []]
    for run, again in zip(comparison.runs, restored.runs, strict=True):
        assert [row[:3] for row in again.refused] == [row[:3] for row in run.refused]
        np.testing.assert_array_equal(
            [row.distance for row in again.refused],
            [row.distance for row in run.refused],
        )


@pytest.fixture(scope="module")
def straight() -> Sequence:
    return straight_sequence(8.0)


@pytest.fixture(scope="module")
def mission() -> Sequence:
    return simulate_mission(MissionOptions(duration_s=20.0))


def changed(
    sequence: Sequence, sensor: str, column: str, rows: list[int], value: Any
) -> Sequence:
    """Some rows of a column have another value."""
    block = getattr(sequence, sensor)
    values = getattr(block, column).copy()
    values[rows] = value
    return replace(sequence, **{sensor: replace(block, **{column: values})})


def without(sequence: Sequence, sensor: str, rows: list[int]) -> Sequence:
    block = getattr(sequence, sensor)
    return replace(
        sequence, **{sensor: block.rows(np.delete(np.arange(len(block)), rows))}
    )


@pytest.mark.parametrize("name", ESTIMATORS)
def test_outliers_are_named_and_not_used(straight, name):
    rows = [20, 41, 42, 60]
    run = run_estimator(changed(straight, "dvl", "velocity", rows, 3.0), name)
    clean = run_estimator(without(straight, "dvl", rows), name)
    assert run.status == "ok"
    assert [(row.sensor, row.stamp_ns, row.reason) for row in run.refused] == [
        ("dvl", int(straight.dvl.stamps_ns[k]), Refusal.OUTLIER) for k in rows
    ]
    assert min(row.distance for row in run.refused) > 44.8
    assert not clean.refused
    assert run.causal.positions == pytest.approx(clean.causal.positions, abs=1e-9)


def assert_same_numbers(one: RunResult, other: RunResult) -> None:
    assert (one.status, other.status) == ("ok", "ok")
    for part in ("positions", "quaternions_xyzw", "covariances"):
        np.testing.assert_array_equal(
            getattr(one.causal, part), getattr(other.causal, part)
        )
        np.testing.assert_array_equal(
            getattr(one.smoothed, part), getattr(other.smoothed, part)
        )
    np.testing.assert_array_equal(one.landmarks.positions, other.landmarks.positions)


BAD_ROWS = [
    ("depth", "z_m", list(range(7, 150, 20)), -1000.0, Refusal.OUT_OF_REACH),
    ("depth", "z_m", [40], 100.0, Refusal.OUT_OF_REACH),
    ("depth", "z_m", [0, 1], -1000.0, Refusal.OUT_OF_REACH),
    ("depth", "variance_m2", [60], -1.0, Refusal.UNSOUND),
    ("imu", "angular_velocity", [900], 1e9, Refusal.BEYOND_SENSOR),
    ("imu", "angular_velocity", [0, 950], -36.0, Refusal.BEYOND_SENSOR),
    ("imu", "specific_force", [1000], -1e9, Refusal.BEYOND_SENSOR),
    ("imu", "specific_force", [1050], np.inf, Refusal.BEYOND_SENSOR),
]


@pytest.mark.parametrize("name", ESTIMATORS)
def test_rows_that_no_sensor_or_vehicle_gives_are_named_and_change_nothing(
    mission, name
):
    spoilt = mission
    left_out = {"depth": [], "imu": []}
    expected = []
    for sensor, column, rows, value, reason in BAD_ROWS:
        spoilt = changed(spoilt, sensor, column, rows, value)
        left_out[sensor] += rows
        stamps_ns = getattr(mission, sensor).stamps_ns[rows]
        expected += [(sensor, stamp_ns, reason) for stamp_ns in stamps_ns]
    whole = mission
    for sensor, rows in left_out.items():
        whole = without(whole, sensor, rows)
    faulty = run_estimator(spoilt, name)
    known = run_estimator(whole, name, instants_ns=mission.instants(2.0))
    assert_same_numbers(faulty, known)
    refused = {(row.sensor, row.stamp_ns, row.reason) for row in faulty.refused}
    assert refused == set(expected)
    assert len(faulty.refused) == len(expected)
    assert all(
        (row.distance > 37.3) == (row.reason is Refusal.OUT_OF_REACH)
        for row in faulty.refused
    )
    assert not known.refused


@pytest.mark.parametrize("name", ESTIMATORS)
def test_an_unsound_detection_is_named_and_changes_nothing(mission, name):
    indefinite = [[1e-4, 1e-2], [1e-2, 1e-4]]
    spoilt = changed(mission, "detections", "range_azimuth_cov", [9], indefinite)
    spoilt = changed(spoilt, "detections", "range_m", [12], -3.0)
    faulty = run_estimator(spoilt, name)
    known = run_estimator(without(mission, "detections", [9, 12]), name)
    assert_same_numbers(faulty, known)
    outcomes = faulty.detections.outcomes
    assert np.flatnonzero([o is Outcome.UNSOUND for o in outcomes]).tolist() == [9, 12]
    sound = [o for o in outcomes if o is not Outcome.UNSOUND]
    assert sound == known.detections.outcomes


@pytest.mark.parametrize("name", ESTIMATORS)
def test_rows_that_a_sensor_and_a_vehicle_can_give_are_used(mission, name):
    """The control: half a metre more of depth, and quick turns and knocks, change what comes out."""
    clean = run_estimator(mission, name)
    sensors = [
        ("imu", "angular_velocity", [900], 3.0),
        ("depth", "z_m", [40], mission.depth.z_m[40] + 0.5),
    ]
    for change in sensors if name != "dead-reckoning" else sensors[:1]:
        run = run_estimator(changed(mission, *change), name)
        assert not run.refused
        assert not np.array_equal(run.causal.positions, clean.causal.positions)


def off_the_clock(sequence: Sequence, rows: int, step_ns: int) -> Sequence:
    """The first rows of each sensor are stamped from zero on."""
    blocks = {}
    for sensor in ("imu", "dvl", "depth", "detections"):
        block = getattr(sequence, sensor)
        blocks[sensor] = replace(
            block, stamps_ns=np.r_[np.arange(rows) * step_ns, block.stamps_ns[rows:]]
        )
    return replace(sequence, **blocks)


def begun_at(sequence: Sequence, rows: int) -> Sequence:
    for sensor in ("imu", "dvl", "depth", "detections"):
        sequence = without(sequence, sensor, list(range(rows)))
    return sequence


@pytest.mark.parametrize("name", ESTIMATORS)
def test_first_rows_before_the_clock_was_set_are_named_and_change_nothing(
    mission, name
):
    rows = 5
    faulty = off_the_clock(mission, rows, NS // 10)
    known = begun_at(mission, rows)
    run = run_estimator(faulty, name)
    assert_same_numbers(run, run_estimator(known, name))
    assert Counter((row.sensor, row.reason) for row in run.refused) == {
        (sensor, Refusal.CLOCK): rows
        for sensor in ("imu", "dvl", "depth", "detections")
    }
    assert np.array_equal(faulty.instants(2.0), known.instants(2.0))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_row_before_the_clock_was_set_starts_nothing(mission, name):
    """A caller that gets rows as they come, and cannot know what follows."""
    poses = []
    for sequence in (off_the_clock(mission, 1, 0), begun_at(mission, 1)):
        estimator = load_estimator(name)(
            sequence.calibration, Odometry(sequence.calibration)
        )
        if not sequence.imu.stamps_ns[0]:
            first = (
                block.between(-1, 0)
                for block in (sequence.imu, sequence.dvl, sequence.depth)
            )
            assert estimator.process(Measurements(0, *first)) is None
        for step in sequence.replay(sequence.instants(3.0)):
            estimator.process(step)
        poses.append(estimator.trajectory())
        told = {
            (row.sensor, row.stamp_ns, row.reason) for row in estimator.refused_rows()
        }
        assert told == (
            {(s, 0, Refusal.CLOCK) for s in ("imu", "dvl")}
            if len(poses) == 1
            else set()
        )
    np.testing.assert_array_equal(poses[0].positions, poses[1].positions)
    np.testing.assert_array_equal(poses[0].stamps_ns, poses[1].stamps_ns)


def live(
    name: str, sequence: Sequence, late: Measurements | None
) -> tuple[Estimate | None, list[RefusedRow]]:
    """Half a second of both sensors is missing, and perhaps comes at the end."""
    estimator = load_estimator(name)(
        sequence.calibration, Odometry(sequence.calibration)
    )
    resumed_ns = HELD_NS[1] + 4 * NS
    for after_ns, until_ns in (
        (0, HELD_NS[0]),
        (HELD_NS[1], resumed_ns),
        (resumed_ns, sequence.end_ns),
    ):
        imu = sequence.imu.between(after_ns, until_ns)
        dvl = sequence.dvl.between(after_ns, until_ns)
        estimator.process(Measurements(until_ns, imu, dvl))
    if late is not None:
        estimator.process(late)
    return estimator.process(Measurements(sequence.end_ns)), refused_rows_of(estimator)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_late_rows_are_named_and_not_used(straight, name):
    imu = straight.imu.between(*HELD_NS)
    dvl = straight.dvl.between(*HELD_NS)
    estimate, refused = live(name, straight, Measurements(straight.end_ns, imu, dvl))
    other, nothing = live(name, straight, None)
    assert not nothing
    assert sorted((row.sensor, row.stamp_ns) for row in refused) == [
        *(("dvl", at_ns) for at_ns in dvl.stamps_ns),
        *(("imu", at_ns) for at_ns in imu.stamps_ns),
    ]
    assert {row.reason for row in refused} == {Refusal.LATE}
    assert estimate.world_T_body.equals(other.world_T_body, 1e-9)


def test_rows_recorded_late_are_placed_by_their_stamps_and_named(straight, tmp_path):
    """Every tenth message of the IMU and of the Doppler log is recorded a third of a second later than it was."""
    write_log(tmp_path / "log.mcap", straight)
    counts: Counter[str] = Counter()
    messages = []
    with (
        (tmp_path / "log.mcap").open("rb") as file,
        (tmp_path / "late.mcap").open("wb") as late_file,
    ):
        reader = make_reader(file)
        writer = Writer(late_file)
        writer.start(profile="ros2")
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        for schema, channel, message in reader.iter_messages():
            counts[channel.topic] += 1
            is_moved = any(sensor in channel.topic for sensor in ("imu", "dvl"))
            is_late = is_moved and counts[channel.topic] % 10 == 0
            at_ns = message.log_time + 350_000_000 * is_late
            messages.append((at_ns, schema, channel, message.data))
        channels: dict[int, int] = {}
        for at_ns, schema, channel, data in sorted(messages, key=lambda one: one[0]):
            if channel.id not in channels:
                known = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, known
                )
            writer.add_message(channels[channel.id], at_ns, data, at_ns)
        writer.finish()
    one, other = (read_log(tmp_path / f"{name}.mcap") for name in ("log", "late"))
    told = "backwards, by 0.3 s at most: rows are sorted"
    assert other.notes["log.stamps"].count(told) == 2
    assert "log.stamps" not in one.notes
    for sensor, column in (("imu", "specific_force"), ("dvl", "velocity")):
        for name in (column, "stamps_ns"):
            values = [getattr(getattr(each, sensor), name) for each in (one, other)]
            np.testing.assert_array_equal(*values)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("unit", [1, 1000], ids=["s", "ms"])
def test_headings_and_fixes_of_another_stamp_unit_are_refused(straight, name, unit):
    """Also in a log whose clock begins at zero, where they lie within the run."""
    stamps_ns = straight.imu.stamps_ns[0] + unit * np.arange(20)
    slow_ns = straight.imu.stamps_ns[0] + NS // 10 * np.arange(20)
    blocks = {
        "heading": lambda t: Heading(t, np.zeros(20), np.full(20, np.nan)),
        "positions": lambda t: PositionFixes(
            t, np.zeros((20, 3)), np.full((20, 3, 3), np.nan)
        ),
    }
    for sensor, block in blocks.items():
        run = run_estimator(replace(straight, **{sensor: block(stamps_ns)}), name)
        assert Counter((row.sensor, row.reason) for row in run.refused) == {
            (sensor, Refusal.RATE): 20
        }
        assert not run_estimator(
            replace(straight, **{sensor: block(slow_ns)}), name
        ).refused
