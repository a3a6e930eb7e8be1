"""Effect of the constants of iSAM2 that are no settings.

* ``REACH``, ``MOST_FILL``: a survey of 200 landmarks that is repeated every nine minutes (`dense_log.py`). Processor
  seconds of all calls and of the last ten minutes, and joint covariances that were computed for each sonar frame.
* ``FEWEST_TOGETHER``: a mission of 34 minutes with a frame twice a second (`isam2_mission.py`), the same figures.
* ``LEAST_ITERATED``, ``MOST_STEPS``: MRCLAM 9, robot 1, to 15 s after a minimum has vanished (frame 761, 204 s).
  Processor seconds of all calls, and the largest distance of a landmark from the minimum below the live estimate, in
  metres, over the frames since.
* ``LEAST_BIAS_SHARE``: runs over a Doppler gap with position fixes (`gap_fixes.py`). Processor seconds, root mean
  square of the causal error (m), and normalised squared error of the causal position, divided by its 3 dimensions.

There is no target.
"""

import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

FOLDER = Path(__file__).resolve().parent
sys.path += [str(FOLDER.parent), str(FOLDER.parent / "performance"), str(FOLDER)]
from common import make_parser, note, print_table, recording
from dense_log import gaps_m, largest, positions, repeated_survey
from gap_fixes import CASES, drive

from sonar_graph.evaluation import judge, run_estimator
from sonar_graph.logs.convert import read_mrclam
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.slam import Isam2, keyframes
from sonar_graph.slam.smoother import JointCovariance, smoother, solve, window

LAST_NS = 600 * 1_000_000_000
RATE_HZ = 2.0
REACHES = (1.0, 1.25, 1.5, 2.0)
FILLS = (1.2, 1.5, 2.0, np.inf)
FEWEST = (2, 3, 4, 6, np.inf)
SHARES = (0.0, 0.01, 0.1, np.inf)
VANISHED = 761
"""Frame after which the minimum of the live estimate does not exist any more."""
ITERATIONS = ((0.03, 4), (0.03, 20), (0.02, 20), (0.01, 20))


class Effort(NamedTuple):
    """Effort of one run."""

    cpu_s: float
    last_s: float
    """Processor seconds of the last ten minutes."""
    covariances: float
    """Joint covariances for each sonar frame."""


def effort(sequence: Sequence) -> Effort:
    """Process a log, asking after each frame."""
    assert sequence.detections is not None
    stamps_ns = np.unique(sequence.detections.stamps_ns)
    stamps_ns = stamps_ns[stamps_ns > sequence.start_ns]
    estimator = Isam2(sequence.calibration, Odometry(sequence.calibration))
    asked = 0
    compute = JointCovariance.of

    def counted(*arguments: Any) -> JointCovariance:
        nonlocal asked
        asked += 1
        return compute(*arguments)

    JointCovariance.of = counted  # type: ignore[method-assign]
    cpu_s = []
    try:
        for step in sequence.replay(stamps_ns):
            start_s = time.thread_time()
            estimator.process(step)
            cpu_s.append(time.thread_time() - start_s)
    finally:
        JointCovariance.of = compute  # type: ignore[method-assign]
    is_last = stamps_ns > stamps_ns[-1] - LAST_NS
    return Effort(
        sum(cpu_s), float(np.array(cpu_s)[is_last].sum()), asked / len(stamps_ns)
    )


def surveys(
    sequence: Sequence, module: Any, name: str, values: tuple[float, ...]
) -> None:
    """One run for each value of a constant."""
    default = getattr(module, name)
    rows = []
    for value in values:
        note(f"{name} {value:g}")
        setattr(module, name, value)
        rows.append((f"{value:g}", *effort(sequence)))
    setattr(module, name, default)
    print_table((name, "CPU s", "last ten minutes s", "covariances a frame"), rows)


def crossing_m(sequence: Sequence) -> tuple[float, float]:
    """Processor seconds, and the largest distance from the minimum (m), where the minimum below it has vanished."""
    assert sequence.detections is not None
    stamps_ns = np.unique(sequence.detections.stamps_ns)
    stamps_ns = stamps_ns[stamps_ns > sequence.start_ns][: VANISHED + 40]
    estimator = Isam2(sequence.calibration, Odometry(sequence.calibration))
    cpu_s = 0.0
    far_m = []
    for k, step in enumerate(sequence.replay(stamps_ns)):
        start_s = time.thread_time()
        estimator.process(step)
        cpu_s += time.thread_time() - start_s
        # the batch solution costs more than the update: some frames represent the others
        if k > VANISHED and (k - VANISHED) % 5 == 1:
            minimum = solve(estimator.graph, estimator.values)
            live_m = positions(estimator.newest_landmarks())
            far_m.append(largest(gaps_m(minimum, live_m)))
    return cpu_s, max(far_m)


def crossings(sequence: Sequence) -> None:
    """One run for each pair of constants of the iteration."""
    defaults = (smoother.LEAST_ITERATED, smoother.MOST_STEPS)
    rows = []
    for least, most in ITERATIONS:
        note(f"LEAST_ITERATED {least:g}, MOST_STEPS {most}")
        smoother.LEAST_ITERATED = least
        smoother.MOST_STEPS = most
        rows.append((f"{least:g}", most, *crossing_m(sequence)))
    smoother.LEAST_ITERATED, smoother.MOST_STEPS = defaults
    print_table(("LEAST_ITERATED", "MOST_STEPS", "CPU s", "from minimum m"), rows)


def gaps(seeds: int) -> None:
    """Runs over a gap for each least share of the biases."""
    default = keyframes.LEAST_BIAS_SHARE
    rows = []
    for share in SHARES:
        note(f"LEAST_BIAS_SHARE {share:g}")
        keyframes.LEAST_BIAS_SHARE = share
        start_s = time.thread_time()
        squares_m2 = []
        nees = []
        for seed in range(seeds):
            sequence = drive(seed, CASES["fixes"])
            run = run_estimator(sequence, "isam2", rate_hz=RATE_HZ)
            scores = judge(sequence, sequence.instants(RATE_HZ), [run]).scores["isam2"]
            squares_m2.append(scores["causal.ate_raw_m"].value ** 2)
            nees.append(scores["causal.nees_position"].value)
        cpu_s = time.thread_time() - start_s
        rows.append(
            (
                f"{share:g}",
                cpu_s,
                float(np.sqrt(np.mean(squares_m2))),
                float(np.mean(nees)),
            )
        )
    keyframes.LEAST_BIAS_SHARE = default
    print_table(("LEAST_BIAS_SHARE", "CPU s", "causal rms m", "NEES"), rows)


def main() -> None:
    arguments = make_parser(__doc__, data=True).parse_args()
    survey = repeated_survey(4.0 if arguments.quick else 60.0)
    note("warming up: compiled functions load at their first use")
    effort(repeated_survey(2.0))
    surveys(survey, smoother, "REACH", REACHES)
    surveys(survey, window, "MOST_FILL", FILLS)
    duration_s = 240.0 if arguments.quick else 2040.0
    mission = simulate_mission(
        MissionOptions(duration_s=duration_s, landmarks=20, frame_rate_hz=RATE_HZ)
    )
    surveys(mission, window, "FEWEST_TOGETHER", FEWEST)
    if not arguments.quick:
        with recording(arguments.data, "mrclam_ds9.tar.xz", "MRCLAM_Dataset9") as logs:
            crossings(read_mrclam(logs, 1))
    gaps(2 if arguments.quick else 8)


if __name__ == "__main__":
    main()
