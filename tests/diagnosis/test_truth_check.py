"""A start that the truth or the true landmarks contradict is grave, and so is a truth that the sensors contradict."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Start
from sonar_graph.diagnosis import Finding
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.truth_check import start_place_findings
from sonar_graph.measurements import NS_PER_S, Floats
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.states import Trajectory

from .runs import (
    compass,
    grave,
    level_vehicle,
    names,
    spoilt,
    started,
    true_yaw,
)

BASIN = simulate_basin(BasinOptions(seed=3, duration_s=120.0, laps=1))
UNKNOWN = replace(BASIN, truth=None)
PLACE = BASIN.calibration.start.position_m


def stated(
    east_m: float = 0.0, turn_rad: float = 0.0, yaw_sigma_rad: float = 0.01
) -> Start:
    """The right start, moved and turned."""
    return Start(
        rpy_sigma_rad=(0.01, 0.01, yaw_sigma_rad),
        position_m=tuple(np.add(PLACE, [east_m, 0.0, 0.0])),
        rpy_rad=tuple(np.add(BASIN.calibration.start.rpy_rad, [0.0, 0.0, turn_rad])),
    )


def moved(truth: Trajectory, positions: Floats) -> Trajectory:
    """The truth at other positions."""
    return replace(truth, positions=positions)


def turned(truth: Trajectory, quaternions_xyzw: Floats) -> Trajectory:
    """The truth with other orientations."""
    return replace(truth, quaternions_xyzw=quaternions_xyzw)


def still(truth: Trajectory) -> Trajectory:
    """The truth with a position that is repeated for half a minute."""
    t = (truth.stamps_ns - truth.stamps_ns[0]) / NS_PER_S
    held = np.where(
        (t > 40.0) & (t < 70.0), np.searchsorted(t, 40.0), np.arange(len(t))
    )
    return moved(truth, truth.positions[held])


def wild(truth: Trajectory) -> Trajectory:
    """The truth with the origin in single rows, as of a tracker that saw nothing."""
    is_lost = np.arange(len(truth)) % 60 == 7
    return moved(truth, np.where(is_lost[:, None], 0.0, truth.positions))


def jumped(truth: Trajectory) -> Trajectory:
    """The truth with another origin from the middle on."""
    is_late = np.arange(len(truth)) > len(truth) // 2
    return moved(truth, truth.positions + np.outer(is_late, [1.0, 0.5, 0.0]))


WRONG_TRUTHS = {
    "w first": (
        lambda truth: turned(truth, np.roll(truth.quaternions_xyzw, 1, axis=1)),
        "quaternions are x, y, z, w",
    ),
    "of the world in the body": (
        lambda truth: turned(truth, truth.rotations().inv().as_quat()),
        "of the body in the world",
    ),
    "of a body with z down": (
        lambda truth: turned(
            truth, (truth.rotations() * Rotation.from_euler("x", np.pi)).as_quat()
        ),
        '`rotation = "frd"` under [truth]',
    ),
    "heights downwards": (
        lambda truth: moved(truth, truth.positions * [1.0, 1.0, -1.0]),
        "turn the sign of its z",
    ),
    "of the markers": (
        lambda truth: moved(
            truth, truth.positions + truth.rotations().apply([0.8, 0.0, 0.0])
        ),
        "take [0.80, 0.00] off each `translation_m`",
    ),
    "stands still": (still, "leaves it out, --start and --end"),
    "jumps": (jumped, "`use = false` under [truth]"),
    "wild rows": (wild, "leave these rows out"),
    "GPS time": (
        lambda truth: replace(truth, stamps_ns=truth.stamps_ns + 18 * NS_PER_S),
        "`stamp_offset_s = -18.0",
    ),
}


@pytest.mark.parametrize("fault", WRONG_TRUTHS)
def test_a_truth_that_the_sensors_contradict_is_named_with_its_line(fault):
    spoil, line = WRONG_TRUTHS[fault]
    found = grave(replace(BASIN, truth=spoil(BASIN.truth)))
    assert [one.quantity.partition(" ")[0].strip(":") for one in found[:1]] == [
        "reference"
    ]
    assert line in found[0].line


def driven(speed_m_s: Floats, yaw_rate: Floats) -> Sequence:
    """A level drive at 50 Hz with its exact truth at 10 Hz."""
    velocity = np.outer(speed_m_s, [1.0, 0.0, 0.0])
    run = level_vehicle(velocity, yaw_rate, seed=3)
    yaw_rad = np.append(0.0, np.cumsum(yaw_rate)[:-1] / 50.0)
    ahead = np.column_stack([np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(yaw_rad)])
    steps_m = speed_m_s[:, None] * ahead / 50.0
    positions = np.vstack([np.zeros(3), np.cumsum(steps_m, axis=0)[:-1]])
    turns = Rotation.from_euler("z", yaw_rad[:, None]).as_quat()
    rows = slice(None, None, 5)
    truth = Trajectory.without_covariances(
        run.imu.stamps_ns[rows], positions[rows], turns[rows]
    )
    return replace(run, truth=truth)


def test_a_vehicle_that_rests_gives_its_right_truth_no_arm():
    t = np.arange(0.0, 240.0, 0.02)
    moves = np.clip(np.abs(t - 130.0) - 65.0, 0.0, 3.0) / 3.0
    run = driven(0.4 * moves, 0.25 * moves * np.sin(0.11 * t))
    assert grave(run) == []


def test_a_long_way_is_compared_with_another_clock_too():
    t = np.arange(0.0, 240.0, 0.02)
    run = driven(np.full_like(t, 1.2), 0.04 * np.sin(0.03 * t) + 0.02)
    late = replace(run.truth, stamps_ns=run.truth.stamps_ns + 37 * NS_PER_S)
    (found,) = grave(replace(run, truth=late))
    assert found.estimate.value == pytest.approx(37.0, abs=0.1)


@pytest.mark.parametrize("speed_m_s", [0.5, 0.02])
def test_a_doppler_log_over_moving_water_is_not_the_truths_fault(speed_m_s):
    t = np.arange(0.0, 240.0, 0.02)
    run = driven(np.full_like(t, speed_m_s), 0.15 * np.sin(0.1 * t))
    yaw_rad = true_yaw(run)[::2]
    water = 0.2 * np.column_stack([np.cos(yaw_rad), -np.sin(yaw_rad), 0.0 * yaw_rad])
    drifting = spoilt(run, "dvl", velocity=run.dvl.velocity + water)
    (found,) = grave(drifting)
    assert found.quantity == "reference: current"
    assert "bottom track under [dvl]" in found.line


def test_wrong_gyros_that_a_compass_shows_are_not_the_truths_fault():
    t = np.arange(0.0, 240.0, 0.02)
    run = compass(driven(np.full_like(t, 0.5), 0.15 * np.sin(0.1 * t)))
    fast = spoilt(run, "imu", angular_velocity=1.5 * run.imu.angular_velocity)
    found = grave(fast)
    assert found
    assert not any(one.quantity.startswith("reference") for one in found)


def test_orientations_of_another_time_are_orientations_of_something_else():
    t = np.arange(0.0, 240.0, 0.02)
    run = driven(np.full_like(t, 0.5), 0.15 * np.sin(0.1 * t + 1e-3 * t**2))
    late = np.roll(run.truth.quaternions_xyzw, 200, axis=0)
    found, *_ = grave(replace(run, truth=turned(run.truth, late)))
    assert found.quantity == "reference: turn over that of the gyros"


def test_a_noisy_first_position_does_not_contradict_the_start():
    truth = BASIN.truth.rows(np.arange(0, len(BASIN.truth), 25))
    noise = np.random.default_rng(2).normal(0.0, 0.4, (len(truth), 3))
    noise[:3] = [0.8, -0.6, 0.0]
    positions = Trajectory.of_positions(truth.stamps_ns, truth.positions + noise)
    assert grave(replace(BASIN, truth=positions)) == []


@pytest.mark.parametrize("noise_m", [0.02, 0.3])
def test_a_noisy_truth_of_positions_alone_is_right(noise_m):
    rows = np.arange(0, len(BASIN.truth), round(0.3 / noise_m) * 5 + 5)
    noise = np.random.default_rng(4).normal(0.0, noise_m, (len(rows), 3))
    truth = BASIN.truth.rows(rows)
    positions = Trajectory.of_positions(truth.stamps_ns, truth.positions + noise)
    assert grave(replace(BASIN, truth=positions)) == []


def of_place(run: Sequence) -> list[Finding]:
    """Findings about the place of the start alone."""
    return list(start_place_findings(run, BodyMotion.of(run)))


def test_a_start_that_agrees_is_not_named():
    assert grave(started(BASIN, stated(east_m=0.3))) == []
    assert of_place(started(UNKNOWN, stated(east_m=0.3))) == []


def test_a_start_far_from_the_truth_is_named_with_the_line_that_mends_it():
    found, *_ = grave(started(BASIN, stated(east_m=-2.0)))
    assert found.quantity == "start position: distance from the truth"
    assert found.estimate.value == pytest.approx(2.0, abs=0.05)
    assert "`start.position_m = [" in found.line


def test_without_a_truth_the_map_contradicts_a_wrong_start():
    run = started(UNKNOWN, stated(east_m=2.0))
    assert names(grave(run)) == ["start pose"]
    assert of_place(replace(run, true_landmarks=None)) == []


@pytest.mark.parametrize(("yaw_sigma_rad", "is_named"), [(0.01, True), (1.0, False)])
def test_the_yaw_sigma_of_a_start_makes_the_places_of_landmarks_unsure(
    yaw_sigma_rad, is_named
):
    start = stated(turn_rad=1.0, yaw_sigma_rad=yaw_sigma_rad)
    assert bool(of_place(started(UNKNOWN, start))) == is_named


def test_a_start_that_defines_the_world_contradicts_nothing():
    anywhere = Start(position_m=(20.0, 0.0, PLACE[2]), source="vehicle")
    assert of_place(started(UNKNOWN, anywhere)) == []
