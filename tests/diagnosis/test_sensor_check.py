"""Truth from the simulator: known faults are named with the line that puts them right, and that line does."""

import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.diagnosis import Finding, sensor_check
from sonar_graph.diagnosis.findings import Gravity
from sonar_graph.diagnosis.start import StartTilt, find_start_tilt
from sonar_graph.diagnosis.units import coarse_findings, range_changes, wrong_units
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.logs.vehicle_setup import unplaced
from sonar_graph.measurements import Dvl, Floats, Heading, Imu
from sonar_graph.navigation.alignment import DvlMatch, Estimate1D, InitialTilt
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.states import Trajectory

RIGHT = simulate_mission(MissionOptions(seed=4, duration_s=240, landmarks=1))
SHORT = simulate_mission(MissionOptions(seed=4, duration_s=120, landmarks=1))
OFFSET_S = 0.4
YAW_RAD = np.radians(5)
SCALE = 1.04
FAR_M = (0.9, 0.0, -0.7)
"""Where a calibration has the IMU that is at the origin; the Doppler log is at (-0.2, 0, -0.15) from it."""


def with_rows(rate: Floats, force: Floats, velocity: Floats) -> Sequence:
    """The mission with other rows: the IMU at 100 Hz, the Doppler log at 5 Hz."""
    imu = Imu(
        np.arange(len(rate)) * 10_000_000, rate, force + np.array([0, 0, 9.80665])
    )
    dvl = Dvl(
        np.arange(len(velocity)) * 200_000_000,
        velocity,
        np.full((len(velocity), 3, 3), np.nan),
    )
    return replace(RIGHT, imu=imu, dvl=dvl, truth=None)


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
    return by_name(sensor_check.check_sensors(spoilt()))


def with_mounting(run: Sequence, sensor: str, **change: tuple[float, ...]) -> Sequence:
    section = getattr(run.calibration, sensor)
    moved = section.model_copy(
        update={"mounting": section.mounting.model_copy(update=change)}
    )
    return replace(run, calibration=run.calibration.model_copy(update={sensor: moved}))


def start_of(run: Sequence, reference: Trajectory) -> tuple[float, float, float]:
    """Roll, pitch and yaw at the start."""
    yaw, pitch, roll = (
        reference.at(np.array([run.start_ns])).rotations().as_euler("ZYX")[0].tolist()
    )
    return roll, pitch, yaw


def started_at(run: Sequence, *rpy_rad: float) -> Sequence:
    start = run.calibration.start.model_copy(update={"rpy_rad": rpy_rad})
    return replace(run, calibration=run.calibration.model_copy(update={"start": start}))


def line_of(finding: Finding) -> dict[str, Any]:
    return tomllib.loads(finding.advice.split("`")[1])


def corrected(run: Sequence, found: dict[str, Finding]) -> Sequence:
    """The Doppler log as the advice's own lines make it."""
    lines = {
        name: line_of(finding)
        for name, finding in found.items()
        if finding.acts and "`" in finding.advice
    }
    shift_s = lines["DVL against IMU: time offset"]["stamp_offset_s"]
    scale = lines["DVL scale"]["scale"]
    rpy = tuple(lines["DVL mounting yaw"]["dvl"]["mounting"]["rpy_rad"])
    place = tuple(
        lines["lever arm from IMU to DVL, x"]["imu"]["mounting"]["translation_m"]
    )
    dvl = run.dvl
    moved = Dvl(
        dvl.stamps_ns + round(shift_s * 1e9), dvl.velocity * scale, dvl.velocity_cov
    )
    return with_mounting(
        with_mounting(replace(run, dvl=moved), "dvl", rpy_rad=rpy),
        "imu",
        translation_m=place,
    )


@pytest.mark.slow
def test_the_advised_lines_put_the_log_right(found_in_spoilt: dict[str, Finding]):
    found = found_in_spoilt
    again = by_name(sensor_check.check_sensors(corrected(spoilt(), found)))
    for name in ("DVL against IMU: time offset", "DVL mounting yaw", "DVL scale"):
        assert found[name].acts, name
        assert not again[name].acts, again[name].text()
        assert again[name].advice == "no need to act"
    names = sorted(name for name in found if name.startswith("lever arm"))  # x, y, z
    arms = [found[name] for name in names]
    assert [arm.acts for arm in arms] == [True, False, True]
    for (
        finding
    ) in found.values():  # each line to change with the option that takes the file
        if "`" in finding.advice:
            assert " FILE)" in finding.advice or "`--start`" in finding.advice, (
                finding.advice
            )
    assert not any(again[arm.quantity].acts for arm in arms)


