"""Did accuracy or consistency get worse beyond noise? A batch against a reference that somebody blessed.

The same suite is run before and after a change. Runs are paired by log, contestant and seed, and each pair gives a log
ratio: of errors, ``ln(new / old)``; of consistency, ``|ln(new)| - |ln(old)|`` of the normalised squared error (1 is
consistent). What the ratios of a log, or of all logs together, say of a contestant and column is tested with
`sonar_graph.batch.permutation`: where nothing got truly worse 5 % of batches fail. A run that fails now and did not
is worse without any test. Method: docs/theory/batch_statistics.md.

The file of a reference: what each run of a blessed batch was asked for, and what it reached.

What a person should look at, because no test can judge it: single runs, and logs with hardly any cases.

Of two draws from one distribution the second has the worst run as often as the first, however far off it is. So none of
this fails a batch. Where runs are deterministic and only the code changed, it is a finding all the same.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sonar_graph.batch.permutation import (
    LEAST_CASES,
    SIGNIFICANT,
    Case,
    Family,
    Group,
    Ratios,
    detectable,
    families,
    testable,
    with_all_logs,
)
from sonar_graph.batch.recorded import ALL_LOGS, RecordedBatch, RecordedRun, require_complete
from sonar_graph.batch.result_table import KINDS, is_timing, metrics_of
from sonar_graph.errors import EvaluationError
from sonar_graph.files import read_json, write_json
from sonar_graph.measurements import Floats

FORMAT = "sonar_graph batch reference 2"
Name = tuple[str, str, int | None]
"""Log, contestant and seed."""


def write_reference(batch: RecordedBatch, keys: list[str], path: Path) -> None:
    """Write all runs with the scores under these keys.

    Raises
    ------
    EvaluationError
        When the results do not say what was asked for.
    """
    content = {"format": FORMAT, "suite": batch.name, "versions": batch.runs[0].texts, "metrics": keys}
    write_json(path, content | {"runs": [_entry(run, keys) for run in batch.runs]})


def _entry(run: RecordedRun, keys: list[str]) -> dict[str, Any]:
    scores = {key: run.values[key] for key in keys if run.ended and key in run.values}
    names = {"log": run.log, "estimator": run.contestant, "seed": run.seed}
    return {**names, "asked": asked_of(run), "status": run.status, "scores": scores}


def asked_of(run: RecordedRun) -> dict[str, Any]:
    """What the suite stated of a run.

    Raises
    ------
    EvaluationError
        When the results are of a version that did not record it.
    """
    if "asked" not in run.texts:
        raise EvaluationError(
            f"{told(name_of(run))}: the results have no column asked, so nobody knows what they are comparable with; "
            "run bench again in that folder"
        )
    return dict(json.loads(run.texts["asked"]))


def read_reference(path: Path) -> dict[str, Any]:
    """Content of a reference, its runs by name.

    Raises
    ------
    EvaluationError
        When the file is no reference of this version.
    """
    content = read_json(path)
    if content.get("format") != FORMAT:
        raise EvaluationError(
            f"{path}: format is {content.get('format')!r}, expected {FORMAT!r}; make it again with bench bless, from a "
            "batch run with the code that it stands for"
        )
    runs = {(entry["log"], entry["estimator"], entry["seed"]): entry for entry in content["runs"]}
    return content | {"runs": runs}


def check_comparable(entry: dict[str, Any], run: RecordedRun, path: Path) -> None:
    """Refuse a run that was asked for something else than the reference's of its name.

    Raises
    ------
    EvaluationError
        With run, field and both values.
    """
    before, now = _flat(entry["asked"]), _flat(asked_of(run))
    for field in sorted(before | now):
        if (field in before, before.get(field)) != (field in now, now.get(field)):
            raise EvaluationError(
                f"{path}: {told(name_of(run))}: {field} is {_value(now, field)}, in the reference "
                f"{_value(before, field)}; these are different experiments: run the suite of the reference, or bless a "
                "new one"
            )


def _flat(asked: dict[str, Any]) -> dict[str, Any]:
    """Fields by name; landmarks that are simulated with nothing stated of them are ``landmarks``, which is ``{}``."""
    flat: dict[str, Any] = {}
    for name, value in asked.items():
        if isinstance(value, dict) and value:
            flat |= {f"{name}.{inner}": content for inner, content in value.items()}
        elif value is not None and (value != {} or name == "landmarks"):
            flat[name] = value
    return flat


def _value(fields: dict[str, Any], field: str) -> str:
    return json.dumps(fields[field]) if field in fields else "not given"


def name_of(run: RecordedRun) -> Name:
    """Under which a run is found again in another batch of its suite."""
    return run.log, run.contestant, run.seed


def told(name: Name) -> str:
    """A run in words."""
    log, contestant, seed = name
    return f"{log}, {contestant}" + ("" if seed is None else f", seed {seed}")


FAR = 2.0
"""An error so many times the worst that the reference has of a contestant on a log stands out."""
ALONE = 0.25
"""Where there is no test, a worsening by more than this share is told."""


@dataclass(frozen=True)
class Pair:
    """One score of a run, and what the reference has."""

    run: RecordedRun
    column: str
    old: float
    new: float


def standing_out(pairs: list[Pair], ratios: Ratios, consistency: Collection[str]) -> list[str]:
    """Runs far beyond all that the reference has, the farthest first, then what has too few cases; one line each."""
    far = _far_runs([pair for pair in pairs if pair.column not in consistency])
    known = {(pair.run.log, pair.run.contestant) for pair in far}
    lines = [
        f"{told(name_of(pair.run))}: {pair.column} is {pair.new:.3g}, before {pair.old:.3g}; more than {FAR:g} times "
        "the worst of the reference"
        for pair in far
    ]
    return [*lines, *_untested(ratios, known)]


def _far_runs(pairs: list[Pair]) -> list[Pair]:
    """Of each run that is far off in any column the one in which it is farthest."""
    worst: dict[Group, float] = {}
    for pair in pairs:
        group = (pair.run.log, pair.run.contestant, pair.column)
        worst[group] = max(worst.get(group, 0.0), pair.old)
    farthest: dict[str, tuple[float, Pair]] = {}
    for pair in pairs:
        base = worst[pair.run.log, pair.run.contestant, pair.column]
        if pair.new > FAR * base > 0:
            name = told(name_of(pair.run))
            farthest[name] = max(farthest.get(name, (0.0, pair)), (pair.new / base, pair), key=lambda one: one[0])
    return [pair for _, pair in sorted(farthest.values(), key=lambda one: -one[0])]


def _untested(ratios: Ratios, known: set[tuple[str, str]]) -> list[str]:
    """Contestants and logs that are up without a test of their own, each with the column that is up most."""
    have_test = testable(ratios)
    most: dict[tuple[str, str], tuple[float, int, str]] = {}
    for (log, contestant, column), own in ratios.items():
        is_told = log == ALL_LOGS or (log, contestant) in known or (log, contestant, column) in have_test
        mean = float(np.mean(list(own.values())))
        if not is_told and mean > np.log1p(ALONE):
            most[log, contestant] = max(most.get((log, contestant), (0.0, 0, "")), (mean, len(own), column))
    return [
        f"{log}, {contestant}: {column} is {np.expm1(mean):.0%} worse; {cases} {'case' if cases == 1 else 'cases'} "
        "here, which no test judges"
        for (log, contestant), (mean, cases, column) in most.items()
    ]


TOLERANCE = 0.02
"""Relative worsening of an error that nobody minds."""
CONSISTENCY_TOLERANCE = 0.1
CONSISTENCY_KEYS = tuple(f"{kind}.{name}" for kind in KINDS for name in ("nees_position", "nees_yaw"))


@dataclass(frozen=True)
class Worsening:
    """One reason why a batch does not pass."""

    log: str
    contestant: str
    column: str
    """Of the results, several where their numbers are the same; ``status`` for runs that failed."""
    explanation: str

    def __str__(self) -> str:
        return f"{self.log}, {self.contestant}, {self.column}: {self.explanation}"


@dataclass(frozen=True)
class GateVerdict:
    """What the gate says."""

    worsenings: list[Worsening]
    look_at: list[str]
    """What no test can judge: single runs, and logs with too few cases. Nothing of it fails a batch."""
    compared: int
    """Pairs of runs."""
    cases: dict[str, int]
    """Of each contestant that was compared: seeds, and logs without seeds."""
    detectable: dict[str, float]
    """Worsening that would have been found with 80 % probability, by contestant that has a test and moved."""
    new: list[str]
    """Runs that the reference does not know, which are not judged."""

    @property
    def passed(self) -> bool:
        """Whether nothing got worse."""
        return not self.worsenings

    @property
    def untested(self) -> list[str]:
        """Contestants with too few cases for a test."""
        return [contestant for contestant, cases in self.cases.items() if cases < LEAST_CASES]

    @property
    def has_test(self) -> bool:
        """Whether a worsening of any contestant could have failed the batch."""
        return len(self.untested) < len(self.cases)

    @property
    def unmoved(self) -> list[str]:
        """Contestants that have a test and whose scores are all within the tolerance of the reference's."""
        return [name for name in self.cases if name not in self.detectable and name not in self.untested]


