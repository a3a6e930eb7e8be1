"""Incremental smoothing whose cost per update stays bounded, and the whole graph's solution when it is asked for.

Two solvers share the same factors:

* *window*: GTSAM's iSAM2 over the poses of the last ``lag_s`` seconds and all landmarks and biases. Older poses are
  marginalised, so that an update does not walk over all sightings that a landmark ever had.
* *history*: every factor ever added. Solving it (Levenberg–Marquardt) relinearises everything.

Marginalising freezes the linearisation of the landmarks it touches. When an estimate has moved away from where it was
frozen, the history is solved again and the window restarts from that solution with fresh linearisation; the number of
factors at least `RESTART_GROWTH` times that of the last time keeps the total cost proportional to the history.
"""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.slam.batch import solve

RESTART_GROWTH = 1.5


class Smoother:
    """A growing graph with a bounded incremental solution.

    Parameters
    ----------
    lag_s
        Poses older than this leave the window; infinite: plain iSAM2 over the whole history.
    relinearize_threshold
        A variable is relinearised when any component of its change exceeds this (rad or m).
    """

    def __init__(self, lag_s: float, relinearize_threshold: float) -> None:
        self._lag_s = lag_s
        self._threshold = relinearize_threshold
        self.graph = gtsam.NonlinearFactorGraph()
        """Every factor ever added."""
        self.values = gtsam.Values()
        """The newest estimate of every variable; of those that left the window, the last one there."""
        self._pending = gtsam.NonlinearFactorGraph()
        self._pending_values = gtsam.Values()
        self._pending_times: dict[int, float] = {}
        self._lasting: list[int] = []
        self._window = self._new_window()
        self._solved: tuple[gtsam.Values, gtsam.Marginals] | None = None
        self._solved_size = 0

    def _new_window(self) -> gtsam.IncrementalFixedLagSmoother:
        params = gtsam.ISAM2Params()
        params.relinearizeSkip = 1
        params.setRelinearizeThreshold(self._threshold)
        params.findUnusedFactorSlots = True
        return gtsam.IncrementalFixedLagSmoother(self._lag_s, params)

    def add_pose(self, key: int, pose: gtsam.Pose3, time_s: float) -> None:
        """A new keyframe, with its first estimate."""
        self._pending_values.insert(key, pose)
        self.values.insert(key, pose)
        self._pending_times[key] = time_s

    def add_lasting(self, key: int, point: Floats) -> None:
        """A new landmark or bias, which never leaves the window."""
        self._pending_values.insert(key, point)
        self.values.insert(key, point)
        self._lasting.append(key)

    def add(self, factors: Iterable[gtsam.NonlinearFactor]) -> None:
        """New factors, used at the next update."""
        for factor in factors:
            self._pending.push_back(factor)
            self.graph.push_back(factor)

    @property
    def has_news(self) -> bool:
        """Whether factors wait for an update."""
        return self._pending.size() > 0

    def update(self, time_s: float) -> None:
        """Bring the window's estimate up to date with what was added."""
        times = self._pending_times | dict.fromkeys(self._lasting, time_s)
        self._window.update(self._pending, self._pending_values, times)
        self._pending = gtsam.NonlinearFactorGraph()
        self._pending_values = gtsam.Values()
        self._pending_times = {}
        self.values.update(self._window.calculateEstimate())

    def covariance(self, key: int) -> Floats:
        """Marginal covariance of a variable in the window."""
        return self._window.marginalCovariance(key)

    def joint_covariance(self, keys: list[int]) -> gtsam.JointMarginal:
        """Joint marginal covariance of variables in the window."""
        return self._window.getISAM2().jointMarginalCovariance(keys)

    def solve_history(self) -> tuple[gtsam.Values, gtsam.Marginals]:
        """Solve the whole graph from the present values; the solution and its marginal covariances."""
        if self._solved is None or self._solved_size != self.graph.size():
            values = solve(self.graph, self.values)
            self._solved = values, gtsam.Marginals(self.graph.linearize(values), values)
            self._solved_size = self.graph.size()
        return self._solved
