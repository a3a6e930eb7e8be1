"""Signals at instants: running integrals, and values in between."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats

Number = TypeVar("Number", np.float64, np.complex128)


def running_integral(
    t: Floats, values: NDArray[Number], *, is_held: bool = False
) -> NDArray[Number]:
    """Integral from zero on of a signal, shape (n,), or of columns, shape (n, k).

    By the trapezoid rule or, ``is_held``, of values that hold for the time before them.
    """
    means = values[1:] if is_held else (values[1:] + values[:-1]) / 2
    steps = np.diff(t).reshape(-1, *[1] * (values.ndim - 1))
    found = np.zeros_like(values)
    np.cumsum(means * steps, axis=0, out=found[1:])
    return found


def columns_at(at: Floats, t: Floats, values: Floats) -> Floats:
    """Columns of values at other times, linear in between, shape (len(at), k)."""
    return np.column_stack([np.interp(at, t, column) for column in values.T])
