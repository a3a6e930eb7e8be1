"""A quarter turn between IMU and Doppler log: the turned one is named where a third sensor shows it, else both are."""

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.diagnosis import Finding, check_sensors
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import Heading, PositionFixes
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission

from .test_sensor_check import line_of

WORLD = simulate_mission(MissionOptions(seed=4, duration_s=60, landmarks=40))
OTHER = {"imu": "dvl", "dvl": "imu"}


def with_turned(run: Sequence, role: str, yaw_rad: float) -> Sequence:
    """Measurements of a sensor that is turned about the vertical under a calibration without it."""
    c = np.cos(yaw_rad)
    s = np.sin(yaw_rad)
    body_R_turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    section = getattr(run.calibration, role)
    body_R_sensor = section.mounting.pose().rotation().matrix()
    # what a sensor measures whose true mounting is the turn of the stated one
    R = (body_R_turned @ body_R_sensor).T @ body_R_sensor
    rows = getattr(run, role)
    fields = ("velocity",) if role == "dvl" else ("angular_velocity", "specific_force")
    turned = {name: getattr(rows, name) @ R.T for name in fields}
    return replace(run, **{role: replace(rows, **turned)})


def with_sensors(run: Sequence, *, sonar: bool, fixes: bool, heading: bool) -> Sequence:
    rng = np.random.default_rng(0)
    truth = run.truth
    rows = slice(0, len(truth), 10)
    n = len(truth.stamps_ns[rows])
    places = truth.positions[rows] + 0.1 * rng.standard_normal((n, 3))
    yaw_rad = truth.rotations().as_euler("ZYX")[rows, 0]
    compass = Heading(
        truth.stamps_ns[rows],
        yaw_rad + 0.01 * rng.standard_normal(n),
        np.full(n, np.nan),
    )
    known = PositionFixes(truth.stamps_ns[rows], places, np.full((n, 3, 3), np.nan))
    return replace(
        run,
        detections=run.detections if sonar else None,
        positions=known if fixes else None,
        heading=compass if heading else None,
        truth=None,
    )


def acting(run: Sequence) -> list[Finding]:
    return [f for f in check_sensors(run, LogConfig()) if f.grave]


def with_measured_start(run: Sequence) -> Sequence:
    start = run.calibration.start.model_copy(update={"source": "fixes"})
    calibration = run.calibration.model_copy(update={"start": start})
    return replace(run, calibration=calibration)


@pytest.mark.parametrize(
    ("role", "yaw_rad", "witness"),
    [("imu", np.pi / 2, "sonar"), ("dvl", -0.7, "sonar"), ("imu", -0.7, "fixes")],
)
def test_a_third_sensor_shows_which_is_turned_and_its_line_puts_all_right(
    role: str, yaw_rad: float, witness: str
) -> None:
    run = with_sensors(
        WORLD, sonar=witness == "sonar", fixes=witness == "fixes", heading=False
    )
    (finding,) = acting(with_turned(run, role, yaw_rad))
    assert finding.quantity.startswith({"imu": "IMU", "dvl": "DVL"}[role])
    assert f"`{role}.mounting.rpy_rad" in finding.line
    assert f"`{OTHER[role]}.mounting" not in finding.line
    *_, found_rad = line_of(finding)[role]["mounting"]["rpy_rad"]
    *_, stated_rad = getattr(WORLD.calibration, role).mounting.rpy_rad
    assert found_rad - stated_rad == pytest.approx(yaw_rad, abs=0.03)


@pytest.mark.parametrize("role", ["imu", "dvl"])
def test_without_a_third_sensor_both_are_named(role: str) -> None:
    run = with_sensors(WORLD, sonar=False, fixes=False, heading=True)
    (finding,) = acting(with_turned(run, role, np.pi / 2))
    assert "no other sensor shows which" in finding.advice
    for name in ("imu", "dvl"):
        assert f"`{name}.mounting.rpy_rad" in finding.line


def test_a_heading_may_come_from_the_turned_imu() -> None:
    run = with_sensors(WORLD, sonar=False, fixes=True, heading=True)
    run = with_measured_start(run)
    (of_imu,) = acting(with_turned(run, "imu", np.pi / 2))
    assert of_imu.quantity.startswith("IMU")
    (of_dvl,) = acting(with_turned(run, "dvl", np.pi / 2))
    assert "no other sensor shows which" in of_dvl.advice
