"""Time of EKF-SLAM, beside the same filter written with filterpy.

    python benchmarks/performance/ekf_step.py [--quick]

All times are processor times of one thread, so that a busy machine changes them little.

``log_s``: sum of the durations of `EkfSlam.process` over a 34-minute mission (100 Hz IMU, 7 Hz Doppler log, 10 Hz
depth, 2 Hz sonar frames, 20 landmarks), asked for an estimate twice a second; the fastest of three runs. A short run
beforehand on another instance keeps compilation out of it. ``invariant_log_s``: the same of `InvariantEkf`; both take
turns.

``filterpy_ratio``: time per step of the filter in `filterpy_ekf.py` over ours, on the first part of the same log. A
step is the prediction from one DVL node to the next, with the corrections (depth, gravity, detections) on the way. All
are timed from measurements to state: taking in rows, merging and integrating samples, association, prediction,
correction; ours makes the estimate with its covariance twice a second besides. filterpy's filter is the one that its
users write: a prediction of the whole state at every IMU or Doppler sample. ``filterpy_only_ratio`` leaves out of its
time all but its own calls and the building of its matrices.

``filterpy_node_ratio``: the same filterpy filter with our algorithm in it, one prediction a DVL node over the motion
that our compiled code has preintegrated from the samples. What remains is the price of dense matrices and of Python.

The three take turns, and the fastest round of each counts. Targets: ``log_s`` at most 0.5, ``filterpy_ratio`` (the
filter as one writes it) at least 50. ``passed`` says whether both are met; where a full run misses one, the exit code
is 1.

The comparison is void, and the exit code always 1, unless all three filters end in the same state: every number of x,
and of P in units of its sigmas, within 1e-6.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import THREAD_VARIABLES

for variable in THREAD_VARIABLES:
    # before numpy: the processor time of one thread is the whole time
    os.environ.setdefault(variable, "1")

import filterpy_ekf
import numpy as np

from baselines.ekf_slam import COMPASS, EkfSlam
from baselines.invariant_ekf import InvariantEkf
from sonar_graph.measurements import NS_PER_S, Floats, Measurements
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission

FULL_S, QUICK_S = 2040.0, 120.0
FILTERPY_S, FILTERPY_QUICK_S = 120.0, 30.0
RATE_HZ = 2.0
ROUNDS = 3
SAME = 1e-6
MOST_LOG_S, LEAST_FILTERPY_RATIO = 0.5, 50.0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help=f"{QUICK_S:.0f} s of mission instead of {FULL_S:.0f} s",
    )
    quick = parser.parse_args().quick
    sequence = simulate_mission(
        MissionOptions(duration_s=QUICK_S if quick else FULL_S, landmarks=20)
    )
    windows = list(sequence.replay(sequence.instants(RATE_HZ)))
    calibration, kinds = sequence.calibration, (EkfSlam, InvariantEkf)
    for kind in kinds:
        timed_run(kind(calibration, Odometry(calibration)), windows[:60])
    rounds = [
        [timed_run(kind(calibration, Odometry(calibration)), windows) for kind in kinds]
        for _ in range(ROUNDS)
    ]
    durations_s, invariant_s = (
        min(of_kind, key=np.sum) for of_kind in zip(*rounds, strict=True)
    )
    median_us, p99_us = 1e6 * np.percentile(durations_s, [50, 99])
    print(
        f"{len(windows)} updates: median {median_us:.0f} µs, p99 {p99_us:.0f} µs, sum {durations_s.sum():.3f} s"
    )
    compared = compare_filterpy(
        sequence, windows, FILTERPY_QUICK_S if quick else FILTERPY_S
    )
    own = {
        "log_s": float(durations_s.sum()),
        "invariant_log_s": float(invariant_s.sum()),
    }
    figures = own | {"mission_s": sequence.duration_s, **compared}
    passed = meets_targets(figures)
    print(
        json.dumps(
            {name: float(f"{value:.4g}") for name, value in figures.items()}
            | {"passed": passed}
        )
    )
    return exit_code(figures, quick=quick)


def is_same(figures: dict[str, float]) -> bool:
    """Check that all filters end in one state."""
    return figures["difference"] < SAME


def meets_targets(figures: dict[str, float]) -> bool:
    """Check that the comparison is valid and both targets are met."""
    fast = (
        figures["log_s"] <= MOST_LOG_S
        and figures["filterpy_ratio"] >= LEAST_FILTERPY_RATIO
    )
    return bool(fast and is_same(figures))


def exit_code(figures: dict[str, float], *, quick: bool) -> int:
    """A short run is not held to the targets, which are about a full one."""
    return 0 if (is_same(figures) if quick else meets_targets(figures)) else 1


def timed_run(slam: EkfSlam | InvariantEkf, windows: list[Measurements]) -> Floats:
    durations_s = []
    for window in windows:
        before = time.thread_time()
        slam.process(window)
        durations_s.append(time.thread_time() - before)
    return np.array(durations_s)


def compare_filterpy(
    sequence: Sequence, windows: list[Measurements], part_s: float
) -> dict[str, float]:
    until_ns = sequence.start_ns + round(part_s * NS_PER_S)
    part = [window for window in windows if window.end_ns <= until_ns]
    ours_s, sample_s, node_s, in_filterpy_s = [], [], [], []
    for _ in range(ROUNDS):
        ours = EkfSlam(sequence.calibration, Odometry(sequence.calibration))
        ours_s.append(timed_run(ours, part).sum())
        seconds, by_sample = timed_filterpy(
            sequence, part[-1].end_ns, predicts_by_node=False
        )
        sample_s.append(seconds)
        in_filterpy_s.append(by_sample.seconds)
        seconds, by_node = timed_filterpy(
            sequence, part[-1].end_ns, predicts_by_node=True
        )
        node_s.append(seconds)
    steps, worst = (
        by_sample.nodes,
        max(difference(ours, by_sample), difference(ours, by_node)),
    )
    print(
        f"{steps} steps, {len(by_sample.x)} states: ours {1e6 * min(ours_s) / steps:.0f} µs a step, filterpy with a"
        f" prediction a sample {1e6 * min(sample_s) / steps:.0f} µs, of these {1e6 * min(in_filterpy_s) / steps:.0f} in"
        f" filterpy itself, with a prediction a node {1e6 * min(node_s) / steps:.0f} µs; they differ by {worst:.0e}"
    )
    return {
        "filterpy_ratio": min(sample_s) / min(ours_s),
        "filterpy_only_ratio": min(in_filterpy_s) / min(ours_s),
        "filterpy_node_ratio": min(node_s) / min(ours_s),
        "states": len(by_sample.x),
        "difference": worst,
    }


def timed_filterpy(
    sequence: Sequence, until_ns: int, *, predicts_by_node: bool
) -> tuple[float, filterpy_ekf.FilterpyRun]:
    before = time.thread_time()
    run = filterpy_ekf.run(sequence, until_ns, predicts_by_node=predicts_by_node)
    return time.thread_time() - before, run


def difference(ours: EkfSlam, theirs: filterpy_ekf.FilterpyRun) -> float:
    node_ns, x, P = ours.state()
    x, P = np.delete(x, COMPASS), np.delete(np.delete(P, COMPASS, 0), COMPASS, 1)
    if (node_ns, len(x)) != (theirs.node_ns, len(theirs.x)):
        return np.inf
    sigma = np.sqrt(np.diag(P))
    return float(
        max(
            np.abs(theirs.x - x).max(),
            np.abs((theirs.P - P) / np.outer(sigma, sigma)).max(),
        )
    )


if __name__ == "__main__":
    sys.exit(main())
