"""GTSAM's incremental solvers: iSAM2 over the whole run, and a fixed-lag smoother for a bounded history.

Kaess et al., "iSAM2: Incremental smoothing and mapping using the Bayes tree", IJRR 31(2), 2012.

GTSAM's Cholesky elimination fails ("indeterminate") when the absolute sigma of a variable exceeds 4096 times its sigma
given its neighbours. Millimetre odometry reaches this ratio after some metres of drift. QR does not fail there, but is
slower: a window changes to QR when Cholesky has failed, and stays with it (docs/theory/isam2.md).
"""

from collections.abc import Container, Iterable, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple

import gtsam
import numpy as np

from sonar_graph.slam.smoother.factor_store import (
    BIAS,
    LANDMARK,
    TANGENT_SIZES,
    FactorGroup,
    graph_of,
    picked,
)

NEVER = 1_000_000_000
"""Updates between two relinearisations that iSAM2 would begin by itself."""
MOST_FILL = 1.5
"""Growth of the Bayes tree since all variables were last ordered together, from which they are ordered again
(`benchmarks/validation/isam2_constants.py`)."""
LAST = 1
"""Group of the variables that are eliminated last; all others are in group 0."""
Times = Mapping[Any, float]
"""Time (s) at which a variable was last used, by key."""


class Thresholds(NamedTuple):
    """Changes of a component of a variable above which the variable is relinearised."""

    position_m: float
    """Of the position of a keyframe."""
    other: float
    """Of the rotation of a keyframe (rad), of a landmark (m), and of the biases."""


def isam2_params(thresholds: Thresholds, *, is_by_qr: bool) -> gtsam.ISAM2Params:
    """Settings of iSAM2."""
    by_kind = gtsam.ISAM2ThresholdMap()
    by_kind.insert(("x", np.repeat([thresholds.other, thresholds.position_m], 3)))
    by_kind.insert(("l", np.full(TANGENT_SIZES[LANDMARK], thresholds.other)))
    by_kind.insert(("b", np.full(TANGENT_SIZES[BIAS], thresholds.other)))
    params = gtsam.ISAM2Params()
    params.setFactorization("QR" if is_by_qr else "CHOLESKY")
    params.setRelinearizeThreshold(by_kind)
    # else the slots of removed factors stay empty, and their number grows with the run
    params.findUnusedFactorSlots = True
    return params


class WholeWindow:
    """iSAM2 over all variables of the run."""

    def __init__(self, thresholds: Thresholds, *, is_by_qr: bool = False) -> None:
        params = isam2_params(thresholds, is_by_qr=is_by_qr)
        params.relinearizeSkip = NEVER
        # an update orders only the variables that it eliminates: over a long run the tree fills up
        params.enableAdaptiveReorder = True
        params.adaptiveReorderThreshold = MOST_FILL
        self.isam = gtsam.ISAM2(params)
        self.linearised_at = self.isam.getLinearizationPoint()
        """Linearisation point of every variable.

        Held as a reference: while Python holds it, GTSAM hands this object to factors written in Python instead of
        copying all values for each of them."""
        self._slots: dict[int, list[int]] = {}

    def begin(self, groups: Mapping[int, FactorGroup], values: gtsam.Values) -> None:
        """Add all groups of factors, by handle, and all variables. RuntimeError where there is no solution."""
        self.update(groups, values, removed=(), relinearises=False)

    def update(
        self,
        new: Mapping[int, FactorGroup],
        values: gtsam.Values,
        *,
        removed: Iterable[int],
        relinearises: bool,
        last: Iterable[int] = (),
    ) -> None:
        """Add groups of factors by their handles, with new variables, and remove others.

        Parameters
        ----------
        relinearises
            True: move the linearisation point of each variable whose change exceeds the threshold.
        last
            Variables to eliminate last. They form the root of the Bayes tree. A covariance is computed along the path
            from the root to its variables, which has one clique then instead of up to fifty.
        """
        # GTSAM would put the variables of new factors last, and in an update without new factors none
        params = gtsam.ISAM2UpdateParams()
        params.removeFactorIndices = [
            slot for handle in removed for slot in self._slots.pop(handle)
        ]
        params.force_relinearize = relinearises
        groups = gtsam.KeyGroupMap()
        eliminated_again = gtsam.KeyList()
        for key in last:
            groups.insert2(key, LAST)
            if not values.exists(key):
                # GTSAM orders only what it eliminates
                eliminated_again.push_back(key)
        params.constrainedKeys = groups
        params.extraReelimKeys = eliminated_again
        result = self.isam.update(graph_of(new.values()), values, params)
        indices = iter(result.getNewFactorsIndices())
        for handle, group in new.items():
            self._slots[handle] = list(islice(indices, len(group.factors)))

    def holds(self, key: int) -> bool:
        """True for a variable in the window."""
        return self.isam.valueExists(key)

    def largest_shift(self, keys: Sequence[int]) -> float:
        """Largest component by which some variables have moved from their linearisation point, rad or m."""
        if not keys:
            return 0.0
        # GTSAM returns a reference, not a copy
        return float(np.abs(self.isam.getDelta().vector(keys)).max())

    def estimate(self, keys: Sequence[int] | None = None) -> gtsam.Values:
        """Estimate of some variables, or of all."""
        if keys is None:
            return self.isam.calculateEstimate()
        return self.isam.calculateEstimate(keys)


