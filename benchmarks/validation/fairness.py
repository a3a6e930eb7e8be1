"""Share of the graph, and of the choices around it, in the difference between a filter and a smoother.

Each estimator runs with its defaults, and with one choice at a time made otherwise:

* gate: 0.999 instead of none (iSAM2: ``identity.policy = "gate"``);
* kernel: EKF-SLAM with the one that the others have by default, the others without; and each of these with the gate;
* bias: EKF-SLAM, which has none in its state, with the drift of one in Q: over `BIAS_IN_Q_S` seconds T a constant
  bias turns as much as white noise of density ``sigma_b sqrt(T)``, which is added to the gyros'. The others without the
  bias that they have;
* identity: every most probable one believed, instead of those from `MINIMUM_PROBABILITY` on;
* deferral (iSAM2): no detection waits until its track is known.

Worlds: MRCLAM data sets 6 and 9, robots and landmarks real, identities known; basins of 1000 s and three laps with
gyro biases of 0 to 1e-3 rad/s, which the calibration states, identities known after 5 s and, with ``--wrong-ids``, a
share of the tracks wrong until halfway. Errors are horizontal rms after the best SE(2) alignment, of the causal
estimate, of the smoothed one and of the map; means over robots or seeds. MRCLAM 9 has no truth of the robots.
docs/theory/fair_comparison.md.

``passed``: with defaults the map of every estimator on every robot of MRCLAM 9 is within `MAP_M`.
"""

import dataclasses
import math
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, print_table, recording, refuse

from sonar_graph.evaluation import judge, run_estimator
from sonar_graph.logs.convert import read_mrclam
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin

RATE_HZ, MAP_M, BIAS_IN_Q_S, LOST_M = 2.0, 0.15, 60.0, 1.0
GYRO_BIASES = (0.0, 5e-5, 2e-4, 1e-3)
"""Sigmas, rad/s, as calibrated and as drawn."""
ROBOTS = {6: (1, 2, 3, 4, 5), 9: (1, 2)}
SCORES = ("causal.ate_se2_m", "smoothed.ate_se2_m", "landmarks.se2_m")
GATE, GATE_ISAM2 = {"gate_probability": 0.999}, {"identity": {"policy": "gate"}}
VARIANTS: dict[str, dict[str, dict[str, Any]]] = {
    "ekf-slam": {
        "default": {},
        "gate": GATE,
        "kernel": {"kernel_width": 1.5},
        "gate and kernel": GATE | {"kernel_width": 1.5},
        "bias": {},
        "identity": {"minimum_id_probability": 0.0},
    },
    "invariant-ekf": {
        "default": {},
        "gate": GATE,
        "no kernel": {"kernel_width": 0.0},
        "gate, no kernel": GATE | {"kernel_width": 0.0},
        "bias": {},
        "identity": {"minimum_id_probability": 0.0},
    },
    "isam2": {
        "default": {},
        "gate": GATE_ISAM2,
        "no kernel": {"kernel": {"shape": "none"}},
        "gate, no kernel": GATE_ISAM2 | {"kernel": {"shape": "none"}},
        "bias": {},
        "identity": {"identity": {"minimum_probability": 0.0}},
        "no deferral": {"identity": {"longest_wait_s": 0.0}},
    },
}
BIAS = {"ekf-slam": "bias in Q", "invariant-ekf": "no bias", "isam2": "no bias"}
"""Name of the variant "bias" of each estimator."""
Case = tuple[str, int, str, str]
"""World, robot or seed, estimator, variant."""
Scores = dict[str, float]


def basin(
    bias_rad_s: float, seed: int, duration_s: float, wrong_ids: float
) -> Sequence:
    """A basin whose gyros have a bias of this sigma."""
    nominal = simulate_basin(
        BasinOptions(duration_s=120.0, laps=1)
    ).calibration.imu.gyro_bias_sigma
    options = BasinOptions(
        seed=seed, duration_s=duration_s, laps=max(1, round(duration_s / 333.0)), gyro_bias_scale=bias_rad_s / nominal,
        tracks=True, id_delay_s=5.0, wrong_id_rate=wrong_ids,
    )  # fmt: skip
    return simulate_basin(options)


def with_bias_otherwise(sequence: Sequence, estimator: str) -> Sequence:
    """The sequence with the drift of a bias in the gyros' noise, or with a calibration that knows of none."""
    calibration = sequence.calibration
    imu = calibration.imu
    changed: dict[str, float] = {"gyro_bias_sigma": 0.0}
    if estimator == "ekf-slam":
        density = math.hypot(
            imu.gyro_noise_density, imu.gyro_bias_sigma * math.sqrt(BIAS_IN_Q_S)
        )
        changed = {"gyro_noise_density": density}
    calibration = calibration.model_copy(update={"imu": imu.model_copy(update=changed)})
    return dataclasses.replace(sequence, calibration=calibration)


