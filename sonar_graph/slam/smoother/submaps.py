"""Submaps: stretches of keyframes, marginalised onto what they share with the rest, in a frame that moves with them.

A submap is the marginal of its factors on its first and last keyframe, its landmarks and biases: with the interior
keyframes eliminated, ``|A delta - b|²`` of the perturbations of those from where they were linearised, in a level frame
(`submap_factor`, docs/theory/isam2.md). A submap that turns and moves as a whole, as when a loop is closed, therefore
stays exact: what is frozen is its shape, and that is known much better than its place. Least known of the shape is how
much it winds, by which what gravity tells of its tilt must not change either.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.linalg import solve_triangular
from threadpoolctl import ThreadpoolController

from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.batch_solution import StackedGraph, is_landmark, is_pose, picked, tangent_size
from sonar_graph.slam.smoother.submap_factor import SubmapFactor

CHANGED = 0.005
"""Change of the shape of a submap (rad or m) from which on it is asked whether its summary still holds."""
TOLERANCE = 0.00005
"""Error (half a sum of squares) a variable of the interior by which a summary may be wrong: of 1,000 keyframes 0.05
together, which moves an estimate by 0.3 of its sigma at most, where all of them err in one direction."""
MOST_STEPS = 5
"""Gauss-Newton steps of the interior of a submap, at most, each time that it is linearised."""
BLAS = ThreadpoolController()
"""Libraries of linear algebra: matrices of this size are faster by one thread, much so on a busy machine."""
Factor = gtsam.NonlinearFactor


@dataclass(eq=False)
class Submap:
    """Keyframes between two others with their factors, or two such submaps and the keyframe between them."""

    interior: list[int]
    """Keys of what is eliminated: its keyframes in the order of time, and biases on which nothing else hangs."""
    factors: dict[Factor, None]
    """On its interior; those that stand for its parts among them."""
    values: gtsam.Values
    """Its interior where it was last linearised."""
    ends: tuple[int, int] = (0, 0)
    """Keys of the keyframes before and after it."""
    parts: tuple[Submap, ...] = ()
    """The two submaps that it joins, if any."""
    parent: Submap | None = None
    """The submap of which it is a part."""
    summary: SubmapFactor | None = None
    """Its marginal; None before it is linearised."""
    marginals: Sequence[Factor] = ()
    """The factor that stands for it elsewhere; none where nothing hangs on it."""
    is_settled: bool = False
    """True when its interior was at rest, and its parts as they are now, when it was linearised."""
    level: int = field(init=False)
    """0 of keyframes, 1 of two such submaps, and so on."""

    def __post_init__(self) -> None:
        self.level = 1 + max((part.level for part in self.parts), default=-1)
        for part in self.parts:
            part.parent = self

    def lineage(self) -> Iterator[Submap]:
        """The submap, the one of which it is a part, and so on."""
        submap: Submap | None = self
        while submap is not None:
            yield submap
            submap = submap.parent

    def present(self, estimate: gtsam.Values) -> gtsam.Values:
        """Its interior at its best, given the estimate of what stays, moved with the frame of the submap."""
        if self.summary is None:
            return self.values
        xi, motion = self.summary.deviation(estimate)
        return self._moved(self.values, solve_triangular(self._R, self._d - self._S @ xi), motion)

    def _moved(self, values: gtsam.Values, step: Floats, motion: gtsam.Pose3) -> gtsam.Values:
        """Its interior, from these values by a step and a motion."""
        moved, n = gtsam.Values(), 0
        for key in self.interior:
            d = step[n : n + tangent_size(key)]
            if is_pose(key):
                moved.insert(key, motion.compose(values.atPose3(key).retract(d)))
            else:
                moved.insert(key, values.atVector(key) + d)
            n += len(d)
        return moved

    def has_changed(self, estimate: gtsam.Values) -> bool:
        """True when its shape is another than where it was linearised, or it was not settled."""
        return not self.is_settled or (self.summary is not None and self.summary.change_of_shape(estimate) > CHANGED)

    def is_stale(self, estimate: gtsam.Values) -> bool:
        """True when the error of its factors has changed otherwise than its summary says, or was not settled."""
        if not self.is_settled or self.summary is None:
            return not self.is_settled
        values = picked(estimate, self.summary.keys)
        values.insert(self.present(estimate))
        error = sum(factor.error(values) for factor in self.factors)
        off = (error - self._error) - (self.marginals[0].error(estimate) - 0.5 * float(self.summary.b @ self.summary.b))
        return abs(off + 0.5 * float(self._d @ self._d)) > TOLERANCE * len(self.interior)

    def linearise(self, estimate: gtsam.Values) -> None:
        """Marginalise its factors at the estimate of what stays, its interior at rest after some Gauss-Newton steps.

        By QR of the whitened rows, with s for what stays: ``[A_interior A_s b] = Q [R S d; 0 A b]``.
        """
        graph, order = gtsam.NonlinearFactorGraph(), gtsam.Ordering()
        for factor in self.factors:
            graph.add(factor)
        stacked, interior, inside = StackedGraph(graph), self.present(estimate), set(self.interior)
        kept = [key for key in graph.keyVector() if key not in inside]
        kept.sort(key=lambda key: (not is_pose(key), not is_landmark(key), key))
        for key in self.interior + kept:
            order.push_back(key)
        n = sum(map(tangent_size, self.interior))
        rows: Floats = np.zeros((0, 0))
        for steps in range(MOST_STEPS):
            if steps:
                interior = self._moved(interior, solve_triangular(rows[:n, :n], rows[:n, -1]), gtsam.Pose3())
            values = picked(estimate, kept)
            values.insert(interior)
            whole = np.column_stack(stacked.linearize(values).jacobian(order))
            with BLAS.limit(limits=1, user_api="blas"):
                rows = np.asarray(np.linalg.qr(whole, "r"))[: whole.shape[1] - 1]
            if len(rows) < n or not np.diag(rows)[:n].all():
                raise RuntimeError("submap: its factors leave a direction of its interior open")
            self.is_settled = bool(0.5 * np.square(rows[:n, -1]).sum() <= TOLERANCE * len(self.interior))
            if self.is_settled:
                break
        self.values, self._R, self._S, self._d = interior, rows[:n, :n], rows[:n, n:-1], rows[:n, -1]
        self._error = stacked.error(values)
        self.summary = SubmapFactor(kept, rows[n:, n:-1], rows[n:, -1], values)
        self.marginals = [self.summary.factor()] if kept else []
