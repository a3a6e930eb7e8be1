"""The offset between the clocks of images and navigation, on steps whose motion is known."""

import re
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sonar_graph.errors import LogError
from sonar_graph.measurements import Floats
from sonar_graph.recognition import (
    ClockOffset,
    ImageMotions,
    PlanarStep,
    estimate_offset,
)
from tests.recognition.imaged_lane import Lane

RANGE_M = 1.9
NOISE = np.array([0.003, 0.002, 0.001])
"""Of yaw, of the motion ahead and of the motion across at the range."""


@pytest.fixture(scope="module")
def steps(lane: Lane) -> list[PlanarStep]:
    """True motion of the lane in the sonar's plane, with the noise of motion from images."""
    body_T_sonar = lane.sequence.calibration.sonar.mounting.pose()
    rng = np.random.default_rng(3)
    stamps = lane.frames.stamps_ns[
        lane.frames.stamps_ns <= lane.sequence.truth.stamps_ns[-1]
    ]
    poses = lane.sequence.truth.at(stamps)
    sonar = [
        gtsam.Pose3(gtsam.Rot3(R), t) * body_T_sonar
        for R, t in zip(poses.matrices, poses.positions, strict=True)
    ]
    found = []
    for k in range(1, len(sonar)):
        tangent = gtsam.Pose3.Logmap(sonar[k - 1].inverse() * sonar[k])
        yaw, ahead, across = NOISE * rng.standard_normal(3)
        motion = tangent[[2, 3, 4]] + np.array([yaw, ahead, across - RANGE_M * yaw])
        found.append(
            PlanarStep(
                int(stamps[k - 1]),
                int(stamps[k]),
                motion,
                np.diag(NOISE**2),
                is_measured=True,
            )
        )
    return found


def moved(steps: list[PlanarStep], offset_s: float) -> list[PlanarStep]:
    shift = round(offset_s * 1e9)
    return [
        replace(step, start_ns=step.start_ns - shift, end_ns=step.end_ns - shift)
        for step in steps
    ]


def estimated(
    lane: Lane, steps: list[PlanarStep], offset_s: float, **search: float
) -> ClockOffset:
    return estimate_offset(moved(steps, offset_s), lane.sequence, RANGE_M, **search)


@pytest.mark.parametrize("offset_s", [0.0, 1.37, -4.2])
def test_an_offset_is_found_within_its_sigma(lane, steps, offset_s):
    found = estimated(lane, steps, offset_s)
    assert abs(found.seconds - offset_s) < 3 * found.sigma_s + 0.01
    assert found.sigma_s < 0.1
    assert re.match(
        r"[+-]\d\.\d{3} s ± 0\.\d{3} s \(1 sigma\), from \d+ steps", str(found)
    )


def test_an_offset_is_searched_about_what_was_stated(lane, steps):
    found = estimated(lane, steps, 50.3, around_s=50.0, search_s=2.0)
    assert abs(found.seconds - 50.3) < 3 * found.sigma_s + 0.01


def test_steps_that_err_wildly_are_left_out(lane, steps):
    wild: list[PlanarStep] = list(steps)
    for k in range(5, len(wild), 17):
        wild[k] = replace(wild[k], motion=np.array([0.15, -0.3, 0.3]))
    found = estimated(lane, wild, 0.9)
    assert abs(found.seconds - 0.9) < 3 * found.sigma_s + 0.02


def replaced(steps: list[PlanarStep], motions: Floats) -> list[PlanarStep]:
    return [
        replace(step, motion=motion)
        for step, motion in zip(steps, motions, strict=True)
    ]


def test_images_that_cannot_tell_are_refused_with_the_reason(lane, steps):
    noise = NOISE * np.random.default_rng(4).standard_normal((len(steps), 3))
    with pytest.raises(
        LogError, match=r"do not determine .*; state it with --offset SECONDS"
    ):
        estimated(lane, replaced(steps, noise), 0.0)
    with pytest.raises(
        LogError, match=r"\d+ of \d+ steps between them could be measured"
    ):
        estimated(lane, [replace(step, is_measured=False) for step in steps], 0.0)
    with pytest.raises(
        LogError, match=r"fewer than 50 steps between them lie in IMU and"
    ):
        estimated(lane, steps, 500.0)
    with pytest.raises(
        LogError, match=r"is at the end of the search; give a longer --search"
    ):
        estimated(lane, steps, 1.5, search_s=1.4)


def test_the_motion_of_images_tells_the_offset(lane):
    motions = ImageMotions(lane.sequence.calibration.model_copy(update={"floor": None}))
    seen = [
        step
        for row in range(len(lane.frames))
        if (step := motions.add(lane.one(row))) is not None
    ]
    found = estimated(lane, seen, -0.8)
    assert abs(found.seconds + 0.8) < 3 * found.sigma_s + 0.01
    assert min(found.correlations) > 0.9
