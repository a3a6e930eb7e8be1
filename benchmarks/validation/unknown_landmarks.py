"""Landmarks without identities: what geometry alone finds, beside known identities and beside dead reckoning.

The same runs, once with the identities and once without any (``identity.unknown.policy``): the basin of default
length, in which nothing but the identities differs, and the robots of UTIAS MRCLAM data set 6.

A landmark of the map stands for the true one to which most of its detections belong. Where several stand for one, all
but one are duplicates. A detection is associated wrongly when it belongs to another than its landmark stands for, or to
nothing. Errors of the map are of the landmarks within `FARTHEST_M` of a true one, one to one, without alignment. Errors
of the trajectory are horizontal: in the basin rms without alignment, for MRCLAM after the best SE(2) alignment.
"""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, print_table, recording

from sonar_graph.evaluation import (
    RunResult,
    judge,
    landmark_errors,
    rmse,
    run_estimator,
)
from sonar_graph.evaluation.metrics import named_by_place
from sonar_graph.logs.convert import read_mrclam
from sonar_graph.measurements import Floats, Ints
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.states import DetectionLog, Outcome

Figures = dict[str, float]
FARTHEST_M = 1.0
SURE = 0.9
"""Least posterior of a detection that was of a landmark, before identities were taken away."""
USED = (
    Outcome.USED,
    Outcome.NEW,
    Outcome.PLACED_LATER,
    Outcome.USED_LATER,
    Outcome.MOVED,
)
PLACES: dict[str, dict[str, Any]] = {
    "basin": {"density_m2": 0.05},
    "mrclam": {"density_m2": 0.15},
}
"""Landmarks a square metre, roughly: 4 on the 49 m² that the basin's square encloses; 15 on 100 m²."""
MOST_ERROR = 1.05
"""Trajectory error in the basin over that with known identities, at most."""


def without_identities(sequence: Sequence) -> Sequence:
    """The same run from a recogniser that names nothing."""
    seen = sequence.detections
    assert seen is not None
    nothing = replace(
        seen,
        candidate_ids=np.full((len(seen), 1), -1, dtype=np.int64),
        id_probability=np.zeros((len(seen), 1)),
    )
    return replace(sequence, detections=nothing)


def run(
    sequence: Sequence, rate_hz: float, error: str, settings: dict[str, Any]
) -> dict[str, Figures]:
    """Figures with identities, without, and of dead reckoning."""
    instants = sequence.instants(rate_hz)
    unknown = {"identity": {"unknown": {"policy": "associate", **settings}}}
    runs = {
        "known": run_estimator(
            sequence, "isam2", instants_ns=instants, interim_maps=False
        ),
        "unknown": run_estimator(
            without_identities(sequence),
            "isam2",
            unknown,
            instants_ns=instants,
            interim_maps=False,
        ),
        "dead reckoning": run_estimator(
            sequence, "dead-reckoning", instants_ns=instants, interim_maps=False
        ),
    }
    found = {}
    for name, result in runs.items():
        if result.status == "failed":
            raise RuntimeError(f"{sequence.name}: {name}: {result.reason}")
        scores = next(iter(judge(sequence, instants, [result]).scores.values()))
        found[name] = {
            key: scores[f"{kind}.{error}"].value
            for kind, key in KINDS
            if f"{kind}.{error}" in scores
        }
        found[name]["nees"] = scores["causal.nees_position"].value
        found[name]["seconds"] = float(result.update_s.sum() + result.finish_s)
        if name != "dead reckoning":
            found[name] |= of_landmarks(sequence, result)
    return found


KINDS = (("causal", "causal_m"), ("smoothed", "smoothed_m"))


