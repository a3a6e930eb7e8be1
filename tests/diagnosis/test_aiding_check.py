"""Headings and position fixes of a simulated vehicle, spoilt by hand: named with the line that puts them right."""

import re
import tomllib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Start
from sonar_graph.diagnosis import Finding, aiding_check, check_sensors
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.units import force_scale
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import Heading, PositionFixes
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission

from .test_sensor_check import RIGHT, line_of, with_mounting

NO_CONFIG = LogConfig()
SLOW = simulate_mission(MissionOptions(seed=5, duration_s=120.0, speed_m_s=0.1))


def heading_findings(run: Sequence, config: LogConfig) -> Iterator[Finding]:
    motion = BodyMotion.of(run)
    match = aiding_check.HEADING.compare(run, motion)
    return aiding_check.heading_findings(match, run, config, motion)


def position_findings(run: Sequence, config: LogConfig) -> Iterator[Finding]:
    motion = BodyMotion.of(run)
    match = aiding_check.POSITIONS.compare(run, motion)
    return aiding_check.position_findings(match, run, config, motion)


def vertical_bias(run: Sequence) -> Finding | None:
    return aiding_check.vertical_bias(run, BodyMotion.of(run))


def compass(run: Sequence, yaw_of) -> Sequence:
    rows = slice(0, len(run.truth), 10)
    yaw_rad = run.truth.rotations().as_euler("ZYX")[rows, 0]
    noise = 0.02 * np.random.default_rng(0).standard_normal(len(yaw_rad))
    return replace(
        run,
        heading=Heading(
            run.truth.stamps_ns[rows],
            yaw_of(yaw_rad) + noise,
            np.full(len(yaw_rad), np.nan),
        ),
    )


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("gyro_bias", [0.0, 0.01])
def test_a_compass_of_the_opposite_sense_is_found(gyro_bias: float, upside_down: bool):
    """Whatever the bias of the gyros, and however the IMU is mounted."""
    imu = replace(
        RIGHT.imu,
        angular_velocity=RIGHT.imu.angular_velocity + np.array([0.0, 0.0, gyro_bias]),
    )
    if upside_down:
        turned = [
            values * [1.0, -1.0, -1.0]
            for values in (imu.angular_velocity, imu.specific_force)
        ]
        imu = replace(imu, angular_velocity=turned[0], specific_force=turned[1])
    run = replace(RIGHT, imu=imu, truth=RIGHT.truth)
    bearing = compass(run, lambda yaw_rad: np.pi / 2 - yaw_rad)
    for given, config, world in (
        (bearing, {}, "ned"),
        (bearing, {"heading": {"world": "ned"}}, "enu"),
    ):
        finding, *_ = heading_findings(given, LogConfig.parse(config, "x"))
        assert finding.acts
        assert "turns against the gyros, clockwise" in finding.advice
        assert line_of(finding) == {"world": world}
        assert finding.estimate.value == pytest.approx(-1.0, abs=0.1)
    sense, *_ = heading_findings(
        compass(run, lambda yaw_rad: yaw_rad + 0.01), NO_CONFIG
    )
    assert not sense.acts
    assert sense.estimate.value == pytest.approx(1.0, abs=0.1)
    stuck, *_ = heading_findings(compass(run, lambda yaw_rad: 0 * yaw_rad), NO_CONFIG)
    assert stuck.acts
    assert "it hardly turns where the gyros do" in stuck.text()


def fixed(
    run: Sequence, scale=1.0, origin=(0.0, 0.0, 0.0), sigma_m=0.0, every_s=1.0
) -> Sequence:
    """Fixes by satellites of the true position, in another unit and from another origin, with noise."""
    t = np.arange(run.truth.stamps_ns[0], run.truth.stamps_ns[-1], round(every_s * 1e9))
    noise = sigma_m * np.random.default_rng(1).standard_normal((len(t), 3))
    places = scale * (run.truth.at(t).positions + noise) + origin
    return replace(
        run, positions=PositionFixes(t, places, np.full((len(t), 3, 3), np.nan))
    )


UNITS = [
    (1e3, {"scale": 1e-3}),
    (1e2, {"scale": 1e-2}),
    (1e-3, {"scale": 1e3}),
    (1 / 1.1e5, "degrees? `geodetic`, with the fields of latitude and longitude"),
    (0.5144, "knots of the Doppler log or fathoms? `scale = 0.5144` under [dvl]"),
    (1.0, None),
]


@pytest.mark.parametrize(("scale", "line"), UNITS)
def test_fixes_in_another_unit_are_named_by_what_the_doppler_log_moves(scale, line):
    finding, *others = position_findings(fixed(RIGHT, scale), NO_CONFIG)
    assert finding.acts == (line is not None)
    assert not any(other.acts for other in others)
    if isinstance(line, dict):
        assert line_of(finding) == pytest.approx(line)
    elif line:
        assert line in finding.advice


