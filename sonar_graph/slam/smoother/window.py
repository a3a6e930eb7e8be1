"""GTSAM's incremental solvers: iSAM2 over the whole run, and a fixed-lag smoother for a bounded history.

Kaess et al., "iSAM2: Incremental smoothing and mapping using the Bayes tree", IJRR 31(2), 2012.

GTSAM's Cholesky elimination fails ("indeterminate") when the absolute sigma of a variable exceeds 4096 times its sigma
given its neighbours. Millimetre odometry reaches this ratio after some metres of drift. QR does not fail there, but is
slower: a window changes to QR when Cholesky has failed, and stays with it (docs/theory/isam2.md).
"""

from collections import defaultdict
from collections.abc import Container, Iterable, Mapping, Sequence
from itertools import chain, islice
from typing import Any, NamedTuple

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.factor_store import (
    BIAS,
    LANDMARK,
    TANGENT_SIZES,
    FactorGroup,
    factors_in,
    graph_of,
    picked,
)

NEVER = 1_000_000_000
"""Updates between two relinearisations that iSAM2 would begin by itself."""
MOST_FILL = 1.5
"""Growth of the Bayes tree since all variables were last ordered together, from which they are ordered again
(`benchmarks/validation/isam2_constants.py`)."""
FEWEST_TOGETHER = 3
"""New sightings of one landmark from one keyframe, from which they become one factor. It is linearised in Python: for
fewer sightings that takes longer than it saves (`benchmarks/validation/isam2_constants.py`)."""
LAST = 1
"""Group of the variables that are eliminated last; all others are in group 0."""
Groups = Mapping[int, FactorGroup]
"""Groups of factors by handle."""
View = tuple[int, int]
"""Keys of a keyframe and of a landmark that it sees."""
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


class BundleError:
    """Error of several sightings of one landmark from one keyframe, called by GTSAM.

    Parameters
    ----------
    view
        Keys of keyframe and landmark.
    groups
        Factors of each sighting.
    """

    __slots__ = ("_graph", "_order", "keys", "rows")

    def __init__(self, view: View, groups: Iterable[FactorGroup]) -> None:
        self.keys = list(view)
        self._graph = graph_of(groups)
        self._order = gtsam.Ordering()
        for key in view:
            self._order.push_back(key)
        self.rows = sum([factor.dim() for factor in factors_in(self._graph)])

    def __call__(
        self,
        _: gtsam.CustomFactor,
        values: gtsam.Values,
        jacobians: list[Floats] | None,
    ) -> Floats:
        """Whitened errors with the weights of their kernels, shape (rows,): iSAM2 only linearises its factors."""
        A, b = self._graph.linearize(values).jacobian(self._order)  # A x = b
        if jacobians is not None:
            jacobians[0] = A[:, :6]  # (rows, 6)
            jacobians[1] = A[:, 6:]  # (rows, 3)
        return -b


def parts_of(groups: Groups) -> list[dict[int, FactorGroup]]:
    """Groups by handle, in parts: several sightings of one landmark from one keyframe, or a single group."""
    views: dict[View | int, dict[int, FactorGroup]] = defaultdict(dict)
    for handle, group in groups.items():
        if group.seen is None:
            views[handle][handle] = group
        else:
            landmark_key, line = group.seen
            views[line.pose_key, landmark_key][handle] = group
    parts = []
    for view in views.values():
        if len(view) >= FEWEST_TOGETHER:
            parts.append(view)
        else:
            parts += [{handle: group} for handle, group in view.items()]
    return parts


def factors_of(part: Groups) -> list[gtsam.NonlinearFactor]:
    """The factors of a single group; one factor for several sightings."""
    groups = list(part.values())
    seen = groups[0].seen
    if len(groups) == 1 or seen is None:
        return list(groups[0].factors.values())
    landmark_key, line = seen
    error = BundleError((line.pose_key, landmark_key), groups)
    noise = gtsam.noiseModel.Unit.Create(error.rows)
    return [gtsam.CustomFactor(noise, error.keys, error)]


class WholeWindow:
    """iSAM2 over all variables of the run.

    An update of iSAM2 searches all factors of each variable that it eliminates. The landmarks in reach are always among
    these variables, so that the search grows with the run. Therefore several new sightings of one landmark from one
    keyframe enter as one factor.
    """

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
        self._parts: dict[int, Groups] = {}
        """By handle: the groups whose factors share these slots."""

    def begin(self, groups: Groups, values: gtsam.Values) -> None:
        """Add all groups of factors, by handle, and all variables. RuntimeError where there is no solution."""
        self.update(groups, values, removed=(), relinearises=False)

    def update(
        self,
        new: Groups,
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
        slots, kept = self._without(set(removed))
        params.removeFactorIndices = slots
        params.force_relinearize = relinearises
        groups = gtsam.KeyGroupMap()
        eliminated_again = gtsam.KeyList()
        new_keys = set(values.keys())
        for key in last:
            groups.insert2(key, LAST)
            if key not in new_keys:
                # GTSAM orders only what it eliminates
                eliminated_again.push_back(key)
        params.constrainedKeys = groups
        params.extraReelimKeys = eliminated_again
        parts = parts_of(kept | dict(new))
        factors = [factors_of(part) for part in parts]
        graph = gtsam.NonlinearFactorGraph()
        for factor in chain.from_iterable(factors):
            graph.add(factor)
        result = self.isam.update(graph, values, params)
        indices = iter(result.getNewFactorsIndices())
        for part, made in zip(parts, factors, strict=True):
            slots = list(islice(indices, len(made)))
            for handle in part:
                self._slots[handle] = slots
                self._parts[handle] = part

    def _without(self, removed: set[int]) -> tuple[list[int], dict[int, FactorGroup]]:
        """Slots of removed groups, and the groups beside them in these slots, which enter again."""
        slots = {slot for handle in removed for slot in self._slots.pop(handle)}
        beside: dict[int, FactorGroup] = {}
        for handle in removed:
            beside.update(self._parts.pop(handle))
        kept = {handle: beside[handle] for handle in sorted(beside.keys() - removed)}
        return sorted(slots), kept

    def holds(self, key: int) -> bool:
        """True for a variable in the window."""
        return self.isam.valueExists(key)

    def delta(self) -> gtsam.VectorValues:
        """Distance of each variable from its linearisation point; a reference, not a copy."""
        return self.isam.getDelta()

    def estimate(self, keys: Sequence[int] | None = None) -> gtsam.Values:
        """Estimate of some variables, or of all."""
        if keys is None:
            return self.isam.calculateEstimate()
        return self.isam.calculateEstimate(keys)


class FixedLagWindow:
    """GTSAM's fixed-lag smoother: iSAM2 over the last seconds, with the marginal of all that is older."""

    def __init__(self, thresholds: Thresholds, *, is_by_qr: bool = False) -> None:
        self._params = isam2_params(thresholds, is_by_qr=is_by_qr)
        # the window is small: every update may relinearise
        self._params.relinearizeSkip = 1
        self._is_by_qr = is_by_qr
        self._begin_empty()

    def _begin_empty(self) -> None:
        # each update has its own lag; at a restart nothing leaves
        self._fixed_lag = gtsam.IncrementalFixedLagSmoother(np.inf, self._params)
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
        for factor in factors_in(graph):
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
        self._begin_empty()
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

    def delta(self) -> gtsam.VectorValues:
        """Distance of each variable from its linearisation point."""
        return self._fixed_lag.getDelta()


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
    return [gtsam.LinearContainerFactor(each, values) for each in factors_in(found)]
