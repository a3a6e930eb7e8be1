"""Headings and position fixes of a simulated vehicle, spoilt by hand: named with the line that puts them right."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Start
from sonar_graph.diagnosis import Finding, aiding_check, check_sensors
from sonar_graph.diagnosis.findings import Gravity
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.signals import Match
from sonar_graph.diagnosis.units import force_scale
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import UNMEASURED_M2, Floats
from sonar_graph.navigation.alignment import Estimate1D
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission

from .runs import (
    acting,
    by_name,
    compass,
    fix_rows,
    fixed,
    heading_rows,
    late,
    level_vehicle,
    line_of,
    lines_of,
    names,
    recalibrated,
    spoilt,
    started,
    true_yaw,
    with_depth,
    with_mounting,
)
from .test_sensor_check import RIGHT

NO_CONFIG = LogConfig()
SLOW = simulate_mission(MissionOptions(seed=5, duration_s=60.0, speed_m_s=0.1))
SEEN = simulate_mission(MissionOptions(seed=5, duration_s=60.0))


def heading_findings(run: Sequence, config: LogConfig = NO_CONFIG) -> list[Finding]:
    motion = BodyMotion.of(run)
    match = aiding_check.HEADING.compare(run, motion)
    return list(aiding_check.heading_findings(match, run, config, motion))


def position_findings(run: Sequence, config: LogConfig = NO_CONFIG) -> list[Finding]:
    motion = BodyMotion.of(run)
    match = aiding_check.POSITIONS.compare(run, motion)
    return list(aiding_check.position_findings(match, run, config, motion))


def with_imu_on_its_back(run: Sequence, turn_rad_s: float) -> Sequence:
    """An IMU upside down under a calibration without it, with a bias about the vertical."""
    back = [1.0, -1.0, -1.0]
    rate = back * np.add(run.imu.angular_velocity, [0.0, 0.0, turn_rad_s])
    force = back * run.imu.specific_force
    return spoilt(run, "imu", angular_velocity=rate, specific_force=force)


def bias_of(run: Sequence) -> Finding:
    return aiding_check.vertical_bias(run, BodyMotion.of(run))


def test_a_compass_of_the_opposite_sense_is_found():
    """Whatever the bias of the gyros, and however the IMU is mounted."""
    run = with_imu_on_its_back(RIGHT, 0.01)
    bearing = compass(run, lambda yaw_rad: np.pi / 2 - yaw_rad)
    for config, world in (({}, "ned"), ({"heading": {"world": "ned"}}, "enu")):
        finding, *_ = heading_findings(bearing, LogConfig.parse(config, "x"))
        assert finding.acts
        assert "turns against the gyros, clockwise" in finding.advice
        assert line_of(finding) == {"world": world}
        assert finding.estimate.value == pytest.approx(-1.0, abs=0.1)
    stuck, *_ = heading_findings(compass(run, np.zeros_like))
    assert stuck.acts
    assert "it hardly turns where the gyros do" in stuck.text()


def turning(
    rate: Floats, ahead_m_s: float = 0.5, late_s: float = 0.0, every: int = 1
) -> Sequence:
    """A level vehicle that goes ahead for two minutes and yaws, with a compass."""
    velocity = np.outer(ahead_m_s + 0.0 * rate, [1.0, 0.0, 0.0])
    run = level_vehicle(velocity, rate, 0, every)
    noise = 0.01 * np.random.default_rng(0).standard_normal(len(rate) // 10)
    yaw_rad = np.cumsum(rate)[::10] * 0.02 + noise
    heading = heading_rows(run.imu.stamps_ns[::10], yaw_rad)
    return late(replace(run, heading=heading), "heading", late_s)


T = np.arange(0.0, 120.0, 0.02)


SWAY = 0.15 * np.pi * np.cos(0.5 * np.pi * T)
"""To and fro in four seconds."""


def test_a_late_compass_of_a_vehicle_that_turns_back_has_not_jumped():
    """Where the turn is reversed, a late heading leaves the gyros within a row."""
    (found,) = acting(turning(np.tanh(20.0 * np.sin(0.1 * T)), 0.0, late_s=0.6))
    assert found.quantity == "heading against the gyros: delay"
    assert line_of(found)["stamp_offset_s"] == pytest.approx(-0.6, abs=0.02)


def test_two_wild_headings_turn_none_of_those_after_them():
    """Their difference is more than half a turn, and shorter the other way round."""
    run = turning(SWAY)
    yaw_rad = run.heading.yaw_rad.copy()
    yaw_rad[300:302] += [1.7, -1.7]
    found, *_ = heading_findings(spoilt(run, "heading", yaw_rad=yaw_rad))
    assert found.estimate.value == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("drift_rad_s", "named"), [(0.02, "gyro bias"), (0.5, "drift")]
)
def test_a_turn_that_no_bias_of_gyros_makes_is_the_headings(drift_rad_s, named):
    """As degrees that are read as radians turn; a bias that they may have is theirs."""
    run = turning(SWAY)
    turned = run.heading.yaw_rad + drift_rad_s * T[::10]
    run = spoilt(run, "heading", yaw_rad=turned)
    found = bias_of(run)
    assert found.grave
    assert named in found.quantity


@pytest.mark.parametrize("scale", [1.0, 1.05])
def test_turns_between_rows_of_a_slow_log_are_no_scale_of_the_gyros(scale):
    """The vehicle yaws with a period of four rows."""
    run = turning(SWAY, every=5)
    rate = scale * run.imu.angular_velocity
    found, *_ = heading_findings(spoilt(run, "imu", angular_velocity=rate))
    assert found.estimate.value == pytest.approx(1.0 / scale, abs=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_a_few_fixes_far_off_of_a_vehicle_at_rest_are_no_contradiction(seed):
    """Three of fifteen, which hide each other in a fit of all."""
    sway = np.outer(0.02 * np.sin(0.004 * np.arange(1500)), [1.0, 0.0, 0.0])
    run = level_vehicle(sway, np.zeros(1500), 0)
    rng = np.random.default_rng(seed)
    places = 0.3 * rng.standard_normal((15, 3))
    far = rng.choice(15, 3, replace=False)
    places[far, :2] += rng.uniform(-20.0, 20.0, (3, 2))
    fixes = fix_rows(run.imu.stamps_ns[::100], places)
    run = recalibrated(run, "positions", sigma_m=(0.3, 0.3, 0.3))
    assert not acting(replace(run, positions=fixes))


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
    finding, *others = position_findings(fixed(RIGHT, scale))
    assert finding.acts == (line is not None)
    assert not any(other.acts for other in others)
    if isinstance(line, dict):
        assert line_of(finding) == pytest.approx(line)
    elif line:
        assert line in finding.advice


@pytest.mark.parametrize("rows", [3, 10])
def test_a_doppler_log_of_one_row_or_a_few_tells_nothing_of_fixes(rows):
    run = replace(RIGHT, dvl=RIGHT.dvl.rows(slice(rows)))
    finding, *_ = position_findings(fixed(run))
    assert finding.text().startswith("cannot be told: too few")


def test_fixes_in_a_map_grid_are_found_with_their_origin():
    grid = (500_000.0, 4_670_000.0, 0.0)
    config = LogConfig.parse({"positions": {"origin_m": [1.0, 2.0, 3.0]}}, "x")
    begun = recalibrated(RIGHT, "start", position_m=grid)
    *_, away = position_findings(fixed(begun, origin=grid), config)
    assert "from the origin of the world, beyond their noise" in away.advice
    *_, finding = position_findings(fixed(RIGHT, origin=grid), config)
    assert finding.acts
    assert "from the start, beyond their noise" in finding.advice
    origin = np.add(grid, (1, 2, 3))
    assert line_of(finding)["origin_m"] == pytest.approx(origin, abs=2.0)


@pytest.mark.parametrize("every_s", [0.1, 10.0])
def test_fixes_faster_than_any_vehicle_are_found_and_outliers_are_not(every_s):
    good = fixed(SLOW if every_s < 10 else RIGHT, sigma_m=2.5, every_s=every_s)
    places = good.positions.position_m
    stamps_ns = good.positions.stamps_ns
    yaw_rad = np.interp(stamps_ns, good.truth.stamps_ns, true_yaw(good))
    angles = np.outer(np.degrees(yaw_rad), [0.0, 0.0, 10.0])
    spikes = places + 500.0 * (np.arange(len(places)) % 20 == 3)[:, None]
    for position_m, jumps in ((places, False), (spikes, False), (angles, True)):
        found = position_findings(spoilt(good, "positions", position_m=position_m))
        assert ("position fixes: jumps" in names(found)) == jumps
        assert not jumps or by_name(found)["position fixes: jumps"].acts


@pytest.mark.parametrize(
    ("places", "before"),
    [("fixes", 0.1), ("true positions", 0.0), ("fixes", None), ("neither", 0.1)],
)
def test_a_heading_with_an_offset_is_found_from_positions(places, before):
    """A Doppler log that is turned on the body is no turn of the heading; an offset of None is a right heading."""
    off_rad = 0.0 if before is None else 0.4
    velocity = Rotation.from_euler("z", -0.7).apply(RIGHT.dvl.velocity)
    run = spoilt(RIGHT, "dvl", velocity=velocity)
    run = with_mounting(run, "dvl", rpy_rad=(0.0, 0.0, 0.7))
    run = compass(run, lambda yaw_rad: yaw_rad + off_rad, sigma_rad=0.0)
    if places == "fixes":
        run = fixed(run)
    if places != "true positions":
        run = replace(run, truth=None)
    config = LogConfig.parse({"heading": {"yaw_offset_rad": before or 0.0}}, "x")
    still = spoilt(run, "dvl", velocity=0 * velocity)
    assert not any(f.estimate.is_known for f in heading_findings(still)[2:])
    sense, lag, *found = heading_findings(run, config)
    assert not sense.acts
    assert not lag.acts
    assert len(found) == (places != "neither")
    for finding in found:
        value = np.degrees(-off_rad)
        assert finding.estimate.value == pytest.approx(value, abs=2.0)
        assert finding.acts == (off_rad > 0)
        if not off_rad:
            continue
        of_heading, of_dvl = lines_of(finding)
        offset = {"yaw_offset_rad": before - off_rad}
        assert of_heading == pytest.approx(offset, abs=0.04)
        cure = of_dvl["dvl"]["mounting"]
        assert cure["rpy_rad"] == pytest.approx([0.0, 0.0, 0.7 - off_rad], abs=0.04)
        turned = with_mounting(run, "dvl", **cure)
        assert not any(f.acts for f in heading_findings(turned, config))


@pytest.mark.parametrize("heading_rad", [0.35, 0.0])
def test_fixes_are_asked_where_the_start_agrees_with_the_heading(
    heading_rad,
):
    """By 0.35 rad, or the heading by as much."""
    run = fixed(compass(RIGHT, lambda yaw_rad: yaw_rad + heading_rad))
    turn = Rotation.from_euler("z", heading_rad - 0.35)
    run = spoilt(run, "positions", position_m=turn.apply(run.positions.position_m))
    *_, found = heading_findings(replace(run, truth=None))
    assert found.estimate.value == pytest.approx(np.degrees(-0.35), abs=2.0)
    asks_fixes = "`use = false` under [positions]" in found.line
    assert asks_fixes == (heading_rad == 0)


@pytest.mark.parametrize(
    ("run", "is_upside_down"),
    [(compass(RIGHT), True), (RIGHT, False)],
    ids=["heading", "truth"],
)
def test_a_constant_bias_of_the_gyros_is_found_and_its_line_takes_it_away(
    run, is_upside_down
):
    """0.67 degrees a second about the vertical, however the IMU sits."""
    bias = np.radians(0.67)
    rate = np.add(run.imu.angular_velocity, [0.0, 0.0, bias])
    biased = spoilt(run, "imu", angular_velocity=rate)
    if is_upside_down:
        biased = with_imu_on_its_back(run, bias)
    found = bias_of(biased)
    assert not bias_of(run).acts
    assert found.acts
    assert found.estimate.value == pytest.approx(bias, abs=4 * found.estimate.sigma)
    assert f"{np.degrees(found.estimate.value):.3g}°/s beyond" in found.text()
    assert not bias_of(recalibrated(biased, "imu", **line_of(found)["imu"])).acts
    # of an IMU on its back the axes come first
    if not is_upside_down:
        assert any("gyro bias" in name for name in names(acting(biased)))


@pytest.mark.parametrize(
    ("z_m", "stated", "gravity"),
    [
        (-3.05, -3.0, None),
        (-3.4, -3.0, Gravity.ACT),
        (-4.5, -3.0, Gravity.GRAVE),
        (3.0, -3.0, Gravity.GRAVE),
        (-50.0, None, None),
        (0.5, None, None),
        (1.5, None, Gravity.ACT),
    ],
)
def test_heights_that_begin_neither_at_the_start_nor_under_water_are_told(
    z_m, stated, gravity
):
    start = Start() if stated is None else Start(position_m=(5.0, 5.0, stated))
    heights_m = RIGHT.depth.z_m + z_m - float(RIGHT.depth.z_m[:5].mean())
    run = started(spoilt(RIGHT, "depth", z_m=heights_m), start)
    found = list(aiding_check.start_depth_findings(run))
    # a height that nothing contradicts may be one over the bottom
    assert [one.gravity for one in found] == [gravity] * (gravity is not None)
    told = "above the water" if stated is None else f"height begins at {z_m:.2f} m"
    assert all(told in finding.advice for finding in found)


@pytest.mark.parametrize(
    ("source", "line"), [("fixes", "use = false"), ("stated", "origin_m")]
)
def test_depths_and_fixes_of_different_height_are_a_fault(source, line):
    run = recalibrated(fixed(RIGHT, sigma_m=0.3), "start", source=source)
    run = spoilt(run, "depth", z_m=run.depth.z_m - 40.0)
    (found,) = aiding_check.fix_height_findings(run, NO_CONFIG)
    assert found.grave
    assert line in found.line
    assert found.estimate.value == pytest.approx(40.0, abs=0.2)


@pytest.mark.parametrize(
    ("factor", "is_told"), [(1.05, True), (0.6, True), (1.005, False), (3.0, None)]
)
def test_the_scale_of_the_accelerometers_is_that_of_gravity(factor, is_told):
    """Within half a per cent gravity itself may differ; three times as much is another unit.

    Forces across gravity, of a hull that shakes, make each one longer, not their mean.
    """
    shaking = np.random.default_rng(0).normal(0.0, 3.0, RIGHT.imu.specific_force.shape)
    for force in (RIGHT.imu.specific_force, RIGHT.imu.specific_force + shaking):
        run = spoilt(RIGHT, "imu", specific_force=factor * force)
        finding = force_scale(run, NO_CONFIG)
        assert (finding and finding.acts) == is_told
        if is_told:
            key = line_of(finding)["linear_acceleration_scale"]
            assert key == pytest.approx(1 / factor, rel=2e-3)


@pytest.mark.parametrize("phase_rad", [0.0, 0.3, 1.9, 4.0])
def test_a_swell_makes_no_accelerometers_of_another_scale(phase_rad):
    """Round and round at 1.5 m/s² every five seconds: single seconds meet it at five phases."""
    imu = RIGHT.imu
    phase = 0.4e-9 * np.pi * (imu.stamps_ns - imu.stamps_ns[0]) + phase_rad
    swell = 1.5 * np.column_stack([np.cos(phase), 0.0 * phase, np.sin(phase)])
    for factor in (1.0, 1.08):
        force = factor * (imu.specific_force + swell)
        found = force_scale(spoilt(RIGHT, "imu", specific_force=force), NO_CONFIG)
        assert found.acts == (factor > 1.0)


@pytest.mark.parametrize("period_s", [4.0, 8.0])
def test_the_sampling_error_of_a_doppler_log_is_that_of_the_trapezoid(period_s):
    """By hand: the integral of a sine over rows a second apart is too small by ``(w T)^2 / 12``."""
    t = np.arange(600.0)
    w = 2 * np.pi / period_s
    height_m = np.append(0.0, np.cumsum((np.sin(w * t[1:]) + np.sin(w * t[:-1])) / 2))
    motion = replace(BodyMotion.of(RIGHT), seconds=t, parts=np.zeros(600, int))
    expected = (2 * np.sin(w / 2)) ** 2 / 12
    sure = Match(*[Estimate1D(1.0, 0.0)] * 3)
    between = motion.between_rows(sure, height_m)
    assert between.gain.sigma == pytest.approx(expected, rel=0.02)
    # a steady motion tells well when
    assert between.lag.sigma < 0.02


@pytest.mark.parametrize("step_m", [0.0, 0.6])
def test_a_dive_that_turns_between_two_slow_velocities_is_no_jump(step_m):
    """A velocity every two seconds does not tell when the vehicle began to climb; a depth that jumps is found beside it."""
    t = np.arange(0.0, 240.0, 0.02)
    climb_m_s = 0.15 * np.tanh(20.0 * np.sin(2 * np.pi * t / 150.0))
    velocity = np.column_stack([0.5 + 0.0 * t, 0.0 * t, climb_m_s])
    run = level_vehicle(velocity, 0.1 * np.sin(0.1 * t), 0, every=10)
    z_m = np.cumsum(climb_m_s) * 0.02 + step_m * (t > 100.0)
    found = acting(with_depth(run, z_m[::10], 1e-4))
    texts = [one.cause for one in found if one.quantity.startswith("depth")]
    assert len(texts) == (step_m > 0)
    assert all("jumps" in text for text in texts)


def test_sensors_without_noise_are_not_stuck_where_the_vehicle_rests():
    """There the gyros and the Doppler log move by noise alone, and an exact compass, depth and fix do not follow."""
    t = np.arange(0.0, 300.0, 0.02)
    moves = (t < 60.0) | (t > 280.0)
    rate = 0.1 * moves * np.sin(0.2 * t)
    yaw_rad = np.cumsum(rate) * 0.02
    climb = 0.1 * moves * np.sin(0.1 * t)
    run = level_vehicle(np.column_stack([0.5 * moves, 0.0 * t, climb]), rate, 0)
    level = 0.5 * moves * np.exp(1j * yaw_rad)
    way = np.column_stack([level.real, level.imag, climb])
    places = np.cumsum(way, axis=0)[::10] * 0.02
    stamps_ns = run.imu.stamps_ns[::10]
    exact = replace(
        with_depth(run, places[:, 2], 1e-6),
        heading=heading_rows(stamps_ns, yaw_rad[::10]),
        positions=fix_rows(stamps_ns, places),
    )
    assert not acting(exact)


@pytest.mark.parametrize("changes", [2, 8])
def test_a_climb_that_begins_between_two_velocities_tells_badly_when(changes):
    """Each sudden change may be anywhere in its two seconds; so many of them tell better by the root of their number."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 600.0, 2.0)
    motion = replace(BodyMotion.of(RIGHT), seconds=t, parts=np.zeros(300, int))
    sure = Match(*[Estimate1D(1.0, 0.0)] * 3)
    late_s = []
    for _ in range(200):
        begins_s = np.sort(rng.uniform(20.0, 580.0, changes))
        fine_s = np.arange(0.0, 600.0, 0.01)
        climb_m_s = 0.1 * (-1.0) ** np.searchsorted(begins_s, fine_s)
        true_m = np.append(0.0, np.cumsum(climb_m_s) * 0.01)[:-1][::200]
        at_rows = climb_m_s[::200]
        height_m = np.append(0.0, np.cumsum(at_rows[1:] + at_rows[:-1]))
        sigma_s = motion.between_rows(sure, height_m).lag.sigma
        off_m = np.diff(height_m - true_m)
        # each change moves the height by twice the speed times its delay
        late_s.append(
            np.sum(off_m * np.sign(np.diff(true_m))) / 0.2 / changes / sigma_s
        )
    assert 0.5 < np.std(late_s) < 1.5


