"""Laws of the filters as estimators, each for every filter for which it holds."""

import importlib.util
import math
import sys
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from baselines.dead_reckoning import DeadReckoning
from baselines.ekf_equations import COMPASS
from baselines.ekf_slam import EkfSlam
from baselines.event_order import DEPTH, END, EPOCH, FIX, FRAME, GRAVITY, HEADING, PLANE, Motion, in_order, remove_rate
from baselines.invariant_ekf import InvariantEkf
from baselines.sonar_update import USED
from sonar_graph.calibration import (
    Calibration,
    DepthCalibration,
    DvlCalibration,
    FloorPrior,
    ImuCalibration,
    Mounting,
    PlanarMotion,
    SonarCalibration,
    Start,
)
from sonar_graph.errors import EstimatorError, MeasurementError
from sonar_graph.evaluation.consistency import yaw_variances
from sonar_graph.measurements import NS_PER_S, Depth, Dvl, Heading, Imu, LandmarkDetections, Measurements, PositionFixes
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.slam.landmarks import ACCEPTED
from sonar_graph.states import CausalEstimates, Estimate, Outcome, Refusal
from sonar_graph.testing import check_consistent
from sonar_graph.testing.numerical import central_differences

BENCHMARKS = Path(__file__).parents[2] / "benchmarks" / "performance"
T0_NS = 1_700_000_000 * NS_PER_S
STANDARD_FORCE = np.array([0.0, 0.0, 9.80665])
NO_FORCE = (math.nan,) * 3


def for_filters(*kinds):
    names = {DeadReckoning: "dead-reckoning", EkfSlam: "ekf-slam", InvariantEkf: "invariant-ekf"}
    return pytest.mark.parametrize("kind", kinds, ids=[names[kind] for kind in kinds])


every_filter = for_filters(EkfSlam, InvariantEkf, DeadReckoning)
slam_filters = for_filters(EkfSlam, InvariantEkf)
filters_with_bias = for_filters(InvariantEkf, DeadReckoning)


def later(*seconds):
    """Stamps so many seconds after the beginning; one stamp for one number."""
    stamps_ns = T0_NS + np.round(np.array(seconds) * NS_PER_S).astype(np.int64)
    return stamps_ns if len(seconds) > 1 else int(stamps_ns[0])


def imu(seconds, rate=(0.0, 0.0, 0.0), force=STANDARD_FORCE, rate_hz=50):
    t = later(*np.arange(round(seconds * rate_hz) + 1) / rate_hz)
    return Imu(t, np.broadcast_to(rate, (len(t), 3)), np.broadcast_to(force, (len(t), 3)))


def dvl(seconds, velocity=(0.0, 0.0, 0.0), rate_hz=5):
    t = later(*np.arange(round(seconds * rate_hz) + 1) / rate_hz)
    return Dvl(t, np.broadcast_to(np.asarray(velocity, float), (len(t), 3)), np.full((len(t), 3, 3), np.nan))


def depths(stamps_ns, z_m, variance_m2=math.nan):
    return Depth(stamps_ns, np.full(len(stamps_ns), z_m), np.full(len(stamps_ns), variance_m2))


def seen(stamps_ns, range_m=2.0, azimuth_rad=0.1, landmark=3, probability=1.0):
    shape = np.shape(stamps_ns)
    rows = [np.broadcast_to(np.asarray(values, float), shape) for values in (range_m, azimuth_rad)]
    ids, probabilities = np.full((*shape, 1), landmark), np.full((*shape, 1), probability)
    return LandmarkDetections(np.asarray(stamps_ns), *rows, np.full((*shape, 2, 2), np.nan), ids, probabilities)


def begun(kind, calibration, **params):
    return kind(calibration, Odometry(calibration), kind.Params(**params))


def run(kind, sequence, rate_hz=1.0, **params):
    estimator = begun(kind, sequence.calibration, **params)
    for window in sequence.replay(sequence.instants(rate_hz)):
        estimator.process(window)
    return estimator


def estimate_after(kind, calibration, seconds, *rows):
    return begun(kind, calibration).process(Measurements(later(seconds), *rows))


def state_of(slam):
    """Arrays of the state at the newest node."""
    return slam.state()[1:] if isinstance(slam, EkfSlam) else tuple(vars(slam.state()[1]).values())


def height_and_tilt(slam):
    """Mean height of the body at the node, its variance, and the variances of roll and pitch (level only)."""
    if isinstance(slam, EkfSlam):
        _, x, P = slam.state()
        return x[2], P[2, 2], np.diag(P)[3:5]
    _, state = slam.state()
    return state.points[0, 2], state.P[16, 16], np.diag(state.P)[:2]


YAW_RATE, SPEED, LEVER = 0.1, 0.3, np.array([0.2, 0.1, -0.3])
CIRCLE_S, CIRCLE_START = 20, Start(position_m=(1.0, 2.0, -3.0), rpy_rad=(0.0, 0.0, 0.5))


def circle_calibration(**imu_noise):
    return Calibration(
        imu=ImuCalibration(gyro_noise_density=1e-3, **imu_noise),
        dvl=DvlCalibration(velocity_sigma_m_s=(0.02, 0.02, 0.02), mounting=Mounting(translation_m=tuple(LEVER))),
        start=CIRCLE_START,
    )


def circle(gyro_error=0.0, velocity_error=0.0):
    """A level circle; the DVL off the centre of the body, the accelerometer silent."""
    velocity = np.array([SPEED, 0.0, 0.0]) + np.cross([0.0, 0.0, YAW_RATE], LEVER)
    gyro, doppler = imu(CIRCLE_S, (0.0, 0.0, YAW_RATE), NO_FORCE), dvl(CIRCLE_S, velocity)
    return (
        replace(gyro, angular_velocity=gyro.angular_velocity + gyro_error),
        replace(doppler, velocity=doppler.velocity + velocity_error),
    )


@every_filter
def test_a_circle_is_a_circle(kind):
    estimator, (gyro, doppler) = begun(kind, circle_calibration()), circle()
    for end_ns in later(*np.arange(0.5, CIRCLE_S, 0.5)):
        rows = gyro.between(T0_NS - 1, end_ns), doppler.between(T0_NS - 1, end_ns)
        estimate = estimator.process(Measurements(int(end_ns), *rows))
        turn = YAW_RATE * (end_ns - T0_NS) * 1e-9
        chord = SPEED / YAW_RATE * np.array([np.sin(turn), 1 - np.cos(turn), 0.0])
        expected = CIRCLE_START.pose().compose(gtsam.Pose3(gtsam.Rot3.Yaw(turn), chord))
        assert estimate.world_T_body.equals(expected, 1e-9)


