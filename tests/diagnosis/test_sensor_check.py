"""Truth from the simulator: known faults are named with the line that puts them right, and that line does."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.diagnosis.findings import Finding, StartTilt, find_start_tilt, with_interval
from sonar_graph.diagnosis.sensor_check import (
    check_sensors,
    corrected_sequence,
    dvl_findings,
    noise_findings,
    surest_bias,
    wrong_units,
)
from sonar_graph.logs.adapters.log_config import LogConfig
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.alignment.dvl_imu import DvlMatch
from sonar_graph.navigation.alignment.gravity import InitialTilt
from sonar_graph.navigation.alignment.time_offset import Estimate1D
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission

RIGHT = simulate_mission(MissionOptions(seed=4, duration_s=240, landmarks=1))
SHORT = simulate_mission(MissionOptions(seed=4, duration_s=120, landmarks=1))
OFFSET_S, YAW_RAD, SCALE = 0.4, np.radians(5), 1.04
FAR_M = (0.9, 0.0, -0.7)
"""Where a calibration has the IMU that is at the origin; the Doppler log is at (-0.2, 0, -0.15) from it."""


def by_name(findings: list[Finding]) -> dict[str, Finding]:
    return {finding.quantity: finding for finding in findings}


def spoilt() -> Sequence:
    """Early stamps, turned and short velocities, a wrong lever arm."""
    velocity = Rotation.from_euler("z", -YAW_RAD).apply(RIGHT.dvl.velocity) / SCALE
    early = RIGHT.dvl.stamps_ns - round(OFFSET_S * 1e9)
    run = replace(RIGHT, dvl=Dvl(early, velocity, RIGHT.dvl.velocity_cov))
    return with_mounting(run, "imu", translation_m=FAR_M)


@pytest.fixture(scope="module")
def found_in_spoilt() -> dict[str, Finding]:
    return by_name(check_sensors(spoilt()))


def with_mounting(run: Sequence, sensor: str, **change: tuple[float, ...]) -> Sequence:
    section = getattr(run.calibration, sensor)
    moved = section.model_copy(update={"mounting": section.mounting.model_copy(update=change)})
    return replace(run, calibration=run.calibration.model_copy(update={sensor: moved}))


def line_of(finding: Finding) -> dict[str, Any]:
    return tomllib.loads(finding.advice.split("`")[1])


def corrected(run: Sequence, found: dict[str, Finding]) -> Sequence:
    """The Doppler log as the advice's own lines make it."""
    lines = {name: line_of(finding) for name, finding in found.items() if finding.acts and "`" in finding.advice}
    shift_s, scale = lines["DVL against IMU: time offset"]["stamp_offset_s"], lines["DVL scale"]["scale"]
    rpy = tuple(lines["DVL mounting yaw"]["dvl"]["mounting"]["rpy_rad"])
    place = tuple(lines["lever arm from IMU to DVL, x"]["imu"]["mounting"]["translation_m"])
    dvl = run.dvl
    moved = Dvl(dvl.stamps_ns + round(shift_s * 1e9), dvl.velocity * scale, dvl.velocity_cov)
    return with_mounting(with_mounting(replace(run, dvl=moved), "dvl", rpy_rad=rpy), "imu", translation_m=place)


@pytest.mark.slow
def test_the_advised_lines_put_the_log_right(found_in_spoilt: dict[str, Finding]):
    found = found_in_spoilt
    again = by_name(check_sensors(corrected(spoilt(), found)))
    for name in ("DVL against IMU: time offset", "DVL mounting yaw", "DVL scale"):
        assert found[name].acts, name
        assert not again[name].acts, again[name].text()
        assert again[name].advice == "no need to act"
    arms = [finding for name, finding in found.items() if name.startswith("lever arm")]
    assert [arm.acts for arm in arms] == [True, False, True]
    assert not any(again[arm.quantity].acts for arm in arms)


