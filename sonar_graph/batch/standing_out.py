"""What a person should look at, because no test can judge it: single runs, and logs with hardly any cases.

Of two draws from one distribution the second has the worst run as often as the first, however far off it is. So none of
this fails a batch. Where runs are deterministic and only the code changed, it is a finding all the same.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from sonar_graph.batch.blessed import name_of, told
from sonar_graph.batch.recorded import ALL_LOGS, RecordedRun
from sonar_graph.batch.worsening_tests import Group, Ratios, testable

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
