"""Accuracy of iSAM2 with a bounded history beside the whole one, on the same logs.

Missions of `sonar_graph.simulation.mission`, and basins with their three laps, one of each a seed. At 1 Hz, without
alignment: horizontal rms of causal and smoothed positions, NEES of the smoothed position by its 3 degrees of freedom
(1 is consistent), and the landmarks' rms and NEES at the end. Differences to the whole history are paired by seed and
come with their standard errors.

There is no target.
"""

import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import in_parallel, make_parser, print_figures, print_table

from sonar_graph.measurements import Floats
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import (
    BasinOptions,
    MissionOptions,
    simulate_basin,
    simulate_mission,
)
from sonar_graph.slam import Isam2, Isam2Params
from sonar_graph.states import LandmarkMap, Trajectory

RATE_HZ = 1.0
SETTLING_S = 10.0
"""Before it errors are the start's."""
SETTINGS: dict[str, dict[str, Any]] = {
    "whole": {},
    "bounded, 5 s": {"history": {"policy": "bounded"}, "smoother": {"lag_s": 5.0}},
    "bounded, 15 s": {"history": {"policy": "bounded"}},
    "bounded, 60 s": {"history": {"policy": "bounded"}, "smoother": {"lag_s": 60.0}},
}
QUANTITIES = ("causal_m", "smoothed_m", "nees", "landmarks_m", "landmarks_nees")
Figures = dict[str, float]


def simulate(world: str, duration_s: float, seed: int) -> Sequence:
    """A run of one of the worlds."""
    if world == "mission":
        return simulate_mission(MissionOptions(duration_s=duration_s, seed=seed))
    return simulate_basin(BasinOptions(duration_s=duration_s, seed=seed))


def run_seed(world: str, duration_s: float, seed: int) -> dict[str, Figures]:
    """By settings."""
    sequence = simulate(world, duration_s, seed)
    return {name: run(sequence, settings) for name, settings in SETTINGS.items()}


def run(sequence: Sequence, settings: dict[str, Any]) -> Figures:
    """One estimator over one run."""
    estimator = Isam2(
        sequence.calibration, Odometry(sequence.calibration), Isam2Params(**settings)
    )
    steps = sequence.replay(sequence.instants(RATE_HZ))
    causal = Trajectory.from_estimates(
        [e for e in map(estimator.process, steps) if e is not None]
    )
    smoothed, landmarks = estimator.trajectory(), estimator.landmarks()
    assert sequence.truth is not None
    assert sequence.true_landmarks is not None
    truth = sequence.truth.at(smoothed.stamps_ns)
    late = smoothed.stamps_ns > sequence.start_ns + SETTLING_S * 1e9
    return {
        "causal_m": rms((causal.positions - truth.positions)[late, :2]),
        "smoothed_m": rms((smoothed.positions - truth.positions)[late, :2]),
        "nees": float(np.mean(position_nees(smoothed, truth)[late])),
        **landmark_figures(landmarks, sequence.true_landmarks),
    }


def rms(off: Floats) -> float:
    """Root mean square of the lengths of rows."""
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def position_nees(said: Trajectory, truth: Trajectory) -> Floats:
    """Per degree of freedom, shape (n,); the error in body axes, as the covariance is."""
    off = said.rotations().inv().apply(truth.positions - said.positions)
    return (
        np.einsum("ni,nij,nj->n", off, np.linalg.inv(said.covariances[:, 3:, 3:]), off)
        / 3
    )


def landmark_figures(said: LandmarkMap, true: LandmarkMap) -> Figures:
    """Rms and NEES per degree of freedom."""
    off = said.positions - true.positions[np.searchsorted(true.ids, said.ids)]
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(said.covariances), off) / 3
    return {"landmarks_m": rms(off), "landmarks_nees": float(np.mean(nees))}


def table(results: list[dict[str, Figures]]) -> dict[str, Figures]:
    """Print means over the seeds, with paired differences and their standard errors; all by name."""
    rows, figures = [], {}
    for name in SETTINGS:
        row, figures[name] = [name], {}
        for quantity in QUANTITIES:
            values = np.array([result[name][quantity] for result in results])
            more = values - np.array([result["whole"][quantity] for result in results])
            error = (
                float(more.std(ddof=1) / np.sqrt(len(more))) if len(more) > 1 else 0.0
            )
            figures[name] |= {
                quantity: float(values.mean()),
                f"{quantity}_more": float(more.mean()),
            }
            figures[name][f"{quantity}_error"] = error
            row.append(f"{values.mean():.4f} ({more.mean():+.4f} ± {error:.4f})")
        rows.append(row)
    print_table(("mean (more than whole ± standard error)", *QUANTITIES), rows)
    return figures


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument(
        "--seeds", type=int, help="of each world (default: 24; with --quick 2)"
    )
    arguments = parser.parse_args()
    seeds = range(arguments.seeds or (2 if arguments.quick else 24))
    durations_s = {
        "mission": 300.0 if arguments.quick else 1800.0,
        "basin": 400.0 if arguments.quick else 1200.0,
    }
    figures = {}
    for world, duration_s in durations_s.items():
        results = in_parallel(
            partial(run_seed, world, duration_s), list(seeds), arguments.workers, world
        )
        print(f"{world}, {duration_s:g} s, {len(seeds)} seeds")
        figures[world] = table(results)
    print_figures({"seeds": len(seeds), **figures})


if __name__ == "__main__":
    main()
