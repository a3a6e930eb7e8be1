"""Measurements that stay the same to the last bit, as of a driver that goes on sending when its sensor does not."""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Floats, Ints

LEAST_S = 1.0
LEAST_ROWS = 5
"""A stretch of equal rows is named from more than this time and at least this many rows on."""
MOST_NAMED = 3
"""Stretches that are named one by one; of more the longest."""


def stuck_warning(stamps_ns: Ints, values: Floats, quantity: str) -> str | None:
    """Stretches of rows that are equal to the bit, zeros or not; None: there are none.

    They are used as they are: a vehicle at rest in a simulator, or coarse steps of a sensor, may look so as well.

    Parameters
    ----------
    values
        Shape (n, 3).
    quantity
        What they are, for the text.
    """
    texts = []
    first, last = _stretches(stamps_ns, values)
    is_zero = ~np.any(values[first], axis=1)
    for chosen, what in ((is_zero, "exactly zero"), (~is_zero, "the same to the last bit")):
        if chosen.any():
            texts.append(f"{what} {_spans(stamps_ns, first[chosen], last[chosen])}")
    if not texts:
        return None
    return f"{quantity} {' and '.join(texts)}: used as measured; unless at rest, a driver may be sending without lock"


def _stretches(stamps_ns: Ints, values: Floats) -> tuple[Ints, Ints]:
    """First and last row of each."""
    differs = np.any(values[1:] != values[:-1], axis=1)
    first = np.concatenate([[0], np.flatnonzero(differs) + 1])
    last = np.concatenate([first[1:] - 1, [len(values) - 1]])
    is_long = (stamps_ns[last] - stamps_ns[first] > LEAST_S * 1e9) & (last - first + 1 >= LEAST_ROWS)
    return first[is_long], last[is_long]


def _spans(stamps_ns: Ints, first: Ints, last: Ints) -> str:
    """From when to when, and how many rows."""
    named = np.sort(np.argsort(first - last, kind="stable")[:MOST_NAMED])
    spans = [
        f"{(stamps_ns[first[k]] - stamps_ns[0]) * 1e-9:.3f} to {(stamps_ns[last[k]] - stamps_ns[0]) * 1e-9:.3f}"
        for k in named
    ]
    text, rows = f"{', '.join(spans)} s after the first", int(np.sum(last - first + 1))
    if len(first) > len(named):
        return f"in {rows} rows of {len(first)} stretches, the longest {text}"
    return f"in {rows} rows, {text}"
