"""Which estimator is best on the demonstration's basin, and are its covariances right? Errors and NEES of many runs.

One run is not enough to compare estimators. Each seed is a basin of its own: route, sensor noise, biases, start, heights
of landmarks, detections. The basin is that of ``sonar-graph demo`` without images, under both of its conditions.

For each condition and estimator: mean errors with their 95 % interval (Hall 1992), in metres, and the average NEES per
degree of freedom at the last scored instant, of position (3 numbers) and heading, which is 1 for consistent estimators.
``sonar-graph demo --runs 20`` makes the same runs and shows them on its page.

``passed``: iSAM2 has the smallest mean causal error under the first condition.
"""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, make_parser, note, write_results

from sonar_graph.cli.compare import DEMO, DEMO_ESTIMATORS, DEMO_EXPERIMENTS
from sonar_graph.evaluation import Ensemble, anees_interval, run_ensembles
from sonar_graph.report.ensemble_section import DOF, HEADLINE, SHOWN, mean_text
from sonar_graph.simulation import BasinOptions

RUNS = 20
QUICK_RUNS = 2
NEES_HEADINGS = {"position": "ANEES of position", "yaw": "ANEES of heading"}


def rows_of(ensemble: Ensemble) -> list[list[str]]:
    """Rows of the table: an estimator each."""
    rows = []
    for name in ensemble.values:
        means = [mean_text(ensemble.of(name, key)) for key in SHOWN]
        anees = [f"{ensemble.nees_at_end(name, what).mean():.2f}" for what in DOF]
        rows.append([ensemble.condition, name, *means, *anees])
    return rows


def main() -> None:
    """Run, write the table, print the figures."""
    parser = make_parser(__doc__, workers=True)
    arguments = parser.parse_args()
    count = QUICK_RUNS if arguments.quick else RUNS
    options = BasinOptions.model_validate(DEMO)
    experiments = {
        condition: options.model_copy(update=changes)
        for condition, changes in DEMO_EXPERIMENTS.items()
    }
    ensembles = run_ensembles(
        experiments,
        range(1, count + 1),
        DEMO_ESTIMATORS,
        workers=arguments.workers,
        progress=lambda what, done, total: note(f"{what}: {done} of {total}"),
    )
    headers = ["runs", "estimator", *(f"{name.lower()}, m" for name in SHOWN.values())]
    for what, dof in DOF.items():
        low, high = anees_interval(count, dof)
        headers.append(f"{NEES_HEADINGS[what]} ({low:.2f} to {high:.2f})")
    rows = [row for ensemble in ensembles for row in rows_of(ensemble)]
    if not arguments.quick:
        write_results(
            "basin_runs.md",
            f"{count} runs of the demonstration's basin under each condition, without images",
            headers,
            rows,
        )
    hard = ensembles[0]
    causal_m = {name: float(hard.of(name, HEADLINE).mean()) for name in DEMO_ESTIMATORS}
    conclude(
        {
            "causal_m": causal_m,
            "passed": min(causal_m, key=causal_m.__getitem__) == "isam2",
        },
        is_quick=arguments.quick,
    )


if __name__ == "__main__":
    main()
