"""Logs by another hand: every fault of the table of checks at three sizes, and logs without a fault.

    python benchmarks/validation/foreign_logs.py [--quick] [--seed 1] [--faultless 50] [--coverage 100]
        [--only WORD ...] [--results FILE] [--table benchmarks/results/foreign_logs.md]

Worlds and files are those of `foreign_world.py`, faults those of `foreign_faults.py`. A log is judged by
``sonar-graph compare``, by its exit code, its printed lines and the trajectories that it writes:

* ``silent``: the error is over five times that of the log without the fault, and no line names the cause;
* ``warned``: a line names the cause, the error is over five times as large, and the exit code is 0;
* ``misled``: a line asks for a change of a sensor that is right;
* ``unhelpful``: no results, and no line names the cause;
* ``false_alarms``: a log without a fault whose lines ask for a change, or whose exit code is not 0.

Rows that their driver marks as not measured are judged against the log without these rows. ``--coverage`` counts how
often the 95 % intervals of ``sonar-graph inspect --json`` hold the true value on logs without a fault. Each log's
outcome is added to ``--results`` at once; a second run with the same file goes on where the first stopped.
"""

import argparse
import contextlib
import copy
import io
import json
import os
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from foreign_faults import Fault, Marked, MarkedSightings, roles, table
from foreign_world import EPOCH_S, Log, calibration_of, make_log, write

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import make_parser, note, print_figures, print_table

os.environ.setdefault("COLUMNS", "2000")  # before rich: a warning stays on its line
from sonar_graph import report
from sonar_graph.cli.main import main as main_command
from sonar_graph.evaluation import write_comparison

report.write_report = (
    write_comparison  # the page is not judged, and its figures take half of the time
)

WORSE = 5.0
"""Ratio of errors above which a fault matters."""
LEAST_ERROR_M = 0.05
FAULTLESS = "faultless"
FAILURES = ("silent", "warned", "misled", "unhelpful", "false alarm")
FIGURES = (
    "logs",
    "right",
    "silent",
    "warned",
    "misled",
    "unhelpful",
    "refused",
    "faultless",
    "false_alarms",
)
QUANTITIES = (
    "angular rate",
    "specific force",
    "velocity",
    "depth",
    "heading",
    "position",
    "range",
    "azimuth",
)
KINDS = ("stuck", "late", "axes or sense", "unit", "scale", "marked invalid")


# --- judging -----------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """What ``compare`` did with a log."""

    code: int
    lines: list[str]
    error_m: float

    def asks_for(self) -> set[str]:
        """Tables and sections that its doubts and warnings ask to change."""
        text = " ".join(
            line for line in self.lines if line.startswith(("Doubtful", "Warning"))
        )
        asked = set(re.findall(r"under \[(\w+)\]", text))
        return asked | set(re.findall(r"`(\w+)\.[\w.]+ = ", text))

    def names(self, words: str) -> bool:
        """True where a line names a cause."""
        return any(re.search(words, line) for line in self.lines)


@dataclass
class Judgement:
    """One log, for the file of results."""

    fault: str
    size: float
    seed: list[int]
    verdict: str
    is_named: bool
    code: int
    error_m: float
    without_m: float | None
    """Error of the log without the fault, where it decided."""
    world: str
    lines: list[str]


