"""Test of many groups of log ratios on few cases: which of them lie beyond a limit, and what the test could have found.

If nothing truly changed, old and new may be exchanged in any case: the log ratios of a case, over all its logs,
contestants and columns together, change their sign. So the largest statistic of all groups is compared with its values
under changes of sign (Westfall, Young 1993): exact for any distribution, any number of groups and any dependence
between them. Fewer than 5 cases have too few changes of sign for 5 %; their ratios are taken as normal and rotated
(Langsrud 2005).
"""

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sonar_graph.batch import ALL_LOGS
from sonar_graph.measurements import Floats

SIGNIFICANT = 0.05
LEAST_CASES = 3
"""Fewest cases for a test."""
LEAST_SIGNS = 5
"""Fewest cases for a test by changes of sign: 2⁻⁵ < 5 % < 2⁻⁴."""
ALL_SIGNS = 10
"""Most cases for which all changes of sign are tried."""
DRAWN = 1999
SEED = 20140214
PRIOR_WEIGHT = 2.0
"""Degrees of freedom given to the mean square of like groups, beside the group's own."""
CLIP = 1.5
"""Ratios are clipped at so many median sizes of their group, so that one lost run does not decide the mean."""
Indices = np.ndarray[tuple[int, ...], np.dtype[np.intp]]
Case = str | int
Group = tuple[str, str, str]
"""Log, contestant and column."""
Ratios = dict[Group, dict[Case, float]]
"""Log ratio of each case of a group, or its excess over the limit; above 0 is worse."""


@dataclass(frozen=True)
class Family:
    """Groups that are tested together."""

    groups: list[Group]
    beyond: Floats
    """Log ratios beyond the limit, shape (cases, groups); NaN if a group lacks a case."""
    share: float
    """Share of the 5 % that all families have together."""

    @property
    def cases(self) -> int:
        """Number of cases of all its groups together."""
        return len(self.beyond)

    @cached_property
    def weights(self) -> Floats:
        """Changes under which the data are equally likely, first the identity, shape (changes, cases)."""
        rng = np.random.default_rng(SEED)
        if (
            self.cases < LEAST_SIGNS
        ):  # a rotation makes of the mean a sum along any direction as long as (1, ..., 1)
            drawn = rng.normal(size=(DRAWN, self.cases))
            directions = (
                np.sqrt(self.cases)
                * drawn
                / np.linalg.norm(drawn, axis=1, keepdims=True)
            )
            return np.vstack([np.ones(self.cases), directions])
        if self.cases <= ALL_SIGNS:
            return np.array(list(itertools.product([1.0, -1.0], repeat=self.cases)))
        return np.vstack(
            [np.ones(self.cases), rng.choice([1.0, -1.0], size=(DRAWN, self.cases))]
        )

    @cached_property
    def pools(self) -> list[Indices]:
        """Groups whose variances support each other: those of one column, on single logs or on all logs."""
        kinds = [(log == ALL_LOGS, column) for log, _, column in self.groups]
        return [
            np.flatnonzero([kind == one for one in kinds])
            for kind in dict.fromkeys(kinds)
        ]

    @cached_property
    def scored(self) -> Floats:
        """Ratios as they are averaged: clipped for changes of sign, unchanged for rotations."""
        return clipped(self.beyond) if self.cases >= LEAST_SIGNS else self.beyond

    @cached_property
    def statistics(self) -> Floats:
        """Statistic of each group under each change, shape (changes, groups)."""
        return statistics(self.weights, self.scored, priors(self.scored, self.pools))

    @cached_property
    def p_values(self) -> Floats:
        """P value of each group, corrected over all groups and families, shape (groups,)."""
        largest = self.statistics.max(axis=1)
        own = self.statistics[0]
        p = (largest[:, None] >= own - 1e-9 * np.abs(own)).mean(axis=0)
        return np.asarray(np.minimum(1.0, p / self.share))


def with_all_logs(ratios: Ratios) -> Ratios:
    """Add, for each contestant and column on several logs, a group of means over logs, case by case."""
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
    """Groups that have a test, in families that can be tested together.

    A contestant and column with at least 5 cases over all logs is tested by changes of sign, with each of its groups of
    that size; with 3 or 4 cases by rotations, with its groups that have all of these cases. Others have no test.
    """
    members = _members(ratios)
    found = []
    for groups in members:
        cases = list(dict.fromkeys(case for group in groups for case in ratios[group]))
        beyond = np.array(
            [[ratios[group].get(case, np.nan) for group in groups] for case in cases]
        )
        found.append(Family(groups, beyond, 1 / len(members)))
    return found


def testable(ratios: Ratios) -> set[Group]:
    """Groups with enough cases for a test."""
    return {group for groups in _members(ratios) for group in groups}


def _members(ratios: Ratios) -> list[list[Group]]:
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


