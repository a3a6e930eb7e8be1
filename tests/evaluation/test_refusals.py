"""Rows that estimators refuse, and what they withhold, are named to the user, from the log to the files."""

import math
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sonar_graph.estimator import installed_estimators, load_estimator, refused_rows_of
from sonar_graph.evaluation import (
    MOST_ROWS_NAMED,
    RunResult,
    gathered,
    run_estimator,
)
from sonar_graph.measurements import Heading, Measurements, PositionFixes
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.states import Estimate, Outcome, Refusal, RefusedRow
from tests.synthetic import late, outlier

from .conftest import straight_sequence

HELD_NS = 3 * 10**9, 3 * 10**9 + 500_000_000
ESTIMATORS = list(installed_estimators())
NS = 10**9


def test_few_rows_are_named_each_and_many_are_counted_by_sensor_and_reason():
    def told(*rows):
        found = gathered(rows)
        return [(r.sensor, r.count, r.times(-NS), r.distances()) for r in found]

    few = [outlier(k, 50.0 + k) for k in range(MOST_ROWS_NAMED)]
    each = [("dvl", 1, "1.000", f"{row.distance:.0f}") for row in few]
    assert told(*few[::-1]) == each
    # rows that differ in their time alone are one line
    waited = ("imu", 2, "1.000 to 2.000", "")
    assert told(late(0), outlier(99, 7.5), *few, late(NS)) == [
        ("dvl", MOST_ROWS_NAMED + 1, "1.000 to 1.000", "7.50 to 54"),
        waited,
    ]
    both = RefusedRow("dvl", 3, Refusal.LATE, math.nan), *few
    assert len(told(*both)) == MOST_ROWS_NAMED + 1


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
    kept = block.rows(np.delete(np.arange(len(block)), rows))
    return replace(sequence, **{sensor: kept})


@pytest.mark.parametrize("name", ESTIMATORS)
def test_outliers_are_named_and_not_used(straight, name):
    rows = [20, 41, 42, 60]
    run = run_estimator(changed(straight, "dvl", "velocity", rows, 3.0), name)
    clean = run_estimator(without(straight, "dvl", rows), name)
    assert run.status == "ok"
    stamps_ns = straight.dvl.stamps_ns[rows].tolist()
    expected = [("dvl", stamp_ns, Refusal.OUTLIER) for stamp_ns in stamps_ns]
    assert [row[:3] for row in run.refused] == expected
    assert min(row.distance for row in run.refused) > 44.8
    assert not clean.refused
    assert run.causal.positions == pytest.approx(clean.causal.positions, abs=1e-9)


def assert_same_numbers(one: RunResult, other: RunResult) -> None:
    assert (one.status, other.status) == ("ok", "ok")
    for part in ("positions", "quaternions_xyzw", "covariances"):
        for path in ("causal", "smoothed"):
            paths = [getattr(run, path) for run in (one, other)]
            np.testing.assert_array_equal(*(getattr(path, part) for path in paths))
    np.testing.assert_array_equal(one.landmarks.positions, other.landmarks.positions)


INDEFINITE = [[1e-4, 1e-2], [1e-2, 1e-4]]


BAD_ROWS = [
    ("depth", "z_m", list(range(7, 150, 20)), -1000.0, Refusal.OUT_OF_REACH),
    ("depth", "z_m", [40], 100.0, Refusal.OUT_OF_REACH),
    ("depth", "z_m", [0, 1], -1000.0, Refusal.OUT_OF_REACH),
    ("depth", "variance_m2", [60], -1.0, Refusal.UNSOUND),
    ("imu", "angular_velocity", [900], 1e9, Refusal.BEYOND_SENSOR),
    ("imu", "angular_velocity", [0, 950], -36.0, Refusal.BEYOND_SENSOR),
    ("imu", "specific_force", [1000], -1e9, Refusal.BEYOND_SENSOR),
    ("imu", "specific_force", [1050], np.inf, Refusal.BEYOND_SENSOR),
    ("detections", "range_azimuth_cov", [9], INDEFINITE, None),
    ("detections", "range_m", [12], -3.0, None),
]