def test_the_start_is_aligned_with_what_was_found_before(
    found_in_spoilt: dict[str, Finding],
):
    """With stamps half a second off, velocities and accelerations differ too much for an alignment."""
    for name, angle in zip(
        ("roll", "pitch"), np.degrees(start_of(RIGHT, RIGHT.truth)[:2]), strict=True
    ):
        assert found_in_spoilt[f"start {name}: value"].estimate.value == pytest.approx(
            angle, abs=0.1
        )
    assert find_start_tilt(spoilt()).tilt is None


def test_corrections_add_to_those_of_the_configuration():
    config = LogConfig.parse({"dvl": {"stamp_offset_s": -0.1, "scale": 2.0}}, "x")
    found = by_name(sensor_check.check_sensors(spoilt(), config))
    offset, scale = (
        line_of(found[name]) for name in ("DVL against IMU: time offset", "DVL scale")
    )
    assert offset["stamp_offset_s"] == pytest.approx(OFFSET_S - 0.1, abs=0.15)
    assert scale["scale"] == pytest.approx(2 * SCALE, abs=0.05)
    dvl = RIGHT.dvl
    in_mm = replace(
        RIGHT, dvl=Dvl(dvl.stamps_ns, dvl.velocity * 1000.0, dvl.velocity_cov)
    )
    (finding,) = sensor_check.check_sensors(in_mm, config)
    assert (finding.quantity, finding.acts, line_of(finding)) == (
        "DVL: unit",
        True,
        {"scale": 0.002},
    )


def test_a_start_taken_from_a_late_reference_is_named_with_the_right_one():
    """The vehicle turns at the start: half a second late is some degrees off."""
    late = replace(SHORT.truth, stamps_ns=SHORT.truth.stamps_ns + 500_000_000)
    is_left = SHORT.imu.stamps_ns >= SHORT.start_ns + 20_000_000_000
    turning = replace(SHORT, truth=late, imu=SHORT.imu.rows(is_left))
    for reference, acts in ((late, True), (SHORT.truth, False)):
        run = started_at(turning, *start_of(turning, reference))
        finding = by_name(sensor_check.check_sensors(run))["start heading: error"]
        assert finding.acts == acts, finding.text()
        assert (
            "(--calibration FILE); the position too is the reference's"
            in finding.advice
        ) == acts


def test_lines_for_the_start_agree_on_roll_pitch_and_heading():
    roll, pitch, yaw = start_of(SHORT, SHORT.truth)
    found = by_name(
        sensor_check.check_sensors(started_at(SHORT, roll + 0.1, pitch, yaw + 0.2))
    )
    ours, theirs = (
        line_of(found[name])["start"]
        for name in ("start roll: value", "start heading: error")
    )
    assert (
        ours["rpy_rad"]
        == theirs["rpy_rad"]
        == pytest.approx([roll, pitch, yaw], abs=2e-3)
    )


def test_a_start_heading_within_its_own_sigma_is_not_wrong():
    roll, pitch, yaw = start_of(SHORT, SHORT.truth)
    run = started_at(SHORT, roll, pitch, yaw + 0.1)
    start = run.calibration.start
    for sigma_rad, acts in ((0.001, True), (0.1, False)):
        sigmas = (*start.rpy_sigma_rad[:2], sigma_rad)
        loose = start.model_copy(update={"rpy_sigma_rad": sigmas})
        calibration = run.calibration.model_copy(update={"start": loose})
        found = by_name(
            sensor_check.check_sensors(replace(run, calibration=calibration))
        )
        assert found["start heading: error"].acts == acts


def test_a_number_that_cannot_be_told_asks_for_nothing():
    short = replace(
        RIGHT,
        imu=RIGHT.imu.rows(slice(0, 150)),
        dvl=RIGHT.dvl.rows(slice(0, 9)),
        truth=None,
    )
    for finding in sensor_check.check_sensors(short):
        assert not finding.acts
        # a second of gravity is enough for this one
        if finding.quantity != "accelerometer scale":
            assert finding.text().startswith("cannot be told: ")
            assert finding.plain()["value"] is None


