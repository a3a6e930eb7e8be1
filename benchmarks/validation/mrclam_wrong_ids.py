"""Cost of wrong identities on real data: MRCLAM data set 6 with 10 % of its landmark identities falsified.

Each detection's identity is replaced, with the probability `SHARE` and independently, by one drawn evenly from the
other landmarks that the robot sees; ``numpy.random.default_rng([SEED, robot])``. Posteriors stay 1: the recogniser is
as sure as it was. Every policy of iSAM2, and both filters, run on the data as they are and as falsified, all else by
default, at 2 Hz. Errors are horizontal rms after the best SE(2) alignment, means over robots 1 to 5.

A run that fails, or is farther off than `LOST_M`, is counted as lost; means are over all that do not fail.
"""

import dataclasses
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, print_table, recording

from sonar_graph.evaluation import judge, run_estimator
from sonar_graph.logs.convert import read_mrclam
from sonar_graph.sequence import Sequence

ROBOTS = (1, 2, 3, 4, 5)
SHARE, SEED, RATE_HZ, LOST_M = 0.1, 6, 2.0, 1.0
POLICIES = ("gate", "robust", "max-mixture")
ESTIMATORS: dict[str, tuple[str, dict[str, Any]]] = {
    **{
        f"isam2 {policy}": ("isam2", {"identity": {"policy": policy}})
        for policy in POLICIES
    },
    "isam2 gate alone": (
        "isam2",
        {"identity": {"policy": "gate"}, "kernel": {"shape": "none"}},
    ),
    "ekf-slam": ("ekf-slam", {}),
    "invariant-ekf": ("invariant-ekf", {}),
}
BEST, PLAIN = "max-mixture", "robust"
"""Policy that is to stand wrong identities, and the default one, against which any may cost so much more."""
LARGEST_GROWTH, LARGEST_COST = 1.25, 1.03
Errors = dict[str, float]
"""By figure; NaN where a run failed."""


def falsified(sequence: Sequence, share: float, seed: list[int]) -> Sequence:
    """The sequence with a share of its identities replaced by others, as surely stated."""
    detections = sequence.detections
    assert detections is not None
    rng = np.random.default_rng(seed)
    ids = detections.candidate_ids.copy()
    known = np.unique(ids)
    for row in np.flatnonzero(rng.random(len(ids)) < share):
        ids[row, 0] = rng.choice(known[known != ids[row, 0]])
    return dataclasses.replace(
        sequence, detections=dataclasses.replace(detections, candidate_ids=ids)
    )


def run_case(folder: Path, case: tuple[int, float, str]) -> Errors:
    """One robot, one share of wrong identities, one estimator."""
    robot, share, label = case
    sequence = falsified(read_mrclam(folder, robot), share, [SEED, robot])
    instants = sequence.instants(RATE_HZ)
    name, settings = ESTIMATORS[label]
    run = run_estimator(
        sequence, name, settings, instants_ns=instants, interim_maps=False
    )
    if run.status == "failed":
        return dict.fromkeys(
            ("smoothed", "causal", "landmarks", "time_s"), float("nan")
        )
    (scores,) = judge(sequence, instants, [run]).scores.values()
    causal = scores["causal.ate_se2_m"].value
    smoothed = (
        scores["smoothed.ate_se2_m"].value if "smoothed.ate_se2_m" in scores else causal
    )
    return {
        "smoothed": smoothed,
        "causal": causal,
        "landmarks": scores["landmarks.se2_m"].value,
        "time_s": scores["time.total_s"].value,
    }


def collect(cases: list[tuple[int, float, str]], runs: list[Errors]) -> dict[str, Any]:
    """Means over the robots, growths and lost runs, by estimator."""
    figures: dict[str, Any] = {}
    for label in ESTIMATORS:
        for share, word in ((0.0, "right"), (SHARE, "wrong")):
            chosen = [
                run
                for (_, s, name), run in zip(cases, runs, strict=True)
                if (s, name) == (share, label)
            ]
            key = label.replace(" ", "_").replace("-", "_")
            for figure in ("smoothed", "causal", "landmarks", "time_s"):
                mean = float(np.mean([run[figure] for run in chosen]))
                figures[f"{key}_{figure}_{word}"] = mean if np.isfinite(mean) else None
            figures[f"{key}_lost_{word}"] = sum(
                not run["smoothed"] <= LOST_M for run in chosen
            )
        right, wrong = (
            figures[f"{key}_smoothed_right"],
            figures[f"{key}_smoothed_wrong"],
        )
        figures[f"{key}_growth"] = wrong / right if right and wrong else None
    return figures


def is_met(figures: dict[str, Any]) -> bool:
    """Check that the best policy stands wrong identities, and no policy costs accuracy where all are right."""
    keys = {policy: f"isam2_{policy.replace('-', '_')}" for policy in POLICIES}
    growth = figures[f"{keys[BEST]}_growth"]
    right = [figures[f"{key}_smoothed_right"] for key in keys.values()]
    lost = [figures[f"{keys[BEST]}_lost_wrong"]]
    lost += [figures[f"{key}_lost_right"] for key in keys.values()]
    if growth is None or None in right or any(lost):
        return False
    plain = figures[f"{keys[PLAIN]}_smoothed_right"]
    return bool(growth <= LARGEST_GROWTH and max(right) <= LARGEST_COST * plain)


def print_estimators(figures: dict[str, Any]) -> None:
    rows = []
    for label in ESTIMATORS:
        key = label.replace(" ", "_").replace("-", "_")
        columns = (
            "smoothed_right",
            "smoothed_wrong",
            "growth",
            "causal_right",
            "causal_wrong",
        )
        rest = (
            "landmarks_right",
            "landmarks_wrong",
            "lost_wrong",
            "time_s_right",
            "time_s_wrong",
        )
        rows.append(
            (
                label,
                *(
                    "-" if (v := figures[f"{key}_{c}"]) is None else v
                    for c in columns + rest
                ),
            )
        )
    headers = (
        "",
        "smoothed m",
        "10 % wrong",
        "growth",
        "causal m",
        "10 % wrong",
        "landmarks m",
        "10 % wrong",
    )
    print_table((*headers, "lost", "s", "10 % wrong"), rows)


def main() -> None:
    parser = make_parser(__doc__, data=True, workers=True)
    parser.add_argument(
        "--robots",
        type=int,
        nargs="+",
        default=ROBOTS,
        help="those to run (default: all five)",
    )
    arguments = parser.parse_args()
    robots = ROBOTS[:1] if arguments.quick else tuple(arguments.robots)
    cases = [
        (robot, share, label)
        for robot in robots
        for share in (0.0, SHARE)
        for label in ESTIMATORS
    ]
    with recording(arguments.data, "mrclam_ds6.tar.xz", "MRCLAM_Dataset6") as folder:
        runs = in_parallel(partial(run_case, folder), cases, arguments.workers, "run")
    figures = collect(cases, runs)
    print_estimators(figures)
    conclude(
        {"robots": robots, "seed": SEED, **figures, "passed": is_met(figures)},
        is_quick=arguments.quick,
    )


if __name__ == "__main__":
    main()
