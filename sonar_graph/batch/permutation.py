"""Which groups of log ratios lie beyond a limit, when many groups are tested at once on few cases.

A batch without a true change is as likely with old and new exchanged in any case: the log ratios of a case, of all its
logs, contestants and columns together, change their sign. So the largest statistic of all groups is compared with what
it is under changes of sign (Westfall, Young 1993): exact for any distribution, any number of groups and whatever these
have to do with each other. Fewer than 5 cases have too few changes of sign for 5 %; there ratios are taken as normal,
and rotated (Langsrud 2005). Method and limits: docs/theory/batch_statistics.md.

What a test could have found: the worsening that 80 % of batches like this one would show.

Noise is resampled from how the ratios of a group scatter about their mean, with signs drawn anew, a worsening is added
to all of them, and the test of the whole family is done again with the other groups as they are.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sonar_graph.batch.recorded import ALL_LOGS
from sonar_graph.measurements import Floats

SIGNIFICANT = 0.05
LEAST_CASES = 3
"""Of fewer there is no test."""
LEAST_SIGNS = 5
"""Cases from which on changes of sign suffice: 2⁻⁵ < 5 % < 2⁻⁴."""
ALL_SIGNS = 10
"""Cases up to which all changes of sign are tried."""
DRAWN = 1999
SEED = 20140214
PRIOR_WEIGHT = 2.0
"""Degrees of freedom that the deviations of like groups have beside the group's own."""
CLIP = 1.5
"""Ratios beyond so many median sizes of their group count as this: a lost run is one bad run, not the mean."""
Indices = np.ndarray[tuple[int, ...], np.dtype[np.intp]]
Case = str | int
Group = tuple[str, str, str]
"""Log, contestant and column."""
Ratios = dict[Group, dict[Case, float]]
"""How far each case of a group is beyond its limit; above 0 is worse."""


@dataclass(frozen=True)
class Family:
    """Groups that are tested together."""

    groups: list[Group]
    beyond: Floats
    """Shape (cases, groups); NaN where a group lacks a case."""
    share: float
    """Of the 5 % that all families have together."""

    @property
    def cases(self) -> int:
        """From which its groups have theirs."""
        return len(self.beyond)

    @cached_property
    def weights(self) -> Floats:
        """Changes that leave the chance of the data as it is, first none, shape (changes, cases)."""
        return _signs(self.cases) if self.cases >= LEAST_SIGNS else _rotations(self.cases)

    @cached_property
    def pools(self) -> list[Indices]:
        """Which groups are alike, so that their deviations support each other: those of a column, one log or all."""
        kinds = [(log == ALL_LOGS, column) for log, _, column in self.groups]
        return [np.flatnonzero([kind == one for one in kinds]) for kind in dict.fromkeys(kinds)]

    @cached_property
    def scored(self) -> Floats:
        """The ratios as they are averaged."""
        return clipped(self.beyond) if self.cases >= LEAST_SIGNS else self.beyond

    @cached_property
    def statistics(self) -> Floats:
        """Of each group under each change, shape (changes, groups)."""
        return statistics(self.weights, self.scored, priors(self.scored, self.pools))

    @cached_property
    def p_values(self) -> Floats:
        """Of each group, corrected over all groups and families, shape (groups,)."""
        largest = self.statistics.max(axis=1)
        own = self.statistics[0]
        p = (largest[:, None] >= own - 1e-9 * np.abs(own)).mean(axis=0)
        return np.asarray(np.minimum(1.0, p / self.share))


def with_all_logs(ratios: Ratios) -> Ratios:
    """The groups, and for each contestant and column on several logs its mean over logs, case by case."""
    together: dict[Group, dict[Case, list[float]]] = {}
    logs: dict[Group, int] = {}
    for (_, contestant, column), cases in ratios.items():
        group = (ALL_LOGS, contestant, column)
        logs[group] = logs.get(group, 0) + 1
        for case, value in cases.items():
            together.setdefault(group, {}).setdefault(case, []).append(value)
    means = {
        group: {case: float(np.mean(values)) for case, values in cases.items()}
        for group, cases in together.items()
        if logs[group] > 1
    }
    return ratios | means


def families(ratios: Ratios) -> list[Family]:
    """Groups that have a test, those together that can be tested together.

    A contestant and column with 5 cases or more over all logs is tested by signs, each of its groups of that size too;
    with 3 or 4 by rotations, its groups that have all of these cases. Others have no test.
    """
    members = _members(ratios)
    return [_family(groups, ratios, 1 / len(members)) for groups in members]


def testable(ratios: Ratios) -> set[Group]:
    """Groups that have a test, were they to move."""
    return {group for groups in _members(ratios) for group in groups}


def _members(ratios: Ratios) -> list[list[Group]]:
    """Groups that are tested together."""
    most: dict[tuple[str, str], set[Case]] = {}
    for (_, contestant, column), cases in ratios.items():
        most.setdefault((contestant, column), set()).update(cases)
    members: dict[frozenset[Case], list[Group]] = {}
    for group, own in ratios.items():
        whole = frozenset(most[group[1:]])
        if len(own) >= LEAST_SIGNS:
            members.setdefault(frozenset(), []).append(group)
        elif LEAST_CASES <= len(own) == len(whole):
            members.setdefault(whole, []).append(group)
    return list(members.values())


def _family(groups: list[Group], ratios: Ratios, share: float) -> Family:
    cases = list(dict.fromkeys(case for group in groups for case in ratios[group]))
    beyond = np.array([[ratios[group].get(case, np.nan) for group in groups] for case in cases])
    return Family(groups, beyond, share)


