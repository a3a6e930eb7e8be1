"""Axes of gyros and Doppler log: each wrong candidate is found and distinguished, and a right log is left as it is."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Mounting
from sonar_graph.diagnosis import check_sensors
from sonar_graph.diagnosis.axes import (
    match_axes,
    signed_permutations,
    turns_less_than_body,
)
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission

from .runs import line_of

WORLD = simulate_mission(MissionOptions(duration_s=90.0, landmarks=1))
MOUNTED = Mounting(rpy_rad=(0.3, -0.2, 1.0))
IDENTITY = np.eye(3)


def spoilt(gyro: np.ndarray, dvl: np.ndarray) -> Sequence:
    """Rates about other axes of the body, of an IMU that sits askew, and velocities along others."""
    sensor_R_body = MOUNTED.pose().rotation().matrix().T
    imu = replace(
        WORLD.imu,
        angular_velocity=WORLD.imu.angular_velocity @ gyro @ sensor_R_body.T,
        specific_force=WORLD.imu.specific_force @ sensor_R_body.T,
    )
    R = WORLD.calibration.dvl.mounting.pose().rotation().matrix()
    velocity = WORLD.dvl.velocity @ R.T @ dvl @ R
    section = WORLD.calibration.imu.model_copy(update={"mounting": MOUNTED})
    return replace(
        WORLD,
        imu=imu,
        dvl=replace(WORLD.dvl, velocity=velocity),
        calibration=WORLD.calibration.model_copy(update={"imu": section}),
    )


@pytest.mark.parametrize("k", range(48))
def test_every_axis_and_sign_of_the_gyros_is_found(
    k: int,
) -> None:
    G = signed_permutations()[k]
    run = spoilt(G, IDENTITY)
    found = match_axes(run.imu, run.dvl, run.calibration)
    assert found is not None
    assert (found.gyro == G).all()
    assert (found.dvl == IDENTITY).all()


@pytest.mark.parametrize("axes", [(1, -1, 1), (-1, -1, 1), (-1, 1, 1), (1, -1, -1)])
def test_signs_of_the_doppler_log_are_found_and_the_gyros_left_alone(
    axes: tuple[float, float, float],
) -> None:
    run = spoilt(IDENTITY, np.diag(axes))
    found = match_axes(run.imu, run.dvl, run.calibration)
    assert found is not None
    assert (found.gyro == IDENTITY).all()
    assert (found.dvl == np.diag(axes)).all()


@pytest.mark.parametrize(
    "axes",
    [
        [(-1, 0, 0), (0, 1, 0), (0, 0, 1)],
        [(1, 0, 0), (0, -1, 0), (0, 0, 1)],
        [(0, 1, 0), (1, 0, 0), (0, 0, 1)],
        [(0, -1, 0), (1, 0, 0), (0, 0, 1)],
    ],
)
def test_level_axes_of_the_accelerometers_are_found_with_a_doppler_log_on_a_long_arm(
    axes: list[tuple[float, float, float]],
) -> None:
    """Rates and velocities agree and so does the arm between them: in the forces' axes it is turned as they are."""
    S = np.array(axes, dtype=np.float64)
    arm_m = np.array([0.6, 0.4, 0.2])
    body_R_dvl = WORLD.calibration.dvl.mounting.pose().rotation().matrix()
    body_R_imu = WORLD.calibration.imu.mounting.pose().rotation().matrix()
    columns = (WORLD.imu.angular_velocity @ body_R_imu.T).T
    stamps_ns = WORLD.imu.stamps_ns
    rate = np.array([np.interp(WORLD.dvl.stamps_ns, stamps_ns, c) for c in columns]).T
    moved = WORLD.dvl.velocity + np.cross(rate, arm_m) @ body_R_dvl
    mounting = WORLD.calibration.dvl.mounting
    place = np.add(mounting.translation_m, arm_m).tolist()
    dvl = WORLD.calibration.dvl.model_copy(
        update={"mounting": mounting.model_copy(update={"translation_m": place})}
    )
    force = WORLD.imu.specific_force @ body_R_imu.T @ S.T @ body_R_imu
    found = match_axes(
        replace(WORLD.imu, specific_force=force),
        replace(WORLD.dvl, velocity=moved),
        WORLD.calibration.model_copy(update={"dvl": dvl}),
    )
    assert found is not None
    assert (found.dvl == S).all()
    assert (found.gyro == np.linalg.det(S) * S).all()


def test_without_accelerometers_or_motion_nothing_is_known() -> None:
    none = np.full_like(WORLD.imu.specific_force, np.nan)
    imu = replace(WORLD.imu, specific_force=none)
    assert match_axes(imu, WORLD.dvl, WORLD.calibration) is None
    few = WORLD.dvl.rows(slice(20))
    assert match_axes(WORLD.imu, few, WORLD.calibration) is None


@pytest.mark.parametrize("given", [("x", "y", "z"), ("x", "-y", "z")])
def test_a_negated_gyro_yaw_is_the_first_finding_with_its_line(
    given: tuple[str, str, str],
) -> None:
    """The line replaces that of the configuration."""
    rate = WORLD.imu.angular_velocity * [1.0, 1.0, -1.0]
    run = replace(WORLD, imu=replace(WORLD.imu, angular_velocity=rate))
    table = {"imu": {"angular_velocity_axes": list(given)}}
    finding, *others = check_sensors(run, LogConfig.parse(table, "x"))
    assert finding.quantity == "gyro axes"
    assert finding.grave
    wanted = [given[0], given[1], "-z"]
    assert line_of(finding) == {"angular_velocity_axes": wanted}
    assert [other.quantity for other in others if other.acts] == []


@pytest.mark.parametrize("yaw_rad", [0.0, 2.0])
def test_velocities_in_axes_of_the_world_are_named_before_all_else(
    yaw_rad: float,
) -> None:
    """Whatever the heading of that world."""
    R = WORLD.calibration.dvl.mounting.pose().rotation().matrix()
    attitude = WORLD.truth.at(WORLD.dvl.stamps_ns).rotations()
    in_body = WORLD.dvl.velocity @ R.T
    in_world = (Rotation.from_rotvec([0.0, 0.0, yaw_rad]) * attitude).apply(in_body)
    run = replace(WORLD, dvl=replace(WORLD.dvl, velocity=in_world @ R))
    ratio = turns_less_than_body(run.imu, run.dvl, run.calibration)
    assert ratio is not None
    assert ratio > 2.0
    first, *_ = check_sensors(run, LogConfig())
    assert "axes of the world" in first.text()


def test_rows_of_the_doppler_log_in_a_hole_of_the_imu_contradict_no_axes() -> None:
    t = (WORLD.imu.stamps_ns - WORLD.imu.stamps_ns[0]) * 1e-9
    imu = WORLD.imu.rows((t <= 30.0) | (t >= 55.0))
    found = match_axes(imu, WORLD.dvl, WORLD.calibration)
    assert found is not None
    assert (found.gyro == IDENTITY).all()
    assert (found.dvl == IDENTITY).all()
