"""Gate: a batch judged against a blessed reference by whether accuracy or consistency got worse beyond noise.

The same suite is run before and after a change. Runs are paired by log, contestant and seed, and each pair gives a log
ratio: ``ln(new / old)`` of errors, and ``|ln(new)| - |ln(old)|`` of the normalised squared error (1 is consistent).
`permutation` tests the ratios of each contestant and column, on a log and on all logs together: a
batch in which nothing truly got worse fails with 5 % probability. A run that fails now and did not before is worse
without a test. Single runs, and logs with few cases, are reported but fail no batch: of two draws from one
distribution, the second has the worst run as often as the first. Method: docs/theory/batch_statistics.md.

Write the reference, then judge later batches by it. Exit code 0: passed, 1: worse, 2: nothing could be judged::

    python benchmarks/regression/regression_gate.py bless results reference.json
    python benchmarks/regression/regression_gate.py judge later reference.json --strict
"""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parent))
import permutation

from sonar_graph.batch import (
    ALL_LOGS,
    GOING_ON,
    KINDS,
    RecordedBatch,
    RecordedRun,
    metrics_of,
    read_batch,
)
from sonar_graph.batch.result_table import is_timing
from sonar_graph.cli.outputs import is_json, writable_file
from sonar_graph.errors import EvaluationError, SonarGraphError
from sonar_graph.files import read_json, write_json
from sonar_graph.measurements import Floats

FORMAT = "sonar_graph batch reference 2"
Name = tuple[str, str, int | None]
"""Log, contestant and seed of a run, by which it is found again in another batch."""
TOLERANCE = 0.02
"""Relative worsening of an error that is accepted."""
CONSISTENCY_TOLERANCE = 0.1
CONSISTENCY_KEYS = tuple(
    f"{kind}.{name}" for kind in KINDS for name in ("nees_position", "nees_yaw")
)
FAR = 2.0
"""An error stands out if it is so many times the worst of its contestant on its log in the reference."""
ALONE = 0.25
"""Without a test, a worsening by more than this share is reported."""


@dataclass(frozen=True)
class Pair:
    """One score of a run, new and in the reference."""

    run: RecordedRun
    column: str
    old: float
    new: float


@dataclass(frozen=True)
class Worsening:
    """One reason for a batch not to pass."""

    log: str
    contestant: str
    column: str
    """Columns of the results with these numbers; ``status`` for runs that failed."""
    explanation: str

    def __str__(self) -> str:
        return f"{self.log}, {self.contestant}, {self.column}: {self.explanation}"


@dataclass(frozen=True)
class GateVerdict:
    """Result of `gate`."""

    worsenings: list[Worsening]
    look_at: list[str]
    """Lines on single runs that stand out and on logs with too few cases for a test. They fail no batch."""
    compared: int
    """Number of pairs of runs."""
    cases: dict[str, int]
    """Number of cases of each contestant: seeds, and logs without seeds."""
    detectable: dict[str, float]
    """Worsening that would be found with 80 % probability, by contestant that has a test and moved."""
    new: list[str]
    """Runs that the reference does not have; they are not judged."""

    @property
    def passed(self) -> bool:
        """True if nothing got worse."""
        return not self.worsenings

    @property
    def untested(self) -> list[str]:
        """Contestants with too few cases for a test."""
        return [
            contestant
            for contestant, cases in self.cases.items()
            if cases < permutation.LEAST_CASES
        ]

    @property
    def has_test(self) -> bool:
        """True if a worsening of some contestant could have failed the batch."""
        return len(self.untested) < len(self.cases)

    @property
    def unmoved(self) -> list[str]:
        """Contestants that have a test and whose scores all lie within the tolerance."""
        return [
            name
            for name in self.cases
            if name not in self.detectable and name not in self.untested
        ]


def bless(batch: RecordedBatch, path: Path) -> None:
    """Write the scores of this batch to a file, as the reference of later batches.

    Raises
    ------
    EvaluationError
        When a planned run was not done, no run ended, or the results do not say what was asked for.
    """
    require_complete(batch, path, "become a reference")
    if not any(run.ended for run in batch.runs):
        raise EvaluationError(
            f"{batch.name}: none of its {len(batch.runs)} runs ended, so every batch would pass by it"
        )
    errors = [
        key
        for metric in metrics_of(batch.metrics)
        if metric.is_error
        for key in metric.keys.values()
    ]
    keys = [*errors, *CONSISTENCY_KEYS]
    entries = [
        {
            "log": run.log,
            "estimator": run.contestant,
            "seed": run.seed,
            "asked": asked_of(run),
            "status": run.status,
            "scores": {
                key: run.values[key] for key in keys if run.ended and key in run.values
            },
        }
        for run in batch.runs
    ]
    content = {
        "format": FORMAT,
        "suite": batch.name,
        "versions": batch.runs[0].texts,
        "metrics": keys,
    }
    write_json(path, content | {"runs": entries})


