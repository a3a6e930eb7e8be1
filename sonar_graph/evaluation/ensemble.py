"""Many runs of one simulated experiment, other seeds of everything random: what one run cannot tell.

Each run is scored as in a comparison. Kept are its scores, and position error and NEES over time, at the same instants
in every run. Means and bands: docs/theory/metrics.md.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sonar_graph.evaluation.comparison import judge
from sonar_graph.evaluation.results import Ensemble
from sonar_graph.evaluation.run import run_estimator

if TYPE_CHECKING:
    from sonar_graph.simulation import BasinOptions

RATE_HZ = 1.0
KEPT = ("causal.ate_se2_m", "smoothed.ate_se2_m", "causal.own_map_m", "landmarks.se2_m")
"""Scores of each run."""


@dataclass(frozen=True)
class _Member:
    """What one run leaves, by estimator."""

    seconds: list[float]
    values: dict[str, dict[str, float | None]]
    errors_m: dict[str, list[float] | None]
    nees: dict[str, dict[str, list[float] | None]]


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
    members: dict[tuple[str, int], _Member] = {}
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
        _gathered(condition, list(seeds), members, names) for condition in experiments
    ]


def run_member(options: BasinOptions, names: list[str]) -> _Member:
    """One run of every estimator."""
    from sonar_graph.simulation import simulate_basin

    sequence = simulate_basin(options)
    instants_ns = sequence.instants(RATE_HZ)
    runs = [run_estimator(sequence, name, instants_ns=instants_ns) for name in names]
    comparison = judge(sequence, instants_ns, runs)
    values: dict[str, dict[str, float | None]] = {}
    errors_m: dict[str, list[float] | None] = {}
    nees: dict[str, dict[str, list[float] | None]] = {}
    for name in names:
        scores = {key: comparison.score_of(name, key) for key in KEPT}
        values[name] = {
            key: None if score is None else score.value for key, score in scores.items()
        }
        errors = comparison.errors.get(name, {}).get("causal")
        errors_m[name], nees[name] = None, {"position": None, "yaw": None}
        if errors is not None:
            place = np.searchsorted(instants_ns, errors.stamps_ns)
            columns = np.full((3, len(instants_ns)), np.nan)
            columns[0, place] = np.linalg.norm(errors.position_m[:, :2], axis=1)
            columns[1:, place] = (
                errors.nees_position / errors.position_dof,
                errors.nees_yaw,
            )
            errors_m[name] = columns[0].tolist()
            nees[name] = {"position": columns[1].tolist(), "yaw": columns[2].tolist()}
    seconds = ((instants_ns - sequence.start_ns) * 1e-9).tolist()
    return _Member(seconds, values, errors_m, nees)


def _gathered(
    condition: str,
    seeds: list[int],
    members: dict[tuple[str, int], _Member],
    names: list[str],
) -> Ensemble:
    """All runs of one experiment."""
    runs = [members[condition, seed] for seed in seeds]
    return Ensemble(
        condition,
        seeds,
        runs[0].seconds,
        {
            name: {key: [run.values[name][key] for run in runs] for key in KEPT}
            for name in names
        },
        {name: [run.errors_m[name] for run in runs] for name in names},
        {
            name: {
                what: [run.nees[name][what] for run in runs]
                for what in ("position", "yaw")
            }
            for name in names
        },
    )