@every_filter
def test_the_earth_s_rotation_is_removed_at_its_latitude(kind):
    latitude = 0.7
    earth = 7.292115e-5 * np.array([0.0, np.cos(latitude), np.sin(latitude)])
    felt = CIRCLE_START.pose().rotation().matrix().T @ earth
    rows = imu(CIRCLE_S, felt, NO_FORCE), dvl(CIRCLE_S)
    aware = circle_calibration().model_copy(update={"earth_rate_latitude_rad": latitude})
    turned = [
        CIRCLE_START.pose().between(estimate_after(kind, c, CIRCLE_S, *rows).world_T_body).rotation().rpy()
        for c in (aware, circle_calibration())
    ]
    assert np.abs(turned[0]).max() < 1e-9
    assert np.abs(turned[1]).max() > 5e-4


@every_filter
def test_the_start_s_covariance_is_that_of_its_perturbations(kind):
    """World-axis positions and body rotations, off the world's origin, come out as perturbations of the body."""
    start = Start(
        position_m=(10.0, -20.0, 3.0), rpy_rad=(0.2, -0.3, 2.0),
        position_sigma_m=(0.1, 0.02, 0.03), rpy_sigma_rad=(0.01, 0.02, 0.03),
    )  # fmt: skip
    calibration = Calibration(
        start=start,
        use_gravity=False,
        imu=ImuCalibration(gyro_noise_density=0.0, gyro_bias_sigma=0.0),
        dvl=DvlCalibration(velocity_sigma_m_s=(1e-9, 1e-9, 1e-9)),
    )
    covariance = estimate_after(kind, calibration, 1, imu(1), dvl(1)).covariance
    R = start.pose().rotation().matrix()
    assert_allclose(covariance[:3, :3], np.diag(np.square(start.rpy_sigma_rad)), atol=1e-12)
    assert_allclose(covariance[3:, 3:], R.T @ np.diag(np.square(start.position_sigma_m)) @ R, atol=1e-12)
    assert_allclose(covariance[:3, 3:], 0.0, atol=1e-12)


@filters_with_bias
def test_a_bias_that_nothing_tells_widens_yaw_as_a_constant_and_a_walk_do(kind):
    def yaw_sigma(**noise):
        return np.sqrt(estimate_after(kind, circle_calibration(**noise), CIRCLE_S, *circle()).covariance[2, 2])

    none = yaw_sigma(gyro_bias_sigma=0.0, gyro_bias_walk_density=1.0)
    some = yaw_sigma(gyro_bias_sigma=1e-3, gyro_bias_walk_density=0.0)
    walking = yaw_sigma(gyro_bias_sigma=1e-3, gyro_bias_walk_density=1e-3)
    start_sigma = CIRCLE_START.rpy_sigma_rad[2]
    assert none == pytest.approx(np.hypot(1e-3 * np.sqrt(CIRCLE_S), start_sigma), rel=1e-3)
    assert some == pytest.approx(np.hypot(none, 1e-3 * CIRCLE_S), rel=1e-3)
    assert walking == pytest.approx(np.hypot(some, 1e-3 * np.sqrt(CIRCLE_S**3 / 3)), rel=0.02)


@pytest.mark.slow
def test_dead_reckoning_s_covariance_is_that_of_many_runs_with_a_constant_bias():
    bias_sigma, noise, rng = 2e-3, 1e-3, np.random.default_rng(2)
    known = circle_calibration(gyro_bias_sigma=bias_sigma, gyro_bias_walk_density=0.0)
    start = CIRCLE_START.model_copy(update={"position_sigma_m": (1e-6,) * 3, "rpy_sigma_rad": (1e-6,) * 3})
    known, (gyro, doppler) = known.model_copy(update={"start": start}), circle()
    mean = estimate_after(DeadReckoning, known, CIRCLE_S, gyro, doppler)
    errors = []
    for _ in range(600):
        gyro_error = bias_sigma * rng.normal(size=3) + noise * np.sqrt(50) * rng.normal(size=(len(gyro), 3))
        rows = circle(gyro_error, 0.02 * rng.normal(size=(len(doppler), 3)))
        between = mean.world_T_body.between(estimate_after(DeadReckoning, known, CIRCLE_S, *rows).world_T_body)
        turn = Rotation.from_matrix(between.rotation().matrix()).as_rotvec()
        errors.append(np.concatenate([turn, between.translation()]))
    sigma = np.sqrt(np.diag(mean.covariance))
    scale = np.outer(sigma, sigma)
    assert_allclose(np.cov(np.array(errors).T) / scale, mean.covariance / scale, atol=0.2)


def test_dead_reckoning_is_level_by_gravity_and_as_sure_of_its_tilt_as_it_is_right():
    """Gyro bias and noise tilt it by 20 mrad without accelerometers."""
    bias_sigma, rng, squares, tilts = 1e-3, np.random.default_rng(5), [], []
    known = circle_calibration(gyro_bias_sigma=bias_sigma, gyro_bias_walk_density=0.0, accel_bias_sigma=1e-4)
    start = CIRCLE_START.model_copy(update={"rpy_sigma_rad": (1e-6,) * 3})
    known, end = known.model_copy(update={"start": start}), Rotation.from_euler("z", 0.5 + YAW_RATE * CIRCLE_S)
    force = np.array([0.0, SPEED * YAW_RATE, known.gravity_m_s2])
    for _ in range(20):
        rate, felt = np.sqrt(50) * rng.normal(size=(2, 50 * CIRCLE_S + 1, 3))
        gyro, doppler = circle(bias_sigma * rng.normal(size=3) + 1e-3 * rate, 0.02 * rng.normal(size=(101, 3)))
        level = replace(gyro, specific_force=force + known.imu.accel_noise_density * felt)
        found, blind = (estimate_after(DeadReckoning, known, CIRCLE_S, rows, doppler) for rows in (level, gyro))
        off = [
            (end.inv() * Rotation.from_matrix(one.world_T_body.rotation().matrix())).as_rotvec()
            for one in (found, blind)
        ]
        squares.append(off[0][:2] @ np.linalg.solve(found.covariance[:2, :2], off[0][:2]))
        tilts.append([np.hypot(*turn[:2]) for turn in off])
    assert np.mean(tilts, axis=0)[0] < 0.3 * np.mean(tilts, axis=0)[1]
    check_consistent(np.array(squares), 2, confidence=0.999)


