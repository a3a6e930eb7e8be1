"""Are filters and iSAM2 as sure as they are right? NEES in the nominal basin and where linearisation costs more.

Four estimators on the same measurements: dead reckoning, EKF-SLAM as published (no gyro bias in its state, Jacobians
at the newest estimate), the invariant filter (gyro bias, right-invariant error), and iSAM2. Causal estimates only.

* nominal: the basin as published, gyro and accelerometer biased as their calibration says;
* without bias: the same with unbiased sensors, where the published filter lacks nothing;
* hard: ten times the gyro bias, more than three times the noise of gyro and Doppler log, a start known to 3 degrees,
  six laps instead of three;
* hard without bias: the same with unbiased sensors, so that the plain filter lacks nothing but its linearisation;
* scale: nominal, velocities of the Doppler log wrong by a factor drawn in each run, of 0.5 %, which the calibration
  states (`dvl.scale_sigma`); scale left out: the same velocities, and a calibration that does not.

The normalised squared error (NEES) per degree of freedom is 1 where errors are as large as the covariance says, above
it where an estimator claims too much. Averaged over independent runs (ANEES) at the last instant it has a two-sided
95 % band; instants of one run are correlated, so the average over time has an interval from the spread between runs,
which should hold 1. Landmarks: all of a run's at its end, horizontally, with the same kind of interval.
Those of one run share the vehicle's errors, so that a run counts as one sample.

``--vertical-scale`` lets vertical ways, and with them depth, tell the Doppler log's scale in iSAM2: what that costs.

``passed``: at the last instant of the nominal basin the ANEES of position and yaw of the invariant filter and of iSAM2
lie inside the band, and in the basin of scale errors that of their landmarks between 0.8 and 1.2. Of consistent
estimators the first four numbers do so at least in four cases of five.
"""

import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parent))
from common import conclude, in_parallel, make_parser, note, print_table, refuse
from consistency import SETTLING_S, judge

from sonar_graph.evaluation import (
    ErrorSeries,
    RunResult,
    compare,
    landmark_errors,
    normalised_squares,
    rmse,
)
from sonar_graph.models import by_biases
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.slam import keyframes
from sonar_graph.states import LandmarkMap, Outcome

ESTIMATORS = {
    "dead_reckoning": "dead-reckoning",
    "ekf": "ekf-slam",
    "invariant": "invariant-ekf",
    "isam2": "isam2",
}
HELD_TO_BAND = ("invariant", "isam2")
DOF = {"position": 3, "yaw": 1}
HARD = {"imu": "mti1", "dvl": "explorer", "start_rotation_sigma_rad": 0.05, "laps": 6}
UNBIASED = {"gyro_bias_scale": 0.0, "accel_bias_scale": 0.0}


@dataclass(frozen=True)
class Basin:
    """Variation of the nominal run."""

    options: dict[str, Any]
    scale_sigma: float = 0.0
    """Of the scale error of the Doppler log, drawn in each run."""
    stated_sigma: float = 0.0
    """The same as the calibration has it; 0: estimators have no such state."""


BASINS = {
    "nominal": Basin({}),
    "without_bias": Basin(UNBIASED),
    "hard": Basin(HARD),
    "hard_without_bias": Basin({**HARD, **UNBIASED}),
    "scale": Basin({}, scale_sigma=0.005, stated_sigma=0.005),
    "scale_left_out": Basin({}, scale_sigma=0.005),
}
LANDMARK_BAND = (0.8, 1.2)
QUICK = {"duration_s": 240.0, "laps": 1}
RATE_HZ = 0.5


@dataclass(frozen=True, eq=False)
class Told:
    """Errors and covariances of one estimator's run."""

    nees: dict[str, np.ndarray]
    """By quantity, over the instants."""
    landmarks: float
    """Mean NEES of the landmarks at the end, per degree of freedom; NaN without any."""
    rms_m: float
    gated_share: float
    """Of the sightings of known landmarks."""


def run_seed(
    basin: Basin, names: tuple[str, ...], has_vertical_scale: bool, seed: int
) -> dict[str, Told]:
    """All estimators on one basin."""
    if has_vertical_scale:

        def whole(D, dR, dp, up, _, arm):
            return by_biases(D, dR, dp, up, np.zeros(3), arm)

        keyframes.by_biases = whole
    scale_error = basin.scale_sigma * float(
        np.random.default_rng((seed, 1)).standard_normal()
    )
    sequence = simulate_basin(
        BasinOptions(seed=seed, dvl_scale_error=scale_error, **basin.options)
    )
    dvl = sequence.calibration.dvl.model_copy(
        update={"scale_sigma": basin.stated_sigma}
    )
    sequence = replace(
        sequence, calibration=sequence.calibration.model_copy(update={"dvl": dvl})
    )
    comparison = compare(
        sequence, [ESTIMATORS[short] for short in names], rate_hz=RATE_HZ
    )
    told = {}
    for short, run in zip(names, comparison.runs, strict=True):
        if run.status == "failed":
            raise RuntimeError(f"seed {seed}: {run.estimator}: {run.reason}")
        seconds = (
            comparison.errors[run.estimator]["causal"].stamps_ns - sequence.start_ns
        ) * 1e-9
        told[short] = tell(
            run,
            comparison.errors[run.estimator]["causal"],
            seconds,
            sequence.true_landmarks,
        )
    return told