def command(*words: str | Path) -> tuple[int, str]:
    """Exit code and printed text of ``sonar-graph`` with these words, in this process, which is faster."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main_command([str(word) for word in words])
        except SystemExit as end:
            code = int(end.code or 0)
            if "interrupted" in printed.getvalue():
                raise
            return code, printed.getvalue()
    return 0, printed.getvalue()


def outcome_of(log: Log, folder: Path) -> Outcome:
    """Run ``compare`` as the owner of the log would."""
    path = folder / "dive.mcap"
    vehicle = folder / "vehicle.toml"
    results = folder / "results"
    write(log, path)
    vehicle.write_text(calibration_of(log))
    options = [
        "--calibration",
        vehicle,
        "-o",
        results,
        "--overwrite",
        "--estimators",
        "isam2,ekf-slam",
    ]
    code, text = command("compare", path, *options)
    errors = [0.0]
    for name in ("isam2", "ekf-slam"):
        file = results / "runs" / name / "causal.tum"
        if code in (0, 3) and file.exists():
            rows = np.loadtxt(file)
            seconds = rows[:, 0] - EPOCH_S
            true = np.column_stack(
                [
                    np.interp(seconds, log.truth[:, 0], column)
                    for column in log.truth[:, 1:].T
                ]
            )
            errors.append(
                float(np.sqrt(np.mean(np.sum((rows[:, 1:4] - true) ** 2, axis=1))))
            )
    return Outcome(code, text.splitlines(), max(errors))


def judge(fault: Fault, size: float, seed: list[int], folder: Path) -> Judgement:
    """Verdict on a log with a fault; the log without it is only run where it decides."""
    right = make_log(seed, fault.needs)
    log = copy.deepcopy(right)
    fault.spoil(log, size)
    outcome = outcome_of(log, folder)
    is_named = outcome.names(fault.words)
    is_wrong_line = bool(outcome.asks_for() - fault.roles)
    without_m = None
    is_worse = False
    if (
        outcome.code in (0, 3)
        and not (is_named and outcome.code == 3)
        and outcome.error_m > LEAST_ERROR_M
    ):
        if isinstance(fault.spoil, Marked | MarkedSightings):
            fault.spoil.without(right, size)
        without_m = outcome_of(right, folder).error_m
        is_worse = outcome.error_m > WORSE * max(without_m, LEAST_ERROR_M / WORSE)
    verdict = "right"
    if outcome.code not in (0, 3):
        verdict = "refused" if is_named else "unhelpful"
    elif is_wrong_line:
        verdict = "misled"
    elif is_worse and not is_named:
        verdict = "silent"
    elif is_worse and outcome.code == 0:
        verdict = "warned"
    return judgement(
        fault.name,
        size,
        seed,
        verdict,
        outcome,
        right,
        is_named=is_named,
        without_m=without_m,
    )


def judge_faultless(seed: list[int], folder: Path) -> Judgement:
    """Verdict on a log without a fault."""
    log = make_log(seed)
    outcome = outcome_of(log, folder)
    is_alarm = bool(outcome.asks_for()) or outcome.code != 0
    return judgement(
        FAULTLESS,
        float(seed[-1]),
        seed,
        "false alarm" if is_alarm else "right",
        outcome,
        log,
    )


def judgement(
    fault: str,
    size: float,
    seed: list[int],
    verdict: str,
    outcome: Outcome,
    log: Log,
    *,
    is_named: bool = False,
    without_m: float | None = None,
) -> Judgement:
    """The record of a log."""
    world = log.world
    text = (
        f"{world.style} {world.speed_m_s:.2f} m/s, IMU {world.imu_hz:g} Hz, DVL {world.dvl_hz:g} Hz, noise "
        f"{world.noise:g}, {', '.join(sorted(world.sensors))}, {len(world.gaps_s)} gaps"
        f"{'' if world.is_start_stated else ', start not stated'}"
    )
    lines = [
        line
        for line in outcome.lines
        if line.startswith(("Doubt", "Warn", "sonar", "Log"))
    ]
    return Judgement(
        fault,
        size,
        seed,
        verdict,
        is_named,
        outcome.code,
        outcome.error_m,
        without_m,
        text,
        lines,
    )


def measure(arguments: argparse.Namespace, folder: Path) -> list[Judgement]:
    """Judge every log that the file of results does not have, one size after the other."""
    file = arguments.results
    done: list[Judgement] = []
    if file is not None and file.exists():
        done = [Judgement(**json.loads(line)) for line in file.read_text().splitlines()]
    known = {(one.fault, tuple(one.seed)) for one in done}
    faults = table()
    wanted: list[tuple[Fault | None, float, list[int]]] = []
    for place in range(arguments.sizes):
        for number, fault in enumerate(faults):
            if not arguments.only or any(word in fault.name for word in arguments.only):
                wanted.append(
                    (fault, fault.sizes[place], [arguments.seed, number, place])
                )
    wanted += [
        (None, 0.0, [arguments.seed, len(faults), place])
        for place in range(arguments.faultless)
    ]
    wanted = [
        one
        for one in wanted
        if (one[0].name if one[0] else FAULTLESS, tuple(one[2])) not in known
    ]
    # a run that is stopped has seen a bit of everything
    order = np.random.default_rng(arguments.seed).permutation(len(wanted)).tolist()
    for count, (fault, size, seed) in enumerate([wanted[place] for place in order]):
        one = (
            judge_faultless(seed, folder)
            if fault is None
            else judge(fault, size, seed, folder)
        )
        done.append(one)
        note(
            f"{count + 1} of {len(wanted)}: {one.fault} {one.size:.4g}: {one.verdict}, {one.error_m:.2f} m"
        )
        if one.verdict not in ("right", "refused"):
            note(
                "\n".join(
                    [f"  {one.world}", *(f"  {line[:600]}" for line in one.lines)]
                )
            )
        if file is not None:
            with file.open("a") as opened:
                opened.write(json.dumps(asdict(one)) + "\n")
    return done


def true_values(log: Log) -> dict[str, float]:
    """What the quantities of ``inspect`` are, by the beginning of their names."""
    arm = log.world.dvl_arm_m - log.world.imu_arm_m
    return {
        "DVL against IMU: time offset": 0.0,
        "DVL mounting yaw": 0.0,
        "DVL scale": 1.0,
        "lever arm from IMU to DVL, x": arm[0],
        "lever arm from IMU to DVL, y": arm[1],
        "lever arm from IMU to DVL, z": arm[2],
        "depth: change over": 1.0,
        "depth against": 0.0,
        "heading: turn over": 1.0,
        "heading against": 0.0,
        "position fixes: change": 1.0,
        "position fixes against": 0.0,
        "ranges to landmarks: change": 1.0,
        "azimuths of landmarks: change": 1.0,
    }


@dataclass
class Coverage:
    """How often the 95 % intervals of a quantity hold the true value."""

    quantity: str
    logs: int
    share: float
    rms: float
    """Of error over sigma."""


def coverage(arguments: argparse.Namespace, folder: Path) -> list[Coverage]:
    """Run ``inspect`` on logs without a fault."""
    ratios: dict[str, list[float]] = {}
    for place in range(arguments.coverage):
        log = make_log(
            [arguments.seed, 10_000, place],
            roles("depth", "heading", "fixes", "sonar", "names"),
        )
        path = folder / "dive.mcap"
        vehicle = folder / "vehicle.toml"
        write(log, path)
        vehicle.write_text(calibration_of(log))
        _, text = command("inspect", path, "--calibration", vehicle, "--json")
        true = true_values(log)
        for finding in json.loads(text)["sensors"]:
            for name, value in true.items():
                if (
                    finding["quantity"].startswith(name)
                    and finding["value"] is not None
                ):
                    ratios.setdefault(name, []).append(
                        (finding["value"] - value) / finding["sigma"]
                    )
        note(f"coverage: {place + 1} of {arguments.coverage}")
    found = []
    for name, errors in ratios.items():
        held = float(np.mean(np.abs(errors) < 1.96))
        found.append(
            Coverage(
                name, len(errors), held, float(np.sqrt(np.mean(np.square(errors))))
            )
        )
    return found


WORDS = {"refused": "refused with the cause", "right": "named", "harmless": "harmless"}
ELSEWHERE = {
    ("specific force", "late"): "one message: as the angular rate",
    ("range", "axes or sense"): "one message: as the azimuth",
    ("azimuth", "late"): "one message: as the range",
}


def cell(done: list[Judgement], quantity: str, kind: str) -> str:
    """What was found of one cell of the table, by fault and size."""
    if (quantity, kind) in ELSEWHERE:
        return ELSEWHERE[quantity, kind]
    texts = []
    for fault in table():
        if (fault.quantity, fault.kind) != (quantity, kind):
            continue
        sizes: dict[str, list[str]] = {}
        for one in sorted(done, key=lambda one: one.seed):
            if one.fault == fault.name:
                is_harmless = one.verdict == "right" and not one.is_named
                word = "harmless" if is_harmless else one.verdict
                sizes.setdefault(WORDS.get(word, word), []).append(f"{one.size:.3g}")
        told = "; ".join(f"{word} {', '.join(of)}" for word, of in sizes.items())
        texts.append(f"{fault.detail}: {told or 'not judged'}")
    return "<br>".join(texts)


def counts_of(done: list[Judgement]) -> dict[str, int]:
    """Number of logs by verdict."""
    counts = Counter[str]()
    for one in done:
        is_faultless = one.fault == FAULTLESS
        counts["faultless" if is_faultless else "logs"] += 1
        if one.verdict == "false alarm":
            counts["false_alarms"] += 1
        elif not is_faultless:
            counts[one.verdict] += 1
    return {name: counts[name] for name in FIGURES}


def page(
    arguments: argparse.Namespace, done: list[Judgement], covered: list[Coverage]
) -> str:
    """What was found of each cell, at which size, what was not, and the coverage of intervals, as Markdown."""
    command_line = f"benchmarks/validation/foreign_logs.py --seed {arguments.seed}"
    cells = [
        (quantity, *(cell(done, quantity, kind) for kind in KINDS))
        for quantity in QUANTITIES
    ]
    missed = [
        (
            one.fault,
            f"{one.size:.3g}",
            one.verdict,
            f"{one.error_m:.2f}",
            "" if one.without_m is None else f"{one.without_m:.2f}",
            one.world,
        )
        for one in done
        if one.verdict in FAILURES
    ]
    of_misses = (
        "fault",
        "size",
        "verdict",
        "error (m)",
        "without the fault (m)",
        "world",
    )
    intervals = [
        (one.quantity, one.logs, f"{one.share:.2f}", f"{one.rms:.2f}")
        for one in covered
    ]
    of_intervals = ("95 % interval of", "logs", "held", "rms error / sigma")
    counts = counts_of(done)
    return "\n\n".join(
        [
            "# Faults of foreign logs",
            f"Written by `{command_line}`, whose docstring explains the words: dives of a minute by worlds "
            "and a writer that share no code with the package, each with one fault, or without one. A fault is "
            "*named* where a line names its cause, and *harmless* where no line does and the error stays below five "
            "times that without the fault. "
            "See [sensor_check](../../docs/theory/sensor_check.md).",
            markdown(list(counts), [list(counts.values())]),
            "## By quantity and kind",
            markdown(["quantity", *KINDS], cells),
            "## Not judged as they should be",
            markdown(of_misses, missed) if missed else "None.",
            "## Intervals of `inspect`",
            markdown(of_intervals, intervals) if intervals else "Not measured.",
        ]
    )


def markdown(headers: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table."""
    lines = [headers, ["---"] * len(headers), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def main() -> None:
    """Measure and print."""
    parser = make_parser(__doc__)
    parser.add_argument("--seed", type=int, default=1, help="of all logs")
    parser.add_argument(
        "--faultless", type=int, default=50, help="logs without a fault"
    )
    parser.add_argument("--sizes", type=int, default=3, help="sizes of each fault")
    parser.add_argument(
        "--coverage", type=int, default=0, help="logs for the coverage of intervals"
    )
    parser.add_argument(
        "--only",
        nargs="*",
        default=[],
        metavar="WORD",
        help="faults with a word in their names",
    )
    parser.add_argument("--results", type=Path, help="file of results, to go on with")
    parser.add_argument("--table", type=Path, help="page to write the tables to")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.faultless = min(arguments.faultless, 2)
        arguments.sizes = 1
        arguments.only = arguments.only or [
            "depth: unit",
            "position: stuck",
            "velocity: axes",
            "azimuth: axes",
        ]
    with tempfile.TemporaryDirectory() as name:
        done = measure(arguments, Path(name))
        covered = coverage(arguments, Path(name))
    rows = [
        (one.fault, one.size, one.code, one.error_m, one.without_m, one.verdict)
        for one in done
    ]
    print_table(
        ("fault", "size", "exit code", "error (m)", "without (m)", "verdict"), rows
    )
    if covered:
        print_table(
            ("quantity", "logs", "95 % held", "rms error / sigma"),
            [tuple(asdict(one).values()) for one in covered],
        )
    if arguments.table is not None:
        text = page(arguments, done, covered)
        arguments.table.write_text(text + "\n", encoding="utf-8")
    print_figures(counts_of(done))


if __name__ == "__main__":
    main()