def is_reference(content: dict[str, Any]) -> bool:
    """True for the content of a file that `bless` wrote, also in an earlier format."""
    return str(content.get("format")).startswith(FORMAT.rstrip("0123456789"))


def gate(batch: RecordedBatch, reference: Path) -> GateVerdict:
    """Judge a batch by a blessed reference.

    Raises
    ------
    EvaluationError
        When the file is no reference, a run of the batch was not done, the batch lacks a run of the reference, or the
        suite states other options for a run than that of the reference.
    """
    require_complete(batch, reference, "be held against it")
    content = read_json(reference)
    if content.get("format") != FORMAT:
        raise EvaluationError(
            f"{reference}: format is {content.get('format')!r}, expected {FORMAT!r}; make it again with bless, "
            "from a batch run with the code that it stands for"
        )
    blessed: dict[Name, dict[str, Any]] = {
        (entry["log"], entry["estimator"], entry["seed"]): entry
        for entry in content["runs"]
    }
    runs = {name_of(run): run for run in batch.runs}
    missing = sorted(set(blessed) - set(runs), key=told)
    if missing:
        raise EvaluationError(
            f"{reference}: {len(missing)} of its runs are not in the batch, first {told(missing[0])}; run the same "
            "suite, or bless a new reference"
        )
    for name, entry in blessed.items():
        check_comparable(entry, runs[name], reference)
    columns = [key for key in content["metrics"] if not is_timing(key)]
    worsenings: list[Worsening] = []
    pairs: list[Pair] = []
    ratios: permutation.Ratios = {}
    for name, entry in blessed.items():
        run = runs[name]
        scores = entry["scores"]
        seed = "" if run.seed is None else f"seed {run.seed}: "
        if entry["status"] == "ok" and not run.ended:
            worsenings.append(
                Worsening(
                    run.log,
                    run.contestant,
                    "status",
                    f"{seed}{run.status}, {run.reason}",
                )
            )
        elif lost := [key for key in scores if key not in run.values and run.ended]:
            explanation = f"{seed}no value, the reference has one"
            worsenings.append(
                Worsening(run.log, run.contestant, ", ".join(lost), explanation)
            )
        for column in columns:
            old = scores.get(column, math.inf)
            new = run.value(column)
            if math.isfinite(old) and math.isfinite(new):
                pairs.append(Pair(run, column, old, new))
                case = run.log if run.seed is None else run.seed
                ratio = float(log_ratios(np.array([old]), np.array([new]), column)[0])
                ratios.setdefault((run.log, run.contestant, column), {})[case] = ratio
    ratios = permutation.with_all_logs(ratios)
    tested = permutation.families(movable(ratios))
    cases: dict[str, set[permutation.Case]] = {
        runs[name].contestant: set() for name in blessed
    }
    for (_, contestant, _), values in ratios.items():
        cases[contestant].update(values)
    errors = [column for column in columns if column not in CONSISTENCY_KEYS]
    return GateVerdict(
        worsenings=[*worsenings, *worse_groups(ratios, tested)],
        look_at=standing_out(pairs, ratios),
        compared=len(blessed),
        cases={contestant: len(own) for contestant, own in cases.items()},
        detectable=permutation.detectable(tested, errors, math.log1p(TOLERANCE)),
        new=[told(name) for name in runs if name not in blessed],
    )


def name_of(run: RecordedRun) -> Name:
    """Name by which a run is found again in another batch of its suite."""
    return run.log, run.contestant, run.seed


def told(name: Name) -> str:
    """A run's name in words."""
    log, contestant, seed = name
    return f"{log}, {contestant}" + ("" if seed is None else f", seed {seed}")


def asked_of(run: RecordedRun) -> dict[str, Any]:
    """Options that the suite states for a run.

    Raises `EvaluationError` when the results are of a version that did not record it.
    """
    if "asked" not in run.texts:
        raise EvaluationError(
            f"{told(name_of(run))}: the results have no column asked, so nobody knows what they are comparable with; "
            "run bench again in that folder"
        )
    return dict(json.loads(run.texts["asked"]))


