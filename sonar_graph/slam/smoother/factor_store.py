"""Stores of a growing graph from which single factors can be taken out: the whole history, or the window's part."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import gtsam

from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.fixed_lag import without

POSE, LANDMARK = ord("x"), ord("l")


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

    def keep(self, window: gtsam.NonlinearFactorGraph, theta: gtsam.Values, left: Iterable[int]) -> None:
        """Keep everything: a factor that leaves the window stays here."""


class Recent:
    """Factors of the window; those on variables that have left are in marginals for good, and their handles end."""

    def __init__(self) -> None:
        self.changes = 0
        """Number of factors ever put in or taken out, and of times that variables left."""
        self._factors: dict[int, gtsam.NonlinearFactor] = {}
        self._handles: dict[int, list[int]] = defaultdict(list)
        self._window, self._theta = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._waiting: list[int] = []
        self._gone: list[gtsam.NonlinearFactor] = []
        self._next = 0

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Factors in the window, marginals among them, and those that wait to be."""
        graph = without(self._window, self._theta, self._gone)
        for handle in self._waiting:
            graph.push_back(self._factors[handle])
        return graph

    def add(self, factor: gtsam.NonlinearFactor) -> int:
        """Put a factor in; its handle."""
        handle, self._next = self._next, self._next + 1
        self._factors[handle] = factor
        keys = [(key, gtsam.symbolChr(key)) for key in list(factor.keys())]
        poses = [key for key, kind in keys if kind == POSE]
        for key in poses or [key for key, kind in keys if kind != LANDMARK]:  # it leaves with its poses, else biases
            self._handles[key].append(handle)
        self._waiting.append(handle)
        self.changes += 1
        return handle

    def factor(self, handle: int) -> gtsam.NonlinearFactor:
        """The factor of a handle."""
        return self._factors[handle]

    def remove(self, handles: Iterable[int]) -> None:
        """Take factors out."""
        gone = [self._factors.pop(handle) for handle in handles]
        self._gone += gone
        self._waiting = [handle for handle in self._waiting if handle in self._factors]
        self.changes += len(gone)

    def keep(self, window: gtsam.NonlinearFactorGraph, theta: gtsam.Values, left: Iterable[int]) -> None:
        """Take over the factors of an updated window, linearised at theta, and drop those of variables that left."""
        self._window, self._theta, self._waiting, self._gone = window, theta, [], []
        for key in left:
            for handle in self._handles.pop(key, ()):
                self._factors.pop(handle, None)
            self.changes += 1


@dataclass(frozen=True, eq=False)
class GraphEdit:
    """Exchange of factors for others."""

    removed: list[int]
    """Handles of factors that go."""
    added: list[list[gtsam.NonlinearFactor]]
    """Factors that come, in groups."""
    new_landmarks: dict[int, Floats]
    """Keys and first estimates of new landmarks."""
    lost_landmarks: list[int]
    """Keys of landmarks on which no factor is left."""


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

    def on(self, key: int) -> dict[int, gtsam.NonlinearFactor]:
        """The factors on a variable, by handle."""
        pairs = zip(self.handles, self.factors, strict=True)
        return {handle: factor for handle, factor in pairs if key in list(factor.keys())}

    def drop(self, handles: set[int], keys: set[int]) -> None:
        """Take factors and variables out again."""
        kept = [(handle, self.graph.at(i)) for i, handle in enumerate(self.handles) if handle not in handles]
        self.graph, self.handles = gtsam.NonlinearFactorGraph(), []
        for handle, factor in kept:
            self.add(factor, handle)
        for key in keys:
            if self.values.exists(key):
                self.values.erase(key)