@pytest.mark.parametrize("rows", [3, 10])
def test_a_doppler_log_of_one_row_or_a_few_tells_nothing_of_fixes(rows: int):
    finding, *_ = position_findings(
        fixed(replace(RIGHT, dvl=RIGHT.dvl.rows(slice(rows)))), NO_CONFIG
    )
    assert finding.text().startswith("cannot be told: too few")


def test_fixes_in_a_map_grid_are_found_with_their_origin():
    grid = np.array([500_000.0, 4_670_000.0, 0.0])
    config = LogConfig.parse({"positions": {"origin_m": [1.0, 2.0, 3.0]}}, "x")
    *_, finding = position_findings(fixed(RIGHT, origin=grid), config)
    assert finding.acts
    assert "from the start, beyond their noise" in finding.advice
    assert line_of(finding)["origin_m"] == pytest.approx(
        np.add(grid, (1, 2, 3)), abs=2.0
    )
    started = RIGHT.calibration.start.model_copy(update={"position_m": tuple(grid)})
    begun = replace(
        RIGHT, calibration=RIGHT.calibration.model_copy(update={"start": started})
    )
    *_, finding = position_findings(fixed(begun, origin=grid), config)
    assert "from the origin of the world, beyond their noise" in finding.advice
    few = fixed(RIGHT, every_s=1000.0)
    assert [one.text() for one in position_findings(few, config)] == [
        "cannot be told: too few rows beside its reference"
    ]


@pytest.mark.parametrize("every_s", [0.1, 1.0, 30.0])
def test_fixes_faster_than_any_vehicle_are_found_and_outliers_are_not(
    every_s: float,
):
    good = fixed(SLOW if every_s < 30 else RIGHT, sigma_m=2.5, every_s=every_s)
    places = good.positions.position_m
    yaw_deg = np.degrees(
        np.interp(good.positions.stamps_ns, good.truth.stamps_ns, yaw_of(good))
    )
    angles = np.column_stack([0 * yaw_deg, 0 * yaw_deg, 10 * yaw_deg])
    spikes = places + 500.0 * (np.arange(len(places)) % 20 == 3)[:, None]
    for wrong, is_named in ((places, False), (spikes, False), (angles, True)):
        given = replace(good, positions=replace(good.positions, position_m=wrong))
        found = [f.quantity for f in position_findings(given, NO_CONFIG) if f.acts]
        assert ("position fixes: jumps" in found) == is_named, (found, every_s)
    # the last one, by the whole comparison
    assert [f.quantity for f in check_sensors(given) if "jumps" in f.quantity] == found


def yaw_of(run: Sequence) -> np.ndarray:
    return np.unwrap(run.truth.rotations().as_euler("ZYX")[:, 0])


