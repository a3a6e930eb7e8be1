import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from baselines.ekf_slam import EkfSlam, EkfSlamParams
from baselines.invariant_ekf import InvariantEkf, InvariantEkfParams, start_state
from sonar_graph.calibration import (
    Calibration,
    DepthCalibration,
    DvlCalibration,
    FloorPrior,
    ImuCalibration,
    PlanarMotion,
    SonarCalibration,
    Start,
)
from sonar_graph.errors import EstimatorError
from sonar_graph.evaluation.consistency import yaw_variances
from sonar_graph.measurements import Depth, Dvl, Imu, LandmarkDetections, Measurements
from sonar_graph.sequence import NS_PER_S, Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.states import Outcome

from .invariant import derivative, moved_by

T0_NS = 1_700_000_000 * NS_PER_S
GRAVITY = np.array([0.0, 0.0, 9.80665])


def stamps(rate_hz, seconds):
    return T0_NS + np.round(np.arange(round(seconds * rate_hz) + 1) * (NS_PER_S / rate_hz)).astype(np.int64)


def imu(seconds, rate=(0.0, 0.0, 0.0), force=GRAVITY):
    t = stamps(100, seconds)
    return Imu(t, np.tile(rate, (len(t), 1)), np.tile(force, (len(t), 1)))


def dvl(seconds, velocity=(0.0, 0.0, 0.0)):
    t = stamps(5, seconds)
    return Dvl(t, np.tile(velocity, (len(t), 1)).astype(float), np.full((len(t), 3, 3), np.nan))


def seen(stamps_ns, ranges_m, azimuths_rad, landmark=3):
    n = len(stamps_ns)
    return LandmarkDetections(
        np.asarray(stamps_ns),
        np.asarray(ranges_m, float),
        np.asarray(azimuths_rad, float),
        np.full((n, 2, 2), np.nan),
        np.full((n, 1), landmark),
        np.ones((n, 1)),
    )


def run(kind, sequence, params=None, rate_hz=1.0):
    estimator = kind(sequence.calibration, params)
    for window in sequence.replay(sequence.instants(rate_hz)):
        estimator.process(window)
    return estimator


@pytest.fixture(scope="module")
def mission():
    """With gaps of the Doppler log, wrong heading and noise enough for estimates to differ from the truth."""
    options = MissionOptions(duration_s=60.0, landmarks=12, dvl_dropouts_per_hour=240.0, dvl="explorer", imu="mti1")
    return simulate_mission(options)


def started(sequence, **changes):
    """The same measurements with another start."""
    start = sequence.calibration.start.model_copy(update=changes)
    calibration = sequence.calibration.model_copy(update={"start": start})
    return Sequence(sequence.name, calibration, sequence.imu, sequence.dvl, sequence.depth, sequence.detections)


def level(sequence, yaw_sigma_rad):
    """Started level, so that the body's third axis is the world's; x and y may be anywhere."""
    yaw_rad = sequence.calibration.start.rpy_rad[2]
    horizontal_m = 100 * yaw_sigma_rad
    return started(
        sequence,
        rpy_rad=(0.0, 0.0, yaw_rad),
        rpy_sigma_rad=(0.02, 0.02, yaw_sigma_rad),
        position_sigma_m=(horizontal_m, horizontal_m, 0.01),
    )


NO_GATE = {InvariantEkf: InvariantEkfParams(gate_probability=1.0), EkfSlam: EkfSlamParams(gate_probability=1.0)}


def sure_and_unsure(kind, mission):
    return [run(kind, level(mission, sigma), NO_GATE[kind]) for sigma in (1e-4, 0.5)]


@pytest.mark.slow
def test_not_knowing_where_the_world_is_changes_no_estimate(mission):
    """Invariance under a stochastic rigid transformation: only covariances differ, by the start's and no more."""
    sure, unsure = sure_and_unsure(InvariantEkf, mission)
    assert_allclose(unsure.trajectory().positions, sure.trajectory().positions, atol=1e-6)
    assert_allclose(unsure.landmarks().positions, sure.landmarks().positions, atol=1e-6)
    yaw_variance_grew = yaw_variances(unsure.trajectory()) - yaw_variances(sure.trajectory())
    assert_allclose(yaw_variance_grew, 0.5**2, rtol=1e-3)


def test_the_plain_filter_s_estimates_change_with_it_and_it_learns_a_heading_that_nothing_tells(mission):
    sure, unsure = sure_and_unsure(EkfSlam, mission)
    assert np.abs(unsure.trajectory().positions - sure.trajectory().positions).max() > 0.1
    yaw_variance_grew = yaw_variances(unsure.trajectory()) - yaw_variances(sure.trajectory())
    assert yaw_variance_grew[-1] < 0.8 * 0.5**2


