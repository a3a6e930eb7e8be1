"""What makes a sensor differ from its reference is named, of a vehicle made by hand: each fault x its name and size."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, PositionCalibration, Start
from sonar_graph.diagnosis.causes import unlike_pair, velocity_steps
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.states import Trajectory

from .runs import (
    acting,
    fix_rows,
    grave,
    heading_rows,
    late,
    level_vehicle,
    spoilt,
    unstated,
    with_depth,
)
from .test_turn_rate import T, level_drive

UP = np.array([0.0, 0.0, 1.0])
NOISE = np.random.default_rng(3).standard_normal((len(T), 3))


def integral(values: np.ndarray) -> np.ndarray:
    return np.append(0.0, np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(T)))


YAW = integral(0.3 * np.sin(0.4 * T) + 0.1)
AHEAD = integral(0.9 + 0.25 * np.sin(0.7 * T))
PATH = integral((0.9 + 0.25 * np.sin(0.7 * T)) * np.exp(1j * YAW))
DIVE = 0.5 * np.sin(0.5 * T) + 0.3 * np.sin(0.21 * T)


def observed(
    height: Floats = DIVE, yaw_rad: Floats = YAW, path: np.ndarray = PATH
) -> Sequence:
    """A drive with depth, heading and fixes, as they are or spoilt."""
    run = level_drive(0)
    climb = np.gradient(DIVE, T)
    velocity = run.dvl.velocity + np.outer(climb[::10], UP)
    force = run.imu.specific_force + np.outer(np.gradient(climb, T), UP)
    run = spoilt(spoilt(run, "dvl", velocity=velocity), "imu", specific_force=force)
    ns = run.imu.stamps_ns
    places = np.column_stack([path.real, path.imag, DIVE]) + 0.2 * NOISE
    of_antenna = PositionCalibration(sigma_m=(0.3, 0.3, 0.5))
    return replace(
        with_depth(run, (height + 0.01 * NOISE[:, 0])[::10]),
        calibration=Calibration(positions=of_antenna),
        heading=heading_rows(ns[::10], (yaw_rad + 0.01 * NOISE[:, 1])[::10]),
        positions=fix_rows(ns[::50], places[::50]),
    )


# fmt: off
SLOPE = np.sin(np.radians(8.0))
IRON_RAD = np.radians(10.0)
FAULTS: dict[str, tuple[Sequence, str, float]] = {
    "depth that drifts": (observed(height=DIVE + 0.1 * T), "depth: drift", 0.1),
    "log or IMU pitched by 8 degrees": (observed(height=DIVE + SLOPE * AHEAD), "depth: pitch of Doppler log or IMU", 8.0),
    "compass among iron": (
        observed(yaw_rad=YAW + IRON_RAD * np.sin(YAW + 0.4)), "heading: deviation with the heading", 10.0),
    "compass beside soft iron": (
        observed(yaw_rad=YAW + IRON_RAD * np.sin(2.0 * YAW + 0.4)), "heading: deviation with the heading", 10.0),
    "current": (observed(path=PATH + (0.3 + 0.4j) * T), "position fixes: current", 0.5),
}
# fmt: on


@pytest.mark.parametrize("fault", FAULTS)
def test_a_cause_is_named_with_its_size_and_nothing_else_is_blamed(fault):
    run, quantity, size = FAULTS[fault]
    (found,) = grave(run)
    assert found.quantity == quantity
    near = max(0.15 * size, 4 * found.estimate.sigma)
    assert found.estimate.value == pytest.approx(size, abs=near)


@pytest.mark.parametrize(("size_deg", "is_unit"), [(30.0, False), (60.0, True)])
def test_a_deviation_larger_than_by_iron_may_be_one_of_the_unit(size_deg, is_unit):
    deviation = np.radians(size_deg) * np.sin(YAW + 0.4)
    (found,) = grave(observed(yaw_rad=YAW + deviation))
    assert ("degrees that are read as radians" in found.cause) == is_unit


def test_gyros_with_holes_make_no_deviation_of_a_right_compass():
    """Over two seconds a deviation looks like a drift of the gyros: it was 63 degrees, by 4 sigma."""
    run = observed()
    is_hole = (T % 4.0 < 2.0) & (T > 5.0)
    holed = replace(run, imu=run.imu.rows(~is_hole))
    assert not [f for f in grave(holed) if "deviation" in f.quantity]


@pytest.mark.parametrize(("size_deg", "is_named"), [(25.0, True), (8.0, False)])
def test_a_compass_that_leaves_the_gyros_for_a_while_is_named(size_deg, is_named):
    bump = np.radians(size_deg) * np.exp(-0.5 * ((T - 40.0) / 6.0) ** 2)
    found = grave(observed(yaw_rad=YAW + bump))
    assert any("excursion" in one.quantity for one in found) == is_named
    told = r"by up to [12]\d° between 3\d and 4\d s"
    assert any(re.search(told, one.advice) for one in found) == is_named


def truth_of(run: Sequence, turned: np.ndarray, late_s: float = 0.0) -> Sequence:
    """The true path, its coordinates turned or mirrored by a matrix."""
    places = np.column_stack([PATH.real, PATH.imag, DIVE]) @ turned.T
    level = Rotation.from_euler("z", YAW[:, None]).as_quat()
    path = Trajectory.without_covariances(run.imu.stamps_ns, places, level)
    return late(replace(run, truth=path), "truth", late_s)


NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@pytest.mark.parametrize(
    ("turned", "late_s", "line", "cause"),
    [
        (NED, 0.0, '`world = "ned"` under [truth]', "mirror image"),
        (1000.0 * np.eye(3), 0.0, "`scale = 0.001` under [truth]", ""),
        (np.eye(3), 3.0, "`stamp_offset_s = -3", ""),
        (np.eye(3), 0.0, "", ""),
    ],
)
def test_a_reference_of_other_axes_unit_or_clock_is_named(turned, late_s, line, cause):
    run = truth_of(observed(), turned, late_s)
    found = [one for one in acting(run) if one.quantity.startswith("reference")]
    assert len(found) == (line != "")
    assert all(line in one.line and cause in one.cause for one in found)
    assert all(one.grave for one in found if cause)


@pytest.mark.parametrize(("sigma_m_s", "is_named"), [(10.0, True), (0.5, False)])
def test_a_stated_noise_of_velocities_in_another_unit_is_named(sigma_m_s, is_named):
    run = observed()
    noisy = run.dvl.velocity + 0.01 * NOISE[: len(run.dvl)]
    stated = np.tile(sigma_m_s**2 * np.eye(3), (len(run.dvl), 1, 1))
    found = grave(spoilt(run, "dvl", velocity=noisy, velocity_cov=stated))
    assert any("stated sigma" in one.quantity for one in found) == is_named


AFTER = 1.0 * (T > 31.0)
JUMPS = {
    "depth": (observed(height=DIVE + 3.0 * AFTER), "by 3 m at 31"),
    "heading": (observed(yaw_rad=YAW + 0.5 * AFTER), "by 29 ° at 31"),
    "position fixes": (observed(path=PATH + 13.0 * AFTER), "by 13 m at 31"),
}


@pytest.mark.parametrize("sensor", JUMPS)
def test_a_jump_is_called_one_and_no_unit_axes_or_delay(sensor):
    run, text = JUMPS[sensor]
    (found,) = grave(run)
    assert found.quantity.startswith(sensor)
    assert text in found.advice
    assert "jumps" in found.advice
    assert "`use = false`" in found.line


@pytest.mark.parametrize(
    ("z_m", "jumps"),
    [
        (1.0 * AFTER + 0.01 * NOISE[:, 0], 1),
        (0.01 * NOISE[:, 0], 0),
        (np.round(0.002 * (T + NOISE[:, 0]), 1), 0),
    ],
    ids=["step", "none", "steps of its resolution"],
)
def test_a_depth_that_jumps_is_named_of_a_level_vehicle_too(z_m, jumps):
    """Without a change of depth nothing is known of its scale, but a step is none of the vehicle.

    Steps of its resolution are none, as it drifts with the tide while the vehicle keeps its height.
    """
    found = grave(with_depth(level_drive(0), z_m[::10]))
    assert ["by 1 m at 31" in one.cause for one in found] == [True] * jumps


def paused(signal: np.ndarray, begin_s: float) -> np.ndarray:
    """The signal with its value repeated for 24 s."""
    is_paused = (begin_s < T) & (begin_s + 24.0 > T)
    return np.where(is_paused, signal[np.argmax(is_paused)], signal)


PAUSES = {
    "depth": (observed(height=paused(DIVE, 33.0)), 33.0),
    "heading": (observed(yaw_rad=paused(YAW, 6.0)), 6.0),
    "position fixes": (observed(path=paused(PATH, 33.0)), 33.0),
}


@pytest.mark.parametrize("sensor", PAUSES)
def test_a_sensor_that_repeats_its_value_for_half_a_minute_is_named(sensor):
    """Its noise goes on, as of a driver that smooths."""
    run, paused_s = PAUSES[sensor]
    (found,) = grave(run)
    assert found.quantity.startswith(sensor)
    told_s = re.findall(r"between (\d+) and (\d+) s", found.cause)[0]
    assert [*map(int, told_s)] == pytest.approx([paused_s, paused_s + 24], abs=4.9)


@pytest.mark.parametrize("drift_m_s", [0.025, 0.08])
def test_a_vehicle_that_keeps_its_depth_has_no_depth_that_stands_still(drift_m_s):
    """The reference drifts, by too much of the Doppler log's vertical velocity, which is another finding if it matters."""
    run = observed(height=np.where(T < 15.0, DIVE, DIVE[T < 15.0][-1]))
    climb_m_s = np.where(T < 15.0, np.gradient(DIVE, T), 0.0) + drift_m_s
    velocity = run.dvl.velocity * [1, 1, 0] + np.outer(climb_m_s[::10], UP)
    found = grave(spoilt(run, "dvl", velocity=velocity))
    assert not [one for one in found if "stands still" in one.cause]