@pytest.mark.slow
@pytest.mark.parametrize("hole_s", [2.0, 5.0])
def test_a_hole_of_the_imu_asks_for_nothing(
    hole_s: float, monkeypatch: pytest.MonkeyPatch
):
    """Drawn straight across, 5 s of manoeuvres make a wrong offset of the reference."""
    t = (RIGHT.imu.stamps_ns - RIGHT.imu.stamps_ns[0]) * 1e-9
    run = replace(RIGHT, imu=RIGHT.imu.rows((t <= 100.0) | (t >= 100.0 + hole_s)))
    found = by_name(sensor_check.check_sensors(run))
    assert [finding.text() for finding in found.values() if finding.acts] == []
    assert found["DVL scale"].estimate.is_known
    assert found["reference against IMU: time offset"].estimate.is_known
    monkeypatch.setattr(
        "sonar_graph.navigation.alignment.dvl_imu.holes_before", np.zeros_like
    )
    blind = by_name(sensor_check.check_sensors(run))
    assert blind["reference against IMU: time offset"].acts == (hole_s > 2.0)


@pytest.mark.parametrize(
    ("speed_m_s", "is_told"), [(0.0, True), (0.05, True), (0.8, False)]
)
def test_a_steady_drive_is_no_rest_to_tell_noise_from(speed_m_s: float, is_told: bool):
    rng = np.random.default_rng(0)
    n = 5000
    force = 0.05 * rng.standard_normal((n, 3))
    rate = 0.01 * rng.standard_normal((n, 3))
    velocity = [speed_m_s, 0, 0] + 0.01 * rng.standard_normal((250, 3))
    found = by_name(sensor_check.check_sensors(with_rows(rate, force, velocity)))
    for name in ("gyro noise density", "accelerometer noise density"):
        assert found[name].estimate.is_known == found[name].acts == is_told
        assert is_told or "steady, but at 0.8 m/s" in found[name].text()


def told(
    *values: float, sigma: float = 1e-3
) -> tuple[Estimate1D, Estimate1D, Estimate1D]:
    x, y, z = (Estimate1D(value, sigma) for value in values)
    return x, y, z


@pytest.mark.parametrize("acts", [True, False])
def test_what_is_corrected_before_the_start_is_what_the_rows_advise(acts: bool):
    offset, yaw, scale = (0.4, 0.05, 1.04) if acts else (0.008, 0.002, 1.001)
    match = DvlMatch(
        offset=Estimate1D(offset, 1e-5),
        turn=told(0.0, 0.0, yaw, sigma=1e-5),
        scale=Estimate1D(scale, 1e-5),
        lever=told(-0.2, 0.0, -0.15),
        accel_bias=told(0.0, 0.0, 0.0),
        gyro_bias=told(0.0, 0.0, 0.0, sigma=1e-6),
    )
    turned = with_mounting(RIGHT, "dvl", rpy_rad=(0.3, 0.1, 0.2))
    rows = list(sensor_check.dvl_findings(match, turned, LogConfig()))
    assert [row.acts for row in rows] == [acts] * 3
    assert rows[0].estimate.sigma == pytest.approx(0.01 / np.sqrt(12), rel=1e-3), (
        "that of a sample's instant"
    )
    right = sensor_check.corrected_sequence(turned, match, rows)
    assert right.dvl.stamps_ns - RIGHT.dvl.stamps_ns == pytest.approx(
        400_000_000 if acts else 0
    )
    assert right.dvl.velocity == pytest.approx(
        RIGHT.dvl.velocity * (1.04 if acts else 1.0)
    )
    assert right.calibration.dvl.mounting.rpy_rad == pytest.approx(
        (0.3, 0.1, 0.25 if acts else 0.2)
    )