def test_the_start_is_aligned_with_what_was_found_before(found_in_spoilt: dict[str, Finding]):
    """With stamps half a second off, velocities and accelerations differ too much for an alignment."""
    assert RIGHT.truth is not None
    _, pitch, roll = RIGHT.truth.at(np.array([RIGHT.start_ns])).rotations().as_euler("ZYX", degrees=True)[0]
    assert found_in_spoilt["start roll"].estimate.value == pytest.approx(roll, abs=0.1)
    assert found_in_spoilt["start pitch"].estimate.value == pytest.approx(pitch, abs=0.1)
    assert find_start_tilt(spoilt()).tilt is None


def test_corrections_are_added_to_what_the_configuration_says():
    config = LogConfig.parse({"dvl": {"stamp_offset_s": -0.1, "scale": 2.0}}, "x")
    found = by_name(check_sensors(spoilt(), config))
    offset, scale = (
        tomllib.loads(found[name].advice.split("`")[1]) for name in ("DVL against IMU: time offset", "DVL scale")
    )
    assert offset["stamp_offset_s"] == pytest.approx(OFFSET_S - 0.1, abs=0.15)
    assert scale["scale"] == pytest.approx(2 * SCALE, abs=0.05)


def test_a_start_taken_from_a_late_reference_is_named_with_the_right_one():
    """The vehicle turns at the start: half a second late is some degrees off."""
    assert SHORT.truth is not None
    late = replace(SHORT.truth, stamps_ns=SHORT.truth.stamps_ns + 500_000_000)
    turning = replace(SHORT, truth=late)
    first_ns = turning.start_ns + 20_000_000_000
    turning = replace(turning, imu=SHORT.imu.rows(SHORT.imu.stamps_ns >= first_ns))
    for reference, acts in ((late, True), (SHORT.truth, False)):
        yaw, pitch, roll = reference.at(np.array([turning.start_ns])).rotations().as_euler("ZYX")[0].tolist()
        start = turning.calibration.start.model_copy(update={"rpy_rad": (roll, pitch, yaw)})
        run = replace(turning, calibration=turning.calibration.model_copy(update={"start": start}))
        finding = by_name(check_sensors(run))["start heading of the calibration"]
        assert finding.acts == acts, finding.text()


def test_lines_for_the_start_agree_on_roll_pitch_and_heading():
    assert SHORT.truth is not None
    yaw, pitch, roll = SHORT.truth.at(np.array([SHORT.start_ns])).rotations().as_euler("ZYX")[0].tolist()
    start = SHORT.calibration.start.model_copy(update={"rpy_rad": (roll + 0.1, pitch, yaw + 0.2)})
    run = replace(SHORT, calibration=SHORT.calibration.model_copy(update={"start": start}))
    found = by_name(check_sensors(run))
    ours, theirs = (line_of(found[name])["start"] for name in ("start roll", "start heading of the calibration"))
    assert ours["rpy_rad"] == theirs["rpy_rad"] == pytest.approx([roll, pitch, yaw], abs=2e-3)


def test_a_number_that_cannot_be_told_asks_for_nothing():
    short = replace(RIGHT, imu=RIGHT.imu.rows(slice(0, 150)), dvl=RIGHT.dvl.rows(slice(0, 9)), truth=None)
    for finding in check_sensors(short):
        assert not finding.acts
        assert finding.text().startswith("cannot be told: ")
        assert finding.plain()["value"] is None


@pytest.mark.slow
@pytest.mark.parametrize("hole_s", [2.0, 5.0])
def test_a_hole_of_the_imu_asks_for_nothing(hole_s: float, monkeypatch: pytest.MonkeyPatch):
    """Drawn straight across, 5 s of manoeuvres make a wrong scale and a wrong offset of the reference."""
    t = (RIGHT.imu.stamps_ns - RIGHT.imu.stamps_ns[0]) * 1e-9
    run = replace(RIGHT, imu=RIGHT.imu.rows((t <= 100.0) | (t >= 100.0 + hole_s)))
    found = by_name(check_sensors(run))
    assert [finding.text() for finding in found.values() if finding.acts] == []
    assert found["DVL scale"].estimate.is_known
    assert found["reference against IMU: time offset"].estimate.is_known
    monkeypatch.setattr("sonar_graph.navigation.alignment.dvl_imu.holes_before", np.zeros_like)
    blind = by_name(check_sensors(run))
    assert blind["DVL scale"].acts == blind["reference against IMU: time offset"].acts == (hole_s > 2.0)


