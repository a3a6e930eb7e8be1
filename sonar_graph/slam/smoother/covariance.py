"""Marginal covariances of a graph or of a window, and one joint covariance for all questions between two updates."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.batch_solution import StackedGraph, qr_tree
from sonar_graph.slam.smoother.variables import tangent_size


@dataclass(frozen=True, eq=False)
class JointCovariance:
    """Joint covariance of some variables of a graph, in the tangent space of each.

    One matrix, so that compiled code can pick what it needs; GTSAM's `JointMarginal` hands out one block a call.
    """

    matrix: Floats
    """Shape (n, n), in the order in which the variables were asked for."""
    rows: dict[int, int]
    """The first row of each variable, by key."""

    @classmethod
    def of(cls, marginals: Marginals | gtsam.ISAM2, keys: list[int]) -> JointCovariance:
        """Ask for poses (6 rows each), biases (11) and points (3)."""
        rows, n = {}, 0
        for key in keys:
            rows[key] = n
            n += tangent_size(key)
        return cls(marginals.jointMarginalCovariance(keys).fullMatrix(), rows)

    def at(self, a: int, b: int) -> Floats:
        """The block of two variables."""
        i, j = self.rows[a], self.rows[b]
        return self.matrix[i : i + tangent_size(a), j : j + tangent_size(b)]


class KeptCovariance:
    """One joint covariance for all questions between two updates.

    A question costs an elimination of most of the map, whatever it asks for. So the first question after an update also
    asks for the landmarks that the next frame is likely to show.
    """

    def __init__(self) -> None:
        self._joint: JointCovariance | None = None
        self._asked: set[int] = set()

    def of(
        self, marginals: Marginals | gtsam.ISAM2, keys: list[int], likely: Callable[[], list[int]]
    ) -> JointCovariance:
        """Joint covariance of these variables, and possibly of more; ``likely`` names those asked for next."""
        self._asked.update(keys)
        if self._joint is None or not self._joint.rows.keys() >= self._asked:
            self._joint = JointCovariance.of(marginals, sorted(self._asked.union(likely())))
        return self._joint

    def renew(self) -> None:
        """The graph has changed."""
        self._joint = None
        self._asked = set()


class Marginals:
    """Marginal covariances of a graph, linearised at the values; by QR where Cholesky refuses.

    GTSAM eliminates anew for each question, so that Cholesky may refuse one variable and not another. Each question
    decides for itself: no answer depends on what was asked before.
    """

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        self._linear, self._values = StackedGraph(graph).linearize(values), values
        self._by_cholesky: gtsam.Marginals | None = None
        with suppress(RuntimeError):
            self._by_cholesky = gtsam.Marginals(self._linear, values)
        self._by_qr: gtsam.ISAM2 | None = None

    def marginalCovariance(self, key: int) -> Floats:
        """Covariance of one variable; the name is GTSAM's."""
        return np.asarray(self._ask(lambda marginals: marginals.marginalCovariance(key)))

    def jointMarginalCovariance(self, keys: list[int]) -> gtsam.JointMarginal:
        """Joint covariance of some; the name is GTSAM's."""
        return self._ask(lambda marginals: marginals.jointMarginalCovariance(keys))

    def _ask(self, question: Callable[[gtsam.Marginals | gtsam.ISAM2], Any]) -> Any:
        if self._by_cholesky is not None:
            with suppress(RuntimeError):
                return question(self._by_cholesky)
        self._by_qr = self._by_qr or qr_tree(self._linear, self._values)
        return question(self._by_qr)
