"""What a new window is made of: a graph cut in two, and the part outside replaced by its marginal."""

from __future__ import annotations

from collections.abc import Container, Iterable

import gtsam


def split(
    graph: gtsam.NonlinearFactorGraph, kept: set[int]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.NonlinearFactorGraph]:
    """Factors on kept variables only, and those that touch any other."""
    inside, outside = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    for i in range(graph.size()):
        factor = graph.at(i)
        (inside if kept.issuperset(factor.keys()) else outside).push_back(factor)
    return inside, outside


def marginal(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, kept: Container[int], *, is_by_qr: bool = False
) -> list[gtsam.NonlinearFactor]:
    """What a graph says about the kept variables alone, linearised at the values.

    Raises
    ------
    RuntimeError
        When elimination gives up: QR on what is not determined, Cholesky also on what is determined weakly.
    """
    linear = graph.linearize(values)
    separator = [key for key in linear.keyVector() if key in kept]
    found = linear.marginal(separator, gtsam.EliminateQR) if is_by_qr else linear.marginal(separator)
    return [gtsam.LinearContainerFactor(found.at(i), values) for i in range(found.size())]


def joined_with_marginal(
    inside: gtsam.NonlinearFactorGraph,
    outside: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    kept: Container[int],
    *,
    is_by_qr: bool,
) -> gtsam.NonlinearFactorGraph:
    """A graph, with what another says about the kept variables."""
    graph = gtsam.NonlinearFactorGraph(inside)
    for factor in marginal(outside, values, kept, is_by_qr=is_by_qr):
        graph.push_back(factor)
    return graph


def _copy(source: gtsam.Values, key: int, target: gtsam.Values) -> None:
    """One variable, a pose or a point, from some values to others."""
    if gtsam.symbolChr(key) == ord("x"):
        target.insert(key, source.atPose3(key))
    else:
        target.insert(key, source.atPoint3(key))


def anchored(factor: gtsam.NonlinearFactor, theta: gtsam.Values) -> gtsam.NonlinearFactor:
    """A factor of a window by itself.

    iSAM2 keeps a marginal without the values at which it holds: those at which the window's variables are linearised.
    """
    if isinstance(factor, gtsam.LinearContainerFactor):
        return gtsam.LinearContainerFactor(factor.linearize(theta), theta)
    return factor


def without(
    graph: gtsam.NonlinearFactorGraph, theta: gtsam.Values, left_out: Iterable[gtsam.NonlinearFactor] = ()
) -> gtsam.NonlinearFactorGraph:
    """A window's graph, its holes closed and its marginals anchored, less some factors.

    Parameters
    ----------
    theta
        Where the window's variables are linearised.
    """
    gone, kept = list(left_out), gtsam.NonlinearFactorGraph()
    for i in range(graph.size()):
        if graph.exists(i) and graph.at(i) not in gone:
            kept.push_back(anchored(graph.at(i), theta))
    return kept


def joined(values: gtsam.Values, new: gtsam.Values) -> gtsam.Values:
    """Values, with new ones where there are none yet."""
    both = gtsam.Values(values)
    for key in keys_of(new):
        if not both.exists(key):
            _copy(new, key, both)
    return both


def keys_of(values: gtsam.Values) -> list[int]:
    """Of all variables."""
    return list(values.keys())


def picked(values: gtsam.Values, keys: Iterable[int]) -> gtsam.Values:
    """Some of the variables. GTSAM copies all that it is given for each factor in Python."""
    few = gtsam.Values()
    for key in keys:
        _copy(values, key, few)
    return few