def bless(batch: RecordedBatch, path: Path) -> None:
    """Write what this batch reached as the reference of later ones; a deliberate act.

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
    write_reference(batch, gated_keys(batch), path)


def gated_keys(batch: RecordedBatch) -> list[str]:
    """Columns that are judged: the suite's errors, causal and smoothed, and consistency."""
    errors = [key for metric in metrics_of(batch.metrics) if metric.is_error for key in metric.keys.values()]
    return [*errors, *CONSISTENCY_KEYS]


def gate(batch: RecordedBatch, reference: Path) -> GateVerdict:
    """Judge a batch by a blessed reference.

    Raises
    ------
    EvaluationError
        When the file is no reference, a run of the batch was not done, the batch lacks a run that the reference has
        (what is missing is not passed), or a run was asked for something else.
    """
    require_complete(batch, reference, "be held against it")
    blessed = read_reference(reference)
    runs = {name_of(run): run for run in batch.runs}
    missing = sorted(set(blessed["runs"]) - set(runs), key=told)
    if missing:
        raise EvaluationError(
            f"{reference}: {len(missing)} of its runs are not in the batch, first {told(missing[0])}; run the same "
            "suite, or bless a new reference"
        )
    entries = [(entry, runs[name]) for name, entry in blessed["runs"].items()]
    for entry, run in entries:
        check_comparable(entry, run, reference)
    columns = [key for key in blessed["metrics"] if not is_timing(key)]
    new = [told(name) for name in runs if name not in blessed["runs"]]
    return _verdict(entries, columns, new)