class FixedLagWindow:
    """GTSAM's fixed-lag smoother: iSAM2 over the last seconds, with the marginal of all that is older.

    Parameters
    ----------
    thresholds
        Changes of a variable above which it is relinearised.
    lag_s
        Age from which variables are marginalised.
    """

    def __init__(
        self, thresholds: Thresholds, lag_s: float, *, is_by_qr: bool = False
    ) -> None:
        self._params = isam2_params(thresholds, is_by_qr=is_by_qr)
        # the window is small: every update may relinearise
        self._params.relinearizeSkip = 1
        self._is_by_qr = is_by_qr
        self._begin_empty(lag_s)

    def _begin_empty(self, lag_s: float) -> None:
        self._fixed_lag = gtsam.IncrementalFixedLagSmoother(lag_s, self._params)
        # held as in `WholeWindow`
        self.linearised_at = self._fixed_lag.getLinearizationPoint()
        self._slots: dict[int, list[int]] = {}

    def begin(
        self,
        graph: gtsam.NonlinearFactorGraph,
        groups: Mapping[int, FactorGroup],
        values: gtsam.Values,
        times_s: Times,
    ) -> None:
        """Begin again with some variables of a graph. RuntimeError where there is no solution.

        Parameters
        ----------
        graph
            All factors. Those on other variables than the kept ones are replaced by their marginal.
        groups
            Groups of factors by handle.
        values
            Where the factors are linearised.
        times_s
            The kept variables, and when they were last used.
        """
        inside = gtsam.NonlinearFactorGraph()
        outside = gtsam.NonlinearFactorGraph()
        slot_of: dict[gtsam.NonlinearFactor, int] = {}
        for factor in (graph.at(i) for i in range(graph.size())):
            is_inside = all(key in times_s for key in list(factor.keys()))
            if is_inside:
                slot_of[factor] = inside.size()
                inside.add(factor)
            else:
                outside.add(factor)
        # these factors also constrain the kept variables
        if outside.size():
            for factor in marginal(outside, values, times_s, is_by_qr=self._is_by_qr):
                inside.add(factor)
        self._begin_empty(self._fixed_lag.smootherLag())
        self._fixed_lag.update(inside, picked(values, times_s), dict(times_s))
        self._slots = {
            handle: [slot_of[factor] for factor in group if factor in slot_of]
            for handle, group in groups.items()
        }

    def update(
        self,
        new: Mapping[int, FactorGroup],
        values: gtsam.Values,
        times_s: Times,
        lag_s: float,
        *,
        removed: Iterable[int],
    ) -> None:
        """Add groups of factors and variables, remove groups, and marginalise variables older than the lag."""
        slots = [slot for handle in removed for slot in self._slots.pop(handle)]
        self._fixed_lag.setSmootherLag(lag_s)
        self._fixed_lag.update(graph_of(new.values()), values, dict(times_s), slots)
        indices = iter(self._fixed_lag.getISAM2Result().getNewFactorsIndices())
        for handle, group in new.items():
            self._slots[handle] = [next(indices) for _ in group]

    def forget(self, handles: Iterable[int]) -> None:
        """Forget groups whose factors were marginalised."""
        for handle in handles:
            self._slots.pop(handle, None)

    @property
    def isam(self) -> gtsam.ISAM2:
        """The solver inside, for covariances; a copy."""
        return self._fixed_lag.getISAM2()

    def holds(self, key: int) -> bool:
        """True for a variable in the window."""
        return self.linearised_at.exists(key)

    def estimate(self, keys: Sequence[int] | None = None) -> gtsam.Values:
        """Estimate of some variables, or of all."""
        values = self._fixed_lag.calculateEstimate()
        return values if keys is None else picked(values, keys)

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """Marginals and factors of the window.

        iSAM2 keeps a marginal without its linearisation point, which is that of the window's variables.
        """
        present = self._fixed_lag.getFactors()
        graph = gtsam.NonlinearFactorGraph()
        for i in range(present.size()):
            # an empty slot: its factor was marginalised or removed
            if not present.exists(i):
                continue
            factor = present.at(i)
            if isinstance(factor, gtsam.LinearContainerFactor):
                # without a linearisation point it could not be relinearised elsewhere
                graph.add(
                    gtsam.LinearContainerFactor(
                        factor.linearize(self.linearised_at), self.linearised_at
                    )
                )
            else:
                graph.add(factor)
        return graph

    def largest_shift(self, keys: Sequence[int]) -> float:
        """Largest component by which some variables have moved from their linearisation point, rad or m."""
        if not keys:
            return 0.0
        return float(np.abs(self._fixed_lag.getDelta().vector(keys)).max())


def marginal(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    kept: Container[int],
    *,
    is_by_qr: bool,
) -> list[gtsam.NonlinearFactor]:
    """Marginal of factors on the kept variables, linearised at the values.

    RuntimeError where elimination fails: QR on what is not determined, Cholesky also on what is determined weakly.
    """
    linear = graph.linearize(values)
    separator = [key for key in linear.keyVector() if key in kept]
    found = (
        linear.marginal(separator, gtsam.EliminateQR)
        if is_by_qr
        else linear.marginal(separator)
    )
    return [
        gtsam.LinearContainerFactor(found.at(i), values) for i in range(found.size())
    ]