def test_dead_reckoning_ignores_detections_and_says_so():
    stamps_ns = later(*range(CIRCLE_S + 1))
    blind, told = (begun(DeadReckoning, circle_calibration()) for _ in range(2))
    one = told.process(Measurements(int(stamps_ns[-1]), *circle(), None, seen(stamps_ns)))
    other = blind.process(Measurements(int(stamps_ns[-1]), *circle()))
    assert one.world_T_body.equals(other.world_T_body, 0.0)
    assert told.detections().outcomes == [Outcome.IGNORED] * (CIRCLE_S + 1)
    assert len(told.landmarks()) == 0


def test_causal_estimates_keep_the_later_answer_and_time_never_runs_back():
    said = CausalEstimates()
    assert len(said.trajectory()) == 0
    for stamp_ns, x in ((1, 0.1), (2, 0.2), (2, 0.3), (1, 0.4), (3, 0.5)):
        said.keep(Estimate(stamp_ns, gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0])), np.eye(6)))
    assert said.trajectory().stamps_ns.tolist() == [1, 2, 3]
    assert said.trajectory().positions[:, 0].tolist() == [0.1, 0.3, 0.5]


@slam_filters
def test_a_refused_row_of_a_frame_changes_nothing(kind):
    """Beside an accepted one of a landmark in the state, before and after it."""
    first, states = seen(later(0.4, 0.5)), []
    both = replace(seen(later(0.8, 0.8, 0.8), 2.01), id_probability=np.array([[0.8], [0.9], [0.3]]))
    for frame in (both, both.rows(slice(1, 2))):
        slam = begun(kind, Calibration())
        slam.process(Measurements(later(0.6), imu(0.6), dvl(0.6), None, first))
        slam.process(Measurements(later(1.0), imu(1), dvl(1), None, frame))
        states.append(state_of(slam))
    assert slam.detections().outcomes[-1] is Outcome.USED
    for part, same in zip(*states, strict=True):
        assert_array_equal(part, same)


@slam_filters
def test_gravity_keeps_a_turning_vehicle_level(kind):
    """On a level circle, over many intervals of gravity; each is in the frame of its own start."""
    rate, speed = 0.5, 1.0
    rows = imu(10, (0.0, 0.0, rate), (0.0, rate * speed, 9.80665)), dvl(10, (speed, 0.0, 0.0))
    level = Calibration(start=Start(rpy_sigma_rad=(0.1, 0.1, 0.1)))
    tilts = []
    for calibration in (level, level.model_copy(update={"use_gravity": False})):
        slam = begun(kind, calibration)
        slam.process(Measurements(later(10.0), *rows))
        R = slam.attitude()
        assert np.abs(R[2, :2]).max() < 1e-4
        tilts.append(np.sqrt(height_and_tilt(slam)[2]).max())
    assert tilts[0] < 0.2 * tilts[1]


@slam_filters
def test_a_question_while_beams_are_few_changes_nothing_later(kind):
    """A call that ends before few-beam rows are completed sees a gap where later there is none."""
    velocity = dvl(12, (0.3, 0.0, 0.0))
    cov = np.tile(np.eye(3), (len(velocity), 1, 1))
    cov[25:36, 2, 2] = np.inf
    rows, views = (imu(12), replace(velocity, velocity_cov=cov)), seen(later(1.0, 3.0, 9.0, 10.0, 11.5), range_m=3.0)
    precise = Calibration(sonar=SonarCalibration(range_sigma_m=1e-3, azimuth_sigma_rad=1e-3))
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
    assert slam.process(Measurements(T0_NS - 5, None, None, None, seen([T0_NS - 10]))) is None
    end_ns = later(1.0)
    slam.process(Measurements(end_ns, imu(1), dvl(1), None, seen([later(0.5)])))
    before = state_of(slam)
    slam.process(Measurements(end_ns, None, None, None, seen([end_ns], landmark=4, probability=0.3)))
    slam.process(Measurements(end_ns, None, None, None, seen([later(0.25)])))
    slam.process(Measurements(end_ns, None, None, None, seen([end_ns], range_m=2.5)))
    for part, same in zip(state_of(slam), before, strict=True):
        assert_array_equal(part, same)
    expected = [Outcome.UNLOCATED, Outcome.NEW, Outcome.NO_IDENTITY, Outcome.LATE, Outcome.GATED]
    log = slam.detections()
    assert log.outcomes == expected
    assert log.landmark_ids.tolist() == [3, 3, 4, 3, 3]
    assert log.innovations[4] == pytest.approx([0.5, 0.0], abs=1e-6)
    assert np.isnan(log.innovations[:4]).all()
    assert slam.landmarks().ids.tolist() == [3]


@slam_filters
def test_a_filter_that_refuses_what_most_detections_say_says_so_and_follows_them(kind):
    """A landmark stands 0.5 m farther than first seen; however the log is cut, and not after one outlier."""
    t = np.concatenate([[0.5], np.arange(1.0, 9.0, 0.25)])
    far_m, states = 2.0 + 0.5 * (t >= 2.0), []
    for cuts in ((9.0,), (1.6, 4.1, 4.2, 9.0)):
        slam, before_ns = begun(kind, Calibration(), gate_probability=0.999), T0_NS - 1
        for end_ns in (later(cut) for cut in cuts):
            rows = [block.between(before_ns, end_ns) for block in (imu(9), dvl(9), seen(later(*t), range_m=far_m))]
            slam.process(Measurements(end_ns, rows[0], rows[1], None, rows[2]))
            before_ns = end_ns
        states.append(state_of(slam))
    for part, same in zip(*states, strict=True):
        assert_array_equal(part, same)
    outcomes = slam.detections().outcomes
    assert outcomes[5:10] == [Outcome.GATED] * 5
    assert outcomes[10] is Outcome.LET_IN
    assert outcomes[-1] is Outcome.USED
    assert np.abs(slam.detections().innovations[-1, 0]) < 0.1
    (message,) = slam.withheld()
    assert f"first at {later(t[10])} ns" in message
    assert "the gate may be the cause" in message
    calm = run(kind, Sequence("one outlier", Calibration(), imu(9), dvl(9), None, seen(later(*t), 2.0 + (t == 4.0))))
    assert calm.withheld() == []


@slam_filters
def test_a_row_of_motion_that_was_used_comes_too_late_and_changes_nothing(kind):
    slam, late = begun(kind, Calibration()), dvl(2, (0.1, 0.0, 0.0), rate_hz=7).rows(slice(9, 10))
    slam.process(Measurements(later(2.0), imu(2), dvl(2)))
    before = state_of(slam)
    slam.process(Measurements(later(2.0), None, late))
    (row,) = slam.refused_rows()
    assert (row.sensor, row.stamp_ns, row.reason) == ("dvl", late.stamps_ns[0], Refusal.LATE)
    for part, same in zip(state_of(slam), before, strict=True):
        assert_array_equal(part, same)


