"""Did accuracy or consistency get worse beyond noise? A batch against a reference that somebody blessed.

The same suite is run before and after a change. Runs are paired by log, estimator and seed, and each pair gives a log
ratio: of errors, ``ln(new / old)``; of consistency, ``|ln(new)| - |ln(old)|`` of the normalised squared error (1 is
consistent). A group is worse where the mean of its log ratios is beyond ``ln(1 + tolerance)`` by a one-sided t test,
corrected by Holm over all groups, where a run fails that did not, or where an error is far beyond all that the
reference ever had in the group. Method: docs/theory/batch_statistics.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from sonar_graph.batch.catalogue import KINDS, is_timing, metrics_of
from sonar_graph.batch.incomplete import require_complete
from sonar_graph.batch.recorded import RecordedBatch, RecordedRun
from sonar_graph.batch.statistics import holm
from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation.strict_json import read_json, write_json
from sonar_graph.measurements import Floats

FORMAT = "sonar_graph batch reference 1"
TOLERANCE = 0.02
"""Relative worsening of an error that nobody minds."""
CONSISTENCY_TOLERANCE = 0.1
SIGNIFICANT = 0.05
FAR = 2.0
"""An error so many times the worst that the reference has in the group is a regression by itself."""
LEAST_PAIRS = 3
ALONE = 0.25
"""With fewer pairs there is no test: a worsening by more than this share is a regression."""
CONSISTENCY_KEYS = tuple(f"{kind}.{name}" for kind in KINDS for name in ("nees_position", "nees_yaw"))
Group = tuple[str, str, str]
"""Log, contestant and column."""


@dataclass(frozen=True)
class Worsening:
    """One reason why a batch does not pass."""

    log: str
    contestant: str
    column: str
    """Of the results; ``status`` for runs that failed."""
    explanation: str

    def __str__(self) -> str:
        return f"{self.log}, {self.contestant}, {self.column}: {self.explanation}"


@dataclass(frozen=True)
class Verdict:
    """What the gate says."""

    worsenings: list[Worsening]
    compared: int
    """Pairs of runs."""
    new: list[str]
    """Runs that the reference does not know, which are not judged."""

    @property
    def passed(self) -> bool:
        """Whether nothing got worse."""
        return not self.worsenings


def bless(batch: RecordedBatch, path: Path) -> None:
    """Write what this batch reached as the reference of later ones; a deliberate act.

    Raises
    ------
    EvaluationError
        When a planned run was not done.
    """
    require_complete(batch, path, "become a reference")
    write_json(
        path,
        {
            "format": FORMAT,
            "suite": batch.name,
            "versions": batch.runs[0].texts,
            "metrics": gated_keys(batch),
            "runs": [_entry(run, gated_keys(batch)) for run in batch.runs],
        },
    )


def gated_keys(batch: RecordedBatch) -> list[str]:
    """Columns that are judged: the suite's errors, causal and smoothed, and consistency."""
    errors = [key for metric in metrics_of(batch.metrics) if metric.is_error for key in metric.keys.values()]
    return [*errors, *CONSISTENCY_KEYS]


def gate(batch: RecordedBatch, reference: Path) -> Verdict:
    """Judge a batch by a blessed reference.

    Raises
    ------
    EvaluationError
        When the file is no reference, a run of the batch was not done, or the batch lacks a run that the reference
        has: what is missing is not passed.
    """
    require_complete(batch, reference, "be held against it")
    blessed = _read_reference(reference)
    runs = {_name(run): run for run in batch.runs}
    missing = sorted(set(blessed["runs"]) - set(runs))
    if missing:
        raise EvaluationError(
            f"{reference}: {len(missing)} of its runs are not in the batch, first {_told(missing[0])}; run the same "
            "suite, or bless a new reference"
        )
    pairs = [(entry, runs[name]) for name, entry in blessed["runs"].items()]
    worse = [*_failures(pairs), *_worse_groups(pairs, _judged(blessed["metrics"]))]
    return Verdict(worse, len(pairs), [_told(name) for name in runs if name not in blessed["runs"]])


def _judged(keys: list[str]) -> list[str]:
    """Columns of a reference without time and memory, which one of an earlier version may have."""
    return [key for key in keys if not is_timing(key)]


def _entry(run: RecordedRun, keys: list[str]) -> dict[str, Any]:
    scores = {key: run.values[key] for key in keys if run.ended and key in run.values}
    return {"log": run.log, "estimator": run.contestant, "seed": run.seed, "status": run.status, "scores": scores}


