"""The joint covariance of several variables, by their keys."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import gtsam

from sonar_graph.measurements import Floats


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
    def of(cls, marginals: gtsam.Marginals | gtsam.ISAM2, keys: list[int]) -> JointCovariance:
        """Ask for poses (6 rows each) and points (3 rows each)."""
        rows, n = {}, 0
        for key in keys:
            rows[key] = n
            n += _size(key)
        return cls(marginals.jointMarginalCovariance(keys).fullMatrix(), rows)

    def at(self, a: int, b: int) -> Floats:
        """The block of two variables."""
        i, j = self.rows[a], self.rows[b]
        return self.matrix[i : i + _size(a), j : j + _size(b)]


class KeptCovariance:
    """One joint covariance for all questions between two updates.

    It also covers what was asked for before the last update, since successive frames show mostly the same landmarks.
    """

    def __init__(self) -> None:
        self._joint: JointCovariance | None = None
        self._asked: set[int] = set()
        self._asked_before: set[int] = set()

    def of(self, marginals: gtsam.Marginals | gtsam.ISAM2, keys: list[int]) -> JointCovariance:
        """Of these variables, and possibly of more of them."""
        self._asked.update(keys)
        if self._joint is None or not self._joint.rows.keys() >= self._asked:
            self._joint = JointCovariance.of(marginals, sorted(self._asked | self._asked_before))
        return self._joint

    def outdate(self) -> None:
        """The same graph is linearised elsewhere."""
        self._joint = None

    def renew(self, lasting: Iterable[int]) -> None:
        """The graph has changed; of what was asked for only some variables last."""
        self._joint, self._asked, self._asked_before = None, set(), self._asked.intersection(lasting)


def _size(key: int) -> int:
    return 6 if gtsam.symbolChr(key) == ord("x") else 3
