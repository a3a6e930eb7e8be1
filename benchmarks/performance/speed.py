"""All ratios of speed that the project states, beside the ones accepted last.

    python benchmarks/performance/speed.py [--quick] [--rounds N] [--accept]

Runs `ekf_step.py`, `preintegration.py` and `isam2_mission.py`, one after the other, as often as ``--rounds`` asks, and
takes the median of each ratio. Within each script both sides take turns, so a busy machine slows both alike.

The accepted ratios are in ``accepted_speed.json``, those of short runs apart from those of full ones. ``--accept``
replaces them by the measured ones. A full run in which a ratio is worse than the accepted one by more than
``--tolerance`` ends with exit code 1.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple

FOLDER = Path(__file__).resolve().parent
sys.path.append(str(FOLDER.parent))
from common import conclude, make_parser, note, print_table

ACCEPTED = FOLDER / "accepted_speed.json"
SCRIPTS = ("ekf_step", "preintegration", "isam2_mission")
Figures = dict[str, Any]


class Headline(NamedTuple):
    """A ratio of two times."""

    what: str
    """For people."""
    script: str
    better: Literal["lower", "higher"]
    of: Callable[[Figures], float]
    """The ratio, given the figures of the script."""


HEADLINES = {
    "filterpy_ratio": Headline(
        "filterpy / EKF-SLAM",
        "ekf_step",
        "higher",
        lambda found: found["filterpy_ratio"],
    ),
    "invariant_ratio": Headline(
        "invariant EKF / EKF-SLAM",
        "ekf_step",
        "lower",
        lambda found: found["invariant_log_s"] / found["log_s"],
    ),
    "gtsam_cpp_ratio": Headline(
        "preintegration, ours / GTSAM in C++",
        "preintegration",
        "lower",
        lambda found: found["gtsam_cpp_ratio"],
    ),
    "gtsam_python_ratio": Headline(
        "preintegration, GTSAM from Python / ours",
        "preintegration",
        "higher",
        lambda found: found["gtsam_python_ratio"],
    ),
    "plain_ratio": Headline(
        "iSAM2 / plain gtsam.ISAM2, all updates",
        "isam2_mission",
        "lower",
        lambda found: found["plain_ratio"],
    ),
    "p99_ratio": Headline(
        "iSAM2 / plain gtsam.ISAM2, 99 % of updates",
        "isam2_mission",
        "lower",
        lambda found: found["p99_ratio"],
    ),
}


def figures_of(script: str, *, is_quick: bool) -> Figures:
    """The last line of a script."""
    command = [
        sys.executable,
        str(FOLDER / f"{script}.py"),
        *(["--quick"] if is_quick else []),
    ]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode not in (
        0,
        1,
    ):  # 1: it missed a target of its own, and its figures hold
        raise SystemExit(f"{script}.py ended with exit code {done.returncode}")
    try:
        found: Figures = json.loads(done.stdout.splitlines()[-1])
    except (IndexError, json.JSONDecodeError):
        raise SystemExit(f"{script}.py ended without a line of figures") from None
    return found


def measure(rounds: int, *, is_quick: bool) -> dict[str, list[float]]:
    """Every ratio of every round."""
    found: dict[str, list[float]] = {name: [] for name in HEADLINES}
    for number in range(1, rounds + 1):
        for script in SCRIPTS:
            note(f"round {number} of {rounds}: {script}")
            figures = figures_of(script, is_quick=is_quick)
            for name, headline in HEADLINES.items():
                if headline.script == script:
                    found[name].append(headline.of(figures))
    return found


def loss(headline: Headline, accepted: float, measured: float) -> float:
    """Relative loss of speed: 0.2 where the ratio is worse by a fifth, negative where it is better."""
    if headline.better == "lower":
        return measured / accepted - 1.0
    return accepted / measured - 1.0


def report(
    measured: dict[str, list[float]], accepted: dict[str, float]
) -> dict[str, float]:
    """Print the table; the loss of every ratio that has an accepted value."""
    rows: list[tuple[object, ...]] = []
    losses = {}
    for name, headline in HEADLINES.items():
        values = measured[name]
        spread = f"{min(values):.3f} to {max(values):.3f}" if len(values) > 1 else "-"
        if name in accepted:
            losses[name] = loss(headline, accepted[name], median(values))
            beside = (accepted[name], f"{losses[name]:+.1%}")
        else:
            beside = ("-", "-")
        rows.append((headline.what, headline.better, median(values), spread, *beside))
    print_table(
        ("ratio of times", "better", "measured", "all rounds", "accepted", "slower by"),
        rows,
    )
    return losses


def parse_arguments() -> argparse.Namespace:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--rounds", type=int, default=1, help="how often each script runs"
    )
    parser.add_argument(
        "--accept",
        action="store_true",
        help=f"write the measured ratios to {ACCEPTED.name}",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=0.15,
        help="largest relative loss of speed that is accepted",
    )
    return parser.parse_args()


def main() -> None:
    arguments = parse_arguments()
    form = "quick" if arguments.quick else "full"
    kept: dict[str, dict[str, float]] = (
        json.loads(ACCEPTED.read_text("utf-8")) if ACCEPTED.is_file() else {}
    )
    measured = measure(max(arguments.rounds, 1), is_quick=arguments.quick)
    losses = report(measured, kept.get(form, {}))
    ratios = {name: float(f"{median(values):.4g}") for name, values in measured.items()}
    if arguments.accept:
        kept[form] = ratios
        ACCEPTED.write_text(json.dumps(kept, indent=2) + "\n", "utf-8")
        note(f"accepted: {ACCEPTED}")
    passed = arguments.accept or all(
        one <= arguments.tolerance for one in losses.values()
    )
    conclude({**ratios, "passed": passed}, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
