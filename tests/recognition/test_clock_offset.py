"""The offset between the clocks of images and navigation, on steps whose motion is known."""

import re
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from sonar_graph.errors import LogError
from sonar_graph.recognition import (
    ClockOffset,
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
    rng = np.random.default_rng(3)
    stamps = pairwise(lane.frames.stamps_ns.tolist())
    found = []
    for begin_and_end_ns, step in zip(stamps, lane.true_steps(), strict=False):
        yaw, ahead, across = NOISE * rng.standard_normal(3)
        noise = np.array([yaw, ahead, across - RANGE_M * yaw])
        motion = gtsam.Pose3.Logmap(step)[[2, 3, 4]] + noise
        found.append(PlanarStep(*begin_and_end_ns, motion, np.diag(NOISE**2), True))
    return found


def estimated(
    lane: Lane, steps: list[PlanarStep], offset_s: float, **search: float
) -> ClockOffset:
    """Of images that are stamped early by so much."""
    shift = round(offset_s * 1e9)
    moved = [
        replace(step, start_ns=step.start_ns - shift, end_ns=step.end_ns - shift)
        for step in steps
    ]
    return estimate_offset(moved, lane.sequence, RANGE_M, **search)


@pytest.mark.parametrize(
    ("offset_s", "search"),
    [(1.37, {}), (-4.2, {}), (50.3, {"around_s": 50.0, "search_s": 2.0})],
)
def test_an_offset_is_found_within_its_sigma(lane, steps, offset_s, search):
    found = estimated(lane, steps, offset_s, **search)
    assert abs(found.seconds - offset_s) < 3 * found.sigma_s + 0.01
    assert found.sigma_s < 0.1
    assert min(found.correlations) > 0.9
    assert re.match(
        r"[+-]\d+\.\d{3} s ± 0\.\d{3} s \(1 sigma\), from \d+ steps", str(found)
    )


def test_steps_that_err_wildly_are_left_out(lane, steps):
    wild = list(steps)
    for k in range(5, len(wild), 17):
        wild[k] = replace(wild[k], motion=np.array([0.15, -0.3, 0.3]))
    found = estimated(lane, wild, 0.9)
    assert abs(found.seconds - 0.9) < 3 * found.sigma_s + 0.02


def test_images_that_cannot_tell_are_refused_with_the_reason(lane, steps):
    rng = np.random.default_rng(4)
    noise = [replace(s, motion=NOISE * rng.standard_normal(3)) for s in steps]
    not_measured = [replace(step, is_measured=False) for step in steps]
    for given, offset_s, search_s, words in (
        (noise, 0.0, 10.0, r"do not determine .*; state it with --offset SECONDS"),
        (not_measured, 0.0, 1.0, r"\d+ of \d+ steps between them could be measured"),
        (steps, 500.0, 1.0, r"fewer than 50 steps between them lie in IMU and"),
        (steps, 1.5, 1.4, r"is at the end of the search; give a longer --search"),
    ):
        with pytest.raises(LogError, match=words):
            estimated(lane, given, offset_s, search_s=search_s)
