"""Is dead reckoning as sure as it is right in gaps of the Doppler log, and after them? NEES of many runs.

The simulated basin, driven once in 300 s. From each run all Doppler samples of 3, 10, 30 and 60 s are taken, beginning
at another place in each. The normalised squared position error (NEES, 3 dimensions) is taken at three instants: in the
gap shortly before it ends (open: nothing but what lies before is known), right after it, and 10 s later. Averaged over
the runs and divided by 3 it is 1 for a covariance that is right; its two-sided 99 % band over n runs is that of a
chi-square with 3 n degrees of freedom over 3 n.

"straight" is the same with the velocity linear from one end of the gap to the other and white noise, and "no
accelerometer" with a random walk of velocity in place of the accelerometers: its density is that of a brisk vehicle, so
that a slow vehicle errs far less than it claims (below the band). ``passed``: with accelerometers all of it lies within
the band.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, print_table

from sonar_graph.evaluation import run_estimator
from sonar_graph.evaluation.consistency import world_position_covs
from sonar_graph.measurements import Floats
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin

GAPS_S = (3.0, 10.0, 30.0, 60.0)
MODES = ("accelerometers", "no accelerometer", "straight")
WHEN = ("before its end", "right after", "10 s later")
BAND_PROBABILITY = 0.99
NS = 1_000_000_000


def nees(seed: int) -> Floats:
    """Per dimension, and the error in m, by gap, mode and instant: shape (4, 3, 3, 2)."""
    sequence = simulate_basin(
        BasinOptions(
            seed=seed, duration_s=300.0, laps=1, speed_m_s=0.3, frame_rate_hz=1
        )
    )
    begin_s = np.random.default_rng(seed).uniform(20.0, 200.0)
    return np.array(
        [[judged(sequence, mode, begin_s, gap_s) for mode in MODES] for gap_s in GAPS_S]
    )


def judged(sequence: Sequence, mode: str, begin_s: float, gap_s: float) -> Floats:
    """NEES per dimension and error, shape (3, 2)."""
    assert sequence.truth is not None
    begin_ns = sequence.start_ns + round(begin_s * NS)
    end_ns = begin_ns + round(gap_s * NS)
    stamps = sequence.dvl.stamps_ns
    lost = replace(
        sequence, dvl=sequence.dvl.rows((stamps <= begin_ns) | (stamps >= end_ns))
    )
    if mode == "no accelerometer":
        lost = replace(
            lost,
            imu=replace(
                lost.imu, specific_force=np.full_like(lost.imu.specific_force, np.nan)
            ),
        )
    if mode == "straight":
        dvl = lost.calibration.dvl.model_copy(update={"gap_s": 1e3})
        lost = replace(
            lost, calibration=lost.calibration.model_copy(update={"dvl": dvl})
        )
    instants = np.array([end_ns - NS // 20, end_ns + NS // 2, end_ns + 10 * NS])
    found = run_estimator(lost, "dead-reckoning", instants_ns=instants).causal
    assert found is not None
    error = found.positions - sequence.truth.at(instants).positions
    squares = np.einsum(
        "ni,nij,nj->n", error, np.linalg.inv(world_position_covs(found)), error
    )
    return np.column_stack([squares / 3, np.linalg.norm(error, axis=1)])


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument("--runs", type=int, default=100, help="seeds (default: 100)")
    arguments = parser.parse_args()
    runs = 4 if arguments.quick else arguments.runs
    found = np.array(in_parallel(nees, range(runs), arguments.workers, "seed"))
    tail = (1 - BAND_PROBABILITY) / 2
    band = [float(chi2.ppf(p, 3 * runs) / (3 * runs)) for p in (tail, 1 - tail)]
    mean, error_m = (
        found[..., 0].mean(axis=0),
        np.sqrt(np.square(found[..., 1]).mean(axis=0)),
    )
    rows = [
        (f"{gap_s:g} s, {mode}", *mean[g, m].tolist(), *error_m[g, m].tolist())
        for g, gap_s in enumerate(GAPS_S)
        for m, mode in enumerate(MODES)
    ]
    print_table(
        (
            "gap",
            *(f"NEES/3 {when}" for when in WHEN),
            *(f"RMSE m {when}" for when in WHEN),
        ),
        rows,
    )
    inside = (mean[:, 0] >= band[0]) & (mean[:, 0] <= band[1])
    figures = {
        "runs": runs,
        "gaps_s": GAPS_S,
        "band": band,
        "nees_per_dof": {mode: mean[:, m].tolist() for m, mode in enumerate(MODES)},
        "rmse_m": {mode: error_m[:, m].tolist() for m, mode in enumerate(MODES)},
        "passed": bool(inside.all()),
    }
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
