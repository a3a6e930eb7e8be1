"""Truth from the simulator: known faults are named with the line that puts them right, and that line does."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.diagnosis import Finding, check_sensors, sensor_check
from sonar_graph.diagnosis.findings import Gravity
from sonar_graph.diagnosis.signals import are_wild
from sonar_graph.diagnosis.start import StartTilt, find_start_tilt
from sonar_graph.diagnosis.units import coarse_findings, range_changes, wrong_units
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.logs.vehicle_setup import unplaced
from sonar_graph.measurements import Floats, Imu
from sonar_graph.navigation.alignment import Estimate1D, InitialTilt
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission

from .runs import (
    acting,
    by_name,
    compass,
    dvl_rows,
    grave,
    late,
    level_vehicle,
    line_of,
    names,
    recalibrated,
    spoilt,
    with_depth,
    with_mounting,
    without_imu,
)

RIGHT = simulate_mission(MissionOptions(seed=4, duration_s=120, landmarks=1))
START = RIGHT.truth.at(np.array([RIGHT.start_ns]))
YAW, PITCH, ROLL = START.rotations().as_euler("ZYX")[0].tolist()


def found_in(run: Sequence, config: LogConfig | None = None) -> dict[str, Finding]:
    return by_name(check_sensors(run, config))


def with_rows(rate: Floats, force: Floats, velocity: Floats) -> Sequence:
    """The mission with other rows: the IMU at 100 Hz, the Doppler log at 5 Hz."""
    up = np.array([0, 0, 9.80665])
    imu = Imu(np.arange(len(rate)) * 10_000_000, rate, force + up)
    dvl = dvl_rows(np.arange(len(velocity)) * 200_000_000, velocity)
    return replace(RIGHT, imu=imu, dvl=dvl, truth=None)


def spoilt_log() -> Sequence:
    """Early stamps, turned and short velocities, a wrong lever arm."""
    velocity = Rotation.from_euler("z", -np.radians(5)).apply(RIGHT.dvl.velocity) / 1.04
    run = late(spoilt(RIGHT, "dvl", velocity=velocity), "dvl", -0.4)
    # the IMU is at the origin; the Doppler log is at (-0.2, 0, -0.15) from it
    return with_mounting(run, "imu", translation_m=(0.9, 0.0, -0.7))


CORRECTED = LogConfig.parse({"dvl": {"stamp_offset_s": -1.0, "scale": 2.0}}, "x")


@pytest.fixture(scope="module")
def found_in_spoilt() -> dict[str, Finding]:
    """With a log configuration that its reading has applied."""
    return found_in(spoilt_log(), CORRECTED)


OF_DVL = ("DVL against IMU: time offset", "DVL scale", "DVL mounting yaw")


def test_the_advised_lines_put_the_log_right(found_in_spoilt):
    """They add to the corrections of the configuration."""
    found = found_in_spoilt
    arms = [f"lever arm from IMU to DVL, {axis}" for axis in "xyz"]
    assert [found[name].acts for name in arms] == [True, False, True]
    for finding in found.values():
        # each line to change with the option that takes the file
        if "`" in finding.advice:
            assert " FILE)" in finding.advice or "`--start`" in finding.advice
    assert all(found[name].acts for name in OF_DVL)
    shift, scale, yaw = (line_of(found[name]) for name in OF_DVL)
    assert shift["stamp_offset_s"] == pytest.approx(0.4 - 1.0, abs=0.15)
    assert scale["scale"] == pytest.approx(2 * 1.04, abs=0.05)
    run = late(spoilt_log(), "dvl", shift["stamp_offset_s"] + 1.0)
    run = spoilt(run, "dvl", velocity=scale["scale"] / 2.0 * run.dvl.velocity)
    run = with_mounting(run, "dvl", **yaw["dvl"]["mounting"])
    run = with_mounting(run, "imu", **line_of(found[arms[0]])["imu"]["mounting"])
    again = found_in(run)
    for name in (*OF_DVL, *arms):
        assert not again[name].acts, again[name].text()
    assert {again[name].advice for name in OF_DVL} == {"no need to act"}


def test_the_start_is_aligned_with_what_was_found_before(found_in_spoilt):
    """With stamps half a second off, velocities and accelerations differ too much for an alignment."""
    for name, angle_rad in (("roll", ROLL), ("pitch", PITCH)):
        found = found_in_spoilt[f"start {name}: value"].estimate.value
        assert found == pytest.approx(np.degrees(angle_rad), abs=0.1)
    assert find_start_tilt(spoilt_log()).tilt is None


def test_a_unit_is_added_to_the_scale_of_the_configuration():
    in_mm = spoilt(RIGHT, "dvl", velocity=1000.0 * RIGHT.dvl.velocity)
    (finding,) = acting(in_mm, CORRECTED)
    assert (finding.quantity, line_of(finding)) == ("DVL: unit", {"scale": 0.002})


def of_reference(run: Sequence) -> dict[str, Finding]:
    """Findings about the reference and the start alone."""
    tilt = find_start_tilt(run)
    return by_name(list(sensor_check.reference_findings(run, LogConfig(), tilt)))


def started_at(*rpy_rad: float, yaw_sigma_rad: float = 0.001) -> Sequence:
    sigmas = (*RIGHT.calibration.start.rpy_sigma_rad[:2], yaw_sigma_rad)
    return recalibrated(RIGHT, "start", rpy_rad=rpy_rad, rpy_sigma_rad=sigmas)


@pytest.mark.parametrize("late_s", [0.0, 0.5])
def test_a_start_taken_from_a_late_reference_is_named_with_the_right_one(late_s):
    """The vehicle turns at the start: half a second late is some degrees off."""
    is_left = RIGHT.imu.stamps_ns >= RIGHT.start_ns + 20_000_000_000
    run = replace(late(RIGHT, "truth", late_s), imu=RIGHT.imu.rows(is_left))
    begun = run.truth.at(np.array([run.start_ns])).rotations().as_euler("ZYX")[0]
    run = recalibrated(run, "start", rpy_rad=tuple(begun[::-1].tolist()))
    finding = of_reference(run)["start heading: error"]
    assert finding.acts == (late_s > 0), finding.text()
    told = "(--calibration FILE); the position too is the reference's"
    assert (told in finding.advice) == finding.acts


def test_lines_for_the_start_agree_on_roll_pitch_and_heading():
    found = found_in(started_at(ROLL + 0.1, PITCH, YAW + 0.2))
    ours, theirs = (
        line_of(found[name])["start"]["rpy_rad"]
        for name in ("start roll: value", "start heading: error")
    )
    assert ours == theirs == pytest.approx([ROLL, PITCH, YAW], abs=2e-3)
    assert found["start roll: value"].gravity is Gravity.ACT


def test_a_start_heading_within_its_own_sigma_is_not_wrong():
    run = started_at(ROLL, PITCH, YAW + 0.1, yaw_sigma_rad=0.1)
    assert not of_reference(run)["start heading: error"].acts


def test_a_start_on_its_back_makes_results_doubtful():
    found = of_reference(started_at(ROLL + 3.0, PITCH, YAW))
    assert found["start roll: value"].gravity is Gravity.GRAVE


def test_a_number_that_cannot_be_told_asks_for_nothing():
    short = {"imu": RIGHT.imu.rows(slice(150)), "dvl": RIGHT.dvl.rows(slice(9))}
    for finding in check_sensors(replace(RIGHT, truth=None, **short)):
        assert not finding.acts
        # a second of gravity is enough for this one
        if finding.quantity != "accelerometer scale":
            assert finding.text().startswith("cannot be told: ")
            assert finding.plain()["value"] is None


@pytest.mark.slow
@pytest.mark.parametrize("hole_s", [2.0, 5.0])
def test_a_hole_of_the_imu_asks_for_nothing(hole_s, monkeypatch):
    """Drawn straight across, 5 s of manoeuvres make a wrong offset of the reference."""
    run = without_imu(RIGHT, 50.0, 50.0 + hole_s)
    found = found_in(run)
    assert not [finding.text() for finding in found.values() if finding.acts]
    of_reference = "reference against IMU: time offset"
    assert found["DVL scale"].estimate.is_known
    assert found[of_reference].estimate.is_known
    holes = "sonar_graph.navigation.alignment.dvl_imu.holes_before"
    monkeypatch.setattr(holes, np.zeros_like)
    assert found_in(run)[of_reference].acts == (hole_s > 2.0)


@pytest.mark.parametrize(
    ("speed_m_s", "stuck", "told"),
    [
        (0.05, False, ""),
        (0.8, False, "steady, but at 0.8 m/s"),
        (0.0, True, "the same to the last bit while still"),
    ],
)
def test_noise_is_told_at_rest_from_readings_that_change(speed_m_s, stuck, told):
    """A density of zero would be believed; one changed digit is noise again."""
    rng = np.random.default_rng(0)
    force = 0.05 * rng.standard_normal((6000, 3))
    rate = np.zeros((6000, 3))
    rate[::7] = 0.0 if stuck else 1e-4
    velocity = [speed_m_s, 0, 0] + 0.01 * rng.standard_normal((300, 3))
    run = with_rows(rate, force, velocity)
    found = by_name(list(sensor_check.noise_findings(run)))
    gyro = found["gyro noise density"]
    forces = found["accelerometer noise density"]
    assert told in gyro.text()
    assert gyro.estimate.is_known == gyro.acts == (not told)
    assert forces.estimate.is_known == forces.acts == (speed_m_s < 0.8)


def test_the_bias_of_smaller_sigma_wins_axis_by_axis():
    unknown = Estimate1D(np.nan, np.inf, "too little turning")
    driven = (Estimate1D(1.0, 1e-4), Estimate1D(2.0, 1e-2), unknown)
    cov = np.diag(np.square([1.0, 1.0, 1e-3, 1e-3, 1e-3]))
    bias = np.array([10.0, 20.0, 30.0])
    rest = InitialTilt(0, 0.0, 0.0, bias, cov, np.ones(3, dtype=np.bool_))
    still = StartTilt(rest, "from 20 s of rest", is_rest=True)
    found, sources = sensor_check.surest_bias(driven, still)
    assert [one.value for one in found] == [1.0, 20.0, 30.0]
    # a bias that changed is one row with both numbers
    assert sources == (
        "from the turns of the drive (from 20 s of rest 10 ± 0.002 rad/s)",
        "from 20 s of rest (from the turns of the drive 2 ± 0.02 rad/s)",
        "from 20 s of rest",
    )
    moving = StartTilt(rest, "from 60 s in motion")
    found, sources = sensor_check.surest_bias(driven, moving)
    assert (found, set(sources)) == (driven, {"from the turns of the drive"})


ALONG = np.array([2.0, -1.0, 2.0]) / 3.0


def vectors(length: float | Floats) -> Floats:
    """All in one direction, along none of the axes."""
    return np.broadcast_to(length, 100)[:, None] * ALONG


def units(
    speed: float = 1.0,
    turn: float = 0.1,
    force: float | Floats = 9.8,
    gravity: float = 9.80665,
) -> list[Finding]:
    """Wrong units of readings so long."""
    stamps_ns = np.arange(100) * 10_000_000
    imu = Imu(stamps_ns, vectors(turn), vectors(force))
    dvl = dvl_rows(stamps_ns, vectors(speed))
    sequence = Sequence("hand", Calibration(gravity_m_s2=gravity), imu, dvl)
    return wrong_units(sequence, LogConfig())


@pytest.mark.parametrize(
    ("speed", "unit", "times"),
    [
        (20.1, "cm/s", 100),
        (299.0, "cm/s", 100),
        (301.0, "mm/s", 1000),
        (9e5, "mm/s", 1000),  # no unit makes it slow: the smallest
    ],
)
def test_the_unit_of_a_speed_over_twenty_is_found(speed, unit, times):
    (fault,) = units(speed=speed)
    assert fault.quantity == "DVL: unit"
    assert fault.advice.startswith(
        f"velocities look {times} times too large (up to {speed:.3g} m/s): {unit}? "
    )
    assert line_of(fault) == pytest.approx({"scale": 1 / times})
    assert ("mm/s if the vehicle moves at" in fault.advice) == (unit == "cm/s")


SLOW = simulate_mission(
    MissionOptions(seed=5, duration_s=60.0, frame_rate_hz=2.0, speed_m_s=0.1)
)


def test_ranges_decide_no_unit_with_wrong_axes_outliers_or_few_landmarks():
    velocity = SLOW.dvl.velocity
    astern = spoilt(SLOW, "dvl", velocity=-100.0 * velocity)
    assert wrong_units(astern, LogConfig())
    is_spike = np.random.default_rng(0).random((len(velocity), 1)) < 0.2
    coarse = recalibrated(SLOW, "sonar", range_sigma_m=0.05)
    few = replace(astern, detections=SLOW.detections.rows(slice(0, 15)))
    assert range_changes(few) is None
    for run in (
        spoilt(SLOW, "dvl", velocity=velocity[:, [1, 2, 0]]),
        spoilt(SLOW, "dvl", velocity=-velocity),
        spoilt(SLOW, "dvl", velocity=velocity + 8.0 * is_spike),
        spoilt(coarse, "detections", range_m=np.full(len(SLOW.detections), 2.0)),
        few,
        replace(astern, detections=None),
    ):
        assert not wrong_units(run, LogConfig())


def test_usual_readings_raise_no_doubt_about_units():
    """0.78 g are within a fifth of 9.1 m/s². Shocks move a mean, not a median."""
    assert not units(speed=19.9, turn=1.99, force=9.0)
    for force in (0.78, 1.22, 0.0, 1.5, 3.7, 300.0, 1e6):
        assert not units(force=force), "gravity in no unit"
    shocks = np.where(np.arange(100) < 40, 20.0, 1.0)
    for readings, words in (
        ({"force": 0.78, "gravity": 9.1}, "instead of 9.1 m/s²: g?"),
        ({"force": shocks}, "typically 1 instead"),
        ({"turn": 2.1}, "57 times too large (up to 2.1 rad/s): degrees a second? "),
    ):
        (fault,) = units(**readings)
        assert words in fault.advice


@pytest.mark.parametrize("is_in_degrees", [True, False])
def test_slow_rates_in_degrees_are_told_by_gravity(is_in_degrees):
    """They tilt the vehicle 57 times farther than gravity turns in the accelerometers; radians, by as much.

    A constant bias tilts nothing. Without accelerometers there is no finding.
    """
    unit = np.degrees(1.0) if is_in_degrees else 1.0
    rates = unit * RIGHT.imu.angular_velocity * [1, 1, 0]
    slow = spoilt(RIGHT, "imu", angular_velocity=np.add(rates, [0.5, -0.5, 0.0]))
    faults = wrong_units(slow, LogConfig())
    assert names(faults) == ["gyro: unit"] * is_in_degrees
    blind = np.full_like(RIGHT.imu.specific_force, np.nan)
    assert not wrong_units(spoilt(slow, "imu", specific_force=blind), LogConfig())
    for fault in faults:
        scale = line_of(fault)["angular_velocity_scale"]
        assert scale == pytest.approx(np.pi / 180, rel=1e-4)
        assert "they tilt the vehicle by" in fault.advice


@pytest.mark.parametrize("sensor", ["imu", "dvl"])
def test_a_delay_that_all_others_share_is_that_of_the_imu(sensor):
    """With the Doppler log late alone, the other sensors agree with the IMU, and the line is the log's."""
    found = acting(late(RIGHT, sensor, 0.5))
    offset = by_name(found)["DVL against IMU: time offset"]
    assert f"under [{sensor}]" in offset.advice
    assert line_of(offset)["stamp_offset_s"] == pytest.approx(-0.5, abs=0.05)
    assert not [name for name in names(found) if name.endswith(": delay")]