@pytest.mark.parametrize("rows", [{"detections": seen([T0_NS + 1])}, {"depth": depths(np.array([T0_NS + 1]), 0.0)}])
def test_a_row_after_the_instant_is_an_error_that_names_it(rows):
    (block,) = rows.values()
    with pytest.raises(MeasurementError, match=f"{type(block).__name__} has a row at {T0_NS + 1} ns, after end_ns"):
        Measurements(T0_NS, **rows)


@slam_filters
def test_many_landmarks_stay_where_they_were_seen(kind):
    """More than the first arrays have room for, seen in the order of their identities turned round."""
    slam, end_ns = begun(kind, Calibration(floor=FloorPrior(z_m=-1.0, sigma_m=0.01))), later(1.0)
    slam.process(Measurements(end_ns, imu(1), dvl(1)))
    for landmark in reversed(range(20)):
        slam.process(Measurements(end_ns, None, None, None, seen([end_ns], 4.0, 0.05 * landmark, landmark)))
    found = slam.landmarks()
    assert_array_equal(found.ids, np.arange(20))
    assert_allclose(np.arctan2(found.positions[:, 1], found.positions[:, 0]), 0.05 * np.arange(20), atol=1e-3)
    assert slam.detections().outcomes == [Outcome.NEW] * 20


@pytest.fixture(scope="module")
def mission():
    """With gaps of the Doppler log, wrong heading and noise enough for estimates to differ from the truth."""
    options = MissionOptions(duration_s=60.0, landmarks=12, dvl_dropouts_per_hour=240.0, dvl="explorer", imu="mti1")
    return simulate_mission(options)


def aided(mission):
    """The mission with headings and fixes at stamps of depths and a little later; some rows are unsound."""
    depth_ns = mission.depth.stamps_ns[1:-1]
    heading_ns, fixes_ns = (np.sort(np.append(depth_ns[::n], depth_ns[::n] + 1_000_000)) for n in (3, 7))
    yaw_rad = mission.truth.at(heading_ns).rotations().as_euler("ZYX")[:, 0]
    sigma_rad, covs = np.full(len(yaw_rad), math.nan), np.full((len(fixes_ns), 3, 3), math.nan)
    sigma_rad[5::10], covs[3::10] = -1.0, -np.eye(3)
    fixes = PositionFixes(fixes_ns, mission.truth.at(fixes_ns).positions + 1.0, covs)
    return replace(mission, heading=Heading(heading_ns, yaw_rad + 0.03, sigma_rad), positions=fixes)


@slam_filters
@pytest.mark.parametrize("with_aiding", [False, True])
def test_the_outcome_depends_neither_on_how_the_log_is_cut_nor_on_being_asked(mission, kind, with_aiding):
    """To the last bit, over gaps of the Doppler log and intervals of gravity, with headings and position fixes."""
    mission = aided(mission) if with_aiding else mission
    instants = mission.instants(0.1)
    instants = instants[instants < mission.start_ns + 35 * NS_PER_S]
    stamps = np.concatenate([block.stamps_ns for block in mission.blocks().values()])
    every_instant = np.unique(np.concatenate([stamps, mission.instants(50.0)]))
    live, windows, whole = (begun(kind, mission.calibration, gravity_interval_s=7.0) for _ in range(3))
    for row in mission.replay(every_instant[every_instant <= instants[-1]]):
        live.process(row)
    for window in mission.replay(instants):
        windows.process(window)
    for window in mission.replay(instants[-1:]):
        whole.process(window)
    assert sorted(live.refused_rows()) == sorted(windows.refused_rows())
    unsound = {row.sensor for row in live.refused_rows() if row.reason is Refusal.UNSOUND}
    assert unsound == ({"heading", "positions"} if with_aiding else set())
    for other in (windows, whole):
        assert live.detections().outcomes == other.detections().outcomes
        for part, same in zip(state_of(live), state_of(other), strict=True):
            assert_array_equal(part, same)
        at = np.searchsorted(live.trajectory().stamps_ns, other.trajectory().stamps_ns)
        assert_array_equal(live.trajectory().positions[at], other.trajectory().positions)
        assert_array_equal(live.trajectory().covariances[at], other.trajectory().covariances)


@slam_filters
@pytest.mark.parametrize("sensor", ["heading", "positions"])
def test_aiding_of_huge_noise_tells_nothing_and_less_of_it_more(mission, kind, sensor):
    block, states = getattr(aided(mission), sensor), []
    for sigma in (None, 1e6, 0.1):
        n, runs = len(block), mission
        if sigma is not None:
            covs = np.tile(sigma**2 * np.eye(3), (n, 1, 1))
            noise = {"sigma_rad": covs[:, 0, 0] ** 0.5} if sensor == "heading" else {"covariance_m2": covs}
            runs = replace(mission, **{sensor: replace(block, **noise)})
        states.append(run(kind, runs).trajectory())
    for poses in ("positions", "covariances"):
        none, nothing, some = (getattr(trajectory, poses) for trajectory in states)
        assert_allclose(nothing, none, atol=1e-9)
        assert np.abs(some - none).max() > 1e-5


@slam_filters
def test_aiding_in_a_gap_shares_the_error_of_the_motion(kind):
    """Ten fixes at 9 s of a gap tell of the start rather less than an exact one; a heading is as good as elsewhere."""
    fixes_ns, unknown = later(*np.linspace(9.0, 9.9, 10)), np.full((10, 3, 3), math.nan)
    fixes = PositionFixes(fixes_ns, np.zeros((10, 3)), np.where(np.isnan(unknown), 1e-8 * np.eye(3), 0.0))
    sequence = replace(in_a_gap(), positions=fixes)
    slam = begun(kind, sequence.calibration)
    for window in sequence.replay(later(8.0, 9.95)):
        slam.process(window)
    walked = sequence.calibration.dvl.velocity_walk_density**2 * 7.0**3 / 3
    assert 1 / (1 + 1 / walked) < height_and_tilt(slam)[1] < 0.9