def test_velocities_that_jump_without_a_force_have_lost_the_bottom():
    run = observed()
    is_water = (run.dvl.stamps_ns > 20e9) & (run.dvl.stamps_ns < 40e9)
    velocity = run.dvl.velocity + np.outer(is_water, [0.3, 0.1, 0.0])
    (found,) = grave(spoilt(run, "dvl", velocity=velocity))
    assert found.quantity == "DVL: steps"
    times_s = [float(text) for text in re.findall(r"at ([0-9.]+) s", found.cause)]
    assert times_s == pytest.approx([20.2, 40.0], abs=0.4)


def wandering(seed: int) -> Floats:
    """Smooth velocities of a minute at 50 Hz, m/s."""
    rng = np.random.default_rng(seed)
    hz = rng.uniform(0.02, 0.1, (4, 3))
    phase = rng.uniform(0.0, 6.0, (4, 3))
    t = np.arange(3500)[:, None] / 50.0
    waves = np.sin(2 * np.pi * hz * t[..., None] + phase).sum(axis=1)
    return 0.5 * np.minimum(t / 5.0, 1.0) * waves * [1.0, 1.0, 0.2]


def wanderer(seed: int, rest_s: float = 0.0) -> Sequence:
    """A vehicle with these velocities, after a rest."""
    velocity = np.vstack([np.zeros((round(50 * rest_s), 3)), wandering(seed)])
    return level_vehicle(velocity, np.zeros(len(velocity)), 1)