def clipped(beyond: Floats) -> Floats:
    """Clip ratios at `CLIP` times the median size of the group, axis 0; changes of sign do not alter that."""
    most = CLIP * np.nanmedian(np.abs(beyond), axis=0)
    return np.clip(beyond, -most, most)


def priors(scored: Floats, pools: list[Indices]) -> Floats:
    """Geometric mean of the mean squares of like groups, shape (groups,); no sign and no rotation alters it."""
    squares = np.maximum(np.nanmean(np.square(scored), axis=0), np.finfo(float).tiny)
    found = np.empty(scored.shape[1])
    for pool in pools:
        found[pool] = np.exp(np.log(squares[pool]).mean())
    return found


def statistics(weights: Floats, scored: Floats, prior: Floats) -> Floats:
    """Student's statistic with a variance moderated by like groups, shape (changes, groups).

    ``√n m / √((w s₀² + Σ(y - m)²) / (w + n - 1))`` with the mean m of the n changed ratios y of a group, the mean
    square s₀² of like groups and its weight w, `PRIOR_WEIGHT`.
    """
    present = ~np.isnan(scored)
    values = np.where(present, scored, 0.0)
    n = present.sum(axis=0)
    mean = weights @ values / n
    rest = np.maximum(np.square(values).sum(axis=0) - n * np.square(mean), 0.0)
    return np.asarray(
        np.sqrt(n)
        * mean
        / np.sqrt((PRIOR_WEIGHT * prior + rest) / (PRIOR_WEIGHT + n - 1))
    )


POWER = 0.8
DRAWN_EFFECTS = 100
SHARES = (
    np.array([2, 3, 4, 5, 7, 10, 15, 20, 30, 40, 50, 70, 100, 150, 200, 300, 500, 900])
    / 100
)
"""Relative worsenings that are tried, in ascending order."""


def detectable(
    families: list[Family], columns: list[str], limit: float
) -> dict[str, float]:
    """For each contestant that has a test, the relative worsening of a typical column that is found with `POWER`.

    Noise is resampled from the scatter of a group about its mean, with random signs. A worsening is added, and the test
    of the whole family is repeated with the other groups unchanged.

    ``columns``: the one with the median scatter stands for all, over all logs together if a contestant has several;
    ``limit``: log ratio that is allowed, and was subtracted.

    Returns worsening by contestant; infinity if a tenfold value would not be found.
    """
    typical: dict[str, list[tuple[float, Family, int]]] = {}
    for family in families:
        over_all = {group[1:] for group in family.groups if group[0] == ALL_LOGS}
        for number, (log, contestant, column) in enumerate(family.groups):
            is_whole = log == ALL_LOGS or (contestant, column) not in over_all
            if column in columns and is_whole:
                scatter = float(np.nanstd(family.beyond[:, number]))
                typical.setdefault(contestant, []).append((scatter, family, number))
    middle = {
        name: sorted(groups, key=lambda one: one[0])[len(groups) // 2]
        for name, groups in typical.items()
    }
    return {
        name: detectable_in(family, number, limit)
        for name, (_, family, number) in middle.items()
    }


def detectable_in(family: Family, number: int, limit: float) -> float:
    """Smallest of `SHARES` that is found with `POWER` in one group of a family; infinity if none is."""
    own = family.beyond[:, number]
    present = np.flatnonzero(~np.isnan(own))
    own, n, rng = own[present], len(present), np.random.default_rng(SEED)
    scatter = (own - own.mean()) * np.sqrt(n / (n - 1))
    noise = rng.choice(scatter, size=(n, DRAWN_EFFECTS)) * rng.choice(
        [1.0, -1.0], size=(n, DRAWN_EFFECTS)
    )
    elsewhere = np.array(
        [other[1:] != family.groups[number][1:] for other in family.groups]
    )
    others = family.statistics[:, elsewhere].max(axis=1, initial=-np.inf)
    (pool,) = [pool for pool in family.pools if number in pool]
    squares = np.log(
        np.maximum(
            np.nanmean(np.square(family.scored[:, pool[pool != number]]), axis=0),
            1e-300,
        )
    )
    low = 0
    high = len(SHARES)
    while low < high:  # by bisection, since power grows with the worsening
        middle = (low + high) // 2
        shifted = noise + np.log1p(SHARES[middle]) - limit
        scored = clipped(shifted) if family.cases >= LEAST_SIGNS else shifted
        log_square = np.log(np.square(scored).mean(axis=0))
        drawn = statistics(
            family.weights[:, present],
            scored,
            np.exp((squares.sum() + log_square) / len(pool)),
        )
        reached = np.maximum(drawn, others[:, None]) >= drawn[0] - 1e-9 * np.abs(
            drawn[0]
        )
        if (reached.mean(axis=0) <= SIGNIFICANT * family.share).mean() >= POWER:
            high = middle
        else:
            low = middle + 1
    return float(SHARES[low]) if low < len(SHARES) else np.inf
