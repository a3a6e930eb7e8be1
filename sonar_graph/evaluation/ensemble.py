"""Many runs of one simulated experiment, other seeds of everything random: one run is not enough to compare estimators.

Each run is scored as in a comparison. Kept are its scores, and its NEES at the last scored instant: there the runs are
independent, so that their average has a chi-square band. Means and bands: docs/theory/metrics.md.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TYPE_CHECKING

from sonar_graph.evaluation.comparison import judge
from sonar_graph.evaluation.results import Ensemble
from sonar_graph.evaluation.run import run_estimator

if TYPE_CHECKING:
    from sonar_graph.evaluation.results import Comparison
    from sonar_graph.simulation import BasinOptions

RATE_HZ = 1.0
KEPT = ("causal.ate_se2_m", "smoothed.ate_se2_m", "causal.own_map_m", "landmarks.se2_m")
"""Scores of each run."""
NEES_AT_END = ("causal.nees_position_end", "causal.nees_yaw_end")
"""NEES per degree of freedom at the last scored instant."""
Values = dict[str, dict[str, float | None]]
"""Values of one run, by estimator, then by key of `KEPT` and `NEES_AT_END`; None where it has no such score."""


def run_ensembles(
    experiments: dict[str, BasinOptions],
    seeds: range,
    names: list[str],
    *,
    workers: int | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[Ensemble]:
    """Simulate each experiment with every seed, and run every estimator on it, on all cores.

    Parameters
    ----------
    experiments
        Options by condition; their seed is replaced, and detections are simulated instead of images.
    seeds
        One run each.
    names
        Estimators.
    workers
        Processes; None: one a core.
    progress
        Called with a subject, the number of runs done and their total.

    Examples
    --------
    In a script, which needs the first line because it starts processes:

    >>> if __name__ == "__main__":
    ...     from sonar_graph.evaluation import run_ensembles
    ...     from sonar_graph.simulation import BasinOptions
    ...
    ...     experiments = {"no bias": BasinOptions(duration_s=130.0, laps=1, gyro_bias_scale=0.0)}
    ...     (ensemble,) = run_ensembles(experiments, range(20), ["isam2", "ekf-slam"])
    """
    members: dict[tuple[str, int], Values] = {}
    total = len(experiments) * len(seeds)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers or os.cpu_count(), mp_context=context) as pool:
        jobs = {
            pool.submit(
                run_member,
                options.model_copy(update={"seed": seed, "image": None}),
                names,
            ): (condition, seed)
            for condition, options in experiments.items()
            for seed in seeds
        }
        try:
            for job in as_completed(jobs):
                members[jobs[job]] = job.result()
                if progress:
                    progress("runs of the same basin", len(members), total)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [
        Ensemble(
            condition,
            list(seeds),
            _by_estimator([members[condition, seed] for seed in seeds]),
        )
        for condition in experiments
    ]


def run_member(options: BasinOptions, names: list[str]) -> Values:
    """Simulate one run, run every estimator on it, and return what is kept."""
    from sonar_graph.simulation import simulate_basin

    sequence = simulate_basin(options)
    instants_ns = sequence.instants(RATE_HZ)
    runs = [run_estimator(sequence, name, instants_ns=instants_ns) for name in names]
    comparison = judge(sequence, instants_ns, runs)
    return {name: _kept(comparison, name) for name in names}


def _kept(comparison: Comparison, name: str) -> dict[str, float | None]:
    """Scores of one estimator, and its NEES at the last scored instant."""
    kept: dict[str, float | None] = {}
    for key in KEPT:
        score = comparison.score_of(name, key)
        kept[key] = None if score is None else score.value
    errors = comparison.errors.get(name, {}).get("causal")
    if errors is None:
        return kept | dict.fromkeys(NEES_AT_END)
    position_nees = float(errors.nees_position[-1] / errors.position_dof)
    yaw_nees = float(errors.nees_yaw[-1])
    return kept | dict(zip(NEES_AT_END, (position_nees, yaw_nees), strict=True))


def _by_estimator(runs: list[Values]) -> dict[str, dict[str, list[float | None]]]:
    """The values of all runs, by estimator and key."""
    return {
        name: {key: [run[name][key] for run in runs] for key in kept}
        for name, kept in runs[0].items()
    }