def test_a_late_fix_has_the_motion_backwards_with_its_covariance_and_derivative(monkeypatch):
    """By differences of the inverse; it is asked for with the attitude at its start, that of the fix."""
    told, (gyro, doppler), nothing = [], circle(), np.zeros(6)
    monkeypatch.setattr(EkfSlam, "_fix", lambda _, motion, *__: told.append(motion))
    slam, end_ns, fix_ns = begun(EkfSlam, circle_calibration()), later(10.0), later(6.03)
    slam.process(Measurements(end_ns, gyro.between(T0_NS - 1, end_ns), doppler.between(T0_NS - 1, end_ns)))
    late = PositionFixes(np.array([fix_ns]), np.zeros((1, 3)), np.eye(3)[None])
    asked, motion = [], slam.odometry.motion
    monkeypatch.setattr(slam.odometry, "motion", lambda *of: asked.append(of[3]) or motion(*of))
    slam.process(Measurements(end_ns, positions=late))
    monkeypatch.undo()
    forth, (back,) = slam.odometry.motion(fix_ns, slam.node_ns, np.zeros(3)), told
    inverse = forth.i_T_j.inverse()
    assert_allclose(asked[-1] @ forth.i_T_j.rotation().matrix(), slam.attitude(), atol=1e-9)
    assert_allclose(back.dR, inverse.rotation().matrix(), atol=1e-12)
    assert_allclose(back.dp, inverse.translation(), atol=1e-12)
    moved = lambda eps: inverse.localCoordinates(forth.i_T_j.retract(eps).inverse())  # noqa: E731
    J = central_differences(moved, nothing)
    assert_allclose(back.C, J @ forth.covariance @ J.T, rtol=1e-6, atol=1e-12)
    assert_allclose(back.D, J @ forth.D_bias, atol=1e-6)
    assert np.abs(back.C - forth.covariance).max() > 1e-6


def without(bias, earth, dR, dp, D, impulse):
    found = dR.copy(), dp.copy(), impulse.copy()
    remove_rate(*found[:2], D, found[2], bias, earth)
    return found


def test_a_bias_and_the_earth_s_rate_are_removed_from_a_motion_as_from_its_rows(mission):
    """Over a second of turning: to first order in the bias, and in the Earth's rate with that of both ends."""
    bias, earth, zero = np.array([2e-3, -1e-3, 3e-3]), np.array([1e-3, 2e-3, -1e-3]), np.zeros(3)
    unbiased = replace(mission.imu, angular_velocity=mission.imu.angular_velocity - bias)
    motions = []
    for rows in (mission.imu, unbiased):
        odometry = Odometry(mission.calibration)
        odometry.add(rows, mission.dvl)
        epochs_ns, reached_ns = odometry.epochs_reached(mission.start_ns, mission.start_ns + 20 * NS_PER_S)
        start_ns, end_ns = epochs_ns[:-8], epochs_ns[8:]
        motions.append(odometry.motions(start_ns, end_ns, reached_ns[8:], zero))
    turns = 0.0
    for start, end, (dR, dp, _, D, impulse), exact in zip(
        start_ns, end_ns, zip(*motions[0], strict=True), zip(*motions[1], strict=True), strict=True
    ):
        if np.isnan(dp[0]):
            continue
        R, p, push = without(bias, zero, dR, dp, D, impulse)
        assert_allclose(Rotation.from_matrix(exact[0].T @ R).as_rotvec(), 0.0, atol=2e-5)
        assert_allclose(p, exact[1], atol=1e-5)
        assert_allclose(push, exact[4], atol=5e-3)
        R, _, _ = without(zero, earth, dR, dp, D, impulse)
        duration_s = (end - start) * 1e-9
        turned = Rotation.from_rotvec(-earth * duration_s).as_matrix() @ dR
        assert_allclose(Rotation.from_matrix(turned.T @ R).as_rotvec(), 0.0, atol=2e-5)
        turns = max(turns, Rotation.from_matrix(dR).magnitude())
    assert turns > 0.1


def test_events_come_in_the_order_of_their_stamps_each_with_its_motion_from_the_newest_epoch():
    """At equal stamps epoch, plane, gravity, depth, heading, fix, frame; gravity where its interval is long enough."""
    samples = np.array([[3, 10, 20, 20, 20, 50], [*[DEPTH] * 3, HEADING, FIX, DEPTH], [0, 1, 2, 0, 1, 3]])
    seen = np.array([18, 20, 20, 45, 45])
    outcome = np.array([*[ACCEPTED] * 3, USED, ACCEPTED], np.int8)

    def events(interval_ns, is_planar=False):
        epochs, reached, out = np.array([19, 39, 57]), np.array([20, 40, 58]), np.empty((5, 30), np.int64)
        n = in_order(epochs, reached, samples, seen, outcome, 10, 60, 5, 5, interval_ns, is_planar, out)
        return list(map(tuple, out[:, :n].T.tolist()))

    expected = [
        (10, 5, 10, DEPTH, 1), (18, 5, 18, FRAME, 0), (20, 5, 19, EPOCH, 0), (20, 19, 20, DEPTH, 2),
        (20, 19, 20, HEADING, 0), (20, 19, 20, FIX, 1),
        (20, 19, 20, FRAME, 1), (40, 19, 39, EPOCH, 1), (40, 39, 39, GRAVITY, 0), (45, 39, 45, FRAME, 4),
        (50, 39, 50, DEPTH, 3), (58, 39, 57, EPOCH, 2), (60, 57, 60, END, 0),
    ]  # fmt: skip
    assert events(34) == expected
    assert events(0) == [event for event in expected if event[3] != GRAVITY]
    assert [event[3] for event in events(14, is_planar=True)[3:6]] == [PLANE, GRAVITY, DEPTH]
    assert [event[3] for event in events(14)].count(GRAVITY) == 3


@pytest.mark.slow
@pytest.mark.parametrize("predicts_by_node", [False, True])
def test_ekf_slam_on_filterpy_ends_in_the_same_state(monkeypatch, predicts_by_node):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location("filterpy_ekf", BENCHMARKS / "filterpy_ekf.py")
    filterpy_ekf = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "filterpy_ekf", filterpy_ekf)  # dataclasses look their module up
    spec.loader.exec_module(filterpy_ekf)

    mission = simulate_mission(MissionOptions(duration_s=40.0, landmarks=12, dvl_dropouts_per_hour=360.0))
    never_a_gap = mission.calibration.dvl.model_copy(update={"gap_s": 1e3})  # filterpy's takes straight lines
    mission = replace(mission, calibration=mission.calibration.model_copy(update={"dvl": never_a_gap}))
    slam = begun(EkfSlam, mission.calibration)
    for window in mission.replay(mission.instants(2.0)):
        slam.process(window)
    theirs = filterpy_ekf.run(mission, int(mission.instants(2.0)[-1]), predicts_by_node=predicts_by_node)
    node_ns, x, P = slam.state()
    x, P = np.delete(x, COMPASS), np.delete(np.delete(P, COMPASS, 0), COMPASS, 1)
    assert node_ns == theirs.node_ns
    assert len(x) > 6 + 3 * 5
    sigma = np.sqrt(np.diag(P))
    assert_allclose(x, theirs.x, atol=1e-8)
    assert_allclose(P / np.outer(sigma, sigma), theirs.P / np.outer(sigma, sigma), atol=1e-8)


