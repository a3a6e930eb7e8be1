"""What is taken out of a graph, and what comes in its place."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from sonar_graph.measurements import Floats


@dataclass(frozen=True, eq=False)
class Exchange:
    """Some factors for others."""

    removed: list[int]
    """Handles of those that go."""
    added: list[list[gtsam.NonlinearFactor]]
    """Those that come, in groups."""
    new_landmarks: dict[int, Floats]
    """Keys and first estimates of landmarks that the graph has not yet got."""
    lost_landmarks: list[int]
    """Keys of those on which no factor is left."""