def test_velocities_of_another_vehicle_are_doubtful_also_after_a_rest():
    """No axes, stamps or scale bring them together, so that none is named, nor any other sensor; its own are right."""
    own, other = (wanderer(seed, rest_s=70.0) for seed in (0, 1))
    assert not acting(own)
    (found,) = acting(replace(own, dvl=other.dvl))
    assert found.grave
    assert found.quantity == "DVL against IMU: velocities and accelerometers"


@pytest.mark.parametrize("held", [1, 4])
@pytest.mark.parametrize("every", [1, 5])
def test_a_hull_that_shakes_contradicts_no_doppler_log_of_its_own(every, held):
    """Thrusters make forces noisier than the sensor at rest, of which the calibration tells; a driver may repeat rows."""
    own = wanderer(0).imu
    shakes = np.random.default_rng(0).normal(0.0, 1.0, own.specific_force.shape)
    for seed, size in ((0, 1.0), (1, 0.3 / np.sqrt(held))):
        force = (own.specific_force + size * shakes)[::held]
        imu = replace(own, specific_force=np.repeat(force, held, axis=0))
        run = wanderer(seed)
        run = replace(run, imu=imu, dvl=run.dvl.rows(slice(0, None, every)))
        assert (unlike_pair(run) is None) == (seed == 0)


