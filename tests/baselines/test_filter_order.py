"""Laws of the calls: order, cuts, refusals and outcomes of what a filter is given."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from baselines.events import (
    DEPTH,
    END,
    EPOCH,
    FIX,
    FRAME,
    HEADING,
    Call,
    Order,
    Views,
    in_order,
)
from baselines.kalman import USED
from sonar_graph.calibration import Calibration, FloorPrior, SonarCalibration
from sonar_graph.errors import EstimatorError, MeasurementError
from sonar_graph.measurements import NS_PER_S, Measurements
from sonar_graph.models import ACCEPTED
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.states import CausalEstimates, Estimate, Outcome, Refusal

from .runs import (
    NAMES,
    T0_NS,
    aided,
    begun,
    depths,
    dvl,
    every_estimator,
    imu,
    in_a_gap,
    later,
    run,
    seen,
    slam_filters,
    state_of,
)


def test_causal_estimates_keep_the_later_answer_and_time_never_runs_back():
    said = CausalEstimates()
    assert len(said.trajectory()) == 0
    for stamp_ns, x in ((1, 0.1), (2, 0.2), (2, 0.3), (1, 0.4), (3, 0.5)):
        said.keep(
            Estimate(
                stamp_ns, gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0])), np.eye(6)
            )
        )
    assert said.trajectory().stamps_ns.tolist() == [1, 2, 3]
    assert said.trajectory().positions[:, 0].tolist() == [0.1, 0.3, 0.5]


@slam_filters
def test_a_refused_row_of_a_frame_changes_nothing(kind):
    """Beside an accepted one of a landmark in the state, before and after it."""
    first, states = seen(later(0.4, 0.5)), []
    both = replace(
        seen(later(0.8, 0.8, 0.8), 2.01), id_probability=np.array([[0.8], [0.9], [0.3]])
    )
    for frame in (both, both.rows(slice(1, 2))):
        slam = begun(kind, Calibration())
        slam.process(Measurements(later(0.6), imu(0.6), dvl(0.6), None, first))
        slam.process(Measurements(later(1.0), imu(1), dvl(1), None, frame))
        states.append(state_of(slam))
    assert slam.detections().outcomes[-1] is Outcome.USED
    for part, same in zip(*states, strict=True):
        assert_array_equal(part, same)


@slam_filters
def test_a_question_while_beams_are_few_changes_nothing_later(kind):
    """A call that ends before few-beam rows are completed sees a gap where later there is none."""
    velocity = dvl(12, (0.3, 0.0, 0.0))
    cov = np.tile(np.eye(3), (len(velocity), 1, 1))
    cov[25:36, 2, 2] = np.inf
    rows, views = (
        (imu(12), replace(velocity, velocity_cov=cov)),
        seen(later(1.0, 3.0, 9.0, 10.0, 11.5), range_m=3.0),
    )
    precise = Calibration(
        sonar=SonarCalibration(range_sigma_m=1e-3, azimuth_sigma_rad=1e-3)
    )
    states = []
    for cuts in ((12.0,), (7.0, 12.0), (6.1, 6.9, 12.0)):
        slam, before_ns = begun(kind, precise, gate_probability=1.0), T0_NS - 1
        for end_ns in (later(cut) for cut in cuts):
            parts = [block.between(before_ns, end_ns) for block in (*rows, views)]
            slam.process(Measurements(end_ns, parts[0], parts[1], None, parts[2]))
            before_ns = end_ns
        states.append((*state_of(slam), slam.detections().innovation_covs))
    for other in states[1:]:
        for part, same in zip(other, states[0], strict=True):
            assert_array_equal(part, same)


@slam_filters
def test_each_detection_has_its_outcome_and_a_refused_one_changes_nothing(kind):
    """Before the first node, without a probable identity, older than what is done, and outside the gate."""
    slam = begun(kind, Calibration(), gate_probability=0.999)
    assert (
        slam.process(Measurements(T0_NS - 5, None, None, None, seen([T0_NS - 10])))
        is None
    )
    end_ns = later(1.0)
    slam.process(Measurements(end_ns, imu(1), dvl(1), None, seen([later(0.5)])))
    before = state_of(slam)
    slam.process(
        Measurements(
            end_ns, None, None, None, seen([end_ns], landmark=4, probability=0.3)
        )
    )
    slam.process(Measurements(end_ns, None, None, None, seen([later(0.25)])))
    slam.process(Measurements(end_ns, None, None, None, seen([end_ns], range_m=2.5)))
    for part, same in zip(state_of(slam), before, strict=True):
        assert_array_equal(part, same)
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
    assert (
        run(
            kind, Sequence(*rows, seen(later(*t), 2.0 + (t == 4.0))), **settings
        ).withheld()
        == []
    )
    free = run(
        kind, Sequence(*rows, seen(later(*t), 2.0 + 0.5 * (t >= 3.0))), kernel_width=0.0
    )
    assert free.withheld() == []


@slam_filters
def test_a_row_of_motion_that_was_used_comes_too_late_and_changes_nothing(kind):
    slam, late = (
        begun(kind, Calibration()),
        dvl(2, (0.1, 0.0, 0.0), rate_hz=7).rows(slice(9, 10)),
    )
    slam.process(Measurements(later(2.0), imu(2), dvl(2)))
    before = state_of(slam)
    slam.process(Measurements(later(2.0), None, late))
    (row,) = slam.refused_rows()
    assert (row.sensor, row.stamp_ns, row.reason) == (
        "dvl",
        late.stamps_ns[0],
        Refusal.LATE,
    )
    for part, same in zip(state_of(slam), before, strict=True):
        assert_array_equal(part, same)


@pytest.mark.parametrize(
    "rows",
    [{"detections": seen([T0_NS + 1])}, {"depth": depths(np.array([T0_NS + 1]), 0.0)}],
)
def test_a_row_after_the_instant_is_an_error_that_names_it(rows):
    (block,) = rows.values()
    with pytest.raises(
        MeasurementError,
        match=f"{type(block).__name__} has a row at {T0_NS + 1} ns, after end_ns",
    ):
        Measurements(T0_NS, **rows)


@slam_filters
def test_many_landmarks_stay_where_they_were_seen(kind):
    """More than the first arrays have room for, seen in the order of their identities turned round."""
    slam, end_ns = (
        begun(kind, Calibration(floor=FloorPrior(z_m=-1.0, sigma_m=0.01))),
        later(1.0),
    )
    slam.process(Measurements(end_ns, imu(1), dvl(1)))
    for landmark in reversed(range(20)):
        slam.process(
            Measurements(
                end_ns, None, None, None, seen([end_ns], 4.0, 0.05 * landmark, landmark)
            )
        )
    found = slam.landmarks()
    assert_array_equal(found.ids, np.arange(20))
    assert_allclose(
        np.arctan2(found.positions[:, 1], found.positions[:, 0]),
        0.05 * np.arange(20),
        atol=1e-3,
    )
    assert slam.detections().outcomes == [Outcome.NEW] * 20


@slam_filters
@pytest.mark.parametrize("with_aiding", [False, True])
def test_the_outcome_depends_neither_on_how_the_log_is_cut_nor_on_being_asked(
    mission, kind, with_aiding
):
    """To the last bit, over gaps of the Doppler log and intervals of gravity, with headings and position fixes."""
    mission = aided(mission) if with_aiding else mission
    instants = mission.instants(0.1)
    instants = instants[instants < mission.start_ns + 35 * NS_PER_S]
    stamps = np.concatenate([block.stamps_ns for block in mission.blocks().values()])
    every_instant = np.unique(np.concatenate([stamps, mission.instants(50.0)]))
    live, windows, whole = (
        begun(kind, mission.calibration, gravity_interval_s=7.0) for _ in range(3)
    )
    for row in mission.replay(every_instant[every_instant <= instants[-1]]):
        live.process(row)
    for window in mission.replay(instants):
        windows.process(window)
    for window in mission.replay(instants[-1:]):
        whole.process(window)
    assert sorted(live.refused_rows()) == sorted(windows.refused_rows())
    unsound = {
        row.sensor for row in live.refused_rows() if row.reason is Refusal.UNSOUND
    }
    assert unsound == ({"heading", "positions"} if with_aiding else set())
    for other in (windows, whole):
        assert live.detections().outcomes == other.detections().outcomes
        for part, same in zip(state_of(live), state_of(other), strict=True):
            assert_array_equal(part, same)
        at = np.searchsorted(live.trajectory().stamps_ns, other.trajectory().stamps_ns)
        assert_array_equal(
            live.trajectory().positions[at], other.trajectory().positions
        )
        assert_array_equal(
            live.trajectory().covariances[at], other.trajectory().covariances
        )


def test_events_come_in_the_order_of_their_stamps_each_with_its_motion_from_the_newest_epoch():
    """At equal stamps epoch, depth, heading, fix, frame; gravity where its interval is long enough."""
    sample_ns, kinds = (
        np.array([3, 10, 20, 20, 20, 50]),
        np.array([*[DEPTH] * 3, HEADING, FIX, DEPTH]),
    )
    stamps_ns = np.array([18, 20, 20, 45, 45])
    outcome = np.array([*[ACCEPTED] * 3, USED, ACCEPTED], np.int8)
    pairs, covs = np.zeros((5, 2)), np.zeros((5, 2, 2))
    views = Views(stamps_ns, np.zeros(5, np.int64), pairs, covs, outcome, pairs, covs)

    def events(interval_ns):
        call = Call(
            since_ns=10, end_ns=60, node_ns=5, opened_ns=5, interval_ns=interval_ns
        )
        order = Order(
            *in_order(
                np.array([19, 39, 57]),
                np.array([20, 40, 58]),
                sample_ns,
                kinds,
                views,
                call,
            )
        )
        return list(zip(*(column.tolist() for column in order), strict=True))

    assert events(34) == [
        (10, 5, 10, DEPTH, 1, 0), (18, 5, 18, FRAME, 0, 0), (20, 5, 19, EPOCH, 0, 0), (20, 19, 20, DEPTH, 2, 0),
        (20, 19, 20, HEADING, 3, 0), (20, 19, 20, FIX, 4, 0), (20, 19, 20, FRAME, 1, 0), (40, 19, 39, EPOCH, 1, 1),
        (45, 39, 45, FRAME, 4, 0), (50, 39, 50, DEPTH, 5, 0), (58, 39, 57, EPOCH, 2, 0), (60, 57, 60, END, 0, 0),
    ]  # fmt: skip
    assert [
        sum(event[5] for event in events(interval_ns)) for interval_ns in (0, 14)
    ] == [0, 3]


@slam_filters
def test_an_innovation_that_a_source_of_motion_lets_be_impossible_is_an_error_with_its_time(
    kind, monkeypatch
):
    """Ours refuses such rows; that of somebody else may not."""
    monkeypatch.setattr(Odometry, "used_depths", lambda _, depth: depth)
    with pytest.raises(
        EstimatorError,
        match=rf"{kind.name}: between \d+ and \d+ ns .* variances above zero",
    ):
        run(kind, in_a_gap(depths(np.array([later(1.0)]), 1.0, -1e6)))


@every_estimator
def test_settings_and_measurements_of_another_type_are_refused_by_name(kind):
    calibration, name = Calibration(), NAMES[kind]
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