def test_the_world_s_frame_changes_nothing_but_the_frame(mission):
    turn, shift = Rotation.from_euler("z", 2.0), np.array([300.0, -200.0, 0.0])
    start = mission.calibration.start
    roll, pitch, yaw = start.rpy_rad
    moved = started(mission, position_m=tuple(turn.apply(start.position_m) + shift), rpy_rad=(roll, pitch, yaw + 2.0))
    here, there = run(InvariantEkf, mission), run(InvariantEkf, moved)
    assert_allclose(there.trajectory().positions, turn.apply(here.trajectory().positions) + shift, atol=1e-6)
    assert_allclose(there.landmarks().positions, turn.apply(here.landmarks().positions) + shift, atol=1e-6)
    into_body = (turn * here.trajectory().rotations()).inv() * there.trajectory().rotations()
    assert_allclose(into_body.magnitude(), 0.0, atol=1e-7)
    assert_allclose(there.trajectory().covariances, here.trajectory().covariances, atol=1e-8)
    R = turn.as_matrix()
    assert_allclose(there.landmarks().covariances, R @ here.landmarks().covariances @ R.T, atol=1e-8)


def stationary(kind, seed=0):
    """Yaw variances of a robot at rest that looks at one landmark time and again, its heading unknown to 0.3 rad."""
    rng = np.random.default_rng(seed)
    calibration = Calibration(
        imu=ImuCalibration(gyro_noise_density=1e-7, gyro_bias_sigma=0.0),
        dvl=DvlCalibration(velocity_sigma_m_s=(1e-5, 1e-5, 1e-5)),
        start=Start(position_sigma_m=(1e-3, 1e-3, 1e-3), rpy_sigma_rad=(1e-3, 1e-3, 0.3)),
        sonar=SonarCalibration(range_sigma_m=0.3, azimuth_sigma_rad=0.1),
        floor=FloorPrior(z_m=0.0, sigma_m=0.01),
    )
    t = stamps(5, 20)[1:]
    detections = seen(t, 5.0 + 0.3 * rng.normal(size=len(t)), 0.4 + 0.1 * rng.normal(size=len(t)))
    sequence = Sequence("at rest", calibration, imu(20), dvl(20), None, detections)
    estimator = run(kind, sequence, NO_GATE[kind])
    assert estimator.detections().outcomes.count(Outcome.USED) == len(t) - 1
    return yaw_variances(estimator.trajectory())


def test_a_robot_at_rest_learns_nothing_of_its_heading_from_a_landmark():
    assert_allclose(stationary(InvariantEkf), 0.3**2, rtol=1e-6)


def test_the_plain_filter_at_rest_believes_that_it_does():
    """Julier and Uhlmann, "A counter example to the theory of SLAM", ICRA 2001."""
    variances = stationary(EkfSlam)
    assert variances[-1] < 0.95 * 0.3**2
    assert variances[-1] < variances[0]


def test_a_gyro_s_bias_is_learnt_from_landmarks():
    """At rest with a gyro that turns: the landmark stays where it was, so the gyro is wrong."""
    bias = 2e-3
    calibration = Calibration(imu=ImuCalibration(gyro_noise_density=1e-4, gyro_bias_sigma=5e-3))
    t = stamps(5, 30)[1:]
    detections = seen(t, np.full(len(t), 3.0), np.zeros(len(t)))
    turning = Sequence("turning gyro", calibration, imu(30, rate=(0.0, 0.0, bias)), dvl(30), None, detections)
    _, state = run(InvariantEkf, turning).state()
    assert state.bias[2] == pytest.approx(bias, abs=2e-4)
    assert state.P[5, 5] ** 0.5 < 0.1 * 5e-3
    blind = Sequence("blind", calibration, turning.imu, turning.dvl)
    _, state = run(InvariantEkf, blind).state()
    assert state.bias[2] == pytest.approx(0.0, abs=1e-6)


def test_without_a_bias_to_estimate_there_is_none_and_none_that_walks(mission):
    without = mission.calibration.imu.model_copy(update={"gyro_bias_sigma": 0.0, "gyro_bias_walk_density": 1e-3})
    calibration = mission.calibration.model_copy(update={"imu": without})
    sequence = Sequence("no bias", calibration, mission.imu, mission.dvl, mission.depth, mission.detections)
    _, state = run(InvariantEkf, sequence).state()
    assert_array_equal(state.bias, 0.0)
    assert_array_equal(state.P[3:6], 0.0)


