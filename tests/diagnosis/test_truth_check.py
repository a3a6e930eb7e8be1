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

from .runs import grave, names, started

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