@pytest.mark.parametrize("late_s", [0.0, 1.0])
def test_a_delay_of_the_sonar_is_found_by_the_turns_between_sightings(late_s):
    run = late(SEEN, "detections", late_s)
    azimuth = aiding_check.AZIMUTH
    match = azimuth.compare(run, BodyMotion.of(run))
    assert match.lag.sigma < 0.1
    assert abs(match.lag.value - late_s) < 4 * match.lag.sigma
    *_, delay = aiding_check.findings_of(azimuth, match, run, NO_CONFIG)
    assert delay.acts == (late_s > 0)
    if late_s:
        assert line_of(delay)["stamp_offset_s"] == pytest.approx(-late_s, abs=0.1)


def acting_of_ranges(run: Sequence) -> list[Finding]:
    match = aiding_check.RANGE.compare(run, BodyMotion.of(run))
    found = aiding_check.findings_of(aiding_check.RANGE, match, run, NO_CONFIG)
    return [finding for finding in found if finding.acts]


@pytest.mark.parametrize(
    ("turn_rad", "noise_m", "gap_s"),
    [(0.0, 0.0, 0), (0.0, 0.06, 0), (-0.4, 0.0, 0), (-0.4, 0.06, 0), (0.35, 0.0, 5)],
)
def test_a_turned_sonar_is_named_with_the_mounting_that_puts_it_right(
    turn_rad, noise_m, gap_s
):
    """Of ranges with much noise the turn explains only a part, but beyond doubt.

    A gap of the Doppler log hides none: no reference is known across it, for a few of the pairs.
    """
    seen = SEEN.detections
    noise = noise_m * np.random.default_rng(0).standard_normal(len(seen))
    azimuth_rad = seen.azimuth_rad + turn_rad
    range_m = seen.range_m + noise
    run = spoilt(SEEN, "detections", azimuth_rad=azimuth_rad, range_m=range_m)
    t = (run.dvl.stamps_ns - run.start_ns) * 1e-9
    run = replace(run, dvl=run.dvl.rows((t < 50.0) | (t > 50.0 + gap_s)))
    found = acting_of_ranges(run)
    of_sonar = "ranges to landmarks: turn of the sonar"
    assert names(found)[:1] == [of_sonar] * (turn_rad != 0)
    if turn_rad:
        *_, yaw_rad = line_of(found[0])["sonar"]["mounting"]["rpy_rad"]
        before = SEEN.calibration.sonar.mounting.rpy_rad[2]
        assert yaw_rad == pytest.approx(before - turn_rad, abs=0.06)


