"""What EKF-SLAM costs, beside the same filter written with filterpy.

    python benchmarks/performance/ekf_step.py [--quick]

``log_s``: sum of the durations of `EkfSlam.process` over a 34-minute mission (100 Hz IMU, 7 Hz Doppler log, 10 Hz depth,
2 Hz sonar frames, 20 landmarks), asked for an estimate twice a second. The first call, which may compile, is made
beforehand on another instance.

``filterpy_ratio``: time per step of the filter in `filterpy_ekf.py` over ours, on the first part of the same log. A step
is the prediction from one DVL node to the next, with the corrections (depth, gravity, detections) on the way. Ours is
timed with everything that `process` does: taking in rows, merging and integrating samples, association, the estimate
with its covariance. filterpy's is timed in its own calls and in building its matrices only: the integrated motion of each
sample is handed to it ready-made. Both run on one thread.

The comparison counts only if both filters end in the same state: 1e-6 in every number of x, and of P relative to its
sigmas.
"""

from __future__ import annotations

import os

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import argparse
import json
import sys
import time
from collections.abc import Sequence as Ordered

import filterpy_ekf
import numpy as np

from baselines.ekf_slam import EkfSlam
from sonar_graph.measurements import Measurements
from sonar_graph.sequence import NS_PER_S, Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission

FULL_S, QUICK_S = 2040.0, 120.0
FILTERPY_S, FILTERPY_QUICK_S = 120.0, 30.0
RATE_HZ = 2.0
SAME = 1e-6


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_S:.0f} s instead of {FULL_S:.0f} s")
    quick = parser.parse_args().quick
    sequence = simulate_mission(MissionOptions(duration_s=QUICK_S if quick else FULL_S, landmarks=20))
    windows = list(sequence.replay(sequence.instants(RATE_HZ)))
    compile_once(sequence, windows)
    durations = timed_run(EkfSlam(sequence.calibration), windows)
    print(
        f"{len(windows)} updates, median {1e6 * np.median(durations):.0f} µs, p99 {1e6 * np.percentile(durations, 99):.0f} µs"
    )
    part_s = FILTERPY_QUICK_S if quick else FILTERPY_S
    figures = {
        "log_s": durations.sum(),
        "mission_s": sequence.duration_s,
        **compare_filterpy(sequence, windows, part_s),
    }
    print(json.dumps({name: round(float(value), 9) for name, value in figures.items()}))
    return 0 if figures["difference"] < SAME else 1


def compile_once(sequence: Sequence, windows: Ordered[Measurements]) -> None:
    timed_run(EkfSlam(sequence.calibration), windows[:60])


def timed_run(slam: EkfSlam, windows: Ordered[Measurements]) -> np.ndarray:
    durations = []
    for window in windows:
        before = time.perf_counter()
        slam.process(window)
        durations.append(time.perf_counter() - before)
    return np.array(durations)


def compare_filterpy(sequence: Sequence, windows: Ordered[Measurements], part_s: float) -> dict[str, float]:
    until_ns = sequence.start_ns + round(part_s * NS_PER_S)
    part = [window for window in windows if window.end_ns <= until_ns]
    ours = EkfSlam(sequence.calibration)
    ours_s = timed_run(ours, part).sum()
    node_ns, x, P = ours.state()
    theirs = filterpy_ekf.run(sequence, part[-1].end_ns)
    assert theirs.node_ns == node_ns
    sigma = np.sqrt(np.diag(P))
    difference = max(np.abs(theirs.x - x).max(), np.abs((theirs.P - P) / np.outer(sigma, sigma)).max())
    print(f"{theirs.nodes} steps, {len(x)} states: ours {1e6 * ours_s / theirs.nodes:.0f} µs a step, "
          f"filterpy {1e6 * theirs.seconds / theirs.nodes:.0f} µs; they differ by {difference:.1e}")  # fmt: skip
    return {"filterpy_ratio": theirs.seconds / ours_s, "difference": difference, "states": len(x)}


if __name__ == "__main__":
    sys.exit(main())