def check_comparable(entry: dict[str, Any], run: RecordedRun, path: Path) -> None:
    """Refuse a run for which the suite states something else than for the reference's run of its name.

    Raises `EvaluationError` with run, field and both values.
    """
    before = _flat(entry["asked"])
    now = _flat(asked_of(run))
    for field in sorted(before | now):
        if (field in before, before.get(field)) != (field in now, now.get(field)):
            raise EvaluationError(
                f"{path}: {told(name_of(run))}: {field} is {_value(now, field)}, in the reference "
                f"{_value(before, field)}; these are different experiments: run the suite of the reference, or bless a "
                "new one"
            )


def _flat(asked: dict[str, Any]) -> dict[str, Any]:
    """Fields by dotted name; simulated landmarks with default options are ``landmarks``, which is ``{}``."""
    flat: dict[str, Any] = {}
    for name, value in asked.items():
        if isinstance(value, dict) and value:
            flat |= {f"{name}.{inner}": content for inner, content in value.items()}
        elif value is not None and (value != {} or name == "landmarks"):
            flat[name] = value
    return flat


def _value(fields: dict[str, Any], field: str) -> str:
    return json.dumps(fields[field]) if field in fields else "not given"


def log_ratios(old: Floats, new: Floats, column: str) -> Floats:
    """Log ratios of new to old scores, shape (n,); above 0 is worse."""
    least = np.finfo(float).tiny
    old_log = np.log(np.maximum(old, least))
    new_log = np.log(np.maximum(new, least))
    if column in CONSISTENCY_KEYS:
        return np.asarray(np.abs(new_log) - np.abs(old_log))
    return np.asarray(new_log - old_log)


def limit_of(column: str) -> float:
    """Log ratio up to which a worsening is accepted."""
    return math.log1p(
        CONSISTENCY_TOLERANCE if column in CONSISTENCY_KEYS else TOLERANCE
    )


def movable(ratios: permutation.Ratios) -> permutation.Ratios:
    """Ratios less the limit, of groups that can be worse; each set of numbers once.

    The mean is at most the root of the mean square. If that is within the limit there is nothing to test, and no test
    to correct for. The rule uses sizes alone, so old and new may still be exchanged.
    """
    distinct = {
        (group[1], tuple(cases.items())): group
        for group, cases in reversed(ratios.items())
    }
    return {
        group: {case: ratio - limit_of(group[2]) for case, ratio in cases.items()}
        for group, cases in ratios.items()
        if distinct[group[1], tuple(cases.items())] == group
        and math.sqrt(np.square(list(cases.values())).mean()) > limit_of(group[2])
    }


def worse_groups(
    ratios: permutation.Ratios, tested: list[permutation.Family]
) -> list[Worsening]:
    """Groups significantly beyond the limit."""
    worse = []
    for family in tested:
        for group, p_value in zip(family.groups, family.p_values.tolist(), strict=True):
            if p_value > permutation.SIGNIFICANT:
                continue
            log, contestant, column = group
            own = ratios[group]
            alike = [
                other
                for at, name, other in ratios
                if (at, name) == group[:2] and ratios[at, name, other] == own
            ]
            share = f"{np.expm1(np.mean(list(own.values()))):.1%}"
            change = (
                f"{share} farther from 1" if column in CONSISTENCY_KEYS else f"+{share}"
            )
            explanation = f"{change} in the mean of {len(own)} cases, p = {p_value:.2g} (of the whole batch)"
            worse.append(Worsening(log, contestant, ", ".join(alike), explanation))
    return worse


def standing_out(pairs: list[Pair], ratios: permutation.Ratios) -> list[str]:
    """Runs far beyond all of the reference, the farthest first, then groups without a test; one line each."""
    errors = [pair for pair in pairs if pair.column not in CONSISTENCY_KEYS]
    worst: dict[permutation.Group, float] = {}
    for pair in errors:
        group = (pair.run.log, pair.run.contestant, pair.column)
        worst[group] = max(worst.get(group, 0.0), pair.old)
    farthest: dict[
        Name, tuple[float, Pair]
    ] = {}  # of each run, the column in which it is farthest
    for pair in errors:
        base = worst[pair.run.log, pair.run.contestant, pair.column]
        if pair.new > FAR * base > 0:
            name = name_of(pair.run)
            farthest[name] = max(
                farthest.get(name, (0.0, pair)),
                (pair.new / base, pair),
                key=lambda one: one[0],
            )
    lines = [
        f"{told(name)}: {pair.column} is {pair.new:.3g}, before {pair.old:.3g}; more than {FAR:g} times the worst of "
        "the reference"
        for name, (_, pair) in sorted(farthest.items(), key=lambda one: -one[1][0])
    ]
    known = {name[:2] for name in farthest}
    have_test = permutation.testable(ratios)
    most: dict[
        tuple[str, str], tuple[float, int, str]
    ] = {}  # the column that is up most
    for (log, contestant, column), own in ratios.items():
        is_told = (
            log == ALL_LOGS
            or (log, contestant) in known
            or (log, contestant, column) in have_test
        )
        mean = float(np.mean(list(own.values())))
        if not is_told and mean > np.log1p(ALONE):
            most[log, contestant] = max(
                most.get((log, contestant), (0.0, 0, "")), (mean, len(own), column)
            )
    return lines + [
        f"{log}, {contestant}: {column} is {np.expm1(mean):.0%} worse; {cases} {'case' if cases == 1 else 'cases'} "
        "here, which no test judges"
        for (log, contestant), (mean, cases, column) in most.items()
    ]