def started(sequence, **changes):
    """The same measurements with another start."""
    start = sequence.calibration.start.model_copy(update=changes)
    return replace(sequence, calibration=sequence.calibration.model_copy(update={"start": start}))


def sure_and_unsure(kind, mission):
    """Started level, so that the body's third axis is the world's; heading, x and y known and hardly known."""
    for sigma in (1e-4, 0.5):
        level = {"rpy_rad": (0.0, 0.0, mission.calibration.start.rpy_rad[2]), "rpy_sigma_rad": (0.02, 0.02, sigma)}
        begun = started(mission, **level, position_sigma_m=(100 * sigma, 100 * sigma, 0.01))
        yield run(kind, begun, gate_probability=1.0)


@pytest.mark.slow
def test_an_unknown_world_frame_changes_no_invariant_estimate(mission):
    """Invariance under a stochastic rigid transformation: only covariances differ, by the start's and no more."""
    sure, unsure = sure_and_unsure(InvariantEkf, mission)
    assert_allclose(unsure.trajectory().positions, sure.trajectory().positions, atol=1e-6)
    assert_allclose(unsure.landmarks().positions, sure.landmarks().positions, atol=1e-6)
    assert_allclose(yaw_variances(unsure.trajectory()) - yaw_variances(sure.trajectory()), 0.5**2, rtol=1e-3)


def test_an_unknown_world_frame_changes_the_plain_filter_s_estimates_and_it_invents_a_heading(mission):
    sure, unsure = sure_and_unsure(EkfSlam, mission)
    assert np.abs(unsure.trajectory().positions - sure.trajectory().positions).max() > 0.1
    assert (yaw_variances(unsure.trajectory()) - yaw_variances(sure.trajectory()))[-1] < 0.8 * 0.5**2


def test_the_world_s_frame_changes_nothing_but_the_frame(mission):
    turn, shift = Rotation.from_euler("z", 2.0), np.array([300.0, -200.0, 0.0])
    start = mission.calibration.start
    roll, pitch, yaw = start.rpy_rad
    moved = started(mission, position_m=tuple(turn.apply(start.position_m) + shift), rpy_rad=(roll, pitch, yaw + 2.0))
    here, there = run(InvariantEkf, mission), run(InvariantEkf, moved)
    for one, other in ((here.trajectory(), there.trajectory()), (here.landmarks(), there.landmarks())):
        assert_allclose(other.positions, turn.apply(one.positions) + shift, atol=1e-6)
    into_body = (turn * here.trajectory().rotations()).inv() * there.trajectory().rotations()
    assert_allclose(into_body.magnitude(), 0.0, atol=1e-7)
    assert_allclose(there.trajectory().covariances, here.trajectory().covariances, atol=1e-8)
    R = turn.as_matrix()
    assert_allclose(there.landmarks().covariances, R @ here.landmarks().covariances @ R.T, atol=1e-8)


@slam_filters
def test_a_robot_at_rest_learns_its_heading_from_one_landmark_only_in_the_plain_filter(kind):
    """Heading unknown to 0.3 rad. Julier and Uhlmann, "A counter example to the theory of SLAM", ICRA 2001."""
    rng, t = np.random.default_rng(0), later(*np.arange(0.2, 20.1, 0.2))
    calibration = Calibration(
        imu=ImuCalibration(gyro_noise_density=1e-7, gyro_bias_sigma=0.0),
        dvl=DvlCalibration(velocity_sigma_m_s=(1e-5, 1e-5, 1e-5)),
        start=Start(position_sigma_m=(1e-3, 1e-3, 1e-3), rpy_sigma_rad=(1e-3, 1e-3, 0.3)),
        sonar=SonarCalibration(range_sigma_m=0.3, azimuth_sigma_rad=0.1),
        floor=FloorPrior(z_m=0.0, sigma_m=0.01),
    )
    detections = seen(t, 5.0 + 0.3 * rng.normal(size=len(t)), 0.4 + 0.1 * rng.normal(size=len(t)))
    slam = run(kind, Sequence("at rest", calibration, imu(20), dvl(20), None, detections), gate_probability=1.0)
    assert slam.detections().outcomes.count(Outcome.USED) == len(t) - 1
    variances = yaw_variances(slam.trajectory())
    if kind is InvariantEkf:
        assert_allclose(variances, 0.3**2, rtol=1e-6)
    else:
        assert variances[-1] < min(0.95 * 0.3**2, variances[0])


def test_a_gyro_s_bias_is_learnt_from_landmarks():
    """At rest with a gyro that turns: the landmark stays where it was, so the gyro is wrong."""
    bias, t = 2e-3, later(*np.arange(0.2, 30.1, 0.2))
    calibration = Calibration(imu=ImuCalibration(gyro_noise_density=1e-4, gyro_bias_sigma=5e-3))
    turning = Sequence("bias", calibration, imu(30, (0.0, 0.0, bias)), dvl(30), None, seen(t, 3.0, 0.0))
    _, state = run(InvariantEkf, turning).state()
    assert state.bias[5] == pytest.approx(bias, abs=2e-4)
    assert state.P[8, 8] ** 0.5 < 0.1 * 5e-3
    _, state = run(InvariantEkf, replace(turning, detections=None)).state()
    assert state.bias[5] == pytest.approx(0.0, abs=1e-6)


def test_without_a_bias_to_estimate_there_is_none_and_none_that_walks(mission):
    without = mission.calibration.imu.model_copy(update={"gyro_bias_sigma": 0.0, "gyro_bias_walk_density": 1e-3})
    calibration = mission.calibration.model_copy(update={"imu": without})
    _, state = run(InvariantEkf, replace(mission, calibration=calibration)).state()
    assert_array_equal(state.bias[:6], 0.0)
    assert_array_equal(state.P[3:9], 0.0)


