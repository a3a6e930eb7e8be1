"""Factors of the graph by handle, in groups that are used together or not at all, each factor with its label.

One store serves window and history: groups are new until the window has taken them up. Of a bounded window a group
leaves with the oldest pose of its factors, or bias where they have none: what it says is in marginals then.
"""

from collections import defaultdict
from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass

import gtsam

from sonar_graph.slam.smoother.batch_solution import Sightline, Sightlines
from sonar_graph.slam.smoother.variables import is_landmark, is_pose

Factors = dict[str, gtsam.NonlinearFactor]
"""Factors by their labels in messages, such as "range"."""


@dataclass(frozen=True, eq=False, slots=True)
class FactorGroup:
    """Factors that are used together or not at all, such as those of one sighting."""

    factors: Factors
    seen: tuple[int, Sightline] | None = None
    """Of a sighting: the key of its landmark, and where that was seen from."""

    def __iter__(self) -> Iterator[gtsam.NonlinearFactor]:
        return iter(self.factors.values())


class FactorStore:
    """Groups of factors in the order in which they came, each with a handle that stays the same."""

    def __init__(self) -> None:
        self.new: dict[int, FactorGroup] = {}
        """Groups that the window has not taken up yet, by handle."""
        self.new_graph = gtsam.NonlinearFactorGraph()
        """Their factors."""
        self.gone: set[gtsam.NonlinearFactor] = set()
        """Factors that were taken out since the window took up the others."""
        self.groups: dict[int, FactorGroup] = {}
        """All groups by handle."""
        self._leaving_with: dict[int, list[int]] = defaultdict(list)
        self._next = 0

    def add(self, group: FactorGroup) -> int:
        """Handle of a new group."""
        handle, self._next = self._next, self._next + 1
        self.groups[handle] = self.new[handle] = group
        for factor in group:
            self.new_graph.add(factor)
        if group.seen is not None:
            lasting = [group.seen[1].pose_key]
        else:
            keys = {key for factor in group for key in list(factor.keys())}
            poses = [key for key in keys if is_pose(key)]
            lasting = poses or [key for key in keys if not is_landmark(key)]
        if lasting:
            self._leaving_with[min(lasting)].append(handle)
        return handle

    def remove(self, handles: Iterable[int]) -> None:
        """Take groups out."""
        for handle in handles:
            self.new.pop(handle, None)
            group = self.groups.pop(handle)
            self.gone.update(group)
        self.new_graph = graph_of(self.new.values())

    def leave(self, keys: Iterable[int]) -> list[int]:
        """Drop the groups that leave with these variables; their handles."""
        left = []
        for key in keys:
            for handle in self._leaving_with.pop(key, ()):
                group = self.groups.pop(handle, None)
                if group is not None:
                    left.append(handle)
        return left

    def take_up(self) -> None:
        """The window has taken up what was new, and let go of what is gone."""
        self.new, self.gone, self.new_graph = {}, set(), gtsam.NonlinearFactorGraph()

    def factors(self, handles: Iterable[int]) -> list[gtsam.NonlinearFactor]:
        """Factors of some groups."""
        return [factor for handle in handles for factor in self.groups[handle]]

    def graph(self, left_out: Container[int] = ()) -> gtsam.NonlinearFactorGraph:
        """All factors but those of some handles."""
        return graph_of(group for handle, group in self.groups.items() if handle not in left_out)

    def __iter__(self) -> Iterator[FactorGroup]:
        return iter(self.groups.values())

    def sightlines(self) -> Sightlines:
        """All sightings, by landmark's key."""
        lines: dict[int, list[Sightline]] = defaultdict(list)
        for group in self:
            if group.seen is not None:
                lines[group.seen[0]].append(group.seen[1])
        return lines


def graph_of(groups: Iterable[FactorGroup]) -> gtsam.NonlinearFactorGraph:
    """Graph of the factors of some groups, in their order."""
    graph = gtsam.NonlinearFactorGraph()
    for group in groups:
        for factor in group:
            graph.add(factor)
    return graph