@pytest.mark.parametrize("rows", [2200, 3500])
def test_a_single_wild_velocity_contradicts_no_accelerometers(rows):
    """Also in a log of less than a minute."""
    own = level_vehicle(wandering(0)[:rows], np.zeros(rows), 1)
    velocity = own.dvl.velocity.copy()
    for row, is_named in ((None, False), (100, False), (-30, True)):
        if row is not None:
            velocity[row] += [2.0, -1.0, 1.0]
        found = unlike_pair(spoilt(own, "dvl", velocity=velocity))
        assert (found is not None) == is_named


def straight(scale: float) -> Sequence:
    """A straight way at 0.9 m/s past landmarks on both sides, with a scale of the Doppler log."""
    run = level_drive(0)
    seconds = np.arange(1.0, 50.0, 2.0)
    places = np.ravel(np.add.outer(np.arange(5.0, 65.0, 10.0), [-6.0j, 4.0j]))
    off = places - 0.9 * seconds[:, None]  # (frames, landmarks)
    frame, landmark = np.nonzero(off.real > 1.0)
    off = off[frame, landmark]
    n = len(frame)
    seen = LandmarkDetections(
        run.imu.stamps_ns[0] + np.rint(seconds[frame] * 1e9).astype(np.int64),
        np.abs(off) + 0.02 * NOISE[:n, 0],
        np.angle(off) + 0.005 * NOISE[:n, 1],
        unstated(n, 2, 2),
        landmark[:, None],
        np.ones((n, 1)),
    )
    force = 9.80665 * UP + 1e-2 * NOISE
    run = spoilt(run, "imu", angular_velocity=1e-4 * NOISE, specific_force=force)
    velocity = np.tile([0.9 * scale, 0.0, 0.0], (len(run.dvl), 1))
    return replace(spoilt(run, "dvl", velocity=velocity), detections=seen)


COURSE_RAD = 1.2


def diving(
    signs: tuple[float, float, float], depth_sign: float = 1.0, start_z_m: float = -20.0
) -> Sequence:
    """The straight way with a slow dive, which accelerations do not show; depths, headings and fixes on its course."""
    run = straight(1.0)
    velocity = run.dvl.velocity + 0.005 * NOISE[: len(run.dvl)]
    velocity += np.outer(0.8 * 0.12 * np.cos(0.12 * T[::10]), UP)
    height_m = -20.0 + 0.8 * np.sin(0.12 * T)
    along = 0.9 * T * np.exp(1j * COURSE_RAD)
    places = np.column_stack([along.real, along.imag, height_m]) + 0.2 * NOISE
    ns = run.imu.stamps_ns[::10]
    start = Start(position_m=(0.0, 0.0, start_z_m), rpy_rad=(0.0, 0.0, COURSE_RAD))
    run = with_depth(run, (depth_sign * height_m + 0.01 * NOISE[:, 0])[::10])
    return replace(
        spoilt(run, "dvl", velocity=velocity * signs),
        calibration=Calibration(start=start if start_z_m else Start()),
        heading=heading_rows(ns, COURSE_RAD + 0.01 * NOISE[::10, 1]),
        positions=fix_rows(ns[::5], places[::50]),
    )


# fmt: off
WRONG_SENSES = {
    "nothing": (diving((1, 1, 1)), ()),
    "all of the Doppler log": (diving((-1, -1, -1)), ('`rotation = ["-x", "-y", "-z"]` under [dvl]',)),
    "its z, depths begin at the start": (diving((1, 1, -1)), ('`rotation = ["x", "y", "-z"]` under [dvl]',)),
    "its z, no start is stated": (diving((1, 1, -1), start_z_m=0.0), ("under [dvl]", "`scale = -1` under [depth]")),
    "depths above the water": (diving((1, 1, 1), -1.0, start_z_m=0.0), ("`scale = -1` under [depth]",)),
}
# fmt: on