@slam_filters
@pytest.mark.parametrize("is_felt", [True, False])
def test_gravity_tells_roll_and_pitch_and_nothing_else_does(kind, is_felt):
    """Start level, lie tilted."""
    R = np.array(Start(rpy_rad=(0.1, -0.07, 0.0)).pose().rotation().matrix())
    rows = imu(20, force=R.T @ STANDARD_FORCE if is_felt else NO_FORCE), dvl(20)
    estimate = estimate_after(kind, Calibration(start=Start(rpy_sigma_rad=(0.2, 0.2, 1e-3))), 20, *rows)
    sigma = np.sqrt(np.diag(estimate.covariance)[:2])
    expected = [0.1, -0.07] if is_felt else [0.0, 0.0]
    assert_allclose(estimate.world_T_body.rotation().rpy()[:2], expected, atol=1e-3 if is_felt else 1e-9)
    assert sigma.max() < 2.5e-3 if is_felt else sigma.min() > 0.19


@slam_filters
def test_an_accelerating_vehicle_is_not_taken_for_a_tilted_one(kind):
    seconds, acceleration = 10, 0.2
    doppler = dvl(seconds, rate_hz=10)
    velocity = np.outer((doppler.stamps_ns - T0_NS) * 1e-9, [acceleration, 0.0, 0.0])
    force = STANDARD_FORCE + np.array([acceleration, 0.0, 0.0])
    rows = imu(seconds, force=force, rate_hz=100), replace(doppler, velocity=velocity)
    estimate = estimate_after(kind, Calibration(start=Start(rpy_sigma_rad=(0.05, 0.05, 1e-3))), seconds, *rows)
    assert_allclose(estimate.world_T_body.rotation().rpy(), 0.0, atol=1e-6)
    assert estimate.world_T_body.translation()[0] == pytest.approx(0.5 * acceleration * seconds**2, abs=1e-6)


@slam_filters
def test_gravity_counts_once_an_interval_with_its_own_variance(kind):
    """At rest: after n intervals a wide prior has become ``sigma^2 / n``, sigma that of one direction."""
    seconds, noise = 10, 0.02
    known = {"gyro_noise_density": 1e-9, "gyro_bias_sigma": 0.0, "accel_bias_sigma": 0.0}
    calibration = Calibration(
        imu=ImuCalibration(accel_noise_density=noise, **known),
        dvl=DvlCalibration(velocity_sigma_m_s=(1e-6, 1e-6, 1e-6)),
        start=Start(rpy_sigma_rad=(1.0, 1.0, 1e-3)),
    )
    slam = run(kind, Sequence("at rest", calibration, imu(seconds), dvl(seconds)))
    assert_allclose(height_and_tilt(slam)[2], noise**2 / calibration.gravity_m_s2**2 / seconds, rtol=1e-3)


@slam_filters
def test_gravity_has_the_velocity_noise_of_both_ends_of_its_interval(kind):
    """At rest for one interval of a second, a Doppler log that grows ten times as exact, and a wide prior."""
    known = {"gyro_noise_density": 1e-9, "gyro_bias_sigma": 0.0, "accel_bias_sigma": 0.0, "accel_noise_density": 1e-9}
    calibration = Calibration(imu=ImuCalibration(**known), start=Start(rpy_sigma_rad=(1.0, 1.0, 1e-3)))
    doppler, variances = dvl(1), np.array([4e-4] + [4e-6] * 5)
    doppler = replace(doppler, velocity_cov=variances[:, None, None] * np.eye(3))
    slam = run(kind, Sequence("at rest", calibration, imu(1.1), doppler))
    expected = (variances[0] + variances[-1]) / calibration.gravity_m_s2**2
    assert_allclose(height_and_tilt(slam)[2], expected, rtol=1e-3)


@slam_filters
def test_depth_of_a_port_off_the_origin_holds_the_height(kind):
    start = Start(position_m=(50.0, 80.0, -1.2), rpy_rad=(0.0, 0.3, 1.0), rpy_sigma_rad=(1e-6, 1e-6, 1e-6))
    port_m = (0.4, 0.1, -0.2)
    calibration = Calibration(start=start, depth=DepthCalibration(port_m=port_m), use_gravity=False)
    true_z = -1.5 - start.pose().rotation().rotate(np.array(port_m))[2]
    rows = imu(20), dvl(20, (0.0, 0.0, 0.01))
    held = estimate_after(kind, calibration, 20, *rows, depths(later(*np.arange(0, 20.01, 0.1)), -1.5))
    free = estimate_after(kind, calibration, 20, *rows)
    assert abs(held.world_T_body.translation()[2] - true_z) < 0.02
    assert abs(free.world_T_body.translation()[2] - true_z) > 0.1
    assert held.covariance[5, 5] < free.covariance[5, 5]


@slam_filters
def test_planar_motion_keeps_height_and_tilt(kind):
    calibration = Calibration(
        planar=PlanarMotion(z_m=0.5),
        start=Start(position_m=(0.0, 0.0, 0.5)),
        imu=ImuCalibration(gyro_noise_density=0.01),
        use_gravity=False,
    )
    rows = imu(10, (0.01, -0.01, 0.1)), dvl(10, (0.3, 0.0, 0.02))
    held = estimate_after(kind, calibration, 10, *rows).world_T_body
    free = estimate_after(kind, calibration.model_copy(update={"planar": None}), 10, *rows).world_T_body
    assert abs(held.translation()[2] - 0.5) < 0.01
    assert abs(free.translation()[2] - 0.5) > 0.1
    assert np.abs(held.rotation().rpy()[:2]).max() < 0.005
    assert held.rotation().yaw() == pytest.approx(1.0, abs=0.01)


def test_a_pitch_of_ninety_degrees_is_an_error_in_euler_angles_only():
    calibration = Calibration(use_gravity=False, start=Start(rpy_rad=(0.0, math.pi / 2, 0.0)))
    with pytest.raises(EstimatorError, match=r"pitch is 90\.\d+ deg .* use isam2"):
        estimate_after(EkfSlam, calibration, 1, imu(1), dvl(1))
    estimate = estimate_after(InvariantEkf, calibration, 1, imu(1), dvl(1, (0.5, 0.0, 0.0)))
    assert_allclose(estimate.world_T_body.translation(), [0.0, 0.0, -0.5], atol=1e-9)


def in_a_gap(depth=None, detections=None):
    """At rest, without accelerometer; the Doppler log is silent from 2 s to 12 s and from 14 s to 24 s."""
    doppler = dvl(25)
    seconds = (doppler.stamps_ns - T0_NS) * 1e-9
    calibration = Calibration(
        use_gravity=False,
        depth=DepthCalibration(sigma_m=0.001),
        start=Start(position_sigma_m=(1.0, 1.0, 1.0)),
        sonar=SonarCalibration(range_sigma_m=0.001, azimuth_sigma_rad=0.001),
    )
    rows = doppler.rows((seconds <= 2.0) | ((seconds >= 12.0) & (seconds <= 14.0)) | (seconds >= 24.0))
    return Sequence("gap", calibration, imu(25, force=NO_FORCE), rows, depth, detections)