def test_fixes_without_a_height_are_compared_in_the_level_alone():
    run = fixed(SEEN, sigma_m=0.3)
    cov = np.diag([0.09, 0.09, UNMEASURED_M2])
    covs = np.tile(cov, (len(run.positions), 1, 1))
    places = np.add(run.positions.position_m, [0.0, 0.0, 40.0])
    run = spoilt(run, "positions", position_m=places, covariance_m2=covs)
    of_height = list(aiding_check.fix_height_findings(run, NO_CONFIG))
    assert not [f for f in (*position_findings(run), *of_height) if f.acts]


@pytest.mark.parametrize(
    ("off_rad", "is_stated", "is_named"),
    [(1.0, True, True), (0.1, True, False), (1.0, False, False)],
)
def test_first_headings_far_from_a_stated_start_are_grave(off_rad, is_stated, is_named):
    run = compass(RIGHT, lambda yaw_rad: yaw_rad + off_rad)
    start = Start(rpy_rad=(0.0, 0.0, float(true_yaw(RIGHT)[0])))
    run = started(run, start if is_stated else Start())
    found = list(aiding_check.start_heading_findings(run, BodyMotion.of(run)))
    assert [finding.grave for finding in found] == [True] * is_named
    for finding in found:
        off_deg = np.degrees(off_rad)
        assert finding.estimate.value == pytest.approx(off_deg, abs=3.0)


def test_velocities_that_estimators_refuse_count_in_no_check():
    """Half of the rows are 0 with the variance of a direction that was not measured."""
    dvl = SEEN.dvl
    is_refused = np.random.default_rng(0).random(len(dvl)) < 0.4
    velocity = np.where(is_refused[:, None], 0.0, dvl.velocity)
    cov = np.where(is_refused[:, None, None], 1e6 * np.eye(3), dvl.velocity_cov)
    with_refused = spoilt(SEEN, "dvl", velocity=velocity, velocity_cov=cov)
    without = replace(SEEN, dvl=dvl.rows(~is_refused))
    assert str(check_sensors(with_refused)) == str(check_sensors(without))