def of_landmarks(sequence: Sequence, result: RunResult) -> Figures:
    """Number of landmarks found, their errors, and the number of detections given to a wrong one."""
    true, estimated, log = sequence.true_landmarks, result.landmarks, result.detections
    assert true is not None
    assert estimated is not None
    assert log is not None
    errors = landmark_errors(named_by_place(estimated, true, FARTHEST_M), true)
    is_used = np.isin(np.array(log.outcomes), USED)
    taken_for, meant = (
        log.landmark_ids[is_used],
        true_identities(sequence, log)[is_used],
    )
    stands_for = {
        i: most_frequent(meant[taken_for == i]) for i in estimated.ids.tolist()
    }
    real = {identity for identity in stands_for.values() if identity >= 0}
    right = sum(
        int(np.sum(meant[taken_for == i] == identity))
        for i, identity in stands_for.items()
        if identity >= 0
    )
    return {
        "landmarks": float(len(estimated)),
        "distinct": float(len(real)),
        "near": float(len(errors)),
        "landmark_m": rmse(errors.horizontal_m) if len(errors) else float("nan"),
        "used": float(is_used.sum()),
        "wrong": float(is_used.sum() - right),
    }


def most_frequent(identities: Ints) -> int:
    """The identity that occurs most; -2 of none."""
    values, counts = np.unique(identities, return_counts=True)
    return int(values[np.argmax(counts)]) if len(values) else -2


def true_identities(sequence: Sequence, log: DetectionLog) -> Ints:
    """True landmark of each detection; -2: none."""
    assert sequence.detections is not None
    ids, probability = sequence.detections.rows(
        np.isin(sequence.detections.stamps_ns, log.stamps_ns)
    ).most_probable()
    return np.where(probability >= SURE, ids, -2)


def basin(seconds: float | None, seed: int) -> dict[str, Figures]:
    """One run of the basin; None: of default length."""
    options = (
        BasinOptions(seed=seed)
        if seconds is None
        else BasinOptions(seed=seed, duration_s=seconds, laps=1)
    )
    return run(simulate_basin(options), 1.0, "ate_raw_m", PLACES["basin"])


def mrclam(folder: Path, robot: int) -> dict[str, Figures]:
    """One robot."""
    return run(read_mrclam(folder, robot), 2.0, "ate_se2_m", PLACES["mrclam"])


def summary(title: str, runs: list[dict[str, Figures]]) -> dict[str, dict[str, float]]:
    """Means over runs (rms of errors), and a table of them."""
    table, found = [], {}
    for name in ("known", "unknown", "dead reckoning"):
        keys = runs[0][name].keys()
        columns: dict[str, Floats] = {
            key: np.array([figures[name][key] for figures in runs]) for key in keys
        }
        found[name] = {
            key: float(
                np.sqrt(np.mean(values**2)) if key.endswith("_m") else np.mean(values)
            )
            for key, values in columns.items()
        }
        found[name] |= {
            "worst_m": float(
                columns["smoothed_m" if "smoothed_m" in columns else "causal_m"].max()
            )
        }
        table.append(
            (f"{title}, {name}", *(found[name].get(key, "-") for key in COLUMNS))
        )
    print_table(("", *COLUMNS), table)
    return found


COLUMNS = (
    "landmarks",
    "distinct",
    "near",
    "used",
    "wrong",
    "landmark_m",
    "causal_m",
    "smoothed_m",
    "worst_m",
    "nees",
    "seconds",
)


def main() -> None:
    parser = make_parser(__doc__, data=True, workers=True)
    parser.add_argument("--seeds", type=int, default=12, help="runs of the basin")
    arguments = parser.parse_args()
    seeds, seconds, robots = (
        (2, 200.0, ()) if arguments.quick else (arguments.seeds, None, (1, 2, 3, 4, 5))
    )
    spread = partial(in_parallel, workers=arguments.workers)
    figures: dict[str, Any] = {
        "basin": summary(
            "basin", spread(partial(basin, seconds), range(seeds), what="seed")
        ),
    }
    if robots:
        with recording(
            arguments.data, "mrclam_ds6.tar.xz", "MRCLAM_Dataset6"
        ) as folder:
            of_robots = spread(partial(mrclam, folder), robots, what="robot")
        for robot, found in zip(robots, of_robots, strict=True):
            summary(f"robot {robot}", [found])
        figures["mrclam"] = summary("MRCLAM", of_robots)
    known, unknown = figures["basin"]["known"], figures["basin"]["unknown"]
    figures["error_ratio"] = unknown["smoothed_m"] / known["smoothed_m"]
    figures["passed"] = bool(
        figures["error_ratio"] <= MOST_ERROR
        and unknown["landmarks"] == unknown["distinct"] == known["landmarks"]
    )
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