def _verdict(entries: list[tuple[dict[str, Any], RecordedRun]], columns: list[str], new: list[str]) -> GateVerdict:
    pairs = [pair for entry, run in entries for pair in _pairs(entry, run, columns)]
    ratios = with_all_logs(_ratios(pairs))
    tested = families(movable(ratios))
    cases: dict[str, set[Case]] = {run.contestant: set() for _, run in entries}
    for (_, contestant, _), values in ratios.items():
        cases[contestant].update(values)
    errors = [column for column in columns if column not in CONSISTENCY_KEYS]
    return GateVerdict(
        worsenings=[*_failures(entries), *worse_groups(ratios, tested)],
        look_at=standing_out(pairs, ratios, CONSISTENCY_KEYS),
        compared=len(entries),
        cases={contestant: len(own) for contestant, own in cases.items()},
        detectable=detectable(tested, errors, math.log1p(TOLERANCE)),
        new=new,
    )


def _pairs(entry: dict[str, Any], run: RecordedRun, columns: list[str]) -> list[Pair]:
    values = [(column, entry["scores"].get(column, math.inf), run.value(column)) for column in columns]
    return [Pair(run, *value) for value in values if all(map(math.isfinite, value[1:]))]


def _failures(entries: list[tuple[dict[str, Any], RecordedRun]]) -> list[Worsening]:
    """Runs that ended in the reference and do not now, or have lost a score."""
    found = []
    for entry, run in entries:
        seed = "" if run.seed is None else f"seed {run.seed}: "
        if entry["status"] == "ok" and not run.ended:
            found.append(Worsening(run.log, run.contestant, "status", f"{seed}{run.status}, {run.reason}"))
        elif lost := [key for key in entry["scores"] if key not in run.values and run.ended]:
            found.append(Worsening(run.log, run.contestant, ", ".join(lost), f"{seed}no value, the reference has one"))
    return found


