import importlib.util
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from baselines.ekf_slam import EkfSlam, EkfSlamParams
from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    FloorPrior,
    ImuCalibration,
    PlanarMotion,
    SonarCalibration,
    Start,
)
from sonar_graph.errors import EstimatorError, MeasurementError
from sonar_graph.measurements import Depth, Dvl, Imu, LandmarkDetections, Measurements
from sonar_graph.sequence import NS_PER_S, Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.states import Outcome
from sonar_graph.testing.laws import CHECKS

BENCHMARKS = Path(__file__).parents[2] / "benchmarks" / "performance"
T0_NS = 1_700_000_000 * NS_PER_S
GRAVITY = np.array([0.0, 0.0, 9.80665])
SMALL = 1e-9


def stamps(rate_hz, seconds):
    return T0_NS + np.round(np.arange(round(seconds * rate_hz) + 1) * (NS_PER_S / rate_hz)).astype(np.int64)


def imu(seconds, rate_hz=100, rate=(0.0, 0.0, 0.0), force=GRAVITY):
    t = stamps(rate_hz, seconds)
    return Imu(t, np.tile(rate, (len(t), 1)), np.tile(force, (len(t), 1)))


def dvl(seconds, velocity=(0.0, 0.0, 0.0), rate_hz=5, cov=None):
    t = stamps(rate_hz, seconds)
    velocity = np.broadcast_to(np.asarray(velocity, float), (len(t), 3))
    return Dvl(t, velocity, np.tile(np.full((3, 3), np.nan) if cov is None else cov, (len(t), 1, 1)))


def detection(stamp_ns, landmark=3, range_m=2.0, azimuth=0.1, probability=0.9):
    return LandmarkDetections(
        np.array([stamp_ns]),
        np.array([range_m]),
        np.array([azimuth]),
        np.full((1, 2, 2), np.nan),
        np.array([[landmark]]),
        np.array([[probability]]),
    )


@pytest.fixture(scope="module")
def mission():
    return simulate_mission(MissionOptions(duration_s=40.0, landmarks=12, dvl_dropouts_per_hour=360.0))


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_the_contract_is_kept(check):
    check(EkfSlam)


@pytest.mark.slow
@pytest.mark.parametrize("predicts_by_node", [False, True])
def test_the_same_filter_on_filterpy_ends_in_the_same_state(mission, monkeypatch, predicts_by_node):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location("filterpy_ekf", BENCHMARKS / "filterpy_ekf.py")
    filterpy_ekf = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "filterpy_ekf", filterpy_ekf)  # dataclasses look their module up
    spec.loader.exec_module(filterpy_ekf)

    never_a_gap = mission.calibration.dvl.model_copy(update={"gap_s": 1e3})  # filterpy's takes straight lines
    slam = EkfSlam(mission.calibration.model_copy(update={"dvl": never_a_gap}))
    for window in mission.replay(mission.instants(2.0)):
        slam.process(window)
    theirs = filterpy_ekf.run(mission, int(mission.instants(2.0)[-1]), predicts_by_node=predicts_by_node)
    node_ns, x, P = slam.state()
    assert node_ns == theirs.node_ns
    assert len(x) > 6 + 3 * 5
    sigma = np.sqrt(np.diag(P))
    assert_allclose(x, theirs.x, atol=1e-8)
    assert_allclose(P / np.outer(sigma, sigma), theirs.P / np.outer(sigma, sigma), atol=1e-8)