def tell(
    run: RunResult,
    errors: ErrorSeries,
    seconds: np.ndarray,
    true_landmarks: LandmarkMap,
) -> Told:
    """The figures of one run."""
    kept = seconds > SETTLING_S
    nees = {"position": errors.nees_position[kept], "yaw": errors.nees_yaw[kept]}
    mapped = landmark_errors(run.landmarks, true_landmarks)
    squares = normalised_squares(mapped.horizontal_m, mapped.horizontal_covs)
    used, gated = (
        run.detections.outcomes.count(kind) for kind in (Outcome.USED, Outcome.GATED)
    )
    return Told(
        nees=nees,
        landmarks=float(squares.mean() / 2) if len(squares) else float("nan"),
        rms_m=rmse(errors.position_m[kept]),
        gated_share=gated / max(used + gated, 1),
    )


def spread(values: np.ndarray) -> tuple[float, float, float]:
    """Mean over runs and its 95 % interval from their spread."""
    half = 1.96 * float(values.std(ddof=1)) / np.sqrt(len(values))
    mean = float(values.mean())
    return mean, mean - half, mean + half


def summarise(
    basin: str, short: str, runs: list[Told]
) -> tuple[list[tuple[object, ...]], dict[str, Any]]:
    """Rows of the table and figures by name, of one estimator in one basin."""
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {}
    for quantity, dof in DOF.items():
        verdict = judge(np.array([run.nees[quantity] for run in runs]), dof)
        low, high = verdict.band
        a, b = verdict.average_interval
        where = "inside" if verdict.final_inside else "OUTSIDE"
        holds = "holds 1" if verdict.average_fits else "DOES NOT"
        name = f"{ESTIMATORS[short]} {quantity}"
        rows.append(
            (
                name,
                verdict.final,
                f"{low:.3f}..{high:.3f}",
                where,
                verdict.average,
                f"{a:.3f}..{b:.3f}",
                holds,
            )
        )
        prefix = f"{basin}_{short}_{quantity}"
        figures[f"{prefix}_anees"] = verdict.final
        figures[f"{prefix}_inside"] = verdict.final_inside
        figures[f"{prefix}_anees_over_time"] = verdict.average
        figures[f"{prefix}_anees_over_time_interval"] = verdict.average_interval
        figures[f"{basin}_band_{quantity}"] = verdict.band
    landmarks = np.array([run.landmarks for run in runs])
    if np.isfinite(landmarks).all():
        mean, low, high = spread(landmarks)
        holds = "holds 1" if low <= 1 <= high else "DOES NOT"
        rows.append(
            (
                f"{ESTIMATORS[short]} landmarks",
                "",
                "",
                "",
                mean,
                f"{low:.3f}..{high:.3f}",
                holds,
            )
        )
        figures[f"{basin}_{short}_landmarks_anees"] = mean
        figures[f"{basin}_{short}_landmarks_interval"] = low, high
    figures[f"{basin}_{short}_rms_m"] = float(
        np.sqrt(np.mean([run.rms_m**2 for run in runs]))
    )
    figures[f"{basin}_{short}_gated_share"] = float(
        np.mean([run.gated_share for run in runs])
    )
    return rows, figures


def report(basin: str, told: list[dict[str, Told]]) -> dict[str, Any]:
    """Print one basin's tables; its figures by name."""
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {}
    for short in told[0]:
        more, named = summarise(basin, short, [run[short] for run in told])
        rows += more
        figures |= named
    print(f"{basin}: {len(told)} runs")
    print_table(
        ("ANEES / dof", "last instant", "band", "", "mean", "95 % interval", ""), rows
    )
    errors = [
        (
            ESTIMATORS[s],
            figures[f"{basin}_{s}_rms_m"],
            figures[f"{basin}_{s}_gated_share"],
        )
        for s in told[0]
    ]
    print_table(("", "position rms, m", "share gated"), errors)
    return figures


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument(
        "--seeds",
        type=int,
        help="number of runs in each basin (default: 100; with --quick 4)",
    )
    parser.add_argument(
        "--first-seed",
        type=int,
        default=0,
        help="runs use this seed and those after it",
    )
    parser.add_argument(
        "--basins", default=",".join(BASINS), help=f"some of {','.join(BASINS)}"
    )
    parser.add_argument(
        "--estimators",
        default=",".join(ESTIMATORS),
        help=f"some of {','.join(ESTIMATORS)}",
    )
    parser.add_argument(
        "--vertical-scale",
        action="store_true",
        help="let vertical ways tell iSAM2 the scale",
    )
    arguments = parser.parse_args()
    count = arguments.seeds or (4 if arguments.quick else 100)
    basins, names = arguments.basins.split(","), tuple(arguments.estimators.split(","))
    if count < 2:
        refuse("--seeds: a spread needs at least 2 runs")
    if unknown := (set(basins) - set(BASINS)) | (set(names) - set(ESTIMATORS)):
        refuse(f"--basins, --estimators: unknown: {', '.join(sorted(unknown))}")
    seeds = range(arguments.first_seed, arguments.first_seed + count)
    figures: dict[str, Any] = {"runs": count}
    for basin in basins:
        note(f"{basin}:")
        chosen = replace(
            BASINS[basin],
            options=BASINS[basin].options | (QUICK if arguments.quick else {}),
        )
        told = in_parallel(
            partial(run_seed, chosen, names, arguments.vertical_scale),
            seeds,
            arguments.workers,
            "seed",
        )
        figures |= report(basin, told)
    judged = [
        key for key in figures if key.startswith("nominal") and key.endswith("inside")
    ]
    judged = [key for key in judged if key.split("_")[1] in HELD_TO_BAND]
    met = [figures[key] for key in judged]
    low, high = LANDMARK_BAND
    met += [
        low <= value <= high
        for s in HELD_TO_BAND
        if (value := figures.get(f"scale_{s}_landmarks_anees"))
    ]
    figures["passed"] = bool(met) and all(met)
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
