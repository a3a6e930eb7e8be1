"""Calls of Python functions for each sonar frame: unlike a time, the count does not depend on the load of the machine.

Counted are calls of functions of `sonar_graph` and `baselines`, and each item of a generator. Code compiled by numba
makes no Python call. Comprehensions are not counted: from Python 3.12 on they are no functions.
"""

import gc
import sys
from collections import Counter
from pathlib import Path
from types import FrameType

import numpy as np
import pytest

import baselines
import sonar_graph
from sonar_graph import Odometry, Sequence, load_estimator
from sonar_graph.measurements import Measurements
from sonar_graph.simulation import MissionOptions, simulate_mission

# Calls for each sonar frame. To accept a new number, write the measured one here.
ACCEPTED = {
    "dead-reckoning": 141.5,
    "ekf-slam": 75.8,
    "invariant-ekf": 100.4,
    # sightings that share a factor are linearised by a call: more calls in a short run, less time in a long one
    "isam2": 283.6,
}
MOST_GROWTH = 1.1
"""A count may grow by a tenth."""
NOT_COUNTED = ("<listcomp>", "<dictcomp>", "<setcomp>")
FOLDERS = tuple(
    f"{Path(str(package.__file__)).parent}/" for package in (sonar_graph, baselines)
)
MOST_NAMED = 8
"""Functions named in a failure."""


@pytest.fixture(scope="module")
def mission() -> Sequence:
    return simulate_mission(
        MissionOptions(duration_s=40.0, landmarks=12, frame_rate_hz=2.0, seed=3)
    )


def run(sequence: Sequence, name: str, steps: list[Measurements]) -> None:
    estimator = load_estimator(name)(
        sequence.calibration, Odometry(sequence.calibration)
    )
    for step in steps:
        estimator.process(step)


def calls(sequence: Sequence, name: str, steps: list[Measurements]) -> Counter[str]:
    """Number of calls of each function while an estimator processes all steps."""
    found: Counter[str] = Counter()

    def count(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if (
            event == "call"
            and code.co_name not in NOT_COUNTED
            and code.co_filename.startswith(FOLDERS)
        ):
            found[f"{Path(code.co_filename).name}: {code.co_qualname}"] += 1

    # what is compiled or cached at the first use is not counted
    run(sequence, name, steps)
    gc.disable()  # a finaliser would be counted wherever the collector happens to run
    before = sys.getprofile()
    sys.setprofile(count)
    try:
        run(sequence, name, steps)
    finally:
        sys.setprofile(before)
        gc.enable()
    return found


@pytest.mark.parametrize("name", ACCEPTED)
def test_calls_for_each_frame_do_not_grow(mission: Sequence, name: str) -> None:
    assert mission.detections is not None
    frames = np.unique(mission.detections.stamps_ns)
    frames = frames[(frames > mission.start_ns) & (frames <= mission.end_ns)]
    steps = list(mission.replay(frames))
    found = calls(mission, name, steps)
    measured = found.total() / len(steps)
    most = ", ".join(
        f"{function} {count / len(steps):.1f}"
        for function, count in found.most_common(MOST_NAMED)
    )
    assert measured <= MOST_GROWTH * ACCEPTED[name], (
        f"{name}: {measured:.1f} calls a frame, accepted {ACCEPTED[name]:.1f}. Most: {most}."
        f' If the growth is meant, set ACCEPTED["{name}"] = {measured:.1f} in {Path(__file__).name}.'
    )