def test_a_gap_adds_what_an_unknown_gyro_bias_does_to_the_displacement_where_the_state_has_none():
    """``sigma^2 J J^T``, J by the motion over the gap without one bias and another."""
    sigma, step, end_ns = 0.01, 1e-5, later(3.0)
    slam = begun(EkfSlam, Calibration(use_gravity=False, imu=ImuCalibration(gyro_bias_sigma=sigma)))
    gyro = imu(3, (0.05, -0.1, 0.2), STANDARD_FORCE + np.array([0.1, -0.2, 0.0]))
    covariance = slam.process(Measurements(end_ns, gyro, dvl(1, (0.4, 0.1, 0.0)))).covariance

    def over_gap(bias):
        return slam.odometry.motion(slam.state()[0], end_ns, bias)

    over = over_gap(np.zeros(3))
    ends = [[over_gap(side * step * e).i_T_j.translation() for side in (1, -1)] for e in np.eye(3)]
    dR, dp = over.i_T_j.rotation().matrix(), over.i_T_j.translation()
    J, C = dR.T @ np.array([(a - b) / (2 * step) for a, b in ends]).T, over.covariance.copy()
    C[3:, 3:] += sigma**2 * J @ J.T
    expected = slam.pose_after(Motion(np.ascontiguousarray(dR), dp, C, over.D_bias, np.zeros(3)))[2]
    assert_allclose(covariance, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    assert np.abs(J @ J.T - J.T @ J).max() > 0.05 * np.linalg.norm(J) ** 2  # else the order would not be seen
    assert sigma**2 * np.linalg.norm(J) ** 2 > 0.1 * np.trace(covariance[3:, 3:])


@slam_filters
def test_many_depths_in_a_gap_tell_less_of_the_start_than_one_exact_one(kind):
    """All share the motion's error, whose variance in a gap is at least that of the random walk, ``q^2 T^3 / 3``."""
    sequence = in_a_gap(depths(later(*np.linspace(9.0, 9.9, 10)), 0.0))
    slam = begun(kind, sequence.calibration)
    for window in sequence.replay(later(8.0, 9.95)):
        slam.process(window)
    assert slam.state()[0] == later(2.0)
    walked = sequence.calibration.dvl.velocity_walk_density**2 * 7.0**3 / 3
    assert 1 / (1 + 1 / walked) < height_and_tilt(slam)[1] < 0.9


@slam_filters
def test_detections_in_a_gap_count_less_and_less_and_those_after_it_in_full(kind):
    """``k (k + 1)`` times the motion's covariance, which is nearly all of the innovation's."""
    sequence = in_a_gap(detections=seen(later(1.5, 9.0, 9.001, 13.0, 13.1, 21.0), 3.0, 0.0))
    log = run(kind, sequence).detections()
    assert log.outcomes == [Outcome.NEW, *[Outcome.USED] * 5]
    variances = log.innovation_covs[:, 0, 0]
    assert variances[2] / variances[1] == pytest.approx(3.0, rel=0.01)
    assert variances[4] < 1e-3 * variances[1]
    assert variances[5] == pytest.approx(variances[1], rel=0.01), "the next gap counts anew"


@slam_filters
def test_a_logged_depth_variance_goes_before_the_calibration_s_and_a_negative_one_is_refused(kind):
    depth_m = {variance: in_a_gap(depths(np.array([later(1.0)]), 1.0, variance)) for variance in (1e6, math.nan, -1e6)}
    runs = [run(kind, sequence) for sequence in depth_m.values()]
    assert [height_and_tilt(slam)[0] for slam in runs] == pytest.approx([0.0, 1.0, 0.0], abs=1e-3)
    assert [[row.reason for row in slam.refused_rows() if row.sensor == "depth"] for slam in runs] == [
        [],
        [],
        [Refusal.UNSOUND],
    ]


@slam_filters
def test_an_innovation_that_a_source_of_motion_lets_be_impossible_is_an_error_with_its_time(kind, monkeypatch):
    """Ours refuses such rows; that of somebody else may not."""
    monkeypatch.setattr(Odometry, "used_depths", lambda _, depth: depth)
    with pytest.raises(EstimatorError, match=rf"{kind.name}: between \d+ and \d+ ns .* variances above zero"):
        run(kind, in_a_gap(depths(np.array([later(1.0)]), 1.0, -1e6)))


def test_ekf_slam_goes_on_from_a_pitch_beyond_a_right_angle_as_from_the_same_attitude_and_says_so():
    """As after a correction by a wrong detection: prediction reads all angles from a rotation."""
    calibration = Calibration(start=Start(rpy_rad=(0.2, 0.4, 3.0), rpy_sigma_rad=(0.01, 0.02, 0.03)))
    rows = imu(9, (0.01, 0.02, 0.2)), dvl(9, (0.3, 0.1, 0.05))
    views = seen(later(*np.arange(1.0, 9.0)), range_m=3.0)
    sequence = Sequence("overturned", calibration, *rows, detections=views)
    windows = list(sequence.replay(sequence.instants(1.0)))
    upright, overturned = begun(EkfSlam, calibration), begun(EkfSlam, calibration)
    for k, window in enumerate(windows):
        if k == 4:
            x, P = overturned._x, overturned._P
            x[3:6] = [x[3] + np.pi, np.pi - x[4], x[5] - np.pi]
            P[4] *= -1.0
            P[:, 4] *= -1.0
            assert upright.withheld() == overturned.withheld() == []
            depth = Measurements(windows[3].end_ns, depth=depths(np.array([windows[3].end_ns]), 0.0, 1.0))
            assert_allclose(*(slam.process(depth).world_T_body.matrix() for slam in (upright, overturned)), atol=1e-9)
        here, there = upright.process(window), overturned.process(window)
    assert_allclose(there.world_T_body.matrix(), here.world_T_body.matrix(), atol=1e-9)
    assert_allclose(there.covariance, here.covariance, rtol=1e-6, atol=1e-12)
    assert_allclose(overturned.state()[1], upright.state()[1], atol=1e-9)
    assert_allclose(overturned.state()[2], upright.state()[2], rtol=1e-6, atol=1e-12)
    (line,) = overturned.withheld()
    assert line.startswith("pitch was corrected to 1")
    assert upright.withheld() == []