def log_ratios(old: Floats, new: Floats, column: str) -> Floats:
    """How much worse each run is, shape (n,): above 0 is worse."""
    least = np.finfo(float).tiny
    old_log, new_log = np.log(np.maximum(old, least)), np.log(np.maximum(new, least))
    if column in CONSISTENCY_KEYS:
        return np.asarray(np.abs(new_log) - np.abs(old_log))
    return np.asarray(new_log - old_log)


def _ratios(pairs: list[Pair]) -> Ratios:
    """Log ratios by group and case: a seed, and where there is none a log."""
    found: Ratios = {}
    for pair in pairs:
        ratio = log_ratios(np.array([pair.old]), np.array([pair.new]), pair.column)[0]
        case = pair.run.log if pair.run.seed is None else pair.run.seed
        found.setdefault((pair.run.log, pair.run.contestant, pair.column), {})[case] = float(ratio)
    return found


def limit_of(column: str) -> float:
    """Log ratio that is allowed."""
    return math.log1p(CONSISTENCY_TOLERANCE if column in CONSISTENCY_KEYS else TOLERANCE)


def movable(ratios: Ratios) -> Ratios:
    """Ratios beyond the limit, of groups that can be worse, each set of numbers once.

    The mean is at most the root of the mean square: where this is within the limit there is nothing to test, and no
    test to correct for. It looks at sizes alone, so old and new may be exchanged.
    """
    distinct = {(group[1], tuple(cases.items())): group for group, cases in reversed(ratios.items())}
    return {
        group: {case: ratio - limit_of(group[2]) for case, ratio in cases.items()}
        for group, cases in ratios.items()
        if distinct[group[1], tuple(cases.items())] == group
        and math.sqrt(np.square(list(cases.values())).mean()) > limit_of(group[2])
    }


def worse_groups(ratios: Ratios, tested: list[Family]) -> list[Worsening]:
    """Groups that are significantly beyond the limit."""
    worse = []
    for family in tested:
        for group, p_value in zip(family.groups, family.p_values.tolist(), strict=True):
            if p_value <= SIGNIFICANT:
                worse.append(_worsening(group, ratios, p_value))
    return worse


def _worsening(group: Group, ratios: Ratios, p_value: float) -> Worsening:
    log, contestant, column = group
    own = ratios[group]
    columns = [other for at, name, other in ratios if (at, name) == group[:2] and ratios[at, name, other] == own]
    share = f"{np.expm1(np.mean(list(own.values()))):.1%}"
    change = f"{share} farther from 1" if column in CONSISTENCY_KEYS else f"+{share}"
    explanation = f"{change} in the mean of {len(own)} cases, p = {p_value:.2g} (of the whole batch)"
    return Worsening(log, contestant, ", ".join(columns), explanation)