def test_velocities_are_known_no_better_than_the_scale_of_the_forces():
    """Forces that are 1.25 times too long are put right to 0.1 %: no velocity can be compared with them more closely."""
    sigmas = []
    for factor in (1.0, 1.25):
        force = factor * RIGHT.imu.specific_force
        found = found_in(spoilt(RIGHT, "imu", specific_force=force))
        sigmas.append(found["DVL scale"].estimate.sigma)
    assert np.diff(np.square(sigmas)) == pytest.approx(1e-3**2, rel=0.3)


def test_of_forces_without_gravity_nothing_else_is_blamed():
    """Neither a bias of the gyros nor depth, heading or fixes."""
    up = RIGHT.truth.at(RIGHT.imu.stamps_ns).rotations().as_matrix()[:, 2, :]
    force = RIGHT.imu.specific_force - 9.80665 * up
    assert acting(spoilt(RIGHT, "imu", specific_force=force)) == []


def test_a_drifting_heading_is_a_fault_of_the_heading():
    bias_rad_s = np.array([0.002, -0.001, 0.003])
    rate = RIGHT.imu.angular_velocity + bias_rad_s
    run = spoilt(RIGHT, "imu", angular_velocity=rate)
    run = compass(run, lambda yaw_rad: yaw_rad - 0.05 * 0.2 * np.arange(len(yaw_rad)))
    found = acting(replace(run, truth=None))
    drift = by_name(found)["heading: drift"]
    assert drift.estimate.value == pytest.approx(-0.05, abs=0.003)
    assert "`use = false` under [heading]" in drift.line
    (of_bias,) = (one for one in found if "gyro_bias_rad_s" in one.line)
    stated = line_of(of_bias)["imu"]["gyro_bias_rad_s"]
    assert stated == pytest.approx(bias_rad_s, abs=1e-3)