@pytest.mark.parametrize("places", ["fixes", "true positions", "neither"])
def test_a_heading_with_an_offset_is_found_from_positions(
    places: str,
):
    """A Doppler log that is turned on the body is no turn of the heading."""
    truth = RIGHT.truth
    off_rad = 0.4
    rows = slice(0, len(truth), max(1, len(truth) // 1000))
    yaw_rad = truth.rotations().as_euler("ZYX")[rows, 0]
    stamps_ns = truth.stamps_ns[rows]
    positions = truth.positions[rows]
    fixes = PositionFixes(stamps_ns, positions, np.full((len(positions), 3, 3), np.nan))
    velocity = Rotation.from_euler("z", -0.7).apply(RIGHT.dvl.velocity)
    run = with_mounting(
        replace(RIGHT, dvl=replace(RIGHT.dvl, velocity=velocity)),
        "dvl",
        rpy_rad=(0.0, 0.0, 0.7),
    )
    run = replace(
        run,
        truth=truth if places == "true positions" else None,
        positions=fixes if places == "fixes" else None,
    )
    for said, before in (
        (yaw_rad + off_rad, 0.0),
        (yaw_rad + off_rad, 0.1),
        (yaw_rad, 0.0),
    ):
        run = replace(run, heading=Heading(stamps_ns, said, np.full(len(said), np.nan)))
        config = LogConfig.parse({"heading": {"yaw_offset_rad": before}}, "x")
        found = list(heading_findings(run, config))
        sense, lag, *found = found
        assert not sense.acts
        assert not lag.acts
        if places == "neither":
            assert not found
            continue
        (finding,) = found
        wrong = said[0] != yaw_rad[0]
        assert finding.estimate.value == pytest.approx(
            np.degrees(-off_rad * wrong), abs=2.0
        )
        assert finding.acts == wrong
        if wrong:
            assert line_of(finding) == pytest.approx(
                {"yaw_offset_rad": before - off_rad}, abs=0.04
            )
            cure = tomllib.loads(finding.advice.split("`")[3])["dvl"]["mounting"][
                "rpy_rad"
            ]
            assert cure == pytest.approx([0.0, 0.0, 0.7 - off_rad], abs=0.04)
            turned = with_mounting(run, "dvl", rpy_rad=cure)
            assert not [f for f in heading_findings(turned, config) if f.acts]
            assert finding.quantity in [
                f.quantity for f in check_sensors(run, config) if f.acts
            ]
    still = replace(run, dvl=replace(run.dvl, velocity=0 * velocity))
    assert not any(
        f.estimate.is_known for f in list(heading_findings(still, LogConfig()))[2:]
    )


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("reference", ["heading", "truth"])
def test_a_constant_bias_of_the_gyros_is_found_and_its_line_takes_it_away(
    reference: str, upside_down: bool
):
    """0.67 degrees a second about the vertical, however the IMU sits."""
    given = compass(RIGHT, lambda yaw_rad: yaw_rad) if reference == "heading" else RIGHT
    right = vertical_bias(given)
    assert right is not None
    assert not right.acts
    turn = np.array([1.0, -1.0, -1.0]) if upside_down else np.ones(3)
    rate = RIGHT.imu.angular_velocity + np.array([0.0, 0.0, np.radians(0.67)])
    imu = replace(
        RIGHT.imu,
        angular_velocity=rate * turn,
        specific_force=RIGHT.imu.specific_force * turn,
    )
    biased = replace(given, imu=imu)
    found = vertical_bias(biased)
    assert found is not None
    assert found.acts
    assert found.estimate.value == pytest.approx(
        np.radians(0.67), abs=4 * found.estimate.sigma
    )
    # of an IMU on its back the axes come first
    of_bias = [f for f in check_sensors(biased) if "gyro bias" in f.quantity and f.acts]
    assert bool(of_bias) == (not upside_down)
    (line,) = re.findall(r"`(imu\.gyro_bias_rad_s = \[.*?\])`", found.text())
    assert re.search(r"0\.6[67]\d?°/s beyond", found.text())
    known = tomllib.loads(line)["imu"]["gyro_bias_rad_s"]
    section = biased.calibration.imu.model_copy(
        update={"gyro_bias_rad_s": tuple(known)}
    )
    mended = replace(
        biased, calibration=biased.calibration.model_copy(update={"imu": section})
    )
    again = vertical_bias(mended)
    assert again is not None
    assert not again.acts


@pytest.mark.parametrize(
    ("z_m", "stated", "is_told"),
    [
        (-3.0, -3.0, False),
        (-3.4, -3.0, False),
        (-4.5, -3.0, True),
        (3.0, -3.0, True),
        (-3000.0, -3.0, True),
        (-50.0, None, False),
        (0.5, None, False),
        (1.5, None, True),
        (7.7, None, True),
    ],
)
def test_heights_that_do_not_begin_at_the_stated_start_or_under_water_are_told(
    z_m: float, stated: float | None, is_told: bool
):
    start = Start() if stated is None else Start(position_m=(5.0, 5.0, stated))
    offset_m = z_m - float(RIGHT.depth.z_m[:5].mean())
    depth = replace(RIGHT.depth, z_m=RIGHT.depth.z_m + offset_m)
    calibration = RIGHT.calibration.model_copy(update={"start": start})
    found = list(
        aiding_check.start_depth_findings(
            replace(RIGHT, depth=depth, calibration=calibration)
        )
    )
    assert [finding.acts for finding in found] == [True] * is_told
    # a height that nothing contradicts may be one over the bottom
    assert [finding.grave for finding in found] == [stated is not None] * is_told
    told = "above the water" if stated is None else f"height begins at {z_m:.2f} m"
    assert all(told in finding.advice for finding in found)


def at_no_stated_start(run: Sequence, source: str) -> Sequence:
    start = run.calibration.start.model_copy(update={"source": source})
    return replace(run, calibration=run.calibration.model_copy(update={"start": start}))


@pytest.mark.parametrize(
    ("off_m", "source", "line"),
    [(40.0, "fixes", "use = false"), (40.0, "stated", "origin_m")],
)
def test_depths_and_fixes_of_different_height_are_a_fault(
    off_m: float, source: str, line: str
):
    run = at_no_stated_start(fixed(RIGHT, sigma_m=0.3), source)
    assert run.depth is not None
    run = replace(run, depth=replace(run.depth, z_m=run.depth.z_m - off_m))
    found = list(aiding_check.fix_height_findings(run, NO_CONFIG))
    assert [finding.grave for finding in found] == [True] * bool(line)
    if line:
        assert line in found[0].line
        assert found[0].estimate.value == pytest.approx(off_m, abs=0.2)


@pytest.mark.parametrize(
    ("factor", "line"),
    [
        (1.05, 1 / 1.05),
        (0.9, 1 / 0.9),
        (1.25, 0.8),
        (0.6, 1 / 0.6),
        (1.005, None),
        (3.0, None),
    ],
)
def test_the_scale_of_the_accelerometers_is_that_of_gravity(factor, line):
    """Within half a per cent gravity itself may differ; three times as much is another unit."""
    imu = replace(RIGHT.imu, specific_force=factor * RIGHT.imu.specific_force)
    finding = force_scale(replace(RIGHT, imu=imu), NO_CONFIG)
    assert (finding is None) == (factor == 3.0)
    if line is not None:
        assert finding.acts
        key = line_of(finding)["linear_acceleration_scale"]
        assert key == pytest.approx(line, rel=2e-3)
    elif finding is not None:
        assert not finding.acts


@pytest.mark.parametrize("period_s", [4.0, 8.0])
def test_the_sampling_error_of_a_doppler_log_is_that_of_the_trapezoid(period_s: float):
    """By hand: the integral of a sine over rows a second apart is too small by ``(w T)^2 / 12``."""
    t = np.arange(600.0)
    w = 2 * np.pi / period_s
    height_m = np.append(0.0, np.cumsum((np.sin(w * t[1:]) + np.sin(w * t[:-1])) / 2))
    motion = BodyMotion(
        0,
        t,
        np.zeros(600, int),
        np.tile([0.0, 0, 1], (600, 1)),
        0 * t,
        height_m,
        0j * t,
        0 * t,
    )
    expected = (2 * np.sin(w / 2)) ** 2 / 12
    assert motion.sampling_error(height_m) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("late_s", [0.0, 1.0])
def test_a_delay_of_the_sonar_is_found_by_the_turns_between_sightings(late_s: float):
    run = simulate_mission(MissionOptions(seed=5, duration_s=120.0))
    seen = run.detections
    assert seen is not None
    late = replace(seen, stamps_ns=seen.stamps_ns + round(late_s * 1e9))
    run = replace(run, detections=late)
    motion = BodyMotion.of(run)
    assert motion is not None
    match = aiding_check.AZIMUTH.compare(run, motion)
    assert match is not None
    assert match.lag.sigma < 0.1
    assert abs(match.lag.value - late_s) < 4 * match.lag.sigma
    *_, delay = aiding_check.findings_of(aiding_check.AZIMUTH, match, run, NO_CONFIG)
    assert delay.acts == (late_s > 0)
    if late_s:
        assert line_of(delay)["stamp_offset_s"] == pytest.approx(-late_s, abs=0.1)


@pytest.mark.parametrize("turn_rad", [0.0, 0.3, -0.6])
def test_a_turned_sonar_is_named_with_the_mounting_that_puts_it_right(turn_rad: float):
    run = simulate_mission(MissionOptions(seed=5, duration_s=120.0))
    seen = run.detections
    assert seen is not None
    turned = replace(seen, azimuth_rad=seen.azimuth_rad + turn_rad)
    found = [f for f in check_sensors(replace(run, detections=turned)) if f.acts]
    if not turn_rad:
        assert not found
        return
    assert found[0].quantity == "ranges to landmarks: turn of the sonar"
    mounting = tomllib.loads(found[0].line.split("`")[1])["sonar"]["mounting"]
    before = run.calibration.sonar.mounting.rpy_rad[2]
    assert mounting["rpy_rad"][2] == pytest.approx(before - turn_rad, abs=0.06)


@pytest.mark.parametrize(
    ("off_rad", "is_stated", "is_named"),
    [(1.0, True, True), (0.1, True, False), (1.0, False, False)],
)
def test_first_headings_far_from_a_stated_start_are_grave(
    off_rad: float, is_stated: bool, is_named: bool
):
    run = compass(RIGHT, lambda yaw_rad: yaw_rad + off_rad)
    yaw_rad = RIGHT.truth.rotations().as_euler("ZYX")[0, 0]
    start = Start(rpy_rad=(0.0, 0.0, yaw_rad)) if is_stated else Start()
    run = replace(run, calibration=run.calibration.model_copy(update={"start": start}))
    motion = BodyMotion.of(run)
    assert motion is not None
    found = list(aiding_check.start_heading_findings(run, motion))
    assert [finding.grave for finding in found] == [True] * is_named
    if is_named:
        assert found[0].estimate.value == pytest.approx(np.degrees(off_rad), abs=3.0)