def straight_world(seed=4):
    """Along x with Doppler noise, a landmark dead ahead whose azimuth says nothing: linear in every unknown."""
    rng = np.random.default_rng(seed)
    sigmas = SMALL * np.ones(3)
    calibration = Calibration(
        imu=ImuCalibration(gyro_noise_density=0.0),
        start=Start(position_sigma_m=(0.05, SMALL, SMALL), rpy_sigma_rad=tuple(sigmas)),
        sonar=SonarCalibration(elevation_aperture_rad=SMALL),
        use_gravity=False,
    )
    seconds, cov = 8, np.diag([1e-4, SMALL**2, SMALL**2])
    doppler = dvl(seconds, cov=cov)
    velocity = np.zeros((len(doppler), 3))
    velocity[:, 0] = 0.3 + 0.01 * rng.normal(size=len(doppler))
    doppler = replace(doppler, velocity=velocity)
    seen = doppler.stamps_ns[2::3]
    ranges = 6.0 - 0.3 * (seen - T0_NS) * 1e-9 + 0.02 * rng.normal(size=len(seen))
    frames = LandmarkDetections(
        seen,
        ranges,
        np.zeros(len(seen)),
        np.tile(np.diag([4e-4, 1e4]), (len(seen), 1, 1)),
        np.full((len(seen), 1), 7),
        np.ones((len(seen), 1)),
    )
    return Sequence("straight", calibration, imu(seconds), doppler, None, frames)


def least_squares(world):
    """All positions along x and the landmark, by whitened rows and numpy: mean and covariance."""
    doppler, frames = world.dvl, world.detections
    n, interval_s = len(doppler), 0.2
    rows, values = [], []

    def add(coefficients, value, sigma):
        row = np.zeros(n + 1)
        for at, factor in coefficients:
            row[at] = factor / sigma
        rows.append(row)
        values.append(value / sigma)

    add([(0, 1.0)], 0.0, 0.05)
    for k in range(n - 1):
        travelled = interval_s * (doppler.velocity[k, 0] + doppler.velocity[k + 1, 0]) / 2
        add([(k, -1.0), (k + 1, 1.0)], travelled, 0.01 * interval_s)
    for stamp_ns, range_m in zip(frames.stamps_ns, frames.range_m, strict=True):
        add([(int(np.searchsorted(doppler.stamps_ns, stamp_ns)), -1.0), (n, 1.0)], range_m, 0.02)
    A, b = np.array(rows), np.array(values)
    information = A.T @ A
    return np.linalg.solve(information, A.T @ b), np.linalg.inv(information)


def test_in_a_linear_gaussian_world_the_filter_is_batch_least_squares():
    world = straight_world()
    slam = EkfSlam(world.calibration, EkfSlamParams(gate_probability=1.0))
    for window in world.replay(world.dvl.stamps_ns):
        slam.process(window)
    mean, cov = least_squares(world)
    _, x, P = slam.state()
    ours = [0, 6]
    assert_allclose(x[ours], mean[-2:], atol=1e-6)
    assert_allclose(P[np.ix_(ours, ours)], cov[-2:, -2:], atol=1e-9)
    assert slam.detections().outcomes.count(Outcome.USED) == len(world.detections) - 1


def test_the_outcome_does_not_depend_on_how_the_log_is_cut(mission):
    instants = mission.instants(0.1)
    every_stamp = np.unique(
        np.concatenate([b.stamps_ns for b in (mission.imu, mission.dvl, mission.depth, mission.detections)])
    )
    live, windows = EkfSlam(mission.calibration), EkfSlam(mission.calibration)
    for row in mission.replay(every_stamp[every_stamp <= instants[-1]]):
        live.process(row)
    for window in mission.replay(instants):
        windows.process(window)
    windows.process(Measurements(int(instants[-1])))
    assert_allclose(live.state()[1], windows.state()[1], atol=1e-9)
    assert_allclose(live.state()[2], windows.state()[2], atol=1e-9)
    assert live.detections().outcomes == windows.detections().outcomes
    at = np.searchsorted(live.trajectory().stamps_ns, instants)
    assert_allclose(live.trajectory().positions[at[:-1]], windows.trajectory().positions[: len(at) - 1], atol=1e-9)


def test_an_improbable_identity_is_refused_with_the_reason():
    slam = EkfSlam(Calibration())
    slam.process(Measurements(T0_NS + NS_PER_S, imu(1), dvl(1), None, detection(T0_NS + NS_PER_S, probability=0.3)))
    assert slam.detections().outcomes == [Outcome.NO_IDENTITY]
    assert len(slam.landmarks()) == 0