def test_values_in_steps_far_above_their_noise_are_named_alone():
    known = RIGHT.calibration
    wave = 1.0 + 0.5 * np.sin(np.arange(len(RIGHT.dvl)) / 50.0)
    velocity_step = 12.0 * max(known.dvl.velocity_sigma_m_s)
    for name, role, column, values, step in (
        ("DVL", "dvl", "velocity", RIGHT.dvl.velocity * wave[:, None], velocity_step),
        ("gyro", "imu", "angular_velocity", RIGHT.imu.angular_velocity, 0.05),
        ("depth", "depth", "z_m", RIGHT.depth.z_m, 12.0 * known.depth.sigma_m),
    ):
        run = spoilt(RIGHT, role, **{column: step * np.trunc(values / step)})
        assert names(coarse_findings(run)) == [f"{name}: resolution"]
    assert coarse_findings(RIGHT) == []


def test_a_mounting_that_is_not_known_is_named_before_what_may_follow():
    """Only where something is grave."""
    run = spoilt(RIGHT, "dvl", velocity=[1.0, -1.0, -1.0] * RIGHT.dvl.velocity)
    run = replace(run, notes={"log.warnings": unplaced("dvl", "x", has_tree=True)})
    found = check_sensors(run)
    assert found[0].quantity == "mountings"
    harmless = [finding for finding in found if not finding.grave]
    assert not list(sensor_check.unplaced_findings(run, harmless))


