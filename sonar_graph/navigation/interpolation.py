"""Values of a sensor between its rows.

``linear``: rate and velocity are piecewise linear through the samples; the mean over a step is the value at its middle.
``hold-past``: a sample is the mean over the interval that ends at its stamp.
"""

from __future__ import annotations

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import inlined
from sonar_graph.navigation.triples import Vector, minus, plus, scaled, vector


@inlined
def rows_until(stamps: Ints, instant_ns: int) -> int:
    """Number of rows stamped at or before an instant; numpy's search takes its side as text, slow to compile."""
    low, high = 0, len(stamps)
    while low < high:
        middle = (low + high) // 2
        if stamps[middle] <= instant_ns:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def bracket(stamps: Ints, n: int, i: int, t: int, hold_past: bool) -> tuple[int, int, float]:
    """Rows before and after t and the share of the later, where ``stamps[i - 1] < t <= stamps[i]``.

    Outside the first n rows the nearest end's value holds.
    """
    if i >= n:
        return n - 1, n - 1, 0.0
    if hold_past or i == 0:
        return i, i, 0.0
    return i - 1, i, (t - stamps[i - 1]) / (stamps[i] - stamps[i - 1])


@inlined
def value_at(stamps: Ints, values: Floats, i: int, t: int, hold_past: bool) -> Vector:
    """Value at t, where ``stamps[i - 1] < t <= stamps[i]``; the nearest end's value outside the rows."""
    return value_among(stamps, values, len(stamps), i, t, hold_past)


@inlined
def value_among(stamps: Ints, values: Floats, rows: int, i: int, t: int, hold_past: bool) -> Vector:
    """The same, of the first rows only."""
    return between(values, *bracket(stamps, rows, i, t, hold_past))


@inlined
def between(values: Floats, before: int, after: int, share: float) -> Vector:
    """Between two rows."""
    a, b = vector(values[before]), vector(values[after])
    return plus(a, scaled(share, minus(b, a)))
