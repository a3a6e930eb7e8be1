"""A turn between IMU and Doppler log: the turned one is named where something else shows it, else both are."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Start
from sonar_graph.diagnosis.turned_sensor import TurnedPair
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission

from .runs import (
    acting,
    compass,
    fixed,
    grave,
    level_vehicle,
    line_of,
    lines_of,
    recalibrated,
    spoilt,
    started,
    with_mounting,
)

WORLD = simulate_mission(MissionOptions(seed=4, duration_s=60, landmarks=40))
OTHER = {"imu": "dvl", "dvl": "imu"}


def with_turned(
    run: Sequence, role: str, angle_rad: float, axis: str = "z"
) -> Sequence:
    """Measurements of a sensor that is turned about an axis of the body under a calibration without it."""
    body_R_turned = Rotation.from_euler(axis, angle_rad).as_matrix()
    mounting = getattr(run.calibration, role).mounting
    body_R_sensor = mounting.pose().rotation().matrix()
    # what a sensor measures whose true mounting is the turn of the stated one
    R = (body_R_turned @ body_R_sensor).T @ body_R_sensor
    names = ("velocity",) if role == "dvl" else ("angular_velocity", "specific_force")
    rows = getattr(run, role)
    return spoilt(run, role, **{name: getattr(rows, name) @ R.T for name in names})


def with_only(*sensors: str) -> Sequence:
    """The mission with some of sonar, fixes and heading."""
    run = fixed(compass(WORLD, sigma_rad=0.01), sigma_m=0.1, every_s=0.2)
    roles = {"sonar": "detections", "fixes": "positions", "heading": "heading"}
    missing = {role: None for name, role in roles.items() if name not in sensors}
    return replace(run, truth=None, **missing)


@pytest.mark.parametrize(
    ("role", "yaw_rad", "witness"),
    [("imu", np.pi / 2, "sonar"), ("dvl", -0.7, "sonar"), ("imu", -0.7, "fixes")],
)
def test_a_third_sensor_shows_which_is_turned_and_its_line_puts_all_right(
    role, yaw_rad, witness
):
    (finding,) = grave(with_turned(with_only(witness), role, yaw_rad))
    assert finding.quantity.startswith({"imu": "IMU", "dvl": "DVL"}[role])
    assert f"`{role}.mounting.rpy_rad" in finding.line
    assert f"`{OTHER[role]}.mounting" not in finding.line
    *_, found_rad = line_of(finding)[role]["mounting"]["rpy_rad"]
    *_, stated_rad = getattr(WORLD.calibration, role).mounting.rpy_rad
    assert found_rad - stated_rad == pytest.approx(yaw_rad, abs=0.03)


def swaying() -> Sequence:
    """A level vehicle that turns, sways and heaves: velocities along all axes of the body show how it is turned."""
    t = np.arange(0.0, 60.0, 0.02)
    ahead = 1.0 + 0.2 * np.sin(0.5 * t)
    velocity = np.column_stack([ahead, 0.3 * np.sin(0.9 * t), 0.2 * np.sin(0.7 * t)])
    run = level_vehicle(velocity, 0.16 * np.cos(0.2 * t), seed=3)
    start = Start(position_m=(0.0, 0.0, 0.0), rpy_rad=(0.0, 0.0, 0.0))
    return started(run, start)


@pytest.mark.parametrize(
    ("role", "roll_rad", "pitch_rad", "is_stated"),
    [
        ("imu", 0.2, 0.0, True),
        ("imu", 0.0, -0.5, False),
        ("dvl", 0.0, 0.1, True),
        ("dvl", 0.2, 0.07, True),
    ],
)
def test_a_stated_start_shows_which_is_rolled_or_pitched(
    role, roll_rad, pitch_rad, is_stated
):
    """One line puts all right; without a start both lines are given, and no other sensor is blamed."""
    run = swaying() if is_stated else recalibrated(swaying(), "start", source="fixes")
    run = with_turned(run, role, roll_rad, "x")
    finding, *others = grave(with_turned(run, role, pitch_rad, "y"))
    # a start that nobody states would be measured by the turned IMU
    assert not (is_stated and others)
    if not (roll_rad and pitch_rad):
        assert finding.quantity.endswith(" roll" if roll_rad else " pitch")
    found = {name: line for one in lines_of(finding) for name, line in one.items()}
    assert found.keys() == ({role} if is_stated else {"imu", "dvl"})
    angles_rad = found[role]["mounting"]["rpy_rad"]
    assert angles_rad[:2] == pytest.approx([roll_rad, pitch_rad], abs=0.02)
    assert (roll_rad and pitch_rad) or abs(angles_rad[2]) < 0.02


def test_a_bias_of_accelerometers_is_told_from_gravity_by_turns():
    """Its line, in the axes of an IMU that is turned on the vehicle, takes it away for all that follows."""
    run = swaying()
    bias_m_s2 = (0.1, -0.4, 0.0)
    imu_R_body = Rotation.from_euler("z", -0.5)
    force = imu_R_body.apply(run.imu.specific_force) + bias_m_s2
    rate = imu_R_body.apply(run.imu.angular_velocity)
    biased = spoilt(run, "imu", specific_force=force, angular_velocity=rate)
    biased = with_mounting(biased, "imu", rpy_rad=(0.0, 0.0, 0.5))
    found = acting(biased)
    assert {f.quantity[:18] for f in found} == {"accelerometer bias"}
    known = line_of(found[0])["imu"]
    assert known["accel_bias_m_s2"] == pytest.approx(bias_m_s2, abs=0.01)
    assert not acting(recalibrated(biased, "imu", **known))


def test_a_start_that_is_tilted_like_a_turned_imu_decides_nothing():
    """It may have been read off that IMU: its gravity fits, and the Doppler log would be blamed."""
    run = with_turned(swaying(), "imu", 0.2, "x")
    finding, *_ = grave(recalibrated(run, "start", rpy_rad=(-0.2, 0.0, 0.0)))
    assert "no other sensor shows which" in finding.advice


def test_mountings_that_are_right_within_two_degrees_are_left_alone():
    assert grave(with_turned(swaying(), "dvl", 0.03, "x")) == []


@pytest.mark.parametrize(("role", "wrong"), [("imu", "imu"), ("dvl", "")])
def test_a_heading_may_come_from_the_turned_imu(role, wrong):
    """One of a Doppler log and an IMU is turned by a quarter."""
    run = recalibrated(with_only("fixes", "heading"), "start", source="fixes")
    turned = with_turned(run, role, np.pi / 2)
    turn_rad = np.pi / 2 if role == "dvl" else -np.pi / 2
    assert TurnedPair(turned, np.array([0.0, 0.0, turn_rad])).wrong_one() == wrong
