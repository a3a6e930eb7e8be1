"""Axes of gyros and Doppler log: each wrong candidate is found and distinguished, and a right log is left as it is."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import interp1d
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.diagnosis.axes import (
    match_axes,
    signed_permutations,
    turns_less_than_body,
)
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import Imu
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission

from .runs import (
    acting,
    dvl_rows,
    grave,
    level_vehicle,
    line_of,
    recalibrated,
    spoilt,
    with_mounting,
    without_imu,
)
from .test_turn_rate import level_drive

WORLD = simulate_mission(MissionOptions(duration_s=60.0, landmarks=1))
MOUNTED = Mounting(rpy_rad=(0.3, -0.2, 1.0))
IDENTITY = np.eye(3)
UP = np.array([0.0, 0.0, 1.0])
BODY_R_DVL = WORLD.calibration.dvl.mounting.pose().rotation().matrix()


def with_axes(gyro: np.ndarray, dvl: np.ndarray) -> Sequence:
    """Rates about other axes of the body, of an IMU that sits askew, and velocities along others."""
    body_R_sensor = MOUNTED.pose().rotation().matrix()
    rate = WORLD.imu.angular_velocity @ gyro @ body_R_sensor
    force = WORLD.imu.specific_force @ body_R_sensor
    run = spoilt(WORLD, "imu", angular_velocity=rate, specific_force=force)
    velocity = WORLD.dvl.velocity @ BODY_R_DVL.T @ dvl @ BODY_R_DVL
    run = spoilt(run, "dvl", velocity=velocity)
    return recalibrated(run, "imu", mounting=MOUNTED)


def found_axes(run: Sequence) -> tuple[list[list[float]], list[list[float]]]:
    found = match_axes(run.imu, run.dvl, run.calibration)
    return found.gyro.tolist(), found.dvl.tolist()


@pytest.mark.parametrize("k", range(0, 48, 5))
def test_every_axis_and_sign_of_the_gyros_is_found(k):
    G = signed_permutations()[k]
    assert found_axes(with_axes(G, IDENTITY)) == (G.tolist(), IDENTITY.tolist())


@pytest.mark.parametrize(
    "axes", [(1, -1, 1), (-1, -1, 1), (-1, 1, 1), (1, -1, -1), (-1, -1, -1)]
)
def test_signs_of_the_doppler_log_are_found_and_the_gyros_left_alone(axes):
    P = np.diag(axes)
    assert found_axes(with_axes(IDENTITY, P)) == (IDENTITY.tolist(), P.tolist())


@pytest.mark.parametrize("signs", [(1, 1), (1, -1)])
@pytest.mark.parametrize("order", [[0, 1, 2], [1, 0, 2]])
def test_axes_of_accelerometers_are_found_beside_a_log_on_a_long_arm(signs, order):
    """Rates and velocities agree and so does the arm between them: in the forces' axes it is turned as they are."""
    S = np.diag([*signs, 1.0])[order]
    arm_m = np.array([0.6, 0.4, 0.2])
    body_R_imu = WORLD.calibration.imu.mounting.pose().rotation().matrix()
    rate = WORLD.imu.angular_velocity @ body_R_imu.T
    rate = interp1d(WORLD.imu.stamps_ns, rate, axis=0)(WORLD.dvl.stamps_ns)
    moved = WORLD.dvl.velocity + np.cross(rate, arm_m) @ BODY_R_DVL
    force = WORLD.imu.specific_force @ body_R_imu.T @ S.T @ body_R_imu
    run = spoilt(spoilt(WORLD, "imu", specific_force=force), "dvl", velocity=moved)
    place = np.add(WORLD.calibration.dvl.mounting.translation_m, arm_m)
    run = with_mounting(run, "dvl", translation_m=place.tolist())
    assert found_axes(run) == ((np.linalg.det(S) * S).tolist(), S.tolist())


def test_gravity_over_a_gap_in_a_slow_doppler_log_is_no_change_of_velocity():
    """Rows a second apart, and one interval of three seconds."""
    run = level_drive(0)
    slow = run.dvl.rows(slice(None, None, 5))
    t = (slow.stamps_ns - run.start_ns) * 1e-9
    negated = replace(slow, velocity=-slow.velocity)
    with_gap = replace(run, dvl=negated.rows((t < 39.5) | (t > 41.5)))
    gyro, dvl = found_axes(with_gap)
    assert gyro == IDENTITY.tolist()
    # ahead is the one way that this vehicle goes
    assert dvl[0] == [-1.0, 0.0, 0.0]


