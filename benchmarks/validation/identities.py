"""Cost of late, wrong and doubtful identities to dead reckoning, two filters, and iSAM2 under each policy.

Basins with a gyro biased as its calibration says, or five times as much (and said so). A share of the tracks is taken
for another landmark: until half of the track's time is over, so that about half as large a share of the detections is
wrong, or to its end. A landmark has no identity until its track has lasted the delay. "Frame by frame": no tracks, and
each detection is wrong by itself. All estimators have the same detections. The smoothed trajectory is not aligned; a
filter's is its causal one.

Of a run that fails or is lost (`LOST_M`) the share is given. A mean is over all runs or not given: a run without a
result has no error, and leaving it out would favour whoever gives up. The map's error is that of the landmarks that are
in it; how many are missing stands beside it. Differences are paired by seed.

``passed``: there is a policy of iSAM2 under which in no kind of case the mean error of the smoothed trajectory, or of
the map, is at 10 % wrong identities more than 15 % above its own at 0 %, or more landmarks are missing than there.
"""

import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parent))
from common import conclude, in_parallel, make_parser, print_table, refuse
from identity_figure import Figures, draw
from identity_runs import ESTIMATORS, Case, Job, Judged, run_job

from sonar_graph.simulation import LANDMARKS_XY_M

RATES = (0.0, 0.05, 0.1, 0.2)
KINDS = [
    Case(0.0, delay_s, bias) for delay_s, bias in product((0.0, 5.0, 20.0), (1.0, 5.0))
]
KINDS += [Case(0.0, 5.0, wrong_id_share=1.0), Case(0.0, tracks=False)]
"""Each at all rates: identities that are corrected, that are not, and that no track carries."""
HELD_RATE, MOST_LOSS = 0.1, 0.15
LANDMARKS = len(LANDMARKS_XY_M)

Runs = list[dict[str, Judged]]


def cases(kinds: list[Case]) -> Iterator[Case]:
    """Each kind at each rate."""
    for kind in kinds:
        for rate in RATES:
            yield Case(
                rate,
                kind.id_delay_s,
                kind.gyro_bias_scale,
                kind.wrong_id_share,
                kind.tracks,
            )


def column(runs: Runs, name: str, figure: str) -> np.ndarray:
    """One figure of one estimator in all runs; NaN where it has none."""
    values = [getattr(run[name], figure) for run in runs]
    return np.array(
        [np.nan if value is None else value for value in values], dtype=np.float64
    )


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Mean and its standard error; NaN as soon as one run has no figure."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def nees_over_runs(runs: Runs, name: str, figure: str, quantity: str) -> float:
    """Mean over runs; NaN as soon as one has none."""
    values = [getattr(run[name], figure) for run in runs]
    return (
        float("nan")
        if None in values
        else float(np.mean([value[quantity] for value in values]))
    )


def summarise(runs: Runs, clean: Runs, name: str) -> dict[str, float]:
    """The figures of one estimator in one case.

    Parameters
    ----------
    clean
        The same seeds without wrong identities.
    """
    smoothed, causal, landmarks = (
        column(runs, name, f"{kind}_m") for kind in ("smoothed", "causal", "landmarks")
    )
    reference, found = (
        column(runs, "dead reckoning", "smoothed_m"),
        [run[name].landmarks for run in runs],
    )
    cost, cost_error = mean_and_error(smoothed - column(clean, name, "smoothed_m"))
    gain, gain_error = mean_and_error(smoothed - reference)
    figures = {
        "smoothed_m": float(smoothed.mean()),
        "smoothed_error_m": mean_and_error(smoothed)[1],
        "causal_m": float(causal.mean()),
        "causal_error_m": mean_and_error(causal)[1],
        "landmarks_m": float(landmarks.mean()),
        "landmarks_error_m": mean_and_error(landmarks)[1],
        "missing": LANDMARKS - float(np.mean(found)),
        "lost": float(np.mean([run[name].is_lost for run in runs])),
        "failed": float(np.mean([run[name].status == "failed" for run in runs])),
        "above_clean_m": cost,
        "above_clean_error_m": cost_error,
        "above_dead_reckoning_m": gain,
        "above_dead_reckoning_error_m": gain_error,
        "loss": float(smoothed.mean() / column(clean, name, "smoothed_m").mean() - 1),
        "landmark_loss": float(
            landmarks.mean() / column(clean, name, "landmarks_m").mean() - 1
        ),
        "more_missing": float(
            np.mean(
                [
                    c[name].landmarks - r[name].landmarks
                    for c, r in zip(clean, runs, strict=True)
                ]
            )
        ),
    }
    for figure, quantity in product(
        ("causal_nees", "final_nees", "smoothed_nees"), ("position", "yaw")
    ):
        figures[f"{figure}_{quantity}"] = nees_over_runs(runs, name, figure, quantity)
    return figures


