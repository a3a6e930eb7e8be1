"""A graph that grows, and from which single factors can be taken out again."""

from __future__ import annotations

from collections.abc import Iterable

import gtsam


class History:
    """Factors, each with a handle that stays the same while others come and go.

    A place that becomes free is filled with the last factor, so that the graph has no holes, whatever is taken out.
    """

    def __init__(self) -> None:
        self.graph = gtsam.NonlinearFactorGraph()
        """The factors that are in."""
        self.changes = 0
        """Number of factors ever put in or taken out."""
        self._handles: list[int] = []
        self._slots: dict[int, int] = {}
        self._next = 0

    def add(self, factor: gtsam.NonlinearFactor) -> int:
        """Put a factor in; its handle."""
        handle, self._next = self._next, self._next + 1
        self._slots[handle] = len(self._handles)
        self._handles.append(handle)
        self.graph.add(factor)
        self.changes += 1
        return handle

    def factor(self, handle: int) -> gtsam.NonlinearFactor:
        """The factor of a handle."""
        return self.graph.at(self._slots[handle])

    def remove(self, handles: Iterable[int]) -> None:
        """Take factors out."""
        for handle in handles:
            slot, last = self._slots.pop(handle), self._handles.pop()
            if last != handle:
                self.graph.replace(slot, self.graph.at(len(self._handles)))
                self._handles[slot] = last
                self._slots[last] = slot
            self.graph.resize(len(self._handles))
            self.changes += 1
