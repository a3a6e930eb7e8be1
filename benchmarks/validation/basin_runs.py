"""Which estimator is best on the demonstration's basin, and are its covariances right? Errors and NEES of many runs.

One run is not enough to compare estimators. Each seed is a basin of its own: route, sensor noise, biases, start, heights
of landmarks, detections. The basin is that of ``sonar-graph demo`` without images, under both of its conditions.

For each condition and estimator: mean errors with their 95 % interval (Hall 1992), in metres, and the average NEES per
degree of freedom at the last scored instant, of position (3 numbers) and heading, which is 1 for consistent estimators.

``passed``: iSAM2 has the smallest mean causal error under the first condition.
"""

import math
import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, write_results

from sonar_graph import compare
from sonar_graph.batch import anees, paired
from sonar_graph.cli.compare import DEMO, DEMO_ESTIMATORS
from sonar_graph.evaluation import anees_interval, format_value
from sonar_graph.measurements import Floats
from sonar_graph.simulation import BasinOptions, simulate_basin

RUNS = 20
QUICK_RUNS = 2
RATE_HZ = 1.0
CONDITIONS = {
    "with a gyro bias, a Doppler log that loses the bottom, and a tenth of the tracks wrongly identified": {
        "tracks": True,
        "wrong_id_rate": 0.1,
    },
    "without gyro bias and with all identities right": {"gyro_bias_scale": 0.0},
}
"""Changes of the options by condition: what makes the difference between estimators, and runs without it."""
HEADLINE = "causal.ate_se2_m"
SCORES = {
    HEADLINE: "causal",
    "smoothed.ate_se2_m": "smoothed",
    "causal.own_map_m": "on its own map",
    "landmarks.se2_m": "map",
}
NEES_HEADINGS = {"position": "ANEES of position", "yaw": "ANEES of heading"}
DOF = {"position": 3, "yaw": 1}
Member = tuple[str, int]
"""Condition and seed."""
Values = dict[str, dict[str, float]]
"""Values of one run by estimator, then by key of `SCORES` and `DOF`; infinite where it has no such value."""


def run_member(member: Member) -> Values:
    """Simulate one run, run every estimator on it, and return its scores and NEES at the last scored instant."""
    condition, seed = member
    changes = CONDITIONS[condition] | {"seed": seed, "image": None}
    options = BasinOptions.model_validate(DEMO).model_copy(update=changes)
    comparison = compare(simulate_basin(options), DEMO_ESTIMATORS, rate_hz=RATE_HZ)
    values: Values = {}
    for name in DEMO_ESTIMATORS:
        own = dict.fromkeys([*SCORES, *DOF], math.inf)
        for key in SCORES:
            score = comparison.score_of(name, key)
            if score is not None:
                own[key] = score.value
        errors = comparison.errors.get(name, {}).get("causal")
        if errors is not None:
            own["position"] = float(errors.nees_position[-1] / errors.position_dof)
            own["yaw"] = float(errors.nees_yaw[-1])
        values[name] = own
    return values


def mean_text(values: Floats) -> str:
    """Mean of the runs with its 95 % interval; the number of runs without a value where there are any."""
    lost = int(np.isinf(values).sum())
    if lost:
        return f"{lost} of {len(values)} runs without"
    mean = format_value(float(values.mean()))
    low, high = paired(values, np.zeros_like(values)).interval
    if np.isnan(low):
        return mean
    return f"{mean} ({format_value(max(low, 0.0))} to {format_value(high)})"


def main() -> None:
    """Run, write the table, print the figures."""
    parser = make_parser(__doc__, workers=True)
    arguments = parser.parse_args()
    count = QUICK_RUNS if arguments.quick else RUNS
    members = [
        (condition, seed) for condition in CONDITIONS for seed in range(1, count + 1)
    ]
    found = in_parallel(run_member, members, arguments.workers, "run")

    def values_of(condition: str, name: str, key: str) -> Floats:
        """Values of the runs under one condition, shape (count,)."""
        runs = zip(members, found, strict=True)
        return np.array(
            [own[name][key] for (under, _), own in runs if under == condition]
        )

    rows = []
    for condition in CONDITIONS:
        for name in DEMO_ESTIMATORS:
            means = [mean_text(values_of(condition, name, key)) for key in SCORES]
            nees = [
                f"{anees(values_of(condition, name, what), dof).mean:.2f}"
                for what, dof in DOF.items()
            ]
            rows.append([condition, name, *means, *nees])
    headers = ["runs", "estimator", *(f"{name}, m" for name in SCORES.values())]
    for what, dof in DOF.items():
        low, high = anees_interval(count, dof)
        headers.append(f"{NEES_HEADINGS[what]} ({low:.2f} to {high:.2f})")
    if not arguments.quick:
        write_results(
            "basin_runs.md",
            f"{count} runs of the demonstration's basin under each condition, without images",
            headers,
            rows,
        )
    hard = next(iter(CONDITIONS))
    causal_m = {
        name: float(values_of(hard, name, HEADLINE).mean()) for name in DEMO_ESTIMATORS
    }
    conclude(
        {
            "causal_m": causal_m,
            "passed": min(causal_m, key=causal_m.__getitem__) == "isam2",
        },
        is_quick=arguments.quick,
    )


if __name__ == "__main__":
    main()
