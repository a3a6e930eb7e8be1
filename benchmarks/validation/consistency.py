"""Are EKF-SLAM and iSAM2 as sure as they are right? NEES over independent runs of the nominal basin.

Each seed is a basin of its own: route, sensor noise, biases as calibrated, start, landmark heights. The normalised
squared error (NEES) of position (3 numbers) and heading is averaged over the seeds at each instant (ANEES, per degree
of freedom: 1 is consistent). Instants of one run are correlated, seeds are not, so three things are said:

* the ANEES at the last instant, with its two-sided 95 % band for this many runs;
* the ANEES over all instants, with a 95 % interval from the spread of the runs' own averages, which should hold 1;
* the share of instants whose ANEES is inside the band; 95 % on average, with much scatter as instants are correlated.

``--images``: three laps in 390 s with the demonstration's sensors, landmarks recognised in simulated sonar images.
NIS: mean over the runs, per degree of freedom of the detections, with a 95 % interval from its spread.

``passed``: the first two hold for iSAM2. EKF-SLAM has no gyro bias in its state, so its heading claims too much.
"""

import sys
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, print_table, refuse

from sonar_graph.cli.compare import DEMO
from sonar_graph.cli.simulate import write_basin
from sonar_graph.evaluation import anees_interval, compare
from sonar_graph.recognition import recognise
from sonar_graph.simulation import BasinOptions, simulate_basin

ESTIMATORS = {"ekf": "ekf-slam", "isam2": "isam2"}
HELD_TO_BAND = "isam2"
QUANTITIES = {"position": 3, "yaw": 1}
RATE_HZ = 1.0
IMAGE_RATE_HZ = 5.0
SETTLING_S = 10.0
"""Before it errors are the start's, known to be drawn from the prior."""
Nees = dict[tuple[str, str], np.ndarray]
"""By estimator and quantity, over the instants."""


@dataclass(frozen=True)
class Basin:
    """Variation of the nominal run."""

    duration_s: float
    laps: int
    has_images: bool = False


def run_seed(basin: Basin, seed: int) -> tuple[np.ndarray, Nees, dict[str, float]]:
    """Seconds since the start (n,), NEES (n,) by estimator and quantity, and mean NIS by estimator."""
    options = BasinOptions(seed=seed, duration_s=basin.duration_s, laps=basin.laps)
    if basin.has_images:
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "basin.mcap"
            # images as often as by default: the demonstration has fewer, which saves time
            changes = {"seed": seed, "frame_rate_hz": IMAGE_RATE_HZ}
            write_basin(log, BasinOptions.model_validate({**DEMO, **changes}))
            sequence = recognise(log)
    else:
        sequence = simulate_basin(options)
    comparison = compare(sequence, list(ESTIMATORS.values()), rate_hz=RATE_HZ)
    for run in comparison.runs:
        if run.status == "failed":
            raise RuntimeError(f"seed {seed}: {run.estimator}: {run.reason}")
    errors = {
        short: comparison.errors[name]["causal"] for short, name in ESTIMATORS.items()
    }
    nees = {}
    for short, series in errors.items():
        nees[short, "position"], nees[short, "yaw"] = (
            series.nees_position,
            series.nees_yaw,
        )
    nis = {
        name: score.value
        for name in ESTIMATORS.values()
        if (score := comparison.score_of(name, "detections.nis"))
    }
    return (errors["ekf"].stamps_ns - sequence.start_ns) * 1e-9, nees, nis


@dataclass(frozen=True)
class Verdict:
    """Consistency of one quantity of one estimator."""

    final: float
    band: tuple[float, float]
    average: float
    average_interval: tuple[float, float]
    share_inside: float

    @property
    def final_inside(self) -> bool:
        return self.band[0] <= self.final <= self.band[1]

    @property
    def average_fits(self) -> bool:
        return self.average_interval[0] <= 1 <= self.average_interval[1]


def judge(nees: np.ndarray, dof: int) -> Verdict:
    """From the NEES of all runs, shape (runs, n)."""
    runs = len(nees)
    band = anees_interval(runs, dof)
    anees = nees.mean(axis=0) / dof
    own = nees.mean(axis=1) / dof
    half = 1.96 * float(own.std(ddof=1)) / np.sqrt(runs)
    mean = float(own.mean())
    inside = float(np.mean((anees >= band[0]) & (anees <= band[1])))
    return Verdict(float(anees[-1]), band, mean, (mean - half, mean + half), inside)


