"""GTSAM's fixed-lag smoother, begun anew from a graph and the marginal of what lies outside it.

GTSAM's Cholesky elimination gives up ("indeterminate") when a variable's absolute sigma is more than 4096 times its
sigma given its neighbours, which millimetre odometry reaches after some metres of drift. QR does not, at a higher cost;
once Cholesky has given up the window stays with QR (docs/theory/isam2.md).
"""

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from sonar_graph.slam.smoother.batch_solution import picked


def split(
    graph: gtsam.NonlinearFactorGraph, kept: set[int]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.NonlinearFactorGraph]:
    """Factors on kept variables only, and those that touch any other."""
    inside, outside = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    for i in range(graph.size()):
        factor = graph.at(i)
        (inside if kept.issuperset(factor.keys()) else outside).add(factor)
    return inside, outside


def marginal(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, kept: Container[int], *, is_by_qr: bool = False
) -> list[gtsam.NonlinearFactor]:
    """Marginal of a graph on the kept variables, linearised at the values.

    A RuntimeError where elimination gives up: QR on what is not determined, Cholesky also on what is determined weakly.
    """
    linear = graph.linearize(values)
    separator = [key for key in linear.keyVector() if key in kept]
    found = linear.marginal(separator, gtsam.EliminateQR) if is_by_qr else linear.marginal(separator)
    return [gtsam.LinearContainerFactor(found.at(i), values) for i in range(found.size())]


def with_marginals(
    window: gtsam.NonlinearFactorGraph, theta: gtsam.Values, left_out: Container[gtsam.NonlinearFactor]
) -> gtsam.NonlinearFactorGraph:
    """Marginals of a window linearised at theta, and its other factors but those left out.

    iSAM2 keeps a marginal without the values at which it holds: those at which the window's variables are linearised.
    """
    graph = gtsam.NonlinearFactorGraph()
    for factor in (window.at(i) for i in range(window.size()) if window.exists(i)):
        if isinstance(factor, gtsam.LinearContainerFactor):
            graph.add(gtsam.LinearContainerFactor(factor.linearize(theta), theta))
        elif factor not in left_out:
            graph.add(factor)
    return graph


MOST_SETTLING_UPDATES = 10
"""Further updates after an exchange, each a Gauss-Newton step: what is exchanged may move the estimate far."""


def isam2_params(relinearize_threshold: float, *, is_by_qr: bool) -> gtsam.ISAM2Params:
    """Settings of iSAM2 that relinearises at each update."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR" if is_by_qr else "CHOLESKY")
    params.relinearizeSkip = 1
    params.setRelinearizeThreshold(relinearize_threshold)
    params.findUnusedFactorSlots = True
    return params


def settle(
    update: Callable[[], object], isam: gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother, threshold: float
) -> None:
    """Update until nothing would be relinearised any more."""
    for _ in range(MOST_SETTLING_UPDATES):
        if isam.getDelta().norm() <= threshold:
            break
        update()


class FixedLagWindow:
    """iSAM2 over the variables of the last ``lag_s`` seconds, by Cholesky, and by QR once that has given up."""

    def __init__(self, relinearize_threshold: float, lag_s: float) -> None:
        self._threshold = relinearize_threshold
        self.lag_s = lag_s
        """Age (s) from which on variables left at the last update."""
        self.is_by_qr = False
        self._begin_empty()

    def _begin_empty(self) -> None:
        params = isam2_params(self._threshold, is_by_qr=self.is_by_qr)
        self.isam = gtsam.IncrementalFixedLagSmoother(self.lag_s, params)
        self._theta = self.isam.getLinearizationPoint()  # held as in `SubmapWindow`

    def begin(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, times_s: Mapping[Any, float], time_s: float
    ) -> None:
        """Begin anew at a time with the variables not older than the lag, by Cholesky, else by QR.

        Of factors that touch others their marginal counts. QR makes it anew, since by Cholesky it may also have lost
        what is weak without a word. A RuntimeError where even QR finds no solution.
        """
        kept_s: dict[Any, float] = {key: t for key, t in times_s.items() if t >= time_s - self.lag_s}
        inside, outside = split(graph, set(kept_s))
        try:
            for factor in marginal(outside, values, kept_s, is_by_qr=self.is_by_qr) if outside.size() else ():
                inside.add(factor)
            self._begin_empty()
            self.isam.update(inside, picked(values, kept_s), kept_s)
        except RuntimeError:
            if self.is_by_qr:
                raise
            self.is_by_qr = True
            self.begin(graph, values, times_s, time_s)

    def update(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        times_s: Mapping[Any, float],
        _time_s: float,
        removed: Sequence[gtsam.NonlinearFactor] = (),
    ) -> gtsam.Values:
        """Estimate with new factors and variables, without some of the factors, which must be in the window."""
        self.isam.setSmootherLag(self.lag_s)
        self.isam.update(graph, values, times_s, self._slots(removed) or [])
        return self.estimate()

    @property
    def marginals(self) -> gtsam.ISAM2:
        """Source of covariances."""
        return self.isam.getISAM2()

    @property
    def factors(self) -> gtsam.NonlinearFactorGraph:
        """Factors, marginals among them; some places may be empty."""
        return self.isam.getFactors()

    @property
    def linearised_at(self) -> gtsam.Values:
        """Where the variables are linearised."""
        return self._theta

    def estimate(self) -> gtsam.Values:
        """Estimate of the variables in the window."""
        return self.isam.calculateEstimate()

    def holds(self, key: int) -> bool:
        """True for a variable in the window."""
        return self.marginals.valueExists(key)

    def can_exchange(self, removed: Sequence[gtsam.NonlinearFactor], keys: Iterable[int]) -> bool:
        """True when the factors to be taken out, and the variables of those to be put in, are in the window."""
        return self._slots(removed) is not None and all(map(self.holds, keys))

    def settle(self) -> None:
        """Update until nothing would be relinearised any more."""
        settle(self.isam.update, self.isam, self._threshold)

    def _slots(self, factors: Sequence[gtsam.NonlinearFactor]) -> list[int] | None:
        """Places of factors in the window; None when one of them is not there."""
        if not factors:
            return []
        inside = self.isam.getFactors()
        place = {inside.at(i): i for i in range(inside.size()) if inside.exists(i)}
        found = [place.get(factor) for factor in factors]
        return None if None in found else [slot for slot in found if slot is not None]

    def largest_shift(self, keys: Sequence[int]) -> float:
        """Largest component by which one of some variables has moved from where it was linearised, rad or m."""
        delta = self.isam.getDelta()
        return float(np.abs([delta.at(key) for key in keys]).max(initial=0.0))