def run_case(
    folders: dict[int, Path], duration_s: float, wrong_ids: float, case: Case
) -> Scores:
    """Scores of one estimator with one choice on one run; NaN where it failed."""
    world, number, estimator, variant = case
    if world.startswith("mrclam"):
        sequence = read_mrclam(folders[int(world.removeprefix("mrclam"))], number)
    else:
        sequence = basin(
            float(world.removeprefix("basin")), number, duration_s, wrong_ids
        )
    if variant == "bias":
        sequence = with_bias_otherwise(sequence, estimator)
    instants = sequence.instants(RATE_HZ)
    settings = VARIANTS[estimator][variant]
    run = run_estimator(
        sequence, estimator, settings, instants_ns=instants, interim_maps=False
    )
    if run.status == "failed":
        return dict.fromkeys(SCORES, float("nan"))
    (scores,) = judge(sequence, instants, [run]).scores.values()
    return {key: scores[key].value for key in SCORES if key in scores}


def collect(cases: list[Case], runs: list[Scores]) -> list[dict[str, Any]]:
    """A row for each world, estimator and choice: means over its runs, and how many were lost."""
    rows = []
    for world, estimator, variant in dict.fromkeys((w, e, v) for w, _, e, v in cases):
        here = world, estimator, variant
        chosen = [
            run
            for (w, _, e, v), run in zip(cases, runs, strict=True)
            if (w, e, v) == here
        ]
        row: dict[str, Any] = {
            "world": world,
            "estimator": estimator,
            "choice": variant,
            "runs": len(chosen),
        }
        if variant == "bias":
            row["choice"] = BIAS[estimator]
        for key in SCORES:
            values = [run[key] for run in chosen if key in run]
            mean = float(np.mean(values)) if values else math.nan
            row[key] = mean if math.isfinite(mean) else None
        row["worst_map_m"] = max(
            (
                v
                for run in chosen
                if math.isfinite(v := run.get("landmarks.se2_m", math.nan))
            ),
            default=None,
        )
        row["lost"] = sum(not max(run.values()) <= LOST_M for run in chosen)
        rows.append(row)
    return rows


def main() -> None:
    parser = make_parser(__doc__, data=True, workers=True)
    worlds = [
        *(f"mrclam{number}" for number in ROBOTS),
        *(f"basin{bias:g}" for bias in GYRO_BIASES),
    ]
    parser.add_argument(
        "--worlds", default=",".join(worlds), help=f"some of {','.join(worlds)}"
    )
    parser.add_argument(
        "--estimators", default=",".join(VARIANTS), help=f"some of {','.join(VARIANTS)}"
    )
    parser.add_argument(
        "--choices",
        help="some of default, gate, ...; those that an estimator has (default: all)",
    )
    parser.add_argument(
        "--seeds", type=int, default=10, help="basins with each bias (default: 10)"
    )
    parser.add_argument(
        "--wrong-ids",
        type=float,
        default=0.0,
        help="share of the basins' tracks (default: 0)",
    )
    arguments = parser.parse_args()
    asked, estimators = arguments.worlds.split(","), arguments.estimators.split(",")
    if unknown := (set(asked) - set(worlds)) | (set(estimators) - set(VARIANTS)):
        refuse(f"--worlds, --estimators: unknown: {', '.join(sorted(unknown))}")
    choices, duration_s, seeds = arguments.choices, 1000.0, range(arguments.seeds)
    if arguments.quick:
        choices, duration_s, seeds = choices or "default,gate", 120.0, range(1)
    cases: list[Case] = []
    for world in asked:
        numbers = (
            ROBOTS[int(world.removeprefix("mrclam"))]
            if world.startswith("mrclam")
            else seeds
        )
        for estimator in estimators:
            variants = [
                v
                for v in VARIANTS[estimator]
                if choices is None or v in choices.split(",")
            ]
            cases += [
                (world, n, estimator, v)
                for v in variants
                for n in (numbers[:1] if arguments.quick else numbers)
            ]
    with ExitStack() as unpacked:
        folders = {
            number: unpacked.enter_context(
                recording(
                    arguments.data,
                    f"mrclam_ds{number}.tar.xz",
                    f"MRCLAM_Dataset{number}",
                )
            )
            for number in ROBOTS
            if f"mrclam{number}" in asked
        }
        runs = in_parallel(
            partial(run_case, folders, duration_s, arguments.wrong_ids),
            cases,
            arguments.workers,
            "run",
        )
    rows = collect(cases, runs)
    shown = ("choice", *SCORES, "worst_map_m", "lost", "runs")
    print_table(
        ("", *shown),
        [
            (
                f"{r['world']} {r['estimator']}",
                *("-" if r[key] is None else r[key] for key in shown),
            )
            for r in rows
        ],
    )
    judged = [r for r in rows if r["world"] == "mrclam9" and r["choice"] == "default"]
    passed = all(
        r["worst_map_m"] is not None and r["worst_map_m"] <= MAP_M for r in judged
    )
    conclude({"rows": rows, "passed": passed}, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