def draw(seconds: np.ndarray, nees: Nees, path: Path) -> None:
    """ANEES over time with the band, one panel a quantity."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    for axes, (quantity, dof) in zip(
        figure.subplots(2, sharex=True), QUANTITIES.items(), strict=True
    ):
        runs = len(nees["ekf", quantity])
        axes.axhspan(*anees_interval(runs, dof), color="0.9", label="95 % band")
        for short, name in ESTIMATORS.items():
            axes.plot(
                seconds, nees[short, quantity].mean(axis=0) / dof, lw=1, label=name
            )
        axes.set_ylabel(f"ANEES of {quantity} / {dof}")
        axes.legend(loc="upper left", ncols=3)
    axes.set_xlabel("time (s)")
    figure.suptitle(f"{runs} runs of the basin")
    figure.savefig(path, dpi=120)


def report(verdicts: dict[tuple[str, str], Verdict]) -> dict[str, Any]:
    """Print the table; the figures by name."""
    rows = []
    figures: dict[str, Any] = {}
    for (short, quantity), verdict in verdicts.items():
        low, high = verdict.band
        a, b = verdict.average_interval
        rows.append(
            (
                f"{ESTIMATORS[short]} {quantity}",
                verdict.final,
                f"{low:.3f}..{high:.3f}",
                "inside" if verdict.final_inside else "OUTSIDE",
                verdict.average,
                f"{a:.3f}..{b:.3f}",
                "holds 1" if verdict.average_fits else "DOES NOT",
                f"{verdict.share_inside:.0%}",
            )
        )
        figures[f"{short}_{quantity}_anees"] = verdict.final
        figures[f"{short}_{quantity}_anees_over_time"] = verdict.average
        figures[f"{short}_{quantity}_anees_over_time_interval"] = (
            verdict.average_interval
        )
        figures[f"share_inside_{short}_{quantity}"] = verdict.share_inside
        figures[f"band_{quantity}"] = verdict.band
    headers = (
        "ANEES / dof",
        "last instant",
        "band",
        "",
        "over time",
        "95 % interval",
        "",
        "instants in band",
    )
    print_table(headers, rows)
    held = [
        verdict for (short, _), verdict in verdicts.items() if short == HELD_TO_BAND
    ]
    figures["passed"] = all(
        verdict.final_inside and verdict.average_fits for verdict in held
    )
    return figures


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument(
        "--seeds", type=int, help="number of runs (default: 50; with --quick 4)"
    )
    parser.add_argument(
        "--first-seed",
        type=int,
        default=0,
        help="runs use this seed and those after it",
    )
    parser.add_argument(
        "--images", action="store_true", help="recognise landmarks in sonar images"
    )
    parser.add_argument("--out", type=Path, help="write a figure (PNG) here")
    arguments = parser.parse_args()
    basin = Basin(240.0, 1) if arguments.quick else Basin(2039.0, 3)
    if arguments.images:
        basin = Basin(DEMO["duration_s"], DEMO["laps"], has_images=True)
    count = arguments.seeds or (4 if arguments.quick else 50)
    if count < 2:
        refuse("--seeds: a spread needs at least 2 runs")
    seeds = range(arguments.first_seed, arguments.first_seed + count)
    runs = in_parallel(partial(run_seed, basin), seeds, arguments.workers, "seed")
    instants = len(min((run[0] for run in runs), key=len))
    seconds = runs[0][0][:instants]
    kept = seconds > SETTLING_S
    nees = {
        key: np.array([run[1][key][:instants][kept] for run in runs])
        for key in runs[0][1]
    }
    verdicts = {key: judge(values, QUANTITIES[key[1]]) for key, values in nees.items()}
    figures = report(verdicts)
    for name in ESTIMATORS.values():
        nis = np.array([run[2].get(name, np.nan) for run in runs])
        half = 1.96 * float(nis.std(ddof=1)) / np.sqrt(count)
        mean = float(nis.mean())
        figures |= {
            f"{name}_nis": mean,
            f"{name}_nis_interval": (mean - half, mean + half),
        }
        print(
            f"{name}: NIS {mean:.2f} ({mean - half:.2f} to {mean + half:.2f}), median {np.median(nis):.2f}"
        )
    if arguments.out:
        draw(seconds[kept], nees, arguments.out)
    conclude(
        {"runs": count, "duration_s": basin.duration_s, **figures},
        is_quick=arguments.quick,
    )


if __name__ == "__main__":
    main()