def test_the_bias_of_smaller_sigma_wins_axis_by_axis():
    unknown = Estimate1D(np.nan, np.inf, "too little turning")
    nothing = told(0.0, 0.0, 0.0)
    x, y, _ = told(1.0, 2.0, 3.0, sigma=1e-4)
    drive = DvlMatch(
        unknown,
        unknown,
        unknown,
        nothing,
        nothing,
        (x, replace(y, sigma=1e-2), unknown),
    )
    sigmas = np.array([1.0, 1.0, 1e-3, 1e-3, 1e-3])
    rest = InitialTilt(
        0,
        0.0,
        0.0,
        np.array([10.0, 20.0, 30.0]),
        np.diag(sigmas**2),
        np.ones(3, dtype=np.bool_),
    )
    bias, sources = sensor_check.surest_bias(
        drive, StartTilt(rest, "from 20 s of rest", is_rest=True)
    )
    assert [one.value for one in bias] == [1.0, 20.0, 30.0]
    # a bias that changed is one row with both numbers
    assert sources == (
        "from the turns of the drive (from 20 s of rest 10 ± 0.002 rad/s)",
        "from 20 s of rest (from the turns of the drive 2 ± 0.02 rad/s)",
        "from 20 s of rest",
    )
    moving, sources = sensor_check.surest_bias(
        drive, StartTilt(rest, "from 60 s in motion")
    )
    assert moving == drive.gyro_bias
    assert set(sources) == {"from the turns of the drive"}


N = 100
ALONG = np.array([2.0, -1.0, 2.0]) / 3.0


def vectors(length: float | Floats) -> Floats:
    """All in one direction, along none of the axes."""
    return np.broadcast_to(length, N)[:, None] * ALONG


def units(
    speed: float | Floats = 1.0, turn: float | Floats = 0.1, force: float | Floats = 9.8, gravity: float = 9.80665,
    **scales: dict[str, float],
) -> list[Finding]:  # fmt: skip
    """Wrong units of readings so long; a force may be rows."""
    stamps_ns = np.arange(N) * 10_000_000
    forces = force if np.ndim(force) == 2 else vectors(force)
    imu = Imu(stamps_ns, vectors(turn), forces)
    dvl = Dvl(stamps_ns, vectors(speed), np.full((N, 3, 3), np.nan))
    sequence = Sequence("hand", Calibration(gravity_m_s2=gravity), imu, dvl)
    return wrong_units(sequence, LogConfig.parse(scales, "x"))


# fmt: off
SPEEDS = [
    (20.1, "cm/s", 100, 0.01), (299.0, "cm/s", 100, 0.01), (301.0, "mm/s", 1000, 0.001), (2900.0, "mm/s", 1000, 0.001),
    (9e5, "mm/s", 1000, 0.001),  # no unit makes it slow: the smallest
]
# fmt: on


@pytest.mark.parametrize(("speed", "unit", "times", "scale"), SPEEDS)
def test_the_unit_of_a_speed_over_twenty_is_found(speed, unit, times, scale):
    (fault,) = units(speed=speed)
    assert fault.quantity == "DVL: unit"
    assert fault.advice.startswith(
        f"velocities look {times} times too large (up to {speed:.3g} m/s): {unit}? "
    )
    assert line_of(fault) == pytest.approx({"scale": scale})
    assert ("mm/s if the vehicle moves at" in fault.advice) == (unit == "cm/s")


SLOW = simulate_mission(
    MissionOptions(seed=5, duration_s=60.0, frame_rate_hz=2.0, speed_m_s=0.1)
)


def test_ranges_decide_no_unit_with_wrong_axes_outliers_or_few_landmarks():
    rng = np.random.default_rng(0)
    velocity = SLOW.dvl.velocity
    spikes = velocity + 8.0 * (rng.random((len(velocity), 1)) < 0.2)
    for wrong in (velocity[:, [1, 2, 0]], -velocity, spikes):
        run = replace(SLOW, dvl=replace(SLOW.dvl, velocity=wrong))
        assert not wrong_units(run, LogConfig())
    astern = replace(SLOW, dvl=replace(SLOW.dvl, velocity=-100.0 * velocity))
    assert wrong_units(astern, LogConfig())
    sonar = SLOW.calibration.sonar.model_copy(update={"range_sigma_m": 0.05})
    coarse = replace(SLOW.detections, range_m=np.full(len(SLOW.detections), 2.0))
    calibration = SLOW.calibration.model_copy(update={"sonar": sonar})
    assert not wrong_units(
        replace(SLOW, detections=coarse, calibration=calibration), LogConfig()
    )
    few = SLOW.detections.rows(slice(0, 15))
    far = replace(SLOW.dvl, velocity=100.0 * velocity)
    assert range_changes(replace(SLOW, detections=few)) is None
    assert not wrong_units(replace(SLOW, detections=few, dvl=far), LogConfig())
    assert not wrong_units(replace(SLOW, detections=None, dvl=far), LogConfig())