def test_digits_are_those_that_the_interval_supports():
    assert with_interval(Estimate1D(1.0312345, 0.0102), "s") == "+1.031 ± 0.020 s"
    assert with_interval(Estimate1D(1.00213, 0.0011), "") == "1.0021 ± 0.0022"


UNITS = {  # per unit of the package, what the driver counts, and the name and the line that are to be found
    "mm/s": ("dvl", 1000.0, "DVL: unit", {"scale": 0.001}),
    "cm/s": ("dvl", 100.0, "DVL: unit", {"scale": 0.01}),
    "degrees a second": ("rate", np.degrees(1), "gyro: unit", {"angular_velocity_scale": np.radians(1)}),
    "g": ("force", 1 / 9.80665, "accelerometer: unit", {"linear_acceleration_scale": 9.80665}),
    "mm/s²": ("force", 1000.0, "accelerometer: unit", {"linear_acceleration_scale": 0.001}),
}


def in_other_units(sensor: str, factor: float) -> Sequence:
    imu, dvl = RIGHT.imu, RIGHT.dvl
    rate = imu.angular_velocity * (factor if sensor == "rate" else 1.0)
    force = imu.specific_force * (factor if sensor == "force" else 1.0)
    velocity = dvl.velocity * (factor if sensor == "dvl" else 1.0)
    return replace(RIGHT, imu=Imu(imu.stamps_ns, rate, force), dvl=Dvl(dvl.stamps_ns, velocity, dvl.velocity_cov))


@pytest.mark.parametrize("unit", UNITS)
def test_a_wrong_unit_is_named_alone_with_the_line_that_puts_it_right(unit: str):
    sensor, factor, quantity, line = UNITS[unit]
    (finding,) = check_sensors(in_other_units(sensor, factor))
    assert finding.quantity == quantity
    assert finding.acts
    assert f": {unit}?" in finding.text()
    assert tomllib.loads(finding.advice.split("`")[1]) == pytest.approx(line, rel=1e-3)


def test_a_wrong_unit_adds_to_what_the_configuration_scales():
    config = LogConfig.parse({"dvl": {"scale": -2.0}}, "x")
    (finding,) = check_sensors(in_other_units("dvl", 1000.0), config)
    assert tomllib.loads(finding.advice.split("`")[1]) == {"scale": -0.002}


def test_right_units_are_not_doubted_even_with_spikes_and_rows_that_were_not_measured():
    rate, force, velocity = (
        RIGHT.imu.angular_velocity.copy(),
        RIGHT.imu.specific_force.copy(),
        RIGHT.dvl.velocity.copy(),
    )
    rate[::50], force[::50], velocity[::50] = 1e3, np.nan, 1e3
    imu = Imu(RIGHT.imu.stamps_ns, rate, force)
    assert not wrong_units(
        replace(RIGHT, imu=imu, dvl=Dvl(RIGHT.dvl.stamps_ns, velocity, RIGHT.dvl.velocity_cov)), LogConfig()
    )


@pytest.mark.parametrize(("speed_m_s", "is_told"), [(0.0, True), (0.05, True), (0.8, False)])
def test_a_steady_drive_is_no_rest_to_tell_noise_from(speed_m_s: float, is_told: bool):
    rng, n = np.random.default_rng(0), 5000
    force = [0, 0, 9.80665] + 0.05 * rng.standard_normal((n, 3))
    imu = Imu(np.arange(n) * 10_000_000, 0.01 * rng.standard_normal((n, 3)), force)
    velocity = [speed_m_s, 0, 0] + 0.01 * rng.standard_normal((250, 3))
    dvl = Dvl(np.arange(250) * 200_000_000, velocity, np.full((250, 3, 3), np.nan))
    found = by_name(check_sensors(replace(RIGHT, imu=imu, dvl=dvl, truth=None)))
    for name in ("gyro noise density", "accelerometer noise density"):
        assert found[name].estimate.is_known == found[name].acts == is_told
        assert is_told or "steady, but at 0.8 m/s" in found[name].text()


