"""Laws of the calls: order, cuts, refusals and outcomes of what a filter is given."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from sonar_graph.calibration import Calibration, KnownMap, Start
from sonar_graph.errors import EstimatorError, MeasurementError
from sonar_graph.measurements import NS_PER_S, Measurements
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.states import Outcome, Refusal

from .runs import (
    NAMES,
    T0_NS,
    aided,
    begun,
    dvl,
    every_estimator,
    imu,
    later,
    run,
    seen,
    slam_filters,
    state_of,
)

LANDMARK_7 = KnownMap.of(
    [7], 2.0 * np.array([[np.cos(0.5), np.sin(0.5), 0.0]]), sigma_m=0.05
)


def assert_same_states(one, other):
    for part, same in zip(state_of(one), state_of(other), strict=True):
        assert_array_equal(part, same)


@slam_filters
def test_each_detection_has_its_outcome_and_a_refused_one_changes_nothing(kind):
    """Before the first node, without a probable identity, older than what is done, and outside the gate.

    Nor does a row of the Doppler log that comes too late.
    """
    slam = begun(kind, Calibration(), gate_probability=0.999)
    assert (
        slam.process(Measurements(T0_NS - 5, None, None, None, seen([T0_NS - 10])))
        is None
    )
    end_ns = later(1.0)
    slam.process(Measurements(end_ns, imu(1), dvl(1), None, seen([later(0.5)])))
    before = state_of(slam)
    late = dvl(2, (0.1, 0.0, 0.0), rate_hz=7).rows(slice(5, 6))
    for block in (
        {"detections": seen([end_ns], landmark=4, probability=0.3)},
        {"detections": seen([later(0.25)])},
        {"detections": seen([end_ns], range_m=2.5)},
        {"dvl": late},
    ):
        slam.process(Measurements(end_ns, **block))
    for part, same in zip(state_of(slam), before, strict=True):
        assert_array_equal(part, same)
    assert [(row.sensor, row.reason) for row in slam.refused_rows()] == [
        ("dvl", Refusal.LATE)
    ]
    expected = [
        Outcome.UNLOCATED,
        Outcome.NEW,
        Outcome.NO_IDENTITY,
        Outcome.LATE,
        Outcome.GATED,
    ]
    log = slam.detections()
    assert log.outcomes == expected
    assert log.landmark_ids.tolist() == [3, 3, 4, 3, 3]
    assert log.innovations[4] == pytest.approx([0.5, 0.0], abs=1e-6)
    assert np.isnan(log.innovations[:4]).all()
    assert slam.landmarks().ids.tolist() == [3]


@slam_filters
def test_each_landmark_of_a_frame_has_its_own_gate(kind):
    """A landmark of the map that contradicts it is refused beside one that the map does not have."""
    slam = begun(kind, Calibration(map=LANDMARK_7))
    now_ns = later(1.0)
    slam.process(Measurements(now_ns, imu(1), dvl(1), None, seen([later(0.5)])))
    both = seen([now_ns, now_ns], [2.0, 5.0], [0.1, 0.5], landmark=[[3], [7]])
    slam.process(Measurements(now_ns, None, None, None, both))
    assert slam.detections().outcomes == [Outcome.NEW, Outcome.USED, Outcome.GATED]


@slam_filters
def test_known_landmarks_of_a_frame_count_before_a_new_one_is_added(kind):
    """One frame gives the state of two that are a nanosecond apart: a large turn is not linear in the new landmark."""
    start = Start(rpy_sigma_rad=(0.01, 0.01, 0.4))
    calibration = Calibration(map=LANDMARK_7, start=start)
    at_once, in_turn = (begun(kind, calibration) for _ in range(2))
    now_ns = later(0.5)
    both = seen([now_ns, now_ns], [2.0, 5.0], [0.2, -0.4], landmark=[[7], [3]])
    first, second = (both.rows(np.array([k])) for k in range(2))
    second = replace(second, stamps_ns=second.stamps_ns + 1)
    at_once.process(Measurements(later(1.0), imu(1), dvl(1), None, both))
    rows = imu(1), dvl(1), None
    in_turn.process(Measurements(now_ns, *rows, first))
    in_turn.process(Measurements(later(1.0), None, None, None, second))
    assert at_once.detections().outcomes == [Outcome.USED, Outcome.NEW]
    assert at_once.landmarks().positions == pytest.approx(
        in_turn.landmarks().positions, abs=1e-6
    )
    assert abs(at_once.detections().innovations[0, 1]) > 0.2


@slam_filters
@pytest.mark.parametrize(
    ("gate_probability", "outcome"), [(1.0, Outcome.USED), (0.5, Outcome.GATED)]
)
def test_a_gate_that_is_stricter_than_that_of_the_map_holds(
    kind, gate_probability, outcome
):
    slam = begun(kind, Calibration(map=LANDMARK_7), gate_probability=gate_probability)
    off = seen([later(0.5)], 2.15, 0.5, landmark=7)
    slam.process(Measurements(later(1.0), imu(1), dvl(1), None, off))
    assert slam.detections().outcomes == [outcome]


@slam_filters
@pytest.mark.parametrize(
    "settings",
    [{"gate_probability": 0.999}, {"kernel_width": 1.5, "gate_probability": 0.999}],
)
def test_a_filter_whose_gate_locks_right_detections_out_says_so(kind, settings):
    """A landmark stands 0.5 m farther than first seen; not after one outlier, and not without gate and kernel."""
    t = np.concatenate([[0.5], np.arange(1.0, 9.0, 0.25)])
    rows = "landmark", Calibration(), imu(9), dvl(9), None
    slam = run(
        kind, Sequence(*rows, seen(later(*t), 2.0 + 0.5 * (t >= 3.0))), **settings
    )
    assert slam.detections().outcomes.count(Outcome.GATED) == 24
    (message,) = slam.withheld()
    assert message.startswith(
        "24 of 32 detections of known landmarks lie outside the 99.9 % ellipse"
    )
    for off_m, of_filter in ((t == 4.0, settings), (t >= 3.0, {"kernel_width": 0.0})):
        detections = seen(later(*t), 2.0 + 0.5 * off_m)
        assert run(kind, Sequence(*rows, detections), **of_filter).withheld() == []


@slam_filters
def test_the_outcome_does_not_depend_on_cuts_of_the_log_or_on_queries(mission, kind):
    """To the last bit, over gaps of the Doppler log and intervals of gravity, with headings and position fixes."""
    mission = aided(mission)
    instants = mission.start_ns + np.arange(10, 30, 10) * NS_PER_S
    stamps = np.concatenate([block.stamps_ns for block in mission.blocks().values()])
    every = np.unique(np.concatenate([stamps, mission.instants(50.0), instants]))
    live, windows, whole = (
        begun(kind, mission.calibration, gravity_interval_s=7.0) for _ in range(3)
    )
    for slam, cuts in ((live, every), (windows, instants), (whole, instants[-1:])):
        for window in mission.replay(cuts[cuts <= instants[-1]]):
            slam.process(window)
    refused = {row.sensor for row in live.refused_rows()}
    assert refused >= {"heading", "positions"}
    assert sorted(live.refused_rows()) == sorted(windows.refused_rows())
    for other in (windows, whole):
        assert live.detections().outcomes == other.detections().outcomes
        assert_same_states(live, other)
        then = other.trajectory()
        rows = live.trajectory()
        rows = rows.rows(np.isin(rows.stamps_ns, then.stamps_ns))
        assert_array_equal(rows.positions, then.positions)
        assert_array_equal(rows.covariances, then.covariances)


@every_estimator
def test_settings_and_measurements_of_another_type_are_refused_by_name(kind):
    calibration = Calibration()
    name = NAMES[kind]
    settings = kind.Params.__name__
    for params, given in (
        ({"gravity_interval_s": 2.0}, "dict"),
        (kind.Params, f"the class {settings}"),
    ):
        said = rf"{name}: params: expected {settings} or None, not {given}; of a dict: {settings}\(\*\*params\)"
        with pytest.raises(EstimatorError, match=said):
            kind(calibration, Odometry(calibration), params)
    for given, said in (
        (None, "NoneType; of blocks"),
        (dvl(1), r"Dvl; of blocks: Measurements\(end_ns, dvl="),
    ):
        with pytest.raises(
            MeasurementError,
            match=rf"{name}: process\(measurements\): expected .*, not {said}",
        ):
            begun(kind, calibration).process(given)
    for given in ({}, None, Odometry(calibration)):
        said = rf"{kind.__name__}\(calibration, .*expected a Calibration, not {type(given).__name__}; of a dict"
        with pytest.raises(TypeError, match=said):
            kind(given, Odometry(calibration))
