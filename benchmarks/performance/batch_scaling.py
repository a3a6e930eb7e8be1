"""A batch scales over local workers, and a run costs little beside reading its log and estimating.

The same runs of a short basin are done by one worker and by several, in new folders, each time with the start of the
cluster. The overhead of a run is the time from one run being kept to the next with one worker, less what the run itself
spent on reading or simulating its log and on estimating.
"""

import sys
import tempfile
import time
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))
import numpy as np
from common import conclude, make_parser, note, print_table
from dask.system import CPU_COUNT

from sonar_graph.batch import Batch, Limits, Where, read_suite
from sonar_graph.batch.store import PlannedRun, RunOutcome

SUITE = """
name = "scaling"
reference = "isam2"

[[logs]]
name = "short basin"
generator = "basin"
options = {{ duration_s = 300, laps = 1 }}
seeds = {seeds}

[[estimators]]
name = "isam2"
"""
TARGETS = {2: 1.7, 4: 3.2}
"""Least ratio by number of workers."""
LEAST_RUNS = 200
OVERHEAD_S = 0.05


class Stopwatch:
    """When each run was kept, and what it spent on itself."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._kept: list[tuple[float, float]] = []

    def keep(self, _run: PlannedRun, outcome: RunOutcome) -> None:
        """Note a run."""
        row = outcome.row
        assert row["status"] == "ok", row["reason"]
        self._kept.append(
            (
                time.perf_counter(),
                float(row["read_s"] or 0) + float(row["estimate_s"] or 0),
            )
        )

    def total_s(self) -> float:
        """From the start of the cluster to the last run."""
        return self._kept[-1][0] - self._began

    def overhead_s(self) -> float:
        """Median over runs, for one worker."""
        kept, own_s = np.array(self._kept).T
        return float(np.median(np.diff(kept) - own_s[1:]))


def measure(suite: Path, folder: Path, workers: int) -> Stopwatch:
    """All runs by so many workers."""
    file = read_suite(suite)
    watch = Stopwatch()
    with Batch.opened(file, folder) as batch:
        batch.run(Where(workers), Limits(file.suite.timeout_s), watch.keep)
    note(f"{workers} workers: {watch.total_s():.1f} s")
    return watch


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--workers",
        type=int,
        default=min(4, CPU_COUNT),
        help="beside one (default: cores, at most 4)",
    )
    parser.add_argument(
        "--runs", type=int, default=LEAST_RUNS, help=f"seeds (default: {LEAST_RUNS})"
    )
    arguments = parser.parse_args()
    runs = 8 if arguments.quick else arguments.runs
    with tempfile.TemporaryDirectory() as scratch:
        suite = Path(scratch) / "suite.toml"
        suite.write_text(SUITE.format(seeds=1))
        # kernels are compiled once on a machine
        measure(suite, Path(scratch) / "warm", 1)
        suite.write_text(SUITE.format(seeds=runs))
        one = measure(suite, Path(scratch) / "one", 1)
        many = measure(suite, Path(scratch) / "many", arguments.workers)
    target = TARGETS.get(arguments.workers, 0.8 * arguments.workers)
    figures = {
        "runs": runs,
        "workers": arguments.workers,
        "cores": CPU_COUNT,
        "one_s": one.total_s(),
        "many_s": many.total_s(),
        "speedup_ratio": one.total_s() / many.total_s(),
        "overhead_s": one.overhead_s(),
    }
    figures["passed"] = (
        figures["speedup_ratio"] >= target and figures["overhead_s"] < OVERHEAD_S
    )
    print_table(
        ("", "measured", "target"),
        [
            (
                f"speedup, {arguments.workers} workers",
                figures["speedup_ratio"],
                f"at least {target:g}",
            ),
            ("overhead of a run, s", figures["overhead_s"], f"below {OVERHEAD_S:g}"),
        ],
    )
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
