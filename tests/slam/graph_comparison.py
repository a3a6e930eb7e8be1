"""Two estimators' graphs, factor by factor and by their marginals."""

from __future__ import annotations

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.slam.isam2 import Isam2


def rows_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> dict[tuple, list[Floats]]:
    """Each factor by its kind and variables: whitened error and derivatives at some values."""
    found: dict[tuple, list[Floats]] = {}
    for i in range(graph.size()):
        factor = graph.at(i)
        A, b = factor.linearize(values).jacobian()
        found.setdefault((type(factor).__name__, *factor.keys()), []).append(np.column_stack([A, b]))
    return {name: sorted(rows, key=lambda row: tuple(row.ravel())) for name, rows in found.items()}


def largest_difference(one: Isam2, other: Isam2) -> float:
    """Between equal factors of two graphs, in standard deviations of what they measure; at the values of one."""
    values, _ = other._smoother.solve_history()
    a, b = rows_of(one.graph, values), rows_of(other.graph, values)
    assert {name: len(rows) for name, rows in a.items()} == {name: len(rows) for name, rows in b.items()}
    return max(
        np.abs(x - y).max() / max(1.0, np.abs(y).max()) for name in a for x, y in zip(a[name], b[name], strict=True)
    )


def assert_marginals_agree(one: Isam2, other: Isam2, tolerance: float) -> None:
    """Of every variable, at the values of one, in the units of its standard deviations."""
    values, _ = other._smoother.solve_history()
    a, b = (gtsam.Marginals(each.graph, values) for each in (one, other))
    for key in values.keys():  # noqa: SIM118  # gtsam.Values is no mapping
        P, Q = a.marginalCovariance(key), b.marginalCovariance(key)
        sigma = np.sqrt(np.diag(Q))
        assert np.abs((P - Q) / np.outer(sigma, sigma)).max() < tolerance