@pytest.mark.parametrize(
    ("by_drive", "by_heading", "expected"),
    [(-0.008, 0.0, 0.0), (0.0, 0.05, 0.0), (0.02, 0.05, 0.02), (0.011, 0.01, 0.0102)],
)
def test_a_bias_that_the_calibration_has_outranks_one_that_it_has_not(
    by_drive, by_heading, expected
):
    """By the drive in a circle with gaps, or by a compass that drifts; where both have one that it has not, the drive's."""
    none = Estimate1D(0.0, 1e-4)
    drive = (none, none, Estimate1D(by_drive, 1e-3))
    heading = Estimate1D(by_heading, 5e-4)
    up = np.array([0.0, 0.0, 1.0])
    *_, z = sensor_check.with_vertical(drive, heading, up, allowed=1e-4)
    assert z.value == pytest.approx(expected, abs=1e-4)


def test_imu_stamps_of_a_wrong_clock_have_one_line():
    """All other sensors look late, each by another time."""
    stamps_ns = RIGHT.imu.stamps_ns
    ahead_ns = (0.03 * (stamps_ns - stamps_ns[0])).astype(np.int64)
    fast = spoilt(RIGHT, "imu", stamps_ns=stamps_ns + ahead_ns)
    note = {"log.stamps": "imu: stamps and recording drift apart by 2 s: a clock"}
    first, *others = acting(replace(fast, notes=note))
    assert '`stamp = "log"` under [imu]' in first.line
    assert not any("stamp_offset_s" in other.line for other in others)