def test_detections_outside_the_odometry_are_refused_with_the_reason():
    slam = EkfSlam(Calibration())
    assert slam.process(Measurements(T0_NS - 5, None, None, None, detection(T0_NS - 10))) is None
    slam.process(Measurements(T0_NS + NS_PER_S, imu(1), dvl(1), None, detection(T0_NS + NS_PER_S // 2)))
    slam.process(Measurements(T0_NS + NS_PER_S, None, None, None, detection(T0_NS + NS_PER_S // 4)))
    assert slam.detections().outcomes == [Outcome.UNLOCATED, Outcome.NEW, Outcome.LATE]


def test_a_detection_far_off_is_gated_and_changes_nothing():
    slam = EkfSlam(Calibration())
    end_ns = T0_NS + NS_PER_S
    slam.process(Measurements(end_ns, imu(1), dvl(1), None, detection(end_ns)))
    before = slam.state()
    slam.process(Measurements(end_ns, None, None, None, detection(end_ns, range_m=2.5)))
    assert slam.detections().outcomes == [Outcome.NEW, Outcome.GATED]
    assert_array_equal(slam.state()[1], before[1])
    assert_array_equal(slam.state()[2], before[2])


def test_a_row_after_the_instant_is_an_error_that_names_it():
    slam = EkfSlam(Calibration())
    with pytest.raises(MeasurementError, match=f"LandmarkDetections has a row at {T0_NS + 1} ns"):
        slam.process(Measurements(T0_NS, None, None, None, detection(T0_NS + 1)))


def tilted(roll, pitch, force_scale=1.0):
    """Start level, lie tilted: gravity has to tell."""
    start = Start(rpy_sigma_rad=(0.2, 0.2, 1e-3))
    R = np.array(Start(rpy_rad=(roll, pitch, 0.0)).pose().rotation().matrix())
    slam = EkfSlam(Calibration(start=start))
    return slam.process(Measurements(T0_NS + 20 * NS_PER_S, imu(20, force=force_scale * (R.T @ GRAVITY)), dvl(20)))


def test_gravity_tells_roll_and_pitch():
    estimate = tilted(0.1, -0.07)
    assert_allclose(estimate.world_T_body.rotation().rpy()[:2], [0.1, -0.07], atol=1e-3)
    assert np.sqrt(np.diag(estimate.covariance)[:2]).max() < 2e-3


def test_without_specific_force_roll_and_pitch_stay_as_they_started():
    estimate = tilted(0.1, -0.07, math.nan)
    assert_allclose(estimate.world_T_body.rotation().rpy(), 0.0, atol=1e-9)
    assert np.sqrt(np.diag(estimate.covariance)[:2]).min() > 0.19


def test_an_accelerating_vehicle_is_not_taken_for_a_tilted_one():
    seconds, acceleration = 10, 0.2
    doppler = dvl(seconds, rate_hz=10)
    velocity = np.zeros((len(doppler), 3))
    velocity[:, 0] = acceleration * (doppler.stamps_ns - T0_NS) * 1e-9
    force = GRAVITY + np.array([acceleration, 0.0, 0.0])
    slam = EkfSlam(Calibration(start=Start(rpy_sigma_rad=(0.05, 0.05, 1e-3))))
    end_ns = T0_NS + seconds * NS_PER_S
    estimate = slam.process(Measurements(end_ns, imu(seconds, force=force), replace(doppler, velocity=velocity)))
    assert_allclose(estimate.world_T_body.rotation().rpy(), 0.0, atol=1e-6)
    assert estimate.world_T_body.translation()[0] == pytest.approx(0.5 * acceleration * seconds**2, abs=1e-6)


def test_depth_holds_the_height_against_a_doppler_log_that_climbs():
    t = stamps(10, 20)
    depth = Depth(t, np.full(len(t), -1.5), np.full(len(t), np.nan))
    start = Start(position_m=(0.0, 0.0, -1.5))
    world = imu(20), dvl(20, velocity=(0.0, 0.0, 0.01), cov=1e-2 * np.eye(3))
    end_ns = T0_NS + 20 * NS_PER_S
    without = EkfSlam(Calibration(start=start)).process(Measurements(end_ns, *world))
    held = EkfSlam(Calibration(start=start)).process(Measurements(end_ns, *world, depth))
    assert without.world_T_body.translation()[2] == pytest.approx(-1.3, abs=1e-6)
    assert held.world_T_body.translation()[2] == pytest.approx(-1.5, abs=0.02)
    assert held.covariance[5, 5] < without.covariance[5, 5]


def test_planar_motion_keeps_height_and_tilt():
    calibration = Calibration(
        planar=PlanarMotion(z_m=0.5),
        start=Start(position_m=(0.0, 0.0, 0.5)),
        imu=ImuCalibration(gyro_noise_density=0.01),
        use_gravity=False,
    )
    wobble = imu(10, rate=(0.01, -0.01, 0.1))
    end_ns = T0_NS + 10 * NS_PER_S
    doppler = dvl(10, velocity=(0.3, 0.0, 0.02))
    estimate = EkfSlam(calibration).process(Measurements(end_ns, wobble, doppler))
    free = EkfSlam(calibration.model_copy(update={"planar": None})).process(Measurements(end_ns, wobble, doppler))
    assert abs(estimate.world_T_body.translation()[2] - 0.5) < 0.01
    assert abs(free.world_T_body.translation()[2] - 0.5) > 0.1
    assert np.abs(estimate.world_T_body.rotation().rpy()[:2]).max() < 0.005
    assert estimate.world_T_body.rotation().yaw() == pytest.approx(1.0, abs=0.01)


def test_a_pitch_of_ninety_degrees_is_an_error_that_says_so():
    slam = EkfSlam(Calibration(use_gravity=False, start=Start(rpy_rad=(0.0, math.pi / 2, 0.0))))
    with pytest.raises(EstimatorError, match=r"pitch is 90\.\d+ deg .* use isam2"):
        slam.process(Measurements(T0_NS + NS_PER_S, imu(1), dvl(1)))


def test_the_estimate_s_covariance_is_that_of_many_starts():
    """World-axis positions and Euler angles of the start come out as perturbations of the body."""
    start = Start(rpy_rad=(0.2, -0.3, 2.0), position_sigma_m=(0.1, 0.02, 0.03), rpy_sigma_rad=(0.01, 0.02, 0.03))
    calibration = Calibration(
        start=start,
        use_gravity=False,
        imu=ImuCalibration(gyro_noise_density=0.0),
        dvl=DvlCalibration(velocity_sigma_m_s=(1e-9, 1e-9, 1e-9)),
    )
    estimate = EkfSlam(calibration).process(Measurements(T0_NS + NS_PER_S, imu(1), dvl(1)))
    R = start.pose().rotation().matrix()
    assert_allclose(estimate.covariance[:3, :3], np.diag(np.square(start.rpy_sigma_rad)), atol=1e-12)
    assert_allclose(estimate.covariance[3:, 3:], R.T @ np.diag(np.square(start.position_sigma_m)) @ R, atol=1e-12)


def test_more_landmarks_than_there_was_room_for_keep_what_was_known():
    slam = EkfSlam(Calibration(floor=FloorPrior(z_m=-1.0, sigma_m=0.01)))
    end_ns = T0_NS + NS_PER_S
    slam.process(Measurements(end_ns, imu(1), dvl(1)))
    for landmark in range(20):
        azimuth = 0.05 * landmark
        slam.process(Measurements(end_ns, None, None, None, detection(end_ns, landmark, 4.0, azimuth)))
    found = slam.landmarks()
    assert_array_equal(found.ids, np.arange(20))
    assert_allclose(np.arctan2(found.positions[:, 1], found.positions[:, 0]), 0.05 * np.arange(20), atol=1e-3)
    assert_array_equal(slam.detections().outcomes, [Outcome.NEW] * 20)