def test_the_start_s_covariance_is_that_of_its_own_perturbations():
    """Positions along the world's axes and rotations of the body, off the world's origin, by differences."""
    start = Start(
        position_m=(10.0, -20.0, 3.0),
        rpy_rad=(0.2, -0.3, 2.0),
        position_sigma_m=(0.1, 0.02, 0.03),
        rpy_sigma_rad=(0.01, 0.02, 0.03),
    )
    state = start_state(Calibration(start=start, imu=ImuCalibration(gyro_bias_sigma=0.5)))

    def perturbation(xi):
        moved = moved_by(state, xi)
        own = Rotation.from_matrix(state.R.T @ moved.R).as_rotvec()
        return np.concatenate([own, xi[3:6], moved.points[0] - state.points[0]])

    G = derivative(perturbation, 9)
    sigmas = [*start.rpy_sigma_rad, 0.5, 0.5, 0.5, *start.position_sigma_m]
    assert_allclose(G @ state.P @ G.T, np.diag(np.square(sigmas)), atol=1e-7)


def test_a_pitch_of_ninety_degrees_is_nothing_special():
    calibration = Calibration(start=Start(rpy_rad=(0.0, np.pi / 2, 0.0)), use_gravity=False)
    end_ns = T0_NS + NS_PER_S
    estimate = InvariantEkf(calibration).process(Measurements(end_ns, imu(1), dvl(1, (0.5, 0.0, 0.0))))
    assert_allclose(estimate.world_T_body.translation(), [0.0, 0.0, -0.5], atol=1e-9)


def tilted(force_scale):
    """Start level, lie tilted: gravity has to tell."""
    R = Rotation.from_euler("xyz", [0.1, -0.07, 0.0]).as_matrix()
    end_ns = T0_NS + 20 * NS_PER_S
    filtered = InvariantEkf(Calibration(start=Start(rpy_sigma_rad=(0.2, 0.2, 1e-3))))
    return filtered.process(Measurements(end_ns, imu(20, force=force_scale * (R.T @ GRAVITY)), dvl(20)))


def test_gravity_tells_roll_and_pitch():
    estimate, blind = tilted(1.0), tilted(np.nan)
    assert_allclose(estimate.world_T_body.rotation().rpy()[:2], [0.1, -0.07], atol=1e-3)
    assert np.sqrt(np.diag(estimate.covariance)[:2]).max() < 2.5e-3
    assert_allclose(blind.world_T_body.rotation().rpy()[:2], 0.0, atol=1e-9)


def test_depth_of_a_port_off_the_origin_holds_the_height():
    t = stamps(10, 20)
    depth = Depth(t, np.full(len(t), -1.5), np.full(len(t), np.nan))
    start = Start(position_m=(50.0, 80.0, -1.2), rpy_rad=(0.0, 0.3, 1.0), rpy_sigma_rad=(1e-6, 1e-6, 1e-6))
    port_m = (0.4, 0.1, -0.2)
    calibration = Calibration(start=start, depth=DepthCalibration(port_m=port_m), use_gravity=False)
    true_z = -1.5 - start.pose().rotation().rotate(np.array(port_m))[2]
    end_ns = T0_NS + 20 * NS_PER_S
    held = InvariantEkf(calibration).process(Measurements(end_ns, imu(20), dvl(20, (0.0, 0.0, 0.01)), depth))
    free = InvariantEkf(calibration).process(Measurements(end_ns, imu(20), dvl(20, (0.0, 0.0, 0.01))))
    assert abs(held.world_T_body.translation()[2] - true_z) < 0.02
    assert abs(free.world_T_body.translation()[2] - true_z) > 0.1


def test_planar_motion_keeps_height_and_tilt():
    calibration = Calibration(
        planar=PlanarMotion(z_m=0.5),
        start=Start(position_m=(0.0, 0.0, 0.5)),
        imu=ImuCalibration(gyro_noise_density=0.01),
        use_gravity=False,
    )
    rows = imu(10, rate=(0.01, -0.01, 0.1)), dvl(10, (0.3, 0.0, 0.02))
    end_ns = T0_NS + 10 * NS_PER_S
    estimate = InvariantEkf(calibration).process(Measurements(end_ns, *rows))
    free = InvariantEkf(calibration.model_copy(update={"planar": None})).process(Measurements(end_ns, *rows))
    assert abs(estimate.world_T_body.translation()[2] - 0.5) < 0.01
    assert abs(free.world_T_body.translation()[2] - 0.5) > 0.1
    assert np.abs(estimate.world_T_body.rotation().rpy()[:2]).max() < 0.005


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
    return Sequence("gap", calibration, imu(25, force=(np.nan,) * 3), rows, depth, detections)


def later(*seconds):
    return T0_NS + np.round(np.array(seconds) * NS_PER_S).astype(np.int64)