def test_a_vehicle_that_begins_to_turn_is_not_wild_and_a_single_row_is():
    """Rows of A-KIT 1, a second apart, where the vehicle begins to turn."""
    ahead = [2.257, 2.27, 2.244, 1.963, 1.773, 1.643, 1.58]
    aside = [0.07, 0.101, 0.265, 0.837, 0.718, 0.585, 0.492]
    up = [0.018, 0.004, 0.0, -0.098, -0.005, 0.044, 0.018]
    turning = np.column_stack([ahead, aside, up])
    wild = turning.copy()
    wild[4] += [0.0, -1.5, 0.4]
    steady = np.full((20, 3), [0.5, 0.05, -0.1])
    steady[8:10] = [[0.6, -1.9, 1.7], [-2.2, 0.3, -1.5]]
    steady[-1] = [0.75, 0.17, 2.0]
    for velocity, rows in ((turning, []), (steady, [8, 9, 19]), (wild, [4])):
        assert np.flatnonzero(are_wild(velocity, 0.01)).tolist() == rows


@pytest.mark.parametrize("sense", [(1, 1, 1), (1, 1, -1), (1, -1, -1)])
def test_a_slow_log_that_is_upside_down_is_named_by_the_depths(sense):
    """A velocity a second of a vehicle that dives: accelerations show that it is wrong, depths in which sense."""
    t = np.arange(0.0, 60.0, 0.02)
    climb_m_s = 0.7 * np.sin(2 * np.pi * t / 35.0)
    level_m_s = [0.05 + 0.02 * np.sin(0.2 * t), 0.02 * np.sin(0.15 * t + 1.0)]
    velocity = np.column_stack([*level_m_s, climb_m_s])
    run = level_vehicle(velocity, 0.1 * np.sin(0.12 * t), 0, every=5)
    noise_m = 0.005 * np.random.default_rng(1).standard_normal(len(t) // 10)
    run = with_depth(run, (np.cumsum(climb_m_s) * 0.02 - 20.0)[::10] + noise_m, 1e-4)
    found = grave(spoilt(run, "dvl", velocity=run.dvl.velocity * sense))
    assert names(found) == ["DVL axes"] * (sense != (1, 1, 1))
    # it hardly moves sideways, so that both fit
    assert all('`rotation = ["x", "y", "-z"]`' in one.line for one in found)
    assert all("`dvl.mounting.rpy_rad = [3.1416" in one.line for one in found)
