"""What a test could have found: the worsening that 80 % of batches like this one would show.

Noise is resampled from how the ratios of a group scatter about their mean, with signs drawn anew, a worsening is added
to all of them, and the test of the whole family is done again with the other groups as they are.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.batch.recorded import ALL_LOGS
from sonar_graph.batch.worsening_tests import (
    LEAST_SIGNS,
    SEED,
    SIGNIFICANT,
    Family,
    Group,
    Indices,
    clipped,
    statistics,
)
from sonar_graph.measurements import Floats

POWER = 0.8
DRAWN = 100
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
    return np.asarray(rng.choice(left, size=(n, DRAWN)) * rng.choice([1.0, -1.0], size=(n, DRAWN)))


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