def _read_reference(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if content.get("format") != FORMAT:
        raise EvaluationError(
            f"{path}: format is {content.get('format')!r}, expected {FORMAT!r}; bless a batch to make a reference"
        )
    runs = {(entry["log"], entry["estimator"], entry["seed"]): entry for entry in content["runs"]}
    return content | {"runs": runs}


def _name(run: RecordedRun) -> tuple[str, str, int | None]:
    return run.log, run.contestant, run.seed


def _told(name: tuple[str, str, int | None]) -> str:
    log, contestant, seed = name
    return f"{log}, {contestant}" + ("" if seed is None else f", seed {seed}")


def _failures(pairs: list[tuple[dict[str, Any], RecordedRun]]) -> list[Worsening]:
    """Runs that ended in the reference and do not now, or have lost a score."""
    found = []
    for entry, run in pairs:
        seed = "" if run.seed is None else f"seed {run.seed}: "
        if entry["status"] == "ok" and not run.ended:
            found.append(Worsening(run.log, run.contestant, "status", f"{seed}{run.status}, {run.reason}"))
        elif lost := [key for key in entry["scores"] if key not in run.values and run.ended]:
            found.append(Worsening(run.log, run.contestant, ", ".join(lost), f"{seed}no value, the reference has one"))
    return found


def _worse_groups(pairs: list[tuple[dict[str, Any], RecordedRun]], keys: list[str]) -> list[Worsening]:
    groups: dict[Group, list[tuple[float, float]]] = {}
    for entry, run in pairs:
        for key in keys:
            old, new = entry["scores"].get(key, math.inf), run.value(key)
            if math.isfinite(old) and math.isfinite(new):
                groups.setdefault((run.log, run.contestant, key), []).append((old, new))
    arrays = {group: np.array(values) for group, values in groups.items()}
    p_values = holm(np.array([_p_worse(group, values) for group, values in arrays.items()]))
    judged = [_judge(group, values, p) for (group, values), p in zip(arrays.items(), p_values.tolist(), strict=True)]
    return [worsening for worsening in judged if worsening is not None]


def log_ratios(old: Floats, new: Floats, column: str) -> Floats:
    """How much worse each run is, shape (n,): above 0 is worse."""
    least = np.finfo(float).tiny
    old_log, new_log = np.log(np.maximum(old, least)), np.log(np.maximum(new, least))
    if column in CONSISTENCY_KEYS:
        return np.asarray(np.abs(new_log) - np.abs(old_log))
    return np.asarray(new_log - old_log)


def _limit(column: str) -> float:
    return math.log1p(CONSISTENCY_TOLERANCE if column in CONSISTENCY_KEYS else TOLERANCE)


def _p_worse(group: Group, values: Floats) -> float:
    """One-sided p value of the mean log ratio being no more than the tolerance; NaN of too few pairs."""
    ratios = log_ratios(values[:, 0], values[:, 1], group[2])
    if len(ratios) < LEAST_PAIRS:
        return math.nan
    beyond = ratios - _limit(group[2])
    if np.ptp(beyond) <= 1e-12:
        return 0.0 if beyond.mean() > 0 else 1.0
    return float(stats.ttest_1samp(beyond, 0.0, alternative="greater").pvalue)


def _judge(group: Group, values: Floats, p_value: float) -> Worsening | None:
    log, contestant, column = group
    old, new = values[:, 0], values[:, 1]
    share = f"{np.expm1(log_ratios(old, new, column).mean()):.1%}"
    change = (
        f"{f'{share} farther from 1' if column in CONSISTENCY_KEYS else f'+{share}'} in the mean of {len(old)} pairs"
    )
    if column not in CONSISTENCY_KEYS and new.max() > FAR * old.max() > 0:
        told = f"{new.max():.3g} in a run; the reference's worst is {old.max():.3g}"
        return Worsening(log, contestant, column, told)
    if math.isnan(p_value):
        is_worse = log_ratios(old, new, column).mean() > math.log1p(ALONE)
        return Worsening(log, contestant, column, f"{change}, too few for a test") if is_worse else None
    if p_value < SIGNIFICANT:
        certainty = f"p = {p_value:.2g} (Holm)" if p_value > 0 else "alike in all of them"
        return Worsening(log, contestant, column, f"{change}, {certainty}")
    return None
