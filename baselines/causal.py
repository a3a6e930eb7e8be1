"""What a filter has said so far: one estimate for each instant that was asked for."""

from __future__ import annotations

from sonar_graph.states import Estimate, Trajectory


class CausalEstimates:
    """Estimates in the order of their instants."""

    def __init__(self) -> None:
        self._estimates: list[Estimate] = []

    def keep(self, estimate: Estimate) -> None:
        """Append; an estimate for the instant of the last one takes its place, an earlier one is passed over."""
        last_ns = self._estimates[-1].stamp_ns if self._estimates else None
        if last_ns is None or estimate.stamp_ns > last_ns:
            self._estimates.append(estimate)
        elif estimate.stamp_ns == last_ns:
            self._estimates[-1] = estimate

    def trajectory(self) -> Trajectory:
        """All of them."""
        return Trajectory.from_estimates(self._estimates)