def test_usual_readings_raise_no_doubt_about_units():
    """0.78 g are within a fifth of 9.1 m/s². Shocks move a mean, not a median."""
    assert not units(speed=19.9, turn=1.99, force=9.0)
    for force in (0.78, 1.22, 0.0, 1.5, 3.7, 300.0, 1e6):
        assert not units(force=force), "gravity in no unit"
    (fault,) = units(force=0.78, gravity=9.1)
    assert "instead of 9.1 m/s²: g?" in fault.advice
    (fault,) = units(force=np.where(np.arange(N) < 40, 20.0, 1.0))
    assert "typically 1 instead" in fault.advice
    (fault,) = units(turn=2.1)
    assert fault.advice.startswith(
        "rates look 57 times too large (up to 2.1 rad/s): degrees a second? "
    )


def test_slow_rates_in_degrees_are_told_by_gravity():
    """They tilt the vehicle 57 times farther than gravity turns in the accelerometers; radians, by as much.

    A constant bias tilts nothing. Without accelerometers there is no finding.
    """
    imu = RIGHT.imu
    for turn, acts in ((np.degrees(1.0), True), (1.0, False)):
        rates = imu.angular_velocity * turn
        assert np.percentile(np.linalg.norm(rates, axis=1), 95) < 10.0
        slow = replace(
            RIGHT,
            imu=replace(imu, angular_velocity=rates * [1, 1, 0] + [0.5, -0.5, 0.0]),
        )
        faults = wrong_units(slow, LogConfig())
        assert [fault.quantity for fault in faults] == ["gyro: unit"] * acts
        unmeasured = replace(
            slow.imu, specific_force=np.full_like(imu.specific_force, np.nan)
        )
        assert not wrong_units(replace(slow, imu=unmeasured), LogConfig())
        if acts:
            assert line_of(faults[0]) == pytest.approx(
                {"angular_velocity_scale": np.pi / 180}, rel=1e-4
            )
            assert "they tilt the vehicle by" in faults[0].advice


def test_readings_that_never_change_have_no_noise_to_be_told():
    """A density of zero would be believed; one changed digit is noise again."""
    commanded = with_rows(
        np.zeros((6000, 3)),
        0.01 * np.random.default_rng(1).standard_normal((6000, 3)),
        np.zeros((300, 3)),
    )
    gyro = by_name(list(sensor_check.noise_findings(commanded)))["gyro noise density"]
    assert not gyro.acts
    assert gyro.text().startswith(
        "cannot be told: the same to the last bit while still"
    )
    changed = np.zeros((6000, 3))
    changed[::7] = 1e-4
    moved = with_rows(changed, np.zeros((6000, 3)), np.zeros((300, 3)))
    assert by_name(list(sensor_check.noise_findings(moved)))[
        "gyro noise density"
    ].estimate.is_known


@pytest.mark.parametrize("sensor", ["imu", "dvl"])
def test_a_delay_that_all_others_share_is_that_of_the_imu(sensor: str) -> None:
    """With the Doppler log late alone, the other sensors agree with the IMU, and the line is the log's."""
    rows = getattr(RIGHT, sensor)
    late = replace(rows, stamps_ns=rows.stamps_ns + 500_000_000)
    found = by_name(sensor_check.check_sensors(replace(RIGHT, **{sensor: late})))
    offset = found["DVL against IMU: time offset"]
    assert offset.acts
    assert f"under [{sensor}]" in offset.advice
    assert line_of(offset)["stamp_offset_s"] == pytest.approx(-0.5, abs=0.05)
    assert not any(
        finding.acts for name, finding in found.items() if name.endswith(": delay")
    )


@pytest.mark.parametrize(("off_rad", "is_grave"), [(0.1, False), (3.0, True)])
def test_a_start_on_its_back_makes_results_doubtful(off_rad, is_grave):
    roll, pitch, yaw = SHORT.calibration.start.rpy_rad
    found = {
        finding.quantity: finding
        for finding in sensor_check.check_sensors(
            started_at(SHORT, roll + off_rad, pitch, yaw)
        )
    }
    row = found["start roll: value"]
    assert row.acts
    assert (row.gravity is Gravity.GRAVE) == is_grave


def test_of_forces_without_gravity_nothing_else_is_blamed() -> None:
    """Neither a bias of the gyros nor depth, heading or fixes."""
    up = SHORT.truth.at(SHORT.imu.stamps_ns).rotations().as_matrix()[:, 2, :]
    force = SHORT.imu.specific_force - 9.80665 * up
    imu = replace(SHORT.imu, specific_force=force)
    found = sensor_check.check_sensors(replace(SHORT, imu=imu))
    assert [finding.quantity for finding in found if finding.acts] == []