def clipped(beyond: Floats) -> Floats:
    """Ratios with their sizes held to `CLIP` times the median size of the group, axis 0; signs change nothing in it."""
    most = CLIP * np.nanmedian(np.abs(beyond), axis=0)
    return np.clip(beyond, -most, most)


def priors(scored: Floats, pools: list[Indices]) -> Floats:
    """Mean square of like groups, geometric mean, shape (groups,); no change of sign and no rotation alters it."""
    squares = np.maximum(np.nanmean(np.square(scored), axis=0), np.finfo(float).tiny)
    found = np.empty(scored.shape[1])
    for pool in pools:
        found[pool] = np.exp(np.log(squares[pool]).mean())
    return found


def statistics(weights: Floats, scored: Floats, prior: Floats) -> Floats:
    """Student's statistic with a variance that like groups support, shape (changes, groups).

    ``√n m / √((w s₀² + Σ(y - m)²) / (w + n - 1))`` with the mean m of the n changed ratios y of a group, the mean
    square s₀² of like groups and its weight w.
    """
    present = ~np.isnan(scored)
    values, n = np.where(present, scored, 0.0), present.sum(axis=0)
    mean = weights @ values / n
    rest = np.maximum(np.square(values).sum(axis=0) - n * np.square(mean), 0.0)
    return np.asarray(np.sqrt(n) * mean / np.sqrt((PRIOR_WEIGHT * prior + rest) / (PRIOR_WEIGHT + n - 1)))


def _signs(cases: int) -> Floats:
    if cases <= ALL_SIGNS:
        return np.array(list(itertools.product([1.0, -1.0], repeat=cases)))
    drawn = np.random.default_rng(SEED).choice([1.0, -1.0], size=(DRAWN, cases))
    return np.vstack([np.ones(cases), drawn])


def _rotations(cases: int) -> Floats:
    """What rotations make of a mean: sums along any direction, as long as ``(1, ..., 1)``."""
    drawn = np.random.default_rng(SEED).normal(size=(DRAWN, cases))
    directions = np.sqrt(cases) * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    return np.vstack([np.ones(cases), directions])


POWER = 0.8
DRAWN_EFFECTS = 100
SHARES = np.array([2, 3, 4, 5, 7, 10, 15, 20, 30, 40, 50, 70, 100, 150, 200, 300, 500, 900]) / 100
"""Relative worsenings that are tried."""


def detectable(families: list[Family], columns: list[str], limit: float) -> dict[str, float]:
    """For each contestant that has a test, the relative worsening of a typical column that is found with `POWER`.

    Parameters
    ----------
    columns
        Of which the one with the median scatter stands for all, over all logs together where a contestant has several.
    limit
        Log ratio that is allowed, and was taken off.

    Returns
    -------
    By contestant; infinity where a tenfold value would not be found.
    """
    typical: dict[str, list[tuple[float, Family, int]]] = {}
    for family in families:
        over_all = {group[1:] for group in family.groups if group[0] == ALL_LOGS}
        for number, (log, contestant, column) in enumerate(family.groups):
            is_whole = log == ALL_LOGS or (contestant, column) not in over_all
            if column in columns and is_whole:
                scatter = float(np.nanstd(family.beyond[:, number]))
                typical.setdefault(contestant, []).append((scatter, family, number))
    middle = {name: sorted(groups, key=lambda one: one[0])[len(groups) // 2] for name, groups in typical.items()}
    return {name: _smallest(family, number, limit) for name, (_, family, number) in middle.items()}


def _smallest(family: Family, number: int, limit: float) -> float:
    """By halving: power grows with the worsening."""
    own = family.beyond[:, number]
    present = np.flatnonzero(~np.isnan(own))
    noise = _noise(own[present])
    others = _others(family, family.groups[number])
    low, high = 0, len(SHARES)
    while low < high:
        middle = (low + high) // 2
        shifted = noise + np.log1p(SHARES[middle]) - limit
        if _power(family, number, present, shifted, others) >= POWER:
            high = middle
        else:
            low = middle + 1
    return float(SHARES[low]) if low < len(SHARES) else np.inf


def _noise(own: Floats) -> Floats:
    """Scatter about the mean, resampled, shape (cases, draws)."""
    rng, n = np.random.default_rng(SEED), len(own)
    left = (own - own.mean()) * np.sqrt(n / (n - 1))
    return np.asarray(rng.choice(left, size=(n, DRAWN_EFFECTS)) * rng.choice([1.0, -1.0], size=(n, DRAWN_EFFECTS)))


def _others(family: Family, group: Group) -> Floats:
    """Largest statistic of all that is not this contestant and column, under each change."""
    elsewhere = np.array([other[1:] != group[1:] for other in family.groups])
    return np.asarray(family.statistics[:, elsewhere].max(axis=1, initial=-np.inf))


def _power(family: Family, number: int, present: Indices, shifted: Floats, others: Floats) -> float:
    scored = clipped(shifted) if family.cases >= LEAST_SIGNS else shifted
    (pool,) = [pool for pool in family.pools if number in pool]
    squares = np.log(np.maximum(np.nanmean(np.square(family.scored[:, pool[pool != number]]), axis=0), 1e-300))
    own = np.log(np.square(scored).mean(axis=0))
    drawn = statistics(family.weights[:, present], scored, np.exp((squares.sum() + own) / len(pool)))
    reached = np.maximum(drawn, others[:, None]) >= drawn[0] - 1e-9 * np.abs(drawn[0])
    return float((reached.mean(axis=0) <= SIGNIFICANT * family.share).mean())
