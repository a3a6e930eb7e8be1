"""What waits for the next update of a smoother."""

from __future__ import annotations

import gtsam


class Pending:
    """New factors with their handles, and new variables with their first estimates."""

    def __init__(self) -> None:
        self.graph = gtsam.NonlinearFactorGraph()
        self.handles: list[int] = []
        """Of the factors, in their order."""
        self.values = gtsam.Values()
        self.times_s: dict[int, float] = {}
        """Of new poses."""

    @property
    def factors(self) -> list[gtsam.NonlinearFactor]:
        """All of them."""
        return [self.graph.at(i) for i in range(len(self.handles))]

    def add(self, factor: gtsam.NonlinearFactor, handle: int) -> None:
        """A new factor."""
        self.graph.add(factor)
        self.handles.append(handle)

    def on(self, key: int) -> list[int]:
        """Handles of the factors on a variable."""
        return [handle for i, handle in enumerate(self.handles) if key in list(self.graph.at(i).keys())]

    def factor(self, handle: int) -> gtsam.NonlinearFactor:
        """The factor of a handle."""
        return self.graph.at(self.handles.index(handle))

    def drop(self, handles: set[int], keys: set[int]) -> None:
        """Take factors and variables out again."""
        kept = [(handle, self.graph.at(i)) for i, handle in enumerate(self.handles) if handle not in handles]
        self.graph, self.handles = gtsam.NonlinearFactorGraph(), []
        for handle, factor in kept:
            self.add(factor, handle)
        for key in keys:
            if self.values.exists(key):
                self.values.erase(key)