COLUMNS = {
    "smoothed m": "smoothed_m",
    "± s.e.": "smoothed_error_m",
    "causal m": "causal_m",
    "landmarks m": "landmarks_m",
    "missing": "missing",
    "lost": "lost",
    "against 0 %": "above_clean_m",
    "its s.e.": "above_clean_error_m",
    "against d.r.": "above_dead_reckoning_m",
    "the s.e.": "above_dead_reckoning_error_m",
    "NEES position": "causal_nees_position",
    "yaw": "causal_nees_yaw",
    "at the end": "final_nees_position",
    "end yaw": "final_nees_yaw",
    "smoothed position": "smoothed_nees_position",
    "smoothed yaw": "smoothed_nees_yaw",
}
"""Of the table: figure by header."""


def report(case: Case, runs: Runs, clean: Runs) -> dict[str, dict[str, float]]:
    """Print one case's table; its figures by estimator."""
    summaries = {name: summarise(runs, clean, name) for name in ESTIMATORS}
    print(f"{case.wrong_id_rate:.0%} wrong, {case.name}: {len(runs)} runs")
    rows = [
        (name, *(figures[key] for key in COLUMNS.values()))
        for name, figures in summaries.items()
    ]
    print_table(("", *COLUMNS), rows)
    return summaries


def best_policy(figures: Figures) -> tuple[str, float]:
    """The policy of iSAM2 whose greatest loss at the held rate is least, and that loss.

    Of trajectory and map; where a run has no figure, or more landmarks are missing than at no wrong identities, it
    counts as infinite.
    """
    held = [
        summaries
        for case, summaries in figures.items()
        if case.wrong_id_rate == HELD_RATE
    ]
    policies = [name for name in ESTIMATORS if name.startswith("iSAM2")]
    worst = {
        name: max(_greatest_loss(told[name]) for told in held) for name in policies
    }
    best = min(worst, key=lambda name: worst[name])
    return best, float(worst[best])


def _greatest_loss(told: dict[str, float]) -> float:
    losses = [told["loss"], told["landmark_loss"]]
    return (
        float(max(losses))
        if np.isfinite(losses).all() and told["more_missing"] <= 0
        else np.inf
    )


def flat(figures: Figures) -> dict[str, float | None]:
    """Mean errors by case and estimator; None where a run has none."""
    return {
        f"{case.wrong_id_rate:.0%} wrong, {case.name}: {name}: {key}": value
        if np.isfinite(value := told[key])
        else None
        for case, summaries in figures.items()
        for name, told in summaries.items()
        for key in (
            "smoothed_m",
            "causal_m",
            "landmarks_m",
            "missing",
            "lost",
            "final_nees_position",
            "final_nees_yaw",
        )
    }


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument(
        "--seeds",
        type=int,
        help="number of runs of each case (default: 100; with --quick 3)",
    )
    parser.add_argument(
        "--kinds",
        default="",
        help=f"some of 0..{len(KINDS) - 1}, with commas (default: all)",
    )
    parser.add_argument(
        "--keep",
        type=Path,
        help="folder that keeps runs that are done: the same command goes on there",
    )
    parser.add_argument(
        "--figure",
        type=Path,
        help="draw errors against the share of wrong identities into this file",
    )
    arguments = parser.parse_args()
    count = arguments.seeds or (3 if arguments.quick else 100)
    if count < 2:
        refuse("--seeds: a spread needs at least 2 runs")
    wanted = (
        arguments.kinds.split(",")
        if arguments.kinds
        else [str(i) for i in range(len(KINDS))]
    )
    if unknown := set(wanted) - {str(i) for i in range(len(KINDS))}:
        refuse(
            f"--kinds: unknown: {', '.join(sorted(unknown))}; there are 0 to {len(KINDS) - 1}"
        )
    chosen = list(cases([KINDS[int(i)] for i in wanted]))
    jobs = [
        Job(case, seed, arguments.quick, arguments.keep)
        for seed in range(count)
        for case in chosen
    ]
    done = in_parallel(run_job, jobs, arguments.workers, "run")
    runs = {
        case: [told for job, told in zip(jobs, done, strict=True) if job.case == case]
        for case in chosen
    }
    figures: Figures = {}
    for case in chosen:
        clean = Case(
            0.0, case.id_delay_s, case.gyro_bias_scale, case.wrong_id_share, case.tracks
        )
        figures[case] = report(case, runs[case], runs[clean])
    if arguments.figure:
        draw(figures, arguments.figure)
    policy, loss = best_policy(figures)
    told: dict[str, Any] = {"runs": count, "cases": len(chosen), "best_policy": policy}
    told |= {
        "greatest_loss": None if np.isinf(loss) else loss,
        "passed": loss <= MOST_LOSS,
    }
    conclude(told | flat(figures), is_quick=arguments.quick)


if __name__ == "__main__":
    main()