@pytest.mark.parametrize(("factor", "acts"), [(0.5, True), (0.75, False), (1.0, False), (1.35, False), (2.0, True)])
def test_a_density_matters_by_half_as_much_again_either_way(factor: float, acts: bool):
    """100 s of rest at 100 Hz, which tells a density to some percent."""
    rng, n, given = np.random.default_rng(1), 10_000, RIGHT.calibration.imu
    rate, force = factor * 10 * rng.standard_normal((2, n, 3))
    at_rest = [0, 0, 9.80665] + given.accel_noise_density * force
    imu = Imu(np.arange(n) * 10_000_000, given.gyro_noise_density * rate, at_rest)
    dvl = Dvl(np.arange(500) * 200_000_000, np.zeros((500, 3)), np.full((500, 3, 3), np.nan))
    for finding in noise_findings(replace(RIGHT, imu=imu, dvl=dvl)):
        assert finding.acts == acts, finding.text()


def told(*values: float, sigma: float = 1e-3) -> tuple[Estimate1D, Estimate1D, Estimate1D]:
    x, y, z = (Estimate1D(value, sigma) for value in values)
    return x, y, z


@pytest.mark.parametrize("acts", [True, False])
def test_what_iscorrected_sequence_before_the_start_is_what_the_rows_advise(acts: bool):
    offset, yaw, scale = (0.4, 0.05, 1.04) if acts else (0.008, 0.002, 1.001)
    numbers = (Estimate1D(value, 1e-5) for value in (offset, yaw, scale))
    match = DvlMatch(*numbers, lever=told(-0.2, 0.0, -0.15), gyro_bias=told(0.0, 0.0, 0.0, sigma=1e-6))
    turned = with_mounting(RIGHT, "dvl", rpy_rad=(0.3, 0.1, 0.2))
    rows = list(dvl_findings(match, turned, LogConfig()))
    assert [row.acts for row in rows] == [acts] * 3
    assert rows[0].estimate.sigma == pytest.approx(0.01 / np.sqrt(12), rel=1e-3), "that of a sample's instant"
    right = corrected_sequence(turned, match, rows)
    assert right.dvl.stamps_ns - RIGHT.dvl.stamps_ns == pytest.approx(400_000_000 if acts else 0)
    assert right.dvl.velocity == pytest.approx(RIGHT.dvl.velocity * (1.04 if acts else 1.0))
    assert right.calibration.dvl.mounting.rpy_rad == pytest.approx((0.3, 0.1, 0.25 if acts else 0.2))


def test_of_two_biases_the_surer_is_told_axis_by_axis_with_where_it_is_from():
    unknown = Estimate1D(np.nan, np.inf, "too little turning")
    nothing = told(0.0, 0.0, 0.0)
    x, y, _ = told(1.0, 2.0, 3.0, sigma=1e-4)
    drive = DvlMatch(unknown, unknown, unknown, nothing, (x, replace(y, sigma=1e-2), unknown))
    sigmas = np.array([1.0, 1.0, 1e-3, 1e-3, 1e-3])
    rest = InitialTilt(0, 0.0, 0.0, np.array([10.0, 20.0, 30.0]), np.diag(sigmas**2), np.ones(3, dtype=np.bool_))
    bias, sources = surest_bias(drive, StartTilt(rest, "from 20 s of rest", is_rest=True))
    assert [one.value for one in bias] == [1.0, 20.0, 30.0]
    assert sources == ("from the turns of the drive", "from 20 s of rest", "from 20 s of rest")
    moving, sources = surest_bias(drive, StartTilt(rest, "from 60 s in motion"))
    assert moving == drive.gyro_bias
    assert set(sources) == {"from the turns of the drive"}