def test_many_depths_in_a_gap_tell_less_of_the_start_than_one_exact_one():
    """All share the motion's error, whose variance in a gap is at least that of the random walk, ``q^2 T^3 / 3``."""
    t = later(*np.linspace(9.0, 9.9, 10))
    sequence = in_a_gap(Depth(t, np.zeros(10), np.full(10, np.nan)))
    filtered = InvariantEkf(sequence.calibration)
    for window in sequence.replay(later(8.0, 9.95)):
        filtered.process(window)
    stamp_ns, state = filtered.state()
    assert stamp_ns == later(2.0)[0]
    walked = sequence.calibration.dvl.velocity_walk_density**2 * 7.0**3 / 3
    assert 1 / (1 + 1 / walked) < state.P[8, 8] < 0.9


def test_looks_in_a_gap_count_less_and_less_and_those_after_it_in_full():
    """``k (k + 1)`` times the motion's covariance, which is nearly all of the innovation's."""
    t = later(1.5, 9.0, 9.001, 13.0, 13.1, 21.0)
    sequence = in_a_gap(detections=seen(t, [3.0] * 6, [0.0] * 6))
    log = run(InvariantEkf, sequence).detections()
    assert log.outcomes == [Outcome.NEW, *[Outcome.USED] * 5]
    variances = log.innovation_covs[:, 0, 0]
    assert variances[2] / variances[1] == pytest.approx(3.0, rel=0.01)
    assert variances[4] < 1e-3 * variances[1]
    assert variances[5] == pytest.approx(variances[1], rel=0.01), "the next gap counts anew"


def test_a_logged_depth_variance_goes_before_the_calibration_s():
    t = later(1.0)
    vague = in_a_gap(Depth(t, np.array([1.0]), np.array([1e6])))
    sharp = in_a_gap(Depth(t, np.array([1.0]), np.array([np.nan])))
    heights = [run(InvariantEkf, sequence).state()[1].points[0, 2] for sequence in (vague, sharp)]
    assert heights == pytest.approx([0.0, 1.0], abs=1e-3)


def test_a_variance_that_is_none_is_an_error_that_says_so():
    t = later(1.0)
    negative = in_a_gap(Depth(t, np.zeros(1), np.array([-1e6])))
    with pytest.raises(EstimatorError, match=r"invariant-ekf: between \d+ and \d+ ns .* variances above zero"):
        run(InvariantEkf, negative)


def test_gravity_counts_once_an_interval_with_its_own_variance():
    """At rest: after n intervals a wide prior has become ``sigma^2 / n``, sigma that of one direction."""
    seconds, noise = 10, 0.02
    calibration = Calibration(
        imu=ImuCalibration(
            gyro_noise_density=1e-9, gyro_bias_sigma=0.0, accel_noise_density=noise, accel_bias_sigma=0.0
        ),
        dvl=DvlCalibration(velocity_sigma_m_s=(1e-6, 1e-6, 1e-6)),
        start=Start(rpy_sigma_rad=(1.0, 1.0, 1e-3)),
    )
    _, state = run(InvariantEkf, Sequence("at rest", calibration, imu(seconds), dvl(seconds))).state()
    sigma2 = noise**2 / calibration.gravity_m_s2**2
    assert_allclose(np.diag(state.P)[:2], sigma2 / seconds, rtol=1e-3)


def test_a_bias_that_nothing_tells_walks_by_its_density():
    calibration = Calibration(imu=ImuCalibration(gyro_bias_sigma=1e-3, gyro_bias_walk_density=1e-3), use_gravity=False)
    _, state = run(InvariantEkf, Sequence("at rest", calibration, imu(20), dvl(20))).state()
    assert_allclose(np.diag(state.P)[3:6], 1e-6 + 1e-6 * 20, rtol=1e-9)


def test_a_detection_far_off_is_gated_and_changes_nothing():
    filtered, end_ns = InvariantEkf(Calibration()), T0_NS + NS_PER_S
    filtered.process(Measurements(end_ns, imu(1), dvl(1), None, seen([end_ns], [2.0], [0.1])))
    _, before = filtered.state()
    filtered.process(Measurements(end_ns, None, None, None, seen([end_ns], [2.5], [0.1])))
    assert filtered.detections().outcomes == [Outcome.NEW, Outcome.GATED]
    for part, same in zip(filtered.state()[1], before, strict=True):
        assert_array_equal(part, same)


def test_many_landmarks_stay_where_they_were_seen():
    filtered, end_ns = InvariantEkf(Calibration(floor=FloorPrior(z_m=-1.0, sigma_m=0.01))), T0_NS + NS_PER_S
    filtered.process(Measurements(end_ns, imu(1), dvl(1)))
    for landmark in range(20):
        sighting = seen([end_ns], [4.0], [0.05 * landmark], landmark)
        filtered.process(Measurements(end_ns, None, None, None, sighting))
    found = filtered.landmarks()
    assert_array_equal(found.ids, np.arange(20))
    assert_allclose(np.arctan2(found.positions[:, 1], found.positions[:, 0]), 0.05 * np.arange(20), atol=1e-3)
