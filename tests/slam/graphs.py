"""Sums of the information of a graph's factors, and differences between two graphs."""

from collections.abc import Iterable

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.slam import Isam2
from sonar_graph.slam.smoother import JointCovariance

from .made import graph_of


def information(
    factors: Iterable[gtsam.NonlinearFactor], values: gtsam.Values, keys: Iterable[int]
) -> Floats:
    """Sum of the factors' information about some variables, in the order of the keys."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return graph_of(factors).linearize(values).hessian(ordering)[0]


def factors_of(graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactor]:
    return [graph.at(i) for i in range(graph.size())]


def gtsams_solution(
    graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, tolerance: float = 1e-12
) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(tolerance)
    params.setMaxIterations(200)
    return gtsam.LevenbergMarquardtOptimizer(graph, initial, params).optimize()


def dense_covariance(
    factors: list[gtsam.NonlinearFactor], values: gtsam.Values, keys: list[int]
) -> Floats:
    """Block of the inverse of the information of all factors, by numpy."""
    every = sorted({key for factor in factors for key in list(factor.keys())})
    sizes = [len(values.zeroVectors().at(key)) for key in every]
    ends = dict(zip(every, np.cumsum(sizes).tolist(), strict=True))
    wanted = np.concatenate(
        [np.arange(ends[k] - sizes[every.index(k)], ends[k]) for k in keys]
    )
    return np.linalg.inv(information(factors, values, every))[np.ix_(wanted, wanted)]


def block_of(joint: JointCovariance, keys: list[int]) -> Floats:
    return np.block([[joint.at(a, b) for b in keys] for a in keys])


def off_sigmas(found: Floats, expected: Floats) -> float:
    """Largest deviation of a covariance, in standard deviations of both components."""
    sigmas = np.sqrt(np.diag(expected))
    return float(np.abs((found - expected) / np.outer(sigmas, sigmas)).max())


def rows_of(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
) -> dict[tuple, list[Floats]]:
    """Each factor by its kind and variables: whitened error and derivatives at some values."""
    found: dict[tuple, list[Floats]] = {}
    for factor in factors_of(graph):
        A, b = factor.linearize(values).jacobian()
        found.setdefault((type(factor).__name__, *factor.keys()), []).append(
            np.column_stack([A, b])
        )
    return {
        name: sorted(rows, key=lambda row: tuple(row.ravel()))
        for name, rows in found.items()
    }


def assert_same_factors(
    one: gtsam.NonlinearFactorGraph,
    other: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    tolerance: float = 1e-7,
) -> None:
    """One by one, in standard deviations of what they measure."""
    a = rows_of(one, values)
    b = rows_of(other, values)
    assert {name: len(rows) for name, rows in a.items()} == {
        name: len(rows) for name, rows in b.items()
    }
    for name, rows in b.items():
        for x, y in zip(a[name], rows, strict=True):
            np.testing.assert_allclose(
                x,
                y,
                rtol=0,
                atol=tolerance * max(1.0, np.abs(y).max()),
                err_msg=str(name),
            )


def assert_same_graph(one: Isam2, other: Isam2, tolerance: float = 1e-6) -> None:
    """Factors, and marginals of every variable in the units of its standard deviations, at the values of the other."""
    values = gtsams_solution(other.graph, other.values)
    assert_same_factors(one.graph, other.graph, values, tolerance)
    a, b = (gtsam.Marginals(each.graph, values) for each in (one, other))
    for key in values.keys():  # noqa: SIM118  # gtsam.Values is no mapping
        assert (
            off_sigmas(a.marginalCovariance(key), b.marginalCovariance(key)) < tolerance
        )