def test_a_drifting_heading_is_a_fault_of_the_heading() -> None:
    bias_rad_s = np.array([0.002, -0.001, 0.003])
    drift_rad_s = 0.05
    imu = SHORT.imu
    truth = SHORT.truth
    biased = replace(imu, angular_velocity=imu.angular_velocity + bias_rad_s)
    stamps_ns = truth.stamps_ns[::10]
    yaw_rad = np.unwrap(truth.rotations().as_euler("ZYX")[::10, 0])
    yaw_rad -= drift_rad_s * (stamps_ns - stamps_ns[0]) * 1e-9
    noise_rad = 0.01 * np.random.default_rng(0).standard_normal(len(yaw_rad))
    heading = Heading(stamps_ns, yaw_rad + noise_rad, np.full(len(yaw_rad), np.nan))
    run = replace(SHORT, imu=biased, heading=heading, truth=None)
    acting = [found for found in sensor_check.check_sensors(run) if found.acts]
    (drift,) = (found for found in acting if found.quantity == "heading: drift")
    assert drift.estimate.value == pytest.approx(-drift_rad_s, abs=0.003)
    assert "`use = false` under [heading]" in drift.line
    (line,) = (found.line for found in acting if "gyro_bias_rad_s" in found.line)
    stated = tomllib.loads(line.split("`")[1])["imu"]["gyro_bias_rad_s"]
    assert stated == pytest.approx(bias_rad_s, abs=1e-3)


@pytest.mark.parametrize("sensor", ["DVL", "gyro", "depth", "none"])
def test_values_in_steps_far_above_their_noise_are_named_alone(sensor: str) -> None:
    run = RIGHT
    if sensor == "DVL":
        step = 12.0 * max(run.calibration.dvl.velocity_sigma_m_s)
        wave = 1.0 + 0.5 * np.sin(np.arange(len(run.dvl)) / 50.0)
        velocity = step * np.trunc(run.dvl.velocity * wave[:, None] / step)
        run = replace(run, dvl=replace(run.dvl, velocity=velocity))
    elif sensor == "gyro":
        rate = np.trunc(20.0 * run.imu.angular_velocity) / 20.0
        run = replace(run, imu=replace(run.imu, angular_velocity=rate))
    elif sensor == "depth":
        assert run.depth is not None
        step = 12.0 * run.calibration.depth.sigma_m
        z_m = step * np.trunc(run.depth.z_m / step)
        run = replace(run, depth=replace(run.depth, z_m=z_m))
    found = [f.quantity for f in coarse_findings(run)]
    assert found == ([] if sensor == "none" else [f"{sensor}: resolution"])


@pytest.mark.parametrize("is_wrong", [True, False])
@pytest.mark.parametrize("is_placed", [True, False])
def test_a_mounting_that_is_not_known_is_named_before_what_may_follow_from_it(
    is_wrong: bool, is_placed: bool
) -> None:
    dvl = SHORT.dvl
    velocity = dvl.velocity * ([1.0, -1.0, -1.0] if is_wrong else 1.0)
    notes = {} if is_placed else {"log.warnings": unplaced("dvl", "x", has_tree=True)}
    run = replace(SHORT, dvl=replace(dvl, velocity=velocity), notes=notes)
    grave = [f.quantity for f in sensor_check.check_sensors(run) if f.grave]
    assert bool(grave) == is_wrong
    assert (grave[:1] == ["mountings"]) == (is_wrong and not is_placed)


@pytest.mark.parametrize("drift", [0.003, 0.03])
def test_imu_stamps_of_a_wrong_clock_have_one_line(drift: float) -> None:
    """All other sensors look late, each by another time."""
    imu = SHORT.imu
    since_ns = imu.stamps_ns - imu.stamps_ns[0]
    fast = replace(imu, stamps_ns=imu.stamps_ns + (drift * since_ns).astype(np.int64))
    note = {"log.stamps": "imu: stamps and recording drift apart by 2 s: a clock"}
    found = sensor_check.check_sensors(replace(SHORT, imu=fast, notes=note))
    first, *others = [f for f in found if f.acts]
    assert '`stamp = "log"` under [imu]' in first.line
    assert not any("stamp_offset_s" in f.line for f in others)