def require_complete(batch: RecordedBatch, subject: str | Path, purpose: str) -> None:
    """Raise `EvaluationError` if a planned run was not done; the message has the subject, and what cannot be done."""
    if batch.missing:
        raise EvaluationError(
            f"{subject}: the batch {batch.name!r} cannot {purpose}, {batch.missing_count}; {GOING_ON}"
        )


SHOWN = 10
"""Most printed lines about single runs that stand out."""


def verdict_lines(verdict: GateVerdict) -> list[str]:
    """Lines of the verdict: worsenings, runs that stand out, and the worsening that the tests could have found."""
    lines = [f"Worse: {worsening}" for worsening in verdict.worsenings]
    lines += [f"Look at: {line}" for line in verdict.look_at[:SHOWN]]
    if len(verdict.look_at) > SHOWN:
        lines.append(
            f"Look at: {len(verdict.look_at) - SHOWN} more such lines are not shown"
        )
    if verdict.new:
        lines.append(
            f"Not judged: {len(verdict.new)} runs that the reference does not have, first {verdict.new[0]}"
        )
    if verdict.untested:
        counted = [f"{name} ({verdict.cases[name]})" for name in verdict.untested]
        lines.append(
            f"No test of errors: {', '.join(counted)}: it needs 3 cases, which are seeds, or logs without seeds"
        )
    if verdict.unmoved:
        lines.append(
            f"Hardly different from the reference: {', '.join(verdict.unmoved)}"
        )
    if verdict.detectable:
        sizes = []
        for name, share in verdict.detectable.items():
            is_found = math.isfinite(share)
            size = f"about {share:.0%}" if is_found else "more than ten times"
            sizes.append(f"{size} ({name}, {verdict.cases[name]} cases)")
        lines.append(
            f"Would have been found in four of five batches: one error larger on all logs by {', '.join(sizes)}"
        )
    return lines


def main(words: Sequence[str] | None = None) -> int:
    """Bless or judge a batch, print the outcome, and return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    blessing = commands.add_parser("bless", help="make a batch the reference")
    judging = commands.add_parser("judge", help="judge a batch by a reference")
    for command in (blessing, judging):
        command.add_argument("batch", type=Path, help="folder that bench wrote")
        command.add_argument("reference", type=Path, help="a file *.json")
    blessing.add_argument(
        "--overwrite", action="store_true", help="also replace a file of others"
    )
    judging.add_argument(
        "--strict", action="store_true", help="lines that begin with 'Look at' fail too"
    )
    arguments = parser.parse_args(words)
    try:
        batch = read_batch(arguments.batch)
        if arguments.command == "bless":
            writable_file(
                arguments.reference,
                ".json",
                is_json(is_reference),
                overwrite=arguments.overwrite,
            )
            bless(batch, arguments.reference)
            failed = sum(not run.ended for run in batch.runs)
            print(
                f"Reference: {arguments.reference} ({len(batch.runs)} runs, {failed} of which did not end)"
            )
            return 0
        return print_verdict(
            gate(batch, arguments.reference),
            arguments.reference,
            is_strict=arguments.strict,
        )
    except (SonarGraphError, OSError) as error:
        print(error, file=sys.stderr)
        return 2


def print_verdict(verdict: GateVerdict, reference: Path, *, is_strict: bool) -> int:
    """Print the verdict, and return 1 if the batch fails; if strict, also if any run stands out."""
    for line in verdict_lines(verdict):
        print(line)
    is_passed = verdict.passed and not (is_strict and verdict.look_at)
    outcome = "passed" if is_passed else "failed"
    if is_passed and not verdict.has_test:
        outcome = "passed, without any test of errors"
    print(f"Gate: {outcome}, {verdict.compared} runs held against {reference}")
    return 0 if is_passed else 1


if __name__ == "__main__":
    raise SystemExit(main())