@pytest.mark.parametrize("seed", range(2))
def test_a_way_straight_up_and_down_is_none_in_axes_of_the_world(seed):
    """A vehicle that pitches, whose level velocities are hardly more than their noise."""
    t = np.arange(0.0, 60.0, 0.02)
    noise = np.random.default_rng(seed).standard_normal((3, len(t), 3))
    stamps_ns = np.rint(t * 1e9).astype(np.int64)
    pitch_rad = 0.05 * np.sin(0.5 * t + seed)
    body_R_world = Rotation.from_euler("y", pitch_rad[:, None]).inv()
    climb = np.outer(np.sin(0.2 * t), UP)
    gravity = np.gradient(climb, t, axis=0) + 9.80665 * UP
    rate = np.outer(np.gradient(pitch_rad, t), [0.0, 1.0, 0.0]) + 1e-3 * noise[0]
    force = body_R_world.apply(gravity) + 0.01 * noise[1]
    velocity = body_R_world.apply(climb) + 0.03 * noise[2]
    slow = slice(None, None, 10)
    dvl = dvl_rows(stamps_ns[slow], velocity[slow])
    imu = Imu(stamps_ns, rate, force)
    assert turns_less_than_body(imu, dvl, Calibration()) is None


def test_without_accelerometers_or_motion_nothing_is_known():
    force = np.full_like(WORLD.imu.specific_force, np.nan)
    blind = spoilt(WORLD, "imu", specific_force=force)
    short = replace(WORLD, dvl=WORLD.dvl.rows(slice(20)))
    for run in (blind, short):
        assert match_axes(run.imu, run.dvl, run.calibration) is None


def test_a_negated_gyro_yaw_is_the_first_finding_with_its_line():
    """The line replaces that of the configuration."""
    rate = WORLD.imu.angular_velocity * [1.0, 1.0, -1.0]
    run = spoilt(WORLD, "imu", angular_velocity=rate)
    table = {"imu": {"angular_velocity_axes": ["x", "-y", "z"]}}
    (finding,) = acting(run, LogConfig.parse(table, "x"))
    assert finding.quantity == "gyro axes"
    assert finding.grave
    assert line_of(finding) == {"angular_velocity_axes": ["x", "-y", "-z"]}


@pytest.mark.parametrize("seed", range(2))
def test_a_negated_gyro_yaw_is_named_where_most_of_a_log_is_a_rest(seed):
    """Velocities in axes of the world fit such turns better than those of the body, but not as well as right turns."""
    t = np.arange(0.0, 60.0, 0.02)
    speed = 0.6 * (1.0 + np.tanh(t - 40.0)) + 0.01 * np.sin(0.3 * t + seed)
    yaw_rate = 0.25 * np.sin(0.25 * t + seed)
    run = level_vehicle(np.outer(speed, [1.0, 0.0, 0.0]), yaw_rate, seed)
    rate = run.imu.angular_velocity * [1.0, 1.0, -1.0]
    finding, *_ = acting(spoilt(run, "imu", angular_velocity=rate))
    assert finding.quantity == "gyro axes"


@pytest.mark.parametrize("seed", range(3))
def test_velocities_of_the_world_are_named_where_turned_ones_fit_nearly(seed):
    """A Doppler log that is turned by the course fits nearly as well; one in axes of the body is right."""
    t = np.arange(0.0, 60.0, 0.02)
    velocity = np.outer(0.5 + 0.4 * np.sin(1.2 * t + seed), [1.0, 0.0, 0.0])
    yaw_rad = 0.7 + 0.6 * np.sin(0.3 * t + 2.0 * seed)
    run = level_vehicle(velocity, np.gradient(yaw_rad, t), seed)
    assert not acting(run)
    turns = Rotation.from_euler("z", yaw_rad[::10, None])
    first, *_ = grave(spoilt(run, "dvl", velocity=turns.apply(run.dvl.velocity)))
    assert "axes of the world" in first.text()


def test_rows_of_the_doppler_log_in_a_hole_of_the_imu_contradict_no_axes():
    run = without_imu(WORLD, 30.0, 55.0)
    assert found_axes(run) == (IDENTITY.tolist(), IDENTITY.tolist())
