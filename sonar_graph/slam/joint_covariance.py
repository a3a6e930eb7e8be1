"""The joint covariance of several variables, by their keys."""

from __future__ import annotations

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


def _size(key: int) -> int:
    return 6 if gtsam.symbolChr(key) == ord("x") else 3
