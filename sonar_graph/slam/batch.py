"""Solving a whole graph at once, when some of its factors are Python functions.

GTSAM's optimisers hand each Python factor a copy of all values, which makes their cost quadratic in the length of a
run. Linearising from Python does not; so the loop is here, and the linear algebra is GTSAM's.
"""

from __future__ import annotations

import gtsam
import numpy as np

MAX_ITERATIONS = 50
RELATIVE_DECREASE = 1e-7
"""Stop when an iteration lowers the error by less than this share of it."""
FIRST_DAMPING = 1e-9
DAMPING_FACTOR = 10.0
MAX_DAMPING = 1e9


def solve(
    graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, most_iterations: int = MAX_ITERATIONS
) -> gtsam.Values:
    """Levenberg–Marquardt from ``initial``.

    Minimises the sum of squared whitened (and robustly weighted) errors. Damping multiplies the identity; it starts
    negligible (a Gauss–Newton step) and grows tenfold while a step does not lower the error (Nocedal and Wright,
    Numerical Optimization, section 10.3).

    Returns
    -------
    gtsam.Values
        The solution; the initial values where no step lowers the error.
    """
    values, error = initial, graph.error(initial)
    damping = FIRST_DAMPING
    for _ in range(most_iterations):
        linear = graph.linearize(values)
        candidate, candidate_error, damping = _lower(graph, linear, values, error, damping)
        if candidate is None:
            break
        decrease = error - candidate_error
        values, error = candidate, candidate_error
        if decrease <= RELATIVE_DECREASE * error:
            break
    return values


def _lower(
    graph: gtsam.NonlinearFactorGraph,
    linear: gtsam.GaussianFactorGraph,
    values: gtsam.Values,
    error: float,
    damping: float,
) -> tuple[gtsam.Values | None, float, float]:
    while damping <= MAX_DAMPING:
        try:
            candidate = _step(linear, values, damping)
            candidate_error = graph.error(candidate)
        except RuntimeError:  # GTSAM: indeterminate for this damping
            candidate_error = np.inf
        if candidate_error < error:
            return candidate, candidate_error, max(damping / DAMPING_FACTOR, FIRST_DAMPING)
        damping *= DAMPING_FACTOR
    return None, error, damping


def _step(linear: gtsam.GaussianFactorGraph, values: gtsam.Values, damping: float) -> gtsam.Values:
    damped = _damped(linear, values, damping)
    try:
        return values.retract(damped.optimize())
    except RuntimeError:  # Cholesky refuses what is determined, but weakly
        return qr_tree(damped, values).calculateEstimate()


def qr_tree(linear: gtsam.GaussianFactorGraph, values: gtsam.Values) -> gtsam.ISAM2:
    """A linear graph, eliminated by QR: for its solution and marginals where Cholesky refuses it.

    GTSAM's Python interface offers QR only inside ISAM2; the factors are held there at the values they came from.
    """
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    tree = gtsam.ISAM2(params)
    held = gtsam.NonlinearFactorGraph()
    for i in range(linear.size()):
        held.push_back(gtsam.LinearContainerFactor(linear.at(i), values))
    tree.update(held, values)
    return tree


def marginals_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Marginals | gtsam.ISAM2:
    """What gives the covariances of a graph, linearised at the values."""
    linear = graph.linearize(values)
    try:
        return gtsam.Marginals(linear, values)
    except RuntimeError:
        return qr_tree(linear, values)


def _damped(linear: gtsam.GaussianFactorGraph, values: gtsam.Values, damping: float) -> gtsam.GaussianFactorGraph:
    if damping <= FIRST_DAMPING:
        return linear
    damped = linear.clone()
    zero = values.zeroVectors()
    for key in linear.keyVector():
        n = len(zero.at(key))
        damped.push_back(
            gtsam.JacobianFactor(key, np.sqrt(damping) * np.eye(n), np.zeros(n), gtsam.noiseModel.Unit.Create(n))
        )
    return damped
