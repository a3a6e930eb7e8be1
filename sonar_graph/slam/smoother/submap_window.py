"""Incremental solution over the whole run: the newest keyframes, submaps of the older ones, landmarks and biases.

iSAM2 holds the keyframes of the last ``lag_s`` seconds with their own factors, and of the older ones only each one
between two submaps (`submaps`, docs/theory/isam2.md). Nothing is given up: a submap keeps its factors, takes in late
ones, and is linearised anew when its shape has changed; each update looks at one of them in turn.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from sonar_graph.slam.smoother.batch_solution import is_pose, picked, tangent_size
from sonar_graph.slam.smoother.fixed_lag import isam2_params, settle
from sonar_graph.slam.smoother.submaps import SubmapFactor

STALE = 0.02
"""Change of the shape of a submap (rad or m) from which on it is linearised anew."""
SETTLED = 0.002
"""Decrease of the error (half a sum of squares) a keyframe, by a step of those of a submap, up to which they rest."""
AT_ONCE = 100.0
"""Shift of a keyframe, in thresholds of relinearisation, from which on the next update relinearises. Not of landmarks:
the height of one that is only seen from one level never comes to rest."""
MOST = 50
"""Submaps from which on neighbours are joined."""
MOST_ROWS = 120
"""Rows of what a joined submap shares with the rest, at most: it is dense."""
NEVER = 1 << 30
Factor = gtsam.NonlinearFactor


@dataclass(eq=False)
class Submap:
    """Keyframes between two others with their factors, or two such submaps and the keyframe between them."""

    interior: list[int]
    """Keys of its keyframes, in the order of time."""
    factors: dict[Factor, None]
    values: gtsam.Values
    """Its keyframes where it was last linearised."""
    net: gtsam.GaussianBayesNet | None = None
    """Its keyframes given what it shares with the rest, both as steps from where it was linearised."""
    summary: SubmapFactor | None = None
    marginals: Sequence[Factor] = ()
    """What stands for it elsewhere: the factor of the summary; absolute where no pose of it stays."""
    is_settled: bool = False
    ends: tuple[int, int] = (0, 0)
    """Keys of the keyframes before and after it."""
    parent: Submap | None = None
    """The submap of which it is a part."""

    def present(self, estimate: gtsam.Values) -> gtsam.Values:
        """Its keyframes at their best, given the estimate of what stays, moved with the frame of the submap."""
        if self.summary is None or self.net is None:
            return self.values
        motion, step = self.summary.motion(estimate), self.net.optimize(self.summary.step(estimate))
        moved = gtsam.Values()
        for key in self.interior:
            moved.insert(key, motion.compose(self.values.atPose3(key).retract(step.at(key))))
        return moved

    def is_stale(self, estimate: gtsam.Values) -> bool:
        """True when its keyframes were not at rest when it was linearised, or its shape has changed since."""
        is_moved = self.summary is not None and np.abs(self.summary.deviation(estimate)[0]).max() > STALE
        return is_moved or not self.is_settled

    def linearise(self, estimate: gtsam.Values) -> None:
        """Marginalise its factors at the estimate of what stays, and take a Gauss-Newton step of what does not."""
        graph, order = gtsam.NonlinearFactorGraph(), gtsam.Ordering()
        for factor in self.factors:
            graph.add(factor)
        for key in self.interior:
            order.push_back(key)
        inside = set(self.interior)
        kept = [key for key in graph.keyVector() if key not in inside]
        values = picked(estimate, kept)
        step = values.zeroVectors()
        interior = self.present(estimate)
        values.insert(interior)
        net, rest = graph.linearize(values).eliminatePartialSequential(order, gtsam.EliminateQR)
        self.is_settled = net.error(values.zeroVectors()) <= SETTLED * len(self.interior)
        self.values, self.net, self.summary = interior, net, None
        poses = [key for key in kept if is_pose(key)]
        if poses:
            keys = [poses[0], *(key for key in kept if key != poses[0])]
            order = gtsam.Ordering()
            for key in keys:
                order.push_back(key)
            A, b = rest.jacobian(order)
            if len(A) > A.shape[1]:
                R = np.asarray(np.linalg.qr(np.column_stack([A, b]), "r"))[: A.shape[1]]
                A, b = R[:, :-1], R[:, -1]
            self.summary = SubmapFactor(keys, A, b, values)
            self.marginals = [self.summary.factor()]
        else:
            self.values, self.net = interior.retract(net.optimize(step)), None
            self.marginals = [gtsam.LinearContainerFactor(rest.at(i), values) for i in range(rest.size())]


class SubmapWindow:
    """Incremental solution over the whole run, by Cholesky, and by QR once that has given up."""

    def __init__(
        self, relinearize_threshold: float, lag_s: float, submap_keyframes: int, relinearised_every: int
    ) -> None:
        self._threshold = relinearize_threshold
        self.relinearised_every = relinearised_every
        self.lag_s = lag_s
        """Age (s) from which on keyframes may leave for submaps."""
        self.size = submap_keyframes
        self.is_by_qr = False
        self._begin_empty()

    def _begin_empty(self) -> None:
        params = isam2_params(self._threshold, is_by_qr=self.is_by_qr)
        params.relinearizeSkip = NEVER
        self._isam = gtsam.ISAM2(params)
        self._slots: dict[Factor, int] = {}
        self._marginals: dict[Factor, None] = {}
        self._times_s: dict[int, float] = {}
        self._on: dict[int, dict[Factor, None]] = defaultdict(dict)
        self._submaps: list[Submap] = []
        self._whole: list[Submap] = []
        self._of: dict[int, Submap] = {}
        self._turn = self._updates = 0

    @property
    def marginals(self) -> gtsam.ISAM2:
        """Source of covariances."""
        return self._isam

    @property
    def factors(self) -> gtsam.NonlinearFactorGraph:
        """Factors, with those of submaps; some places may be empty."""
        return self._isam.getFactorsUnsafe()

    @property
    def linearised_at(self) -> gtsam.Values:
        """Where the variables are linearised."""
        return self._isam.getLinearizationPoint()

    def estimate(self) -> gtsam.Values:
        """Estimate of the variables in the window."""
        return self._isam.calculateEstimate()

    def holds(self, key: int) -> bool:
        """True for a keyframe with its own factors, and for any other variable."""
        return self._isam.valueExists(key) and (not is_pose(key) or key in self._times_s)

    def begin(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, times_s: Mapping[Any, float], time_s: float
    ) -> None:
        """Begin anew at a time with all factors, linearised at the values.

        A RuntimeError where even QR finds no solution.
        """
        self._begin_empty()
        self._times_s = {key: t for key, t in times_s.items() if is_pose(key)}
        factors = [graph.at(i) for i in range(graph.size())]
        self._register(factors)
        self._close(values, time_s)
        rest = gtsam.NonlinearFactorGraph()
        for factor in factors:
            if self._submap_of(factor) is None:
                rest.add(factor)
        try:
            self._feed(rest, picked(values, [key for key in list(values.keys()) if key not in self._of]), [])
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
        time_s: float,
        removed: Sequence[Factor] = (),
    ) -> gtsam.Values:
        """Estimate with new factors and variables, without some of the factors; with keyframes of what was touched."""
        new, slots, touched = gtsam.NonlinearFactorGraph(), list[int](), dict[Submap, None]()
        for factor in removed:
            if submap := self._submap_of(factor):
                del submap.factors[factor]
                touched[submap] = None
            else:
                slots.append(self._slots.pop(factor))
                for key in filter(is_pose, list(factor.keys())):
                    del self._on[key][factor]
        for factor in (graph.at(i) for i in range(graph.size())):
            if submap := self._submap_of(factor):
                submap.factors[factor] = None
                touched[submap] = None
            else:
                new.add(factor)
        self._updates += 1
        is_due = self._updates % self.relinearised_every == 0 or not self._submaps
        shifts = self._isam.getDelta()
        is_due = is_due or any(np.abs(shifts.at(key)).max() > AT_ONCE * self._threshold for key in self._times_s)
        estimate = self.estimate()
        if self._whole and not touched and (not is_due or self.relinearised_every == 1):
            self._turn = (self._turn + 1) % len(self._whole)
            submap = self._whole[self._turn]
            if submap.is_stale(self._around(submap, estimate)):
                touched[submap] = None
        slots += self._close(estimate, time_s)
        self._times_s |= {key: t for key, t in times_s.items() if is_pose(key)}
        self._register(new.at(i) for i in range(new.size()))
        known = gtsam.Values(values)
        known.insert_or_assign(estimate)
        for submap in touched:
            self._linearise(submap, known)
        self._feed(new, values, slots, relinearises=is_due)
        estimate = self.estimate()
        for submap in touched:
            estimate.insert_or_assign(submap.present(self._around(submap, estimate)))
        return estimate

    def _submap_of(self, factor: Factor) -> Submap | None:
        """The submap that a factor belongs to: of several the innermost."""
        owners = [self._of[key] for key in list(factor.keys()) if key in self._of]
        return next((one for one in owners if not any(one is other.parent for other in owners)), None)

    def _register(self, factors: Iterable[Factor]) -> None:
        for factor in factors:
            for key in filter(is_pose, list(factor.keys())):
                if key not in self._of:
                    self._on[key][factor] = None

    def _around(self, submap: Submap, estimate: gtsam.Values) -> gtsam.Values:
        """Estimate, with the keyframes of the submaps that a submap is part of."""
        if submap.parent is None:
            return estimate
        values = gtsam.Values(self._around(submap.parent, estimate))
        values.insert_or_assign(submap.parent.present(values))
        return values

    def _linearise(self, submap: Submap, estimate: gtsam.Values) -> None:
        """Linearise a submap anew, and those that it is part of."""
        old = submap.marginals
        submap.linearise(self._around(submap, estimate))
        if submap.parent is not None:
            for factor in old:
                del submap.parent.factors[factor]
            submap.parent.factors |= dict.fromkeys(submap.marginals)
            self._linearise(submap.parent, estimate)

    def _close(self, estimate: gtsam.Values, time_s: float) -> list[int]:
        """Make submaps of keyframes that are older than the lag, as many of them as fill one, between two that stay.

        Neighbours are joined while there are many, and what they share with the rest is not. Returns the places of the
        factors that belong to submaps now.
        """
        gone: list[Factor] = []
        while True:
            keys = list(self._times_s)
            old = sum(t < time_s - self.lag_s for t in self._times_s.values())
            if old <= self.size or len(keys) < self.size + 2:
                break
            interior, ends = keys[1 : self.size + 1], (keys[0], keys[self.size + 1])
            gone += self._add(Submap(interior, {}, picked(estimate, interior), ends=ends), len(self._submaps), estimate)
            for key in keys[: self.size + 1]:
                del self._times_s[key]
        while len(self._submaps) > MOST:
            pairs = list(pairwise(self._submaps))
            rows = [
                sum(map(tangent_size, {k for part in pair for f in part.marginals for k in list(f.keys())}))
                for pair in pairs
            ]
            place = int(np.argmin(rows))
            if rows[place] > MOST_ROWS:
                break
            before, after = self._submaps[place : place + 2]
            middle = [before.ends[1]]
            joined = Submap(middle, {}, picked(estimate, middle), ends=(before.ends[0], after.ends[1]))
            joined.factors = dict.fromkeys([*before.marginals, *after.marginals])
            before.parent = after.parent = joined
            del self._submaps[place : place + 2]
            gone += self._add(joined, place, estimate)
        return [self._slots.pop(factor) for factor in gone if factor in self._slots]

    def _add(self, submap: Submap, place: int, estimate: gtsam.Values) -> list[Factor]:
        """Add a submap with the factors on its keyframes; these."""
        on_it = {factor: None for key in submap.interior for factor in self._on.pop(key)}
        submap.factors |= {factor: None for factor in on_it if self._submap_of(factor) is None}
        self._of |= dict.fromkeys(submap.interior, submap)
        self._submaps.insert(place, submap)
        self._whole.append(submap)
        submap.linearise(estimate)
        return list(submap.factors)

    def _feed(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, slots: list[int], *, relinearises: bool = False
    ) -> None:
        """Bring the factors of submaps in line, and update."""
        present = {factor: None for submap in self._submaps for factor in submap.marginals}
        slots += [
            self._slots.pop(factor) for factor in self._marginals if factor not in present and factor in self._slots
        ]
        for factor in present:
            if factor not in self._slots:
                graph.add(factor)
        self._marginals = present
        result = self._isam.update(graph, values, slots, force_relinearize=relinearises)
        self._slots |= {graph.at(i): slot for i, slot in enumerate(result.getNewFactorsIndices())}

    def settle(self) -> None:
        """Update until nothing would be relinearised any more."""
        settle(partial(self._isam.update, force_relinearize=True), self._isam, self._threshold)

    def carried(self, values: gtsam.Values) -> gtsam.Values:
        """Values, with the keyframes of submaps moved with these."""
        carried = gtsam.Values(values)
        for submap in reversed(self._whole):
            carried.update(submap.present(carried))
        return carried
