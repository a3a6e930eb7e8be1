"""What makes a sensor differ from its reference is named, of a vehicle made by hand: each fault x its name and size."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, PositionCalibration, Start
from sonar_graph.diagnosis import check_sensors
from sonar_graph.diagnosis.causes import velocity_steps
from sonar_graph.measurements import (
    Depth,
    Floats,
    Heading,
    LandmarkDetections,
    PositionFixes,
)
from sonar_graph.sequence import Sequence
from sonar_graph.states import Trajectory

from .test_turn_rate import T, level_drive

NOISE = np.random.default_rng(3).standard_normal((len(T), 3))
EVERY = {"depth": 10, "heading": 10, "positions": 50}
"""Rows of the IMU from one to the next."""


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
    climb = np.gradient(DIVE, T)[::10]
    velocity = run.dvl.velocity + climb[:, None] * [0.0, 0.0, 1.0]
    force = run.imu.specific_force + np.gradient(np.gradient(DIVE, T), T)[:, None] * [
        0.0,
        0.0,
        1.0,
    ]
    ns = run.imu.stamps_ns
    places = np.column_stack([path.real, path.imag, DIVE]) + 0.2 * NOISE
    rows = {role: slice(0, len(T), every) for role, every in EVERY.items()}
    of_fixes = rows["positions"]
    unknown = np.full(len(ns[rows["heading"]]), np.nan)
    of_antenna = PositionCalibration(sigma_m=(0.3, 0.3, 0.5))
    return replace(
        run,
        calibration=Calibration(positions=of_antenna),
        imu=replace(run.imu, specific_force=force),
        dvl=replace(run.dvl, velocity=velocity),
        depth=Depth(
            ns[rows["depth"]], (height + 0.01 * NOISE[:, 0])[rows["depth"]], unknown
        ),
        heading=Heading(
            ns[rows["heading"]],
            (yaw_rad + 0.01 * NOISE[:, 1])[rows["heading"]],
            unknown,
        ),
        positions=PositionFixes(
            ns[of_fixes],
            places[of_fixes],
            np.full((len(ns[of_fixes]), 3, 3), np.nan),
        ),
    )


FAULTS: dict[str, tuple[Callable[[], Sequence], str, float]] = {
    "depth that drifts": (
        lambda: observed(height=DIVE + 0.1 * T),
        "depth: drift",
        0.1,
    ),
    "log or IMU pitched by 8 degrees": (
        lambda: observed(height=DIVE + np.sin(np.radians(8.0)) * AHEAD),
        "depth: pitch of Doppler log or IMU",
        8.0,
    ),
    "compass among iron": (
        lambda: observed(yaw_rad=YAW + np.radians(10.0) * np.sin(YAW + 0.4)),
        "heading: deviation with the heading",
        10.0,
    ),
    "compass beside soft iron": (
        lambda: observed(yaw_rad=YAW + np.radians(10.0) * np.sin(2.0 * YAW + 0.4)),
        "heading: deviation with the heading",
        10.0,
    ),
    "current": (
        lambda: observed(path=PATH + (0.3 + 0.2j) * T),
        "position fixes: current",
        np.hypot(0.3, 0.2),
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_cause_is_named_with_its_size_and_nothing_else_is_blamed(fault: str):
    make, quantity, size = FAULTS[fault]
    acting = [found for found in check_sensors(make()) if found.grave]
    assert [found.quantity for found in acting] == [quantity]
    estimate = acting[0].estimate
    assert estimate.value == pytest.approx(
        size, abs=max(0.15 * size, 4 * estimate.sigma)
    )


@pytest.mark.parametrize(("size_deg", "is_named"), [(25.0, True), (8.0, False)])
def test_a_compass_that_leaves_the_gyros_for_a_while_is_named(size_deg, is_named):
    bump = np.radians(size_deg) * np.exp(-0.5 * ((T - 40.0) / 6.0) ** 2)
    found = [
        f
        for f in check_sensors(observed(yaw_rad=YAW + bump))
        if "excursion" in f.quantity
    ]
    assert bool(found) == is_named
    if found:
        assert found[0].grave
        assert re.search(r"by up to [12]\d° between 3\d and 4\d s", found[0].advice)


def truth_of(run: Sequence, turned: np.ndarray) -> Sequence:
    """The true path, its coordinates turned or mirrored by a matrix."""
    places = np.column_stack([PATH.real, PATH.imag, DIVE]) @ turned.T
    level = Rotation.from_euler("z", YAW[:, None]).as_quat()
    path = Trajectory.without_covariances(run.imu.stamps_ns, places, level)
    return replace(run, truth=path)


NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@pytest.mark.parametrize(("turned", "is_named"), [(NED, True), (np.eye(3), False)])
def test_a_reference_in_north_east_down_is_named(turned, is_named):
    found = check_sensors(truth_of(observed(), turned))
    named = [f for f in found if "mirror image" in f.cause]
    assert bool(named) == is_named
    if named:
        assert named[0].grave
        assert '`world = "ned"` under [truth]' in named[0].line
    else:
        assert not any(f.grave for f in found)


@pytest.mark.parametrize(("sigma_m_s", "is_named"), [(10.0, True), (0.5, False)])
def test_a_stated_noise_of_velocities_in_another_unit_is_named(sigma_m_s, is_named):
    run = observed()
    noisy = run.dvl.velocity + 0.01 * NOISE[: len(run.dvl)]
    stated = np.tile(sigma_m_s**2 * np.eye(3), (len(run.dvl), 1, 1))
    dvl = replace(run.dvl, velocity=noisy, velocity_cov=stated)
    found = check_sensors(replace(run, dvl=dvl))
    assert any("stated sigma" in f.quantity for f in found if f.grave) == is_named


JUMPS = {
    "depth": (lambda: observed(height=DIVE + 3.0 * (T > 31.0)), "by 3 m at 31"),
    "heading": (lambda: observed(yaw_rad=YAW + 0.5 * (T > 31.0)), "by 29 ° at 31"),
    "position fixes": (
        lambda: observed(path=PATH + 13.0 * (T > 31.0)),
        "by 13 m at 31",
    ),
}


@pytest.mark.parametrize("sensor", JUMPS)
def test_a_jump_is_called_one_and_no_unit_axes_or_delay(sensor: str):
    make, text = JUMPS[sensor]
    (found,) = (found for found in check_sensors(make()) if found.grave)
    assert found.quantity.startswith(sensor)
    assert f"{text}" in found.advice
    assert "jumps" in found.advice
    assert "`use = false`" in found.line


def test_velocities_that_jump_without_a_force_have_lost_the_bottom():
    run = observed()
    is_water = (run.dvl.stamps_ns > 20e9) & (run.dvl.stamps_ns < 40e9)
    velocity = run.dvl.velocity + is_water[:, None] * [0.3, 0.1, 0.0]
    (found,) = (
        found
        for found in check_sensors(
            replace(run, dvl=replace(run.dvl, velocity=velocity))
        )
        if found.grave
    )
    assert found.quantity == "DVL: steps"
    times_s = [float(text) for text in re.findall(r"at ([0-9.]+) s", found.cause)]
    assert times_s == pytest.approx([20.2, 40.0], abs=0.4)


def straight(scale: float) -> Sequence:
    """A straight way at 0.9 m/s past landmarks on both sides, with a scale of the Doppler log."""
    run = level_drive(0)
    seconds = np.arange(1.0, 50.0)
    x_m, y_m = np.meshgrid(np.arange(5.0, 65.0, 10.0), [-6.0, 4.0])
    ahead_m = x_m.ravel() - 0.9 * seconds[:, None]  # (frames, landmarks)
    aside_m = np.broadcast_to(y_m.ravel(), ahead_m.shape)
    seen = np.argwhere(ahead_m > 1.0)
    range_m = np.hypot(ahead_m, aside_m)[tuple(seen.T)]
    n = len(seen)
    rest = np.zeros((len(T), 3))
    imu = replace(
        run.imu,
        angular_velocity=rest + 1e-4 * NOISE,
        specific_force=rest + [0.0, 0.0, 9.80665] + 1e-2 * NOISE,
    )
    velocity = np.tile([0.9 * scale, 0.0, 0.0], (len(run.dvl.stamps_ns), 1))
    return replace(
        run,
        imu=imu,
        dvl=replace(run.dvl, velocity=velocity),
        detections=LandmarkDetections(
            stamps_ns=run.imu.stamps_ns[0]
            + np.rint(seconds[seen[:, 0]] * 1e9).astype(np.int64),
            range_m=range_m + 0.02 * NOISE[:n, 0],
            azimuth_rad=np.arctan2(aside_m, ahead_m)[tuple(seen.T)]
            + 0.005 * NOISE[:n, 1],
            range_azimuth_cov=np.full((n, 2, 2), np.nan),
            candidate_ids=seen[:, 1:].astype(np.int64),
            id_probability=np.ones((n, 1)),
        ),
    )


COURSE_RAD = 1.2
SLOW_DIVE = 0.8 * np.sin(0.12 * T)


def diving(
    signs: tuple[float, float, float], depth_sign: float = 1.0, start_z_m: float = -20.0
) -> Sequence:
    """The straight way with a slow dive, which accelerations do not show; depths, headings and fixes on its course."""
    run = straight(1.0)
    velocity = run.dvl.velocity + 0.005 * NOISE[: len(run.dvl)]
    t = (run.dvl.stamps_ns - run.imu.stamps_ns[0]) * 1e-9
    velocity[:, 2] += 0.8 * 0.12 * np.cos(0.12 * t)
    height_m = -20.0 + SLOW_DIVE
    along = 0.9 * T * np.exp(1j * COURSE_RAD)
    places = np.column_stack([along.real, along.imag, height_m]) + 0.2 * NOISE
    ns = run.imu.stamps_ns[::10]
    unknown = np.full(len(ns), np.nan)
    start = Start(position_m=(0.0, 0.0, start_z_m), rpy_rad=(0.0, 0.0, COURSE_RAD))
    return replace(
        run,
        calibration=Calibration(start=start if start_z_m else Start()),
        dvl=replace(run.dvl, velocity=velocity * signs),
        depth=Depth(ns, (depth_sign * height_m + 0.01 * NOISE[:, 0])[::10], unknown),
        heading=Heading(ns, COURSE_RAD + 0.01 * NOISE[::10, 1], unknown),
        positions=PositionFixes(
            ns[::5], places[::50], np.full((len(ns[::5]), 3, 3), np.nan)
        ),
    )


WRONG_SENSES = {
    "nothing": (lambda: diving((1, 1, 1)), ()),
    "all of the Doppler log": (
        lambda: diving((-1, -1, -1)),
        ('`rotation = ["-x", "-y", "-z"]` under [dvl]',),
    ),
    "its z, depths begin at the start": (
        lambda: diving((1, 1, -1)),
        ('`rotation = ["x", "y", "-z"]` under [dvl]',),
    ),
    "its z, no start is stated": (
        lambda: diving((1, 1, -1), start_z_m=0.0),
        ("under [dvl]", "`scale = -1` under [depth]"),
    ),
    "depths above the water": (
        lambda: diving((1, 1, 1), -1.0, start_z_m=0.0),
        ("`scale = -1` under [depth]",),
    ),
}


@pytest.mark.parametrize("wrong", WRONG_SENSES)
def test_of_two_that_run_against_each_other_the_right_one_is_not_asked(wrong: str):
    make, lines = WRONG_SENSES[wrong]
    grave = [f for f in check_sensors(make()) if f.grave]
    asked = {role for f in grave for role in re.findall(r"under \[(\w+)\]", f.line)}
    assert asked == {re.findall(r"\w+", line)[-1] for line in lines}
    assert not [f for f in grave if ".mounting." in f.line]
    assert all(any(line in f.line for f in grave) for line in lines)


@pytest.mark.parametrize("has_sightings", [True, False])
def test_a_clockwise_heading_on_a_straight_way_blames_no_doppler_log_that_fits(
    has_sightings: bool,
):
    run = diving((1, 1, 1))
    heading = replace(run.heading, yaw_rad=np.pi / 2 - run.heading.yaw_rad)
    run = replace(run, heading=heading, calibration=Calibration())
    if not has_sightings:
        run = replace(run, detections=None)
    (found,) = (f for f in check_sensors(run) if f.quantity.endswith("the positions"))
    assert found.grave
    assert '`world = "ned"` under [heading]' in found.line
    assert "`yaw_offset_rad = " in found.line
    assert ("dvl.mounting" in found.line) == (not has_sightings)


def test_ranges_on_a_straight_way_blame_the_scale_and_no_current():
    assert not [f.quantity for f in check_sensors(straight(1.0)) if f.acts]
    (found,) = (f for f in check_sensors(straight(1.2)) if f.acts)
    assert found.quantity.startswith("ranges to landmarks: change")
    assert "range_scale" in found.line
    assert "the scale of the Doppler log" in found.line


def test_right_sensors_have_no_cause():
    assert not [found.quantity for found in check_sensors(observed()) if found.acts]


@pytest.mark.parametrize("wrong", ["heading", "gyros"])
def test_a_scale_of_the_heading_is_told_from_one_of_the_gyros_by_the_fixes(wrong: str):
    """Fixes lie along the true path: its turns are those of the gyros, or those of the heading."""
    run = observed(yaw_rad=1.12 * YAW) if wrong == "heading" else observed()
    if wrong == "gyros":
        rate = run.imu.angular_velocity / 1.12
        run = replace(run, imu=replace(run.imu, angular_velocity=rate))
    acting = [f for f in check_sensors(run) if f.grave]
    (found,) = (f for f in acting if f.quantity.startswith("heading: turn over"))
    assert found.estimate.value == pytest.approx(1.12, abs=0.01)
    line = {
        "heading": "use = false` under [heading]",
        "gyros": "angular_velocity_scale = 1.12",
    }
    assert line[wrong] in found.line
    assert not [f.quantity for f in acting if f.quantity.startswith("position fixes")]


@pytest.mark.parametrize("felt", ["always", "but for a hole", "but for two"])
def test_velocities_that_change_where_no_force_was_measured_have_lost_nothing(
    felt: str,
):
    """The vehicle speeds up in 4 s. Between two holes of the accelerometers no velocity is measured."""
    run = observed()
    t = (run.imu.stamps_ns - run.imu.stamps_ns[0]) * 1e-9
    push = 0.3 * ((t > 30.0) & (t < 34.0))
    force = run.imu.specific_force + push[:, None] * [1.0, 0.0, 0.0]
    if felt != "always":
        force[(t > 29.0) & (t < 35.0)] = np.nan
    if felt == "but for two":
        between = np.searchsorted(t, 32.05)
        force[between] = run.imu.specific_force[between]
    of_dvl = (run.dvl.stamps_ns - run.imu.stamps_ns[0]) * 1e-9
    faster = 0.3 * np.clip(of_dvl - 30.0, 0.0, 4.0)
    velocity = run.dvl.velocity + faster[:, None] * [1.0, 0.0, 0.0]
    run = replace(
        run,
        imu=replace(run.imu, specific_force=force),
        dvl=replace(run.dvl, velocity=velocity),
    )
    assert velocity_steps(run) is None