@pytest.mark.parametrize("wrong", WRONG_SENSES)
def test_of_two_that_run_against_each_other_the_right_one_is_not_asked(wrong):
    run, lines = WRONG_SENSES[wrong]
    said = " ".join(found.line for found in grave(run))
    asked = set(re.findall(r"under \[(\w+)\]", said))
    assert asked == {re.findall(r"\w+", line)[-1] for line in lines}
    assert ".mounting." not in said
    assert all(line in said for line in lines)


@pytest.mark.parametrize("has_sightings", [True, False])
def test_a_clockwise_heading_blames_no_doppler_log_that_fits(
    has_sightings,
):
    run = diving((1, 1, 1), start_z_m=0.0)
    run = spoilt(run, "heading", yaw_rad=np.pi / 2 - run.heading.yaw_rad)
    if not has_sightings:
        run = replace(run, detections=None)
    (found,) = (f for f in grave(run) if f.quantity.endswith("the positions"))
    assert '`world = "ned"` under [heading]' in found.line
    assert "`yaw_offset_rad = " in found.line
    assert ("dvl.mounting" in found.line) == (not has_sightings)


def test_ranges_on_a_straight_way_blame_the_scale_and_no_current():
    assert not acting(straight(1.0))
    (found,) = acting(straight(1.2))
    assert found.quantity.startswith("ranges to landmarks: change")
    assert "range_scale" in found.line
    assert "the scale of the Doppler log" in found.line


WILD = {
    "dvl": ("velocity", 3.0),
    "depth": ("z_m", 5.0),
    "heading": ("yaw_rad", 2.0),
    "positions": ("position_m", 20.0),
}


@pytest.mark.parametrize("seed", [2, 3])
def test_single_wild_rows_of_right_sensors_have_no_cause(seed):
    """Of all sensors in one run."""
    rng = np.random.default_rng(seed)
    run = observed()
    for sensor, (column, size) in WILD.items():
        values = getattr(getattr(run, sensor), column).copy()
        is_wild = rng.random(len(values)) < 0.02
        signs = rng.choice([-1.0, 1.0], values[is_wild].shape)
        values[is_wild] += size * signs
        run = spoilt(run, sensor, **{column: values})
    assert not acting(run)


@pytest.mark.parametrize(
    ("role", "line"),
    [("heading", "use = false` under [heading]"), ("imu", "velocity_scale = 1.12")],
)
def test_a_scale_of_the_heading_is_told_from_one_of_the_gyros_by_the_fixes(role, line):
    """Fixes lie along the true path: its turns are those of the gyros, or those of the heading."""
    run = observed(yaw_rad=1.12 * YAW if role == "heading" else YAW)
    if role == "imu":
        rate = run.imu.angular_velocity / 1.12
        run = spoilt(run, "imu", angular_velocity=rate)
    found = grave(run)
    (scale,) = (f for f in found if f.quantity.startswith("heading: turn over"))
    assert scale.estimate.value == pytest.approx(1.12, abs=0.01)
    assert line in scale.line
    assert not [f for f in found if f.quantity.startswith("position fixes")]


@pytest.mark.parametrize("felt", ["always", "but for a hole", "but for two"])
def test_velocities_that_change_where_no_force_is_known_have_lost_nothing(felt):
    """The vehicle speeds up in 4 s. Between two holes of the accelerometers no velocity is measured."""
    run = observed()
    ahead = [1.0, 0.0, 0.0]
    push = 0.3 * ((T > 30.0) & (T < 34.0))
    force = run.imu.specific_force + np.outer(push, ahead)
    if felt != "always":
        is_lost = (T > 29.0) & (T < 35.0)
        is_lost[np.searchsorted(T, 32.05)] = felt != "but for two"
        force[is_lost] = np.nan
    faster = 0.3 * np.clip(T[::10] - 30.0, 0.0, 4.0)
    velocity = run.dvl.velocity + np.outer(faster, ahead)
    run = spoilt(spoilt(run, "imu", specific_force=force), "dvl", velocity=velocity)
    assert velocity_steps(run) is None
