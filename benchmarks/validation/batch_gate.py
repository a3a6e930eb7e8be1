"""False alarms and power of the gate of batches, on drawn log ratios.

Drawn log ratios of new to old errors, for 1, 3, 5 and 20 seeds, 1, 3 and 9 logs (seeds of a grid), 2, 4 and 8
contestants and 9 columns. An error is ``exp(0.1 z)`` times its size, where z is shared in part by the logs of a seed
(half of the variance) and by the columns of a run (seven tenths); old and new are two draws. "heavy": beside that each
run is lost with probability 0.1, and its errors are a hundred times as large. "shared" loses a seed on all logs and
with all contestants at once. "real": logs without seeds, cases of their own.

False alarms: share of batches that fail with no worsening. Power: share that fails where one contestant's errors are 5,
20 or 50 % larger in all columns on all logs. ``told_power``: power for a worsening of one column by what the gate says
that it would have found with 80 %. ``passed``: no design has more false alarms than 5 % by more than chance (binomial,
one in a thousand).
"""

import math
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import binom

BENCHMARKS = Path(__file__).resolve().parents[1]
sys.path += [str(BENCHMARKS), str(BENCHMARKS / "regression")]
from common import conclude, in_parallel, make_parser, print_table
from permutation import Case, Ratios, detectable, families, with_all_logs
from regression_gate import TOLERANCE, movable, worse_groups

SIGMA = 0.1
LOST_SHARE, LOST_FACTOR = 0.1, 100.0
OF_SEED, OF_RUN = 0.5, 0.7
COLUMNS = 9
WORSENINGS = (0.0, 0.05, 0.2, 0.5)
SIGNIFICANT = 0.05
POWER_PART = 8


@dataclass(frozen=True)
class Design:
    """Size of a batch and distribution of its errors."""

    seeds: int
    logs: int
    contestants: int
    tails: str = "normal"
    is_real: bool = False

    def __str__(self) -> str:
        logs = (
            f"{self.logs} real logs"
            if self.is_real
            else f"{self.seeds} seeds, {self.logs} logs"
        )
        return f"{logs}, {self.contestants} contestants, {self.tails}"


DESIGNS = [
    *(
        Design(s, n, 4, tails)
        for s in (1, 3, 5, 20)
        for n in (1, 3, 9)
        for tails in ("normal", "heavy")
    ),
    *(
        Design(s, n, c, "heavy")
        for s, n in ((3, 1), (3, 9), (5, 1), (5, 9))
        for c in (2, 8)
    ),
    *(Design(s, 3, 4, "shared") for s in (3, 5)),
    *(
        Design(1, n, 4, tails, is_real=True)
        for n in (3, 9)
        for tails in ("normal", "heavy")
    ),
]


def draw(
    design: Design, worse: float, rng: np.random.Generator, columns: int = COLUMNS
) -> Ratios:
    """Log ratios of a batch; the first contestant is worse in the first columns."""
    shape = (2, design.contestants, design.logs, design.seeds)
    of_seed = math.sqrt(OF_SEED) * rng.normal(
        size=(2, design.contestants, 1, design.seeds)
    )
    runs = (
        rng.normal(size=shape)
        if design.is_real
        else of_seed + math.sqrt(1 - OF_SEED) * rng.normal(size=shape)
    )
    own = rng.normal(size=(*shape, COLUMNS))
    errors = SIGMA * (math.sqrt(OF_RUN) * runs[..., None] + math.sqrt(1 - OF_RUN) * own)
    if design.tails != "normal":
        lost = (
            rng.random((2, 1, 1, design.seeds) if design.tails == "shared" else shape)
            < LOST_SHARE
        )
        errors += math.log(LOST_FACTOR) * lost[..., None]
    ratios = errors[1] - errors[0]
    ratios[0, ..., :columns] += math.log1p(worse)
    return {
        (f"log {n}", f"contestant {c}", f"column {k}"): {
            _case(design, n, s): float(ratios[c, n, s, k]) for s in range(design.seeds)
        }
        for c in range(design.contestants)
        for n in range(design.logs)
        for k in range(COLUMNS)
    }


def _case(design: Design, log: int, seed: int) -> Case:
    return f"log {log}" if design.is_real else seed


def fails(
    design: Design, worse: float, rng: np.random.Generator, columns: int = COLUMNS
) -> bool:
    """Verdict of the gate on one batch."""
    ratios = with_all_logs(draw(design, worse, rng, columns))
    return bool(worse_groups(ratios, families(movable(ratios))))


def told(design: Design, rng: np.random.Generator) -> float:
    """Worsening that the gate says it would have found."""
    tested = families(movable(with_all_logs(draw(design, 0.0, rng))))
    found = detectable(
        tested, [f"column {k}" for k in range(COLUMNS)], math.log1p(TOLERANCE)
    )
    return float(np.median(list(found.values()))) if found else math.inf


def measured(batches: int, design: Design) -> tuple[list[float], float, float]:
    """Share of batches that fail by worsening; the median of what is told; power for it."""
    rng = np.random.default_rng(
        [
            design.seeds,
            design.logs,
            design.contestants,
            len(design.tails),
            design.is_real,
        ]
    )
    shares = [
        float(
            np.mean(
                [
                    fails(design, worse, rng)
                    for _ in range(batches if worse == 0 else batches // POWER_PART)
                ]
            )
        )
        for worse in WORSENINGS
    ]
    share = float(np.median([told(design, rng) for _ in range(5)]))
    if not math.isfinite(share):
        return shares, share, math.nan
    return (
        shares,
        share,
        float(
            np.mean(
                [
                    fails(design, share, rng, columns=1)
                    for _ in range(batches // POWER_PART)
                ]
            )
        ),
    )


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument(
        "--batches",
        type=int,
        default=240,
        help="a design without a worsening (default: 240)",
    )
    arguments = parser.parse_args()
    batches = 32 if arguments.quick else arguments.batches
    designs = DESIGNS[2::6] if arguments.quick else DESIGNS
    found = in_parallel(
        partial(measured, batches), designs, arguments.workers, "design"
    )
    headers = [
        "design",
        "false alarms",
        *(f"+{worse:.0%}" for worse in WORSENINGS[1:]),
        "told",
        "power for it",
    ]
    print_table(
        headers,
        [
            (str(d), *shares, share, power)
            for d, (shares, share, power) in zip(designs, found, strict=True)
        ],
    )
    most = float(binom.ppf(0.999, batches, SIGNIFICANT)) / batches
    alarms = [shares[0] for shares, _, _ in found]
    powers = [power for _, _, power in found if not math.isnan(power)]
    figures = {
        "false_alarms": max(alarms),
        "false_alarms_allowed": most,
        "told_power_least": min(powers),
        "told_power_median": float(np.median(powers)),
    }
    for worse, place in zip(WORSENINGS[1:], (1, 2, 3), strict=True):
        figures |= {
            f"power_{worse * 100:.0f}_percent_{d.seeds}_seeds": shares[place]
            for d, (shares, _, _) in zip(designs, found, strict=True)
            if (d.logs, d.contestants, d.tails, d.is_real) == (3, 4, "normal", False)
        }
    conclude(figures | {"passed": max(alarms) <= most}, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
