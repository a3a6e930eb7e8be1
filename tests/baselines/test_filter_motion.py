"""Laws of prediction: paths, their covariances, biases and attitudes that come of motions alone."""

import importlib.util
import sys
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from baselines.dead_reckoning import DeadReckoning
from baselines.ekf_slam import COMPASS, EkfSlam
from baselines.events import Motion, remove_rate
from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Start
from sonar_graph.measurements import NS_PER_S, Measurements
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.states import Outcome
from sonar_graph.testing import check_consistent

from .runs import (
    BENCHMARKS,
    CIRCLE_S,
    CIRCLE_START,
    NO_FORCE,
    SPEED,
    STANDARD_FORCE,
    T0_NS,
    YAW_RATE,
    begun,
    circle,
    circle_calibration,
    depths,
    dvl,
    estimate_after,
    every_filter,
    filters_with_bias,
    imu,
    later,
    seen,
    slam_filters,
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
    aware = circle_calibration().model_copy(
        update={"earth_rate_latitude_rad": latitude}
    )
    turned = [
        CIRCLE_START.pose()
        .between(estimate_after(kind, c, CIRCLE_S, *rows).world_T_body)
        .rotation()
        .rpy()
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
    assert_allclose(
        covariance[:3, :3], np.diag(np.square(start.rpy_sigma_rad)), atol=1e-12
    )
    assert_allclose(
        covariance[3:, 3:],
        R.T @ np.diag(np.square(start.position_sigma_m)) @ R,
        atol=1e-12,
    )
    assert_allclose(covariance[:3, 3:], 0.0, atol=1e-12)


@filters_with_bias
def test_a_bias_that_nothing_tells_widens_yaw_as_a_constant_and_a_walk_do(kind):
    def yaw_sigma(**noise):
        return np.sqrt(
            estimate_after(
                kind, circle_calibration(**noise), CIRCLE_S, *circle()
            ).covariance[2, 2]
        )

    none = yaw_sigma(gyro_bias_sigma=0.0, gyro_bias_walk_density=1.0)
    some = yaw_sigma(gyro_bias_sigma=1e-3, gyro_bias_walk_density=0.0)
    walking = yaw_sigma(gyro_bias_sigma=1e-3, gyro_bias_walk_density=1e-3)
    start_sigma = CIRCLE_START.rpy_sigma_rad[2]
    assert none == pytest.approx(
        np.hypot(1e-3 * np.sqrt(CIRCLE_S), start_sigma), rel=1e-3
    )
    assert some == pytest.approx(np.hypot(none, 1e-3 * CIRCLE_S), rel=1e-3)
    assert walking == pytest.approx(
        np.hypot(some, 1e-3 * np.sqrt(CIRCLE_S**3 / 3)), rel=0.02
    )


@pytest.mark.slow
def test_dead_reckoning_s_covariance_is_that_of_many_runs_with_a_constant_bias():
    bias_sigma, noise, rng = 2e-3, 1e-3, np.random.default_rng(2)
    known = circle_calibration(gyro_bias_sigma=bias_sigma, gyro_bias_walk_density=0.0)
    start = CIRCLE_START.model_copy(
        update={"position_sigma_m": (1e-6,) * 3, "rpy_sigma_rad": (1e-6,) * 3}
    )
    known, (gyro, doppler) = known.model_copy(update={"start": start}), circle()
    mean = estimate_after(DeadReckoning, known, CIRCLE_S, gyro, doppler)
    errors = []
    for _ in range(600):
        gyro_error = bias_sigma * rng.normal(size=3) + noise * np.sqrt(50) * rng.normal(
            size=(len(gyro), 3)
        )
        rows = circle(gyro_error, 0.02 * rng.normal(size=(len(doppler), 3)))
        between = mean.world_T_body.between(
            estimate_after(DeadReckoning, known, CIRCLE_S, *rows).world_T_body
        )
        turn = Rotation.from_matrix(between.rotation().matrix()).as_rotvec()
        errors.append(np.concatenate([turn, between.translation()]))
    sigma = np.sqrt(np.diag(mean.covariance))
    scale = np.outer(sigma, sigma)
    assert_allclose(
        np.cov(np.array(errors).T) / scale, mean.covariance / scale, atol=0.2
    )


def test_dead_reckoning_is_level_by_gravity_and_as_sure_of_its_tilt_as_it_is_right():
    """Gyro bias and noise tilt it by 20 mrad without accelerometers."""
    bias_sigma, rng, squares, tilts = 1e-3, np.random.default_rng(5), [], []
    known = circle_calibration(
        gyro_bias_sigma=bias_sigma, gyro_bias_walk_density=0.0, accel_bias_sigma=1e-4
    )
    start = CIRCLE_START.model_copy(update={"rpy_sigma_rad": (1e-6,) * 3})
    known, end = (
        known.model_copy(update={"start": start}),
        Rotation.from_euler("z", 0.5 + YAW_RATE * CIRCLE_S),
    )
    force = np.array([0.0, SPEED * YAW_RATE, known.gravity_m_s2])
    for _ in range(20):
        rate, felt = np.sqrt(50) * rng.normal(size=(2, 50 * CIRCLE_S + 1, 3))
        gyro, doppler = circle(
            bias_sigma * rng.normal(size=3) + 1e-3 * rate,
            0.02 * rng.normal(size=(101, 3)),
        )
        level = replace(
            gyro, specific_force=force + known.imu.accel_noise_density * felt
        )
        found, blind = (
            estimate_after(DeadReckoning, known, CIRCLE_S, rows, doppler)
            for rows in (level, gyro)
        )
        off = [
            (
                end.inv() * Rotation.from_matrix(one.world_T_body.rotation().matrix())
            ).as_rotvec()
            for one in (found, blind)
        ]
        squares.append(
            off[0][:2] @ np.linalg.solve(found.covariance[:2, :2], off[0][:2])
        )
        tilts.append([np.hypot(*turn[:2]) for turn in off])
    assert np.mean(tilts, axis=0)[0] < 0.3 * np.mean(tilts, axis=0)[1]
    check_consistent(np.array(squares), 2, confidence=0.999)


def test_dead_reckoning_ignores_detections_and_says_so():
    stamps_ns = later(*range(CIRCLE_S + 1))
    blind, told = (begun(DeadReckoning, circle_calibration()) for _ in range(2))
    one = told.process(
        Measurements(int(stamps_ns[-1]), *circle(), None, seen(stamps_ns))
    )
    other = blind.process(Measurements(int(stamps_ns[-1]), *circle()))
    assert one.world_T_body.equals(other.world_T_body, 0.0)
    assert told.detections().outcomes == [Outcome.IGNORED] * (CIRCLE_S + 1)
    assert len(told.landmarks()) == 0


def without(bias, earth, dR, dp, D, impulse):
    reduced = remove_rate(Motion(dR, dp, np.eye(6), D, impulse), bias, earth)
    return reduced.dR, reduced.dp, reduced.impulse


def test_a_bias_and_the_earth_s_rate_are_removed_from_a_motion_as_from_its_rows(
    mission,
):
    """Over a second of turning: to first order in the bias, and in the Earth's rate with that of both ends."""
    bias, earth, zero = (
        np.array([2e-3, -1e-3, 3e-3]),
        np.array([1e-3, 2e-3, -1e-3]),
        np.zeros(3),
    )
    unbiased = replace(
        mission.imu, angular_velocity=mission.imu.angular_velocity - bias
    )
    motions = []
    for rows in (mission.imu, unbiased):
        odometry = Odometry(mission.calibration)
        odometry.add(rows, mission.dvl)
        epochs_ns, reached_ns = odometry.epochs_reached(
            mission.start_ns, mission.start_ns + 20 * NS_PER_S
        )
        start_ns, end_ns = epochs_ns[:-8], epochs_ns[8:]
        motions.append(odometry.motions(start_ns, end_ns, reached_ns[8:], zero))
    turns = 0.0
    for start, end, (dR, dp, _, D, impulse), exact in zip(
        start_ns,
        end_ns,
        zip(*motions[0], strict=True),
        zip(*motions[1], strict=True),
        strict=True,
    ):
        if np.isnan(dp[0]):
            continue
        R, p, push = without(bias, zero, dR, dp, D, impulse)
        assert_allclose(
            Rotation.from_matrix(exact[0].T @ R).as_rotvec(), 0.0, atol=2e-5
        )
        assert_allclose(p, exact[1], atol=1e-5)
        assert_allclose(push, exact[4], atol=5e-3)
        R, _, _ = without(zero, earth, dR, dp, D, impulse)
        duration_s = (end - start) * 1e-9
        turned = Rotation.from_rotvec(-earth * duration_s).as_matrix() @ dR
        assert_allclose(Rotation.from_matrix(turned.T @ R).as_rotvec(), 0.0, atol=2e-5)
        turns = max(turns, Rotation.from_matrix(dR).magnitude())
    assert turns > 0.1


def test_a_gap_adds_what_an_unknown_gyro_bias_does_to_the_displacement_where_the_state_has_none():
    """``sigma^2 J J^T``, J the derivative of the displacement over the gap by the bias."""
    sigma = 0.01
    end_ns = later(3.0)
    slam = begun(
        EkfSlam,
        Calibration(use_gravity=False, imu=ImuCalibration(gyro_bias_sigma=sigma)),
    )
    gyro = imu(3, (0.05, -0.1, 0.2), STANDARD_FORCE + np.array([0.1, -0.2, 0.0]))
    covariance = slam.process(
        Measurements(end_ns, gyro, dvl(1, (0.4, 0.1, 0.0)))
    ).covariance

    over = slam.odometry.motion(slam.state()[0], end_ns, np.zeros(3))
    dR = over.i_T_j.rotation().matrix()
    dp = over.i_T_j.translation()
    J = over.D_bias[3:]
    C = over.covariance.copy()
    C[3:, 3:] += sigma**2 * J @ J.T
    expected = slam.pose_after(
        Motion(np.ascontiguousarray(dR), dp, C, over.D_bias, np.zeros(3))
    )[2]
    assert_allclose(covariance, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    # else the order would not be seen
    assert np.abs(J @ J.T - J.T @ J).max() > 0.05 * np.linalg.norm(J) ** 2
    assert sigma**2 * np.linalg.norm(J) ** 2 > 0.1 * np.trace(covariance[3:, 3:])


@pytest.mark.slow
@pytest.mark.parametrize("predicts_by_node", [False, True])
def test_ekf_slam_on_filterpy_ends_in_the_same_state(monkeypatch, predicts_by_node):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location(
        "filterpy_ekf", BENCHMARKS / "filterpy_ekf.py"
    )
    filterpy_ekf = importlib.util.module_from_spec(spec)
    # dataclasses look their module up
    monkeypatch.setitem(sys.modules, "filterpy_ekf", filterpy_ekf)
    spec.loader.exec_module(filterpy_ekf)

    mission = simulate_mission(
        MissionOptions(duration_s=40.0, landmarks=12, dvl_dropouts_per_hour=360.0)
    )
    # filterpy's takes straight lines
    never_a_gap = mission.calibration.dvl.model_copy(update={"gap_s": 1e3})
    mission = replace(
        mission, calibration=mission.calibration.model_copy(update={"dvl": never_a_gap})
    )
    slam = begun(EkfSlam, mission.calibration)
    for window in mission.replay(mission.instants(2.0)):
        slam.process(window)
    theirs = filterpy_ekf.run(
        mission, int(mission.instants(2.0)[-1]), predicts_by_node=predicts_by_node
    )
    node_ns, x, P = slam.state()
    x, P = np.delete(x, COMPASS), np.delete(np.delete(P, COMPASS, 0), COMPASS, 1)
    assert node_ns == theirs.node_ns
    assert len(x) > 6 + 3 * 5
    sigma = np.sqrt(np.diag(P))
    assert_allclose(x, theirs.x, atol=1e-8)
    assert_allclose(
        P / np.outer(sigma, sigma), theirs.P / np.outer(sigma, sigma), atol=1e-8
    )


@slam_filters
@pytest.mark.parametrize(
    ("rpy_rad", "comes_to"),
    [
        ((-0.3, 0.0, 0.0), []),
        ((0.0, 0.0, 0.0), ["90"]),
        ((2.0, 0.0, 0.0), []),
        ((np.pi, 0.0, 0.0), ["-90"]),
        ((0.0, np.pi / 2, 0.0), ["90"]),
    ],
)
def test_through_the_vertical_a_pose_and_its_covariance_come_to_what_they_are_on_the_level(
    kind, rpy_rad, comes_to
):
    """Of the same motion, half a looping and half a circle on a vehicle's side, to 1 mrad over its way of 5.73 m."""
    rows, ends = (
        (imu(18, (0.0, np.pi / 18, 0.0), NO_FORCE), dvl(18, (0.5, 0.0, 0.0))),
        [],
    )
    for angles in (rpy_rad, (np.pi / 2, 0.0, 0.0)):
        start = Start(
            rpy_rad=angles,
            rpy_sigma_rad=(0.01, 0.02, 0.03),
            position_sigma_m=(0.1, 0.1, 0.1),
        )
        slam = begun(kind, Calibration(use_gravity=False, start=start))
        estimate = slam.process(Measurements(later(18), *rows))
        ends.append(
            (
                start.pose().between(estimate.world_T_body).matrix(),
                estimate.covariance,
                slam.withheld(),
            )
        )
    (there, covariance, told), (here, expected, nothing) = ends
    sigmas = np.sqrt(np.diag(expected))
    assert_allclose(there, here, atol=1.1e-3 * 5.73)
    assert_allclose(
        covariance / np.outer(sigmas, sigmas),
        expected / np.outer(sigmas, sigmas),
        atol=5e-3,
    )
    assert [line.split(" deg")[0] for line in told] == [
        f"pitch came to {deg}" for deg in comes_to if kind is EkfSlam
    ]
    assert nothing == []


def test_ekf_slam_goes_on_from_a_pitch_beyond_a_right_angle_as_from_the_same_attitude_and_says_so():
    """As after a correction by a wrong detection: prediction reads all angles from a rotation."""
    calibration = Calibration(
        start=Start(rpy_rad=(0.2, 0.4, 3.0), rpy_sigma_rad=(0.01, 0.02, 0.03))
    )
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
            depth = Measurements(
                windows[3].end_ns, depth=depths(np.array([windows[3].end_ns]), 0.0, 1.0)
            )
            assert_allclose(
                *(
                    slam.process(depth).world_T_body.matrix()
                    for slam in (upright, overturned)
                ),
                atol=1e-9,
            )
        here, there = upright.process(window), overturned.process(window)
    assert_allclose(there.world_T_body.matrix(), here.world_T_body.matrix(), atol=1e-9)
    assert_allclose(there.covariance, here.covariance, rtol=1e-6, atol=1e-12)
    assert_allclose(overturned.state()[1], upright.state()[1], atol=1e-9)
    assert_allclose(overturned.state()[2], upright.state()[2], rtol=1e-6, atol=1e-12)
    (line,) = overturned.withheld()
    assert line.startswith("pitch came to 1")
    assert upright.withheld() == []
