"""Derivatives of factors by differences, and what a graph of factors says in sum."""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np

from sonar_graph.measurements import Floats

STEP = 1e-6


def perturbed(values: gtsam.Values, key: int, change: Floats) -> gtsam.Values:
    """One variable moved along its tangent space."""
    delta = gtsam.VectorValues()
    delta.insert(key, change)
    return values.retract(delta)


def numerical_jacobian(factor: gtsam.NonlinearFactor, values: gtsam.Values, key: int) -> Floats:
    """Derivative of the unwhitened error by a variable, central differences."""
    n = len(values.zeroVectors().at(key))
    columns = []
    for axis in np.eye(n):
        plus, minus = (factor.unwhitenedError(perturbed(values, key, sign * STEP * axis)) for sign in (1, -1))
        columns.append((plus - minus) / (2 * STEP))
    return np.column_stack(columns)


def analytic_jacobians(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> Floats:
    """Whitened derivative that a factor hands to the solver, columns in the order of its keys."""
    A, _ = factor.linearize(values).jacobian()
    return A


def assert_jacobians(factor: gtsam.NonlinearFactor, values: gtsam.Values, tolerance: float = 1e-5) -> None:
    """Every derivative of a factor equals the differences of its error, relative to the largest."""
    numerical = np.hstack([numerical_jacobian(factor, values, key) for key in list(factor.keys())])
    whitened = factor.noiseModel().R() @ numerical
    assert np.abs(analytic_jacobians(factor, values) - whitened).max() < tolerance * max(np.abs(whitened).max(), 1.0)


def graph_of(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def information(factors: Iterable[gtsam.NonlinearFactor], values: gtsam.Values, keys: list[int]) -> Floats:
    """Sum of the factors' information about some variables, in the order of the keys."""
    dims = {key: len(values.zeroVectors().at(key)) for key in keys}
    at = dict(zip(keys, np.cumsum([0, *dims.values()])[:-1].tolist(), strict=True))
    total = np.zeros((sum(dims.values()),) * 2)
    for factor in factors:
        A = analytic_jacobians(factor, values)
        columns = np.concatenate([np.arange(at[k], at[k] + dims[k]) for k in list(factor.keys())])
        total[np.ix_(columns, columns)] += A.T @ A
    return total