@pytest.mark.parametrize("name", ESTIMATORS)
def test_rows_that_no_sensor_or_vehicle_gives_are_named_and_change_nothing(
    mission, name
):
    """Detections among the outcomes."""
    spoilt = whole = mission
    left_out = {"depth": [], "imu": [], "detections": []}
    expected = []
    for sensor, column, rows, value, reason in BAD_ROWS:
        spoilt = changed(spoilt, sensor, column, rows, value)
        left_out[sensor] += rows
        if reason:
            stamps_ns = getattr(mission, sensor).stamps_ns[rows].tolist()
            expected += [(sensor, stamp_ns, reason) for stamp_ns in stamps_ns]
    for sensor, rows in left_out.items():
        whole = without(whole, sensor, rows)
    faulty = run_estimator(spoilt, name)
    known = run_estimator(whole, name, instants_ns=mission.instants(2.0))
    assert_same_numbers(faulty, known)
    assert sorted(row[:3] for row in faulty.refused) == sorted(expected)
    for row in faulty.refused:
        assert (row.distance > 37.3) == (row.reason is Refusal.OUT_OF_REACH)
    assert not known.refused
    outcomes = dict(enumerate(faulty.detections.outcomes))
    unsound = [k for k, outcome in outcomes.items() if outcome is Outcome.UNSOUND]
    assert unsound == left_out["detections"]
    sound = [outcomes[k] for k in outcomes if k not in unsound]
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


SENSORS = "imu", "dvl", "depth", "detections"


def off_the_clock(sequence: Sequence, rows: int, step_ns: int) -> Sequence:
    """The first rows of each sensor are stamped from zero on."""
    for sensor in SENSORS:
        first_ns = np.arange(rows) * step_ns
        sequence = changed(sequence, sensor, "stamps_ns", slice(rows), first_ns)
    return sequence


def begun_at(sequence: Sequence, rows: int) -> Sequence:
    for sensor in SENSORS:
        sequence = without(sequence, sensor, list(range(rows)))
    return sequence


@pytest.mark.parametrize("name", ESTIMATORS)
def test_first_rows_before_the_clock_was_set_are_named_and_change_nothing(
    mission, name
):
    faulty = off_the_clock(mission, 5, NS // 10)
    known = begun_at(mission, 5)
    run = run_estimator(faulty, name)
    assert_same_numbers(run, run_estimator(known, name))
    found = Counter((row.sensor, row.reason) for row in run.refused)
    assert found == {(sensor, Refusal.CLOCK): 5 for sensor in SENSORS}
    assert np.array_equal(faulty.instants(2.0), known.instants(2.0))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_row_before_the_clock_was_set_starts_nothing(mission, name):
    """A caller that gets rows as they come, and cannot know what follows."""
    faulty = off_the_clock(mission, 1, 0)
    paths = []
    for sequence in (faulty, begun_at(mission, 1)):
        calibration = sequence.calibration
        estimator = load_estimator(name)(calibration, Odometry(calibration))
        clocks = set()
        if sequence is faulty:
            motion = (sequence.imu, sequence.dvl, sequence.depth)
            first = Measurements(0, *(block.between(-1, 0) for block in motion))
            assert estimator.process(first) is None
            clocks = {(sensor, 0, Refusal.CLOCK) for sensor in ("imu", "dvl")}
        for step in sequence.replay(sequence.instants(3.0)):
            estimator.process(step)
        paths.append(estimator.trajectory())
        assert {row[:3] for row in estimator.refused_rows()} == clocks
    for part in ("positions", "stamps_ns"):
        np.testing.assert_array_equal(*(getattr(path, part) for path in paths))


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
        sensors = sequence.imu, sequence.dvl
        rows = (block.between(after_ns, until_ns) for block in sensors)
        estimator.process(Measurements(until_ns, *rows))
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
    expected = [("dvl", at_ns, Refusal.LATE) for at_ns in dvl.stamps_ns.tolist()]
    expected += [("imu", at_ns, Refusal.LATE) for at_ns in imu.stamps_ns.tolist()]
    assert sorted(row[:3] for row in refused) == expected
    assert estimate.world_T_body.equals(other.world_T_body, 1e-9)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("unit", [1, 1000], ids=["s", "ms"])
def test_headings_and_fixes_of_another_stamp_unit_are_refused(straight, name, unit):
    """Also in a log whose clock begins at zero, where they lie within the run."""
    unknown = np.full((20, 3, 3), np.nan)
    kinds = {
        "heading": (Heading, np.zeros(20), unknown[:, 0, 0]),
        "positions": (PositionFixes, np.zeros((20, 3)), unknown),
    }
    for sensor, (kind, *columns) in kinds.items():

        def refused(step_ns, sensor=sensor, kind=kind, columns=columns):
            stamps_ns = straight.imu.stamps_ns[0] + step_ns * np.arange(20)
            block = {sensor: kind(stamps_ns, *columns)}
            run = run_estimator(replace(straight, **block), name)
            return Counter((row.sensor, row.reason) for row in run.refused)

        assert refused(unit) == {(sensor, Refusal.RATE): 20}
        assert not refused(NS // 10)
